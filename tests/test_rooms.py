"""The house's order: a file imports only from floors below its own, or from what stands before it on its own floor.

Imports inside functions and under TYPE_CHECKING count. Nothing is imported here: the files are read.
"""

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From the ground up; a folder stands for what is in it, in the order of the list where that names its files.
FLOORS = [
    "lerobot_unimask/records.py",
    "lerobot_unimask/machine.py",
    "lerobot_unimask/language/grammar.py",
    "lerobot_unimask/language/masks.py",
    "lerobot_unimask/language/training_masks.py",
    "lerobot_unimask/data/factors.py",
    "lerobot_unimask/data/soundness.py",
    "lerobot_unimask/data/window.py",
    "lerobot_unimask/data/returns.py",
    "lerobot_unimask/data/taking_over.py",
    "lerobot_unimask/data/frames.py",
    "lerobot_unimask/data/reads.py",
    "lerobot_unimask/data/episodes.py",
    "lerobot_unimask/data/checkpoints.py",
    "lerobot_unimask/optimiser.py",
    "lerobot_unimask/configuration_unimask.py",
    "lerobot_unimask/processor_unimask.py",
    "lerobot_unimask/networks/layers.py",
    "lerobot_unimask/networks/growing.py",
    "lerobot_unimask/networks/vision.py",
    "lerobot_unimask/networks/feedforward.py",
    "lerobot_unimask/networks/decision_transformer.py",
    "lerobot_unimask/networks/transformer.py",
    "lerobot_unimask/networks/__init__.py",
    "lerobot_unimask/objective.py",
    "lerobot_unimask/asking/answers.py",
    "lerobot_unimask/asking/given.py",
    "lerobot_unimask/asking/looking.py",
    "lerobot_unimask/asking/memory.py",
    "lerobot_unimask/asking/sampling.py",
    "lerobot_unimask/asking/acting.py",
    "lerobot_unimask/asking/held_out.py",
    "lerobot_unimask/asking/questions.py",
    "lerobot_unimask/asking/foresight.py",
    "lerobot_unimask/plots/style.py",
    "lerobot_unimask/plots/answers.py",
    "lerobot_unimask/plots/growth.py",
    "lerobot_unimask/plots/reliability.py",
    "lerobot_unimask/plots/thumbnails.py",
    "lerobot_unimask/pretrained/__init__.py",
    "lerobot_unimask/sharing/cards.py",
    "lerobot_unimask/sharing/hub.py",
    "lerobot_unimask/modeling_unimask.py",
    "lerobot_unimask/envs/record.py",
    "lerobot_unimask/envs/returns.py",
    "lerobot_unimask/envs/cameras.py",
    "lerobot_unimask/envs/maze2d/maze.py",
    "lerobot_unimask/envs/configs.py",
    "lerobot_unimask/envs/doorkey/rules.py",
    "lerobot_unimask/envs/doorkey/environment.py",
    "lerobot_unimask/envs/doorkey/expert.py",
    "lerobot_unimask/envs/doorkey/episodes.py",
    "lerobot_unimask/envs/doorkey/optimum.py",
    "lerobot_unimask/envs/doorkey/panels.py",
    "lerobot_unimask/envs/doorkey/pictures.py",
    "lerobot_unimask/envs/doorkey/comparison.py",
    "lerobot_unimask/envs/doorkey/record.py",
    "lerobot_unimask/envs/maze2d/rendering.py",
    "lerobot_unimask/envs/maze2d/environment.py",
    "lerobot_unimask/envs/maze2d/expert.py",
    "lerobot_unimask/envs/maze2d/pictures.py",
    "lerobot_unimask/envs/maze2d/record.py",
    "lerobot_unimask/envs/metaworld/environment.py",
    "lerobot_unimask/envs/metaworld/expert.py",
    "lerobot_unimask/envs/metaworld/record.py",
    "lerobot_unimask/envs/__init__.py",
    "dataset_builders/folders.py",
    "dataset_builders/videos.py",
    "dataset_builders/writer.py",
    "dataset_builders/label.py",
    "dataset_builders/prepare.py",
    "dataset_builders/doorkey.py",
    "dataset_builders/maze2d.py",
    "dataset_builders/metaworld.py",
    "lerobot_unimask/training.py",
    "lerobot_unimask/evaluating.py",
    "lerobot_unimask/validation.py",
    "lerobot_unimask/measures.py",
    "lerobot_unimask/query.py",
    "lerobot_unimask/bench/clock.py",
    "lerobot_unimask/bench/measuring.py",
    "lerobot_unimask/bench/contender.py",
    "lerobot_unimask/bench/device.py",
    "lerobot_unimask/bench/beside.py",
    "lerobot_unimask/bench/tables.py",
    "lerobot_unimask/demo.py",
    "lerobot_unimask/paper/study_tables.py",
    "lerobot_unimask/paper/claims.py",
    "lerobot_unimask/paper/tables.py",
    "lerobot_unimask/paper/study.py",
    "lerobot_unimask/paper/early_stopping.py",
    "lerobot_unimask/paper/heatmap_panels.py",
    "lerobot_unimask/paper/heatmap.py",
    "lerobot_unimask/paper/table.py",
    "lerobot_unimask/paper/search.py",
    "lerobot_unimask/paper/ablation.py",
    "lerobot_unimask/paper/learning_curve.py",
    "lerobot_unimask/paper/questions.py",
    "lerobot_unimask/paper/chunks.py",
    "lerobot_unimask/paper/gallery.py",
    "lerobot_unimask/lerobot_patches.py",
    "lerobot_policy_unimask/__init__.py",
    "lerobot_unimask/commands/flags.py",
    "lerobot_unimask/commands/push.py",
    "lerobot_unimask/commands/build.py",
    "lerobot_unimask/commands/demo.py",
    "lerobot_unimask/commands/prepare.py",
    "lerobot_unimask/commands/pretrained.py",
    "lerobot_unimask/commands/query.py",
    "lerobot_unimask/commands/given.py",
    "lerobot_unimask/commands/frames.py",
    "lerobot_unimask/commands/validate.py",
    "lerobot_unimask/commands/measure.py",
    "lerobot_unimask/commands/serve.py",
    "lerobot_unimask/commands/bench.py",
    "lerobot_unimask/commands/paper.py",
    "lerobot_unimask/cli.py",
    "lerobot_unimask/__init__.py",
]


@pytest.fixture(scope="session", autouse=True)
def plugin():
    """Nothing is imported: the files are read."""


PACKAGES = ("lerobot_unimask", "dataset_builders", "lerobot_policy_unimask")
SOURCES = sorted(str(path.relative_to(ROOT)) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("*.py"))


@functools.cache
def parsed(source: str) -> ast.Module:
    return ast.parse((ROOT / source).read_text())


@functools.cache
def file_of(module: str) -> str | None:
    """The file that a dotted name is, if it is one of ours."""
    path = module.replace(".", "/")
    return next((name for name in (f"{path}.py", f"{path}/__init__.py") if (ROOT / name).exists()), None)


def imported(source: str) -> set[str]:
    """The files of ours that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = {alias.name: file_of(f"{node.module}.{alias.name}") for alias in node.names}
            names = [f"{node.module}.{name}" if file else node.module for name, file in modules.items()]
        else:
            continue
        found |= {file for name in names if name.split(".")[0] in PACKAGES and (file := file_of(name))}
    return found - {source}


def is_empty(source: str) -> bool:
    """Whether a file holds no more than a docstring."""
    return all(isinstance(node, ast.Expr) for node in parsed(source).body)


def test_every_file_stands_on_a_floor():
    assert sorted(FLOORS) == [source for source in SOURCES if not is_empty(source)]


@pytest.mark.parametrize("source", FLOORS)
def test_imports_lead_downwards(source):
    upwards = {file for file in imported(source) if not is_empty(file) and FLOORS.index(file) >= FLOORS.index(source)}
    # Public names are looked up by text, so that a command line's help stays light.
    assert upwards - {"lerobot_unimask/__init__.py"} == set()


@pytest.mark.parametrize("source", SOURCES + TESTS)
def test_a_file_holds_one_room(source):
    text = (ROOT / source).read_text()
    assert len(text.splitlines()) <= (600 if source.startswith("tests/") else 450)
    long = [
        node.name
        for node in ast.walk(parsed(source))
        if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno >= 100
    ]
    assert long == []
