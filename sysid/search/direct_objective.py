"""The swarm's cost of a problem in its own unknowns: many candidates at once."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.modal_analysis.complex_frequency import Smoothed
from sysid.modal_analysis.response import columns, gains, weights_of_test
from sysid.models.unknowns import split
from sysid.problem.feasibility import violation_of
from sysid.problem.formulation import Matrices, sampling_function
from sysid.problem.problem import Problem
from sysid.search.swarm_objective import CHUNK, padded, stacked
from sysid.structure.structure import Array, ComplexArray

_ROUND_OFF = 1e-9  # of the largest entry
_WORST = 1e6  # a residual that no candidate passes that keeps the constraints


class WrittenCost:
    """Root of the squared relative residuals of a whole swarm at once: (n_particles, n_variables) → (n_particles,).

    Matrices are a compiled CasADi function of all candidates; responses follow from LAPACK's batched eigensolvers, of
    the undamped structure or, for a damping matrix, of its state space.

    Parameters
    ----------
    problem : Problem
        Written in expressions; its healing is applied, and its constraints count by the feasibility rules of Deb
        (Comput. Methods Appl. Mech. Eng. 186 (2000) 311-338): whatever keeps them comes before what does not.
    """

    def __init__(self, problem: Problem, smoothed: tuple[Smoothed, ...] | None = None) -> None:
        self.problem = problem
        f = problem.formulation
        own = [Smoothed(test, 0.0) for test in (problem.measurement, *(t for t, _ in f.others))]
        s = ca.MX.sym("s", f.size)
        x = ca.vertcat(*(sampling_function(v)(p) for v, p in zip(f.variables, split(f.variables, s), strict=True)))
        if f.healing is not None:
            x = ca.fmin(ca.fmax(f.healing(x), ca.DM(f.lower)), ca.DM(f.upper))
        self._unknowns = ca.Function("unknowns", [s], [x])
        models = (f.matrices, *(matrices for _, matrices in f.others))
        self._tests = [
            (share, _TestCost(test, matrices, s, x))
            for share, test, matrices in zip((1.0, *f.shares), smoothed or own, models, strict=True)
            if f.misfit is None or matrices is not f.matrices
        ]
        self._own = None if f.misfit is None else ca.Function("misfit", [s], [ca.norm_2(f.misfit(x))])
        rows = [] if f.residuals is None else [f.residuals(x)]
        rows += [] if f.known is None else [f.level * f.known(x)]
        self._residuals = ca.Function("residuals", [s], [ca.norm_2(ca.vertcat(*rows))]) if rows else None
        self._constraints = (
            None if f.constraints is None else ca.Function("constraints", [s], [ca.densify(f.constraints.function(x))])
        )

    def __call__(self, particles: Array) -> Array:
        """Cost of each row; NaN where a candidate is no structure."""
        chunks = range(0, len(particles), CHUNK)
        return np.concatenate([self._chunk(particles[start : start + CHUNK]) for start in chunks])

    def unknowns(self, s: Array) -> Array:
        """The unknowns x that the swarm coordinates `s` stand for, healed."""
        return np.asarray(self._unknowns(s)).ravel()

    def refined(self, s: Array) -> Array:
        """The same: nothing of a written problem is replaced by what was measured."""
        return self.unknowns(s)

    def _chunk(self, particles: Array) -> Array:
        count = len(particles)
        squared = np.zeros(count) if self._own is None else _each(self._own, particles) ** 2
        for share, test in self._tests:
            squared = squared + share**2 * test.squared(particles)
        if self._residuals is not None:
            squared = squared + _each(self._residuals, particles) ** 2
        cost = np.sqrt(squared)
        constraints = self.problem.formulation.constraints
        if constraints is None:
            return cost
        assert self._constraints is not None
        values = np.array([np.asarray(self._constraints(row)).ravel() for row in particles]).reshape(count, -1)
        over = violation_of(constraints.lower, constraints.upper, values) / self.problem.tolerance
        over = np.where(np.isfinite(over), over, np.inf)
        broken = np.sum(np.where(over > 1, over, 0.0), axis=1)
        return np.where(broken > 0, _WORST * (1 + broken), np.minimum(cost, _WORST))


class _TestCost:
    """Squared relative residual of one test."""

    def __init__(self, smoothed: Smoothed, matrices: Matrices, s: ca.MX, x: ca.MX) -> None:
        self.by_ratios, self.recovery = matrices.by_ratios, matrices.recovery
        self.test, self.shift = smoothed.test, smoothed.shift
        motion = matrices.motion(x)
        parts = [motion.mass, motion.stiffness, motion.damping, motion.push, motion.rigid_body_mass]
        parts += [motion.coupling, motion.base]
        self._expand = _expanded(ca.Function("expand", [s], [ca.densify(part) for part in parts])).map(CHUNK)
        test = smoothed.test
        self._base = columns(test.base)
        records = [test.relative] if test.force is None else [test.relative, test.force]
        self._targets = [
            (columns(record), np.asarray(weight), scale)
            for record, (weight, scale) in zip(records, weights_of_test(test, weighted=True), strict=True)
        ]

    def squared(self, particles: Array) -> Array:
        """Of each candidate, (count,); NaN where it is no structure."""
        count, freq, runs = len(particles), self.test.freq, self.test.n_runs
        M, K, C, B, rigid, M_S0, M_00 = (stacked(np.asarray(part))[:count] for part in self._expand(padded(particles)))
        n = M.shape[1]
        # A candidate that is no structure must not stop the eigensolver for the others.
        broken = ~np.all([np.all(np.isfinite(part), axis=(1, 2)) for part in (M, K, C, B)], axis=0)
        M[broken], K[broken], C[broken], B[broken] = np.eye(n), np.eye(n), 0.0, 0.0
        light = _least(M) <= 0
        M[light] = np.eye(n)
        light |= _least(K) <= 0
        remainder = M_00 - M_S0.swapaxes(1, 2) @ np.linalg.solve(M, M_S0)
        light |= _least(remainder) < -_ROUND_OFF * np.abs(M).max(axis=(1, 2))
        if not self.by_ratios:
            # A damping that feeds energy in is no structure's either.
            light |= _least(C) < -_ROUND_OFF * np.abs(C).max(axis=(1, 2))
        K[light] = np.eye(n)
        a = (_by_modes if self.by_ratios else _by_states)(M, K, C, B, freq, self.shift)  # (count, n, d, n_freq)
        u = self._base.reshape(-1, runs, freq.size)
        a = np.einsum("pndf,drf->pnrf", a, u).reshape(count, n, -1)
        predicted = [self.recovery @ a]
        if len(self._targets) > 1:
            predicted.append(B.swapaxes(1, 2) @ a + rigid @ self._base)
        squared = np.zeros(count)
        for (record, weight, scale), made in zip(self._targets, predicted, strict=True):
            squared += np.sum(np.abs(weight * (made - record)) ** 2, axis=(1, 2)) / scale**2
        squared[broken | light] = np.nan
        return squared


def _least(stack: Array) -> Array:
    """Least eigenvalue of each symmetric matrix; minus infinity where it is no number."""
    bad = ~np.all(np.isfinite(stack), axis=(1, 2))
    clean = np.where(bad[:, None, None], 0.0, (stack + stack.swapaxes(1, 2)) / 2)
    return np.where(bad, -np.inf, np.linalg.eigvalsh(clean)[:, 0])


def _by_modes(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Relative acceleration for unit base motion, damping by ratios (count, n, 1)."""
    L = np.linalg.cholesky((M + M.swapaxes(1, 2)) / 2)
    half = np.linalg.solve(L, K)
    H = np.linalg.solve(L, half.swapaxes(1, 2))
    lam, psi = np.linalg.eigh((H + H.swapaxes(1, 2)) / 2)
    phi = np.linalg.solve(L.swapaxes(1, 2), psi)
    with np.errstate(invalid="ignore"):
        omega = np.sqrt(lam)
    g = np.array([gains(freq, w, zeta.ravel(), shift) for w, zeta in zip(omega, C, strict=True)])
    return np.einsum("pik,pkd,pkf->pidf", phi, phi.swapaxes(1, 2) @ B, g, optimize=True)


def _by_states(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Relative acceleration for unit base motion, from the eigenvalues of the state space: ``a = s² v``."""
    count, n, d = B.shape
    A = np.zeros((count, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:, :n], A[:, n:, n:] = -np.linalg.solve(M, K), -np.linalg.solve(M, C)
    push = np.concatenate([np.zeros((count, n, d)), -np.linalg.solve(M, B)], axis=1)
    s = shift + 2j * np.pi * freq
    lam, vectors = np.linalg.eig(A)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        try:
            strength = np.linalg.solve(vectors, push.astype(complex))
        except np.linalg.LinAlgError:  # a defective candidate among them: each by least squares
            strength = np.linalg.pinv(vectors) @ push
        poles = s**2 / (s - lam[:, :, None])
        return np.einsum("pik,pkd,pkf->pidf", vectors[:, :n], strength, poles, optimize=True)


def _each(function: ca.Function, particles: Array) -> Array:
    return np.array([float(function(row)) for row in particles])


def _expanded(function: ca.Function) -> ca.Function:
    """The same in scalar operations where all of it can be: several times faster for small matrices."""
    try:
        return function.expand()
    except RuntimeError:  # a linear solver or an interpolant inside has no scalar form
        return function
