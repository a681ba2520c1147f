"""`unimask given`: goals or waypoints of recorded episodes, as `--policy.given` takes them."""

import argparse
import json
from typing import Any

from lerobot_unimask.commands.flags import add_command, dataset_flags, open_both, policy_flags


def add(commands: Any) -> None:
    parser = add_command(
        commands, "given", "print goals or waypoints of recorded episodes, for lerobot-eval --policy.given"
    )
    policy_flags(parser)
    dataset_flags(parser)
    parser.add_argument(
        "--dataset.episodes",
        required=True,
        dest="episodes",
        metavar="0:50",
        help="episodes, as many as lerobot-eval has environments, --eval.batch_size",
    )
    parser.add_argument("--tokens", default="s[-1]", help="single tokens, as in 's[3], s[-1]'; default: %(default)s")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.query import given_from_episodes

    print(json.dumps(given_from_episodes(*open_both(arguments), arguments.episodes, arguments.tokens)))
