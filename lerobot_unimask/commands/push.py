"""`unimask push`: a policy or a dataset to the Hub, with its card."""

import argparse
import json
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, private_flag


def add(commands: Any) -> None:
    parser = add_command(commands, "push", "push a saved policy or a dataset to the Hub, or finish such a push")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--policy.path",
        type=Path,
        dest="policy",
        metavar="DIR",
        help="a checkpoint, or a lerobot-train output folder, of which the last checkpoint counts",
    )
    what.add_argument("--dataset.root", type=Path, dest="dataset", metavar="DIR", help="the dataset's folder")
    parser.add_argument("--repo_id", required=True, metavar="ME/NAME", help="its name on the Hub")
    parser.add_argument(
        "--results",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.json",
        help="for the policy's card: a record of `unimask validate`, or an eval_info.json of lerobot-eval; repeatable",
    )
    private_flag(parser)
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    if arguments.dataset:
        if arguments.results:
            raise ValueError("--results are a policy's; a dataset's card has none.")
        url = push_dataset(arguments.dataset, arguments.repo_id, private=arguments.private)
    else:
        from lerobot_unimask.data.checkpoints import last_checkpoint
        from lerobot_unimask.modeling_unimask import UniMASKPolicy
        from lerobot_unimask.sharing import cards, hub

        folder = last_checkpoint(arguments.policy)
        results = [json.loads(path.read_text()) for path in arguments.results]
        card = cards.policy_card(UniMASKPolicy.from_pretrained(folder).card_facts(folder), arguments.repo_id, results)
        url = hub.push_policy(folder, arguments.repo_id, card, private=arguments.private)
    print(f"pushed to {url}")


def push_dataset(root: Path, repo_id: str, *, private: bool | None = None) -> str:
    """Push a dataset with the card that suits its environment; see `hub.push_dataset`."""
    from lerobot_unimask.data.episodes import check_folder, provenance_of
    from lerobot_unimask.envs import environment_of_data
    from lerobot_unimask.sharing import cards, hub

    check_folder(root)
    card = cards.dataset_card(root, repo_id, environment_of_data(provenance_of(root)))
    return hub.push_dataset(root, repo_id, card, private=private)
