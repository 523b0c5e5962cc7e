"""The local phase: IPOPT with exact derivatives, in coordinates in which the problem is easy.

The response is bilinear in mode shapes and participations, so these are the unknowns, with
``log w`` and ``log zeta``; no inverse, no eigenvector routine and no infinite slope is left in the graph.

- A full mass with a spectral stiffness is free in them: every regular Phi gives a positive definite
  ``M_SS = (Phi Phi')^-1`` and ``K_SS = M_SS Phi diag(w²) Phi' M_SS``, and participations give the coupling.
- A structured mass or stiffness keeps its own unknowns. ``Phi = L^-T Psi``, and Psi is held orthogonal
  and, for a structured stiffness, diagonalises H: polynomial equality constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from sysid.damping import ModalDamping
from sysid.mass import FullMass
from sysid.problem import Problem, assemble
from sysid.response import residual
from sysid.stiffness import SpectralStiffness
from sysid.structure import Array, Structure

FREQUENCY_WINDOW = 0.05  # relative; what a frequency read off a peak may be wrong by
_OPEN_WINDOW = 20.0  # factor either way for a frequency that nobody gave
_SPARE = 1e-3  # least share of a total mass that is left to the base
_OBJECTIVE_SCALE = 1e3  # lifts a residual of 1e-8 above IPOPT's tolerance
GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True, eq=False)
class LocalResult:
    """How the local phase ended.

    Attributes
    ----------
    x : (n_variables,)
        The problem's unknowns; not held by the box where the coordinates are modal.
    success : bool
        IPOPT's status is Solve_Succeeded or Solved_To_Acceptable_Level.
    message : str
        IPOPT's status and what else the user must know, such as a bound that the solution ends on.
    iterations : int
    curve : (iterations + 1,)
        Relative residual of the fitted records after each iteration (root of the objective).
    interrupted : bool
        Ctrl-C stopped IPOPT; `x` is the best iterate until then.
    """

    x: Array
    success: bool
    message: str
    iterations: int
    curve: Array
    interrupted: bool = False


class _Coordinates:
    """Unknowns z of the nonlinear programme, collected piece by piece."""

    def __init__(self) -> None:
        self.symbols: list[ca.MX] = []
        self.names: list[str] = []
        self.start: list[Array] = []
        self.lower: list[Array] = []
        self.upper: list[Array] = []
        self.ties: list[ca.MX] = []
        self.tie_lower: list[Array] = []
        self.tie_upper: list[Array] = []

    def add(self, name: str, start: Array, lower: Array | float = -np.inf, upper: Array | float = np.inf) -> ca.MX:
        shape = start.shape if start.ndim == 2 else (start.size, 1)
        symbol = ca.MX.sym(name, *shape)
        self.symbols.append(ca.vec(symbol))
        self.names += [name] * start.size
        self.start.append(start.ravel(order="F"))
        self.lower.append(np.broadcast_to(lower, start.shape).ravel(order="F"))
        self.upper.append(np.broadcast_to(upper, start.shape).ravel(order="F"))
        return symbol

    def tie(self, expression: ca.MX, lower: float = 0.0, upper: float = 0.0) -> None:
        self.ties.append(expression)
        self.tie_lower.append(np.full(expression.numel(), lower))
        self.tie_upper.append(np.full(expression.numel(), upper))


@dataclass(frozen=True, eq=False)
class _Model:
    """The programme's expressions in its unknowns, and the way back to the problem's."""

    z: _Coordinates
    phi: ca.MX
    gamma: ca.MX
    omega: ca.MX
    ratios: ca.MX
    rigid: ca.MX | None
    back: Callable[[Callable[[ca.MX], Array]], Array]


def solve(
    problem: Problem,
    x: Array,
    *,
    max_iterations: int = 500,
    max_time: float | None = None,
    monitor: Callable[[int, float], bool] | None = None,
) -> LocalResult:
    """Minimise the residual from the unknowns `x`.

    Parameters
    ----------
    problem : Problem
    x : ndarray, shape (n_variables,)
    max_iterations : int
    max_time : float, optional
        s.
    monitor : callable, optional
        Called with (iteration, relative residual) after each iteration; True stops the solver.
    """
    start = problem.structure(x)
    free = isinstance(problem.mass, FullMass) and isinstance(problem.stiffness, SpectralStiffness)
    model = _modal(problem, start) if free else _structured(problem, x, start)
    z = model.z
    symbols = ca.vertcat(*z.symbols)
    miss = residual(problem.target, model.phi, model.gamma, model.omega, model.ratios, model.rigid)
    nlp = {"x": symbols, "f": _OBJECTIVE_SCALE * ca.sumsqr(miss), "g": ca.vertcat(*z.ties) if z.ties else ca.MX(0, 1)}
    curve: list[float] = []
    watch = _Watch(nlp, curve, monitor)
    limits: dict[str, float] = {"max_iter": max_iterations}
    if max_time is not None:
        limits["max_wall_time"] = max(max_time, 0.1)
    options = {
        "print_time": False,
        "iteration_callback": watch,
        "ipopt": {
            "print_level": 0, "sb": "yes", "tol": 1e-11, "acceptable_tol": 1e-8, "acceptable_iter": 5,
            "constr_viol_tol": 1e-11, "mu_strategy": "adaptive", **limits,
        },
    }  # fmt: skip
    solver = ca.nlpsol("local", "ipopt", nlp, options)
    join = lambda pieces: np.concatenate(pieces) if pieces else np.zeros(0)  # noqa: E731
    lower, upper = join(z.lower), join(z.upper)
    try:
        answer = solver(
            x0=np.clip(join(z.start), lower, upper), lbx=lower, ubx=upper, lbg=join(z.tie_lower), ubg=join(z.tie_upper)
        )
        stats = solver.stats()
        status, best = stats["return_status"], np.asarray(answer["x"]).ravel()
    except KeyboardInterrupt:
        watch.interrupted, status, best = True, "interrupted", watch.z
    if watch.interrupted:
        status, best = "interrupted", watch.z
    value = lambda expression: np.asarray(ca.Function("value", [symbols], [expression])(best))  # noqa: E731
    message = f"IPOPT: {status}"
    ended = _on_bounds(z.names, best, lower, upper)
    if ended:
        message += f"; ended on a bound: {ended}"
    return LocalResult(model.back(value), status in GOOD, message, len(curve) - 1, np.array(curve), watch.interrupted)


class _Watch(ca.Callback):
    """IPOPT's iteration callback: keeps the curve and lets the caller stop."""

    def __init__(self, nlp: dict, curve: list[float], monitor: Callable[[int, float], bool] | None) -> None:
        ca.Callback.__init__(self)
        self.sizes = {"x": nlp["x"].numel(), "f": 1, "g": nlp["g"].numel(), "lam_x": nlp["x"].numel()}
        self.sizes |= {"lam_g": self.sizes["g"], "lam_p": 0}
        self.curve, self.monitor = curve, monitor
        self.interrupted, self.z = False, np.zeros(0)
        self.construct("watch", {})

    def get_n_in(self) -> int:
        """Number of outputs of an nlpsol."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """One flag."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Name of an nlpsol output."""
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        """Name of the flag."""
        return "stop"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shapes of the nlpsol outputs."""
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arg: list) -> list:
        """Record the iterate and its residual; a nonzero answer stops IPOPT."""
        try:
            self.z = np.asarray(arg[0]).ravel()
            self.curve.append(float(np.sqrt(max(float(arg[1]), 0.0) / _OBJECTIVE_SCALE)))
            return [int(self.monitor is not None and self.monitor(len(self.curve) - 1, self.curve[-1]))]
        except KeyboardInterrupt:  # must not unwind through IPOPT
            self.interrupted = True
            return [1]


def _spectrum(problem: Problem, start: Structure, z: _Coordinates) -> tuple[ca.MX, ca.MX, Array]:
    """Frequencies and damping ratios as expressions; circular frequencies that they are relative to."""
    own = 2 * np.pi * start.natural_frequencies
    center, window = own.copy(), np.full(own.size, np.log(_OPEN_WINDOW))
    if isinstance(problem.stiffness, SpectralStiffness):
        targets = problem.stiffness.targets
        center[: targets.size], window[: targets.size] = targets, np.log1p(FREQUENCY_WINDOW)
    shift = z.add("frequency", np.clip(np.log(own / center), -window, window), -window, window)
    omega = ca.DM(center) * ca.exp(shift)
    damping = problem.damping
    (variable,) = damping.variables(problem.layout)
    if isinstance(damping, ModalDamping):
        guess = np.clip(start.damping_ratios, variable.lower, variable.upper)
        log = z.add(
            "damping ratio", np.zeros(guess.size), np.log(variable.lower / guess), np.log(variable.upper / guess)
        )
        return omega, ca.DM(guess) * ca.exp(log), center
    guess = np.clip(damping.values(start.damping_ratios, own), variable.lower, variable.upper)
    y = z.add("Rayleigh factor", guess / variable.upper, variable.lower / variable.upper, 1.0)
    return omega, damping.ratios(y * ca.DM(variable.upper), omega), center


def _modal(problem: Problem, start: Structure) -> _Model:
    """Full mass, spectral stiffness: mode shapes and participations are free."""
    z, layout, mass = _Coordinates(), problem.layout, problem.mass
    assert isinstance(mass, FullMass)
    d, G = layout.d, layout.rigid_body
    unit = np.sqrt(problem.totals.max())  # kg^½: makes shapes and participations of order one
    phi = z.add("mode shape", start.mode_shapes * unit) / unit
    gamma = z.add("participation", start.participation / unit) * unit
    omega, ratios, _ = _spectrum(problem, start, z)
    remainder = start.rigid_body_mass - start.participation.T @ start.participation
    rigid, root = None, None
    if problem.target.force is not None:
        totals = problem.totals
        root = np.linalg.cholesky(remainder + 1e-6 * np.diag(totals)) / np.sqrt(totals)[:, None]
        entries = z.add("base mass", root[np.tril_indices(d)])
        factor = ca.MX(ca.Sparsity.lower(d))
        for at, (i, j) in enumerate(zip(*(index.tolist() for index in np.tril_indices(d)), strict=True)):
            factor[i, j] = entries[at] * np.sqrt(totals[i])
        rigid = gamma.T @ gamma + factor @ factor.T
        if mass.total_mass is not None:
            _tie_totals(z, problem, phi, gamma, rigid)

    def back(value: Callable[[ca.MX], Array]) -> Array:
        shapes, pushes, w = value(phi), value(gamma), value(omega).ravel()
        order = np.argsort(w)
        shapes, pushes, w, zeta = shapes[:, order], pushes[order], w[order], value(ratios).ravel()[order]
        P = np.linalg.inv(shapes)
        if rigid is None:
            t, left = _fit_totals(problem, P, pushes, remainder)
            P, pushes = P * np.sqrt(t), pushes * np.sqrt(t)
        else:
            left = value(rigid) - pushes.T @ pushes
        M_SS = P.T @ P
        M_S0 = P.T @ pushes - M_SS @ G
        low = np.linalg.solve(np.linalg.cholesky(M_SS), M_S0)
        structure = assemble(M_SS, M_S0, low.T @ low + left, (P.T * w**2) @ P, zeta, G)
        return problem.values(structure)

    return _Model(z, phi, gamma, omega, ratios, rigid, back)


def _tie_totals(z: _Coordinates, problem: Problem, phi: ca.MX, gamma: ca.MX, rigid: ca.MX) -> None:
    """Hold the stated total mass where the base force would set another."""
    layout, mass, totals = problem.layout, problem.mass, problem.totals
    assert isinstance(mass, FullMass)
    if mass.healing == "rigid_body":
        z.tie(ca.diag(rigid) / totals - 1)
        return
    P = ca.inv(phi)
    G = ca.DM(layout.rigid_body)
    delta = gamma - P @ G
    rows = ca.diag(P.T @ P)
    base = ca.diag(rigid - gamma.T @ gamma + delta.T @ delta)
    groups = layout.directions[: layout.n]
    for i in range(layout.d):
        z.tie((ca.sum1(rows[np.flatnonzero(groups == i).tolist()]) + base[i]) / totals[i] - 1)


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
    z, layout = _Coordinates(), problem.layout
    n, G = layout.n, ca.DM(layout.rigid_body)
    symbols = ca.SX.sym("x", problem.n_variables)
    blocks = problem.matrices(symbols)
    L_inverse = ca.solve(blocks.factor, ca.SX.eye(n))
    expand = ca.Function("expand", [symbols], [ca.densify(b) for b in (L_inverse, *blocks[:4])])

    held = isinstance(problem.stiffness, SpectralStiffness)  # its unknowns are the modes themselves
    pieces: list[ca.MX] = []
    at = 0
    names = [*(v.name for v in problem.mass.variables(layout)), *(v.name for v in problem.stiffness.variables(layout))]
    for variable in problem.variables:
        values = np.clip(x[at : at + variable.size], variable.lower, variable.upper)
        at += variable.size
        if variable.name not in names or (held and variable.name == "stiffness_factor"):
            pieces.append(ca.MX(ca.DM(values)))
            continue
        # Each unknown in units of its start, or of its range where that is smaller.
        unit = np.maximum(np.abs(values), 0.05 * (variable.upper - variable.lower))
        fixed = np.where(unit > 0, unit, 1.0)
        pieces.append(
            z.add(variable.name, values / fixed, variable.lower / fixed, variable.upper / fixed) * ca.DM(fixed)
        )
    L_inv, L, M_S0, M_00, H = expand(ca.vertcat(*pieces))

    omega, ratios, center = _spectrum(problem, start, z)
    psi = z.add("mode shape", np.linalg.cholesky(start.mass[:n, :n]).T @ start.mode_shapes)
    z.tie(_lower(psi.T @ psi - ca.MX.eye(n)))
    if not held:
        scaled = psi @ ca.diag(1 / ca.DM(center))
        z.tie(_lower(scaled.T @ H @ scaled - ca.diag((omega / ca.DM(center)) ** 2)))
    phi = L_inv.T @ psi
    push = L @ (L.T @ G) + M_S0
    rigid = None
    if problem.target.force is not None:
        rigid = G.T @ push + M_S0.T @ G + M_00

    def back(value: Callable[[ca.MX], Array]) -> Array:
        unknowns = value(ca.vertcat(*pieces)).ravel()
        w, zeta = value(omega).ravel(), value(ratios).ravel()
        order = np.argsort(w)
        ends = np.cumsum([v.size for v in problem.variables])
        damping = problem.damping.values(zeta[order], w[order])
        unknowns[ends[-1] - damping.size :] = damping
        if held:
            u, _, vt = np.linalg.svd(value(psi)[:, order])  # exactly orthogonal
            shapes = u @ vt
            spectral = problem.stiffness.values(layout, (shapes * w[order] ** 2) @ shapes.T, np.zeros((n, n)))
            unknowns[ends[-1] - damping.size - spectral.size : ends[-1] - damping.size] = spectral
        return unknowns

    return _Model(z, phi, phi.T @ push, omega, ratios, rigid, back)


def _lower(matrix: ca.MX) -> ca.MX:
    """Entries of the lower triangle of a symmetric matrix, as a column."""
    n = matrix.size1()
    rows, columns = np.tril_indices(n)
    return ca.vec(matrix)[(columns * n + rows).tolist()]


def _on_bounds(names: list[str], z: Array, lower: Array, upper: Array) -> str:
    """Which unknowns the solution presses against a finite bound, in words."""
    with np.errstate(invalid="ignore"):
        near = 1e-6 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
        low, high = np.isfinite(lower) & (z - lower < near), np.isfinite(upper) & (upper - z < near)
    seen: dict[str, int] = {}
    words = []
    for name, is_low, is_high in zip(names, low, high, strict=True):
        seen[name] = seen.get(name, 0) + 1
        if is_low or is_high:
            words.append(f"{name} {seen[name]} ({'lower' if is_low else 'upper'})")
    return ", ".join(words[:6]) + (f" and {len(words) - 6} more" if len(words) > 6 else "")
