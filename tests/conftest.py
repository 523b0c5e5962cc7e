"""Random structures that the tests share, built from modes and geometry so that their properties are known beforehand."""

import numpy as np
import pytest

import sysid


def _geometry(rng, n, d):
    """Rows [e', (r x e)'] of n sensors at random places along random axes, the first d columns."""
    r, e = rng.uniform(-1, 2, (n, 3)), rng.normal(size=(n, 3))
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    return np.hstack([e, np.cross(r, e)])[:, :d]


def _orthogonal(rng, n):
    q, r = np.linalg.qr(rng.normal(size=(n, n)))
    return q * np.sign(np.diag(r))


def _blocks(rng, n, d, *, frequencies=None, base_mass=1.0, G=None):
    """Full M and K, and G: M_SS well conditioned, frequencies as asked, M_00 = its least + base_mass · (a random SPD)."""
    G = _geometry(rng, n, d) if G is None else G
    if frequencies is None:
        frequencies = np.sort(rng.uniform(4, 60, n))
    q = _orthogonal(rng, n)
    M_SS = (q * rng.uniform(0.5, 3, n)) @ q.T
    L = np.linalg.cholesky(M_SS)
    half = L @ _orthogonal(rng, n)
    K_SS = (half * (2 * np.pi * np.asarray(frequencies)) ** 2) @ half.T
    M_S0 = 0.3 * rng.normal(size=(n, d))
    w = rng.normal(size=(d, d))
    M_00 = M_S0.T @ np.linalg.solve(M_SS, M_S0) + base_mass * (w @ w.T + 0.1 * np.eye(d))
    M = np.block([[M_SS, M_S0], [M_S0.T, M_00]])
    K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
    return (M + M.T) / 2, (K + K.T) / 2, G


def _structure(rng, n=4, d=2, *, damping="ratios", ratios=None, **options):
    """A random `sysid.Structure`; damping "ratios", or "matrix": dampers that couple the modes."""
    M, K, _ = _blocks(rng, n, d, **options)
    if damping == "ratios":
        return sysid.Structure(M, K, rng.uniform(0.006, 0.04, n) if ratios is None else ratios, n_base=d)
    L = np.linalg.cholesky(M[:n, :n])
    x = L @ rng.normal(size=(n, n))
    C = x @ x.T * 2 * 0.02 * 2 * np.pi * 20 / n + 1e-4 * K[:n, :n]
    return sysid.Structure(M, K, n_base=d, damping_matrix=(C + C.T) / 2)


@pytest.fixture
def random_geometry():
    return _geometry


@pytest.fixture
def random_orthogonal():
    return _orthogonal


@pytest.fixture
def random_blocks():
    return _blocks


@pytest.fixture
def random_structure():
    return _structure
