"""The command line: what it says, and that bad input ends in one clear line with nothing lost."""

from pathlib import Path

import pytest

import dataset_builders.doorkey
import dataset_builders.writer
from lerobot_unimask import cli


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with its contents."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# --- Asking for it ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "required: COMMAND"),
        (["biuld"], "invalid choice: 'biuld'"),
        (["build"], "required: ENVIRONMENT"),
        (["build", "doorkeys"], "invalid choice: 'doorkeys'"),
        (["build", "doorkey"], "required: --root"),
        (["build", "doorkey", "--root=d", "--episode=3"], "Did you mean --episodes?"),
        (["build", "doorkey", "--root=d", "--sed=3"], "Did you mean --seed?"),
        (["build", "doorkey", "--root=d", "--xyzzy"], "This command knows"),
        (["build", "doorkey", "--root=d", "--episodes=0"], "'0' is not a whole number of at least 1"),
        (["build", "doorkey", "--root=d", "--episodes=few"], "'few' is not a whole number of at least 1"),
        (["build", "doorkey", "--root=d", "--expert=best"], "choose from"),
        (["build", "doorkey", "--root=d", "--seed=-1"], "seed"),
        (["build", "doorkey", "--root=d", "--use_videos=false"], "there are none without --camera=true"),
        (["demo", "--ouput=d"], "Did you mean --output?"),
        (["validate", "--dataset.root=d"], "required: --policy.path"),
        (["validate", "--policy.path=r"], "Which dataset?"),
        (["validate", "--policy.path=r", "--dataset.root=d", "--dataset.rot=d"], "Did you mean --dataset.root?"),
    ],
    ids=" ".join,
)
def test_a_mistyped_command_says_what_is_meant(arguments, expected, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert expected in refused(*arguments)
    assert not files(tmp_path)


# --- Building --------------------------------------------------------------------------------------------------------


def test_build_makes_the_same_files_from_the_same_seed(tmp_path, capsys):
    for folder, seed in (("one", 3), ("two", 3), ("other", 4)):
        cli.main(["build", "doorkey", "--episodes=20", f"--seed={seed}", f"--root={tmp_path / folder / 'data'}"])
    said = capsys.readouterr().out.splitlines()
    assert said == [f"20 episodes in {tmp_path / folder / 'data'}" for folder in ("one", "two", "other")]
    one, two, other = (files(tmp_path / folder) for folder in ("one", "two", "other"))
    assert one == two
    assert one.keys() == other.keys()
    changed = {name for name in one if one[name] != other[name]}
    assert {"data/data/chunk-000/file-000.parquet", "data/meta/provenance.json"} <= changed


@pytest.mark.parametrize("place", [".", "thesis.txt"])
def test_build_refuses_a_place_that_is_taken_before_any_work(place, refused, tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_builders.doorkey, "rollout", None)
    (tmp_path / "thesis.txt").write_text("three years of work")
    said = refused("build", "doorkey", "--episodes=20", "--root", tmp_path / place)
    assert said.startswith(f"unimask: error: {(tmp_path / place).resolve()}")
    assert said.count("\n") == 1
    assert files(tmp_path) == {"thesis.txt": b"three years of work"}


@pytest.mark.parametrize(
    ("module", "function"),
    [(dataset_builders.doorkey, "rollout"), (dataset_builders.writer, "_write_provenance")],
    ids=["while rolling out", "while writing"],
)
def test_an_interrupted_build_leaves_nothing(module, function, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, function, interrupt)
    with pytest.raises(SystemExit, match="interrupted"):  # a text as the status: Python prints it and ends with 1
        cli.main(["build", "doorkey", "--episodes=20", f"--root={tmp_path / 'data'}"])
    assert list(tmp_path.iterdir()) == []


# --- Validating ------------------------------------------------------------------------------------------------------


@pytest.fixture
def checkpoint(tiny_policy, tmp_path):
    tiny_policy().save_pretrained(tmp_path / "checkpoint")
    return tmp_path / "checkpoint"


def test_validate_prints_each_tasks_loss_and_writes_the_record(checkpoint, doorkey_root, tmp_path, capsys):
    record = tmp_path / "results" / "validation.json"
    cli.main(["validate", f"--policy.path={checkpoint}", f"--dataset.root={doorkey_root}", f"--output={record}"])
    said = capsys.readouterr().out
    assert "forward_dynamics" in said
    assert "random_mask" in said
    assert '"command": "unimask validate --policy.path=' in record.read_text()
