"""The paper's early stopping: of a training, the weights with the lowest validation loss."""

from typing import Any

from torch import Tensor

from lerobot_unimask.training import Trainer
from lerobot_unimask.validation import task_losses


def train_to_lowest(
    trainer: Trainer,
    batch: dict[str, Tensor],
    *,
    every: int,
    patience: int | None = None,
    count_start: bool = False,
) -> dict[str, Any]:
    """Train, and end with the weights that had the lowest validation loss (the paper's early stopping).

    Args:
        batch: validation windows, a LeRobot batch.
        every: updates between validations.
        patience: validations in a row, none of them the lowest so far, after which the training ends; None: it never
            does.
        count_start: the weights from before the first update count too.

    Returns:
        What a run's record says of it: `curve`, updates -> validation loss on what the policy is trained on, states
        and actions with weight 1; `loss`, the lowest of it; `updates`, where that was.
    """
    policy = trainer.policy
    weights = policy.training_masks.weights

    def validate() -> float:
        losses = task_losses(policy, batch, weights)
        return sum(weight * losses[text] for text, weight in weights.items()) / sum(weights.values())

    curve = {0: validate()} if count_start else {}
    best = {name: value.clone() for name, value in policy.state_dict().items()}
    for done, _ in enumerate(trainer, start=1):
        if done % every == 0 or done == trainer.steps:
            curve[done] = validate()
            if curve[done] == min(curve.values()):
                best = {name: value.clone() for name, value in policy.state_dict().items()}
            elif patience and min(curve.values()) not in list(curve.values())[-patience:]:
                break
    policy.load_state_dict(best)
    return {"loss": min(curve.values()), "updates": min(curve, key=curve.get), "curve": curve}
