"""Four questions of one policy of MetaWorld's arm, none of which it was trained for: the picture in docs/arm.md.

    uv run unimask build metaworld --task=peg-insert-side-v3 --episodes=12 --seed=1 --root=data/unseen
    uv run python tests/measuring/arm_questions.py --policy=outputs/peg --root=data/peg --unseen=data/unseen \
        --output=docs/arm_questions.png
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import lerobot_policy_unimask  # noqa: F401 (registers)
from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.asking.answers import ContinuousDistribution
from lerobot_unimask.data.episodes import bounds_of, open_dataset, read_windows
from lerobot_unimask.plots.style import BLACK, BLUE, COLOURS, FAINT, NORMAL, ORANGE, SMALL, VERMILLION, WIDTH

EVERY = 10  # steps between the windows of an episode that are scored
MOST = 3  # episodes that are coloured, those that surprise the most


def windows_of(dataset: LeRobotDataset, episode: int, K: int, every: int = 1) -> dict[str, Any]:
    """The full windows of an episode, as one batch."""
    first, end = bounds_of(dataset)[episode]
    return read_windows(dataset, range(first, end - K + 1, every))


def where_will_the_hand_be(axes: Axes, policy: UniMASKPolicy, batch: dict[str, Any]) -> None:
    """From two states on: what is expected of the hand, beside what it did."""
    K = policy.config.context_length
    rows = slice(0, None, K)
    part = {key: value[rows] for key, value in batch.items()}
    answer = policy.infer(part, "s[2:] | s[:2], a[0]")
    hand = answer.distributions["s"][0]
    states = policy.make_window(part).values["s"]
    axes.plot(*states[..., (0, 2)].reshape(-1, 2).T, color=BLACK, linewidth=1, label="recorded")
    for i, (mean, scale) in enumerate(zip(hand.mean[:, 1:], hand.scale[:, 1:], strict=True)):
        label = "asked, two deviations wide" if i == 0 else None
        axes.plot(mean[:, 0], mean[:, 2], color=VERMILLION, linewidth=1.5, label=label)
        low, high = mean[:, 2] - 2 * scale[:, 2].nan_to_num(), mean[:, 2] + 2 * scale[:, 2].nan_to_num()
        axes.fill_between(mean[:, 0], low, high, color=VERMILLION, alpha=0.25, linewidth=0)
    axes.set(xlabel="hand_x (m)", ylabel="hand_z (m)")
    finish(axes, f"Where will the hand be?\ns[2:] | s[:2], a[0], every {K} steps")


def which_action_led_here(axes: Axes, policy: UniMASKPolicy, batch: dict[str, Any]) -> None:
    """Each action of an episode, from the four states around it."""
    truth = policy.make_window(batch).values["a"][:, 1]
    found = policy.infer(batch, "a[1] | s[:4]").most_likely("a")[:, 1]
    for number, colour in zip((0, 2, 3), (BLUE, VERMILLION, ORANGE), strict=True):
        axes.plot(truth[:, number], color=colour, linewidth=2.5, alpha=0.35)
        axes.plot(found[:, number], color=colour, linewidth=1, label=policy.number_names["a"][number])
    axes.set(xlabel="step", ylabel="action; pale: recorded")
    finish(axes, "Which action led here?\na[1] | s[:4]")


def be_there(axes: Axes, policy: UniMASKPolicy, dataset: LeRobotDataset) -> None:
    """The action that is asked for so that the hand ends a window higher or lower than it did."""
    K, asked = policy.config.context_length, []
    heights = np.linspace(-0.04, 0.04, 9)
    for episode in range(len(bounds_of(dataset))):
        states = policy.make_window(windows_of(dataset, episode, K, 3 * EVERY)).values["s"]
        for now, end in zip(states[:, 0], states[:, -1], strict=True):
            rows = []
            for height in heights:
                there = end.clone()
                there[2] += height
                given = {"s[0]": now.tolist(), "s[-1]": there.tolist()}
                rows.append(policy.infer(None, "a[0] | s[0], s[-1]", given=given).most_likely("a")[0, 0, 2].item())
            asked.append(rows)
    table = np.array(asked)
    axes.plot(100 * heights, table.T, color=FAINT, linewidth=1)
    axes.plot(100 * heights, np.median(table, 0), color=BLUE, linewidth=2, label=f"median of {len(table)} windows")
    axes.set(xlabel="hand at the end higher than recorded (cm)", ylabel="dz asked for")
    finish(axes, "Act so as to be there at the window's end\na[0] | s[0], s[-1]")


def surprise(policy: UniMASKPolicy, dataset: LeRobotDataset) -> np.ndarray:
    """For each episode, how much the policy is surprised by its actions and states, in nats a number: mean over steps
    of the negative log-density of the next one after two steps."""
    found = []
    for episode in range(len(bounds_of(dataset))):
        batch = windows_of(dataset, episode, policy.config.context_length, EVERY)
        window = policy.make_window(batch)
        costs = []
        for question, name in (("a[2] | s[:3], a[:2]", "a"), ("s[3] | s[:3], a[:3]", "s")):
            step = 2 if name == "a" else 3
            parts = policy.infer(batch, question).distributions[name]
            density = [
                part.log_density(window.values[name])[:, step]
                for part in parts
                if isinstance(part, ContinuousDistribution)
            ]
            costs.append(-torch.stack(density).sum(0).mean().item() / policy.factors[name].size)
        found.append(np.mean(costs))
    return np.array(found)


def unlike_the_rest(axes: Axes, policy: UniMASKPolicy, dataset: LeRobotDataset) -> None:
    """The hand's ways in all episodes, those coloured that surprise the most."""
    surprises = surprise(policy, dataset)
    order = np.argsort(surprises)
    for rank, episode in enumerate(order):
        batch = windows_of(dataset, int(episode), policy.config.context_length)
        way = policy.make_window(batch).values["s"][:, 0]
        left = len(order) - rank  # it and those that surprise more
        colour = COLOURS[left - 1] if left <= MOST else FAINT
        label = f"episode {episode}: {surprises[episode]:.1f} nats a number" if left <= MOST else None
        axes.plot(way[:, 0], way[:, 2], color=colour, linewidth=1, label=label)
    low, middle, high = np.quantile(surprises, [0, 0.5, 0.95])
    axes.plot([], [], color=FAINT, label=f"all: {low:.1f} to {high:.1f} for 95 %, median {middle:.1f}")
    axes.set(xlabel="hand_x (m)", ylabel="hand_z (m)")
    finish(axes, "Which demonstrations look unlike the rest?\na[2] | s[:3], a[:2]   and   s[3] | s[:3], a[:3]")


def finish(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=NORMAL)
    axes.tick_params(labelsize=SMALL)
    axes.legend(fontsize=SMALL, frameon=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", required=True, help="a checkpoint")
    parser.add_argument("--root", type=Path, required=True, help="what it was trained on")
    parser.add_argument("--unseen", type=Path, required=True, help="other episodes of the same expert")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    policy = UniMASKPolicy.from_pretrained(arguments.policy)
    dataset, unseen = (open_dataset(policy.config, root) for root in (arguments.root, arguments.unseen))
    whole = windows_of(unseen, 0, policy.config.context_length)
    figure = Figure(figsize=(WIDTH, 0.8 * WIDTH), layout="constrained", dpi=110)
    (one, two), (three, four) = figure.subplots(2, 2)
    where_will_the_hand_be(one, policy, whole)
    which_action_led_here(two, policy, whole)
    be_there(three, policy, unseen)
    unlike_the_rest(four, policy, dataset)
    figure.savefig(arguments.output)


if __name__ == "__main__":
    main()
