"""Records in time of what the lines of a test hold, and scores of predicted ones against them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels, WholeRecords
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import NEGLIGIBLE

_LINES = 32  # in a part of a run whose noise is told, at least
_NO_LINE = 0.1  # of the distance of lines, off which a frequency is none of them, however fine they are


class RunInTime(NamedTuple):
    """Records of a run at `rate` Hz, and how many lines they hold.

    Base (d, n), absolute responses (n_sensors, n), and force (d, n) where it was measured: in m/s² and N, or all in one
    unknown unit where spectra were given without their sample rate (`levels_are_known`).
    """

    base: Array
    response: Array
    force: Array | None
    rate: float
    lines: int


def runs_in_time(test: Measurement) -> list[RunInTime]:
    """The records of each run; none where the spectra are not those of whole records.

    Spectra that were given as such are taken for those of whole records where their lines can be, and all runs have the
    same.
    """
    whole = as_whole(test).whole
    if whole is None:
        return []
    rate, samples, recordings = whole.sample_rate, whole.samples, []
    for run, (lines, n) in enumerate(zip(test.own_lines, samples, strict=True)):
        at = np.round(test.freq[lines] * n / rate).astype(int)
        base, response, force = (
            None if record is None else _of_lines(record[run][:, lines] * rate, at, n)
            for record in (test.base, test.response, test.force)
        )
        assert base is not None and response is not None
        recordings.append(RunInTime(base, response, force, rate, at.size))
    return recordings


def levels_are_known(test: Measurement) -> bool:
    """True where the spectra have the unit of `from_time`, m/s² s: the scale of those that were given is free."""
    return test.whole is not None or test.sample_rate is not None


def peaks(test: Measurement) -> list[float]:
    """Largest accelerations of a sensor against the base in each run, m/s²; none where levels are not known."""
    if not levels_are_known(test):
        return []
    return [float(np.abs(run.response - test.rigid_body @ run.base).max()) for run in runs_in_time(test)]


def cut_in_motion(test: Measurement, parts: int = 64, at_rest: float = 0.1) -> bool:
    """True where plain spectra are those of records that neither begin nor end at rest.

    At rest the first or last of so many `parts` of a run holds no more than this share of its mean square.
    """
    if test.sample_rate is None:
        return False
    for run in runs_in_time(test):
        power = np.sum((run.response - test.rigid_body @ run.base) ** 2, axis=0)
        ends = max(1, power.size // parts)
        if max(power[:ends].mean(), power[-ends:].mean()) > at_rest * power.mean():
            return True
    return False


def quiet_levels(test: Measurement) -> NoiseLevels | None:
    """Levels of noise of the quietest parts of each run, (runs, channels) each.

    Noise is no larger, and as large where all was at rest for a while. None where spectra are not those of whole
    records, or lines are too few.
    """
    runs = runs_in_time(test)
    if not runs or min(run.lines for run in runs) < 2 * _LINES:
        return None
    response = np.array([_quietest(run, run.response) for run in runs])
    base = np.array([_quietest(run, run.base) for run in runs])
    forces = [_quietest(run, run.force) for run in runs if run.force is not None]
    return NoiseLevels(response, base, np.array(forces) if forces else None)


def _quietest(run: RunInTime, records: Array, most: int = 32, share: float = 0.1) -> Array:
    """Deviations of a sample of white noise up to half the rate that holds as much, (channels,).

    As much as the quietest `share` of the parts of a run, `most` at most.
    """
    blocks = np.array_split(records**2, min(most, run.lines // _LINES), axis=1)
    power = np.quantile([block.mean(axis=1) for block in blocks], share, axis=0)
    return np.asarray(np.sqrt(power * records.shape[1] / (2 * run.lines)))


def as_whole(test: Measurement) -> Measurement:
    """Spectra as those of whole records cut in motion; as they are where their lines cannot be such."""
    if test.whole is not None or test.averaged or test.has_unit_runs or test.freq.size < 2:
        return test
    lines_of_runs = test.own_lines
    if np.any(lines_of_runs.sum(axis=1) < 2) or (test.sample_rate is None and not np.all(lines_of_runs)):
        return test
    freq = [test.freq[lines] for lines in lines_of_runs]
    spacing = np.array([float(np.min(np.diff(lines))) for lines in freq])
    at = [f / df for f, df in zip(freq, spacing, strict=True)]
    if any(np.max(np.abs(k - np.round(k))) > min(NEGLIGIBLE * k[-1], _NO_LINE) for k in at):
        return test
    if test.sample_rate is None:
        # A period of the highest line, where the sample rate is not known.
        n = int(scipy.fft.next_fast_len(int(np.ceil(2.5 * test.freq[-1] / spacing[0]))))
        samples, rate = [n] * test.n_runs, n * float(spacing[0])
    else:
        samples, rate = np.round(test.sample_rate / spacing).astype(int).tolist(), test.sample_rate
    return replace(test, whole=WholeRecords(tuple(samples), rate, (False,) * test.n_runs))


def _of_lines(lines: ComplexArray, at: Array, n: int) -> Array:
    """Records (channels, n) of some lines of their discrete Fourier transforms, zero at the others."""
    every = np.zeros((len(lines), n // 2 + 1), complex)
    every[:, at] = lines
    return np.asarray(np.fft.irfft(every, n, axis=-1))


@dataclass(frozen=True, eq=False)
class TimeScores:
    """Scores of each channel.

    Attributes
    ----------
    error : (n_channels,)
        ``‖predicted - measured‖ / ‖measured‖``; NaN where nothing was measured.
    correlation : (n_channels,)
        Of the two records about their means, -1 to 1; NaN where one does not move.
    measured_peaks, predicted_peaks : (n_channels,)
        Largest magnitudes, in the unit of the records.
    """

    error: Array
    correlation: Array
    measured_peaks: Array
    predicted_peaks: Array


def time_scores(measured: ArrayLike, predicted: ArrayLike) -> TimeScores:
    """Compare predicted records with measured ones, channel by channel.

    Parameters
    ----------
    measured, predicted : array_like, shape (n_channels, n_samples)
        Such as absolute accelerations, the second from `Structure.simulate`; of any length. One channel may be given
        without its axis.

    Returns
    -------
    TimeScores

    Raises
    ------
    InputError
        Where the shapes differ, or there is no sample.

    Notes
    -----
    Absolute accelerations of a stiff structure are near those of the base whatever the model: subtract the rigid-body
    motion ``G base`` from both to judge the structure alone.

    Examples
    --------
    >>> scores = time_scores([[0.0, 2.0, 0.0, -2.0]], [[0.0, 1.0, 0.0, -1.0]])
    >>> float(scores.error[0]), round(float(scores.correlation[0]), 6), float(scores.predicted_peaks[0])
    (0.5, 1.0, 1.0)
    """
    records = [np.atleast_2d(finite_array("measured", measured)), np.atleast_2d(finite_array("predicted", predicted))]
    a, b = records
    if a.shape != b.shape or a.ndim != 2 or a.size == 0:
        raise InputError(
            f"measured is {a.shape} and predicted {b.shape}; both must be (n_channels, n_samples), not empty"
        )
    moving, following = (record - record.mean(axis=1, keepdims=True) for record in records)
    product = np.linalg.norm(moving, axis=1) * np.linalg.norm(following, axis=1)
    return TimeScores(
        error=_ratio(np.linalg.norm(b - a, axis=1), np.linalg.norm(a, axis=1)),
        correlation=_ratio(np.einsum("ci,ci->c", moving, following), product),
        measured_peaks=np.abs(a).max(axis=1),
        predicted_peaks=np.abs(b).max(axis=1),
    )


def _ratio(numerator: Array, denominator: Array) -> Array:
    """Quotients; NaN where the denominator is zero."""
    return np.divide(numerator, denominator, out=np.full_like(denominator, np.nan), where=denominator > 0)
