"""Console scripts, run as a user would, in a process forked from this one, which has imported everything.

Importing LeRobot takes 15 to 25 s of processor time on an older machine, and there are some fifty commands to run. A
forked process has its own arguments, folder, environment, output and exit status. What a library reads from the
environment while it is imported it has read already: tests of that start a real process.
"""

import contextlib
import io
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

SECONDS = 240  # for one command, on a busy machine


@dataclass
class Result:
    """What a command left behind: its exit status, and what it printed on stdout and stderr."""

    status: int
    stdout: str
    stderr: str


@cache
def _main(script: str):
    (found,) = {point.value: point for point in entry_points(group="console_scripts", name=script)}.values()
    return found.load()


def run(script: str, *arguments: str, cwd: Path, env: Mapping[str, str] | None = None) -> Result:
    """Run a console script in a forked process.

    Raises:
        TimeoutError: it takes longer than `SECONDS`.
    """
    main = _main(script)
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)
            os._exit(_be(main, [script, *arguments], cwd, env or {}, out, err))
        with contextlib.suppress(OSError):  # both set it, so that it is set whoever comes first
            os.setpgid(child, child)
        status = _wait(child, [script, *arguments])
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read())
    return Result(status, *texts)


def check(script: str, *arguments: str, cwd: Path, env: Mapping[str, str] | None = None) -> str:
    """Run a console script that has to succeed, and return all that it printed."""
    result = run(script, *arguments, cwd=cwd, env=env)
    assert result.status == 0, f"{script} {arguments}\n{result.stdout[-1000:]}\n{result.stderr[-3000:]}"
    return result.stdout + result.stderr


def fresh(main: Callable[[], object]) -> Callable[[], None]:
    """A command that finds nothing of what this process has set up for Accelerate."""

    def command() -> None:
        from accelerate.state import AcceleratorState, PartialState

        AcceleratorState._reset_state(reset_partial_state=True)
        PartialState._reset_state()
        main()

    return command


def _be(main, words: list[str], cwd: Path, env: Mapping[str, str], out: io.TextIOBase, err: io.TextIOBase) -> int:
    """In the child: be the command, and return its exit status."""
    status = 0
    try:
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        sys.stdin = open(os.devnull)  # noqa: SIM115 (for as long as this process lives)
        sys.stdout, sys.stderr = (io.TextIOWrapper(os.fdopen(number, "wb", 0), write_through=True) for number in (1, 2))
        os.chdir(cwd)
        os.environ.update(env)
        sys.argv = words
        fresh(main)()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
    except BaseException:
        sys.excepthook(*sys.exc_info())
        status = 1
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    return status


def _wait(child: int, words: list[str]) -> int:
    deadline = time.monotonic() + SECONDS
    try:
        while time.monotonic() < deadline:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        raise TimeoutError(f"{' '.join(words)} takes longer than {SECONDS} s")
    except BaseException:  # the test's interruption too: neither the command nor what it has started outlives it
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
