"""What is said of held-out episodes: acting beside repeating the last action, against a loop over windows."""

import logging
import re

import pytest

from lerobot_unimask.language.training_masks import validation_masks


def said(caplog):
    return [record.getMessage() for record in caplog.records if "held-out steps" in record.getMessage()]


@pytest.mark.parametrize(("kind", "split"), [("doorkey", 1), ("gaussian", 1), ("gaussian", 3), ("mixture", 1)])
def test_an_evaluation_says_how_far_acting_is_from_repeating(tiny_policy, batch_of, kind, split, caplog):
    """However the windows are divided into batches."""
    settings = {"continuous_head": "mixture"} if kind == "mixture" else {}
    policy, batch = tiny_policy(kind, **settings).eval(), batch_of(kind)
    parts = [{key: value[first::split] for key, value in batch.items()} for first in range(split)]
    for part in parts:
        policy.forward(part)
    with caplog.at_level(logging.INFO):
        policy.train()
    (line,) = said(caplog)

    missed = []
    for part in parts:
        window = policy.make_window(part)
        asked = validation_masks("behavior_cloning", tuple(policy.factors), window.valid, part["index"]).asked["a"]
        for row, t in asked[:, 1:].nonzero().tolist():
            recorded, last = window.values["a"][row, t + 1], window.values["a"][row, t]
            guess = policy.infer(part, "behavior_cloning", t=t + 1).carried_out("a")[row, t + 1]
            scale = policy.statistics.get_buffer("a_std")
            missed.append([((one - recorded) / scale).square().mean().item() for one in (guess, last)])
    means = [sum(column) / len(missed) for column in zip(*missed, strict=True)]
    numbers = [float(number) for number in re.findall(r"\d+\.\d+", line)]
    assert int(re.search(r"\d+", line).group()) == len(missed)
    if kind == "doorkey":
        means = [100 * sum(pair[i] > 0 for pair in missed) / len(missed) for i in range(2)]
        assert numbers == pytest.approx(means, abs=0.051)
    else:
        assert numbers == pytest.approx([mean**0.5 for mean in means], abs=0.00051)


@pytest.mark.parametrize("settings", [{}, {"context_length": 1}])
def test_nothing_is_said_where_nothing_was_held_out_or_asked(tiny_policy, load_doorkey, settings, caplog):
    policy = tiny_policy("doorkey", **settings).train()
    with caplog.at_level(logging.INFO):
        if settings:  # a window of one step has no action before
            dataset = load_doorkey(1)
            policy.eval().forward({key: value.unsqueeze(0) for key, value in dataset[0].items() if key != "task"})
        policy.train()
    assert said(caplog) == []


def test_each_evaluation_stands_for_itself(tiny_policy, doorkey_batch, caplog):
    policy = tiny_policy("doorkey")
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            policy.eval().forward(doorkey_batch)
            policy.train()
    one, other = said(caplog)
    assert one == other
