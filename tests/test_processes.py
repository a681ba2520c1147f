"""Several processes train the model that one process trains with all their windows in one batch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import distributed, multiprocessing
from torch.nn.parallel import DistributedDataParallel

from dataset_builders.doorkey import build_doorkey

UPDATES = 100
WITHOUT_DROPOUT = ["--policy.dropout=0", "--policy.optimizer_grad_clip_norm=1e9"]  # gradients as they are, not scaled
SMALL = ["--policy.width=16", "--policy.depth=1", "--policy.heads=2", "--policy.feedforward_width=16"]


def gradients_of(policy):
    return torch.cat([p.grad.flatten() for p in policy.parameters() if p.grad is not None])


def train_once(rank, policy, batches, results):
    """What lerobot-train does for one update: a process of a group of `len(batches)`."""
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{results}/meet", rank=rank, world_size=len(batches))
    model = DistributedDataParallel(policy, find_unused_parameters=True)
    loss, parts = model.forward(batches[rank])
    loss.backward()
    logged = torch.stack([loss.detach(), *map(torch.tensor, parts.values())])
    distributed.all_reduce(logged)
    if rank == 0:
        torch.save({"logged": logged / len(batches), "gradients": gradients_of(policy)}, results / "update.pt")
    distributed.destroy_process_group()


@pytest.mark.parametrize("masks", ["random_mask", "past"])
def test_processes_with_unequal_token_counts_have_the_loss_and_gradients_of_one(
    tiny_policy, doorkey_batch, tmp_path, masks
):
    policy = tiny_policy(training_masks=masks).train()
    batches = [{key: value[part] for key, value in doorkey_batch.items()} for part in (slice(0, 3), slice(3, 8))]
    processes = [
        multiprocessing.get_context("fork").Process(target=train_once, args=(rank, policy, batches, tmp_path))
        for rank in range(2)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(timeout=60)
        assert process.exitcode == 0
    together = torch.load(tmp_path / "update.pt")

    loss, parts = policy.forward(doorkey_batch)
    loss.backward()
    torch.testing.assert_close(together["logged"], torch.tensor([loss.item(), *parts.values()]), rtol=0, atol=1e-5)
    torch.testing.assert_close(together["gradients"], gradients_of(policy), rtol=0, atol=1e-5)
    apart = [policy.forward(batch)[0].item() for batch in batches]
    assert abs(sum(apart) / 2 - loss.item()) > 1e-3  # each over its own tokens would be another loss


def recorded_run(launcher: list[str], arguments: list[str], output: Path) -> dict[str, torch.Tensor]:
    command = [*launcher, str(Path(__file__).with_name("recorded_training.py")), str(output), *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, cwd=output.parent, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    return torch.load(output)


@pytest.mark.slow
def test_accelerate_launch_trains_the_model_of_one_process_with_twice_the_batch(tmp_path: Path) -> None:
    # 1,000 windows, of which a hundred updates take 800: within the first epoch no batch is short.
    root = build_doorkey(tmp_path / "doorkey", episodes=1000, progress=False)
    train = ["--policy.type=unimask", "--policy.push_to_hub=false", "--policy.device=cpu", *SMALL, *WITHOUT_DROPOUT]
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
