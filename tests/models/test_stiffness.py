"""Stiffness models: spectra by SciPy, bounds of the search space, a hand-assembled chain, round trips, refusals."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

import sysid
from sysid import ChainStiffness, InputError, SpectralStiffness
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.models.model import FACTOR_FLOOR, Geometry, MassBlocks, stiffness_blocks
from sysid.models.spectrum import Refinement
from sysid.models.stiffness_and_damping import WrittenStiffness

SEEDS = range(5)


def blocks(model, geometry, y, L):
    """K_SS and H at the unknowns `y`, L the Cholesky factor of M_SS."""
    symbols, L = ca.SX.sym("y", len(y)), ca.SX(ca.DM(L))
    made = stiffness_blocks(model.blocks(geometry, symbols, MassBlocks(L, None, None, L @ L.T)), L)
    K, H = ca.Function("blocks", [symbols], [ca.densify(part) for part in made])(y)
    return np.asarray(K), np.asarray(H)


def mass_normalised(model, geometry, y, L):
    return blocks(model, geometry, y, L)[1]


def holding(geometry, K, M=None):
    """A structure with this stiffness over the sensors, of unit masses where none are given."""
    G, n, d = geometry.rigid_body, geometry.n, geometry.d
    whole = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    M = np.pad(np.eye(n) if M is None else M, (0, d))
    return sysid.Structure(M, whole, np.full(n, 0.01), n_base=d)


def random_mass(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T + n * np.eye(n)


class TestSpectral:
    @pytest.mark.parametrize("seed", SEEDS)
    def test_the_spectrum_of_H_is_the_generalized_spectrum(self, geometry_of, seed):
        """H = L^-1 K L^-T has the eigenvalues of K phi = w² M phi, whatever the mass."""
        rng = np.random.default_rng(seed)
        n = 6
        model, geometry = SpectralStiffness([1.0, 2, 3, 4, 5, 6]), geometry_of(np.ones((n, 1)))
        (variable,) = model.unknowns(geometry)
        y = rng.uniform(variable.lower, variable.upper)
        M = random_mass(rng, n)
        L = np.linalg.cholesky(M)
        K, H = blocks(model, geometry, y, L)
        raw = np.zeros((n, n))
        raw[np.tril_indices(n)] = y
        np.testing.assert_allclose(H, raw @ raw.T, rtol=1e-12)
        lam = scipy.linalg.eigh(K, M, eigvals_only=True)
        np.testing.assert_allclose(np.linalg.eigvalsh(H), lam, rtol=1e-8, atol=1e-11 * lam[-1])

    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize("n", [2, 5, 12])
    def test_the_box_holds_every_H_with_a_spectrum_below_the_limit(self, geometry_of, random_orthogonal, seed, n):
        """A row of L_H has the squared norm H_ii <= w_lim² (eq. 36-37)."""
        rng = np.random.default_rng(seed)
        frequencies = np.sort(rng.uniform(1, 50, n))
        for model in (SpectralStiffness(frequencies), SpectralStiffness(frequencies, max_frequency=80.0)):
            geometry = geometry_of(np.ones((n, 1)))
            (variable,) = model.unknowns(geometry)
            limit = 2 * np.pi * (model.max_frequency or frequencies[-1])
            assert model.limit(geometry) == pytest.approx(limit)
            assert variable.size == n * (n + 1) // 2
            np.testing.assert_allclose(variable.upper, limit)
            for _ in range(20):
                q = random_orthogonal(rng, n)
                H = (q * (2 * np.pi * frequencies) ** 2) @ q.T
                y = model.values(geometry, holding(geometry, (H + H.T) / 2))
                assert np.all(y <= variable.upper * (1 + 1e-12))
                assert np.all(y[variable.lower < 0] >= variable.lower[variable.lower < 0] * (1 + 1e-12))

    def test_the_diagonal_has_a_floor_above_zero(self, geometry_of):
        model = SpectralStiffness([1.0, 2.0, 3.0])
        (variable,) = model.unknowns(geometry_of(np.ones((3, 1))))
        rows, columns = np.tril_indices(3)
        limit = 6 * np.pi
        np.testing.assert_allclose(variable.lower[rows == columns], FACTOR_FLOOR * limit)
        np.testing.assert_allclose(variable.lower[rows != columns], -limit)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_values_are_the_inverse(self, geometry_of, random_orthogonal, seed):
        rng = np.random.default_rng(seed)
        q = random_orthogonal(rng, 5)
        H = (q * rng.uniform(1e2, 1e5, 5)) @ q.T
        geometry, model = geometry_of(np.ones((5, 1))), SpectralStiffness([1, 2, 3, 4, 5])
        M = random_mass(rng, 5)
        L = np.linalg.cholesky(M)
        K = L @ H @ L.T
        y = model.values(geometry, holding(geometry, (K + K.T) / 2, M))
        np.testing.assert_allclose(mass_normalised(model, geometry, y, L), H, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(blocks(model, geometry, y, L)[0], K, rtol=1e-9, atol=1e-6)

    def test_a_candidate_that_ipopt_could_not_refine_takes_the_closed_form(self, monkeypatch):
        """Of a diagonal H that is the spectrum itself on the diagonal."""
        answers = iter([
            Refinement(np.array([[1.0, 0.0], [2.0, 3.0]]), 0.0, True, "solved"),
            Refinement(np.array([[8.0, 0.0], [9.0, 8.0]]), 0.5, False, "not solved"),
        ])  # fmt: skip
        monkeypatch.setattr(
            "sysid.models.stiffness_and_damping.by_ipopt", lambda factor, targets, max_time: next(answers)
        )
        rows = np.array([[5.0, 1.0, 6.0], [3.0, 0.0, 5.0]])
        refined, statuses = SpectralStiffness().with_spectrum(rows, np.array([4.0, 7.0]), by_solver=True)
        np.testing.assert_allclose(refined, [[1, 2, 3], [4, 0, 7]], atol=1e-12)
        assert statuses == ("solved", "not solved")

    def test_targets_are_the_given_frequencies_in_radians_a_second(self, geometry_of):
        geometry = geometry_of(np.ones((3, 1)))
        targets = SpectralStiffness([1, 2.5, 2.5]).targets(geometry)
        np.testing.assert_allclose(targets, 2 * np.pi * np.array([1, 2.5, 2.5]))

    @pytest.mark.parametrize(
        ("match", "frequencies", "limit"),
        [
            ("positive numbers", [0.0, 1], None),
            ("positive numbers", [-1.0, 1], None),
            ("natural_frequencies holds NaN", [np.nan, 1], None),
            ("positive numbers", [], None),
            ("positive numbers", [[1.0, 2.0, 3.0]], None),
            ("ascending order", [2.0, 1, 3], None),
            ("4 natural frequencies are given for 3 sensors", [1.0, 2, 3, 4], None),
            ("max_frequency = 2.5 Hz is below the given natural frequency 3 Hz", [1.0, 2, 3], 2.5),
            ("max_frequency", [1.0, 2, 3], np.nan),
            ("max_frequency", [1.0, 2, 3], np.inf),
            ("max_frequency = 0.0: a positive number", None, 0.0),
            ("max_frequency = -2.0: a positive number", None, -2.0),
            ("max_frequency", None, "high"),
        ],
    )
    def test_refusals(self, geometry_of, match, frequencies, limit):
        with pytest.raises(InputError, match=match):
            SpectralStiffness(frequencies, max_frequency=limit).unknowns(geometry_of(np.ones((3, 1))).unsearched())

    def test_fewer_frequencies_than_sensors_with_a_limit(self, geometry_of):
        (variable,) = SpectralStiffness([1.0, 2.0], max_frequency=9.0).unknowns(geometry_of(np.ones((3, 1))))
        np.testing.assert_allclose(variable.upper, 18 * np.pi)

    def test_fewer_frequencies_than_sensors_are_searched_up_to_the_last_line(self, geometry_of):
        geometry = geometry_of(np.ones((3, 1)))
        assert SpectralStiffness([1.0, 2.0]).limit(geometry) == pytest.approx(2 * np.pi * geometry.test.freq[-1])


class TestChain:
    @pytest.mark.parametrize("seed", SEEDS)
    def test_one_direction_is_a_chain_assembled_by_hand(self, geometry_of, seed):
        rng = np.random.default_rng(seed)
        n = 5
        k = rng.uniform(10, 100, n)
        K = np.zeros((n, n))
        for i in range(n):
            K[i, i] = k[i] + (k[i + 1] if i + 1 < n else 0)
            if i:
                K[i, i - 1] = K[i - 1, i] = -k[i]
        geometry, model = geometry_of(np.ones((n, 1))), ChainStiffness(1.0, 1e3)
        M = random_mass(rng, n)
        L = np.linalg.cholesky(M)
        made, H = blocks(model, geometry, k, L)
        np.testing.assert_allclose(made, K, atol=1e-12)
        np.testing.assert_allclose(L @ H @ L.T, K, atol=1e-10)
        np.testing.assert_allclose(model.values(geometry, holding(geometry, K)), k, rtol=1e-12)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_two_directions_are_two_chains_in_the_order_of_the_sensors(self, geometry_of, seed):
        """Energy of the springs: each pulls its sensor to the one below it in its own direction."""
        rng = np.random.default_rng(seed)
        groups = np.array([1, 0, 0, 1, 0])
        below = [-1, -1, 1, 0, 2]
        k, u = rng.uniform(10, 100, 5), rng.normal(size=5)
        energy = sum(k[i] * (u[i] - (u[below[i]] if below[i] >= 0 else 0)) ** 2 for i in range(5))
        geometry, model = geometry_of(np.eye(2)[groups]), ChainStiffness(1.0, 1e3)
        K = mass_normalised(model, geometry, k, np.eye(5))
        assert u @ K @ u == pytest.approx(energy, rel=1e-12)
        np.testing.assert_allclose(model.values(geometry, holding(geometry, K)), k, rtol=1e-11)

    def test_sampling_is_logarithmic_and_inverse(self, geometry_of):
        low, high = np.array([1.0, 10.0, 100.0]), np.array([1e3, 20.0, 1e7])
        (variable,) = ChainStiffness(low, high).unknowns(geometry_of(np.ones((3, 1))))
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
    def test_bounds(self, geometry_of, lower, upper):
        with pytest.raises(InputError, match="ChainStiffness: bounds"):
            ChainStiffness(lower, upper).unknowns(geometry_of(np.ones((3, 1))))

    @pytest.mark.parametrize(("lower", "upper"), [([1.0, 2.0], 10.0), (1.0, [10.0, 20.0]), ("soft", 10.0)])
    def test_bounds_of_another_shape(self, geometry_of, lower, upper):
        with pytest.raises(InputError, match="ChainStiffness"):
            ChainStiffness(lower, upper).unknowns(geometry_of(np.ones((3, 1))))

    def test_a_sensor_that_no_direction_moves(self, geometry_of):
        geometry = geometry_of([[1, 0], [0, 0], [0, 1]])
        with pytest.raises(InputError, match="sensor 2 is moved by no base direction"):
            mass_normalised(ChainStiffness(1.0, 2.0), geometry, np.ones(3), np.eye(3))

    def test_a_sensor_against_the_direction_turns_the_sign_of_its_coupling(self, geometry_of):
        """The second of two, read backwards: v2 = -x2, so that k2 couples with +k2."""
        geometry, model = geometry_of([[1.0], [-1.0]]), ChainStiffness(1.0, 10.0)
        K, _ = blocks(model, geometry, [3.0, 2.0], np.eye(2))
        np.testing.assert_allclose(K, [[5, 2], [2, 2]], rtol=1e-14)
        np.testing.assert_allclose(model.values(geometry, holding(geometry, K)), [3, 2], rtol=1e-12)

    @pytest.mark.parametrize(
        ("G", "translates"),
        [([[1.0, 0.0], [0.6, 0.8]], [True, True]), ([[1.0], [0.5]], [True]), ([[1.0, 1.0], [1.0, 0.0]], [True, False])],
    )
    def test_sensors_along_no_one_direction_are_refused(self, geometry_of, G, translates):
        geometry = geometry_of(G, translates)
        with pytest.raises(InputError, match="each sensor must point along one base direction"):
            ChainStiffness(1.0, 10.0).stated(geometry)


class TestStated:
    """Statement of each model about its matrix, by hand."""

    def test_spectral(self, geometry_of):
        stated = SpectralStiffness([1.0, 2.0, 2.0]).stated(geometry_of(np.ones((3, 1))))
        np.testing.assert_allclose(stated.spectrum, 2 * np.pi * np.array([1, 2, 2]))
        assert stated.free
        assert (stated.entries, stated.totals, stated.positive, stated.sentence) == (None, None, None, "")

    def test_without_frequencies_the_poles_of_the_records_are(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=3, d=1, frequencies=[5.0, 9.0, 16.0])
        geometry = Geometry(ModalEstimate.of_lines(sysid.simulate(s, np.linspace(2, 20, 200))))
        spectrum = SpectralStiffness().stated(geometry).spectrum
        np.testing.assert_allclose(spectrum, 2 * np.pi * np.array([5, 9, 16]), rtol=1e-6)
        assert SpectralStiffness().limit(geometry) == pytest.approx(2 * np.pi * 16, rel=1e-6)

    def test_with_fewer_modes_than_sensors_the_last_line_is_the_limit(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=3, d=1, frequencies=[5.0, 9.0, 300.0])
        geometry = Geometry(ModalEstimate.of_lines(sysid.simulate(s, np.linspace(2, 20, 200))))
        assert SpectralStiffness().targets(geometry).size < 3
        assert SpectralStiffness().limit(geometry) == pytest.approx(2 * np.pi * 20)
        assert SpectralStiffness(max_frequency=400.0).limit(geometry) == pytest.approx(2 * np.pi * 400)

    def test_chain(self, geometry_of):
        """Sensors 1 and 3 on one direction, 2 on the other."""
        stated, nan = ChainStiffness(1.0, 1e3).stated(geometry_of(np.eye(2)[[0, 1, 0]])), np.nan
        expected = [[nan, 0, nan, nan, 0], [0, nan, 0, 0, nan], [nan, 0, nan, 0, 0]]
        np.testing.assert_array_equal(stated.entries, expected)
        k = np.array([7.0, 5.0, 3.0])
        K = np.array([[10.0, 0, -3], [0, 5, 0], [-3, 0, 3]])
        np.testing.assert_allclose(np.sum(stated.positive * K, axis=(1, 2)), k)
        assert not stated.free
        assert (stated.totals, stated.spectrum) == (None, None)
        assert stated.sentence == "the stiffness is stated to be a chain"

    def test_written(self, geometry_of):
        stated = WrittenStiffness(np.eye(3)).stated(geometry_of(np.ones((3, 1))))
        assert not stated.free
        assert (stated.entries, stated.totals, stated.spectrum, stated.positive) == (None, None, None, None)


class TestWritten:
    K = np.array([[5.0, -2.0], [-2.0, 2.0]])  # springs 3 and 2 from the base up

    def whole(self, sign=-1.0):
        return np.block([[self.K, sign * np.array([[3.0], [0.0]])], [sign * np.array([[3.0, 0.0]]), 3.0]])

    def test_base_rows_are_checked_and_cut_off(self, geometry_of):
        geometry, mass = geometry_of(np.ones((2, 1))), MassBlocks(None, None, None)
        for given in (self.K, self.whole()):
            made = WrittenStiffness(given).blocks(geometry, ca.MX(0, 1), mass)
            np.testing.assert_array_equal(np.asarray(ca.densify(ca.evalf(made))), self.K)
        with pytest.raises(InputError, match="K_S0 must be -K_SS G"):
            WrittenStiffness(self.whole(1.0)).blocks(geometry, ca.MX(0, 1), mass)

    def test_numbers_have_no_unknowns_and_variables_no_inverse(self, geometry_of):
        geometry = geometry_of(np.ones((2, 1)))
        structure = holding(geometry, self.K)
        held = sysid.Variable("held", lower=0, upper=2, guess=1, fixed=True)
        for given in (self.K, self.whole(), held * self.K):
            assert WrittenStiffness(given).unknowns(geometry) == ()
            assert WrittenStiffness(given).values(geometry, structure).shape == (0,)
        with pytest.raises(InputError, match="stiffness written in expressions has no inverse"):
            WrittenStiffness(sysid.Variable("k", lower=0, upper=2) * self.K).values(geometry, structure)
