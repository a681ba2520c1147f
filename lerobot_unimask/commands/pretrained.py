"""`unimask pretrained`: where the policies are that come with the package."""

import argparse
from typing import Any

from lerobot_unimask.commands.flags import add_command
from lerobot_unimask.pretrained import FOLDERS


def add(commands: Any) -> None:
    parser = add_command(commands, "pretrained", "print the folder of a policy that comes with the package")
    parser.add_argument("name", choices=FOLDERS, help="also what --policy.path= of unimask's commands takes")
    parser.set_defaults(run=_run, light=True)


def _run(arguments: argparse.Namespace) -> None:
    print(FOLDERS[arguments.name])
