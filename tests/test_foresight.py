"""How well properties are foretold: against numbers that are known, and of the optimum, which is right on average."""

from functools import partial

import numpy as np
import pytest
import torch

from lerobot_unimask.asking.answers import Answer, ContinuousDistribution, DiscreteDistribution, answer
from lerobot_unimask.asking.foresight import foretold
from lerobot_unimask.data.factors import Feature, make_factors
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey.episodes import rollout
from lerobot_unimask.envs.doorkey.optimum import Optimum
from lerobot_unimask.envs.doorkey.rules import GOAL
from lerobot_unimask.plots.reliability import FEW, reliability

K = 6


def window_with(name, truth):
    """A window of B episodes whose property is `truth`, (B,)."""
    nothing = torch.zeros(len(truth), K, 1)
    values = {"s": nothing, "a": nothing, name: truth.float()[:, None, None].expand(-1, K, 1)}
    return Window(values, torch.ones(len(truth), K, dtype=torch.bool))


def test_a_category_is_measured_as_it_is_said():
    """Four windows that are said to have it with 0.8, 0.8, 0.2 and 0.9; the last two have it."""
    says = torch.tensor([0.8, 0.8, 0.2, 0.9])
    window = window_with("won", torch.tensor([0, 0, 1, 1]))
    output = make_factors({"won": [Feature("observation.won", 1, [2])]})["won"].outputs[0]

    def ask(window, mask):
        probabilities = torch.stack([1 - says, says], dim=-1)[:, None].expand(-1, K, -1)
        return Answer(mask, {"won": [DiscreteDistribution(output, probabilities)]})

    first, *_ = found = foretold(ask, window, "won")
    assert [entry["t"] for entry in found] == [0, 2, 4]
    assert first["error"] == pytest.approx(3 / 4)
    assert first["log_loss"] == pytest.approx(-(np.log(0.2) * 3 + np.log(0.9)) / 4)
    bins = first["calibration"]
    assert bins["predicted"] == pytest.approx([0.2, 0.8, 0.9])
    assert bins["happened"] == [1, 0, 1]
    assert bins["count"] == [1, 2, 1]
    assert first["calibration_error"] == pytest.approx((0.8 + 2 * 0.8 + 0.1) / 4)


@pytest.mark.parametrize(("stretched", "least", "most"), [(1, 0, 0.01), (3, 0.05, 1)])
def test_a_density_is_calibrated_if_it_is_that_of_the_data(stretched, least, most):
    generator = torch.Generator().manual_seed(0)
    mean, scale = torch.randn(4000, generator=generator), 0.5
    window = window_with("rtg", mean + scale * torch.randn(4000, generator=generator))
    output = make_factors({"pay": [Feature("observation.pay", 1)]}, gaussians=1)["pay"].outputs[0]

    def ask(window, mask):
        means = mean.view(-1, 1, 1, 1).expand(-1, K, 1, 1)
        ones = torch.ones_like(means)
        said = ContinuousDistribution(output, ones[..., 0], means, ones * scale * stretched)
        return Answer(mask, {"rtg": [said]})

    found = foretold(ask, window, "rtg")[0]
    assert found["mean_absolute_error"] == pytest.approx(scale * np.sqrt(2 / np.pi), rel=0.03)
    assert least <= found["calibration_error"] <= most


@pytest.fixture(scope="module")
def of_the_optimum():
    episodes = rollout(1500, np.random.default_rng(4))
    values = {
        "s": torch.from_numpy(np.stack([episodes.agent, episodes.key], axis=-1)[:, :10]).float(),
        "a": torch.from_numpy(episodes.action).float()[..., None],
        "rtg": torch.zeros(1500, 10, 2),
        "success": torch.from_numpy((episodes.agent == GOAL).any(1)).float()[:, None, None].expand(-1, 10, 1),
    }
    values["rtg"][:, 0, 0] = torch.from_numpy(episodes.reward.sum(1)).float()
    window = Window(values, torch.ones(1500, 10, dtype=torch.bool))
    ask = partial(answer, Optimum(properties=["success"]))
    return {name: foretold(ask, window, name) for name in ("rtg", "success")}


@pytest.mark.parametrize("name", ["rtg", "success"])
def test_the_optimum_is_right_on_average_and_the_more_so_the_more_it_sees(name, of_the_optimum):
    found = of_the_optimum[name]
    assert all(entry["calibration_error"] < 0.02 for entry in found)
    errors = [entry.get("mean_absolute_error", entry.get("log_loss")) for entry in found]
    assert errors == sorted(errors, reverse=True)
    assert len(set(errors)) == 3


def test_the_diagram_has_a_line_for_each_time(of_the_optimum):
    record = {"runs": [{"foretold": of_the_optimum}], "optimum": {"foretold": of_the_optimum}}
    panels = reliability(record).axes
    assert [axes.get_title() for axes in panels] == ["rtg", "success"]
    for axes, name in zip(panels, of_the_optimum, strict=True):
        for line, entry in zip(axes.lines[1:], of_the_optimum[name] * 2, strict=True):
            bins = entry["calibration"]
            drawn = [y for y, count in zip(bins["happened"], bins["count"], strict=True) if count >= FEW]
            assert line.get_ydata().tolist() == drawn
    with pytest.raises(ValueError, match="no calibration"):
        reliability({"runs": [{"foretold": {}}]})
