"""Measured against identified spectra: magnitude above phase, a panel a channel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement, unit_runs
from sysid.plot.canvas import FAINT, IDENTIFIED, MEASURED, RESIDUAL, dress, new_figure, plain_log
from sysid.results.identification import Identification
from sysid.results.summary import DEVIATES
from sysid.structure.structure import Array, ComplexArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAND: dict[str, Any] = {
    "color": IDENTIFIED["color"],
    "alpha": 0.25,
    "linewidth": 0,
    "label": "95 % band",
    "zorder": 1.5,
}
_VISIBLE = 2e-3  # of the magnitude: a narrower band hides behind the curve
_ROUND_OFF = 1e-10  # of the largest channel: below it a response is arithmetic, not motion
_COLUMNS = 3
_PANEL_WIDTHS = {2: 5.6, 3: 4.0}  # in, by the number of columns
_DENSE = 800  # lines beyond which curves are drawn thinner


class Channel(NamedTuple):
    """One record of a test and what the model answers: spectra (n_freq,), and the words for a picture."""

    freq: Array
    measured: ComplexArray
    identified: ComplexArray
    against: ComplexArray  # what the phase is told against
    title: str
    quantity: str
    phase: str
    negligible: bool
    std: Array | None = None  # of the identified spectrum


def is_unit(test: Measurement) -> bool:
    """Whether run i is unit motion in base direction i alone, so that responses are transmissibilities."""
    return test.n_runs == test.n_base and np.array_equal(test.base, unit_runs(test.n_base, test.freq.size))


def run_names(test: Measurement) -> tuple[str, ...]:
    """What each run is called in a title: "base x" for unit runs, else "run 1"."""
    if is_unit(test):
        return tuple(f"base {name}" for name in test.base_axes or ())
    return tuple(f"run {r + 1}" for r in range(test.n_runs))


def response_channel(
    identification: Identification, test: Measurement, sensor: int, run: int, *, band: Array | None = None
) -> Channel:
    """Response of one sensor in one run; `band`: std of the complex transmissibility, (n_sensors, d, n_freq)."""
    predicted = test.predict(identification.structure)[run, sensor] + test.rigid_body[sensor] @ test.base[run]
    title = f"{test.sensor_names[sensor]}, {run_names(test)[run]}"
    largest = np.abs(test.response).max()
    lever = "" if test.translational[run % test.n_base] else "m"
    words = ("transmissibility", lever) if is_unit(test) else ("acceleration", "m/s²")
    channel = _channel(test, test.response[run, sensor], predicted, run, title, *words, largest)
    return channel._replace(std=_std(test, run, None if band is None else band[sensor]))


def force_channel(
    identification: Identification, test: Measurement, direction: int, run: int, *, band: Array | None = None
) -> Channel:
    """Base force in one direction in one run; `band`: std of the complex apparent mass, (d, d, n_freq)."""
    assert test.force is not None and test.base_axes is not None
    predicted = test.predict_force(identification.structure)[run, direction]
    turns = not test.translational[direction]
    name = f"{'moment about' if turns else 'force'} {test.base_axes[direction].removeprefix('r' if turns else '')}"
    title = f"{name}, {run_names(test)[run]}"
    words = ("force", "N m" if turns else "N")
    if is_unit(test):
        words = ("apparent mass", ("kg", "kg m", "kg m²")[int(turns) + int(not test.translational[run])])
    largest = np.abs(test.force[:, direction]).max()
    channel = _channel(test, test.force[run, direction], predicted, run, title, *words, largest)
    return channel._replace(std=_std(test, run, None if band is None else band[direction]))


def band_of(test: Measurement, band: ArrayLike | None, rows: int) -> Array | None:
    """Check standard deviations of a test's spectra, (rows, d, n_freq)."""
    if band is None:
        return None
    std, shape = np.asarray(band, float), (rows, test.n_base, test.freq.size)
    if std.shape != shape:
        raise InputError(f"band has shape {std.shape}; standard deviations at the test's lines are {shape}")
    return std


def _std(test: Measurement, run: int, band: Array | None) -> Array | None:
    """Of a spectrum in one run, `band` (d, n_freq) being that of the answer to each direction alone."""
    # Errors of different directions may add up whatever their phases: the sum is never too small.
    return None if band is None else np.sum(band * np.abs(test.base[run]), axis=0)


def _channel(
    test: Measurement, measured: ComplexArray, predicted: ComplexArray, run: int, title: str, what: str, unit: str,
    largest: float,
) -> Channel:  # fmt: skip
    negligible = bool(np.abs(measured).max() <= _ROUND_OFF * largest)
    if is_unit(test):
        ones = np.ones_like(measured)
        return Channel(test.freq, measured, predicted, ones, title, f"{what} [{unit or '–'}]", "phase [°]", negligible)
    moved = int(np.argmax(np.linalg.norm(test.base[run], axis=-1)))
    assert test.base_axes is not None
    # The scale of a spectrum (a line, per Hz, one-sided) is the record's own affair.
    return Channel(
        test.freq, measured, predicted, test.base[run, moved], title, f"{what} spectrum\n[{unit}, own scale]",
        f"phase to\nbase {test.base_axes[moved]} [°]", negligible,
    )  # fmt: skip


def place(ax: Axes | Sequence[Axes] | None, channel: Channel) -> Any:
    """Draw a channel into axes for magnitude and phase, which are given back; without them into a new figure."""
    if ax is None:
        return panels([channel])
    draw(np.ravel(np.asarray(ax, dtype=object)), channel)
    return ax


def panels(channels: Sequence[Channel], *, alone: float = 6.4) -> Figure:
    """Magnitude above phase, a column a channel, at most three columns; `alone` is the width of one, in."""
    from matplotlib.ticker import NullLocator

    columns = min(len(channels), _COLUMNS)
    blocks = -(-len(channels) // columns)
    width, height = alone if columns == 1 else _PANEL_WIDTHS[columns] * columns, 3.5 * blocks + 0.25
    figure = new_figure(width, height, layout=None)  # as regular as these panels are, and three times as fast
    left = 0.92 if "\n" in channels[0].quantity else 0.72
    grid = figure.add_gridspec(
        blocks, columns, left=left / width, right=1 - 0.12 / width, bottom=0.75 / height, top=1 - 0.3 / height,
        wspace=0.24, hspace=0.3,
    )  # fmt: skip
    for at, channel in enumerate(channels):
        axes: Any = grid[divmod(at, columns)].subgridspec(2, 1, height_ratios=[2.2, 1], hspace=0.12).subplots()
        draw(axes, channel)
        axes[0].yaxis.set_minor_locator(NullLocator())  # most of the time goes into ticks
        # What is shared along a row is said once.
        if at % columns and channel.quantity == channels[at - 1].quantity:
            axes[0].set_ylabel("")
        if at % columns and channel.phase == channels[at - 1].phase:
            axes[1].set_ylabel("")
    figure.legend(handles=key(axes[0]), loc="lower center", ncols=4, frameon=False, fontsize="small")
    return figure


def key(magnitude: Axes) -> list[Any]:
    """The entries of a legend, in their order."""
    handles, labels = magnitude.get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    told = (style["label"] for style in (MEASURED, IDENTIFIED, _BAND, RESIDUAL))
    return [entries[label] for label in told if label in entries]


def draw(axes: Any, channel: Channel) -> None:
    """Draw magnitude into the first of `axes` and phase into the second, where there is one."""
    freq, measured, identified = channel.freq, channel.measured, channel.identified
    magnitude = axes[0]
    # Whole-record spectra have thousands of lines, which at full width would hide each other.
    thin = {"linewidth": 0.7} if freq.size > _DENSE else {}
    shown, answered = MEASURED | thin, IDENTIFIED | thin
    size, error = positive(np.abs(measured)), positive(np.abs(identified - measured))
    magnitude.plot(freq, error, **RESIDUAL)
    magnitude.plot(freq, size, **shown)
    magnitude.plot(freq, positive(np.abs(identified)), **answered)
    reach = np.zeros(freq.size) if channel.std is None else DEVIATES * channel.std
    if np.any(reach > _VISIBLE * np.abs(identified)):
        # The magnitude strays no further than the complex value; to zero, a logarithmic axis cannot follow.
        lower = np.maximum(np.abs(identified) - reach, 1e-3 * np.abs(identified))
        magnitude.fill_between(freq, lower, np.abs(identified) + reach, **_BAND)
    lowest, highest = _span(size, positive(np.abs(identified)), error)
    if highest > 0:
        magnitude.set_yscale("log")
        magnitude.set_ylim(lowest, highest)
        if highest < 30 * lowest:
            plain_log(magnitude.yaxis)
    dress(magnitude, channel.title, "frequency [Hz]" if len(axes) == 1 else "", channel.quantity)
    if channel.negligible:
        magnitude.text(0.5, 0.06, "round-off: no response", transform=magnitude.transAxes, ha="center", color=FAINT)
    for ax in axes[:2]:
        if freq[0] > 0 and freq[-1] > 10 * freq[0]:
            ax.set_xscale("log")
            plain_log(ax.xaxis)
        ax.set_xlim(freq[0], freq[-1] if freq.size > 1 else freq[0] + 1)
    if len(axes) > 1:
        magnitude.tick_params(which="both", labelbottom=False)
        phase = axes[1]
        for record, style in ((measured, shown), (identified, answered)):
            phase.plot(*_wrapped(freq, np.angle(record * np.conj(channel.against), deg=True)), **style)
        phase.set_ylim(-190, 190)
        phase.set_yticks([-180, -90, 0, 90, 180], ["−180", "", "0", "", "180"])
        dress(phase, "", "frequency [Hz]", channel.phase)


def _span(measured: Array, identified: Array, error: Array) -> tuple[float, float]:
    """Limits of a magnitude axis: all of the measured one, and the difference where it is not far below."""
    if not np.any(measured > 0) and not np.any(identified > 0):
        return 0.0, 0.0
    both = np.concatenate([measured, identified])
    top = float(np.nanmax(both))
    shown = [0.5 * float(np.nanmin(both))]
    if np.any(error > 0):
        shown.append(0.5 * float(np.nanmedian(error)))
    return max(min(shown), 1e-5 * top), 1.8 * top


def _wrapped(freq: Array, degrees: Array) -> tuple[Array, Array]:
    """Break a phase curve where it wraps, rather than draw a line across the picture."""
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(freq, jumps, np.nan), np.insert(degrees, jumps, np.nan)


def positive(values: Array) -> Array:
    """NaN, which is not drawn, in place of what a logarithmic axis cannot show."""
    return np.where(values > 0, values, np.nan)


def index_of(what: str, value: int | str, names: Sequence[str]) -> int:
    """Index of a name or of a number, which may count from the end; `what` it is, for the message of an InputError."""
    if isinstance(value, str):
        if value not in names:
            raise InputError(f"{what} {value!r} is unknown; there are {', '.join(names)}")
        return list(names).index(value)
    if not -len(names) <= value < len(names):
        raise InputError(f"{what} {value} is out of range; there are {len(names)}")
    return int(value) % len(names)


def sensor_index(test: Measurement, sensor: int | str) -> int:
    """Index of a sensor by name or number."""
    return index_of("sensor", sensor, test.sensor_names)


def run_index(test: Measurement, run: int | str) -> int:
    """Index of a run by name or number; runs of unit base motion are called as the base axes."""
    names = (test.base_axes or ()) if is_unit(test) else run_names(test)
    return index_of("run", run, names)


def strongest(
    test: Measurement, count: int, *, sensor: int | str | None = None, run: int | str | None = None
) -> list[tuple[int, int]]:
    """Pairs (sensor, run) with the largest relative accelerations, of different sensors, the runs in turn."""
    energy = np.linalg.norm(test.relative, axis=-1)
    sensors = range(test.n_sensors) if sensor is None else [sensor_index(test, sensor)]
    runs = range(test.n_runs) if run is None else [run_index(test, run)]
    free = list(sensors)
    chosen: list[tuple[int, int]] = []
    first = max(runs, key=lambda r: energy[r, free].max())
    while free and len(chosen) < count:
        r = runs[(runs.index(first) + len(chosen)) % len(runs)]
        s = max(free, key=lambda s: energy[r, s])
        free.remove(s)
        chosen.append((s, r))
    return chosen


def with_force(test: Measurement) -> Measurement:
    """The measurement itself; an InputError where it has no base force."""
    if test.force is None:
        raise InputError("base_force: this measurement has no base force")
    return test
