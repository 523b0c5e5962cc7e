"""Fit of modes to plain spectra: participations, poles and rigid-body mass, the shapes eliminated."""

from __future__ import annotations

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.least_squares import LeastSquares, minimise
from sysid.modal_analysis.modal_fit import ModalFit, Modes, gauge_of, poles_of
from sysid.modal_analysis.modal_model import Parameters
from sysid.modal_analysis.spectra_model import SpectraModel, weights_at
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor
from sysid.structure.structure import Array

_SETTLED = 1e-12  # of the sum of squares: a fall that is promised, at which the fit stands still
_EXACT = 1e-26  # of the records' sum of squares: the same where nothing is left


def fit_spectra(
    test: Measurement, first: Modes, rigid: Array, *, monitor: IterationMonitor, max_iterations: int
) -> ModalFit:
    """Modes with the least weighted squared error of accelerations and, where it was measured, base force.

    The rigid-body mass is as free as the records have it: what no mode carries may come out as a negative mass.

    Parameters
    ----------
    test : Measurement
    first : Modes
        Where to start; shapes are not read. Modes whose poles are equal keep one pole.
    rigid : (d, d)
        Rigid-body mass to start with; read where a force was measured.
    """
    poles, pole = poles_of(first)
    weights = weights_at(test, first.omega[poles], first.ratios[poles])
    model = SpectraModel(test, weights, pole)
    unit = np.sqrt(np.maximum(np.mean(first.gamma**2, axis=0), np.finfo(float).tiny))
    gauge, held = gauge_of(first, unit, test.force is not None)
    first = first._replace(gamma=gauge * unit)
    model.hold(first.gamma, held)

    def tell(_: int, p: Parameters, chi2: float) -> bool:
        return monitor.record(model.pack(p), OBJECTIVE_SCALE * chi2)

    def chi2_of(p: Parameters) -> float:
        good = np.all(np.isfinite(p.modes.omega)) and np.all(p.modes.ratios < 1.0)
        value = model.chi2(p, model.levels) if good else np.inf
        return value if np.isfinite(value) else np.inf

    problem = LeastSquares(
        model.pack(model.with_best_shapes(first, rigid)), model.unpack, chi2_of,
        lambda p: model.normal_equations(p, model.levels),
    )  # fmt: skip
    p, chi2, settled = minimise(problem, tell, max_iterations, lambda chi2: max(_SETTLED * chi2, _EXACT))
    status = "settled" if settled else "stopped" if monitor.stopped is not None else "not settled"
    of_accelerations = np.sqrt(model.chi2(p, model.levels_of_accelerations))
    return ModalFit(p.modes, p.rigid, float(np.sqrt(chi2)), float(of_accelerations), status, "", weights)
