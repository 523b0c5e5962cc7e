"""The local phase: what it reaches, what it keeps, and what it says."""

import dataclasses
import functools
import itertools
import time
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import FullMass, SpectralStiffness
from sysid.modal_analysis.modal_fit import ModalFit
from sysid.modal_analysis.residues import linear_residues
from sysid.models.spectrum import SOLVED
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor, NonlinearProgram
from sysid.search import local
from sysid.search.local import _gauss_newton
from sysid.search.modal_coordinates import (
    _linear_starts,
    _regular_inverse,
    add_unknowns,
    fit_in_modes,
    frequencies,
    modes_of,
)
from sysid.search.swarm_objective import SwarmObjective

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MASSES, DAMPINGS = ("trace", "rigid_body", "lumped", "known"), ("modal", "proportional")


def refined(problem, x):
    """The unknowns with the measured spectrum."""
    formulation, x = problem.formulation, x.copy()
    if formulation.refinable:
        part = formulation.parts.stiffness
        x[part] = formulation.with_spectrum(x[None, part], formulation.stiffness.spectrum)[0][0]
    return x


def random_start(rng, problem):
    """A random candidate of the swarm with the measured spectrum."""
    objective = SwarmObjective(problem.prepared)
    for row in rng.uniform(problem.lower, problem.upper, (50, problem.n_variables)):
        if np.isfinite(objective(row[None])[0]):
            return refined(problem, objective.unknowns(row))
    raise AssertionError("no random candidate is a structure")


def near(rng, problem, truth, by):
    """The truth, every unknown off by up to a fraction, with the measured spectrum."""
    x = problem.values(truth) * rng.uniform(1 - by, 1 + by, problem.n_variables)
    return refined(problem, np.clip(x, problem.lower, problem.upper))


def total_error(problem, structure):
    mass = problem.mass
    if isinstance(mass, FullMass):
        got = mass.total(problem.geometry, structure.mass)
    else:
        got = np.diag(structure.rigid_body_mass)
    return np.max(np.abs(got / problem.totals - 1))


def sound(problem, answer):
    """Whatever the solver's end: a structure (Structure checks M, K), finite, with the stated totals."""
    structure = problem.structure(answer.x)
    n = structure.n
    assert np.all(np.isfinite(answer.x))
    assert np.linalg.eigvalsh(structure.mass[:n, :n])[0] > 0
    assert np.linalg.eigvalsh(structure.stiffness[:n, :n])[0] > 0
    assert total_error(problem, structure) < 1e-9
    residual, solved = problem.measurement.residual(structure), any(good in answer.message for good in SOLVED)
    assert answer.success or not solved
    # At round-off IPOPT may find no further step and call that a failure.
    assert solved or not answer.success or residual < 1e-8
    return residual


# Of twelve random starts, how many at least end below 1e-6 and below 1e-8. Over 120 other starts each (48 where the
# mass is structured) the rates are 0.97 and 0.87 (full, modal), 0.86 and 0.83 (full, proportional), 0.94 and 0.94
# (structured, modal), 0.79 and 0.79 (structured, proportional): each bound fails by chance once in a hundred at most.
KINDS = {"full": ("trace", "rigid_body"), "structured": ("lumped", "known")}
LEAST = {
    ("full", "modal"): (5, 4), ("full", "proportional"): (4, 4),
    ("structured", "modal"): (4, 4), ("structured", "proportional"): (3, 3),
}  # fmt: skip


@pytest.fixture(scope="module")
def from_random_start(random_case):
    """Give a function that searches a noise-free test with a spectral stiffness from a random start, each once.

    It returns the problem, the answer, and what the monitor was told.
    """

    @functools.cache
    def searched(mass, damping, n, seed):
        rng, seen = np.random.default_rng([seed, n]), []
        _, problem = random_case(rng, mass, "spectral", damping, n=n)
        start = random_start(rng, problem)
        answer = local.solve(problem.prepared, start, max_iterations=300, monitor=lambda *args: seen.append(args))
        return problem, answer, seen

    return searched


@pytest.mark.parametrize(("kind", "damping"), list(LEAST))
def test_from_random_starts_most_searches_end_at_the_truth_of_a_noise_free_test(from_random_start, kind, damping):
    """n = 4, once 5 and 6, by turns with one mass and the other. Not convex: some starts end in another minimum."""
    residuals = []
    for i, (n, seed) in enumerate([(4, 0), (4, 1), (4, 2), (4, 3), (5, 0), (6, 0)]):
        problem, answer, _ = from_random_start(KINDS[kind][i % 2], damping, n, seed)
        residuals.append(sound(problem, answer))
    found, exact = LEAST[kind, damping]
    assert sum(r < 1e-6 for r in residuals) >= found, residuals
    assert sum(r < 1e-8 for r in residuals) >= exact, residuals


@pytest.mark.parametrize("mass", KINDS["full"])
def test_a_local_minimum_of_the_residues_is_seen_and_left(from_random_start, mass):
    """With all poles free a search from random shapes may end where linear least squares at its own poles fits better:
    then further attempts are made, the curve spans them all, and the best of them is the answer."""
    again = []
    for seed in (2, 3, 4, 13):
        problem, answer, seen = from_random_start(mass, "modal", 4, seed)
        assert [iteration for iteration, _ in seen] == list(range(answer.curve.size))
        np.testing.assert_array_equal([residual for _, residual in seen], answer.curve)
        residual = sound(problem, answer)
        assert residual == pytest.approx(answer.curve.min(), rel=1e-2, abs=1e-9)
        if "as the first ended in a local minimum" in answer.message:
            assert any(f"best of {count} starts" in answer.message for count in (2, 3))
            again.append(residual)
    assert len(again) >= 2
    assert np.median(again) < 1e-6, again


@pytest.mark.parametrize(("mass", "damping", "force"), list(itertools.product(MASSES, DAMPINGS, (False, True))))
def test_from_near_the_truth_every_search_of_a_spectral_stiffness_ends_there(random_case, mass, damping, force):
    rng = np.random.default_rng([0, 4])
    truth, problem = random_case(rng, mass, "spectral", damping, n=4, force=force)
    answer = local.solve(problem.prepared, near(rng, problem, truth, 0.05), max_iterations=300)
    assert sound(problem, answer) < 1e-8
    if force:
        assert problem.measurement.force_residual(problem.structure(answer.x)) < 1e-8


@pytest.mark.parametrize(("mass", "damping"), list(itertools.product(MASSES, DAMPINGS)))
def test_from_near_the_truth_every_search_of_a_chain_ends_there(random_case, mass, damping):
    """A full mass with a chain leaves directions open along which IPOPT still creeps when its iterations end."""
    goal = 1e-8 if mass in ("lumped", "known") else 1e-4
    rng = np.random.default_rng([0, 4])
    truth, problem = random_case(rng, mass, "chain", damping, n=4)
    answer = local.solve(problem.prepared, near(rng, problem, truth, 0.01), max_iterations=200)
    assert sound(problem, answer) < goal


@pytest.mark.parametrize("mass", ["rigid_body", "lumped", "known"])
@pytest.mark.parametrize("seed", range(2))
def test_records_that_want_negative_damping_end_on_the_bound_and_say_so(random_case, mass, seed):
    """Spectra of the other sign convention, exp(-i w t): the factors press on 0 and must not come out below it."""
    rng = np.random.default_rng(seed)
    truth, problem = random_case(rng, mass, "spectral", "proportional", n=4)
    mirrored = dataclasses.replace(problem.measurement, response=problem.measurement.response.conj())
    problem = dataclasses.replace(problem, measurement=mirrored, reference=None)
    answer = local.solve(problem.prepared, near(rng, problem, truth, 0.01), max_iterations=60)
    assert "rayleigh" in answer.message
    assert np.all(answer.x[problem.formulation.parts.damping] >= 0)
    assert np.all(problem.structure(answer.x).damping_ratios >= 0)


@pytest.mark.parametrize("seed", range(2))
def test_a_determined_problem_gives_the_true_matrices(random_case, seed):
    rng = np.random.default_rng(seed)
    for mass, force in (("rigid_body", True), ("lumped", False), ("known", False)):
        truth, problem = random_case(rng, mass, n=4, force=force)
        answer = local.solve(problem.prepared, near(rng, problem, truth, 0.05))
        structure = problem.structure(answer.x)
        for name in ("mass", "stiffness", "damping"):
            a, b = getattr(structure, name)[:4, :4], getattr(truth, name)[:4, :4]
            assert np.linalg.norm(a - b) < 1e-6 * np.linalg.norm(b), (mass, name)


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
@pytest.mark.parametrize("seed", range(2))
def test_a_stated_total_is_kept_where_the_force_says_otherwise(random_case, healing, seed):
    rng = np.random.default_rng(seed)
    truth, problem = random_case(rng, healing, n=4, force=True)
    stated = problem.totals * [1.05, 0.97]
    problem = dataclasses.replace(problem, mass=FullMass(stated, healing=healing))
    answer = local.solve(problem.prepared, random_start(rng, problem), max_iterations=40)
    structure = problem.structure(answer.x)
    np.testing.assert_allclose(problem.mass.total(problem.geometry, structure.mass), stated, rtol=1e-9)
    assert problem.measurement.force_residual(structure) > 1e-4  # the two cannot both be right
    assert truth.n == 4


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
def test_a_total_that_is_not_stated_is_the_forces(random_case, healing):
    rng = np.random.default_rng(0)
    truth, problem = random_case(rng, healing, n=4, force=True, total=False)
    answer = local.solve(problem.prepared, near(rng, problem, truth, 0.05))
    structure = problem.structure(answer.x)
    np.testing.assert_allclose(structure.rigid_body_mass, truth.rigid_body_mass, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("factor", "side"), [(1.2, "lower"), (0.8, "upper")])
@pytest.mark.parametrize("mass", ["rigid_body", "lumped"])
def test_a_given_frequency_that_is_20_percent_wrong_is_said(random_case, mass, factor, side):
    rng = np.random.default_rng(3)
    truth, problem = random_case(rng, mass, n=4)
    given = truth.natural_frequencies.copy()
    given[0] *= factor
    given = np.sort(given)
    stiffness = SpectralStiffness(given, max_frequency=1.3 * given[-1])
    wrong = dataclasses.replace(problem, stiffness=stiffness)
    answer = local.solve(wrong.prepared, near(rng, problem, truth, 0.02))
    assert "ended on a bound" in answer.message
    assert f"frequency {1 + list(given).index(truth.natural_frequencies[0] * factor)} ({side})" in answer.message
    assert problem.measurement.residual(problem.structure(answer.x)) > 1e-3


def test_a_damping_ratio_outside_its_bounds_is_said(random_case):
    rng = np.random.default_rng(0)
    truth, problem = random_case(rng, "rigid_body", n=4)
    narrow = dataclasses.replace(problem, damping=sysid.ModalDamping(0.04, 0.05))
    answer = local.solve(narrow.prepared, near(rng, problem, truth, 0.02), max_iterations=150)
    assert "damping ratio 1 (lower)" in answer.message


def test_a_solution_inside_says_nothing_of_bounds(random_case):
    rng = np.random.default_rng(0)
    truth, problem = random_case(rng, "rigid_body", n=4)
    answer = local.solve(problem.prepared, near(rng, problem, truth, 0.05))
    assert answer.success
    assert "bound" not in answer.message


def test_what_noise_free_records_hardly_show_is_found_too():
    """A damper of a hundred-thousandth of the others: where IPOPT's tolerance is met it is off by two percent."""
    true = np.array([2e6, 1e6, 1.5e6, 800.0, 0.006, 500.0])
    mass, stretch = ca.diag(ca.DM([1000, 1200, 900, 0])), np.diff(np.eye(4), axis=0)[:, [1, 2, 3, 0]]
    spring = sysid.Variable("spring", 3, lower=1e5, upper=1e7, log=True)
    damper = sysid.Variable("damper", 3, lower=1e-4, upper=1e4, log=True)
    chain = lambda at: stretch.T @ ca.diag(at) @ stretch  # noqa: E731
    matrices = [np.asarray(ca.DM(part)) for part in (mass, chain(ca.DM(true[:3])), chain(ca.DM(true[3:])))]
    truth = sysid.Structure(*matrices[:2], damping_matrix=matrices[2][:3, :3], n_base=1)
    test = sysid.simulate(truth, np.geomspace(2.0, 20.0, 200))
    problem = sysid.Problem(test, mass=mass, stiffness=chain(spring), damping=chain(damper))
    start = true * [1.0, 1.0, 1.0, 1.0, 1.5, 1.0]
    answer = local.solve(problem.prepared, start)
    assert answer.success
    np.testing.assert_allclose(answer.x, true, rtol=1e-6)


def at_start(z, expression):
    return np.asarray(ca.Function("start", [z.z], [expression])(np.concatenate(z.start))).ravel()


class TestStarts:
    """Starts of a fit in modal coordinates."""

    def test_frequencies_start_where_they_are_unless_that_is_outside_their_window(self, random_case):
        """Of five per cent about those that were given, on the side that they are on."""
        _, problem = random_case(np.random.default_rng(0), n=3, d=1)
        given, z = problem.formulation.stiffness.spectrum, NonlinearProgram()
        omega, _ = frequencies(problem, given * [1.02, 0.97, 1.3], z)
        np.testing.assert_allclose(at_start(z, omega), given * [1.02, 0.97, 1.05], rtol=1e-12)

    def test_of_a_local_minimum_at_its_own_poles_then_at_the_first(self, random_case):
        """Also where its own poles allow nothing better than what was reached."""
        truth, problem = random_case(np.random.default_rng(1), n=3, d=2)
        test, first = problem.measurement, modes_of(truth)
        ended = first._replace(omega=1.3 * first.omega)
        left = linear_residues(test, ended.omega, ended.ratios)[1]
        assert left > 0.1
        own, other = _linear_starts(test, SimpleNamespace(modes=ended, of_accelerations=left), first, truth.n)
        np.testing.assert_array_equal(own.omega, ended.omega)
        np.testing.assert_array_equal(other.omega, first.omega)
        residues = np.einsum("nk,kd->knd", other.phi, other.gamma)
        expected = np.einsum("nk,kd->knd", first.phi, first.gamma)
        np.testing.assert_allclose(residues, expected, atol=1e-8 * np.abs(expected).max())

    def test_the_best_end_is_kept_not_the_last(self, random_case, monkeypatch):
        """Ends of three starts that leave 0.5, 0.3 and 0.4."""
        truth, problem = random_case(np.random.default_rng(1), n=3, d=2)
        ends = [
            ModalFit(modes_of(truth), truth.rigid_body_mass, left, left, f"end {left}", "") for left in (0.5, 0.3, 0.4)
        ]
        monkeypatch.setattr("sysid.search.modal_coordinates.solve_modes", lambda *args, **options: ends.pop(0))
        monkeypatch.setattr(
            "sysid.search.modal_coordinates._linear_starts", lambda test, best, first, own: iter([first, first])
        )
        end = fit_in_modes(problem.prepared, problem.values(truth), IterationMonitor(None, None), 1)
        assert not ends
        assert (end.objective, end.status) == (0.3, "end 0.3")
        assert "best of 3 starts" in end.remark

    def test_shapes_that_are_nearly_alike_have_a_regular_inverse(self):
        """Singular values 2, 1 and 1e-9: the last counts as a millionth of the first."""
        turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
        inverse = _regular_inverse(turn * [2.0, 1.0, 1e-9])
        np.testing.assert_allclose(inverse, (turn * [0.5, 1.0, 5e5]).T, rtol=1e-6)

    def test_unknowns_in_units_of_their_scale_keep_their_bounds(self):
        z = NonlinearProgram()
        wide = sysid.Variable("wide", lower=-50.0, upper=200.0)
        narrow = sysid.Variable("narrow", lower=1e-4, upper=0.02)
        x = add_unknowns(z, [wide, narrow], np.array([40.0, 0.01]))
        made = ca.Function("made", [z.z], [x])
        for bounds, expected in ((z.lower, [-50, 1e-4]), (z.start, [40, 0.01]), (z.upper, [200, 0.02])):
            np.testing.assert_allclose(np.asarray(made(np.concatenate(bounds))).ravel(), expected, rtol=1e-12)

    def test_steps_that_finish_keep_equalities_and_bounds(self):
        """x y = 2 with x near 1, and y near 2 by a millionth of the weight: (1, 2), unless y has an upper bound."""
        for upper, expected in ((np.inf, [1.0, 2.0]), (1.95, [1.1, 1.9])):
            z = NonlinearProgram()
            x = z.variable("x", np.zeros(2), upper=np.array([np.inf, upper]))
            z.constrain(x[0] * x[1], 2.0, 2.0)
            found = z.finished(ca.vertcat(x[0] - 1, 1e-6 * (x[1] - 2)), np.array([1.1, 1.9]))
            np.testing.assert_allclose(found, expected, rtol=1e-9)

    def test_the_gauss_newton_hessian_holds_the_constraints_own(self):
        """Rows that are linear, so that 2 J'J is exact, and x0 x1 + x1² x2 = const, by hand."""
        z = NonlinearProgram()
        x = z.variable("x", np.zeros(3))
        z.constrain(x[0] * x[1] + x[1] ** 2 * x[2], 1.0, 1.0)
        J = np.array([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0]])
        at, factor, multiplier = np.array([0.3, -0.7, 1.1]), 0.4, 2.5
        made = np.asarray(_gauss_newton(z, ca.DM(J) @ x - 1)(at, [], factor, multiplier))
        of_constraint = np.array([[0.0, 1.0, 0.0], [1.0, 2 * at[2], 2 * at[1]], [0.0, 2 * at[1], 0.0]])
        whole = 2 * OBJECTIVE_SCALE * factor * J.T @ J + multiplier * of_constraint
        np.testing.assert_allclose(made, np.triu(whole), rtol=1e-12)

    def test_near_a_bound_is_within_a_millionth_of_the_range(self):
        z = NonlinearProgram()
        z.variable("spring", np.zeros(3), np.zeros(3), np.array([1e6, 1e6, 1e6]))
        z.variable("ratio", np.zeros(2), np.zeros(2), np.array([1e-6, 0.0]))
        at = np.array([0.5, 1e6 - 0.5, 2.0, 5e-7, 0.0])
        assert z.on_bounds(at) == "spring 1 (lower), 2 (upper)"


class TestControl:
    @pytest.fixture
    def start(self, random_case):
        rng = np.random.default_rng(1)
        _, problem = random_case(rng, "rigid_body", n=4)
        return problem, random_start(rng, problem)

    def test_the_curve_starts_at_the_start_and_ends_at_the_answer(self, start):
        problem, x = start
        answer = local.solve(problem.prepared, x)
        residual = lambda at: problem.measurement.residual(problem.structure(at))  # noqa: E731
        assert answer.curve.ndim == 1
        # Shapes follow from the rest, so the first iterate already has better ones than its start.
        assert answer.curve[0] < residual(x)
        assert answer.curve[-1] == pytest.approx(residual(answer.x), rel=1e-3, abs=1e-9)
        assert answer.curve[-1] < answer.curve[0]
        assert answer.stopped is None

    def test_its_bits_repeat(self, start):
        problem, x = start
        first, again = local.solve(problem.prepared, x), local.solve(problem.prepared, x)
        np.testing.assert_array_equal(first.x, again.x)
        np.testing.assert_array_equal(first.curve, again.curve)

    @pytest.mark.parametrize("mass", ["rigid_body", "lumped"])
    def test_a_spent_budget_is_no_success_and_is_said(self, random_case, mass):
        rng = np.random.default_rng(1)
        _, problem = random_case(rng, mass, n=4)
        answer = local.solve(problem.prepared, random_start(rng, problem), max_iterations=1)
        assert not answer.success
        assert "Maximum_Iterations_Exceeded" in answer.message
        if mass == "lumped":
            assert answer.curve.size == 2  # the start, and one iteration
        else:
            assert answer.curve.size in (2, 4, 6)  # of each attempt
        assert total_error(problem, problem.structure(answer.x)) < 1e-9

    @pytest.mark.parametrize("mass", ["rigid_body", "lumped"])
    def test_a_monitor_sees_every_iteration_and_can_stop_it(self, random_case, mass):
        rng = np.random.default_rng(1)
        _, problem = random_case(rng, mass, n=4)
        seen = []

        def monitor(iteration, residual):
            seen.append((iteration, residual))
            if iteration == 4:
                raise StopIteration

        answer = local.solve(problem.prepared, random_start(rng, problem), monitor=monitor)
        assert [iteration for iteration, _ in seen] == [0, 1, 2, 3, 4]
        np.testing.assert_array_equal([residual for _, residual in seen], answer.curve)
        assert not answer.success
        assert answer.message.startswith("IPOPT: stopped")
        assert isinstance(answer.stopped, StopIteration)
        assert total_error(problem, problem.structure(answer.x)) < 1e-9

    def test_what_the_monitor_returns_changes_nothing(self, start):
        problem, x = start
        quiet, answer = (
            local.solve(problem.prepared, x),
            local.solve(problem.prepared, x, monitor=lambda iteration, residual: True),
        )
        np.testing.assert_array_equal(quiet.x, answer.x)
        assert answer.stopped is None

    @pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError, SystemExit])
    @pytest.mark.parametrize("at", [0, 5])
    def test_whatever_the_monitor_raises_is_handed_back_with_the_last_iterate(self, start, capfd, error, at):
        problem, x = start
        mine = error("mine")

        def monitor(iteration, residual):
            if iteration == at:
                raise mine

        answer = local.solve(problem.prepared, x, monitor=monitor)
        assert answer.stopped is mine
        assert not answer.success
        assert answer.message.startswith("IPOPT: stopped")
        assert answer.curve.size == at + 1
        assert problem.measurement.residual(problem.structure(answer.x)) == pytest.approx(answer.curve[-1], rel=1e-6)
        assert capfd.readouterr() == ("", "")  # CasADi's own account of it reaches nobody

    def test_time_runs_out(self, start):
        problem, x = start

        def monitor(iteration, residual):
            time.sleep(0.05)

        begun = time.perf_counter()
        answer = local.solve(problem.prepared, x, max_time=0.1, monitor=monitor)
        assert not answer.success
        assert "Maximum_WallTime_Exceeded" in answer.message
        assert time.perf_counter() - begun < 5
