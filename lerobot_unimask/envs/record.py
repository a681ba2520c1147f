"""What the rest of the package may know of an environment: a record that query, validation and cards look up."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lerobot_unimask.asking.answers import Answer
from lerobot_unimask.asking.sampling import Check, Samples
from lerobot_unimask.data.window import Window
from lerobot_unimask.language.masks import Mask

Provenance = Mapping[str, Any]  # what a dataset's folder says of how it was built


@dataclass(frozen=True)
class Environment:
    """One environment of this package.

    Attributes:
        type: its name in `--env.type=`.
        env_id: its gymnasium id, which the provenance of its datasets names.
        state_names: names of its states' numbers, by which a policy trained on it is recognised.
        horizon: steps of an episode.
        description: sentences for a dataset's card; so are `expert` and `reward`.
        columns: meaning of each of its own columns.
        draw_episodes: picture of the first episodes' states, (N, T, D).
        draw_answer: picture that suits an answer or samples, or None where the general ones do. It is given the
            question's text, the answer, the recorded window if there is one, and the data's provenance.
        checks: names of the rules that samples can be held to.
        make_check: check by name, for windows that begin at a step of the episode.
        experts: names of the experts whose exact optimum is known.
        exact_answer: the optimum's answer to a window and mask, for an expert's data and a window's first step.
        beside_optimum: comparison of policies with the optimum; see `envs.doorkey.comparison`.
    """

    type: str
    env_id: str
    state_names: tuple[str, ...]
    horizon: int
    description: str
    expert: str
    reward: str
    columns: Mapping[str, str]
    draw_episodes: Callable[[np.ndarray, Provenance], Figure]
    draw_answer: Callable[[str, Answer | Samples, Mask, Window | None, Provenance], Figure | None] | None = None
    checks: tuple[str, ...] = ()
    make_check: Callable[[str, int], Check] | None = None
    experts: tuple[str, ...] = ()
    exact_answer: Callable[..., Answer] | None = None
    beside_optimum: Callable[..., tuple[dict[str, Any], list[dict[str, Any]]]] | None = None


def check_expert(environment: Environment | None, expert: str, provenance: Provenance) -> None:
    """The optimum is known for some environments, and is that of the data's own expert.

    Raises:
        ValueError: it is not known, or the data are another's.
    """
    if environment is None or expert not in environment.experts:
        known: Sequence[str] = environment.experts if environment else ()
        raise ValueError(
            f"There is no exact optimum {expert!r} for {environment.type if environment else 'this environment'}; "
            f"known are {', '.join(known) or 'none'}."
        )
    built_by = provenance.get("expert", expert)
    if built_by != expert:
        raise ValueError(f"These are data of the expert {built_by!r}: their optimum is not {expert!r}'s.")
