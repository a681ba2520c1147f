"""Policies with cameras: what is hidden or later changes no answer, each picture is looked at once, and what is asked
with a picture is what a recorded one answers."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from policies import CONTINUOUS_FEATURES, CONTINUOUS_STATS, assert_same_answers

from lerobot_unimask import UniMASKPolicy, query
from lerobot_unimask.data import frames
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import TASKS, Mask, parse_token, tabulate
from lerobot_unimask.language.training_masks import TrainingMasks
from lerobot_unimask.measures import action_error, latency
from lerobot_unimask.sharing import cards
from lerobot_unimask.validation import task_losses

K, SIDE = 6, 16
CAMERAS = ("top", "wrist")
COLUMNS = {name: f"observation.images.{name}" for name in CAMERAS}
CAMERA = {"dtype": "video", "shape": (24, 32, 3), "names": ["height", "width", "channels"]}
FEATURES = {**CONTINUOUS_FEATURES, **dict.fromkeys(COLUMNS.values(), CAMERA)}


@pytest.fixture
def make(tiny_policy):
    """make(**settings) -> an untrained policy of continuous states, actions and returns, with two cameras."""
    shared = {"context_length": K, "image_size": [SIDE, SIDE]}
    return lambda **settings: tiny_policy("gaussian", features=FEATURES, **(shared | settings))


@pytest.fixture(scope="module")
def batch():
    """Three windows, pictures from 0 to 1; the last one ends after four steps."""
    generator = torch.Generator().manual_seed(0)
    batch = {"index": torch.arange(3), "timestamp": torch.zeros(3)}
    for key in CONTINUOUS_FEATURES:
        mean, std = (torch.tensor(CONTINUOUS_STATS[key][name]) for name in ("mean", "std"))
        batch[key] = (mean + std * torch.randn(3, K, len(mean), generator=generator)).squeeze(-1)
    for key in COLUMNS.values():
        batch[key] = torch.rand(3, K, 3, SIDE, SIDE, generator=generator)
    batch["action_is_pad"] = torch.zeros(3, K, dtype=torch.bool)
    batch["action_is_pad"][2, 4:] = True
    return batch


def observation(batch, step):
    keys = ("observation.state", *COLUMNS.values())
    return {key: batch[key][:, step] for key in keys} | {"observation.return_so_far": torch.zeros(3, 1)}


# --- The language ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in TASKS if name != "reward_conditioned"])
def test_s_is_the_state_and_every_camera(name):
    plain = tabulate(name, ("s", "a"), K)
    table = tabulate(name, ("s", "a"), K, CAMERAS)
    assert torch.equal(table.shown[:, :2], plain.shown)
    assert torch.equal(table.asked[:, :2], plain.asked)
    assert torch.equal(table.shown[:, 2:], plain.shown[:, :1].expand(-1, 2, -1))
    assert not table.asked[:, 2:].any()


def test_a_camera_and_the_state_have_names_of_their_own():
    table = tabulate("state[3], a[t] | state[:t+1], wrist[0, -1]", ("s", "a"), K, CAMERAS)
    mask = table.at(1)
    assert mask.draw() == "s ##.?..  a .?....  top ......  wrist #....#"
    assert tabulate("state[1] | state[0]", ("s", "a"), K).at(None).draw() == "s #?....  a ......"
    assert str(parse_token("top[-1]", ("s", "a"), K, CAMERAS)) == f"top[{K - 1}]"
    assert str(parse_token("top@90", ("s", "a"), K, CAMERAS)) == "top@90"
    assert str(parse_token("state[0]", ("s", "a"), K, CAMERAS)) == "s[0]"


@pytest.mark.parametrize("text", ["top[t] | s[:t]", "a[0], wrist[-1] | s[0]"])
def test_a_camera_is_never_asked(text):
    with pytest.raises(MaskError, match=r"top|wrist"):
        tabulate(text, ("s", "a"), K, CAMERAS)


def test_random_masks_hide_pictures_token_by_token():
    draw = TrainingMasks("random_mask", ("s", "a"), K, cameras=CAMERAS, causal_share=0.5)
    mask = draw(torch.ones(4000, K, dtype=torch.bool), torch.arange(4000), seed=0, step=0)
    both = ~mask.causal
    for name in CAMERAS:
        assert not mask.asked[name].any()
        assert mask.shown[name][mask.causal].all()
        assert mask.shown[name][both].float().mean(0) == pytest.approx([0.5] * K, abs=0.05)
    assert (mask.shown["top"] != mask.shown["wrist"])[both].any(0).all()


# --- Leaks -----------------------------------------------------------------------------------------------------------

QUESTIONS = {"behavior_cloning": 3, "a[t] | s[:t+1], a[:t], top[-1]": 3, "s[1:4] | state[0], wrist[2], s[5]": None}
ATTENTION = {
    "both": {},
    "bidirectional": {"attention": "bidirectional"},
    "stacked": {"attention": "bidirectional", "token_layout": "stacked"},
}


@pytest.mark.parametrize("wrong", [torch.nan, 0.7])
@pytest.mark.parametrize(("question", "t"), QUESTIONS.items(), ids=["imitation", "goal", "waypoints"])
@pytest.mark.parametrize("attention", ATTENTION.values(), ids=ATTENTION)
def test_a_hidden_picture_changes_no_answer(make, batch, attention, question, t, wrong):
    policy = make(**attention)
    before = policy.infer(batch, question, t=t)
    changed = dict(batch)
    for name, key in COLUMNS.items():
        hidden = ~before.mask.shown[name]
        assert hidden.any()
        changed[key] = torch.where(hidden[..., None, None, None], wrong, batch[key])
    assert_same_answers(policy.infer(changed, question, t=t), before)


def test_a_shown_picture_changes_answers(make, batch):
    policy = make()
    before = policy.infer(batch, "behavior_cloning", t=3)["a"][0].mean[:, 3]
    for key in COLUMNS.values():
        after = policy.infer({**batch, key: 1 - batch[key]}, "behavior_cloning", t=3)["a"][0].mean[:, 3]
        assert (after != before).any()


def test_a_later_picture_changes_no_causal_answer(make, batch):
    policy = make()
    window = policy.statistics.normalise(policy.make_window(batch))
    everything = {name: torch.ones(3, K, dtype=torch.bool) for name in ("s", "a", *CAMERAS)}
    everything["rtg"] = everything["s"] & (torch.arange(K) == 0)

    def answers(window):
        return policy.network(window, everything, True)

    before = answers(window)
    for name in CAMERAS:
        for step in range(K):
            values = dict(window.values)
            values[name] = values[name].clone()
            values[name][:, step] = 1 - values[name][:, step]
            after = answers(type(window)(values, window.valid))
            for factor, end in (("s", step + 1), ("a", step)):  # a step's picture stands between its state and action
                assert torch.equal(after[factor][0][:, :end], before[factor][0][:, :end])
            assert not torch.equal(after["a"][0][:, step], before["a"][0][:, step])


def test_training_sees_no_hidden_picture(make, batch):
    policy = make()
    policy.eval()
    mask = policy.training_masks(~batch["action_is_pad"], batch["index"], seed=policy.config.mask_seed, step=-1)
    changed = dict(batch)
    for name, key in COLUMNS.items():
        changed[key] = torch.where(mask.shown[name][..., None, None, None], batch[key], torch.nan)
    assert policy.forward(changed)[0] == policy.forward(batch)[0]


def test_only_shown_pictures_are_looked_at(make, batch):
    policy = make()
    seen = count_pictures(policy)
    policy.infer(batch, "a[t] | s[t], top[0]", t=3)
    assert seen == {"top": 6, "wrist": 3}


def count_pictures(policy):
    seen = dict.fromkeys(CAMERAS, 0)
    for name in CAMERAS:
        backbone = policy.network.cameras[name].encoder.backbone

        def count(module, arguments, name=name):
            seen[name] += len(arguments[0])

        backbone.register_forward_pre_hook(count)
    return seen


# --- Acting and asking -----------------------------------------------------------------------------------------------


def test_latency_is_that_of_acting_with_pictures(make, batch):
    assert latency(make(), batch, calls=2)["median_ms"] > 0


@pytest.mark.parametrize("attention", ["both", "bidirectional", "causal"])
def test_acting_answers_as_the_recorded_window_does_and_looks_once(make, batch, attention):
    policy = make(attention=attention)
    seen = count_pictures(policy)
    actions = [policy.select_action(observation(batch, step)) for step in range(K)]
    assert seen == dict.fromkeys(CAMERAS, 3 * K)
    assert policy._memory.values["top"].shape == (3, K, policy.config.width)
    policy.select_action(observation(batch, 0))  # the window slides
    assert seen == dict.fromkeys(CAMERAS, 3 * K + 3)
    recorded = {**batch, "action": torch.stack(actions, 1), "action_is_pad": torch.zeros(3, K, dtype=torch.bool)}
    for step in (0, 3, K - 1):
        asked = policy.infer(recorded, "behavior_cloning", t=step).most_likely("a")[:, step]
        torch.testing.assert_close(asked, actions[step], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("hidden", ["", ", top[0]", ", wrist[:t+1]"], ids=["all", "later ones", "one camera's"])
def test_acting_answers_as_the_recorded_window_does_where_pictures_are_hidden(make, batch, hidden):
    """An action is predicted from the place before it, which is a picture's, hidden or not."""
    question = f"a[t] | state[:t+1], a[:t]{hidden}"
    policy = make(attention="causal", training_masks=question, inference_mask=question)
    actions = [policy.select_action(observation(batch, step)) for step in range(K)]
    recorded = {**batch, "action": torch.stack(actions, 1), "action_is_pad": torch.zeros(3, K, dtype=torch.bool)}
    for step in range(K):
        asked = policy.infer(recorded, question, t=step).most_likely("a")[:, step]
        torch.testing.assert_close(asked, actions[step], rtol=1e-4, atol=1e-4)
    slid = policy.select_action(observation(batch, 0))
    later = {key: value.roll(-1, dims=1) if value.ndim > 1 else value for key, value in recorded.items()}
    for key, value in observation(batch, 0).items():
        if key in later:
            later[key][:, -1] = value
    asked = policy.infer(later, question, t=K - 1).most_likely("a")[:, K - 1]
    torch.testing.assert_close(asked, slid, rtol=1e-4, atol=1e-4)


def test_a_missing_camera_is_named(make, batch):
    shown = observation(batch, 0)
    del shown["observation.images.wrist"]
    with pytest.raises(ValueError, match=r"observation\.images\.wrist"):
        make().select_action(shown)


def test_a_picture_of_another_size_is_resized_and_said_once(make, batch, caplog):
    policy = make()
    large = {key: batch[key].repeat_interleave(3, -1).repeat_interleave(2, -2) for key in COLUMNS.values()}
    resized = {key: frames.resized(large[key], (SIDE, SIDE)) for key in large}
    small = policy.infer({**batch, **resized}, "behavior_cloning", t=2)
    answer = policy.infer({**batch, **large}, "behavior_cloning", t=2)
    policy.infer({**batch, **large}, "behavior_cloning", t=2)
    assert sum("resized to 16 x 16" in record.getMessage() for record in caplog.records) == 1
    assert_same_answers(answer, small, exactly=False)


def test_a_given_picture_answers_as_a_recorded_one(make, batch, tmp_path):
    policy = make()
    question = "a[t] | s[:t+1], a[:t], top[-1]"
    pictures = {key: (255 * batch[key]).round().to(torch.uint8) for key in COLUMNS.values()}
    recorded = {**batch, **pictures, "action_is_pad": torch.zeros(3, K, dtype=torch.bool)}
    expected = policy.infer(recorded, question, t=2)
    hidden = {**recorded, COLUMNS["top"]: recorded[COLUMNS["top"]].clone()}
    goals = hidden[COLUMNS["top"]][:, -1].clone()
    hidden[COLUMNS["top"]][:, -1] = 0
    assert_same_answers(policy.infer(hidden, question, t=2, given={"top[-1]": goals}), expected, exactly=False)
    last = goals.permute(0, 2, 3, 1).numpy()  # colours last
    assert_same_answers(policy.infer(hidden, question, t=2, given={"top[-1]": last}), expected, exactly=False)
    Image.fromarray(last[1]).save(tmp_path / "goal.png")
    one = policy.infer(hidden, question, t=2, given={"top[-1]": str(tmp_path / "goal.png")})
    torch.testing.assert_close(one["a"][0].mean[1, 2], expected["a"][0].mean[1, 2])
    alone = policy.infer(None, "a[0] | state[0], top[-1]", given={"state[0]": [100, -5, 0.5], "top[-1]": goals[0]})
    assert alone["a"][0].mean[0, 0].isfinite().all()


def test_rollouts_take_a_goal_picture(make, batch, tmp_path):
    goal = (255 * np.random.default_rng(0).random((30, 40, 3))).astype(np.uint8)
    Image.fromarray(goal).save(tmp_path / "goal.png")
    question = {"inference_mask": "a[t] | s[:t+1], a[:t], top[-1]", "chunk_size": 2}
    policy = make(**question, given={"top[-1]": str(tmp_path / "goal.png")})
    other = make(**question)
    actions = [policy.select_action(observation(batch, step % K)) for step in range(K + 2)]
    same = [other.select_action(observation(batch, step % K), given={"top[-1]": goal}) for step in range(K + 2)]
    plain = make()
    blind = [plain.select_action(observation(batch, step % K)) for step in range(K + 2)]
    assert torch.equal(torch.stack(actions), torch.stack(same))
    assert not torch.allclose(torch.stack(actions), torch.stack(blind))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"top[-1]": "nowhere.png"}, "nowhere.png"),
        ({"top[-1]": [1, 2, 3]}, r"shape \(3,\)"),
        ({"top[-1]": torch.full((3, 8, 8), 7.0)}, "0 to 1"),
        ({}, r"top\[5\].*neither observed nor given"),
    ],
)
def test_bad_pictures_are_refused(make, batch, given, message):
    policy = make()
    with pytest.raises(ValueError, match=message):
        policy.infer({key: batch[key] for key in CONTINUOUS_FEATURES}, "a[0] | state[0], top[-1]", given=given)


def test_a_mask_without_cameras_hides_them(make, batch):
    policy = make()
    yes, no = torch.ones(3, K, dtype=torch.bool), torch.zeros(3, K, dtype=torch.bool)
    mask = Mask({"s": yes, "a": no, "rtg": no}, {"s": no, "a": yes, "rtg": no})
    answer = policy.infer(batch, mask)
    assert_same_answers(answer, policy.infer(batch, "a[:] | state[:]"))


def test_samples_are_drawn_given_pictures(make, batch):
    drawn = make().sample(batch, "future", t=1, samples=2)
    assert drawn.values["a"][:2, 1:].isfinite().all()


# --- Settings and checkpoints ----------------------------------------------------------------------------------------


def test_a_checkpoint_from_before_cameras_loads(tiny_policy, tmp_path):
    tiny_policy("gaussian").save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    new = ("cameras", "image_size", "cache_frames", "pictures", "vision_backbone", "pretrained_backbone_weights")
    content = {name: value for name, value in content.items() if name not in (*new, "optimizer_lr_backbone")}
    path.write_text(json.dumps(content))
    policy = UniMASKPolicy.from_pretrained(tmp_path)
    assert policy.cameras == {}
    policy.config.set_dataset_feature_metadata(FEATURES)  # goes on, blind, with a dataset that has cameras
    assert policy.config.pictures == {}


def test_cameras_are_chosen(make):
    assert list(make(cameras=["observation.images.wrist"]).cameras) == ["wrist"]
    assert list(make(cameras=[]).cameras) == []
    with pytest.raises(ValueError, match=r"observation\.images\.side"):
        make(cameras=["observation.images.side"])
    with pytest.raises(ValueError, match="network=feedforward"):
        make(network="feedforward")


def test_names_that_are_taken_or_cannot_be_written_become_others(tiny_policy):
    names = ("observation.images.s", "observation.images.cam-left", "observation.images.0", "observation.image")
    policy = tiny_policy(
        "gaussian", features={**CONTINUOUS_FEATURES, **dict.fromkeys(names, CAMERA)}, image_size=[16, 16]
    )
    assert list(policy.cameras) == ["images_s", "cam_left", "camera_0", "image"]


def test_what_looks_learns_at_a_rate_of_its_own(make):
    policy = make(optimizer_lr_backbone=1e-5)
    rest, seeing = policy.get_optim_params()
    assert seeing["lr"] == 1e-5
    assert len(rest["params"]) + len(seeing["params"]) == len(list(policy.parameters()))
    backbones = [p for camera in policy.network.cameras.values() for p in camera.encoder.backbone.parameters()]
    assert all(one is other for one, other in zip(seeing["params"], backbones, strict=True))


def test_a_resnet_looks(make, batch):
    policy = make(vision_backbone="resnet18", image_size=[64, 64], cameras=["observation.images.top"])
    assert policy.select_action(observation(batch, 0)).isfinite().all()


def test_one_picture_serves_all_steps_of_a_causal_window(make, batch):
    """`top[0]` is before every action, so that a causal window has them all for one picture; `top[t]` is not."""
    question = "a[t] | state[:t+1], a[:t], top[0]"
    policy = make(training_masks=question, attention="causal", cameras=["observation.images.top"])
    mask = policy.training_masks(torch.ones(3, K, dtype=torch.bool), batch["index"], seed=0, step=0)
    assert mask.draw().startswith("s ######  a ######") or mask.asked["a"].all()
    assert mask.shown["top"].sum(1).tolist() == [1, 1, 1]
    assert policy.infer(batch, question, t=3).most_likely("a")[:, 3].isfinite().all()
    with pytest.raises(MaskError, match="attends causally alone"):
        make(training_masks="a[t] | state[:t+1], a[:t], top[t]", attention="causal")
    with pytest.raises(MaskError, match="attends causally alone"):
        policy.infer(batch, "a[t] | state[:t+1], a[:t]", t=3)


def test_cards_and_the_overview_say_what_is_looked_at(make, tmp_path):
    policy = make(training_masks=["random_mask", "a[t] | s[:t+1], a[:t], top[-1]"])
    policy.save_pretrained(tmp_path)
    card = cards.policy_card(policy.card_facts(tmp_path), "me/arm")["README.md"].decode()
    assert "observation.images.wrist" in card
    assert "3 x 16 x 16" in card
    text = query.describe_overview(query.overview(policy))
    assert "top" in text
    assert "pictures of observation.images.top, read at 16 x 16" in text


def test_measures_and_losses_read_pictures(make, batch):
    policy = make()
    whole = {**batch, "action_is_pad": torch.zeros(3, K, dtype=torch.bool)}
    assert action_error(policy, whole, "behavior_cloning") > 0
    assert task_losses(policy, whole, ["behavior_cloning", "random_mask"]).keys() == {"behavior_cloning", "random_mask"}


def test_a_query_names_and_draws_the_pictures_shown(make, batch, tmp_path):
    policy = make()
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(tmp_path / "goal.png")
    one = {key: value[:1] for key, value in batch.items()}
    question = "a[t] | state[:t+1], a[:t], top[0, -1], wrist[t]"
    reply = query.ask(policy, question, batch=one, t=2, given={"top[-1]": str(tmp_path / "goal.png")})
    assert list(reply.pictures) == ["top[0]", "wrist[2]", f"top[{K - 1}]"]
    assert reply.pictures[f"top[{K - 1}]"].max() == 0
    assert torch.equal(reply.pictures["wrist[2]"], one[COLUMNS["wrist"]][0, 2].permute(1, 2, 0))
    figure = query.picture(policy, reply)
    assert [axes.get_title() for axes in figure.axes][-3:] == list(reply.pictures)
    figure.savefig(tmp_path / "answer.png")
