"""What every attack stands on: a Hub and a home of its own, an attempt, a process that is killed, a small policy.

It is imported before anything of huggingface_hub, which reads the environment as it is imported.
"""

import atexit
import logging
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
from hub_server import Hub

HUB = Hub({"token": "me"}).__enter__()
HOME = Path(tempfile.mkdtemp(prefix="attack_"))
OWNER = os.getpid()
atexit.register(lambda: os.getpid() == OWNER and shutil.rmtree(HOME, ignore_errors=True))
os.environ.update(HF_ENDPOINT=HUB.endpoint, HF_HOME=str(HOME), HF_TOKEN="token", HF_HUB_DISABLE_XET="1")
os.environ.update(HF_HUB_OFFLINE="0", HF_HUB_DISABLE_PROGRESS_BARS="1", HF_HUB_DOWNLOAD_TIMEOUT="2")


from policies import SMALL  # noqa: E402

import lerobot_policy_unimask  # noqa: E402, F401
from lerobot_unimask import UniMASKConfig, UniMASKPolicy  # noqa: E402
from lerobot_unimask.sharing import cards, hub  # noqa: E402

logging.getLogger("lerobot").setLevel(logging.ERROR)

SECONDS = 5.0  # of processor time, for one attempt
ENDED = os.WEXITED | os.WNOHANG | os.WNOWAIT  # whether a process has, which stays to be waited for
EXPECTED = (ValueError, OSError)  # what the commands print as one sentence; MaskError and HubError are among them
Outcome = str | None  # what was lost, or nothing
Attack = Callable[[int, Path], Iterator[tuple[str, Outcome]]]  # attempts, a dataset -> each one's outcome


def attempt(call: Callable[[], Any], check: Callable[[Any], Outcome] = lambda _: None) -> tuple[str, Outcome]:
    """ "refused" or "held", and what was lost by it."""
    began = time.process_time()
    kind, lost = "held", None
    try:
        lost = check(call())
    except EXPECTED as error:
        kind = "refused"
        if len(str(error)) > 5000 or not str(error):
            lost = f"an error of {len(str(error))} characters"
    except Exception as error:
        lost = f"{type(error).__name__}: {error}"
    if time.process_time() - began > SECONDS:
        lost = f"{time.process_time() - began:.1f} s"
    return kind, lost


def forked(
    work: Callable[[], Any],
    *,
    kill_after: float | None = None,
    kill_from: Path | None = None,
    most_bytes: int | None = None,
) -> int | None:
    """Run in a forked process, that is killed or may write no larger file; its exit status, None if it was killed.

    Args:
        kill_after: seconds from the start, or from when there is a file `kill_from`.
    """
    child = os.fork()
    if child == 0:
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        if most_bytes is not None:
            import resource

            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        try:
            work()
            os._exit(0)
        except EXPECTED:
            os._exit(2)
        except BaseException:
            os._exit(1)
    if kill_after is not None:
        while kill_from is not None and not kill_from.exists() and os.waitid(os.P_PID, child, ENDED) is None:
            time.sleep(0.002)
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    return None if os.WIFSIGNALED(status) else os.waitstatus_to_exitcode(status)


def duration(work: Callable[[], Any]) -> float:
    """Seconds of the work in a forked process, where it is not killed."""
    began = time.monotonic()
    status = forked(work)
    assert status == 0, f"status {status}"
    return time.monotonic() - began


def push_policy(folder: Path, name: str) -> str:
    return hub.push_policy(
        folder, name, cards.policy_card(UniMASKPolicy.from_pretrained(folder).card_facts(folder), name)
    )


def push_dataset(root: Path, name: str) -> str:
    return hub.push_dataset(root, name, cards.dataset_card(root, name))


def complete(repository, what: str) -> bool:
    wanted = {"model.safetensors", "config.json"} if what == "model" else {"meta/info.json", "meta/stats.json"}
    return {*wanted, "README.md"} <= set(repository.files)


def CONFIG() -> UniMASKConfig:
    return UniMASKConfig(device="cpu", **SMALL)


def small_policy(root: Path) -> UniMASKPolicy:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    config, meta = CONFIG(), LeRobotDatasetMetadata("local/dataset", root=root)
    config.set_dataset_feature_metadata(meta.features)
    return UniMASKPolicy(config, dataset_stats=meta.stats).eval()
