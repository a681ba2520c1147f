"""`unimask measure`: what a policy's answers are worth, on episodes that it was not trained on."""

import argparse
import json
from typing import Any

from lerobot_unimask.commands.flags import (
    add_command,
    dataset_flags,
    open_both,
    output_flag,
    policy_flags,
    positive,
    write_record,
)


def add(commands: Any) -> None:
    parser = add_command(
        commands, "measure", "how far ahead a policy sees, whether its directions agree, how fast it acts"
    )
    policy_flags(parser)
    dataset_flags(parser)
    parser.add_argument(
        "--dataset.episodes",
        required=True,
        dest="episodes",
        metavar="900:1000",
        help="episodes that it was not trained on",
    )
    parser.add_argument("--ahead", type=positive, default=5, help="steps to see ahead; default: %(default)s")
    output_flag(parser)
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.data.episodes import episode_numbers
    from lerobot_unimask.measures import measure
    from lerobot_unimask.records import versions

    policy, dataset = open_both(arguments)
    episodes = episode_numbers(arguments.episodes, len(dataset.meta.episodes))
    record = measure(policy, dataset, episodes, ahead=arguments.ahead)
    record["policy"] = policy.describe_origin()
    record |= {"command": arguments.text, "versions": versions()}
    print(json.dumps(record, indent=2))
    write_record(arguments, record)
