"""The fused AdamW: plain AdamW's numbers and files, whichever of the two a training began with."""

import pytest
import torch
from lerobot.optim import AdamWConfig
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state

from lerobot_unimask.optimiser import FusedAdamWConfig


def trained(optimiser, weight, steps):
    for step in range(steps):
        optimiser.zero_grad()
        (weight * torch.arange(6.0) - step).square().sum().backward()
        optimiser.step()


@pytest.mark.parametrize("first", [AdamWConfig, FusedAdamWConfig])
@pytest.mark.parametrize("then", [AdamWConfig, FusedAdamWConfig])
def test_a_training_goes_on_whichever_it_began_with(first, then, tmp_path):
    straight = torch.nn.Parameter(torch.ones(6))
    trained(AdamWConfig(lr=0.1).build([straight]), straight, 5)
    weight = torch.nn.Parameter(torch.ones(6))
    begun = first(lr=0.1).build([weight])
    trained(begun, weight, 3)
    save_optimizer_state(begun, tmp_path)
    resumed = load_optimizer_state(then(lr=0.1).build([weight]), tmp_path)
    for step in range(3, 5):
        resumed.zero_grad()
        (weight * torch.arange(6.0) - step).square().sum().backward()
        resumed.step()
    assert resumed.param_groups[0]["fused"] is (True if then is FusedAdamWConfig else None)
    torch.testing.assert_close(weight, straight, rtol=1e-6, atol=1e-6)
