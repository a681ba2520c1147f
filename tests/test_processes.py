"""Several processes train the model that one process trains with all their windows in one batch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from policies import TRAIN_FLAGS
from torch import distributed

from dataset_builders.doorkey import build_doorkey

UPDATES = 100
WITHOUT_DROPOUT = ["--policy.dropout=0", "--policy.optimizer_grad_clip_norm=1e9"]  # gradients as they are, not scaled


class Group:
    """Stands for a group of processes whose collective calls meet: each process's counts, in the order of its calls."""

    def __init__(self, size):
        self.counts = [[] for _ in range(size)]
        self.rank, self.met = 0, False

    def all_reduce(self, count):
        mine = self.counts[self.rank]
        if self.met:
            self.calls += 1
            count.copy_(sum(counts[self.calls - 1] for counts in self.counts))
        else:
            mine.append(count.clone())

    def forward(self, policy, batches):
        """Every process's (loss, parts): a first round to tell the counts, a second in which all know them."""
        for self.met in (False, True):
            results = []
            for self.rank, batch in enumerate(batches):
                self.calls = 0
                results.append(policy.forward(batch))
        return results


@pytest.mark.parametrize("masks", ["random_mask", "past"])
def test_processes_with_unequal_token_counts_have_the_loss_and_gradients_of_one(
    tiny_policy, doorkey_batch, monkeypatch, masks
):
    policy = tiny_policy(training_masks=masks).train()
    loss, parts = policy.forward(doorkey_batch)
    gradients = torch.autograd.grad(loss, list(policy.parameters()), allow_unused=True)
    batches = [{key: value[part] for key, value in doorkey_batch.items()} for part in (slice(0, 1), slice(1, 8))]
    apart = [policy.forward(batch)[0].item() for batch in batches]
    assert abs(sum(apart) / 2 - loss.item()) > 1e-3  # each over its own tokens would be another loss

    group = Group(2)
    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(distributed, "get_world_size", lambda: 2)
    monkeypatch.setattr(distributed, "all_reduce", group.all_reduce)
    results = group.forward(policy, batches)
    together = sum(one for one, _ in results) / 2
    torch.testing.assert_close(together, loss, rtol=0, atol=1e-5)
    for name, part in parts.items():
        assert sum(others[name] for _, others in results) / 2 == pytest.approx(part, abs=1e-5)
    averaged = torch.autograd.grad(together, list(policy.parameters()), allow_unused=True)
    for gradient, expected in zip(averaged, gradients, strict=True):
        assert (gradient is None) == (expected is None)
        if expected is not None:
            torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-5)


def recorded_run(launcher: list[str], arguments: list[str], output: Path) -> dict[str, torch.Tensor]:
    command = [*launcher, str(Path(__file__).with_name("recorded_training.py")), str(output), *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, cwd=output.parent, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    return torch.load(output)


@pytest.mark.slow
def test_accelerate_launch_trains_the_model_of_one_process_with_twice_the_batch(tmp_path):
    # 1,000 windows, of which a hundred updates take 800: within the first epoch no batch is short.
    root = build_doorkey(tmp_path / "doorkey", episodes=1000, progress=False)
    train = [*TRAIN_FLAGS, *WITHOUT_DROPOUT]
    train += ["--dataset.repo_id=local/doorkey", f"--dataset.root={root}", f"--steps={UPDATES}", "--log_freq=1"]
    train += ["--num_workers=0", "--save_checkpoint=false", "--dataset.eval_split=0.1", "--eval_steps=100"]
    # With --cpu accelerate leaves it to MPI to start processes and, without that, starts one; --multi_gpu starts them
    # itself, and on what they then train --policy.device says.
    launcher = [str(Path(sys.executable).with_name("accelerate")), "launch", "--multi_gpu", "--num_processes=2"]
    two = recorded_run(launcher, [*train, "--batch_size=4", "--output_dir=two"], tmp_path / "two.pt")
    one = recorded_run([sys.executable], [*train, "--batch_size=8", "--output_dir=one"], tmp_path / "one.pt")
    assert one["processes"] == 1
    assert two["processes"] == 2
    assert torch.equal(one["frames"], two["frames"])
    assert one["losses"].shape == (UPDATES,)
    assert one["gradients"].shape[0] == UPDATES
    for name in ("losses", "gradients"):
        print(f"\n{name} differ by at most {(two[name] - one[name]).abs().max():.1e}")
        torch.testing.assert_close(two[name], one[name], rtol=0, atol=1e-5)
    assert one["gradients"].abs().amax(1).min() > 1e-3  # the tolerance would not hide them
