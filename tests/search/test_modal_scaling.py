"""Modal masses by base force, known mass, lumped mass and totals, against structures that are known."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import FullMass, InputError, KnownMass, LumpedMass, Measurement, Problem, Structure, simulate
from sysid.modal_analysis.modal_fit import ModalFit, Modes, weigh
from sysid.modal_analysis.response import weighted_error
from sysid.nlp import IterationMonitor
from sysid.search.modal import held_to_totals
from sysid.search.stated_masses import nearest_lumped, of_known_mass, stated_totals, to_stated_totals


def lines(truth, count=200):
    f = truth.natural_frequencies
    return np.geomspace(0.6 * f[0], 1.3 * f[-1], count)


def rescaled(truth, t):
    """The modes of `truth` with modal masses that are wrong by `t`."""
    return Modes(
        truth.mode_shapes * np.sqrt(t), truth.participation / np.sqrt(t)[:, None],
        2 * np.pi * truth.natural_frequencies, truth.damping_ratios,
    )  # fmt: skip


def general_test(rng, truth, *, noise=0.0):
    """Runs of complex base motion in all directions at once, with force."""
    freq, d = lines(truth), truth.n_base
    base = rng.normal(size=(d + 1, d, freq.size)) + 1j * rng.normal(size=(d + 1, d, freq.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    force = np.einsum("edf,rdf->ref", truth.base_force(freq), base)
    return Measurement(freq, base, response, rigid_body=truth.rigid_body, force=force)


def lumped(rng, orthogonal, n, d):
    """Diagonal masses without coupling, any stiffness."""
    G = np.eye(d)[np.arange(n) % d]
    masses = rng.uniform(0.5, 3, n)
    half = np.sqrt(masses)[:, None] * orthogonal(rng, n)
    K = (half * (2 * np.pi * np.sort(rng.uniform(4, 60, n))) ** 2) @ half.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return Structure(np.diag([*masses, *np.zeros(d)]), (full + full.T) / 2, rng.uniform(0.01, 0.03, n), n_base=d)


@pytest.mark.parametrize("general", [False, True])
@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
class TestWeigh:
    def test_modal_and_rigid_body_masses_are_exact(self, random_structure, seed, d, general):
        rng = np.random.default_rng([seed, d])
        truth = random_structure(rng, n=4, d=d)
        t = 10 ** rng.uniform(-2, 2, 4)
        test = general_test(rng, truth) if general else simulate(truth, lines(truth), force=True)
        found, rigid = weigh(test, rescaled(truth, t))
        np.testing.assert_allclose(found, t, rtol=1e-8)
        np.testing.assert_allclose(rigid, truth.rigid_body_mass, atol=1e-9 * np.abs(rigid).max())
        np.testing.assert_array_equal(rigid, rigid.T)

    def test_the_wrong_sign_is_refused(self, random_structure, seed, d, general):
        rng = np.random.default_rng([seed, d])
        truth = random_structure(rng, n=4, d=d)
        test = general_test(rng, truth) if general else simulate(truth, lines(truth), force=True, noise=0.02, rng=rng)
        wrong = Measurement(test.freq, test.base, test.response, rigid_body=test.rigid_body, force=-test.force)
        with pytest.raises(InputError, match="negative masses: check its sign"):
            weigh(wrong, rescaled(truth, np.ones(4)))

    def test_so_is_that_of_one_load_cell_by_its_direction(self, random_structure, seed, d, general):
        rng = np.random.default_rng([seed, d])
        truth = random_structure(rng, n=4, d=d)
        test = general_test(rng, truth) if general else simulate(truth, lines(truth), force=True, noise=0.02, rng=rng)
        for i in range(d):
            flipped = test.force * np.where(np.arange(d) == i, -1.0, 1.0)[:, None]
            wrong = Measurement(test.freq, test.base, test.response, rigid_body=test.rigid_body, force=flipped)
            named = (
                "force" if d == 1 else f"force in {'xyz'[i]}" if wrong.base_axes else f"force in base direction {i + 1}"
            )
            with pytest.raises(InputError, match=f"{named} answers to the modes with negative masses: check its sign"):
                weigh(wrong, rescaled(truth, np.ones(4)))


def test_forces_and_moments_count_in_units_of_their_own(random_structure):
    """A moment in N mm weighs no less: with noise, the modal masses do not depend on the unit of length."""
    rng = np.random.default_rng(0)
    truth = random_structure(rng, n=4, d=4)
    test = simulate(truth, lines(truth), force=True, noise=0.02, rng=0)
    unit = np.array([1.0, 1.0, 1.0, 1e-3])
    other = Measurement(
        test.freq, test.base / unit[:, None], test.response, rigid_body=test.rigid_body * unit,
        force=test.force * unit[:, None], base_axes=test.base_axes,
    )  # fmt: skip
    modes = rescaled(truth, np.full(4, 2.0))
    t, rigid = weigh(test, modes)
    t_other, rigid_other = weigh(other, modes._replace(gamma=modes.gamma * unit))
    np.testing.assert_allclose(t_other, t, rtol=1e-8)
    np.testing.assert_allclose(rigid_other, rigid * np.outer(unit, unit), rtol=1e-6, atol=1e-9 * rigid.max())


def test_noise_makes_no_mass_negative(random_structure):
    """A mode that the base hardly moves answers to noise: its mass stays positive, the others stay theirs."""
    rng = np.random.default_rng(1)
    truth = random_structure(rng, n=4, d=2)
    for seed in range(10):
        modes = rescaled(truth, np.ones(4))
        modes.gamma[2] *= 1e-4
        t, _ = weigh(simulate(truth, lines(truth), force=True, noise=0.02, rng=seed), modes)
        assert np.all(t > 0)


def known_pieces(truth):
    """Arguments of the functions of a modal model: P, participations, G and the directions."""
    return np.linalg.inv(truth.mode_shapes), truth.participation, truth.rigid_body


@pytest.mark.parametrize("d", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_a_known_mass_tells_all_modal_masses(random_structure, seed, d):
    rng = np.random.default_rng(seed)
    truth = random_structure(rng, n=4, d=d)
    t = 10 ** rng.uniform(-2, 2, 4)
    modes = rescaled(truth, t)
    found = of_known_mass(truth.mass, np.linalg.inv(modes.phi), modes.gamma, truth.rigid_body)
    np.testing.assert_allclose(found, t, rtol=1e-9)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("model", ["lumped", "full"])
@pytest.mark.parametrize("seed", range(3))
def test_a_lumped_structure_is_its_own_nearest_lumped_one(random_orthogonal, seed, model, d):
    rng = np.random.default_rng([seed, d])
    truth = lumped(rng, random_orthogonal, 6, d)
    groups = np.arange(6) % d
    totals = [np.diag(truth.mass)[:6][groups == i].sum() for i in range(d)]
    mass = LumpedMass(totals) if model == "lumped" else FullMass(totals)
    given = sysid.SpectralStiffness(truth.natural_frequencies)
    problem = Problem(simulate(truth, lines(truth)), mass=mass, stiffness=given)
    t = 10 ** rng.uniform(-1, 1, 6)
    modes = rescaled(truth, t)
    found = nearest_lumped(problem.prepared, np.linalg.inv(modes.phi), modes.gamma, truth.rigid_body, groups)
    # No modal mass is let below a tenth of an equal share.
    np.testing.assert_allclose(found, t, rtol=1e-7)


def test_any_structure_has_a_nearest_lumped_one_with_all_its_modes(random_structure):
    for seed in range(5):
        truth = random_structure(np.random.default_rng(seed), n=5, d=2)
        given = sysid.SpectralStiffness(truth.natural_frequencies)
        problem = Problem(simulate(truth, lines(truth)), mass=FullMass(10.0), stiffness=given)
        t = nearest_lumped(problem.prepared, *known_pieces(truth), problem.geometry.directions[:5])
        assert np.all(t > 0)
        P = known_pieces(truth)[0]
        assert np.linalg.eigvalsh((P.T * t) @ P)[0] > 0


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
@pytest.mark.parametrize("total", [1e-3, [40.0, 70.0], 1e4])
@pytest.mark.parametrize("seed", range(3))
def test_totals_are_met_by_one_factor_and_the_base(random_structure, seed, total, healing):
    """Judged by the model's own total of the mass matrix; nothing that accelerations show has changed."""
    rng = np.random.default_rng(seed)
    truth = random_structure(rng, n=5, d=2)
    given = sysid.SpectralStiffness(truth.natural_frequencies)
    problem = Problem(simulate(truth, lines(truth)), mass=FullMass(total, healing=healing), stiffness=given)
    P, gamma, G = known_pieces(truth)
    remainder = np.array([[2.0, 0.9], [0.9, 1.0]])
    t, left = to_stated_totals(problem.prepared, P, gamma, G, problem.geometry.directions[:5], remainder)
    assert 0 < t <= 1
    M_SS, coupling = t * P.T @ P, t * (P.T @ gamma - P.T @ P @ G)
    delta = np.sqrt(t) * (gamma - P @ G)
    mass = np.block([[M_SS, coupling], [coupling.T, delta.T @ delta + left]])
    np.testing.assert_allclose(problem.mass.total(problem.geometry, mass), np.broadcast_to(total, 2), rtol=1e-9)
    assert np.linalg.eigvalsh(left)[0] > 0
    assert left[0, 1] / np.sqrt(left[0, 0] * left[1, 1]) == pytest.approx(0.9 / np.sqrt(2))


class TestStatedTotals:
    @staticmethod
    def problem(truth, mass, *, force=True):
        given = sysid.SpectralStiffness(truth.natural_frequencies)
        return Problem(simulate(truth, lines(truth), force=force), mass=mass, stiffness=given)

    @pytest.mark.parametrize("healing", ["trace", "rigid_body"])
    def test_the_ties_vanish_where_the_model_has_its_totals_and_nowhere_else(self, random_structure, healing):
        truth = random_structure(np.random.default_rng(2), n=4, d=2)
        model = FullMass([1.0, 1.0], healing=healing)
        totals = model.total(self.problem(truth, model).geometry, truth.mass)
        problem = self.problem(truth, FullMass(totals, healing=healing))
        pieces = truth.mode_shapes, truth.participation, truth.rigid_body_mass
        ties = stated_totals(problem.prepared)
        symbols = [ca.MX.sym("piece", *piece.shape) for piece in pieces]
        off = ca.Function("ties", symbols, [ca.vertcat(*ties(*symbols))])
        np.testing.assert_allclose(np.asarray(off(*pieces)), 0.0, atol=1e-12)
        # Half a kilogram more on the base, in the first direction.
        heavier = pieces[2] + np.diag([0.5, 0.0])
        np.testing.assert_allclose(
            np.asarray(off(*pieces[:2], heavier)).ravel(), [0.5 / totals[0], 0.0], atol=1e-12
        )  # fmt: skip

    def test_there_are_none_without_a_force_or_a_total(self, random_structure):
        truth = random_structure(np.random.default_rng(2), n=4, d=2)
        assert stated_totals(self.problem(truth, FullMass(9.0), force=False).prepared) is None
        assert stated_totals(self.problem(truth, FullMass()).prepared) is None
        assert stated_totals(self.problem(truth, KnownMass(truth.mass)).prepared) is None


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
def test_a_total_that_is_not_stated_is_what_known_masses_make(random_structure, healing):
    """Of a model of some ten grams as well: no kilogram is added to the base."""
    truth = random_structure(np.random.default_rng(4), n=3, d=2)
    small = Structure(0.001 * truth.mass, 0.001 * truth.stiffness, truth.damping_ratios, n_base=2)
    known = np.full((3, 3), np.nan)
    np.fill_diagonal(known, np.diag(small.mass)[:3])
    problem = Problem(simulate(small, lines(small)), mass=FullMass(known=known, healing=healing))
    P, gamma, G = known_pieces(small)
    groups = problem.geometry.directions[:3]
    t, remainder = to_stated_totals(problem.prepared, P, gamma, G, groups, np.eye(2), scaled=True)
    assert t == 1.0
    M_SS, M_S0 = P.T @ P, P.T @ gamma - P.T @ P @ G
    whole = np.block([[M_SS, M_S0], [M_S0.T, (gamma - P @ G).T @ (gamma - P @ G) + remainder]])
    made, least = (
        FullMass(healing=healing).total(problem.geometry, mass)
        for mass in (whole, whole - np.pad(remainder, ((3, 0), (3, 0))))
    )
    np.testing.assert_allclose(made, least, rtol=0.01)
    assert np.all(made > least)


@pytest.mark.parametrize(
    ("noise", "factor", "held"), [(0.0, 1.0, True), (0.0, 1.005, False), (0.05, 1.005, True), (0.05, 1.03, False)]
)
def test_a_total_is_held_where_the_force_weighs_it_and_the_records_allow_it(random_structure, noise, factor, held):
    """Within 1 % of what the force weighs, and where the fit leaves hardly more: else it is met after the fit."""
    truth = random_structure(np.random.default_rng(7), n=3, d=1)
    total = factor * truth.rigid_body_mass[0, 0]
    test = simulate(truth, lines(truth), noise=noise, force=True, rng=1)
    problem = Problem(test, mass=FullMass(total, healing="rigid_body"))
    modes = rescaled(truth, np.ones(3))
    left = weighted_error(test, truth)
    first = ModalFit(modes, truth.rigid_body_mass, left, left, "Solve_Succeeded", "")
    found = held_to_totals(problem.prepared, first, IterationMonitor(None, None), 100)
    assert (found is not None) is held
    if found is not None:
        assert found.rigid[0, 0] == pytest.approx(total, rel=1e-9)
