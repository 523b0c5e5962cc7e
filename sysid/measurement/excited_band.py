"""The band that the base excites, by the spectrum of its motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sysid.measurement.spectra import FOLDED, lines_of_record, runs_of_records
from sysid.structure.structure import Array

_AT_REST = 1 / 16  # of the largest motion of a run: the base of a run with less counts as at rest


def excited_band(
    runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]], sample_rate: float
) -> tuple[float, float]:
    """Find the band that the base excites: around most of its power, where it moves twice as much as where it is quiet.

    Slow drift below a quiet stretch and the noise above the motion are left out; gaps of up to an octave, as between
    the steps of a sine, are not. All lines are excited where none stand out (white motion), and to either side where
    motion falls evenly without a floor (pink). Several runs excite what any of them does.

    Parameters
    ----------
    runs : sequence of (base, response, force or None)
        Records in time, as in `Measurement.from_time`.
    sample_rate : float
        Hz.

    Returns
    -------
    low, high : float
        Hz, of lines of the records; the first line, and the last up to 0.4 of the sample rate, where nothing is cut.

    Examples
    --------
    Random motion from 2 to 10 Hz, 100 s of it, and noise of 1 % of the same level:

    >>> rng = np.random.default_rng(0)
    >>> white, freq = rng.standard_normal((2, 1, 10000)), np.fft.rfftfreq(10000, 0.01)
    >>> moved = np.fft.irfft(np.where((freq > 2) & (freq < 10), np.fft.rfft(white[0]), 0.0))
    >>> low, high = excited_band([(moved + 0.01 * white[1], moved, None)], 100.0)
    >>> bool(1.6 < low <= 2.01 and 9.99 <= high < 12)
    True
    """
    bases = [run.base for run in runs_of_records(runs, sample_rate)]
    moved = [float(np.std(base, axis=1).max()) for base in bases]
    # The noise of a run at rest is spread over all lines.
    bands = [
        _band_of(base, sample_rate) for base, rms in zip(bases, moved, strict=True) if rms >= _AT_REST * max(moved)
    ]
    low, high = zip(*bands, strict=True)
    return min(low), max(high)


class _Levels(NamedTuple):
    """Levels of the base's motion in bins of a sixth of an octave, each of some lines; all (bins,).

    `low` and `high` are a bin's first and last line, Hz; `level` its mean power density and `smooth` that over half an
    octave; `body` are the bins in which a twentieth, half and nineteen twentieths of the power are reached, `typical`
    the level that most of the power has.
    """

    low: Array
    high: Array
    octaves: Array
    level: Array
    smooth: Array
    body: NDArray[np.intp]
    typical: float


def _band_of(base: Array, sample_rate: float) -> tuple[float, float]:
    """The band of one run (d, n)."""
    freq = lines_of_record(base.shape[1]) * sample_rate
    freq = freq[: max(np.searchsorted(freq, FOLDED * sample_rate, side="right"), 1)]
    power = _without_hum(_density(base))[1 : 1 + freq.size]
    if not np.any(power):
        return float(freq[0]), float(freq[-1])
    levels = _levels(freq, power)
    down, up = np.arange(levels.body[1], -1, -1), np.arange(levels.body[1], levels.low.size)
    low, still = _end(levels, down, levels.body[0], levels.smooth[down].min())
    # Noise seldom rises with frequency: the quietest bins of all tell that above.
    high, quiet = _end(levels, up, levels.body[2], levels.smooth.min())
    first, last = np.searchsorted(freq, [levels.low[low], levels.high[high]])
    # Bins at the ends hold lines that do not move.
    few = min(12, last + 1 - first)
    moves = np.convolve(power[first : last + 1], np.full(few, 1 / few), "valid")
    begin, end = freq[first + np.flatnonzero(moves > still)[0]], freq[last - np.flatnonzero(moves[::-1] > quiet)[0]]
    # A sweep reaches its ends where the tapers of the density vanish.
    inside = freq[first : last + 1]
    return float(inside[inside >= begin / 1.02][0]), float(inside[inside <= 1.02 * end][-1])


def _density(base: Array, tapers: int = 5) -> Array:
    """Power density of all directions together, (n // 2 + 1,), in a scale of its own.

    By sine tapers (Riedel and Sidorenko, IEEE Trans. Signal Process. 43 (1995) 188-195), which weigh all samples nearly
    alike and leak little beside strong lines.
    """
    n = base.shape[1]
    centred, at = base - base.mean(axis=1, keepdims=True), np.pi * np.arange(1, n + 1) / (n + 1)
    parts = (np.fft.rfft(np.sin(k * at) * centred, axis=1) for k in range(1, tapers + 1))
    return sum((np.sum(np.abs(part) ** 2, axis=0) for part in parts), np.zeros(n // 2 + 1))


def _without_hum(power: Array, little: float = 1e-5, out: float = 30.0, near: int = 8, about: int = 17) -> Array:
    """A power density without lines that stand out of those on both sides and hold next to nothing of the power.

    The mains leave such lines where the base does not move; a step of a sine holds more.
    """
    shift = near + about // 2
    if power.size < 4 * shift:
        return power
    median = scipy.ndimage.median_filter(np.pad(power, shift, mode="reflect"), about)
    beside = np.maximum(median[: power.size], median[2 * shift :])
    hum = (power > out * beside) & (np.convolve(power, np.ones(near), "same") < little * power.sum())
    return np.where(np.convolve(hum, np.ones(near + 1), "same") > 0, np.minimum(power, beside), power)


def _levels(freq: Array, power: Array, fewest: int = 6) -> _Levels:
    """Levels of a power density at lines in Hz, in bins of a sixth of an octave and `fewest` lines or more."""
    starts = [0]
    while starts[-1] + 2 * fewest <= freq.size:
        wide = int(np.searchsorted(freq, 2 ** (1 / 6) * freq[starts[-1]]))
        starts.append(min(max(starts[-1] + fewest, wide), freq.size - fewest))
    first, last = np.array(starts), np.array([*starts[1:], freq.size])
    total, bins = np.append(0.0, np.cumsum(power)), np.arange(first.size)
    mean = lambda a, b: (total[b] - total[a]) / (b - a)  # noqa: E731
    around = first[np.maximum(bins - 1, 0)], last[np.minimum(bins + 1, bins[-1])]
    reached = np.searchsorted(total[1:], total[-1] * np.array([0.05, 0.5, 0.95]))
    seen = power > 0
    return _Levels(
        freq[first], freq[last - 1], np.log2(np.append(freq[first[1:]], freq[-1]) / freq[first]),
        mean(first, last), mean(*around), np.searchsorted(last, np.minimum(reached, freq.size - 1), side="right"),
        float(np.exp(np.average(np.log(power[seen]), weights=power[seen]))),
    )  # fmt: skip


def _end(
    levels: _Levels, outward: NDArray[np.intp], inner: np.intp, quiet: float, standing: float = 4.0
) -> tuple[np.intp, float]:
    """The last bin of the band going `outward` from the middle of its power, and the level of motion there, or zero.

    It lies past the bin `inner` of the band's body.

    `standing` times the level where it is `quiet` is motion. Beyond the end it stays on a floor, rises again, or is
    below a thousandth of the motion; else all that follows belongs to it.
    """
    quiet, deep = max(quiet, 1e-6 * levels.typical), quiet < 1e-6 * levels.typical
    moves = levels.level[outward] > standing * quiet
    moves[: abs(int(inner) - int(outward[0])) + 1] = True
    octaves = np.cumsum(levels.octaves[outward])
    steps = np.flatnonzero(moves)
    wide = np.flatnonzero(octaves[steps[1:] - 1] - octaves[steps[:-1]] > 1)  # gaps of more than an octave
    last = steps[wide[0] if wide.size else -1]
    within = lambda times: levels.octaves[outward[levels.smooth[outward] < times * quiet]].sum()  # noqa: E731
    # Of a stretch within 6 dB of its end a power law has half within 3 dB, a floor nearly all.
    floor = within(standing / 2) > 0.65 * within(standing)
    ends = levels.typical > standing**2 * quiet and (floor or deep or np.any(moves[last + 1 :]))
    # The next bin may hold some of its lines.
    return (outward[min(last + 1, outward.size - 1)], standing * quiet) if ends else (outward[-1], 0.0)
