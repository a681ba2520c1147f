"""`unimask build | demo | validate | curve`: what LeRobot's own commands do not do.

Training and evaluation are `lerobot-train` and `lerobot-eval`. Each command imports what it needs when it runs.
"""

import argparse
import difflib
import json
import logging
import shlex
import sys
from pathlib import Path


class _Parser(argparse.ArgumentParser):
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


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def make_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="unimask",
        description="One masked model that answers any question about behaviour, as a LeRobot policy.",
        epilog="Training and evaluation are LeRobot's own: lerobot-train --policy.type=unimask ..., lerobot-eval ...",
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    build = commands.add_parser("build", help="roll out an expert and write a LeRobotDataset", allow_abbrev=False)
    environments = build.add_subparsers(dest="environment", required=True, metavar="ENVIRONMENT")
    doorkey = environments.add_parser(
        "doorkey", help="the paper's gridworld, a noisy-rational expert", allow_abbrev=False
    )
    _dataset_arguments(doorkey, episodes=500)
    doorkey.add_argument(
        "--expert",
        choices=("paper", "released"),
        default="paper",
        help="how the expert counts a bump into a wall: as the paper's text says, or as its authors' code does",
    )
    doorkey.set_defaults(run=_build_doorkey)

    maze2d = environments.add_parser("maze2d", help="a point mass in a maze, a waypoint controller", allow_abbrev=False)
    _dataset_arguments(maze2d, episodes=1000)
    maze2d.add_argument("--noise", type=float, default=0.5, help="standard deviation of the noise on actions")
    maze2d.add_argument("--maze", default="medium", help="umaze, medium, large, or a maze's own text")
    maze2d.set_defaults(run=_build_maze2d)

    demo = commands.add_parser(
        "demo", help="build, train, evaluate and question a DoorKey model in a few minutes", allow_abbrev=False
    )
    demo.add_argument("--output", type=Path, default=Path("unimask-demo"), help="folder to write to; new or empty")
    demo.add_argument("--steps", type=_positive, default=None, help="training updates, for a shorter or longer demo")
    demo.set_defaults(run=_demo)

    validate = commands.add_parser(
        "validate", help="validation loss of each task, as in the paper's heatmap", allow_abbrev=False
    )
    validate.add_argument(
        "--run",
        type=Path,
        action="append",
        required=True,
        dest="runs",
        metavar="DIR",
        help="a checkpoint, or a lerobot-train output folder, of which the checkpoint with the lowest random-mask loss "
        "counts; give it once for each seed",
    )
    validate.add_argument("--dataset.root", type=Path, required=True, dest="root", metavar="DIR")
    validate.add_argument("--dataset.repo_id", default="local/dataset", dest="repo_id", metavar="ME/NAME")
    validate.add_argument("--output", type=Path, help="write the record here as JSON")
    validate.set_defaults(run=_validate)
    curve = commands.add_parser(
        "curve", help="return of each checkpoint of a run, by LeRobot's evaluation", allow_abbrev=False
    )
    curve.add_argument("--run", type=Path, action="append", required=True, dest="runs", metavar="DIR")
    curve.add_argument("--env.type", required=True, dest="env_type", choices=("doorkey", "maze2d"))
    curve.add_argument("--episodes", type=_positive, default=200, help="rollouts of each checkpoint")
    curve.add_argument("--last_episodes", type=_positive, default=1000, help="rollouts of the last one")
    curve.add_argument("--batch_size", type=_positive, default=100, help="environments side by side")
    curve.add_argument("--seed", type=int, default=100_000, help="of the first rollout's start")
    curve.add_argument("--output", type=Path, required=True, help="JSON record; a picture goes beside it")
    curve.set_defaults(run=_curve)
    return parser


def _dataset_arguments(parser: argparse.ArgumentParser, *, episodes: int) -> None:
    parser.add_argument("--episodes", type=_positive, default=episodes, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same episodes")
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="the dataset's folder; new or empty")
    parser.add_argument("--repo_id", metavar="ME/NAME", help="the dataset's name on the Hub")


def _build_doorkey(arguments: argparse.Namespace) -> None:
    from dataset_builders.doorkey import build_doorkey

    root = build_doorkey(
        arguments.root,
        episodes=arguments.episodes,
        seed=arguments.seed,
        expert=arguments.expert,
        repo_id=arguments.repo_id,
    )
    print(f"{arguments.episodes} episodes in {root}")


def _build_maze2d(arguments: argparse.Namespace) -> None:
    from dataset_builders.maze2d import build_maze2d

    root = build_maze2d(
        arguments.root,
        episodes=arguments.episodes,
        seed=arguments.seed,
        noise=arguments.noise,
        maze=arguments.maze,
        repo_id=arguments.repo_id,
    )
    print(f"{arguments.episodes} episodes in {root}")


def _demo(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.experiments.demo import run_demo

    run_demo(arguments.output, **({"steps": arguments.steps} if arguments.steps else {}))


def _validate(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.experiments.validation import validate

    record = validate(arguments.runs, arguments.root, arguments.repo_id)
    record["command"] = arguments.text
    width = max(map(len, record["mean"]))
    for task, loss in record["mean"].items():
        print(f"{task:{width}}  {loss:.4f}  (spread {record['spread'][task]:.4f} over {len(arguments.runs)} runs)")
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(record, indent=2) + "\n")
        print(f"written to {arguments.output}")


def _curve(arguments: argparse.Namespace) -> None:
    from lerobot_unimask import plots
    from lerobot_unimask.experiments.learning_curve import learning_curve

    record = learning_curve(
        arguments.runs,
        arguments.env_type,
        episodes=arguments.episodes,
        last_episodes=arguments.last_episodes,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
    )
    record["command"] = arguments.text
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(record, indent=2) + "\n")
    picture = arguments.output.with_suffix(".png")
    plots.learning_curves(record).savefig(picture, dpi=200)
    print(f"written to {arguments.output} and {picture}")


def main(argv: list[str] | None = None) -> None:
    """The console script `unimask`. Ends with status 2 and one line on bad input."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = make_parser().parse_args(argv)
    arguments.text = shlex.join(["unimask", *argv])  # for records
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    # LeRobot logs a page where FFmpeg is missing, which only datasets with videos need.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    try:
        arguments.run(arguments)
    except KeyboardInterrupt:
        sys.exit("unimask: interrupted")
    except (ValueError, KeyError, OSError) as error:
        message = error.args[0] if isinstance(error, KeyError) and error.args else error
        print(f"unimask: error: {message}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
