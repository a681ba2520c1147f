"""Maze2D's expert, a waypoint controller, and the LeRobotDataset of its episodes (UniMASK, section 5.2)."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from dataset_builders.folders import refuse_existing
from dataset_builders.videos import CAMERA, camera_feature
from dataset_builders.writer import SUCCESS, SUCCESS_FEATURE, write_dataset
from lerobot_unimask.data.returns import return_to_go
from lerobot_unimask.envs.maze2d.environment import Maze2DEnv
from lerobot_unimask.envs.maze2d.expert import WaypointExpert, _clip
from lerobot_unimask.envs.maze2d.maze import ENV_ID, FPS, HORIZON, parse_maze, task_of
from lerobot_unimask.envs.maze2d.rendering import camera_picture

FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "goal_x", "goal_y"]},
    "observation.return_to_go": {"dtype": "float32", "shape": (1,), "names": ["return_to_go"]},
    SUCCESS: SUCCESS_FEATURE,
    "action": {"dtype": "float32", "shape": (2,), "names": ["force_x", "force_y"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


def collect_episodes(
    mazes: Sequence[str], episodes: int, seed: int, noise: float, progress: bool
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Run the expert for whole episodes, one in each maze in turn; N = 200 episodes, frames in order.

    Episode i depends only on (seed, i, its maze, noise), and its start and goal not on the noise.

    Returns:
        The columns (N, ...) `observation.state`, `action` (as the environment received it), `observation.success`,
        `next.reward` and `next.done`; and each episode's initial velocity, float32 (episodes, 2), which the state
        hides.
    """
    envs = [Maze2DEnv(maze) for maze in mazes]
    frames = episodes * HORIZON
    states = np.empty((frames, 4), np.float32)
    actions = np.empty((frames, 2), np.float32)
    rewards = np.empty((frames, 1), np.float32)
    success = np.empty((frames, 1), np.int64)
    initial_velocities = np.empty((episodes, 2), np.float32)
    frame = 0
    bar = tqdm(range(episodes), desc="Rolling out Maze2D", unit="episode", disable=None if progress else True)
    for episode in bar:
        env = envs[episode % len(envs)]
        start_seed, expert_seed = np.random.SeedSequence([seed, episode]).generate_state(2, np.uint64).tolist()
        observation, _ = env.reset(seed=start_seed)
        initial_velocities[episode] = env.velocity
        rng = np.random.default_rng(expert_seed)
        expert = WaypointExpert(env.maze, env.position, env.goal, rng)
        for noise_x, noise_y in rng.normal(0.0, noise, (HORIZON, 2)).tolist():
            action_x, action_y = expert.act(env.position, env.velocity)
            states[frame] = observation["agent_pos"]
            action = actions[frame]
            action[0], action[1] = _clip(action_x + noise_x), _clip(action_y + noise_y)
            observation, reward, _, _, info = env.step(action)
            rewards[frame] = reward
            frame += 1
        success[frame - HORIZON : frame] = info["is_success"]
    done = np.zeros((frames, 1), bool)
    done[HORIZON - 1 :: HORIZON] = True
    columns: dict[str, np.ndarray] = {"observation.state": states, "action": actions, SUCCESS: success}
    return {**columns, "next.reward": rewards, "next.done": done}, initial_velocities


def build_maze2d(
    root: str | Path,
    *,
    episodes: int,
    seed: int = 0,
    noise: float = 0.5,
    maze: str = "medium",
    repo_id: str | None = None,
    camera: bool = False,
    use_videos: bool = True,
    hide_goal: bool = False,
    progress: bool = True,
) -> Path:
    """Write the expert's episodes, 200 frames each at 100 frames per second, as a LeRobotDataset.

    The same arguments give the same episodes, and the first n of a larger build are those of a build of n. Provenance
    holds `initial_velocity`, one (vx, vy) per episode: with the first frame's x, y and goal, `Maze2DEnv.reset(options=
    {"position": ..., "velocity": ..., "goal": ...})` starts the episode again, and its stored actions replay it.

    Args:
        root: folder of the dataset: new, or an existing empty one.
        noise: standard deviation of the normal noise added to each action, before it is clipped to [-1, 1].
        maze: name or text of the maze, see `parse_maze`; or several, comma-separated, an episode of each in turn, each
            a task of its own.
        repo_id: name of the dataset, `ME/NAME`; `local/maze2d` if None.
        camera: whether there is `observation.images.top`, a video of the maze, the goal and the mass from above.
        use_videos: whether it is a video; else pictures in the table.
        hide_goal: whether the state is x and y, without the goal.
        progress: whether to show progress bars, on a terminal.

    Returns:
        The dataset's folder.

    Raises:
        FileExistsError: `root` exists and is not an empty folder; it is left as it was.
        ValueError: an argument is out of range, or the maze bad.
    """
    root = refuse_existing(root)  # now, rather than after the work
    if episodes < 1 or seed < 0:
        raise ValueError(f"episodes must be at least 1 and seed at least 0, got {episodes} and {seed}.")
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise is a standard deviation, a finite number from 0 up, got {noise}.")
    mazes = maze.split(",")
    columns, initial_velocities = collect_episodes(mazes, episodes, seed, noise, progress)
    lengths = np.full(episodes, HORIZON)
    states, features, pictures = columns["observation.state"], dict(FEATURES), {}
    if camera:
        shapes = {camera_picture(parse_maze(one), (1, 1), (1, 1)).shape for one in mazes}
        if len(shapes) > 1:
            raise ValueError(f"The camera's pictures are of one size, those of the mazes {maze} are not.")
        height, width, _ = shapes.pop()
        features[CAMERA] = camera_feature(height, width, use_videos=use_videos)
        pictures[CAMERA] = _pictures(mazes, states)
    if hide_goal:
        features["observation.state"] = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
        columns["observation.state"] = np.ascontiguousarray(states[:, :2])
    columns["observation.return_to_go"] = return_to_go(columns["next.reward"][:, 0], lengths)[:, None]
    return write_dataset(
        root,
        repo_id=repo_id or "local/maze2d",
        fps=FPS,
        features=features,
        columns=columns,
        lengths=lengths,
        task=[task_of(mazes[i % len(mazes)]) for i in range(episodes)],
        robot_type="maze2d",
        provenance={
            "environment": ENV_ID,
            "maze": maze,
            "expert": "waypoint controller",
            "episodes": episodes,
            "seed": seed,
            "noise": noise,
            "initial_velocity": initial_velocities.tolist(),
            "camera": camera,
            "hide_goal": hide_goal,
        },
        progress=progress,
        pictures=pictures,
    )


def _pictures(mazes: Sequence[str], states: np.ndarray) -> Iterator[np.ndarray]:
    """What the camera sees at each of (N, 4) states of whole episodes: x, y, goal x, goal y."""
    parsed = [parse_maze(maze) for maze in mazes]
    for step, (x, y, goal_x, goal_y) in enumerate(states.tolist()):
        yield camera_picture(parsed[step // HORIZON % len(parsed)], (int(goal_x), int(goal_y)), (x, y))
