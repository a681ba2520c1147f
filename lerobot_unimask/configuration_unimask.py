"""The policy's one config dataclass, `--policy.type=unimask`."""

import json
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from draccus import decode
from draccus.utils import DecodingError, ParsingError
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.utils.constants import OBS_IMAGES, OBS_PREFIX

from lerobot_unimask.data.factors import (
    TASK,
    Camera,
    Factor,
    Feature,
    check_layout,
    colour_cameras,
    describe_features,
    group_features,
    is_numeric,
    make_factors,
    name_cameras,
    read_feature,
)
from lerobot_unimask.language.grammar import MAX_CONTEXT
from lerobot_unimask.language.masks import ASKABLE, RANDOM_MASK, parse
from lerobot_unimask.language.training_masks import mixture
from lerobot_unimask.machine import has_bfloat16
from lerobot_unimask.optimiser import FusedAdamWConfig
from lerobot_unimask.records import read_json

logger = logging.getLogger(__name__)

# Each network with the ways in which it can attend, its default first
NETWORKS = {
    "transformer": ("both", "bidirectional", "causal"),
    "feedforward": ("bidirectional",),
    "decision_transformer": ("causal",),
}
TOKEN_LAYOUTS = ("stacked", "separate")
DISCRETE_HEADS = ("joint", "separate")
CONTINUOUS_HEADS = ("l2", "gaussian", "mixture")
UNCHANGED = dict.fromkeys(("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY)
FINE_FROM = 500  # episodes of a task; fewer are learnt by heart from sines and cosines (docs/arm.md)
# Settings that are numbers from 1 on -> the highest, or the setting that bounds it. More is a damaged file, or a slip.
MOST: dict[str, int | str] = {
    "context_length": MAX_CONTEXT,
    "chunk_size": "context_length",
    "n_action_steps": "chunk_size",
    "n_obs_steps": "context_length",
    "mixture_components": 64,
    "width": 65536,
    "depth": 512,
    "heads": 1024,
    "feedforward_width": 262144,
}


class FormatVersion(int):
    """A number of its own type, so that a checkpoint's is checked as it is read: before LeRobot's parser refuses the
    fields that a newer format has and this code does not know."""


FORMAT_VERSION = FormatVersion(4)  # of a checkpoint's files; it grows when older code would misread them


@decode.register(FormatVersion)
def _read_format(value: Any, path: Sequence[str] = ()) -> FormatVersion:
    if not isinstance(value, int) or value < 1:
        raise DecodingError(path, f"{value!r} is not a format's number; they count from 1.")
    if value > FORMAT_VERSION:
        raise DecodingError(
            path,
            f"This checkpoint has format {value}; lerobot_policy_unimask {version('lerobot_policy_unimask')} reads "
            f"formats up to {FORMAT_VERSION}: upgrade it, with `pip install -U lerobot_policy_unimask`.",
        )
    if value == 1:
        raise DecodingError(
            path,
            "This checkpoint has format 1. UniMASKPolicy.from_pretrained(FOLDER) reads it, and "
            ".save_pretrained(FOLDER) then saves it in today's format.",
        )
    return FormatVersion(value)


@PreTrainedConfig.register_subclass("unimask")
@dataclass
class UniMASKConfig(PreTrainedConfig):
    """Settings of a UniMASK policy. The defaults train on random masks; `configs/doorkey.yaml` has the paper's network.

    Raises:
        ValueError: a setting outside its range, or one that contradicts another.
        MaskError: a mask text that does not parse.
    """

    # The window
    context_length: int = 5
    """K: steps that the model sees at once; a question about more of them needs a longer window."""
    drop_n_last_frames: int | None = None
    """Frames at the end of an episode that start no training window; None: K - 1, which keeps to full windows."""

    # The questions
    training_masks: list[str] | dict[str, float] | str = RANDOM_MASK
    """What is trained on: one mask text or task name, a list, or a mapping to weights."""
    mask_seed: int = 0
    """Training masks are a function of this seed, the update count and the frame's index."""
    inference_mask: str = "behavior_cloning"
    """The question that acting asks at every step; it must ask for a[t]."""
    target_return: float | str | None = None
    """Return to ask for from an episode's first step on, shown as rtg[0] where the inference mask shows it;
    "auto": that of the training episode whose first state is nearest, times target_return_scale."""
    target_return_scale: float = 1.1
    """Factor of the nearest episode's return, with target_return=auto; the paper asks for a tenth more."""
    given: dict[str, list[list[float] | float | str] | float | str] = field(default_factory=dict)
    """Values of single tokens in a rollout, in the dataset's units: of a position in the window, {"s[-1]": [15, 15]},
    of a step of the episode, {"s@150": [15, 15]}, or a task's text, {"task[0]": "open the door"}."""
    sample_actions: bool = False
    """Whether acting draws from the answer instead of taking its most likely action."""
    n_obs_steps: int | None = None
    """Steps that acting remembers, at most K; None: K. A setting of acting, not of training; but where K is long, fewer
    want a training with drop_n_last_frames=0."""
    chunk_size: int = 1
    """H: actions that acting asks for at once, from the present on. H - 1 steps of the window then lie ahead of the
    present, for as long as the episode lasts."""
    n_action_steps: int = 1
    """Actions of a chunk that are carried out before acting asks again, at most H."""

    # The network
    network: str = "transformer"
    """Architecture: "transformer", or one of the paper's others, "feedforward" and "decision_transformer"."""
    attention: str | None = None
    """How a window is read. "both": training windows are read causally or in both directions, and so are questions:
    causally where they ask for the next token given all before it, as acting does, or for what was trained causally.
    "bidirectional" is the paper's, "causal" only acts. None: the network's own way, "both" for the transformer."""
    causal_share: float = 0.5
    """Share of the training windows that are read causally, with attention=both."""
    token_layout: str = "separate"
    """Tokens of a step. "separate": one for each factor; "stacked", the paper's: one, made of all its factors."""
    fine_inputs: bool | None = None
    """Whether continuous values are read with displacements, sines and cosines, which tell places apart that are close
    together, but let a network learn few episodes by heart; False: as plain numbers, the paper's. None: where the
    dataset has 500 episodes or more for each of its tasks."""
    state_residuals: bool = True
    """Whether continuous states are predicted as departures from the straight course of those shown; False: as plain
    values, the paper's."""
    ask_properties: bool | None = None
    """Whether the return and properties are predicted too: rtg[0] | s[:t+1]. None: yes, but for attention=causal."""
    discrete_head: str | None = None
    """What is predicted of a token's discrete numbers: "joint", one distribution over all combinations of their
    categories (up to 16,384; more are divided), or "separate", the paper's: one for each number. None: joint; in a
    checkpoint of format 2 or older, separate."""
    continuous_head: str = "gaussian"
    """What is predicted of continuous values: "gaussian", a mean and a scale for each number; "mixture", several
    Gaussians over all of a token's numbers together, for futures that fork; or "l2", the paper's: a mean by the squared
    error, which hardly notices what is nearly certain, such as states some steps ahead."""
    mixture_components: int = 5
    """Number of Gaussians, with continuous_head=mixture."""
    width: int = 128
    """Numbers that stand for a token inside the network."""
    depth: int = 3
    """Number of blocks, or of the perceptron's hidden layers."""
    heads: int = 8
    """Attention heads of a block; they divide the width."""
    feedforward_width: int = 512
    """Width of the layer inside a block, or of the perceptron's hidden layers."""
    dropout: float = 0.1
    """Share of a layer's outputs that training leaves out."""

    vision_backbone: str | None = None
    """What looks at pictures: a ResNet of torchvision by its name, such as "resnet18"; None: three convolutions, which
    two processor cores can train."""
    pretrained_backbone_weights: str | None = None
    """Weights that the ResNet begins with, torchvision's "ResNet18_Weights.IMAGENET1K_V1" for one; None: drawn."""
    optimizer_lr_backbone: float | None = None
    """Learning rate of what looks at pictures; None: optimizer_lr."""

    # The loss
    loss_weights: dict[str, float] = field(default_factory=dict)
    """Weight of each factor's loss, {"s": 0.5}; where not named 1, of properties 1 / context_length."""

    # The optimiser's preset
    optimizer_lr: float = 1e-3
    """Learning rate of AdamW, at its highest."""
    optimizer_weight_decay: float = 0.01
    """Weight decay of AdamW."""
    optimizer_grad_clip_norm: float = 1.0
    """Norm to which gradients are clipped."""
    use_amp: bool = False
    """Whether training computes in bfloat16; on a processor that has no such arithmetic it stays with float32."""
    compile_model: bool | None = None
    """Whether torch.compile captures what an update computes: 20 to 60 s at the start, and on a GPU a few launches for
    each update instead of hundreds. None: on one GPU, without cameras, after 200 updates; not where it fails."""
    scheduler_warmup_steps: int = 200
    """Updates in which the learning rate rises; then it falls along a cosine."""

    # The data
    states: list[str] | None = None
    """Columns that make up `s`, such as ["observation.state", "observation.velocity"]; None: observation.state and
    observation.environment_state, where the dataset has them."""
    properties: list[str] = field(default_factory=list)
    """Columns that label whole episodes, observation.NAME: each is a factor NAME, shown as NAME[0] or not at all."""

    cameras: list[str] | None = None
    """Columns of pictures that the model reads, such as ["observation.images.top"]; [] reads none, None all that the
    dataset has, but for depth."""
    image_size: list[int] = field(default_factory=lambda: [96, 96])
    """Height and width at which pictures are read."""
    cache_frames: bool = True
    """Whether a dataset's pictures are decoded once, at this size, into files under LeRobot's cache folder; False: at
    each read."""

    # Read off the training dataset and saved, so that a checkpoint knows what it was trained on.
    features: dict[str, list[Feature]] = field(default_factory=dict)
    """Factor name -> the dataset's columns that make it up."""
    pictures: dict[str, Camera] = field(default_factory=dict)
    """Name of each camera that the model reads -> the dataset's column."""
    dataset_revision: str | None = None
    """Commit on the Hub that the training data are of; None: they were read from a folder."""
    format_version: FormatVersion = FORMAT_VERSION
    """Format of a checkpoint's files."""

    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=UNCHANGED.copy)
    """LeRobot's processors change no number: the policy normalises, with statistics that it keeps itself."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.use_amp and not has_bfloat16(str(self.device)):
            logger.warning("use_amp does not help here: this processor has no bfloat16 arithmetic. Using float32.")
            self.use_amp = False
        for name, most in MOST.items():
            value, bound = getattr(self, name), getattr(self, most) if isinstance(most, str) else most
            if not (1 <= value <= bound if value is not None else name == "n_obs_steps"):
                limit = f", {most}" if bound != most else ""
                if most == "context_length" and (value or 0) > bound:
                    limit += f". For more train with --policy.context_length={value} or more"
                raise ValueError(f"{name} is {value}; it must lie in 1 to {bound}{limit}.")
        if self.drop_n_last_frames is None:
            self.drop_n_last_frames = self.context_length - 1
        if self.network not in NETWORKS:
            raise ValueError(f"network is {self.network!r}; choose one of {', '.join(NETWORKS)}.")
        if self.attention is None:
            self.attention = NETWORKS[self.network][0]
        if self.discrete_head is None:
            self.discrete_head = "joint" if self.format_version > 2 else "separate"
        if self.ask_properties is None:
            self.ask_properties = self.format_version > 3 and self.attention != "causal"
        self.format_version = FORMAT_VERSION
        for name, choices in {
            "attention": NETWORKS[self.network],
            "token_layout": TOKEN_LAYOUTS,
            "discrete_head": DISCRETE_HEADS,
            "continuous_head": CONTINUOUS_HEADS,
        }.items():
            if getattr(self, name) not in choices:
                of = f" with network={self.network}" if name == "attention" else ""
                raise ValueError(f"{name} is {getattr(self, name)!r}; choose one of {', '.join(choices)}{of}.")
        if self.token_layout == "stacked" and self.attention != "bidirectional":
            raise ValueError(
                "token_layout=stacked needs attention=bidirectional: a step's state and action are one token there, "
                "so the state cannot be seen before the action."
            )
        if not 0 < self.causal_share < 1:
            raise ValueError(
                f"causal_share is {self.causal_share}; it must lie between 0 and 1. For none or all use "
                "attention=bidirectional or causal."
            )
        if self.width % self.heads:
            raise ValueError(f"width ({self.width}) must be a multiple of heads ({self.heads}).")
        if len(self.image_size) != 2 or not all(1 <= size <= 4096 for size in self.image_size):
            raise ValueError(f"image_size is {self.image_size}; give height and width, 1 to 4096 pixels: [96, 96].")
        if self.vision_backbone is not None and not self.vision_backbone.startswith("resnet"):
            raise ValueError(f"vision_backbone is {self.vision_backbone!r}; name a ResNet, such as resnet18, or none.")
        if self.pretrained_backbone_weights is not None and self.vision_backbone is None:
            raise ValueError("pretrained_backbone_weights needs vision_backbone: the convolutions have none.")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout is {self.dropout}; it must lie in [0, 1).")
        if isinstance(self.target_return, str) and self.target_return != "auto":
            raise ValueError(f"target_return is {self.target_return!r}; give a number or auto.")
        if isinstance(self.target_return, float) and not math.isfinite(self.target_return):
            raise ValueError(f"target_return is {self.target_return}; give a finite number or auto.")
        for name, weight in self.loss_weights.items():
            if name not in ASKABLE and not self.ask_properties:
                raise ValueError(f"loss_weights names {name}; only {' and '.join(ASKABLE)} are predicted.")
            if not 0 <= weight < float("inf"):
                raise ValueError(f"loss_weights gives {name} the weight {weight}; weights are numbers from 0 on.")
        # Just the syntax: which factors exist is known once the dataset or the checkpoint has been read.
        for text in mixture(self.training_masks):
            if text != RANDOM_MASK:
                parse(text)
        parse(self.inference_mask)

    def predicted(self, factors: Iterable[str]) -> tuple[str, ...]:
        """Those of the model's factors that it can be asked for: states and actions, and then properties."""
        properties = [name for name in factors if name not in (*ASKABLE, *self.pictures)]
        return (*ASKABLE, *properties) if self.ask_properties else ASKABLE

    def make_factors(self) -> dict[str, Factor]:
        """The model's factors, and how the heads predict them."""
        gaussians = {"l2": 0, "gaussian": 1, "mixture": self.mixture_components}[self.continuous_head]
        return make_factors(self.features, joint=self.discrete_head == "joint", gaussians=gaussians)

    # LeRobot's contract

    @property
    def dtype(self) -> str:
        """What lerobot-train computes in; without it, `use_amp` on a GPU would be float16."""
        return "bfloat16" if self.use_amp else "float32"

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(self.context_length))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.context_length))

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        return FusedAdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig:
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    def set_dataset_feature_metadata(self, dataset_features: dict[str, dict[str, Any]]) -> None:
        """Read the factors off a dataset's features; LeRobot calls this only in training. Properties may be new.

        Raises:
            ValueError: the dataset has no action or no state, or is not one that a loaded checkpoint can go on with.
        """
        found = {key: read_feature(key, entry) for key, entry in dataset_features.items() if is_numeric(entry)}
        check_layout(dataset_features, self.states)
        features = group_features(found, self.properties, self.states)
        pictures = self._named_cameras(dataset_features, features)
        tasks = {name: columns for name, columns in self.features.items() if name == TASK}  # not among the columns
        features |= tasks
        added = {key.rpartition(".")[-1] for key in self.properties} - self.features.keys()
        known = {name: columns for name, columns in features.items() if name not in added}
        if self.features and (known, pictures) != (self.features, self.pictures):
            raise ValueError(
                "This checkpoint was trained on other features than the dataset has.\n"
                f"  checkpoint: {describe_features(self.features, self.pictures)}\n"
                f"  dataset:    {describe_features(features, pictures)}"
            )
        self.features, self.pictures = features, pictures

    def cameras_of(self, dataset_features: dict[str, dict[str, Any]]) -> list[str]:
        """The columns of pictures that the model reads of a dataset: a checkpoint's own, where there is one.

        Raises:
            ValueError: a camera that the dataset does not have, or a network that reads none.
        """
        colour = list(colour_cameras(dataset_features))
        wanted = self.cameras
        if wanted is None:
            wanted = [camera.key for camera in self.pictures.values()] if self.features else colour
        for key in wanted:
            if key not in colour or wanted.count(key) > 1:
                raise ValueError(
                    f"The camera {key!r} is not among the dataset's, or named twice; its colour cameras are "
                    f"{', '.join(colour) or 'none'}. `unimask prepare --rename OLD={key}` gives one that name."
                )
            if not key.startswith(OBS_PREFIX):
                raise ValueError(
                    f"LeRobot hands policies no pictures of a column named {key!r}: `unimask prepare` names it "
                    f"{OBS_IMAGES}.{key}, --policy.cameras=[] reads none."
                )
        if wanted and self.network != "transformer":
            raise ValueError(f"network={self.network} reads no cameras: leave them out with --policy.cameras=[].")
        return list(wanted)

    def _named_cameras(self, entries: dict[str, dict[str, Any]], taken: Iterable[str]) -> dict[str, Camera]:
        channels = colour_cameras(entries)
        return name_cameras({key: channels[key] for key in self.cameras_of(entries)}, self.image_size, list(taken))

    def add_tasks(self, texts: Sequence[str]) -> None:
        """Make the task a factor, where the dataset has several."""
        if len(texts) > 1 and self.network != "decision_transformer":  # which reads no properties
            self.features[TASK] = [Feature(TASK, 1, [len(texts)], labels=list(texts))]

    def validate_features(self) -> None:
        """Where no dataset has said more, take the factors from LeRobot's input and output features, all continuous.

        Raises:
            ValueError: there is no action or no state.
        """
        if not self.features:
            declared = {**(self.input_features or {}), **(self.output_features or {})}
            sizes = {key: feature for key, feature in declared.items() if len(feature.shape) <= 1}
            found = {key: Feature(key, feature.shape[0] if feature.shape else 1) for key, feature in sizes.items()}
            self.features = group_features(found, self.properties, self.states)
            pictures = {
                key: {"dtype": "image", "shape": list(feature.shape), "names": ["channels", "height", "width"]}
                for key, feature in declared.items()
                if len(feature.shape) == 3
            }
            self.pictures = self._named_cameras(pictures, self.features)


def _upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """A config.json of format 1 as one of today's format, which answers the same."""
    content = {name: value for name, value in content.items() if name != "causal_draw"}
    content["n_obs_steps"] = None  # LeRobot's own default, 1, stands in all of them, and nothing read it
    content["state_residuals"] = content.get("fine_inputs", True)
    content |= {"discrete_head": "separate", "ask_properties": False}
    content["format_version"] = int(FORMAT_VERSION)
    if content.get("network") == "decision_gpt":
        content |= {"network": "transformer", "attention": "causal", "token_layout": "separate"}
    return content


def read_config(folder: Path) -> UniMASKConfig:
    """A checkpoint's config.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is not one of this policy. Says what is wrong; LeRobot's parser hides that behind its own words.
    """
    path = folder / CONFIG_NAME
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no checkpoint: there is no {CONFIG_NAME} in it.")
    content = read_json(path)
    kind = content.get("type") if isinstance(content, dict) else None
    if kind != UniMASKConfig.get_choice_name(UniMASKConfig):
        raise ValueError(f"{folder} is a policy of type {kind!r}, not of type 'unimask'.")
    try:
        if content.get("format_version") != 1:
            return PreTrainedConfig.from_pretrained(folder)
        with TemporaryDirectory() as upgraded:
            (Path(upgraded) / CONFIG_NAME).write_text(json.dumps(_upgraded(content)))
            return PreTrainedConfig.from_pretrained(upgraded)
    except (ParsingError, ValueError, AttributeError) as error:
        hidden = isinstance(error, ParsingError) and not isinstance(error, DecodingError)
        reason = error.__cause__ if hidden else error
        raise ValueError(f"{path} cannot be read: {str(reason)[:1000]}") from error
