"""Unknowns and back, many candidates at once against Structure, bits that do not depend on the batch, and mistakes."""

import dataclasses
import itertools

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import FullMass, InputError, KnownMass, Measurement, Problem, SpectralStiffness
from sysid.models.expressions import triangle, triangle_entries
from sysid.models.spectrum import nearest_factors
from sysid.problem import batch as candidates

SEEDS = range(2)
MASSES = ("trace", "rigid_body", "lumped", "known")
COMBINATIONS = list(itertools.product(MASSES, ("spectral", "chain"), ("modal", "proportional")))
combinations = pytest.mark.parametrize(("mass", "stiffness", "damping"), COMBINATIONS)


def particles(rng, problem, count):
    return rng.uniform(problem.lower, problem.upper, (count, problem.n_variables))


def sampled(problem, rows):
    """Unknowns for the swarm's coordinates, (count, n_variables)."""
    s = ca.MX.sym("s", problem.n_variables)
    function = ca.Function("sampling", [s], [problem.formulation.from_sampling(s)])
    return np.array([np.asarray(function(row)).ravel() for row in rows])


def batch(problem, rows, spectrum=None):
    """Root of the squared relative residual of each candidate, all at once."""
    return np.sqrt(problem.formulation.own_test.squared(sampled(problem, rows), spectrum))


def refined(problem, x):
    """The unknowns whose spectrum is the stated one: the nearest factor of H with it."""
    x, part, n = x.copy(), problem.formulation.parts.stiffness, problem.geometry.n
    factors = nearest_factors(triangle(x[part], n)[None], problem.formulation.stiffness.spectrum)
    x[part] = triangle_entries(factors[0])
    return x


def same(a, b, rtol):
    for name in ("mass", "stiffness", "damping"):
        x, y = getattr(a, name), getattr(b, name)
        assert np.linalg.norm(x - y) <= rtol * np.linalg.norm(y), name
    np.testing.assert_allclose(a.damping_ratios, b.damping_ratios, rtol=rtol)


@combinations
@pytest.mark.parametrize("force", [False, True])
def test_the_structure_of_the_values_of_a_structure_is_that_structure(random_case, mass, stiffness, damping, force):
    for seed in SEEDS:
        for total in (True, False) if force and mass != "known" else (True,):
            rng = np.random.default_rng([seed, total])
            truth, problem = random_case(rng, mass, stiffness, damping, n=4, force=force, total=total)
            x = problem.values(truth)
            assert x.shape == (problem.n_variables,)
            again = problem.structure(x)
            same(again, truth, 1e-8)
            np.testing.assert_allclose(again.rigid_body, truth.rigid_body, atol=1e-10)
            assert problem.measurement.residual(again) < 1e-7


@combinations
def test_a_batch_has_the_residual_of_each_structure(random_case, mass, stiffness, damping):
    """With a force, here beside each of the models in turn, the root of the sum of both squared relative residuals."""
    force = (stiffness == "chain") == (damping == "modal")
    rng = np.random.default_rng(1)
    _, problem = random_case(rng, mass, stiffness, damping, n=4, force=force)
    rows = particles(rng, problem, 6)
    assert_residuals(problem, rows, refine=False)
    assert problem.formulation.refinable == (stiffness == "spectral")
    if problem.formulation.refinable:
        assert_residuals(problem, rows, refine=True)


def assert_residuals(problem, rows, *, refine):
    found = batch(problem, rows, problem.formulation.stiffness.spectrum if refine else None)
    checked = 0
    for x, value in zip(sampled(problem, rows), found, strict=True):
        if not np.isfinite(value):
            continue  # a rigid-body healing without an answer
        x = refined(problem, x) if refine else x
        structure = problem.structure(x)
        expected = np.hypot(problem.measurement.residual(structure), problem.measurement.force_residual(structure) or 0)
        # Both go through the inverse of L: a candidate close to a singular mass loses digits with its condition.
        tolerance = 1e-9 + 1e-12 * np.linalg.cond(structure.mass[:4, :4])
        assert value == pytest.approx(expected, rel=tolerance)
        assert problem.objective(x) == pytest.approx(expected, rel=tolerance)
        assert problem.residual(x) == pytest.approx(problem.measurement.residual(structure), rel=tolerance)
        checked += 1
    assert checked >= 4


@pytest.mark.parametrize("seed", SEEDS)
def test_with_refinement_it_is_the_residual_of_the_closed_form(random_case, seed):
    rng = np.random.default_rng(seed)
    truth, problem = random_case(rng, n=5)
    spectrum = 2 * np.pi * truth.natural_frequencies
    for s in particles(rng, problem, 5):
        (x,) = sampled(problem, s[None])
        structure = problem.structure(refined(problem, x))
        np.testing.assert_allclose(structure.natural_frequencies, truth.natural_frequencies, rtol=1e-8)
        found = batch(problem, s[None], spectrum)[0]
        assert found == pytest.approx(problem.measurement.residual(structure), rel=1e-8)


@pytest.mark.parametrize(("mass", "stiffness"), [("rigid_body", "spectral"), ("lumped", "chain")])
def test_bits_do_not_depend_on_the_batch_or_the_threads(random_case, monkeypatch, mass, stiffness):
    rng = np.random.default_rng(0)
    _, problem = random_case(rng, mass, stiffness, n=4, force=True)
    rows = sampled(problem, particles(rng, problem, 200))
    whole = problem.formulation.own_test.squared(rows)
    for threads in (1, 3):
        monkeypatch.setattr(candidates, "_THREADS", threads)
        term = problem.prepared.formulate(problem.geometry).own_test
        np.testing.assert_array_equal(term.squared(rows), whole)
    for count in (1, 63, 64, 65, 127, 129, 200):
        np.testing.assert_array_equal(term.squared(rows[:count]), whole[:count])
    order = rng.permutation(200)
    np.testing.assert_array_equal(term.squared(rows[order]), whole[order])


def test_candidates_that_are_no_structure_are_not_a_number_and_harm_no_other():
    """Sensors at 45 degrees to the base directions: a fair share has no rigid-body healing."""
    rng = np.random.default_rng(0)
    G = np.tile([[1, 1], [-1, 1]], (2, 1)) / np.sqrt(2)
    response = rng.normal(size=(2, 4, 6)) + 0j
    problem = Problem(
        Measurement(np.arange(1, 7), np.ones((2, 2, 6)) * np.eye(2)[:, :, None], response, rigid_body=G),
        mass=FullMass([40.0, 60.0], healing="rigid_body"), stiffness=SpectralStiffness([2.0, 3.0, 4.0, 5.0]),
    )  # fmt: skip
    rows, spectrum = particles(rng, problem, 130), 2 * np.pi * np.array([2.0, 3, 4, 5])
    values = batch(problem, rows, spectrum)
    good = np.isfinite(values)
    assert 10 < good.sum() < 130
    np.testing.assert_array_equal(batch(problem, rows[good], spectrum), values[good])
    for x in sampled(problem, rows[good][:10]):
        totals = np.diag(problem.structure(refined(problem, x)).rigid_body_mass)
        np.testing.assert_allclose(totals, [40, 60], rtol=1e-9)
    bad = sampled(problem, rows[~good])[0]
    assert np.isnan(problem.objective(bad))


@combinations
def test_sampling_and_unsampling_are_inverse(random_case, mass, stiffness, damping):
    rng = np.random.default_rng(2)
    _, problem = random_case(rng, mass, stiffness, damping, n=4)
    span = problem.upper - problem.lower
    for _ in range(10):
        x = rng.uniform(problem.lower + 0.05 * span, problem.upper - 0.05 * span)
        s = problem.formulation.to_sampling(x)
        assert np.all((s >= problem.lower) & (s <= problem.upper))
        np.testing.assert_allclose(sampled(problem, s[None])[0], x, atol=1e-9 * span.max(), rtol=1e-9)
    far = problem.formulation.to_sampling(problem.upper + span)
    np.testing.assert_array_equal(far, problem.formulation.to_sampling(problem.upper))


class TestUnknowns:
    @pytest.mark.parametrize(("n", "d"), [(3, 1), (6, 2), (10, 3)])
    def test_table_of_unknowns(self, random_geometry, n, d):
        """Full M over S and 0 (with M_S0, which Table 1 of the paper leaves out), L_H, one ratio a mode."""
        rng = np.random.default_rng(0)
        G = random_geometry(rng, n, d)
        test = Measurement([1.0, 2.0], np.ones((1, d, 2)), rng.normal(size=(1, n, 2)), rigid_body=G)
        stiffness = SpectralStiffness(np.arange(1.0, n + 1))
        problem = Problem(test, mass=FullMass(1.0), stiffness=stiffness)
        full, spectral = (n + d) * (n + d + 1) // 2, n * (n + 1) // 2
        assert full == n * (n + 1) // 2 + n * d + d * (d + 1) // 2
        assert problem.unknowns == (("mass", full), ("stiffness", spectral), ("damping", n))
        assert problem.n_variables == full + spectral + n
        ends = [0, full, full + spectral, full + spectral + n]
        assert problem.formulation.parts == tuple(slice(a, b) for a, b in itertools.pairwise(ends))
        lumped = Problem(test, mass=sysid.LumpedMass(1.0), stiffness=stiffness)
        assert lumped.unknowns == (("mass", n), ("stiffness", spectral), ("damping", n))
        known = Problem(test, mass=np.eye(n), stiffness=stiffness, damping=sysid.ProportionalDamping((0, 1), (0, 1e-3)))
        assert known.unknowns == (("mass", 0), ("stiffness", spectral), ("damping", 2))
        assert isinstance(known.mass, KnownMass)

    def test_a_weighed_total_adds_one_unknown_a_direction(self, random_case):
        rng = np.random.default_rng(0)
        _, problem = random_case(rng, "rigid_body", force=True, total=False, n=4, d=2)
        assert problem.unknowns[0] == ("mass", 2 + 21)
        assert [v.name for v in problem.variables] == ["total_mass", "mass_factor", "stiffness_factor", "damping_ratio"]

    @pytest.mark.parametrize("seed", SEEDS)
    def test_the_search_for_a_total_holds_the_true_one(self, random_case, seed):
        truth, problem = random_case(np.random.default_rng(seed), "rigid_body", force=True, total=False)
        total = np.diag(truth.rigid_body_mass)
        low, high = problem.lower[:2], problem.upper[:2]
        assert np.all((low < total) & (total < high))

    def test_bounds_are_those_of_the_variables(self, random_case):
        _, problem = random_case(np.random.default_rng(0))
        assert problem.lower.shape == problem.upper.shape == (problem.n_variables,)
        assert np.all(problem.lower < problem.upper)
        np.testing.assert_array_equal(problem.lower[problem.formulation.parts.damping], 0.005)


@pytest.mark.parametrize("mass", MASSES)
def test_totals(random_case, mass):
    truth, problem = random_case(np.random.default_rng(0), mass)
    rigid = np.diag(truth.rigid_body_mass)
    strongest = np.argmax(np.abs(np.vstack([truth.rigid_body, np.eye(2)])), axis=1)
    traces = [np.diag(truth.mass)[strongest == i].sum() for i in range(2)]
    expected = traces if mass == "trace" else rigid
    np.testing.assert_allclose(problem.totals, expected, rtol=1e-10)


class TestMistakes:
    @pytest.fixture
    def good(self):
        rng = np.random.default_rng(0)
        test = Measurement([1.0, 2.0, 4.0], np.ones((1, 2, 3)), rng.normal(size=(1, 3, 3)), rigid_body=np.eye(3, 2))
        return {"measurement": test, "mass": FullMass(10.0), "stiffness": SpectralStiffness([1.0, 2.0, 3.0])}

    @pytest.mark.parametrize(
        ("match", "changes"),
        [
            ("measurement is a list", {"measurement": [1, 2]}),
            ("mass is a str", {"mass": "heavy"}),
            ("mass is a", {"mass": 3.0}),
            (r"known mass matrix is \(2, 2\)", {"mass": np.eye(2)}),
            ("mass matrix is not symmetric", {"mass": np.triu(np.ones((3, 3)))}),
            ("total_mass has shape", {"mass": FullMass([1.0, 2.0, 3.0])}),
            ("stiffness is a str", {"stiffness": "soft"}),
            ("stiffness is a ModalDamping", {"stiffness": sysid.ModalDamping()}),
            ("damping is a float", {"damping": 0.02}),
            ("mass is a ModalDamping", {"mass": sysid.ModalDamping()}),
            ("damping is a FullMass", {"damping": FullMass(10.0)}),
            ("damping is a SpectralStiffness", {"damping": SpectralStiffness([1.0, 2.0, 3.0])}),
            ("4 natural frequencies", {"stiffness": SpectralStiffness([1.0, 2, 3, 4])}),
            ("goal", {"goal": 0.0}),
            ("goal", {"goal": -1.0}),
            ("goal", {"goal": np.inf}),
            ("goal", {"goal": np.nan}),
        ],
    )
    def test_refused_at_once_by_name(self, good, match, changes):
        with pytest.raises(InputError, match=match):
            Problem(**(good | changes))

    @pytest.mark.parametrize(
        ("match", "make"),
        [
            ("masses must be positive", lambda: FullMass(-1.0)),
            ("masses must be positive", lambda: sysid.LumpedMass(0.0)),
            ("below the given natural frequency", lambda: SpectralStiffness([1.0, 2, 3], max_frequency=2.0)),
        ],
    )
    def test_a_model_that_is_wrong_for_any_test_is_refused_before_there_is_a_problem(self, match, make):
        with pytest.raises(InputError, match=match):
            make()

    def test_a_known_mass_that_is_not_positive_definite(self, good):
        with pytest.raises(InputError, match="not positive semidefinite .* or a sensor has no mass"):
            Problem(**(good | {"mass": np.diag([1.0, -1.0, 1.0])}))
        with pytest.raises(InputError, match="not positive definite over the sensors"):
            Problem(**(good | {"mass": np.ones((3, 3))}))

    def test_a_known_mass_whose_base_rows_are_not_semidefinite(self, good):
        M = np.eye(5)
        M[0, 3] = M[3, 0] = 2.0  # positive definite over the sensors, not with the base
        with pytest.raises(InputError, match="semidefinite"):
            Problem(**(good | {"mass": M}))

    def test_a_chain_through_a_sensor_that_nothing_moves(self, good):
        with pytest.raises(InputError, match="moved by no base direction"):
            Problem(**(good | {"stiffness": sysid.ChainStiffness(1.0, 10.0)}))

    def test_validation_and_reference_of_other_sensors(self, good, random_structure):
        other = Measurement([1.0], np.ones((1, 1, 1)), np.ones((1, 3, 1)), rigid_body=np.ones((3, 1)))
        with pytest.raises(InputError, match="validation"):
            Problem(**good, validation=[other])
        with pytest.raises(InputError, match="reference"):
            Problem(**good, reference=random_structure(np.random.default_rng(0), n=4, d=2))

    def test_unknowns_of_another_length(self, good):
        problem = Problem(**good)
        for bad in (np.ones(3), np.ones((1, problem.n_variables)), 1.0):
            with pytest.raises(InputError, match="x has shape"):
                problem.structure(bad)

    def test_a_force_of_the_wrong_sign(self, random_case):
        """It is told where lines lie well below the first mode."""
        truth, problem = random_case(np.random.default_rng(0), force=True)
        f = truth.natural_frequencies
        test = sysid.simulate(truth, np.linspace(0.1 * f[0], 1.2 * f[-1], 80), force=True)
        wrong = dataclasses.replace(test, force=-test.force)
        problem = Problem(wrong, mass=FullMass(), stiffness=problem.stiffness)
        with pytest.raises(InputError, match="check its sign"):
            problem.check()

    def test_too_few_lines_to_find_poles(self, good):
        problem = Problem(**(good | {"stiffness": SpectralStiffness()}))
        with pytest.raises(InputError, match="too few to look for"):
            problem.check()


class TestValues:
    """The unknowns of a structure where not every matrix is a model."""

    def test_numbers_have_none_and_variables_that_enter_no_matrix_are_at_their_guess(self, random_structure):
        truth = random_structure(np.random.default_rng(0), n=3, d=1)
        test = sysid.simulate(truth, np.linspace(3, 70, 30))
        u = sysid.Variable("u", 2, lower=0.0, upper=2.0, guess=[0.5, 1.5])
        problem = Problem(test, mass=truth.mass, stiffness=truth.stiffness, residuals=[sysid.Prior(u, 1.0, 0.1)])
        x = problem.values(truth)
        np.testing.assert_allclose(x, [*truth.damping_ratios, 0.5, 1.5], rtol=1e-12)
        same(problem.structure(x), truth, 1e-9)

    @pytest.mark.parametrize("matrix", ["mass", "stiffness", "damping"])
    def test_an_expression_has_no_inverse(self, random_structure, matrix):
        truth = random_structure(np.random.default_rng(0), n=3, d=1)
        scale = sysid.Variable("scale", lower=0.5, upper=2.0)
        given = {"mass": truth.mass, "stiffness": truth.stiffness, "damping": truth.damping}
        problem = Problem(sysid.simulate(truth, [5.0, 9.0]), **given | {matrix: scale * given[matrix]})
        with pytest.raises(InputError, match=f"a {matrix} written in expressions has no inverse"):
            problem.values(truth)
