"""`unimask query`: one question put to one policy, about an episode of a dataset or about values that are given.

Everything that decides the answer is in the record, so that somebody else can ask the same question again.

Legend of shapes: K steps of the window; there is one window.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from matplotlib.figure import Figure
from torch import Tensor

from lerobot_unimask.asking.answers import Answer, ContinuousDistribution
from lerobot_unimask.asking.given import Given, read_given
from lerobot_unimask.asking.looking import shown_pictures
from lerobot_unimask.asking.questions import pose_question
from lerobot_unimask.asking.sampling import Check, Samples
from lerobot_unimask.data.episodes import episode_numbers, provenance_of, read_window
from lerobot_unimask.data.window import Window
from lerobot_unimask.envs import environment_of_states
from lerobot_unimask.envs.record import Environment, optimum_of
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import ASKABLE, TASKS, Mask, parse_token, tabulate
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.plots.answers import distributions, marginals
from lerobot_unimask.plots.thumbnails import add_thumbnails


def given_from_episodes(
    policy: UniMASKPolicy, dataset: LeRobotDataset, episodes: str, tokens: str
) -> dict[str, list[Any]]:
    """Waypoints, goals or properties of recorded episodes, a row for each: what `--policy.given` takes, for as many
    environments side by side.

    Args:
        episodes: their numbers, `0:50` or `3,5,7`.
        tokens: single tokens of the window at the episode's first step, `s[3], s[-1]`, or of steps of the episode,
            `s@150`.

    Raises:
        MaskError: a token that the window does not have.
        ValueError: no such episodes, or one that ends before a token's step or lacks its column.
    """
    numbers = episode_numbers(episodes, len(dataset.meta.episodes))
    windows = [policy.make_window(read_window(dataset, number), partial=True) for number in numbers]
    rows = {}
    for text in re.split(r",(?![^\[]*\])", tokens):  # at commas outside brackets
        token = parse_token(text.strip(), tuple(policy.factors), policy.config.context_length, tuple(policy.cameras))
        name, step, here = token.factor, token.step, windows
        if name in policy.cameras:
            raise ValueError(f'{token} is a picture, which is given by its file: {{"{token}": "goal.png"}}.')
        if token.of_episode:
            here = [policy.make_window(read_window(dataset, number, step), partial=True) for number in numbers]
            step = 0
        factor = policy.factors[name]
        values = torch.stack([window.values[name][0, step, : factor.given_size] for window in here])
        short = [number for number, window in zip(numbers, here, strict=True) if not window.valid[0, step]]
        if short or values.isnan().any():
            where = f"episode {short[0]}, which is shorter" if short else "this dataset"
            raise ValueError(f"{text.strip()} is not recorded in {where}.")
        rows[text.strip()] = (values.long() if factor.discrete else values).tolist()
    return rows


@dataclass(frozen=True)
class Sampling:
    """How to draw joint samples instead of asking for marginals; see `UniMASKPolicy.sample`."""

    samples: int
    order: str = "forward"
    seed: int = 0
    check: str | None = None


@dataclass(frozen=True)
class Source:
    """The recorded window that a question is about.

    Attributes:
        folder: place of the dataset on this machine.
        root: folder that the user named, if one.
        repo_id: name that the user gave, if one.
        episode: number of the episode.
        start: step of the episode that the window begins at.
    """

    folder: Path
    root: Path | None
    repo_id: str | None
    episode: int
    start: int


@dataclass(frozen=True)
class Reply:
    """A question, as `ask` takes it, and what came of it.

    Attributes:
        mask: its mask, of one window.
        answer: marginals, or samples where those were asked for.
        recorded: what was recorded.
        best: the exact optimum's marginals, where those were asked for too.
        pictures: those that were shown, (H, W, C) by token.
    """

    question: str
    source: Source | None
    t: int | None
    given: Given | None
    sampling: Sampling | None
    exact: str | None
    mask: Mask
    answer: Answer | Samples
    recorded: Window | None
    best: Answer | None
    pictures: Mapping[str, Tensor]


def ask(
    policy: UniMASKPolicy,
    mask: str,
    *,
    batch: Mapping[str, Tensor] | None = None,
    source: Source | None = None,
    t: int | None = None,
    given: Given | None = None,
    sampling: Sampling | None = None,
    exact: str | None = None,
) -> Reply:
    """Put one question to a policy.

    Args:
        batch: one recorded window, as `read_window` gives it; None where everything shown is in `given`.
        source: place where it was recorded, of which a check and the optimum know.
        exact: name of the expert whose data it is, to put the question to the exact optimum too.

    Raises:
        MaskError, ValueError: as `UniMASKPolicy.infer` and `sample`; values are given for several windows; or there is
            no such check or optimum, or the optimum finds what is shown impossible.
    """
    recorded = None if batch is None else policy.make_window(batch, partial=True)
    start = source.start if source else 0
    window, question = pose_question(policy, recorded, mask, t, given)
    if len(window.valid) > 1:
        raise ValueError(f"Values for {len(window.valid)} windows are given; give one value for each token.")
    if not any(asked.any() for asked in question.asked.values()):
        raise ValueError(
            f"The episode ends before what is asked: of the window's {policy.config.context_length} steps it has "
            f"{int(window.valid.sum())}. Start earlier or ask for an earlier step."
        )
    answer: Answer | Samples
    if sampling is None:
        answer = policy.infer(window, question)
    else:
        check = make_check(policy, sampling.check, start) if sampling.check else None
        n, order, seed = sampling.samples, sampling.order, sampling.seed
        answer = policy.sample(window, question, samples=n, order=order, seed=seed, check=check)
    best = None
    if exact is not None:
        optimum = optimum_of(_environment(policy), exact, provenance_of(source.folder) if source else {})
        cpu = torch.device("cpu")
        best = optimum.answer(window.to(cpu), question.to(cpu), expert=exact, first_step=start)
    own = read_given(given or {}, policy.factors, policy.config.context_length, 1, policy.cameras)
    pictures = shown_pictures(policy, recorded, question, own)
    return Reply(mask, source, t, given, sampling, exact, question, answer, recorded, best, pictures)


def _environment(policy: UniMASKPolicy) -> Environment | None:
    return environment_of_states(policy.number_names["s"])


def make_check(policy: UniMASKPolicy, name: str, start: int = 0) -> Check:
    """A check of the policy's environment by name, for windows that begin at a step of the episode.

    Raises:
        ValueError: the environment offers no such check.
    """
    environment = _environment(policy)
    if environment is None or name not in environment.checks:
        known = ", ".join(environment.checks) if environment else ""
        raise ValueError(
            f"The environment of this policy, whose states are {', '.join(policy.number_names['s'])}, offers no check "
            f"{name!r}; it offers {known or 'none'}."
        )
    return environment.checks[name](start)


def rows(policy: UniMASKPolicy, reply: Reply) -> list[dict[str, Any]]:
    """The answer token by token in the order of time, one row for each number of a token.

    Marginals have `most_likely`, its `probability` and all `probabilities`, and where categories are texts its `label`;
    or `mean` and `scale` (None from an L2 head), and of a mixture the `weights`, `means` and `scales` of its Gaussians;
    samples `most_frequent`, its `share` and all `shares`, or `mean` and `scale` over the samples. `recorded` is None
    where nothing is. `exact` has the optimum's marginal, where that was asked for.
    """
    K = policy.config.context_length
    table = []
    for step in range(K):
        for name in policy.factors:
            if not reply.mask.asked[name][0, step]:
                continue
            for component in [c for c in policy.factors[name].components if not c.computed]:
                for i in range(component.dims.start, component.dims.stop):
                    value = math.nan if reply.recorded is None else reply.recorded.values[name][0, step, i].item()
                    recorded = None if math.isnan(value) else int(value) if component.discrete else value
                    if isinstance(reply.answer, Samples):
                        said = _of_samples(reply.answer.values[name][:, step, i], component.categories)
                    else:
                        said = _of_marginals(reply.answer, name, step, i)
                    label = policy.number_names[name][i]
                    row = {"token": f"{name}[{step}]", "step": step, "factor": name, "component": label}
                    if component.labels:
                        said["label"] = component.labels[said.get("most_likely", said.get("most_frequent", 0))]
                    exact = {} if reply.best is None else {"exact": _of_marginals(reply.best, name, step, i)}
                    table.append({**row, **said, **exact, "recorded": recorded})
    return table


def _of_marginals(answer: Answer, name: str, step: int, i: int) -> dict[str, Any]:
    distribution = next(d for d in answer[name] if d.component.dims.start <= i < d.component.dims.stop)
    if isinstance(distribution, ContinuousDistribution):
        at = i - distribution.component.dims.start
        scale = None if distribution.scale is None else distribution.scale[0, step, at].item()
        said: dict[str, Any] = {"mean": distribution.mean[0, step, at].item(), "scale": scale}
        if distribution.scales is not None and distribution.output.gaussians > 1:
            means, scales = (part[0, step, :, at].tolist() for part in (distribution.means, distribution.scales))
            said |= {"weights": distribution.weights[0, step].tolist(), "means": means, "scales": scales}
        return said
    probabilities = distribution.probabilities[0, step]
    best = int(probabilities.argmax())
    return {"most_likely": best, "probability": probabilities[best].item(), "probabilities": probabilities.tolist()}


def _of_samples(values: Tensor, categories: int | None) -> dict[str, Any]:
    if categories is None:
        return {"mean": values.mean().item(), "scale": values.std(correction=0).item()}
    shares = values.long().bincount(minlength=categories) / len(values)
    best = int(shares.argmax())
    return {"most_frequent": best, "share": shares[best].item(), "shares": shares.tolist()}


def record(policy: UniMASKPolicy, reply: Reply) -> dict[str, Any]:
    """Everything that decides an answer, and the answer, for a JSON."""
    data, source, sampling = None, reply.source, reply.sampling
    if source is not None:
        root = str(source.root) if source.root else None
        data = {"root": root, "repo_id": source.repo_id, "episode": source.episode, "start": source.start}
    result: dict[str, Any] = {
        "policy": policy.describe_origin(),
        "mask": reply.question,
        "t": reply.t,
        "given": dict(reply.given or {}),
        "data": data,
        "exact": reply.exact,
        "drawing": reply.mask.draw(),
        "units": "those of the dataset; probabilities and shares from 0 to 1",
        "answers": rows(policy, reply),
    }
    if sampling is not None and isinstance(reply.answer, Samples):
        counts = {name: getattr(reply.answer, name) for name in ("drawn", "rejected", "restarted", "acceptance")}
        drawn = [name for name in policy.factors if name in ASKABLE or reply.mask.asked[name].any()]
        values = {name: _plain(reply.answer.values[name].tolist()) for name in drawn}
        result["sampling"] = {**vars(sampling), **counts, "values": values}
    return result


def _plain(value: Any) -> Any:
    """Nested lists with None for NaN, which JSON does not have."""
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return None if math.isnan(value) else value


def describe(result: Mapping[str, Any]) -> str:
    """A record as a table for people."""
    asked_at = f", at t = {result['t']}" if result["t"] is not None else ""
    lines = [f"{result['mask']}{asked_at}", f"  {result['drawing']}   (# shown, ? asked, . neither)"]
    if result["given"]:
        lines.append(f"  given {json.dumps(result['given'])}")
    if result["data"] is not None:
        data = result["data"]
        lines.append(f"  episode {data['episode']} of {data['root'] or data['repo_id']}, from step {data['start']} on")
    if result["exact"]:
        lines.append(f"  exact: the optimum's answer, for data of the expert {result['exact']!r}")
    sampled = result.get("sampling")
    if sampled:
        lines.append(
            f"  {sampled['samples']} samples, {sampled['order']}, seed {sampled['seed']}; check {sampled['check']}: "
            f"{sampled['rejected']} of {sampled['drawn']} drawn tokens rejected,\n  acceptance "
            f"{sampled['acceptance']:.1%}, {sampled['restarted']} samples started over"
        )
    return "\n".join([*lines, "", *_align(list(_cells(result["answers"], sampled is not None)))])


def _cells(answers: Sequence[Mapping[str, Any]], sampled: bool) -> Iterator[list[str]]:
    discrete = any("mean" not in row for row in answers)
    continuous = any("mean" in row for row in answers)
    value, weight = ("most frequent", "share") if sampled else ("most likely", "probability")
    heads = [value if discrete else "", "mean" if continuous else ""]
    weights = [weight if discrete else "", "scale" if continuous else ""]
    best = ["exact", " / ".join(filter(None, weights))] if "exact" in answers[0] else []
    yield [
        "step",
        "factor",
        "component",
        " / ".join(filter(None, heads)),
        " / ".join(filter(None, weights)),
        *best,
        "recorded",
    ]
    for row in answers:
        recorded = "" if row["recorded"] is None else f"{row['recorded']:.4g}"
        if "mean" in row:
            said = [f"{row['mean']:.4g}", "" if row["scale"] is None else f"± {row['scale']:.3g}"]
        else:
            said = [row.get("label") or str(row[value.replace(" ", "_")]), f"{row[weight]:.3f}"]
        exact, best = row.get("exact", {}), []
        if "probability" in exact:
            best = [str(exact["most_likely"]), f"{exact['probability']:.3f}"]
        elif exact:
            best = [f"{exact['mean']:.4g}", f"± {exact['scale']:.3g}"]
        yield [str(row["step"]), row["factor"], row["component"], *said, *best, recorded]


def _align(cells: Sequence[Sequence[str]]) -> list[str]:
    """Columns of equal width, numbers to the right, names to the left."""
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = []
    for row in cells:
        parts = [c.ljust(w) if i in (1, 2) else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  ".join(parts).rstrip())
    return lines


def overview(policy: UniMASKPolicy) -> dict[str, Any]:
    """What one can ask a policy: its factors, and the named tasks that fit it, with their masks drawn."""
    K = policy.config.context_length
    factors = {}
    for name, factor in policy.factors.items():
        mean, std = (policy.statistics.get_buffer(f"{name}_{part}").tolist() for part in ("mean", "std"))
        factors[name] = [
            {"component": policy.number_names[name][i], "categories": component.categories}
            if component.discrete
            else {"component": policy.number_names[name][i], "mean": mean[i], "std": std[i]}
            for component in factor.components
            if not component.computed
            for i in range(component.dims.start, component.dims.stop)
        ]
    tasks = []
    for name, text in TASKS.items():
        try:
            table = tabulate(text, tuple(policy.factors), K, tuple(policy.cameras))
        except MaskError:
            continue  # a factor that this model does not have
        t = int(table.t[len(table.t) // 3])
        mask = table.at(t)
        drawing = mask.draw()
        tasks.append({"name": name, "mask": text, "t": t, "drawing": drawing})
    return {
        "policy": policy.describe_origin(),
        "context_length": K,
        "attention": policy.config.attention,
        "training_masks": policy.training_masks.weights,
        "factors": factors,
        "predicted": policy.config.predicted(policy.factors),
        "cameras": {name: {"column": camera.key, "shape": camera.shape} for name, camera in policy.cameras.items()},
        "tasks": tasks,
    }


def describe_overview(result: Mapping[str, Any]) -> str:
    """An overview as text for people."""
    lines = [
        f"{result['policy']['path']}: windows of {result['context_length']} steps, 0 to {result['context_length'] - 1}"
    ]
    lines += ["", "Factors, with the dataset's units:"]
    width_of = max(map(len, (*result["factors"], *result["cameras"])))
    for name, components in result["factors"].items():
        how = "shown or asked" if name in result["predicted"] else "shown"
        where = "" if name in ASKABLE else f"; {how} as {name}[0]"
        for part in components:
            kind = (
                f"category 0 to {part['categories'] - 1}"
                if "categories" in part
                else f"number, {part['mean']:.4g} ± {part['std']:.3g} in the training data"
            )
            lines.append(f"  {name:{width_of}}  {part['component']}: {kind}{where}")
    for name, camera in result["cameras"].items():
        height, width = camera["shape"][1:]
        lines.append(
            f"  {name:{width_of}}  pictures of {camera['column']}, read at {height} x {width}; shown at any step"
        )
    if result["cameras"]:
        lines.append("  s is the numbers and every camera; state is the numbers.")
    lines += ["", "Named tasks (# shown, ? asked, . neither):"]
    name, mask = (max(len(task[key]) for task in result["tasks"]) for key in ("name", "mask"))
    lines += [
        f"  {task['name']:{name}}  {task['mask']:{mask}}  at t={task['t']}: {task['drawing']}"
        for task in result["tasks"]
    ]
    lines += [
        "",
        "Ask for one with --mask=NAME --t=STEP, or write any question: --mask='s[1:9] | s[0], s[3]'.",
        "What the mask shows comes from --dataset.root=DIR --episode=N, or from --given='{\"s[0]\": [...]}'.",
    ]
    return "\n".join(lines)


def picture(policy: UniMASKPolicy, reply: Reply) -> Figure:
    """The picture that suits the environment and the answer, under those that the question shows."""
    figure = _picture_of_answer(policy, reply)
    add_thumbnails(figure, {token: shown.numpy() for token, shown in reply.pictures.items()})
    return figure


def _picture_of_answer(policy: UniMASKPolicy, reply: Reply) -> Figure:
    """That of the environment; of any other model, its marginals or distributions."""
    environment = _environment(policy)
    if environment is not None and environment.draw_answer is not None:
        provenance = provenance_of(reply.source.folder) if reply.source else {}
        figure = environment.draw_answer(reply.question, reply.answer, reply.mask, reply.recorded, provenance)
        if figure is not None:
            return figure
    if not isinstance(reply.answer, Samples):
        return marginals(reply.answer, reply.recorded)
    groups = {"sampled": _known(reply.answer, reply.mask)}
    if reply.recorded is not None:
        groups = {"recorded": _known(reply.recorded, reply.mask), **groups}
    return distributions(groups, policy.factors)


def _known(window: Window, mask: Mask) -> Window:
    """The window with NaN where nothing was asked."""
    values = {
        name: torch.where(tokens.unsqueeze(-1), window.values[name], torch.nan)
        for name, tokens in mask.asked.items()
        if name in ASKABLE or tokens.any()
    }
    return Window(values, window.valid)
