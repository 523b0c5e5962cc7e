"""The fit in modal coordinates: participations, frequencies and damping ratios through IPOPT, mode shapes eliminated.

The response is bilinear in mode shapes and participations, so at given participations and poles the shapes are a
linear least-squares problem; what is left has (d + 2) unknowns a mode, whatever the number of sensors (variable
projection, Golub and Pereyra 1973). The gradient is exact, and the Hessian is the Gauss-Newton one of the exact
Jacobian of the projected residual (Kaufman 1975): all its columns belong to one mode each, so that it comes from
one small Gram matrix. A measured base force is fitted jointly; it sets the scale of each mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.errors import SolverError
from sysid.measurement.measurement import Measurement
from sysid.measurement.noise import separable
from sysid.modal_analysis.residues import force_residual_left, linear_residues
from sysid.modal_analysis.response import columns, parts_of, stacked
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor, NonlinearProgram
from sysid.structure.structure import Array
from sysid.structure.triangular import lower_triangle, triangle_entries

_RIDGE = 1e-14  # of the modes' own size
_LEAST_MASS = 1e-6  # of the rigid-body mass; the least remainder that a fit starts with
_LEAST_MISFIT = 1e-9  # relative; records that fit better than this weigh alike


class Modes(NamedTuple):
    """A modal model as numbers: shapes at the sensors (n, m), participations (m, d), rad/s (m,), ratios (m,)."""

    phi: Array
    gamma: Array
    omega: Array
    ratios: Array


class Index:
    """Where the modal parameters stand in theta."""

    def __init__(self, s: int, m: int, d: int) -> None:
        self.shapes = ((s, m), (m, d), (m,), (m,))
        ends = np.cumsum([np.prod(shape) for shape in self.shapes]).tolist()
        self.phi, self.gamma, self.log_omega, self.log_ratios = map(slice, [0, *ends], ends)
        self.pairs = [(i, j) for i in range(d) for j in range(i, d)]  # of M_rb, which is symmetric
        self.size = ends[-1] + len(self.pairs)
        self.rigid = np.arange(ends[-1], self.size)

    def split(self, theta: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Phi, Gamma, log w, log zeta and M_rb of columns of theta, (..., columns)."""
        d = self.shapes[1][1]
        rigid = np.empty((d, d, theta.shape[1]))
        for (i, j), row in zip(self.pairs, theta[self.rigid], strict=True):
            rigid[i, j] = rigid[j, i] = row
        phi, gamma = theta[self.phi].reshape(*self.shapes[0], -1), theta[self.gamma].reshape(*self.shapes[1], -1)
        return phi, gamma, theta[self.log_omega], theta[self.log_ratios], rigid


def rank_one(residues: Array, omega: Array, ratios: Array, size: Array) -> Modes:
    """Modal model nearest to residues (m, n, d); `size` (m,) of the shapes, as the split of a residue is free."""
    u, s, vt = np.linalg.svd(residues)
    return Modes(u[:, :, 0].T * size, vt[:, 0] * (s[:, 0] / size)[:, None], omega, ratios)


@dataclass(frozen=True, eq=False)
class ModalFit:
    """Result of a fit in modal coordinates.

    Attributes
    ----------
    modes : Modes
    rigid : (d, d)
        Rigid-body mass; of no meaning where no force was measured.
    residual : float
        Root of the weighted squared error of all records, in units of the weighted accelerations.
    of_accelerations : float
        That of the accelerations alone.
    status : str
        Return status of IPOPT.
    bounds : str
        Bounds that the solution presses on, in words.
    """

    modes: Modes
    rigid: Array
    residual: float
    of_accelerations: float
    status: str
    bounds: str


Spectrum = Callable[[NonlinearProgram], tuple[ca.MX, ca.MX]]
Ties = Callable[[ca.MX, ca.MX, ca.MX], list[ca.MX]]


def fit_modes(
    test: Measurement,
    first: Modes,
    spectrum: Spectrum,
    *,
    unit: Array,
    remainder: Array,
    ties: Ties | None = None,
    monitor: IterationMonitor,
    max_iterations: int = 500,
) -> ModalFit:
    """Minimise the weighted squared error of accelerations and, where it was measured, base force.

    Parameters
    ----------
    test : Measurement
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

    Raises
    ------
    SolverError
        Where the modes' motions are linearly dependent.

    References
    ----------
    G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432; L. Kaufman, BIT 15 (1975) 49-57.
    """
    z = NonlinearProgram()
    m, d = first.gamma.shape
    weighed = test.force is not None
    gauge, held = _gauge(first, unit, weighed)
    low, high = np.full((m, d), -np.inf), np.full((m, d), np.inf)
    low[held], high[held] = gauge[held], gauge[held]
    gamma = z.variable("participation", gauge, low, high) @ ca.diag(ca.DM(unit))
    omega, ratios = spectrum(z)
    rigid = gamma.T @ gamma
    if weighed:
        lam, vectors = np.linalg.eigh(remainder / np.outer(unit, unit))
        # A factor of zero has no slope.
        root = np.linalg.cholesky((vectors * np.maximum(lam, _LEAST_MASS * max(1.0, lam[-1]))) @ vectors.T)
        factor = ca.diag(ca.DM(unit)) @ lower_triangle(z.variable("base mass", triangle_entries(root)), d)
        rigid = rigid + factor @ factor.T
    error = _Error(test, gamma, omega, ratios, rigid, first)
    if ties is not None:
        for tie in ties(error.phi, gamma, rigid):
            z.constrain(tie)
    best, status = z.minimize(error.value, monitor, max_iterations, _derivatives(z, error, gamma, omega, ratios, rigid))
    end = ca.Function("end", [z.z], [error.phi, gamma, omega, ratios, rigid, error.value, ca.norm_fro(error.left)])
    try:
        values = [np.asarray(v) for v in end(best)]
        if not all(np.all(np.isfinite(v)) for v in values):
            values = [np.asarray(v) for v in end(np.concatenate(z.start))]
    except RuntimeError:  # of CasADi: the normal equations are singular
        raise SolverError(f"{m} modes move so much alike that no shapes can be told apart") from None
    modes = Modes(values[0], values[1], values[2].ravel(), values[3].ravel())
    left = float(np.sqrt(values[5].item())), float(values[6].item())
    return ModalFit(modes, values[4], *left, status, z.on_bounds(best))


def _gauge(first: Modes, unit: Array, weighed: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Participations in one of the equivalent forms, and which of them are held to keep it.

    Accelerations leave the scale of each mode open: its largest participation is held. Of modes that share a pole they
    leave every mixture open, and the block in as many directions is held to a unit matrix; a force leaves only
    rotations of these modes into each other, and the block is held triangular.
    """
    gauge, held = first.gamma / unit, np.zeros(first.gamma.shape, dtype=bool)
    _, start = np.unique(first.omega + 1j * first.ratios, return_index=True)
    for same in np.split(np.arange(first.omega.size), np.sort(start)[1:]):
        pivots = scipy.linalg.qr(gauge[same], pivoting=True, mode="r")[1]  # directions best conditioned together first
        block = np.ix_(same, pivots[: same.size])
        if weighed:
            gauge[same] = np.linalg.qr(gauge[block])[0].T @ gauge[same]
            lower = np.tril(np.ones((same.size, same.size), dtype=bool), -1)
            gauge[block] = np.where(lower, 0.0, gauge[block])
            held[block] = lower
        else:
            gauge[same] = np.linalg.solve(gauge[block], gauge[same])
            held[block] = True
    return gauge, held


class _Error:
    """Weighted squared error as a CasADi expression, its shapes eliminated, and what its derivatives are made of."""

    def __init__(
        self, test: Measurement, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX, first: Modes
    ) -> None:
        self.gamma, self.rigid = gamma, rigid
        channel, line = separable(test.response_std, test.response.shape)
        target = stacked(columns(test.relative * channel[:, None] * line[:, None])).T
        size = float(np.linalg.norm(target))
        self.motion = _Motion(test, line, gamma, omega, ratios)
        q = self.motion.q
        # Rows of very different size would spoil the solve.
        scale = ca.sqrt(ca.sum2(q**2))
        scaled = q / ca.repmat(scale, 1, q.size2())
        # The ridge keeps the system regular where two modes become one; it changes shapes by less than their error.
        self.normal = scaled @ scaled.T + _RIDGE * ca.DM.eye(q.size1())
        shapes = ca.solve(self.normal, scaled @ ca.DM(target).T) / ca.repmat(scale, 1, test.n_sensors)
        self.scale, self.shapes = scale, shapes.T / size  # of weighted sensors, in units of all their records
        self.left = ca.DM(target / size) - self.shapes @ q
        self.phi = ca.diag(ca.DM(size / channel)) @ self.shapes
        self.value = ca.sumsqr(self.left)
        self.force_motion: _Motion | None = None
        if test.force is not None:
            channel, force_line = separable(test.force_std, test.force.shape)
            same = np.allclose(force_line / force_line.mean(), line / line.mean(), rtol=1e-12)
            if same:
                channel, force_line = channel * force_line.mean() / line.mean(), line
            self.force_motion = self.motion if same else _Motion(test, force_line, gamma, omega, ratios)
            target = stacked(columns(test.force * channel[:, None] * force_line[:, None])).T
            weight = _force_weight(test, first, size, float(np.linalg.norm(target)))
            self.force_channel = ca.DM(weight * channel)
            answered = gamma.T @ self.force_motion.q + rigid @ self.force_motion.base
            self.force_left = ca.diag(self.force_channel) @ answered - ca.DM(weight * target)
            self.value += ca.sumsqr(self.force_left)

    def slopes(self) -> tuple[ca.MX, ca.MX]:
        """Gradient and Gauss-Newton Hessian by (participations, column by column; log w; log zeta; rigid-body mass).

        The rigid-body mass counts with all its d² entries, as if they were free.
        """
        gamma, motion = self.gamma, self.motion
        m, d = gamma.shape
        pull = self.shapes.T @ self.left
        gradient = ca.vertcat(*(-2 * ca.sum2(pull * v) for v in motion.vectors), ca.MX(d * d, 1))
        modes = motion.q.T
        onto = ca.vertcat(*(v @ modes for v in motion.vectors)) / ca.repmat(self.scale.T, m * (d + 2), 1)
        # Records that weigh their lines alike have their products in common.
        same = self.force_motion is motion
        gram = _gram([*motion.vectors, motion.base] if same else motion.vectors)
        inner = gram[: m * (d + 2), : m * (d + 2)] - onto @ ca.solve(self.normal, onto.T)
        alike = ca.repmat(self.shapes.T @ self.shapes, d + 2, d + 2)
        hessian = ca.diagcat(2 * inner * alike, ca.MX(d * d, d * d))
        if self.force_motion is None:
            return gradient, hessian
        motion = self.force_motion
        full = [*motion.vectors, motion.base]
        gram = gram if same else _gram(full)
        onto = ca.horzcat(*(self.force_left @ v.T for v in full))
        for j in range(d):
            blocks = [[ca.MX(m, m)] * (d + 2) for _ in range(d + 2)]
            for i in range(d + 2):
                blocks[i][i] = ca.diag(gamma[:, j])
            for i in range(d):
                blocks[j][i] = blocks[j][i] + ca.diag(gamma[:, i])
            modal = ca.vertcat(*(ca.horzcat(*row) for row in blocks))
            rigid = ca.DM(d * d, d)
            for i in range(d):
                rigid[i * d + j, i] = 1.0
            T = self.force_channel[j] * ca.diagcat(modal, rigid)
            gradient += 2 * (T @ onto[j, :].T)
            hessian += 2 * (T @ gram @ T.T)
        return gradient, hessian


class _Motion:
    """Modal accelerations of a test with its lines weighted, and their slopes; real parts beside imaginary ones.

    ``q`` (m, 2 L); ``base`` (d, 2 L); ``vectors``: slopes of q by the participations in each direction, by log w and
    by log zeta, (m, 2 L) each.
    """

    def __init__(self, test: Measurement, line: Array, gamma: ca.MX, omega: ca.MX, ratios: ca.MX) -> None:
        u_re, u_im = parts_of(test.base * line[:, None])  # zeros are structural, so that they cost no arithmetic
        w = ca.DM(np.tile(2 * np.pi * test.freq, test.n_runs)).T
        m, d = gamma.shape
        squared, ones = ca.repmat(w**2, m, 1), ca.DM.ones(1, w.numel())
        stiff, loss = omega**2 @ ones, (2 * ratios * omega) @ w
        detuning = stiff - squared
        size = 1 / (detuning**2 + loss**2)
        over = (size * detuning, -size * loss)  # one over the denominator
        g = (squared * over[0], squared * over[1])
        push = (gamma @ u_re, gamma @ u_im)
        q = _times(g, push)
        turned = _times(q, over)
        self.q, self.base = ca.horzcat(*q), ca.horzcat(u_re, u_im)
        by_ratio = (turned[1] * loss, -turned[0] * loss)
        by_omega = (by_ratio[0] - 2 * stiff * turned[0], by_ratio[1] - 2 * stiff * turned[1])
        by_gamma = [_times(g, (ca.repmat(u_re[i, :], m, 1), ca.repmat(u_im[i, :], m, 1))) for i in range(d)]
        self.vectors = [ca.horzcat(*pair) for pair in (*by_gamma, by_omega, by_ratio)]


def _gram(blocks: list[ca.MX]) -> ca.MX:
    """Inner products of all rows of the blocks."""
    turned = [block.T for block in blocks]
    inner = {(i, j): blocks[i] @ turned[j] for i in range(len(blocks)) for j in range(i + 1)}
    return ca.vertcat(
        *(
            ca.horzcat(*(inner[i, j] if j <= i else inner[j, i].T for j in range(len(blocks))))
            for i in range(len(blocks))
        )
    )


def _times(a: tuple[ca.MX, ca.MX], b: tuple[ca.MX, ca.MX]) -> tuple[ca.MX, ca.MX]:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _force_weight(test: Measurement, first: Modes, size: float, force_size: float) -> float:
    """Weight of the weighted force beside accelerations in units of `size`.

    Stated deviations of both records set it. Otherwise it follows from what free residues at the first poles leave.
    """
    if test.response_std is not None and test.force_std is not None:
        return 1 / size
    _, first_pole = np.unique(first.omega + 1j * first.ratios, return_index=True)
    poles = first.omega[first_pole], first.ratios[first_pole]
    left = max(linear_residues(test, *poles)[1], _LEAST_MISFIT)
    force_left = max(force_residual_left(test, *poles), _LEAST_MISFIT)
    assert test.force is not None
    return left / force_left * float(np.sqrt(test.force.size / test.relative.size)) / force_size


def _derivatives(
    z: NonlinearProgram, error: _Error, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX
) -> dict[str, ca.Function]:
    """Gradient and Gauss-Newton Hessian by the unknowns, in IPOPT's scale of the objective."""
    unknowns = z.z
    plain = ca.vertcat(ca.vec(gamma), ca.log(omega), ca.log(ratios), ca.vec(rigid))
    chain = ca.jacobian(plain, unknowns)
    gradient, hessian = error.slopes()
    # Where the data want less base mass than none its factor ends at zero, where it has no slope, only curvature.
    d = rigid.size1()
    slope = ca.MX.sym("slope", d, d)
    bend = ca.substitute(
        ca.hessian(ca.dot(slope, rigid - gamma.T @ gamma), unknowns)[0], slope, ca.reshape(gradient[-d * d :], d, d)
    )
    p, factor, multipliers = ca.MX.sym("p", 0), ca.MX.sym("factor"), ca.MX.sym("multipliers", sum(
        tie.numel() for tie in z.constraints
    ))  # fmt: skip
    return {
        "grad_f": ca.Function(
            "gradient", [unknowns, p], [OBJECTIVE_SCALE * error.value, OBJECTIVE_SCALE * (chain.T @ gradient)],
            ["x", "p"], ["f", "grad_f_x"],
        ),
        "hess_lag": ca.Function(
            "hessian", [unknowns, p, factor, multipliers],
            [ca.triu(factor * OBJECTIVE_SCALE * (chain.T @ hessian @ chain + bend))],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        ),
    }  # fmt: skip
