"""What the rest of the package may know of an environment: a record that query, validation and cards look up."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.asking.sampling import Check, Samples
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import Mask
from lerobot_unimask.sharing.cards import Described, Provenance


@dataclass(frozen=True)
class ExactOptimum:
    """The best possible answers about an environment's data.

    Attributes:
        experts: names of those for whose data they are known.
        answer: answer to a window and mask, for an expert's data and a window's first step.
        compare: policies beside it; see `envs.doorkey.comparison`.
    """

    experts: tuple[str, ...]
    answer: Callable[..., Answer]
    compare: Callable[..., tuple[dict[str, Any], list[dict[str, Any]]]]


@dataclass(frozen=True)
class Environment(Described):
    """One environment of this package, and what a dataset's card says of it.

    Attributes:
        env_id: its gymnasium id, which the provenance of its datasets names.
        state_names: names of its states' numbers, by which a policy trained on it is recognised.
        draw_answer: picture that suits an answer or samples, or None where the general ones do. It is given the
            question's text, the answer, the recorded window if there is one, and the data's provenance.
        checks: rules that samples can be held to, by name: what makes one, from the step of the episode at which the
            windows begin.
        optimum: best possible answers, where they are known.
    """

    env_id: str
    state_names: tuple[str, ...]
    draw_answer: Callable[[str, Answer | Samples, Mask, Window | None, Provenance], Figure | None] | None = None
    checks: Mapping[str, Callable[[int], Check]] = field(default_factory=dict)
    optimum: ExactOptimum | None = None


def optimum_of(environment: Environment | None, expert: str, provenance: Provenance) -> ExactOptimum:
    """The optimum is known for some environments, and is that of the data's own expert.

    Raises:
        ValueError: it is not known, or the data are another's.
    """
    optimum = environment.optimum if environment else None
    if optimum is None or expert not in optimum.experts:
        known = optimum.experts if optimum else ()
        raise ValueError(
            f"There is no exact optimum {expert!r} for {environment.type if environment else 'this environment'}; "
            f"known are {', '.join(known) or 'none'}."
        )
    built_by = provenance.get("expert", expert)
    if built_by != expert:
        raise ValueError(f"These are data of the expert {built_by!r}: their optimum is not {expert!r}'s.")
    return optimum
