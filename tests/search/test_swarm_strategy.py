"""Strategy "swarm" as the paper has it: its defaults, budgets, phases and what vouches for its end."""

import dataclasses

import numpy as np
import pytest

import sysid


@pytest.fixture
def problem(random_case):
    return random_case(np.random.default_rng(0), "rigid_body", n=3, d=1)[1]


def test_the_defaults():
    """Velocities up to 0.4 of the range and 5 particles an unknown, which None stands for, are the paper's (3.3.1)."""
    strategy = sysid.Swarm()
    assert strategy.n_particles is None
    assert strategy.settings.max_velocity == 0.4
    assert strategy.max_iterations == 150


def test_a_search_with_the_defaults_has_five_particles_an_unknown_and_up_to_150_iterations(problem):
    seen = []

    def stop(progress):
        seen.append(progress)
        if progress.iteration == 2:
            raise StopIteration

    result = sysid.identify(problem, strategy="swarm", rng=0, callback=stop)
    assert [(progress.phase, progress.of) for progress in seen] == [("swarm", 150)] * 2
    rows = 5 * result.x.size
    assert result.history.evaluations in (2 * rows, 2 * rows + 1)  # elitist learning adds one


@pytest.fixture
def swarms(monkeypatch):
    """Settings of each swarm of the strategy; its local phase returns its start, and calls that solved."""
    from sysid.search import swarm

    asked, minimize = [], swarm.minimize_swarm

    def spy(fun, bounds, **options):
        asked.append(options)
        return minimize(fun, bounds, **options)

    def stays(problem, x, steps, session, coordinates):
        return swarm.local.LocalResult(x, True, "IPOPT: Solve_Succeeded", np.array([1.0]))

    monkeypatch.setattr(swarm, "minimize_swarm", spy)
    monkeypatch.setattr(swarm, "descend", stays)
    return asked


FEW = {"max_iterations": 3, "n_particles": 12, "restarts": 1}


def searched_from(problem, monkeypatch, ends, goal=1e-3, start=1 + 1e-5):
    """The search of one swarm after a local phase from next to the truth that ended at `ends` times it."""
    from sysid.search import swarm
    from sysid.search.session import DeferredInterrupt, Session

    search = swarm._Search(
        dataclasses.replace(problem, goal=goal).prepared, sysid.Swarm(), Session([], DeferredInterrupt())
    )
    truth, (at, solved) = problem.values(problem.reference), ends
    search.x = truth * start
    answer = swarm.local.LocalResult(truth * at, solved, "IPOPT: as it ended", np.array([1.0]))
    monkeypatch.setattr(swarm, "descend", lambda *given: answer)
    search.local("modal")
    return search


def test_a_goal_that_is_met_without_the_solvers_success_does_not_stop_restarts(problem, monkeypatch):
    """Residuals of about 7e-4 at the start and 7e-5 at the end; the goal is 1e-3."""
    for solved in (True, False):
        search = searched_from(problem, monkeypatch, (1 + 1e-6, solved))
        assert search.meets_goal
        assert search.success == search.good_enough == solved
    assert not searched_from(problem, monkeypatch, (1 + 1e-6, True), goal=1e-9).good_enough


def test_a_local_phase_that_ends_above_its_start_vouches_for_nothing(problem, monkeypatch):
    """Not even where the start meets the goal; one that ends where it began says that this is a solution."""
    worse = searched_from(problem, monkeypatch, (1 + 2e-5, True))
    assert worse.meets_goal
    assert not worse.success
    assert not worse.good_enough
    assert "its start is kept" in worse.message
    np.testing.assert_array_equal(worse.x, problem.values(problem.reference) * (1 + 1e-5))
    assert searched_from(problem, monkeypatch, (1 + 1e-5, True)).success


def test_of_two_searches_that_end_alike_the_solved_one_is_kept(problem, monkeypatch):
    lower, solved, other = (
        searched_from(problem, monkeypatch, end)
        for end in ((1 + 1e-6, False), (1 + 1e-6 * (1 + 1e-8), True), (1 + 2e-6, True))
    )
    assert lower.objective < solved.objective < other.objective
    assert solved.beats(lower)
    assert not lower.beats(solved)
    assert lower.beats(other)
    assert not other.beats(lower)


def test_all_swarms_together_keep_to_the_evaluations_that_are_allowed(problem, swarms):
    result = sysid.identify(problem, strategy=sysid.Swarm.published(**FEW), rng=0, max_evaluations=90)
    first, second = (asked["max_evaluations"] for asked in swarms)
    assert first == 90
    assert 36 <= 90 - second <= 39  # three iterations of twelve particles, and one more row in each at most
    assert result.history.restarts == 1


def test_the_swarm_ends_at_the_goal_where_its_objective_is_the_residual(problem, swarms):
    """Stated noise weighs the objective, which is then another number than the residual of the goal."""
    few, test = sysid.Swarm(**{**FEW, "restarts": 0}), problem.measurement
    noise = np.linspace(1.0, 3.0, test.n_sensors)[:, None] * np.ones(test.freq.size)
    for stated in (None, noise):
        measured = dataclasses.replace(test, response_std=stated)
        sysid.identify(dataclasses.replace(problem, measurement=measured, goal=1e-3), strategy=few, rng=0)
    assert [asked["target"] for asked in swarms] == [1e-3, None]


@pytest.mark.parametrize(("field", "value"), [("local", "cholesky "), ("local", True), ("refine_by", "closed form")])
def test_a_setting_that_is_not_known_is_refused_by_name(field, value):
    with pytest.raises(sysid.InputError, match=f"Swarm: {field} = {value!r} is unknown; give one of '"):
        sysid.Swarm(**{field: value})


class TestPublished:
    """Strategy "hpso-ls": the paper's algorithm by one name."""

    def test_its_settings_are_those_of_the_sources_that_the_paper_names(self):
        strategy = sysid.Swarm.published()
        assert (strategy.settings.inertia_b1, strategy.settings.inertia_b2) == (0.3, 0.2)
        assert strategy.settings.acceleration_sum == 4.0
        assert (strategy.local, strategy.refine, strategy.name) == ("cholesky", True, "hpso-ls")
        assert strategy.refine_by == "leaders"
        assert sysid.Swarm().refine_by == "closed-form"
        assert sysid.Swarm.published(local=None).local is None

    def test_it_finds_an_exact_fit_and_tells_what_each_phase_left(self, problem):
        result = sysid.identify(problem, strategy="hpso-ls", rng=1)
        assert result.strategy == "hpso-ls"
        assert result.success, result.message
        assert result.residual < 1e-6
        phases = result.history.phases
        assert [phase.name for phase in phases] == ["start", "swarm", "local phase"]
        left = [phase.objective for phase in phases]
        assert left == sorted(left, reverse=True)
        for phase in phases:
            assert problem.objective(phase.x) == pytest.approx(phase.objective, rel=1e-9, abs=1e-12)
        assert left[1] > 1e-4 > 1e-6 > left[2]  # the local phase does depend on it, and does its part

    def test_a_model_with_a_form_of_its_own_is_searched_in_its_own_unknowns_and_that_is_said(self, random_case):
        few = {"max_iterations": 2, "n_particles": 8, "restarts": 0}
        for stiffness in ("chain", "spectral"):
            _, problem = random_case(np.random.default_rng(2), stiffness=stiffness, n=2, d=1)
            result = sysid.identify(problem, strategy=sysid.Swarm.published(**few), rng=0)
            assert len(result.of_kind("search")) == (stiffness == "chain")

    def test_written_back_the_swarm_itself_holds_candidates_of_the_spectrum(self, problem, swarms):
        few = {"max_iterations": 3, "n_particles": 12, "local": None, "write_back": True}
        result = sysid.identify(problem, strategy=sysid.Swarm(**few), rng=0)
        rows = np.random.default_rng(0).uniform(problem.lower, problem.upper, (4, problem.n_variables))
        for row in swarms[0]["repair"](rows):
            x = np.asarray(problem.formulation.from_sampling(row)).ravel()
            f = problem.structure(x).natural_frequencies
            np.testing.assert_allclose(f, problem.reference.natural_frequencies, rtol=1e-8)
        np.testing.assert_allclose(
            result.structure.natural_frequencies, problem.reference.natural_frequencies, rtol=1e-8
        )

    def test_a_search_that_is_stopped_tells_how_far_the_swarm_came(self, problem):
        def stop(progress):
            if progress.iteration == 3:
                raise StopIteration

        result = sysid.identify(problem, strategy="hpso-ls", rng=0, callback=stop)
        assert [phase.name for phase in result.history.phases] == ["start", "swarm"]
        assert sum(phase.evaluations for phase in result.history.phases) == result.history.evaluations
        assert result.history.phases[-1].objective == pytest.approx(result.objective)

    def test_a_local_minimum_is_no_success(self, problem, swarms):
        """A local phase that ends beside the truth, as where it stops at once, is told by free residues."""
        result = sysid.identify(problem, strategy=sysid.Swarm.published(**FEW), rng=0)
        assert not result.success
        assert "local minimum" in result.message
        assert result.history.restarts == 1
