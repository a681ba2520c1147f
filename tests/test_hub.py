"""Checkpoints that other people made: what is wrong with them ends in one error, and nothing of theirs is run.

Pushing and pulling need a process of their own, see `hub_flow.py`.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hub_server import Hub
from policies import SMALL_FLAGS

from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.configuration_unimask import FORMAT_VERSION

FLOW = Path(__file__).with_name("hub_flow.py")


def test_everything_by_way_of_a_hub():
    """The tests of hub_flow.py and hub_refusals.py, whose huggingface_hub is imported for the loopback server."""
    flags = ["-q", "--show-capture=no", "-p", "no:cacheprovider", "-p", "no:randomly", "--noconftest"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("HF_", "PYTEST_"))}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *flags, FLOW, FLOW.with_name("hub_refusals.py")],
        cwd=FLOW.parent.parent,
        env={**environment, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=580,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


@pytest.mark.slow
def test_the_console_scripts_with_a_hub_and_then_without(tmp_path):
    """Each command a process of its own, as a user runs it; in the end HF_HUB_OFFLINE=1, and no server at all."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
    environment |= {"HF_HOME": str(tmp_path / "home"), "HF_HUB_DISABLE_XET": "1", "OMP_NUM_THREADS": "1"}

    def run(name: str, *arguments: str, status: int = 0, **variables: str) -> str:
        script = Path(sys.executable).with_name(name)
        done = subprocess.run(
            [script, *arguments], cwd=tmp_path, env={**environment, **variables}, capture_output=True, text=True
        )
        assert done.returncode == status, done.stderr[-3000:]
        return done.stderr if status else done.stdout

    train = ["--policy.device=cpu", "--num_workers=0", "--batch_size=8", "--steps=2", "--dataset.repo_id=me/data"]
    query = ["query", "--policy.path=me/policy", "--dataset.repo_id=me/data", "--episode=0", "--mask=past", "--t=3"]
    evaluate = ["--policy.path=me/policy", "--env.type=doorkey", "--eval.n_episodes=1", "--eval.batch_size=1"]
    with Hub({"token": "me"}) as hub:
        environment |= {"HF_ENDPOINT": hub.endpoint, "HF_TOKEN": "token"}
        run("unimask", "build", "doorkey", "--episodes=20", "--root=data", "--repo_id=me/data", "--push_to_hub=true")
        flags = ["--policy.type=unimask", "--policy.repo_id=me/policy", *SMALL_FLAGS, *train, "--output_dir=run"]
        run("lerobot-train", *flags)
        assert "lerobot-train --policy.type=unimask" in hub.model("me/policy").files["README.md"].decode()
        answer = run("unimask", *query, "--json")
    offline = {"HF_HUB_OFFLINE": "1"}
    assert run("unimask", *query, "--json", **offline) == answer
    run("lerobot-eval", *evaluate, "--output_dir=eval", **offline)
    flags = ["--policy.path=me/policy", "--policy.push_to_hub=false", *train, "--output_dir=tuned"]
    run("lerobot-train", *flags, **offline)
    said = run("unimask", "query", "--policy.path=me/other", status=2, **offline)
    assert "me/other" in said
    assert "HF_HUB_OFFLINE=1" in said


@pytest.fixture
def checkpoint(tiny_policy, tmp_path):
    tiny_policy().save_pretrained(tmp_path / "checkpoint")
    return tmp_path / "checkpoint"


def change(checkpoint: Path, **settings: object) -> None:
    path = checkpoint / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **settings}))


CODE = "__import__('pathlib').Path('ran').touch()"
WRONG = {
    "an unknown field": ({"learning_speed": 1}, "`learning_speed` are not valid for UniMASKConfig"),
    "a wrong type": ({"width": "wide"}, "`width`: Couldn't parse 'wide' into an int"),
    "a list for a number": ({"context_length": [10]}, "context_length"),
    "width of 1000000000": ({"width": 10**9}, "width is 1000000000; it must lie in 1 to"),
    "no depth": ({"depth": None}, "depth is None; it must lie in 1 to"),
    "no feedforward_width": ({"feedforward_width": None}, "feedforward_width is None; it must lie in 1 to"),
    "a factor's size": (
        {"features": {"s": [{"key": "observation.state", "size": 10**9}], "a": [{"key": "action", "size": 1}]}},
        "observation.state has size 1000000000",
    ),
    "a factor's negative size": (
        {"features": {"s": [{"key": "observation.state", "size": -4}], "a": [{"key": "action", "size": 1}]}},
        "observation.state has size -4",
    ),
    **{
        f"{count} categories": (
            {
                "features": {
                    "s": [{"key": "observation.state", "size": 1, "categories": [count]}],
                    "a": [{"key": "action", "size": 1}],
                }
            },
            f"observation.state has {count} categories",
        )
        for count in (10**9, 0, -1)
    },
    "a mask that does not parse": ({"training_masks": "a[t] | s[:t+"}, "a[t] | s[:t+"),
    "a mask that is code": ({"inference_mask": CODE}, "__import__"),
    "a list of masks of code": ({"training_masks": [CODE]}, "__import__"),
    "a newer format": ({"format_version": 7, "clock": "on"}, "This checkpoint has format 7; lerobot_policy_unimask"),
    "no format": ({"format_version": "newest"}, "'newest' is not a format's number"),
}


@pytest.mark.parametrize(("settings", "words"), WRONG.values(), ids=WRONG)
def test_a_wrong_config_ends_in_one_error(checkpoint, settings, words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    change(checkpoint, **settings)
    with pytest.raises(ValueError, match=r"config\.json") as error:
        UniMASKPolicy.from_pretrained(checkpoint)
    assert words in str(error.value)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["an unknown field", "a mask that does not parse"])
def test_lerobot_eval_refuses_it_too(checkpoint, name, monkeypatch, tmp_path, capsys):
    from lerobot.scripts import lerobot_eval

    settings, words = WRONG[name]
    change(checkpoint, **settings)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={checkpoint}", "--env.type=doorkey"])
    with pytest.raises((SystemExit, Exception)) as error:
        lerobot_eval.main()
    # LeRobot prints one line and ends, or lets the sentence stand as the cause at the end of its traceback.
    causes = [error.value]
    while causes[-1].__cause__ is not None:
        causes.append(causes[-1].__cause__)
    assert words in capsys.readouterr().err + "".join(map(str, causes))


@pytest.mark.parametrize(
    "sizes", [{"width": 65536}, {"depth": 512}, {"feedforward_width": 262144}, {"width": 65536, "depth": 100}]
)
def test_sizes_that_the_weights_do_not_have_are_refused_before_anything_is_allocated(checkpoint, sizes, monkeypatch):
    change(checkpoint, **sizes)
    monkeypatch.setattr(UniMASKPolicy, "__init__", None)  # is not even begun
    began = time.process_time()
    with pytest.raises(ValueError, match=r"model\.safetensors"):
        UniMASKPolicy.from_pretrained(checkpoint)
    assert time.process_time() - began < 5


def test_a_config_that_is_no_json_ends_in_one_error(checkpoint):
    (checkpoint / "config.json").write_text('{"type": "unimask",')
    with pytest.raises(ValueError, match=r"config\.json"):
        UniMASKPolicy.from_pretrained(checkpoint)


def test_a_saved_config_has_the_format(checkpoint):
    assert json.loads((checkpoint / "config.json").read_text())["format_version"] == FORMAT_VERSION
    assert UniMASKPolicy.from_pretrained(checkpoint).config.format_version == FORMAT_VERSION
