"""A dataset's columns -> the factors of the mask language: `s`, `a`, `rtg`, the properties and the cameras."""

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from lerobot.utils.constants import OBS_PREFIX
from torch import Tensor

logger = logging.getLogger(__name__)

STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"
ACTION = "action"
RETURN_TO_GO = "observation.return_to_go"
RETURN_SO_FAR = "observation.return_so_far"
TASK = "task"  # LeRobot's name for what an episode is to do, a text; here the factor that it becomes, too

TEXTS = ("string", "language")  # LeRobot's types of columns that hold no numbers, beside pictures
MAX_SIZE = 65536  # numbers of a column, categories of a number: more is a damaged file
MAX_JOINT = 1024  # combinations of categories that have a logit each; beyond, their components are chained
MAX_CHAIN = 16_384  # combinations of components that are chained; an answer is a table of them
LINK = 16  # numbers by which a chained category tells later components that it was drawn
LOG_SCALE = (-7.0, 7.0)  # a Gaussian head's scales stay within e^-7 to e^7 standard deviations of the data


@dataclass(frozen=True)
class Feature:
    """One column of the dataset inside a factor, as the checkpoint's config stores it."""

    key: str
    size: int
    categories: list[int] | None = None  # per dimension; None: continuous
    names: list[str] | None = field(default=None, compare=False)  # per dimension, for people
    labels: list[str] | None = None  # of the categories, where the dataset stores texts

    def __post_init__(self) -> None:
        if not 1 <= self.size <= MAX_SIZE:
            raise ValueError(f"{self.key} has size {self.size}; it must lie in 1 to {MAX_SIZE}.")
        for what, entries in {"categories": self.categories, "names": self.names}.items():
            if entries is not None and len(entries) != self.size:
                raise ValueError(f"{self.key} has {self.size} numbers and {len(entries)} {what}.")
        for count in self.categories or []:
            if not 1 <= count <= MAX_SIZE:
                raise ValueError(f"{self.key} has {count} categories; each number has 1 to {MAX_SIZE}.")


@dataclass(frozen=True)
class Camera:
    """A column of pictures that the model reads, as the checkpoint's config stores it."""

    key: str
    shape: list[int]  # channels, height and width, as the model reads them

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or not all(1 <= size <= MAX_SIZE for size in self.shape):
            raise ValueError(f"{self.key} has shape {self.shape}; a picture has channels, a height and a width.")


@dataclass(frozen=True)
class Component:
    """A single discrete number of a factor, or a run of continuous ones."""

    name: str
    dims: slice  # of the factor's D
    categories: int | None  # None: continuous
    computed: bool = False  # by this package, not stored in the dataset or given by a user
    names: tuple[str, ...] = ()  # of its numbers
    labels: tuple[str, ...] = ()  # of its categories, where they are texts

    @property
    def discrete(self) -> bool:
        return self.categories is not None


@dataclass(frozen=True)
class Output:
    """What a network predicts of a token in one piece: discrete components together, as one distribution over all
    combinations of their categories; or continuous ones, as a mean, or as Gaussians, each with a weight and with means
    and scales of all numbers.

    Where there are more than `MAX_JOINT` combinations, the distribution is a chain, the product of each component's
    given those before it. Of each category a logit and a vector are predicted; to the logits of a component are added
    the products of its categories' vectors with the sum of the vectors of what the components before it are.
    """

    components: tuple[Component, ...]
    gaussians: int = 0  # 0: a mean

    @property
    def discrete(self) -> bool:
        return self.components[0].discrete

    @property
    def chained(self) -> bool:
        return self.discrete and len(self.components) > 1 and math.prod(self.categories) > MAX_JOINT

    @property
    def apart(self) -> "list[Output]":
        """Each of its components as an output."""
        return [replace(self, components=(component,)) for component in self.components]

    @property
    def numbers(self) -> list[int]:
        """Which of the factor's D numbers it is about."""
        return [number for component in self.components for number in range(component.dims.start, component.dims.stop)]

    @property
    def dims(self) -> slice | list[int]:
        """The numbers as an index; a run of them as a slice, which no GPU has to be told of."""
        first, last = self.numbers[0], self.numbers[-1]
        return slice(first, last + 1) if last - first == len(self.numbers) - 1 else self.numbers

    @property
    def categories(self) -> tuple[int, ...]:
        """Of each discrete component."""
        return tuple(component.categories for component in self.components if component.categories is not None)

    @property
    def size(self) -> int:
        """Of a prediction: logits of the combinations, or the links of a chain; or the parts that `unpack` makes of
        it."""
        if self.chained:
            return sum(self.categories) * (1 + LINK)
        if self.discrete:
            return math.prod(self.categories)
        return sum(self._parts)

    @property
    def _parts(self) -> tuple[int, int, int]:
        """Numbers of logits, means and logarithms of scales in a prediction; a single Gaussian needs no logit."""
        logits, means = self.gaussians if self.gaussians > 1 else 0, max(self.gaussians, 1) * len(self.numbers)
        return logits, means, means if self.gaussians else 0

    def unpack(self, prediction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A continuous prediction, (..., size) -> logits (..., n) of n Gaussians, their means (..., n, d) and
        logarithms of their scales (..., n, d), 0 where only a mean is predicted."""
        logits, means, scales = prediction.split(self._parts, dim=-1)
        means = means.unflatten(-1, (-1, len(self.numbers)))
        scales = scales.unflatten(-1, (-1, len(self.numbers))) if self.gaussians else torch.zeros_like(means)
        if not self._parts[0]:
            logits = torch.zeros_like(means[..., 0])
        return logits, means, scales.clamp(*LOG_SCALE)

    def pack(self, logits: Tensor, means: Tensor, scales: Tensor) -> Tensor:
        """What `unpack` unpacks."""
        parts = (logits, means.flatten(-2), scales.flatten(-2))
        return torch.cat([part for part, size in zip(parts, self._parts, strict=True) if size], dim=-1)

    def links(self, prediction: Tensor) -> list[tuple[Tensor, Tensor]]:
        """A chained prediction, (..., size) -> logits (..., C) and vectors (..., C, LINK) of each component's C
        categories."""
        parts = prediction.split([count * (1 + LINK) for count in self.categories], dim=-1)
        tables = [part.unflatten(-1, (-1, 1 + LINK)) for part in parts]
        return [(table[..., 0], table[..., 1:] * LINK**-0.25) for table in tables]  # as attention scales its products

    def table(self, prediction: Tensor) -> Tensor:
        """A discrete prediction, (..., size), as logits of all combinations, (..., C)."""
        if not self.chained:
            return prediction
        logs = torch.zeros_like(prediction[..., :1])  # (..., combinations so far)
        told = logs.unsqueeze(-1).expand(*logs.shape, LINK)  # (..., combinations so far, LINK)
        earlier: Tensor | None = None
        for logits, vectors in self.links(prediction):
            if earlier is not None:
                told = (told.unsqueeze(-2) + earlier.unsqueeze(-3)).flatten(-3, -2)
            given = (logits.unsqueeze(-2) + told @ vectors.transpose(-1, -2)).log_softmax(-1)
            logs, earlier = (logs.unsqueeze(-1) + given).flatten(-2), vectors
        return logs

    def combination(self, values: Tensor) -> Tensor:
        """The discrete values of tokens, (..., D), as numbers of combinations, (...); the last category runs first."""
        number = torch.zeros(values.shape[:-1], dtype=torch.int64, device=values.device)
        for component, count in zip(self.components, self.categories, strict=True):
            number = number * count + values[..., component.dims.start].long()
        return number

    def split(self, combination: Tensor) -> Tensor:
        """Numbers of combinations, (...), as the categories of each component, (..., d)."""
        parts = []
        for count in reversed(self.categories):
            parts.append(combination % count)
            combination = combination // count
        return torch.stack(parts[::-1], dim=-1)


@dataclass(frozen=True)
class Factor:
    """What the mask language calls `s`, `a`, `rtg` or by a property's name.

    Attributes:
        components: its numbers, in the dataset's order.
        outputs: what a network predicts of them, but for those that are computed.
    """

    name: str
    components: tuple[Component, ...]
    outputs: tuple[Output, ...]

    @property
    def size(self) -> int:
        """D, the numbers of one token."""
        return self.components[-1].dims.stop

    @property
    def discrete(self) -> bool:
        """Whether all its numbers are categories."""
        return all(component.discrete for component in self.components)

    @property
    def continuous(self) -> bool:
        """Whether none of its numbers is a category."""
        return not any(component.discrete for component in self.components)

    @property
    def given_size(self) -> int:
        """The first of the D numbers, which a dataset stores and a user gives."""
        return max(component.dims.stop for component in self.components if not component.computed)


def make_factors(
    features: Mapping[str, Sequence[Feature]], *, joint: bool = False, gaussians: int = 0
) -> dict[str, Factor]:
    """The model's factors from the features that its config stores under each name.

    Args:
        joint: predict a token's discrete components as one distribution, or as several, each over at most `MAX_CHAIN`
            combinations; otherwise each by itself.
        gaussians: number of Gaussians that continuous components are predicted as: 0, just a mean; 1, a mean and a
            scale for each number; more, a mixture over all of a token's continuous numbers.
    """
    factors = {}
    for name, columns in features.items():
        components: list[Component] = []
        start = 0
        for feature in columns:
            if feature.categories is None:
                label = feature.key.removeprefix("observation.")
                dims = slice(start, start + feature.size)
                components.append(Component(label, dims, None, names=names_of(feature)))
            else:
                for i, (label, count) in enumerate(zip(names_of(feature), feature.categories, strict=True)):
                    dims, labels = slice(start + i, start + i + 1), tuple(feature.labels or ())
                    components.append(Component(label, dims, count, names=(label,), labels=labels))
            start += feature.size
        if name == "rtg":  # the token is the pair (return-to-go, timestep / horizon)
            components.append(Component("timestep", slice(start, start + 1), None, computed=True))
        factors[name] = Factor(name, tuple(components), _outputs(components, joint=joint, gaussians=gaussians))
    return factors


def _outputs(components: Sequence[Component], *, joint: bool, gaussians: int) -> tuple[Output, ...]:
    discrete = [component for component in components if component.discrete]
    continuous = [component for component in components if not component.discrete and not component.computed]
    groups: list[list[Component]] = []
    for component in discrete:
        together = math.prod(c.categories or 1 for c in [*groups[-1], component]) if groups else math.inf
        if joint and together <= MAX_CHAIN:
            groups[-1].append(component)
        else:
            groups.append([component])
    outputs = [Output(tuple(group)) for group in groups]
    groups = [continuous] if gaussians > 1 else [[component] for component in continuous]
    return tuple(outputs + [Output(tuple(group), gaussians) for group in groups if group])


def names_of(feature: Feature) -> tuple[str, ...]:
    """A name for each number of a column, the dataset's own where it has them."""
    plain = feature.key.removeprefix("observation.")
    return tuple(feature.names or ([plain] if feature.size == 1 else [f"{plain}.{i}" for i in range(feature.size)]))


def flat_names(names: Any) -> list[str]:
    """Names as `info.json` has them, some nested one deep: `[["a", "b"]]`, `{"motors": ["a", "b"]}`, `{"motors": {"a":
    0, "b": 1}}`; those that two groups share begin with the group's."""
    if isinstance(names, Mapping):
        parts = [(group, list(part)) for group, part in names.items() if isinstance(part, list | tuple | Mapping)]
        found = [name for _, part in parts for name in part]
        if len(set(found)) < len(found):  # two arms, each with its joints
            found = [f"{group}.{name}" for group, part in parts for name in part]
        names = found or list(names)
    flat: list[Any] = []
    for part in names if isinstance(names, list | tuple) else []:
        flat += part if isinstance(part, list | tuple) else [part]
    return [str(name) for name in flat]


def is_numeric(entry: dict[str, Any]) -> bool:
    return entry["dtype"] not in ("image", "video", *TEXTS) and len(entry["shape"]) <= 1


def read_feature(key: str, entry: dict[str, Any]) -> Feature:
    size = entry["shape"][0] if entry["shape"] else 1
    categories = entry.get("categories", [2] * size if entry["dtype"] == "bool" else None)
    names = flat_names(entry.get("names"))
    return Feature(
        key, size, list(categories) if categories is not None else None, names if len(names) == size else None
    )


def check_layout(entries: Mapping[str, Mapping[str, Any]], states: Sequence[str] | None = None) -> None:
    """What `unimask prepare` mends in a dataset's states and actions.

    Raises:
        ValueError: one of them has two dimensions.
    """
    for key in (*(states or (STATE, ENVIRONMENT_STATE)), ACTION):
        entry = entries.get(key)
        if entry is None:
            continue
        if len(entry["shape"]) > 1 and entry["dtype"] not in ("image", "video"):
            raise ValueError(
                f"{key} has shape {tuple(entry['shape'])}, and a model reads rows of numbers: "
                "`unimask prepare --dataset.root=DIR --output=DIR` makes one row of it."
            )
        if entry["dtype"].startswith(("int", "uint")) and not entry.get("categories"):
            logger.warning(
                "%s holds whole numbers and is read as a continuous one. If they are choices, say how many there are: "
                "`unimask prepare --categories %s=auto`.",
                key,
                key,
            )


def category_numbers(texts: str | Sequence[str], factor: Factor) -> list[list[float]]:
    """The categories that texts name, one row of one number for each.

    Raises:
        ValueError: a text that is none of them.
    """
    labels = factor.components[0].labels
    texts = [texts] if isinstance(texts, str) else texts
    for text in texts:
        if text not in labels:
            known = ", ".join(map(repr, labels))
            raise ValueError(f"{factor.name} is {text!r}, which this model has not seen; it knows {known}.")
    return [[float(labels.index(text))] for text in texts]


def group_features(
    found: dict[str, Feature], properties: Sequence[str], states: Sequence[str] | None = None
) -> dict[str, list[Feature]]:
    """Which factor each column belongs to. `s` is what LeRobot calls the robot's and the environment's state: a label
    of the episode under another name must never slip into it, for no environment reports one.

    Args:
        properties: columns that label whole episodes.
        states: columns that make up `s`; None: the robot's and the environment's state, where they are there.

    Raises:
        ValueError: a column is missing, or cannot be what it is named as.
    """
    columns = [key for key in found if key.startswith(OBS_PREFIX) and key != RETURN_TO_GO]
    if states is None:
        states = [key for key in (STATE, ENVIRONMENT_STATE) if key in found]
    for key in states:
        if key not in columns or states.count(key) > 1:
            raise ValueError(
                f"states names {key!r}; name each of its columns once, of {', '.join(columns) or 'none'}, or give one "
                f"that name: `unimask prepare --rename OLD={key}`."
            )
    taken = (*states, STATE, ENVIRONMENT_STATE, RETURN_TO_GO)  # columns that are no properties
    if not states:
        instead = f"--policy.states names others of {', '.join(columns)}" if columns else "pictures are not enough"
        raise ValueError(
            f"The dataset has no {STATE!r} of numbers: UniMASK models states and actions. Of numbers it has "
            f"{', '.join(found)}; `unimask prepare --rename OLD={STATE}` renames a column, {instead}."
        )
    if ACTION not in found:
        raise ValueError(
            f"The dataset has no {ACTION!r} of numbers: UniMASK models states and actions. It has {', '.join(found)}; "
            f"`unimask prepare --rename OLD={ACTION}` renames a column."
        )
    features = {"s": [found[key] for key in states], "a": [found[ACTION]]}
    if RETURN_TO_GO in found:
        features["rtg"] = [found[RETURN_TO_GO]]
    for key in properties:
        name = key.rpartition(".")[-1]
        if key not in found:
            others = [other for other in found if other.startswith(OBS_PREFIX) and other not in taken]
            raise ValueError(
                f"properties names {key!r}, which the dataset does not have; columns that could be one: "
                f"{', '.join(others) or 'none'}. `unimask prepare` adds one."
            )
        if key in taken or found[key] in features.get(name, []):
            raise ValueError(f"{key!r} is a factor already, so it cannot be named in properties as well.")
        if (
            not key.startswith(OBS_PREFIX)
            or not re.fullmatch(r"[A-Za-z_]\w*", name)
            or name in ("t", "rtg", "state", TASK, *features)
        ):
            raise ValueError(
                f"{key!r} cannot be a property: it is named observation.NAME, NAME is letters, digits and "
                f"underscores, and s, a, t, rtg, state, task and other properties' names are taken."
            )
        features[name] = [found[key]]
    return features


def colour_cameras(entries: Mapping[str, dict[str, Any]]) -> dict[str, int]:
    """A dataset's columns of pictures, without those that measure depth -> their number of channels, as LeRobot reads
    them: a video's are three, also of a grey one."""
    found = {}
    for key, entry in entries.items():
        info = {**(entry.get("video_info") or {}), **(entry.get("info") or {})}
        depth = info.get("is_depth_map") or info.get("video.is_depth_map")
        if entry["dtype"] in ("image", "video") and not depth:
            names = list(entry.get("names") or ["height", "width", "channels"])
            channels = next((axis for axis, name in enumerate(names) if name in ("channel", "channels")), 2)
            found[key] = 3 if entry["dtype"] == "video" else entry["shape"][channels]
    return found


def name_cameras(channels: Mapping[str, int], size: Sequence[int], taken: Sequence[str]) -> dict[str, Camera]:
    """Cameras by their names in the mask language: `top` for `observation.images.top`, `images_top` where that is
    another factor's name.

    Args:
        channels: column -> number of its pictures' channels.
        size: height and width at which they are read.
        taken: names of the other factors.

    Raises:
        ValueError: a camera for which no name is left.
    """
    cameras: dict[str, Camera] = {}
    for key, count in channels.items():
        parts = key.removeprefix(OBS_PREFIX).split(".")
        for n in range(1, len(parts) + 1):
            name = re.sub(r"\W", "_", "_".join(parts[-n:]))
            name = name if re.match(r"[A-Za-z_]", name) else f"camera_{name}"
            if name not in (*taken, *cameras, "t", "s", "a", "state", "rtg", TASK):
                break
        else:
            raise ValueError(f"{key!r} has a name that another factor has: leave it out with --policy.cameras.")
        cameras[name] = Camera(key, [count, *size])
    return cameras


def describe_features(features: dict[str, list[Feature]], cameras: Mapping[str, Camera]) -> str:
    kinds = [
        f"{name} = {f.key} ({f.size} numbers{f', categories {f.categories}' if f.categories else ''})"
        for name, columns in features.items()
        for f in columns
    ]
    return "; ".join([*kinds, *(f"{name} = {c.key} ({' x '.join(map(str, c.shape))})" for name, c in cameras.items())])
