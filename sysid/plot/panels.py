"""Panels: measured and identified spectra, stabilisation diagram, complex mode indicator function, laws."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, refuse
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.stabilisation import LEVELS, relative_frf, singular_values, stabilisation
from sysid.modal_analysis.stretches import Stretch
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.plot.canvas import (
    COLOURS,
    FAINT,
    GRID,
    IDENTIFIED,
    INK,
    MEASURED,
    RESIDUAL,
    dress,
    frequency_axis,
    new_figure,
    plain_log,
    positive,
)  # fmt: skip
from sysid.results.identification import Identification
from sysid.structure.amplitude import FittedLaw
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import LIKELY, ROUND_OFF

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAND: dict[str, Any] = {
    "color": IDENTIFIED["color"], "alpha": 0.25, "linewidth": 0, "label": "95 % band", "zorder": 1.5,
}  # fmt: skip
_OUTLIER: dict[str, Any] = {
    "color": INK, "linestyle": "none", "marker": "x", "markersize": 4, "markeredgewidth": 0.9, "label": "outlier",
    "zorder": 4,
}  # fmt: skip
_WIDTHS = {2: 11.2, 3: 12.0}  # of a figure, in, by the number of columns


class PlottedChannel(NamedTuple):
    """One record of a test and what the model answers: spectra (n_freq,), and the words for a picture."""

    freq: Array
    measured: ComplexArray
    identified: ComplexArray
    against: ComplexArray  # what the phase is told against
    title: str
    quantity: str
    phase: str
    negligible: bool
    std: Array  # of the identified spectrum
    outliers: Array  # Hz
    gaps: NDArray[np.intp]  # lines before which others are left out


def run_names(test: Measurement) -> tuple[str, ...]:
    """Names of the runs in a title: "base x" for unit runs, else "run 1"."""
    if test.has_unit_runs:
        return tuple(f"base {name}" for name in test.base_axes or ())
    return tuple(f"run {r + 1}" for r in range(test.n_runs))


def response_channel(
    identification: Identification, test: Measurement, sensor: int, run: int, *, band: ArrayLike | None = None
) -> PlottedChannel:
    """Response of one sensor in one run; `band`: std of the complex transmissibility, (n_sensors, d, n_freq)."""
    predicted = test.predict(identification.structure)[run, sensor] + test.rigid_body[sensor] @ test.base[run]
    unit = "–" if test.translational[run % test.n_base] else "m"
    words = test.sensor_names[sensor], f"transmissibility [{unit}]", "acceleration spectrum\n[m/s², own scale]"
    std = _std(test, run, band, test.n_sensors, sensor)
    drawn = _channel(test, test.response[run, sensor], predicted, run, words, np.abs(test.response).max(), std)
    return drawn._replace(outliers=_outliers(identification, test, test.sensor_names[sensor], run))


def force_channel(
    identification: Identification, test: Measurement, direction: int, run: int, *, band: ArrayLike | None = None
) -> PlottedChannel:
    """Base force in one direction in one run; `band`: std of the complex apparent mass, (d, d, n_freq)."""
    assert test.force is not None and test.base_axes is not None
    predicted = test.predict_force(identification.structure)[run, direction]
    turns = ~test.translational[[direction, run % test.n_base]]
    kind, unit = ("moment about", "N m") if turns[0] else ("force", "N")
    per_base = ("kg", "kg m", "kg m²")[np.count_nonzero(turns)]
    words = (
        f"{kind} {test.base_axes[direction].removeprefix('r')}",
        f"apparent mass [{per_base}]",
        f"force spectrum\n[{unit}, own scale]",
    )
    std = _std(test, run, band, test.n_base, direction)
    largest = np.abs(test.force[:, direction]).max()
    drawn = _channel(test, test.force[run, direction], predicted, run, words, largest, std)
    return drawn._replace(outliers=_outliers(identification, test, f"force {test.base_axes[direction]}", run))


def _outliers(identification: Identification, test: Measurement, channel: str, run: int) -> Array:
    """Lines of a record that are outliers, Hz; none of a test that was not fitted."""
    found = identification.outliers if test is identification.measurement else ()
    return np.array([one.freq for one in found if one[:3] == (1, run + 1, channel)])


def _std(test: Measurement, run: int, given: ArrayLike | None, rows: int, row: int) -> Array:
    """Of a spectrum in one run, those of the answers to each direction alone `given`, (rows, d, n_freq), or zeros."""
    shape = (rows, test.n_base, test.freq.size)
    std = np.zeros(shape) if given is None else np.asarray(given, float)
    refuse((std.shape != shape, f"band has shape {std.shape}; standard deviations at the test's lines are {shape}"))
    band = std[row]
    # Errors of different directions may add up whatever their phases: the sum is never too small.
    return np.sum(band * np.abs(test.base[run]), axis=0)


def _channel(
    test: Measurement, measured: ComplexArray, predicted: ComplexArray, run: int, words: tuple[str, str, str],
    largest: float, std: Array,
) -> PlottedChannel:  # fmt: skip
    """A channel of which `words` name the record, what it is for unit runs, and what it is for others."""
    name, per_base, spectrum = words
    title, at, gaps = f"{name}, {run_names(test)[run]}", np.ones(test.freq.size, bool), test.gaps
    negligible = bool(np.abs(measured).max() <= ROUND_OFF * largest)
    against, quantity, phase = np.ones_like(measured), per_base, "phase [°]"
    if not test.has_unit_runs:
        moved = int(np.argmax(np.linalg.norm(test.base[run], axis=-1)))
        assert test.base_axes is not None
        # The scale of a spectrum (a line, per Hz, one-sided) is the record's own affair.
        against, quantity, phase = test.base[run, moved], spectrum, f"phase to\nbase {test.base_axes[moved]} [°]"
        at, gaps = lines_of(test, run)
    return PlottedChannel(
        test.freq[at], measured[at], predicted[at], against[at], title, quantity, phase, negligible, std[at],
        np.zeros(0), gaps,
    )  # fmt: skip


def lines_of(test: Measurement, run: int) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Which lines are a run's own, (n_freq,), and those of them before which others were left out.

    Whole records of other lengths have zeros at the others.
    """
    lines = test.own_lines[run]
    return lines, np.concatenate([[0], np.cumsum(lines)])[test.gaps]


def place(ax: Axes | Sequence[Axes] | None, channel: PlottedChannel) -> Any:
    """Draw a channel into axes for magnitude and phase, which are given back; without them into a new figure."""
    if ax is None:
        return panels([channel])
    draw(np.ravel(np.asarray(ax, dtype=object)), channel)
    return ax


def panels(channels: Sequence[PlottedChannel], *, alone: float = 6.4) -> Figure:
    """Magnitude above phase, a column a channel, at most three columns; `alone` is the width of one, in."""
    from matplotlib.ticker import NullLocator

    columns = min(len(channels), 3)
    blocks = -(-len(channels) // columns)
    width, height = _WIDTHS.get(columns, alone), 3.5 * blocks + 0.25
    figure = new_figure(width, height, layout=None)  # as regular as these panels are, and three times as fast
    left = 0.92 if "\n" in channels[0].quantity else 0.72
    grid = figure.add_gridspec(
        blocks, columns, left=left / width, right=1 - 0.12 / width, bottom=0.75 / height, top=1 - 0.3 / height,
        wspace=0.24 if len({(one.quantity, one.phase) for one in channels}) == 1 else 0.36, hspace=0.3,
    )  # fmt: skip
    for at, channel in enumerate(channels):
        axes: Any = grid[divmod(at, columns)].subgridspec(2, 1, height_ratios=[2.2, 1], hspace=0.12).subplots()
        draw(axes, channel)
        axes[0].yaxis.set_minor_locator(NullLocator())  # most of the time goes into ticks
    for first in range(0, len(figure.axes), 2 * columns):
        row = figure.axes[first : first + 2 * columns]
        label_once(row[::2])
        label_once(row[1::2])
    figure.legend(handles=key(figure.axes), loc="lower center", ncols=5, frameon=False, fontsize="small")
    return figure


def label_once(row: Sequence[Axes]) -> None:
    """Keep of axes beside each other the labels upwards that differ from the one before."""
    labels = [ax.get_ylabel() for ax in row]
    for ax, before, label in zip(row[1:], labels, labels[1:], strict=False):
        ax.set_ylabel(label * (label != before))


def key(axes: Iterable[Axes]) -> list[Any]:
    """The entries of a legend of all these axes, in their order."""
    entries: dict[str, Any] = {}
    for ax in axes:
        handles, labels = ax.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    order = (style["label"] for style in (MEASURED, IDENTIFIED, _BAND, RESIDUAL, _OUTLIER))
    return [entries[label] for label in order if label in entries]


def draw(axes: Any, channel: PlottedChannel) -> None:
    """Draw magnitude into the first of `axes` and phase into the second, where there is one."""
    freq, measured, identified = channel.freq, channel.measured, channel.identified
    magnitude = axes[0]
    # Whole-record spectra have thousands of lines, which at full width would hide each other.
    thin = {"linewidth": 0.7} if freq.size > 800 else {}
    measured_style, answered = MEASURED | thin, IDENTIFIED | thin
    size, modelled, error = np.abs(measured), np.abs(identified), np.abs(identified - measured)
    lines = broken(freq, channel.gaps)
    for curve, style in ((error, RESIDUAL), (size, measured_style), (modelled, answered)):
        magnitude.plot(lines, broken(positive(curve), channel.gaps), **style)
    off = np.isin(freq, channel.outliers)
    if np.any(off):
        magnitude.plot(freq[off], positive(size[off]), **_OUTLIER)
    reach = LIKELY * channel.std
    if np.any(reach > 2e-3 * modelled):  # a narrower band hides behind the curve
        # The magnitude strays no further than the complex value; to zero, a logarithmic axis cannot follow.
        ends = np.maximum(modelled - reach, 1e-3 * modelled), modelled + reach
        magnitude.fill_between(lines, *(broken(end, channel.gaps) for end in ends), **_BAND)
    lowest, highest = _span(np.append(size, modelled), error)
    if highest > 0:
        magnitude.set_yscale("log")
        magnitude.set_ylim(lowest, highest)
        if highest < 30 * lowest:
            plain_log(magnitude.yaxis)
    dress(magnitude, channel.title, "frequency [Hz]", channel.quantity)
    if channel.negligible:
        magnitude.text(0.5, 0.06, "round-off: no response", transform=magnitude.transAxes, ha="center", color=FAINT)
    for ax in axes[:2]:
        frequency_axis(ax, freq)
    if len(axes) > 1:
        phase = axes[1]
        magnitude.set_xlabel("")
        magnitude.tick_params(which="both", labelbottom=False)
        for record, style in ((measured, measured_style), (identified, answered)):
            angle = np.angle(record * np.conj(channel.against), deg=True)
            phase.plot(*_wrapped(freq, angle, channel.gaps), **style)
        phase.set_ylim(-190, 190)
        phase.set_yticks([-180, -90, 0, 90, 180], ["−180", "", "0", "", "180"])
        dress(phase, "", "frequency [Hz]", channel.phase)


def _span(sizes: Array, error: Array) -> tuple[float, float]:
    """Limits of a magnitude axis: all of `sizes`, and the difference where it is not far below; zeros for nothing."""
    top = float(sizes.max())
    lowest = sizes.min(where=sizes > 0, initial=top)
    if np.any(error > 0):
        lowest = min(lowest, float(np.median(error[error > 0])))
    return max(0.5 * lowest, 1e-5 * top), 1.8 * top


def broken(values: Array, gaps: NDArray[np.intp]) -> Array:
    """Values along lines, with NaN, where no curve is joined, before those that come after a gap."""
    return np.insert(values, gaps, np.nan, axis=-1)


def _wrapped(freq: Array, degrees: Array, gaps: NDArray[np.intp]) -> tuple[Array, Array]:
    """Break a phase curve at gaps, and where it wraps, rather than draw a line across the picture."""
    jumps = np.union1d(np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1, gaps)
    return broken(freq, jumps), broken(degrees, jumps)


def named_index(what: str, value: int | str, names: Sequence[str]) -> int:
    """Index of a name or of a number, which may count from the end; `what` it is, for the message of an InputError."""
    if isinstance(value, str):
        refuse((value not in names, f"{what} {value!r} is unknown; there are {', '.join(names)}"))
        return list(names).index(value)
    outside = not -len(names) <= value < len(names)
    refuse((outside, f"{what} {value} is out of range: there are {len(names)}, counted from 0"))
    return int(value) % len(names)


def run_index(test: Measurement, run: int | str) -> int:
    """Index of a run by name or number; runs of unit base motion are called as the base axes."""
    names = (test.base_axes or ()) if test.has_unit_runs else run_names(test)
    return named_index("run", run, names)


def strongest(
    test: Measurement, count: int, *, sensor: int | str | None = None, run: int | str | None = None
) -> list[tuple[int, int]]:
    """Pairs (sensor, run) with the largest relative accelerations, of different sensors, the runs in turn."""
    energy = np.linalg.norm(test.relative, axis=-1)
    free = list(range(test.n_sensors)) if sensor is None else [named_index("sensor", sensor, test.sensor_names)]
    runs = range(test.n_runs) if run is None else [run_index(test, run)]
    chosen: list[tuple[int, int]] = []
    first = runs.index(max(runs, key=lambda r: energy[r, free].max()))
    for k in range(first, first + min(count, len(free))):
        r = runs[k % len(runs)]
        s = max(free, key=lambda s: energy[r, s])
        free.remove(s)
        chosen.append((s, r))
    return chosen


def with_force(test: Measurement) -> Measurement:
    """The measurement itself; an InputError where it has no base force."""
    refuse((test.force is None, "base_force: this measurement has no base force"))
    return test


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


def draw_law(row: Sequence[Axes], law: FittedLaw, stretches: Sequence[Stretch]) -> None:
    """Frequency and damping of a law into two axes, beside those of stretches, of all modes of its structure."""
    (low, high), k = law.levels, law.mode
    seen = [one for one in stretches if one.std[k] < one.ratio[k] * one.frequency[k]]  # others tell nothing
    at = np.array([np.sqrt(2) * one.level[law.level_of] for one in seen])
    of_stretches = np.array([
        ((one.frequency[k], one.std[k]), (100 * one.ratio[k], 100 * one.ratio_std[k])) for one in seen
    ]).reshape(-1, 2, 2)  # fmt: skip
    levels = np.geomspace(low / 1.5, 1.2 * high, 120)
    values = np.array([law.at(level) for level in levels]).T * [[1], [100]]
    reach = LIKELY * np.array([law.deviations_at(level) for level in levels]).T * [[1], [100]]
    for ax, value, width, points, what in zip(
        row, values, reach, of_stretches.transpose(1, 2, 0), ("frequency [Hz]", "damping ratio [%]"), strict=True
    ):
        ax.axvspan(low, high, color=GRID, alpha=0.6, zorder=0, label="levels tested")
        ax.plot(levels, value, color=IDENTIFIED["color"], linewidth=1.6, label="law")
        ax.fill_between(levels, value - width, value + width, **{**_BAND, "label": "its 95 % interval"})
        style: Any = {"color": INK, "markersize": 4, "linewidth": 0.9, "label": "stretches of the records, 95 %"}
        ax.errorbar(at, points[0], LIKELY * points[1], fmt="o", **style)
        ax.set_xscale("log")
        ax.set_xlim(levels[0], levels[-1])
        plain_log(ax.xaxis)
        dress(ax, f"Mode {k + 1}{f', by the level of mode {law.level_of + 1}' if law.followed else ''}", "", what)


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
