"""What the commands share: values, the flags of policies and data, and errors that say which flag was meant."""

import argparse
import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_unimask.pretrained import FOLDERS

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_unimask.modeling_unimask import UniMASKPolicy


class Parser(argparse.ArgumentParser):
    """argparse that says which flag was probably meant."""

    def error(self, message: str):
        if message.startswith("unrecognized arguments:"):
            known = [flag for action in self._actions for flag in action.option_strings]
            wrong = message.removeprefix("unrecognized arguments:").split()[0].split("=")[0]
            near = difflib.get_close_matches(wrong, known, n=1)
            message += f"\n  Did you mean {near[0]}?" if near else f"\n  This command knows {', '.join(known)}."
        super().error(message)

    def parse_known_args(self, args=None, namespace=None):
        """A subcommand reports what it does not know itself, as the parser that knows its flags."""
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown and not self._subparsers:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return namespace, unknown


def add_command(commands: Any, name: str, what: str) -> argparse.ArgumentParser:
    """A subcommand's parser.

    Args:
        commands: the subparsers that it joins.
        what: one line of help.
    """
    return commands.add_parser(name, help=what, description=what[0].upper() + what[1:] + ".", allow_abbrev=False)


def positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def boolean(text: str) -> bool:
    if text not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither true nor false")
    return text == "true"


def policy_flags(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """`--policy.path` and `--policy.revision`, as `arguments.path` (a list of `several`) and `arguments.revision`."""
    which = "best" if several else "last"
    what = (
        f"a checkpoint, a lerobot-train output folder, of which the {which} checkpoint counts, a Hub repository, or "
        f"the name of a policy that comes with the package: {' or '.join(FOLDERS)}{'; repeatable' * several}"
    )
    action = "append" if several else "store"
    parser.add_argument("--policy.path", action=action, required=True, dest="path", metavar="PATH", help=what)
    parser.add_argument(
        "--policy.revision", dest="revision", metavar="COMMIT", help="commit of the Hub repository; default: newest"
    )


def dataset_flags(
    parser: argparse.ArgumentParser, *, required: bool = True, what: str = "the dataset's folder"
) -> None:
    """`--dataset.root` and `--dataset.repo_id`, as `arguments.root` and `arguments.repo_id`."""
    parser.add_argument("--dataset.root", type=Path, dest="root", metavar="DIR", help=what)
    parser.add_argument("--dataset.repo_id", dest="repo_id", metavar="ME/NAME", help="its name on the Hub")
    parser.set_defaults(needs_dataset=required)


def check_dataset(arguments: argparse.Namespace) -> None:
    """
    Raises:
        ValueError: a command that reads a dataset is told of none.
    """
    if getattr(arguments, "needs_dataset", False) and arguments.root is None and arguments.repo_id is None:
        raise ValueError("Which dataset? Give its folder, --dataset.root=DIR, or its name, --dataset.repo_id=ME/NAME.")


def open_both(arguments: argparse.Namespace) -> tuple["UniMASKPolicy", "LeRobotDataset"]:
    """The policy and the dataset that `policy_flags` and `dataset_flags` name."""
    from lerobot_unimask.data.episodes import open_dataset
    from lerobot_unimask.modeling_unimask import UniMASKPolicy

    policy = UniMASKPolicy.from_pretrained(arguments.path, revision=arguments.revision)
    return policy, open_dataset(policy.config, arguments.root, arguments.repo_id)


def write_record(arguments: argparse.Namespace, record: Mapping[str, Any]) -> None:
    """Write a record, and the command that made it, to where `--output` says, if it does."""
    from lerobot_unimask.records import write_json

    if arguments.output:
        write_json(arguments.output, {**record, "command": arguments.text})


def output_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--output", type=Path, metavar="FILE.json", help="write the record here")


def private_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--private", type=boolean, nargs="?", const=True, metavar="true", help="create the repository as a private one"
    )
