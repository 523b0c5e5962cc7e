"""Records in time of what the lines of a test hold: band-passed, each run on samples of its own."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.fft import next_fast_len

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels, WholeRecords
from sysid.structure.structure import Array, ComplexArray

_SAMPLES = 2.5  # a period of the highest line, where the sample rate is not known
_EVEN = 1e-6  # of their distance, by which lines of whole records are evenly spaced
_BLOCKS = 32  # of a run, of which the quietest tell its noise ..
_LINES = 32  # .. with so many lines to a block at least
_QUIET = 0.1


class RunInTime(NamedTuple):
    """Records of a run at `rate` Hz, and how many lines they hold.

    Base (d, n), absolute responses (n_sensors, n), and force (d, n) where it was measured.
    """

    base: Array
    response: Array
    force: Array | None
    rate: float
    lines: int


def in_time(test: Measurement) -> list[RunInTime]:
    """The records of each run; none where the spectra are not those of whole records.

    Parameters
    ----------
    test : Measurement
        As ``from_time`` gives it with the estimators "records" and "spectra".
    """
    whole = as_whole(test).whole
    if whole is None:
        return []
    rate, samples, made = whole.sample_rate, whole.samples, []
    for run, (own, n) in enumerate(zip(test.own_lines, samples, strict=True)):
        at = np.round(test.freq[own] * n / rate).astype(int)
        base, response, force = (
            None if record is None else _of_lines(record[run][:, own] * rate, at, n)
            for record in (test.base, test.response, test.force)
        )
        assert base is not None and response is not None
        made.append(RunInTime(base, response, force, rate, at.size))
    return made


def peaks(test: Measurement) -> list[float]:
    """Largest accelerations of a sensor against the base in each run, m/s²."""
    return [float(np.abs(run.response - test.rigid_body @ run.base).max()) for run in in_time(test)]


def quiet_levels(test: Measurement) -> NoiseLevels | None:
    """What the quietest parts of each run hold, as levels of noise, (runs, channels) each.

    Noise is no larger, and as large where all was at rest for a while. None where spectra are not those of whole
    records, or lines are too few.
    """
    runs = in_time(test)
    if not runs or min(run.lines for run in runs) < 2 * _LINES:
        return None
    response = np.array([_quietest(run, run.response) for run in runs])
    base = np.array([_quietest(run, run.base) for run in runs])
    forces = [_quietest(run, run.force) for run in runs if run.force is not None]
    return NoiseLevels(response, base, np.array(forces) if forces else None)


def _quietest(run: RunInTime, records: Array) -> Array:
    """Deviations of a sample of white noise up to half the rate that holds as much, (channels,)."""
    blocks = np.array_split(records**2, min(_BLOCKS, run.lines // _LINES), axis=1)
    power = np.quantile([block.mean(axis=1) for block in blocks], _QUIET, axis=0)
    return np.asarray(np.sqrt(power * records.shape[1] / (2 * run.lines)))


def as_whole(test: Measurement) -> Measurement:
    """Spectra as those of whole records cut in motion; as they are where their lines cannot be such."""
    if test.whole is not None or test.averaged or test.has_unit_runs or test.freq.size < 2:
        return test
    spacing = float(np.min(np.diff(test.freq)))
    multiple = test.freq / spacing
    if np.any(np.abs(multiple - np.round(multiple)) > _EVEN * multiple[-1]):
        return test
    n, runs = int(next_fast_len(int(np.ceil(_SAMPLES * multiple[-1])))), test.n_runs
    return replace(test, whole=WholeRecords((n,) * runs, n * spacing, (False,) * runs))


def _of_lines(lines: ComplexArray, at: Array, n: int) -> Array:
    """Records (channels, n) of some lines of their discrete Fourier transforms, zero at the others."""
    every = np.zeros((len(lines), n // 2 + 1), complex)
    every[:, at] = lines
    return np.asarray(np.fft.irfft(every, n, axis=-1))
