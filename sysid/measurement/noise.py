"""Stated noise: weights of a fit from standard deviations, and levels from stretches in which nothing moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array, sequence
from sysid.measurement.spectra import TimeRun, check_runs
from sysid.measurement.whole import NoiseLevels
from sysid.structure.structure import Array
from sysid.structure.thresholds import NEGLIGIBLE

_FEWEST_LINES = 50  # a deviation known to 7 %


def levels_at_rest(
    runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]],
    sample_rate: float,
    *,
    band: tuple[float, float] | None = None,
) -> NoiseLevels:
    """Noise of each channel from stretches in which nothing moves, for ``from_time(noise=)``.

    Deviations of a sample in time, were the noise white as it is in the band. A mean and a straight line are taken off
    each record; the lowest line, which that touches, is left out.

    Parameters
    ----------
    runs : sequence of (base, response, force or None)
        Records at rest, as in `Measurement.from_time`.
    sample_rate : float
        Hz.
    band : (low, high), optional
        Hz, both ends included: that of the test; noise that is not white has another level elsewhere.

    Raises
    ------
    InputError
        Records that do not fit each other, or are too short for a level.
    """
    given = sequence("runs", runs, "a list of (base, response, force or None)")
    base, response, _ = sequence("run 1", given[0], "(base, response, force or None)", 3)
    shape = tuple(np.atleast_2d(finite_array("run 1", record)).shape[0] for record in (response, base))
    records = check_runs(given, sample_rate, shape)
    low, high = (0.0, np.inf) if band is None else sequence("band", band, "(low, high) in Hz", 2)
    level = _levels(records, sample_rate, low, high)
    n, d = shape
    return NoiseLevels(level[:n], level[n : n + d], None if records[0].force is None else level[n + d :])


def _levels(runs: Sequence[TimeRun], sample_rate: float, low: float, high: float) -> Array:
    """Deviations of a sample of responses, base and force, (channels,), by the lines from `low` to `high` Hz."""
    power, lines = np.zeros(0), 0
    for run in runs:
        records = np.vstack([run.response, run.base, *([] if run.force is None else [run.force])])
        n = records.shape[1]
        freq = np.fft.rfftfreq(n, 1 / sample_rate)
        keep = (np.arange(freq.size) > 1) & (freq < sample_rate / 2) & (freq >= low) & (freq <= high)
        unit = np.vander(np.linspace(-1.0, 1.0, n), 2)
        slopes = np.linalg.lstsq(unit, records.T, rcond=None)[0]
        spectra = np.fft.rfft(records - (unit @ slopes).T, axis=1)[:, keep]
        run_power = np.sum(np.abs(spectra) ** 2, axis=1) / n
        power, lines = (run_power if not power.size else power + run_power), lines + int(keep.sum())
    if lines < _FEWEST_LINES:
        raise InputError(
            f"the stretch at rest has {lines} lines in the band, too few for a level (at least {_FEWEST_LINES}): "
            "give a longer stretch, or a wider band"
        )
    return np.sqrt(power / lines)


def separable(std: Array | None, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Weights 1/std as a product: of the channels (channels,) and of the lines of each run (runs, n_freq).

    They are geometric means over the other axes: exact where the noise is a product of the two, as it is where
    one number, one number for each channel or one spectrum is stated. Fits with other weights than 1/std are
    unbiased all the same, and their covariance is computed with the stated noise.

    Parameters
    ----------
    std : (runs, channels, n_freq) or None
        Ones are returned where nothing is stated.
    shape : (runs, channels, n_freq)
    """
    runs, channels, lines = shape
    floored = raised(std)
    if floored is None:
        return np.ones(channels), np.ones((runs, lines))
    weight = -np.log(floored)
    channel = weight.mean(axis=(0, 2))
    return np.exp(channel), np.exp((weight - channel[:, None]).mean(axis=1))


def raised(std: Array | None) -> Array | None:
    """Stated deviations as fits weigh by them, the smallest raised; None where none is stated, or none above zero."""
    if std is None or not np.any(std > 0):
        return None
    return np.maximum(std, NEGLIGIBLE * np.median(std[std > 0]))
