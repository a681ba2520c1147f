"""The record of chunks: rollouts on a clock, and what they count."""

from itertools import pairwise

import pytest
import torch
from test_deployment import FEATURES, STATS

from lerobot_unimask.paper import chunks


@pytest.fixture
def policy(tiny_policy):
    return tiny_policy("gaussian", features=FEATURES, stats=STATS, chunk_size=8)


@pytest.mark.parametrize("delay", [0, 2, 4])
def test_a_new_chunk_begins_every_four_steps(policy, delay):
    """It is asked for every four steps, and there as soon as the delay has passed."""
    returns, steps, seams = chunks.act_in_real_time(policy, 2, delay, prefix=True, seed=0)
    assert returns.shape == (2,)
    assert steps.shape == (199, 2, 2)
    assert seams[0] == max(4, delay) + delay - 1
    assert set(torch.tensor(seams).diff().tolist()) == {4}


def test_without_a_delay_nothing_is_on_its_way(policy):
    with_mask, without = (chunks.act_in_real_time(policy, 2, 0, prefix=prefix, seed=0) for prefix in (True, False))
    assert torch.equal(with_mask[1], without[1])
    assert torch.equal(with_mask[0], without[0])


def test_with_the_mask_a_chunk_goes_on_from_the_one_before(policy, monkeypatch):
    """Its first actions are those that were carried out while it was worked out."""
    asked = []
    ask = chunks._ask
    monkeypatch.setattr(chunks, "_ask", lambda *arguments: asked.append(ask(*arguments)) or asked[-1])
    chunks.act_in_real_time(policy, 2, 4, prefix=True, seed=0)
    for before, after in pairwise(asked):
        assert torch.equal(after[:, :4], before[:, 4:8])
