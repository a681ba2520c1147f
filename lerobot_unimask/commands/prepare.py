"""`unimask prepare`: from a dataset as it was found to one that trains."""

import argparse
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, boolean, positive


def add(commands: Any) -> None:
    parser = add_command(
        commands, "prepare", "make a dataset that trains from one as it was found, or add a label to it"
    )
    parser.add_argument("--dataset.root", type=Path, required=True, dest="root", metavar="DIR")
    parser.add_argument("--output", type=Path, metavar="DIR", help="a new folder for the result")
    parser.add_argument("--replace", type=boolean, default=False, metavar="true", help="write in the old one's place")
    changes = parser.add_argument_group("changes, beside those that are found to be needed")
    changes.add_argument("--rename", action="append", default=[], metavar="OLD=NEW", help="a column; repeatable")
    changes.add_argument(
        "--drop", action="append", default=[], metavar="COLUMN", help="a column, or missing: cameras without files"
    )
    changes.add_argument(
        "--categories",
        action="append",
        default=[],
        metavar="COLUMN=N",
        help="whole numbers that are choices; N or auto",
    )
    label = parser.add_argument_group("a label: a property of each episode, or the return-to-go, as a new column")
    what = label.add_mutually_exclusive_group()
    what.add_argument("--return_to_go", action="store_true", help="from next.reward, as observation.return_to_go")
    what.add_argument("--visits", metavar="STATE=CATEGORY", help="whether any step is there, as in agent_cell=0")
    what.add_argument(
        "--function",
        metavar="MODULE:NAME",
        help="a Python function of one episode's columns, a dict of arrays, that returns its label",
    )
    label.add_argument("--name", metavar="observation.NAME", help="the label's column")
    label.add_argument("--label_categories", type=positive, help="how many, where whole numbers do not all occur")
    parser.set_defaults(run=_run)


def _pairs(texts: list[str], flag: str) -> dict[str, str]:
    pairs = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (key and equals and value):
            raise ValueError(
                f"--{flag}={text} is no pair: write it as --{flag} {'COLUMN=auto' if flag[0] == 'c' else 'OLD=NEW'}."
            )
        pairs[key] = value
    return pairs


def _run(arguments: argparse.Namespace) -> None:
    from dataset_builders.prepare import make_plan, prepare

    if arguments.output is not None and arguments.replace:
        raise ValueError("--output and --replace=true say two things: give one of them.")
    categories = _pairs(arguments.categories, "categories")
    wrong = [value for value in categories.values() if value != "auto" and not value.isdecimal()]
    if wrong:
        raise ValueError(f"--categories gives {wrong[0]!r}; give a number, or auto.")
    changes = {"rename": _pairs(arguments.rename, "rename"), "drop": arguments.drop, "categories": categories}
    labels = arguments.return_to_go or arguments.visits is not None or arguments.function is not None
    if arguments.name is not None and not labels:
        raise ValueError("--name is given without a label: add --return_to_go, --visits or --function.")
    plan = make_plan(arguments.root, **changes)
    print("\n".join(plan.why) or f"{arguments.root} needs nothing to train.")
    if arguments.output is None and not arguments.replace:
        if plan.steps or labels:
            print(
                "Nothing has been written: --output=DIR writes the result there, --replace=true in the old one's place."
            )
        return
    root = arguments.root
    if plan.steps or not labels:
        root = prepare(arguments.root, plan, output=arguments.output)
    if labels:
        root = _label(arguments, root, None if plan.steps else arguments.output)
    print(f"written to {root}; videos are links to the same files where the disk allows it")


def _label(arguments: argparse.Namespace, root: Path, output: Path | None) -> Path:
    from dataset_builders import label

    labeller: label.Labeller
    if arguments.return_to_go:
        name, labeller, how = arguments.name or "observation.return_to_go", label.remaining_return, "return-to-go"
    elif arguments.name is None:
        raise ValueError("--name is missing: what is the new column called? As in --name=observation.visits_corner.")
    elif arguments.visits is not None:
        name, labeller = arguments.name, label.visits(root, arguments.visits)
        how = f"visits {arguments.visits}"
    else:
        name, labeller, how = arguments.name, label.load_function(arguments.function), arguments.function
    root = label.add_label(root, name, labeller, how=how, output=output, categories=arguments.label_categories)
    print(f"{name} in {root}")
    return root
