"""Problem and SwarmCost: unknowns and back, costs against Structure, bits that do not depend on the batch."""

import dataclasses
import itertools

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import FullMass, InputError, KnownMass, Measurement, Problem, SpectralStiffness
from sysid.models.spectrum import closed_form
from sysid.search import swarm_objective as swarm_cost
from sysid.search.swarm_objective import SwarmCost

SEEDS = range(3)
MASSES = ("trace", "rigid_body", "lumped", "known")
COMBINATIONS = list(itertools.product(MASSES, ("spectral", "chain"), ("modal", "proportional")))
combinations = pytest.mark.parametrize(("mass", "stiffness", "damping"), COMBINATIONS)


def particles(rng, problem, count):
    return rng.uniform(problem.lower, problem.upper, (count, problem.n_variables))


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
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("refine", [False, True])
def test_the_swarms_cost_is_the_residual_of_the_structure(random_case, mass, stiffness, damping, force, refine):
    """With a force, the root of the sum of both squared relative residuals."""
    rng = np.random.default_rng(1)
    _, problem = random_case(rng, mass, stiffness, damping, n=4, force=force)
    cost = SwarmCost(problem, refine=refine)
    rows = particles(rng, problem, 12)
    costs = cost(rows)
    checked = 0
    for s, value in zip(rows, costs, strict=True):
        if not np.isfinite(value):
            continue  # a rigid-body healing without an answer
        structure = problem.structure(cost.refined(s) if refine else cost.unknowns(s))
        expected = np.hypot(problem.measurement.residual(structure), problem.measurement.force_residual(structure) or 0)
        # Both go through the inverse of L: a candidate close to a singular mass loses digits with its condition.
        assert value == pytest.approx(expected, rel=1e-9 + 1e-12 * np.linalg.cond(structure.mass[:4, :4]))
        checked += 1
    assert checked >= 8


@pytest.mark.parametrize("seed", SEEDS)
def test_with_refinement_it_is_the_cost_of_the_closed_form(random_case, seed):
    rng = np.random.default_rng(seed)
    truth, problem = random_case(rng, n=5)
    cost, n = SwarmCost(problem), 5
    for s in particles(rng, problem, 5):
        x = cost.unknowns(s)
        factor = np.zeros((n, n))
        factor[np.tril_indices(n)] = x[problem.parts.stiffness]
        x[problem.parts.stiffness] = closed_form(factor, problem.stiffness.targets).factor[np.tril_indices(n)]
        structure = problem.structure(x)
        np.testing.assert_allclose(structure.natural_frequencies, truth.natural_frequencies, rtol=1e-8)
        assert cost(s[None])[0] == pytest.approx(problem.measurement.residual(structure), rel=1e-8)
        np.testing.assert_allclose(cost.refined(s), x, rtol=1e-12)


@pytest.mark.parametrize(("mass", "stiffness"), [("rigid_body", "spectral"), ("lumped", "chain")])
def test_bits_do_not_depend_on_the_batch_or_the_threads(random_case, monkeypatch, mass, stiffness):
    rng = np.random.default_rng(0)
    _, problem = random_case(rng, mass, stiffness, n=4, force=True)
    rows = particles(rng, problem, 200)
    whole = SwarmCost(problem)(rows)
    for threads in (1, 3):
        monkeypatch.setattr(swarm_cost, "_THREADS", threads)
        cost = SwarmCost(problem)
        np.testing.assert_array_equal(cost(rows), whole)
    for count in (1, 63, 64, 65, 127, 129, 200):
        np.testing.assert_array_equal(cost(rows[:count]), whole[:count])
    order = rng.permutation(200)
    np.testing.assert_array_equal(cost(rows[order]), whole[order])


def test_candidates_that_are_no_structure_are_not_a_number_and_harm_no_other():
    """Sensors at 45 degrees to the base directions: a fair share has no rigid-body healing."""
    rng = np.random.default_rng(0)
    G = np.tile([[1, 1], [-1, 1]], (2, 1)) / np.sqrt(2)
    response = rng.normal(size=(2, 4, 6)) + 0j
    problem = Problem(
        Measurement(np.arange(1, 7), np.ones((2, 2, 6)) * np.eye(2)[:, :, None], response, rigid_body=G),
        mass=FullMass([40.0, 60.0], healing="rigid_body"), stiffness=SpectralStiffness([2.0, 3.0, 4.0, 5.0]),
    )  # fmt: skip
    cost, rows = SwarmCost(problem), particles(rng, problem, 130)
    values = cost(rows)
    good = np.isfinite(values)
    assert 10 < good.sum() < 130
    np.testing.assert_array_equal(cost(rows[good]), values[good])
    for s in rows[good][:10]:
        totals = np.diag(problem.structure(cost.refined(s)).rigid_body_mass)
        np.testing.assert_allclose(totals, [40, 60], rtol=1e-9)


@combinations
def test_sampling_and_unsampling_are_inverse(random_case, mass, stiffness, damping):
    rng = np.random.default_rng(2)
    _, problem = random_case(rng, mass, stiffness, damping, n=4)
    s = ca.SX.sym("s", problem.n_variables)
    forward = ca.Function("f", [s], [problem.from_sampling(s)])
    span = problem.upper - problem.lower
    for _ in range(10):
        x = rng.uniform(problem.lower + 0.05 * span, problem.upper - 0.05 * span)
        sampled = problem.to_sampling(x)
        assert np.all((sampled >= problem.lower) & (sampled <= problem.upper))
        np.testing.assert_allclose(np.asarray(forward(sampled)).ravel(), x, atol=1e-9 * span.max(), rtol=1e-9)
    far = problem.to_sampling(problem.upper + span)
    np.testing.assert_array_equal(far, problem.to_sampling(problem.upper))


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
        assert problem.parts.stiffness == slice(full, full + spectral)
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
        np.testing.assert_array_equal(problem.lower[problem.parts.damping], 0.005)


@pytest.mark.parametrize("mass", MASSES)
def test_totals(random_case, mass):
    truth, problem = random_case(np.random.default_rng(0), mass)
    rigid = np.diag(truth.rigid_body_mass)
    expected = FullMass().total(problem.layout, truth.mass) if mass == "trace" else rigid
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
            ("masses must be positive", {"mass": FullMass(-1.0)}),
            ("masses must be positive", {"mass": sysid.LumpedMass(0.0)}),
            ("total_mass has shape", {"mass": FullMass([1.0, 2.0, 3.0])}),
            ("stiffness is a str", {"stiffness": "soft"}),
            ("stiffness is a ModalDamping", {"stiffness": sysid.ModalDamping()}),
            ("damping is a float", {"damping": 0.02}),
            ("too few to look for", {"stiffness": SpectralStiffness()}),
            ("below the given natural frequency", {"stiffness": SpectralStiffness([1.0, 2, 3], max_frequency=2.0)}),
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

    def test_a_known_mass_that_is_not_positive_definite(self, good):
        with pytest.raises(InputError, match="not positive semidefinite .* or a sensor has no mass"):
            Problem(**(good | {"mass": np.diag([1.0, -1.0, 1.0])}))
        with pytest.raises(InputError, match="not positive definite over the sensors"):
            SwarmCost(Problem(**(good | {"mass": np.ones((3, 3))})))

    def test_a_known_mass_whose_base_rows_are_not_semidefinite(self, good):
        M = np.eye(5)
        M[0, 3] = M[3, 0] = 2.0  # positive definite over the sensors, not with the base
        with pytest.raises(InputError, match="semidefinite"):
            Problem(**(good | {"mass": M}))

    def test_a_chain_through_a_sensor_that_nothing_moves(self, good):
        with pytest.raises(InputError, match="moved by no base direction"):
            SwarmCost(Problem(**(good | {"stiffness": sysid.ChainStiffness(1.0, 10.0)})))

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
        with pytest.raises(InputError, match="check its sign"):
            Problem(wrong, mass=FullMass(), stiffness=problem.stiffness)
