"""From time records to spectra: whole-record transforms, averaged estimators, one clock for many instruments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError
from sysid.structure.structure import Array, ComplexArray


class Run(NamedTuple):
    """One run in time: base (d, n), response (n_sensors, n), force (d, n) or None."""

    base: Array
    response: Array
    force: Array | None


@dataclass(frozen=True)
class Estimate:
    """Averaged frequency response functions.

    Attributes
    ----------
    freq : (n_freq,) Hz
    frf, frf_std : (n_sensors, d, n_freq)
        Absolute transmissibility and its standard deviation, ``sqrt(E|e|²)``.
    force, force_std : (d, d, n_freq) or None
    coherence : (n_sensors, n_freq)
        Multiple coherence of each sensor with all base directions.
    """

    freq: Array
    frf: ComplexArray
    frf_std: Array
    force: ComplexArray | None
    force_std: Array | None
    coherence: Array


def check_runs(
    runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]], sample_rate: float, shape: tuple[int, ...]
) -> list[Run]:
    """Check time records against ``shape = (n_sensors, d)`` and each other."""
    if not (np.isfinite(sample_rate) and sample_rate > 0):
        raise InputError(f"sample_rate = {sample_rate}: a positive number of samples a second is needed")
    if not runs:
        raise InputError("no runs: give a list of (base, response, force or None)")
    sensors, d = shape
    checked = []
    for index, run in enumerate(runs):
        if len(run) != 3:
            raise InputError(f"run {index} has {len(run)} records; give (base, response, force or None)")
        base = _record(f"run {index}, base", run[0], d)
        response = _record(f"run {index}, response", run[1], sensors)
        force = None if run[2] is None else _record(f"run {index}, force", run[2], d)
        lengths = {record.shape[1] for record in (base, response, force) if record is not None}
        if len(lengths) > 1:
            raise InputError(f"run {index}: its records have different lengths {sorted(lengths)}")
        checked.append(Run(base, response, force))
    if len({run.force is None for run in checked}) > 1:
        raise InputError("some runs have a force and some have none; give it for all or for none")
    return checked


def whole_record(
    runs: Sequence[Run], sample_rate: float
) -> tuple[Array, ComplexArray, ComplexArray, ComplexArray | None]:
    """Fourier transforms of whole records, without the zero line; m/s² s.

    Returns
    -------
    freq (n_freq,), base (runs, d, n_freq), response (runs, n_sensors, n_freq), force or None
    """
    lengths = {run.base.shape[1] for run in runs}
    if len(lengths) > 1:
        raise InputError(f"whole-record spectra need equally long runs; these have {sorted(lengths)} samples")
    n = lengths.pop()
    freq = np.fft.rfftfreq(n, 1 / sample_rate)[1:]
    if freq.size == 0:
        raise InputError(f"a record of {n} samples has no spectral line above zero")
    transform = lambda records: np.fft.rfft(np.array(records), axis=-1)[..., 1:] / sample_rate  # noqa: E731
    forces = [run.force for run in runs if run.force is not None]
    return (
        freq,
        transform([run.base for run in runs]),
        transform([run.response for run in runs]),
        transform(forces) if forces else None,
    )


def averaged(runs: Sequence[Run], sample_rate: float, *, kind: str, segment: int | None = None) -> Estimate:
    """H1 or H2 by Welch's method (Hann window, half overlap), several inputs at once.

    H1 solves ``S_yx = H S_xx`` for all base directions together; H2 is ``S_yy / S_xy``, for one
    base direction. The variance of an estimate from n_e effective averages is
    ``(1 - coherence) S_yy [S_xx^-1]_ii / n_e`` (Bendat and Piersol, *Random Data*, ch. 9), n_e
    counting the overlap as in Welch (1967). What the window blurs (`_smoothing`) is added.

    Raises
    ------
    InputError
        Too few segments for the number of inputs, base directions that are not independent, H2
        with several base directions.
    """
    from scipy import signal

    d = runs[0].base.shape[0]
    if kind == "h2" and d > 1:
        raise InputError("'h2' divides by one input; with several base directions use 'h1'")
    shortest = min(run.base.shape[1] for run in runs)
    length = max(shortest // 4, 2) if segment is None else int(segment)
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

    def cross(a: str, b: str) -> ComplexArray:
        """E[conj(a_i) b_j] over segments of all runs, (i, j, n_freq)."""
        parts = []
        for run, count in zip(runs, counts, strict=True):
            x, y = _channels(run, a), _channels(run, b)
            _, S = signal.csd(
                x[:, None], y[None], sample_rate, window=window, noverlap=length - step, detrend="constant"
            )
            parts.append(count * S)
        return sum(parts)[..., 1:] / counts.sum()

    freq = np.fft.rfftfreq(length, 1 / sample_rate)[1:]
    S_xx = np.moveaxis(cross("base", "base"), -1, 0).swapaxes(1, 2)  # [line, a, b] = E[x_a conj(x_b)]
    _check_independent(S_xx)
    S_yx = np.moveaxis(cross("base", "outputs"), -1, 0).swapaxes(1, 2)  # [line, output, input] = E[y conj(x)]
    S_yy = np.moveaxis(_auto(runs, counts, sample_rate, window, length - step), -1, 0)
    inverse = np.linalg.inv(S_xx)
    H = S_yx @ inverse
    explained = np.einsum("fsi,fsi->fs", H, S_yx.conj()).real
    coherence = np.clip(explained / np.where(S_yy > 0, S_yy, np.inf), 0.0, 1.0)
    # The residual spectrum has averages - d degrees of freedom left.
    variance = ((1 - coherence) * S_yy)[:, :, None] * np.einsum("fii->fi", inverse).real[:, None, :] / (averages - d)
    std = np.sqrt(variance + _smoothing(H) ** 2)
    if kind == "h2":
        ratio = 1 / np.maximum(coherence, np.finfo(float).tiny)[:, :, None]  # H2 = H1 / coherence
        H, std = H * ratio, std * ratio
    frf, frf_std = np.moveaxis(H, 0, -1), np.moveaxis(std, 0, -1)
    n = runs[0].response.shape[0]
    forced = runs[0].force is not None
    return Estimate(
        freq=freq,
        frf=frf[:n],
        frf_std=frf_std[:n],
        force=frf[n:] if forced else None,
        force_std=frf_std[n:] if forced else None,
        coherence=coherence[:, :n].T,
    )


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

    if not records:
        raise InputError("no records to resample")
    clocks, samples = [], []
    for index, (time, values) in enumerate(records):
        t = np.asarray(time, dtype=float)
        x = np.atleast_2d(np.asarray(values, dtype=float))
        if t.ndim != 1 or x.shape[-1] != t.size or t.size < 4:
            raise InputError(f"record {index}: time {t.shape} and samples {x.shape} disagree (or fewer than 4 samples)")
        if not (np.all(np.isfinite(t)) and np.all(np.isfinite(x))):
            raise InputError(f"record {index} holds NaN or infinite samples")
        gaps = np.diff(t)
        if np.any(gaps <= 0):
            raise InputError(f"record {index}: time does not rise at sample {int(np.argmax(gaps <= 0)) + 1}")
        if gaps.max() > 3 * np.median(gaps):
            raise InputError(f"record {index}: a gap of {gaps.max():.4g} s at {t[np.argmax(gaps)]:.6g} s; cut it there")
        clocks.append(t)
        samples.append(x)
    rates = np.array([(t.size - 1) / (t[-1] - t[0]) for t in clocks])
    rate = float(rates.min()) if sample_rate is None else float(sample_rate)
    if not 0 < rate <= 1.01 * rates.min():
        raise InputError(f"sample_rate = {rate:g} Hz is not between 0 and the slowest instrument's {rates.min():g} Hz")
    start, stop = max(t[0] for t in clocks), min(t[-1] for t in clocks)
    count = int(np.floor((stop - start) * rate * (1 + 1e-12))) + 1
    if stop <= start or count < 2:
        raise InputError("the records have no time in common; check that their clocks have one origin")
    time = start + np.arange(count) / rate
    out = []
    folding = bool(np.any(rates > 1.1 * rate))
    for index, (t, x, own) in enumerate(zip(clocks, samples, rates, strict=True)):
        if folding:
            if t.size < 60:
                raise InputError(f"record {index}: {t.size} samples are too few to low-pass before resampling")
            x = sosfiltfilt(butter(8, 0.8 * rate / own, output="sos"), x, axis=-1)
        out.append(np.asarray(CubicSpline(t, x, axis=-1)(np.minimum(time, t[-1]))))
    return time, out


def _record(name: str, value: ArrayLike, channels: int) -> Array:
    try:
        array = np.atleast_2d(np.array(value, dtype=float))
    except (TypeError, ValueError):
        raise InputError(f"{name} is not an array of real numbers") from None
    if array.ndim != 2 or array.shape[0] != channels:
        raise InputError(f"{name} has shape {array.shape}; ({channels}, n_samples) is needed")
    if not np.all(np.isfinite(array)):
        raise InputError(f"{name} holds {int(np.sum(~np.isfinite(array)))} NaN or infinite samples")
    return array


def _channels(run: Run, which: str) -> Array:
    if which == "base":
        return run.base
    return run.response if run.force is None else np.vstack([run.response, run.force])


def _auto(runs: Sequence[Run], counts: Array, sample_rate: float, window: Array, overlap: int) -> Array:
    from scipy import signal

    total = 0.0
    for run, count in zip(runs, counts, strict=True):
        _, S = signal.welch(_channels(run, "outputs"), sample_rate, window=window, noverlap=overlap, detrend="constant")
        total = total + count * S
    return np.asarray(total)[..., 1:] / counts.sum()


def _smoothing(H: ComplexArray) -> Array:
    """Error of lines that the window blurs, ``h² |H''| / 6`` for Hann's, h the distance of lines; (n_freq, ...).

    An average over the window's squared spectrum, whose second moment is h²/3. No average over segments lowers it and
    no coherence of exact records shows it, so beside sharp peaks it is most of what an estimate is off by.
    """
    bend = np.zeros(H.shape)
    bend[1:-1] = np.abs(np.diff(H, 2, axis=0)) / 6
    return bend


def _effective_averages(window: Array, step: int, counts: Array) -> float:
    """Independent averages that the overlapped segments of all runs are worth (Welch 1967, eq. 12)."""
    energy = np.sum(window**2)
    total = 0.0
    for count in counts:
        correlation = [
            (np.sum(window[: -j * step] * window[j * step :]) / energy) ** 2
            for j in range(1, int(count))
            if j * step < window.size
        ]
        spread = 1 + 2 * sum((1 - (j + 1) / count) * c for j, c in enumerate(correlation))
        total += count / spread
    return total
