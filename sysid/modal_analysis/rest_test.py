"""Runs that are stated to begin and end at rest, and whose records show that they did not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from sysid.modal_analysis.record_fit import RecordFit, half_inverse, refitted, unit_diagonal
from sysid.modal_analysis.record_model import Parameters, RecordModel
from sysid.modal_analysis.record_spread import uneven
from sysid.structure.structure import Array
from sysid.structure.thresholds import FALSE_ALARM, ROUND_OFF


def runs_in_motion(fit: RecordFit) -> tuple[int, ...]:
    """Runs stated to be at rest at both ends whose transients the records show, by a score test (Rao 1948).

    Where the fit with these transients still leaves more than noise about the peaks, the model is wrong and no run is
    accused. Where the fit was stopped none is looked for.
    """
    if fit.stopped:
        return ()
    assert fit.test.whole is not None
    stated = [run for run, rest in enumerate(fit.test.whole.at_rest) if rest]
    found = []
    for run in stated:
        moving, p = _moving(fit, (run,))
        chi2, freedom = _score(moving, p)
        if scipy.special.chdtrc(freedom, chi2) < FALSE_ALARM / len(stated):
            found.append(run)
    if not found:
        return ()
    again = refitted(*_moving(fit, tuple(found)))
    return () if uneven(again) else tuple(found)


def _moving(fit: RecordFit, runs: tuple[int, ...]) -> tuple[RecordFit, Parameters]:
    """The fit with some runs in motion, not yet fitted, and its parameters, where their transients are zero."""
    whole, p = fit.test.whole, fit.parameters
    assert whole is not None
    other = replace(whole, at_rest=tuple(rest and run not in runs for run, rest in enumerate(whole.at_rest)))
    ends: Array = np.zeros((len(p.ends), 2 * len(other.moving)))
    for at, run in enumerate(other.moving):
        if run in whole.moving:
            was = 2 * whole.moving.index(run)
            ends[:, 2 * at : 2 * at + 2] = p.ends[:, was : was + 2]
    return replace(fit, test=replace(fit.test, whole=other)), replace(p, ends=ends)


def _score(fit: RecordFit, p: Parameters) -> tuple[float, int]:
    """Chi-squared of all that the unknowns could still explain, and its degrees of freedom beyond those of the fit."""
    model = RecordModel(fit.test, p.modes.omega.size)
    equations = model.normal_equations(p, fit.levels)
    N, size = unit_diagonal(equations.normal)
    gradient = equations.gradient / size
    added = np.zeros(model.size, bool)
    ends = np.zeros(p.ends.shape, bool)
    ends[:, np.all(p.ends == 0, axis=0)] = True
    added[model.kept : model.kept + model.n_ends] = ends.ravel()
    half = half_inverse(N[np.ix_(~added, ~added)], ROUND_OFF)
    across = half.T @ N[np.ix_(~added, added)]
    left = gradient[added] - across.T @ (half.T @ gradient[~added])
    lam, V = np.linalg.eigh(N[np.ix_(added, added)] - across.T @ across)
    seen = lam > ROUND_OFF
    # The score has half the normal matrix for its covariance.
    return float(2 * np.sum((V[:, seen].T @ left) ** 2 / lam[seen])), int(np.count_nonzero(seen))
