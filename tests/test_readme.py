"""The README cannot rot: its commands and its Python are run, in short forms, and its links and numbers have sources.

The fenced blocks of README.md, then of docs/results.md, marked `bash` and `python` are cases in the order in which they
stand, named by their line, and run in one folder that holds nothing but a copy of `configs/`; each may need what those
before it made, so run this file as a whole. Those of docs/results.md take minutes together: they are `slow`, and by
default what they say to `unimask` is only parsed. A command `uv run X ...` becomes the console script X beside this
Python. What makes it short is in `SHORT`; nothing else of it is changed. What is not run is in `NOT_RUN`, with the
reason; a trailing comment with the word hours does the same for one line.
"""

import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import commands
import pytest
import yaml

ROOT = Path(__file__).parents[1]
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "results.md"
DOCUMENTS = [README, *sorted(ROOT.glob("docs/*.md"))]

NOT_RUN = {
    "git": "needs the network",
    "cd": "the folder is this one",
    "pip": "installs",
    "python -m pip": "installs",
    "python3 -m pip": "installs",
    "uv pip": "installs",
    "uv add": "installs",
    "uv sync": "installs",
    "uv run pytest": "is what runs this",
    "uv run ruff": "is in .ci/run",
    "uv run unimask demo": "has its own test",
    "uv run accelerate": "wants several GPUs",
    "uv run hf": "needs the network",
}
HOURS = re.compile(r"#.*\bhours\b")
SMALL = {"policy.width": 16, "policy.depth": 1, "policy.heads": 2, "policy.feedforward_width": 16}
# Console script -> its flags: (flag, value, when): `always`, or `smaller` where the README itself gives a larger value.
SHORT: dict[str, list[tuple[str, int, str]]] = {
    "unimask": [(name, 40, "smaller") for name in ("episodes", "last_episodes", "dataset.episodes")],
    "lerobot-train": [
        ("steps", 4, "always"),
        ("batch_size", 8, "always"),
        ("save_freq", 2, "always"),
        ("log_freq", 1, "always"),
        ("eval_steps", 2, "smaller"),
        ("env_eval_freq", 4, "smaller"),
        ("num_workers", 0, "always"),  # workers have their own test, and take half a minute to start
        ("eval.n_episodes", 1, "always"),
        ("eval.batch_size", 1, "always"),
    ],
    "lerobot-eval": [("eval.n_episodes", 1, "always"), ("eval.batch_size", 1, "always")],
}


@dataclass
class Block:
    """A fenced block: its language, its text and the number of its first line."""

    language: str
    text: str
    line: int


@dataclass
class Command:
    """One line of a bash block, continuations joined."""

    text: str
    line: int

    @property
    def words(self) -> list[str]:
        return shlex.split(self.text, comments=True)

    @property
    def reason_not_to_run(self) -> str | None:
        if HOURS.search(self.text):
            return "takes hours"
        words = [word for word in self.words if not re.match(r"\w+=", word)]
        return next((why for start, why in NOT_RUN.items() if words[: start.count(" ") + 1] == start.split()), None)


def read_blocks(text: str) -> list[Block]:
    blocks, inside = [], None
    for number, line in enumerate(text.splitlines(), start=1):
        fence = re.match(r"\s*(```+|~~~+)\s*(\w*)", line)
        if inside is None and fence:
            inside = Block(fence[2], "", number + 1)
        elif inside is not None and fence:
            blocks.append(inside)
            inside = None
        elif inside is not None:
            inside.text += f"{line}\n"
    assert inside is None, f"the block at line {inside.line} does not end"
    return blocks


def read_commands(block: Block) -> list[Command]:
    commands, text, start = [], "", block.line
    for number, line in enumerate(block.text.splitlines(), start=block.line):
        start = start if text else number
        text += line
        if text.endswith("\\"):
            text = text[:-1]
        else:
            commands.append(Command(text, start))
            text = ""
    return [command for command in commands if command.words]


def shortened(words: list[str]) -> list[str]:
    """A console script's command line, short."""
    script, *arguments = words
    flags = {name: value for name, equals, value in (word.partition("=") for word in arguments) if equals}
    overrides: dict[str, Any] = {}
    for name, value, when in SHORT.get(script, []):
        given = flags.get(f"--{name}")
        if given is not None and ":" in given:  # a range of episodes, the last of a dataset
            overrides[name] = f"{value - 4}:{value}"
        elif when == "always" or (given is not None and int(given) > value):
            overrides[name] = value
    if script == "lerobot-train":
        overrides |= _short_training(flags)
    arguments = [word for word in arguments if word.split("=")[0].removeprefix("--") not in overrides]
    arguments = [re.sub(r"/checkpoints/\d+/", "/checkpoints/last/", word) for word in arguments]
    return [script, *arguments, *(f"--{name}={value}" for name, value in overrides.items())]


def _short_training(flags: dict[str, str]) -> dict[str, Any]:
    """What shortens a training run, depending on where its settings come from."""
    config = flags.get("--config_path", "")
    if config.endswith(".yaml"):
        settings = yaml.safe_load((ROOT / config).read_text())
        often = {name: 2 for name in ("eval_steps",) if settings.get(name)}
        return SMALL | often | {name: 4 for name in ("env_eval_freq",) if settings.get(name)}
    if flags.get("--resume") == "true":
        return {"steps": 6}  # four have been made
    return SMALL if "--policy.type" in flags else {}


CASES: list[tuple[Path, Command | Block]] = [
    (document, case)
    for document in (README, RESULTS)
    for block in read_blocks(document.read_text())
    for case in (read_commands(block) if block.language == "bash" else [block] if block.language == "python" else [])
]


def name(value: Path | Command | Block) -> str:
    if isinstance(value, Path):
        return value.name
    text = value.text if isinstance(value, Command) else "python"
    return f"line {value.line} {' '.join(text.split())[:60]}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the README's reader stands: after cloning, with nothing built."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "configs", folder / "configs")
    return folder


@pytest.fixture(scope="module")
def namespace():
    """The Python blocks are one session."""
    return {"__name__": "readme"}


@pytest.mark.parametrize(
    ("document", "case"),
    [pytest.param(*case, marks=[pytest.mark.slow] * (case[0] == RESULTS)) for case in CASES],
    ids=name,
)
def test_what_the_readme_says_works(document, case, folder, namespace, monkeypatch):
    monkeypatch.chdir(folder)
    if isinstance(case, Block):
        padding = "\n" * (case.line - 1)  # so that a traceback names the document's lines
        exec(compile(padding + case.text, document, "exec"), namespace)
    elif case.reason_not_to_run:
        pytest.skip(case.reason_not_to_run)
    else:
        run(case, folder)


@pytest.mark.parametrize(
    "command", [c for _, c in CASES if isinstance(c, Command) and c.words[:3] == ["uv", "run", "unimask"]], ids=name
)
def test_unimask_understands_its_commands(command):
    from lerobot_unimask.cli import make_parser

    make_parser().parse_args(command.words[3:])


def run(command: Command, folder: Path) -> None:
    """Run the short form of a command in the folder."""
    words = command.words
    settings = {}
    while re.match(r"\w+=", words[0]):
        key, _, settings[key] = words.pop(0).partition("=")
    assert words[:2] == ["uv", "run"], f"what should the test do with {words[0]!r}? See NOT_RUN."
    words = shortened(words[2:])
    if config := next((word for word in words if re.match(r"--config_path=.*\.yaml", word)), None):
        build_data(folder / config.partition("=")[2])
    commands.check(*words, cwd=folder, env=settings)


def build_data(config: Path) -> None:
    """Make a config's dataset with the command in its opening comment, where the README has not made it."""
    from lerobot_unimask.cli import main

    text = config.read_text()
    if not Path(yaml.safe_load(text)["dataset"]["root"]).exists():
        build = re.search(r"^#\s+uv run (unimask build .*)$", text, re.MULTILINE)
        assert build, f"{config.name} does not say how to build its data"
        main(shortened(shlex.split(build[1]))[1:])


# --- Sources ---------------------------------------------------------------------------------------------------------


def prose(document: Path) -> str:
    """A document without its code, in which brackets mean other things."""
    return re.sub(r"^\s*```.*?^\s*```|`[^`\n]*`", "", document.read_text(), flags=re.MULTILINE | re.DOTALL)


def heading_anchors(document: Path) -> set[str]:
    """The names under which GitHub links a document's headings."""
    text = re.sub(r"^\s*```.*?^\s*```", "", document.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+\s+(.*?)\s*$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_images_lead_somewhere(document):
    text = prose(document)
    targets = re.findall(r"\]\(\s*<?([^)\s>]+)", text) + re.findall(r"(?:src|href)=\"([^\"]+)\"", text)
    targets += re.findall(r"^\[[^\]]+\]:\s*(\S+)", text, re.MULTILINE)
    lost = []
    for target in targets:
        if re.match(r"[a-z]+:", target):  # another site, or mail
            continue
        path, _, anchor = target.partition("#")
        file = document.parent / path if path else document
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in heading_anchors(file)):
            lost.append(target)
    assert lost == []
