"""`unimask label`: a new column in a dataset."""

import argparse
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, positive


def add(commands: Any) -> None:
    parser = add_command(
        commands, "label", "add a column to a dataset: a property of its episodes, or the return-to-go"
    )
    parser.add_argument("--dataset.root", type=Path, required=True, dest="root", metavar="DIR")
    parser.add_argument("--output", type=Path, metavar="DIR", help="a new folder; without it the dataset is replaced")
    parser.add_argument("--name", metavar="observation.NAME", help="the new column's")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--return_to_go", action="store_true", help="from next.reward, as observation.return_to_go")
    what.add_argument("--visits", metavar="STATE=CATEGORY", help="whether any step is there, as in agent_cell=0")
    what.add_argument(
        "--function",
        metavar="MODULE:NAME",
        help="a Python function of one episode's columns, a dict of arrays, that returns its label",
    )
    parser.add_argument("--categories", type=positive, help="how many, where whole numbers do not all occur")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    from dataset_builders import label

    if arguments.return_to_go:
        name, labeller, how = arguments.name or "observation.return_to_go", label.remaining_return, "return-to-go"
    elif arguments.name is None:
        raise ValueError("--name is missing: what is the new column called? As in --name=observation.visits_corner.")
    elif arguments.visits is not None:
        name, labeller = arguments.name, label.visits(arguments.root, arguments.visits)
        how = f"visits {arguments.visits}"
    else:
        name, labeller, how = arguments.name, label.load_function(arguments.function), arguments.function
    root = label.add_label(
        arguments.root, name, labeller, how=how, output=arguments.output, categories=arguments.categories
    )
    print(f"{name} in {root}")
