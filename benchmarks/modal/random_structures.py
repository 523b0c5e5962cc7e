"""Random structures on a moving base, with full mass matrices and close pairs of modes."""

from __future__ import annotations

import numpy as np

import sysid

SIZES, DIRECTIONS = (4, 20), (1, 3)  # both ends included
MASS_UNIT, CONDITION = (-1.0, 3.0), (0.0, 3.0)  # decades: kg, and largest over smallest eigenvalue of M
FIRST, DECADES = (-0.5, 1.5), 1.6  # decades: Hz, and the range of the frequencies
PAIRS, APART = 0.15, (0.002, 0.01)  # share of neighbours that become close pairs, and how close
DAMPING = (0.003, 0.05)
LEAST = 0.1  # % of the rigid-body mass that a mode must carry in some direction


def random_structure(seed: int, *, n: int | None = None, d: int | None = None) -> sysid.Structure:
    """A structure with a full, coupled mass matrix and close pairs of modes.

    Parameters
    ----------
    seed : int
        The same seed, n and d give the same structure.
    n, d : int, optional
        Number of degrees of freedom, each with a sensor along a base direction, and of base
        directions; drawn from 4 to 20 and from 1 to 3 where not given.

    Returns
    -------
    sysid.Structure
        Each direction has a sensor, and each mode an effective mass of at least 0.1 % of the
        rigid-body mass in some direction.

    Notes
    -----
    Frequencies are log-uniform over 1.6 decades. Nothing keeps two of them apart, so that besides the pairs
    made on purpose, 0.2 to 1 % apart, a few are closer still.
    """
    rng = np.random.default_rng(seed)
    drawn_n, drawn_d = int(rng.integers(SIZES[0], SIZES[1] + 1)), int(rng.integers(DIRECTIONS[0], DIRECTIONS[1] + 1))
    n, d = n or drawn_n, d or drawn_d
    unit, condition = 10 ** rng.uniform(*MASS_UNIT), 10 ** rng.uniform(*CONDITION)
    while True:
        structure = _draw(rng, n, d, unit * np.geomspace(1.0, condition, n + d))
        if np.all(structure.effective_mass_percent.max(axis=1) >= LEAST):
            return structure


def frequency_lines(structure: sysid.Structure, count: int | None = None) -> np.ndarray:
    """Lines of a test, Hz: 60 a mode unless `count` is given, from below the first to above the last mode."""
    f = structure.natural_frequencies
    return np.geomspace(0.7 * f[0], 1.3 * f[-1], count or 60 * structure.n)


def _draw(rng: np.random.Generator, n: int, d: int, eigenvalues: np.ndarray) -> sysid.Structure:
    Q = _orthogonal(rng, n + d)
    M = (Q * eigenvalues) @ Q.T
    # At least one sensor a direction, in any order.
    G = np.eye(d)[rng.permutation(np.concatenate([np.arange(d), rng.integers(d, size=n - d)]))]
    half = np.linalg.cholesky(M[:n, :n]) @ _orthogonal(rng, n)
    K_SS = (half * (2 * np.pi * _frequencies(rng, n)) ** 2) @ half.T
    K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
    return sysid.Structure((M + M.T) / 2, (K + K.T) / 2, rng.uniform(*DAMPING, n), n_base=d)


def _frequencies(rng: np.random.Generator, n: int) -> np.ndarray:
    """Natural frequencies, Hz, ascending, some in close pairs."""
    f = np.sort(10 ** (rng.uniform(*FIRST) + rng.uniform(0.0, DECADES, n)))
    paired = rng.random(n) < PAIRS
    for k in range(1, n):
        # Pairs, not rows of three: their neighbours are left alone.
        if paired[k] and not paired[k - 1]:
            f[k] = min(f[k], f[k - 1] * (1 + rng.uniform(*APART)))
    return f


def _orthogonal(rng: np.random.Generator, n: int) -> np.ndarray:
    """An orthogonal matrix, uniform over all of them (Mezzadri, Notices of the AMS 54 (2007) 592)."""
    q, r = np.linalg.qr(rng.standard_normal((n, n)))
    return q * np.sign(np.diag(r))
