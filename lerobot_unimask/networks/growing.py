"""From a checkpoint's weights to those of the model that goes on with them: with joint heads, more properties, and
heads for them."""

import re
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from pathlib import Path

import torch
from torch import Tensor

from lerobot_unimask.configuration_unimask import UniMASKConfig, read_config
from lerobot_unimask.data.factors import Factor
from lerobot_unimask.language.masks import ASKABLE


def saved_config(config: UniMASKConfig, folder: Path) -> UniMASKConfig:
    """The config of a checkpoint's own weights: that which it is read with may say joint where it has separate heads,
    a mixture where it has Gaussians, name more properties, or ask for them where it does not."""
    saved, own = copy(config), read_config(folder)
    saved.discrete_head, saved.ask_properties = own.discrete_head, own.ask_properties
    if (own.continuous_head, config.continuous_head) == ("gaussian", "mixture"):
        saved.continuous_head = "gaussian"
    saved.features = own.features or config.features
    return saved


def fitted(
    weights: Mapping[str, Tensor], saved: UniMASKConfig, config: UniMASKConfig, drawn: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """A checkpoint's weights as those of a model that is read with another config, where they can be.

    Args:
        saved: config of the weights.
        config: config of the model; `drawn` is its state before any weights are loaded.
    """
    before, factors = saved.make_factors(), config.make_factors()
    new = {name for name in factors if name not in before}
    new_heads = set(config.predicted(factors)) - set(saved.predicted(before))
    return {
        **weights,
        **joined(weights, before, factors, drawn),
        **grown(weights, drawn, list(factors), new, new_heads),
    }


def joined(
    weights: Mapping[str, Tensor],
    saved: Mapping[str, Factor],
    wanted: Mapping[str, Factor],
    drawn: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """A checkpoint's heads as those that training goes on with. Separate heads become joint ones, which at first answer
    the same: the logit of a combination is the sum of its categories'; in a chain the first component's vectors are
    `drawn`, and the others' are 0. Gaussians become a mixture whose parts begin at their means, each with another
    scale, so that the parts can come to differ. Of heads that are as wanted, nothing."""
    heads: dict[str, Tensor] = {}
    for key, rows in weights.items():
        found = re.fullmatch(r"network\.heads\.(\w+)\.(weight|bias)", key)
        if found is None or saved == wanted:
            continue
        outputs = saved[found[1]].outputs
        sizes = [output.size for output in outputs]
        parts = rows.unflatten(0, (-1, sum(sizes))).split(sizes, dim=1)  # (steps, size, ...) each
        of_number = {output.numbers[0]: part for output, part in zip(outputs, parts, strict=True)}
        wanted_outputs, whole = wanted[found[1]].outputs, []
        begun = drawn[key].unflatten(0, (len(parts[0]), -1)).split([output.size for output in wanted_outputs], dim=1)
        for output, fresh in zip(wanted_outputs, begun, strict=True):
            if output.chained:
                whole.append(_begin_chain([of_number[number] for number in output.numbers], fresh))
                continue
            total, *others = (of_number[number] for number in output.numbers if number in of_number)
            if output.gaussians > 1 and outputs[-1].gaussians == 1:
                total = _begin_mixture([total, *others], output.gaussians, bias=found[2] == "bias")
            else:
                for other in others:
                    total = (total.unsqueeze(2) + other.unsqueeze(1)).flatten(1, 2)
            whole.append(total)
        heads[key] = torch.cat(whole, dim=1).flatten(0, 1)
    return heads


def _begin_chain(separate: Sequence[Tensor], drawn: Tensor) -> Tensor:
    """The rows of a head that predicts a chain, (steps, size, ...), from those of one for each component."""
    counts = [rows.shape[1] for rows in separate]
    parts = drawn.unflatten(1, (sum(counts), -1)).split(counts, dim=1)  # (steps, C, 1 + LINK, ...) each
    links = [part * (i == 0) for i, part in enumerate(parts)]
    for logits, link in zip(separate, links, strict=True):
        link[:, :, 0] = logits
    return torch.cat(links, dim=1).flatten(1, 2)


def _begin_mixture(gaussians: Sequence[Tensor], count: int, *, bias: bool) -> Tensor:
    """The rows of a head that predicts `count` Gaussians, from those of one for each component, (steps, 2 d, ...)."""
    means, scales = (torch.cat(part, dim=1) for part in zip(*(rows.chunk(2, dim=1) for rows in gaussians), strict=True))
    factors = (
        torch.arange(count, device=means.device) / 2 * bias
    )  # logarithms: each part is narrower than the one before
    scales = torch.cat([scales - factor for factor in factors], dim=1)
    logits = torch.zeros_like(means[:, :1]).repeat_interleave(count, dim=1)
    return torch.cat([logits, torch.cat([means] * count, dim=1), scales], dim=1)


def grown(
    weights: Mapping[str, Tensor],
    drawn: Mapping[str, Tensor],
    factors: Sequence[str],
    new: Collection[str],
    new_heads: Collection[str],
) -> dict[str, Tensor]:
    """What a checkpoint's weights lack of new properties and of heads for properties, as drawn for the model that goes
    on with them. With new heads alone it answers as before.

    Args:
        drawn: the model's state, before the weights are loaded.
        factors: names of the model's factors; `new` are those that the checkpoint does not know, `new_heads` those that
            it does not predict.
    """
    belongs = [rf"network\.embeddings\.{name}\..*|statistics\.{name}_(mean|std)" for name in new]
    belongs += [rf"network\.heads\.{name}\..*" for name in new_heads]
    more = {key: value for key, value in drawn.items() if any(re.fullmatch(of, key) for of in belongs)}
    properties = [name for name in factors if name not in ASKABLE]
    if new and "network.positions" in weights:  # properties' stand first, in the factors' order
        old, more["network.positions"] = weights["network.positions"], drawn["network.positions"].clone()
        kept = [i for i, name in enumerate(properties) if name not in new]
        more["network.positions"][kept] = old[: len(kept)]
        more["network.positions"][len(properties) :] = old[len(kept) :]
    return more
