"""From time records to spectra: whole-record transforms, averaged estimators, one clock; lines without a number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import (
    InputError,
    as_float,
    finite_array,
    listed,
    numbers,
    refuse,
    sequence,
    shaped_array,
    whole_number,
)
from sysid.structure.structure import Array, ComplexArray

FOLDED = 0.4  # of the sample rate; whole records are fitted up to it


class TimeRun(NamedTuple):
    """One run in time: base (d, n), response (n_sensors, n), force (d, n) or None."""

    base: Array
    response: Array
    force: Array | None

    @property
    def outputs(self) -> Array:
        """Responses and, below them, forces where there are any."""
        return np.vstack([record for record in self[1:] if record is not None])


@dataclass(frozen=True)
class Estimate:
    """Averaged frequency response functions.

    Lines `freq` (n_freq,), Hz; absolute transmissibility `frf` and its standard deviation ``sqrt(E|e|²)``, (n_sensors,
    d, n_freq); `force` likewise (d, d, n_freq), or None; multiple coherence of each sensor with all base directions,
    (n_sensors, n_freq).
    """

    freq: Array
    frf: ComplexArray
    frf_std: Array
    force: ComplexArray | None
    force_std: Array | None
    coherence: Array


def of_run(index: int, runs: int) -> str:
    """Words for a message after what is of a run, such as " of run 2" for index 1 of many; none of the only run."""
    return f" of run {index + 1}" if runs > 1 else ""


def check_runs(
    runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]], sample_rate: float, shape: tuple[int, ...]
) -> list[TimeRun]:
    """Check time records against ``shape = (n_sensors, d)`` and each other."""
    as_float("sample_rate", sample_rate, "a positive number of samples a second", above=0)
    given = sequence("runs", runs, "a list of (base, response, force or None)")
    if len(shape) != 2:
        raise InputError(f"rigid_body has shape {shape}; (n_sensors, d) is needed")
    sensors, d = shape
    records = []
    for place, entry in enumerate(given, start=1):
        run = sequence(f"run {place}", entry, "(base, response, force or None)", 3)
        base = _record(f"run {place}, base", run[0], d)
        response = _record(f"run {place}, response", run[1], sensors)
        force = None if run[2] is None else np.atleast_2d(finite_array(f"run {place}, force", run[2]))
        if force is not None and (force.ndim != 2 or force.shape[0] != d):
            words = f"run {place}, force has shape {force.shape}; ({d}, n_samples) is needed"
            raise InputError(f"{words}: {FORCE_NEEDED}")
        lengths = {record.shape[1] for record in (base, response, force) if record is not None}
        if len(lengths) > 1:
            raise InputError(f"run {place}: its records have different lengths {sorted(lengths)}")
        records.append(TimeRun(base, response, force))
    if len({run.force is None for run in records}) > 1:
        raise InputError("some runs have a force and some have none; give it for all or for none")
    return records


def runs_of_records(runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]], sample_rate: float) -> list[TimeRun]:
    """Check time records against the first run and each other."""
    given = sequence("runs", runs, "a list of (base, response, force or None)")
    base, response, _ = sequence("run 1", given[0], "(base, response, force or None)", 3)
    shape = tuple(np.atleast_2d(finite_array("run 1", record)).shape[0] for record in (response, base))
    return check_runs(given, sample_rate, shape)


def directions(runs: Any) -> int:
    """Number of directions of the base in the first run, as far as it can be told; `check_runs` looks closer."""
    try:
        return int(np.atleast_2d(np.asarray(runs[0][0])).shape[0])
    except (TypeError, IndexError, KeyError, ValueError):
        return 1


def lines_of_record(samples: int) -> Array:
    """Lines above zero of a whole record, in cycles a sample, (samples // 2,); those of two records alike are equal."""
    if samples < 2:
        raise InputError(f"a record of {samples} samples has no spectral line above zero")
    return np.round(np.arange(1, samples // 2 + 1) / samples, 14)


def whole_record(
    runs: Sequence[TimeRun], sample_rate: float
) -> tuple[Array, ComplexArray, ComplexArray, ComplexArray | None]:
    """Lines (n_freq,), and Fourier transforms of whole records (runs, channels, n_freq), without the zero line; m/s² s.

    Of base, responses and force, None where there is none. Where runs differ in length the lines are those of all, and
    a run has zeros at the lines of others.
    """
    lengths = sorted({run.base.shape[1] for run in runs})
    grids = {n: lines_of_record(n) for n in lengths}
    lines = np.unique(np.concatenate(list(grids.values())))
    at = {n: np.searchsorted(lines, freq) for n, freq in grids.items()}

    def transform(records: list[Array]) -> ComplexArray:
        out = np.zeros((len(records), len(records[0]), lines.size), complex)
        for spectrum, record in zip(out, records, strict=True):
            spectrum[:, at[record.shape[1]]] = np.fft.rfft(record, axis=-1)[:, 1:] / sample_rate
        return out

    forces = [run.force for run in runs if run.force is not None]
    return (
        lines * sample_rate,
        transform([run.base for run in runs]),
        transform([run.response for run in runs]),
        transform(forces) if forces else None,
    )


def averaged(runs: Sequence[TimeRun], sample_rate: float, *, kind: str, segment: int | None = None) -> Estimate:
    """H1 or H2 by Welch's method (Hann window, half overlap), several inputs at once.

    H1 solves ``S_yx = H S_xx`` for all base directions together; H2 is ``S_yy / S_xy``, for one base direction. The
    variance of an estimate from n_e effective averages is ``(1 - coherence) S_yy [S_xx^-1]_ii / n_e`` (Bendat and
    Piersol, *Random Data*, ch. 9), n_e counting the overlap as in Welch (1967). What the window blurs (`blurred`) is
    added. Refused where there are too few segments, or base directions are not independent.
    """
    from scipy import signal

    d = runs[0].base.shape[0]
    if kind == "h2" and d > 1:
        raise InputError("'h2' divides by one input; with several base directions use 'h1'")
    shortest = min(run.base.shape[1] for run in runs)
    length = max(shortest // 4, 2) if segment is None else whole_number("segment", segment, at_least=2)
    if not 2 <= length <= shortest:
        raise InputError(f"segment = {segment}: between 2 and the {shortest} samples of the shortest run are needed")
    window = signal.get_window("hann", length)
    step = length - length // 2
    counts = np.array([(run.base.shape[1] - length) // step + 1 for run in runs])
    averages = _effective_averages(window, step, counts)
    if averages <= d:
        raise InputError(
            f"{counts.sum()} segments cannot separate {d} base directions and leave a coherence; "
            f"take a shorter segment than {length} samples or add runs"
        )

    def cross(pairs: Iterable[tuple[Array, Array]]) -> ComplexArray:
        """E[conj(x) y] over the segments of all runs, the line last."""
        options: Any = {"window": window, "noverlap": length - step, "detrend": "constant"}
        parts = [n * signal.csd(x, y, sample_rate, **options)[1] for n, (x, y) in zip(counts, pairs, strict=True)]
        return sum(parts)[..., 1:] / counts.sum()

    freq = np.fft.rfftfreq(length, 1 / sample_rate)[1:]
    S_xx = cross((run.base[:, None], run.base[None]) for run in runs).T  # [line, a, b] = E[x_a conj(x_b)]
    _check_independent(S_xx)
    S_yx = cross((run.base[:, None], run.outputs[None]) for run in runs).T  # [line, output, input] = E[y conj(x)]
    S_yy = cross((y, y) for y in (run.outputs for run in runs)).T.real  # [line, output]
    inverse = np.linalg.inv(S_xx)
    H = S_yx @ inverse
    explained = np.einsum("fsi,fsi->fs", H, S_yx.conj()).real
    coherence = np.clip(explained / np.where(S_yy > 0, S_yy, np.inf), 0.0, 1.0)
    # The residual spectrum has averages - d degrees of freedom left.
    variance = ((1 - coherence) * S_yy)[:, :, None] * np.einsum("fii->fi", inverse).real[:, None, :] / (averages - d)
    std = np.sqrt(variance + blurred(H.T).T ** 2)
    if kind == "h2":
        ratio = 1 / np.maximum(coherence, np.finfo(float).tiny)[:, :, None]  # H2 = H1 / coherence
        H, std = H * ratio, std * ratio
    frf, frf_std = np.moveaxis(H, 0, -1), np.moveaxis(std, 0, -1)
    n = runs[0].response.shape[0]
    force, force_std = (None, None) if runs[0].force is None else (frf[n:], frf_std[n:])
    return Estimate(
        freq=freq, frf=frf[:n], frf_std=frf_std[:n], force=force, force_std=force_std, coherence=coherence[:, :n].T
    )


def std_of_functions(H: ComplexArray, coherence: Array, averages: int) -> Array:
    """Standard deviations ``sqrt(E|e|²)`` of functions H1 (..., lines) by their coherences and independent averages.

    ``|H|² (1 - coherence) / (coherence averages)`` (Bendat and Piersol, *Random Data*, ch. 9). Coherences are those of
    text files: above one less 1e-6 they are not told apart.
    """
    known = np.clip(coherence, 1e-6, 1 - 1e-6)
    std: Array = np.sqrt(np.abs(H) ** 2 * (1 - known) / (known * averages))
    return std


def coherence_of(name: str, given: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Coherences of functions of this shape, one a function and line; the axis of one base direction may be missing."""
    known = finite_array(name, given)
    try:
        known = np.broadcast_to(known[:, None] if known.ndim == 2 else known, shape)
    except ValueError:
        raise InputError(f"{name} is {known.shape}: one a function and line, {shape}") from None
    if np.any((known < 0) | (known > 1)):
        raise InputError(f"{name} is between 0 and 1")
    return known


def _check_independent(S_xx: ComplexArray) -> None:
    """Refuse base spectra (n_freq, d, d) of directions that do not move, or not by themselves."""
    size = np.sqrt(np.einsum("fii->fi", S_xx).real)
    if np.any(size == 0):
        raise InputError("a base direction does not move at some line; narrow the band or leave that direction out")
    condition = np.linalg.cond(S_xx / (size[:, :, None] * size[:, None, :]))
    if np.median(condition) > 1e8:
        raise InputError(
            "the base directions do not move independently over these runs (one fixed direction of motion?); "
            "their responses cannot be told apart: add runs, or state fewer base directions"
        )


def resample(
    records: Sequence[tuple[ArrayLike, ArrayLike]], sample_rate: float | None = None
) -> tuple[Array, list[Array]]:
    """Bring records of unequal clocks to one uniform clock over the time they share.

    Parameters
    ----------
    records : sequence of (time, samples)
        Time (n,) in s, strictly increasing and on one origin; samples (channels, n) or (n,).
    sample_rate : float, optional
        Hz; the slowest instrument's mean rate by default. Where an instrument is faster than that,
        all records are low-passed alike (zero phase, to about 0.35 of the rate), so that nothing
        folds into the band and ratios of records keep their size.

    Returns
    -------
    time : (n_common,) s
    samples : list of (channels, n_common)
        By cubic splines.

    Raises
    ------
    InputError
        Times that do not rise, a gap of more than three samples, no time in common, or a rate
        above an instrument's own.
    """
    from scipy.interpolate import CubicSpline
    from scipy.signal import butter, sosfiltfilt

    given = sequence("records", records, "a list of (time, samples)")
    clocks, samples = map(list, zip(*(_timed(f"record {i}", one) for i, one in enumerate(given, start=1)), strict=True))
    rates = np.array([(t.size - 1) / (t[-1] - t[0]) for t in clocks])
    rate = float(rates.min()) if sample_rate is None else as_float("sample_rate", sample_rate)
    if not 0 < rate <= 1.01 * rates.min():
        raise InputError(f"sample_rate = {rate:g} Hz is not between 0 and the slowest instrument's {rates.min():g} Hz")
    start, stop = max(t[0] for t in clocks), min(t[-1] for t in clocks)
    count = int(np.floor((stop - start) * rate * (1 + 1e-12))) + 1
    if stop <= start or count < 2:
        raise InputError("the records have no time in common; check that their clocks have one origin")
    time = start + np.arange(count) / rate
    if np.any(rates > 1.1 * rate):
        few = "samples are too few to low-pass before resampling"
        refuse(*((t.size < 60, f"record {place}: {t.size} {few}") for place, t in enumerate(clocks, start=1)))
        filters = [butter(8, 0.8 * rate / record_rate, output="sos") for record_rate in rates]
        samples = [sosfiltfilt(sos, x, axis=-1) for sos, x in zip(filters, samples, strict=True)]
    splines = [CubicSpline(t, x, axis=-1) for t, x in zip(clocks, samples, strict=True)]
    return time, [np.asarray(spline(np.minimum(time, spline.x[-1]))) for spline in splines]


def on_one_clock(
    records: Array, delays: Array, sample_rate: float, place: str = "", *, half: int = 32, shape: float = 20.0
) -> Array:
    """Records (channels, n), each earlier by its delay, s, (channels,), at the times that all have in common.

    Between samples by a sum of `half` samples to either side, weighed by a sine cardinal and Kaiser's window: exact to
    1e-9 up to 0.4 of the sample rate, Hz, to 2 % at 0.45. All records are cut by as many samples at each end,
    and by the delays: none holds what was not recorded.
    """
    whole = np.rint(delays * sample_rate).astype(int)
    part = delays * sample_rate - whole
    between = np.abs(part) > 1e-6
    reach = half * bool(np.any(between))
    first, last = reach - min(whole.min(), 0), records.shape[1] - reach - max(whole.max(), 0)
    words = f"the delays that are stated leave nothing of {records.shape[1]} samples{place}"
    refuse((last - first < 2, f"{words}: are they in seconds?"))
    found = np.array([row[first + at : last + at] for row, at in zip(records, whole, strict=True)])
    for channel in np.flatnonzero(between):
        steps = np.arange(-half, half + 1) - part[channel]
        taps = np.sinc(steps) * np.i0(shape * np.sqrt(1 - (steps / (half + 0.5)) ** 2)) / np.i0(shape)
        at = whole[channel]
        found[channel] = np.convolve(records[channel, first - half + at : last + half + at], taps[::-1], "valid")
    return found


def runs_on_one_clock(runs: Sequence[TimeRun], delays: Array, sample_rate: float) -> list[TimeRun]:
    """Runs whose channels are earlier by their delays, s: of the sensors, then of base and force, (n_sensors + 2,).

    See `on_one_clock`; as they are where there is none.
    """
    if not np.any(delays):
        return list(runs)
    found = []
    for number, run in enumerate(runs):
        n, d = len(run.response), len(run.base)
        each = np.repeat(delays, [*[1] * n, d, 0 if run.force is None else d])
        rows = np.vstack([part for part in (run.response, run.base, run.force) if part is not None])
        rows = on_one_clock(rows, each, sample_rate, of_run(number, len(runs)))
        found.append(TimeRun(rows[n : n + d], rows[:n], None if run.force is None else rows[n + d :]))
    return found


def _timed(name: str, entry: Any) -> tuple[Array, Array]:
    """Times (n,) that rise without gaps, and samples (channels, n), of a pair of both."""
    time, values = sequence(name, entry, "(time, samples)", 2)
    t, x = finite_array(f"time of {name}", time), np.atleast_2d(finite_array(f"samples of {name}", values))
    if t.ndim != 1 or x.ndim != 2 or x.shape[1] != t.size or t.size < 4:
        raise InputError(f"{name}: time {t.shape} and samples {x.shape} disagree (or fewer than 4 samples)")
    gaps = np.diff(t)
    widest, back = np.argmax(gaps), np.argmax(gaps <= 0)
    refuse(
        (gaps[back] <= 0, f"{name}: time does not rise at sample {back + 2}"),  # from 1, as in files
        (
            gaps[widest] > 3 * np.median(gaps),
            f"{name}: a gap of {gaps[widest]:.4g} s at {t[widest]:.6g} s; cut it there",
        ),
    )
    return t, x


def _record(name: str, value: ArrayLike, channels: int) -> Array:
    return shaped_array(name, np.atleast_2d(finite_array(name, value)), channels, "n_samples")


def blurred(H: ComplexArray) -> Array:
    """Error of lines that the window blurs, ``h² |H''| / 6`` for Hann's, h the distance of lines; (..., n_freq).

    An average over the window's squared spectrum, whose second moment is h²/3. No average over segments lowers it and
    no coherence of exact records shows it, so beside sharp peaks it is most of what an estimate is off by.
    """
    bend = np.zeros(H.shape)
    bend[..., 1:-1] = np.abs(np.diff(H, 2)) / 6
    return bend


def _effective_averages(window: Array, step: int, counts: Array) -> float:
    """Independent averages that the segments of all runs are worth, which overlap by half (Welch 1967, eq. 12)."""
    correlation = (np.sum(window[:-step] * window[step:]) / np.sum(window**2)) ** 2  # of neighbours alone
    return float(np.sum(counts / (1 + 2 * (1 - 1 / counts) * correlation)))


Missing = Literal["refuse", "drop"]
FORCE_NEEDED = (
    "measure it along each base direction, moments too, or give no force (one along some of them can be a residual of "
    "a written model: docs/own_unknowns.md)"
)


def present(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, NDArray[np.bool_]]]:
    """Records and deviations, by name, without the lines at which any of them is NaN; and where they are.

    Infinite numbers stay. Refused where no line is left.
    """
    lines, found = given["freq"].size, {name: value for name, value in given.items() if value is not None}
    arrays = {name: numbers(name, value, float if "std" in name else complex) for name, value in found.items()}
    arrays["freq"] = given["freq"]
    # What stands for all lines alike lacks at all of them.
    holes = {
        name: np.broadcast_to(np.any(np.isnan(array), axis=tuple(range(array.ndim - 1))), lines)
        for name, array in arrays.items()
        if not array.ndim or array.shape[-1] in (1, lines)
    }
    keep = ~np.any(list(holes.values()), axis=0)
    if not np.any(keep):
        counts = ", ".join(f"{name} at {np.count_nonzero(hole)}" for name, hole in holes.items() if np.any(hole))
        raise InputError(f"missing='drop' leaves no line: of {lines}, NaN stands in {counts}")
    kept = {name: a[..., keep] if a.shape[-1:] == (lines,) else a for name, a in arrays.items()}
    return given | kept, {name: np.isnan(arrays[name]) for name, hole in holes.items() if np.any(hole)}


def named(holes: dict[str, NDArray[np.bool_]], freq: Array, sensors: Sequence[str]) -> tuple[tuple[str, Array], ...]:
    """Records with NaN, and where, Hz: sensors by name, other records by their own."""
    found: list[tuple[str, Array]] = []
    for name, hole in holes.items():
        names, channels = (sensors, len(sensors)) if name == "response" else ([name], 1)
        # Of a sensor all runs, of another record all its channels.
        rows: NDArray[np.bool_] = np.any(hole.reshape(-1, channels, hole.shape[-1]), axis=0)
        found += [(one, freq[row]) for one, row in zip(names, rows, strict=True) if np.any(row)]
    return tuple(found)


def in_words(holes: tuple[tuple[str, Array], ...], freq: Array) -> str:
    """Which channels hold NaN and from where to where; what no line of `freq` parts is one range."""
    phrases = []
    for name, at in holes:
        parts = np.split(at, np.flatnonzero(np.diff(np.searchsorted(freq, at))) + 1)
        ranges = [f"{p[0]:.5g}" if p.size == 1 else f"{p[0]:.5g} to {p[-1]:.5g}" for p in parts]
        phrases.append(f"{name} at {listed(ranges)} Hz")
    return "; ".join(phrases)


def complete(name: str, value: ArrayLike, kind: type = float) -> NDArray[Any]:
    """Check that all lines are finite numbers; the message says how lines with NaN are left out."""
    try:
        return finite_array(name, value, kind)
    except InputError as error:
        if not np.any(np.isnan(numbers(name, value, kind))):
            raise
        raise InputError(f"{error}; missing='drop' leaves out the lines at which anything is NaN") from None


def checked_lines(name: str, value: Any, n_freq: int, read: Callable[..., Any] = complete) -> ComplexArray:
    """Spectra (runs, channels, n_freq) of a number of lines; one run may be given without its axis."""
    array: ComplexArray = read(name, value, complex)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[-1] != n_freq:
        raise InputError(f"{name} has shape {array.shape}; (runs, channels, {n_freq}) is needed, frequency last")
    return array


def checked_deviations(
    name: str, value: Any, record: ComplexArray | None, read: Callable[..., Any] = complete
) -> Array | None:
    """Deviations of a record, of its shape; None where none are given.

    A zero among others, as of a function that is zero at a line, tells no noise: the median of its channel's other
    lines stands in its place, or of the whole record where it has none.
    """
    if value is None:
        return None
    if record is None:
        raise InputError(f"{name} is given without its record")
    array = read(name, value)
    try:
        full = np.broadcast_to(array, record.shape).copy()
    except ValueError:
        raise InputError(f"{name} {array.shape} does not broadcast to its record {record.shape}") from None
    if np.any(full < 0):
        raise InputError(f"{name} holds negative entries")
    known = full > 0
    for channel in np.argwhere(np.any(~known, axis=-1)) if np.any(known) else []:
        lines, some = full[*channel], known[*channel]
        lines[~some] = np.median(lines[some] if np.any(some) else full[known])
    return full
