"""Every shipped config is one that its command reads, opens with the commands that use it, and fits the model."""

import shlex
import sys
from pathlib import Path

import pytest
import yaml
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_unimask import UniMASKConfig
from lerobot_unimask.cli import make_parser
from lerobot_unimask.language.masks import tabulate
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.paper.ablation import AblationConfig
from lerobot_unimask.paper.heatmap import HeatmapConfig
from lerobot_unimask.paper.search import SearchConfig, draw, nested
from lerobot_unimask.paper.study import read_config
from lerobot_unimask.paper.table import TableConfig

ROOT = Path(__file__).parents[1]
CONFIGS = sorted(path.relative_to(ROOT) for path in ROOT.glob("configs/*.yaml"))
TRAINING = [path for path in CONFIGS if "dataset" in yaml.safe_load((ROOT / path).read_text())]
GRIDS = [path for path in CONFIGS if path not in TRAINING]
GRID_OF = {"ablation": AblationConfig, "heatmap": HeatmapConfig, "search": SearchConfig, "table": TableConfig}


def opening(path: Path) -> list[str]:
    """The comment that a config opens with, without its hash signs."""
    lines = (ROOT / path).read_text().splitlines()
    end = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    return [line.removeprefix("#").strip() for line in lines[:end]]


@pytest.fixture(scope="module", params=TRAINING, ids=str)
def path(request):
    return request.param


@pytest.fixture(scope="module")
def config(path, tmp_path_factory):
    """As lerobot-train reads it, up to the point where it would load the dataset. Not to be written to."""
    register_third_party_plugins()
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(tmp_path_factory.mktemp("empty"))  # the output folder must not be there
        monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={ROOT / path}"])
        config = TrainPipelineConfig.from_pretrained(ROOT / path)
        config.validate()
    return config


def test_it_opens_with_the_commands_that_use_it(path, config):
    lines = opening(path)
    assert f"uv run lerobot-train --config_path={path}" in lines
    (build,) = (line for line in lines if line.startswith("uv run unimask build "))
    arguments = make_parser().parse_args(shlex.split(build)[3:])
    root = Path(config.dataset.root)
    if "uv run unimask prepare " in "\n".join(lines):
        text = " ".join(line.removesuffix("\\") for line in lines[lines.index(build) + 1 :])
        label = make_parser().parse_args(shlex.split(text.partition("uv run ")[2].partition(" uv run ")[0])[1:])
        assert label.root == arguments.root
        assert (label.output or label.root) == root
    else:
        assert arguments.root == root


def test_lerobot_reads_it_and_knows_each_setting(path, config):
    assert isinstance(config.policy, UniMASKConfig)
    assert not config.policy.push_to_hub
    assert config.num_workers == 0  # windows are read in batches, faster than a worker can pass them on
    assert config.output_dir == Path("outputs") / path.stem
    assert config.save_freq <= config.steps
    assert config.eval_steps == 0 or config.dataset.eval_split > 0


def test_its_masks_fit_its_window(config):
    policy = config.policy
    factors = ("s", "a", "rtg", *(name.removeprefix("observation.") for name in policy.properties))
    cameras = ("top",)  # what the environments' datasets may have
    assert TrainingMasks(policy.training_masks, factors, policy.context_length, cameras=cameras).weights
    steps = tabulate(policy.inference_mask, factors, policy.context_length, cameras).t.tolist()
    assert steps == list(range(policy.context_length))


@pytest.mark.parametrize("path", GRIDS, ids=str)
def test_a_grid_opens_with_its_command_which_reads_it(path):
    (command,) = (line for line in opening(path) if line.startswith("uv run unimask paper "))
    arguments = make_parser().parse_args(shlex.split(command)[3:])
    assert arguments.config_path == path
    config = read_config(GRID_OF[arguments.part], ROOT / path)
    assert config.name == path.stem
    variants = getattr(config, "variants", {"all": {}})
    drawn = [nested(settings) for settings in draw(getattr(config, "space", {}), getattr(config, "draws", 1))]
    for settings in variants.values():
        for more in drawn:
            UniMASKConfig(**{**config.policy, **settings, **{k: v for k, v in more.items() if k != "batch_size"}})
