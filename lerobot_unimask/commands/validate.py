"""`unimask validate`: the validation loss of each task."""

import argparse
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, dataset_flags, output_flag, policy_flags, write_record


def add(commands: Any) -> None:
    parser = add_command(commands, "validate", "validation loss of each task, as in the paper's heatmap")
    policy_flags(parser, several=True)
    dataset_flags(parser)
    parser.add_argument(
        "--exact", metavar="EXPERT", help="expert of the data, whose exact optimum is set beside the models (DoorKey)"
    )
    output_flag(parser)
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="draw how often the returns and properties come that are said to be so likely",
    )
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.plots.reliability import reliability
    from lerobot_unimask.validation import summary, validate

    record = validate(
        arguments.path, arguments.root, arguments.repo_id, exact=arguments.exact, revision=arguments.revision
    )
    print(summary(record))
    write_record(arguments, record)
    if arguments.plot:
        reliability(record).savefig(arguments.plot, dpi=150)
