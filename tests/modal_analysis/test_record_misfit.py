"""Whole records that a modal model misses by more than white noise: spurious modes, and deviations by blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import sysid
from sysid.modal_analysis.fit import estimate
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.model_order import with_further_modes, without_spurious_modes
from sysid.modal_analysis.record_fit import RecordFit, record_modes, refitted
from sysid.modal_analysis.residual_tests import line_blocks, scatter_over_blocks
from sysid.structure.structure import Array

RATE, SAMPLES, FINE, STEADY = 50.0, 3000, 8, 30.0  # Hz, of records; samples; finer steps; s of a steady sine
FREQUENCIES, RATIOS = np.array([3.1, 7.3]), np.array([0.01, 0.012])
SHAPES, PARTICIPATIONS, DRIVEN = np.array([[0.5, 0.8], [0.9, -0.6]]), np.array([1.2, 0.5]), 5.02  # Hz


def _records(rng: np.random.Generator, missed: float) -> tuple[Array, Array]:
    """Base and two floors under random motion and half a minute of a sine; to it, floors answer by more than modes do.

    Exact for a base that is linear between fine steps: ``z' = pole z + load``, the modal displacement ``Im z / w_d``.
    """
    time = np.arange(SAMPLES * FINE) / (RATE * FINE)
    base = scipy.signal.resample(0.3 * rng.standard_normal(SAMPLES), SAMPLES * FINE)
    base += np.where(time < STEADY, np.sin(2 * np.pi * DRIVEN * time), 0.0)
    moved = []
    for f, ratio, participation in zip(FREQUENCIES, RATIOS, PARTICIPATIONS, strict=True):
        pole = 2 * np.pi * f * (-ratio + 1j * np.sqrt(1 - ratio**2))
        load, x = -participation * base, pole / (RATE * FINE)
        first, second = np.expm1(x) / x, (np.expm1(x) - x) / x**2
        steps = ((first - second) * load[:-1] + second * load[1:]) / (RATE * FINE)
        z = np.append(0.0, scipy.signal.lfilter([1.0], [1.0, -np.exp(x)], steps))
        moved.append((pole**2 * z).imag / pole.imag + load)
    relative = SHAPES @ np.array(moved)[:, ::FINE]
    base, time = base[::FINE], time[::FINE]
    sine = np.where((time > 3) & (time < STEADY), np.sin(2 * np.pi * DRIVEN * time + 0.7), 0.0)
    error = missed * np.std(relative) * np.outer([1.0, -0.7], sine)
    noise = 0.01 * rng.standard_normal((3, SAMPLES))
    return base[None] + noise[:1], relative + base + error + noise[1:]


def _measured(base: Array, response: Array, level: float | None = None) -> sysid.Measurement:
    noise = None if level is None else sysid.NoiseLevels(np.full(2, level), np.full(1, level))
    return sysid.Measurement.from_time(
        [(base, response, None)], RATE, rigid_body=np.ones((2, 1)), band=(1.0, 10.0), noise=noise
    )


def _fitted(base: Array, response: Array, level: float | None = None) -> RecordFit:
    test = _measured(base, response, level)
    fit = record_modes(test, 2 * np.pi * FREQUENCIES, RATIOS)
    return refitted(fit, fit.parameters)


def test_what_modes_miss_of_a_steady_sine_is_no_mode() -> None:
    fit = _fitted(*_records(np.random.default_rng(0), missed=0.05))
    more = with_further_modes(fit, monitor=FitMonitor())
    assert more.parameters.modes.omega.size > 2
    found = np.sort(without_spurious_modes(more).parameters.modes.omega) / (2 * np.pi)
    assert found == pytest.approx(FREQUENCIES, rel=3e-3)


def test_where_noise_alone_is_left_every_mode_stays() -> None:
    fit = _fitted(*_records(np.random.default_rng(1), missed=0.0))
    assert without_spurious_modes(fit) is fit


def _uneven(seed: int) -> tuple[Array, Array]:
    """Records with noise five times as large about the second mode."""
    rng = np.random.default_rng(seed)
    base, response = _records(rng, missed=0.0)
    band = scipy.signal.butter(4, [6.3, 8.3], "bandpass", fs=RATE, output="sos")
    return base, response + scipy.signal.sosfilt(band, 0.05 * rng.standard_normal(response.shape), axis=1)


def _of_logarithms(fit: RecordFit, scatter: Array | None = None) -> Array:
    """Variances of the logarithms of frequencies and damping ratios, from the information and, if given, a scatter."""
    A, index = fit.information(), fit.model.index
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    inverse = np.linalg.pinv(A / np.outer(size, size), rcond=1e-11, hermitian=True) / np.outer(size, size)
    covariance = inverse if scatter is None else inverse @ scatter @ inverse
    return np.diag(covariance)[np.r_[index.log_omega, index.log_ratios]] / 2


def test_scatter_over_blocks_is_the_information_where_noise_alone_is_left() -> None:
    """On average over draws of white noise; blocks hold up to nine tenths of what tells a mode."""
    fits = [_fitted(*_records(np.random.default_rng(seed), missed=0.0)) for seed in range(16)]
    ratios = [_of_logarithms(fit, scatter_over_blocks(fit)) / _of_logarithms(fit) for fit in fits]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.25)  # four deviations of the mean


def test_stated_deviations_are_those_of_refits_without_a_block() -> None:
    """The jackknife refits all lines but those of a block.

    What it is too wide by, where noise is white, is taken off: without a block an estimate moves by the difference of
    both variances.
    """
    fit = _fitted(*_uneven(2))
    found = estimate(fit)
    assert found.scatter is not None
    variances, plain = [], []
    for shift in (0.0, 0.25, 0.5, 0.75):
        left, wide = [], []
        for block in line_blocks(fit.model.runs[0], fit, shift):
            part = replace(fit, test=fit.test.at(np.delete(np.arange(fit.test.freq.size), block)))
            part = replace(refitted(part, fit.parameters), levels=fit.levels)
            left.append(np.log(np.concatenate([part.parameters.modes.omega, part.parameters.modes.ratios])))
            wide.append(_of_logarithms(part) / _of_logarithms(fit) - 1)
        variances.append(np.var(left, axis=0) * (len(left) - 1))
        plain.append(np.sum(wide, axis=0))
    assert np.sqrt(_of_logarithms(fit, found.scatter)) == pytest.approx(
        np.sqrt(np.mean(variances, axis=0) / np.mean(plain, axis=0)), rel=0.2
    )


def test_levels_stated_too_low_are_no_reason_for_a_scatter_over_blocks() -> None:
    records = _records(np.random.default_rng(1), missed=0.0)
    for level in (0.01, 0.004):
        assert estimate(_fitted(*records, level)).scatter is None


def test_a_scatter_over_blocks_holds_the_misfit_whatever_levels_were_stated() -> None:
    """Levels are but weights there: of one common factor deviations do not depend."""
    stated = []
    for level in (0.01, 0.004):
        result = sysid.identify(sysid.Problem(_measured(*_uneven(2), level), mass=sysid.FullMass()), rng=0)
        assert result.modal[0] is not None
        assert result.modal[0].scatter is not None
        stated.append(result.uncertainty.natural_frequencies)
    assert stated[1] == pytest.approx(stated[0], rel=0.02)


def test_the_sum_of_squares_is_at_the_levels_found_where_the_fit_does_not_come_to_its_end() -> None:
    rough = record_modes(
        _measured(*_records(np.random.default_rng(1), missed=0.0)), 2 * np.pi * 1.05 * FREQUENCIES, RATIOS
    )
    assert not rough.settled
    assert rough.chi2 == pytest.approx(rough.model.chi2(rough.parameters, rough.levels), rel=1e-9)
