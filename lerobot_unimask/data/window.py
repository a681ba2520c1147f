"""A LeRobot batch -> a `Window`: the factors of K steps as tensors, in the dataset's units; and those units'
statistics.

Legend of shapes: B windows, K steps, D the numbers of a factor; C channels, H and W pixels of a picture.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_unimask.data.factors import (
    ACTION,
    STATE,
    Camera,
    Factor,
    Feature,
    Output,
    category_numbers,
    names_of,
)
from lerobot_unimask.data.soundness import check_statistics, compute_statistics

logger = logging.getLogger(__name__)


@dataclass
class Window:
    """K steps of B trajectories.

    values: factor -> (B, K, D) float32, in the dataset's units; discrete values are category numbers. `rtg` holds
        (return-to-go, timestep / horizon). A camera's are pictures, (B, K, C, H, W), uint8 or float32 from 0 to 1, or
        the tokens that the network has made of them, (B, K, width).
    valid: (B, K) bool, False past the episode's end.
    """

    values: dict[str, Tensor]
    valid: Tensor

    def repeat(self, times: int) -> "Window":
        """Each window `times` times, one after another."""
        values = {name: value.repeat_interleave(times, dim=0) for name, value in self.values.items()}
        return Window(values, self.valid.repeat_interleave(times, dim=0))

    def to(self, device: torch.device) -> "Window":
        return Window({name: value.to(device) for name, value in self.values.items()}, self.valid.to(device))


def make_window(
    batch: Mapping[str, Tensor],
    features: Mapping[str, Sequence[Feature]],
    context_length: int,
    *,
    horizon: Tensor,
    fps: Tensor,
    partial: bool = False,
    cameras: Mapping[str, Camera] | None = None,
) -> Window:
    """Read a window from a LeRobot batch, which is not changed. Pictures are not copied.

    Args:
        batch: the dataset's keys, each (B, K, size) or, for features of one number, (B, K) or (B, K, 1);
            `observation.state_is_pad` (B, K) if steps lie past the episode's end; `timestamp` (B,), seconds of step 0.
        horizon: steps of an episode. With `fps` it turns the timestamp into the return token's timestep / horizon.
        partial: columns may be missing, all but one; their values are NaN then.
        cameras: by name, the columns of pictures to read.

    Raises:
        KeyError: a column that the model needs is missing.
        ValueError: a column's shape is not (B, context_length, size), or a camera's not (B, context_length, C, H, W).
    """
    cameras = cameras or {}
    if partial:
        batch = _with_missing(batch, features, cameras, context_length)
    values = {}
    for name, columns in features.items():
        parts = [_column(batch, feature, context_length) for feature in columns]
        if name == "rtg":
            parts.append(_timestep(batch, parts[0], fps) / horizon)
        values[name] = torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]
    first = next(iter(values.values()))
    values |= {name: _pictures(batch, camera, context_length) for name, camera in cameras.items()}
    lengths = {name: len(value) for name, value in values.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"The batch's columns are of different length: {lengths}.")
    pad = batch.get(f"{STATE}_is_pad", batch.get(f"{ACTION}_is_pad"))
    if pad is None:
        return Window(values, torch.ones(first.shape[:2], dtype=torch.bool, device=first.device))
    if pad.shape != first.shape[:2] or (pad.dtype != torch.bool and not ((pad == 0) | (pad == 1)).all()):
        raise ValueError(
            f"The batch's is_pad is {pad.dtype} of shape {tuple(pad.shape)}; it is True or False, of shape "
            f"{tuple(first.shape[:2])}."
        )
    return Window(values, ~pad.bool())


def read_batch(
    batch: Mapping[str, Any],
    features: Mapping[str, Sequence[Feature]],
    device: torch.device,
    cameras: Mapping[str, Camera] | None = None,
) -> dict[str, Tensor]:
    """A batch's columns as tensors on a device. What is none stays out, where the model does not read it.

    Raises:
        ValueError: a column that the model reads holds no numbers.
    """
    if not isinstance(batch, Mapping):
        raise ValueError(f"A batch maps the dataset's columns to tensors; this is a {type(batch).__name__}.")
    read = {feature.key for columns in features.values() for feature in columns}
    read |= {camera.key for camera in (cameras or {}).values()}
    read |= {f"{key}_is_pad" for key in read} | {"timestamp", "index"}
    return {
        key: as_tensor(repr(key), value, device)
        for key, value in batch.items()
        if isinstance(value, Tensor) or key in read
    }


def frame_index(batch: Mapping[str, Tensor], window: Window) -> Tensor:
    """(B,) the frame that each window starts at; a batch that no dataset made is numbered from 0."""
    if "index" in batch:
        index = as_tensor("index", batch["index"], window.valid.device).reshape(-1)
        if len(index) != len(window.valid):
            raise ValueError(f"The batch's index numbers {len(index)} windows of {len(window.valid)}.")
        return index
    return torch.arange(len(window.valid), device=window.valid.device)


def as_tensor(what: str, value: Any, device: torch.device | None = None) -> Tensor:
    """Numbers of any kind as a tensor.

    Raises:
        ValueError: it holds none, or is a tensor that is sparse, complex or, on another device than `meta`, without
            values.
    """
    try:
        tensor = torch.as_tensor(value)
    except (TypeError, ValueError, OverflowError, RuntimeError, RecursionError) as error:
        raise ValueError(f"{what} holds no numbers that a tensor can hold: {error}") from error
    empty = tensor.is_meta and (device is None or device.type != "meta")
    if tensor.layout != torch.strided or empty or tensor.is_complex():
        raise ValueError(
            f"{what} is no plain tensor of numbers but one of {tensor.dtype}, {tensor.layout}, on {tensor.device}."
        )
    return tensor if device is None else tensor.to(device)


def task_column(texts: str | Sequence[str], factor: Factor, context_length: int) -> Tensor:
    """LeRobot's `task`, a text for each of B windows, as a column, (B, K, 1).

    Raises:
        ValueError: a text that is none of the factor's.
    """
    return torch.tensor(category_numbers(texts, factor)).unsqueeze(1).expand(-1, context_length, -1)


def _with_missing(
    batch: Mapping[str, Tensor], features: Mapping[str, Sequence[Feature]], cameras: Mapping[str, Camera], K: int
) -> Mapping[str, Tensor]:
    """The batch with NaN for each column that is not there, where one is."""
    columns = [feature for columns in features.values() for feature in columns]
    present = [feature.key for feature in columns if feature.key in batch]
    if not present:
        return batch
    like = batch[present[0]]
    nothing = like.new_full((len(like), K, 1, 1, 1), torch.nan, dtype=torch.float32)
    missing = {f.key: nothing[..., 0, 0].expand(-1, -1, f.size) for f in columns if f.key not in batch}
    missing |= {c.key: nothing.expand(-1, -1, *c.shape) for c in cameras.values() if c.key not in batch}
    return {**batch, **missing}


def _column(batch: Mapping[str, Tensor], feature: Feature, K: int) -> Tensor:
    """(B, K, size) float32."""
    if feature.key not in batch:
        raise KeyError(f"The batch lacks {feature.key!r}, which this model reads; it has {', '.join(sorted(batch))}.")
    value = batch[feature.key]
    shape = tuple(value.shape)
    if value.ndim == 2 and feature.size == 1:
        value = value.unsqueeze(-1)
    if value.ndim != 3 or value.shape[1:] != (K, feature.size):
        raise ValueError(
            f"{feature.key} has shape {shape}; a window of this model is (batch, {K}, {feature.size}): "
            f"{K} steps from the sampled frame on."
        )
    return value.to(torch.float32, copy=True)  # changing a window must not change the batch it was read from


def _pictures(batch: Mapping[str, Tensor], camera: Camera, K: int) -> Tensor:
    """(B, K, C, H, W) of any height and width, as they are."""
    if camera.key not in batch:
        raise KeyError(f"The batch lacks {camera.key!r}, a camera of this model; it has {', '.join(sorted(batch))}.")
    value = batch[camera.key]
    if K == 1 and value.ndim == 4:  # LeRobot drops the only step
        value = value.unsqueeze(1)
    if value.ndim != 5 or value.shape[1:3] != (K, camera.shape[0]):
        raise ValueError(
            f"The batch's {camera.key!r} has shape {tuple(value.shape)}; a window's pictures are (batch, {K}, "
            f"{camera.shape[0]}, height, width)."
        )
    return value


def _timestep(batch: Mapping[str, Tensor], like: Tensor, fps: Tensor) -> Tensor:
    """Each step's number within its episode, (B, K, 1)."""
    steps = torch.arange(like.shape[1], device=like.device, dtype=like.dtype).expand(like.shape[:2])
    if "timestamp" in batch:
        first = (batch["timestamp"].reshape(-1, 1).to(like) * fps).round()  # (B, 1)
        steps = steps + first
    return steps.unsqueeze(-1)


class Statistics(nn.Module):
    """Everything that the model knows about the dataset's units, as buffers: they are saved with the weights.

    Discrete numbers and computed ones keep mean 0 and standard deviation 1, so that one rule serves every factor. Until
    `fill` is called, nothing is scaled.

    `horizon` is the number of steps of the longest episode, `fps` how many there are in a second.
    """

    horizon: Tensor
    fps: Tensor

    def __init__(self, features: Mapping[str, Sequence[Feature]], factors: Mapping[str, Factor], context_length: int):
        super().__init__()
        self.features = features
        for name, factor in factors.items():
            self.register_buffer(f"{name}_mean", torch.zeros(factor.size))
            self.register_buffer(f"{name}_std", torch.ones(factor.size))
        self.register_buffer("horizon", torch.tensor(float(context_length)))
        self.register_buffer("fps", torch.tensor(1.0))

    def fill(
        self,
        dataset_stats: Mapping[str, Mapping[str, Any]],
        *,
        root: Path | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Take over a dataset's statistics, as `LeRobotDatasetMetadata.stats` holds them.

        Args:
            root: folder of the dataset, from whose columns absent statistics are computed.
            episodes: those that are read; None: all. Statistics that others have made unsound are computed too.

        Raises:
            ValueError: a continuous feature has no mean and standard deviation there, or unsound ones, or a discrete
                one more values than categories.
        """
        for name, columns in self.features.items():
            mean, std = self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_std")
            start = 0
            for feature in columns:
                dims = slice(start, start + feature.size)
                start += feature.size
                known = {key: _numbers(value) for key, value in dataset_stats.get(feature.key, {}).items()}
                if feature.categories is None:
                    spoilt = episodes is not None and not all(value.isfinite().all() for value in known.values())
                    if spoilt or not {"mean", "std"} <= known.keys():
                        if root is None:
                            raise ValueError(
                                f"The dataset's statistics lack {feature.key!r}: `unimask prepare` recomputes them."
                            )
                        computed = compute_statistics(root, feature.key, episodes)
                        known = {kind: _numbers(value) for kind, value in computed.items()}
                    kept = {kind: _numbers(known[kind]) for kind in ("mean", "std")}
                    check_statistics(feature.key, names_of(feature), kept)
                    known = known | {kind: value.to(mean) for kind, value in kept.items()}
                    constant = known["std"] <= 1e-6 * (1 + known["mean"].abs())  # is only shifted
                    mean[dims], std[dims] = known["mean"], torch.where(constant, 1.0, known["std"])
                elif "max" in known and (known["max"] >= torch.tensor(feature.categories)).any():
                    raise ValueError(
                        f"{feature.key} reaches {known['max'].tolist()} in the dataset, whose info.json gives it the "
                        f"categories {feature.categories}: numbers from 0 to one less."
                    )
        if root is None and "frame_index" in dataset_stats and "timestamp" in dataset_stats:
            last = _numbers(dataset_stats["frame_index"]["max"])
            self.horizon.fill_(last.item() + 1)
            self.fps.fill_((last / _numbers(dataset_stats["timestamp"]["max"])).item() if last > 0 else 1.0)

    def keep_time(self, fps: float, horizon: int) -> None:
        """Take over how many frames a second a dataset has, and how many steps its longest episode."""
        self.fps.fill_(fps)
        self.horizon.fill_(horizon)

    def warn_of_difference(self, before: Mapping[str, Tensor]) -> None:
        """Say by how much a dataset differs from the one that a checkpoint was trained on.

        Args:
            before: `state_dict` of the statistics that the checkpoint kept.
        """
        for name in self.features:
            moved = (self.get_buffer(f"{name}_mean") - before[f"{name}_mean"]).abs() / before[f"{name}_std"]
            if moved.max() > 0.1:
                logger.warning(
                    "This dataset is not what the checkpoint was trained on: a mean of %s lies %.2g of its standard "
                    "deviations away. The model now reads it in this dataset's units.",
                    name,
                    moved.max().item(),
                )

    def normalise(self, window: Window) -> Window:
        values = {
            name: (value - self.get_buffer(f"{name}_mean")) / self.get_buffer(f"{name}_std")
            for name, value in window.values.items()
            if name in self.features
        }
        return Window(window.values | values, window.valid)  # pictures as they are

    def denormalise(self, name: str, output: Output, prediction: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """A prediction of one continuous output, (..., size), as weights (..., n), means and scales (..., n, d) of n
        Gaussians, in the dataset's units; the scales are None where the head predicts none."""
        mean, std = (self.get_buffer(f"{name}_{part}")[output.dims] for part in ("mean", "std"))
        logits, means, scales = output.unpack(prediction)
        return logits.softmax(-1), means * std + mean, scales.exp() * std if output.gaussians else None


def _numbers(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float32).flatten()
