"""Training updates captured by torch.compile: whole, with eager's losses, eager where a batch does not fit."""

import copy
import functools
import os
import traceback

import pytest
import torch
from policies import CONTINUOUS_FEATURES
from torch._subclasses.fake_tensor import FakeTensorMode

from lerobot_unimask import objective
from lerobot_unimask.modeling_unimask import UniMASKPolicy

TOP = "observation.images.top"
CAMERA = {TOP: {"dtype": "video", "shape": (24, 32, 3), "names": ["height", "width", "channels"]}}
NETWORKS = {
    "both": {"attention": "both"},
    "seeing": {"features": CONTINUOUS_FEATURES | CAMERA, "image_size": [24, 32]},
    "stacked": {"attention": "bidirectional", "token_layout": "stacked"},
    "causal": {"attention": "causal", "training_masks": "behavior_cloning"},
    "feedforward": {"network": "feedforward"},
    "decision_transformer": {"network": "decision_transformer", "training_masks": "behavior_cloning"},
}


def alone(test):
    """A test in a forked process: after torch.compile has been at work, autograd refuses what is forked from a process,
    and so would the trainings that other tests fork."""

    @functools.wraps(test)
    def forked(**fixtures):
        child = os.fork()
        if child == 0:
            # Torch makes its pool of threads anew after a fork when it is first asked for, and two that ask at once get
            # none ("Invalid thread pool"): one asks before there are others.
            torch.set_num_threads(torch.get_num_threads())
            try:
                test(**fixtures)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0

    return forked


def updates(policy, batches):
    """The losses of one update on each batch."""
    policy.train()
    optimiser = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    losses = []
    for batch in batches:
        loss, _ = policy(batch)
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
        policy.update()
        losses.append(loss.item())
    return torch.tensor(losses)


@pytest.fixture
def capture(monkeypatch):
    """capture(backend): updates are captured whole, or fail, by this backend; returns a list of the captured graphs."""

    def set_backend(backend):
        torch._dynamo.reset()
        graphs = []
        compiler = torch._dynamo.lookup_backend(backend)

        def counting(graph, inputs, **keywords):
            graphs.append(graph)
            return compiler(graph, inputs, **keywords)

        captured = torch.compile(objective.batch_loss, fullgraph=True, dynamic=False, backend=counting)
        monkeypatch.setattr(objective, "_captured", lambda mode: captured)
        return graphs

    return set_backend


def pair(tiny_policy, kind, **settings):
    """Two policies of the same weights: one whose updates are captured, one whose are not."""
    captured, eager = (tiny_policy(kind, dropout=0.0, compile_model=c, **settings) for c in (True, False))
    eager.load_state_dict(captured.state_dict())
    return captured, eager


@pytest.mark.parametrize("settings", [pytest.param(s, id=n, marks=pytest.mark.slow) for n, s in NETWORKS.items()])
@alone
def test_an_update_is_one_graph_with_eagers_losses(tiny_policy, batch_of, capture, settings):
    graphs = capture("aot_eager")
    captured, eager = pair(tiny_policy, "gaussian", **settings)
    batch = batch_of("gaussian")
    pictures = torch.randint(256, (5, 10, 3, 24, 32), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    batches = [{**batch, **dict.fromkeys(settings.get("features", {}).keys() & {TOP}, pictures)}] * 5
    torch.testing.assert_close(updates(captured, batches), updates(eager, batches), rtol=1e-4, atol=1e-4)
    assert len(graphs) == 1


def test_a_loss_is_one_graph(tiny_policy, batch_of, capture):
    """Without a backward pass, which would keep this process from forking trainings."""
    graphs = capture("eager")
    captured, eager = pair(tiny_policy, "gaussian")
    with torch.no_grad():
        losses = [policy.train()(batch_of("gaussian"))[0] for policy in (captured, eager)]
    torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-4)
    assert len(graphs) == 1


@pytest.fixture
def on_gpu(tiny_policy, batch_of):
    """A policy and a batch on a GPU that is not there: PyTorch's fake tensors have devices and shapes, and refuse two
    devices at once and whatever a processor would have to wait for."""
    overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    policy = tiny_policy("gaussian", dropout=0.1)
    batch = {key: value for key, value in batch_of("gaussian").items() if isinstance(value, torch.Tensor)}
    with FakeTensorMode() as mode:
        policy._apply(lambda tensor: mode.from_tensor(tensor).to("cuda"))
        yield policy.train(), {key: mode.from_tensor(value).to("cuda") for key, value in batch.items()}
    torch.__future__.set_overwrite_module_params_on_conversion(overwrites)


@pytest.mark.slow
@torch.no_grad()
def test_on_a_gpu_a_loss_is_one_graph_of_that_gpus_tensors(on_gpu, capture):
    graphs = capture("eager")
    policy, batch = on_gpu
    policy._batch_loss.required = True
    assert policy(batch)[0].device.type == "cuda"
    (graph,) = graphs
    values = [node.meta.get("example_value") for node in graph.graph.nodes]
    devices = {value.device.type for value in values if isinstance(value, torch.Tensor)}
    assert devices == {"cuda"}


@torch.no_grad()
def test_on_a_gpu_updates_are_captured_once_there_have_been_some_and_an_error_ends_that(on_gpu, monkeypatch, caplog):
    policy, batch = on_gpu
    tried = []

    def fail(*_):
        tried.append(policy._batch_loss.seen)
        raise RuntimeError("no compiler\nand more")

    monkeypatch.setattr(objective, "EAGER", 2)
    monkeypatch.setattr(objective, "_captured", lambda mode: fail)
    for _ in range(5):
        assert policy(batch)[0].device.type == "cuda"
    policy(batch, reduction="none")
    assert tried == [3]
    assert caplog.messages == ["Updates are not captured, and run as they did before: no compiler"]


@pytest.mark.slow
@alone
def test_a_batch_that_does_not_fit_runs_eagerly(tiny_policy, batch_of, capture, monkeypatch):
    """Captured as on a GPU where nobody requires it: after a rehearsal, which changes nothing."""
    graphs = capture("eager")
    monkeypatch.setattr(objective.CapturedLoss, "_captures", lambda *_: True)
    batch = batch_of("doorkey")
    small = {key: value[:3] for key, value in batch.items()}
    captured, eager = pair(tiny_policy, "doorkey")
    captured._batch_loss.required = False
    batches = [batch, small, batch]
    torch.testing.assert_close(updates(captured, batches), updates(eager, batches), rtol=1e-4, atol=1e-4)
    assert captured._batch_loss.rehearsed
    assert not captured._batch_loss.failed
    assert len(graphs) == 1
    each, _ = captured(batch, reduction="none")
    assert each.shape == (len(batch["index"]),)
    captured.eval()
    assert captured(batch)[0].isfinite()
    assert len(graphs) == 1


@pytest.mark.slow
@alone
def test_a_captured_policy_is_saved_loaded_and_copied(tiny_policy, batch_of, capture, tmp_path):
    capture("eager")
    batch = batch_of("doorkey")
    captured, eager = pair(tiny_policy, "doorkey")
    for policy, name in ((captured, "captured"), (eager, "eager")):
        updates(policy, [batch] * 2)
        policy.save_pretrained(tmp_path / name)
    files = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("captured", "eager")]
    assert files[0] == files[1]
    assert captured.state_dict().keys() == eager.state_dict().keys()
    resumed = UniMASKPolicy.from_pretrained(tmp_path / "captured")
    assert resumed.config.compile_model
    twin = copy.deepcopy(captured)
    expected = updates(captured, [batch] * 2)
    assert torch.equal(updates(resumed, [batch] * 2)[:1], expected[:1])
    assert torch.equal(updates(twin, [batch] * 2)[:1], expected[:1])


@pytest.mark.slow
@alone
def test_a_hundred_compiled_updates_have_eagers_losses(tiny_policy, batch_of, capture):
    capture("inductor")
    captured, eager = pair(tiny_policy, "gaussian")
    batches = [batch_of("gaussian")] * 100
    torch.testing.assert_close(updates(captured, batches), updates(eager, batches), rtol=1e-4, atol=1e-4)
