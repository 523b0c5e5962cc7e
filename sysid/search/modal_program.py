"""The program in modal coordinates: participations, frequencies and damping ratios through IPOPT, shapes eliminated.

Every answer in modal coordinates ends here, most of them after one to three iterations from an estimate. The residual
is symbolic, its gradient CasADi's own. Of spectra it is that of the lines; the Hessian is exact, and its products of
all lines are NumPy's (`SpectraModel`), as CasADi multiplies dense matrices many times slower. Of whole records it is
what the modes miss their estimate by, in units of its noise. A measured base force is fitted jointly; it sets the scale
of each mode.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from sysid.errors import SolverError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import (
    ModalEstimate,
    factor_of,
    index_of,
    residual_of,
    scale_in,
    theta_of,
)
from sysid.modal_analysis.modal_fit import ModalFit, Modes, Weights, held_gauge, separate_poles
from sysid.modal_analysis.response import columns, modal_gains, modal_motion, parts_of, stacked, weights_of_test
from sysid.modal_analysis.spectra_model import SpectraModel, weights_at
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor, NonlinearProgram, NumpyFunction, product
from sysid.structure.structure import Array
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, round_off
from sysid.structure.triangular import lower_triangle, triangle_entries

Spectrum = Callable[[NonlinearProgram], tuple[ca.MX, ca.MX]]
Ties = Callable[[ca.MX, ca.MX, ca.MX], list[ca.MX]]


def solve_modes(
    modal: ModalEstimate, first: Modes, spectrum: Spectrum, *, unit: Array, remainder: Array, ties: Ties | None = None,
    weights: Weights | None = None, monitor: IterationMonitor, max_iterations: int = 500,
) -> ModalFit:  # fmt: skip
    """Minimise the weighted squared error of accelerations and, where it was measured, base force.

    Parameters
    ----------
    modal : ModalEstimate
        Of the test.
    first : Modes
        Where to start; shapes are not read.
    spectrum : callable
        Adds its unknowns to the program, and gives circular frequencies and damping ratios, (m, 1) each.
    unit : (d,), kg^½ (times m for a rotation)
        Makes participations of order one.
    remainder : (d, d)
        Start of the rigid-body mass that no mode carries; positive semidefinite.
    ties : callable, optional
        Equalities between shapes, participations and rigid-body mass.
    weights : Weights, optional
        Those of an estimate that the program goes on from; else by what free residues at the first poles leave.

    Raises
    ------
    SolverError
        Where the modes' motions are linearly dependent.

    References
    ----------
    G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432; L. Kaufman, BIT 15 (1975) 49-57.
    """
    z, test = NonlinearProgram(), modal.records
    (m, d), by_lines = first.gamma.shape, not (modal.by_modes and modal.omega.size == first.omega.size)
    weighed = test.force is not None
    # The information of an estimate is of each of its modes apart.
    gauge, held = held_gauge(first if by_lines else first._replace(omega=np.arange(float(m))), unit, weighed)
    low, high = np.full((m, d), -np.inf), np.full((m, d), np.inf)
    low[held], high[held] = gauge[held], gauge[held]
    gamma = z.variable("participation", gauge, low, high) @ ca.diag(ca.DM(unit))
    omega, ratios = spectrum(z)
    rigid = gamma.T @ gamma
    if weighed:
        lam, vectors = np.linalg.eigh(remainder / np.outer(unit, unit))
        # A factor of zero has no slope.
        root = np.linalg.cholesky((vectors * np.maximum(lam, NEGLIGIBLE * max(1.0, lam[-1]))) @ vectors.T)
        factor = ca.diag(ca.DM(unit)) @ lower_triangle(z.variable("base mass", triangle_entries(root)), d)
        rigid = rigid + factor @ factor.T
    error: ModalResidual | EstimateResidual
    if by_lines:
        poles = separate_poles(first)[0]
        weights = weights_at(test, first.omega[poles], first.ratios[poles]) if weights is None else weights
        error = ModalResidual(test, weights, gamma, omega, ratios, rigid)
    else:
        error = EstimateResidual(modal, gamma, omega, ratios, rigid)
    if ties is not None:
        for tie in ties(error.phi, gamma, rigid):
            z.constrain(tie)
    best, status = z.minimize(error.value, monitor, max_iterations, error.derivatives(z))
    end = ca.Function("end", [z.z], [error.phi, gamma, omega, ratios, rigid, error.value])
    try:
        values = [np.asarray(v) for v in end(best)]
        if not all(np.all(np.isfinite(v)) for v in values):
            values = [np.asarray(v) for v in end(np.concatenate(z.start))]
    except RuntimeError:  # of CasADi: the normal equations are singular
        raise SolverError(f"{m} modes move so much alike that no shapes can be told apart") from None
    modes = Modes(values[0], values[1], values[2].ravel(), values[3].ravel())
    left, (counted, of_all, of_accelerations) = float(np.sqrt(values[5].item())), error.counted(modes, values[4])
    if abs(counted - left) > EXACT:
        status = f"{status}, but the residual {left:.6g} of its end is {counted:.6g} when counted anew"
    return ModalFit(modes, values[4], of_all, of_accelerations, status, z.on_bounds(best), weights)


class ModalResidual:
    """Weighted residual as CasADi expressions, its shapes eliminated.

    Attributes
    ----------
    phi : (n, m)
        The best shapes.
    left : (n, 2 L)
        Weighted errors of the accelerations, real parts beside imaginary ones.
    force_left : (d, 2 L), or None
    value :
        Their sum of squares.
    """

    def __init__(
        self, test: Measurement, weights: Weights, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX
    ) -> None:
        self.model = SpectraModel(test, weights, np.arange(omega.numel()))
        self.hessian = hessian_of(self.model)  # CasADi keeps no reference to it
        self.gamma, self.omega, self.ratios, self.rigid = gamma, omega, ratios, rigid
        gains = modal_gains(omega, ratios, test.freq)
        self.q = ca.horzcat(*modal_motion(test.base * weights.lines[:, None], gamma, gains))
        target = stacked(columns(test.relative * weights.sensors[:, None] * weights.lines[:, None])).T
        # Rows of very different size would spoil the solve.
        scale = ca.sqrt(ca.sum2(self.q**2))
        scaled = self.q / ca.repmat(scale, 1, self.q.size2())
        # The ridge keeps the system regular where two modes become one; it changes shapes by less than their error.
        normal = product(scaled, scaled.T) + round_off(scaled.size1()) * ca.DM.eye(scaled.size1())
        shapes = ca.solve(normal, product(scaled, ca.DM(target).T)) / ca.repmat(scale, 1, test.n_sensors)
        self.shapes = shapes.T  # of weighted sensors
        self.left = ca.DM(target) - product(self.shapes, self.q)
        self.phi = ca.diag(ca.DM(1 / weights.sensors)) @ self.shapes
        self.value = ca.sumsqr(self.left)
        self.force_left: ca.MX | None = None
        if test.force is not None and weights.force is not None:
            base = test.base * weights.force_lines[:, None]
            q = ca.horzcat(*modal_motion(base, gamma, gains)) if weights.force_lines is not weights.lines else self.q
            target = stacked(columns(test.force * weights.force[:, None] * weights.force_lines[:, None])).T
            self.force_channel, self.force_base = ca.DM(weights.force), ca.horzcat(*parts_of(base))
            self.force_left = ca.diag(self.force_channel) @ (gamma.T @ q + rigid @ self.force_base) - ca.DM(target)
            self.value += ca.sumsqr(self.force_left)

    def gradient(self, z: ca.MX) -> ca.MX:
        """Of the value by the unknowns z, CasADi's own.

        The best shapes leave no slope by themselves, so that they count as constants.
        """
        pull = ca.vec(-2 * product(self.shapes.T, self.left))
        slope = ca.jtimes(ca.vec(self.q), z, pull, True)
        if self.force_left is not None:
            slope += ca.gradient(ca.sumsqr(self.force_left), z)
        return slope

    def by_rigid(self) -> ca.MX:
        """Gradient of the value by the rigid-body mass, (d, d)."""
        if self.force_left is None:
            return ca.MX(*self.rigid.shape)
        return 2 * ca.diag(self.force_channel) @ self.force_left @ self.force_base.T

    def theta(self) -> ca.MX:
        """Argument of `hessian_of`: participations mode by mode, log w, log zeta and, with a force, the rigid mass."""
        d = self.rigid.size1()
        corner = [self.rigid[i, j] for i in range(d) for j in range(i, d)] if self.force_left is not None else []
        return ca.vertcat(ca.vec(self.gamma.T), ca.log(self.omega), ca.log(self.ratios), *corner)

    def derivatives(self, z: NonlinearProgram) -> dict[str, ca.Function]:
        """Gradient and Hessian by the unknowns of a program, in IPOPT's scale of the objective."""
        return _derivatives(z, self, self.hessian)

    def counted(self, modes: Modes, rigid: Array) -> tuple[float, float, float]:
        """Root of the value by NumPy; what is left of all records, and of the accelerations alone."""
        model = self.model
        p = model.with_best_shapes(modes, rigid)
        every, of_accelerations = (np.sqrt(model.chi2(p, at)) for at in (model.levels, model.levels_of_accelerations))
        return float(every), float(every), float(of_accelerations)


class EstimateResidual:
    """Misfit of modes to an estimate, in units of its noise and of the records, the best shapes eliminated.

    Half a chi-squared rises by ``|R (theta - estimate)|²``, with ``R' R`` the information; shapes enter it linearly.

    Attributes
    ----------
    phi : (n, m)
        The best shapes.
    value :
        The sum of squares.
    """

    def __init__(self, modal: ModalEstimate, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX) -> None:
        test = modal.records
        self.modal, index = modal, index_of(modal)
        self.size = weights_of_test(test, weighted=True)[0][1]
        factor = factor_of(modal) / self.size
        theta, at = theta_of(modal.modes, modal.rigid, index), index.gamma.start
        scale = scale_in(modal, gamma)
        if test.force is not None:
            scale = ca.sign(scale)
        corner = [rigid[i, j] for i, j in index.pairs]
        moved = ca.vertcat(ca.vec((gamma / ca.repmat(scale, 1, test.n_base)).T), ca.log(omega), ca.log(ratios), *corner)
        off = moved - ca.DM(theta[at:])
        U, s, vt = np.linalg.svd(factor[:, :at], full_matrices=False)
        seen = s > round_off(s.size) * s[0]
        onto = U[:, seen].T @ factor[:, at:]
        self.value = ca.sumsqr(ca.DM(np.linalg.qr(factor[:, at:] - U[:, seen] @ onto, mode="r")) @ off)
        best = ca.DM(theta[:at]) - ca.DM((vt[seen].T / s[seen]) @ onto) @ off
        self.phi = ca.reshape(best, *modal.phi.T.shape).T / ca.repmat(scale.T, test.n_sensors, 1)

    def derivatives(self, z: NonlinearProgram) -> None:
        """None of its own: CasADi's are as fast."""

    def counted(self, modes: Modes, rigid: Array) -> tuple[float, float, float]:
        """Root of the value by NumPy; what is left of all records, and of the accelerations alone."""
        modal, index = self.modal, index_of(self.modal)
        scale = np.sum(modes.gamma * modal.gamma, axis=1) / np.sum(modal.gamma**2, axis=1)
        if modal.records.force is not None:
            scale = np.sign(scale)
        scaled = modes._replace(phi=modes.phi * scale, gamma=modes.gamma / scale[:, None])
        off = theta_of(scaled, rigid, index) - theta_of(modal.modes, modal.rigid, index)
        risen = float(np.linalg.norm(factor_of(modal) @ off)) / self.size
        return risen, float(np.hypot(risen, residual_of(modal, modal.modes))), residual_of(modal, modes)


def hessian_of(model: SpectraModel) -> NumpyFunction:
    """Hessian of the sum of squares of a model by theta without the shapes, for CasADi."""
    size = model.kept - model.index.gamma.start
    return NumpyFunction(size, [(size, size)], lambda x: [2 * model.slopes(model.unpack(x), model.levels)[1]])


def _derivatives(z: NonlinearProgram, error: ModalResidual, of_theta: NumpyFunction) -> dict[str, ca.Function]:
    """Gradient and Hessian by the unknowns, in IPOPT's scale of the objective."""
    unknowns, theta = z.z, error.theta()
    chain = ca.jacobian(theta, unknowns)
    hessian = chain.T @ of_theta(theta) @ chain
    # Of theta, the rigid-body mass alone bends by the unknowns, but for stated laws of the damping.
    slope = ca.MX.sym("slope", *error.rigid.shape)
    bend = ca.substitute(ca.hessian(ca.dot(slope, error.rigid), unknowns)[0], slope, error.by_rigid())
    p, factor, multipliers = ca.MX.sym("p", 0), ca.MX.sym("factor"), ca.MX.sym("multipliers", sum(
        tie.numel() for tie in z.constraints
    ))  # fmt: skip
    return {
        "grad_f": ca.Function(
            "gradient", [unknowns, p], [OBJECTIVE_SCALE * error.value, OBJECTIVE_SCALE * error.gradient(unknowns)],
            ["x", "p"], ["f", "grad_f_x"],
        ),
        "hess_lag": ca.Function(
            "hessian", [unknowns, p, factor, multipliers],
            [ca.triu(factor * OBJECTIVE_SCALE * (hessian + bend))],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        ),
    }  # fmt: skip
