"""`unimask query`: its table and JSON are the policy's answers, and whoever mistypes is told what would have worked."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from policies import MAZE, MAZE_STATS, without_return

from lerobot_unimask import UniMASKPolicy, cli, query
from lerobot_unimask.data.episodes import read_window
from lerobot_unimask.envs.doorkey.expert import expert_probabilities
from lerobot_unimask.envs.doorkey.optimum import exact_answer
from lerobot_unimask.envs.doorkey.rules import DynamicsCheck
from lerobot_unimask.envs.maze2d.maze import parse_maze
from lerobot_unimask.language.masks import tabulate
from lerobot_unimask.query import Sampling
from lerobot_unimask.sharing import hub

MASK = "s[1:4], a[:2] | s[0], s[4]"


@pytest.fixture(scope="module")
def checkpoint(tiny_policy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy") / "checkpoint"
    tiny_policy().save_pretrained(folder)
    return folder


@pytest.fixture
def ask(checkpoint, doorkey_root, capsys):
    """ask("--mask=...", episode=3) -> what `unimask query` prints."""

    def run(*flags, episode=None):
        data = [] if episode is None else [f"--dataset.root={doorkey_root}", f"--episode={episode}"]
        cli.main(["query", f"--policy.path={checkpoint}", *data, *flags])
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(refused, checkpoint, doorkey_root):
    """refused("--mask=...") -> the error; `{data}` stands for the flag that names the dataset."""

    def run(*flags, path=checkpoint, command="query"):
        flags = [flag.replace("{data}", f"--dataset.root={doorkey_root}") for flag in flags]
        return refused(command, f"--policy.path={path}", *flags)

    return run


# --- Answers ---------------------------------------------------------------------------------------------------------


def test_the_json_holds_the_policys_answer_and_all_that_decides_it(ask, tiny_policy, doorkey, checkpoint, doorkey_root):
    result = json.loads(ask(f"--mask={MASK}", "--json", episode=3))
    assert result["policy"] == {"path": str(checkpoint), "revision": None, "updates": 0}
    assert (result["mask"], result["t"], result["given"]) == (MASK, None, {})
    assert result["data"] == {"root": str(doorkey_root), "repo_id": None, "episode": 3, "start": 0}
    policy = tiny_policy()
    batch = read_window(doorkey, 3)
    answer, window = policy.infer(batch, MASK), policy.make_window(batch)
    asked = [("s", 1, 0), ("s", 1, 1), ("s", 2, 0), ("s", 2, 1), ("s", 3, 0), ("s", 3, 1), ("a", 0, 0), ("a", 1, 0)]
    asked.sort(key=lambda token: (token[1], token[0] == "a"))
    names = {"s": ["agent_cell", "key_cell"], "a": ["direction"]}
    assert [(row["token"], row["component"]) for row in result["answers"]] == [
        (f"{name}[{step}]", names[name][i]) for name, step, i in asked
    ]
    for row, (name, step, i) in zip(result["answers"], asked, strict=True):
        probabilities = answer[name][i].probabilities[0, step]
        assert row["probabilities"] == pytest.approx(probabilities.tolist())
        assert row["most_likely"] == probabilities.argmax().item()
        assert row["probability"] == pytest.approx(probabilities.max().item())
        assert row["recorded"] == window.values[name][0, step, i].item()


def test_the_table_has_a_row_for_each_component(ask):
    said = ask(f"--mask={MASK}", episode=3)
    assert "s #???#.....  a ??........" in said
    assert "episode 3 of" in said
    table = said[said.index("step  factor") :].splitlines()
    assert table[0].split() == ["step", "factor", "component", "most", "likely", "probability", "recorded"]
    assert len(table) == 9
    assert all(len(row.split()) == 6 for row in table[1:])


def test_values_need_no_dataset(ask, tiny_policy):
    given = {"s[0]": [0, 9], "s[-1]": [15, 15]}
    result = json.loads(ask("--mask=s[4] | s[0], s[-1]", f"--given={json.dumps(given)}", "--json"))
    expected = tiny_policy().infer(None, "s[4] | s[0], s[-1]", given=given)
    assert result["given"] == given
    assert result["data"] is None
    for i, row in enumerate(result["answers"]):
        assert row["probability"] == pytest.approx(expected["s"][i].probabilities[0, 4].max().item())
        assert row["recorded"] is None


def test_a_window_may_start_later_and_what_lies_past_the_end_is_not_asked(ask, tiny_policy, doorkey):
    result = json.loads(ask("--mask=future", "--t=1", "--start=7", "--json", episode=2))
    assert [row["token"] for row in result["answers"] if row["component"] == "direction"] == ["a[1]", "a[2]"]
    batch = read_window(doorkey, 2, 7)
    expected = tiny_policy().infer(batch, "future", t=1)["a"][0].probabilities[0, 2]
    assert result["answers"][-1]["probabilities"] == pytest.approx(expected.tolist())


def test_the_exact_optimum_answers_the_same_question(ask, tiny_policy, doorkey):
    question = "s[1:], a[:] | s[0]"
    flags = (f"--mask={question}", "--start=6", '--given={"s[0]": [12, 12]}', "--exact=paper")
    result = json.loads(ask(*flags, "--json", episode=2))
    assert result["exact"] == "paper"
    window = tiny_policy().make_window(read_window(doorkey, 2, 6))
    window.values["s"][0, 0] = 12
    mask = tabulate(question, tuple(window.values), 10).at(None).within(window.valid)
    exact = exact_answer(window, mask, first_step=6)
    for row in result["answers"]:
        name, i = row["token"][0], ["agent_cell", "key_cell", "direction"].index(row["component"]) % 2
        probabilities = exact[name][i].probabilities[0, row["step"]]
        assert row["exact"]["probabilities"] == pytest.approx(probabilities.tolist())
        assert row["exact"]["probability"] == pytest.approx(probabilities.max().item())
    said = ask(*flags, episode=2)
    assert "for data of the expert 'paper'" in said
    table = said[said.index("step  factor") :].splitlines()
    assert " ".join(table[0].split()) == "step factor component most likely probability exact probability recorded"
    assert table[1].split()[5:7] == [
        str(result["answers"][0]["exact"]["most_likely"]),
        f"{result['answers'][0]['exact']['probability']:.3f}",
    ]
    assert "exact" not in json.loads(ask("--mask=s[1] | s[0]", "--json", episode=2))["answers"][0]


def test_the_optimum_is_that_of_the_expert_that_is_named(tiny_policy):
    """Up is a bump from there, which the two count differently."""
    given = {"s[0]": [0, 5]}
    up = {
        expert: query.ask(tiny_policy(), "a[0] | s[0]", given=given, exact=expert).best["a"][0].probabilities[0, 0, 3]
        for expert in ("paper", "released")
    }
    for expert, probability in up.items():
        expected = expert_probabilities(np.array(0), np.array(5), np.array(False), expert=expert)[3]
        assert probability.item() == pytest.approx(expected)
    assert up["paper"] != pytest.approx(up["released"].item(), abs=0.01)


def test_only_doorkey_has_an_exact_optimum(tiny_policy, continuous_batch):
    batch = {key: value[:1] for key, value in continuous_batch.items()}
    with pytest.raises(ValueError, match="no exact optimum 'paper'"):
        query.ask(tiny_policy("continuous"), "s[1] | s[0]", batch=batch, exact="paper")


def test_samples_follow_the_policy_and_count_what_was_rejected(ask, tiny_policy, doorkey):
    flags = ("--mask=a[:3] | s[:4]", "--sample=50", "--order=backward", "--seed=4", "--check=dynamics")
    result = json.loads(ask(*flags, "--json", episode=0))
    drawn = tiny_policy().sample(
        read_window(doorkey, 0), "a[:3] | s[:4]", samples=50, order="backward", seed=4, check=DynamicsCheck()
    )
    sampling = result["sampling"]
    assert {name: sampling[name] for name in ("samples", "order", "seed", "check")} == {
        "samples": 50,
        "order": "backward",
        "seed": 4,
        "check": "dynamics",
    }
    assert (sampling["drawn"], sampling["rejected"]) == (drawn.drawn, drawn.rejected)
    assert drawn.rejected > 0
    actions = torch.tensor(
        [[step[0] if step[0] is not None else -1 for step in one] for one in sampling["values"]["a"]]
    )
    assert torch.equal(actions[:, :3], drawn.values["a"][:, :3, 0])
    for row in result["answers"]:
        assert row["share"] == pytest.approx((actions[:, row["step"]] == row["most_frequent"]).float().mean().item())
    said = ask(*flags, episode=0)
    assert f"{drawn.rejected} of {drawn.drawn} drawn tokens rejected" in said
    assert "most frequent" in said


def test_continuous_answers_have_means_and_scales(tiny_policy, continuous_batch):
    policy = tiny_policy("gaussian")
    batch = {key: value[:1] for key, value in continuous_batch.items()}
    reply = query.ask(policy, "s[1] | s[0]", batch=batch)
    answer, recorded = policy.infer(batch, "s[1] | s[0]")["s"][0], batch["observation.state"][0, 1]
    rows = query.rows(policy, reply)
    assert [row["component"] for row in rows] == ["x", "y", "goal"]
    for i, row in enumerate(rows):
        assert row["mean"] == pytest.approx(answer.mean[0, 1, i].item())
        assert row["scale"] == pytest.approx(answer.scale[0, 1, i].item())
        assert row["recorded"] == pytest.approx(recorded[i].item())
    sampling = Sampling(20)
    reply = query.ask(policy, "s[1] | s[0]", batch=batch, sampling=sampling)
    result = query.record(policy, reply)
    assert "±" in query.describe(json.loads(json.dumps(result)))
    assert query.rows(policy, query.ask(tiny_policy("continuous"), "s[1] | s[0]", batch=batch))[0]["scale"] is None


def test_without_a_mask_it_lists_what_can_be_asked(ask, tiny_policy, doorkey):
    said = ask()
    for word in ("behavior_cloning", "a[t] | s[:t+1], a[:t]", "s ####......  a ###?......", "agent_cell", "rtg[0]"):
        assert word in said
    result = json.loads(ask("--json"))
    assert result["factors"]["a"] == [{"component": "direction", "categories": 4}]
    assert result["factors"]["rtg"][0].keys() == {"component", "mean", "std"}
    tasks = query.overview(tiny_policy(features=without_return(doorkey)))["tasks"]
    assert "reward_conditioned" not in [task["name"] for task in tasks]


# --- Pictures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "flags",
    [
        ["--mask=s[:] | s[0]"],
        ["--mask=s[1], a[:] | s[0]"],
        ["--mask=s[:], a[:] | s[0]", "--sample=3"],
        ["--mask=a[:3] | s[0]", "--sample=3"],
    ],
    ids=["states", "anything", "trajectories", "samples of anything"],
)
def test_every_answer_can_be_drawn(flags, ask, tmp_path):
    picture = tmp_path / "new" / "answer.png"
    assert f"drawn into {picture}" in ask(*flags, f"--plot={picture}", episode=1)
    assert Image.open(picture).width > 400


def test_a_maze_is_drawn_with_the_walls_of_its_data(tiny_policy, tmp_path):
    source = query.Source(tmp_path, tmp_path, None, episode=0, start=0)
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "provenance.json").write_text('{"maze": "umaze"}')
    policy = tiny_policy("continuous", features=MAZE, stats=MAZE_STATS)
    reply = query.ask(policy, "s[1:] | s[0]", given={"s[0]": [1, 1, 2, 2]}, source=source)
    drawn = query.picture(policy, reply)
    assert len(drawn.axes[0].patches) == "".join(parse_maze("umaze").rows).count("#")


def test_with_json_only_the_json_is_printed(ask, tmp_path):
    json.loads(ask("--mask=s[1] | s[0]", "--json", f"--plot={tmp_path / 'a.png'}", episode=1))


# --- Where policies come from ----------------------------------------------------------------------------------------


def test_a_policy_of_the_hub_is_named_with_its_commit(tiny_policy, tmp_path, monkeypatch):
    commit = "0123456789abcdef0123456789abcdef01234567"
    folder = tmp_path / "models--me--doorkey" / "snapshots" / commit
    tiny_policy().save_pretrained(folder)
    asked = []
    monkeypatch.setattr(
        hub, "fetch", lambda repo_id, *, revision=None, **_: asked.append((repo_id, revision)) or folder
    )
    assert UniMASKPolicy.from_pretrained("me/doorkey", revision="main").origin == ("me/doorkey", commit)
    assert asked == [("me/doorkey", "main")]


# --- Mistakes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--masks=past"], "Did you mean --mask?"),
        (["--mask=past", "--t=1", "{data}", "--episode=30"], "0 to 29"),
        (["--mask=past", "--t=1", "{data}", "--episode=-1"], "no episode -1"),
        (["--mask=past", "--t=1", "{data}", "--episode=3", "--start=10"], "0 to 9"),
        (["--mask=past"], "t=3"),
        (["--mask=past", "--t=12"], "1, 2, 3"),
        (["--mask=s[3] | s[0]", "--t=1"], "t=1"),
        (["--mask=pasta", "--t=1"], "Did you mean 'past'?"),
        (["--mask=q[1] | s[0]"], "Its factors are s, a, rtg"),
        (["--mask=s[10] | s[0]"], "0 to 9"),
        (["--mask=s[5] | s[0]", "{data}", "--episode=3", "--start=8"], "Start earlier"),
        (["--mask=s[1] | s[0]"], "s[0]"),
        (["--mask=s[1] | s[0]", '--given={"s[0]": [16, 0]}'], "agent_cell is a category from 0 to 15"),
        (["--mask=s[1] | s[0]", '--given={"s[0]": [[1, 2], [3, 4]]}'], "one value for each token"),
        (["--mask=s[1] | s[0]", "--given=s[0]"], "not JSON"),
        (["--mask=s[1] | s[0]", "--given=[0]"], "no JSON object"),
        (["--mask=s[1] | s[0]", "{data}"], "--dataset.root is given without --episode=N"),
        (["--mask=s[1] | s[0]", "--episode=1"], "--episode is given without --dataset.root=DIR"),
        (["--mask=s[1] | s[0]", "--order=forward"], "--order is given without --sample=N"),
        (["--t=1"], "--t is given without --mask"),
        (["--exact=paper"], "--exact is given without --mask"),
        (["--mask=s[1] | s[0]", "{data}", "--episode=1", "--exact=released"], "data of the expert 'paper'"),
        (["--mask=s[1] | s[0]", "--sample=2", "--exact=paper"], "leave out --sample or --exact"),
        (["--mask=s[1] | s[0]", '--given={"s[0]": [2, 0]}', "--exact=paper"], "cannot occur together in DoorKey"),
        (["--mask=s[1] | s[0]", "--dataset.root=nowhere", "--episode=1"], "nowhere holds no LeRobotDataset"),
        (["--mask=s[1] | s[0]", "{data}", "--episode=1", "--plot=answer.doc"], "--plot=answer.doc"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_told_what_would_have_worked(flags, expected, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert expected in refused(*flags)


def test_a_wrong_policy_is_told(refused, tmp_path):
    assert str(tmp_path) in refused(path=tmp_path)
    assert "ME/NAME" in refused(path="./no/where")
    (tmp_path / "config.json").write_text('{"type": "act"}')
    assert "'act'" in refused(path=tmp_path)


def test_only_doorkey_offers_its_dynamics(tiny_policy, continuous_batch):
    batch = {key: value[:1] for key, value in continuous_batch.items()}
    with pytest.raises(ValueError, match="'dynamics'"):
        query.ask(tiny_policy("continuous"), "s[1] | s[0]", batch=batch, sampling=Sampling(2, check="dynamics"))


# --- Goals of recorded episodes --------------------------------------------------------------------------------------


def test_goals_of_recorded_episodes_are_what_policy_given_takes(checkpoint, doorkey_root, doorkey, tiny_policy, capsys):
    flags = [f"--policy.path={checkpoint}", f"--dataset.root={doorkey_root}"]
    cli.main(["given", *flags, "--dataset.episodes=2:5", "--tokens=s[3], s[-1], rtg[0]"])
    given = json.loads(capsys.readouterr().out)
    states = torch.stack([doorkey[10 * episode]["observation.state"] for episode in (2, 3, 4)])
    assert given["s[3]"] == states[:, 3].tolist()
    assert given["s[-1]"] == states[:, 9].tolist()
    policy = tiny_policy(inference_mask="a[t] | s[:t+1], a[:t], s[3], s[-1], rtg[0]", given=given)
    policy.select_action({"observation.state": states[:, 0].float()})
    cli.main(["given", *flags, "--dataset.episodes=4"])
    assert json.loads(capsys.readouterr().out) == {"s[-1]": states[2:, 9].tolist()}
    cli.main(["given", *flags, "--dataset.episodes=2:5", "--tokens=s@7, s[3]"])  # of the episode, and of its window
    given = json.loads(capsys.readouterr().out)
    assert given == {"s@7": states[:, 7].tolist(), "s[3]": states[:, 3].tolist()}
    tiny_policy(given={"s@7": given["s@7"]}).select_action({"observation.state": states[:, 0].float()})


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--dataset.episodes=20:40"], "0 to 29"),
        (["--dataset.episodes=few"], "0:50 or 3,5,7"),
        (["--dataset.episodes=0:2", "--tokens=s[12]"], "0 to 9"),
        (["--dataset.episodes=0:2", "--tokens=s@500"], "500"),
        (["--dataset.episodes=0:2", "--tokens=goal"], "Expected '['"),
    ],
)
def test_goals_that_are_not_there_are_refused(flags, expected, refused):
    assert expected in refused("{data}", *flags, command="given")
