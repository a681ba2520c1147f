"""`unimask bench`: how fast this machine reads, trains, acts, evaluates and builds."""

import argparse
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, write_record


def add(commands: Any) -> None:
    parser = add_command(commands, "bench", "how fast this machine reads, trains, acts, evaluates and builds")
    parser.add_argument("--configs", type=Path, default=Path("configs"), metavar="DIR", help="default: %(default)s")
    parser.add_argument("--quick", action="store_true", help="everything once, in a minute, to try the command itself")
    parser.add_argument(
        "--device", metavar="DEVICE", help="only updates and actions, on this device (cuda), in eight minutes on a GPU"
    )
    parser.add_argument(
        "--beside",
        dest="light",  # what it measures loads what it needs in processes of its own
        action="store_true",
        help="only processor time, beside models of the same size",
    )
    parser.add_argument("--before", type=Path, metavar="DIR", help="with --beside: an older checkout, one more model")
    parser.add_argument("--avx2", action="store_true", help="with --beside: compute as if there were nothing newer")
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE.json",
        help="the record; without --device or --beside a picture goes beside it",
    )
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.bench import tables

    if arguments.light:
        from lerobot_unimask.bench.beside import bench_beside

        record, table = bench_beside(arguments.before, avx2=arguments.avx2), tables.beside
    elif arguments.device:
        from lerobot_unimask.bench.device import bench_device

        record, table = bench_device(arguments.configs, arguments.device, quick=arguments.quick), tables.device
    else:
        from lerobot_unimask.bench.measuring import bench

        record, table = bench(arguments.configs, quick=arguments.quick), tables.markdown
    write_record(arguments, record)
    print(table(record))
    if "growth" not in record:
        return
    from lerobot_unimask.plots.growth import cost_of_growth

    picture = arguments.output.with_suffix(".png")
    cost_of_growth(record).savefig(picture, dpi=200)
    print(f"drawn into {picture}")
