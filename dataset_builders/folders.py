"""A dataset's folder is written by one process at a time, and whole or not at all."""

import contextlib
import ctypes
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows; writers of one folder are not kept apart there
    fcntl = None  # type: ignore[assignment]

RENAME_EXCHANGE = 2  # of Linux's renameat2
AT_FDCWD = -100


def refuse_existing(root: str | Path) -> Path:
    """`root` as an absolute path, if a dataset may be written there.

    Raises:
        FileExistsError: If it exists and is not an empty folder.
    """
    root = Path(root).expanduser().resolve()
    if root.exists() and not (root.is_dir() and not any(root.iterdir())):
        kind = "folder is not empty" if root.is_dir() else "is a file"
        raise FileExistsError(f"{root}: {kind}. Choose a new folder for the dataset, or remove this one first.")
    return root


@contextlib.contextmanager
def written_whole(target: Path, *, replacing: bool = False) -> Iterator[Path]:
    """A folder to make and to write a dataset into, which takes the name `target` when the block ends without an error.

    Everything happens in a hidden folder beside `target`. Another process that writes the same dataset waits; what one
    left that was killed is tidied by the next.

    Args:
        target: The dataset's folder: new, empty, or, with `replacing`, an old dataset, which stays until the new one
            takes its place, in one step where the system has one.

    Raises:
        FileExistsError: Somebody has put something there by now.
    """
    work = target.with_name(f".{target.name}.partial")
    new, old = work / "new", work / "old"
    held = _hold(work)
    try:
        if old.exists() and not target.exists():
            old.rename(target)
        for left in work.iterdir():
            shutil.rmtree(left)
        if not replacing:
            refuse_existing(target)
        yield new
        if not replacing:
            with contextlib.suppress(FileNotFoundError):
                target.rmdir()  # fails, as it should, if somebody has put something there by now
            new.rename(target)
        elif not _exchange(new, target):
            _move_aside(target, old, new)
    finally:
        shutil.rmtree(work, ignore_errors=True)
        if held is not None:
            os.close(held)


def _hold(work: Path) -> int | None:
    """Make a folder and wait until no other process holds it. The system lets go of it when the descriptor is closed,
    or when this process ends, however it ends."""
    while True:
        work.mkdir(parents=True, exist_ok=True)
        if fcntl is None:
            return None
        with contextlib.suppress(FileNotFoundError):  # its holder has removed it meanwhile
            held = os.open(work, os.O_RDONLY)
            fcntl.flock(held, fcntl.LOCK_EX)
            if work.exists() and os.path.samestat(os.fstat(held), work.stat()):
                return held
            os.close(held)


def _exchange(new: Path, target: Path) -> bool:
    """Swap two folders in one step; False where the system or the disk cannot."""
    if sys.platform != "linux":
        return False
    swap = getattr(ctypes.CDLL(None), "renameat2", None)
    return swap is not None and swap(AT_FDCWD, os.fsencode(new), AT_FDCWD, os.fsencode(target), RENAME_EXCHANGE) == 0


def _move_aside(target: Path, old: Path, new: Path) -> None:
    target.rename(old)
    try:
        new.rename(target)
    except BaseException:
        old.rename(target)
        raise
