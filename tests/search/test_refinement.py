"""Eigenvalue refinement in a swarm: in closed form, by IPOPT for every candidate, and by both for its leaders."""

import re
from collections import Counter

import numpy as np
import pytest

import sysid
from sysid.models.spectrum import Refinement, by_ipopt
from sysid.search.session import DeferredInterrupt, Session
from sysid.search.swarm_objective import Refiner, Tally

FEW = {"max_iterations": 6, "n_particles": 20, "local": None}


@pytest.fixture
def problem(random_case):
    return random_case(np.random.default_rng(0), "rigid_body", n=3, d=1)[1]


@pytest.fixture
def solved(monkeypatch):
    """Every refinement that IPOPT was asked for, and what it came to."""
    answers = []

    def spy(factor, targets, max_time):
        answers.append(by_ipopt(factor, targets, max_time))
        return answers[-1]

    monkeypatch.setattr("sysid.models.stiffness_and_damping.by_ipopt", spy)
    return answers


@pytest.fixture
def swarms(monkeypatch):
    """Settings of each swarm, and what it ended at."""
    from sysid.search import swarm

    ran, minimize = [], swarm.minimize_swarm

    def spy(fun, bounds, **options):
        ran.append((options, minimize(fun, bounds, **options)))
        return ran[-1][1]

    monkeypatch.setattr(swarm, "minimize_swarm", spy)
    return ran


def search(problem, seed=0, **options):
    return sysid.identify(problem, strategy=sysid.Swarm.published(**{**FEW, **options}), rng=seed)


def counts(history):
    return history.leaders_tried, history.leaders_won, dict(history.refinement_statuses)


class TestLeaders:
    def test_each_new_best_is_tried_and_every_status_counted(self, problem, solved):
        bests = []
        result = sysid.identify(
            problem, strategy=sysid.Swarm.published(**FEW), rng=0, progress=lambda at: bests.append(at.objective)
        )
        tried, won, statuses = counts(result.history)
        assert tried == len(np.unique(bests)) == len(solved) > 2  # the best of the sample is the first
        assert statuses == Counter(answer.status for answer in solved)
        assert 0 <= won <= tried

    def test_the_leader_is_left_with_the_measured_spectrum_and_its_objective(self, problem, swarms):
        """By singular values of its own L_H; the objective by the problem, with no refinement."""
        part, formulation = problem.formulation.parts.stiffness, problem.formulation
        for seed in range(3):
            result = search(problem, seed)
            best = swarms[-1][1]
            factor = np.zeros((3, 3))
            factor[np.tril_indices(3)] = best.x[part]
            own = np.sort(np.linalg.svd(factor, compute_uv=False)) / (2 * np.pi)
            np.testing.assert_allclose(own, problem.reference.natural_frequencies, rtol=1e-8)
            x = np.asarray(formulation.from_sampling(best.x)).ravel()
            healed = np.asarray(formulation.healing(x)).ravel() if formulation.healed else x
            assert problem.objective(healed) == pytest.approx(best.fun, rel=1e-7)
            assert result.objective == pytest.approx(best.fun, rel=1e-7)

    def test_ipopt_wins_where_its_objective_is_lower(self, problem):
        """Six seeds: it wins some leaders, never all; without it nothing is tried."""
        ends = [search(problem, seed).history for seed in range(6)]
        assert sum(end.leaders_won for end in ends) >= 1
        assert all(end.leaders_won < end.leaders_tried for end in ends)
        assert counts(search(problem, refine_by="closed-form").history) == (0, 0, {})

    @pytest.mark.parametrize("better", [True, False])
    def test_the_better_of_both_is_written_back(self, problem, monkeypatch, better):
        """An objective of rows that is lower, or higher, where IPOPT's factor (here twice the closed form's) stands."""
        omega = problem.formulation.stiffness.spectrum
        answer = Refinement(np.diag(omega[::-1]), 0.0, True, "Solve_Succeeded")
        monkeypatch.setattr("sysid.models.stiffness_and_damping.by_ipopt", lambda *_: answer)
        refiner, tally = made(problem, Tally())
        row = middle(problem)
        closed = refiner.rows(row[None])[0]
        part = problem.formulation.parts.stiffness
        wanted = closed.copy()
        if better:
            wanted[part] = np.diag(omega[::-1])[np.tril_indices(3)]

        def objective(rows):
            by_solver = np.all(rows[:, part] == np.diag(omega[::-1])[np.tril_indices(3)], axis=1)
            return np.where(by_solver, 1.0 if better else 3.0, 2.0)

        point, cost = refiner.of_leader(objective)(row, 2.0)
        np.testing.assert_array_equal(point, wanted)
        assert cost == (1.0 if better else 2.0)
        assert (tally.tried, tally.won, tally.statuses) == (1, int(better), {"Solve_Succeeded": 1})

    def test_a_refined_leader_stays_in_the_box_of_the_swarm(self, problem, monkeypatch):
        """Which may be narrower than the bounds: a swarm refuses points beyond it."""
        ends = tuple(end / 2 for end in problem.formulation.box)
        monkeypatch.setattr(problem.formulation, "box", ends)
        refiner, _ = made(problem, Tally())
        point, _ = refiner.of_leader(lambda rows: np.array([1.0, 0.5]))(middle(problem), 2.0)
        assert np.all((point >= ends[0]) & (point <= ends[1]))

    def test_ipopt_starts_from_the_leaders_own_factor(self, problem, monkeypatch):
        """And not from what the closed form made of it."""
        given = []

        def spy(factor, targets, max_time):
            given.append(factor)
            return by_ipopt(factor, targets, max_time)

        monkeypatch.setattr("sysid.models.stiffness_and_damping.by_ipopt", spy)
        refiner, _ = made(problem, Tally())
        row = middle(problem)
        refiner.of_leader(lambda rows: np.ones(len(rows)))(row, 1.0)
        np.testing.assert_array_equal(given[0][np.tril_indices(3)], row[problem.formulation.parts.stiffness])

    def test_round_off_is_no_win(self, problem):
        refiner, tally = made(problem, Tally())
        refiner.of_leader(lambda rows: np.array([1.0, 1.0 - 1e-12]))(middle(problem), 1.0)
        assert (tally.tried, tally.won) == (1, 0)

    def test_a_leader_that_ipopt_does_not_solve_keeps_the_closed_form_and_is_counted(self, problem, monkeypatch):
        worse = Refinement(np.eye(3), 0.5, False, "Restoration_Failed")
        monkeypatch.setattr("sysid.models.stiffness_and_damping.by_ipopt", lambda *_: worse)
        result = search(problem)
        tried, won, statuses = counts(result.history)
        assert (won, statuses) == (0, {"Restoration_Failed": tried})
        told = result.history.refinement_in_words
        assert re.findall(r"\d+", told) == [str(tried), "0", str(tried)] and f"(Restoration_Failed {tried})" in told
        np.testing.assert_allclose(
            result.structure.natural_frequencies, problem.reference.natural_frequencies, rtol=1e-8
        )

    def test_leaders_that_there_is_no_time_for_are_not_tried(self, problem):
        session = Session([], DeferredInterrupt(), max_time=1e-9)
        refiner, tally = made(problem, Tally(), session)
        row = middle(problem)
        point, cost = refiner.of_leader(lambda rows: np.zeros(len(rows)))(row, 2.0)
        np.testing.assert_array_equal(point, row)
        assert (cost, tally) == (2.0, Tally())

    def test_ipopt_is_given_the_time_that_is_left(self, problem, monkeypatch):
        given = []

        def spy(factor, targets, max_time):
            given.append(max_time)
            return by_ipopt(factor, targets, max_time)

        monkeypatch.setattr("sysid.models.stiffness_and_damping.by_ipopt", spy)
        search(problem)
        assert set(given) == {None}
        given.clear()
        sysid.identify(problem, strategy=sysid.Swarm.published(**FEW), rng=0, max_time=50.0)
        assert all(0 < left <= 50 for left in given)
        assert np.all(np.diff(given) < 0)

    def test_the_counts_are_those_of_all_swarms(self, problem, solved, monkeypatch):
        from sysid.search import swarm

        def stays(problem, x, steps, session, coordinates):
            return swarm.local.LocalResult(x, True, "IPOPT: Solve_Succeeded", np.array([1.0]))

        monkeypatch.setattr(swarm, "descend", stays)
        result = search(problem, local="cholesky", restarts=2)
        assert result.history.restarts == 2
        assert result.history.leaders_tried == len(solved)
        assert sum(count for _, count in result.history.refinement_statuses) == len(solved)


class TestEveryCandidate:
    def test_each_is_refined_by_ipopt_and_every_status_counted(self, problem, solved):
        result = search(problem, max_iterations=3, n_particles=8, refine_by="ipopt")
        closed = search(problem, max_iterations=3, n_particles=8, refine_by="closed-form")
        tried, won, statuses = counts(result.history)
        assert (tried, won, sum(statuses.values())) == (0, 0, result.history.evaluations)
        assert f"IPOPT refined {result.history.evaluations} candidates (" in result.history.refinement_in_words
        # Another solution of eq. 31 than the nearest matrix: the same particles have other objectives.
        assert result.history.start != pytest.approx(closed.history.start, rel=1e-6)
        assert result.objective == pytest.approx(result.history.swarm, rel=1e-7)
        np.testing.assert_allclose(
            result.structure.natural_frequencies, problem.reference.natural_frequencies, rtol=1e-8
        )

    def test_written_back_the_particles_hold_it(self, problem, swarms):
        search(problem, max_iterations=2, n_particles=6, refine_by="ipopt", write_back=True)
        rows = np.random.default_rng(0).uniform(problem.lower, problem.upper, (3, problem.n_variables))
        part = problem.formulation.parts.stiffness
        for row, given in zip(swarms[0][0]["repair"](rows), rows, strict=True):
            factor = np.zeros((3, 3))
            factor[np.tril_indices(3)] = given[part]
            alone = by_ipopt(factor, problem.formulation.stiffness.spectrum).factor
            np.testing.assert_array_equal(row[part], alone[np.tril_indices(3)])


def made(problem, tally, session=None):
    spectrum = problem.formulation.stiffness.spectrum
    return Refiner(problem.prepared, "leaders", spectrum, session or Session([], DeferredInterrupt()), tally), tally


def middle(problem):
    """A row of the swarm whose L_H is no diagonal one."""
    return problem.lower + 0.6 * (problem.upper - problem.lower)
