"""Whether what is said to be likely comes as often."""

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from lerobot_unimask.plots.style import COLOURS, FAINT, SMALL, WIDTH

FEW = 20  # what a bin must hold to be drawn


def reliability(record: Mapping[str, Any]) -> Figure:
    """How often came what was said to be so likely, a panel for each property: the first run's, and the optimum's;
    bins of few are left out.

    Args:
        record: As `validation.validate` makes it.

    Raises:
        ValueError: It foretells nothing.
    """
    run = record["runs"][0]["foretold"]
    panels = {name: asked for name, asked in run.items() if all("calibration" in said for said in asked)}
    if not panels:
        raise ValueError("This policy foretells neither a return nor a property: there is no calibration to draw.")
    exact = record.get("optimum", {}).get("foretold", {})
    figure = Figure(figsize=(WIDTH, 0.5 * WIDTH), layout="constrained")
    for axes, (name, asked) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        axes.plot([0, 1], [0, 1], color=FAINT, linewidth=4)
        for source, points, line, marker in (("", asked, "-", "o"), ("optimum, ", exact.get(name, []), ":", "x")):
            for said, colour in zip(points, COLOURS, strict=False):
                bins = said["calibration"]
                filled = [i for i, count in enumerate(bins["count"]) if count >= FEW]
                predicted, happened = ([bins[part][i] for i in filled] for part in ("predicted", "happened"))
                style: dict[str, Any] = {"color": colour, "linestyle": line, "marker": marker, "markersize": 4}
                axes.plot(predicted, happened, **style, label=f"{source}t = {said['t']}")
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=name, xlabel="said to be so likely")
        axes.legend(fontsize=SMALL)
    figure.axes[0].set_ylabel("came so often")
    return figure
