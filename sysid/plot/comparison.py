"""Pictures that compare: methods, minima of many starts, draws of noise, identifications beside a result."""

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
from sysid.jobs.minima import Minimum, Spread
from sysid.jobs.score import DECISIVE, Compared, Move, Score
from sysid.plot.canvas import positive
from sysid.structure.thresholds import LIKELY

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


_TICKS = (3.0, 10.0, 100.0, 1000.0, 1e4, 1e6)  # standard deviations; to the first the axis is linear


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


def draws(found: Sequence[Spread], count: int, title: str = "") -> Figure:
    """A row for each quantity whose linear deviation is known: the ratio, 1 where the linear one is right.

    `found` is of `count` draws, as `sysid.jobs.spreads` gives it; the bars are what chance alone makes of so many, in
    95 %.
    """
    known = [spread for spread in found if np.isfinite(spread.ratio)]
    figure = new_figure(7.2, 1.3 + 0.22 * len(known))
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


def sweep(rows: Sequence[Compared], title: str = "", *, part: bool) -> Figure:
    """A row an identification, the result's own first: residuals, and beside them the steps of its quantities.

    Of parts of the records steps are told in standard deviations; else AIC and BIC are drawn, above the least.
    """
    figure = new_figure(8.6, 1.5 + 0.28 * len(rows))
    left, right = figure.subplots(1, 2, sharey=True)
    at = np.arange(len(rows))
    left.plot(positive(np.array([row.residual for row in rows])), at, "o", color=COLOURS[0], label="fitted")
    predicted = positive(np.array([row.score.predicted for row in rows]))
    if np.any(np.isfinite(predicted)):
        left.plot(predicted, at, "D", color=COLOURS[5], fillstyle="none", label="predicted")
    left.set_xscale("log")
    lowest, highest = left.get_xlim()
    if highest < 1.5 * lowest:
        left.set_xlim(lowest / 2, 2 * highest)
    if highest < 100 * lowest:
        plain_log(left.xaxis)
    left.set_yticks(at, [row.title for row in rows])
    left.set_ylim(len(rows) - 0.5, -0.5)
    dress(left, title, "relative residual [–]", "")
    if part:
        _draw_moves(right, [row.moves for row in rows])
    else:
        _draw_criteria(right, [row.score for row in rows])
    handles = [handle for ax in (left, right) for handle in ax.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize="small")
    return figure


def _draw_moves(ax: Any, steps: Sequence[Sequence[Move]]) -> None:
    """All steps of a row, in standard deviations, or in per cent where none are known."""
    from matplotlib.ticker import NullLocator

    sizes = [abs(step.deviations) for row in steps for step in row if np.isfinite(step.deviations)]
    known = bool(sizes)
    for at, row in enumerate(steps):
        values = [step.deviations if known else 100 * step.relative for step in row]
        ax.plot(values, np.full(len(values), at), "|", color=COLOURS[0], markersize=9, label="" if at else "a quantity")
    if known:
        ax.axvspan(-LIKELY, LIKELY, color=FAINT, alpha=0.25, linewidth=0, label="noise alone, 95 %")
        ax.set_xscale("symlog", linthresh=_TICKS[0], linscale=1.0)
        ticks = [tick for tick in _TICKS if tick <= 2 * max(sizes)]
        ax.set_xticks([*(-tick for tick in reversed(ticks)), 0, *ticks])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_locator(NullLocator())
        ax.set_xlim(-1.3 * max(*sizes, _TICKS[0]), 1.3 * max(*sizes, _TICKS[0]))
    ax.axvline(0.0, color=FAINT, linewidth=0.9)
    dress(
        ax,
        "steps from the first row",
        f"standard deviations of a step, logarithmic beyond {_TICKS[0]:g}" if known else "per cent",
        "",
    )


def _draw_criteria(ax: Any, scores: Sequence[Score]) -> None:
    """AIC and BIC above the least."""
    for name, marker, colour in (("aic", "o", COLOURS[2]), ("bic", "s", COLOURS[3])):
        values = np.array([getattr(score, name) for score in scores])
        if np.any(np.isfinite(values)):
            at = np.arange(len(values))
            ax.plot(values - np.nanmin(values), at, marker, color=colour, fillstyle="none", label=name.upper())
    ax.axvspan(0, DECISIVE, color=FAINT, alpha=0.25, linewidth=0, label="no decisive difference")
    ax.set_xscale("symlog", linthresh=DECISIVE)
    dress(ax, "AIC and BIC above the least", f"difference, logarithmic beyond {DECISIVE:g} [–]", "")
