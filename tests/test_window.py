"""Windows from LeRobot batches, and the statistics that turn their units."""

import math

import pytest
import torch

from lerobot_unimask.data.factors import Feature, make_factors
from lerobot_unimask.data.window import Statistics, make_window

K = 4
FEATURES = {
    "s": [Feature("observation.state", 2, [16, 8], ["agent", "key"]), Feature("observation.environment_state", 3)],
    "a": [Feature("action", 1)],
    "rtg": [Feature("observation.return_to_go", 1)],
}
STATS = {
    "observation.state": {"mean": [7.0, 3.0], "std": [2.0, 2.0]},
    "observation.environment_state": {"mean": [1.0, -20.0, 5.0], "std": [0.5, 10.0, 0.0]},
    "action": {"mean": [3.0], "std": [2.0]},
    "observation.return_to_go": {"mean": [4.0], "std": [8.0]},
    "frame_index": {"max": [24]},
    "timestamp": {"max": [4.8]},
}


def make_batch(B=3):
    generator = torch.Generator().manual_seed(0)
    return {
        "observation.state": torch.randint(0, 8, (B, K, 2), generator=generator),
        "observation.environment_state": torch.randn(B, K, 3, generator=generator),
        "action": torch.randn(B, K, generator=generator),  # LeRobot drops the axis of features of one number
        "observation.return_to_go": torch.randn(B, K, 1, generator=generator),
        "observation.state_is_pad": torch.arange(K) >= torch.tensor([[4], [2], [1]])[:B],
        "action_is_pad": torch.zeros(B, K, dtype=torch.bool),
        "timestamp": torch.tensor([0.0, 0.4, 4.8])[:B],
        "index": torch.arange(B),
        "task": ["go there"] * B,
    }


def read(batch, features=FEATURES, horizon=25.0, fps=5.0):
    return make_window(batch, features, K, horizon=torch.tensor(horizon), fps=torch.tensor(fps))


def test_factors_say_what_each_number_is():
    factors = make_factors(FEATURES)
    assert {name: (factor.size, factor.given_size) for name, factor in factors.items()} == {
        "s": (5, 5),
        "a": (1, 1),
        "rtg": (2, 1),  # the timestep is not given by a user
    }
    assert [(c.name, c.dims, c.categories, o.size) for o in factors["s"].outputs for c in o.components] == [
        ("agent", slice(0, 1), 16, 16),
        ("key", slice(1, 2), 8, 8),
        ("environment_state", slice(2, 5), None, 3),
    ]


def test_discrete_numbers_of_a_token_make_one_output_where_their_combinations_are_few():
    (cells, numbers) = make_factors(FEATURES, joint=True)["s"].outputs
    assert (cells.size, cells.numbers, numbers.size, numbers.numbers) == (128, [0, 1], 3, [2, 3, 4])
    values = torch.cartesian_prod(torch.arange(16), torch.arange(8))
    assert torch.equal(cells.combination(values), torch.arange(128))
    assert torch.equal(cells.split(torch.arange(128)), values)


@pytest.mark.parametrize(
    ("categories", "together"),
    [
        ([32, 32], [[32, 32]]),
        ([32, 33], [[32, 33]]),
        ([5000], [[5000]]),
        ([128, 128, 2], [[128, 128], [2]]),
        ([11] * 6, [[11] * 4, [11] * 2]),
    ],
)
def test_as_many_discrete_numbers_as_can_be_told_are_predicted_together(categories, together):
    features = {"s": [Feature("observation.state", len(categories), categories)]}
    outputs = make_factors(features, joint=True)["s"].outputs
    assert [list(output.categories) for output in outputs] == together
    for output in outputs:
        count = math.prod(output.categories)
        chained = len(output.components) > 1 and count > 1024
        assert output.size == (sum(output.categories) * 17 if chained else count)
        assert output.table(torch.zeros(2, output.size)).shape == (2, count)


def test_a_window_holds_the_batchs_numbers():
    batch = make_batch()
    window = read(batch)
    assert {name: (tuple(value.shape), value.dtype) for name, value in window.values.items()} == {
        "s": ((3, K, 5), torch.float32),
        "a": ((3, K, 1), torch.float32),
        "rtg": ((3, K, 2), torch.float32),
    }
    for b in range(3):
        for k in range(K):
            assert window.values["s"][b, k, :2].tolist() == batch["observation.state"][b, k].tolist()
            assert window.values["s"][b, k, 2:].tolist() == batch["observation.environment_state"][b, k].tolist()
            assert window.values["a"][b, k, 0] == batch["action"][b, k]
            assert window.values["rtg"][b, k, 0] == batch["observation.return_to_go"][b, k, 0]
            step = [0, 2, 24][b] + k  # of the episode: timestamp times 5 frames a second
            assert window.values["rtg"][b, k, 1].item() == pytest.approx(step / 25)
    assert window.valid.tolist() == [[True] * 4, [True, True, False, False], [True, False, False, False]]


def test_one_number_may_keep_its_axis():
    batch, squeezed = make_batch(), make_batch()
    batch["action"] = batch["action"].unsqueeze(-1)
    squeezed["observation.return_to_go"] = squeezed["observation.return_to_go"].squeeze(-1)
    for name, value in read(batch).values.items():
        assert torch.equal(value, read(squeezed).values[name])


def test_without_padding_and_time_everything_is_valid_and_starts_at_0():
    batch = {key: value for key, value in make_batch().items() if "_is_pad" not in key and key != "timestamp"}
    window = read(batch)
    assert window.valid.all()
    assert torch.equal(window.values["rtg"][:, :, 1], (torch.arange(K) / 25).expand(3, K))


def test_padding_is_read_off_the_action_where_there_is_no_state():
    batch = make_batch()
    batch["action_is_pad"] = batch.pop("observation.state_is_pad")
    assert read(batch).valid.sum(1).tolist() == [4, 2, 1]


def test_a_missing_column_is_named():
    batch = make_batch()
    del batch["action"]
    with pytest.raises(KeyError, match=r"'action'.*observation\.state"):
        read(batch)


@pytest.mark.parametrize(
    ("key", "shape"),
    [
        ("observation.state", (3, K + 1, 2)),
        ("observation.state", (3, K, 3)),
        ("observation.state", (3, 2)),
        ("action", (3,)),
        ("action", (3, K, 1, 1)),
        ("action", (3, K - 1)),
    ],
)
def test_a_wrong_shape_is_named(key, shape):
    with pytest.raises(ValueError, match=rf"{key}.*{shape[-1]}.*\(batch, 4, "):
        read(make_batch() | {key: torch.zeros(shape)})


def make_statistics():
    return Statistics(FEATURES, make_factors(FEATURES), K)


def test_statistics_are_those_of_the_dataset():
    statistics = make_statistics()
    statistics.fill(STATS)
    # Discrete numbers and the timestep are never scaled; a constant is only shifted.
    assert statistics.s_mean.tolist() == [0, 0, 1, -20, 5]
    assert statistics.s_std.tolist() == [1, 1, 0.5, 10, 1]
    assert (statistics.rtg_mean.tolist(), statistics.rtg_std.tolist()) == ([4, 0], [8, 1])
    assert statistics.horizon == 25
    assert statistics.fps.item() == pytest.approx(5)


def test_normalising_and_back_is_the_identity():
    statistics = make_statistics()
    window = read(make_batch())
    unscaled = statistics.normalise(window)
    assert all(torch.equal(unscaled.values[name], value) for name, value in window.values.items())
    statistics.fill(STATS)
    normalised = statistics.normalise(window)
    slow = (window.values["s"][1, 2, 3].item() + 20) / 10
    assert normalised.values["s"][1, 2, 3].item() == pytest.approx(slow)
    for name, factor in make_factors(FEATURES).items():
        for output in factor.outputs:
            value = normalised.values[name][..., output.numbers]
            _, back, scale = statistics.denormalise(name, output, value)
            assert scale is None
            torch.testing.assert_close(back[..., 0, :], window.values[name][..., output.numbers])
            if output.discrete:
                assert torch.equal(value, window.values[name][..., output.numbers])


def test_a_gaussians_scale_is_in_the_datasets_units():
    statistics = make_statistics()
    statistics.fill(STATS)
    output = make_factors(FEATURES, gaussians=1)["s"].outputs[-1]
    assert output.size == 6
    prediction = torch.tensor([0.0, 1.0, 2.0, 0.0, torch.tensor(3.0).log(), 0.0])
    weight, mean, scale = statistics.denormalise("s", output, prediction)
    assert weight.tolist() == [1]
    torch.testing.assert_close(mean, torch.tensor([[1.0, -10.0, 7.0]]))
    torch.testing.assert_close(scale, torch.tensor([[0.5, 30.0, 1.0]]))


def test_missing_statistics_are_named():
    with pytest.raises(ValueError, match=r"lack 'action'"):
        make_statistics().fill({key: value for key, value in STATS.items() if key != "action"})


def test_a_dataset_of_single_frames_has_no_frame_rate_to_read():
    statistics = make_statistics()
    statistics.fill(STATS | {"frame_index": {"max": [0]}, "timestamp": {"max": [0.0]}})
    assert (statistics.horizon.item(), statistics.fps.item()) == (1, 1)
