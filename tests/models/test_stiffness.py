"""Stiffness models: spectra by SciPy, bounds of the search space, a hand-assembled chain, round trips, refusals."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

from sysid import ChainStiffness, InputError, SpectralStiffness
from sysid.models.geometry import FACTOR_FLOOR, Layout

SEEDS = range(5)


def layout_of(G):
    G = np.asarray(G, dtype=float)
    return Layout(G, np.ones(G.shape[1], bool))


def mass_normalised(model, layout, y, L):
    symbols = ca.SX.sym("y", len(y))
    H = model.mass_normalised(layout, symbols, ca.SX(ca.DM(L)))
    return np.asarray(ca.densify(ca.Function("H", [symbols], [H])(y)))


def random_mass(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T + n * np.eye(n)


class TestSpectral:
    @pytest.mark.parametrize("seed", SEEDS)
    def test_the_spectrum_of_H_is_the_generalized_spectrum(self, seed):
        """H = L^-1 K L^-T has the eigenvalues of K phi = w² M phi, whatever the mass."""
        rng = np.random.default_rng(seed)
        n = 6
        model, layout = SpectralStiffness([1.0, 2, 3, 4, 5, 6]), layout_of(np.ones((n, 1)))
        (variable,) = model.variables(layout)
        y = rng.uniform(variable.lower, variable.upper)
        M = random_mass(rng, n)
        L = np.linalg.cholesky(M)
        H = mass_normalised(model, layout, y, L)
        raw = np.zeros((n, n))
        raw[np.tril_indices(n)] = y
        np.testing.assert_allclose(H, raw @ raw.T, rtol=1e-12)
        lam = scipy.linalg.eigh(L @ H @ L.T, M, eigvals_only=True)
        np.testing.assert_allclose(np.linalg.eigvalsh(H), lam, rtol=1e-8, atol=1e-11 * lam[-1])

    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize("n", [2, 5, 12])
    def test_the_box_holds_every_H_with_a_spectrum_below_the_limit(self, random_orthogonal, seed, n):
        """A row of L_H has the squared norm H_ii <= w_lim² (eq. 36-37)."""
        rng = np.random.default_rng(seed)
        frequencies = np.sort(rng.uniform(1, 50, n))
        for model in (SpectralStiffness(frequencies), SpectralStiffness(frequencies, max_frequency=80.0)):
            layout = layout_of(np.ones((n, 1)))
            (variable,) = model.variables(layout)
            limit = 2 * np.pi * (model.max_frequency or frequencies[-1])
            assert model.limit(n) == pytest.approx(limit)
            assert variable.size == n * (n + 1) // 2
            np.testing.assert_allclose(variable.upper, limit)
            for _ in range(20):
                q = random_orthogonal(rng, n)
                H = (q * (2 * np.pi * frequencies) ** 2) @ q.T
                y = model.values(layout, (H + H.T) / 2, np.zeros((n, n)))
                assert np.all(y <= variable.upper * (1 + 1e-12))
                assert np.all(y[variable.lower < 0] >= variable.lower[variable.lower < 0] * (1 + 1e-12))

    def test_the_diagonal_has_a_floor_above_zero(self):
        model = SpectralStiffness([1.0, 2.0, 3.0])
        (variable,) = model.variables(layout_of(np.ones((3, 1))))
        rows, columns = np.tril_indices(3)
        limit = 6 * np.pi
        np.testing.assert_allclose(variable.lower[rows == columns], FACTOR_FLOOR * limit)
        np.testing.assert_allclose(variable.lower[rows != columns], -limit)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_values_are_the_inverse(self, random_orthogonal, seed):
        rng = np.random.default_rng(seed)
        q = random_orthogonal(rng, 5)
        H = (q * rng.uniform(1e2, 1e5, 5)) @ q.T
        layout, model = layout_of(np.ones((5, 1))), SpectralStiffness([1, 2, 3, 4, 5])
        y = model.values(layout, H, np.zeros((5, 5)))
        np.testing.assert_allclose(mass_normalised(model, layout, y, np.eye(5)), H, rtol=1e-10, atol=1e-7)

    def test_targets_are_the_given_frequencies_in_radians_a_second(self):
        np.testing.assert_allclose(SpectralStiffness([1, 2.5, 2.5]).targets, 2 * np.pi * np.array([1, 2.5, 2.5]))

    @pytest.mark.parametrize(
        ("match", "frequencies", "limit"),
        [
            ("no natural_frequencies", None, None),
            ("positive numbers", [0.0, 1], None),
            ("positive numbers", [-1.0, 1], None),
            ("natural_frequencies holds NaN", [np.nan, 1], None),
            ("positive numbers", [], None),
            ("positive numbers", [[1.0, 2.0, 3.0]], None),
            ("ascending order", [2.0, 1, 3], None),
            ("4 natural frequencies are given or found for 3 sensors", [1.0, 2, 3, 4], None),
            ("state max_frequency", [1.0, 2], None),
            ("max_frequency = 2.5 Hz is below the given natural frequency 3 Hz", [1.0, 2, 3], 2.5),
            ("max_frequency", [1.0, 2, 3], np.nan),
            ("max_frequency", [1.0, 2, 3], np.inf),
        ],
    )
    def test_refusals(self, match, frequencies, limit):
        with pytest.raises(InputError, match=match):
            SpectralStiffness(frequencies, max_frequency=limit).variables(layout_of(np.ones((3, 1))))

    def test_fewer_frequencies_than_sensors_with_a_limit(self):
        (variable,) = SpectralStiffness([1.0, 2.0], max_frequency=9.0).variables(layout_of(np.ones((3, 1))))
        np.testing.assert_allclose(variable.upper, 18 * np.pi)


class TestChain:
    @pytest.mark.parametrize("seed", SEEDS)
    def test_one_direction_is_a_chain_assembled_by_hand(self, seed):
        rng = np.random.default_rng(seed)
        n = 5
        k = rng.uniform(10, 100, n)
        K = np.zeros((n, n))
        for i in range(n):
            K[i, i] = k[i] + (k[i + 1] if i + 1 < n else 0)
            if i:
                K[i, i - 1] = K[i - 1, i] = -k[i]
        layout, model = layout_of(np.ones((n, 1))), ChainStiffness(1.0, 1e3)
        M = random_mass(rng, n)
        L = np.linalg.cholesky(M)
        np.testing.assert_allclose(L @ mass_normalised(model, layout, k, L) @ L.T, K, atol=1e-10)
        np.testing.assert_allclose(model.values(layout, np.zeros((n, n)), np.pad(K, (0, 1))), k, rtol=1e-12)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_two_directions_are_two_chains_in_the_order_of_the_sensors(self, seed):
        """Energy of the springs: each pulls its sensor to the one below it in its own direction."""
        rng = np.random.default_rng(seed)
        groups = np.array([1, 0, 0, 1, 0])
        below = [-1, -1, 1, 0, 2]
        k, u = rng.uniform(10, 100, 5), rng.normal(size=5)
        energy = sum(k[i] * (u[i] - (u[below[i]] if below[i] >= 0 else 0)) ** 2 for i in range(5))
        layout, model = layout_of(np.eye(2)[groups]), ChainStiffness(1.0, 1e3)
        K = mass_normalised(model, layout, k, np.eye(5))
        assert u @ K @ u == pytest.approx(energy, rel=1e-12)
        np.testing.assert_allclose(model.values(layout, np.zeros((5, 5)), np.pad(K, (0, 2))), k, rtol=1e-11)

    def test_sampling_is_logarithmic_and_inverse(self):
        low, high = np.array([1.0, 10.0, 100.0]), np.array([1e3, 20.0, 1e7])
        (variable,) = ChainStiffness(low, high).variables(layout_of(np.ones((3, 1))))
        s = ca.SX.sym("s", 3)
        f = ca.Function("f", [s], [variable.sampling(s)])
        to = lambda values: np.asarray(f(values)).ravel()  # noqa: E731
        np.testing.assert_allclose(to(low), low, rtol=1e-12)
        np.testing.assert_allclose(to(high), high, rtol=1e-12)
        np.testing.assert_allclose(to((low + high) / 2), np.sqrt(low * high), rtol=1e-12)
        k = np.array([3.0, 11.0, 5e5])
        np.testing.assert_allclose(to(variable.unsampling(k)), k, rtol=1e-10)

    @pytest.mark.parametrize(
        ("lower", "upper"),
        [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0, 1.0), (1.0, np.inf), (np.nan, 1.0), ([1, 2, 3], [4, 5, 2])],
    )
    def test_bounds(self, lower, upper):
        with pytest.raises(InputError, match="ChainStiffness: bounds"):
            ChainStiffness(lower, upper).variables(layout_of(np.ones((3, 1))))

    @pytest.mark.parametrize(("lower", "upper"), [([1.0, 2.0], 10.0), (1.0, [10.0, 20.0]), ("soft", 10.0)])
    def test_bounds_of_another_shape(self, lower, upper):
        with pytest.raises(InputError, match="ChainStiffness"):
            ChainStiffness(lower, upper).variables(layout_of(np.ones((3, 1))))

    def test_a_sensor_that_no_direction_moves(self):
        layout = layout_of([[1, 0], [0, 0], [0, 1]])
        with pytest.raises(InputError, match="sensor 2 is moved by no base direction"):
            mass_normalised(ChainStiffness(1.0, 2.0), layout, np.ones(3), np.eye(3))
