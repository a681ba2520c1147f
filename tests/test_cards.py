"""Cards: everything that a stranger needs, in Markdown with valid metadata."""

import io
import json
import re
import shutil
from pathlib import Path

import pytest
import yaml
from PIL import Image

from dataset_builders.maze2d import build_maze2d
from lerobot_unimask.data.episodes import check_folder
from lerobot_unimask.envs.doorkey.record import DOORKEY
from lerobot_unimask.envs.maze2d.record import MAZE2D
from lerobot_unimask.sharing import cards

TRAIN_CONFIG = {"dataset": {"repo_id": "me/doorkey", "root": None}, "env": {"type": "doorkey"}}


def read(files: dict[str, bytes]) -> tuple[dict, str]:
    """A card's metadata and text; every picture that it shows is there and opens."""
    text = files["README.md"].decode()
    _, metadata, body = text.split("---\n", 2)
    for name, data in files.items():
        if name.endswith(".png"):
            assert f"]({name})" in body
            assert max(Image.open(io.BytesIO(data)).size) < 1200
            assert len(data) < 200_000
    return yaml.safe_load(metadata), body


def card(policy, repo_id="me/policy", results=(), **told):
    """A policy's card from the facts that pushing takes off it."""
    facts = cards.PolicyFacts(policy.config, policy.training_masks.weights, parameters=1000, updates=7, **told)
    return cards.policy_card(facts, repo_id, results)


def test_a_policy_s_card_draws_the_questions_it_was_trained_on(tiny_policy):
    policy = tiny_policy(training_masks={"goal_conditioned": 3, "s[1:9] | s[0]": 1, "random_mask": 4})
    metadata, body = read(card(policy, "me/policy", train_config=TRAIN_CONFIG, command="lerobot-train x"))
    found = [metadata[name] for name in ("library_name", "license", "pipeline_tag")]
    assert found == ["lerobot", "apache-2.0", "robotics"]
    assert metadata["datasets"] == ["me/doorkey"]
    assert "goal_conditioned (38%): a[t] | s[:t+1], a[:t], s[-1]   at t = 5" in body
    assert "s ######...#  a #####?....  rtg .........." in body
    assert "question (12%): s[1:9] | s[0]\n    s #????????.  a ..........  rtg ..........\n" in body
    assert "random_mask (50%)" in body
    assert "| `s` | `observation.state` | 2 | agent_cell, key_cell | 16 x 16 categories |" in body
    assert "Context length: 10 steps." in body
    assert "lerobot-train x" in body
    assert "lerobot-eval --policy.path=me/policy --env.type=doorkey" in body
    assert "--episode=0 --mask=goal_conditioned --t=5\n" in body


@pytest.mark.parametrize("masks", [["random_mask", "past"], "random_mask"])
def test_the_question_to_try_is_one_that_can_be_asked(tiny_policy, masks):
    body = read(card(tiny_policy(training_masks=masks), "me/policy"))[1]
    assert f"--mask={'past' if len(masks) == 2 else 'behavior_cloning'} --t=" in body


def test_a_policy_s_card_says_which_data(tiny_policy):
    policy = tiny_policy()
    local = {"dataset": {"repo_id": "local/doorkey", "root": "data/door key"}, "env": None}
    metadata, body = read(card(policy, "me/policy", train_config=local))
    assert "datasets" not in metadata
    assert "`local/doorkey`, local" in body
    assert "--dataset.root='data/door key'" in body
    assert "lerobot-train --config_path=me/policy" in body
    policy.config.dataset_revision = "c0ffee"
    pulled = {"dataset": {"repo_id": "me/doorkey", "root": None}, "env": None}
    assert "`me/doorkey`, at revision `c0ffee`" in read(card(policy, "me/p", train_config=pulled))[1]
    assert "How it was trained was not saved" in read(card(policy, "me/p"))[1]


def test_a_policy_s_card_has_the_results_that_it_is_given(tiny_policy):
    folder = Path(__file__).parent.parent / "docs" / "results"
    names = ("doorkey_20000.json", "doorkey_20000_most_likely.json")
    records = [json.loads((folder / name).read_text()) for name in names]
    body = read(card(tiny_policy(), "me/policy", results=records))[1]
    assert f"| `past` | {records[0]['mean']['past']:.3f} |" in body
    assert "Rollouts: 1,000 episodes" in body
    with pytest.raises(ValueError, match="unimask validate"):
        card(tiny_policy(), "me/policy", results=[{"loss": 1}])


def test_the_card_of_a_continuous_model_without_data(tiny_policy):
    body = read(card(tiny_policy("gaussian", context_length=5), "me/policy"))[1]
    assert "| `s` | `observation.state` | 3 | x, y, goal | continuous |" in body
    assert "--env.type=YOUR_ENVIRONMENT" in body


def test_a_dataset_s_card_says_how_it_was_made(doorkey_root):
    metadata, body = read(cards.dataset_card(doorkey_root, "me/doorkey", DOORKEY))
    assert metadata["license"] == "apache-2.0"
    assert metadata["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    for words in ("4 x 4 cells", "- expert: paper: noisily rational", "seed 0", "- episodes: 30, 300 steps"):
        assert words in body
    for column in json.loads((doorkey_root / "meta" / "info.json").read_text())["features"]:
        assert f"| `{column}` |" in body
    assert "lerobot-train --policy.type=unimask --policy.push_to_hub=false --dataset.repo_id=me/doorkey" in body


def test_maze2d_s_card(tmp_path):
    root = build_maze2d(tmp_path / "maze", episodes=2, noise=0.25, maze="umaze", progress=False)
    body = read(cards.dataset_card(root, "me/maze", MAZE2D))[1]
    assert "- settings: noise 0.25, maze umaze, seed 0" in body
    assert "Maze2D, a point mass" in body


def test_any_other_dataset_has_a_card_too(doorkey_root, tmp_path):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_bytes((doorkey_root / "meta" / "info.json").read_bytes())
    files = cards.dataset_card(tmp_path, "me/other")
    assert set(files) == {"README.md"}
    assert "agent_cell, key_cell" in read(files)[1]


HOSTILE = "a\n# no title\n```\n<script>alert(1)</script> | [link](https://evil.example) `code`"


def test_nothing_that_a_name_holds_becomes_markdown_or_html(tiny_policy):
    """Names, datasets, environments, commands and tasks of a policy's card, each as in a file that somebody made."""
    features = {
        "observation.state": {"dtype": "float32", "shape": (2,), "names": [HOSTILE, "plain"]},
        "action": {"dtype": "float32", "shape": (1,), "names": [HOSTILE]},
    }
    stats = {"observation.state": {"mean": [0, 0], "std": [1, 1]}, "action": {"mean": [0], "std": [1]}}
    policy = tiny_policy("gaussian", features=features, stats=stats)
    told = {"dataset": {"repo_id": HOSTILE, "root": HOSTILE}, "env": {"type": HOSTILE}}
    losses = {"mean": {HOSTILE: 1.0}, "validation_episodes": 3, "runs": [1]}
    check_tame(card(policy, "me/policy", results=[losses], train_config=told, command=f"lerobot-train '{HOSTILE}'"))


@pytest.mark.parametrize("field", ["expert", "command", "seed", "beta", "package_version", "names", "dtype", "column"])
def test_nothing_that_a_dataset_s_files_hold_becomes_markdown_or_html(doorkey_root, tmp_path, field):
    root = tmp_path / "dataset"
    shutil.copytree(doorkey_root, root)
    info, provenance = (json.loads((root / "meta" / f"{name}.json").read_text()) for name in ("info", "provenance"))
    if field in ("names", "dtype", "column"):
        names, dtype = [HOSTILE] if field == "names" else None, HOSTILE if field == "dtype" else "float32"
        info["features"][HOSTILE if field == "column" else "extra"] = {"dtype": dtype, "shape": [1], "names": names}
    else:
        provenance[field] = HOSTILE
    (root / "meta" / "info.json").write_text(json.dumps(info))
    (root / "meta" / "provenance.json").write_text(json.dumps(provenance))
    check_tame(cards.dataset_card(root, "me/doorkey", DOORKEY))


def check_tame(files: dict[str, bytes]) -> None:
    """Outside of code, none of the markup of `HOSTILE`; and no line of it ends a block of code."""
    body = read(files)[1]
    assert "alert" in body
    outside, fence = [], ""
    for line in body.splitlines():
        run = re.match("`{3,}", line)
        if run and not fence:
            fence = run[0]
        elif line == fence:
            fence = ""
        elif not fence:
            outside.append(re.sub("`[^`]*`", "", line.replace("\\`", "")))
    assert not fence
    text = "\n".join(outside)
    assert "<script" not in text
    assert "\n# no title" not in text
    assert not re.search(r"(?<!\\)\[link(?<!\\)\]", text)
    tables = [line for line in outside if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in tables} <= {3, 5, 6}


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        *(("fps", value) for value in ("10", None, 0, -1, 1e30, True, [10])),
        *(("features", value) for value in ([], None, "all", {"a": 1}, {"a": {"dtype": "float32", "shape": "big"}})),
        *(("features", {"a": {"dtype": 3, "shape": [1]}}) for _ in range(1)),
        *(("features", {"a": {"dtype": "float32", "shape": [size]}}) for size in (-1, 0, 10**30, "2")),
        *((name, value) for name in ("total_episodes", "total_frames") for value in ("3", -1, 10**30, None, 1.5)),
        *(("chunks_size", value) for value in (0, -1, 10**30, "1000")),
        ("codebase_version", 3),
        *(
            ("data_path", value)
            for value in (
                "../../secret.parquet",
                "/etc/passwd",
                "data/../../x",
                "data\\..\\..\\x",
                "data/{chunk_index:9999999999d}.parquet",
                "{chunk_index.__class__}",
                "{x}",
                "{",
                7,
            )
        ),
        ("video_path", "../{video_key}.mp4"),
    ],
)
def test_an_entry_of_info_json_that_cannot_be_is_named(doorkey_root, tmp_path, entry, value):
    (tmp_path / "meta").mkdir()
    info = json.loads((doorkey_root / "meta" / "info.json").read_text())
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info | {entry: value}))
    with pytest.raises(ValueError, match=rf"info.json has {entry}"):
        cards.dataset_card(tmp_path, "me/other")
    with pytest.raises(ValueError, match=rf"info.json has {entry}"):
        check_folder(tmp_path)


@pytest.mark.parametrize("text", ["[]", "3", '"x"', "{", "[" * 10_000, "\x00"])
def test_an_info_json_that_is_no_mapping_is_named(tmp_path, text):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(text)
    with pytest.raises(ValueError, match=r"info\.json"):
        check_folder(tmp_path)
