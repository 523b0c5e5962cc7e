"""The swarm's cost: the residual of a whole swarm at once, on compiled CasADi functions."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.modal_analysis.response import residual
from sysid.models.spectrum import closed_form, replace_spectrum
from sysid.models.stiffness import SpectralStiffness
from sysid.problem.problem import Problem
from sysid.structure.structure import Array
from sysid.structure.triangular import triangle, triangle_entries

CHUNK = 64  # particles a compiled call: fixed, so that the bits do not depend on the swarm's size
_THREADS = 2  # of CasADi's own; the bits do not depend on it


class SwarmCost:
    """Relative residual of a whole swarm at once: (n_particles, n_variables) → (n_particles,).

    Two compiled CasADi functions with LAPACK's batched eigensolver between them, which also does
    the eigenvalue refinement in closed form.

    Parameters
    ----------
    problem : Problem
    refine : bool
        Replace the spectrum of each candidate by the measured one, where the stiffness has one.
    """

    def __init__(self, problem: Problem, *, refine: bool = True) -> None:
        self.problem = problem
        layout, D = problem.layout, problem.n_variables
        n, d = layout.n, layout.d
        s = ca.SX.sym("s", D)
        x = problem.from_sampling(s)
        blocks = problem.matrices(x)
        L, G = blocks.factor, ca.SX(layout.rigid_body)
        L_inverse = ca.densify(ca.solve(L, ca.SX.eye(n)))
        push = L @ (L.T @ G) + blocks.coupling
        rigid = G.T @ push + blocks.coupling.T @ G + blocks.base
        outputs = [ca.densify(block) for block in (L_inverse, push, blocks.mass_normalised, rigid, blocks.damping)]
        self._expand = ca.Function("expand", [s], outputs).map(CHUNK)
        self._unknowns = ca.Function("unknowns", [s], [x])

        shapes = {"phi": (n, n), "gamma": (n, d), "omega": (n, 1), "rigid": (d, d), "c": blocks.damping.shape}
        phi, gamma, omega, rigid_mx, c = (ca.MX.sym(name, *shape) for name, shape in shapes.items())
        miss = residual(problem.measurement, phi, gamma, omega, problem.damping.ratios(c, omega), rigid_mx)
        cost = ca.sqrt(ca.sumsqr(miss))
        self._evaluate = ca.Function("cost", [phi, gamma, omega, rigid_mx, c], [cost]).map(CHUNK, "thread", _THREADS)
        stiffness = problem.stiffness
        self._targets = stiffness.targets if refine and isinstance(stiffness, SpectralStiffness) else None

    def __call__(self, particles: Array) -> Array:
        """Relative residual of each row; NaN where a candidate is no structure."""
        return np.concatenate(
            [self._chunk(particles[start : start + CHUNK]) for start in range(0, len(particles), CHUNK)]
        )

    def unknowns(self, s: Array) -> Array:
        """The unknowns x that the swarm coordinates `s` stand for."""
        return np.asarray(self._unknowns(s)).ravel()

    def refined(self, s: Array) -> Array:
        """The unknowns of the structure that `s` was given its cost for: its spectrum replaced."""
        x = self.unknowns(s)
        if self._targets is not None:
            n, part = self.problem.layout.n, self.problem.parts.stiffness
            x[part] = triangle_entries(closed_form(triangle(x[part], n), self._targets).factor)
        return x

    def _chunk(self, particles: Array) -> Array:
        count = len(particles)
        n = self.problem.layout.n
        flat = [np.asarray(block) for block in self._expand(padded(particles))]
        L_inverse, push, H = (stacked(block) for block in flat[:3])
        # A candidate that is no structure must not stop the eigensolver for the others.
        broken = ~np.all(np.isfinite(H), axis=(1, 2))
        H[broken] = np.eye(n)
        lam, psi = np.linalg.eigh((H + H.transpose(0, 2, 1)) / 2)
        if self._targets is not None:
            lam = replace_spectrum(lam, self._targets)
        with np.errstate(invalid="ignore"):
            omega = np.sqrt(lam)
        phi = L_inverse.transpose(0, 2, 1) @ psi
        gamma = phi.transpose(0, 2, 1) @ push
        cost = self._evaluate(_wide(phi), _wide(gamma), omega.T, flat[3], flat[4])
        out = np.array(cost).ravel()[:count]
        out[broken[:count]] = np.nan
        return out


def padded(particles: Array) -> Array:
    """Candidates side by side, as a compiled call takes them: the last one again and again fills the chunk."""
    return np.concatenate([particles, np.repeat(particles[-1:], CHUNK - len(particles), axis=0)]).T


def stacked(wide: Array) -> Array:
    """CasADi's side-by-side blocks (rows, CHUNK * columns) → (CHUNK, rows, columns)."""
    return np.ascontiguousarray(wide.reshape(wide.shape[0], CHUNK, -1).transpose(1, 0, 2))


def _wide(stack: Array) -> Array:
    """Inverse of `stacked`."""
    return stack.transpose(1, 0, 2).reshape(stack.shape[1], -1)
