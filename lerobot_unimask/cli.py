"""`unimask build | demo | query | validate | curve | ...`: what LeRobot's own commands do not do.

Training and evaluation are `lerobot-train` and `lerobot-eval`. Each command imports what it needs when it runs.
"""

import argparse
import difflib
import json
import logging
import shlex
import sys
from pathlib import Path

from lerobot_unimask.plots.curves import cost_of_growth, learning_curves


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

    label = commands.add_parser(
        "label", help="add a column to a dataset: a property of its episodes, or the return-to-go", allow_abbrev=False
    )
    label.add_argument("--dataset.root", type=Path, required=True, dest="root", metavar="DIR")
    label.add_argument("--output", type=Path, metavar="DIR", help="a new folder; without it the dataset is replaced")
    label.add_argument("--name", metavar="observation.NAME", help="the new column's")
    what = label.add_mutually_exclusive_group(required=True)
    what.add_argument("--return_to_go", action="store_true", help="from next.reward, as observation.return_to_go")
    what.add_argument("--visits", metavar="STATE=CATEGORY", help="whether any step is there, as in agent_cell=0")
    what.add_argument(
        "--function",
        metavar="MODULE:NAME",
        help="a Python function of one episode's columns, a dict of arrays, that returns its label: see the README",
    )
    label.add_argument("--categories", type=_positive, help="how many, where whole numbers do not all occur")
    label.set_defaults(run=_label)

    query = commands.add_parser(
        "query", help="put one question to a policy; without --mask, list what one can ask", allow_abbrev=False
    )
    _question_arguments(query)
    query.set_defaults(run=_query)

    given = commands.add_parser(
        "given",
        help="print goals or waypoints of recorded episodes, for lerobot-eval --policy.given",
        allow_abbrev=False,
    )
    _policy_arguments(given)
    given.add_argument("--dataset.root", type=Path, required=True, dest="root", metavar="DIR")
    given.add_argument(
        "--episodes", required=True, metavar="0:50", help="as many as lerobot-eval has environments, --eval.batch_size"
    )
    given.add_argument("--tokens", default="s[-1]", help="single tokens, as in 's[3], s[-1]'; default: %(default)s")
    given.set_defaults(run=_print_given)

    questions = commands.add_parser(
        "questions",
        help="how often a DoorKey policy does what it is asked: goals, returns, a property, samples",
        allow_abbrev=False,
    )
    _policy_arguments(questions)
    questions.add_argument(
        "--dataset.root", type=Path, required=True, dest="root", metavar="DIR", help="unseen episodes"
    )
    questions.add_argument("--dataset.repo_id", default="local/dataset", dest="repo_id", metavar="ME/NAME")
    questions.add_argument("--each", type=_positive, default=10, help="rollouts for each goal and return from a start")
    questions.add_argument("--samples", type=_positive, default=4000, help="drawn in each order")
    questions.add_argument("--seed", type=int, default=0)
    questions.add_argument("--output", type=Path, help="write the record here as JSON")
    questions.set_defaults(run=_questions)

    gallery = commands.add_parser("gallery", help="draw the pictures of docs/gallery.md", allow_abbrev=False)
    _policy_arguments(gallery)
    gallery.add_argument(
        "--dataset.root", type=Path, required=True, dest="root", metavar="DIR", help="DoorKey episodes"
    )
    gallery.add_argument("--maze.path", dest="maze_path", metavar="PATH", help="a Maze2D policy, for its picture")
    gallery.add_argument("--maze.root", type=Path, dest="maze_root", metavar="DIR", help="Maze2D episodes")
    gallery.add_argument("--output", type=Path, default=Path("docs"), help="folder of gallery.md; default: docs")
    gallery.set_defaults(run=_gallery)

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
    validate.add_argument(
        "--exact",
        choices=("paper", "released"),
        help="DoorKey: set the exact optimum beside the models, for data of this expert",
    )
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

    measure = commands.add_parser(
        "measure",
        help="how far ahead a policy sees, whether its directions agree, how fast it acts",
        allow_abbrev=False,
    )
    _policy_arguments(measure)
    measure.add_argument("--dataset.root", type=Path, required=True, dest="root", metavar="DIR")
    measure.add_argument("--episodes", required=True, metavar="900:1000", help="that it was not trained on")
    measure.add_argument("--ahead", type=_positive, default=5, help="steps to see ahead; default: %(default)s")
    measure.add_argument("--output", type=Path, help="write the record here as JSON")
    measure.set_defaults(run=_measure)

    bench = commands.add_parser(
        "bench", help="how fast this machine reads, trains, acts, evaluates and builds", allow_abbrev=False
    )
    bench.add_argument("--configs", type=Path, default=Path("configs"), metavar="DIR", help="default: %(default)s")
    bench.add_argument("--quick", action="store_true", help="everything once, in a minute: numbers of no worth")
    bench.add_argument(
        "--output", type=Path, required=True, metavar="FILE.json", help="the record; a picture goes beside it"
    )
    bench.set_defaults(run=_bench)

    for name, what in {
        "heatmap": "the paper's DoorKey heatmap: a grid of runs, shared by workers",
        "table": "the paper's Maze2D table: a grid of runs, shared by workers",
        "search": "the paper's random search for hyperparameters: runs shared by workers",
        "ablation": "what earns its place: variants of one Maze2D model at equal updates",
    }.items():
        study = commands.add_parser(name, help=what, allow_abbrev=False)
        study.add_argument("--config_path", type=Path, required=True, metavar="YAML", help="as in configs/")
        study.add_argument("--workers", type=_positive, default=1, help="processes to start here; default: %(default)s")
        study.add_argument(
            "--storage",
            metavar="URL",
            help="database that the study is kept in, such as postgresql://...; default: an SQLite file in the output",
        )
        study.set_defaults(run=_study)

    push = commands.add_parser(
        "push", help="push a saved policy or a dataset to the Hub, or finish such a push", allow_abbrev=False
    )
    what = push.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--policy.path",
        type=Path,
        dest="policy",
        metavar="DIR",
        help="a checkpoint, or a lerobot-train output folder, of which the last checkpoint counts",
    )
    what.add_argument("--dataset.root", type=Path, dest="dataset", metavar="DIR")
    push.add_argument("--repo_id", required=True, metavar="ME/NAME")
    push.add_argument(
        "--results",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.json",
        help="for the policy's card: a record of `unimask validate`, or an eval_info.json of lerobot-eval; repeatable",
    )
    _privacy_argument(push)
    push.set_defaults(run=_push)
    return parser


def _dataset_arguments(parser: argparse.ArgumentParser, *, episodes: int) -> None:
    parser.add_argument("--episodes", type=_positive, default=episodes, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same episodes")
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="the dataset's folder; new or empty")
    parser.add_argument("--repo_id", metavar="ME/NAME", help="the dataset's name on the Hub")
    parser.add_argument("--push_to_hub", type=_boolean, default=False, metavar="true", help="push it when it is built")
    _privacy_argument(parser)


def _privacy_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--private", type=_boolean, nargs="?", const=True, metavar="true", help="create the repository as a private one"
    )


def _policy_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--policy.path",
        required=True,
        dest="path",
        metavar="PATH",
        help="a checkpoint, a lerobot-train output folder, of which the last checkpoint counts, or a Hub repository",
    )
    parser.add_argument("--policy.revision", dest="revision", metavar="COMMIT", help="of a Hub repository")


def _question_arguments(parser: argparse.ArgumentParser) -> None:
    _policy_arguments(parser)
    parser.add_argument("--mask", help="a question, as in 's[1:9] | s[0], s[3]', or the name of a task")
    parser.add_argument("--t", type=int, help="the step that a question with a t is about")
    parser.add_argument(
        "--given",
        type=_given,
        metavar="JSON",
        help="""values of single tokens, as in '{"s[0]": [0, 9], "rtg[0]": 5}', instead of recorded ones""",
    )
    parser.add_argument("--dataset.root", type=Path, dest="root", metavar="DIR")
    parser.add_argument("--dataset.repo_id", dest="repo_id", metavar="ME/NAME")
    parser.add_argument("--episode", type=int, help="of the dataset, to read what is shown from")
    parser.add_argument("--start", type=int, help="the episode's step that the window begins at; default: 0")
    parser.add_argument("--sample", type=_positive, metavar="N", help="draw N joint samples instead of marginals")
    parser.add_argument(
        "--order", choices=("forward", "backward", "random"), help="of drawing, with --sample; default: forward"
    )
    parser.add_argument("--seed", type=int, help="of the samples; default: 0")
    parser.add_argument(
        "--check",
        choices=("dynamics", "agreement"),
        help="draw again what contradicts DoorKey's rules: step by step, or together with all that is shown",
    )
    parser.add_argument(
        "--exact",
        choices=("paper", "released"),
        help="DoorKey: set the exact optimum's marginals beside the model's, for data of this expert",
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the answer, into a .png, .svg or .pdf")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def _given(text: str) -> dict:
    try:
        given = json.loads(text)
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"not JSON ({error}): write it as '{{\"s[0]\": [0, 9]}}'") from None
    if not isinstance(given, dict):
        raise argparse.ArgumentTypeError(f"{text} is no JSON object: write it as '{{\"s[0]\": [0, 9]}}'")
    return given


def _boolean(text: str) -> bool:
    if text not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither true nor false")
    return text == "true"


def _build_doorkey(arguments: argparse.Namespace) -> None:
    from dataset_builders.doorkey import build_doorkey

    _check_push(arguments)
    root = build_doorkey(
        arguments.root,
        episodes=arguments.episodes,
        seed=arguments.seed,
        expert=arguments.expert,
        repo_id=arguments.repo_id,
    )
    _report_built(arguments, root)


def _build_maze2d(arguments: argparse.Namespace) -> None:
    from dataset_builders.maze2d import build_maze2d

    _check_push(arguments)
    root = build_maze2d(
        arguments.root,
        episodes=arguments.episodes,
        seed=arguments.seed,
        noise=arguments.noise,
        maze=arguments.maze,
        repo_id=arguments.repo_id,
    )
    _report_built(arguments, root)


def _check_push(arguments: argparse.Namespace) -> None:
    """Before the work is done.

    Raises:
        ValueError: it is to be pushed, and nothing says where to.
    """
    if arguments.push_to_hub and not arguments.repo_id:
        raise ValueError("--push_to_hub=true needs the repository's name: --repo_id=ME/NAME.")


def _report_built(arguments: argparse.Namespace, root: Path) -> None:
    print(f"{arguments.episodes} episodes in {root}")
    if arguments.push_to_hub:
        from lerobot_unimask.sharing.hub import push_dataset

        print(f"pushed to {push_dataset(root, arguments.repo_id, private=arguments.private)}")


def _push(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.sharing import hub

    if arguments.dataset:
        if arguments.results:
            raise ValueError("--results are a policy's; a dataset's card has none.")
        url = hub.push_dataset(arguments.dataset, arguments.repo_id, private=arguments.private)
    else:
        from lerobot_unimask import UniMASKPolicy
        from lerobot_unimask.data.checkpoints import checkpoints_of

        folder = checkpoints_of(arguments.policy)[-1]
        results = [json.loads(path.read_text()) for path in arguments.results]
        policy = UniMASKPolicy.from_pretrained(folder)
        url = hub.push_policy(policy, folder, arguments.repo_id, private=arguments.private, results=results)
    print(f"pushed to {url}")


def _demo(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.demo import run_demo

    run_demo(arguments.output, **({"steps": arguments.steps} if arguments.steps else {}))


def _label(arguments: argparse.Namespace) -> None:
    from dataset_builders import label

    if arguments.return_to_go:
        name, labeller, how = arguments.name or "observation.return_to_go", label.remaining_return, "return-to-go"
    elif arguments.name is None:
        raise ValueError("--name is missing: what is the new column called? As in --name=observation.visits_corner.")
    elif arguments.visits is not None:
        name, labeller = arguments.name, label.visits(arguments.root, arguments.visits)
        how = f"visits {arguments.visits}"
    else:
        name, labeller, how = arguments.name, label.load_function(arguments.function), arguments.function
    root = label.add_label(
        arguments.root, name, labeller, how=how, output=arguments.output, categories=arguments.categories
    )
    print(f"{name} in {root}")


def _query(arguments: argparse.Namespace) -> None:
    _check_query(arguments)
    from lerobot_unimask import query
    from lerobot_unimask.data.episodes import open_dataset, read_window
    from lerobot_unimask.envs.doorkey.optimum import check_expert

    loaded = query.load_policy(arguments.path, arguments.revision)
    if arguments.mask is None:
        overview = query.overview(loaded)
        print(json.dumps(overview, indent=2) if arguments.json else query.describe_overview(overview))
        return
    batch = data = sampling = None
    drawing = {}
    start = arguments.start or 0
    if arguments.episode is not None:
        dataset = open_dataset(loaded.policy.config, arguments.root, arguments.repo_id)
        batch = read_window(dataset, arguments.episode, start)
        drawing = {"maze": query.maze_of(dataset)}
        check_expert(Path(dataset.root), arguments.exact)
        root = str(arguments.root) if arguments.root else None
        data = {"root": root, "repo_id": arguments.repo_id, "episode": arguments.episode, "start": start}
    if arguments.sample:
        sampling = query.Sampling(arguments.sample, arguments.order or "forward", arguments.seed or 0, arguments.check)
    question = {"t": arguments.t, "given": arguments.given, "sampling": sampling, "exact": arguments.exact}
    reply = query.ask(loaded.policy, arguments.mask, batch=batch, start=start, **question)
    result = query.record(loaded, arguments.mask, reply, data=data, **question)
    print(json.dumps(result, indent=2) if arguments.json else query.describe(result))
    if arguments.plot:
        arguments.plot.parent.mkdir(parents=True, exist_ok=True)
        query.picture(loaded.policy, arguments.mask, reply, **drawing).savefig(arguments.plot, dpi=200)
        print(f"drawn into {arguments.plot}", file=sys.stderr if arguments.json else sys.stdout)


def _check_query(arguments: argparse.Namespace) -> None:
    """Flags that do nothing without another are mistakes.

    Raises:
        ValueError: names the flag that is missing.
    """
    needs_mask = ("t", "given", "episode", "sample", "exact", "plot")
    needs_sample, needs_data = ("order", "seed", "check"), arguments.root is None and arguments.repo_id is None
    for needed, flags, missing in (
        ("--mask", needs_mask, arguments.mask is None),
        ("--sample=N", needs_sample, arguments.sample is None),
        ("--dataset.root=DIR or --dataset.repo_id=ME/NAME", ("episode",), needs_data),
        ("--episode=N", ("root", "repo_id", "start"), arguments.episode is None),
    ):
        given = [flag for flag in flags if getattr(arguments, flag) is not None]
        if missing and given:
            flag = {"root": "dataset.root", "repo_id": "dataset.repo_id"}.get(given[0], given[0])
            raise ValueError(f"--{flag} is given without {needed}: give both or neither.")
    if arguments.exact and arguments.sample:
        raise ValueError("--exact answers with marginals, not samples: leave out --sample or --exact.")
    if arguments.plot is not None and arguments.plot.suffix not in (".png", ".svg", ".pdf"):
        raise ValueError(f"--plot={arguments.plot} is no picture's name: end it in .png, .svg or .pdf.")


def _print_given(arguments: argparse.Namespace) -> None:
    from lerobot_unimask import query
    from lerobot_unimask.data.episodes import open_dataset

    policy = query.load_policy(arguments.path, arguments.revision).policy
    dataset = open_dataset(policy.config, arguments.root)
    print(json.dumps(query.given_from_episodes(policy, dataset, arguments.episodes, arguments.tokens)))


def _questions(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.data.checkpoints import training_settings
    from lerobot_unimask.data.episodes import first_windows, open_dataset, provenance_of
    from lerobot_unimask.paper.questions import ask_everything, summary
    from lerobot_unimask.query import load_policy

    loaded = load_policy(arguments.path, arguments.revision)
    batch = first_windows(open_dataset(loaded.policy.config, arguments.root, arguments.repo_id))
    expert = provenance_of(arguments.root).get("expert", "paper")
    settings = {"each": arguments.each, "samples": arguments.samples, "seed": arguments.seed, "expert": expert}
    record = ask_everything(loaded.policy, batch, **settings)
    record["policy"] = {"path": loaded.path, "revision": loaded.revision}
    record["training"] = training_settings(Path(loaded.path))
    record["command"] = arguments.text
    print(summary(record))
    if arguments.output:
        _write_record(record, arguments.output)
        print(f"written to {arguments.output}")


def _gallery(arguments: argparse.Namespace) -> None:
    if (arguments.maze_path is None) != (arguments.maze_root is None):
        raise ValueError("--maze.path and --maze.root go together: give both or neither.")
    from itertools import chain

    from lerobot_unimask.data.episodes import first_windows, middle_windows, open_dataset
    from lerobot_unimask.paper.gallery import doorkey_pictures, maze_pictures, write_gallery
    from lerobot_unimask.query import load_policy, maze_of

    policy = load_policy(arguments.path, arguments.revision).policy
    pictures = doorkey_pictures(policy, first_windows(open_dataset(policy.config, arguments.root)))
    if arguments.maze_path is not None:
        maze = load_policy(arguments.maze_path).policy
        dataset = open_dataset(maze.config, arguments.maze_root)
        pictures = chain(pictures, maze_pictures(maze, middle_windows(dataset), walls=maze_of(dataset)))
    for path in write_gallery(pictures, arguments.output, command=arguments.text):
        print(path)


def _validate(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.validation import validate

    record = validate(arguments.runs, arguments.root, arguments.repo_id, arguments.exact)
    record["command"] = arguments.text
    width = max(map(len, record["mean"]))
    for task, loss in record["mean"].items():
        line = f"{task:{width}}  {loss:.4f}  (spread {record['spread'][task]:.4f} over {len(arguments.runs)} runs)"
        if arguments.exact:
            best, expected = (record["optimum"][kind][task] for kind in ("losses", "expected_losses"))
            line += f"  optimum {best:.4f}, expected {expected:.4f}"
        print(line)
    if arguments.output:
        _write_record(record, arguments.output)
        print(f"written to {arguments.output}")


def _study(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper import ablation, heatmap, search, table
    from lerobot_unimask.paper.study import read_config

    kind, run, markdown = {
        "heatmap": (heatmap.HeatmapConfig, heatmap.heatmap, heatmap.markdown),
        "table": (table.TableConfig, table.table, table.markdown),
        "search": (search.SearchConfig, search.search, search.markdown),
        "ablation": (ablation.AblationConfig, ablation.ablation, ablation.markdown),
    }[arguments.command]
    config = read_config(kind, arguments.config_path)
    print(markdown(run(config, storage=arguments.storage, workers=arguments.workers)))
    print(f"written to {config.output}")


def _measure(arguments: argparse.Namespace) -> None:
    from lerobot_unimask import query
    from lerobot_unimask.data.episodes import episode_numbers, open_dataset
    from lerobot_unimask.measures import latency, measure
    from lerobot_unimask.records import versions

    loaded = query.load_policy(arguments.path, arguments.revision)
    dataset = open_dataset(loaded.policy.config, arguments.root)
    episodes = episode_numbers(arguments.episodes, len(dataset.meta.episodes))
    record = measure(loaded.policy, arguments.root, episodes, ahead=arguments.ahead)
    record["latency"] = latency(loaded.policy)
    record["policy"] = {"path": loaded.path, "revision": loaded.revision, "updates": int(loaded.policy.updates)}
    record["command"], record["versions"] = arguments.text, versions()
    print(json.dumps(record, indent=2))
    if arguments.output:
        _write_record(record, arguments.output)
        print(f"written to {arguments.output}")


def _bench(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.bench.measuring import bench
    from lerobot_unimask.bench.tables import markdown

    record = bench(arguments.configs, quick=arguments.quick)
    record["command"] = arguments.text
    print(markdown(record))
    _write_record(record, arguments.output)
    picture = arguments.output.with_suffix(".png")
    cost_of_growth(record).savefig(picture, dpi=200)
    print(f"written to {arguments.output} and {picture}")


def _curve(arguments: argparse.Namespace) -> None:
    from lerobot_unimask.paper.learning_curve import learning_curve

    record = learning_curve(
        arguments.runs,
        arguments.env_type,
        episodes=arguments.episodes,
        last_episodes=arguments.last_episodes,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
    )
    record["command"] = arguments.text
    _write_record(record, arguments.output)
    picture = arguments.output.with_suffix(".png")
    learning_curves(record).savefig(picture, dpi=200)
    print(f"written to {arguments.output} and {picture}")


def _write_record(record: dict, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=2) + "\n")


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
