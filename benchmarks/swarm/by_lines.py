"""The swarm's objective in batched NumPy, line by line: what the objective without lines is compared with."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

import sysid
from sysid.models.mass import sampling_exponent

CHUNK = 16  # candidates at once: what their lines take stays in a core's cache
THREADS = 2


class ByLines:
    """Relative residual of candidates with the stated spectrum, (count, n_variables) swarm coordinates to (count,).

    Of a test with any base motion, sensors along the base directions, with or without base force, and a
    `sysid.FullMass` healed by its trace. Everything is written out from the paper's equations, for all candidates of a
    chunk at once and with two threads.

    Parameters
    ----------
    problem : sysid.Problem
    """

    def __init__(self, problem: sysid.Problem) -> None:
        test = problem.measurement
        self.n, self.d = test.rigid_body.shape
        self.G, self.totals = test.rigid_body, problem.totals
        self.groups = np.append(np.argmax(np.abs(self.G), axis=1), range(self.d))
        self.w, self.omega = 2 * np.pi * test.freq, 2 * np.pi * np.asarray(problem.stiffness.natural_frequencies)
        size = self.n + self.d
        self.of_mass, self.of_factor = np.tril_indices(size), np.tril_indices(self.n)
        self.exponents = np.array([sampling_exponent(k) for k in range(1, size + 1)])[self.of_mass[0]]
        self.lower = problem.lower[: self.exponents.size]
        self.base, self.target = test.base, test.relative
        self.size, self.force = np.linalg.norm(self.target), test.force
        self.pool = ThreadPoolExecutor(THREADS)

    def __call__(self, particles: np.ndarray) -> np.ndarray:
        """Relative residual of each row."""
        starts = range(0, len(particles), CHUNK)
        return np.concatenate(list(self.pool.map(lambda at: self._chunk(particles[at : at + CHUNK]), starts)))

    def _chunk(self, s: np.ndarray) -> np.ndarray:
        ends = np.cumsum([self.exponents.size, self.of_factor[0].size])
        of_mass, of_stiffness, ratios = np.split(s, ends, axis=1)
        factors = self._mass_factors(of_mass)
        phi, gamma = self._modes(factors, of_stiffness)
        squared = self._squared(phi, gamma, ratios) / self.size**2
        if self.force is not None:
            squared += self._squared_force(factors, gamma, ratios)
        return np.sqrt(squared)

    def _gains(self, ratios: np.ndarray) -> np.ndarray:
        """Eq. 14: gains of modes, (count, modes, lines)."""
        loss = (2j * ratios * self.omega)[:, :, None] * self.w
        return self.w**2 / (self.omega[:, None] ** 2 - self.w**2 + loss)

    def _squared(self, phi: np.ndarray, gamma: np.ndarray, ratios: np.ndarray) -> np.ndarray:
        """Eq. 14 and 15: squared difference from the records, (count,)."""
        gains, squared = self._gains(ratios), np.zeros(len(phi))
        for base, target in zip(self.base, self.target, strict=True):
            made = phi @ (gains * (gamma @ base)) - target
            flat = made.reshape(len(phi), -1).view(float)
            squared += np.einsum("pi,pi->p", flat, flat)
        return squared

    def _squared_force(self, factors: np.ndarray, gamma: np.ndarray, ratios: np.ndarray) -> np.ndarray:
        """Squared difference of the force ``gamma' g gamma u + M_rb u``, relative to the measured one, (count,)."""
        moved = np.hstack([self.G.T, np.eye(self.d)]) @ factors
        gains, rigid, squared = self._gains(ratios), moved @ moved.swapaxes(1, 2), np.zeros(len(gamma))
        for base, force in zip(self.base, self.force, strict=True):
            made = gamma.swapaxes(1, 2) @ (gains * (gamma @ base)) + rigid @ base - force
            squared += np.sum(np.abs(made) ** 2, axis=(1, 2))
        return squared / np.linalg.norm(self.force) ** 2

    def _mass_factors(self, s: np.ndarray) -> np.ndarray:
        """Eq. 18 and 21-22: Cholesky factors of the healed mass, (count, n + d, n + d)."""
        size = self.n + self.d
        factors = np.zeros((len(s), size, size))
        y = np.sign(s) * (1 - (1 - np.abs(s)) ** self.exponents)
        factors[:, self.of_mass[0], self.of_mass[1]] = np.maximum(y, self.lower)
        squares = np.einsum("pij,pij->pi", factors, factors)
        traces = np.stack([squares[:, self.groups == i].sum(axis=1) for i in range(self.d)], axis=1)
        return factors * np.sqrt(self.totals / traces)[:, self.groups, None]

    def _modes(self, factors: np.ndarray, of_stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mode shapes (count, n, modes) and participations (count, modes, d)."""
        n = self.n
        L, Z = factors[:, :n, :n], factors[:, n:, :n]
        L_H = np.zeros((len(factors), n, n))
        L_H[:, self.of_factor[0], self.of_factor[1]] = of_stiffness
        psi = np.linalg.eigh(L_H @ L_H.swapaxes(1, 2))[1]
        phi = self._shapes(L, psi)
        return phi, psi.swapaxes(1, 2) @ (L.swapaxes(1, 2) @ self.G + Z.swapaxes(1, 2))

    def _shapes(self, L: np.ndarray, psi: np.ndarray) -> np.ndarray:
        """Mode shapes ``L^-T psi``."""
        return np.linalg.inv(L).swapaxes(1, 2) @ psi


class ByLinesBySubstitution(ByLines):
    """The same with substitution: a general inverse loses digits of an ill-conditioned triangle of many rows."""

    def _shapes(self, L: np.ndarray, psi: np.ndarray) -> np.ndarray:
        """As above, one candidate after the other."""
        return np.stack([solve_triangular(own, to, lower=True, trans="T") for own, to in zip(L, psi, strict=True)])


class ByLinesOfUnitRuns(ByLines):
    """The same where each run moves one direction by one unit: in real arithmetic, all runs in one product."""

    def _squared(self, phi: np.ndarray, gamma: np.ndarray, ratios: np.ndarray) -> np.ndarray:
        """As above."""
        detuning = self.omega[:, None] ** 2 - self.w**2
        loss = (2 * ratios * self.omega)[:, :, None] * self.w
        size = self.w**2 / (detuning**2 + loss**2)
        gains = np.concatenate([size * detuning, -size * loss], axis=2)
        residues = gamma.swapaxes(1, 2)[:, :, None] * phi[:, None]  # (count, runs, n, modes)
        made = residues.reshape(len(phi), self.d * self.n, self.n) @ gains
        made -= self.parts
        flat = made.reshape(len(phi), -1)
        return np.einsum("pi,pi->p", flat, flat)

    @cached_property
    def parts(self) -> np.ndarray:
        """The records, a run's sensors below each other, real and imaginary parts side by side."""
        target = self.target.reshape(self.d * self.n, -1)
        return np.hstack([target.real, target.imag])
