"""UniMASKPolicy: the masked model behind LeRobot's policy contract, and the questions that one can ask it."""

import contextlib
import io
import logging
import shlex
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_unimask.asking.acting import act, check_settings, new_memory, observed_return, observed_state, plan_from
from lerobot_unimask.asking.answers import Answer, answer, predict, without_dropout
from lerobot_unimask.asking.given import Given
from lerobot_unimask.asking.held_out import HeldOutActions
from lerobot_unimask.asking.looking import observed_pictures
from lerobot_unimask.asking.memory import RolloutMemory
from lerobot_unimask.asking.questions import pose_question
from lerobot_unimask.asking.sampling import Check, Samples, check_count, make_generator, sample
from lerobot_unimask.configuration_unimask import FINE_FROM, UniMASKConfig, read_config
from lerobot_unimask.data.checkpoints import WEIGHTS, check_header, check_weights, read_weights
from lerobot_unimask.data.factors import TASK
from lerobot_unimask.data.returns import EpisodeStarts
from lerobot_unimask.data.soundness import check_loss, check_saved
from lerobot_unimask.data.taking_over import take_over
from lerobot_unimask.data.window import Statistics, Window, frame_index, make_window, read_batch, task_column
from lerobot_unimask.language.masks import Mask
from lerobot_unimask.language.training_masks import VALIDATION_STEP, TrainingMasks
from lerobot_unimask.machine import keep_freed_memory, wait_without_spinning
from lerobot_unimask.networks import make_network
from lerobot_unimask.networks.growing import fitted, saved_config
from lerobot_unimask.networks.layers import Cache, Predictions
from lerobot_unimask.networks.vision import parameter_groups
from lerobot_unimask.objective import CapturedLoss, LossParts, batch_loss
from lerobot_unimask.processor_unimask import make_unimask_pre_post_processors
from lerobot_unimask.records import read_json
from lerobot_unimask.sharing import cards, hub

logger = logging.getLogger(__name__)


class UniMASKPolicy(PreTrainedPolicy):
    """One masked transformer over windows of states, actions and returns (Carroll et al., NeurIPS 2022).

    Args:
        config: settings, with `features` read off a dataset, or LeRobot's input and output features.
        dataset_stats: statistics to normalise with, `LeRobotDatasetMetadata.stats`; without them nothing is scaled
            until a checkpoint is loaded.
        dataset_meta: metadata of the training dataset; its folder holds how each episode began and what it returned.
        load_backbone: whether pretrained weights of what looks at pictures are fetched; a checkpoint brings its own.

    Raises:
        ValueError: the dataset lacks states or actions, or the settings ask for a factor that it does not have.
        MaskError: a training mask or the inference mask that does not fit the model's factors and window.
    """

    config_class = UniMASKConfig
    name = "unimask"

    def __init__(
        self,
        config: UniMASKConfig,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        load_backbone: bool = True,
    ) -> None:
        super().__init__(config)
        config.validate_features()
        if dataset_meta is not None and TASK not in config.features:
            config.add_tasks(list(dataset_meta.tasks.index))
        if config.fine_inputs is None:
            config.fine_inputs = (
                dataset_meta is None or dataset_meta.total_episodes >= FINE_FROM * dataset_meta.total_tasks
            )
        self.factors = config.make_factors()
        self.cameras = config.pictures
        check_settings(config, self.factors)
        self.statistics = Statistics(config.features, self.factors, config.context_length)
        self.episode_starts = EpisodeStarts(self.factors["s"].size)
        self._read_dataset(dataset_stats, dataset_meta)
        self.training_masks = TrainingMasks(
            config.training_masks,
            tuple(self.factors),
            config.context_length,
            causal_share=config.causal_share if config.attention == "both" else float(config.attention == "causal"),
            cameras=tuple(self.cameras),
            predicted=config.predicted(self.factors),
        )
        self.network = make_network(config, self.factors, load_backbone=load_backbone)
        captured = CapturedLoss(required=bool(config.compile_model))
        self._batch_loss = batch_loss if config.compile_model is False else captured
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))  # made so far; training masks depend on it
        self._held_out = HeldOutActions()  # since it was last trained
        self._loss: Tensor | None = None  # of the last batch that was trained on
        self.origin: hub.Origin | None = None  # where it was loaded from
        self.folder: Path | None = None  # of the files that were loaded, on this machine
        self.reset()

    def _read_dataset(self, stats: Mapping[str, Mapping[str, Any]] | None, meta: LeRobotDatasetMetadata | None) -> None:
        """Take over what is kept of a training dataset: its statistics, and its episodes' starts and returns."""
        if meta is not None:
            self.config.dataset_revision = hub.commit_of(Path(meta.root))
            window = {"steps": self.config.context_length, "dropped": self.config.drop_n_last_frames or 0}
            take_over(meta, stats or {}, self.config.features, self.statistics, self.episode_starts, **window)
        elif stats is not None:
            self.statistics.fill(stats)

    @property
    def device(self) -> torch.device:
        return self.updates.device

    @property
    def number_names(self) -> dict[str, list[str]]:
        """factor -> the name of each number that the dataset stores of it."""
        return {
            name: [label for component in factor.components if not component.computed for label in component.names]
            for name, factor in self.factors.items()
        }

    # --- Training ----------------------------------------------------------------------------------------------------

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, LossParts]:
        """The loss of one batch.

        Args:
            batch: `observation.state` (B, K, D), `action` (B, K, D), `observation.return_to_go` (B, K), each with its
                `*_is_pad` (B, K), cameras (B, K, C, H, W), `timestamp` (B,) and `index` (B,). Not changed.
            reduction: "mean"; or "none" for each window's part, which lerobot-train weights with --sample_weighting.

        Returns:
            The scalar loss, or (B,) whose mean it is; and each factor's part in it for the log.
        """
        window = self.make_window(batch)
        step, index = self.updates if self.training else VALIDATION_STEP, frame_index(batch, window)
        loss, losses = self._batch_loss(self, window, index, step, reduction)
        if self.training:
            self._loss = _mean(loss)
        else:
            self._held_out.add(self, window, index)
        return loss, LossParts({f"loss_{name}": _mean(part) for name, part in losses.items()})

    def train(self, mode: bool = True) -> "UniMASKPolicy":
        """As PyTorch's; on a processor, training begins with glibc told to keep freed memory, and with threads
        that do not spin where other processes want the cores. What lies between two trainings is an evaluation of
        held-out episodes, of which this then says how far acting is from repeating the last action."""
        if mode and (line := self._held_out.line(self)):
            logger.info(line)
        self._held_out = HeldOutActions()
        if mode and self.device.type == "cpu":
            keep_freed_memory()
            wait_without_spinning()
        return super().train(mode)

    def update(self) -> None:
        """Count an update; LeRobot calls this after each optimiser step, when it has read the loss.

        Raises:
            FloatingPointError: the loss is no longer finite. The last checkpoint is whole: it was saved before.
        """
        if self._loss is not None:
            check_loss(self._loss, self.updates)
        self.updates += 1

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """What --peft adapts, of whichever network: its linear layers."""
        linear = r"query_key_value|project|feedforward\.[02]|hidden\.\d+\.0|numbers|returns|stack|out|heads\.\w+"
        return {"target_modules": rf"network\.(.*\.)?({linear})"}

    def get_optim_params(self) -> Iterable[torch.nn.Parameter] | list[dict[str, Any]]:
        return parameter_groups(self, self.config.optimizer_lr_backbone)

    # --- Asking ------------------------------------------------------------------------------------------------------

    def predict(self, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
        """What the network puts out for each asked token; see `asking.answers.predict`."""
        return predict(self, window, mask, cache)

    def make_window(self, batch: Mapping[str, Any], *, partial: bool = False) -> Window:
        """A LeRobot batch as a window of this model, in the dataset's units; see `data.window.make_window`."""
        if TASK in self.factors and TASK in batch:
            batch = {**batch, TASK: task_column(batch[TASK], self.factors[TASK], self.config.context_length)}
        return make_window(
            read_batch(batch, self.config.features, self.device, self.cameras),
            self.config.features,
            self.config.context_length,
            horizon=self.statistics.horizon,
            fps=self.statistics.fps,
            partial=partial,
            cameras=self.cameras,
        )

    @torch.no_grad()
    def infer(
        self,
        window: Window | Mapping[str, Tensor] | None,
        mask: Mask | str,
        *,
        t: int | None = None,
        given: Given | None = None,
    ) -> Answer:
        """The distribution of every asked token given the shown ones.

        Args:
            window: recorded values: a LeRobot batch ((B, K, ...) under the dataset's keys; columns that the mask does
                not show may be missing) or a Window; None where everything shown is in `given`. Not changed.
            mask: a question, the name of a task, or a Mask.
            t: step that the question is about, where it has a t.
            given: values of single tokens, {"s[-1]": [15, 15], "rtg[0]": 5}, instead of the recorded ones. Steps past
                a recorded episode's end stay hidden all the same.

        Raises:
            MaskError: the question does not fit the model, or not this t.
            ValueError: a shown token is neither recorded nor given, or a given value is not a legal one.
        """
        window, mask = pose_question(self, window, mask, t, given)
        with without_dropout(self):
            return answer(self, window, mask)

    @torch.no_grad()
    def sample(
        self,
        window: Window | Mapping[str, Tensor] | None,
        mask: Mask | str,
        *,
        t: int | None = None,
        given: Given | None = None,
        samples: int = 1,
        order: str = "forward",
        seed: int = 0,
        check: Check | None = None,
        tries: int = 100,
    ) -> Samples:
        """Draw the asked tokens jointly, one after another by the chain rule; see `infer` for the other arguments.

        Args:
            samples: number of draws for each window; those of a window stand together, (B * samples, K, D).
            order: `forward` in time, `backward` or `random`.
            seed: number that the draws follow from.
            check: rule that a sample must keep: what breaks it is drawn again, see `asking.sampling.sample`.
            tries: bound of how often.

        Returns:
            A window in the dataset's units: shown values as they were, drawn ones where asked, NaN elsewhere; with the
            numbers of tokens drawn and rejected, and of samples started over.

        Raises:
            ValueError: also where the check cannot be met.
        """
        window, mask = pose_question(self, window, mask, t, given)
        window, mask = window.repeat(check_count(samples)), mask.repeat(samples)
        generator = make_generator(seed, self.device)
        with without_dropout(self):
            return sample(self, window, mask, order=order, generator=generator, check=check, tries=tries)

    # --- Acting ------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the episode; LeRobot calls this once for each batch of environments."""
        self._memory: RolloutMemory | None = None

    @torch.no_grad()
    def select_action(
        self,
        batch: dict[str, Any],
        *,
        mask: str | None = None,
        given: Given | None = None,
        sample: bool | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """One action for each environment: the answer to the inference mask at the present step.

        Args:
            batch: `observation.state` (B, D) of this step; cameras (B, C, H, W), from 0 to 1, where the model has any;
                `observation.return_so_far` (B, 1) where a return is asked for and the episode is longer than the
                window; `task`, a text or (B,) of them, where the model has several. Not changed.
            mask: question of this step, instead of `inference_mask`. While actions of a chunk are left, none is put.
            given: values of single tokens, instead of the config's: of positions in the window, `s[-1]`, or of steps
                of the episode, `s@150`. What has been observed wins over them.
            sample: whether to draw the action instead of taking the most likely one; None: as `sample_actions` says.
            generator: source of the draws; None: torch's global one, which lerobot-eval seeds.

        Returns:
            (B, D) in the dataset's units: int64 category numbers, or float32.

        Raises:
            MaskError: the mask does not ask for a[t] or does not fit the model.
            ValueError: the mask shows a later token that nobody gives, or not one that is given; a value is not legal.
        """
        state = observed_state(self, batch)
        so_far = observed_return(self, batch, len(state))
        if self._memory is None or len(self._memory.valid) != len(state):
            self._memory = new_memory(self, len(state))
        question = {"mask": mask, "given": given, "sample": sample, "generator": generator}
        with without_dropout(self):
            pictures = observed_pictures(self, batch, len(state))
            return act(self, self._memory, state, so_far, pictures, batch.get(TASK), **question)

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        inference_delay: int = 0,
        prev_chunk_left_over: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """A chunk for this observation, (B, H, D). Nothing is remembered, so that a server or a thread may call it at
        any time; for arguments see `asking.acting.plan_from`."""
        how = {"inference_delay": inference_delay, "left_over": prev_chunk_left_over, **kwargs}
        with without_dropout(self):
            state = observed_state(self, batch)
            return plan_from(self, state, observed_pictures(self, batch, len(state)), batch.get(TASK), **how)

    def supports_rtc(self) -> bool:
        """Whether LeRobot may act by real-time chunking: there is more than one action to a chunk."""
        return self.config.chunk_size > 1

    # --- Checkpoints -------------------------------------------------------------------------------------------------

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> "UniMASKPolicy":
        """Load a checkpoint, as LeRobot's base class does; weights load strictly.

        Args:
            pretrained_name_or_path: folder of a checkpoint, output folder of lerobot-train, of which the last
                checkpoint counts, or repository of the Hub.
            dataset_stats, dataset_meta: those of the dataset to go on with (fine-tuning): what they say of it replaces
                what the checkpoint kept of its own.
            kwargs: arguments of the base class: `config`, `revision`, `token`, `local_files_only`, ...

        Raises:
            HubError: a repository, revision or file is missing or damaged, or there is no folder of that name.
            ValueError: the config is not one of this policy, or the weights are not its: names every missing, extra or
                misshapen tensor.
        """
        config = kwargs.pop("config", None)
        revision = kwargs.pop("revision", None)
        names = ("force_download", "token", "cache_dir", "local_files_only")
        download = {name: kwargs.pop(name) for name in names if name in kwargs}
        folder = hub.find_policy(pretrained_name_or_path, revision=revision, **download)
        config = config or read_config(folder)
        config.validate_features()
        with torch.device("meta"):
            saved = saved_config(config, folder)
            network = make_network(saved, saved.make_factors(), load_backbone=False)
        check_header(folder / WEIGHTS, network.state_dict(prefix="network."))
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints where the weights come from
            policy = super().from_pretrained(folder, config=config, **kwargs)
        before = {name: value.clone() for name, value in policy.statistics.state_dict().items()}
        policy._read_dataset(dataset_stats, dataset_meta)
        policy.statistics.warn_of_difference(before)
        source = folder if Path(pretrained_name_or_path).is_dir() else pretrained_name_or_path
        policy.origin, policy.folder = hub.Origin(str(source), hub.commit_of(folder)), folder
        return policy

    def describe_origin(self) -> dict[str, Any]:
        """Which policy this is, for a record: its folder or repository, commit and number of updates."""
        path, revision = self.origin or (None, None)
        return {"path": path, "revision": revision, "updates": int(self.updates)}

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Config, weights and processors: all that acting needs.

        Raises:
            FloatingPointError: a weight is not finite.
        """
        check_saved(self.state_dict())
        super()._save_pretrained(save_directory, state_dict=state_dict)
        for pipeline in make_unimask_pre_post_processors(self.config):
            pipeline.save_pretrained(save_directory)

    def push_model_to_hub(
        self,
        cfg: TrainPipelineConfig,
        peft_model: Any = None,
        state_dict: dict[str, Tensor] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        """Push a finished training's policy, its processors and its card in one commit; lerobot-train calls this.

        Note: LeRobot's own asks a fixed public address to validate the card, and leaves the processors to later
        commits, so until then nobody can use the policy.

        Raises:
            HubError: it could not be pushed. Nothing of it is to be seen on the Hub then.
        """
        if peft_model is not None:  # an adapter is LeRobot's to save
            super().push_model_to_hub(cfg, peft_model, state_dict, dataset_meta)
            return
        name = Path(sys.argv[0]).name
        command = shlex.join([name, *sys.argv[1:]]) if name == "lerobot-train" else None
        with TemporaryDirectory() as folder:
            self.save_pretrained(folder, state_dict=state_dict)
            cfg.save_pretrained(folder)
            card = cards.policy_card(self.card_facts(Path(folder), command), self.config.repo_id)
            saved = Path(cfg.output_dir)
            url = hub.push_policy(Path(folder), self.config.repo_id, card, private=self.config.private, saved=saved)
        logging.info("Model pushed to %s", url)  # LeRobot's remote jobs watch for these words

    def card_facts(self, folder: Path, command: str | None = None) -> cards.PolicyFacts:
        """What a card says of this policy, which is saved in `folder`; `command` is what trained it."""
        train_config = folder / "train_config.json"
        return cards.PolicyFacts(
            config=self.config,
            weights=self.training_masks.weights,
            parameters=sum(parameter.numel() for parameter in self.network.parameters()),
            updates=int(self.updates),
            train_config=read_json(train_config) if train_config.exists() else None,
            command=command,
        )

    @classmethod
    def _load_as_safetensor(
        cls, model: "UniMASKPolicy", model_file: str, map_location: str, strict: bool
    ) -> "UniMASKPolicy":
        """Strictly, whatever `strict` says: LeRobot never passes it, and a partly loaded model answers nonsense.
        Separate heads become joint ones where the config says so, and what it asks for besides begins as drawn."""
        weights = read_weights(Path(model_file))
        if weights.get("episode_starts.returns", torch.empty(())).ndim == 1:
            model.episode_starts.make_room(len(weights["episode_starts.returns"]))
        saved = saved_config(model.config, Path(model_file).parent)
        weights = fitted(weights, saved, model.config, model.state_dict())
        check_weights(weights, model.state_dict(), model_file)
        model.load_state_dict(weights)
        return model


def _mean(loss: Tensor) -> Tensor:
    """The mean of a loss for each window, or the one loss, without its graph."""
    return loss.detach().mean() if loss.ndim else loss.detach()
