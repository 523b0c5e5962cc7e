"""Where fitted modes end: through IPOPT within the bounds of damping ratios, and with stated totals held."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import SolverError
from sysid.modal_analysis.modal_fit import ModalFit, separate_poles
from sysid.models.spectrum import SOLVED
from sysid.models.unknowns import lower_of, upper_of
from sysid.nlp import IterationMonitor, NonlinearProgram
from sysid.problem.prepared import Prepared
from sysid.search.modal_program import Spectrum, Ties, solve_modes
from sysid.search.modal_scaling import stated_totals
from sysid.search.strategy import DoesNotApplyError
from sysid.structure.structure import Array
from sysid.structure.thresholds import AS_GOOD, EXACT

Integers = NDArray[np.intp]

_AGREES = 0.01  # relative; a stated total that the base force weighs within this is held in the fit


def held_to_totals(problem: Prepared, end: ModalFit, monitor: IterationMonitor, max_iterations: int) -> ModalFit | None:
    """The same fit with stated totals held, where what the base force weighs agrees with them; else None."""
    ties, modes = stated_totals(problem), end.modes
    if ties is None or monitor.is_over:
        return None
    off = ca.vertcat(*ties(ca.DM(modes.phi), ca.DM(modes.gamma), ca.DM(end.rigid)))
    if np.any(np.abs(np.asarray(off)) > _AGREES):
        return None
    held = _again(problem, end, monitor, max_iterations, ties)
    agrees = held.residual <= AS_GOOD * end.residual + EXACT
    return held if agrees and held.status in SOLVED else None


def ended(problem: Prepared, estimate: ModalFit, monitor: IterationMonitor, max_iterations: int) -> ModalFit:
    """Where IPOPT ends from an estimate, with damping ratios within their bounds and no negative mass.

    The estimate itself where nobody wants to wait for it.

    Raises
    ------
    DoesNotApplyError
        Where modes move so much alike that no shapes can be told apart.
    """
    within = _within_bounds(problem, estimate)
    if monitor.is_over or monitor.stopped is not None:
        return estimate
    try:
        # Bounds that nothing presses on would cost iterations, as IPOPT begins away from them.
        end = _again(problem, estimate, monitor, max_iterations, bounded=False) if within else estimate
        return end if within and _within_bounds(problem, end) else _again(problem, end, monitor, max_iterations)
    except SolverError as error:
        raise DoesNotApplyError(f"{error}: use fewer modes, Modal(modes=), or narrow the band") from None


def _within_bounds(problem: Prepared, end: ModalFit) -> bool:
    """True where all damping ratios are within the problem's bounds."""
    low, high = damping_bounds(problem)
    return bool(np.all((end.modes.ratios >= low) & (end.modes.ratios <= high)))


def damping_bounds(problem: Prepared) -> tuple[float, float]:
    """Bounds of the free damping ratios of a problem, those of all modes alike."""
    unknowns = problem.formulation.of_models[2]
    return float(lower_of(unknowns).min()), float(upper_of(unknowns).max())


def _again(
    problem: Prepared, end: ModalFit, monitor: IterationMonitor, max_iterations: int, ties: Ties | None = None,
    *, bounded: bool = True,
) -> ModalFit:  # fmt: skip
    """A fit from where another ended, with ties, and damping ratios within the problem's bounds."""
    modes = end.modes
    first, pole = separate_poles(modes)
    unit, bounds = np.sqrt(problem.totals), damping_bounds(problem) if bounded else (0.0, np.inf)
    return solve_modes(
        problem.modal[0], modes, _free_spectrum(modes.omega[first], modes.ratios[first], pole, *bounds), unit=unit,
        remainder=end.rigid - modes.gamma.T @ modes.gamma, ties=ties, weights=end.weights, monitor=monitor,
        max_iterations=max_iterations,
    )  # fmt: skip


def _free_spectrum(omega: Array, ratios: Array, pole: Integers, lower: float = 0.0, upper: float = np.inf) -> Spectrum:
    """Frequencies without bounds and damping ratios, of each pole; modes of one pole share them."""

    def spectrum(z: NonlinearProgram) -> tuple[ca.MX, ca.MX]:
        # In units of the half-power half-width, which is what frequencies are known in.
        # Cut off where no step of use leads.
        shift = _within(z.variable("frequency", np.zeros(omega.size)) * ca.DM(ratios), 1.0)
        with np.errstate(divide="ignore"):
            low, high = np.log(lower / ratios), np.log(upper / ratios)
        loss = _within(z.variable("damping ratio", np.clip(np.zeros(omega.size), low, high), low, high), 10.0)
        moved, lossy = ca.DM(omega) * ca.exp(shift), ca.DM(ratios) * ca.exp(loss)
        # Entries of a scalar are a row.
        return ca.vec(moved[pole.tolist()]), ca.vec(lossy[pole.tolist()])

    return spectrum


def _within(value: ca.MX, limit: float) -> ca.MX:
    return ca.fmin(ca.fmax(value, -limit), limit)
