"""DoorKey: rules against MiniGrid and slow readings of the text, the environment in LeRobot, datasets."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.datasets import LeRobotDataset
from lerobot.envs import env_to_policy_features, make_env, make_env_config, make_env_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout as lerobot_rollout

from dataset_builders.doorkey import FEATURES, build_doorkey, frames
from dataset_builders.writer import PROVENANCE_PATH
from lerobot_unimask.envs.doorkey.environment import DoorKeyEnv
from lerobot_unimask.envs.doorkey.episodes import rollout
from lerobot_unimask.envs.doorkey.expert import expert_probabilities
from lerobot_unimask.envs.doorkey.rules import (
    DOOR,
    ENV_ID,
    GOAL,
    HORIZON,
    START_CELLS,
    START_PAIRS,
    TASK,
    DynamicsCheck,
    cell_at,
    coordinates,
    distance_to_goal,
    reward,
    step,
)

RIGHT, DOWN, LEFT, UP = range(4)
# From agent (1, 1) and key (2, 1): through the door and down to the goal in six steps, then against the wall.
TO_GOAL = [RIGHT, RIGHT, RIGHT, DOWN, DOWN, DOWN, DOWN, RIGHT, RIGHT, DOWN]


def reachable_states():
    """Every reachable (agent, key, door open) -> (start pair, actions that lead there), breadth first."""
    paths = {(int(agent), int(key), False): ((int(agent), int(key)), []) for agent, key in START_PAIRS}
    queue = list(paths)
    for state in queue:
        for action in range(4):
            following = tuple(entry.item() for entry in step(*state, action))
            if following not in paths:
                start, actions = paths[state]
                paths[following] = (start, [*actions, action])
                queue.append(following)
    return paths


STATES = reachable_states()


def all_starts():
    """Agent, key, door of all equally likely starts, (56,) each."""
    return START_PAIRS[:, 0], START_PAIRS[:, 1], np.zeros(len(START_PAIRS), dtype=bool)


# --- The rules --------------------------------------------------------------------------------------------------------


def test_states_are_those_of_the_text():
    assert START_CELLS.tolist() == [cell_at(x, y) for y in range(1, 5) for x in (1, 2)]
    assert (DOOR, GOAL) == (2, 15)
    assert len(START_PAIRS) == len(np.unique(START_PAIRS, axis=0)) == 8 * 7
    # key on the ground; carried, door shut; carried, door open: left room, door, right room
    assert len(STATES) == 8 * 7 + 8 + (8 + 1 + 4)


def test_rules_equal_minigrid_in_every_reachable_state():
    env = DoorKeyEnv()
    for state, (start, path) in STATES.items():
        for action in range(4):
            observation, _ = env.reset(options=dict(zip(("agent", "key"), start, strict=True)))
            for earlier in path:
                observation, *_ = env.step(earlier)
            assert (*observation["agent_pos"], env.door_open) == state
            observation, gained, _, _, _ = env.step(action)
            agent, key, door_open = step(*state, action)
            assert (*observation["agent_pos"], env.door_open) == (agent, key, door_open), (state, action)
            assert gained == reward(state[0], agent)


def slow_distance(x, y):
    if x > 3:
        return abs(x - 4) + abs(y - 4)
    if x == 3:
        return 4
    return abs(x - 2) + abs(y - 1) + 1 + 4


def test_distance_and_reward_are_those_of_the_text():
    for agent, _, _ in STATES:
        x, y = (int(c) for c in coordinates(agent))
        assert distance_to_goal(agent) == slow_distance(x, y)
    assert reward(DOOR, cell_at(4, 1)) == 1
    assert reward(cell_at(2, 1), cell_at(2, 2)) == -1
    assert reward(GOAL, GOAL) == 0


def slow_expert(state, reading):
    """The text of `environments.md`, cell by cell."""
    agent, key, door_open = state
    x, y = agent % 4 + 1, agent // 4 + 1
    carrying = agent == key
    goal_x, goal_y = (4, 4) if door_open else (3, 1) if carrying else (key % 4 + 1, key // 4 + 1)
    weights = []
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        to_x, to_y = x + dx, y + dy
        inner_wall = to_x == 3 and to_y in (2, 3, 4)
        right_or_bottom = to_x == 5 or to_y == 5
        left_or_top = to_x == 0 or to_y == 0
        locked = (to_x, to_y) == (3, 1) and not carrying
        stays = inner_wall or right_or_bottom
        if reading == "paper":
            stays = stays or left_or_top or locked
        if stays:
            to_x, to_y = x, y
        closer = abs(x - goal_x) + abs(y - goal_y) - abs(to_x - goal_x) - abs(to_y - goal_y)
        weights.append(math.exp(closer))
    return [weight / sum(weights) for weight in weights]


@pytest.mark.parametrize("reading", ["paper", "released"])
def test_expert_is_that_of_the_text(reading):
    for state in STATES:
        np.testing.assert_allclose(
            expert_probabilities(*state, expert=reading), slow_expert(state, reading), rtol=1e-12, err_msg=str(state)
        )


def test_beta_is_the_experts_rationality():
    start = (cell_at(1, 1), cell_at(2, 2), False)
    np.testing.assert_allclose(expert_probabilities(*start, beta=0), 1 / 4)
    np.testing.assert_allclose(expert_probabilities(*start, beta=1000), [1 / 2, 1 / 2, 0, 0])


@pytest.mark.parametrize(("reading", "entropy", "mean_return"), [("paper", 1.126, 3.04), ("released", 1.045, 3.44)])
def test_entropy_and_return_are_the_known_ones(reading, entropy, mean_return):
    """Exactly, by the distribution over states after each step; the figures are `environments.md`'s."""
    chances = dict.fromkeys(zip(*(column.tolist() for column in all_starts()), strict=True), 1 / len(START_PAIRS))
    entropies, gained = [], 0.0
    for _ in range(HORIZON):
        following: dict = {}
        here = 0.0
        for state, chance in chances.items():
            probabilities = expert_probabilities(*state, expert=reading)
            here -= chance * (probabilities * np.log(probabilities)).sum()
            for action, probability in enumerate(probabilities):
                after = tuple(entry.item() for entry in step(*state, action))
                following[after] = following.get(after, 0.0) + chance * probability
                gained += chance * probability * reward(state[0], after[0])
        chances = following
        entropies.append(here)
    assert round(float(np.mean(entropies)), 3) == entropy
    assert round(float(gained), 2) == mean_return


@pytest.mark.parametrize(("wrong", "message"), [({"expert": "best"}, "'best'"), ({"beta": math.inf}, "finite")])
def test_unknown_experts_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        expert_probabilities(0, 1, False, **wrong)


# --- The environment --------------------------------------------------------------------------------------------------


def test_gymnasium_accepts_the_environment():
    check_env(gym.make(ENV_ID).unwrapped, skip_render_check=True)


def test_an_episode_lasts_ten_steps_and_success_stays():
    env = DoorKeyEnv()
    observation, info = env.reset(options={"agent": cell_at(1, 1), "key": cell_at(2, 1)})
    assert not info["is_success"]
    assert observation["return_so_far"] == 0
    total = 0.0
    for number, action in enumerate([*TO_GOAL[:7], UP, UP, UP]):  # leaves the goal again
        observation, gained, terminated, truncated, info = env.step(action)
        total += gained
        assert observation["return_so_far"] == total
        assert not terminated
        assert truncated == (number == HORIZON - 1)
        assert info["is_success"] == (number >= 5)
    assert env.observation_space.contains(observation)
    observation, info = env.reset()
    assert observation["return_so_far"] == 0
    assert not info["is_success"]


def test_the_state_after_the_tenth_action_counts_for_success():
    env = DoorKeyEnv()
    env.reset(options={"agent": cell_at(1, 1), "key": cell_at(2, 1)})
    for action in [UP, UP, UP, UP, *TO_GOAL[:5]]:
        *_, info = env.step(action)
        assert not info["is_success"]
    _, _, _, truncated, info = env.step(DOWN)
    assert truncated
    assert info["is_success"]


def test_resets_follow_the_seed_and_cover_all_starts():
    env = DoorKeyEnv()
    starts = [tuple(env.reset(seed=seed)[0]["agent_pos"].tolist()) for seed in range(600)]
    assert starts == [tuple(env.reset(seed=seed)[0]["agent_pos"].tolist()) for seed in range(600)]
    assert set(starts) == set(map(tuple, START_PAIRS.tolist()))


def test_chosen_starts():
    env = DoorKeyEnv()
    both, _ = env.reset(seed=1, options={"agent": 5, "key": 0, "lerobot_new_rollout": True})
    assert both["agent_pos"].tolist() == [5, 0]
    keys = {env.reset(seed=seed, options={"agent": 5})[0]["agent_pos"][1] for seed in range(100)}
    assert keys == set(START_CELLS.tolist()) - {5}
    agents = {env.reset(seed=seed, options={"key": 0})[0]["agent_pos"][0] for seed in range(100)}
    assert agents == set(START_CELLS.tolist()) - {0}


@pytest.mark.parametrize(
    "options", [{"agent": 4, "key": 4}, {"agent": GOAL}, {"key": DOOR}, {"key": 16}, {"agent": -1}]
)
def test_impossible_starts_are_refused(options):
    with pytest.raises(ValueError, match="left room"):
        DoorKeyEnv().reset(options=options)


@pytest.mark.parametrize(
    "action", [1, np.int64(1), np.array(1), np.array([1]), np.array([1.2], dtype=np.float32), torch.tensor([1])]
)
def test_actions_of_every_kind_are_understood(action):
    env = DoorKeyEnv()
    env.reset(options={"agent": 0, "key": 1})
    observation, *_ = env.step(action)
    assert observation["agent_pos"].tolist() == [4, 1]


@pytest.mark.parametrize("action", [4, -1, np.nan, np.inf, np.array([0.0, 1.0]), None, "up", np.array([[]])])
def test_other_actions_are_refused(action):
    env = DoorKeyEnv()
    env.reset()
    with pytest.raises(ValueError, match="0 to 3"):
        env.step(action)


def test_drawing_needs_no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = DoorKeyEnv(render_mode="rgb_array")
    env.reset(options={"agent": 0, "key": 1})
    before = env.render()
    assert before.dtype == np.uint8
    assert before.shape == (192, 192, 3)
    env.step(RIGHT)
    changed = (env.render() != before).any(axis=-1).reshape(6, 32, 6, 32).any(axis=(1, 3))  # (y, x)
    assert np.argwhere(changed).tolist() == [[1, 1], [1, 2]]  # the agent's cell and the key's
    with pytest.raises(ValueError, match="rgb_array"):
        DoorKeyEnv(render_mode="human")


# --- LeRobot's evaluation ---------------------------------------------------------------------------------------------


class Scripted(torch.nn.Module):
    """A policy that takes these actions, the same in all environments, and keeps what it was shown."""

    def __init__(self, actions, batch):
        super().__init__()
        self.actions, self.batch, self.observations = actions, batch, []

    def reset(self):
        self.observations = []

    def select_action(self, observation):
        self.observations.append(observation)
        return torch.full((self.batch, 1), self.actions[len(self.observations) - 1])


@pytest.fixture
def environments():
    config = make_env_config("doorkey")
    vector = make_env(config, n_envs=3, use_async_envs=True)["doorkey"][0]
    yield config, vector
    vector.close()


def test_lerobot_gets_synchronous_environments(environments):
    config, vector = environments
    assert type(vector) is gym.vector.SyncVectorEnv
    assert vector.metadata["autoreset_mode"] is gym.vector.AutoresetMode.SAME_STEP
    assert vector.metadata["render_fps"] == config.fps == 10
    assert vector.call("_max_episode_steps") == (HORIZON,) * 3
    assert vector.call("task_description") == (TASK,) * 3
    assert vector.call("task") == ("DoorKey-v0",) * 3
    assert {name: feature.shape for name, feature in env_to_policy_features(config).items()} == {
        "action": (1,),
        "observation.state": (2,),
        "observation.return_so_far": (1,),
    }


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_vectors_of_environments_take_actions_with_an_axis(environments, dtype):
    _, vector = environments
    assert vector.action_space.shape == (3, 1)
    vector.reset(options={"agent": 0, "key": 1})
    observation, *_ = vector.step(np.array([[RIGHT], [DOWN], [LEFT]], dtype=dtype))
    assert observation["agent_pos"].tolist() == [[1, 1], [4, 1], [0, 1]]
    assert observation["agent_pos"].dtype == np.int64


def test_lerobots_rollout(environments, monkeypatch):
    config, vector = environments
    for env in vector.envs:  # LeRobot chooses no start cells
        monkeypatch.setattr(env.unwrapped, "_start_cells", lambda options: (0, 1))
    policy = Scripted(TO_GOAL, batch=3)
    identity = PolicyProcessorPipeline(steps=[], to_transition=lambda data: data, to_output=lambda data: data)
    result = lerobot_rollout(
        vector, policy, *make_env_pre_post_processors(config, None), identity, identity, seeds=[1, 2, 3]
    )
    assert result["reward"].tolist() == [[1.0] * 6 + [0.0] * 4] * 3
    assert result["success"].tolist() == [[False] * 5 + [True] * 5] * 3
    assert result["done"].tolist() == [[False] * 9 + [True]] * 3
    shown = [observation["observation.return_so_far"][0].item() for observation in policy.observations]
    assert shown == [0, 1, 2, 3, 4, 5, 6, 6, 6, 6]
    assert policy.observations[2]["observation.state"].tolist() == [[DOOR, DOOR]] * 3


# --- The datasets -----------------------------------------------------------------------------------------------------


def test_rollouts_obey_the_rules():
    episodes = rollout(500, np.random.default_rng(0))
    state = (episodes.agent[:, :-1], episodes.key[:, :-1], episodes.door_open[:, :-1])
    for now, after in zip(
        step(*state, episodes.action), (episodes.agent, episodes.key, episodes.door_open), strict=True
    ):
        np.testing.assert_array_equal(now, after[:, 1:])
    np.testing.assert_array_equal(episodes.reward, reward(episodes.agent[:, :-1], episodes.agent[:, 1:]))
    assert not episodes.door_open[:, 0].any()
    starts = set(zip(episodes.agent[:, 0].tolist(), episodes.key[:, 0].tolist(), strict=True))
    assert starts == set(map(tuple, START_PAIRS.tolist()))


@pytest.mark.parametrize("reading", ["paper", "released"])
def test_rollouts_act_as_the_expert(reading):
    episodes = rollout(40_000, np.random.default_rng(0), expert=reading)
    counts = np.zeros((16, 16, 2, 4))
    state = (episodes.agent[:, :-1], episodes.key[:, :-1], episodes.door_open[:, :-1].astype(int))
    np.add.at(counts, (*state, episodes.action), 1)
    for agent, key, door_open in STATES:
        seen = counts[agent, key, int(door_open)]
        expected = expert_probabilities(agent, key, door_open, expert=reading) * seen.sum()
        # Each count within five standard deviations; 616 counts, fixed seed
        assert (np.abs(seen - expected) < 5 * np.sqrt(expected + 1)).all(), (agent, key, door_open)


def test_a_larger_rollout_begins_with_a_smaller_ones_episodes():
    small, large = (rollout(count, np.random.default_rng(7)) for count in (30, 50))
    rng = np.random.default_rng(7)
    parts = rollout(30, rng), rollout(20, rng)
    for field, few, many in zip(small._fields, small, large, strict=True):
        np.testing.assert_array_equal(few, many[:30], err_msg=field)
        np.testing.assert_array_equal(np.concatenate([getattr(part, field) for part in parts]), many, err_msg=field)


def test_frames_are_the_episodes_steps():
    episodes = rollout(20, np.random.default_rng(0))
    columns = frames(episodes)
    assert columns.keys() == FEATURES.keys()
    for episode in range(20):
        for now in range(HORIZON):
            row = episode * HORIZON + now
            expected_state = [episodes.agent[episode, now], episodes.key[episode, now]]
            assert columns["observation.state"][row].tolist() == expected_state
            assert columns["action"][row] == episodes.action[episode, now]
            assert columns["next.reward"][row] == episodes.reward[episode, now]
            assert columns["observation.return_to_go"][row] == episodes.reward[episode, now:].sum()
            assert columns["observation.success"][row] == (GOAL in episodes.agent[episode])
            assert columns["next.done"][row] == (now == HORIZON - 1)


def test_build_makes_a_dataset_that_lerobot_loads(tmp_path, monkeypatch):
    monkeypatch.setattr("dataset_builders.doorkey.CHUNK", 8)  # so that the build is in several chunks
    root = build_doorkey(tmp_path / "new", episodes=20, seed=3, expert="released")
    dataset = LeRobotDataset("local/doorkey", root=root)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (20, 200, 10)
    assert dataset.meta.features["observation.state"]["categories"] == [16, 16]
    assert dataset.meta.features["action"]["categories"] == [4]
    expected = frames(rollout(20, np.random.default_rng(3), expert="released"))
    stored = dataset.hf_dataset.with_format("numpy")
    for name, column in expected.items():
        np.testing.assert_array_equal(np.asarray(stored[name][:]).reshape(column.shape), column)
        assert stored[name][:].dtype == column.dtype
    assert dataset[0]["task"] == TASK
    record = json.loads((root / PROVENANCE_PATH).read_text())
    assert record | {"package_version": None, "command": None} == {
        "environment": ENV_ID,
        "expert": "released",
        "beta": 1.0,
        "seed": 3,
        "episodes": 20,
        "camera": False,
        "package_version": None,
        "command": None,
    }


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"episodes": 0}, "episodes.* 1"),
        ({"episodes": 5, "seed": -1}, "seed.* 0"),
        ({"episodes": 5, "expert": "best"}, "'best'"),
        ({"episodes": 5, "beta": math.nan}, "finite"),
    ],
)
def test_wrong_arguments_are_refused(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=message):
        build_doorkey(tmp_path / "new", **wrong)
    assert list(tmp_path.iterdir()) == []


# --- The dynamics as a check -----------------------------------------------------------------------------------------


def all_episodes(first_step, K):
    """Every (states, actions) of K steps, (M, K, 2) and (M, K - 1), from `first_step` of an episode on."""
    agent, key = START_PAIRS.T
    for _ in range(first_step):
        pairs = [step(agent, key, np.array(False), action)[:2] for action in range(4)]
        agent, key = np.unique(np.concatenate(pairs, axis=1), axis=1)
    ways, taken = np.stack([agent, key], axis=-1)[:, None], np.zeros((len(agent), 0), dtype=int)
    for _ in range(K - 1):
        parts = []
        for action in range(4):
            nexts = step(ways[:, -1, 0], ways[:, -1, 1], np.array(False), np.array(action))[:2]
            longer = np.concatenate([ways, np.stack(nexts, axis=-1)[:, None]], axis=1)
            parts.append((longer, np.concatenate([taken, np.full((len(ways), 1), action)], axis=1)))
        ways, taken = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    return ways, taken


@pytest.mark.parametrize("first_step", [0, 2])
def test_the_check_is_whether_some_episode_has_all_that_is_decided(first_step):
    """Against every episode of three steps: recorded ones with some cells and actions changed, and some undecided."""
    K, N = 3, 400
    ways, taken = all_episodes(first_step, K)
    rng = np.random.default_rng(first_step)
    chosen = rng.integers(len(ways), size=N)
    states, actions = ways[chosen].copy(), np.concatenate([taken[chosen], np.zeros((N, 1), dtype=int)], axis=1)
    wrong = rng.random((N, K, 2)) < 0.15
    states[wrong] = rng.integers(16, size=wrong.sum())
    wrong = rng.random((N, K)) < 0.15
    actions[wrong] = rng.integers(4, size=wrong.sum())
    s, a = rng.random((N, K)) < 0.6, rng.random((N, K)) < 0.6
    values = {
        "s": torch.tensor(np.where(s[..., None], states, np.nan)).float(),
        "a": torch.tensor(np.where(a, actions, np.nan)).float()[..., None],
    }
    decided = {"s": torch.tensor(s), "a": torch.tensor(a)}
    agree = []
    for n in range(N):
        same = (ways == states[n]).all(-1) | ~s[n]
        agree.append(bool((same.all(1) & ((taken == actions[n, :-1]) | ~a[n, :-1]).all(1)).any()))
    check = DynamicsCheck(agree=True, first_step=first_step)(values, decided)
    assert check.tolist() == agree
    assert 0.2 < np.mean(agree) < 0.8
    alone = DynamicsCheck()(values, decided)
    assert (alone | ~check).all()  # what is part of an episode has possible steps alone
    assert (alone & ~check).any()  # but not the other way round


def test_the_check_judges_each_step_by_the_rules():
    episodes = rollout(300, np.random.default_rng(0))
    states = torch.tensor(np.stack([episodes.agent, episodes.key], axis=-1)[:, :-1]).float()
    actions = torch.tensor(episodes.action).float()[..., None]
    every = {"s": torch.ones(states.shape[:2], dtype=torch.bool), "a": torch.ones(states.shape[:2], dtype=torch.bool)}
    for check in (DynamicsCheck(), DynamicsCheck(agree=True)):
        assert check({"s": states, "a": actions}, every).all()
        turned = (actions + 2) % 4
        legal = step(
            *(states[:, :-1, i].long().numpy() for i in (0, 1)), np.array(False), turned[:, :-1, 0].long().numpy()
        )
        same = (np.stack(legal[:2], axis=-1) == states[:, 1:].numpy()).all(axis=(1, 2))
        assert check({"s": states, "a": turned}, every).tolist() == same.tolist()
    nothing = {name: torch.zeros_like(known) for name, known in every.items()}
    assert DynamicsCheck(agree=True)({"s": states * torch.nan, "a": actions * torch.nan}, nothing).all()


def test_a_key_left_in_the_right_room_is_no_state():
    values = {
        "s": torch.tensor([[[5.0, 7.0]], [[7.0, 5.0]], [[7.0, 7.0]], [[5.0, 4.0]]]),
        "a": torch.full((4, 1, 1), torch.nan),
    }
    decided = {"s": torch.ones(4, 1, dtype=torch.bool), "a": torch.zeros(4, 1, dtype=torch.bool)}
    assert DynamicsCheck()(values, decided).tolist() == [False, False, True, True]
    assert DynamicsCheck(agree=True)(values, decided).tolist() == [False, False, False, True]
