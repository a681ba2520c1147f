"""The gallery in `docs/`: each picture with the question behind it, all drawn anew by one command."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from lerobot_unimask.data.factors import STATE
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs.doorkey.panels import (
    BACKWARDS_GIVEN,
    BACKWARDS_QUESTION,
    five_panels,
    predicted_states,
)
from lerobot_unimask.envs.doorkey.pictures import draw_panels, state_distributions, trajectories
from lerobot_unimask.envs.doorkey.rules import GOAL, START_PAIRS, DynamicsCheck
from lerobot_unimask.envs.maze2d.pictures import draw_ways, maze_trajectories
from lerobot_unimask.language.masks import tabulate
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.paper.questions import (
    CORNER,
    IMITATION,
    PROPERTY,
    PROPERTY_QUESTION,
    possible_steps,
    rollout,
)
from lerobot_unimask.plots.answers import distributions, marginals, mask_diagram

DOTS_PER_INCH = 180

COLOURS = 128  # of a PNG's palette; enough for these drawings, at a third of the size

LARGEST = 150 * 1024  # bytes


@dataclass(frozen=True)
class Picture:
    """One picture: the file's name, a title, what it shows, and what draws it."""

    name: str
    title: str
    text: str
    figure: Figure


def doorkey_pictures(policy: UniMASKPolicy, batch: dict[str, torch.Tensor]) -> Iterator[Picture]:
    """Every picture of a DoorKey policy.

    Args:
        batch: first windows of recorded episodes.
    """
    factors, K = tuple(policy.factors), policy.config.context_length
    text = "waypoint_conditioned"
    yield Picture(
        "mask",
        "A mask",
        f"`{text}` at t = 4: the model sees the past and the waypoints, and is asked for one action.",
        mask_diagram(tabulate(text, factors, K).at(4)),
    )
    window = policy.make_window({key: value[:1] for key, value in batch.items()}, partial=True)
    text = "s[1:9], a[:9] | s[0], s[3], s[6]"
    yield Picture(
        "marginals",
        "Marginals",
        f"`{text}`, the first recorded episode: the picture for models of any kind.",
        marginals(policy.infer(window, text), window),
    )
    answer = predicted_states(policy)
    yield Picture(
        "state_distributions",
        "Predicted states",
        "`s[:] | s[0], s[3], s[6]`: where the agent was, is and will be.",
        state_distributions(answer),
    )
    yield Picture(
        "five_panels",
        "Five questions",
        "The paper's gridworld figure: rollouts of the most likely actions, and histories sampled backwards.",
        draw_panels(five_panels(policy)),
    )
    yield _backwards(policy)
    yield _distributions(policy, batch)
    if PROPERTY in policy.factors:
        yield _property(policy)


def _backwards(policy: UniMASKPolicy) -> Picture:
    """Histories of reaching the goal, with and without the check."""
    groups, captions = {}, []
    for name, check in {"as drawn": None, "with the dynamics check": DynamicsCheck(agree=True)}.items():
        drawn = policy.sample(
            None, BACKWARDS_QUESTION, given=BACKWARDS_GIVEN, samples=200, order="backward", check=check
        )
        states = drawn.values["s"].long().numpy(force=True)
        possible = possible_steps(states, drawn.values["a"][:, :-1, 0].long().numpy(force=True)).all(axis=1).mean()
        groups[name] = states
        captions.append(
            f"{possible:.0%} of 200 possible" + f", acceptance {drawn.acceptance:.1%}" * (check is not None)
        )
    text = (
        f"`{BACKWARDS_QUESTION}`, given the goal, cell {GOAL}, with the key: twelve of two hundred histories, drawn "
        "from the end to the start. With the check, tokens that contradict the rules are drawn again."
    )
    return Picture("backwards", "Histories, backwards", text, trajectories(groups, captions=captions))


def _distributions(policy: UniMASKPolicy, batch: dict[str, torch.Tensor]) -> Picture:
    """Recorded episodes beside samples from their starts."""
    recorded = policy.make_window(batch, partial=True)
    question = "s[1:], a[:] | s[0]"
    groups: dict[str, Window] = {"recorded": recorded, "sampled": policy.sample(recorded, question)}
    text = (
        f"`{question}`: states and actions of {len(recorded.valid)} recorded episodes, beside as many sampled forward "
        "from the same starts."
    )
    return Picture("distributions", "Data and samples", text, distributions(groups, policy.factors))


def _property(policy: UniMASKPolicy) -> Picture:
    """Rollouts asked to visit the corner, and not to (the paper's property figure)."""
    starts = START_PAIRS[(START_PAIRS != CORNER).all(axis=1)]
    starts = np.random.default_rng(0).permutation(starts.repeat(10, axis=0))
    asked = {"imitation": None, "asked to visit the corner": 1, "asked not to": 0}
    groups, captions = {}, []
    for name, value in asked.items():
        question = IMITATION if value is None else PROPERTY_QUESTION
        given = {} if value is None else {f"{PROPERTY}[0]": value}
        groups[name] = rollout(policy, starts, question, given, seed=0).states
        share = (groups[name][..., 0] == CORNER).any(axis=1).mean()
        captions.append(f"{share:.0%} of {len(starts)} rollouts visit it")
    text = f"`{PROPERTY_QUESTION}` with 1 and with 0, beside imitation; sampled actions, twelve rollouts of each."
    figure = trajectories(groups, captions=captions, cell=CORNER)
    return Picture("property", "A property", text, figure)


def maze_pictures(
    policy: UniMASKPolicy, batch: dict[str, torch.Tensor], starts: torch.Tensor, *, walls: str = "medium"
) -> Iterator[Picture]:
    """The pictures of a Maze2D policy: the way through a window, its ends and middle shown; and where episodes begin.

    Args:
        batch: recorded windows, of which the one with the longest way is drawn.
        starts: (E, 4), the episodes' first states, of which nine are drawn.
        walls: the maze's name or text.
    """
    way = (batch[STATE][:, -1, :2] - batch[STATE][:, 0, :2]).norm(dim=-1)
    chosen = int(way.argmax())
    window = policy.make_window({key: value[chosen : chosen + 1] for key, value in batch.items()})
    K = policy.config.context_length
    text = f"s[:] | s[0], s[{K // 2}]"
    yield Picture(
        "maze2d",
        "Maze2D, with uncertainty",
        f"`{text}`, a recorded episode: the mass's position, shown twice; what lies between and what follows is asked.",
        maze_trajectories(policy.infer(window, text), window, maze=walls),
    )
    text = "Where nine recorded episodes begin and where they are sent: the paper's figure of initialisations."
    yield Picture("maze2d_starts", "Maze2D's starts", text, draw_ways(starts[:9, None].numpy(force=True), walls))


def write_gallery(pictures: Iterator[Picture], output: Path, *, command: str) -> list[Path]:
    """Write `gallery.md` and the pictures beside it, and return all files.

    Args:
        output: the folder of gallery.md; the pictures go into gallery/.
        command: what drew them.
    """
    drawn = list(pictures)  # all of them, before the first file is replaced
    folder = output / "gallery"
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Gallery", "", "Every picture is one function of `lerobot_unimask.plots`. Drawn by", "", "```text"]
    lines += [command, "```", ""]
    files = []
    for picture in drawn:
        files.append(folder / f"{picture.name}.png")
        save_small(picture.figure, files[-1])
        lines += [f"## {picture.title}", "", picture.text, "", f"![{picture.title}](gallery/{picture.name}.png)", ""]
    page = output / "gallery.md"
    page.write_text("\n".join(lines[:-1]) + "\n")
    return [page, *files]


def save_small(figure: Figure, path: Path) -> None:
    """Save a figure as a PNG with a palette, which is a third of the size and looks the same."""
    data = io.BytesIO()
    figure.savefig(data, dpi=DOTS_PER_INCH, format="png")
    Image.open(data).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
