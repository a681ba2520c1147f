"""`unimask build`: a dataset of an environment's expert."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, boolean, positive, private_flag


def add(commands: Any) -> None:
    build = add_command(commands, "build", "roll out an expert and write a LeRobotDataset")
    environments = build.add_subparsers(dest="environment", required=True, metavar="ENVIRONMENT")

    doorkey = add_command(environments, "doorkey", "the paper's gridworld, a noisy-rational expert")
    _dataset(doorkey, episodes=500)
    doorkey.add_argument(
        "--expert",
        choices=("paper", "released"),
        default="paper",
        help="how the expert counts a bump into a wall: as the paper's text says, or as its authors' code does",
    )
    _camera(doorkey)
    doorkey.set_defaults(run=_build, settings=("expert", "camera", "use_videos"))

    maze2d = add_command(environments, "maze2d", "a point mass in a maze, a waypoint controller")
    _dataset(maze2d, episodes=1000)
    maze2d.add_argument("--noise", type=float, default=0.5, help="standard deviation of the noise on actions")
    maze2d.add_argument("--maze", default="medium", help="umaze, medium, large, or a maze's own text; or several: A,B")
    _camera(maze2d)
    maze2d.add_argument(
        "--hide_goal", type=boolean, default=False, metavar="true", help="leave the goal out of the state"
    )
    maze2d.set_defaults(run=_build, settings=("noise", "maze", "camera", "use_videos", "hide_goal"))

    metaworld = add_command(environments, "metaworld", "tasks of MetaWorld for a Sawyer arm, scripted experts (extra)")
    _dataset(metaworld, episodes=100)
    metaworld.add_argument("--task", required=True, metavar="NAME", help="as in peg-insert-side-v3, or several: A,B")
    metaworld.add_argument(
        "--noise", type=float, default=0.1, help="standard deviation of the noise on half of the steps"
    )
    metaworld.set_defaults(run=_build, settings=("task", "noise"))


def _dataset(parser: argparse.ArgumentParser, *, episodes: int) -> None:
    parser.add_argument("--episodes", type=positive, default=episodes, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same episodes")
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="the dataset's folder; new or empty")
    parser.add_argument("--repo_id", metavar="ME/NAME", help="the dataset's name on the Hub")
    parser.add_argument("--push_to_hub", type=boolean, default=False, metavar="true", help="push it when it is built")
    private_flag(parser)


def _camera(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--camera", type=boolean, default=False, metavar="true", help="add observation.images.top, a video from above"
    )
    parser.add_argument(
        "--use_videos", type=boolean, default=True, metavar="false", help="false: pictures in place of the video"
    )


def _build(arguments: argparse.Namespace) -> None:
    if arguments.push_to_hub and not arguments.repo_id:  # before the work is done
        raise ValueError("--push_to_hub=true needs the repository's name: --repo_id=ME/NAME.")
    if not getattr(arguments, "use_videos", True) and not arguments.camera:
        raise ValueError("--use_videos=false says how pictures are stored, and there are none without --camera=true.")
    from dataset_builders.doorkey import build_doorkey
    from dataset_builders.maze2d import build_maze2d
    from dataset_builders.metaworld import build_metaworld

    builders: dict[str, Callable[..., Path]] = {
        "doorkey": build_doorkey,
        "maze2d": build_maze2d,
        "metaworld": build_metaworld,
    }
    build = builders[arguments.environment]
    settings = {name: getattr(arguments, name) for name in ("episodes", "seed", "repo_id", *arguments.settings)}
    root = build(arguments.root, **settings)
    print(f"{arguments.episodes} episodes in {root}")
    if arguments.push_to_hub:
        from lerobot_unimask.commands.push import push_dataset

        print(f"pushed to {push_dataset(root, arguments.repo_id, private=arguments.private)}")
