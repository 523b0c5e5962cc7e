"""Stabilisation diagram and complex mode indicator function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.stabilisation import LEVELS, relative_frf, singular_values, stabilisation
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.plot.canvas import COLOURS, FAINT, IDENTIFIED, INK, MEASURED, dress, frequency_axis, positive
from sysid.plot.panels import broken
from sysid.results.identification import Identification
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# New poles stay in the background; what is stable in everything stands out.
_MARKS: tuple[dict[str, Any], ...] = (
    {"marker": ".", "color": "#c3cad2", "markersize": 4},
    {"marker": "x", "color": COLOURS[4], "markersize": 4, "markeredgewidth": 0.9},
    {"marker": "s", "color": COLOURS[1], "markersize": 3.2, "markerfacecolor": "none"},
    {"marker": "o", "color": COLOURS[2], "markersize": 3.8},
)


_ORDINALS = ("second", "third", "fourth", "fifth", "sixth")
_CURVES: tuple[dict[str, Any], ...] = (
    {"color": MEASURED["color"], "linewidth": 1.2, "label": "first"},
    *({"color": colour, "linewidth": 1.0, "label": name} for colour, name in zip(COLOURS, _ORDINALS, strict=False)),
)


def draw_stabilisation(ax: Axes, subject: Identification | Measurement) -> None:
    """Poles of every order over the largest singular value of the FRFs; found modes as vertical lines."""
    from matplotlib.ticker import MaxNLocator

    test, modes, label = _modes_of(subject)
    values, _, unit = _indicator(test)
    behind: Any = ax.twinx()
    behind.plot(broken(test.freq, test.gaps), broken(positive(values[0]), test.gaps), color=FAINT, linewidth=0.8)
    ax.set_zorder(behind.get_zorder() + 1)
    ax.patch.set_visible(False)
    frequency_axis(ax, test.freq)
    _mode_lines(ax, modes, label)
    words, quantity = "", "order [modes]"
    try:
        diagram = stabilisation(test)
    except InputError as error:
        words, quantity = f"No poles are shown: {error}.", ""
        _remark(ax, words)
        ax.set_yticks([])
    else:
        for level, style in enumerate(_MARKS):
            of_level = diagram.stable == level
            at = diagram.frequency[of_level], diagram.order[of_level]
            name = f"stable: {LEVELS[level]}" if level else "new pole"
            ax.plot(*at, linestyle="none", zorder=2 + 0.1 * level, label=name, **style)
        ax.set_ylim(0, 1.04 * diagram.order.max(initial=2))
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    dress(ax, "Stabilisation diagram", "frequency [Hz]", quantity)
    _log_magnitude(behind, values[0], room=bool(words))
    dress(behind, "", "", f"largest singular value{unit}", grid=False)
    for name, spine in behind.spines.items():
        spine.set_visible(name == "right")
    # What is surest is told first.
    legend_below(ax, list(reversed(ax.get_lines())), 3)


def draw_cmif(ax: Axes, subject: Identification | Measurement) -> None:
    """All singular values of the FRFs at each line; found modes as vertical lines."""
    test, modes, label = _modes_of(subject)
    values, reason, unit = _indicator(test)
    # Runs of other lengths have other lines: where they are alone, there is one singular value.
    values = values[np.median(values, axis=1) > ROUND_OFF * values.max()]
    for curve, style in zip(values, _CURVES, strict=False):
        ax.plot(broken(test.freq, test.gaps), broken(positive(curve), test.gaps), zorder=3, **style)
    frequency_axis(ax, test.freq)
    _mode_lines(ax, modes, label)
    _log_magnitude(ax, values, room=bool(reason))
    if reason:
        _remark(ax, f"Singular values of the runs' own spectra: {reason}.")
    dress(ax, "Complex mode indicator function", "frequency [Hz]", f"singular value{unit}")
    legend_below(ax, ax.get_lines(), 4)


def _modes_of(subject: Identification | Measurement) -> tuple[Measurement, Array, str]:
    """Test, the modes to compare with (Hz), and whose they are: the result's, else those that vector fitting finds."""
    if isinstance(subject, Identification):
        return subject.fitted.records, subject.structure.natural_frequencies, "identified mode"
    try:
        return subject, find_poles(subject).omega / (2 * np.pi), "vector fitting"
    except InputError:
        return subject, np.zeros(0), ""


def _indicator(test: Measurement) -> tuple[Array, str, str]:
    """Singular values of the FRFs or, with the reason, where there are none of the runs' spectra; and their unit."""
    try:
        turns = not np.all(test.translational)
        return singular_values(relative_frf(test)), "", " [–; m for rotations]" if turns else " [–]"
    except InputError as error:
        return singular_values(np.moveaxis(test.relative, 0, 1)), str(error), "\n[m/s², own scale]"


def _log_magnitude(ax: Axes, values: Array, *, room: bool) -> None:
    """Logarithmic axis over seven decades at most (what lies below is arithmetic), with room for a remark on top."""
    from matplotlib.ticker import NullLocator

    if np.any(values > 0):
        top = float(values.max())
        ax.set_yscale("log")
        ax.yaxis.set_minor_locator(NullLocator())  # most of the time goes into ticks
        ax.set_ylim(max(0.5 * float(values[values > 0].min()), 1e-7 * top), (20 if room else 2) * top)


def _remark(ax: Axes, words: str) -> None:
    import textwrap

    ax.text(
        0.02, 0.97, textwrap.fill(words, 72), transform=ax.transAxes, va="top", fontsize=8, color=INK,
        parse_math=False, zorder=5, bbox={"facecolor": "white", "edgecolor": "none"},
    )  # fmt: skip


def _mode_lines(ax: Axes, modes: Array, label: str) -> None:
    low, high = ax.get_xlim()
    in_band = modes[(modes >= low) & (modes <= high)]
    for mode, name in zip(in_band, [label, *["_"] * in_band.size], strict=False):
        ax.axvline(mode, **{**IDENTIFIED, "linewidth": 0.9, "zorder": 1.5, "label": name})


def legend_below(ax: Axes, drawn: Sequence[Any], columns: int) -> None:
    """Set the legend of what is drawn below the x axis, where it covers nothing."""
    handles = [one for one in drawn if not str(one.get_label()).startswith("_")]
    ax.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=3.6, ncols=columns,
        frameon=False, fontsize="small", columnspacing=1.4, handlelength=1.6,
    )  # fmt: skip
