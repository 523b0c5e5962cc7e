"""Picture of draws of noise: their standard deviations over the linear ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid.jobs.spread import Spread
from sysid.plot.canvas import COLOURS, FAINT, dress, new_figure
from sysid.structure.thresholds import LIKELY

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROW, _MARGIN = 0.22, 1.3  # inches


def draws(found: Sequence[Spread], count: int, title: str = "") -> Figure:
    """A row for each quantity whose linear deviation is known: the ratio, 1 where the linear one is right.

    Parameters
    ----------
    found : sequence of Spread
        As `sysid.jobs.spreads` gives them.
    count : int
        Draws that they are of; the bars are what chance alone makes of so many, in 95 %.
    title : str

    Returns
    -------
    Figure
    """
    known = [spread for spread in found if np.isfinite(spread.ratio)]
    figure = new_figure(7.2, _MARGIN + _ROW * len(known))
    ax = figure.subplots()
    rows = np.arange(len(known))
    ratios = [spread.ratio for spread in known]
    chance = LIKELY / np.sqrt(2 * count)
    ax.axvspan(1 - chance, 1 + chance, color=FAINT, alpha=0.25, linewidth=0, label=f"chance of {count} draws, 95 %")
    ax.axvline(1.0, color=FAINT, linewidth=0.9)
    ax.plot(ratios, rows, "o", color=COLOURS[0], markersize=5)
    ax.set_yticks(rows, [spread.name for spread in known])
    ax.set_ylim(len(known) - 0.5, -0.5)
    ax.set_xlim(0.0, max(2.0, 1.1 * max(ratios, default=0.0)))
    dress(ax, title, "standard deviation of the draws / linear one [–]", "")
    figure.legend(loc="outside lower center", frameon=False, fontsize="small")
    return figure
