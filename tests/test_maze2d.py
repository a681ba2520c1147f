"""Maze2D, its expert and its builder, against the constants and figures of `environments.md` (the paper's and D4RL's).

Oracles: the point mass's equation of motion by hand, distances by relaxation, and a stored episode played again.
"""

import json
import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import preprocess_observation

import lerobot_unimask.envs  # noqa: F401 (registers the environment)
from dataset_builders.maze2d import build_maze2d, collect_episodes
from lerobot_unimask.bench.measuring import building_seconds, stepping_seconds
from lerobot_unimask.envs.maze2d.environment import Maze2DEnv, compile_maze
from lerobot_unimask.envs.maze2d.expert import WaypointExpert, shortest_path
from lerobot_unimask.envs.maze2d.maze import HORIZON, MAZES, parse_maze
from lerobot_unimask.envs.maze2d.rendering import PIXELS_PER_CELL, draw_maze

MASS = 4 / 3 * math.pi * 0.1**3 * 1000
REST = np.zeros(2, np.float32)


def start(position, goal=(6, 6), velocity=(0.0, 0.0), maze="medium") -> Maze2DEnv:
    env = Maze2DEnv(maze)
    env.reset(seed=0, options={"position": position, "velocity": velocity, "goal": goal})
    return env


# --- The model --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "free"), [("umaze", 7), ("medium", 26), ("large", 46)])
def test_the_compiled_model_has_the_published_constants(name, free):
    maze = parse_maze(name)
    model = compile_maze(maze)
    assert len(maze.cells) == free

    assert model.opt.timestep == 0.01
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert not model.opt.gravity.any()
    assert model.nbody == 2  # the world and the mass
    np.testing.assert_array_equal(model.body("mass").pos, (1.2, 1.2, 0))
    assert model.body("mass").mass == pytest.approx(MASS)
    np.testing.assert_array_equal(model.geom_margin, 0.002)
    np.testing.assert_array_equal(model.geom_condim, 1)
    np.testing.assert_array_equal(model.geom_conaffinity, 1)
    np.testing.assert_array_equal(model.geom_friction, np.tile((0.5, 0.1, 0.1), (model.ngeom, 1)))

    sphere = model.geom("mass")
    assert (sphere.type, sphere.size[0], sphere.contype) == (mujoco.mjtGeom.mjGEOM_SPHERE, 0.1, 1)
    walls = [(r, c) for r, row in enumerate(MAZES[name].split()) for c, cell in enumerate(row) if cell == "#"]
    assert model.ngeom == len(walls) + 1
    for r, c in walls:
        wall = model.geom(f"wall {r} {c}")
        assert (wall.type, wall.contype) == (mujoco.mjtGeom.mjGEOM_BOX, 2)
        np.testing.assert_array_equal(wall.size, (0.5, 0.5, 0.2))
        np.testing.assert_array_equal(wall.pos, (r + 1, c + 1, 0))

    np.testing.assert_array_equal(model.jnt_type, mujoco.mjtJoint.mjJNT_SLIDE)
    np.testing.assert_array_equal(model.jnt_axis, ((1, 0, 0), (0, 1, 0)))
    np.testing.assert_array_equal(model.jnt_limited, False)
    np.testing.assert_array_equal(model.dof_damping, 1)
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 100)
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], (0, 1))
    np.testing.assert_array_equal(model.actuator_ctrllimited, True)
    np.testing.assert_array_equal(model.actuator_ctrlrange, ((-1, 1), (-1, 1)))


def test_a_free_mass_obeys_the_equation_of_motion():
    env = start((3, 3), velocity=(0.5, -0.25))
    position, velocity = np.array([3.0, 3.0]), np.array([0.5, -0.25])
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        env.step(action)
        velocity += 0.01 * (100 * action - velocity) / (MASS + 0.01)  # Euler, with the damping taken implicitly
        position += 0.01 * velocity
        np.testing.assert_allclose(env.position, position, atol=1e-12)
        np.testing.assert_allclose(env.velocity, velocity, atol=1e-12)


def test_velocity_is_clipped_before_each_step_and_the_action_always():
    fast, limit = start((3, 3), velocity=(9.0, -7.0)), start((3, 3), velocity=(5.0, -5.0))
    fast.step(np.array([0.5, -3.0]))
    limit.step(np.array([0.5, -1.0]))
    assert fast.position == limit.position
    assert fast.velocity == limit.velocity
    assert start((3, 3), velocity=(5, 0)).step(np.array([1.0, 0.0]))[0]["agent_pos"][0] > 3.05  # only before it


@pytest.mark.parametrize(
    ("action", "axis", "stop"),
    [
        ((-1, 0), 0, 0.4),  # the wall of row 0 ends at 1.5, so the body stops at 1.6 = 1.2 + 0.4
        ((1, 0), 0, 2.2),  # that of cell (3, 1) begins at 3.5
        ((0, -1), 1, 0.4),
        ((0, 1), 1, 2.2),  # that of cell (1, 3)
    ],
)
def test_walls_stop_the_mass(action, axis, stop):
    env = start((1, 1))
    for _ in range(HORIZON):
        env.step(np.array(action, np.float32))
    assert env.position[axis] == pytest.approx(stop, abs=0.01)
    assert env.position[1 - axis] == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("name", MAZES)
def test_the_mass_never_enters_a_wall(name):
    env = Maze2DEnv(name)
    rng = np.random.default_rng(0)
    for seed in range(10):
        env.reset(seed=seed)
        for _ in range(10):
            action = rng.choice([-1.0, 1.0], 2)  # hard pushes, 20 steps each
            for _ in range(20):
                env.step(action)
                row, column = (round(coordinate + 0.2) for coordinate in env.position)
                assert env.maze.is_free((row, column))


# --- The environment --------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*A Box observation space")  # positions have no bounds that matter
def test_gymnasium_accepts_the_environment():
    check_env(Maze2DEnv(), skip_render_check=True)


def test_rewards_telescope_and_episodes_are_truncated_at_the_horizon():
    env = Maze2DEnv()
    observation, _ = env.reset(seed=3)
    first = observation["agent_pos"].astype(np.float64)
    assert observation["agent_pos"].dtype == np.float32
    assert observation["return_so_far"] == 0
    total = 0.0
    for step in range(1, HORIZON + 1):
        action = env.action_space.sample()
        observation, reward, terminated, truncated, _ = env.step(action)
        total += reward
        assert observation["return_so_far"] == pytest.approx(total, abs=1e-6)
        assert not terminated
        assert truncated == (step == HORIZON)
    last = observation["agent_pos"].astype(np.float64)
    shrunk = math.dist(first[:2], first[2:]) - math.dist(last[:2], last[2:])
    assert abs(total) > 0.01
    assert total == pytest.approx(shrunk, abs=1e-5)


def test_success_is_being_within_a_half_of_the_goal_and_stays():
    for position, expected in [((3.5, 4), True), ((3.5 + 1e-9, 4), False), ((2.5, 4), True), ((3.4, 4.4), False)]:
        _, info = Maze2DEnv().reset(options={"position": position, "velocity": (0, 0), "goal": (3, 4)})
        assert info["is_success"] is expected

    env = start((4.5, 4), goal=(3, 4))
    successes, distances = [], []
    for step in range(HORIZON):  # towards the goal, past it and back again
        action = np.array([-1.0 if step < 60 else 1.0, 0.0])
        info = env.step(action)[-1]
        successes.append(info["is_success"])
        distances.append(math.dist(env.position, (3, 4)))
    inside = np.array(distances) <= 0.5
    assert not inside[0]
    assert not inside[-1]
    np.testing.assert_array_equal(successes, np.maximum.accumulate(inside))


def test_resets_are_seeded_and_drawn_as_published():
    env = Maze2DEnv()
    starts, goals, velocities = [], [], []
    for seed in range(2000):
        observation, _ = env.reset(seed=seed)
        starts.append(observation["agent_pos"][:2])
        goals.append(observation["agent_pos"][2:])
        velocities.append(env.velocity)
    starts, goals = np.array(starts), np.array(goals)
    cells = np.rint(starts)
    assert {tuple(cell) for cell in cells} == set(env.maze.cells) == {tuple(goal) for goal in goals}
    assert (cells != goals).any(axis=1).all()
    offsets = np.abs(starts - cells)
    assert offsets.max() <= 0.3 + 1e-6
    assert offsets.mean() == pytest.approx(0.15, abs=0.01)
    assert np.std(velocities) == pytest.approx(0.1, abs=0.005)

    again, _ = Maze2DEnv().reset(seed=7, options={"lerobot_new_rollout": True})
    np.testing.assert_array_equal(again["agent_pos"], np.concatenate((starts[7], goals[7])))


def test_nothing_is_left_of_the_episode_before():
    used, fresh = start((1, 1)), Maze2DEnv()
    for _ in range(100):
        used.step(np.array([-1.0, -1.0]))  # into the corner, so that the contact solver has something to remember
    options = {"position": (0.41, 0.41), "velocity": (-1, -1), "goal": (6, 6)}
    for env in (used, fresh):
        env.reset(options=options)
    for _ in range(50):
        for env in (used, fresh):
            env.step(np.array([-1.0, -0.5]))
        assert used.position == fresh.position


def test_a_chosen_goal_is_kept_and_never_the_start():
    env = Maze2DEnv("umaze")
    for seed in range(30):
        observation, _ = env.reset(seed=seed, options={"goal": (3, 2)})
        x, y, *goal = observation["agent_pos"].tolist()
        assert goal == [3, 2]
        assert (round(x), round(y)) != (3, 2)


# --- Bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("maze", "message"),
    [
        ("###\n###\n###", "no free cell"),
        ("###\n#G#\n###", "1 free cell"),
        ("####\n#OG#\n###", "differ in length"),
        ("####\n#OG \n####", "differ in length"),
        ("####\n#OX#\n####", "not 'X'"),
        ("####\n#OGO\n####", "not enclosed"),
        ("#####\n#O#G#\n#####", "cannot be reached"),
        ("mediun", "umaze, medium, large"),
        ("", "neither"),
        (None, "None"),
    ],
)
def test_bad_mazes_are_refused(maze, message):
    with pytest.raises(ValueError, match=message):
        Maze2DEnv(maze)


def test_a_custom_maze_works_in_either_notation():
    assert (
        parse_maze("#####\\#OOG#\\#####").cells == parse_maze("#####\n#OOG#\n#####\n").cells == ((1, 1), (1, 2), (1, 3))
    )


NOT_FREE = r"is not a free cell.*\n########\n#OO##OO#"


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        *((goal, NOT_FREE) for goal in ((0, 0), (1, 3), (-1, 1), (8, 1), (1.5, 1))),
        *((goal, "goal must be|could not convert") for goal in ((math.nan, 1), (1,), "ab")),
    ],
)
def test_goals_in_walls_or_outside_are_refused(goal, message):
    with pytest.raises(ValueError, match=message):
        Maze2DEnv().reset(options={"goal": goal})


@pytest.mark.parametrize("position", [(0, 0), (3, 0.9), (20, 3), (math.inf, 3)])
def test_positions_in_walls_or_outside_are_refused(position):
    with pytest.raises(ValueError, match="position"):
        Maze2DEnv().reset(options={"position": position})


@pytest.mark.parametrize("action", [(math.nan, 0), (0, math.inf), (0,), ((0, 0),), 0])
def test_bad_actions_are_refused_and_change_nothing(action):
    env = start((3, 3))
    with pytest.raises(ValueError, match="action must be"):
        env.step(np.array(action, np.float32))
    assert env.position == (3, 3)


# --- Drawing ----------------------------------------------------------------------------------------------------------


def test_drawing_shows_walls_goal_mass_and_trail():
    def pixel(frame, x, y):
        return frame[round((x + 0.7) * PIXELS_PER_CELL), round((y + 0.7) * PIXELS_PER_CELL)].astype(int)

    for name in MAZES:
        env = Maze2DEnv(name)
        env.reset(seed=0)
        rows = MAZES[name].split()
        frame = env.render()
        assert frame.dtype == np.uint8
        assert frame.shape == (48 * len(rows), 48 * len(rows[0]), 3)

    env = start((2, 1), goal=(1, 5))
    frame = env.render()
    red, green, _ = pixel(frame, 2, 1)
    assert red > 1.5 * green  # the mass
    red, green, _ = pixel(frame, 1, 5)
    assert green > 1.5 * red  # the goal
    assert pixel(frame, 2.8, 0.8).sum() < 400 < pixel(frame, 3.8, 0.8).sum()  # the wall (3, 1), the free cell (4, 1)
    before = pixel(frame, 2, 1)
    for _ in range(40):
        env.step(np.array([0.0, 1.0]))
    assert (pixel(env.render(), 2, 1) != before).any()  # moved on, and left its trail
    with_trail, without = (draw_maze(env.maze, env.goal, trail) for trail in (env._trail, env._trail[-1:]))
    assert (pixel(with_trail, 2, 1.3) != pixel(without, 2, 1.3)).any()


# --- The expert -------------------------------------------------------------------------------------------------------


def relaxed_steps(maze, goal):
    """Distances over cells without a queue: relax all cells until nothing changes. Walls stay infinite."""
    free = np.array([[cell != "#" for cell in row] for row in maze.rows])
    steps = np.where(free, np.inf, np.nan)
    steps[goal] = 0
    while True:
        near = np.stack([np.roll(steps, shift, axis) for axis in (0, 1) for shift in (1, -1)])
        best = np.fmin.reduce([steps, *(near + 1)])
        best[~free] = np.nan
        if np.array_equal(best, steps, equal_nan=True):
            return steps
        steps = best


@pytest.mark.parametrize("name", MAZES)
def test_paths_are_shortest_and_break_ties_in_the_published_order(name):
    maze = parse_maze(name)
    for goal in maze.cells:
        steps = relaxed_steps(maze, goal)
        for cell in maze.cells:
            path = shortest_path(maze, cell, goal)
            assert len(path) == steps[cell]
            for following in path:
                x, y = cell
                ordered = [(x, y - 1), (x, y + 1), (x - 1, y), (x + 1, y)]
                assert following == next(other for other in ordered if steps[other] == steps[cell] - 1)
                cell = following
            assert cell == goal


def test_the_expert_follows_the_published_rule():
    maze, rng = parse_maze("medium"), np.random.default_rng(0)
    shifts = []
    for _ in range(200):
        expert = WaypointExpert(maze, (1.2, 0.8), (3, 4), rng)
        assert expert.waypoints[-1] == (3, 4)
        shifts.append(np.subtract(expert.waypoints[:-1], [(1, 2), (2, 2), (3, 2), (3, 3)]))
    assert -0.2 <= np.min(shifts) < -0.19
    assert -0.01 < np.max(shifts) <= 0

    first, second = np.array(expert.waypoints[:2])
    velocity = np.array([6.0, -0.3])  # unclipped
    position = first + 0.06  # within 0.1: this action still aims at the first, the next at the second
    np.testing.assert_allclose(expert.act(tuple(position), tuple(velocity)), (-1, -0.3), atol=1e-9)
    np.testing.assert_allclose(
        expert.act(tuple(position), (0.0, 0.0)), np.clip(10 * (second - position), -1, 1), atol=1e-9
    )
    np.testing.assert_allclose(expert.act((3.05, 4.05), (0.0, 0.0)), (-0.5, -0.5), atol=1e-9)  # at the goal: aims there
    with pytest.raises(ValueError, match="cannot plan"):
        WaypointExpert(maze, (0.2, 0.2), (3, 4), rng)


@pytest.mark.parametrize(("noise", "published"), [(0.5, 2.81), (0.0, 2.91)])
def test_a_thousand_episodes_return_what_was_published(noise, published):
    columns, _ = collect_episodes(["medium"], 1000, seed=0, noise=noise, progress=False)
    states, actions = columns["observation.state"].reshape(1000, HORIZON, 4), columns["action"]
    assert columns["next.reward"].sum(dtype=np.float64) / 1000 == pytest.approx(published, abs=0.12)
    distances = np.linalg.norm(states[:, 0, :2] - states[:, 0, 2:], axis=-1)
    assert distances.mean() == pytest.approx(3.30, abs=0.12)
    assert np.abs(actions).max() == 1


# --- The builder ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_maze2d(tmp_path_factory.mktemp("maze2d") / "data", episodes=6, seed=1, progress=False)


def stored(root):
    return LeRobotDataset("local/maze2d", root=root).hf_dataset.with_format("numpy")[:]


def test_lerobot_reads_the_dataset(built):
    meta = LeRobotDatasetMetadata("local/maze2d", root=built)
    assert (meta.total_episodes, meta.total_frames, meta.fps) == (6, 6 * HORIZON, 100)
    assert meta.features["observation.state"]["names"] == ["x", "y", "goal_x", "goal_y"]
    frames = stored(built)
    rewards = frames["next.reward"].reshape(6, HORIZON)
    for step in (0, 50, HORIZON - 1):
        returns = frames["observation.return_to_go"].reshape(6, HORIZON)[:, step]
        np.testing.assert_allclose(returns, rewards[:, step:].sum(axis=1), atol=1e-5)
    np.testing.assert_array_equal(np.flatnonzero(frames["next.done"]), np.arange(1, 7) * HORIZON - 1)


def test_a_stored_episode_can_be_replayed(built):
    provenance = json.loads((built / "meta/provenance.json").read_text())
    frames = stored(built)
    env = Maze2DEnv(provenance["maze"])
    for episode, velocity in enumerate(provenance["initial_velocity"]):
        steps = slice(episode * HORIZON, (episode + 1) * HORIZON)
        states, actions, rewards = (frames[name][steps] for name in ("observation.state", "action", "next.reward"))
        x, y, *goal = states[0].tolist()
        observation, _ = env.reset(options={"position": (x, y), "velocity": velocity, "goal": goal})
        for state, action, expected in zip(states, actions, rewards, strict=True):
            np.testing.assert_array_equal(observation["agent_pos"], state)  # 1e-5 would do; starts are stored exactly
            observation, reward, _, _, info = env.step(action)
            assert np.float32(reward) == expected
        assert (frames["observation.success"][steps] == info["is_success"]).all()
    assert len(provenance["initial_velocity"]) == 6


def test_builds_are_determined_by_their_seed_and_begin_alike(built, tmp_path):
    frames, smaller = stored(built), stored(build_maze2d(tmp_path / "two", episodes=2, seed=1, progress=False))
    for name, column in smaller.items():
        np.testing.assert_array_equal(column, frames[name][: 2 * HORIZON])
    other, _ = collect_episodes(["medium"], 2, seed=2, noise=0.5, progress=False)
    assert (other["observation.state"][0] != frames["observation.state"][0]).any()
    calm, _ = collect_episodes(["medium"], 2, seed=1, noise=0.0, progress=False)
    np.testing.assert_array_equal(calm["observation.state"][::HORIZON], smaller["observation.state"][::HORIZON])
    assert (calm["action"] != smaller["action"]).any()


def test_each_of_several_mazes_is_a_task_that_its_environment_says(tmp_path):
    """An episode of each in turn; the first is as if it were built alone."""
    build_maze2d(tmp_path / "both", maze="umaze,medium", episodes=3, seed=1, progress=False)
    meta = LeRobotDatasetMetadata("local/maze2d", root=tmp_path / "both")
    told = [Maze2DEnv(maze).task_description for maze in ("umaze", "medium", "umaze")]
    assert [list(meta.episodes[i]["tasks"]) for i in range(3)] == [[text] for text in told]
    assert len(set(told)) == 2
    frames = stored(tmp_path / "both")
    assert [meta.tasks.index[i] for i in frames["task_index"][::HORIZON]] == told
    alone, _ = collect_episodes(["umaze"], 1, seed=1, noise=0.5, progress=False)
    np.testing.assert_array_equal(frames["observation.state"][:HORIZON], alone["observation.state"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"maze": "umaze,medium", "camera": True}, "one size"),
        ({"episodes": 0}, "episodes"),
        ({"seed": -1}, "seed"),
        ({"noise": -0.1}, "noise"),
        ({"noise": math.nan}, "noise"),
        ({"maze": "###"}, "no free cell"),
    ],
)
def test_bad_builds_are_refused_and_leave_nothing(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        build_maze2d(tmp_path / "data", **{"episodes": 1, **arguments})
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_building_costs_at_most_three_times_stepping():
    assert building_seconds(1000) <= 3 * stepping_seconds(1000)


# --- In LeRobot -------------------------------------------------------------------------------------------------------


def test_lerobot_steps_a_synchronous_batch():
    envs = make_env(make_env_config("maze2d", maze="umaze"), n_envs=3, use_async_envs=True)["maze2d"][0]
    assert isinstance(envs, gym.vector.SyncVectorEnv)
    assert envs.call("_max_episode_steps") == (HORIZON,) * 3
    assert all(envs.call("task_description"))
    assert envs.metadata["render_fps"] == make_env_config("maze2d").fps == 100
    observation, _ = envs.reset(seed=[0, 1, 2], options={"lerobot_new_rollout": True})
    features = preprocess_observation(observation)
    assert features["observation.state"].shape == (3, 4)
    assert features["observation.return_so_far"].shape == (3, 1)
    assert envs.envs[0].render().shape == (240, 240, 3)

    rng, total = np.random.default_rng(0), np.zeros(3)
    for _ in range(HORIZON):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        observation, rewards, terminated, truncated, info = envs.step(actions)
        total += rewards
    assert not terminated.any()
    assert truncated.all()
    assert info["final_info"]["is_success"].shape == (3,)
    final = np.stack([final["return_so_far"] for final in info["final_obs"]])
    np.testing.assert_allclose(final[:, 0], total, atol=1e-5)
    envs.close()
