"""lerobot-train, which also writes what each update was, at full precision: `recorded_training.py FILE FLAGS...`.

FILE, of the main process: `losses` (updates,) as logged, `gradients` (updates, parameters), `frames` (updates, windows)
that all processes together trained on, sorted, and the number of `processes`.
"""

import sys

import torch
from accelerate import PartialState
from accelerate.utils import gather
from lerobot.scripts import lerobot_train
from lerobot.utils.logging_utils import MetricsTracker
from torch.optim.optimizer import register_optimizer_step_pre_hook

losses, gradients, frames = [], [], []


def record_gradients(optimizer, *_):
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    gradients.append(
        torch.cat([torch.zeros_like(p).flatten() if p.grad is None else p.grad.flatten() for p in parameters])
    )


def record_losses(self):
    reduce_across_ranks(self)
    losses.append(self.metrics["loss"].avg)


def record_frames(metrics, policy, batch, *arguments, **keywords):
    frames.append(gather(batch["index"]).sort().values)
    return update_policy(metrics, policy, batch, *arguments, **keywords)


output = sys.argv.pop(1)
torch.set_num_threads(1)
register_optimizer_step_pre_hook(record_gradients)
reduce_across_ranks, MetricsTracker.reduce_across_ranks = MetricsTracker.reduce_across_ranks, record_losses
update_policy, lerobot_train.update_policy = lerobot_train.update_policy, record_frames
lerobot_train.main()
state = PartialState()
if state.is_main_process:
    record = {"losses": torch.tensor(losses), "gradients": torch.stack(gradients), "frames": torch.stack(frames)}
    torch.save(record | {"processes": state.num_processes}, output)
