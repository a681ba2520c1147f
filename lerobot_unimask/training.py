"""Training without LeRobot's command line: the same updates, in this process, for grids of many short runs.

What `lerobot-train` does with one process and no workers, in the same order of random draws, over windows read in
batches; a test holds the two to the same losses. No checkpoints, logs or evaluations: the caller does what it needs
between updates.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.policies.factory import make_policy
from lerobot.utils.random_utils import set_seed
from torch.utils.data import DataLoader

from lerobot_unimask.configuration_unimask import UniMASKConfig
from lerobot_unimask.data.episodes import open_dataset
from lerobot_unimask.modeling_unimask import UniMASKPolicy


def check_settings(names: Iterable[str]) -> None:
    """
    Raises:
        ValueError: a setting that the policy does not have.
    """
    unknown = sorted(set(names) - {field.name for field in dataclasses.fields(UniMASKConfig)})
    if unknown:
        raise ValueError(f"The policy has no setting {unknown[0]!r}; UniMASKConfig says which there are.")


class Trainer:
    """A policy, its data and its optimiser; iterating makes one update after another and yields each one's loss.

    Args:
        settings: settings of the policy, as `--policy.NAME=...`; with a checkpoint, those that replace its own.
        root: folder of the dataset.
        seed: number that the weights and the data's order follow from.
        steps: number of updates to make.
        checkpoint: folder of a policy to go on from (fine-tuning); None: a new policy.
        episodes: numbers of those to train on; None: all.

    Raises:
        FileNotFoundError: there is no dataset in `root`.
        ValueError: a setting that the policy does not have, or one out of its range.
    """

    def __init__(
        self,
        settings: dict[str, Any],
        root: Path,
        *,
        seed: int,
        steps: int,
        batch_size: int,
        checkpoint: Path | None = None,
        episodes: list[int] | None = None,
    ):
        check_settings(settings)
        if checkpoint is None:
            config = UniMASKConfig(**settings)
        else:
            config = PreTrainedConfig.from_pretrained(checkpoint)
            for name, value in settings.items():
                setattr(config, name, value)
            config.pretrained_path = checkpoint
        set_seed(seed)
        dataset = open_dataset(config, root, episodes=episodes)
        self.policy: UniMASKPolicy = make_policy(config, ds_meta=dataset.meta)
        self.settings = settings
        self.steps = steps
        self.batch_size = batch_size
        preset = config.get_optimizer_preset()
        self.grad_clip_norm = preset.grad_clip_norm
        self.optimizer = preset.build(self.policy.get_optim_params())
        self.scheduler = config.get_scheduler_preset().build(self.optimizer, steps)
        sampler = EpisodeAwareSampler(
            dataset.meta.episodes["dataset_from_index"],
            dataset.meta.episodes["dataset_to_index"],
            episode_indices_to_use=dataset.episodes,
            drop_n_last_frames=config.drop_n_last_frames,
            shuffle=True,
            seed=seed,
            absolute_to_relative_idx=dataset.absolute_to_relative_idx,
        )
        self.loader = DataLoader(dataset, batch_size=batch_size, sampler=sampler)

    def __iter__(self) -> Iterator[float]:
        done = 0
        while done < self.steps:
            for batch in self.loader:  # another order in each epoch
                yield self._update(batch)
                done += 1
                if done == self.steps:
                    return

    def record(self) -> dict[str, Any]:
        """What a run's record says of its training."""
        return {
            "steps": self.steps,
            "batch_size": self.batch_size,
            "settings": self.settings,
            "parameters": sum(parameter.numel() for parameter in self.policy.network.parameters()),
            "device": str(self.policy.device),
        }

    def _update(self, batch: dict[str, Any]) -> float:
        self.policy.train()
        with torch.autocast(self.policy.device.type, torch.bfloat16, enabled=self.policy.config.use_amp):
            loss, _ = self.policy.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.grad_clip_norm)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.scheduler.step()
        self.policy.update()
        return loss.item()
