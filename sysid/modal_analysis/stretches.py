"""Frequencies of modes in stretches of whole records: whether they hold along a record, and from run to run.

Each run is cut into stretches, and each stretch is a whole record of its own, with transients of its own. Shapes and
participations are those of all stretches of a test together; poles are fitted to each.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.measurement import spectra
from sysid.measurement.in_time import RunInTime, runs_in_time
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import TimeRun
from sysid.measurement.whole import NoiseLevels, WholeRecords
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_model import Parameters, trace_count
from sysid.modal_analysis.record_fit import Limits, RecordFit, fit_model, record_modes
from sysid.modal_analysis.record_model import RecordModel
from sysid.structure.structure import Array

_PERIODS = 25  # of the lowest mode, that a stretch holds at least
_LEAST = 1e-3  # of the sensor that moves most: how much of the motion of one that hardly moves counts in full
_FEWEST = 8  # lines of a stretch for each mode


class HeldShapes(RecordModel):
    """The same with shapes, participations and rigid-body mass held, and with `poles` these too.

    What is left to be found are poles, transients and traces.
    """

    def __init__(
        self, test: Measurement, m: int, *, poles: bool = False, static: int = 0, coupled: bool = False
    ) -> None:
        super().__init__(test, m, static=static, coupled=coupled)
        self.held[: self.index.log_omega.start], self.held[self.index.log_ratios.stop : self.kept] = True, True
        self.held[self.coupling] = True
        self.held[self.index.log_omega.start : self.index.log_ratios.stop] |= poles

    def scales(self, p: Parameters) -> Array:
        """See `RecordModel`: with shapes held there are none."""
        return np.zeros((0, self.size))

    @property
    def unknowns(self) -> int:
        """Numbers that are not held."""
        return int(np.sum(~self.held))


class Stretch(NamedTuple):
    """Poles of m modes in a stretch of a run.

    Attributes
    ----------
    run : int
        Of the test, from 0.
    start, end : float
        s, from the beginning of the run.
    frequency, std : (m,)
        Hz, and its standard deviation, roughly, from what is left about its peak: too small by some times where a
        stretch has only a few lines there.
    ratio, ratio_std : (m,)
        Damping ratio, and its standard deviation likewise.
    level : (m,)
        Root mean square of what each mode makes of the acceleration of the sensor that it moves most, m/s² (see
        `sysid.measurement.in_time.levels_are_known`).
    left, left_by_all : float
        Norms of what is left of the accelerations with poles of its own, and with those of all stretches together.
    """

    run: int
    start: float
    end: float
    frequency: Array
    std: Array
    ratio: Array
    ratio_std: Array
    level: Array
    left: float
    left_by_all: float


class Piece(NamedTuple):
    """Records of a stretch of a run: its number, seconds at both ends."""

    number: int
    start: float
    end: float
    records: TimeRun


def stretches_of(test: Measurement, omega: Array, ratios: Array) -> list[Stretch]:
    """Poles of each stretch of the runs of a test; none where there are no two.

    Parameters
    ----------
    test : Measurement
        Spectra of whole records, as ``from_time`` gives them with the estimators "records" and "spectra".
    omega, ratios : (m,)
        Poles, rad/s and fractions, near which those of the stretches are.
    """
    runs = runs_in_time(test)
    pieces = _pieces(runs, _PERIODS * 2 * np.pi / float(omega.min()))
    if len(pieces) < 2:
        return []
    rate = runs[0].rate
    # Least squares, each sensor by its size: were levels fitted, a change would pass for noise of the base.
    moved = [run.response - test.rigid_body @ run.base for run in runs]
    size = np.sqrt(np.mean(np.concatenate(moved, axis=1) ** 2, axis=1))
    noise = NoiseLevels(np.maximum(size, _LEAST * size.max()), np.zeros(test.n_base))
    cut = _as_test(test, pieces, rate, noise)
    if cut is None or cut.own_lines.sum(axis=1).min() < _FEWEST * omega.size:
        return []
    every = record_modes(cut, omega, ratios)
    return [
        _stretch(piece, every, one) for piece in pieces if (one := _as_test(test, [piece], rate, noise)) is not None
    ]


def _stretch(piece: Piece, every: RecordFit, test: Measurement) -> Stretch:
    """Poles of one stretch, with the shapes of all."""
    fit, held = _with_poles_of(every, test), _with_poles_of(every, test, held=True)
    modes, index, model = fit.parameters.modes, fit.model.index, fit.model
    free = np.r_[index.log_omega, index.log_ratios, model.kept : model.size]
    N = fit.normal[np.ix_(free, free)]
    unit = 1 / np.sqrt(np.maximum(np.diag(N), np.finfo(float).tiny))
    m, f = modes.omega.size, modes.omega / (2 * np.pi)
    variance = (unit**2 * np.diag(np.linalg.pinv(N * np.outer(unit, unit), hermitian=True)))[: 2 * m].reshape(2, m)
    variance *= _noise_at_peaks(fit) / 2
    std = np.sqrt(np.where(variance > 0, variance, np.inf)) * [f, modes.ratios]  # inf: round-off, a mode shows nowhere
    of_poles = f, std[0], modes.ratios, std[1]
    return Stretch(piece.number, piece.start, piece.end, *of_poles, _levels(fit), _left(fit), _left(held))


def _noise_at_peaks(fit: RecordFit, about: int = 12, explained: int = 2) -> Array:
    """Noise about each mode, over the levels, (m,): that of the base is larger there than elsewhere.

    Each line counts by what it tells of the frequency of the mode: the power of the response's slope in it. The few
    lines at a peak may leave nothing beside poles and transients: what the base's noise makes there is told by lines
    `about` it too, of which a pole and transients have `explained` some, each by how much of that noise the sensors
    show; a model that errs errs at few of them.
    """
    modes, parts = fit.parameters.modes, []
    for chunk in fit.model.chunks(fit.parameters):
        slope = np.abs(chunk.g**2 * (modes.gamma @ chunk.run.base + chunk.pushed_by_ends)) ** 2
        inverse_std, _ = chunk.deviations(fit.levels)
        passed = np.sum(np.abs(chunk.H) ** 2 * (inverse_std**2)[:, None], axis=(0, 1))
        parts.append(np.vstack([chunk.run.w, chunk.weighed(fit.levels).power, passed, slope]))
    w, left, passed, *slopes = np.concatenate(parts, axis=1)
    weight = np.array(slopes) / np.maximum(np.sum(slopes, axis=1, keepdims=True), np.finfo(float).tiny)
    of_base = []
    for omega in modes.omega:
        near = np.argsort(np.abs(w - omega))[:about]
        typical = np.median(left[near] / passed[near]) / np.log(2)  # the mean of a chi-squared of two degrees
        of_base.append(typical * near.size / max(near.size - explained, 1))
    return np.maximum(weight @ left * fit.model.numbers / fit.freedom, np.array(of_base) * (weight @ passed))


def _left(fit: RecordFit) -> float:
    """Norm of what a fit leaves."""
    return float(np.linalg.norm([np.linalg.norm(chunk.error) for chunk in fit.model.chunks(fit.parameters)]))


def _levels(fit: RecordFit) -> Array:
    """Root mean squares of what modes make of the acceleration of the sensor that each moves most, (m,)."""
    modes, whole = fit.parameters.modes, fit.model.whole
    power: Array = np.zeros(modes.omega.size)
    for chunk in fit.model.chunks(fit.parameters):
        moved = chunk.g * (modes.gamma @ chunk.run.base + chunk.pushed_by_ends)
        power += np.sum(np.abs(moved) ** 2, axis=1)
    return np.asarray(np.sqrt(2 * power) * whole.sample_rate / whole.samples[0] * np.abs(modes.phi).max(axis=0))


def _pieces(runs: list[RunInTime], shortest: float, most: int = 12) -> list[Piece]:
    """Stretches of the runs of a test, each of `shortest` seconds or longer, `most` of a run."""
    pieces = []
    for number, run in enumerate(runs):
        n = run.base.shape[1]
        count = int(np.clip(n / run.rate / shortest, 1, most))
        for i in range(count):
            part = slice(i * (n // count), (i + 1) * (n // count))
            records = TimeRun(run.base[:, part], run.response[:, part], None)
            pieces.append(Piece(number, part.start / run.rate, part.stop / run.rate, records))
    return pieces


def _as_test(
    test: Measurement, pieces: list[Piece], rate: float, noise: NoiseLevels, ends: int = 2
) -> Measurement | None:
    """Stretches as the runs of a test of whole records, within the band of theirs; None where that holds no line.

    At the ends of the band some lines of theirs are left out: what lies beyond it reaches them.
    """
    freq, base, response, _ = spectra.whole_record([piece.records for piece in pieces], rate)
    samples = tuple(piece.records.base.shape[1] for piece in pieces)
    margin = ends * rate / min(samples)
    inside = (freq >= test.freq[0] + margin) & (freq <= test.freq[-1] - margin)
    if not np.any(inside):
        return None
    tones = () if test.whole is None else test.whole.tones
    whole = WholeRecords(samples, rate, (False,) * len(pieces), noise, tones=tones)
    given = (freq[inside], base[..., inside], response[..., inside])
    return Measurement(
        *given, rigid_body=test.rigid_body, base_axes=test.base_axes, sensors=test.sensors, whole=whole,
        gain_std=np.zeros(test.n_sensors),
    )  # fmt: skip


def _with_poles_of(fit: RecordFit, test: Measurement, *, held: bool = False) -> RecordFit:
    """Poles, transients and levels of a test of one run, with the shapes of a fit of others; or, `held`, its poles too.

    Poles that leave the records unexplained are not looked for far away: a few steps are taken.
    """
    m, channels = fit.parameters.modes.omega.size, fit.parameters.traces.shape[1]
    first = replace(fit.parameters, ends=np.zeros((m, 2)), traces=np.zeros((1, channels, trace_count(test))), laws=())
    model = HeldShapes(test, m, poles=held, static=fit.static, coupled=first.coupling is not None)
    return fit_model(model, first, None, FitMonitor(), Limits(1, 20))
