"""The local phase in a problem's own unknowns: structured models, and whatever is written in expressions.

- Where C is an expression the response is a direct solve, and the unknowns are all there is: a least-squares problem
  with exact Jacobian, whose Hessian is taken as ``J'J`` (Gauss-Newton) plus that of the constraints.
- Where damping is by ratios the response needs the modes. They are further unknowns: ``Phi = L^-T Psi``, Psi is held
  orthogonal and, but for a spectral stiffness, diagonalises ``H = L^-1 K L^-T``: polynomial equalities, so that no
  eigenvector routine is left in the graph. A scale of the mass that no record sees then moves no mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from sysid.modal_analysis.complex_frequency import Smoothed
from sysid.modal_analysis.response import residual
from sysid.models.damping import ModalDamping, ProportionalDamping
from sysid.models.stiffness import SpectralStiffness
from sysid.models.unknowns import Block, Variable, slices_of, split, steps_of
from sysid.nlp import OBJECTIVE_SCALE, Coordinates, Watch
from sysid.problem.direct_response import relative_misfit
from sysid.problem.feasibility import HELD, LOOSE
from sysid.problem.formulation import labels_of
from sysid.problem.problem import Problem
from sysid.search.modal import FREQUENCY_WINDOW
from sysid.structure.structure import Array, Structure
from sysid.structure.triangular import lower_entries, triangle_entries

_OPEN_WINDOW = 20.0  # factor either way for a frequency that nobody gave


@dataclass(frozen=True, eq=False)
class StructuredFit:
    """Where IPOPT ended: unknowns (n_variables,), root of the squared error, status, and bounds in words."""

    x: Array
    residual: float
    status: str
    bounds: str


def fit_structured(
    problem: Problem,
    x: Array,
    watch: Watch,
    max_iterations: int,
    smoothed: tuple[Smoothed, ...] | None = None,
) -> StructuredFit:
    """Minimise the residuals of a problem over its own unknowns, from `x`.

    `smoothed` are to be fitted in the place of the problem's own test and its further ones.
    """
    z, formulation = Coordinates(), problem.formulation
    tests = smoothed or [Smoothed(test, 0.0) for test in (problem.measurement, *(t for t, _ in formulation.others))]
    modal = needs_modes(problem)
    # The modes themselves stand for a spectral stiffness.
    held = modal and isinstance(problem.stiffness, SpectralStiffness)
    pieces: list[ca.MX] = []
    factors = ca.MX(0, 1)
    for variable, given in zip(problem.variables, split(problem.variables, x), strict=True):
        values = np.clip(given, variable.lower, variable.upper)
        if held and variable.name == "stiffness_factor":
            pieces.append(ca.MX(ca.DM(values)))
            continue
        unit = unit_of(variable, values)
        own = isinstance(variable, Variable)
        name = variable.name if own else variable.name.replace("_", " ")
        labels = [label.removeprefix(variable.name) for label in labels_of(variable)] if own else None
        ends = variable.lower / unit, variable.upper / unit
        pieces.append(z.add(name, values / unit, *ends, labels) * ca.DM(unit))
        factors = pieces[-1] if variable.name == "rayleigh_factor" else factors
    unknowns = ca.vertcat(*pieces)

    constraints = formulation.constraints
    if constraints is not None:
        broken = constraints.function(unknowns)
        # In units of what the constraint makes over the search space.
        unit = problem.tolerance / np.where(constraints.lower == constraints.upper, LOOSE, HELD)
        z.tie(broken / ca.DM(unit), constraints.lower / unit, constraints.upper / unit)
    if modal:
        miss, psi, omega = _in_modes(problem, tests[0], unknowns, factors, problem.structure(x), z, held=held)
    else:
        psi = omega = ca.MX(0, 1)
        if formulation.misfit is not None:
            miss = formulation.misfit(unknowns)
        else:
            miss = relative_misfit(
                tests[0].test, formulation.matrices.motion(unknowns), weighted=True, shift=tests[0].shift
            )
    for other, (_, matrices), share in zip(tests[1:], formulation.others, formulation.shares, strict=True):
        further = share * relative_misfit(other.test, matrices.motion(unknowns), weighted=True, shift=other.shift)
        miss = ca.vertcat(miss, further)
    if formulation.residuals is not None:
        miss = ca.vertcat(miss, formulation.residuals(unknowns))
    if formulation.known is not None:
        miss = ca.vertcat(miss, formulation.level * formulation.known(unknowns))
    derivatives = None if modal else {"hess_lag": _gauss_newton(z, miss)}
    # Beside noise the objective's round-off stops the line search first: the gradient is then small, not at tolerance.
    acceptable = 1e2 if modal else 1e3
    best, status = z.minimize(ca.sumsqr(miss), watch, max_iterations, derivatives, acceptable=acceptable)

    values = [np.asarray(v) for v in ca.Function("end", [z.z], [unknowns, psi, omega, ca.norm_2(miss)])(best)]
    ended = values[0].ravel()
    if not held and isinstance(problem.damping, ModalDamping) and modal:
        names = [variable.name for variable in problem.variables]
        part = slices_of(problem.variables)[names.index("damping_ratio")]
        ended[part] = ended[part][np.argsort(values[2].ravel())]
    if held:
        w = values[2].ravel()
        order = np.argsort(w)
        u, _, vt = np.linalg.svd(values[1][:, order])  # exactly orthogonal
        at = {
            variable.name: part for variable, part in zip(problem.variables, slices_of(problem.variables), strict=True)
        }
        ended[at["stiffness_factor"]] = triangle_entries(np.linalg.cholesky((u @ vt * w[order] ** 2) @ (u @ vt).T))
        if "damping_ratio" in at:
            ended[at["damping_ratio"]] = ended[at["damping_ratio"]][order]
    ended = np.clip(ended, problem.lower, problem.upper)
    return StructuredFit(ended, float(values[3].item()), status, z.on_bounds(best))


def needs_modes(problem: Problem) -> bool:
    """Whether modes are further unknowns: damping by ratios has no direct solve."""
    by_ratios = problem.formulation.matrices.by_ratios or isinstance(problem.damping, ProportionalDamping)
    return by_ratios and problem.formulation.misfit is None


def unit_of(variable: Block | Variable, values: Array) -> Array:
    """What IPOPT counts a variable in: its start, or a part of its range where that is larger."""
    if variable.name == "rayleigh_factor":
        return variable.upper
    unit = steps_of([variable], values)
    return np.where(unit > 0, unit, 1.0)


def frequencies(problem: Problem, start: Array, z: Coordinates) -> tuple[ca.MX, Array]:
    """Circular frequencies as new unknowns, held near those that were given, and what they are relative to, rad/s."""
    center, window = start.copy(), np.full(start.size, np.log(_OPEN_WINDOW))
    if isinstance(problem.stiffness, SpectralStiffness):
        targets = problem.stiffness.targets
        center[: targets.size], window[: targets.size] = targets, np.log1p(FREQUENCY_WINDOW)
    shift = np.clip(np.log(start / center), -window, window)
    return ca.DM(center) * ca.exp(z.add("frequency", shift, -window, window)), center


def _in_modes(
    problem: Problem, test: Smoothed, unknowns: ca.MX, factors: ca.MX, start: Structure, z: Coordinates, *, held: bool
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Misfit in mode shapes and frequencies, tied to the matrices; ``Psi`` and w beside it.

    `factors` are those of a proportional damping.
    """
    motion = problem.formulation.matrices.motion(unknowns)
    n = start.n
    omega, center = frequencies(problem, 2 * np.pi * start.natural_frequencies, z)
    _, inverse = problem.formulation.matrices.factors(unknowns)
    psi = z.add("mode shape", np.linalg.cholesky(start.mass[:n, :n]).T @ start.normal_modes)
    z.tie(lower_entries(psi.T @ psi - ca.MX.eye(n)))
    if not held:
        scaled = psi @ ca.diag(1 / ca.DM(center))
        H = inverse @ motion.stiffness @ inverse.T
        z.tie(lower_entries(scaled.T @ H @ scaled - ca.diag((omega / ca.DM(center)) ** 2)))
    phi = inverse.T @ psi
    shapes = ca.DM(motion.recovery) @ phi
    damping = problem.damping
    ratios = damping.ratios(factors, omega) if isinstance(damping, ProportionalDamping) else motion.damping
    miss = residual(
        test.test, shapes, phi.T @ motion.push, omega, ratios, motion.rigid_body_mass, weighted=True, shift=test.shift
    )
    return miss, psi, omega


def _gauss_newton(z: Coordinates, miss: ca.MX) -> ca.Function:
    """Hessian of the Lagrangian with ``2 J'J`` for that of the objective, as nlpsol's `hess_lag`."""
    at = z.z
    J = ca.densify(ca.jacobian(miss, at))
    ties = ca.vertcat(ca.MX(0, 1), *z.ties)
    p, factor, multipliers = ca.MX.sym("p", 0), ca.MX.sym("factor"), ca.MX.sym("multipliers", ties.numel())
    hessian = 2 * OBJECTIVE_SCALE * factor * (J.T @ J)
    if ties.numel():
        hessian = hessian + ca.hessian(ca.dot(multipliers, ties), at)[0]
    return ca.Function(
        "hessian", [at, p, factor, multipliers], [ca.triu(hessian)],
        ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
    )  # fmt: skip
