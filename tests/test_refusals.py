"""What is no question, no batch and no observation: each ends in one clear error, and nothing is answered or
remembered."""

from functools import reduce

import numpy as np
import pytest
import torch

NESTED = reduce(lambda inner, _: [inner], range(10_000), 0)

VALUES = {
    "a number too large": 10**400,
    "a number of 20,000 digits": 10**20_000,
    "nested 10,000 deep": NESTED,
    "a text": "left",
    "None": None,
    "a mapping": {"x": 1},
    "an object": object(),
    "a list of lists of other lengths": [[1, 2], [3]],
    "NaN": [float("nan"), 0],
    "infinity": [float("inf"), 0],
    "three numbers": [1, 2, 3],
    "no numbers": [],
    "complex numbers": torch.zeros(2, dtype=torch.complex64),
    "a sparse tensor": torch.zeros(2).to_sparse(),
    "a tensor without values": torch.zeros(2, device="meta"),
    "no category": [16, 0],
    "half a category": [0.5, 0],
    "objects in an array": np.array([object(), object()]),
}


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_a_given_value_that_is_none_of_its_token_is_refused(tiny_policy, value):
    policy = tiny_policy()
    with pytest.raises(ValueError, match=r"s\[0\]") as error:
        policy.infer(None, "a[0] | s[0]", given={"s[0]": value})
    assert len(str(error.value)) < 1000
    with pytest.raises(ValueError, match=r"s\[-1\]"):
        policy.select_action({"observation.state": torch.zeros(1, 2)}, mask="goal_conditioned", given={"s[-1]": value})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        *((given, "give values by token") for given in ([1, 2], "s[0]")),
        *((given, "name a token by its text") for given in ({3: [1, 2]}, {None: 1})),
        ({"": 1}, "Expected a factor"),
        ({"s[99]": [0, 0]}, "outside the window"),
        ({"s[0": [0, 0]}, "found the end of the text"),
    ],
)
def test_what_maps_no_tokens_to_values_is_refused(tiny_policy, given, message):
    with pytest.raises(ValueError, match=message):
        tiny_policy().infer(None, "a[0] | s[0]", given=given)


@pytest.mark.parametrize("t", ["3", 3.0, None, -1, 10, 10**30, [3], float("nan")])
def test_t_is_the_number_of_a_step(tiny_policy, doorkey_batch, t):
    with pytest.raises(ValueError, match=r"\bt\b"):
        tiny_policy().infer(doorkey_batch, "future", t=t)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("samples", value) for value in (0, -1, None, "3", 2.0, True)),
        *(("seed", value) for value in (-1, 2**63, 10**400, None, "0", 0.5)),
        *(("order", value) for value in ("sideways", None, 3)),
        *(("tries", value) for value in (0, -1, None, "3")),
    ],
)
def test_a_setting_of_sampling_out_of_range_is_named(tiny_policy, doorkey_batch, name, value):
    with pytest.raises(ValueError, match=name):
        tiny_policy().sample(doorkey_batch, "future", t=3, **{name: value})


STATES = {
    **{
        name: VALUES[name]
        for name in ("a text", "a mapping", "complex numbers", "a sparse tensor", "nested 10,000 deep")
    },
    "a tensor without values": torch.zeros(1, 2, device="meta"),
    "no dimensions": torch.tensor(3.0),
    "one state of another size": torch.zeros(3),
    "a window": torch.zeros(1, 10, 2),
    "another number of numbers": torch.zeros(1, 3),
    "NaN": torch.full((1, 2), torch.nan),
    "None": None,
}


@pytest.mark.parametrize("state", STATES.values(), ids=STATES)
def test_an_observation_of_another_kind_is_refused_and_not_remembered(tiny_policy, state):
    policy = tiny_policy()
    start = {"observation.state": torch.zeros(1, 2)}
    policy.reset()
    policy.select_action(start)
    with pytest.raises(ValueError, match=r"observation\.state|observed state"):
        policy.select_action({"observation.state": state})
    assert policy._memory.step == 0


@pytest.mark.parametrize("batch", [None, [1, 2], torch.zeros(1, 2), np.zeros((1, 2)), "state"])
def test_what_is_no_batch_is_refused(tiny_policy, batch):
    for ask in (tiny_policy().select_action, tiny_policy().forward, tiny_policy().make_window):
        with pytest.raises(ValueError, match="columns"):
            ask(batch)


@pytest.mark.parametrize(
    "received",
    ["3", torch.zeros(3, 1), torch.tensor([[float("nan")], [0.0]]), torch.zeros(2, 1).to_sparse(), [None, 1]],
)
def test_a_return_so_far_of_another_kind_is_refused_and_not_remembered(tiny_policy, received):
    policy = tiny_policy()
    policy.reset()
    state = torch.zeros(2, 2)
    policy.select_action({"observation.state": state})
    with pytest.raises(ValueError, match=r"observation\.return_so_far"):
        policy.select_action({"observation.state": state, "observation.return_so_far": received})
    assert policy._memory.step == 0


@pytest.mark.parametrize("kind", [np.asarray, torch.Tensor.tolist])
def test_observations_as_arrays_or_lists_are_read(tiny_policy, kind):
    state = torch.tensor([[3.0, 7.0], [0.0, 1.0]])
    policy = tiny_policy(inference_mask="reward_conditioned", target_return=3.0)
    actions = []
    for read in (lambda tensor: tensor, kind):
        policy.reset()
        batch = {"observation.state": read(state), "observation.return_so_far": read(torch.zeros(2, 1))}
        actions.append(policy.select_action(batch))
    assert torch.equal(*actions)


def test_a_batch_of_arrays_trains_as_one_of_tensors(tiny_policy, doorkey_batch):
    policy = tiny_policy().train()
    arrays = {key: value.numpy() for key, value in doorkey_batch.items() if isinstance(value, torch.Tensor)}
    assert torch.equal(policy.forward(arrays)[0], policy.forward(doorkey_batch)[0])


PAD = "observation.state_is_pad"
BATCHES = {
    "is_pad of another shape": (PAD, lambda batch: batch[PAD][:, :3], "is_pad"),
    "is_pad of numbers": (PAD, lambda batch: torch.full(batch[PAD].shape, 0.5), "is_pad"),
    "is_pad that is a text": (PAD, lambda batch: "no", "is_pad"),
    "columns of another length": ("action", lambda batch: batch["action"][:3], "length"),
    "an index of another length": ("index", lambda batch: batch["index"][:3], "index"),
    "an action that is a text": ("action", lambda batch: "left", "action"),
    "a sparse action": ("action", lambda batch: batch["action"].to_sparse(), "action"),
    "a state without values": ("observation.state", lambda batch: batch["observation.state"].to("meta"), "state"),
}


@pytest.mark.parametrize(("key", "change", "words"), BATCHES.values(), ids=BATCHES)
def test_a_batch_that_is_none_of_this_model_is_refused(tiny_policy, doorkey_batch, key, change, words):
    with pytest.raises(ValueError, match=words):
        tiny_policy().forward({**doorkey_batch, key: change(doorkey_batch)})


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32])
def test_is_pad_may_be_zeros_and_ones(tiny_policy, doorkey_batch, dtype):
    policy = tiny_policy().train()
    batch = {key: value.to(dtype) if key.endswith("_is_pad") else value for key, value in doorkey_batch.items()}
    assert torch.equal(policy.forward(batch)[0], policy.forward(doorkey_batch)[0])
