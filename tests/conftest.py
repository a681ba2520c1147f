"""What the tests share: a small DoorKey dataset and policies that are made in milliseconds."""

import os

os.environ["HF_HUB_OFFLINE"] = "1"  # read when huggingface_hub is imported

import pytest
import torch
from policies import CONTINUOUS_FEATURES, CONTINUOUS_STATS, KINDS, LAYOUTS, SMALL, Episode

torch.set_num_threads(1)  # two threads beside another busy process are many times slower than one

EPISODES = 30

# --- Processor time, which does not depend on who else is at work; processes that tests start count too ---------------

SPENT = {}  # test -> seconds, its fixtures' included


def processor_seconds():
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    before = processor_seconds()
    try:
        return (yield)
    finally:
        SPENT[item.nodeid] = processor_seconds() - before


def pytest_addoption(parser):
    parser.addoption("--costly", type=int, default=0, metavar="N", help="list the N tests of most processor time")


def pytest_terminal_summary(terminalreporter, config):
    terminalreporter.write_line(f"{processor_seconds():.0f} s of processor time, {sum(SPENT.values()):.0f} s in tests")
    for test in sorted(SPENT, key=SPENT.get, reverse=True)[: config.getoption("--costly")]:
        terminalreporter.write_line(f"{SPENT[test]:8.2f} s  {test}")


# --- What tests share ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session", autouse=True)
def plugin():
    """Policy and environments are registered, as by LeRobot's discovery."""
    import lerobot_policy_unimask  # noqa: F401 (not above: hub_flow.py sets up what huggingface_hub reads first)


@pytest.fixture(scope="session")
def doorkey_root(tmp_path_factory):
    """The folder of a DoorKey dataset of 30 episodes. Not to be written to."""
    from dataset_builders.doorkey import build_doorkey

    return build_doorkey(tmp_path_factory.mktemp("doorkey") / "dataset", episodes=EPISODES, progress=False)


@pytest.fixture(scope="session")
def load_doorkey(doorkey_root):
    """load_doorkey(context_length=10) -> LeRobotDataset whose items are windows."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_unimask.envs.doorkey.rules import FPS

    def load(context_length=10):
        seconds = [step / FPS for step in range(context_length)]
        keys = ("observation.state", "action", "observation.return_to_go")
        return LeRobotDataset("local/doorkey", root=doorkey_root, delta_timestamps=dict.fromkeys(keys, seconds))

    return load


@pytest.fixture(scope="session")
def doorkey(load_doorkey):
    """The dataset as a model of context length 10 reads it. Its `meta` has the features and the statistics."""
    return load_doorkey()


@pytest.fixture(scope="session")
def doorkey_batch(doorkey):
    """A LeRobot batch of eight windows: six full ones and two that run past the end of their episode."""
    from torch.utils.data import default_collate

    return default_collate([doorkey[i] for i in (0, 10, 20, 30, 40, 50, 64, 79)])


@pytest.fixture(scope="session")
def continuous_batch():
    """A LeRobot batch of five windows of ten steps of `CONTINUOUS_FEATURES`; the last one has four valid steps."""
    generator = torch.Generator().manual_seed(0)
    batch = {"index": torch.arange(5), "timestamp": torch.tensor([0.0, 0.1, 1.0, 2.5, 4.4])}
    for key in ("observation.state", "action", "observation.return_to_go"):
        mean, std = (torch.tensor(CONTINUOUS_STATS[key][name]) for name in ("mean", "std"))
        value = mean + std * torch.randn(5, 10, len(mean), generator=generator)
        batch[key] = value.squeeze(-1)
        batch[f"{key}_is_pad"] = torch.zeros(5, 10, dtype=torch.bool)
        batch[f"{key}_is_pad"][4, 4:] = True
    return batch


@pytest.fixture(scope="session")
def tiny_policy(doorkey):
    """tiny_policy(**settings) -> an untrained DoorKey policy in evaluation mode; same settings, same weights.

    `kind="continuous"` makes one of `CONTINUOUS_FEATURES` with an L2 head, `kind="gaussian"` with a Gaussian one;
    `features` and `stats` replace those of the dataset.
    """
    from lerobot_unimask import UniMASKConfig, UniMASKPolicy

    def make(kind="doorkey", *, features=None, stats=None, **settings):
        if kind == "continuous":
            settings = {"continuous_head": "l2"} | settings
        if kind != "doorkey":
            features, stats = features or CONTINUOUS_FEATURES, stats or CONTINUOUS_STATS
        config = UniMASKConfig(device="cpu", **(SMALL | {"dropout": 0.0} | settings))
        config.set_dataset_feature_metadata(features or doorkey.meta.features)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            return UniMASKPolicy(config, dataset_stats=stats or doorkey.meta.stats).eval()

    return make


@pytest.fixture
def losses(monkeypatch):
    """Every training loss of the runs that follow in this process, at full precision."""
    from lerobot_unimask import UniMASKPolicy

    recorded = []
    forward = UniMASKPolicy.forward

    def recording(self, batch):
        loss, parts = forward(self, batch)
        if self.training:
            recorded.append(loss.item())
        return loss, parts

    monkeypatch.setattr(UniMASKPolicy, "forward", recording)
    return recorded


@pytest.fixture
def refused(capsys):
    """refused("query", ...) -> what `unimask` says on standard error as it ends with status 2, having said nothing
    else; any other exception would be a traceback for the user."""
    from lerobot_unimask import cli

    def run(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main([str(argument) for argument in arguments])
        assert ended.value.code == 2
        said = capsys.readouterr()
        assert not said.out
        return said.err

    return run


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return request.param


@pytest.fixture
def batch_of(doorkey_batch, continuous_batch):
    return lambda kind: doorkey_batch if kind == "doorkey" else continuous_batch


@pytest.fixture
def states():
    """Six steps of four environments."""
    return Episode("continuous", 4, 6).states
