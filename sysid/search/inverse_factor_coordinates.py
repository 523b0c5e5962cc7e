"""The local phase of the published algorithm: IPOPT with exact derivatives over the inverse of the mass's factor.

The unknowns stand for those of Cerini et al. 2024, section 3: ``R = L^-1`` of ``M_SS = L L'``, ``P = L^-1 B`` with
``B = M_SS G + M_S0``, N of ``M_rb = P'P + N N'`` where a base force was measured, the eigenvectors Psi of
``H = L^-1 K_SS L^-T``, its spectrum and the damping ratios. With ``Phi = R' Psi`` and ``Gamma = Psi' P`` nothing is
inverted. ``Phi = L^-T Psi`` is so far from linear in the entries of L that with noise IPOPT ends in them on its
iteration limit. Psi is ``Psi_0 Cayley(S)`` with a skew-symmetric S, so that no eigenvector routine is in the graph, and
frequencies and damping ratios count in logarithms. R, P and N have no bounds. A stated total is an equality where a
base force could tell another one; else masses are scaled to it at the end. The paper's own entries follow then. Far
from Psi_0 the Cayley transform is steep, so every so many iterations the search goes on from a new Psi_0.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import products
from sysid.modal_analysis.modal_error import ModalError
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.response import records_of, weights_of_test
from sysid.models.expressions import lower_triangle, triangle_entries
from sysid.models.spectrum import SOLVED
from sysid.nlp import IterationMonitor, NonlinearProgram, product, time_too_short
from sysid.problem.prepared import Prepared
from sysid.search.modal_coordinates import modes_of, spectrum_near, unknowns_of
from sysid.search.modal_program import End
from sysid.search.stated_masses import stated_totals
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, ROUND_OFF

_ROUND = 150  # iterations, after which Psi_0 is taken anew
_LIMIT = "Maximum_Iterations_Exceeded"  # IPOPT's word for a round that was not long enough
_SECONDS, _POWER = 0.2, 4.7  # of a processor, that the graphs of 10 modes take, and how that grows with the modes


def fit_in_inverse_factor(problem: Prepared, x: Array, monitor: IterationMonitor, max_iterations: int) -> End:
    """Minimise the objective of a problem with free modes, from the unknowns `x`.

    Where the monitor's deadline would pass while the graph of the Hessian is made, nothing is begun.
    """
    first = best = End(x, problem.objective(x), "not begun", "")
    seconds = _SECONDS * (problem.geometry.n / 10) ** _POWER
    if not monitor.allows(seconds):
        return first._replace(status=time_too_short(seconds))
    error, left = InverseFactorError(problem), max_iterations
    while left > 0:
        end = _fit_about(problem, best.x, error, monitor, min(_ROUND, left))
        left -= _ROUND
        falls = end.objective < best.objective
        # A status belongs to the point that it was given for; that of the first round tells why where none is better.
        if end.objective <= best.objective or best is first:
            best = end
        over = monitor.stopped is not None or monitor.left < 1.0  # s, that a round is worth beginning with
        if end.status != _LIMIT or best.objective <= EXACT or not falls or over:
            break
    if best.objective > first.objective:
        return first._replace(status=f"{best.status}, above the start")
    return best._replace(status="stopped") if monitor.stopped is not None else best


class Coordinates(NamedTuple):
    """A structure in the coordinates of this phase."""

    inverse: Array  # R, (n, n), lower triangular; M_SS = (R'R)^-1, kg^-½
    loads: Array  # P, (n, d), kg^½ (times m for a rotation)
    base: Array  # N, (d, d), lower triangular
    psi: Array  # eigenvectors of H, (n, n), orthogonal


def coordinates_of(structure: Structure) -> Coordinates:
    """The coordinates of a structure; a base mass of nothing is raised, as its factor would have no slope there."""
    n, G = structure.n, structure.rigid_body
    M_SS, M_S0 = structure.mass[:n, :n], structure.mass[:n, n:]
    L = np.linalg.cholesky(M_SS)
    R = np.linalg.solve(L, np.eye(n))
    P = L.T @ G + R @ M_S0
    size = np.sqrt(np.diag(structure.rigid_body_mass))
    lam, vectors = np.linalg.eigh((structure.rigid_body_mass - P.T @ P) / np.outer(size, size))
    root = np.linalg.cholesky((vectors * np.maximum(lam, NEGLIGIBLE)) @ vectors.T)
    first, _, last = np.linalg.svd(L.T @ structure.normal_modes)
    return Coordinates(np.tril(R), P, size[:, None] * root, first @ last)


class InverseFactorError:
    """The squared error of a test in the coordinates of this phase, with exact gradient and Hessian.

    The coordinates are one column: the entries of R, row by row, P by columns, the entries of N, row by row, where a
    base force was measured, the entries below the diagonal of the skew-symmetric S, those of residual modes, log w (n,)
    and log zeta (n,). Residual modes, r of them at poles that are held, have shapes (n, r), by columns, and with a base
    force participations, an upper triangle (d, d) a pole; else these are unit matrices.

    `sizes` tells how many there are of R, P, N, S, of residual modes, and log w with log zeta. Functions of the
    coordinates and Psi_0 (n, n) are `value`, `gradient` (the value beside it), `hessian`, and `modes`: shapes (n, n),
    participations (n, d) and rigid-body mass (d, d). `totals` takes the entries of R, P and N to what is stated of
    totals beside a measured base force, each relative to its value and zero where it is met; no rows where nothing is
    stated.
    """

    def __init__(self, problem: Prepared) -> None:
        test, n, d = problem.measurement, problem.geometry.n, problem.geometry.d
        weighed, beyond = test.force is not None, problem.formulation.matrices.beyond
        omega, ratios = beyond.omega.repeat(d), beyond.ratios.repeat(d)
        r, corner = omega.size, weighed * d * (d + 1) // 2
        self.sizes = (n * (n + 1) // 2, n * d, corner, n * (n - 1) // 2, n * r + r // d * corner, 2 * n)
        y, psi_0 = ca.MX.sym("y", sum(self.sizes)), ca.MX.sym("psi_0", n, n)
        *factors, skew, others, pole = (ca.MX.sym("part", size) for size in self.sizes)
        shapes = ca.vertcat(*factors, skew, others)
        R, P, N = _matrices(factors, n, d)
        psi = psi_0 @ cayley(skew_symmetric(skew, n))
        phi, gamma, rigid = R.T @ psi, psi.T @ P, P.T @ P + N @ N.T
        alone, value, gradient, hessian = ca.MX(0), ca.MX(0), ca.MX(y.numel(), 1), ca.MX(y.numel(), y.numel())
        blocks = [lower_triangle(one, d).T for one in ca.vertsplit(others[n * r :], corner)] if weighed and r else []
        every = ca.vertcat(gamma, *blocks) if blocks else ca.vertcat(gamma, ca.DM(np.tile(np.eye(d), (r // d, 1))))
        at_sensors = ca.horzcat(phi, ca.reshape(others[: n * r], n, r))
        own = np.eye(2 * (n + r))[:, np.concatenate([np.arange(n), n + r + np.arange(n)])]
        held = np.concatenate([np.zeros(n), np.log(omega), np.zeros(n), np.log(ratios)])
        self._errors = list(_errors_of(test, n + r))  # which must live as long as the functions made of them
        for error, of_force in self._errors:
            moved = ca.veccat(*((every.T, rigid) if of_force else (at_sensors,)), every)
            at = ca.vertcat(moved, ca.DM(own) @ pole + ca.DM(held))
            squared, slope = error.gradient(at)
            # What holds no lines is differentiated as it stands.
            chain = ca.densify(ca.diagcat(ca.jacobian(moved, shapes), ca.DM(own)))
            pull = ca.MX.sym("pull", moved.numel())
            bend = ca.Function("bend", [shapes, psi_0, pull], [ca.hessian(ca.dot(pull, moved), shapes)[0]])
            alone += error.value(at)
            value += squared
            gradient += chain.T @ slope
            bent = bend(shapes, psi_0, slope[: moved.numel()])
            hessian += product(product(chain.T, error.hessian(at)), chain) + ca.diagcat(bent, ca.MX(2 * n, 2 * n))
        parts, given = [*factors, skew, others, pole], ca.vertsplit(y, np.cumsum([0, *self.sizes]).tolist())

        def function(name: str, *outputs: ca.MX) -> ca.Function:
            inner = ca.Function(name, [*parts, psi_0], list(outputs))
            return ca.Function(name, [y, psi_0], inner.call([*given, psi_0]))

        self.value = function("value", alone)  # a search along a line needs no slopes
        self.gradient, self.hessian = function("gradient", value, gradient), function("hessian", hessian)
        self.modes = function("modes", phi, gamma, rigid)
        self.totals = _totals(problem, self.sizes[:3])


def _matrices(factors: list[ca.MX] | list[ca.SX], n: int, d: int) -> tuple[ca.MX, ca.MX, ca.MX]:
    """R, P and N of their entries; N is zero where it has none."""
    R, P, N = factors
    return lower_triangle(R, n), ca.reshape(P, n, d), lower_triangle(N, d) if N.numel() else type(N)(d, d)


def _totals(problem: Prepared, sizes: tuple[int, ...]) -> ca.Function:
    """Stated totals as functions of the entries of R, P and N; L by forward substitution where they need it."""
    factors = [ca.SX.sym("part", size) for size in sizes]
    R, P, N = _matrices(factors, problem.geometry.n, problem.geometry.d)
    ties = stated_totals(problem)
    # The mass is that of any orthogonal Psi, the unit matrix too, which leaves R' in the place of the shapes.
    rows = [] if ties is None else ties(R.T, P, P.T @ P + N @ N.T)
    return ca.Function("totals", factors, [ca.densify(ca.vertcat(ca.SX(0, 1), *rows))])


def _errors_of(test: Measurement, modes: int) -> Iterator[tuple[ModalError, bool]]:
    """The errors of accelerations and, where it was measured, base force, in the weights of the objective."""
    weighed = zip(records_of(test), weights_of_test(test, weighted=True), strict=True)
    for of_force, ((record, std), (_, scale)) in enumerate(weighed):
        for runs, channel, line in products(std, record.shape):
            of_runs = test.base[runs], record[runs], test.freq, channel / scale, line
            yield ModalError(*of_runs, modes=modes, with_base=bool(of_force)), bool(of_force)


def skew_symmetric(entries: ca.MX, n: int) -> ca.MX:
    """Skew-symmetric (n, n) with the `entries` below its diagonal, column by column."""
    rows, columns = np.tril_indices(n, -1)
    order = np.lexsort((rows, columns))
    below = ca.MX(ca.Sparsity.triplet(n, n, rows[order].tolist(), columns[order].tolist()), entries)
    return below - below.T


def cayley(S: ca.MX) -> ca.MX:
    """Orthogonal ``(I + S)^-1 (I - S)`` of a skew-symmetric S; the unit matrix at zero."""
    unit = ca.MX.eye(S.size1())
    return ca.solve(unit + S, unit - S)


def _fit_about(problem: Prepared, x: Array, error: InverseFactorError, monitor: IterationMonitor, limit: int) -> End:
    """IPOPT from the unknowns `x`, with their Psi_0, in at most `limit` iterations; then again with totals held."""
    structure = problem.structure(x)
    start, n = coordinates_of(structure), structure.n
    z = NonlinearProgram()
    of_mass = triangle_entries(start.inverse), start.loads.ravel(order="F"), triangle_entries(start.base)
    size = _rms(np.concatenate(of_mass[1:]))
    inverse = _scaled(z, "inverse of the mass's factor", of_mass[0], _rms(of_mass[0]))
    loads = _scaled(z, "load of modes", of_mass[1], size)
    base = _scaled(z, "base mass", of_mass[2], size) if error.sizes[2] else ca.MX(0, 1)
    skew = z.variable("rotation of modes", np.zeros(n * (n - 1) // 2))
    beyond = [_scaled(z, "residual mode", part, _rms(part)) for part in _residual_of(structure, error) if part.size]
    omega, ratios = spectrum_near(problem, structure, modes_of(structure), z)
    y = ca.vertcat(inverse, loads, base, skew, *beyond, ca.log(omega), ca.log(ratios))
    objective, derivatives = error.value(y, start.psi), _derivatives(z, y, error, start.psi)
    best, status = z.minimize(objective, monitor, limit, derivatives, barrier="monotone")
    rows = error.totals(inverse, loads, base)
    if rows.numel() and monitor.stopped is None:
        # Held from the beginning, totals make local minima on the way.
        z.start = [best]
        z.constrain(rows)
        derivatives = _derivatives(z, y, error, start.psi)
        best, status = z.minimize(objective, monitor, limit, derivatives, barrier="monotone")
    end = ca.Function("end", [z.z], [*error.modes(y, start.psi), omega, ratios])
    phi, gamma, rigid, omega, ratios = (np.asarray(part) for part in end(best))
    try:
        found = unknowns_of(problem, Modes(phi, gamma, omega.ravel(), ratios.ravel()), rigid, structure, x)
    except (InputError, np.linalg.LinAlgError) as wrong:  # an R so ill-conditioned that it stands for no structure
        return End(x, np.inf, f"{status}, at no structure ({wrong})", "")
    solved = status in SOLVED or monitor.stopped is not None
    left = "" if solved else _left_in_words(problem, z, derivatives, best)
    return End(found, problem.objective(found), status, z.on_bounds(best), left)


def _residual_of(structure: Structure, error: InverseFactorError) -> tuple[Array, Array]:
    """Entries of the residual modes of a structure: of their shapes, and of their participations with a base force."""
    beyond, d = structure.residual, structure.n_base
    loads, shapes = beyond.participation.reshape(-1, d, d), beyond.shapes
    if not error.sizes[2]:
        scaled = [shapes[:, i * d : (i + 1) * d] @ load for i, load in enumerate(loads)]
        return np.hstack([shapes[:, :0], *scaled]).ravel(order="F"), np.zeros(0)
    return shapes.ravel(order="F"), np.array([triangle_entries(load.T) for load in loads]).ravel()


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _scaled(z: NonlinearProgram, name: str, start: Array, size: float) -> ca.MX:
    """New unknowns without bounds, in units of `size`."""
    return size * z.variable(name, start / size)


def _derivatives(z: NonlinearProgram, y: ca.MX, error: InverseFactorError, psi_0: Array) -> dict[str, ca.Function]:
    """Gradient and exact Hessian by the program's unknowns, in IPOPT's scale of the objective."""
    at = z.z
    value, slope = error.gradient(y, psi_0)
    chain, pull = ca.jacobian(y, at), ca.MX.sym("pull", y.numel())
    bend = ca.Function("bend", [at, pull], [ca.hessian(ca.dot(pull, y), at)[0]])
    hessian = chain.T @ error.hessian(y, psi_0) @ chain + bend(at, slope)
    return {"grad_f": z.gradient(value, chain.T @ slope), "hess_lag": z.hessian(hessian)}


def _left_in_words(problem: Prepared, z: NonlinearProgram, derivatives: dict[str, ca.Function], at: Array) -> str:
    """Gain in chi² that an end that is no solution leaves: half the Newton decrement, beside what is left in all.

    What a fit leaves in all counts as one for each degree of freedom, as noise of its size does.
    """
    value, gain = half_newton_decrement(z, derivatives, at)
    freedom = max(2 * problem.measurement.numbers - z.z.numel(), 1)
    return f"about {gain * freedom / value:.3g} of {freedom} chi² still to gain"


def half_newton_decrement(z: NonlinearProgram, derivatives: dict[str, ca.Function], at: Array) -> tuple[float, float]:
    """The objective at a point, and ``g' H^-1 g / 2``: by how much a Newton step would lower it, both in one unit.

    Equalities are kept and unknowns on a bound held. Where the objective is not convex, the sizes of its curvatures
    count; directions along which it is flat gain nothing.
    """
    value, gradient = (np.asarray(part) for part in derivatives["grad_f"](at, []))
    A = np.asarray(ca.Function("slopes", [z.z], [ca.densify(ca.jacobian(z.rows, z.z))])(at)).reshape(-1, at.size)
    g, (lower, upper) = gradient.ravel(), z.bounds
    near = 1e-6 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    free = ~(((at - lower < near) & (g > 0)) | ((upper - at < near) & (g < 0)))
    g, A = g[free], A[:, free]
    multipliers = -np.linalg.lstsq(A.T, g)[0]
    upper_half = np.asarray(ca.densify(derivatives["hess_lag"](at, [], 1.0, multipliers)))
    H = (upper_half + np.triu(upper_half, 1).T)[np.ix_(free, free)]
    along = scipy.linalg.null_space(A) if len(A) else np.eye(g.size)
    curvature, vectors = np.linalg.eigh(along.T @ H @ along)
    slopes, size = vectors.T @ (along.T @ g), np.abs(curvature)
    bent = size > ROUND_OFF * size.max()
    return float(value.item()), float(np.sum(slopes[bent] ** 2 / size[bent]) / 2)
