"""`unimask demo`: the main job from end to end."""

import argparse
import os
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, positive


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "demo",
        "ask the policy that comes with the package, then train another and ask it too: about four minutes",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("unimask-demo"),
        help="folder to write to, new or empty; default: %(default)s",
    )
    parser.add_argument("--steps", type=positive, default=None, help="training updates, for a shorter or longer demo")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    os.environ["HF_HUB_OFFLINE"] = "1"  # everything is local; the Hub's client reads this when it is imported
    from lerobot_unimask.demo import run_demo

    run_demo(arguments.output, **({"steps": arguments.steps} if arguments.steps else {}))
