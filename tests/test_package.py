"""The built wheel works by itself: installed without dependencies, in a process that does not see the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder that holds the installed wheel and nothing else."""
    uv = os.environ.get("UV") or shutil.which("uv")
    assert uv, "run the tests with `uv run pytest`"
    work = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", work], cwd=ROOT, check=True)
    (wheel,) = work.glob("lerobot_policy_unimask-*.whl")
    target = work / "site"
    flags = ["--no-deps", "--offline", "--python", sys.executable, "--target", target]
    subprocess.run([uv, "pip", "install", *flags, wheel], check=True)
    return target


def run_outside(code: str, installed: Path, cwd: Path) -> str:
    """Run code with the wheel and the dependencies, but without the checkout: -S leaves out editable installs."""
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(installed), sysconfig.get_path("purelib")]))
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_the_wheel_holds_the_three_packages_and_no_more(installed):
    packages = {path.parent.relative_to(installed).parts[0] for path in installed.rglob("*.py")}
    assert packages == {"lerobot_unimask", "lerobot_policy_unimask", "dataset_builders"}
    policies = {path.parent.name for path in installed.glob("lerobot_unimask/pretrained/*/model.safetensors")}
    assert policies == {"doorkey", "maze2d"}


def test_lerobot_discovers_the_wheel_and_makes_policy_and_environment_by_name(installed, tmp_path):
    code = """
import sys
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
import importlib.metadata
import lerobot_unimask
print(importlib.metadata.distribution("lerobot_policy_unimask").locate_file(""))
from lerobot.envs import make_env
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import get_policy_class, make_policy_config
from dataset_builders.doorkey import build_doorkey, FEATURES
config = make_policy_config("unimask", device="cpu")
config.set_dataset_feature_metadata(FEATURES)
policy = get_policy_class("unimask")(config)
print(make_env(make_env_config("doorkey"), n_envs=2)["doorkey"][0].num_envs)
print(build_doorkey("doorkey", episodes=2, progress=False).name)
print(lerobot_unimask.__file__)
print([path for path in sys.path if path and "site" not in path and "python" not in path])
"""
    distribution, environments, name, file, others = run_outside(code, installed, tmp_path).splitlines()[-5:]
    assert Path(distribution) == installed
    assert (environments, name) == ("2", "doorkey")
    assert Path(file).is_relative_to(installed)
    assert str(ROOT) not in others
