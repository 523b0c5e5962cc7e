"""Picture of many starts: the residual that each left, minimum by minimum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid.jobs.minima import Minimum
from sysid.plot.canvas import COLOURS, FAINT, dress, new_figure, plain_log
from sysid.structure.thresholds import EPSILON

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def minima(found: Sequence[Minimum], title: str = "", *, goal: float | None = None) -> Figure:
    """The residual of each start, those that ended in one minimum side by side and in one colour.

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
    drawn = 0
    for i, minimum in enumerate(found):
        left = np.maximum(sorted(result.residual for result in minimum.results), EPSILON)
        named = i < len(COLOURS)
        times = f"reached {len(left)} time{'s' if len(left) > 1 else ''}"
        label = f"{i + 1}: {minimum.residual:.4e}, {times}" if named else "others" if i == len(COLOURS) else None
        colour = COLOURS[i] if named else FAINT
        ax.plot(drawn + 1 + np.arange(len(left)), left, "o", color=colour, markersize=5, label=label)
        drawn += len(left)
    if goal is not None:
        ax.axhline(goal, color=FAINT, linewidth=0.9, linestyle="--", label=f"goal {goal:.3g}")
    ax.set_yscale("log")
    # Over round-off alone the ticks would all be one number.
    lowest, highest = ax.dataLim.intervaly
    ax.set_ylim(lowest / 2, 2 * highest)
    if highest < 25 * lowest:
        plain_log(ax.yaxis)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    dress(ax, title, "starts, by minimum", "relative residual [–]")
    ax.legend(frameon=False, fontsize="small", title="minimum and its residual", title_fontsize="small")
    return figure
