"""The local phase: IPOPT with exact derivatives, in coordinates in which the problem is easy.

The response is bilinear in mode shapes and participations, so these are the unknowns, with
``log w`` and ``log zeta``; no inverse, no eigenvector routine and no infinite slope is left in the graph.

- A full mass with a spectral stiffness is free in them: every regular Phi gives a positive definite
  ``M_SS = (Phi Phi')^-1`` and ``K_SS = M_SS Phi diag(w²) Phi' M_SS``, and participations give the coupling.
  A local minimum shows: with frequencies and damping as they ended, the best residues are a linear
  least-squares problem, and where that fits clearly better, the search starts again from there.
- A structured mass or stiffness keeps its own unknowns. ``Phi = L^-T Psi``, and Psi is held orthogonal
  and, for a structured stiffness, diagonalises H: polynomial equality constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from sysid._watch import OBJECTIVE_SCALE, Watch
from sysid.damping import ModalDamping
from sysid.layout import lower_entries, lower_triangle, triangle_entries
from sysid.mass import FullMass
from sysid.measurement import Measurement
from sysid.problem import Problem, assemble
from sysid.refinement import SOLVED
from sysid.response import linear_residues, residual
from sysid.stiffness import SpectralStiffness
from sysid.structure import Array, Structure
from sysid.variables import split

FREQUENCY_WINDOW = 0.05  # relative; what a frequency read off a peak may be wrong by
_OPEN_WINDOW = 20.0  # factor either way for a frequency that nobody gave
_SPARE = 1e-3  # least share of a total mass that is left to the base
_TOLERANCE = 1e-9  # of IPOPT
_SUSPECT = 1.05  # a residual so many times that of free residues at the same poles is a local minimum
_EXACT = 1e-8  # a residual that needs no second look


@dataclass(frozen=True, eq=False)
class LocalResult:
    """How the local phase ended.

    Attributes
    ----------
    x : (n_variables,)
        The problem's unknowns; not held by the box where the coordinates are modal.
    success : bool
        IPOPT's status is Solve_Succeeded or Solved_To_Acceptable_Level, or the fit is exact to round-off.
    message : str
        IPOPT's status and what else the user must know, such as a bound that the solution ends on.
    curve : (iterations,)
        Residual of each iterate, over all attempts (root of the sum of the squared relative
        residuals of accelerations and, where measured, of the force).
    stopped : BaseException or None
        What the monitor raised, or Ctrl-C; `x` is then the last iterate.
    """

    x: Array
    success: bool
    message: str
    curve: Array
    stopped: BaseException | None = None


class Modes(NamedTuple):
    """A modal model as numbers: shapes (n, m), participations (m, d), rad/s (m,), ratios (m,)."""

    phi: Array
    gamma: Array
    omega: Array
    ratios: Array


class _Coordinates:
    """Unknowns z of the nonlinear programme, collected piece by piece, and the equalities that tie them."""

    def __init__(self) -> None:
        self.symbols: list[ca.MX] = []
        self.names: list[str] = []
        self.start: list[Array] = []
        self.lower: list[Array] = []
        self.upper: list[Array] = []
        self.ties: list[ca.MX] = []

    def add(self, name: str, start: Array, lower: Array | float = -np.inf, upper: Array | float = np.inf) -> ca.MX:
        shape = start.shape if start.ndim == 2 else (start.size, 1)
        symbol = ca.MX.sym(name, *shape)
        self.symbols.append(ca.vec(symbol))
        self.names += [name] * start.size
        self.start.append(start.ravel(order="F"))
        self.lower.append(np.broadcast_to(lower, start.shape).ravel(order="F"))
        self.upper.append(np.broadcast_to(upper, start.shape).ravel(order="F"))
        return symbol


@dataclass(frozen=True, eq=False)
class _Model:
    """The programme's expressions in its unknowns, and the way back to the problem's."""

    z: _Coordinates
    phi: ca.MX
    gamma: ca.MX
    omega: ca.MX
    ratios: ca.MX
    rigid: ca.MX
    back: Callable[[Callable[[ca.MX], Array]], Array]


class _Attempt(NamedTuple):
    x: Array
    modes: Modes
    residual: float
    status: str
    bounds: str


def is_modal(problem: Problem) -> bool:
    """Whether mode shapes and participations are free, so that the coordinates are modal."""
    return isinstance(problem.mass, FullMass) and isinstance(problem.stiffness, SpectralStiffness)


def solve(
    problem: Problem,
    x: Array,
    *,
    max_iterations: int = 500,
    max_time: float | None = None,
    monitor: Callable[[int, float], object] | None = None,
) -> LocalResult:
    """Minimise the residual from the unknowns `x`.

    Parameters
    ----------
    problem : Problem
    x : ndarray, shape (n_variables,)
    max_iterations : int
        Of each attempt.
    max_time : float, optional
        s, for all attempts.
    monitor : callable, optional
        Called with (iteration, residual) after each iteration; whatever it raises stops the solver
        and is handed back in `stopped`.
    """
    start = problem.structure(x)
    if is_modal(problem):
        remainder = start.rigid_body_mass - start.participation.T @ start.participation
        return fit_modes(
            problem, _modes(start), remainder, max_iterations=max_iterations, max_time=max_time, monitor=monitor
        )
    watch = Watch(monitor, max_time)
    best = _attempt(problem, _structured(problem, x, start), watch, max_iterations)
    return _result(best, 1, watch)


def fit_modes(
    problem: Problem,
    first: Modes,
    remainder: Array,
    *,
    held: bool = True,
    max_iterations: int = 500,
    max_time: float | None = None,
    monitor: Callable[[int, float], object] | None = None,
) -> LocalResult:
    """Minimise the residual of a full mass with spectral stiffness, from a modal model.

    Parameters
    ----------
    problem : Problem
        One for which `is_modal` holds.
    first : Modes
        n modes at the n sensors.
    remainder : (d, d)
        Part of the rigid-body mass that no mode carries; positive semidefinite.
    held : bool
        Whether the damping keeps inside its search space.
    max_iterations, max_time, monitor :
        As in `solve`.
    """
    watch = Watch(monitor, max_time)
    best = _attempt(problem, _modal(problem, first, remainder, held), watch, max_iterations)
    tried = 1
    for again in _linear_starts(problem.measurement, best, first):
        if watch.stopped is not None or best.residual <= _EXACT or watch.left < 1.0:
            break
        answer = _attempt(problem, _modal(problem, again, remainder, held), watch, max_iterations)
        tried += 1
        if answer.residual < best.residual:
            best = answer
    return _result(best, tried, watch)


def _result(best: _Attempt, tried: int, watch: Watch) -> LocalResult:
    message = f"IPOPT: {best.status}"
    if best.bounds:
        message += f"; ended on a bound: {best.bounds}"
    if tried > 1:
        message += f"; best of {tried} starts, as the first ended in a local minimum"
    # At round-off IPOPT runs out of steps rather than of gradient.
    success = best.status in SOLVED or best.residual <= _EXACT
    return LocalResult(best.x, success, message, np.array(watch.curve), watch.stopped)


def _linear_starts(test: Measurement, ended: _Attempt, first: Modes) -> Iterator[Modes]:
    """New starts where free residues fit clearly better than what was reached: at its poles, then at the first ones."""
    fits = [(poles, *linear_residues(test, poles.omega, poles.ratios)) for poles in (ended.modes, first)]
    if ended.residual <= _SUSPECT * min(possible for _, _, possible in fits):
        return
    for poles, residues, _ in fits:
        yield rank_one(residues, poles.omega, poles.ratios, np.linalg.norm(poles.phi, axis=0))


def rank_one(residues: Array, omega: Array, ratios: Array, size: Array) -> Modes:
    """Modal model nearest to residues (m, n, d); `size` (m,) of the shapes, as the split of a residue is free."""
    u, s, vt = np.linalg.svd(residues)
    return Modes(u[:, :, 0].T * size, vt[:, 0] * (s[:, 0] / size)[:, None], omega, ratios)


def _attempt(problem: Problem, model: _Model, watch: Watch, max_iterations: int) -> _Attempt:
    """One run of IPOPT."""
    z = model.z
    symbols = ca.vertcat(*z.symbols)
    miss = residual(problem.measurement, model.phi, model.gamma, model.omega, model.ratios, model.rigid)
    ties = ca.vertcat(*z.ties) if z.ties else ca.MX(0, 1)
    nlp = {"x": symbols, "f": OBJECTIVE_SCALE * ca.sumsqr(miss), "g": ties}
    lower, upper = np.concatenate(z.lower), np.concatenate(z.upper)
    start = np.clip(np.concatenate(z.start), lower, upper)
    call = watch.callback(start, ties.numel())

    def run(at: Array, tolerance: float) -> tuple[str, Array]:
        limits: dict[str, float] = {"max_iter": max_iterations}
        if np.isfinite(watch.left):
            limits["max_wall_time"] = max(watch.left, 0.1)
        options = {
            "print_time": False,
            "iteration_callback": call,
            "ipopt": {
                "print_level": 0, "sb": "yes", "tol": tolerance, "acceptable_tol": 100 * tolerance,
                "acceptable_iter": 5, "constr_viol_tol": 1e-11, "mu_strategy": "adaptive", **limits,
            },
        }  # fmt: skip
        solver = ca.nlpsol("local", "ipopt", nlp, options)
        answer = solver(x0=at, lbx=lower, ubx=upper, lbg=0, ubg=0)
        return solver.stats()["return_status"], np.asarray(answer["x"]).ravel()

    try:
        status, best = run(start, _TOLERANCE)
        if status == "Search_Direction_Becomes_Too_Small" and watch.stopped is None:
            # Noise can leave the gradient's round-off above the tolerance: the same point is judged by a wider one.
            status, best = run(best, 1e3 * _TOLERANCE)
    except KeyboardInterrupt as interrupt:
        watch.stopped = interrupt
    if watch.stopped is not None:
        status, best = "stopped", watch.z
    value = lambda expression: np.asarray(ca.Function("value", [symbols], [expression])(best))  # noqa: E731
    omega, ratios = value(model.omega).ravel(), value(model.ratios).ravel()
    modes = Modes(value(model.phi), value(model.gamma), omega, ratios)
    size = float(np.linalg.norm(value(miss)))
    return _Attempt(model.back(value), modes, size, status, _on_bounds(z.names, best, lower, upper))


def _modes(structure: Structure) -> Modes:
    return Modes(
        structure.mode_shapes,
        structure.participation,
        2 * np.pi * structure.natural_frequencies,
        structure.damping_ratios,
    )


def _spectrum(problem: Problem, start: Modes, z: _Coordinates, held: bool = True) -> tuple[ca.MX, ca.MX, Array]:
    """Frequencies and damping ratios as expressions; circular frequencies that they are relative to."""
    center, window = start.omega.copy(), np.full(start.omega.size, np.log(_OPEN_WINDOW))
    if isinstance(problem.stiffness, SpectralStiffness):
        targets = problem.stiffness.targets
        center[: targets.size], window[: targets.size] = targets, np.log1p(FREQUENCY_WINDOW)
    shift = z.add("frequency", np.clip(np.log(start.omega / center), -window, window), -window, window)
    omega = ca.DM(center) * ca.exp(shift)
    damping = problem.damping
    (variable,) = damping.variables(problem.layout)
    if isinstance(damping, ModalDamping) and not held:
        return omega, ca.DM(start.ratios) * ca.exp(z.add("damping ratio", np.zeros(start.ratios.size))), center
    if isinstance(damping, ModalDamping):
        guess = np.clip(start.ratios, variable.lower, variable.upper)
        low, high = np.log(variable.lower / guess), np.log(variable.upper / guess)
        return omega, ca.DM(guess) * ca.exp(z.add("damping ratio", np.zeros(guess.size), low, high)), center
    guess = np.clip(damping.values(start.ratios, start.omega), variable.lower, variable.upper)
    y = z.add("Rayleigh factor", guess / variable.upper, variable.lower / variable.upper, 1.0)
    return omega, damping.ratios(y * ca.DM(variable.upper), omega), center


def _damping_values(problem: Problem, ratios: Array, omega: Array) -> Array:
    """The damping's unknowns, inside the bounds that IPOPT may leave by its tolerance."""
    (variable,) = problem.damping.variables(problem.layout)
    return np.clip(problem.damping.values(ratios, omega), variable.lower, variable.upper)


def _modal(problem: Problem, start: Modes, remainder: Array, held: bool) -> _Model:
    """Full mass, spectral stiffness: mode shapes and participations are free."""
    z, layout, mass, test = _Coordinates(), problem.layout, problem.mass, problem.measurement
    assert isinstance(mass, FullMass)
    d, G, totals = layout.d, layout.rigid_body, problem.totals
    unit = np.sqrt(totals.max())  # kg^½: makes shapes and participations of order one
    phi = z.add("mode shape", start.phi * unit) / unit
    gamma = z.add("participation", start.gamma / unit) * unit
    omega, ratios, _ = _spectrum(problem, start, z, held)
    rigid = gamma.T @ gamma
    if test.force is not None:
        root = np.linalg.cholesky(remainder + 1e-6 * np.diag(totals)) / np.sqrt(totals)[:, None]
        factor = ca.diag(ca.DM(np.sqrt(totals))) @ lower_triangle(z.add("base mass", triangle_entries(root)), d)
        rigid = rigid + factor @ factor.T
        if mass.total_mass is not None:
            _tie_totals(z, problem, phi, gamma, rigid)

    def back(value: Callable[[ca.MX], Array]) -> Array:
        w = value(omega).ravel()
        order = np.argsort(w)
        pushes, w, zeta = value(gamma)[order], w[order], value(ratios).ravel()[order]
        P = np.linalg.inv(value(phi)[:, order])
        if test.force is None:
            t, left = _fit_totals(problem, P, pushes, remainder)
            P, pushes = P * np.sqrt(t), pushes * np.sqrt(t)
        else:
            left = value(rigid) - pushes.T @ pushes
        M_SS = P.T @ P
        M_S0 = P.T @ pushes - M_SS @ G
        low = np.linalg.solve(np.linalg.cholesky(M_SS), M_S0)
        zeta = np.maximum(zeta, 0.0)  # Rayleigh factors may leave their bounds by IPOPT's tolerance
        structure = assemble(M_SS, M_S0, low.T @ low + left, (P.T * w**2) @ P, zeta, G)
        x = problem.values(structure)
        if held:
            x[problem.parts.damping] = _damping_values(problem, zeta, w)
        return x

    return _Model(z, phi, gamma, omega, ratios, rigid, back)


def _tie_totals(z: _Coordinates, problem: Problem, phi: ca.MX, gamma: ca.MX, rigid: ca.MX) -> None:
    """Hold the stated total mass where the base force would set another."""
    layout, mass, totals = problem.layout, problem.mass, problem.totals
    assert isinstance(mass, FullMass)
    if mass.healing == "rigid_body":
        z.ties.append(ca.diag(rigid) / totals - 1)
        return
    P = ca.inv(phi)
    G = ca.DM(layout.rigid_body)
    delta = gamma - P @ G
    rows = ca.diag(P.T @ P)
    base = ca.diag(rigid - gamma.T @ gamma + delta.T @ delta)
    groups = layout.directions[: layout.n]
    for i in range(layout.d):
        own = ca.sum1(rows[np.flatnonzero(groups == i).tolist()])
        z.ties.append((own + base[i]) / totals[i] - 1)


def _fit_totals(problem: Problem, P: Array, gamma: Array, remainder: Array) -> tuple[float, Array]:
    """Common modal-mass factor t and base remainder (d, d) with which the mass has the stated totals.

    Scaling all modal masses by one t changes no response; the remainder is invisible in
    accelerations. It keeps the correlations of the start's, and takes what mass the modes leave.
    """
    layout, mass = problem.layout, problem.mass
    assert isinstance(mass, FullMass)
    if mass.healing == "rigid_body":
        used = np.sum(gamma**2, axis=0)
    else:
        delta = gamma - P @ layout.rigid_body
        groups = layout.directions[: layout.n]
        rows = np.sum(P**2, axis=0)
        used = np.array([rows[groups == i].sum() for i in range(layout.d)]) + np.sum(delta**2, axis=0)
    t = min(1.0, float(np.min((1 - _SPARE) * problem.totals / used)))
    share = np.sqrt((problem.totals - t * used) / np.maximum(np.diag(remainder), np.finfo(float).tiny))
    return t, remainder * np.outer(share, share)


def _structured(problem: Problem, x: Array, start: Structure) -> _Model:
    """Mass or stiffness with unknowns of their own."""
    z, layout, parts = _Coordinates(), problem.layout, problem.parts
    n, G = layout.n, ca.DM(layout.rigid_body)
    symbols = ca.SX.sym("x", problem.n_variables)
    blocks = problem.matrices(symbols)
    L_inverse = ca.solve(blocks.factor, ca.SX.eye(n))
    outputs = [ca.densify(b) for b in (L_inverse, blocks.factor, blocks.coupling, blocks.base, blocks.mass_normalised)]
    expand = ca.Function("expand", [symbols], outputs)

    # The modes themselves stand for a spectral stiffness and for the damping.
    held = isinstance(problem.stiffness, SpectralStiffness)
    searched = parts.mass.stop if held else parts.stiffness.stop
    pieces: list[ca.MX] = []
    at = 0
    for variable, given in zip(problem.variables, split(problem.variables, x), strict=True):
        values = np.clip(given, variable.lower, variable.upper)
        if at < searched:
            # Each unknown in units of its start, or of its range where that is smaller.
            unit = np.maximum(np.abs(values), 0.05 * (variable.upper - variable.lower))
            pieces.append(
                z.add(variable.name, values / unit, variable.lower / unit, variable.upper / unit) * ca.DM(unit)
            )
        else:
            pieces.append(ca.MX(ca.DM(values)))
        at += variable.size
    L_inv, L, M_S0, M_00, H = expand(ca.vertcat(*pieces))

    omega, ratios, center = _spectrum(problem, _modes(start), z)
    psi = z.add("mode shape", np.linalg.cholesky(start.mass[:n, :n]).T @ start.mode_shapes)
    z.ties.append(lower_entries(psi.T @ psi - ca.MX.eye(n)))
    if not held:
        scaled = psi @ ca.diag(1 / ca.DM(center))
        z.ties.append(lower_entries(scaled.T @ H @ scaled - ca.diag((omega / ca.DM(center)) ** 2)))
    phi = L_inv.T @ psi
    push = L @ (L.T @ G) + M_S0
    rigid = G.T @ push + M_S0.T @ G + M_00

    def back(value: Callable[[ca.MX], Array]) -> Array:
        unknowns = value(ca.vertcat(*pieces)).ravel()
        w = value(omega).ravel()
        order = np.argsort(w)
        unknowns[parts.damping] = _damping_values(problem, value(ratios).ravel()[order], w[order])
        if held:
            u, _, vt = np.linalg.svd(value(psi)[:, order])  # exactly orthogonal
            shapes = u @ vt
            unknowns[parts.stiffness] = triangle_entries(np.linalg.cholesky((shapes * w[order] ** 2) @ shapes.T))
        return unknowns

    return _Model(z, phi, phi.T @ push, omega, ratios, rigid, back)


def _on_bounds(names: list[str], z: Array, lower: Array, upper: Array) -> str:
    """Which unknowns the solution presses against a finite bound, in words."""
    with np.errstate(invalid="ignore"):
        near = 1e-6 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
        low, high = np.isfinite(lower) & (z - lower < near), np.isfinite(upper) & (upper - z < near)
    seen: dict[str, int] = {}
    ended: dict[str, list[str]] = {}
    for name, is_low, is_high in zip(names, low, high, strict=True):
        seen[name] = seen.get(name, 0) + 1
        if is_low or is_high:
            ended.setdefault(name, []).append(f"{seen[name]} ({'lower' if is_low else 'upper'})")
    return "; ".join(
        f"{name} {', '.join(which[:4])}" + (f" and {len(which) - 4} more" if len(which) > 4 else "")
        for name, which in ended.items()
    )
