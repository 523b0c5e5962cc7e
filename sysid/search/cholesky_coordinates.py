"""The paper's local phase: IPOPT with exact derivatives over the Cholesky unknowns (Cerini et al. 2024, section 3).

The unknowns are the entries of L_M, which healing scales to the stated total, the eigenvectors Psi and the spectrum of
``H = L_H L_H'``, and the damping ratios; ``Phi = L^-T Psi``, ``Gamma = Psi' L^-1 B``. Two coordinates are ours: Psi is
``Psi_0 Cayley(S)`` with a skew-symmetric S, so that no eigenvector routine is in the graph, and frequencies and damping
ratios count in logarithms. The paper's own entries of L_H follow at the end. Far from Psi_0 the Cayley transform is
steep, so every so many iterations the search goes on from a new Psi_0.
"""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.measurement.noise import separable
from sysid.modal_analysis.modal_error import ModalError
from sysid.modal_analysis.response import records_of, weights_of_test
from sysid.models.model import mass_blocks
from sysid.models.spectrum import SOLVED
from sysid.models.unknowns import lower_of, upper_of
from sysid.nlp import EXACT, OBJECTIVE_SCALE, IterationMonitor, NonlinearProgram, not_begun
from sysid.problem.matrices import assemble
from sysid.problem.problem import Problem
from sysid.search.modal_coordinates import End, modes_of, spectrum_near
from sysid.search.scaled_unknowns import add_unknowns
from sysid.structure.structure import Array

_ROUND = 150  # iterations, after which Psi_0 is taken anew
_GAIN = 0.9  # a round that leaves more of the objective than this was the last
_ROUNDS = 6
_LEAST_TIME = 1.0  # s, that a round is worth beginning with
_SECONDS, _POWER = 0.5, 5.2  # of a processor, that the graphs of 10 modes take, and how that grows with the modes


def fit_in_cholesky(problem: Problem, x: Array, monitor: IterationMonitor, max_iterations: int) -> End:
    """Minimise the objective of a problem with free modes, from the unknowns `x`.

    Where the monitor's deadline would pass while the graph of the Hessian is made, nothing is begun.
    """
    best = first = End(x, problem.objective(x), "not begun", "")
    seconds = _SECONDS * (problem.geometry.n / 10) ** _POWER
    if not monitor.allows(seconds):
        return first._replace(status=not_begun(seconds))
    error = CholeskyError(problem)
    for _ in range(_ROUNDS):
        end = _fit_about(problem, best.x, error, monitor, min(_ROUND, max_iterations))
        gained = end.objective < _GAIN * best.objective
        # A status belongs to the point that it was given for; that of the first round tells why where none is better.
        if end.objective <= best.objective or best is first:
            best = end
        over = monitor.stopped is not None or monitor.left < _LEAST_TIME
        if end.status in SOLVED or best.objective <= EXACT or not gained or over:
            break
    if best.objective > first.objective:
        return first._replace(status=f"{best.status}, above the start")
    return best._replace(status="stopped") if monitor.stopped is not None else best


class CholeskyError:
    """The squared error of a test in Cholesky coordinates, with exact gradient and Hessian.

    The coordinates are one column: the unknowns of the mass (entries of L_M, in front of them totals where these are
    unknown), the entries below the diagonal of the skew-symmetric S, log w (n,) and log zeta (n,).

    Parameters
    ----------
    problem : Problem
        With free modes.

    Attributes
    ----------
    gradient : casadi.Function
        Coordinates and Psi_0 (n, n) to the squared error and its gradient.
    hessian : casadi.Function
        Coordinates and Psi_0 to the Hessian.
    """

    def __init__(self, problem: Problem) -> None:
        formulation, geometry = problem.formulation, problem.geometry
        n, n_mass = geometry.n, formulation.parts.mass.stop
        mass, skew = ca.MX.sym("mass", n_mass), ca.MX.sym("skew", n * (n - 1) // 2)
        pole, psi_0 = ca.MX.sym("pole", 2 * n), ca.MX.sym("psi_0", n, n)
        made = mass_blocks(formulation.models[0].blocks(geometry, mass), geometry)
        L, G = ca.tril(made.factor), ca.DM(geometry.rigid_body)
        inverse = ca.solve(L, ca.MX.eye(n))
        psi = psi_0 @ cayley(skew_symmetric(skew, n))
        push = L.T @ G + inverse @ made.coupling  # L^-1 B
        phi, gamma = inverse.T @ psi, psi.T @ push
        rigid = push.T @ push + made.base - ca.mtimes([made.coupling.T, inverse.T, inverse, made.coupling])
        y = ca.vertcat(mass, skew, pole)
        # What holds no lines is differentiated as it stands.
        shapes = ca.vertcat(mass, skew)
        value, gradient, hessian = ca.MX(0), ca.MX(y.numel(), 1), ca.MX(y.numel(), y.numel())
        for error, of_force in _errors_of(problem.measurement, n):
            factors = (gamma.T, rigid) if of_force else (phi,)
            moved = ca.veccat(*factors, gamma)
            at = ca.vertcat(moved, pole)
            squared, slope = error.gradient(at)
            curvature = error.hessian(at)
            chain = ca.diagcat(ca.densify(ca.jacobian(moved, shapes)), ca.DM.eye(2 * n))
            pull = ca.MX.sym("pull", moved.numel())
            bend = ca.Function("bend", [shapes, psi_0, pull], [ca.hessian(ca.dot(pull, moved), shapes)[0]])
            value += squared
            gradient += chain.T @ slope
            bent = bend(shapes, psi_0, slope[: moved.numel()])
            hessian += chain.T @ curvature @ chain + ca.diagcat(bent, ca.MX(2 * n, 2 * n))
        symbols = ca.MX.sym("y", y.numel())
        parts = ca.vertsplit(symbols, np.cumsum([0, n_mass, skew.numel(), 2 * n]).tolist())
        inner = ca.Function("inner", [mass, skew, pole, psi_0], [value, gradient])
        outer = ca.Function("outer", [mass, skew, pole, psi_0], [hessian])
        self.gradient = ca.Function("gradient", [symbols, psi_0], inner(*parts, psi_0))
        self.hessian = ca.Function("hessian", [symbols, psi_0], [outer(*parts, psi_0)])
        self.eigenvectors = ca.Function("eigenvectors", [skew, psi_0], [psi])


def _errors_of(test: Measurement, modes: int) -> Iterator[tuple[ModalError, bool]]:
    """The errors of accelerations and, where it was measured, base force, in the weights of the objective."""
    weighed = zip(records_of(test), weights_of_test(test, weighted=True), strict=True)
    for of_force, ((record, std), (_, scale)) in enumerate(weighed):
        channel, line = separable(std, record.shape)
        yield (
            ModalError(test.base, record, test.freq, channel / scale, line, modes=modes, with_base=bool(of_force)),
            bool(of_force),
        )


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


def _fit_about(problem: Problem, x: Array, error: CholeskyError, monitor: IterationMonitor, max_iterations: int) -> End:
    """One run of IPOPT, with Psi_0 of the unknowns `x` that it starts from."""
    formulation, structure = problem.formulation, problem.structure(x)
    of_mass, n = formulation.of_models[0], structure.n
    # The same mass with its largest entry in the middle of the box: healing makes every scale of it alike.
    start = problem.values(structure)[formulation.parts.mass]
    z = NonlinearProgram()
    mass = add_unknowns(z, of_mass, np.clip(start, lower_of(of_mass), upper_of(of_mass)))
    skew = z.variable("rotation of modes", np.zeros(n * (n - 1) // 2))
    omega, ratios = spectrum_near(problem, structure, modes_of(structure), z)
    first, _, last = np.linalg.svd(np.linalg.cholesky(structure.mass[:n, :n]).T @ structure.normal_modes)
    psi_0 = first @ last
    y = ca.vertcat(mass, skew, ca.log(omega), ca.log(ratios))
    objective = error.gradient(y, psi_0)[0]
    best, status = z.minimize(
        objective, monitor, max_iterations, _derivatives(z.z, y, error, psi_0), barrier="monotone"
    )
    end = ca.Function("end", [z.z], [mass, error.eigenvectors(skew, psi_0), omega, ratios, objective])
    entries, psi, omega, ratios, squared = (np.asarray(part) for part in end(best))
    try:
        found = _unknowns(problem, x, entries.ravel(), psi, omega.ravel(), ratios.ravel())
    except (InputError, np.linalg.LinAlgError) as wrong:  # an L_M so ill-conditioned that it stands for no structure
        return End(x, np.inf, f"{status}, at no structure ({wrong})", "")
    return End(found, float(np.sqrt(squared.item())), status, z.on_bounds(best))


def _derivatives(z: ca.MX, y: ca.MX, error: CholeskyError, psi_0: Array) -> dict[str, ca.Function]:
    """Gradient and exact Hessian by the program's unknowns, in IPOPT's scale of the objective."""
    value, slope = error.gradient(y, psi_0)
    chain, pull = ca.jacobian(y, z), ca.MX.sym("pull", y.numel())
    bend = ca.Function("bend", [z, pull], [ca.hessian(ca.dot(pull, y), z)[0]])
    hessian = chain.T @ error.hessian(y, psi_0) @ chain + bend(z, slope)
    p, factor, multipliers = ca.MX.sym("p", 0), ca.MX.sym("factor"), ca.MX.sym("multipliers", 0)
    return {
        "grad_f": ca.Function(
            "gradient", [z, p], [OBJECTIVE_SCALE * value, OBJECTIVE_SCALE * (chain.T @ slope)],
            ["x", "p"], ["f", "grad_f_x"],
        ),
        "hess_lag": ca.Function(
            "hessian", [z, p, factor, multipliers], [ca.triu(OBJECTIVE_SCALE * factor * hessian)],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        ),
    }  # fmt: skip


def _unknowns(problem: Problem, x: Array, entries: Array, psi: Array, omega: Array, ratios: Array) -> Array:
    """The paper's unknowns at an end, modes in ascending order; what enters no matrix as in `x`."""
    order, formulation = np.argsort(omega), problem.formulation
    at = x.copy()
    at[formulation.parts.mass] = entries
    M_SS, M_S0, M_00, *_ = formulation.matrices.numbers(at)
    root = np.linalg.cholesky(M_SS) @ psi[:, order] * omega[order]
    structure = assemble(
        M_SS, M_S0, M_00, root @ root.T, formulation.matrices.rigid_body, ratios=ratios[order],
        test=problem.measurement,
    )  # fmt: skip
    found = problem.values(structure)
    damping = formulation.parts.damping
    # IPOPT may leave bounds by its tolerance.
    found[damping] = np.clip(found[damping], problem.lower[damping], problem.upper[damping])
    found[damping.stop :] = x[damping.stop :]
    return found
