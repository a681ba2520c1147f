"""`unimask demo`: the main job from end to end, in a few minutes on two cores.

It asks the policy that comes with the package the questions of the paper's gridworld figures and draws the answers.
Then it builds a DoorKey dataset, trains another policy with lerobot-train, mostly on random masks, evaluates it with
lerobot-eval and asks it the same. Every number that it prints is in its JSON.
"""

import dataclasses
import json
import multiprocessing
import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.scripts import lerobot_eval, lerobot_train
from matplotlib.figure import Figure
from tqdm import tqdm

from dataset_builders.doorkey import build_doorkey
from lerobot_unimask.asking.answers import Answer, DiscreteDistribution
from lerobot_unimask.data.episodes import first_windows, open_dataset
from lerobot_unimask.envs.doorkey.panels import DRAWN, Panel, five_panels, predicted_states
from lerobot_unimask.envs.doorkey.pictures import draw_panels, state_distributions
from lerobot_unimask.language.masks import TASKS
from lerobot_unimask.modeling_unimask import UniMASKPolicy
from lerobot_unimask.pretrained import FOLDERS
from lerobot_unimask.records import versions, write_json
from lerobot_unimask.validation import task_losses

EPISODES = 20_000

UNSEEN_EPISODES = 500

STEPS = 3000

ROLLOUTS = 200

# Just random masks would do, with more updates: they hit the questions of acting rarely.
MASKS = {"random_mask": 3, "goal_conditioned": 1, "reward_conditioned": 1}

COMMANDS = {"lerobot-train": lerobot_train.main, "lerobot-eval": lerobot_eval.main}

EXPERT = {"success_percent": 6.9, "mean_return": 3.04}


def run_demo(output: Path, *, steps: int = STEPS) -> dict:
    """Run all of it into `output` and return the record that it writes there as demo.json.

    Raises:
        FileExistsError: `output` exists and is not an empty folder; it is left as it was.
        ChildProcessError: one of LeRobot's commands failed; its log says why.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise FileExistsError(f"{output} exists and is not empty: give another folder, --output=DIR, or remove it.")
    output.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a process that has started OpenMP's threads must not be forked

    _say(1, "Asking the policy that comes with the package five questions, each one a mask, with the same weights")
    shipped = five_panels(UniMASKPolicy.from_pretrained(FOLDERS["doorkey"]))
    _report(shipped)
    _draw(output / "five_panels.png", draw_panels(shipped))

    _say(2, f"Building DoorKey: {EPISODES} training episodes of a noisy expert, {UNSEEN_EPISODES} to test on")
    data = build_doorkey(output / "data", episodes=EPISODES, seed=0)
    unseen = build_doorkey(output / "data_unseen", episodes=UNSEEN_EPISODES, seed=1)

    _say(3, f"Training another, {steps} updates with LeRobot's own training loop: mostly random masks")
    checkpoint = _train(output, data, steps, threads)

    _say(4, f"Evaluating it in the environment, {ROLLOUTS} episodes a question, with LeRobot's own evaluation loop")
    rollouts = _evaluate(output, checkpoint)

    _say(5, "Asking it the same questions, and others of episodes that it has not seen")
    policy = UniMASKPolicy.from_pretrained(checkpoint)
    panels = five_panels(policy)
    _report(panels)
    losses = task_losses(policy, first_windows(open_dataset(policy.config, unseen)), TASKS)
    for task, loss in losses.items():
        print(f"  {task:21} {TASKS[task]:34} loss {loss:.3f} nats on unseen episodes")
    answer = predicted_states(policy)
    _draw(output / "trained_five_panels.png", draw_panels(panels))
    _draw(output / "trained_state_distributions.png", state_distributions(answer))

    seconds = round(time.monotonic() - began, 1)
    record = {
        "seconds": seconds,
        "episodes": {"training": EPISODES, "unseen": UNSEEN_EPISODES},
        "updates": steps,
        "rollouts": rollouts,
        "drawn_rollouts": DRAWN,
        "expert": EXPERT,
        "loss_on_unseen_episodes": losses,
        "shipped_panels": [dataclasses.asdict(panel) for panel in shipped],
        "panels": [dataclasses.asdict(panel) for panel in panels],
        "state_distributions": _states(answer),
        "versions": versions(),
    }
    write_json(output / "demo.json", record, say=False)
    _close(output, checkpoint, seconds)
    return record


def _report(panels: Sequence[Panel]) -> None:
    """Each question, what came of it, and how often drawn actions do what it asks."""
    for panel in panels:
        achieved = ", ".join(f"{name} {values}" for name, values in panel.achieved.items())
        print(f"  {panel.name:16} {panel.question}  given {json.dumps(panel.given)}\n{'':19}{achieved}")
        if panel.share is not None:
            print(f"{'':19}of {DRAWN} rollouts with drawn actions {panel.share:.0%} do what is asked")


def _draw(path: Path, figure: Figure) -> None:
    figure.savefig(path, dpi=200)
    print(f"  {path}")


def _say(number: int, what: str) -> None:
    print(f"\n[{number}/5] {what}", flush=True)


def _train(output: Path, data: Path, steps: int, threads: int) -> Path:
    """The folder of the trained checkpoint."""
    _run(
        output / "train.log",
        "lerobot-train",
        "--policy.type=unimask",
        "--policy.push_to_hub=false",
        f"--policy.training_masks={json.dumps(MASKS)}",
        "--policy.context_length=10",  # a whole episode
        "--policy.attention=bidirectional",  # the paper's network: half as many tokens, so twice the updates in time
        "--policy.token_layout=stacked",
        "--policy.depth=2",
        "--policy.dropout=0",
        "--dataset.repo_id=local/doorkey",
        f"--dataset.root={data}",
        f"--steps={steps}",
        "--batch_size=100",
        f"--save_freq={steps}",
        f"--log_freq={max(steps // 6, 1)}",
        "--env_eval_freq=0",
        "--num_workers=0",
        f"--output_dir={output / 'train'}",
        total=steps,
        threads=threads,
    )
    return output / "train" / "checkpoints" / "last" / "pretrained_model"


def _evaluate(output: Path, checkpoint: Path) -> dict[str, dict]:
    """What lerobot-eval reports for the most likely actions and for sampled ones."""
    questions = {
        "imitation": [],
        "imitation, sampled actions": ["--policy.sample_actions=true"],
    }
    rollouts = {}
    for name, flags in questions.items():
        folder = output / "eval" / name.replace(", ", "_").replace(" ", "_")
        _run(
            output / "eval.log",
            "lerobot-eval",
            f"--policy.path={checkpoint}",
            "--env.type=doorkey",
            f"--eval.n_episodes={ROLLOUTS}",
            "--eval.batch_size=100",
            *flags,
            f"--output_dir={folder}",
        )
        overall = json.loads((folder / "eval_info.json").read_text())["overall"]
        rollouts[name] = {"success_percent": overall["pc_success"], "mean_return": overall["avg_sum_reward"]}
    for name, result in rollouts.items():
        print(f"  {name:27} success {result['success_percent']:5.1f} %, mean return {result['mean_return']:5.2f}")
    print(
        f"  (The expert itself: success {EXPERT['success_percent']} %, mean return {EXPERT['mean_return']}. "
        "Its most likely actions are far better than its own.)"
    )
    return rollouts


def _run(log: Path, script: str, *arguments: str, total: int | None = None, threads: int = 1) -> None:
    """One of LeRobot's console scripts, in a process of its own, which on Linux has imported everything already.

    Args:
        log: file that its output goes to.
        total: number of steps of which LeRobot counts those made, for a bar.
        threads: number that it computes with.

    Raises:
        ChildProcessError: it failed.
    """
    print(f"  {script}; its output is in {log}", flush=True)
    log.touch()
    context: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    process = context.Process(target=_become, args=(log, threads, script, *arguments))
    process.start()
    with tqdm(total=total, desc="  training", disable=None if total else True, leave=False) as bar:
        while process.is_alive():
            process.join(timeout=1)
            bar.update(_steps_made(log) - bar.n)
    if process.exitcode != 0:
        raise ChildProcessError(f"{script} failed, with status {process.exitcode}; {log} says why.")


def _become(log: Path, threads: int, script: str, *arguments: str) -> None:
    """Be a console script, with a log as output."""
    torch.set_num_threads(threads)
    sys.stdout = sys.stderr = log.open("a", buffering=1)
    for number in (1, 2):
        os.dup2(sys.stdout.fileno(), number)
    sys.argv = [script, *arguments]
    COMMANDS[script]()


def _steps_made(log: Path) -> int:
    """The number of steps that LeRobot's own bar shows last."""
    with log.open("rb") as file:
        file.seek(max(log.stat().st_size - 4096, 0))
        counts = re.findall(rb" (\d+)/\d+ \[", file.read())
    return int(counts[-1]) if counts else 0


def _states(answer: Answer) -> dict:
    """Each step's distribution of agent and key, and which steps were shown."""
    parts = (part for part in answer["s"] if isinstance(part, DiscreteDistribution))
    return {
        "shown": answer.mask.shown["s"][0].nonzero().flatten().tolist(),
        **{part.name: torch.round(part.probabilities[0], decimals=4).tolist() for part in parts},
    }


def _close(output: Path, checkpoint: Path, seconds: float) -> None:
    print(f"""
Done in {seconds:.0f} s; everything is in {output}. Look at {output}/five_panels.png first, the answers of the policy
that comes with the package; {output}/trained_five_panels.png has those of the one that was trained just now.
What to try next:

  uv run lerobot-eval --policy.path={checkpoint} --env.type=doorkey --eval.n_episodes=100 --eval.batch_size=50 \\
      --policy.inference_mask='a[t] | s[:t+1], a[:t], s[-1]' --policy.given='{{"s[-1]": [12, 12]}}'
  uv run lerobot-train --policy.path={checkpoint} --policy.push_to_hub=false --policy.training_masks=behavior_cloning \\
      --dataset.repo_id=local/doorkey --dataset.root={output}/data --steps=500 --num_workers=0
  uv run unimask validate --policy.path={output}/train --dataset.root={output}/data_unseen
""")
