"""Levels of noise that vary smoothly over the lines, where what a fit of whole records leaves asks for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.whole import VaryingLevel
from sysid.modal_analysis.record_fit import Monitor, RecordFit, refitted
from sysid.modal_analysis.record_whiteness import excess_of

_ROUNDS = 3  # in each of which the channels that still stand out are joined to those whose level varies


def with_varying_levels(fit: RecordFit, *, monitor: Monitor | None = None) -> RecordFit:
    """The fit with levels that vary, for the channels where the noise is not white; as it is where none is.

    Also as it is where smooth levels do not explain what is left: that is the error of a model, at its peaks, or hum.
    """
    assert fit.test.whole is not None
    if fit.test.whole.noise is not None:
        return fit
    found = excess_of(fit)
    trial, varying = fit, np.zeros((fit.test.n_runs, fit.levels.shape[1]), bool)
    for _ in range(_ROUNDS):
        if not found:
            return trial if trial.schwarz > fit.schwarz else fit
        before = varying.copy()
        varying[[one.run for one in found], [one.channel for one in found]] = True
        if np.array_equal(varying, before):
            return fit
        test = replace(fit.test, whole=replace(fit.test.whole, varying=varying.copy()))
        start = replace(fit, test=test)
        rows = [run.number for run in start.model.runs]
        trial = refitted(replace(start, levels=fit.levels_of_runs[rows]), fit.parameters, monitor=monitor)
        found = excess_of(trial)
    return fit


def varying_levels(fit: RecordFit) -> tuple[VaryingLevel, ...]:
    """Channels whose level varies, and between what deviations of a sample."""
    varying = fit.model.whole.varying
    if varying is None:
        return ()
    made = []
    for number, channel in np.argwhere(varying):
        rows = [run.piece for run in fit.model.runs if run.number == number]
        own = np.sqrt(fit.levels[rows, channel])
        made.append(VaryingLevel(int(channel), int(number), float(own.min()), float(own.max())))
    return tuple(made)
