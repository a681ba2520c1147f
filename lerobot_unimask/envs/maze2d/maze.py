"""Maze2D: D4RL's point mass in a maze, on MuJoCo, with the velocity hidden (UniMASK, section 5.2).

Rows of a maze's text lie along x, columns along y. All positions are joint positions, in cells: cell (row, column)
is the position (row, column).

Note: the mass's body stands at (1.2, 1.2) and the walls' boxes at (row + 1, column + 1), so the middle of a cell's
free space is the joint position (row - 0.2, column - 0.2). That is D4RL's quirk, kept, and the drawing shows it.
"""

from dataclasses import dataclass
from functools import lru_cache

ENV_ID = "lerobot_unimask/Maze2D-v0"

TASK = "push the point mass through the maze to the goal"

HORIZON = 200  # steps in every episode

SECONDS_PER_STEP = 0.01

FPS = round(1 / SECONDS_PER_STEP)  # so that timestamps and videos run on the simulator's time

MAX_SPEED = 5.0  # per axis, cells per second

SUCCESS_DISTANCE = 0.5

START_SPREAD = 0.3  # half the width of the square around a cell in which an episode starts

START_SPEED = 0.1  # standard deviation per axis, cells per second

BODY_OFFSET = 1.2  # where the mass's body stands at joint position 0

WALL_OFFSET = 1.0  # where the box of cell 0 stands

MASS_RADIUS = 0.1

CAMERA_PIXELS_PER_CELL = 14  # the smallest maze, of 5 cells, is as large as LeRobot's video codec needs

MAZES = {
    "umaze": """\
#####
#GOO#
###O#
#OOO#
#####""",
    "medium": """\
########
#OO##OO#
#OO#OOO#
##OOO###
#OO#OOO#
#O#OO#O#
#OOO#OG#
########""",
    "large": """\
############
#OOOO#OOOOO#
#O##O#O#O#O#
#OOOOOO#OOO#
#O####O###O#
#OO#O#OOOOO#
##O#O#O#O###
#OO#OOO#OGO#
############""",
}

Cell = tuple[int, int]


def task_of(maze: str) -> str:
    """What an episode is to do: each maze is a task of its own; the medium one's text does not name it."""
    return TASK if maze == "medium" else f"{TASK} ({maze})"


@dataclass(frozen=True)
class Maze:
    """A checked maze: `rows` of equal length, and its free cells as (row, column), in reading order."""

    rows: tuple[str, ...]
    cells: tuple[Cell, ...]

    def is_free(self, cell: Cell) -> bool:
        row, column = cell
        return 0 <= row < len(self.rows) and 0 <= column < len(self.rows[0]) and self.rows[row][column] != "#"

    def neighbours(self, cell: Cell) -> list[Cell]:
        """The free cells beside a cell, in the order y - 1, y + 1, x - 1, x + 1."""
        row, column = cell
        beside = [(row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column)]
        return [other for other in beside if self.is_free(other)]


@lru_cache(maxsize=32)
def parse_maze(maze: str) -> Maze:
    """Read a maze: the name of one in `MAZES`, or a text of `#` (wall), `O` and `G` (free).

    Rows are separated by line breaks or, as in D4RL's one-line texts, by backslashes. `O` and `G` are the same
    here: starts and goals are drawn from both.

    Raises:
        ValueError: neither a known name nor a rectangle of these characters, a border cell that is not wall, fewer
            than two free cells (a start and a goal), or a free cell that cannot be reached from another.
    """
    if not isinstance(maze, str):  # LeRobot's parser reads YAML, in which # begins a comment
        raise ValueError(f"The maze is {maze!r}; it is a name or a text, which quotes keep together: '\"#####...\"'.")
    text = MAZES.get(maze, maze).replace("\\", "\n").strip()
    rows = tuple(row.strip() for row in text.split("\n"))
    unknown = sorted(set("".join(rows)) - set("#OG"))
    if unknown or not text:
        raise ValueError(
            f"{maze!r} is neither the name of a maze ({', '.join(MAZES)}) nor a maze's text: "
            f"rows of '#' (wall), 'O' and 'G' (free){f', not {unknown[0]!r}' if unknown else ''}."
        )
    if len({len(row) for row in rows}) > 1:
        raise ValueError(f"The maze's rows differ in length ({[len(row) for row in rows]}):\n{text}")
    if set(rows[0] + rows[-1] + "".join(row[0] + row[-1] for row in rows)) != {"#"}:
        raise ValueError(f"The maze is not enclosed, every cell of its border must be a wall '#':\n{text}")
    cells = tuple((r, c) for r, row in enumerate(rows) for c, cell in enumerate(row) if cell != "#")
    if len(cells) < 2:
        raise ValueError(f"The maze has {len(cells) or 'no'} free cell, an episode needs a start and a goal:\n{text}")
    parsed = Maze(rows, cells)
    cut_off = set(cells) - steps_to_goal(parsed, cells[0]).keys()
    if cut_off:
        raise ValueError(f"The maze's free cell {min(cut_off)} cannot be reached from {cells[0]}:\n{text}")
    return parsed


def steps_to_goal(maze: Maze, goal: Cell) -> dict[Cell, int]:
    """The shortest walk's length in cells from every cell that reaches `goal`, by breadth-first search."""
    steps = {goal: 0}
    frontier = [goal]
    for cell in frontier:  # grows while it is walked: a queue
        for other in maze.neighbours(cell):
            if other not in steps:
                steps[other] = steps[cell] + 1
                frontier.append(other)
    return steps
