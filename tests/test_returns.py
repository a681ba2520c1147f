"""Return-to-go against a slow loop."""

import numpy as np
import pytest

from lerobot_unimask.data.returns import return_to_go


def test_equals_a_loop_over_steps():
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 9, size=40)
    rewards = rng.normal(size=lengths.sum()).astype(np.float32)
    expected, start = [], 0
    for length in lengths:
        for step in range(start, start + length):
            expected.append(sum(float(reward) for reward in rewards[step : start + length]))
        start += length
    returns = return_to_go(rewards, lengths)
    assert returns.dtype == np.float32
    np.testing.assert_allclose(returns, expected, rtol=1e-6, atol=1e-6)


def test_an_episode_does_not_see_another():
    rewards = np.array([1.0, 2.0, np.nan, 4.0])
    np.testing.assert_array_equal(return_to_go(rewards, np.array([2, 1, 1])), [3.0, 2.0, np.nan, 4.0])


@pytest.mark.parametrize("lengths", [[3, 2], [4, 0], [5, -1]])
def test_lengths_that_do_not_fit_are_refused(lengths):
    with pytest.raises(ValueError, match="lengths"):
        return_to_go(np.zeros(4), np.array(lengths))
