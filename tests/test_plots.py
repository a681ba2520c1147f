"""Pictures have what a reader needs: labels, legends, and the numbers of the answer that they show."""

import dataclasses

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from policies import MAZE, MAZE_STATS, doorkey_policy, few_draws

from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey import panels as gridworld
from lerobot_unimask.envs.doorkey.episodes import rollout
from lerobot_unimask.envs.doorkey.pictures import (
    _draw_trajectories,
    draw_grid,
    draw_panels,
    state_distributions,
    trajectories,
)
from lerobot_unimask.envs.doorkey.rules import GOAL, HORIZON, coordinates
from lerobot_unimask.envs.maze2d.maze import MAZES
from lerobot_unimask.envs.maze2d.pictures import maze_trajectories
from lerobot_unimask.language.masks import tabulate
from lerobot_unimask.plots.answers import distributions, marginals, mask_diagram
from lerobot_unimask.plots.style import ASKED, LEAST, SHOWN, WALL, WIDTH, time_colours


@pytest.fixture(scope="module")
def policy():
    return doorkey_policy()


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
    draw_grid(axes)
    walls = [patch for patch in axes.patches if patch.get_facecolor() == to_rgba(WALL)]
    assert sorted(tuple(patch.get_center()) for patch in walls) == [(3, 2), (3, 3), (3, 4)]
    assert any(tuple(patch.get_center()) == (4, 4) and patch.get_alpha() for patch in axes.patches)
    assert axes.yaxis_inverted()  # y grows downwards
    assert axes.get_xticks().tolist() == axes.get_yticks().tolist() == [1, 2, 3, 4]


def test_five_panels_name_their_questions_and_what_came_of_them(policy):
    with few_draws():
        panels = gridworld.five_panels(policy)
    figure = draw_panels(panels)
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
        ({}, {"possible histories": 3, "tokens drawn": 57, "rejected": 3}, "3 possible histories"),
        ({}, {"possible histories": 0}, "no possible history found"),
    ],
)
def test_the_line_below_a_grid_says_what_came_of_the_question(given, achieved, line):
    figure = draw_panels([expert_panel(given=given, achieved=achieved)])
    assert figure.axes[0].get_xlabel() == line


def test_trajectories_stay_in_their_cells():
    panel = expert_panel()
    points = np.concatenate([panel.states] * 3)  # three trajectories that share every cell
    axes = Figure().subplots()
    _draw_trajectories(axes, points, time_colours(HORIZON))
    cells = coordinates(points[..., 0])
    ways = axes.collections
    lines = [way for way in ways if hasattr(way, "get_segments")]
    assert len(lines) == 3
    for n, line in enumerate(lines):
        drawn = np.array([segment[0] for segment in line.get_segments()])  # (T - 1, 2)
        assert (np.abs(drawn - np.stack(cells, axis=-1)[n, :-1]) < 0.5).all()
    firsts = [tuple(line.get_segments()[0][0]) for line in lines]
    assert len(set(firsts)) == 3  # apart from each other


def test_state_distributions_have_a_grid_for_each_step_with_its_probabilities(policy):
    answer = gridworld.predicted_states(policy)
    figure = state_distributions(answer)
    *grids, colorbar = figure.axes
    titles = [axes.get_title() for axes in grids]
    assert titles == [f"s[{at}]" + "  shown" * (at in gridworld.SHOWN_STATES) for at in range(HORIZON)]
    agent = answer["s"][0].probabilities[0].numpy()
    for at, axes in enumerate(grids):
        expected = [f"{p:.2f}" for p in agent[at] if p >= LEAST]
        assert texts_of(axes) == expected
    assert "probability" in colorbar.get_ylabel()
    assert legend_of(figure)[-1] == "shown"


def test_state_distributions_need_an_answer_about_every_state(policy):
    answer = policy.infer(None, "s[1] | s[0]", given={"s[0]": gridworld.START})
    with pytest.raises(ValueError, match=r"every state.*s\[2\]"):
        state_distributions(answer)


def test_a_mask_diagram_marks_every_token():
    mask = tabulate("a[t] | s[:t+1], a[:t], s[-1], rtg[0]", ("s", "a", "rtg"), 6).at(2)
    figure = mask_diagram(mask)
    axes = figure.axes[0]
    styles = {to_rgba(SHOWN["facecolor"]): "#", to_rgba(ASKED["facecolor"]): "?"}
    tokens = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    drawn = "".join(styles.get(token.get_facecolor(), ".") for token in tokens)
    rows = [f"{name} {drawn[6 * row : 6 * row + 6]}" for row, name in enumerate(("s", "a", "rtg"))]
    assert "  ".join(rows) == mask.draw() == "s ###..#  a ##?...  rtg #....."
    assert [label.get_text() for label in axes.get_yticklabels()] == ["s", "a", "rtg"]
    assert axes.get_xlabel() == "step"
    assert legend_of(figure) == ["shown", "asked for", "neither"]


def test_a_long_window_keeps_the_figure_s_width():
    mask = tabulate("behavior_cloning", ("s", "a"), 200).at(100)
    assert mask_diagram(mask).get_size_inches()[0] == WIDTH


# --- Samples, marginals and mazes ------------------------------------------------------------------------------------


def expert_states(episodes):
    played = rollout(episodes, np.random.default_rng(1))
    return np.stack([played.agent, played.key], axis=-1)[:, :HORIZON]


def test_trajectories_have_a_grid_for_each_group():
    states = expert_states(40)
    figure = trajectories({"one": states[:20], "two": states[20:]}, captions=["a", "b"], cell=0, most=15)
    one, two, colorbar = figure.axes
    assert [axes.get_title() for axes in (one, two)] == ["one", "two"]
    assert [axes.get_xlabel() for axes in (one, two)] == ["a", "b"]
    assert colorbar.get_ylabel() == "step"
    for axes, drawn in ((one, states[:15]), (two, states[20:35])):
        lines = [way for way in axes.collections if hasattr(way, "get_segments")]
        assert len(lines) == 15
        for line, way in zip(lines, drawn, strict=True):
            points = np.array([segment[0] for segment in line.get_segments()])
            cells = np.stack(coordinates(way[:-1, 0]), axis=-1)
            assert (np.abs(points - cells) < 0.5).all()  # the jitter leaves no cell
    assert legend_of(figure)[-1] == "the cell in question"
    assert "the cell in question" not in legend_of(trajectories({"one": states}))


def test_marginals_show_every_component_that_is_asked(policy):
    states = torch.tensor(expert_states(1)).float()
    window = Window(
        {"s": states, "a": torch.zeros(1, HORIZON, 1), "rtg": torch.zeros(1, HORIZON, 2)},
        torch.ones(1, HORIZON, dtype=torch.bool),
    )
    answer = policy.infer(window, "s[1:8], a[:3] | s[0]")
    figure = marginals(answer, window)
    *rows, colorbar = figure.axes
    assert [axes.get_ylabel() for axes in rows] == ["s: agent_cell", "s: key_cell", "a: direction"]
    assert rows[-1].get_xlabel() == "step"
    assert colorbar.get_ylabel() == "probability"
    agent = answer["s"][0].probabilities[0].T.numpy()
    np.testing.assert_array_equal(np.ma.filled(rows[0].images[0].get_array(), np.nan), agent)
    truth = rows[0].collections[0].get_offsets()
    np.testing.assert_array_equal(truth, [[step, states[0, step, 0]] for step in range(1, 8)])
    assert legend_of(figure) == ["shown", "recorded"]
    assert legend_of(marginals(answer)) == ["shown"]
    assert len(marginals(policy.infer(window, "a[0] | s[0]")).axes) == 2  # states are not asked


@pytest.mark.parametrize("kind", ["continuous", "gaussian"])
def test_marginals_of_numbers_are_lines(kind, tiny_policy, continuous_batch):
    policy = tiny_policy(kind)
    window = policy.make_window(continuous_batch)
    answer = policy.infer(window, "s[1:8] | s[0]")
    (axes,) = marginals(answer, window).axes
    assert [line.get_ydata()[4] for line in axes.lines] == pytest.approx(answer["s"][0].mean[0, 4].tolist())
    bands = [band for band in axes.collections if type(band).__name__ == "FillBetweenPolyCollection"]
    assert len(bands) == (3 if kind == "gaussian" else 0)


def test_distributions_are_shares_of_each_group(policy, tiny_policy, continuous_batch):
    states = torch.tensor(expert_states(30)).float()
    valid = torch.ones(30, HORIZON, dtype=torch.bool)
    valid[:, 8:] = False
    actions = torch.randint(4, (30, HORIZON, 1)).float()
    actions[:, 3] = torch.nan
    recorded = Window({"s": states, "a": actions}, valid)
    shifted = Window({"s": 15 - states, "a": actions}, valid)
    figure = distributions({"recorded": recorded, "shifted": shifted}, policy.factors)
    agent, key, direction = figure.axes
    assert [axes.get_xlabel() for axes in (agent, key, direction)] == ["s: agent_cell", "s: key_cell", "a: direction"]
    assert legend_of(figure) == ["recorded", "shifted"]
    share = np.bincount(states[:, :8, 1].flatten().long(), minlength=16) / 240
    heights = np.array([bar.get_height() for bar in key.patches]).reshape(2, 16)
    np.testing.assert_allclose(heights, [share, share[::-1]])
    assert sum(bar.get_height() for bar in direction.patches) == pytest.approx(2)
    continuous = tiny_policy("continuous")
    window = continuous.make_window(continuous_batch)
    labels = [axes.get_xlabel() for axes in distributions({"all": window}, continuous.factors).axes]
    assert labels[:5] == ["s: x", "s: y", "s: goal", "a: action.0", "a: action.1"]
    nothing = Window({name: values * torch.nan for name, values in window.values.items()}, window.valid)
    with pytest.raises(ValueError, match="nothing to draw"):
        distributions({"all": window, "none": nothing}, continuous.factors)


@pytest.mark.parametrize("kind", ["continuous", "gaussian"])
def test_maze_trajectories_stand_over_the_walls(kind, tiny_policy, tmp_path):
    policy = tiny_policy(kind, features=MAZE, stats=MAZE_STATS)
    states = torch.tensor([[4.8 - 0.05 * step, 0.8, 3.0, 2.0] for step in range(10)])[None]
    window = Window({"s": states, "a": torch.zeros(1, 10, 2)}, torch.ones(1, 10, dtype=torch.bool))
    answer = policy.infer(window, "s[:] | s[0], s[5]")
    figure = maze_trajectories(answer, window)
    figure.savefig(tmp_path / "maze.png")
    whole, close = figure.axes
    for axes in (whole, close):
        ellipses = [patch for patch in axes.patches if type(patch).__name__ == "Ellipse"]
        assert len(ellipses) == (8 if kind == "gaussian" else 0)  # none where shown
        drawn = np.stack(axes.lines[1].get_data(), axis=1)
        np.testing.assert_allclose(drawn, answer["s"][0].mean[0, :, :2].numpy(), rtol=1e-6)
    if kind == "gaussian":
        ellipse, scale = ellipses[0], answer["s"][0].scale[0, 1]
        assert (ellipse.width, ellipse.height) == pytest.approx((4 * scale[0].item(), 4 * scale[1].item()))
    assert ("two scales around it" in legend_of(figure)) == (kind == "gaussian")
    walls = [patch for patch in whole.patches if patch.get_facecolor() == to_rgba(WALL)]
    assert min(patch.get_center()[0] for patch in walls) == pytest.approx(-0.2)  # D4RL's quirk, see envs/maze2d.py
    assert len(walls) == MAZES["medium"].count("#")
