"""Makes one LeRobotDataset from another: from a dataset as it was found to one that trains.

Columns get LeRobot's names, cameras without files go, columns of two dimensions become rows, nested names become plain,
whole numbers that are choices get their categories, absent statistics are computed, and format v2.1 becomes v3.0 by
LeRobot's own converter. Videos are linked, not copied, where the disk allows it. The new dataset appears whole or not
at all, and the old one stays as it is.

Shapes: N frames, E episodes, D numbers of a column.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_PREFIX, OBS_STATE

from dataset_builders.folders import refuse_existing, written_whole
from dataset_builders.label import copy_rest, flat_numbers, rewrite, stored_schema, with_statistics
from dataset_builders.writer import EpisodeStatistics, as_cells, dataset_statistics, episode_statistics
from lerobot_unimask.data.episodes import (
    TASKS,
    absent_files,
    check_age,
    check_folder,
    check_tables,
    check_whole,
    is_type,
    order_of_tasks,
    read_statistics,
)
from lerobot_unimask.data.factors import TEXTS, flat_names
from lerobot_unimask.data.soundness import (
    are_statistics,
    check_columns,
    check_statistics,
    data_files,
    episode_files,
    episode_lengths,
)
from lerobot_unimask.records import read_json, write_json

PICTURES = ("image", "video")
OTHER_NAMES = {  # what others call what LeRobot calls so
    OBS_STATE: ("state", "states", "observation.states", "qpos", "observation.qpos", "proprio"),
    ACTION: ("actions", "act"),
}
AUTO = "auto"


@dataclass
class Plan:
    """What is to be done to a dataset, and why.

    Attributes:
        convert: whether to bring format v2.1 to v3.0.
        rename: old name -> new name.
        drop: columns to leave out.
        flatten: columns of several dimensions, or of none, that become rows.
        retype: columns whose type in info.json is none that a table has.
        categories: column -> number of categories, or `auto` to count them.
        statistics: columns, by their new names, whose statistics are absent.
        why: a line for each step.
    """

    convert: bool = False
    rename: dict[str, str] = field(default_factory=dict)
    drop: list[str] = field(default_factory=list)
    flatten: list[str] = field(default_factory=list)
    retype: list[str] = field(default_factory=list)
    categories: dict[str, int | str] = field(default_factory=dict)
    statistics: list[str] = field(default_factory=list)
    why: list[str] = field(default_factory=list)

    @property
    def steps(self) -> list[str]:
        """The lines of what is done."""
        return [line for line in self.why if not line.startswith("(not done)")]


def make_plan(
    root: Path,
    *,
    rename: Mapping[str, str] | None = None,
    drop: Sequence[str] = (),
    categories: Mapping[str, str] | None = None,
) -> Plan:
    """Look through a dataset's metadata and say what it needs to train.

    Args:
        root: folder of the dataset.
        rename: old name -> new name, beside what is found out.
        drop: columns to leave out; `missing`: the cameras whose files are absent.
        categories: column -> how many, or `auto`.

    Raises:
        FileNotFoundError: there is no dataset in `root`, or what LeRobot's converter reads of one is missing.
        ValueError: a column that there is not, or a name that is taken.
    """
    check_folder(root)
    info = read_json(root / "meta" / "info.json")
    features: dict[str, dict[str, Any]] = info["features"]
    plan, asked = Plan(), dict(rename or {})
    for key in (*asked, *(categories or {}), *(name for name in drop if name != "missing")):
        if key not in features and key not in asked.values():
            raise ValueError(f"{root} has no column {key!r}; it has {', '.join(features)}.")
    check_age(root, info["codebase_version"])
    if (root / TASKS).exists() and order_of_tasks(root) is not None:
        plan.why.append(f"tasks: {TASKS} does not list their texts by number, from 0 on.")
    if not str(info.get("codebase_version", "")).startswith("v3"):
        plan.convert = True
        plan.why.append(f"convert: the format is {info.get('codebase_version')}, and LeRobot reads v3.0.")
        for name in ("tasks", "episodes", "episodes_stats"):
            if not (root / "meta" / f"{name}.jsonl").exists():
                raise FileNotFoundError(
                    f"{root} lacks meta/{name}.jsonl, which LeRobot's converter reads: copy or fetch it anew."
                )
    for wanted, others in OTHER_NAMES.items():
        found = [name for name in others if name in features and name not in asked]
        have = wanted in features or (wanted == OBS_STATE and OBS_ENV_STATE in features)
        if not have and wanted not in asked.values() and found:
            asked[found[0]] = wanted
    plan.drop = [name for name in drop if name != "missing"]
    plan.why += [f"--drop {name}." for name in plan.drop]
    absent = [] if plan.convert else [key for key in absent_files(root, info) if key]
    for key, entry in features.items():
        seen = key.startswith(OBS_PREFIX) or key in (*asked, *plan.drop, *absent)
        if entry["dtype"] in PICTURES and not seen:
            asked[key] = f"{OBS_IMAGES}.{key}"
    for old, new in asked.items():
        if new in features:
            raise ValueError(f"{root} has a column {new!r} already, so {old!r} cannot be called so.")
        plan.rename[old] = new
        plan.why.append(f"--rename {old}={new}: LeRobot's policies read columns of that name.")
    for key in absent:
        if key not in plan.drop:
            plan.drop.append(key)
            plan.why.append(f"--drop {key}: its files are not in {root / 'videos'}.")
    if not plan.convert:
        check_whole(root, without=plan.drop)
        check_tables(root, info, without=plan.drop)
    stats = read_statistics(root)
    for old, entry in features.items():
        new = plan.rename.get(old, old)
        if old in plan.drop:
            continue
        if entry["dtype"] in (*PICTURES, *TEXTS):
            if old in stats and not are_statistics(stats[old]):
                plan.why.append(f"statistics of {new}: those in meta/stats.json are no numbers, and are left out.")
            continue
        if not is_type(entry["dtype"]):
            plan.retype.append(old)
            plan.why.append(
                f"type of {new}: {entry['dtype']} in info.json, which no table has; that of the files instead."
            )
        if len(entry["shape"]) != 1:
            plan.flatten.append(old)
            plan.why.append(f"flatten {new}: it has shape {tuple(entry['shape'])}, and policies read rows of numbers.")
        whole = entry["dtype"].startswith(("int", "uint")) and "categories" not in entry
        if new == ACTION and whole and new not in (categories or {}) and old not in (categories or {}):
            plan.why.append(f"(not done) {new} holds whole numbers: if they are choices, --categories {new}=auto.")
        fault = (
            None
            if plan.convert or old in plan.flatten
            else _fault(stats.get(old, {}), int(np.prod(entry["shape"])), _is_read(new))
        )
        if fault or old in plan.flatten:
            plan.statistics.append(new)
            plan.why.append(f"statistics of {new}: {fault or 'those in meta/stats.json have its old shape'}.")
    plan.why += _not_done({plan.rename.get(key, key): entry for key, entry in features.items() if key not in plan.drop})
    for key, count in (categories or {}).items():
        plan.categories[plan.rename.get(key, key)] = count if count == AUTO else int(count)
        plan.why.append(f"--categories {key}={count}.")
    nested = [plan.rename.get(key, key) for key in features if key not in plan.drop and _is_nested(features[key])]
    if nested and plan.steps:
        plan.why.append(f"names of {', '.join(nested)}: they are nested, which alone would not matter.")
    return plan


def _not_done(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What policies miss among the columns as they will be, and only the user can name."""
    numbers, why = {key for key, entry in features.items() if entry["dtype"] not in (*PICTURES, *TEXTS)}, []
    if ACTION not in numbers:
        why.append(f"(not done) no column of numbers is called {ACTION}: --rename OLD={ACTION} gives one that name.")
    if not numbers & {OBS_STATE, OBS_ENV_STATE}:
        why.append(
            f"(not done) no column of numbers is called {OBS_STATE}: --rename OLD={OBS_STATE} gives one that name, or "
            f"train with --policy.states and columns called {OBS_PREFIX}*."
        )
    return why


def _is_nested(entry: Mapping[str, Any]) -> bool:
    """Whether a column's names are nested: read as they are, but plain in a dataset that is written anew."""
    return entry.get("names") not in (None, flat_names(entry.get("names")))


def _fault(known: Mapping[str, Any], size: int, is_read: bool) -> str | None:
    """What is wrong with a column's statistics."""
    if not are_statistics(known):
        return "those in meta/stats.json are no numbers"
    if not {"mean", "std"} <= known.keys():
        return "meta/stats.json lacks them"
    try:
        check_statistics("it", [""] * size, known)
    except ValueError:
        return "those in meta/stats.json are not sound" if is_read else None
    return None


def _is_read(key: str) -> bool:
    """Whether policies read columns of that name; others may hold what they like."""
    return key == ACTION or key.startswith(OBS_PREFIX)


def prepare(root: Path, plan: Plan, *, output: Path | None = None) -> Path:
    """Carry out a plan.

    Args:
        output: folder to write to, new or empty; None: in place of `root`.

    Returns:
        The new dataset's folder.

    Raises:
        FileExistsError: `output` exists and is not an empty folder; it is left as it was.
        ValueError: a column does not hold what the plan says of it, or numbers that are not finite.
    """
    root = Path(root).expanduser().resolve()
    target = root if output is None else refuse_existing(output)
    with written_whole(target, replacing=output is None) as new:
        source = convert(root, new.with_name("converted")) if plan.convert else root
        if plan.convert:  # now the files can be looked for
            plan.drop += [k for k in make_plan(source).drop if k not in plan.drop]
        copy_rest(source, new, without=plan.drop)
        for old, name in plan.rename.items():  # a video's files bear its name
            if (new / "videos" / old).is_dir():
                (new / "videos" / old).rename(new / "videos" / name)
        _rewrite_all(source, new, plan)
    return target


def convert(root: Path, target: Path) -> Path:
    """A dataset of format v2.1 in format v3.0, by the parts of LeRobot's converter; `root` stays as it is."""
    from lerobot.scripts import convert_dataset_v21_to_v30 as lerobots

    sizes = lerobots.DEFAULT_DATA_FILE_SIZE_IN_MB, lerobots.DEFAULT_VIDEO_FILE_SIZE_IN_MB
    lerobots.validate_local_dataset_version(root)
    lerobots.convert_info(root, target, *sizes)
    lerobots.convert_tasks(root, target)
    episodes = lerobots.convert_data(root, target, sizes[0])
    videos = lerobots.convert_videos(root, target, sizes[1])
    lerobots.convert_episodes_metadata(root, target, episodes, videos)
    return target


def _rewrite_all(source: Path, partial: Path, plan: Plan) -> None:
    info = read_json(source / "meta" / "info.json")
    old_features = {key: entry for key, entry in info["features"].items() if key not in plan.drop}
    columns = _read_numbers(source, old_features, plan)
    kinds = pq.read_schema(data_files(source)[0])
    for old in plan.retype:
        old_features[old] = {**old_features[old], "dtype": _dtype(kinds.field(old).type)}
    features = {plan.rename.get(old, old): _entry(old, entry, plan, columns) for old, entry in old_features.items()}
    stored = stored_schema(features)
    new_names = {old: plan.rename.get(old, old) for old in old_features}

    numbers = order_of_tasks(source)
    if numbers:
        texts = pd.DataFrame({"task_index": range(len(numbers))}, index=pd.Index(numbers.values(), name="task"))
        (partial / TASKS).unlink()  # a link, it may be
        texts.to_parquet(partial / TASKS)

    def with_columns(table: pa.Table) -> pa.Table:
        arrays = {new: table.column(old) for old, new in new_names.items() if old in table.column_names}
        fields = [stored.field(new) for new in arrays]
        if numbers:
            renumbered = np.searchsorted(list(numbers), arrays["task_index"].to_numpy())
            arrays["task_index"] = pa.chunked_array([renumbered])
        cells = [_as_stored(f.name, arrays[f.name], f.type, features[f.name]["shape"]) for f in fields]
        return pa.table(cells, schema=pa.schema(fields, metadata=stored.metadata))

    for path in data_files(source):
        rewrite(path, partial / path.relative_to(source), with_columns)
    lengths = episode_lengths(source)
    measured = {
        old: flat_names(old_features[old].get("names")) for old in new_names if new_names[old] in plan.statistics
    }
    check_columns(source, measured)
    found = {key: episode_statistics(columns[key], lengths) for key in plan.statistics if key in columns}
    for path in episode_files(source):
        rewrite(path, partial / path.relative_to(source), lambda table: _episodes_table(table, plan, found))
    old_stats = read_statistics(source)
    stats = {plan.rename.get(k, k): v for k, v in old_stats.items() if k not in plan.drop and are_statistics(v)}
    for key, statistics in found.items():
        stats[key] = {name: value.tolist() for name, value in dataset_statistics(statistics).items()}
    write_json(partial / "meta" / "stats.json", stats, say=False)
    write_json(partial / "meta" / "info.json", {**info, "features": features}, say=False)


def _read_numbers(source: Path, features: Mapping[str, Mapping[str, Any]], plan: Plan) -> dict[str, np.ndarray]:
    """The columns that have to be counted or measured, by their new names, (N, D) each."""
    wanted = {*plan.statistics, *plan.categories}
    columns = {}
    for old in features:
        new = plan.rename.get(old, old)
        if new in wanted:
            parts = [flat_numbers(pq.read_table(path, columns=[old]).column(old)) for path in data_files(source)]
            columns[new] = np.concatenate(parts).reshape(sum(episode_lengths(source)), -1)
    return columns


def _dtype(kind: pa.DataType) -> str:
    """The dtype of info.json for a column stored as (lists of) numbers of this kind."""
    while isinstance(kind, pa.BaseExtensionType) or pa.types.is_nested(kind):
        kind = kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind.value_type
    return str(np.dtype(kind.to_pandas_dtype()))


def _entry(old: str, entry: dict[str, Any], plan: Plan, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """A column's entry in info.json, as it will be."""
    entry, new = dict(entry), plan.rename.get(old, old)
    if old in plan.flatten:
        entry["shape"] = [int(np.prod(entry["shape"]))]
    if entry["dtype"] not in PICTURES:
        names = flat_names(entry.get("names"))
        entry["names"] = names if len(names) == np.prod(entry["shape"]) else None
    if new in plan.categories:
        values = columns[new]
        count = int(values.max()) + 1 if plan.categories[new] == AUTO else plan.categories[new]
        if values.min() < 0 or values.max() >= count or (values != np.round(values)).any():
            raise ValueError(f"{new} runs from {values.min():g} to {values.max():g}; categories count from 0 on.")
        entry |= {"dtype": "int64", "categories": [int(count)] * values.shape[1]}
    return entry


def _as_stored(
    key: str, column: pa.ChunkedArray, kind: pa.DataType, shape: Sequence[int]
) -> pa.Array | pa.ChunkedArray:
    """A column as its new type stores it: a list of a row's numbers, or the number itself.

    Raises:
        ValueError: it holds other things.
    """
    if column.type == kind:
        return column
    try:
        if pa.types.is_struct(column.type):  # pictures
            return column.cast(kind)
        return as_cells(flat_numbers(column).reshape(len(column), int(np.prod(shape))), kind)
    except (ValueError, TypeError, pa.ArrowException) as error:
        raise ValueError(
            f"{key} holds {column.type}, and meta/info.json says {kind} of shape {tuple(shape)} ({error}): mend the "
            f"data, or leave the column out with --drop {key}."
        ) from error


def _episodes_table(table: pa.Table, plan: Plan, found: Mapping[str, EpisodeStatistics]) -> pa.Table:
    """The episodes' metadata with columns renamed, dropped, and statistics added."""
    gone = {*plan.drop, *found}
    kept = []
    for name in table.column_names:
        kind, _, rest = name.partition("/")
        key = rest.rpartition("/")[0]
        if kind in ("stats", "videos") and (key in gone or plan.rename.get(key, key) in gone):
            continue
        new = f"{kind}/{plan.rename[key]}/{rest.rpartition('/')[2]}" if key in plan.rename else name
        kept.append((new, table.column(name)))
    return with_statistics(pa.table([column for _, column in kept], names=[name for name, _ in kept]), found)
