"""A simulated robot for LeRobot's own commands, `--robot.type=maze_robot`: Maze2D as one of LeRobot's robots.

It has a clock: the mass moves on by one step whenever an action is sent, so that what happens does not depend on how
fast a machine is.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import Robot, RobotConfig

from lerobot_unimask.envs.maze2d.environment import Maze2DEnv

OBSERVED = ("x.pos", "y.pos", "goal_x.pos", "goal_y.pos")
MOVED = ("force_x.pos", "force_y.pos")


@RobotConfig.register_subclass("maze_robot")
@dataclass(kw_only=True)
class MazeRobotConfig(RobotConfig):
    """`maze`: its text; `seed`: of where the mass starts and goes; `log`: file for what the robot saw and did."""

    maze: str = "umaze"
    seed: int = 0
    log: Path | None = None


class MazeRobot(Robot):
    config_class = MazeRobotConfig
    name = "maze_robot"

    def __init__(self, config: MazeRobotConfig):
        super().__init__(config)
        self.config = config
        self.environment: Maze2DEnv | None = None
        self.log: list[dict[str, list[float]]] = []

    @property
    def observation_features(self) -> dict[str, type]:
        return dict.fromkeys(OBSERVED, float)

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(MOVED, float)

    @property
    def is_connected(self) -> bool:
        return self.environment is not None

    def connect(self, calibrate: bool = True) -> None:
        self.environment = Maze2DEnv(maze=self.config.maze, render_mode=None)
        observation, _ = self.environment.reset(seed=self.config.seed)
        self.state = observation["agent_pos"]

    is_calibrated = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, float]:
        return dict(zip(OBSERVED, self.state.tolist(), strict=True))

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        forces = [action[name] for name in MOVED]
        self.log.append({"state": self.state.tolist(), "action": forces})
        observation, *_ = self.environment.step(forces)
        self.state = observation["agent_pos"]
        return action

    def disconnect(self) -> None:
        self.environment = None
        if self.config.log:
            self.config.log.write_text(json.dumps(self.log))
