"""The measurements of a DoorKey policy, against the expert's own rollouts and a network that is exactly right."""

import json

import numpy as np
import pytest
import torch
from policies import CORNER, doorkey_policy

from dataset_builders.doorkey import FEATURES
from lerobot_unimask import cli
from lerobot_unimask.envs.doorkey.episodes import rollout
from lerobot_unimask.envs.doorkey.optimum import Optimum
from lerobot_unimask.envs.doorkey.rules import HORIZON, START_PAIRS
from lerobot_unimask.paper import questions


@pytest.fixture(scope="module")
def exact():
    """A policy that answers with the exact posterior."""
    policy = doorkey_policy()
    optimum = Optimum("paper")

    def predict(window, mask, cache=None):
        return {name: [part.float() for part in parts] for name, parts in optimum.predict(window, mask).items()}

    policy.predict = predict
    return policy


@pytest.fixture(scope="module")
def outcomes():
    return questions.expert_outcomes()


@pytest.fixture(scope="module")
def imitation(exact):
    return questions.rollout(exact, START_PAIRS.repeat(40, axis=0), questions.IMITATION, {}, seed=0)


def test_the_experts_outcomes_are_those_of_its_rollouts(outcomes):
    assert np.allclose(outcomes.final.sum(axis=(1, 2)), 1)
    assert np.allclose(outcomes.returns.sum(axis=1), 1)
    N = 40_000
    played = rollout(N, np.random.default_rng(0))
    final = np.zeros((16, 16))
    np.add.at(final, (played.agent[:, HORIZON - 1], played.key[:, HORIZON - 1]), 1 / N)
    assert np.abs(outcomes.final.mean(axis=0) - final).max() < 0.01
    returns = np.bincount(played.reward.sum(axis=1) + HORIZON, minlength=21) / N
    assert np.abs(outcomes.returns.mean(axis=0) - returns).max() < 0.01
    visited = (played.agent[:, :HORIZON] == questions.CORNER).any(axis=1).mean()
    assert abs(outcomes.visits.mean() - visited) < 0.01
    assert (outcomes.visits[(START_PAIRS[:, 0] == questions.CORNER)] == 1).all()


def test_the_experts_known_numbers(outcomes):
    away = (START_PAIRS != questions.CORNER).all(axis=1)
    assert outcomes.visits[away].mean() == pytest.approx(0.298, abs=0.001)
    assert (outcomes.returns.mean(axis=0) * np.arange(-10, 11)).sum() == pytest.approx(3.04, abs=0.01)


def test_whoever_knows_the_posterior_reaches_every_goal(exact, outcomes, imitation):
    """The rules leave nothing to chance, so actions from the exact posterior lead where they are asked to."""
    result = questions.goals(exact, outcomes, imitation, each=1, seed=1)
    assert result["reached"] == 1
    assert result["reached_by_imitation"] == pytest.approx(result["reached_by_the_expert"], rel=0.15)
    assert questions.RARE <= result["reached_by_the_expert"] <= questions.COMMON
    assert result["rollouts"] == result["starts_and_goals"] > 200


def test_whoever_knows_the_posterior_returns_what_is_asked(exact, outcomes):
    result = questions.returns(exact, outcomes, each=1, seed=1)
    assert [row["asked"] for row in result["returns"]] == list(range(7))
    assert result["largest_deviation"] == 0
    assert all(row["exactly"] == 1 for row in result["returns"])


def test_imitation_by_the_posterior_is_the_expert(imitation, outcomes):
    mean = (outcomes.returns * np.arange(-10, 11)).sum(axis=1).mean()
    assert imitation.returns.mean() == pytest.approx(
        mean, abs=5 * imitation.returns.std() / len(imitation.returns) ** 0.5
    )


def test_histories_that_the_check_accepts_are_possible(exact):
    drawn = exact.sample(
        None,
        questions.BACKWARDS_QUESTION,
        given={"s[-1]": [15, 15]},
        samples=100,
        order="backward",
        check=questions.DynamicsCheck(agree=True),
    )
    states, actions = drawn.values["s"].long().numpy(), drawn.values["a"][:, :-1, 0].long().numpy()
    assert questions.possible_steps(states, actions).all()
    assert drawn.rejected == 0  # the posterior draws agent and key together, given all that is shown
    assert drawn.restarted == 0  # looking at the whole episode leaves no dead ends


def test_orders_agree_where_the_network_is_exact(exact):
    result = questions.differences_of_orders(exact, questions.ACTIONS_QUESTION, None, samples=600, seed=0)
    assert result.keys() == {"backward", "random", "forward again"}
    assert max(result.values()) < 5 * 0.5 * (2 / 600) ** 0.5


def test_every_measurement_is_in_the_record(doorkey_root, tmp_path, monkeypatch, capsys):
    """Of a model that has learnt nothing; its samples would not pass a real check."""
    features = {**FEATURES, f"observation.{questions.PROPERTY}": CORNER}
    policy = doorkey_policy(features, properties=[f"observation.{questions.PROPERTY}"])
    policy.save_pretrained(tmp_path / "policy")
    monkeypatch.setattr(
        questions, "DynamicsCheck", lambda **_: lambda values, decided: torch.ones(len(values["s"]), dtype=torch.bool)
    )
    output = tmp_path / "results" / "questions.json"
    flags = [f"--policy.path={tmp_path / 'policy'}", f"--dataset.root={doorkey_root}", "--each=1", "--samples=30"]
    cli.main(["paper", "questions", *flags, f"--output={output}"])
    said, record = capsys.readouterr().out, json.loads(output.read_text())
    assert record["command"].startswith("unimask paper questions --policy.path=")
    assert record.keys() >= {"goals", "returns", "visits", "backward", "orders", "consistency", "versions", "training"}
    assert record["consistency"]["masks"] == 30
    assert record["consistency"]["shown_values_changed"] == 0
    assert record["consistency"]["largest_deviation_of_a_sum_from_1"] < 1e-5
    assert record["consistency"]["largest_difference_of_a_token_alone_and_among_others"] < 1e-5
    assert record["backward"]["unchecked"]["impossible_steps"] > 0  # it knows nothing of the rules
    assert record["visits"]["starts"] == 42
    assert len(record["returns"]["returns"]) == 7
    for words in ("goals:", "return 6 asked", "the corner:", "backward samples, dynamics", "30 random masks"):
        assert words in said


def test_other_policies_are_refused(tiny_policy, continuous_batch):
    with pytest.raises(ValueError, match="whole DoorKey episodes"):
        questions.ask_everything(tiny_policy("continuous"), continuous_batch)
    with pytest.raises(ValueError, match="context_length is 5"):
        questions.ask_everything(doorkey_policy(context_length=5), continuous_batch)
