"""`unimask query`: one question put to one policy."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lerobot_unimask.commands.flags import add_command, dataset_flags, policy_flags, positive


def add(commands: Any) -> None:
    parser = add_command(commands, "query", "put one question to a policy; without --mask, list what one can ask")
    policy_flags(parser)
    parser.add_argument("--mask", help="a question, as in 's[1:9] | s[0], s[3]', or the name of a task")
    parser.add_argument("--t", type=int, help="the step that a question with a t is about")
    parser.add_argument(
        "--given",
        type=_given,
        metavar="JSON",
        help="""values of single tokens, as in '{"s[0]": [0, 9], "rtg[0]": 5}', instead of recorded ones""",
    )
    dataset_flags(parser, required=False)
    parser.add_argument("--episode", type=int, help="recorded episode that shown values are read from")
    parser.add_argument("--start", type=int, help="step of the episode that the window begins at; default: 0")
    parser.add_argument("--sample", type=positive, metavar="N", help="draw N joint samples instead of marginals")
    parser.add_argument(
        "--order",
        choices=("forward", "backward", "random"),
        help="order of the draws, with --sample; default: forward",
    )
    parser.add_argument("--seed", type=int, help="number that the samples follow from; default: 0")
    parser.add_argument(
        "--check",
        metavar="NAME",
        help="rule, dynamics or agreement: what breaks it is drawn again",
    )
    parser.add_argument(
        "--exact",
        metavar="EXPERT",
        help="expert of the data, whose exact optimum is set beside the model: paper or released",
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the answer, into a .png, .svg or .pdf")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    parser.set_defaults(run=_run)


def _given(text: str) -> dict:
    try:
        given = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise argparse.ArgumentTypeError(f"not JSON ({error}): write it as '{{\"s[0]\": [0, 9]}}'") from None
    if not isinstance(given, dict):
        raise argparse.ArgumentTypeError(f"{text} is no JSON object: write it as '{{\"s[0]\": [0, 9]}}'")
    return given


def _run(arguments: argparse.Namespace) -> None:
    _check(arguments)
    from lerobot_unimask import query
    from lerobot_unimask.data.episodes import open_dataset, read_window
    from lerobot_unimask.modeling_unimask import UniMASKPolicy

    policy = UniMASKPolicy.from_pretrained(arguments.path, revision=arguments.revision)
    if arguments.mask is None:
        overview = query.overview(policy)
        print(json.dumps(overview, indent=2) if arguments.json else query.describe_overview(overview))
        return
    batch = source = sampling = None
    start = arguments.start or 0
    if arguments.episode is not None:
        dataset = open_dataset(policy.config, arguments.root, arguments.repo_id)
        batch = read_window(dataset, arguments.episode, start)
        source = query.Source(Path(dataset.root), arguments.root, arguments.repo_id, arguments.episode, start)
    if arguments.sample:
        sampling = query.Sampling(arguments.sample, arguments.order or "forward", arguments.seed or 0, arguments.check)
    how = {"t": arguments.t, "given": arguments.given, "sampling": sampling, "exact": arguments.exact}
    reply = query.ask(policy, arguments.mask, batch=batch, source=source, **how)
    result = query.record(policy, reply)
    print(json.dumps(result, indent=2) if arguments.json else query.describe(result))
    if arguments.plot:
        arguments.plot.parent.mkdir(parents=True, exist_ok=True)
        query.picture(policy, reply).savefig(arguments.plot, dpi=200)
        print(f"drawn into {arguments.plot}", file=sys.stderr if arguments.json else sys.stdout)


def _check(arguments: argparse.Namespace) -> None:
    """Flags that do nothing without another are mistakes.

    Raises:
        ValueError: names the flag that is missing.
    """
    needs_mask = ("t", "given", "episode", "sample", "exact", "plot")
    needs_sample, no_data = ("order", "seed", "check"), arguments.root is None and arguments.repo_id is None
    for needed, flags, missing in (
        ("--mask", needs_mask, arguments.mask is None),
        ("--sample=N", needs_sample, arguments.sample is None),
        ("--dataset.root=DIR or --dataset.repo_id=ME/NAME", ("episode",), no_data),
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
