"""Plain spectra whose errors grow with the signal, as of a stepped sine whose channels are read to a share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import SteadyLines
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import Parameters
from sysid.modal_analysis.noise_levels import interpolation_matrix, likeliest_levels, likeliest_profile, plain_levels
from sysid.modal_analysis.record_fit import RecordFit, refitted
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.residual_tests import scatter
from sysid.modal_analysis.residues import linear_residues
from sysid.modal_analysis.response import gains
from sysid.modal_analysis.vector_fitting import Poles
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import beyond_chance


def may_grow(test: Measurement, least: int = 32) -> bool:
    """True for plain spectra of which no noise is stated and no window is known, of so many lines at least."""
    stated = test.response_std is not None or test.force_std is not None
    return test.freq.size >= least and bool(np.all(test.own_lines)) and not (test.averaged or stated)


def errors_grow(test: Measurement, poles: Poles, much: float = 5.0, least: float = 2e-5) -> bool:
    """True where what free residues at the poles leave grows with what the sensors record, beyond chance.

    By ranks (Spearman 1904), which outliers do not sway: of independent errors of one size the correlations of all
    sensors and runs have a mean of zero, and about `much` deviations tell that they grow. What leaves less than `least`
    of the motion is exact.
    """
    residues, left = linear_residues(test, poles.omega, poles.ratios)
    if left < least:
        return False
    motion = np.einsum("knd,kf,rdf->rnf", residues, gains(test.freq, poles.omega, poles.ratios), test.base)
    errors = test.relative - motion
    ranks = [_ranks(one) for one in (errors, test.response - errors)]
    along = np.mean(ranks[0] * ranks[1], axis=-1) * np.sqrt(test.freq.size - 1)
    return bool(np.sum(along) > much * np.sqrt(along.size))


def with_profile(fit: RecordFit, monitor: FitMonitor, rounds: int = 4, most: float = 0.03) -> RecordFit:
    """The fit with noise that varies over the lines, alike in all channels; as it is where that is no likelier.

    It is smooth in the root of frequency, but for a share of the lines, `most` at most, that stand out beyond chance in
    all runs together, as about the frequency of the mains.
    """
    freq, p = fit.test.freq, fit.parameters
    lines, shape = freq.size, interpolation_matrix(freq, *freq[[0, -1]])
    numbers, trial, beside = 2 * fit.model.channels * fit.test.n_runs, fit, np.zeros(lines)
    for _ in range(rounds):
        trial = _at_profile(trial, likeliest_profile(trial.model, p, trial.levels, shape, beside))
        power = np.zeros(lines)
        for chunk in trial.model.chunks(p):
            power[chunk.run.among(fit.test.freq)] += 2 * chunk.weighed(trial.levels).power
        size = np.log(np.maximum(power, 1.0) / numbers) + beside
        out = (size >= np.sort(size)[-int(np.ceil(most * lines))]) & (power > beyond_chance(numbers, lines))
        beside = np.where(out | (beside > 0), np.maximum(size, 0.0), 0.0)
    monitor.doing = "noise that varies over the lines"
    trial = refitted(trial, p, monitor=monitor)
    price = (shape.shape[1] - 1 + np.count_nonzero(beside)) * np.log(fit.model.numbers) / 2
    return trial if trial.settled and trial.schwarz - fit.schwarz > price else fit


def _at_profile(fit: RecordFit, logarithm: Array) -> RecordFit:
    """The fit with this profile of the noise, and the levels that are likeliest beside it, the modes as they are."""
    assert isinstance(fit.test.whole, SteadyLines)
    fit = replace(fit, test=replace(fit.test, whole=replace(fit.test.whole, profile=np.exp(logarithm))))
    return replace(fit, levels=likeliest_levels(fit.model, fit.parameters, fit.levels))


def scatter_of_lines(test: Measurement, modes: Modes, rigid: Array, most: int = 1000) -> tuple[Array, Array] | None:
    """Information and scatter of modes fitted to plain spectra, (p, p) each, where what is left is no white noise.

    Over the unknowns of `Index`, as `residual_tests.scatter` has them of whole records, of squares in which all
    sensors weigh alike; None where what is left may be white, or noise is stated. Of `most` entries of shapes at most,
    as more take long.
    """
    if not may_grow(test) or modes.phi.size > most:
        return None
    whole = replace(SteadyLines.of(test.n_runs, test.freq, grows=False), plain=True)
    m, channels = modes.omega.size, test.outputs.shape[1]
    p = Parameters(modes, rigid, np.zeros((m, 0)), np.zeros((test.n_runs, channels, 0)))
    model = RecordModel(replace(test, whole=whole), m)
    if model.numbers <= model.unknowns:
        return None
    levels = plain_levels(model, p)
    fit = RecordFit(model.test, p, levels, model.chi2(p, levels), settled=True)
    found = scatter(fit)
    return None if found is None else (fit.information(), found)


def _ranks(records: ComplexArray) -> Array:
    """Ranks of moduli over the lines, (..., L), of mean zero and variance one."""
    ranks = np.argsort(np.argsort(np.abs(records), axis=-1), axis=-1)
    centred = ranks - ranks.mean(axis=-1, keepdims=True)
    return np.asarray(centred / np.sqrt(np.mean(centred**2, axis=-1, keepdims=True)))
