"""Maze2D's expert, a waypoint controller (UniMASK, section 5.2)."""

import math
from functools import lru_cache

import numpy as np

from lerobot_unimask.envs.maze2d.maze import Cell, Maze, steps_to_goal

POSITION_GAIN = 10.0

ARRIVED = 0.1  # within this distance a waypoint, or the goal, is reached

WAYPOINT_SHIFT = 0.2  # waypoints are moved by up to this, towards smaller x and y


@lru_cache(maxsize=1024)
def next_cells(maze: Maze, goal: Cell) -> dict[Cell, Cell]:
    """For every free cell but the goal, the first neighbour that is closer to `goal`."""
    steps = steps_to_goal(maze, goal)
    return {
        cell: next(other for other in maze.neighbours(cell) if steps[other] < steps[cell])
        for cell in maze.cells
        if cell != goal
    }


def shortest_path(maze: Maze, start: Cell, goal: Cell) -> list[Cell]:
    """The cells from `start` (left out) to `goal`; among shortest paths, the neighbours' order decides."""
    following = next_cells(maze, goal)
    path = []
    while start != goal:
        start = following[start]
        path.append(start)
    return path


class WaypointExpert:
    """D4RL's waypoint controller: planned once, at an episode's start; it sees the velocity that the policy does not.

    The action is 10 (waypoint - position) - velocity, clipped to [-1, 1] per axis.

    Args:
        position: start of the episode, (x, y); rounded, a free cell.
        rng: source of the shifts by which every waypoint but the goal is moved, -U(0, 0.2) per axis.
    """

    def __init__(self, maze: Maze, position: tuple[float, float], goal: Cell, rng: np.random.Generator):
        start = (round(position[0]), round(position[1]))
        if not maze.is_free(start):
            raise ValueError(f"The expert cannot plan from {position}: the cell {start} is not free.")
        path = np.array(shortest_path(maze, start, goal)[:-1], np.float64).reshape(-1, 2)
        self.waypoints: list[tuple[float, float]] = [
            *map(tuple, (path - rng.uniform(0, WAYPOINT_SHIFT, path.shape)).tolist()),
            goal,
        ]
        self._next = 0

    def act(self, position: tuple[float, float], velocity: tuple[float, float]) -> tuple[float, float]:
        """The action at a position and (unclipped) velocity; then on to the next waypoint if this one is reached."""
        goal = self.waypoints[-1]
        at_goal = math.dist(position, goal) < ARRIVED
        aim_x, aim_y = aim = goal if at_goal else self.waypoints[self._next]
        x, y = position
        velocity_x, velocity_y = velocity
        if not at_goal and math.dist(position, aim) < ARRIVED:
            self._next += 1
        return _clip(POSITION_GAIN * (aim_x - x) - velocity_x), _clip(POSITION_GAIN * (aim_y - y) - velocity_y)


def _clip(force: float) -> float:
    return -1.0 if force < -1.0 else 1.0 if force > 1.0 else force
