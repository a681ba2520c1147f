"""Chunks: several actions asked at once, carried out one after another, and real-time chunking as a mask."""

import pytest
import torch
from policies import CONTINUOUS_STATS, Episode, roll

from lerobot_unimask.data.window import Window

H, D = 4, 2
# Where later actions follow from answered states, sines and cosines and small scales would make a last bit of a state,
# which differs by the processor, a hundredth of an action.
STATES = CONTINUOUS_STATS["observation.state"] | {"std": [10.0, 1.0, 1.0]}
CALM = {"fine_inputs": False, "stats": CONTINUOUS_STATS | {"observation.state": STATES}}


@pytest.fixture
def policy(tiny_policy):
    return tiny_policy("continuous", context_length=10, chunk_size=H, **CALM)


def answered_in_turn(policy, batch, steps, on_their_way=0):
    """A chunk by the slow way: each action asked by itself, given the states and actions as they were answered."""
    batch = {key: value.clone() for key, value in batch.items()}
    for step in range(steps):
        if step:
            answer = policy.infer(batch, f"s[{step}] | s[:{step}], a[:{step}]")
            batch["observation.state"][:, step] = answer.most_likely("s")[:, step]
        if step >= on_their_way:
            answer = policy.infer(batch, "behavior_cloning", t=step)
            batch["action"][:, step] = answer.most_likely("a")[:, step]
    return batch["action"][:, :steps]


def observation(states, step=0):
    return {"observation.state": states[step], "observation.return_so_far": torch.zeros(len(states[step]), 1)}


def test_the_present_leaves_room_for_the_chunk(policy):
    episode = Episode("continuous", 3, 12)
    for step in range(12):
        policy.select_action(episode.observation(step))
        assert policy._memory.position == min(step, 10 - H)
        assert policy._memory.first_step == max(0, step - (10 - H))


@pytest.mark.parametrize("remembered", [1, 3, 10])
def test_acting_remembers_no_more_than_n_obs_steps(tiny_policy, remembered):
    """An answer is that of a window with the last steps alone, laid out by hand."""
    policy = tiny_policy("continuous", n_obs_steps=remembered)
    episode = Episode("continuous", 3, 8)
    for step in range(8):
        action = policy.select_action(episode.observation(step))
        batch, _, t = episode.window(step, remembered, policy.statistics.fps.item())
        missing = 10 - remembered
        padded = {
            key: torch.nn.functional.pad(value, (0, 0) * (value.ndim - 2) + (0, missing), value=torch.nan)
            for key, value in batch.items()
            if key != "timestamp"
        }
        expected = policy.infer({**batch, **padded}, "behavior_cloning", t=t).most_likely("a")[:, t]
        torch.testing.assert_close(action, expected, rtol=1e-5, atol=1e-5)
        episode.actions.append(action)


@pytest.mark.parametrize("attention", ["both", "bidirectional"])
def test_a_chunks_first_action_is_what_acting_without_chunks_answers(tiny_policy, attention):
    """With the same history and direction."""
    states = Episode("continuous", 3, 6).states
    one = tiny_policy("continuous", attention=attention)
    chunk = tiny_policy("continuous", attention=attention, chunk_size=H)
    torch.testing.assert_close(roll(chunk, states), roll(one, states), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("settings", [{"attention": "bidirectional"}, {"training_masks": "behavior_cloning"}])
def test_a_chunk_is_the_question_about_its_actions(tiny_policy, settings):
    """Asked at once, where the model cannot answer causally or has not learnt to say so what comes between."""
    policy = tiny_policy("continuous", chunk_size=H, **settings)
    episode = Episode("continuous", 3, 1)
    chunk = policy.predict_action_chunk(episode.observation(0))
    assert chunk.shape == (3, H, D)
    batch, _, _ = episode.window(0, 10, policy.statistics.fps.item())
    expected = policy.infer(batch, f"a[:{H}] | s[0]").most_likely("a")[:, :H]
    torch.testing.assert_close(chunk, expected, rtol=1e-5, atol=1e-5)


def test_a_chunk_for_a_goal_is_asked_at_once(policy):
    episode = Episode("continuous", 3, 1)
    goal = {"s[-1]": [150.0, -5.0, 0.5]}
    chunk = policy.predict_action_chunk(episode.observation(0), mask="goal_conditioned", given=goal)
    batch, _, _ = episode.window(0, 10, policy.statistics.fps.item())
    expected = policy.infer(batch, f"a[:{H}] | s[0], s[-1]", given=goal).most_likely("a")[:, :H]
    torch.testing.assert_close(chunk, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", ["continuous", "doorkey"])
@pytest.mark.parametrize("attention", ["both", "causal"])
def test_its_actions_follow_one_from_another(tiny_policy, kind, attention):
    """Each is what acting would answer if all went as the model expects."""
    policy = tiny_policy(kind, attention=attention, chunk_size=H, **(CALM if kind == "continuous" else {}))
    episode = Episode(kind, 3, 1)
    chunk = policy.predict_action_chunk(episode.observation(0))
    batch, _, _ = episode.window(0, 10, policy.statistics.fps.item())
    expected = answered_in_turn(policy, batch, H).to(chunk.dtype)
    torch.testing.assert_close(chunk, expected, rtol=1e-5, atol=1e-5)


def test_its_actions_are_carried_out_before_acting_asks_again(tiny_policy):
    policy = tiny_policy("continuous", chunk_size=H, n_action_steps=3)
    states = Episode("continuous", 3, 7).states
    first = policy.predict_action_chunk(observation(states))
    asked = []
    ask = policy.predict
    policy.predict = lambda *arguments: asked.append(policy._memory.step) or ask(*arguments)
    actions = roll(policy, states)
    assert sorted(set(asked)) == [0, 3, 6]
    torch.testing.assert_close(actions[:3].transpose(0, 1), first[:, :3], rtol=1e-5, atol=1e-5)
    memory = policy._memory  # it goes on observing and remembering meanwhile
    assert torch.equal(memory.values["s"][:, : memory.position + 1], states[: memory.position + 1].transpose(0, 1))
    assert torch.equal(memory.values["a"][:, : memory.position + 1], actions.transpose(0, 1))


def test_asking_for_a_chunk_remembers_nothing(policy):
    states = Episode("continuous", 3, 4).states
    before = roll(policy, states)
    policy.predict_action_chunk(observation(states, 2))
    first = policy.predict_action_chunk(observation(states))
    assert torch.equal(policy.predict_action_chunk(observation(states)), first)
    assert torch.equal(roll(policy, states), before)


@pytest.mark.parametrize("delay", [0, 1, 3, H, 9])
def test_actions_on_their_way_come_back_unchanged_and_the_rest_follow_them(policy, delay):
    """Real-time chunking is the mask a[d:H] | s[0], a[:d], answered one after another."""
    episode = Episode("continuous", 1, 1)
    left_over = torch.randn(H, D, generator=torch.Generator().manual_seed(1))
    padded = torch.cat([left_over, torch.zeros(6, D)])  # as LeRobot hands it over
    chunk = policy.predict_action_chunk(episode.observation(0), inference_delay=delay, prev_chunk_left_over=padded)
    d = min(delay, H)
    assert torch.equal(chunk[0, :d], left_over[:d])
    if 0 < d < H:
        batch, _, _ = episode.window(0, 10, policy.statistics.fps.item())
        batch["action"][0, :d] = left_over[:d]
        torch.testing.assert_close(chunk, answered_in_turn(policy, batch, H, d), rtol=1e-5, atol=1e-5)


def test_lerobots_padding_is_not_taken_for_actions(policy):
    episode = Episode("continuous", 1, 1)
    left_over = torch.zeros(10, D)
    left_over[0] = 0.5
    chunk = policy.predict_action_chunk(episode.observation(0), inference_delay=3, prev_chunk_left_over=left_over)
    short = policy.predict_action_chunk(episode.observation(0), inference_delay=1, prev_chunk_left_over=left_over[:1])
    assert torch.equal(chunk, short)


def test_a_drawn_chunk_is_one_plan(tiny_policy):
    """Drawn by the chain rule: each action given the states and actions drawn before it."""
    policy = tiny_policy("gaussian", chunk_size=H, **CALM)
    states = Episode("continuous", 2, 1).states
    generator = torch.Generator().manual_seed(5)
    chunk = policy.predict_action_chunk(observation(states), sample=True, generator=generator)
    values = {name: torch.full((2, 10, factor.size), torch.nan) for name, factor in policy.factors.items()}
    values["s"][:, 0] = states[0]
    window = Window(values, torch.ones(2, 10, dtype=torch.bool))
    drawn = policy.sample(window, f"s[1:{H}], a[:{H}] | s[0]", seed=5).values["a"][:, :H]
    torch.testing.assert_close(chunk, drawn, rtol=1e-5, atol=1e-5)


def test_real_time_chunking_wants_chunks(tiny_policy, policy):
    from lerobot.rollout.inference.rtc import supports_rtc_inference

    assert supports_rtc_inference(policy)
    assert not supports_rtc_inference(tiny_policy("continuous"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"prev_chunk_left_over": torch.ones(3, 5), "inference_delay": 1}, "(3, 5)"),
        ({"prev_chunk_left_over": torch.ones(5), "inference_delay": 1}, "(5,)"),
        ({"inference_delay": -1}, "-1"),
    ],
)
def test_a_left_over_of_another_form_is_refused(policy, arguments, words):
    with pytest.raises(ValueError, match=r"inference_delay|prev_chunk_left_over") as raised:
        policy.predict_action_chunk(Episode("continuous", 1, 1).observation(0), **arguments)
    assert words in str(raised.value)


# --- Goals that last -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "step", "counts"), [(H, 5, True), (H, 13, True), (1, 5, True), (1, 13, False)])
def test_a_goal_at_the_windows_end_lasts_where_there_is_room_ahead(tiny_policy, size, step, counts):
    """With H > 1, s[-1] is H - 1 steps from now once the window slides; with H = 1 the present stands there itself."""
    policy = tiny_policy("continuous", chunk_size=size)
    states = Episode("continuous", 3, 14).states
    question = {"mask": "goal_conditioned", "given": {"s[-1]": [150.0, -5.0, 0.5]}}
    roll(policy, states[:step])
    plain = policy.select_action(observation(states, step))
    roll(policy, states[:step])
    assert torch.equal(policy.select_action(observation(states, step), **question), plain) != counts


def test_a_goal_of_the_episode_comes_nearer_and_shows_once_it_is_in_the_window(tiny_policy):
    states = Episode("continuous", 2, 20).states
    goal = [150.0, -5.0, 0.5]
    policy = tiny_policy("continuous", chunk_size=H)  # the present stands at 6 at the most
    plain = roll(policy, states)
    given = roll(policy, states, given={"s@15": goal})
    differs = (given - plain).abs().amax((1, 2)) > 0
    # It is in the window of step k if k - 6 <= 15 <= k - 6 + 9, and in the future if k < 15.
    assert differs[12:15].all()
    assert not differs[:12].any()
    for step in (12, 14):  # as if it had been given at its position
        policy.reset()
        for k in range(step):
            policy.select_action(observation(states, k), given={"s@15": goal})
        position = 15 - (step - 6)
        mask = f"a[t] | s[:t+1], a[:t], s[{position}]"
        expected = policy.select_action(observation(states, step), mask=mask, given={f"s[{position}]": goal})
        torch.testing.assert_close(expected, given[step], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("token", "words"), [("s@50", "0 to 49"), ("rtg@3", "step 0 only"), ("s@x", "integer"), ("q@3", "no factor 'q'")]
)
def test_a_moment_that_is_not_of_the_episode_is_refused(tiny_policy, token, words):
    policy = tiny_policy("continuous")
    with pytest.raises(ValueError, match=r"s@50|rtg@3|s@x|q@3") as raised:
        policy.select_action(Episode("continuous", 1, 1).observation(0), given={token: [150.0, -5.0, 0.5]})
    assert words in str(raised.value)
