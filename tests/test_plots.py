"""Pictures have what a reader needs: labels, legends, and the numbers of the answer that they show."""

import dataclasses

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dataset_builders.doorkey import FEATURES, rollout
from lerobot_unimask import UniMASKConfig, UniMASKPolicy, plots
from lerobot_unimask.envs.doorkey import GOAL, HORIZON
from lerobot_unimask.experiments import gridworld
from lerobot_unimask.masks import tabulate


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(0)
    config = UniMASKConfig(device="cpu", width=16, depth=1, heads=2, feedforward_width=16)
    config.set_dataset_feature_metadata(FEATURES)
    return UniMASKPolicy(config)


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def texts_of(axes):
    return [text.get_text() for text in axes.texts]


def expert_panel(**changes):
    """A panel with a trajectory that the expert walked."""
    episodes = rollout(1, np.random.default_rng(3))
    states = np.stack([episodes.agent, episodes.key], axis=-1)[:, :HORIZON].tolist()
    panel = gridworld.Panel("Imitation", "a[t] | s[:t+1], a[:t]", {}, states, episodes.action.tolist(), {})
    return dataclasses.replace(panel, **changes)


def test_the_grid_shows_walls_door_and_goal():
    axes = Figure().subplots()
    plots.draw_grid(axes)
    walls = [patch for patch in axes.patches if patch.get_facecolor() == to_rgba(plots.WALL)]
    assert sorted(tuple(patch.get_center()) for patch in walls) == [(3, 2), (3, 3), (3, 4)]
    assert any(tuple(patch.get_center()) == (4, 4) and patch.get_alpha() for patch in axes.patches)
    assert axes.yaxis_inverted()  # y grows downwards
    assert axes.get_xticks().tolist() == axes.get_yticks().tolist() == [1, 2, 3, 4]


def test_five_panels_name_their_questions_and_what_came_of_them(policy, tmp_path):
    panels = gridworld.five_panels(policy)
    figure = plots.five_panels(panels)
    figure.savefig(tmp_path / "five.png")
    *grids, colorbar = figure.axes
    assert len(grids) == 5
    for number, (axes, panel) in enumerate(zip(grids, panels, strict=True), start=1):
        assert f"({number}) {panel.name}" in texts_of(axes)
        assert axes.get_title() == panel.question
        given_states = [token for token in panel.given if token.startswith("s")]
        assert [text for text in texts_of(axes) if text.startswith("s[")] == given_states
    assert colorbar.get_ylabel() == "step"
    assert legend_of(figure) == [
        "wall",
        "door, locked",
        "goal",
        "key at the start",
        "first state",
        "last state",
        "state given in advance",
    ]


@pytest.mark.parametrize(
    ("given", "achieved", "line"),
    [
        ({}, {"return": [7.0], "success": [True]}, "returned 7, goal reached"),
        ({}, {"return": [0.0], "success": [False]}, "returned 0, goal missed"),
        (
            {"s[-1]": [GOAL, GOAL]},
            {"return": [-1.0], "success": [False], "s[-1] reached": [False]},
            "s[-1] missed, returned -1",
        ),
        ({"s[3]": [5, 5]}, {"return": [2.0], "success": [True], "s[3] reached": [True]}, "s[3] reached, returned 2"),
        ({"rtg[0]": 2.0}, {"return": [3.0], "success": [False]}, "asked for 2, returned 3"),
        ({}, {"samples": 100, "possible": 43, "impossible_steps": [0]}, "43 of 100 samples possible"),
    ],
)
def test_the_line_below_a_grid_says_what_came_of_the_question(given, achieved, line):
    figure = plots.five_panels([expert_panel(given=given, achieved=achieved)])
    assert figure.axes[0].get_xlabel() == line


def test_trajectories_stay_in_their_cells():
    panel = expert_panel()
    points = np.concatenate([panel.states] * 3)  # three trajectories that share every cell
    axes = Figure().subplots()
    plots._draw_trajectories(axes, points, plots._time(HORIZON))
    cells = plots.coordinates(points[..., 0])
    ways = axes.collections
    lines = [way for way in ways if hasattr(way, "get_segments")]
    assert len(lines) == 3
    for n, line in enumerate(lines):
        drawn = np.array([segment[0] for segment in line.get_segments()])  # (T - 1, 2)
        assert (np.abs(drawn - np.stack(cells, axis=-1)[n, :-1]) < 0.5).all()
    firsts = [tuple(line.get_segments()[0][0]) for line in lines]
    assert len(set(firsts)) == 3  # apart from each other


def test_state_distributions_have_a_grid_for_each_step_with_its_probabilities(policy, tmp_path):
    answer = gridworld.predicted_states(policy)
    figure = plots.state_distributions(answer)
    figure.savefig(tmp_path / "states.png")
    *grids, colorbar = figure.axes
    titles = [axes.get_title() for axes in grids]
    assert titles == [f"s[{at}]" + "  shown" * (at in gridworld.SHOWN_STATES) for at in range(HORIZON)]
    agent = answer["s"][0].probabilities[0].numpy()
    for at, axes in enumerate(grids):
        expected = [f"{p:.2f}" for p in agent[at] if p >= plots.LEAST]
        assert texts_of(axes) == expected
    assert "probability" in colorbar.get_ylabel()
    assert legend_of(figure)[-1] == "shown"


def test_state_distributions_need_an_answer_about_every_state(policy):
    answer = policy.infer(None, "s[1] | s[0]", given={"s[0]": gridworld.START})
    with pytest.raises(ValueError, match=r"every state.*s\[2\]"):
        plots.state_distributions(answer)


def test_a_mask_diagram_marks_every_token():
    mask = tabulate("a[t] | s[:t+1], a[:t], s[-1], rtg[0]", ("s", "a", "rtg"), 6).at(2)
    figure = plots.mask_diagram(mask)
    axes = figure.axes[0]
    styles = {to_rgba(plots.SHOWN["facecolor"]): "#", to_rgba(plots.ASKED["facecolor"]): "?"}
    tokens = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    drawn = "".join(styles.get(token.get_facecolor(), ".") for token in tokens)
    rows = [f"{name} {drawn[6 * row : 6 * row + 6]}" for row, name in enumerate(("s", "a", "rtg"))]
    assert "  ".join(rows) == mask.draw() == "s ###..#  a ##?...  rtg #....."
    assert [label.get_text() for label in axes.get_yticklabels()] == ["s", "a", "rtg"]
    assert axes.get_xlabel() == "step"
    assert legend_of(figure) == ["shown", "asked for", "neither"]


def test_a_long_window_keeps_the_figure_s_width():
    mask = tabulate("behavior_cloning", ("s", "a"), 200).at(100)
    assert plots.mask_diagram(mask).get_size_inches()[0] == plots.WIDTH
