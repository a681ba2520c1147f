"""Measures against their definitions, and the ablation in a form that takes seconds."""

import json

import pytest
import torch
from safetensors.torch import load_file
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal, kl_divergence

from dataset_builders.maze2d import build_maze2d
from lerobot_unimask import UniMASKConfig, UniMASKPolicy
from lerobot_unimask.cli import main
from lerobot_unimask.data.episodes import open_dataset
from lerobot_unimask.data.factors import Component, Output
from lerobot_unimask.measures import (
    _divergence,
    action_error,
    disagreement,
    error_ahead,
    latency,
    measure,
    unseen_windows,
)

EPISODES, LAST = 4, [2, 3]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return build_maze2d(tmp_path_factory.mktemp("maze") / "dataset", episodes=EPISODES, seed=0, progress=False)


@pytest.fixture
def make(root):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata("local/maze2d", root=root)

    def policy(**settings):
        small = {"width": 16, "depth": 1, "heads": 2, "feedforward_width": 16, "dropout": 0.0, "context_length": 8}
        config = UniMASKConfig(device="cpu", **(small | settings))
        config.set_dataset_feature_metadata(meta.features)
        torch.manual_seed(0)
        return UniMASKPolicy(config, dataset_stats=meta.stats).eval()

    return policy


def windows(policy, root):
    return unseen_windows(open_dataset(policy.config, root), policy.config.context_length, LAST)


def test_windows_are_full_and_of_these_episodes_alone(make, root):
    batch = windows(make(), root)
    assert set(batch["episode_index"].tolist()) == set(LAST)
    assert not batch["observation.state_is_pad"].any()
    with pytest.raises(ValueError, match="None of these episodes"):
        windows(make(context_length=300), root)


def test_the_error_ahead_is_the_distance_to_the_true_state(make, root):
    policy = make()
    batch = windows(policy, root)
    found = error_ahead(policy, batch, 3)  # from step 4 to step 7
    states = batch["observation.state"]
    answers = policy.infer(batch, "s[7] | s[:5], a[:4]").most_likely("s")[:, 7]
    assert found["model"] == pytest.approx((answers - states[:, 7]).norm(dim=1).mean().item())
    repeated = 4 * states[:, 4] - 3 * states[:, 3]
    assert found["last_displacement_repeated"] == pytest.approx(
        (repeated - states[:, 7]).norm(dim=1).mean().item(), rel=1e-4
    )
    assert found["windows"] == len(states)
    with pytest.raises(ValueError, match=r"context_length.* 9"):
        error_ahead(policy, batch, 7)


@pytest.mark.parametrize("head", ["gaussian", "mixture"])
def test_the_action_error_is_that_of_what_acting_does_at_each_step(make, root, head):
    policy = make(continuous_head=head)
    batch = windows(policy, root)
    actions = policy.make_window(batch).values["a"]
    steps = range(policy.config.context_length)
    answers = [policy.infer(batch, "behavior_cloning", t=t).carried_out("a")[:, t] for t in steps]
    error = (torch.stack(answers, dim=1) - actions) / policy.statistics.a_std
    assert action_error(policy, batch, "behavior_cloning") == pytest.approx(error.square().mean().item(), rel=1e-5)


def test_divergences_are_those_of_torch():
    torch.manual_seed(0)
    p, q = torch.randn(2, 20, 4)
    categorical = _divergence(p, q, Output((Component("a", slice(0, 1), 4),)))
    torch.testing.assert_close(categorical, kl_divergence(Categorical(logits=p), Categorical(logits=q)))
    gaussian = _divergence(p, q, Output((Component("a", slice(0, 2), None),), gaussians=1))
    normals = [Normal(x[:, :2], x[:, 2:].exp()) for x in (p, q)]
    torch.testing.assert_close(gaussian, kl_divergence(*normals).sum(-1))
    unit = _divergence(p, q, Output((Component("a", slice(0, 4), None),)))
    torch.testing.assert_close(unit, kl_divergence(Normal(p, 1.0), Normal(q, 1.0)).sum(-1))


def test_a_divergence_of_mixtures_is_that_of_their_draws():
    """Of mixtures whose Gaussians are all the same, in closed form."""
    torch.manual_seed(0)
    p, q = torch.randn(2, 20, 4) / 2
    output = Output((Component("a", slice(0, 2), None),), gaussians=3)
    wholes = [
        output.pack(torch.randn(20, 3), *(x[:, None, i : i + 2].expand(-1, 3, -1) for i in (0, 2))) for x in (p, q)
    ]
    normals = [Normal(x[:, :2], x[:, 2:].exp()) for x in (p, q)]
    expected = kl_divergence(*normals).sum(-1)
    torch.testing.assert_close(_divergence(*wholes, output).mean(), expected.mean(), atol=0.1, rtol=0)


@pytest.mark.parametrize("head", ["gaussian", "mixture"])
def test_the_density_ahead_is_that_of_the_answers_gaussians(head, make, root):
    policy = make(continuous_head=head)
    batch = windows(policy, root)
    said = policy.infer(batch, "s[7] | s[:6], a[:5]").distributions["s"][0]
    normals = Independent(Normal(said.means[:, 7], said.scales[:, 7]), 1)
    density = MixtureSameFamily(Categorical(said.weights[:, 7]), normals).log_prob(batch["observation.state"][:, 7])
    assert error_ahead(policy, batch, 2)["log_density"] == pytest.approx(density.mean().item(), rel=1e-4)


def test_directions_that_say_the_same_disagree_by_nothing(make, root):
    policy = make()
    batch = windows(policy, root)
    assert disagreement(policy, batch, "behavior_cloning") > 0
    for parameter in policy.network.heads["a"].parameters():
        torch.nn.init.zeros_(parameter)
    assert disagreement(policy, batch, "behavior_cloning") == 0


@pytest.mark.parametrize(
    ("settings", "ahead", "parts"),
    [
        ({}, 3, {"action_error", "ahead", "disagreement_nats"}),
        ({"attention": "bidirectional"}, 3, {"action_error", "ahead"}),
        ({}, 7, {"action_error", "disagreement_nats"}),
    ],
)
def test_a_record_holds_what_applies(make, root, settings, ahead, parts):
    policy = make(**settings)
    record = measure(policy, open_dataset(policy.config, root), LAST, ahead=ahead)
    assert set(record) == {"what", "units", "windows", "episodes", "trained_on_episodes", "latency"} | parts


def test_latency_is_a_median_between_quartiles(make, root):
    policy = make()
    timed = latency(policy, windows(policy, root), calls=5)
    assert 0 < timed["quartiles_ms"][0] <= timed["median_ms"] <= timed["quartiles_ms"][1]


def test_the_ablation_command_in_short(root, tmp_path, capsys):
    config = tmp_path / "short.yaml"
    config.write_text(f"""
name: short
variants:
  plain: {{fine_inputs: false}}
  zeros: {{}}
zero_hidden: zeros
context_lengths: [4, 6]
seeds: [0]
steps: 2
rollouts: 2
episodes: {EPISODES}
training_episodes: 2
measured_episodes: 1
ahead: 2
policy: {{device: cpu, width: 16, depth: 1, heads: 2, feedforward_width: 16, dropout: 0.0}}
data: {root}
output: {tmp_path / "out"}
""")
    main(["paper", "ablation", f"--config_path={config}"])
    record = json.loads((tmp_path / "out" / "short.json").read_text())
    assert [(run["row"], run["context_length"]) for run in record["runs"]] == [
        ("plain", 4), ("zeros", 4), ("plain", 6), ("zeros", 6),
    ]  # fmt: skip
    for run in record["runs"]:
        assert run["steps"] == 2
        assert run["episodes"] == 1 < EPISODES - 2
        assert set(run["returns"]) == {"behavior_cloning", "reward_conditioned"}
        cell = record["summary"][f"{run['row']}, K = {run['context_length']}"]
        assert cell["error_ahead"]["mean"] == pytest.approx(run["ahead"]["model"])
        assert cell["behavior_cloning"]["mean"] == pytest.approx(run["returns"]["behavior_cloning"]["mean_return"])
    hidden = {
        row: load_file(tmp_path / "out" / "checkpoints" / f"{row}-4-0" / "model.safetensors")[
            "network.embeddings.s.hidden"
        ]
        for row in ("plain", "zeros")
    }
    assert hidden["plain"].abs().min() > 0
    assert hidden["zeros"].abs().max() == 0
    assert (tmp_path / "out" / "short.png").stat().st_size > 10_000
    assert "| plain, K = 6 |" in capsys.readouterr().out
