"""The policies that come with the package: small, found by name, and as good as their cards say."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_unimask import TASKS, UniMASKPolicy, cli
from lerobot_unimask.envs.doorkey.comparison import beside_optimum
from lerobot_unimask.envs.doorkey.episodes import rollout
from lerobot_unimask.envs.doorkey.rules import GOAL
from lerobot_unimask.evaluating import rollout as evaluate
from lerobot_unimask.pretrained import FOLDERS
from lerobot_unimask.validation import foretold_properties

ROOT = Path(__file__).parents[1]
MOST = 4 * 2**20  # bytes


@pytest.mark.parametrize(("name", "config"), [("doorkey", "doorkey_20000_both"), ("maze2d", "maze2d_pretrained")])
def test_a_folder_is_small_and_says_how_it_was_made(name, config):
    assert sum(path.stat().st_size for path in FOLDERS[name].iterdir()) < MOST
    card, path = (FOLDERS[name] / "README.md").read_text(), f"configs/{config}.yaml"
    assert f"lerobot-train --config_path={path}" in card
    (build,) = (line for line in (ROOT / path).read_text().splitlines() if "unimask build" in line)
    assert build.removeprefix("#   uv run ") in card
    for file in FOLDERS[name].glob("*.json"):
        assert "/tmp" not in file.read_text()


@pytest.mark.parametrize("name", FOLDERS)
def test_its_folder_is_printed_without_loading_lerobot(name):
    """And lerobot-eval takes it: what is printed is the folder and nothing else."""
    code = f"""
import sys
from lerobot_unimask.cli import main
main(["pretrained", "{name}"])
sys.exit("torch" in sys.modules or "lerobot" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"{FOLDERS[name]}\n"


def test_a_query_takes_the_name(capsys):
    given = '{"s[0]": [0, 9]}'
    cli.main(["query", "--policy.path=doorkey", "--mask=a[0] | s[0]", f"--given={given}", "--exact=paper", "--json"])
    (row,) = json.loads(capsys.readouterr().out)["answers"]
    assert row["probabilities"] == pytest.approx(row["exact"]["probabilities"], abs=0.05)


def test_a_folder_of_that_name_wins(tiny_policy, tmp_path, monkeypatch):
    tiny_policy().save_pretrained(tmp_path / "doorkey")
    monkeypatch.chdir(tmp_path)
    assert UniMASKPolicy.from_pretrained("doorkey").config.width == 16
    monkeypatch.chdir(ROOT / "tests")
    assert UniMASKPolicy.from_pretrained("doorkey").folder == FOLDERS["doorkey"]


def test_doorkeys_answers_are_near_the_optimum():
    """On 200 fresh episodes."""
    played = rollout(200, np.random.default_rng(7))
    returns = torch.from_numpy(played.reward).flip(1).cumsum(1).flip(1)
    batch = {
        "observation.state": torch.from_numpy(np.stack([played.agent, played.key], axis=-1)[:, :10]),
        "action": torch.from_numpy(played.action),
        "observation.return_to_go": returns.float(),
        "observation.success": torch.from_numpy((played.agent == GOAL).any(1)).long()[:, None].expand(-1, 10),
        "index": torch.arange(200) * 10,
        "timestamp": torch.zeros(200),
    }
    policy = UniMASKPolicy.from_pretrained("doorkey")
    optimum, (distance,) = beside_optimum([policy], batch, list(TASKS), "paper")
    for task, apart in distance["divergence"].items():
        assert apart < 0.03 * optimum["expected_losses"][task] + 0.005, task
    with torch.no_grad():
        foretold = foretold_properties(policy, batch)["rtg"]
    for said, exact in zip(foretold, optimum["foretold"]["rtg"], strict=True):
        assert said["mean_absolute_error"] < 1.2 * exact["mean_absolute_error"], said["t"]


def test_doorkeys_card_says_what_was_measured():
    card = " ".join((FOLDERS["doorkey"] / "README.md").read_text().split())
    found = json.loads((ROOT / "docs/results/doorkey_pretrained.json").read_text())
    for task, apart in found["runs"][0]["divergence"].items():
        assert f"| `{task}` | {found['optimum']['expected_losses'][task]:.3f} | {apart:.3f} |" in card
    drawn = json.loads((ROOT / "docs/results/doorkey_pretrained_questions.json").read_text())["backward"]["unchecked"]
    assert f"{100 * drawn['possible_samples']:.1f} % are possible" in card
    rules = json.loads((ROOT / "docs/results/doorkey_pretrained_acts.json").read_text())["rules"]
    assert f"{rules['most_likely']['success']:.1%}".replace("%", " %") in card
    assert f"sampled ones return {rules['sampled']['mean_return']:.2f}" in card


def test_maze2d_acts_as_its_card_says():
    card = " ".join((FOLDERS["maze2d"] / "README.md").read_text().split())
    means = {}
    for name in ("imitation", "return"):
        (task,) = json.loads((ROOT / f"docs/results/maze2d_pretrained_{name}.json").read_text())["per_task"]
        returns = torch.tensor(task["metrics"]["sum_rewards"])
        means[name] = returns.mean().item()
        assert f"{means[name]:.2f} ± {returns.std() / len(returns) ** 0.5:.2f}" in card
    result = evaluate(FOLDERS["maze2d"], "maze2d", 20, batch_size=20, seed=1000)
    assert result["mean_return"] == pytest.approx(means["imitation"], abs=4 * result["standard_error"])
