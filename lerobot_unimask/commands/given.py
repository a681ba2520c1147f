"""`unimask given`: goals or waypoints of recorded episodes, as `--policy.given` takes them."""

import argparse
import json
from typing import Any

from lerobot_unimask.commands.flags import add_command, dataset_flags, policy_flags


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
    from lerobot_unimask.data.episodes import open_dataset
    from lerobot_unimask.modeling_unimask import UniMASKPolicy
    from lerobot_unimask.query import given_from_episodes

    policy = UniMASKPolicy.from_pretrained(arguments.path, revision=arguments.revision)
    dataset = open_dataset(policy.config, arguments.root, arguments.repo_id)
    print(json.dumps(given_from_episodes(policy, dataset, arguments.episodes, arguments.tokens)))
