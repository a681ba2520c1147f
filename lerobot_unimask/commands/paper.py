"""`unimask paper ...`: what only the reproduction of the paper needs."""

import argparse
from collections.abc import Callable
from pathlib import Path
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

STUDIES = {
    "heatmap": "the paper's DoorKey heatmap: a grid of runs, shared by workers",
    "table": "the paper's Maze2D table: a grid of runs, shared by workers",
    "search": "the paper's random search for hyperparameters: runs shared by workers",
    "ablation": "what earns its place: variants of one Maze2D model at equal updates",
}


def add(commands: Any) -> None:
    paper = add_command(commands, "paper", "the paper's tables and figures: heatmap, table, search, gallery, ...")
    parts = paper.add_subparsers(dest="part", required=True, metavar="PART")
    for name, what in STUDIES.items():
        study = add_command(parts, name, what)
        study.add_argument("--config_path", type=Path, required=True, metavar="YAML", help="as in configs/")
        workers = "processes to start here, 0 to write down what is done; default: %(default)s"
        study.add_argument("--workers", type=int, choices=range(257), default=1, metavar="N", help=workers)
        study.add_argument(
            "--storage",
            metavar="URL",
            help="database that the study is kept in, such as postgresql://...; default: an SQLite file in the output",
        )
        study.set_defaults(run=_study)
    _add_curve(parts)
    _add_questions(parts)
    _add_chunks(parts)
    _add_gallery(parts)
    tables = add_command(parts, "tables", "write the tables of README.md and docs/ from their records")
    tables.set_defaults(run=_tables, light=True)


def _add_chunks(parts: Any) -> None:
    chunks = add_command(parts, "chunks", "Maze2D in chunks and by real-time chunking: returns, costs, jumps at seams")
    policy_flags(chunks)
    chunks.add_argument("--dataset.root", type=Path, required=True, dest="data", metavar="DIR", help="Maze2D episodes")
    chunks.add_argument("--episodes", type=positive, default=1000, help="rollouts of each way of acting")
    chunks.add_argument("--rtc_episodes", type=positive, default=200, help="rollouts of each delay")
    chunks.add_argument("--batch_size", type=positive, default=100, help="environments side by side")
    chunks.add_argument("--seed", type=int, default=100_000, help="of the first rollout's start")
    output_flag(chunks)
    chunks.set_defaults(run=_chunks)

    goals = add_command(parts, "goals", "Maze2D with --hide_goal=true: told of the goal by s[-1] alone, at every step")
    policy_flags(goals)
    goals.add_argument("--maze", default="medium", help="that of its episodes")
    goals.add_argument("--chunk_size", type=positive, action="append", required=True, dest="sizes", help="H; several")
    goals.add_argument("--mask", default="goal_conditioned", help="the question that shows s[-1]; default: %(default)s")
    goals.add_argument("--n_action_steps", type=positive, default=1, help="actions of a chunk that are carried out")
    goals.add_argument("--episodes", type=positive, default=200, help="rollouts of each way of showing the goal")
    goals.add_argument("--seed", type=int, default=100_000, help="of the first rollout's start")
    output_flag(goals)
    goals.set_defaults(run=_goals)
    tasks = add_command(parts, "tasks", "Maze2D, several mazes: each asked for, another asked for, and the task hidden")
    policy_flags(tasks)
    tasks.add_argument("--maze", required=True, help="the mazes of its data: A,B")
    tasks.add_argument("--episodes", type=positive, default=200, help="rollouts of each question in each maze")
    tasks.add_argument("--batch_size", type=positive, default=100, help="environments side by side")
    tasks.add_argument("--seed", type=int, default=100_000, help="of the first rollout's start")
    output_flag(tasks)
    tasks.set_defaults(run=_tasks)


def _add_curve(parts: Any) -> None:
    curve = add_command(parts, "curve", "return of each checkpoint of a run, by LeRobot's evaluation")
    curve.add_argument("--run", type=Path, action="append", required=True, dest="runs", metavar="DIR")
    curve.add_argument("--env.type", required=True, dest="env_type", metavar="ENVIRONMENT")
    curve.add_argument("--episodes", type=positive, default=200, help="rollouts of each checkpoint")
    curve.add_argument("--last_episodes", type=positive, default=1000, help="rollouts of the last one")
    curve.add_argument("--batch_size", type=positive, default=100, help="environments side by side")
    curve.add_argument("--seed", type=int, default=100_000, help="of the first rollout's start")
    curve.add_argument("--output", type=Path, required=True, help="JSON record; a picture goes beside it")
    curve.set_defaults(run=_curve)


def _add_questions(parts: Any) -> None:
    questions = add_command(
        parts, "questions", "how often a DoorKey policy does what it is asked: goals, returns, a property, samples"
    )
    policy_flags(questions)
    dataset_flags(questions, what="unseen episodes")
    questions.add_argument("--each", type=positive, default=10, help="rollouts for each goal and return from a start")
    questions.add_argument("--samples", type=positive, default=4000, help="drawn in each order")
    questions.add_argument("--seed", type=int, default=0)
    output_flag(questions)
    questions.set_defaults(run=_questions)


def _add_gallery(parts: Any) -> None:
    gallery = add_command(parts, "gallery", "draw the pictures of docs/gallery.md")
    policy_flags(gallery)
    dataset_flags(gallery, what="DoorKey episodes")
    gallery.add_argument("--maze.path", dest="maze_path", metavar="PATH", help="a Maze2D policy, for its picture")
    gallery.add_argument("--maze.root", type=Path, dest="maze_root", metavar="DIR", help="Maze2D episodes")
    gallery.add_argument("--output", type=Path, default=Path("docs"), help="folder of gallery.md; default: docs")
    gallery.set_defaults(run=_gallery)


def _study(arguments: argparse.Namespace) -> None:
    try:
        import optuna  # noqa: F401
    except ImportError as error:
        raise ValueError("Studies need the extra: pip install 'lerobot_policy_unimask[paper]'.") from error
    from lerobot_unimask.paper import ablation, heatmap, search, table
    from lerobot_unimask.paper.study import read_config

    parts: dict[str, tuple[type, Any, Any]] = {
        "heatmap": (heatmap.HeatmapConfig, heatmap.heatmap, heatmap.markdown),
        "table": (table.TableConfig, table.table, table.markdown),
        "search": (search.SearchConfig, search.search, search.markdown),
        "ablation": (ablation.AblationConfig, ablation.ablation, ablation.markdown),
    }
    kind, run, markdown = parts[arguments.part]
    config: Any = read_config(kind, arguments.config_path)
    print(markdown(run(config, storage=arguments.storage, workers=arguments.workers)))
    print(f"written to {config.output}")


def _chunks(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper.chunks import markdown, measure_chunks

    _measure_acting(
        arguments,
        measure_chunks,
        markdown,
        data=arguments.data,
        rtc_episodes=arguments.rtc_episodes,
        batch_size=arguments.batch_size,
        chunk_size=8,
        carried_out=(1, 4, 8),
        delays=(0, 2, 4, 8),
    )


def _goals(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper.chunks import measure_goals
    from lerobot_unimask.paper.study_tables import goals_table

    _measure_acting(
        arguments,
        measure_goals,
        goals_table,
        maze=arguments.maze,
        chunk_sizes=arguments.sizes,
        mask=arguments.mask,
        n_action_steps=arguments.n_action_steps,
    )


def _tasks(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper.chunks import measure_tasks
    from lerobot_unimask.paper.study_tables import tasks_table

    mazes = arguments.maze.split(",")
    _measure_acting(arguments, measure_tasks, tasks_table, mazes=mazes, batch_size=arguments.batch_size)


def _measure_acting(
    arguments: argparse.Namespace, measure: Callable[..., dict], markdown: Callable[[dict], str], **settings: Any
) -> None:
    """Measure a checkpoint, print the tables and write the record."""
    from lerobot_unimask.data.checkpoints import last_checkpoint, training_settings

    folder = last_checkpoint(Path(arguments.path))
    record = measure(folder, episodes=arguments.episodes, seed=arguments.seed, **settings)
    record["training"] = training_settings(folder)
    print(markdown(record))
    write_record(arguments, record)


def _curve(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper.learning_curve import learning_curve, learning_curves

    record = learning_curve(
        arguments.runs,
        arguments.env_type,
        episodes=arguments.episodes,
        last_episodes=arguments.last_episodes,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
    )
    write_record(arguments, record)
    picture = arguments.output.with_suffix(".png")
    learning_curves(record).savefig(picture, dpi=200)
    print(f"drawn into {picture}")


def _questions(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.data.checkpoints import training_settings
    from lerobot_unimask.data.episodes import first_windows, provenance_of
    from lerobot_unimask.paper.questions import ask_everything, summary

    policy, dataset = open_both(arguments)
    expert = provenance_of(Path(dataset.root)).get("expert", "paper")
    settings = {"each": arguments.each, "samples": arguments.samples, "seed": arguments.seed, "expert": expert}
    record = ask_everything(policy, first_windows(dataset), **settings)
    record["policy"] = policy.describe_origin()
    record["training"] = training_settings(policy.folder)
    print(summary(record))
    write_record(arguments, record)


def _tables(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper.tables import pages, rewrite

    for path in pages(Path()):
        text = path.read_text()
        written, unknown = rewrite(text, Path())
        if written != text:
            path.write_text(written)
            print(f"written to {path}")
        for head in unknown:
            print(f"{path}: left as it is: {head}")


def _gallery(arguments: argparse.Namespace) -> None:
    if (arguments.maze_path is None) != (arguments.maze_root is None):
        raise ValueError("--maze.path and --maze.root go together: give both or neither.")
    from itertools import chain

    from lerobot_unimask.data.episodes import bounds_of, first_windows, open_dataset, provenance_of, read_windows
    from lerobot_unimask.data.factors import STATE
    from lerobot_unimask.envs.maze2d.record import mazes_of
    from lerobot_unimask.modeling_unimask import UniMASKPolicy
    from lerobot_unimask.paper.gallery import doorkey_pictures, maze_pictures, write_gallery

    policy, dataset = open_both(arguments)
    pictures = doorkey_pictures(policy, first_windows(dataset))
    if arguments.maze_path is not None:
        maze = UniMASKPolicy.from_pretrained(arguments.maze_path)
        dataset = open_dataset(maze.config, arguments.maze_root)
        middles = [(first + end) // 2 for first, end in bounds_of(dataset)[:200]]
        starts, walls = first_windows(dataset)[STATE][:, 0], mazes_of(provenance_of(Path(dataset.root)))[0]
        pictures = chain(pictures, maze_pictures(maze, read_windows(dataset, middles), starts, walls=walls))
    for path in write_gallery(pictures, arguments.output, command=arguments.text):
        print(path)
