"""The tables of the records of `unimask bench`."""

from collections.abc import Iterator, Mapping
from typing import Any

from lerobot_unimask.records import markdown_table


def targets(record: Mapping[str, Any]) -> list[tuple[str, str, str, bool]]:
    """What was promised: the quantity, its bound, what was measured, and whether it keeps the bound."""
    share = record["training"]["doorkey"]["share"]
    waiting = share["data"] + share["masks"]
    latency = record["acting"]["unimask"]["1"]["latency_ms"]["median"]
    rollout = record["evaluating"]["ms_per_rollout"]
    plain = record["building"]["stepping"]["ms_per_episode"]["median"]
    times = rollout["total"] / (plain + rollout["forward"])
    return [
        ("DoorKey training: share of waiting for data and drawing masks", "< 5 %", f"{waiting:.1%}", waiting < 0.05),
        ("Maze2D, one environment, one thread: `select_action`", "< 3 ms", f"{latency:.1f} ms", latency < 3),
        ("lerobot-eval beside plain stepping and forward passes", "≤ 2 times", f"{times:.2f} times", times <= 2),
    ]


def markdown(record: Mapping[str, Any]) -> str:
    """The record as the README's tables."""
    found = record["machine"]
    gpu = f", {found['gpu']}" if found["gpu"] else ", no GPU"
    machine = (
        f"{found['processor']}, {found['cores']} cores, {found['memory_gib']:.0f} GiB{gpu}; torch "
        f"{record['versions']['torch']}, LeRobot {record['versions']['lerobot']}. Memory is each process's peak, "
        f"of which {record['imports']['peak_memory_mib']} MiB are imports."
    )
    promised = [(what, bound, measured, "met" if met else "missed") for what, bound, measured, met in targets(record)]
    training = [
        (name, _text(run["step_ms"]), *(f"{share:.1%}" for share in run["share"].values()), run["peak_memory_mib"])
        for name, run in record["training"].items()
    ]
    parts = ("data", "masks", "forward", "backward", "optimiser", "rest")
    counts = list(record["acting"]["unimask"])
    acting = []
    for name, runs in record["acting"].items():
        one = runs[counts[0]]
        how = f", {one['passes']} passes" if one["passes"] > 1 else ""
        how += f", by default for {one['actions_per_chunk']} steps" if one["actions_per_chunk"] > 1 else ""
        memory = max(run["peak_memory_mib"] for run in runs.values())
        latencies = (_text(runs[n]["latency_ms"]) for n in counts)
        acting.append((f"{name} ({one['parameters'] / 1e6:.1f} M parameters{how})", *latencies, memory))
    environments = (f"{n} environment{'s' * (n != '1')}" for n in counts)
    baseline = ("median (quartiles)", "this package", "MiB", "baseline", "MiB", "baseline is")
    rollout = record["evaluating"]["ms_per_rollout"]
    evaluation = (
        f"Of a rollout's {rollout['total']:.0f} ms in lerobot-eval the network takes {rollout['forward']:.0f}, the "
        f"rest of acting {rollout['acting']:.1f}, the environment {rollout['environment']:.1f}, LeRobot and gymnasium "
        f"{rollout['lerobot']:.1f}."
    )
    tables = (
        machine,
        markdown_table(("target", "bound", "measured", "outcome"), promised),
        markdown_table(baseline, _beside_baselines(record)),
        markdown_table(("lerobot-train", "ms per step", *parts, "MiB"), training),
        markdown_table(("`select_action`, ms", *environments, "MiB"), acting),
        evaluation,
    )
    return "\n\n".join(tables) + "\n"


def _beside_baselines(record: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    read, build, rolled = record["reading"], record["building"], record["evaluating"]
    train = record["training"]
    per_second = {name: {"median": 1000 / build[name]["ms_per_episode"]["median"]} for name in build}
    items = train["doorkey, LeRobot's reads"]
    stepping = per_second["stepping"], build["stepping"], "stepping the environment alone"
    rows: list[tuple[Any, ...]] = [
        (
            "windows read per second",
            *(read["unimask"]["windows_per_second"], read["unimask"]),
            *(read["lerobot"]["windows_per_second"], read["lerobot"], "LeRobot, item by item"),
        ),
        (
            "DoorKey training steps per second",
            *({"median": train["doorkey"]["steps_per_second"]}, train["doorkey"]),
            *({"median": items["steps_per_second"]}, items, "the same, read item by item"),
        ),
        ("Maze2D episodes built per second", per_second["building"], build["building"], *stepping),
        ("Maze2D rollouts evaluated per second", {"median": rolled["rollouts_per_second"]}, rolled, *stepping),
    ]
    for what, ours, our_run, theirs, their_run, baseline in rows:
        yield what, _text(ours), our_run["peak_memory_mib"], _text(theirs), their_run["peak_memory_mib"], baseline


def _text(found: Mapping[str, Any]) -> str:
    """The median, with quartiles where they are known."""
    quartiles = found.get("quartiles")
    return _number(found["median"]) + (f" ({_number(quartiles[0])} to {_number(quartiles[1])})" if quartiles else "")


def _number(value: float) -> str:
    """Three digits."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def beside(record: Mapping[str, Any]) -> str:
    """The table of `unimask bench --beside`: of each model the median, the least, and its share of what this package
    took before, or takes."""
    names = list(dict.fromkeys(name for found in record["ms"].values() for name in found))
    rows = []
    for title, found in record["ms"].items():
        whole = found.get("before", found["unimask"])["median"]
        cells = {
            name: f"{one['median']:.1f} ({one['least']:.1f}), {one['median'] / whole:.2f}"
            for name, one in found.items()
        }
        rows.append((title, *(cells.get(name) for name in names)))
    heads = (name.replace("_", " ") for name in names)
    return markdown_table((f"processor ms{', AVX2' if record['avx2'] else ''}: median (least), ratio", *heads), rows)


def device(record: Mapping[str, Any]) -> str:
    """The tables of `unimask bench --device`."""
    machine = record["machine"]
    on_gpu = record["device"].startswith("cuda")
    where = machine["gpu"] if on_gpu else f"{machine['processor']}, {machine['cores']} cores"
    versions = record["versions"]
    updates = []
    for name, runs in record["updates"].items():
        for batch, run in runs.items():
            shown = {"launches": "{:.0f}", "waits": "{:.0f}", "kernel_ms": "{:.1f}", "kernel_share": "{:.0%}"}
            counted = (form.format(run[key]) if key in run else None for key, form in shown.items())
            step, rate = run["step_ms"]["median"], run["windows_per_second"]
            updates.append((name, batch, f"{step:.1f}", f"{rate:,.0f}", *counted))
    counts = list(dict.fromkeys(count for runs in record["acting"].values() for count in runs))
    acting = [
        (name, *(f"{runs[count]['latency_ms']['median']:.1f}" if count in runs else None for count in counts))
        for name, runs in record["acting"].items()
    ]
    heads = ("update", "batch", "ms", "windows a second", "launches", "waits", "kernels, ms", "share of the time")
    parts = [
        f"{where}; torch {versions['torch']}, LeRobot {versions['lerobot']}.",
        markdown_table(heads, updates),
        markdown_table(("an action, ms", *counts[:-1], f"{counts[-1]} environments"), acting),
    ]
    if record["left_out"]:
        parts.append(f"Left out for want of time: {'; '.join(record['left_out'])}.")
    parts += ["\n".join(f"Failed: {label}: {error}" for label, error in record["failed"].items())]
    return "\n\n".join(filter(None, parts))
