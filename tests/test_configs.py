"""Every shipped config is one that LeRobot reads, opens with the commands that use it, and fits the model."""

import shlex
import sys
from pathlib import Path

import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_unimask import UniMASKConfig
from lerobot_unimask.cli import make_parser
from lerobot_unimask.masks import TrainingMasks, tabulate

ROOT = Path(__file__).parents[1]
CONFIGS = sorted(path.relative_to(ROOT) for path in ROOT.glob("configs/*.yaml"))

pytestmark = pytest.mark.parametrize("path", CONFIGS, ids=str)


def opening(path: Path) -> list[str]:
    """The comment that a config opens with, without its hash signs."""
    lines = (ROOT / path).read_text().splitlines()
    end = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    return [line.removeprefix("#").strip() for line in lines[:end]]


def read(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> TrainPipelineConfig:
    """As lerobot-train reads it, up to the point where it would load the dataset."""
    register_third_party_plugins()
    monkeypatch.chdir(tmp_path)  # the output folder must not be there
    monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={ROOT / path}"])
    config = TrainPipelineConfig.from_pretrained(ROOT / path)
    config.validate()
    return config


def test_it_opens_with_the_commands_that_use_it(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    lines = opening(path)
    assert f"uv run lerobot-train --config_path={path}" in lines
    (build,) = (line for line in lines if line.startswith("uv run unimask build "))
    arguments = make_parser().parse_args(shlex.split(build)[3:])
    assert arguments.root == Path(read(path, monkeypatch, tmp_path).dataset.root)


def test_lerobot_reads_it_and_knows_each_setting(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config = read(path, monkeypatch, tmp_path)
    assert isinstance(config.policy, UniMASKConfig)
    assert not config.policy.push_to_hub
    assert config.num_workers == 0  # windows are read in batches, faster than a worker can pass them on
    assert config.output_dir == Path("outputs") / path.stem
    assert config.save_freq <= config.steps
    assert config.eval_steps == 0 or config.dataset.eval_split > 0


def test_its_masks_fit_its_window(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    policy = read(path, monkeypatch, tmp_path).policy
    factors = ("s", "a", "rtg")
    assert TrainingMasks(policy.training_masks, factors, policy.context_length).weights
    assert tabulate(policy.inference_mask, factors, policy.context_length).t.tolist() == list(
        range(policy.context_length)
    )
