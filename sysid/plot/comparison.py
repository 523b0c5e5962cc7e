"""Picture of a comparison: objective, and errors of M, K and C at the end, against time, method by method."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sysid.compare.comparison import Comparison
from sysid.compare.peers import MethodResult
from sysid.plot.canvas import COLOURS, FAINT, INK, dress, new_figure, plain_log
from sysid.structure.structure import Array
from sysid.structure.thresholds import EPSILON

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHAPES = {"M": ("o", "full", 7), "K": ("s", "none", 9), "C": ("^", "full", 5)}  # marker, filling, size
_TINTS = (*COLOURS[:4], INK, *COLOURS[4:], FAINT)  # a colour a method
_HOLLOW: dict[str, Any] = {"marker": "o", "markerfacecolor": "white", "markersize": 5.5, "linestyle": "none"}


def comparison(compared: Comparison, title: str = "") -> Figure:
    """Draw what each method had reached at which time: a line a method, the search thick and the local phase thin.

    A hollow marker is where the local phase begins, a filled one the end. Where peaks are widened on the way, the
    search is dotted, as its objective is of other records, and a straight line leads to the end. Below, where the truth
    is known, the errors of M, K and C at the end.

    Parameters
    ----------
    compared : Comparison
    title : str

    Returns
    -------
    Figure
    """
    compared_results = [result for result in compared.results if result.ran]
    known = bool(np.any(np.isfinite([result.errors for result in compared_results])))
    figure = new_figure(8.2, 7.4 if known else 4.6)
    axes = np.atleast_1d(figure.subplots(1 + known, sharex=True, height_ratios=[1.7, 1][: 1 + known]))
    for result, colour in zip(compared_results, cycle(_TINTS)):
        _draw(axes[0], result, colour)
    axes[0].plot([], [], color=FAINT, label="before the local phase", **_HOLLOW)
    for _ in range(any(result.widened for result in compared_results)):
        axes[0].plot([], [], ":", color=FAINT, label="with widened peaks")
    axes[0].set_xscale("log")
    axes[0].set_yscale("log")
    what = {"residual": "relative residual [–]", "objective": "objective [–]"}[compared.quantity]
    dress(axes[0], title, "" if known else "time [s]", what)
    if known:
        _draw_errors(axes[1], compared_results)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize="small")
    return figure


def _draw(ax: Any, result: MethodResult, colour: str) -> None:
    """The phases of one method, one after the other, and its markers."""
    start = result.phases[0][1][0, 0] if result.phases else result.seconds
    last = [start, result.before]
    for name, curve in result.phases:
        local = name == "local phase"
        if local and np.isfinite(last[1]):
            ax.plot(*_clipped(last), color=colour, zorder=4, **_HOLLOW)
        if result.widened and name in ("local phase", "continuation"):
            continue
        line = np.vstack([last, curve]) if local else curve
        ax.plot(*_clipped(line), ":" if result.widened else "-", color=colour, linewidth=0.9 if local else 1.8)
        last = [curve[-1, 0], result.before if result.widened else curve[-1, 1]]
    end = [result.seconds, result.after]
    ax.plot(*_clipped([last, end]), color=colour, linewidth=0.9)
    ax.plot(*_clipped(end), "o", color=colour, markeredgecolor="white", markersize=8, zorder=5, label=result.name)


def _clipped(points: ArrayLike) -> Array:
    """Times and values (2, k) of points (k, 2), none below what a logarithmic axis shows: 10 ms, and round-off."""
    return np.maximum(np.reshape(points, (-1, 2)), [1e-2, EPSILON]).T


def _draw_errors(ax: Any, results: Sequence[MethodResult]) -> None:
    """A marker a matrix, at the time at which a method ended."""
    drawn = []
    for result, colour in zip(results, cycle(_TINTS)):
        for error, (marker, filling, size) in zip(result.errors, _SHAPES.values(), strict=True):
            at = _clipped([result.seconds, error])
            ax.plot(*at, marker, fillstyle=filling, color=colour, markersize=size)
            drawn.append(at[1, 0])
    for name, (marker, filling, size) in _SHAPES.items():
        ax.plot([], [], marker, fillstyle=filling, markersize=size, color=FAINT, label=name)
    ax.set_yscale("log")
    if np.nanmax(drawn) < 100 * np.nanmin(drawn):
        plain_log(ax.yaxis)
    ax.legend(frameon=False, fontsize="small", loc="upper left", ncols=3)
    dress(ax, "", "time [s]", "error at the end [%]")
