"""Several tasks: what an episode is to do is a property, read from the batch's texts and shown as task[0]."""

import pytest
import torch
from policies import CONTINUOUS_FEATURES, CONTINUOUS_STATS, SMALL, Episode

from lerobot_unimask import UniMASKConfig, UniMASKPolicy
from lerobot_unimask.data.factors import Feature

TASKS = ["open the door", "close it"]


def make(tasks=TASKS, **settings):
    config = UniMASKConfig(device="cpu", **(SMALL | {"dropout": 0.0} | settings))
    config.set_dataset_feature_metadata(CONTINUOUS_FEATURES)
    config.add_tasks(tasks)
    torch.manual_seed(0)
    return UniMASKPolicy(config, dataset_stats=CONTINUOUS_STATS).eval()


def observation(task=None, B=2):
    observed = Episode("continuous", B, 1).observation(0)
    return observed if task is None else {**observed, "task": task}


def test_one_task_is_no_factor():
    assert "task" not in make(TASKS[:1]).factors
    assert make().config.features["task"] == [Feature("task", 1, [2], labels=TASKS)]


@pytest.mark.parametrize("name", ["behavior_cloning", "future", "goal_conditioned"])
def test_named_tasks_show_it(name, continuous_batch):
    batch = continuous_batch | {"task": [TASKS[0]] * 5}
    answer = make().infer(batch, name, t=3)
    assert answer.mask.shown["task"][:, 0].all()
    assert not answer.mask.shown["task"][:, 1:].any()


def test_training_reads_it_from_the_batch(continuous_batch):
    policy = make(training_masks="a[t] | s[t], task[0]").train()
    losses = [policy.forward(continuous_batch | {"task": [task] * 5})[0].item() for task in TASKS]
    assert losses[0] != losses[1]
    hidden = make(training_masks="a[t] | s[t]").train()
    assert len({hidden.forward(continuous_batch | {"task": [task] * 5})[0].item() for task in TASKS}) == 1


@pytest.mark.parametrize(
    "asked",
    [
        lambda policy, task: policy.select_action(observation([TASKS[0], task])),
        lambda policy, task: policy.select_action(observation(), given={"task[0]": [TASKS[0], task]}),
        lambda policy, task: policy.predict_action_chunk(observation([TASKS[0], task])),
    ],
)
def test_acting_asks_for_the_environments_own_task(asked):
    one, other = (asked(make(), task)[1] for task in TASKS)
    assert not torch.equal(one, other)
    plain = make().select_action(observation(), given={"task[0]": [0, 0]})
    torch.testing.assert_close(one.reshape(-1), plain[1], rtol=1e-5, atol=1e-5)


def test_what_is_given_wins_over_what_the_environment_says():
    given = make().select_action(observation("no such task"), given={"task[0]": TASKS[1]})
    assert torch.equal(given, make().select_action(observation(TASKS[1])))


def test_a_question_without_it_is_about_all_tasks():
    policy = make(inference_mask="a[t] | s[:t+1], a[:t]")
    assert torch.equal(
        policy.select_action(observation("no such task")),
        make().select_action(observation(), mask="a[t] | s[:t+1], a[:t]"),
    )


@pytest.mark.parametrize("observed", [observation("fly"), observation(["fly", TASKS[0]]), observation("")])
def test_an_unknown_task_is_refused_with_those_that_are_known(observed):
    with pytest.raises(ValueError, match=r"open the door.*close it"):
        make().select_action(observed)


def test_an_environment_that_says_no_task_is_told_what_is_missing():
    with pytest.raises(ValueError, match=r"task\[0\]"):
        make().select_action(observation())


def test_a_checkpoint_keeps_the_texts(tmp_path):
    make().save_pretrained(tmp_path)
    loaded = UniMASKPolicy.from_pretrained(tmp_path)
    assert torch.equal(loaded.select_action(observation(TASKS[1])), make().select_action(observation(TASKS[1])))
    loaded.config.set_dataset_feature_metadata(CONTINUOUS_FEATURES)  # fine-tuning: the columns are the same
    assert loaded.config.features["task"][0].labels == TASKS


def test_asked_for_each_task_it_does_that_one_and_with_the_task_hidden_the_mixture():
    policy = make(context_length=2, optimizer_lr=1e-2, continuous_head="l2").train()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-2)
    generator = torch.Generator().manual_seed(0)
    mean, std = (torch.tensor(CONTINUOUS_STATS["action"][key]) for key in ("mean", "std"))
    state = torch.tensor(CONTINUOUS_STATS["observation.state"]["mean"])
    for _ in range(150):
        which = torch.randint(0, 2, (32,), generator=generator)
        action = mean + std * (2 * which - 1)[:, None, None] * torch.ones(32, 2, 1)
        batch = {"observation.state": state.expand(32, 2, 3), "action": action, "index": torch.arange(32)}
        batch |= {"observation.return_to_go": torch.zeros(32, 2, 1), "task": [TASKS[i] for i in which.tolist()]}
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        policy.update()
    policy.eval()
    observed = {"observation.state": state.expand(2, 3)}
    did = (policy.select_action(observed | {"task": TASKS}) - mean) / std
    assert did[0].max() < -0.7
    assert did[1].min() > 0.7
    policy.reset()
    hidden = (policy.select_action(observed, mask="a[t] | s[:t+1], a[:t]") - mean) / std
    assert hidden.abs().max() < 0.5
