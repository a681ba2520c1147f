"""UniMASKPolicy: the masked model behind LeRobot's policy contract, and the questions that one can ask it."""

import json
import logging
import operator
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from draccus.utils import DecodingError, ParsingError
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.pretrained import PreTrainedPolicy
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.asking.answers import answer as answer_question
from lerobot_unimask.asking.given import Given, check_known, check_shown, check_values, give, read_given
from lerobot_unimask.asking.memory import RolloutMemory
from lerobot_unimask.asking.sampling import Check, Samples
from lerobot_unimask.asking.sampling import sample as sample_tokens
from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.factors import RETURN_SO_FAR, RETURN_TO_GO, make_factors
from lerobot_unimask.data.returns import EpisodeStarts, read_starts
from lerobot_unimask.data.window import Statistics, Window, make_window
from lerobot_unimask.language.grammar import MaskError
from lerobot_unimask.language.masks import Mask, MaskTable, tabulate
from lerobot_unimask.language.training_masks import VALIDATION_STEP, TrainingMasks
from lerobot_unimask.networks import make_network
from lerobot_unimask.networks.layers import Cache, Predictions
from lerobot_unimask.networks.losses import masked_losses
from lerobot_unimask.processor_unimask import make_unimask_pre_post_processors
from lerobot_unimask.sharing import hub

logger = logging.getLogger(__name__)


class LossParts(Mapping[str, float]):
    """What makes up a loss, for the log: scalar tensors, read off the device when somebody asks for the numbers.

    lerobot-train does so once it has waited for the update, so that between forward and backward nothing waits.
    """

    def __init__(self, parts: Mapping[str, Tensor | float]):
        self._parts = parts

    def __getitem__(self, name: str) -> float:
        return float(self._parts[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)


class UniMASKPolicy(PreTrainedPolicy):
    """One masked transformer over windows of states, actions and returns (Carroll et al., NeurIPS 2022).

    Args:
        config: with `features` read off a dataset, or LeRobot's input and output features.
        dataset_stats: statistics to normalise with, `LeRobotDatasetMetadata.stats`; without them nothing is scaled
            until a checkpoint is loaded.
        dataset_meta: the training dataset's metadata; its folder holds how each episode began and what it returned.

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
    ) -> None:
        super().__init__(config)
        config.validate_features()
        if config.image_features:
            logger.warning(
                "unimask ignores the camera features %s; LeRobot decodes them all the same.",
                ", ".join(config.image_features),
            )
        self.factors = make_factors(config.features, gaussian=config.continuous_head == "gaussian")
        self._check_settings()
        self.statistics = Statistics(config.features, self.factors, config.context_length)
        self.episode_starts = EpisodeStarts(self.factors["s"].size)
        self._read_dataset(dataset_stats, dataset_meta)
        self.training_masks = TrainingMasks(
            config.training_masks,
            tuple(self.factors),
            config.context_length,
            causal_share={"bidirectional": 0.0, "both": config.causal_share, "causal": 1.0}[config.attention],
            causal_draw=config.causal_draw,
        )
        self.network = make_network(config, self.factors)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))  # made so far; training masks depend on it
        # What to ask for at the start of an episode: as the config says, or a function of its first states, (B, D) ->
        # (B, 1), both in the dataset's units, which Python alone can set.
        self.target_return: float | str | Callable[[Tensor], Tensor] | None = config.target_return
        self.origin: hub.Origin | None = None  # where it was loaded from
        self.reset()

    def _read_dataset(self, stats: Mapping[str, Mapping[str, Any]] | None, meta: LeRobotDatasetMetadata | None) -> None:
        """Take over what is kept of a training dataset: its statistics, and its episodes' starts and returns."""
        if stats is not None:
            self.statistics.fill(stats)
        if meta is not None:
            self.config.dataset_revision = hub.commit_of(Path(meta.root))
        if meta is not None and "rtg" in self.factors:
            starts = read_starts(Path(meta.root), [f.key for f in self.config.features["s"]], RETURN_TO_GO)
            if starts is not None:
                self.episode_starts.fill(*starts)

    def _check_settings(self) -> None:
        unknown = set(self.config.loss_weights) - {"s", "a"}
        if unknown:
            raise ValueError(f"loss_weights names {', '.join(sorted(unknown))}; only s and a are predicted.")
        if self.config.target_return is not None and "rtg" not in self.factors:
            raise ValueError(
                f"target_return is {self.config.target_return}, but this model has no return factor: its dataset has "
                "no 'observation.return_to_go'."
            )
        for name, weight in self.config.loss_weights.items():
            if not 0 <= weight < float("inf"):
                raise ValueError(f"loss_weights gives {name} the weight {weight}; weights are numbers from 0 on.")
        table = self._acting_table(self.config.inference_mask)
        tokens = list(read_given(self.config.given, self.factors, self.config.context_length))
        if self.config.target_return is not None:
            if ("rtg", 0) in tokens:
                raise ValueError("target_return and given both name rtg[0]; give one of them.")
            tokens.append(("rtg", 0))
        check_shown(tokens, table.shows, self.config.inference_mask)
        missing = [
            f"{name}[{step}]"
            for name, ahead in table.shows_ahead.items()
            for step in ahead.nonzero().flatten().tolist()
            if (name, step) not in tokens
        ]
        if missing:
            logger.warning(
                "The inference mask shows %s before a rollout has observed it: rollouts fail unless it is given, with "
                "%s or in each call of select_action.",
                ", ".join(missing),
                "target_return" if missing == ["rtg[0]"] else "given",
            )
        for name, step in tokens:
            if not table.shows_ahead[name][step]:
                logger.warning(
                    "%s[%d] is given, but the inference mask shows it once it has been observed: it changes nothing.",
                    name,
                    step,
                )

    # --- Training ----------------------------------------------------------------------------------------------------

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, Mapping[str, float]]:
        """The loss of one batch.

        Args:
            batch: `observation.state` (B, K, D), `action` (B, K, D), `observation.return_to_go` (B, K), each with its
                `*_is_pad` (B, K), `timestamp` (B,) and `index` (B,), as LeRobot's dataset gives them. Not changed.

        Returns:
            The scalar loss, and each factor's part in it for the log.
        """
        window = self.make_window(batch)
        step = self.updates if self.training else VALIDATION_STEP
        mask = self.training_masks(window.valid, _index(batch, window), seed=self.config.mask_seed, step=step)
        window = self.statistics.normalise(window)
        predictions = self.network(window, mask.shown, mask.causal)
        losses = masked_losses(predictions, window, mask.asked, self.factors)
        loss = sum(self.config.loss_weights.get(name, 1.0) * part for name, part in losses.items())
        return loss, LossParts({f"loss_{name}": part.detach() for name, part in losses.items()})

    def update(self) -> None:
        """Count an update; LeRobot calls this after each optimiser step."""
        self.updates += 1

    def get_optim_params(self):
        return self.parameters()

    # --- Asking ------------------------------------------------------------------------------------------------------

    def predict(self, window: Window, mask: Mask, cache: Cache | None = None) -> Predictions:
        """What the network puts out for each asked-for token. A token that follows a history shown in full is predicted
        causally, where the model has learnt that, and every other one in both directions; so a token's answer does not
        depend on what else is asked.

        Args:
            window: normalised values.
            cache: of the rollout that asks; what it holds of a causal prediction is not computed again.

        Raises:
            MaskError: the model attends causally alone and has not learnt to answer this.
        """
        causally = self.training_masks.answered_causally(mask)
        if all(torch.equal(causally[name], mask.asked[name]) for name in causally):
            return self.network(window, mask.shown, True, cache)
        if self.config.attention == "causal":
            raise MaskError(
                "This model attends causally alone. It was trained on "
                f"{', '.join(self.training_masks.weights)}, and asks for one token given every state and action before "
                "it. A model of attention=both answers any question.",
                mask.draw(),
            )
        predictions = self.network(window, mask.shown, False)
        if any(tokens.any() for tokens in causally.values()):
            for name, outputs in self.network(window, mask.shown, True).items():
                here = causally[name].unsqueeze(-1)
                pairs = zip(outputs, predictions[name], strict=True)
                predictions[name] = [torch.where(here, causal, other) for causal, other in pairs]
        return predictions

    def make_window(self, batch: Mapping[str, Tensor], *, partial: bool = False) -> Window:
        """A LeRobot batch as a window of this model, in the dataset's units; see `window.make_window`."""
        return make_window(
            {key: value.to(self.device) for key, value in batch.items() if isinstance(value, Tensor)},
            self.config.features,
            self.config.context_length,
            horizon=self.statistics.horizon,
            fps=self.statistics.fps,
            partial=partial,
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
        """The distribution of every asked-for token given the shown ones.

        Args:
            window: recorded values: a LeRobot batch ((B, K, ...) under the dataset's keys; columns that the mask does
                not show may be missing) or a Window; None where everything shown is in `given`. Not changed.
            mask: a question, the name of a task, or a Mask.
            t: the step that the question is about, where it has a t.
            given: values of single tokens, {"s[-1]": [15, 15], "rtg[0]": 5}, instead of the recorded ones. Steps past
                a recorded episode's end stay hidden all the same.

        Raises:
            MaskError: the question does not fit the model, or not this t.
            ValueError: a shown token is neither recorded nor given, or a given value is not a legal one.
        """
        window, mask = self.pose(window, mask, t, given)
        with _evaluation(self):
            return answer_question(self.predict, self.statistics, self.factors, window, mask)

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
        """Draw the asked-for tokens jointly, one after another by the chain rule; see `infer` for the other arguments.

        Args:
            samples: how many of each window; those of a window stand together in the result, (B * samples, K, D).
            order: `forward` in time, `backward` or `random`.
            seed: the same seed draws the same samples.
            check: what a sample must not contradict: what it rejects is drawn again, see `asking.sampling.sample`.
            tries: bounds how often.

        Returns:
            A window in the dataset's units: shown values as they were, drawn ones where asked, NaN elsewhere; with the
            numbers of tokens drawn and rejected, and of samples started over.

        Raises:
            ValueError: also where the check cannot be met.
        """
        window, mask = self.pose(window, mask, t, given)
        window, mask = window.repeat(samples), mask.repeat(samples)
        generator = torch.Generator(self.device).manual_seed(seed)
        with _evaluation(self):
            return sample_tokens(
                self.predict,
                self.statistics,
                self.factors,
                window,
                mask,
                order=order,
                generator=generator,
                check=check,
                tries=tries,
            )

    def pose(
        self, window: Window | Mapping[str, Tensor] | None, mask: Mask | str, t: int | None, given: Given | None
    ) -> tuple[Window, Mask]:
        """The window and mask of a question, on the policy's device, with nothing shown that is not known; arguments
        and errors are those of `infer`."""
        K = self.config.context_length
        recorded = window is not None
        if window is None:
            rows = (len(token) for token in read_given(given or {}, self.factors, K).values())
            empty = RolloutMemory(self.factors, K, max(rows, default=1), self.device)
            window = empty.window(self.statistics.horizon)
            empty.carry_return(window)
        elif not isinstance(window, Window):
            window = self.make_window(window, partial=True)
        if window.valid.shape[1] != K:
            raise ValueError(f"The window has {window.valid.shape[1]} steps; this model's have {K}.")
        window = window.to(self.device)
        batch_size = len(window.valid)
        if isinstance(mask, Mask):
            text = mask.draw()
        else:
            table = self._table(mask)
            text, mask = table.question.text, table.at(None if t is None else operator.index(t), batch_size)
        mask = mask.to(self.device).within(window.valid)
        tokens = read_given(given or {}, self.factors, K, batch_size)
        known = {}
        for name, value in window.values.items():
            lacking = mask.shown[name] & value.isnan().any(-1)  # as in a sample, or a column that is not there
            known[name] = torch.full((K,), recorded) & ~lacking.any(0).cpu()
        for name, step in tokens:  # here the user changes a recorded window on purpose
            known[name][step] = False
        window, known = give(window, tokens, known)
        check_shown(tokens, mask.shown, text)
        check_known(mask, known, text)
        for name, value in window.values.items():
            check_values(f"A shown token of {name}", value[mask.shown[name]], self.factors[name])
        return window, mask

    def _table(self, text: str) -> MaskTable:
        return tabulate(text, tuple(self.factors), self.config.context_length)

    def _acting_table(self, text: str) -> MaskTable:
        """The table of a question that a rollout can ask at every step.

        Raises:
            MaskError: it does not ask for a[t].
        """
        table = self._table(text)
        if not table.acts:
            raise MaskError(
                "A mask for a rollout asks for a[t] at every step, as 'a[t] | s[:t+1], a[:t]' does.",
                table.question.text,
                table.question.asked[0].position,
            )
        return table

    # --- Acting ------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the episode; LeRobot calls this once for each batch of environments."""
        self._memory: RolloutMemory | None = None

    @torch.no_grad()
    def select_action(
        self,
        batch: dict[str, Tensor],
        *,
        mask: str | None = None,
        given: Given | None = None,
        sample: bool | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """One action for each environment: the answer to the inference mask at the present step.

        Args:
            batch: `observation.state` (B, D) of this step; `observation.return_so_far` (B, 1) where a return is asked
                for and the episode is longer than the window. Not changed.
            mask: this step's question, instead of `inference_mask`.
            given: values of window positions, instead of the config's; what has been observed wins over them.
            sample: draw the action instead of taking the most likely one; None: as `sample_actions` says.
            generator: to draw with; None: torch's global one, which lerobot-eval seeds.

        Returns:
            (B, D) in the dataset's units: int64 category numbers, or float32.

        Raises:
            MaskError: the mask does not ask for a[t] or does not fit the model.
            ValueError: the mask shows a later token that nobody gives, or not one that is given; a value is not legal.
        """
        state = self._state(batch)
        memory = self._memory
        if memory is None or len(memory.valid) != len(state):
            memory = self._memory = RolloutMemory(self.factors, self.config.context_length, len(state), self.device)
        table = self._acting_table(self.config.inference_mask if mask is None else mask)
        text = table.question.text
        so_far = batch.get(RETURN_SO_FAR)
        memory.observe(state, so_far.to(self.device).reshape(-1) if so_far is not None else None)
        if memory.step == 0:
            memory.target_return = self._choose_target(state)
        tokens = read_given(
            self.config.given if given is None else given, self.factors, self.config.context_length, len(state)
        )
        if given is not None:  # the config's may go unused by a question that is asked in passing
            check_shown(tokens, table.shows, text)
        if "rtg" in self.factors and table.shows["rtg"][0]:
            target = tokens.get(("rtg", 0), memory.target_return)
            if target is not None:
                tokens["rtg", 0] = memory.remaining(target.to(self.device))
        window, known = give(memory.window(self.statistics.horizon), tokens, memory.known())
        memory.carry_return(window)
        posed = table.at(memory.position, len(state))
        check_known(posed, known, text)
        with _evaluation(self):
            answer = answer_question(
                self.predict, self.statistics, self.factors, window, posed.to(self.device), memory.cache
            )
        chosen = self.config.sample_actions if sample is None else sample
        parts = [d.draw(generator) if chosen else d.most_likely for d in answer["a"]]
        action = torch.cat(parts, dim=-1)[:, memory.position]  # (B, D)
        memory.act(action)
        discrete = all(component.discrete for component in self.factors["a"].components)
        return action.long() if discrete else action

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A chunk of one action, (B, 1, D): `select_action`, which counts as the step's action; the question is asked
        anew at every step."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    def _choose_target(self, state: Tensor) -> Tensor | None:
        """The return to ask for from these first states (B, D) on, (B, 1) or (1, 1)."""
        target = self.target_return
        if target is None:
            return None
        if callable(target):
            return torch.as_tensor(target(state), dtype=torch.float32, device=self.device).reshape(-1, 1)
        if target == "auto":
            return self.config.target_return_scale * self.episode_starts.nearest_return(state)
        return torch.tensor([[float(target)]], device=self.device)

    def _state(self, batch: Mapping[str, Tensor]) -> Tensor:
        """(B, D) of the present step's `s`."""
        parts = []
        for feature in self.config.features["s"]:
            value = batch.get(feature.key)
            if value is not None and value.ndim == 1 and feature.size == 1:
                value = value.unsqueeze(-1)
            if value is None or value.shape[-1] != feature.size or value.ndim != 2:
                found = "nothing" if value is None else f"shape {tuple(value.shape)}"
                raise ValueError(
                    f"This policy observes {feature.key!r} with {feature.size} numbers, (batch, {feature.size}); "
                    f"the environment gives {found} under that name."
                )
            parts.append(value.to(self.device, torch.float32))
        state = torch.cat(parts, dim=-1)
        check_values("The observed state", state, self.factors["s"])
        return state

    # --- Checkpoints -------------------------------------------------------------------------------------------------

    @property
    def device(self) -> torch.device:
        return self.updates.device

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> "UniMASKPolicy":
        """Load a checkpoint, from a folder or the Hub, as LeRobot's base class does; weights load strictly.

        Args:
            dataset_stats, dataset_meta: of the dataset to go on with (fine-tuning): what they say of it replaces what
                the checkpoint kept of its own.
            kwargs: of the base class: `config`, `revision`, `token`, `local_files_only`, ...

        Raises:
            HubError: a repository, revision or file is missing or damaged, or there is no folder of that name.
            ValueError: the config is not one of this policy, or the weights are not its: names every missing, extra or
                misshapen tensor.
        """
        config = kwargs.pop("config", None)
        revision = kwargs.pop("revision", None)
        folder = Path(pretrained_name_or_path)
        if not folder.is_dir():
            names = ("force_download", "token", "cache_dir", "local_files_only")
            download = {name: kwargs.pop(name) for name in names if name in kwargs}
            folder = hub.fetch(str(pretrained_name_or_path), revision=revision, **download)
        config = config or _read_config(folder)
        saved = folder / CONFIG_NAME
        if saved.exists() and "attention" not in json.loads(saved.read_text()):  # it has learnt nothing causally
            raise ValueError(
                f'{saved} is of a version without attention in one direction: add "attention": "bidirectional" to it.'
            )
        policy = super().from_pretrained(folder, config=config, **kwargs)
        policy._read_dataset(dataset_stats, dataset_meta)
        policy.origin = hub.Origin(str(pretrained_name_or_path), hub.commit_of(folder))
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Config, weights and processors: all that acting needs."""
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
        with TemporaryDirectory() as folder:
            self.save_pretrained(folder, state_dict=state_dict)
            cfg.save_pretrained(folder)
            url = hub.push_policy(
                self,
                Path(folder),
                self.config.repo_id,
                private=self.config.private,
                command=shlex.join([name, *sys.argv[1:]]) if name == "lerobot-train" else None,
                saved=Path(cfg.output_dir),
            )
        logging.info("Model pushed to %s", url)  # LeRobot's remote jobs watch for these words

    @classmethod
    def _load_as_safetensor(
        cls, model: "UniMASKPolicy", model_file: str, map_location: str, strict: bool
    ) -> "UniMASKPolicy":
        """Strictly, whatever `strict` says: LeRobot never passes it, and a partly loaded model answers nonsense."""
        try:
            weights = load_file(model_file, device="cpu")
        except (SafetensorError, OSError) as error:
            raise ValueError(f"{model_file} cannot be read as safetensors: {error}") from error
        if weights.get("episode_starts.returns", torch.empty(())).ndim == 1:
            model.episode_starts.make_room(len(weights["episode_starts.returns"]))
        expected = model.state_dict()
        faults = [f"missing {name}" for name in expected if name not in weights]
        faults += [f"extra {name}" for name in weights if name not in expected]
        faults += [
            f"{name} has shape {tuple(weights[name].shape)} instead of {tuple(tensor.shape)}"
            for name, tensor in expected.items()
            if name in weights and weights[name].shape != tensor.shape
        ]
        if faults:
            raise ValueError(f"The weights in {model_file} are not those of its config: {'; '.join(faults)}.")
        model.load_state_dict(weights)
        return model


def _read_config(folder: Path) -> UniMASKConfig:
    """A checkpoint's config.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is not one of this policy. Says what is wrong; LeRobot's parser hides that behind its own words.
    """
    path = folder / CONFIG_NAME
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no checkpoint: there is no {CONFIG_NAME} in it.")
    try:
        if json.loads(path.read_text()).get("type") != UniMASKConfig.get_choice_name(UniMASKConfig):
            raise ValueError("it is not that of a unimask policy.")
        return PreTrainedConfig.from_pretrained(folder)
    except (ParsingError, ValueError, AttributeError) as error:
        hidden = isinstance(error, ParsingError) and not isinstance(error, DecodingError)
        reason = error.__cause__ if hidden else error
        raise ValueError(f"{path} cannot be read: {reason}") from error


@contextmanager
def _evaluation(policy: UniMASKPolicy) -> Iterator[None]:
    """Answers are given without dropout, also while the policy is being trained."""
    was_training = policy.training
    if was_training:  # each change of mode walks through all modules
        policy.eval()
    try:
        yield
    finally:
        if was_training:
            policy.train()


def _index(batch: Mapping[str, Tensor], window: Window) -> Tensor:
    """(B,) the frame that each window starts at; a batch that no dataset made is numbered from 0."""
    if "index" in batch:
        return batch["index"].reshape(-1).to(window.valid.device)
    return torch.arange(len(window.valid), device=window.valid.device)
