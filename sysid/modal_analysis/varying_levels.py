"""Levels of noise that vary smoothly over the lines, where what a fit of whole records leaves asks for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_estimate import VaryingLevel
from sysid.modal_analysis.noise_levels import NO_NOISE, level_deviations, likeliest_levels
from sysid.modal_analysis.record_fit import RecordFit, refitted
from sysid.modal_analysis.whiteness_test import excess_of

_UNTOLD = 0.5  # standard deviation of a level's logarithm, beyond which the records do not determine it


def with_varying_levels(fit: RecordFit, *, monitor: FitMonitor | None = None) -> RecordFit:
    """The fit with levels that vary, for the channels where the noise is not white; as it is where none is.

    Also as it is where smooth levels do not explain what is left, which is the error of a model, at its peaks, or hum:
    the levels are tried beside the modes as they are, and only then fitted with them.
    """
    assert fit.test.whole is not None
    if fit.test.whole.noise is not None:
        return fit
    found, trial = excess_of(fit), fit
    varying = np.zeros((fit.test.n_runs, fit.levels.shape[1]), bool)
    while found:
        before = varying.copy()
        varying[[one.run for one in found], [one.channel for one in found]] = True
        if np.array_equal(varying, before):
            return fit
        trial = _levels_alone(fit, varying.copy())
        found = excess_of(trial)
    if trial is fit:
        return fit
    trial = refitted(trial, fit.parameters, monitor=monitor)
    return fit if excess_of(trial) or trial.schwarz < fit.schwarz else trial


def _levels_alone(fit: RecordFit, varying: NDArray[np.bool_]) -> RecordFit:
    """The fit with some levels that vary, and the modes as they are."""
    assert fit.test.whole is not None
    trial = replace(fit, test=replace(fit.test, whole=replace(fit.test.whole, varying=varying)))
    levels = fit.levels_of_runs[[run.number for run in trial.model.runs]]
    return replace(trial, levels=likeliest_levels(trial.model, fit.parameters, levels, fit.model.unknowns))


def varying_levels(fit: RecordFit) -> tuple[VaryingLevel, ...]:
    """Channels whose level varies, and between what deviations of a sample."""
    varying = fit.model.whole.varying
    if varying is None:
        return ()
    found = []
    for number, channel in np.argwhere(varying):
        rows = [run.piece for run in fit.model.runs if run.number == number]
        std = np.sqrt(fit.levels[rows, channel])
        found.append(VaryingLevel(int(channel), int(number), float(std.min()), float(std.max())))
    return tuple(found)


def unidentifiable_levels(fit: RecordFit) -> tuple[tuple[int, int], ...]:
    """Run and channel of levels that were found and that the records do not determine; none where there is no noise."""
    assert fit.test.whole is not None
    outputs = fit.test.response if fit.test.force is None else np.concatenate([fit.test.response, fit.test.force], 1)
    power = np.sum(np.abs(np.concatenate([outputs, fit.test.base], axis=1)) ** 2, axis=2)
    rms = np.sqrt(power / (fit.test.own_lines.sum(axis=1) * fit.test.whole.density)[:, None])
    if fit.test.whole.noise is not None or np.all(np.sqrt(fit.levels_of_runs) <= NO_NOISE * rms):
        return ()
    wide = level_deviations(fit.model, fit.parameters, fit.levels) > _UNTOLD
    return tuple((int(run), int(channel)) for run, channel in np.argwhere(wide))
