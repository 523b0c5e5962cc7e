"""The program in modal coordinates: participations, frequencies and damping ratios through IPOPT, shapes eliminated.

Every answer in modal coordinates ends here, most of them after one to three iterations from an estimate. The residual
is symbolic, its gradient CasADi's own. Of spectra it is that of the lines; the Hessian is exact, and its products of
all lines are NumPy's (`SpectraModel`), as CasADi multiplies dense matrices many times slower. Of whole records it is
what the modes miss their estimate by, in units of its noise. A measured base force is fitted jointly; it sets the scale
of each mode.

Accelerations alone leave all modal masses open (the modal-mass cone, see `modal_masses`). A known mass matrix, enough
known entries of one, or a lumped one with its total fix them, each by a small linear problem; otherwise the member
nearest to a lumped mass is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import SolverError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate, factor_of, index_of, residual_of, scale_in, theta_of
from sysid.modal_analysis.modal_fit import ModalFit, Modes, Weights, held_gauge, separate_poles
from sysid.modal_analysis.response import columns, modal_gains, modal_motion, parts_of, stacked, weights_of_test
from sysid.modal_analysis.spectra_model import SpectraModel, weights_at
from sysid.models.expressions import lower_entries, lower_triangle, triangle_entries
from sysid.models.spectrum import SOLVED
from sysid.models.unknowns import Unknown, scales_of, split
from sysid.nlp import IterationMonitor, NonlinearProgram, NumpyFunction, product
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, round_off

Spectrum = Callable[[NonlinearProgram], tuple[ca.MX, ca.MX]]
Ties = Callable[[ca.MX, ca.MX, ca.MX], list[ca.MX]]


class End(NamedTuple):
    """Where IPOPT ended: unknowns (n_variables,), objective, status, and bounds in words."""

    x: Array
    objective: float
    status: str
    bounds: str
    remark: str = ""


def solve_modes(
    modal: ModalEstimate, first: Modes, spectrum: Spectrum, *, unit: Array, remainder: Array, ties: Ties | None = None,
    weights: Weights | None = None, monitor: IterationMonitor, max_iterations: int = 500, every_rank: bool = False,
) -> ModalFit:  # fmt: skip
    """Minimise the weighted squared error of accelerations and, where it was measured, base force.

    Parameters
    ----------
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
    every_rank : bool
        Let the remainder have any rank from the beginning. Else it keeps the rank that it starts with, which converges
        at once where modes carry all of a direction's mass, unless the end shows that this is too few.

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
    if modal.static and not by_lines:  # those at one pole stay in the form that they have, without turning
        held[-modal.static :] = (gauge[-modal.static :] == 0) | (not weighed)
    sizes = ca.MX.ones(m)
    if weighed:  # by its logarithm, so that a mode that the force gives no mass turns nothing singular on the way
        largest = np.max(np.abs(gauge), axis=1, keepdims=True)
        largest[largest == 0] = 1.0  # of a mode without any, which stays so
        gauge = gauge / largest
        held = held | (np.arange(d) == np.argmax(np.abs(gauge), axis=1)[:, None])
        size = np.log(largest[:, 0])
        # Of a mode that has next to no mass, which the force sees by its square, it has nowhere to settle: it stays.
        least = np.minimum(size, np.log(NEGLIGIBLE) / 2)
        room = np.where(size > least, np.inf, 0.0)
        sizes = ca.exp(ca.fmax(z.variable("size of participation", size, size - room, size + room), least))
    low, high = np.full((m, d), -np.inf), np.full((m, d), np.inf)
    low[held], high[held] = gauge[held], gauge[held]
    gamma = ca.diag(sizes) @ z.variable("participation", gauge, low, high) @ ca.diag(ca.DM(unit))
    omega, ratios = spectrum(z)
    rigid = in_parts = gamma.T @ gamma
    if weighed:
        every_rank = every_rank or ties is not None
        rigid, in_parts = _rigid_mass(z, gamma, first.gamma.T @ first.gamma, remainder, unit, every_rank=every_rank)
    curved = z.rows.numel()
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
    best, status = z.minimize(error.value, monitor, max_iterations, error.derivatives(z, curved))
    end = ca.Function("end", [z.z], [error.phi, gamma, omega, ratios, in_parts, error.value])
    try:
        values = [np.asarray(v) for v in end(best)]
        if not all(np.all(np.isfinite(v)) for v in values):
            values = [np.asarray(v) for v in end(np.concatenate(z.start))]
    except RuntimeError:  # of CasADi: the normal equations are singular
        raise SolverError(f"{m} modes move so much alike that no shapes can be told apart") from None
    modes = Modes(values[0], values[1], values[2].ravel(), values[3].ravel())
    left, (counted, of_all, of_accelerations) = float(np.sqrt(values[5].item())), error.counted(modes, values[4])
    if weighed and not (every_rank or monitor.is_over) and _lacks_base(error, modes, values[4], unit):
        left_over = values[4] - modes.gamma.T @ modes.gamma
        return solve_modes(
            modal, modes, spectrum, unit=unit, remainder=left_over, weights=weights, monitor=monitor,
            max_iterations=max_iterations, every_rank=True,
        )  # fmt: skip
    if abs(counted - left) > EXACT:
        status = f"{status}, but the residual {left:.6g} of its end is {counted:.6g} when counted anew"
    return ModalFit(modes, values[4], of_all, of_accelerations, status, z.on_bounds(best), weights)


def free_spectrum(
    omega: Array,
    ratios: Array,
    pole: NDArray[np.intp],
    lower: float = 0.0,
    upper: float = np.inf,
    *,
    held: NDArray[np.bool_],
) -> Spectrum:
    """Frequencies without bounds and damping ratios, of each pole that is not held; modes of one pole share them."""

    def spectrum(z: NonlinearProgram) -> tuple[ca.MX, ca.MX]:
        # In units of the half-power half-width, by which frequencies are known; cut off where no step of use leads.
        room = np.where(held, 0.0, np.inf)
        shift = z.variable("frequency", np.zeros(omega.size), -room, room) * ca.DM(ratios)
        with np.errstate(divide="ignore"):
            low, high = (np.where(held, 0.0, np.log(limit / ratios)) for limit in (lower, upper))
        loss = z.variable("damping ratio", np.clip(np.zeros(omega.size), low, high), low, high)
        shift, loss = ca.fmin(ca.fmax(shift, -1.0), 1.0), ca.fmin(ca.fmax(loss, -10.0), 10.0)
        moved, lossy = ca.DM(omega) * ca.exp(shift), ca.DM(ratios) * ca.exp(loss)
        # Entries of a scalar are a row.
        return ca.vec(moved[pole.tolist()]), ca.vec(lossy[pole.tolist()])

    return spectrum


def _rigid_mass(
    z: NonlinearProgram, gamma: ca.MX, of_modes: Array, remainder: Array, unit: Array, *, every_rank: bool
) -> tuple[ca.MX, ca.MX]:
    """Rigid-body mass (d, d), and what it is held to: that of all modes and a remainder, positive semidefinite.

    The mass is an unknown of its own, as the records tell it far better than the parts that it is the sum of: else
    IPOPT follows a curved valley, along which one part takes from the other.
    """
    d, scale = unit.size, np.outer(unit, unit)
    root = _root(remainder / scale, every_rank=every_rank)
    free = np.where(np.any(root != 0, axis=0)[np.tril_indices(d)[1]], np.inf, 0.0)  # its columns
    factor = lower_triangle(z.variable("base mass", triangle_entries(root), -free, free), d)
    entries = z.variable("rigid-body mass", triangle_entries((of_modes + remainder) / scale))
    in_parts = gamma.T @ gamma / ca.DM(scale) + factor @ factor.T
    z.constrain(entries - lower_entries(in_parts))
    lower = lower_triangle(entries, d)
    return ca.DM(scale) * (lower + ca.tril(lower, False).T), ca.DM(scale) * in_parts


def _root(remainder: Array, *, every_rank: bool) -> Array:
    """Lower-triangular factor (d, d) of a mass: columns of zeros behind as many as it has positive eigenvalues.

    With `every_rank` all are of the least size at which a factor has a slope.
    """
    lam, vectors = np.linalg.eigh(remainder)
    least = NEGLIGIBLE * max(1.0, lam[-1])
    if every_rank:
        return np.linalg.cholesky((vectors * np.maximum(lam, least)) @ vectors.T)
    there = lam > least
    root = np.zeros_like(remainder)
    root[:, : np.count_nonzero(there)] = np.asarray(
        np.linalg.qr((vectors[:, there] * np.sqrt(lam[there])).T, mode="r")
    ).T
    return root


def _lacks_base(error: ModalResidual | EstimateResidual, modes: Modes, rigid: Array, unit: Array) -> bool:
    """True where base mass in directions that have none would leave less of the force."""
    lam, vectors = np.linalg.eigh((rigid - modes.gamma.T @ modes.gamma) / np.outer(unit, unit))
    none = unit[:, None] * vectors[:, lam <= NEGLIGIBLE * max(1.0, lam[-1])]
    count, left = none.shape[1], error.counted(modes, rigid)[1] ** 2
    slope = np.zeros((count, count))
    for i, j in zip(*np.tril_indices(count), strict=True):
        mass = np.outer(none[:, i], none[:, j]) + np.outer(none[:, j], none[:, i])
        less, more = (error.counted(modes, rigid + sign * mass)[1] ** 2 for sign in (-1, 1))
        slope[i, j] = slope[j, i] = (more - less) / 4
    return bool(count and np.linalg.eigvalsh(slope)[0] < -NEGLIGIBLE * left)


class ModalResidual:
    """Weighted residual as CasADi expressions, its shapes eliminated.

    `phi` (n, m) are the best shapes, `parts` hold the weighted errors of the accelerations, `force_left` (d, 2 L), real
    parts beside imaginary ones, or None, those of the force, and `value` is their sum of squares.
    """

    def __init__(
        self, test: Measurement, weights: Weights, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX
    ) -> None:
        self.model = SpectraModel(test, weights, np.arange(omega.numel()))
        self.hessian = hessian_of(self.model)  # CasADi keeps no reference to it
        self.gamma, self.omega, self.ratios, self.rigid = gamma, omega, ratios, rigid
        gains = modal_gains(omega, ratios, test.freq)
        self.q = ca.horzcat(*modal_motion(test.base * weights.lines[:, None], gamma, gains))
        of_runs = lambda each: np.tile(np.repeat(each, test.freq.size, axis=0), (2, 1)).T  # noqa: E731 - (c, 2 L)
        target = of_runs(weights.sensors) * stacked(columns(test.relative * weights.lines[:, None])).T
        self.parts = [
            _Sensors(self.q, target[sensors], of_runs(over[:, None]), sensors, weights.sensors[0, sensors])
            for over, sensors in self.model.groups
        ]
        order = np.argsort(np.concatenate([part.sensors for part in self.parts])).tolist()
        self.phi = ca.vertcat(*(part.phi for part in self.parts))[order, :]
        self.value = sum((ca.sumsqr(part.left) for part in self.parts), ca.MX(0))
        self.force_left: ca.MX | None = None
        if test.force is not None and weights.force is not None:
            base = test.base * weights.force_lines[:, None]
            q = ca.horzcat(*modal_motion(base, gamma, gains)) if weights.force_lines is not weights.lines else self.q
            of_force = of_runs(weights.force)
            target = of_force * stacked(columns(test.force * weights.force_lines[:, None])).T
            self.force_left = ca.DM(of_force) * (gamma.T @ q + rigid @ ca.horzcat(*parts_of(base))) - ca.DM(target)
            self.value += ca.sumsqr(self.force_left)

    def gradient(self, z: ca.MX) -> ca.MX:
        """Of the value by the unknowns z, CasADi's own.

        The best shapes leave no slope by themselves, so that they count as constants.
        """
        pull = sum((part.pull for part in self.parts), ca.MX(*self.q.shape))
        slope = ca.jtimes(ca.vec(self.q), z, ca.vec(pull), True)
        if self.force_left is not None:
            slope += ca.gradient(ca.sumsqr(self.force_left), z)
        return slope

    def theta(self) -> ca.MX:
        """Argument of `hessian_of`: participations mode by mode, log w, log zeta and, with a force, the rigid mass."""
        d = self.rigid.size1()
        corner = [self.rigid[i, j] for i in range(d) for j in range(i, d)] if self.force_left is not None else []
        return ca.vertcat(ca.vec(self.gamma.T), ca.log(self.omega), ca.log(self.ratios), *corner)

    def derivatives(self, z: NonlinearProgram, curved: int) -> dict[str, ca.Function]:
        """Gradient and Hessian by the unknowns of a program; its first `curved` constraints are nonlinear."""
        return _derivatives(z, self, self.hessian, curved)

    def counted(self, modes: Modes, rigid: Array) -> tuple[float, float, float]:
        """Root of the value by NumPy; what is left of all records, and of the accelerations alone."""
        model = self.model
        p = model.with_best_shapes(modes, rigid)
        every, of_accelerations = (np.sqrt(model.chi2(p, at)) for at in (model.levels, model.levels_of_accelerations))
        return float(every), float(every), float(of_accelerations)


class _Sensors:
    """Some of the sensors, which weigh the runs alike: their best shapes `phi` and weighted errors `left` (n, 2 L).

    `pull` (m, 2 L) is the gradient of the sum of squares by the motions q of all modes.
    """

    def __init__(
        self, q: ca.MX, target: Array, over: Array, sensors: NDArray[np.intp], weights: Array
    ) -> None:  # fmt: skip
        weighed = lambda x: ca.DM(np.repeat(over, q.size1(), axis=0)) * x if np.any(over != 1) else x  # noqa: E731
        self.sensors, motions = sensors, weighed(q)
        # Rows of very different size would spoil the solve.
        scale = ca.sqrt(ca.sum2(motions**2))
        scaled = motions / ca.repmat(scale, 1, q.size2())
        # The ridge keeps the system regular where two modes become one; it changes shapes by less than their error.
        normal = product(scaled, scaled.T) + round_off(scaled.size1()) * ca.DM.eye(scaled.size1())
        shapes = (ca.solve(normal, product(scaled, ca.DM(target).T)) / ca.repmat(scale, 1, sensors.size)).T
        self.left = ca.DM(target) - product(shapes, motions)
        self.phi = ca.diag(ca.DM(1 / weights)) @ shapes
        self.pull = weighed(-2 * product(shapes.T, self.left))


class EstimateResidual:
    """Misfit of modes to an estimate, in units of its noise and of the records, the best shapes eliminated.

    Half a chi-squared rises by ``|R (theta - estimate)|²``, with ``R' R`` the information; shapes enter it linearly.
    `phi` (n, m) are the best shapes, `value` is the sum of squares. The scale of static modes, which the force alone
    tells, may be far off: accelerations see none of it, and the force its square.
    """

    def __init__(self, modal: ModalEstimate, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX) -> None:
        test = modal.records
        self.modal, index = modal, index_of(modal)
        self.size = weights_of_test(test, weighted=True)[0][1]
        factor = factor_of(modal) / self.size
        theta, at = theta_of(modal.modes, modal.rigid, index), index.gamma.start
        scale, shift = self._scales(scale_in(modal, gamma), ca.sign)
        corner, d = [rigid[i, j] for i, j in index.pairs], test.n_base
        pushed = gamma / ca.repmat(scale, 1, d) + ca.DM(modal.gamma) * ca.repmat(shift, 1, d)
        off = ca.vertcat(ca.vec(pushed.T), ca.log(omega), ca.log(ratios), *corner) - ca.DM(theta[at:])
        shapes = ca.DM(modal.phi) * ca.repmat(1 + shift.T, test.n_sensors, 1)
        U, s, vt = np.linalg.svd(factor[:, :at], full_matrices=False)
        seen = s > round_off(s.size) * s[0]
        onto = U[:, seen].T @ factor[:, at:]
        self.value = ca.sumsqr(ca.DM(np.linalg.qr(factor[:, at:] - U[:, seen] @ onto, mode="r")) @ off)
        best = ca.vec(shapes.T) - ca.DM((vt[seen].T / s[seen]) @ onto) @ off
        self.phi = ca.reshape(best, *modal.phi.T.shape).T / ca.repmat(scale.T, test.n_sensors, 1)

    def _scales(self, scale: Any, sign: Callable[[Any], Any]) -> tuple[Any, Any]:
        """Participations over the estimate's, (m, 1), as far as accelerations leave them open, and half the force's."""
        if self.modal.records.force is None:
            return scale, 0 * scale
        static = (np.arange(len(self.modal.omega))[:, None] >= len(self.modal.omega) - self.modal.static).astype(float)
        return static * scale + (1 - static) * sign(scale), static * (scale**2 - 1) / 2

    def derivatives(self, z: NonlinearProgram, curved: int) -> None:
        """None of its own: CasADi's are as fast."""

    def counted(self, modes: Modes, rigid: Array) -> tuple[float, float, float]:
        """Root of the value by NumPy; what is left of all records, and of the accelerations alone."""
        modal, index = self.modal, index_of(self.modal)
        apart = np.sum(modes.gamma * modal.gamma, axis=1) / np.sum(modal.gamma**2, axis=1)
        scale, shift = self._scales(apart[:, None], np.sign)
        scaled = modes._replace(
            phi=modes.phi * scale.T - modal.phi * shift.T, gamma=modes.gamma / scale + modal.gamma * shift
        )  # fmt: skip
        off = theta_of(scaled, rigid, index) - theta_of(modal.modes, modal.rigid, index)
        risen = float(np.linalg.norm(factor_of(modal) @ off)) / self.size
        return risen, float(np.hypot(risen, residual_of(modal, modal.modes))), residual_of(modal, modes)


def hessian_of(model: SpectraModel) -> NumpyFunction:
    """Hessian of the sum of squares of a model by theta without the shapes, and its gradient, for CasADi."""
    size = model.kept - model.index.gamma.start

    def values(theta: Array) -> tuple[Array, Array]:
        plain, curved = model.slopes(model.unpack(theta), model.levels)
        return 2 * curved, -2 * plain.gradient

    column = ca.Sparsity.dense(size)
    return NumpyFunction(values, [column], [ca.Sparsity.dense(size, size), column])


def _derivatives(
    z: NonlinearProgram, error: ModalResidual, of_theta: NumpyFunction, curved: int
) -> dict[str, ca.Function]:
    """Gradient and Hessian by the unknowns, in IPOPT's scale of the objective."""
    unknowns, theta = z.z, error.theta()
    chain, (twice, slope) = ca.jacobian(theta, unknowns), of_theta(theta)
    pull = ca.MX.sym("pull", theta.numel())
    bend = ca.substitute(ca.hessian(ca.dot(pull, theta), unknowns)[0], pull, slope)
    hessian = chain.T @ twice @ chain
    return {
        "grad_f": z.gradient(error.value, error.gradient(unknowns)),
        "hess_lag": z.hessian(hessian + bend, curved=curved),
    }


def fit_apart(problem: Prepared, end: End, monitor: IterationMonitor, max_iterations: int = 500) -> End:
    """The same end with the unknowns that enter no matrix fitted to the terms and constraints that they enter.

    Where modes are free nothing connects them with the others.
    """
    formulation = problem.formulation
    at = formulation.parts.damping.stop
    if at == formulation.size or monitor.stopped is not None:
        return end
    z, auxiliary = NonlinearProgram(), formulation.unknowns[sum(map(len, formulation.of_models)) :]
    start = np.clip(end.x[at:], formulation.lower[at:], formulation.upper[at:])
    unknowns = ca.vertcat(ca.DM(end.x[:at]), add_unknowns(z, auxiliary, start))
    constraints = formulation.constraints
    if constraints.lower.size:
        z.constrain(constraints.function(unknowns), constraints.lower, constraints.upper)
    rows = ca.vertcat(ca.MX(0, 1), *(term.rows(unknowns) for term in formulation.beside))
    best, status = z.minimize(ca.sumsqr(rows), monitor, max_iterations)
    x = np.asarray(ca.Function("end", [z.z], [unknowns])(best)).ravel()
    if status in SOLVED:
        return end._replace(x=x)
    return end._replace(x=x, status=status, remark=f"{end.remark or end.status}; that is of what enters no matrix")


def add_unknowns(z: NonlinearProgram, unknowns: Sequence[Unknown], x: Array, held: slice = slice(0, 0)) -> ca.MX:
    """The unknowns as expressions of new ones in units of their scale, those in `held` as numbers."""
    pieces, at = [], 0
    for unknown, values in zip(unknowns, split(unknowns, x), strict=True):
        if held.start <= at < held.stop:
            pieces.append(ca.MX(ca.DM(values)))
        else:
            unit = scales_of([unknown], values)  # its start, or a part of its range where that is larger
            unit = np.where(unit > 0, unit, 1.0)
            labels = [label.removeprefix(unknown.title) for label in unknown.labels]
            scaled = z.variable(unknown.title, values / unit, unknown.lower / unit, unknown.upper / unit, labels)
            pieces.append(scaled * ca.DM(unit))
        at += unknown.size
    return ca.vertcat(*pieces)
