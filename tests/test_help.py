"""Help tells the truth, and quickly: LeRobot's parser has each field's own text; ours imports nothing heavy."""

import ast
import inspect
import itertools
import json
import subprocess
import sys

import pytest
from draccus.argparsing import ArgumentParser
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_unimask import UniMASKConfig
from lerobot_unimask.cli import COMMANDS

HEAVY = {"torch", "lerobot", "numpy", "matplotlib", "gymnasium", "datasets", "huggingface_hub", "optuna", "mujoco"}
BODY = ast.parse(inspect.getsource(UniMASKConfig)).body[0].body
# Each field with the docstring under it, as Python reads them
TEXTS = {
    field.target.id: inspect.cleandoc(below.value.value) if isinstance(below, ast.Expr) else ""
    for field, below in itertools.pairwise(BODY)
    if isinstance(field, ast.AnnAssign)
}


@pytest.fixture(scope="module")
def flags():
    """lerobot-train's flags, as its own parser has them once it has imported its policies, and plugins after these."""
    policies = PreTrainedConfig._choice_registry
    policies["unimask"] = policies.pop("unimask")
    actions = ArgumentParser(config_class=TrainPipelineConfig).parser._actions
    return {flag: action for action in actions for flag in action.option_strings}


@pytest.mark.parametrize("name", TEXTS)
def test_lerobots_help_shows_each_field_its_own_text(name, flags):
    shown = flags[f"--policy.{name}"].help
    assert TEXTS[name]
    assert shown.split() == TEXTS[name].split()


def test_help_loads_nothing_heavy_and_is_quick():
    """One process asks for the help of every command, then tells its processor time and what it has imported."""
    asked = [["--help"], *([command.__name__.rpartition(".")[2], "--help"] for command in COMMANDS)]
    code = f"""
import contextlib, io, json, sys, time
from lerobot_unimask.cli import main
for words in {asked}:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(words)
print(json.dumps([time.process_time(), sorted(name for name in sys.modules if "." not in name)]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    seconds, loaded = json.loads(done.stdout)
    assert "lerobot_unimask" in loaded
    assert HEAVY & set(loaded) == set()
    assert seconds < 0.5 * len(asked)
