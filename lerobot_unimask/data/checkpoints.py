"""Checkpoints of a training run: which there are, and what was saved beside their weights."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor

from lerobot_unimask.data.episodes import provenance_of
from lerobot_unimask.records import read_json

CONFIG, WEIGHTS = "config.json", "model.safetensors"  # lerobot's names, in this order of being written
ADAPTER = "adapter_model.safetensors"  # PEFT's, in the weights' place
MAX_FAULTS = 20  # named in one error


def checkpoints_of(run: Path) -> list[Path]:
    """A training run's whole checkpoints in the order of their updates, or the folder itself if it is a checkpoint.

    Raises:
        FileNotFoundError: it is neither.
    """
    if (run / CONFIG).exists():
        return [run]
    found = [path.parent for path in run.glob(f"checkpoints/*/pretrained_model/{CONFIG}")]
    found = [path for path in found if path.parent.name.isdecimal() and _is_whole(path)]
    if not found:
        raise FileNotFoundError(
            f"{run} is neither a checkpoint (a folder with config.json) nor a training run with a whole one in "
            "checkpoints/."
        )
    return sorted(found, key=lambda path: int(path.parent.name))


def _is_whole(checkpoint: Path) -> bool:
    """Whether all that acting needs has been written; of the weights the header is read, which says where they end."""
    adapter = (checkpoint / ADAPTER).exists()
    try:
        with safe_open(checkpoint / (ADAPTER if adapter else WEIGHTS), framework="pt"):
            return True
    except (SafetensorError, OSError):
        return False


def last_checkpoint(run: Path) -> Path:
    """The checkpoint that a run's `last` points to; LeRobot sets it once all of a checkpoint has been written.

    Raises:
        FileNotFoundError: it is neither a training run nor a checkpoint.
    """
    last = run / "checkpoints" / "last" / "pretrained_model"
    if not (run / CONFIG).exists() and (last / CONFIG).exists():
        return last.parent.resolve() / last.name
    return checkpoints_of(run)[-1]


def _train_config(checkpoint: str | Path) -> dict[str, Any] | None:
    path = Path(checkpoint) / "train_config.json"
    return read_json(path) if path.exists() else None


def training_settings(checkpoint: str | Path | None) -> dict[str, Any] | None:
    """What lerobot-train saved beside the weights: the policy's settings, the seed, the data and its provenance but for
    what that says of each episode."""
    config = _train_config(checkpoint) if checkpoint is not None else None
    if config is None:
        return None
    root = config["dataset"].get("root")
    keep = ("seed", "batch_size", "steps")
    policy = {
        key: value for key, value in config["policy"].items() if isinstance(value, str | int | float | dict | list)
    }
    for unrelated in ("input_features", "output_features", "features", "normalization_mapping", "pretrained_path"):
        policy.pop(unrelated, None)
    provenance = provenance_of(Path(root)) if root else {}
    data = {key: value for key, value in provenance.items() if not isinstance(value, list)}
    return {**{key: config[key] for key in keep}, "policy": policy, "data": data or None}


def episodes_trained_on(checkpoint: str | Path | None, root: Path, repo_id: str | None, count: int) -> list[int]:
    """The episodes, of a dataset's `count`, that a checkpoint's training read: none where it read another dataset, by
    its folder or its name on the Hub, or where that is not known."""
    data = (_train_config(checkpoint) or {}).get("dataset") if checkpoint else None
    if not data:
        return []
    if data.get("root"):
        same = Path(data["root"]).resolve() == root.resolve()
    else:
        same = repo_id is not None and data.get("repo_id") == repo_id
    episodes = data.get("episodes")
    return (list(range(count)) if episodes is None else sorted(set(episodes) & set(range(count)))) if same else []


def check_header(file: Path, expected: Mapping[str, Tensor]) -> None:
    """Compare the header of a file of weights with tensors of `meta`: nothing of a config's sizes is allocated before
    the weights are known to have them.

    Raises:
        ValueError: the file is not one of safetensors, or lacks one of these tensors or has it in another shape; or
            there is an adapter in its place.
    """
    if not file.exists() and (file.parent / ADAPTER).exists():
        raise ValueError(
            f"{file.parent} holds a PEFT adapter, which lerobot-train and lerobot-eval load beside its base policy. "
            "To be asked it has to be merged: PeftModel.from_pretrained(UniMASKPolicy.from_pretrained(BASE), "
            "ADAPTER).merge_and_unload().save_pretrained(DIR)."
        )
    try:
        with safe_open(file, framework="pt") as weights:
            shapes = {name: tuple(weights.get_slice(name).get_shape()) for name in weights.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{file} cannot be read as safetensors: {error}") from error
    _refuse(_misshapen(shapes, expected), file)


def read_weights(file: Path) -> dict[str, Tensor]:
    """
    Raises:
        ValueError: the file is not one of safetensors.
    """
    try:
        return load_file(file, device="cpu")
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{file} cannot be read as safetensors: {error}") from error


def check_weights(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor], file: str | Path) -> None:
    """
    Raises:
        ValueError: names every tensor that is missing, too many, of another shape or type, or not finite, and every
            standard deviation that is not positive.
    """
    faults = _misshapen({name: tuple(tensor.shape) for name, tensor in weights.items()}, expected)
    faults += [f"extra {name}" for name in weights if name not in expected]
    for name, tensor in expected.items():
        found = weights.get(name)
        if found is None or found.shape != tensor.shape:
            continue
        if found.is_floating_point() != tensor.is_floating_point() or found.is_complex():
            faults.append(f"{name} has type {found.dtype} instead of {tensor.dtype}")
        elif not found.to(tensor.dtype).isfinite().all():
            faults.append(f"{name} holds numbers that are not finite")
        elif name.startswith("statistics.") and name.endswith(("_std", "horizon", "fps")) and not (found > 0).all():
            faults.append(f"{name} holds numbers that are not positive")
        elif name == "updates" and found < 0:
            faults.append("updates is negative")
    _refuse(faults, file)


def _misshapen(shapes: Mapping[str, tuple[int, ...]], expected: Mapping[str, Tensor]) -> list[str]:
    faults = [f"missing {name}" for name in expected if name not in shapes]
    for name, tensor in expected.items():
        if name in shapes and shapes[name] != tensor.shape:
            faults.append(f"{name} has shape {shapes[name]} instead of {tuple(tensor.shape)}")
    return faults


def _refuse(faults: Sequence[str], file: str | Path) -> None:
    if faults:
        more = f"; and {len(faults) - MAX_FAULTS} more" if len(faults) > MAX_FAULTS else ""
        raise ValueError(f"The weights in {file} are not those of its config: {'; '.join(faults[:MAX_FAULTS])}{more}.")
