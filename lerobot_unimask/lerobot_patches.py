"""Every change that importing this plugin makes to LeRobot, each with its reason and with what happens to other
policies.

`UNIMASK_PATCH_LEROBOT=0` in the environment turns all of them off.
"""

import contextlib
import functools
import logging
import os
import sys
import traceback
from collections.abc import Iterator
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from draccus.parsers import decoding
from draccus.utils import DecodingError, ParsingError
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import dataset_metadata, factory, lerobot_dataset, video_utils
from lerobot.datasets.io_utils import cast_stats_to_numpy
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import configs
from lerobot.scripts import lerobot_eval
from torch.utils.data._utils.collate import default_collate_fn_map

from lerobot_unimask.data import reads
from lerobot_unimask.data.episodes import open_checked, read_statistics
from lerobot_unimask.data.soundness import are_statistics
from lerobot_unimask.data.taking_over import keep_to
from lerobot_unimask.envs.metaworld.environment import load_metaworld
from lerobot_unimask.sharing import hub

logger = logging.getLogger(__name__)

ENVIRONMENT_VARIABLE = "UNIMASK_PATCH_LEROBOT"


def apply() -> None:
    """Make the changes, here and in processes that datasets are pickled to. Does nothing the second time."""
    if os.environ.get(ENVIRONMENT_VARIABLE) == "0" or hasattr(LeRobotDataset, "__getitems__"):
        return
    _read_windows_in_batches()
    _read_as_this_policy_needs()
    _leave_out_unsound_statistics()
    _work_offline()
    _record_integers()
    _say_in_a_line_what_decodes()
    _end_in_a_sentence()
    _say_why_a_config_is_refused()
    _start_metaworld()


def _read_windows_in_batches() -> None:
    """LeRobotDataset reads item by item, 2 to 11 ms a window; PyTorch's DataLoader asks a dataset that has
    `__getitems__` for whole batches.

    Other policies: their batches are equal in keys, dtypes, shapes and values, and come faster; a test compares them.
    """
    state_of = LeRobotDataset.__getstate__
    LeRobotDataset.__getitems__ = property(reads.batched_read)
    LeRobotDataset.__getstate__ = lambda self: {**state_of(self), "_patches": _ApplyWhereUnpickled()}
    default_collate_fn_map[reads.Item] = reads.collate_windows


class _ApplyWhereUnpickled:
    """Travels in a pickled dataset: spawned DataLoader workers import no plugin, but unpickle the dataset."""

    def __reduce__(self):
        return apply, ()


def _read_as_this_policy_needs() -> None:
    """Streams are refused: LeRobot 0.6.1's fail on windows of a feature of shape (1,), give nothing at all, and wait
    for ever, with `--num_workers=0`, and heed neither `--dataset.episodes` nor `drop_n_last_frames`. So is a
    rename_map: LeRobot tells a policy nothing of it, and what is kept of a dataset is read from its files. And a
    dataset that is read in batches gets no DataLoader workers, of which LeRobot starts four: each imports LeRobot
    first, some 20 s, for batches that take a millisecond, and beside them dropout draws other numbers. Of cameras,
    those that the policy reads are decoded once, others not at all; LeRobot decodes all of a window's frames of all of
    them at each read. Columns of texts, which cannot be read in batches, are left out. And a policy is to know which
    episodes are read, where LeRobot tells it of all of them.

    Other policies: unchanged.
    """
    lerobots_make_dataset, lerobots_make_both = factory.make_dataset, factory.make_train_eval_datasets
    opened: list[LeRobotDataset] = []  # the last one for this policy

    @functools.wraps(lerobots_make_dataset)
    def make_dataset(cfg: TrainPipelineConfig) -> LeRobotDataset:
        if cfg.trainable_config.type != "unimask":
            return lerobots_make_dataset(cfg)
        if cfg.dataset.streaming:
            raise ValueError(
                "unimask does not train on streamed datasets: LeRobot's streams do not give it whole windows. Leave "
                "out --dataset.streaming: columns are memory-mapped, and ten million frames need no more than 2 GB. "
                "A dataset in a bucket has to be downloaded first, and named with --dataset.root."
            )
        if cfg.rename_map:
            names = " ".join(f"--rename {old}={new}" for old, new in cfg.rename_map.items())
            raise ValueError(
                "unimask trains on columns by the names that they have in the dataset's files, without --rename_map: "
                f"`unimask prepare --dataset.root=DIR {names} --output=NEW` gives them others."
            )
        root = cfg.dataset.root and Path(cfg.dataset.root)
        with _without_imagenet_statistics(cfg):
            dataset = open_checked(
                lambda: lerobots_make_dataset(cfg), root, cfg.dataset.repo_id, cfg.dataset.episodes
            )  # one that is old or damaged ends in one sentence
        opened[:] = [dataset]
        reads.read_cameras(dataset, cfg.trainable_config)
        keep_to(dataset.meta, dataset.episodes)
        if cfg.num_workers and getattr(dataset, "__getitems__", None):
            logger.info("Windows are read in batches, faster than workers start: num_workers=0.")
            cfg.num_workers = 0
        return dataset

    @functools.wraps(lerobots_make_both)
    def make_train_eval_datasets(cfg: TrainPipelineConfig) -> tuple[LeRobotDataset, LeRobotDataset | None]:
        with _without_imagenet_statistics(cfg):
            both = lerobots_make_both(cfg)
        if cfg.trainable_config.type == "unimask" and both[1] is not None:  # opened anew, each with its episodes
            for part in both:
                reads.read_cameras(part, cfg.trainable_config, opened[0])
                keep_to(part.meta, opened[0].episodes)
            cfg.eval_steps = cfg.eval_steps or cfg.steps
        opened.clear()
        return both

    factory.make_dataset = make_dataset
    factory.make_train_eval_datasets = make_train_eval_datasets
    for name in ("lerobot.datasets", "lerobot.scripts.lerobot_train"):  # where LeRobot has imported it by name
        if name in sys.modules:
            vars(sys.modules[name])["make_train_eval_datasets"] = make_train_eval_datasets


@contextlib.contextmanager
def _without_imagenet_statistics(cfg: TrainPipelineConfig) -> Iterator[None]:
    """LeRobot puts them in the place of each camera's own, and ends in a KeyError where the dataset has none; this
    policy reads neither."""
    asked = cfg.dataset.use_imagenet_stats
    if cfg.trainable_config.type == "unimask":
        cfg.dataset.use_imagenet_stats = False
    try:
        yield
    finally:
        cfg.dataset.use_imagenet_stats = asked


def _leave_out_unsound_statistics() -> None:
    """LeRobot ends in an error of numpy's or torch's where an entry of meta/stats.json is no mapping to numbers, also
    one of a column that no policy reads. Such entries are left out, and a line says so once; this policy computes those
    that it reads.

    Other policies: do without such entries too; sound files are read as before.
    """
    load = dataset_metadata.load_stats
    said: set[Path] = set()

    @functools.wraps(load)
    def load_sound(root: Path) -> dict[str, dict[str, Any]] | None:
        found = read_statistics(root)
        wrong = [key for key, known in found.items() if not are_statistics(known)]
        if not wrong:
            return load(root) if found else None
        if root not in said:
            logger.warning("%s holds for %s what are no statistics: they are left out.", root, ", ".join(wrong))
            said.add(root)
        return cast_stats_to_numpy({key: known for key, known in found.items() if key not in wrong}) or None

    vars(dataset_metadata)["load_stats"] = load_sound


def _say_in_a_line_what_decodes() -> None:
    """Where FFmpeg is missing LeRobot logs a page about it whenever a dataset is opened, with videos or without. Now a
    line says so once, when a process decodes a video.

    Other policies: the same.
    """
    unsaid: list[str] = []
    known: set[str] = set()
    decode = video_utils.decode_video_frames_pyav

    def keep(record: logging.LogRecord) -> bool:
        if record.levelno == logging.WARNING:
            line = record.getMessage().splitlines()[-1].replace(" (see the error above)", "")
            unsaid.extend({line} - known)
            known.add(line)
        return record.levelno != logging.WARNING

    @functools.wraps(decode)
    def decode_and_say(*arguments: Any, **settings: Any) -> Any:
        with contextlib.suppress(IndexError):  # several threads decode
            logger.warning(unsaid.pop())
        return decode(*arguments, **settings)

    logging.getLogger("lerobot.utils.import_utils").addFilter(keep)
    vars(video_utils)["decode_video_frames_pyav"] = decode_and_say


def _end_in_a_sentence() -> None:
    """LeRobot's commands show a page of its own functions above the sentence with which this package refuses something.

    Other policies, and errors that this package does not raise itself: unchanged. So is the exit status.
    """
    show = sys.excepthook

    def say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        command = Path(sys.argv[0]).name
        by = Path(traceback.extract_tb(trace)[-1].filename if trace else "")
        ours = by.is_relative_to(Path(__file__).parent) and issubclass(kind, ValueError | OSError | ArithmeticError)
        if ours and command.startswith(("lerobot-", "lerobot_")):
            print(f"{command}: error: {error}", file=sys.stderr)
        else:
            show(kind, error, trace)

    sys.excepthook = say


def _say_why_a_config_is_refused() -> None:
    """LeRobot's parser keeps a config's own reason to itself: "Couldn't instantiate class UniMASKConfig using the given
    arguments."

    Other policies: their configs' reasons are said too.
    """
    decode = decoding.decode_dataclass

    @functools.wraps(decode)
    def decode_or_say_why(cls: Any, content: Any, path: Any = ()) -> Any:
        try:
            return decode(cls, content, path)
        except ParsingError as error:
            if isinstance(error, DecodingError) or error.__cause__ is None:
                raise
            raise DecodingError(path, str(error.__cause__)) from error.__cause__

    vars(decoding)["decode_dataclass"] = decode_or_say_why


def _work_offline() -> None:
    """With HF_HUB_OFFLINE=1 LeRobot asks the Hub for a dataset's versions even if it has the dataset, and reads a
    policy's config, whatever its type, before it calls the policy: what is missing is named in one sentence.

    Other policies: the same, offline; online nothing changes but the sentence for a policy that is not there.
    """
    dataset_metadata.get_safe_version = lerobot_dataset.get_safe_version = hub.pulled_version
    read = PreTrainedConfig.from_pretrained.__func__

    @functools.wraps(read)
    def read_or_name(cls: type, pretrained_name_or_path: str | Path, **kwargs: Any) -> PreTrainedConfig:
        try:
            return read(cls, pretrained_name_or_path, **kwargs)
        except LocalEntryNotFoundError:
            with hub.pull_errors(str(pretrained_name_or_path), kwargs.get("revision")):
                raise

    PreTrainedConfig.from_pretrained = classmethod(read_or_name)


def _record_integers() -> None:
    """lerobot-eval --eval.recording=true declares all numbers as float32 and then refuses others, such as DoorKey's
    cells and directions.

    Other policies: numbers are recorded as the type that LeRobot has declared; those that it took are not changed.
    """
    build = lerobot_eval._build_raw_frame

    @functools.wraps(build)
    def build_declared(*arguments: Any) -> dict[str, Any]:
        features, frame = arguments[-1], build(*arguments)
        for key, value in frame.items():
            if isinstance(value, np.ndarray) and features.get(key, {}).get("dtype") == "float32":
                frame[key] = value.astype(np.float32, copy=False)
        return frame

    lerobot_eval._build_raw_frame = build_declared


def _start_metaworld() -> None:
    """LeRobot's own `--env.type=metaworld` ends in an error of numpy's where MuJoCo is 4 or later (`load_metaworld`).
    Its workers import no plugin, so that all environments run in one process there.

    Other policies: the same; with MuJoCo 3 nothing changes.
    """
    create = configs.MetaworldEnv.create_envs

    @functools.wraps(create)
    def create_mended(self: configs.MetaworldEnv, n_envs: int, use_async_envs: bool = False) -> Any:
        if find_spec("mujoco") and int(version("mujoco").split(".")[0]) > 3:
            load_metaworld()
            use_async_envs = False
        return create(self, n_envs, use_async_envs)

    configs.MetaworldEnv.create_envs = create_mended


def make_known_to_policy_server() -> None:
    """LeRobot's policy server refuses policies that are not in a list of its own, and takes chunks as long as the
    checkpoint's config says, here 1 by default, however many actions a client asks for. Now they are as long as it
    asks, or as the window. Only `unimask serve` calls this.

    Other policies: unchanged.
    """
    from lerobot.async_inference.constants import SUPPORTED_POLICIES
    from lerobot.async_inference.policy_server import PolicyServer

    if "unimask" in SUPPORTED_POLICIES:
        return
    SUPPORTED_POLICIES.append("unimask")
    load = PolicyServer.SendPolicyInstructions

    @functools.wraps(load)
    def load_for_chunks(self: Any, request: Any, context: Any) -> Any:
        answer = load(self, request, context)
        if self.policy is not None and self.policy_type == "unimask":
            config = self.policy.config
            config.chunk_size = min(self.actions_per_chunk, config.context_length)
        return answer

    PolicyServer.SendPolicyInstructions = load_for_chunks
