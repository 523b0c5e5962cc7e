"""Picture of many starts: the residual that each left, in order, and which ended in one minimum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid.jobs.minima import Minimum
from sysid.plot.canvas import COLOURS, FAINT, dress, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST = 1e-16  # what is below is drawn there


def minima(found: Sequence[Minimum], title: str = "", *, goal: float | None = None) -> Figure:
    """The residual of each start, the best first; starts that ended in one minimum have one colour.

    Parameters
    ----------
    found : sequence of Minimum
        As `sysid.jobs.minima.distinct` gives them.
    title : str
    goal : float, optional
        Drawn as a line.

    Returns
    -------
    Figure
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(7.2, 4.2)
    ax = figure.subplots()
    begun = 0
    for i, minimum in enumerate(found):
        left = np.maximum(sorted(result.residual for result in minimum.results), _LEAST)
        named = i < len(COLOURS)
        times = f"reached {len(left)} time{'s' if len(left) > 1 else ''}"
        label = f"{minimum.residual:.3g}, {times}" if named else "others" if i == len(COLOURS) else None
        colour = COLOURS[i] if named else FAINT
        ax.plot(begun + 1 + np.arange(len(left)), left, "o", color=colour, markersize=5, label=label)
        begun += len(left)
    if goal is not None:
        ax.axhline(goal, color=FAINT, linewidth=0.9, linestyle="--", label=f"goal {goal:.3g}")
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    dress(ax, title, "starts, the best first", "relative residual [–]")
    ax.legend(frameon=False, fontsize="small", title="residual of the minimum", title_fontsize="small")
    return figure
