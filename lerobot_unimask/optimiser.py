"""LeRobot's AdamW, whose step is one fused pass over memory where there is such a kernel."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.optim.optimizers import OptimizerParams


@OptimizerConfig.register_subclass("fused_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """As `adamw`, and its checkpoints are the same: what is saved does not say how a step is computed, which LeRobot
    would compare when a training is resumed on another device, or one that began with `adamw`."""

    def build(self, params: OptimizerParams) -> torch.optim.Optimizer:
        optimizer = super().build(params)
        optimizer.register_step_pre_hook(_fuse)
        optimizer.register_state_dict_post_hook(_forget)
        return optimizer


def _fuse(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        devices = {parameter.device for parameter in group["params"]}
        if not group["fused"] and {device.type for device in devices} <= {"cpu", "cuda"}:
            group["fused"] = True
            for parameter in group["params"]:  # a fused step counts on the parameter's device
                state = optimizer.state.get(parameter)
                if state:
                    state["step"] = state["step"].to(parameter.device)


def _forget(_: torch.optim.Optimizer, state_dict: dict[str, Any]) -> dict[str, Any]:
    groups = [{**group, "fused": None} for group in state_dict["param_groups"]]
    return {**state_dict, "param_groups": groups}
