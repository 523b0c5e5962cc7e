"""Mass models: healing to exact totals, block form, round trips, refusals."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import FullMass, InputError, KnownMass, LumpedMass
from sysid.models.mass import WrittenMass, heal, total_of
from sysid.models.model import mass_blocks

SEEDS = range(4)
HEALINGS = ("trace", "rigid_body")


def evaluate(model, geometry):
    """A function from the model's unknowns to the full matrix (n + d, n + d) and L."""
    size = sum(v.size for v in model.unknowns(geometry))
    y = ca.SX.sym("y", size)
    f = ca.Function("blocks", [y], list(model.blocks(geometry, y))[:3])

    def full(values):
        L, M_S0, M_00 = (np.asarray(block) for block in f(values))
        return np.block([[L @ L.T, M_S0], [M_S0.T, M_00]]), L

    return full


def holding(geometry, mass):
    """A structure with this mass over sensors and base, (n + d, n + d)."""
    G, n = geometry.rigid_body, geometry.n
    K = 1e4 * np.eye(n)
    stiffness = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    return sysid.Structure(mass, stiffness, np.full(n, 0.01), n_base=geometry.d)


def box(model, geometry):
    unknowns = model.unknowns(geometry)
    return np.concatenate([v.lower for v in unknowns]), np.concatenate([v.upper for v in unknowns])


def candidates(rng, model, geometry, count):
    """Random candidates as the swarm draws them: uniform in its box, then through the sampling transform."""
    (variable,) = model.unknowns(geometry)
    s = ca.SX.sym("s", variable.size)
    transform = ca.Function("sampling", [s], [variable.sampling(s)])
    for row in rng.uniform(variable.lower, variable.upper, (count, variable.size)):
        yield np.asarray(transform(row)).ravel()


def rigid_totals(M, G):
    R = np.vstack([G, np.eye(np.shape(G)[1])])
    return np.diag(R.T @ M @ R)


def turned(n, angle):
    """Sensor pairs in the plane of two base directions, turned by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.tile([[c, s], [-s, c]], (n // 2, 1))


class TestFullMass:
    @pytest.mark.parametrize("healing", HEALINGS)
    @pytest.mark.parametrize("seed", SEEDS)
    def test_block_form_is_the_cholesky_factorization_of_the_full_matrix(
        self, geometry_of, random_geometry, healing, seed
    ):
        """L_M is (n + d, n + d), S first (eq. 17, 24): its leading block is L and M = L_M L_M'."""
        rng = np.random.default_rng(seed)
        geometry = geometry_of(np.eye(2)[rng.integers(0, 2, 5)])
        model = FullMass([30.0, 50.0], healing=healing)
        full = evaluate(model, geometry)
        low, high = box(model, geometry)
        y = rng.uniform(low, high)
        M, L = full(y)
        factor = np.linalg.cholesky(M)
        np.testing.assert_allclose(factor[:5, :5], L, atol=1e-9)
        # The rows of the unscaled factor, each times its direction's scale.
        raw = np.zeros((7, 7))
        raw[np.tril_indices(7)] = y
        scales = np.linalg.norm(factor, axis=1) / np.linalg.norm(raw, axis=1)
        np.testing.assert_allclose(factor, scales[:, None] * raw, atol=1e-8)
        for i in range(2):
            rows = geometry.directions == i
            np.testing.assert_allclose(scales[rows], scales[rows][0], rtol=1e-7)

    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize("d", [1, 2, 3, 6])
    def test_trace_healing_makes_each_directions_trace_its_total(self, geometry_of, random_geometry, seed, d):
        rng = np.random.default_rng(seed)
        geometry = geometry_of(random_geometry(rng, 6, d), np.arange(d) < 3)
        totals = rng.uniform(0.5, 200, d)
        full = evaluate(FullMass(totals), geometry)
        for y in candidates(rng, FullMass(totals), geometry, 20):
            M, _ = full(y)
            traces = [np.trace(M[np.ix_(geometry.directions == i, geometry.directions == i)]) for i in range(d)]
            np.testing.assert_allclose(traces, totals, rtol=1e-12)

    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize("d", [1, 2, 3])
    def test_rigid_body_healing_of_sensors_along_the_base_axes_never_fails(self, geometry_of, seed, d):
        rng = np.random.default_rng(seed)
        G = np.eye(d)[rng.integers(0, d, 6)] * rng.choice([-1, 1], (6, 1))
        geometry, totals = geometry_of(G), rng.uniform(0.5, 200, d)
        model = FullMass(totals, healing="rigid_body")
        full = evaluate(model, geometry)
        for y in candidates(rng, model, geometry, 30):
            np.testing.assert_allclose(rigid_totals(full(y)[0], G), totals, rtol=1e-11)

    @pytest.mark.parametrize("angle", [0.1, 0.3, 0.5, np.pi / 4])
    @pytest.mark.parametrize("n", [4, 10])
    def test_coupled_rigid_body_healing_is_exact_or_says_that_it_has_no_answer(self, geometry_of, n, angle):
        """Turned sensors: the scales obey d quadratics. Each candidate has the exact totals, or is not a number; and
        nearly always the latter only where no positive scales exist.

        For d = 2 the two ellipses s'A s = 1 and s'B s = 1 meet in the positive quadrant exactly where s'(A - B)s
        vanishes along a positive direction.
        """
        G, totals = turned(n, angle), np.array([40.0, 60.0])
        geometry, model = geometry_of(G), FullMass(totals, healing="rigid_body")
        full = evaluate(model, geometry)
        rigid = np.vstack([G, np.eye(2)])
        healed, missed, impossible = 0, 0, 0
        for y in candidates(np.random.default_rng(n), model, geometry, 300):
            M, _ = full(y)
            raw = np.zeros((n + 2, n + 2))
            raw[np.tril_indices(n + 2)] = y
            forms = []
            for i in range(2):
                parts = np.array([rigid[geometry.directions == a, i] @ raw[geometry.directions == a] for a in range(2)])
                forms.append(parts @ parts.T / totals[i])
            D = forms[0] - forms[1]
            ratio = np.roots([D[1, 1], 2 * D[0, 1], D[0, 0]])
            exists = np.any((np.abs(ratio.imag) < 1e-12) & (ratio.real > 0))
            if np.all(np.isfinite(M)):
                np.testing.assert_allclose(rigid_totals(M, G), totals, rtol=1e-9)
                assert exists
                healed += 1
            else:
                assert np.all(np.isnan(M[:n, :n]))
                missed, impossible = missed + bool(exists), impossible + (not exists)
        assert missed <= 0.1 * (healed + missed), (healed, missed, impossible)
        assert healed > 100

    @pytest.mark.parametrize("d", [2, 3])
    @pytest.mark.parametrize("seed", SEEDS)
    def test_healing_of_sensors_along_random_axes_is_exact_or_not_a_number(self, geometry_of, random_geometry, d, seed):
        rng = np.random.default_rng(seed)
        G, totals = random_geometry(rng, 6, d), rng.uniform(20, 80, d)
        model, geometry = FullMass(totals, healing="rigid_body"), geometry_of(G)
        full = evaluate(model, geometry)
        healed = 0
        for y in candidates(rng, model, geometry, 100):
            M, _ = full(y)
            if np.all(np.isfinite(M)):
                np.testing.assert_allclose(rigid_totals(M, G), totals, rtol=1e-9)
                healed += 1
            else:
                assert np.all(np.isnan(M[:6, :6]))
        assert healed >= 20

    @pytest.mark.parametrize("columns", [(0, 4), (0, 1, 5), range(6)])
    def test_healing_under_a_base_that_also_rotates_finds_candidates(self, geometry_of, random_blocks, columns):
        """With totals that a real structure has, a fair share of the random candidates can be healed (and exactly)."""
        columns = list(columns)
        d, n, share = len(columns), 6, []
        for seed in SEEDS:
            rng = np.random.default_rng(seed)
            M, _, G = random_blocks(rng, n, 6)
            keep = [*range(n), *(n + c for c in columns)]
            G = G[:, columns]
            totals = rigid_totals(M[np.ix_(keep, keep)], G)
            geometry = geometry_of(G, np.array(columns) < 3)
            model = FullMass(totals, healing="rigid_body")
            full, healed = evaluate(model, geometry), 0
            for y in candidates(rng, model, geometry, 100):
                candidate, _ = full(y)
                if np.all(np.isfinite(candidate)):
                    np.testing.assert_allclose(rigid_totals(candidate, G), totals, rtol=1e-9)
                    healed += 1
            share.append(healed / 100)
            assert candidate.shape == (n + d, n + d)
        assert min(share) >= 0.02

    @pytest.mark.parametrize("healing", HEALINGS)
    @pytest.mark.parametrize("where", ["uniform", "lower", "upper", "corner"])
    def test_positive_definite_everywhere_in_the_box(self, geometry_of, healing, where):
        rng = np.random.default_rng(0)
        geometry = geometry_of(np.eye(2)[[0, 1, 0, 1, 0]])
        model = FullMass([10.0, 20.0], healing=healing)
        full, (low, high) = evaluate(model, geometry), box(model, geometry)
        for _ in range(20):
            corner = np.where(rng.random(low.size) < 0.5, low, high)
            y = {"uniform": rng.uniform(low, high), "lower": low, "upper": high, "corner": corner}[where]
            M, L = full(y)
            assert np.all(np.isfinite(M))
            # L L' for a factor with a positive diagonal is positive definite however small its lowest eigenvalue.
            assert np.all(np.diag(L) > 0)
            assert np.linalg.eigvalsh(M)[0] > -1e-12 * np.trace(M)

    @pytest.mark.parametrize("healing", HEALINGS)
    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize("d", [1, 2, 3, 6])
    @pytest.mark.parametrize("base_mass", [0.0, 1.0])
    def test_values_are_the_inverse_of_blocks(self, geometry_of, random_blocks, healing, seed, d, base_mass):
        """Also for coupled geometry, rotations, and where the base adds nothing beyond its least mass."""
        M, _, G = random_blocks(np.random.default_rng(seed), 5, d, base_mass=base_mass)
        geometry = geometry_of(G, np.arange(d) < 3)
        totals = total_of(geometry, M, healing)
        model = FullMass(totals, healing=healing)
        y = model.values(geometry, holding(geometry, M))
        np.testing.assert_allclose(np.abs(y).max(), 1 / 2)  # away from the box's edge, where sampling loses digits
        again, _ = evaluate(model, geometry)(y)
        np.testing.assert_allclose(again, M, atol=1e-9 * np.abs(M).max())

    def test_values_of_a_massless_base(self, geometry_of, random_blocks):
        M, _, G = random_blocks(np.random.default_rng(1), 4, 2)
        M[4:], M[:, 4:] = 0, 0
        geometry = geometry_of(G)
        for healing in HEALINGS:
            model = FullMass(total_of(geometry, M, healing), healing=healing)
            again, _ = evaluate(model, geometry)(model.values(geometry, holding(geometry, M)))
            np.testing.assert_allclose(again, M, atol=1e-10)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_what_each_healing_calls_the_total(self, geometry_of, random_blocks, seed):
        M, _, G = random_blocks(np.random.default_rng(seed), 5, 2)
        geometry = geometry_of(G)
        np.testing.assert_allclose(total_of(geometry, M, "rigid_body"), rigid_totals(M, G), rtol=1e-12)
        trace = total_of(geometry, M, "trace")
        assert trace.sum() == pytest.approx(np.trace(M))

    def test_a_weighed_total_is_an_unknown_around_what_was_weighed(self, geometry_of):
        geometry = geometry_of(np.eye(2)[[0, 1, 0]], weighed=np.array([40.0, 60.0]))
        for healing in HEALINGS:
            total, factor = FullMass(healing=healing).unknowns(geometry)
            # One direction may hold all skew sensors, and with them what the force weighs in both.
            np.testing.assert_array_equal([total.lower, total.upper], [[10, 15], [400, 400]])
            assert factor.size == 15
            assert len(FullMass(1.0, healing=healing).unknowns(geometry)) == 1
            model = FullMass(healing=healing)
            y = np.concatenate([[33.0, 77.0], np.random.default_rng(0).uniform(0.1, 1, 15)])
            M, _ = evaluate(model, geometry)(y)
            np.testing.assert_allclose(total_of(geometry, M, healing), [33, 77], rtol=1e-12)
            np.testing.assert_allclose(model.values(geometry, holding(geometry, M))[:2], [33, 77], rtol=1e-12)

    def test_without_a_total_each_direction_has_one_kilogram(self, geometry_of):
        geometry = geometry_of(np.eye(2)[[0, 1, 0]])
        M, _ = evaluate(FullMass(healing="rigid_body"), geometry)(np.random.default_rng(0).uniform(0.1, 1, 15))
        np.testing.assert_allclose(rigid_totals(M, geometry.rigid_body), 1, rtol=1e-12)

    def test_a_sensor_of_no_direction_keeps_a_positive_definite_mass(self, geometry_of):
        geometry = geometry_of([[1, 0], [0, 0], [0, 1]])
        for healing in HEALINGS:
            model = FullMass([5.0, 7.0], healing=healing)
            for y in candidates(np.random.default_rng(0), model, geometry, 10):
                M, _ = evaluate(model, geometry)(y)
                assert np.linalg.eigvalsh(M)[0] > 0
                np.testing.assert_allclose(total_of(geometry, M, healing), [5, 7], rtol=1e-10)

    @pytest.mark.parametrize("healing", HEALINGS)
    def test_a_sensor_of_no_direction_takes_the_mean_of_the_scales(self, geometry_of, healing):
        """Of unit rows a sensor and its base row total 2: scales 2 and 3 make 8 and 18, and their mean is 2.5."""
        geometry, totals = geometry_of([[1, 0], [0, 0], [0, 1]]), np.array([8.0, 18.0])
        expected = np.diag([2.0, 2.5, 3.0, 2.0, 3.0])
        healed = heal(ca.SX.eye(5), geometry, totals, healing)
        np.testing.assert_allclose(np.asarray(ca.evalf(ca.densify(healed))), expected, rtol=1e-12)

    def test_healing_that_is_unknown(self):
        with pytest.raises(InputError, match="'magic' is unknown"):
            FullMass(healing="magic")


def test_an_entry_with_two_deviations_has_the_larger_one(geometry_of):
    """One given on either side of the diagonal, or on one side alone; that of the coupling has no other side."""
    nan = np.nan
    known = [[4.0, 0.5, nan, 0.2], [0.5, 3.0, 0.1, nan], [nan, nan, nan, nan]]
    std = [[0.2, 0.1, nan, 0.05], [0.3, 0.0, 0.02, nan], [nan, nan, nan, nan]]
    stated = FullMass(known=known, known_std=std).stated(geometry_of(np.ones((3, 1))))
    expected = np.array([[0.2, 0.3, 0.0, 0.05], [0.3, 0.0, 0.02, 0.0], [0.0, 0.02, 0.0, 0.0]])
    np.testing.assert_array_equal(stated.entries_std, expected)


class TestLumpedMass:
    @pytest.mark.parametrize("seed", SEEDS)
    def test_diagonal_without_coupling_with_the_totals_on_the_sensors(self, geometry_of, seed):
        rng = np.random.default_rng(seed)
        groups = np.array([0, 1, 0, 1, 1])
        geometry, totals = geometry_of(np.eye(2)[groups]), rng.uniform(1, 100, 2)
        model = LumpedMass(totals)
        y = rng.uniform(*box(model, geometry))
        M, _ = evaluate(model, geometry)(y)
        assert np.all(M[5:] == 0)
        np.testing.assert_array_equal(M, np.diag(np.diag(M)))
        for i in range(2):
            share = y[groups == i]
            np.testing.assert_allclose(np.diag(M)[:5][groups == i], totals[i] * share / share.sum(), rtol=1e-12)
        again, _ = evaluate(model, geometry)(model.values(geometry, holding(geometry, M)))
        np.testing.assert_allclose(again, M, rtol=1e-12)

    def test_a_mass_of_a_hundredth_of_the_largest_can_be_found(self, geometry_of):
        """A mast on a roof, say: its shares lie within the bounds."""
        geometry, model = geometry_of(np.ones((3, 1))), LumpedMass(201.0)
        y = model.values(geometry, holding(geometry, np.diag([100.0, 100.0, 1.0, 0.0])))
        lower, upper = box(model, geometry)
        assert np.all((lower <= y) & (y <= upper))

    def test_weighed_totals_are_unknowns(self, geometry_of):
        geometry = geometry_of(np.eye(2)[[0, 1, 0]], weighed=np.array([40.0, 60.0]))
        model = LumpedMass()
        y = np.array([30.0, 90.0, 0.2, 0.5, 0.6])
        M, _ = evaluate(model, geometry)(y)
        np.testing.assert_allclose(np.diag(M), [7.5, 90, 22.5, 0, 0], rtol=1e-12)
        np.testing.assert_allclose(
            evaluate(model, geometry)(model.values(geometry, holding(geometry, M)))[0], M, rtol=1e-12
        )

    def test_a_sensor_of_no_direction_has_a_positive_mass(self, geometry_of):
        geometry = geometry_of([[1, 0], [0, 0], [0, 1]])
        M, _ = evaluate(LumpedMass([5.0, 7.0]), geometry)(np.array([0.5, 0.5, 0.5]))
        np.testing.assert_allclose(np.diag(M)[[0, 2]], [5, 7], rtol=1e-12)
        assert M[1, 1] > 0


class TestKnownMass:
    def test_full_or_over_the_sensors(self, geometry_of, random_blocks):
        M, _, G = random_blocks(np.random.default_rng(0), 4, 2)
        geometry = geometry_of(G)
        assert KnownMass(M).unknowns(geometry) == ()
        np.testing.assert_allclose(evaluate(KnownMass(M), geometry)(np.zeros(0))[0], M, rtol=1e-12, atol=1e-13)
        small, _ = evaluate(KnownMass(M[:4, :4]), geometry)(np.zeros(0))
        np.testing.assert_allclose(small, np.pad(M[:4, :4], (0, 2)), rtol=1e-12, atol=1e-13)

    def test_refusals(self, geometry_of, random_blocks):
        M, _, G = random_blocks(np.random.default_rng(0), 4, 2)
        geometry, y = geometry_of(G), ca.SX(0, 1)
        with pytest.raises(InputError, match=r"is \(5, 5\)"):
            KnownMass(M[:5, :5]).blocks(geometry, y)
        asymmetric, infinite = M.copy(), M.copy()
        asymmetric[0, 1] += 0.1
        infinite[0, 0] = np.nan
        for match, bad in (("mass matrix is not symmetric", asymmetric), ("mass matrix holds NaN or inf", infinite)):
            with pytest.raises(InputError, match=match):
                KnownMass(bad).blocks(geometry, y)
        with pytest.raises(InputError, match="not positive definite over the sensors"):
            KnownMass(np.ones((4, 4))).blocks(geometry, y)
        with pytest.raises(InputError, match="not positive semidefinite .* or a sensor has no mass"):
            KnownMass(np.diag([1.0, 1, -1, 1])).blocks(geometry, y)
        with pytest.raises(InputError, match="a sensor has no mass"):
            KnownMass([[0.0, 1.0], [1.0, 2.0]]).blocks(geometry_of(np.ones((2, 1))), y)

    # [[m, c], [c, 0]] has the determinant -c²: indefinite.
    @pytest.mark.parametrize(("row", "column"), [(0, 2), (1, 3), (2, 3)])
    @pytest.mark.parametrize("coupling", [1e-6, 0.5, 5.0])
    def test_a_base_direction_without_mass_couples_with_nothing(self, geometry_of, row, column, coupling):
        M = np.diag([2.0, 2.0, 0.0, 0.0])
        geometry, y = geometry_of(np.eye(2)), ca.SX(0, 1)
        blocks = KnownMass(M).blocks(geometry, y)
        np.testing.assert_allclose(blocks.base, np.zeros((2, 2)))
        M[row, column] = M[column, row] = coupling
        with pytest.raises(InputError, match="couples a base direction that has no mass"):
            KnownMass(M).blocks(geometry, y)

    def test_a_base_direction_with_mass_may_couple_up_to_its_bound(self, geometry_of):
        geometry, y = geometry_of(np.eye(2)), ca.SX(0, 1)
        M = np.diag([2.0, 2.0, 0.5, 0.0])  # M_00 = 0.5 >= c² / 2 for |c| <= 1
        M[0, 2] = M[2, 0] = 0.999
        np.testing.assert_allclose(np.asarray(ca.DM(KnownMass(M).blocks(geometry, y).coupling))[0, 0], 0.999)
        M[0, 2] = M[2, 0] = 1.001
        with pytest.raises(InputError, match="not positive semidefinite"):
            KnownMass(M).blocks(geometry, y)


class TestWrittenMass:
    """Expressions over sensors, or with the base's rows last; M is what is written, also where it is indefinite."""

    @staticmethod
    def numbers(parts, *at):
        symbols = [variable.symbol for variable, _ in at]
        function = ca.Function("f", symbols, [ca.densify(ca.MX(part)) for part in parts])
        return [np.asarray(part) for part in function.call([ca.DM(value) for _, value in at])]

    def test_blocks_with_and_without_base_rows(self, geometry_of, random_blocks):
        whole, _, G = random_blocks(np.random.default_rng(0), 3, 2)
        geometry, s = geometry_of(G), sysid.Variable("s", lower=0.5, upper=2)
        for size in (3, 5):
            model = WrittenMass(s * whole[:size, :size])
            assert model.unknowns(geometry) == ()
            blocks = mass_blocks(model.blocks(geometry, ca.MX(0, 1)), geometry)
            L, M_S0, M_00, M = self.numbers(blocks, (s, 1.5))
            expected = np.pad(1.5 * whole[:size, :size], (0, 5 - size))
            np.testing.assert_allclose(M, expected[:3, :3], rtol=1e-14)
            np.testing.assert_allclose(L, np.linalg.cholesky(expected[:3, :3]), rtol=1e-12, atol=1e-14)
            np.testing.assert_allclose(M_S0, expected[:3, 3:], rtol=1e-14)
            np.testing.assert_allclose(M_00, expected[3:, 3:], rtol=1e-14)

    def test_an_indefinite_matrix_is_itself(self, geometry_of):
        geometry, c = geometry_of(np.ones((2, 1))), sysid.Variable("c", lower=-3, upper=3, guess=0.1)
        blocks = mass_blocks(WrittenMass([[1, c], [c, 1]]).blocks(geometry, ca.MX(0, 1)), geometry)
        (M,) = self.numbers([blocks.mass], (c, 2.0))
        np.testing.assert_array_equal(M, [[1, 2], [2, 1]])

    def test_numbers_have_no_unknowns_and_variables_no_inverse(self, geometry_of):
        geometry = geometry_of(np.ones((2, 1)))
        structure = holding(geometry, np.diag([1.0, 2, 3]))
        held = sysid.Variable("held", lower=0, upper=2, guess=1, fixed=True)
        for given in (ca.MX(ca.DM.eye(2)), ca.SX.eye(2), held * ca.DM.eye(2)):
            assert WrittenMass(given).values(geometry, structure).shape == (0,)
        with pytest.raises(InputError, match="mass written in expressions has no inverse"):
            WrittenMass(sysid.Variable("m", lower=0, upper=2) * np.eye(2)).values(geometry, structure)


class TestStated:
    """Statement of each model about its matrix, by hand."""

    @staticmethod
    def same(stated, *, free, entries=None, totals=None, kind=None, sentence=""):
        assert stated.free is free
        assert stated.sentence == sentence
        assert (stated.spectrum, stated.positive) == (None, None)
        for made, expected in ((stated.entries, entries), (stated.totals and stated.totals.values, totals)):
            assert (made is None) is (expected is None)
            if expected is not None:
                np.testing.assert_array_equal(made, expected)
        assert (stated.totals and stated.totals.kind) == kind

    def test_full(self, geometry_of):
        geometry = geometry_of(np.eye(2)[[0, 1]])
        self.same(FullMass().stated(geometry), free=True)
        self.same(FullMass(12.0).stated(geometry), free=True, totals=[12, 12], kind="trace")
        rigid = FullMass([5.0, 6.0], healing="rigid_body")
        self.same(rigid.stated(geometry), free=True, totals=[5, 6], kind="rigid_body")
        whole = [[5.0, 1.0], [1.0, 6.0]]
        rigid = FullMass(whole, healing="rigid_body")
        self.same(rigid.stated(geometry), free=True, totals=whole, kind="rigid_body")

    def test_full_with_known_entries(self, geometry_of):
        geometry, nan = geometry_of(np.ones((2, 1))), np.nan
        known = FullMass(known=[[3.0, 0.5], [nan, nan]])
        entries = [[3.0, 0.5, nan], [0.5, nan, nan]]
        sentence = "2 entries of the mass matrix stated to be known"
        self.same(known.stated(geometry), free=True, entries=entries, sentence=sentence)
        known = FullMass(7.0, known=[[nan, nan, 0.2], [nan, nan, nan]])
        entries = [[nan, nan, 0.2], [nan, nan, nan]]
        sentence = "1 entry of the mass matrix stated to be known"
        self.same(known.stated(geometry), free=True, entries=entries, totals=[7], kind="trace", sentence=sentence)

    def test_lumped(self, geometry_of):
        geometry, nan = geometry_of(np.ones((2, 1))), np.nan
        entries, sentence = [[nan, 0, 0], [0, nan, 0]], "the mass is stated to be lumped on the sensors"
        self.same(LumpedMass().stated(geometry), free=False, entries=entries, sentence=sentence)
        sentence += ", with its total given"
        lumped = LumpedMass(9.0).stated(geometry)
        self.same(lumped, free=False, entries=entries, totals=[9], kind="sensors", sentence=sentence)

    def test_known_and_written(self, geometry_of):
        geometry, M = geometry_of(np.ones((2, 1))), np.array([[3.0, 1, 0.5], [1, 2, 0], [0.5, 0, 1]])
        sentence = "the mass matrix is known"
        self.same(KnownMass(M).stated(geometry), free=False, entries=M[:2], sentence=sentence)
        small = np.hstack([M[:2, :2], np.zeros((2, 1))])
        self.same(KnownMass(M[:2, :2]).stated(geometry), free=False, entries=small, sentence=sentence)
        self.same(WrittenMass(sysid.Variable("m", lower=0, upper=2) * np.eye(2)).stated(geometry), free=False)

    def test_totals_that_do_not_fit_are_refused(self, geometry_of):
        geometry = geometry_of(np.ones((2, 1)))
        for model in (FullMass([1.0, 2.0]), LumpedMass([1.0, 2.0])):
            with pytest.raises(InputError, match="total_mass has shape"):
                model.stated(geometry)
