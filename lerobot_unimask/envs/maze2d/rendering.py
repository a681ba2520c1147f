"""Maze2D from above: a video's frames, and what a camera sees."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from lerobot_unimask.envs.maze2d.maze import (
    BODY_OFFSET,
    CAMERA_PIXELS_PER_CELL,
    MASS_RADIUS,
    SUCCESS_DISTANCE,
    WALL_OFFSET,
    Cell,
    Maze,
)

PIXELS_PER_CELL = 48  # times any number of cells it is a multiple of 16, which suits video codecs

SMOOTHING = 2  # drawn this many times larger and averaged down: smooth edges

FLOOR_COLOUR, WALL_COLOUR, EDGE_COLOUR = (244, 242, 236), (62, 70, 86), (84, 94, 112)

GOAL_COLOUR, GOAL_HALO = (46, 160, 103), (203, 231, 214)

MASS_COLOUR, TRAIL_OLD, TRAIL_NEW = (222, 84, 62), (240, 214, 200), (232, 130, 104)


def draw_maze(maze: Maze, goal: Cell, trail: Sequence[tuple[float, float]]) -> np.ndarray:
    """Draw a maze from above as its text reads: x downwards, y to the right.

    Args:
        goal: cell of the goal; its halo is the success distance.
        trail: the mass's positions so far, the present one last.

    Returns:
        uint8 (48 rows, 48 columns, 3).
    """
    image = _draw_walls(maze).copy()
    draw = ImageDraw.Draw(image)
    _draw_disc(draw, goal, SUCCESS_DISTANCE, GOAL_HALO)
    image.paste(_draw_walls(maze), mask=_wall_mask(maze))  # the halo lies under the walls
    _draw_disc(draw, goal, 0.14, GOAL_COLOUR)
    points = [_to_pixels(position) for position in trail]
    for i in range(1, len(points)):
        newness = i / len(points)
        colour = tuple(round(old + newness * (new - old)) for old, new in zip(TRAIL_OLD, TRAIL_NEW, strict=True))
        draw.line((*points[i - 1], *points[i]), fill=colour, width=3 * SMOOTHING)
    _draw_disc(draw, trail[-1], MASS_RADIUS, MASS_COLOUR)
    return np.asarray(image.reduce(SMOOTHING))


CAMERA_GOAL, CAMERA_MASS = 0.4, 0.2  # radii of the discs, in cells: they are seen in small pictures too


def camera_picture(maze: Maze, goal: Cell, position: tuple[float, float]) -> np.ndarray:
    """What a camera above the maze sees: walls, goal and mass, and of the way that the mass came nothing.

    Returns:
        uint8 (14 rows, 14 columns, 3).
    """
    picture = _camera_walls(maze).copy()
    for place, radius, colour in ((goal, CAMERA_GOAL, GOAL_COLOUR), (position, CAMERA_MASS, MASS_COLOUR)):
        _blend_disc(picture, place, radius, colour)
    return picture.astype(np.uint8)


@lru_cache(maxsize=32)
def _camera_walls(maze: Maze) -> np.ndarray:
    walls = np.array([[cell == "#" for cell in row] for row in maze.rows])
    walls = walls.repeat(CAMERA_PIXELS_PER_CELL, axis=0).repeat(CAMERA_PIXELS_PER_CELL, axis=1)
    return np.where(walls[..., None], WALL_COLOUR, FLOOR_COLOUR).astype(np.float32)


def _blend_disc(picture: np.ndarray, place: tuple[float, float], radius: float, colour: tuple[int, ...]) -> None:
    """Draw a disc with smooth edges over a picture, (height, width, 3) float32, in place."""
    x, y = ((part + BODY_OFFSET - WALL_OFFSET + 0.5) * CAMERA_PIXELS_PER_CELL for part in place)
    reach = radius * CAMERA_PIXELS_PER_CELL
    rows = slice(max(0, int(x - reach - 1)), max(0, int(x + reach + 2)))
    columns = slice(max(0, int(y - reach - 1)), max(0, int(y + reach + 2)))
    part = picture[rows, columns]  # a view
    down = np.arange(rows.start, rows.start + part.shape[0])[:, None] + 0.5 - x
    right = np.arange(columns.start, columns.start + part.shape[1]) + 0.5 - y
    share = np.clip(reach + 0.5 - np.hypot(down, right), 0, 1)[..., None]
    part += share * (np.array(colour, np.float32) - part)


def _to_pixels(position: tuple[float, float]) -> tuple[float, float]:
    """A joint position (x, y) as (right, down) in the enlarged drawing, whose corner is the corner of cell (0, 0)."""
    x, y = position
    corner = BODY_OFFSET - WALL_OFFSET + 0.5
    return (y + corner) * PIXELS_PER_CELL * SMOOTHING, (x + corner) * PIXELS_PER_CELL * SMOOTHING


def _draw_disc(draw: ImageDraw.ImageDraw, position: tuple[float, float], radius: float, colour: tuple) -> None:
    draw.circle(_to_pixels(position), radius * PIXELS_PER_CELL * SMOOTHING, fill=colour)


@lru_cache(maxsize=32)
def _wall_mask(maze: Maze) -> Image.Image:
    walls = np.array([[cell == "#" for cell in row] for row in maze.rows])
    size = PIXELS_PER_CELL * SMOOTHING
    return Image.fromarray(walls.repeat(size, axis=0).repeat(size, axis=1))


@lru_cache(maxsize=32)
def _draw_walls(maze: Maze) -> Image.Image:
    mask = _wall_mask(maze)
    image = Image.new("RGB", mask.size, FLOOR_COLOUR)
    image.paste(WALL_COLOUR, mask=mask)
    draw = ImageDraw.Draw(image)
    size = PIXELS_PER_CELL * SMOOTHING
    for r, row in enumerate(maze.rows):
        for c, cell in enumerate(row):
            if cell == "#":
                draw.rectangle((c * size, r * size, (c + 1) * size - 1, (r + 1) * size - 1), outline=EDGE_COLOUR)
    return image
