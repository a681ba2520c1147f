"""Acting: how an observation becomes an action. It is a question asked at every step:

    observation -> memory -> window, with what is given -> mask -> network -> the answer's a[t] -> memory

Where the present stands in the window is said by `RolloutMemory` alone; how far it may go, by `new_memory`.

Legend of shapes: B environments, K steps, D the numbers of a factor, H actions of a chunk.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_unimask.asking.answers import LearntModel, Model, answer
from lerobot_unimask.asking.given import (
    Given,
    check_known,
    check_shown,
    check_values,
    give,
    in_window,
    read_given,
    text_of,
)
from lerobot_unimask.asking.looking import look_at_given
from lerobot_unimask.asking.memory import NO_RETURN_SO_FAR, RolloutMemory
from lerobot_unimask.asking.sampling import sample as draw_jointly
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import RETURN_SO_FAR, TASK, Camera, Factor, category_numbers
from lerobot_unimask.data.window import Window, as_tensor
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import Mask, MaskTable, Token, tabulate
from lerobot_unimask.networks.layers import Cache

logger = logging.getLogger(__name__)


def act(
    model: LearntModel,
    memory: RolloutMemory,
    state: Tensor,
    return_so_far: Tensor | None,
    pictures: Mapping[str, Tensor],
    task: str | Sequence[str] | None,
    **question: Any,
) -> Tensor:
    """One action for each environment.

    Args:
        state: (B, D) of the present step, as `observed_state` reads it.
        return_so_far: (B,) rewards received before it, as `observed_return` reads it.
        pictures: camera -> (B, width), tokens of its pictures, as `observed_pictures` makes them.
        task: text of each environment's, or of all, where they say one.
        question: `mask`, `given`, `sample` and `generator`, as `UniMASKPolicy.select_action` takes them.

    Returns:
        (B, D) in the dataset's units.
    """
    memory.task = task
    memory.observe(state, return_so_far, pictures)
    if not memory.planned:
        actions = plan(model, memory, model.config.n_action_steps, **question)
        memory.planned = list(actions.unbind(1))
    action = memory.planned.pop(0)
    memory.act(action)
    return as_action(model, action)


def plan_from(
    model: LearntModel,
    state: Tensor,
    pictures: Mapping[str, Tensor],
    task: str | Sequence[str] | None,
    *,
    inference_delay: int = 0,
    left_over: Tensor | None = None,
    **question: Any,
) -> Tensor:
    """A chunk of actions for the observation that is handed over, at position 0; nothing is remembered.

    Actions that are on their way while this is worked out are shown, and the rest are asked given them: real-time
    chunking as a mask, for which others condition on action prefixes in training (Black et al., "Training-Time Action
    Conditioning for Efficient Real-Time Chunking", 2025).

    Args:
        state: (B, D) of the present step.
        pictures: camera -> (B, width), tokens of its pictures.
        task: text of each environment's, or of all, where they say one.
        inference_delay: number of actions of `left_over` that will be done by the time the chunk is there.
        left_over: (T, D) actions of the chunk before that are still to be carried out, the next one first; rows of
            zeros at its end are LeRobot's padding and do not count.
        question: `mask`, `given`, `sample` and `generator`, as `UniMASKPolicy.select_action` takes them.

    Returns:
        (B, H, D) in the dataset's units; its first actions are those of `left_over` that are on their way.

    Raises:
        ValueError: `left_over` is not (T, D), or the delay is negative.
    """
    memory = new_memory(model, len(state))
    memory.task = task
    memory.observe(state, torch.zeros(len(state), device=model.device), pictures)
    prefix = _on_their_way(model, inference_delay, left_over)
    return as_action(model, plan(model, memory, model.config.chunk_size, prefix=prefix, **question))


def _on_their_way(model: LearntModel, inference_delay: int, left_over: Tensor | None) -> Tensor | None:
    """(1, d, D) of the actions that will have been carried out, d at most the delay and the chunk."""
    if inference_delay < 0:
        raise ValueError(f"inference_delay is {inference_delay}; it counts steps, from 0 on.")
    if left_over is None:
        return None
    size = model.factors["a"].size
    if left_over.ndim != 2 or left_over.shape[1] != size:
        raise ValueError(
            f"prev_chunk_left_over has shape {tuple(left_over.shape)}; actions of this policy are (T, {size})."
        )
    done = left_over.ne(0).any(1).nonzero()  # rows that are not padding
    actions = left_over[: int(done[-1]) + 1 if len(done) else 0]
    return actions[: min(inference_delay, model.config.chunk_size)].unsqueeze(0).to(model.device, torch.float32)


def plan(
    model: LearntModel,
    memory: RolloutMemory,
    size: int,
    *,
    mask: str | None = None,
    given: Given | None = None,
    sample: bool | None = None,
    generator: torch.Generator | None = None,
    prefix: Tensor | None = None,
) -> Tensor:
    """The next `size` actions from the present on, (B, size, D), in the dataset's units.

    Where the model answers the present action causally, and has learnt what comes after it so too, the actions
    are answered one after another, each given the actions and states before it, those of the chunk as they were
    answered: so each is what acting would answer there if all went as the model expects. Else all are answered at once.

    Args:
        prefix: (B, d, D) actions that are on their way already: shown, and returned as they are.
    """
    config, present = model.config, memory.position
    text = config.inference_mask if mask is None else mask
    table = acting_table(text, model.factors, config.context_length, model.cameras)
    text = table.question.text
    given_here = config.given if given is None else given
    tokens = read_given(given_here, model.factors, config.context_length, len(memory.valid), model.cameras)
    if given is not None:  # the config's may go unused by a question that is asked in passing
        check_shown(tokens, table.shows, text)
    horizon = int(model.statistics.horizon)
    here = in_window(look_at_given(model, tokens), memory.first_step, config.context_length, horizon)
    if TASK in model.factors and table.shows[TASK][0] and (TASK, 0) not in here and memory.task is not None:
        here[TASK, 0] = torch.tensor(category_numbers(memory.task, model.factors[TASK]))
    if "rtg" in model.factors and table.shows["rtg"][0]:
        target = here.get(("rtg", 0), target_return(model, memory))
        if target is not None:
            slides = horizon > memory.last_position + 1
            if memory.step == 0 and slides and memory.return_so_far[:, 0].isnan().any():  # say so at once
                raise ValueError(NO_RETURN_SO_FAR)
            here["rtg", 0] = memory.remaining(target.to(model.device))
    window, known = give(memory.window(model.statistics.horizon), here, memory.known())
    memory.carry_return(window)
    moments = {(token.factor, token.step - memory.first_step) for token in tokens if token.of_episode} & here.keys()
    posed = text, present, size, moments, set(here)
    question = memory.question if memory.posed == posed and prefix is None else None
    if question is None:
        question = table.at(present, len(memory.valid))
        for name, position in moments:  # a moment of the episode is shown once the window reaches it
            question.shown[name][:, position] = True
            question.asked[name][:, position] = False
        _ask_chunk(question, window, known, present, size, prefix)
        check_known(question, known, text)
        question = question.to(model.device)
        memory.posed, memory.question = posed, question
    drawn = config.sample_actions if sample is None else sample
    memory.cache.grows = size > 1 and _follow_on(model, question, present, size)
    if memory.cache.grows:
        values = _one_by_one(model, window, question, present, size, memory.cache, drawn, generator)
    elif size > 1 and drawn:
        values = draw_jointly(model, window, question, order="forward", generator=generator).values["a"]
    else:
        said = answer(model, window, question, memory.cache, factors=["a"])
        values = said.draw("a", generator) if drawn else said.carried_out("a")
    return values[:, present : present + size]


def _history(question: Mask, present: int, step: int, name: str) -> Mask:
    """The question about the state or the action of a step at or after the present, given all states and actions before
    it and what the question shows of properties and pictures."""
    steps = torch.arange(question.shown["s"].shape[1], device=question.shown["s"].device)
    shown = dict(question.shown)
    shown["s"] = question.shown["s"] | ((steps > present) & (steps < step + (name == "a")))
    shown["a"] = (question.shown["a"] & (steps < present)) | ((steps >= present) & (steps < step))
    asked = {other: torch.zeros_like(tokens) for other, tokens in shown.items()}
    asked[name][:, step] = True
    return Mask(shown, asked)


def _follow_on(model: LearntModel, question: Mask, present: int, size: int) -> bool:
    """Whether the model has learnt to answer the actions of a chunk, and the states between them, causally."""
    if question.shown["s"][:, present + 1 :].any() or question.shown["a"][:, present + size :].any():
        return False
    learnt = model.training_masks.answered_causally
    state = learnt(_history(question, present, present + 1, "s"))["s"]
    action = learnt(_history(question, present, present + size - 1, "a"))["a"]
    return bool(state.any(1).all() and action.any(1).all())


def _one_by_one(
    model: LearntModel,
    window: Window,
    question: Mask,
    present: int,
    size: int,
    cache: Cache,
    drawn: bool,
    generator: torch.Generator | None,
) -> Tensor:
    """The window's actions, (B, K, D), with those of the chunk: answered in the order of time, each given the states
    and actions before it as they are observed, on their way or answered."""
    values = {name: value.clone() for name, value in window.values.items()}
    rows = torch.arange(len(window.valid), device=window.valid.device)
    for step in range(present, present + size):
        for name in "sa":
            if not question.shown[name][0, step]:
                asked = _history(question, present, step, name)
                here = answer(model, Window(values, window.valid), asked, cache, [name]).at(rows, step)
                if drawn:
                    values[name][:, step] = here.draw(name, generator)[:, 0]
                else:
                    values[name][:, step] = (here.carried_out(name) if name == "a" else here.most_likely(name))[:, 0]
    return values["a"]


def _ask_chunk(
    question: Mask, window: Window, known: dict[str, Tensor], present: int, chunk_size: int, prefix: Tensor | None
) -> None:
    """Ask for a[t] to a[t + H - 1] at the present t, and show those that are on their way."""
    ahead = slice(present, present + chunk_size)
    question.asked["a"][:, ahead] = ~question.shown["a"][:, ahead]
    if prefix is not None and prefix.shape[1]:
        begun = slice(present, present + prefix.shape[1])
        window.values["a"] = window.values["a"].clone()
        window.values["a"][:, begun] = prefix
        question.shown["a"][:, begun], question.asked["a"][:, begun] = True, False
        known["a"] = known["a"].clone()
        known["a"][begun] = True


def new_memory(model: LearntModel, batch_size: int) -> RolloutMemory:
    """An empty memory. The present goes as far as `n_obs_steps` lets acting remember, and leaves room for a chunk."""
    config = model.config
    remembered = config.n_obs_steps or config.context_length
    last_position = min(remembered - 1, config.context_length - config.chunk_size)
    cameras = dict.fromkeys(model.cameras, config.width)
    return RolloutMemory(model.factors, config.context_length, batch_size, model.device, last_position, cameras)


def acting_table(
    text: str, factors: Mapping[str, Factor], context_length: int, cameras: Mapping[str, Camera]
) -> MaskTable:
    """The table of a question that a rollout can ask at every step.

    Raises:
        MaskError: it does not ask for a[t].
    """
    table = tabulate(text, tuple(factors), context_length, tuple(cameras))
    if not table.acts:
        raise MaskError(
            "A mask for a rollout asks for a[t] at every step, as 'a[t] | s[:t+1], a[:t]' does.",
            table.question.text,
            table.question.asked[0].position,
        )
    return table


def target_return(model: LearntModel, memory: RolloutMemory) -> Tensor | None:
    """The return to ask for from the episode's first step on, (B, 1) or (1, 1); None: nobody asks for one."""
    target = model.config.target_return
    if target is None:
        return None
    if target == "auto":
        return model.config.target_return_scale * model.episode_starts.nearest_return(memory.first_state)
    return torch.tensor([[float(target)]], device=model.device)


def observed_state(model: LearntModel, batch: Mapping[str, Tensor]) -> Tensor:
    """(B, D) of the present step's `s`.

    Raises:
        ValueError: a column is missing, has another shape, or holds a value that is not legal.
    """
    if not isinstance(batch, Mapping):
        raise ValueError(f"An observation maps the dataset's columns to tensors; this is a {type(batch).__name__}.")
    parts = []
    for feature in model.config.features["s"]:
        value = batch.get(feature.key)
        if value is not None:
            value = as_tensor(repr(feature.key), value).float()
        if value is not None and value.ndim < 2 and (feature.size == 1 or value.numel() == feature.size):
            value = value.reshape(-1, feature.size)  # LeRobot makes a batch of `observation.state` alone
        if value is None or value.ndim != 2 or value.shape[-1] != feature.size:
            found = "nothing" if value is None else f"shape {tuple(value.shape)}"
            raise ValueError(
                f"This policy observes {feature.key!r} with {feature.size} numbers, (batch, {feature.size}); "
                f"the environment gives {found} under that name."
            )
        parts.append(value.to(model.device))
    if len({len(part) for part in parts}) > 1:
        raise ValueError(f"The parts of the state are of {', '.join(str(len(part)) for part in parts)} environments.")
    state = torch.cat(parts, dim=-1)
    check_values("The observed state", state, model.factors["s"])
    return state


def observed_return(model: LearntModel, batch: Mapping[str, Any], batch_size: int) -> Tensor | None:
    """(B,) rewards received so far, where the environment reports them.

    Raises:
        ValueError: they are not one finite number for each environment.
    """
    value = batch.get(RETURN_SO_FAR)
    if value is None:
        return None
    received = as_tensor(repr(RETURN_SO_FAR), value).float().reshape(-1)
    if len(received) != batch_size or not received.isfinite().all():
        raise ValueError(f"{RETURN_SO_FAR!r} is {text_of(value)}; {batch_size} finite numbers are awaited, (B, 1).")
    return received.to(model.device)


def as_action(model: Model, action: Tensor) -> Tensor:
    """Category numbers as integers, other actions as they are."""
    return action.long() if model.factors["a"].discrete else action


def check_settings(config: UniMASKConfig, factors: Mapping[str, Factor]) -> None:
    """Whether the settings of acting fit the model, before anything runs; warns of what will be missing in a rollout.

    Raises:
        MaskError: the inference mask does not fit the model, or does not ask for a[t].
        ValueError: a return is asked of a model without one, or something is given that the mask does not show.
    """
    if config.target_return is not None and "rtg" not in factors:
        raise ValueError(
            f"target_return is {config.target_return}, but this model has no return factor: its dataset has "
            "no 'observation.return_to_go'."
        )
    table = acting_table(config.inference_mask, factors, config.context_length, config.pictures)
    tokens = list(read_given(config.given, factors, config.context_length, cameras=config.pictures))
    if config.target_return is not None:
        if Token("rtg", 0) in tokens:
            raise ValueError("target_return and given both name rtg[0]; give one of them.")
        tokens.append(Token("rtg", 0))
    check_shown(tokens, table.shows, config.inference_mask)
    missing = [
        f"{name}[{step}]"
        for name, ahead in table.shows_ahead.items()
        for step in ahead.nonzero().flatten().tolist()
        if Token(name, step) not in tokens and name != TASK  # which environments say
    ]
    if missing:
        logger.warning(
            "The inference mask shows %s before a rollout has observed it: rollouts fail unless it is given, with "
            "%s or in each call of select_action.",
            ", ".join(missing),
            "target_return" if missing == ["rtg[0]"] else "given",
        )
    for token in tokens:
        if not token.of_episode and not table.shows_ahead[token.factor][token.step]:
            logger.warning(
                "%s is given, but the inference mask shows it once it has been observed: it changes nothing.", token
            )
