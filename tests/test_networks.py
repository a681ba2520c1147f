"""What every network must keep: hidden values change nothing, shown ones do, windows do not see each other."""

import math

import pytest
import torch
from torch import nn

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import Feature, make_factors
from lerobot_unimask.data.window import Window
from lerobot_unimask.networks.feedforward import FeedForward
from lerobot_unimask.networks.layers import Block, Cache, Dropout, NumberEncoding, course
from lerobot_unimask.networks.transformer import Transformer
from lerobot_unimask.objective import masked_losses

B, K = 3, 5
LAYOUTS = ("stacked", "separate", "stacked, plain inputs", "feedforward")  # of the transformer, and the perceptron
KINDS = {
    "discrete": {
        "s": [Feature("observation.state", 2, [7, 4])],
        "a": [Feature("action", 1, [3])],
        "rtg": [Feature("observation.return_to_go", 1)],
    },
    "continuous": {"s": [Feature("observation.state", 3)], "a": [Feature("action", 2)]},
    "mixed": {
        "s": [Feature("observation.state", 2, [7, 4]), Feature("observation.environment_state", 2)],
        "a": [Feature("action", 2)],
        "rtg": [Feature("observation.return_to_go", 1)],
        "corner": [Feature("observation.visits_corner", 1, [2])],
    },
}


def make_network(kind, layout, dropout=0.0):
    factors = make_factors(KINDS[kind], joint=kind == "mixed")
    torch.manual_seed(0)
    sizes = {"context_length": K, "width": 16, "depth": 2, "heads": 2, "feedforward_width": 16, "dropout": dropout}
    if "stacked" in layout:
        sizes |= {"token_layout": "stacked", "attention": "bidirectional"}
    fine = "plain" not in layout
    config = UniMASKConfig(ask_properties=False, state_residuals=fine, fine_inputs=fine, **sizes)
    return (FeedForward if layout == "feedforward" else Transformer)(config, factors).eval(), factors


def random_window(factors, seed=0):
    generator = torch.Generator().manual_seed(seed)
    values = {}
    for name, factor in factors.items():
        parts = [
            torch.randint(0, c.categories, (B, K, 1), generator=generator).float()
            if c.discrete
            else torch.randn(B, K, c.dims.stop - c.dims.start, generator=generator)
            for c in factor.components
        ]
        values[name] = torch.cat(parts, dim=-1)
    return Window(values, torch.ones(B, K, dtype=torch.bool))


def random_shown(factors, seed=1):
    """As the language has it: of a property, at most the first step is shown."""
    generator = torch.Generator().manual_seed(seed)
    shown = {name: torch.rand(B, K, generator=generator) < 0.5 for name in factors}
    for name in factors:
        if name not in ("s", "a"):
            shown[name][:, 1:] = False
            shown[name][:, 0] = torch.tensor([True, False, True])
    return shown


def flat(predictions):
    return torch.cat([output.flatten(1) for outputs in predictions.values() for output in outputs], dim=1)  # (B, ...)


@pytest.fixture(params=list(KINDS))
def kind(request):
    return request.param


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return request.param


def test_predictions_have_the_outputs_sizes(kind, layout):
    network, factors = make_network(kind, layout)
    predictions = network(random_window(factors), random_shown(factors))
    assert list(predictions) == ["s", "a"]
    for name, outputs in predictions.items():
        assert [tuple(o.shape) for o in outputs] == [(B, K, o.size) for o in factors[name].outputs]


def test_a_hidden_value_changes_nothing_not_even_a_nan(kind, layout):
    network, factors = make_network(kind, layout)
    window, shown = random_window(factors), random_shown(factors)
    expected = flat(network(window, shown))
    for wrong in (float("nan"), float("inf"), -1e9, 1.0):
        values = {name: torch.where(shown[name].unsqueeze(-1), value, wrong) for name, value in window.values.items()}
        assert torch.equal(flat(network(Window(values, window.valid), shown)), expected)


def test_a_nan_in_a_hidden_place_spoils_no_gradient(kind, layout):
    network, factors = make_network(kind, layout)
    window, shown = random_window(factors), random_shown(factors)
    values = {name: torch.where(shown[name].unsqueeze(-1), value, torch.nan) for name, value in window.values.items()}
    flat(network(Window(values, window.valid), shown)).square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_every_shown_value_changes_every_prediction_of_its_window_and_no_others(kind, layout):
    network, factors = make_network(kind, layout)
    window, shown = random_window(factors), random_shown(factors)
    before = network(window, shown)
    for name, tokens in shown.items():
        for b, k in tokens.nonzero().tolist():
            for component in factors[name].components:
                values = {other: value.clone() for other, value in window.values.items()}
                cell = values[name][b, k, component.dims]
                cell.copy_((cell + 1) % component.categories if component.discrete else cell + 1)
                after = network(Window(values, window.valid), shown)
                for asked in ("s", "a"):
                    for old, new in zip(before[asked], after[asked], strict=True):
                        changed = (old != new).any(-1)  # (B, K): attention reaches every step, both ways
                        assert changed[b].all()
                        assert not changed[[i for i in range(B) if i != b]].any()


def test_hidden_is_not_zero(kind, layout):
    network, factors = make_network(kind, layout)
    window = random_window(factors)
    zero = Window({name: torch.zeros_like(value) for name, value in window.values.items()}, window.valid)
    everything = {name: torch.ones(B, K, dtype=torch.bool) for name in factors}
    for name in factors:
        less = everything | {name: torch.zeros(B, K, dtype=torch.bool)}
        assert not torch.equal(flat(network(zero, everything)), flat(network(zero, less)))


def test_a_windows_answer_is_its_own(kind, layout):
    network, factors = make_network(kind, layout)
    window, shown = random_window(factors), random_shown(factors)
    together = flat(network(window, shown))
    for b in range(B):
        alone = Window({name: value[b : b + 1] for name, value in window.values.items()}, window.valid[b : b + 1])
        output = flat(network(alone, {name: tokens[b : b + 1] for name, tokens in shown.items()}))
        torch.testing.assert_close(output[0], together[b], rtol=1e-5, atol=1e-6)


def test_steps_are_told_apart(kind, layout):
    network, factors = make_network(kind, layout)
    window = random_window(factors)
    nothing = {name: torch.zeros(B, K, dtype=torch.bool) for name in factors}
    for outputs in network(window, nothing).values():
        for output in outputs:
            assert all(not torch.equal(output[0, i], output[0, j]) for i in range(K) for j in range(i))


def test_dropout_is_for_training_alone(kind, layout):
    network, factors = make_network(kind, layout, dropout=0.5)
    window, shown = random_window(factors), random_shown(factors)
    assert torch.equal(flat(network(window, shown)), flat(network(window, shown)))
    network.train()
    assert not torch.equal(flat(network(window, shown)), flat(network(window, shown)))


def test_number_encodings_are_those_of_a_loop_over_tokens():
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(20, 6, 2, generator=generator)
    shown = torch.rand(20, 6, generator=generator) < 0.6
    encoding = NumberEncoding(2, fine=True)
    encoded = encoding(torch.where(shown.unsqueeze(-1), value, 0.0), shown)
    assert encoded.shape == (20, 6, encoding.size)
    for b in range(20):
        previous = None
        for k in range(6):
            if not shown[b, k]:
                continue
            numbers = value[b, k].tolist()
            angles = [number * math.pi / 2 * 2**octave for number in numbers for octave in range(4)]
            moved, exists = [0.0] * 8, 0.0
            if previous is not None:
                speed = ((value[b, k] - value[b, previous]) / (k - previous)).tolist()
                moved, exists = [math.tanh(s * 4**scale) for s in speed for scale in range(4)], 1.0
            expected = [*numbers, *map(math.sin, angles), *map(math.cos, angles), *moved, exists]
            torch.testing.assert_close(encoded[b, k], torch.tensor(expected), rtol=1e-4, atol=1e-5)
            previous = k
    plain = NumberEncoding(2, fine=False)
    assert plain.size == 2
    assert torch.equal(plain(value, shown), value)


def slow_course(value, shown, k, causal):
    """Of one step of one window, by cases."""
    steps = shown.nonzero().flatten().tolist()
    before, after = [i for i in steps if i < k], [] if causal else [i for i in steps if i > k]
    if before and after:
        i, j = before[-1], after[0]
        return value[i] + (value[j] - value[i]) * (k - i) / (j - i)
    near = before[::-1] or after
    if len(near) > 1:
        i, j = near[:2]
        return value[i] + (value[i] - value[j]) / (i - j) * (k - i)
    return value[near[0]] if near else torch.zeros(2)


def test_the_course_of_states_is_that_of_a_loop_over_tokens():
    generator = torch.Generator().manual_seed(0)
    shown = torch.rand(300, K, generator=generator) < torch.rand(300, 1, generator=generator)
    value = torch.where(shown.unsqueeze(-1), torch.randn(300, K, 2, generator=generator), 0.0)
    causal = torch.rand(300, generator=generator) < 0.5
    expected = [[slow_course(value[b], shown[b], k, causal[b]) for k in range(K)] for b in range(300)]
    expected = torch.stack([torch.stack(row) for row in expected])
    torch.testing.assert_close(course(value, shown, causal), expected)
    torch.testing.assert_close(course(value, shown, True)[causal], expected[causal])
    torch.testing.assert_close(course(value, shown, False)[~causal], expected[~causal])


def test_states_that_go_straight_on_are_predicted_before_anything_is_learnt():
    """With an output of 0 the prediction is the course itself."""
    network, factors = make_network("continuous", "separate")
    for parameter in network.heads["s"].parameters():
        torch.nn.init.zeros_(parameter)
    values = random_window(factors).values | {"s": 3 + torch.arange(K).view(1, K, 1) * torch.randn(B, 1, 3)}
    shown = {name: (torch.arange(K) < 2).expand(B, K) for name in factors}
    predicted = network(Window(values, torch.ones(B, K).bool()), shown)["s"][0]
    torch.testing.assert_close(predicted[:, 2:], values["s"][:, 2:])


@pytest.mark.parametrize(
    ("network", "settings"),
    [
        (Transformer, {"token_layout": "stacked", "attention": "bidirectional", "heads": 2, "depth": 1}),
        (FeedForward, {"depth": 2}),
    ],
)
def test_a_network_learns_what_a_mask_hides(network, settings):
    """Forward dynamics of a ring, s[k + 1] = (s[k] + 1) mod 7, from one shown state: model and loss together."""
    torch.manual_seed(0)
    factors = make_factors({"s": [Feature("observation.state", 1, [7])], "a": [Feature("action", 1)]})
    plain = {"fine_inputs": False, "state_residuals": False}
    sizes = {"context_length": K, "width": 32, "feedforward_width": 32, "dropout": 0.0}
    network = network(UniMASKConfig(**plain, **sizes, **settings), factors)
    starts = torch.arange(7)
    states = ((starts[:, None] + torch.arange(K)) % 7).float().unsqueeze(-1)  # (7, K, 1)
    window = Window({"s": states, "a": torch.zeros(7, K, 1)}, torch.ones(7, K, dtype=torch.bool))
    first = (torch.arange(K) == 0).expand(7, K)
    shown = {"s": first, "a": torch.zeros_like(first)}
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(250):
        loss = masked_losses(network(window, shown), window, {"s": ~first, "a": shown["a"]}, factors)["s"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.05  # chance is ln 7 = 1.95
    assert torch.equal(network(window, shown)["s"][0].argmax(-1)[:, 1:], states[:, 1:, 0].long())


def test_a_mixture_learns_a_fork_where_one_gaussian_points_between():
    """From the start the way goes to (1, 1) or (-1, -1), as often: the loss against the entropy."""
    scale, count = 0.1, 128
    generator = torch.Generator().manual_seed(0)
    side = torch.randint(0, 2, (count, 1, 1), generator=generator) * 2.0 - 1
    states = side * torch.tensor([0.0, 1.0]).view(1, 2, 1) + scale * torch.randn(count, 2, 2, generator=generator)
    window = Window({"s": states, "a": torch.zeros(count, 2, 1)}, torch.ones(count, 2, dtype=torch.bool))
    first = (torch.arange(2) == 0).expand(count, 2)
    shown, asked = {"s": first, "a": first & False}, {"s": ~first, "a": first & False}
    lowest = math.log(2) / 2 + math.log(scale) + 0.5 * math.log(2 * math.pi * math.e)  # in nats for each number
    losses = {}
    for gaussians in (1, 3):
        torch.manual_seed(0)
        factors = make_factors(
            {"s": [Feature("observation.state", 2)], "a": [Feature("action", 1)]}, gaussians=gaussians
        )
        sizes = {"context_length": 2, "width": 8, "depth": 1, "feedforward_width": 32, "dropout": 0.0}
        network = FeedForward(UniMASKConfig(fine_inputs=False, **sizes), factors)
        optimiser = torch.optim.Adam(network.parameters(), lr=2e-2)
        for _ in range(200):
            loss = masked_losses(network(window, shown), window, asked, factors)["s"]
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        losses[gaussians] = loss.item()
    assert losses[3] < lowest + 0.1
    assert losses[1] > lowest + 1


# --- Causal attention ------------------------------------------------------------------------------------------------


def in_order(factors):
    """The tokens in the order in which a causal network reads them."""
    return [(name, 0) for name in factors if name not in ("s", "a")] + [(n, k) for k in range(K) for n in ("s", "a")]


def test_a_causal_prediction_sees_the_tokens_before_it_and_no_others(kind):
    network, factors = make_network(kind, "separate")
    window, shown = random_window(factors), random_shown(factors)
    shown = {name: tokens.index_fill(1, torch.tensor(0), True) for name, tokens in shown.items()}
    order = in_order(factors)
    reference = network(window, shown, True)
    for place, (changed, step) in enumerate(order):
        seen = shown[changed][:, step]
        values = {name: value.clone() for name, value in window.values.items()}
        # Another category, or another number
        values[changed][:, step] = torch.where(values[changed][:, step] == 0, 1.0, 0.0)
        moved = network(Window(values, window.valid), shown, True)
        for later, (name, at) in enumerate(order):
            if name not in moved:
                continue
            same = torch.stack(
                [(x[:, at] == y[:, at]).all(1) for x, y in zip(moved[name], reference[name], strict=True)]
            ).all(0)
            if later <= place:
                assert same.all(), (changed, step, name, at)
            else:
                assert torch.equal(same, ~seen), (changed, step, name, at)


def test_a_causal_prediction_does_not_depend_on_whether_its_own_token_is_shown(kind):
    network, factors = make_network(kind, "separate")
    window, shown = random_window(factors), random_shown(factors)
    other = {name: tokens.clone() for name, tokens in shown.items()}
    other["a"][:, -1] = ~other["a"][:, -1]
    for x, y in zip(network(window, shown, True)["a"], network(window, other, True)["a"], strict=True):
        assert torch.equal(x, y)


def test_each_window_is_read_in_its_own_direction(kind):
    network, factors = make_network(kind, "separate")
    window, shown = random_window(factors), random_shown(factors)
    causal = torch.tensor([True, False, True])
    mixed, forwards, both = (flat(network(window, shown, direction)) for direction in (causal, True, False))
    torch.testing.assert_close(mixed, torch.where(causal[:, None], forwards, both))


def test_a_rollouts_cache_changes_no_prediction_and_computes_each_token_once(kind):
    network, factors = make_network(kind, "separate")
    window = random_window(factors)
    counted = []
    network.blocks[0].register_forward_hook(lambda _, inputs, __: counted.append(inputs[0].shape[1]))
    cache = Cache()
    properties = len(factors) - 2
    for step in range(K):
        shown = {name: torch.zeros(B, K, dtype=torch.bool) for name in factors}
        for name in factors:
            shown[name][:, : {"s": step + 1, "a": step}.get(name, 1)] = True
        asked = {name: torch.zeros(B, K, dtype=torch.bool) for name in factors}
        asked["a"][:, step] = True
        with torch.no_grad():
            kept, anew = network(window, shown, True, cache, asked)["a"], network(window, shown, True)["a"]
        for x, y in zip(kept, anew, strict=True):
            torch.testing.assert_close(x[:, step], y[:, step])
    assert counted[::2] == [properties + 1] + [2] * (K - 1)
    # Another history, another question or other environments: what was kept is not used.
    shown["a"][0, 0] = False
    with torch.no_grad():
        kept, anew = network(window, shown, True, cache, asked)["a"], network(window, shown, True)["a"]
    for x, y in zip(kept, anew, strict=True):
        torch.testing.assert_close(x[:, K - 1], y[:, K - 1])
    assert counted[-2] == properties + 2 * K - 1


@pytest.mark.parametrize("windows", [1, 5])
def test_the_last_token_of_a_block_needs_no_keys_and_values_of_the_others(windows):
    block = Block(UniMASKConfig(width=24, heads=3, feedforward_width=48)).eval()
    x = torch.randn(windows, 7, 24)
    expected = block(x, torch.ones(7, 7, dtype=torch.bool).tril(), None)[0][:, -1:]
    torch.testing.assert_close(block.last(x), expected, rtol=1e-5, atol=1e-6)
    block.query_key_value = nn.Sequential(block.query_key_value, nn.Linear(72, 72))  # as an adapter wraps it
    expected = block(x, None, None)[0][:, -1:]
    torch.testing.assert_close(block.last(x), expected, rtol=1e-5, atol=1e-6)


def test_mixed_precision_answers_in_full_precision(kind):
    network, factors = make_network(kind, "separate")
    window, shown = random_window(factors), random_shown(factors)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = flat(network(window, shown))
    assert mixed.dtype == torch.float32
    torch.testing.assert_close(mixed, flat(network(window, shown)), rtol=0.1, atol=0.05)


@pytest.mark.parametrize("causal", [False, True, torch.tensor([True, False, True])], ids=["both", "causal", "mixed"])
@pytest.mark.parametrize("dropout", [0.0, 0.3])
def test_what_is_asked_alone_is_answered_and_learnt_as_with_all_the_rest(kind, causal, dropout):
    network, factors = make_network(kind, "separate", dropout)
    window, shown = random_window(factors), random_shown(factors)
    asked = {name: ~tokens for name, tokens in shown.items()}
    gradients, answers = [], []
    for some in (None, asked):
        outputs = network(window, shown, causal, asked=some)
        answers.append({name: [o[asked[name]] for o in outputs[name]] for name in ("s", "a")})
        network.zero_grad()
        sum(o.square().sum() for parts in answers[-1].values() for o in parts).backward()
        gradients.append({name: p.grad for name, p in network.named_parameters() if p.grad is not None})
    torch.testing.assert_close(answers[1], answers[0])
    torch.testing.assert_close(gradients[1], gradients[0])


def test_nothing_asked_costs_nothing(kind):
    network, factors = make_network(kind, "separate")
    window, shown = random_window(factors), random_shown(factors)
    nothing = {name: torch.zeros_like(tokens) for name, tokens in shown.items()}
    outputs = flat(network(window, shown, True, asked=nothing))
    outputs.sum().backward()
    assert all(p.grad is None or not p.grad.any() for p in network.parameters())


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_dropout_leaves_out_its_share_and_keeps_the_mean(share):
    torch.manual_seed(0)
    x = torch.ones(1001, 101, requires_grad=True)
    dropped = Dropout(share)(x)
    left_out = dropped == 0
    assert left_out.double().mean().item() == pytest.approx(share, abs=0.01)
    assert torch.allclose(dropped[~left_out], torch.tensor(1 / (1 - share)), rtol=1e-4)
    neighbours = (left_out[:, 1:] & left_out[:, :-1]).double().mean().item()  # draws that share 64 bits are independent
    assert neighbours == pytest.approx(share**2, abs=0.01)
    dropped.sum().backward()
    assert torch.equal(x.grad, dropped.detach())
    assert torch.equal(Dropout(share).eval()(x), x)


def test_attention_with_dropout_is_pytorchs_where_nothing_is_left_out():
    block = Block(UniMASKConfig(width=16, heads=2, feedforward_width=16, dropout=0.0))
    query, key, value = torch.randn(3, 2, 2, 5, 8, generator=torch.Generator().manual_seed(0)).unbind(0)
    attend = torch.ones(5, 5, dtype=torch.bool).tril()
    expected = [block._attend(query, key, value, mask) for mask in (None, attend)]
    block.dropout.p = 1e-9  # too small to leave anything out
    torch.testing.assert_close([block._attend(query, key, value, mask) for mask in (None, attend)], expected)
