"""`unimask frames`: the pictures that training has decoded, what they take on the disk, and how to be rid of them."""

import argparse
from typing import Any

from lerobot_unimask.commands.flags import add_command, boolean


def add(commands: Any) -> None:
    parser = add_command(commands, "frames", "tell how much disk the decoded pictures of datasets take, or remove them")
    parser.add_argument(
        "--remove", type=boolean, default=False, metavar="true", help="remove them; training decodes them again"
    )
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.data.frames import frames_folder, stored_files

    files = stored_files()
    size = sum(bytes_taken for _, bytes_taken in files)
    if arguments.remove:
        for path, _ in files:
            path.unlink(missing_ok=True)
    verb = "removed from" if arguments.remove else "in"
    whole = sum(path.suffix == ".frames" for path, _ in files)
    print(f"frames of {whole} cameras, {size / 1e9:.3g} GB, {verb} {frames_folder()}")
