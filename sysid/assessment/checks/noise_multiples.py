"""By how many times its noise a model misses a record, and what quiet lines hold of noise that is not known."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.measurement.in_time import cut_in_motion, quiet_levels
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.outliers import Outlier
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, ComplexArray, Structure

BEYOND = 3.0  # times the noise, from which a model is not within it
_UNKNOWN = 0.1  # relative residual, up to which spectra without a stated noise may hold as much of it at some lines
_NEAR = 5.0  # half-power widths, or distances of lines, about a mode
_TRACE = 1e-4  # of the records; smaller ones are no noise of an instrument

_FORCE = "the base force"


class Miss(NamedTuple):
    """By how many times its noise a model misses a record; by as many at least where quiet lines tell the noise."""

    times: float
    at_least: bool
    record: str
    share: float
    """Of the record."""
    cut: bool
    """Whether it holds spectra of a record that neither begins nor ends at rest, with its transients."""

    @property
    def whose(self) -> str:
        """The pronoun of the record."""
        return "its" if self.record.startswith(_FORCE) else "their"


class JudgedRecord(NamedTuple):
    """Accelerations or base force of a test, (runs, channels, n_freq), and what a structure leaves of them."""

    name: str
    channels: tuple[str, ...]
    measured: ComplexArray
    left: ComplexArray
    variance: Array | None
    """Of the noise at each line; None where it is neither stated nor found."""


def misses_of(problem: Prepared, structure: Structure, x: Array | None) -> list[Miss]:
    """Misfit of the structure to accelerations and base force of each test that is fitted.

    Records whose noise is neither stated nor to be found are left out; numbers that stand alone are not counted.

    Parameters
    ----------
    problem : Prepared
    structure : Structure
    x : (n_variables,) or None
        The unknowns that stand for it.
    """
    misses = list(_misses(problem, structure, x, []))
    if problem.stated.loss == "squares" and any(miss.times > BEYOND for miss in misses):  # spikes may be all there is
        return list(_misses(problem, structure, x, problem.outliers(structure, x)))
    return misses


def _misses(problem: Prepared, structure: Structure, x: Array | None, alone: list[Outlier]) -> Iterator[Miss]:
    fits = problem.screened.fits(structure, x)
    for i, (modal, its) in enumerate(fits, start=problem.first_test):
        of, test = "" if len(fits) == 1 else f" of test {i}", modal.records
        for record in _records(modal, its):
            for one in alone:
                if one.test == i and one.channel in record.channels:
                    at = int(np.argmin(np.abs(test.freq - one.freq)))
                    record.left[one.run - 1, record.channels.index(one.channel), at] = 0.0
            yield from _miss(record._replace(name=record.name + of), test, modal.found_noise, _near_modes(modal, its))


def _records(modal: ModalEstimate, structure: Structure) -> Iterator[JudgedRecord]:
    """Records of a test without its transients."""
    test, noise = modal.records, modal.noise
    left = test.relative - test.predict(structure)
    quiet = _quiet_base(modal)
    std = test.response_std
    if std is not None and quiet is not None and noise is not None:
        std = _bounded(modal, std, noise.response, left, quiet)
    yield JudgedRecord("the accelerations", test.sensor_names, test.relative, left, None if std is None else std**2)
    if test.force is not None:
        axes = tuple(f"force {axis}" for axis in test.base_axes or ())
        left, std = test.force - test.predict_force(structure), test.force_std
        if std is not None and quiet is not None and noise is not None and noise.force is not None:
            std = _bounded(modal, std, noise.force, left, quiet)
        yield JudgedRecord(_FORCE, axes, test.force, left, None if std is None else std**2)


def _quiet_base(modal: ModalEstimate) -> Array | None:
    """Share of the base's level that its quietest parts hold, (runs,), where levels were found; else None.

    Levels are found with modes of constant poles: what these leave at the peaks passes for noise of the base.
    """
    if modal.noise is None or not modal.found_noise or modal.varying:
        return None
    quiet = quiet_levels(modal.given)
    return None if quiet is None else np.minimum(quiet.base / modal.noise.base, 1.0).max(axis=1)


def _bounded(modal: ModalEstimate, std: Array, level: Array, left: ComplexArray, passed: Array) -> Array:
    """Deviations (runs, channels, n_freq) of which a channel's own is at most what quiet lines hold of what is left.

    Hum and error of a model raise the level that was found. Of the base's share of the noise, `passed` is left, or less
    where quiet lines hold less.
    """
    test = modal.records
    of_channel = np.minimum(std**2, (modal.density[:, None] * np.broadcast_to(level, std.shape[:2]) ** 2)[..., None])
    base, share = std**2 - of_channel, passed**2
    quiet = _quiet(left, np.ones(left.shape), test.own_lines)
    if quiet is not None:
        of_base = _quiet(left, np.maximum(base, np.finfo(float).tiny), test.own_lines)
        share = np.minimum(share, np.asarray(of_base).min(axis=1))
        of_channel = np.minimum(of_channel, quiet[..., None])
    return np.asarray(np.sqrt(of_channel + share[:, None, None] * base))


def _near_modes(modal: ModalEstimate, structure: Structure) -> NDArray[np.bool_]:
    """Lines near a mode of a structure or of its records, (n_freq,)."""
    test = modal.records
    f = np.concatenate([structure.natural_frequencies, modal.omega / (2 * np.pi)])
    ratio = np.concatenate([structure.damping_ratios, modal.ratios])
    reach = np.maximum(2 * _NEAR * ratio * f, _NEAR * np.median(np.diff(test.freq))) if test.freq.size > 1 else np.inf
    return np.asarray(np.any(np.abs(test.freq - f[:, None]) < np.broadcast_to(reach, f.shape)[:, None], axis=0))


def _miss(record: JudgedRecord, test: Measurement, found: bool, near: NDArray[np.bool_]) -> Iterator[Miss]:
    """Misfit to one record in units of its noise; `found`: with the fit, so that it holds errors of the model.

    Of noise that is not stated, what stands out far from all modes is a part, such as hum.
    """
    in_run, size, missed = test.own_lines, float(np.linalg.norm(record.measured)), float(np.linalg.norm(record.left))
    variance = np.ones(record.left.shape) if record.variance is None else record.variance
    # Noise that is not stated may be in proportion to the record.
    if record.variance is None and (test.has_unit_runs or missed < _UNKNOWN * size):
        return
    bounded = record.variance is None or found
    if bounded:
        quiet = _quiet(record.left, variance, in_run)
        if quiet is None:
            return
        variance = variance if found else variance * quiet[..., None]
    variance = variance * in_run[:, None]
    noise = float(np.sqrt(np.sum(variance)))
    left = np.abs(record.left) ** 2
    if bounded:
        left = np.where(near, left, np.minimum(left, variance))
    if noise > _TRACE * size:
        times = float(np.sqrt(np.sum(left))) / noise
        yield Miss(times, bounded, record.name, missed / size, times > BEYOND and cut_in_motion(test))


def _quiet(
    left: ComplexArray, variance: Array, in_run: NDArray[np.bool_], size: int = 16, least: int = 8, share: float = 0.25
) -> Array | None:
    """Power over the variance in the quietest `share` of blocks of lines, (runs, channels); None with few blocks."""
    out = np.ones(left.shape[:2])
    mean = float(scipy.special.gammaincinv(size, share)) / size
    for run, lines in enumerate(in_run):
        power = np.abs(left[run][:, lines]) ** 2 / variance[run][:, lines]
        blocks = power.shape[1] // size
        if blocks < least:
            return None
        held = power[:, : blocks * size].reshape(len(power), blocks, size).mean(axis=2)
        out[run] = np.minimum(np.quantile(held, share, axis=1) / mean, power.mean(axis=1))
    return out


def noise_at_most(test: Measurement, left: ComplexArray) -> Array | None:
    """Noise that is not known, at most: what a fit leaves of the quietest quarter of the lines.

    Parameters
    ----------
    test : Measurement
    left : ndarray, shape (runs, channels, n_freq)
        Measured less predicted.

    Returns
    -------
    ndarray, shape (runs, channels, 1), or None
        Standard deviations; None with few lines, and of transmissibilities, whose noise may be in proportion to them.
    """
    quiet = None if test.has_unit_runs else _quiet(left, np.ones(left.shape), test.own_lines)
    return None if quiet is None else np.asarray(np.sqrt(quiet)[..., None])


def misses_of_test(test: Measurement, structure: Structure) -> list[Miss]:
    """Misfit of a structure to a test that was not fitted."""
    modal = ModalEstimate.of_lines(test)
    near = _near_modes(modal, structure)
    return [miss for record in _records(modal, structure) for miss in _miss(record, test, False, near)]
