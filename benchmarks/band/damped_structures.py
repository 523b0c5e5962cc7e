r"""Structures with a dashpot between two floors, and their tests, from the complex modes of M, K and C.

With states v, v' the relative motion has poles lambda and shapes psi of the state matrix; line by line

.. math:: a = w^2 (K - w^2 M + i w C)^{-1} B u_0''.

A record of a sum of cosines that are no lines of it, cut in motion, is that response summed over the cosines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

import sysid
from benchmarks.band.structures import log_uniform
from benchmarks.records.simulated import random_motion

QUADRATURE = (0.003, 0.05)  # of the residue of the mode that has most: norm of imaginary parts over that of real ones
VISIBLE = 0.002  # of the rigid-body mass, that each mode has at least
NOISE = (0.003, 0.01)
FLOORS = (3, 8)
RATIOS = (0.008, 0.02)
LINES = (0.5, 1.25)  # of the first and the last frequency
SPREAD_LINES, PEAK_LINES, PEAK = 30, 13, 4.0  # lines a mode: over all frequencies, and within so many half widths
ECCENTRIC = 0.05  # of a storey's spring
PERIODS = (60, 100)  # of the first mode, in a record
RATE = 3.2  # samples a period of the last line


@dataclass(frozen=True, eq=False)
class Damped:
    """A structure, and how it is tested.

    Attributes
    ----------
    mass, stiffness : (n + d, n + d)
    damping : (n, n)
    rigid_body : (n, d)
    noise : float
        Over each channel's rms.
    quadrature : float
        Of the residue of the mode that has most, norm of imaginary parts over that of real ones; zero where the damping
        is classical.
    records : bool
        Whole records, else spectra.
    """

    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    rigid_body: np.ndarray
    noise: float
    quadrature: float
    records: bool

    @property
    def blocks(self) -> tuple[np.ndarray, ...]:
        """M_SS, K_SS, C, B = M_SS G + M_S0 and the rigid-body mass."""
        n, G = len(self.damping), self.rigid_body
        M, M_S0 = self.mass[:n, :n], self.mass[:n, n:]
        rigid = np.vstack([G, np.eye(G.shape[1])])
        return M, self.stiffness[:n, :n], self.damping, M @ G + M_S0, rigid.T @ self.mass @ rigid

    @property
    def omega(self) -> np.ndarray:
        """Circular frequencies of the undamped modes, rad/s, (n,)."""
        M, K, *_ = self.blocks
        return np.sqrt(scipy.linalg.eigh(K, M, eigvals_only=True))

    @property
    def lines(self) -> tuple[float, float]:
        """First and last line, Hz."""
        f = self.omega / (2 * np.pi)
        return LINES[0] * f[0], LINES[1] * f[-1]

    def response(self, omega: np.ndarray) -> np.ndarray:
        """Absolute accelerations, then forces, for unit base accelerations, (n + d, d, lines)."""
        M, K, C, B, rigid = self.blocks
        w = np.asarray(omega)[:, None, None]
        a = np.moveaxis(np.linalg.solve(K - w**2 * M + 1j * w * C, w**2 * B + 0j), 0, -1)
        force = np.einsum("ie,idf->edf", B, a) + rigid[:, :, None]
        return np.concatenate([a + self.rigid_body[:, :, None], force])


def residues_in_quadrature(M: np.ndarray, K: np.ndarray, C: np.ndarray, B: np.ndarray) -> float:
    """Largest norm of a mode's residue in quadrature over that of the rest, from the poles of the state matrix."""
    n, inverse = len(M), np.linalg.inv(M)
    state = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ C]])
    poles, right = np.linalg.eig(state)
    left = np.linalg.inv(right)
    up = poles.imag > 0
    # Those of classical damping have one angle each, which only the origin of phases sets.
    residues = np.einsum("k,ik,kd->kid", poles[up], right[:n, up], left[up][:, n:] @ inverse @ B)
    turned = [one * np.exp(-0.5j * np.angle(np.sum(one**2))) for one in residues]
    return float(max(np.linalg.norm(one.imag) / np.linalg.norm(one.real) for one in turned))


def damped(number: int, *, classical: bool = False) -> Damped:
    """The structure of this number: floors in one or two directions, springs between them; or its classical twin."""
    rng = np.random.default_rng((number, 27))
    n, d = int(rng.integers(FLOORS[0], FLOORS[1] + 1)), 1 + number % 2
    G = np.eye(d)[np.arange(n) % d]
    goal, noise = (float(log_uniform(rng, ends)) for ends in (QUADRATURE, NOISE))
    least = 0.0
    while least < VISIBLE:
        mass, K = _matrices(rng, G)
        M = mass[:n, :n]
        squares, phi = scipy.linalg.eigh(K, M)
        rigid = np.trace(mass) / d
        least = float(np.min(np.max((phi.T @ M @ G) ** 2, axis=1)) / rigid)
    P = phi.T @ M
    C = P.T @ np.diag(2 * rng.uniform(*RATIOS, n) * np.sqrt(squares)) @ P
    at = int(rng.integers(d, n))
    dashpot = np.outer(*(2 * [np.eye(n)[at] - np.eye(n)[at - d]]))
    size = 0.0
    if not classical:
        size = scipy.optimize.brentq(lambda c: residues_in_quadrature(M, K, C + c * dashpot, M @ G) - goal, 0.0, 2e3)
    stiffness = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return Damped(mass, stiffness, C + size * dashpot, G, noise, 0.0 if classical else goal, number % 4 >= 2)


def _matrices(rng: np.random.Generator, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masses of floors and base, (n + d, n + d), and K_SS: each floor on the one below it in its direction."""
    n, d = G.shape
    mass = np.diag(np.concatenate([rng.uniform(70, 130, n), rng.uniform(30, 60, d)]))
    K, springs = np.zeros((n, n)), rng.uniform(0.7, 1.4, n) * 2e5
    springs[1::2] *= 1.7 if d == 2 else 1.0
    for i, spring in enumerate(springs):
        one = np.eye(n)[i] - (np.eye(n)[i - d] if i >= d else 0.0)
        K += spring * np.outer(one, one)
        if d == 2:  # columns out of the centre
            both = np.eye(n)[i] + np.eye(n)[(i + 1) % n]
            K += ECCENTRIC * spring * np.outer(both, both)
    return mass, K


def draw_of(structure: Damped, number: int, draw: int = 0) -> sysid.Measurement:
    """One draw of its test, with noise: spectra, a run a base axis, or a whole record of random motion."""
    rng = np.random.default_rng((number, draw, 28))
    return (of_record if structure.records else of_spectra)(structure, rng)


def of_spectra(structure: Damped, rng: np.random.Generator) -> sysid.Measurement:
    """Stepped sines, closer lines about the peaks; noise on responses and forces, its deviations stated."""
    (low, high), f = structure.lines, structure.omega / (2 * np.pi)
    n, d = structure.rigid_body.shape
    widths = RATIOS[1] * np.tan(np.linspace(-1, 1, PEAK_LINES) * np.arctan(PEAK))
    lines = np.concatenate([np.geomspace(low, high, SPREAD_LINES * n), (f[:, None] * (1 + widths)).ravel()])
    freq = np.unique(lines[(lines >= low) & (lines <= high)])
    base = np.eye(d)[:, :, None] * np.ones(freq.size, complex)
    clean = np.einsum("cdf,rdf->rcf", structure.response(2 * np.pi * freq), base)
    std = structure.noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=-1, keepdims=True)) * np.ones(freq.size)
    noisy = clean + std * (rng.standard_normal((2, *clean.shape)) * [[[[1]]], [[[1j]]]]).sum(axis=0) / np.sqrt(2)
    return sysid.Measurement(
        freq, base, noisy[:, :n], rigid_body=structure.rigid_body, force=noisy[:, n:], response_std=std[:, :n],
        force_std=std[:, n:], base_axes="xy"[:d],
    )  # fmt: skip


def of_record(structure: Damped, rng: np.random.Generator) -> sysid.Measurement:
    """One run of random motion along all base axes, cut in motion; white noise on all channels, base included."""
    (low, high), (n, d) = structure.lines, structure.rigid_body.shape
    rate, duration = RATE * high, float(log_uniform(rng, PERIODS)) * 2 * np.pi / structure.omega[0]
    motion = random_motion(rng, duration, rate, (0.9 * low, 1.1 * high), correlation=np.eye(d))
    outputs = motion.in_time(np.einsum("cdf,df->cf", structure.response(motion.omega), motion.amplitudes))
    both = np.vstack([motion.in_time(motion.amplitudes), outputs])
    level = structure.noise * np.sqrt(np.mean(both**2, axis=1, keepdims=True))
    both = both + level * rng.standard_normal(both.shape)
    return sysid.Measurement.from_time(
        [(both[:d], both[d : d + n], both[d + n :])], rate, rigid_body=structure.rigid_body, band=(low, high),
        base_axes="xy"[:d],
    )  # fmt: skip
