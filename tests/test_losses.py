"""The loss against a loop over tokens."""

import itertools
import math

import pytest
import torch

from lerobot_unimask.data.factors import Feature, make_factors
from lerobot_unimask.data.window import Window
from lerobot_unimask.networks.layers import by_component
from lerobot_unimask.objective import masked_losses, output_loss

B, K = 5, 4
FEATURES = {
    "s": [Feature("observation.state", 2, [5, 3]), Feature("observation.environment_state", 3)],
    "a": [Feature("action", 2)],
}
FACTORS = make_factors(FEATURES)


@pytest.fixture
def question():
    return make_question(FACTORS)


def make_question(factors):
    """(predictions, window, asked)"""
    generator = torch.Generator().manual_seed(0)
    cells = torch.stack([torch.randint(0, n, (B, K), generator=generator) for n in (5, 3)], dim=-1)
    values = {
        "s": torch.cat([cells.float(), torch.randn(B, K, 3, generator=generator)], dim=-1),
        "a": torch.randn(B, K, 2, generator=generator),
    }
    predictions = {
        name: [torch.randn(B, K, o.size, generator=generator).requires_grad_() for o in factor.outputs]
        for name, factor in factors.items()
    }
    asked = {name: torch.rand(B, K, generator=generator) < 0.4 for name in FACTORS}
    return predictions, Window(values, torch.ones(B, K, dtype=torch.bool)), asked


def slow_losses(predictions, window, asked, factors):
    losses = {}
    for name, factor in factors.items():
        losses[name], count = 0.0, int(asked[name].sum())
        for b in range(B):
            for k in range(K):
                if not asked[name][b, k]:
                    continue
                value = window.values[name][b, k].tolist()
                for prediction, output in zip(predictions[name], factor.outputs, strict=True):
                    numbers = prediction[b, k].tolist()
                    target = [value[number] for number in output.numbers]
                    if output.discrete:
                        combinations = list(itertools.product(*map(range, output.categories)))
                        cost = math.log(sum(math.exp(n) for n in numbers)) - numbers[combinations.index(tuple(target))]
                    elif output.gaussians:
                        n, d = output.gaussians, len(target)
                        logits = numbers[:n] if n > 1 else [0.0]
                        means, logarithms = (numbers[len(numbers) - k * n * d :][: n * d] for k in (2, 1))
                        density = 0.0
                        for i in range(n):
                            part = math.exp(logits[i]) / sum(map(math.exp, logits))
                            for v, m, s in zip(target, means[i * d :][:d], logarithms[i * d :][:d], strict=True):
                                part *= math.exp(-(((v - m) / math.exp(s)) ** 2) / 2)
                                part /= math.sqrt(2 * math.pi) * math.exp(s)
                            density += part
                        cost = -math.log(density) / d
                    else:
                        cost = sum((n - v) ** 2 for n, v in zip(numbers, target, strict=True)) / len(target)
                    losses[name] += cost / count
    return losses


@pytest.mark.parametrize("how", [{}, {"gaussians": 1}, {"joint": True}, {"joint": True, "gaussians": 3}])
def test_the_loss_is_that_of_a_loop_over_tokens(how):
    factors = make_factors(FEATURES, **how)
    question = make_question(factors)
    fast = masked_losses(*question, factors)
    for name, loss in slow_losses(*question, factors).items():
        assert fast[name].item() == pytest.approx(loss, rel=1e-5)
        assert loss > 0


def test_a_joint_predictions_marginals_cost_what_tables_say():
    """Of logits over 5 x 3 combinations of cells; beside the paper each cell counts by itself."""
    factors = make_factors(FEATURES, joint=True)
    (predictions, window, asked) = make_question(factors)
    together = masked_losses(predictions, window, asked, factors)["s"]
    apart = masked_losses(predictions, window, asked, factors, apart=True)["s"]
    table = predictions["s"][0].detach().softmax(-1).view(B, K, 5, 3)
    agent, key = window.values["s"][..., :2].long().unbind(-1)
    joint, of_agent, of_key = (torch.zeros(B, K) for _ in range(3))
    for b, k in itertools.product(range(B), range(K)):
        joint[b, k] = table[b, k, agent[b, k], key[b, k]]
        of_agent[b, k], of_key[b, k] = table[b, k, agent[b, k]].sum(), table[b, k, :, key[b, k]].sum()
    difference = (joint.log() - of_agent.log() - of_key.log())[asked["s"]].mean()
    assert (apart - together).item() == pytest.approx(difference.item(), rel=1e-4)
    for part, size in zip(by_component(predictions, factors)["s"], (5, 3, 3), strict=True):
        assert part.shape == (B, K, size)


CHAIN = make_factors({"s": [Feature("observation.state", 3, [40, 3, 20])]}, joint=True)["s"].outputs[0]


def test_a_chain_is_the_product_of_each_number_given_those_before_it():
    """Its table and its loss against a loop over the chain."""
    generator = torch.Generator().manual_seed(0)
    prediction = 3 * torch.randn(2, 1, CHAIN.size, generator=generator)
    table = CHAIN.table(prediction).view(2, 40, 3, 20)
    torch.testing.assert_close(table.exp().sum((1, 2, 3)), torch.ones(2))
    for combination in ((0, 0, 0), (39, 2, 19), (7, 1, 12)):
        for b in range(2):
            log, told, start = 0.0, torch.zeros(16), 0
            for value, count in zip(combination, CHAIN.categories, strict=True):
                link = prediction[b, 0, start : start + 17 * count].view(count, 17)
                logits = [(link[c, 0] + (link[c, 1:] / 2) @ (told / 2)).item() for c in range(count)]
                log += logits[value] - math.log(sum(map(math.exp, logits)))
                told, start = told + link[value, 1:], start + 17 * count
            assert table[b, *combination].item() == pytest.approx(log, rel=1e-4)
        value = torch.tensor(combination).float().expand(2, 1, 3)
        torch.testing.assert_close(output_loss(prediction, value, CHAIN)[:, 0], -table[:, *combination])


def test_a_chain_learns_numbers_that_belong_together():
    """Each of the 40 with one of the 20 and with one of the 3: separately they cost three times as much."""
    first = torch.arange(40).float()
    value = torch.stack([first, first % 3, (7 * first) % 20], dim=-1).unsqueeze(1)  # (40, 1, 3)
    prediction = torch.nn.Parameter(0.1 * torch.randn(CHAIN.size, generator=torch.Generator().manual_seed(0)))
    optimizer = torch.optim.Adam([prediction], lr=0.1)
    for _ in range(200):
        loss = output_loss(prediction.expand(40, 1, -1), value, CHAIN).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() == pytest.approx(math.log(40), abs=0.05)
    assert CHAIN.table(prediction.detach()).softmax(-1)[CHAIN.combination(value[:, 0])].sum() > 0.95


def test_a_gaussians_scale_is_bounded():
    output = make_factors(FEATURES, gaussians=1)["a"].outputs[0]
    value = torch.tensor([[[1.0, -1.0]]])
    for log_scale in (-1e6, 1e6):
        prediction = torch.tensor([[[1.0, -1.0, log_scale, log_scale]]], requires_grad=True)
        loss = output_loss(prediction, value, output).sum()
        loss.backward()
        assert loss.isfinite()
        assert prediction.grad.isfinite().all()


def test_a_gaussians_gradient_is_that_of_its_likelihood_times_its_scale():
    output = make_factors(FEATURES, gaussians=1)["a"].outputs[0]
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(B, K, 2, generator=generator)
    mean, log_scale = (torch.randn(B, K, 2, generator=generator).requires_grad_() for _ in range(2))
    output_loss(torch.cat([mean, log_scale], dim=-1), value, output).sum().backward()
    density = torch.distributions.Normal(mean, log_scale.exp()).log_prob(value).mean(-1)
    for numbers, gradient in zip(
        (mean, log_scale), torch.autograd.grad(-density.sum(), (mean, log_scale)), strict=True
    ):
        torch.testing.assert_close(numbers.grad, gradient * log_scale.detach().exp())


def test_a_mixtures_gradient_is_that_of_its_likelihood_times_scales_and_of_its_weights_as_it_is():
    output = make_factors(FEATURES, gaussians=3)["a"].outputs[0]
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(B, K, 2, generator=generator)
    logits = torch.randn(B, K, 3, generator=generator).requires_grad_()
    means, scales = (torch.randn(B, K, 3, 2, generator=generator).requires_grad_() for _ in range(2))
    output_loss(output.pack(logits, means, scales), value, output).sum().backward()
    normals = torch.distributions.Independent(torch.distributions.Normal(means, scales.exp()), 1)
    mixture = torch.distributions.MixtureSameFamily(torch.distributions.Categorical(logits=logits), normals)
    expected = torch.autograd.grad(-mixture.log_prob(value).sum() / 2, (logits, means, scales))
    torch.testing.assert_close(logits.grad, expected[0])
    for parameter, gradient in zip((means, scales), expected[1:], strict=True):
        torch.testing.assert_close(parameter.grad, gradient * scales.detach().exp())


def test_a_perfect_prediction_costs_nothing():
    value = torch.tensor([[[2.0, 1.0, 0.5, -1.0, 3.0]]])
    agent, _, numbers = FACTORS["s"].outputs
    certain = torch.full((1, 1, 5), -100.0)
    certain[..., 2] = 100.0
    assert output_loss(certain, value, agent).item() == 0
    assert output_loss(value[..., 2:], value, numbers).item() == 0
    assert output_loss(torch.zeros(1, 1, 5), value, agent).item() == pytest.approx(math.log(5))


def test_what_is_not_asked_does_not_matter_not_even_a_nan(question):
    predictions, window, asked = question
    loss = sum(masked_losses(predictions, window, asked, FACTORS).values())
    outputs = [output for name in FACTORS for output in predictions[name]]
    gradients = torch.autograd.grad(loss, outputs)
    for wrong in (float("nan"), float("inf"), -3.0, 1e9):
        values = {name: torch.where(asked[name].unsqueeze(-1), value, wrong) for name, value in window.values.items()}
        other = sum(masked_losses(predictions, Window(values, window.valid), asked, FACTORS).values())
        assert torch.equal(other, loss)
        for gradient, expected in zip(torch.autograd.grad(other, outputs), gradients, strict=True):
            assert torch.equal(gradient, expected)
    for name in FACTORS:
        for output in predictions[name]:
            gradient = gradients[[output is o for o in outputs].index(True)]
            assert torch.equal(gradient.abs().sum(-1) > 0, asked[name])


def test_a_factor_that_is_not_asked_costs_zero_and_can_be_differentiated(question):
    predictions, window, asked = question
    losses = masked_losses(predictions, window, {**asked, "a": torch.zeros(B, K, dtype=torch.bool)}, FACTORS)
    assert losses["a"].item() == 0
    losses["a"].backward()
    assert predictions["a"][0].grad.abs().sum() == 0
    assert losses["s"] > 0
