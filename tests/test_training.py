"""Training in this process makes the updates of lerobot-train."""

import sys
from pathlib import Path

import pytest
from policies import SMALL

from lerobot_unimask.training import Trainer

SETTINGS = SMALL | {"device": "cpu"}


def lerobot_train(monkeypatch, root: Path, *flags: str) -> None:
    from lerobot.scripts import lerobot_train

    flags = ("--policy.push_to_hub=false", "--dataset.repo_id=local/doorkey", f"--dataset.root={root}", *flags)
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags, "--num_workers=0"])
    lerobot_train.main()


def test_its_losses_are_those_of_lerobot_train(doorkey_root, tmp_path, losses, monkeypatch):
    """Four epochs of 30 windows in batches of 8, with dropout; then fine-tuning from the checkpoint that it left."""
    settings = SETTINGS | {"dropout": 0.3, "training_masks": "multi_task"}
    flags = [f"--policy.{name}={value}" for name, value in settings.items()]
    monkeypatch.chdir(tmp_path)
    training = ("--seed=7", "--steps=16", "--batch_size=8", "--save_freq=16")
    lerobot_train(monkeypatch, doorkey_root, "--policy.type=unimask", *flags, *training, "--output_dir=one")
    expected = losses.copy()
    assert len(expected) == 16
    trainer = Trainer(settings, doorkey_root, seed=7, steps=16, batch_size=8)
    assert list(trainer) == expected
    assert int(trainer.policy.updates) == 16

    losses.clear()
    checkpoint = Path("one/checkpoints/last/pretrained_model")
    tuning = ("--policy.training_masks=past", "--policy.optimizer_lr=0.01", "--seed=3", "--steps=6", "--batch_size=8")
    lerobot_train(monkeypatch, doorkey_root, f"--policy.path={checkpoint}", *tuning, "--output_dir=two")
    expected = losses.copy()
    settings = {"training_masks": "past", "optimizer_lr": 0.01}
    assert list(Trainer(settings, doorkey_root, seed=3, steps=6, batch_size=8, checkpoint=checkpoint)) == expected


def test_what_is_not_there_is_named(doorkey_root, tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no LeRobotDataset"):
        Trainer(SETTINGS, tmp_path, seed=0, steps=1, batch_size=8)
    with pytest.raises(ValueError, match="flavour"):
        Trainer(SETTINGS | {"flavour": 1}, doorkey_root, seed=0, steps=1, batch_size=8)
