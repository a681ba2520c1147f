"""Records: JSON files, the versions that they name, and tables of them."""

import json
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


def versions(*more: str) -> dict[str, str]:
    """The versions that a result depends on: Python's and the packages', those of `more` where they are installed."""
    found = {"python": platform.python_version()}
    for name in ("torch", "lerobot", "lerobot_policy_unimask", *more):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """The repository's commit, with `-dirty` where files have been changed since; None: it is no repository."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else None


def write_json(path: Path, content: Mapping[str, Any], *, say: bool = True) -> None:
    """Write a record at once: the file is there in full or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    partial.replace(path)
    if say:
        print(f"written to {path}")


def read_json(path: Path) -> Any:
    """
    Raises:
        ValueError: the file is not JSON.
    """
    try:
        return json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as JSON: {error}") from error


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table in Markdown; None is an empty cell, and a bar inside a cell does not end it."""

    def text(cell: Any) -> str:
        return "" if cell is None else re.sub(r"(?<!\\)\|", r"\\|", str(cell))

    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(text, line))} |" for line in lines)
