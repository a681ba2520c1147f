"""`unimask COMMAND ...`: what LeRobot's own commands do not do. Training and evaluation are lerobot-train and -eval."""

import importlib
import logging
import shlex
import sys

from lerobot_unimask.commands import (
    bench,
    build,
    demo,
    frames,
    given,
    measure,
    paper,
    prepare,
    pretrained,
    push,
    query,
    serve,
    validate,
)
from lerobot_unimask.commands.flags import Parser, check_dataset

COMMANDS = (demo, build, prepare, pretrained, query, given, validate, measure, push, frames, serve, bench, paper)


def make_parser() -> Parser:
    parser = Parser(
        prog="unimask",
        description="One masked model that answers any question about behaviour, as a LeRobot policy.",
        epilog="Training and evaluation are LeRobot's own: lerobot-train --policy.type=unimask ..., lerobot-eval ...",
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser


def main(argv: list[str] | None = None) -> None:
    """The console script `unimask`. Ends with status 2 and one line on bad input."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = make_parser().parse_args(argv)
    arguments.text = shlex.join(["unimask", *argv])  # for records
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        check_dataset(arguments)
        if not getattr(arguments, "light", False):
            importlib.import_module("lerobot_policy_unimask")  # as LeRobot's own commands do
        arguments.run(arguments)
    except KeyboardInterrupt:
        sys.exit("unimask: interrupted")
    except (ValueError, KeyError, OSError, ImportError) as error:
        message = error.args[0] if isinstance(error, KeyError) and error.args else error
        print(f"unimask: error: {message}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
