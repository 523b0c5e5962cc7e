"""Whole searches: known optima, stop rules, refinement of the best, results and mistakes."""

import numpy as np
import pytest
from scipy.optimize import Bounds
from scipy.stats import ortho_group

from sysid.errors import InputError
from sysid.swarm import EvolutionaryState, ParticleSwarm, StopReason, SwarmProgress, minimize_swarm

SQUARE = [(-5.0, 5.0)] * 2


def sphere(rows):
    return (rows**2).sum(axis=1)


def flat(rows):
    return np.full(len(rows), 2.0)


def nowhere(rows):
    return np.full(len(rows), np.nan)


class Counted:
    """A cost that remembers how many rows each call had."""

    def __init__(self, fun):
        self.fun = fun
        self.calls = []

    def __call__(self, rows):
        self.calls.append(len(rows))
        return self.fun(rows)


# Known optima, none of them at the middle of the box


@pytest.mark.parametrize("seed", range(6))
def test_sphere(seed):
    centre = np.array([1.0, -2.0, 3.0, 0.5, -4.0, 2.5])
    result = minimize_swarm(lambda rows: sphere(rows - centre), [(-5, 5)] * 6, rng=seed, max_iterations=300)
    assert result.success
    np.testing.assert_allclose(result.x, centre, atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_rosenbrock(seed):
    def rosenbrock(rows):
        x, y = rows.T
        return 100 * (y - x**2) ** 2 + (1 - x) ** 2

    result = minimize_swarm(rosenbrock, [(-2, 3)] * 2, rng=seed, n_particles=30, max_iterations=500)
    np.testing.assert_allclose(result.x, [1, 1], atol=1e-2)


@pytest.mark.parametrize("seed", range(6))
def test_rotated_ellipsoid(seed):
    axes = ortho_group.rvs(5, random_state=12)
    weights = np.geomspace(1, 100, 5)
    centre = np.linspace(-1, 2, 5)

    def ellipsoid(rows):
        return ((rows - centre) @ axes) ** 2 @ weights

    result = minimize_swarm(ellipsoid, [(-4, 4)] * 5, rng=seed, max_iterations=500)
    np.testing.assert_allclose(result.x, centre, atol=1e-2)


@pytest.mark.parametrize("seed", range(6))
def test_an_optimum_in_a_corner_is_met_exactly(seed):
    result = minimize_swarm(lambda rows: rows @ [1.0, -1.0, 2.0], [(0, 1)] * 3, rng=seed, max_iterations=200)
    np.testing.assert_array_equal(result.x, [0, 1, 0])


@pytest.mark.parametrize("seed", range(6))
def test_the_optimum_is_found_where_part_of_the_box_has_no_cost(seed):
    def holed(rows):
        with np.errstate(invalid="ignore"):
            return sphere(rows - 1) + 0 * np.sqrt(rows[:, 0])

    result = minimize_swarm(holed, SQUARE, rng=seed, max_iterations=200)
    assert result.n_nan > 0
    assert result.success
    np.testing.assert_allclose(result.x, [1, 1], atol=1e-5)


def test_a_fixed_variable_comes_back_exactly():
    result = minimize_swarm(sphere, [(-5, 5), (0.3, 0.3), (-5, 5)], rng=0, max_iterations=200)
    assert result.x[1] == 0.3
    np.testing.assert_allclose(result.x, [0, 0.3, 0], atol=1e-5)


def test_scipy_bounds_are_the_same_as_pairs():
    pairs = minimize_swarm(sphere, [(-5, 1), (-5, 2)], rng=0, max_iterations=20)
    bounds = minimize_swarm(sphere, Bounds(-5, [1, 2]), rng=0, max_iterations=20)
    np.testing.assert_array_equal(pairs.x, bounds.x)


# The result


def test_the_result_agrees_with_the_cost_and_its_calls():
    fun = Counted(sphere)
    result = minimize_swarm(fun, SQUARE, rng=0, max_iterations=40)
    assert result.fun == sphere(result.x[None])[0]
    assert result.nit == len(fun.calls) == len(result.history) == 40
    assert result.nfev == sum(fun.calls)
    assert result.history[-1] == result.fun
    assert np.all(np.diff(result.history) <= 0)
    assert result.n_nan == 0
    assert set(result.state_counts) == {state.name for state in EvolutionaryState}
    assert "EXPLORATION" in repr(result)
    assert sum(result.state_counts.values()) == 39


def test_the_search_is_that_many_steps_of_the_swarm():
    result = minimize_swarm(sphere, SQUARE, rng=8, max_iterations=35)
    swarm = ParticleSwarm(SQUARE, rng=8, horizon=35)
    for _ in range(35):
        swarm.tell(sphere(swarm.ask()))
    np.testing.assert_array_equal(result.x, swarm.best_x)
    np.testing.assert_array_equal(result.history, swarm.history)
    assert result.state_counts == {state.name: count for state, count in swarm.state_counts.items()}


def test_a_cost_may_write_into_its_rows():
    def careless(rows):
        rows -= 1
        return sphere(rows)

    result = minimize_swarm(careless, SQUARE, rng=0, max_iterations=150)
    np.testing.assert_allclose(result.x, [1, 1], atol=1e-5)


def test_a_start_guess_at_the_optimum_is_kept():
    result = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=1, x0=[0, 0])
    assert result.fun < 1e-28


# Stop rules


def test_target_stops_at_the_first_cost_at_or_below_it():
    result = minimize_swarm(sphere, SQUARE, rng=0, target=1e-3)
    assert result.reason is StopReason.TARGET
    assert result.success
    assert result.fun <= 1e-3 < result.history[-2]


def test_a_missed_target_is_no_success_and_the_message_says_so():
    result = minimize_swarm(flat, SQUARE, rng=0, target=1.0, max_iterations=5)
    assert result.reason is StopReason.MAX_ITERATIONS
    assert not result.success
    assert "target 1.0" in result.message and "not reached" in result.message


def test_stall_stops_after_so_many_iterations_without_a_fall():
    result = minimize_swarm(flat, SQUARE, rng=0, stall_iterations=12)
    assert result.reason is StopReason.STALL
    assert result.success
    assert result.nit == 13
    assert "refine x" in result.message


def test_a_stall_is_counted_from_the_last_fall():
    costs = iter([2.0, *np.ones(50)])  # a fall in the second iteration, and three without one after it
    result = minimize_swarm(lambda rows: np.full(len(rows), next(costs)), SQUARE, rng=0, stall_iterations=3)
    assert (result.reason, result.nit) == (StopReason.STALL, 5)


def test_the_stall_tolerance_is_relative_to_the_cost():
    # Each iteration lowers the cost by a thousandth of itself.
    def falling(factor):
        costs = iter(factor * 0.999 ** np.arange(200))
        return lambda rows: np.full(len(rows), next(costs))

    for factor in (1e-9, 1.0, 1e9):
        going = minimize_swarm(
            falling(factor), SQUARE, rng=0, max_iterations=100, stall_iterations=10, stall_tolerance=5e-3
        )
        stopped = minimize_swarm(
            falling(factor), SQUARE, rng=0, max_iterations=100, stall_iterations=10, stall_tolerance=2e-2
        )
        assert going.reason is StopReason.MAX_ITERATIONS
        assert (stopped.reason, stopped.nit) == (StopReason.STALL, 11)


def test_no_stall_rule_no_stall():
    result = minimize_swarm(flat, SQUARE, rng=0, stall_iterations=None, max_iterations=150)
    assert (result.reason, result.nit) == (StopReason.MAX_ITERATIONS, 150)


@pytest.mark.parametrize(("budget", "every"), [(10, 1), (10, 2), (57, 2), (300, 2)])
def test_the_evaluation_budget_is_spent_and_never_passed(budget, every):
    """Nor by `improve`, where the particles have just spent it."""
    fun = Counted(sphere)
    result = minimize_swarm(fun, SQUARE, rng=0, max_evaluations=budget, improve=lambda x: x * 0.9, improve_every=every)
    assert result.reason is StopReason.MAX_EVALUATIONS
    assert result.success
    assert result.nfev == sum(fun.calls)
    assert budget - 11 <= result.nfev <= budget


def test_elitist_learning_narrows_over_the_evaluations_where_they_end_first():
    result = minimize_swarm(sphere, SQUARE, rng=3, max_evaluations=400, stall_iterations=None)
    swarm = ParticleSwarm(SQUARE, rng=3, horizon=40)
    for _ in range(result.nit):
        swarm.tell(sphere(swarm.ask()))
    np.testing.assert_array_equal(result.x, swarm.best_x)


def test_no_iteration_starts_after_the_time():
    result = minimize_swarm(sphere, SQUARE, rng=0, max_time=0.0)
    assert (result.reason, result.nit) == (StopReason.MAX_TIME, 1)
    assert result.success


def test_stop_iteration_from_the_callback_ends_the_search_with_the_best_so_far():
    def stop(progress):
        if progress.nit == 7:
            raise StopIteration

    result = minimize_swarm(sphere, SQUARE, rng=0, callback=stop)
    full = minimize_swarm(sphere, SQUARE, rng=0)
    assert (result.reason, result.nit) == (StopReason.CALLBACK, 7)
    assert not result.success
    np.testing.assert_array_equal(result.history, full.history[:7])


def test_the_callback_sees_each_iteration():
    seen = []
    result = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=9, callback=seen.append)
    assert all(isinstance(progress, SwarmProgress) for progress in seen)
    assert [progress.nit for progress in seen] == list(range(1, 10))
    np.testing.assert_array_equal([progress.fun for progress in seen], result.history)
    assert all(sphere(progress.x[None])[0] == progress.fun for progress in seen)
    assert seen[-1].nfev == result.nfev


def test_a_callback_cannot_disturb_the_search():
    def scribble(progress):
        progress.x[:] = 99

    quiet = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=20)
    disturbed = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=20, callback=scribble)
    np.testing.assert_array_equal(quiet.x, disturbed.x)


def test_an_interrupt_goes_through_and_the_last_progress_has_the_best_so_far():
    costs, seen = [], []

    def interrupted(rows):
        if len(costs) == 4:
            raise KeyboardInterrupt
        costs.append(sphere(rows))
        return costs[-1]

    with pytest.raises(KeyboardInterrupt):
        minimize_swarm(interrupted, SQUARE, rng=0, callback=seen.append)
    assert seen[-1].fun == min(c.min() for c in costs)


def test_no_finite_cost_is_no_success_and_the_message_says_what_to_do():
    result = minimize_swarm(nowhere, SQUARE, rng=0, max_iterations=5)
    assert not result.success
    assert result.fun == np.inf
    assert result.n_nan == result.nfev == 50
    assert "50 costs" in result.message and "bounds" in result.message


def test_a_search_without_finite_costs_stalls():
    result = minimize_swarm(nowhere, SQUARE, rng=0, stall_iterations=6)
    assert (result.reason, result.nit) == (StopReason.STALL, 7)


# Refinement of the best


def test_improve_is_called_every_so_many_iterations_with_the_best():
    points, seen = [], []

    def halve(x):
        points.append(x.copy())
        return x / 2

    # Each call is cheaper than all before it, so that there is always a new best to improve.
    falling = Counted(lambda rows: sphere(rows) - 100 * len(falling.calls))
    result = minimize_swarm(
        falling, SQUARE, rng=0, max_iterations=20, improve=halve, improve_every=5, callback=seen.append
    )
    assert result.n_improved == len(points) == 4
    assert [i for i, n_rows in enumerate(falling.calls) if n_rows == 1] == [5, 11, 17, 23]
    for k, point in enumerate(points, start=1):
        np.testing.assert_array_equal(seen[5 * k - 1].x, point / 2)
        assert seen[5 * k - 1].fun == result.history[5 * k - 1]


def test_an_exact_refinement_reaches_the_optimum_and_is_not_repeated():
    calls = []

    def exact(x):
        calls.append(x)
        return np.zeros(2)

    result = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=30, improve=exact, improve_every=3)
    assert result.fun == 0
    assert len(calls) == result.n_improved == 1


def test_improve_is_off_by_default():
    def never(x):
        raise AssertionError("improve was called")

    assert minimize_swarm(sphere, SQUARE, rng=0, max_iterations=10, improve=never).n_improved == 0


def test_an_improvement_outside_the_bounds_is_clipped():
    result = minimize_swarm(
        lambda rows: rows.sum(axis=1), SQUARE, rng=0, max_iterations=1, improve=lambda x: x - 100, improve_every=1
    )
    np.testing.assert_array_equal(result.x, [-5, -5])


@pytest.mark.parametrize("answer", [[4.9, 4.9], [np.nan, 0.0]])
def test_an_improvement_that_is_none_is_dropped(answer):
    plain = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=10)
    result = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=10, improve=lambda x: answer, improve_every=2)
    np.testing.assert_array_equal(result.history, plain.history)
    assert result.n_improved == 0


def test_improve_waits_for_a_finite_cost():
    def never(x):
        raise AssertionError("improve was called")

    assert not minimize_swarm(nowhere, SQUARE, rng=0, max_iterations=4, improve=never, improve_every=1).success


# Leaders


def test_each_new_leader_is_handed_over_once_and_what_comes_back_takes_its_place():
    """A leader moved half way to the optimum of the sphere costs a quarter."""
    given, seen = [], []

    def halve(x, cost):
        assert cost == sphere(x[None])[0]
        given.append(x)
        return x / 2, cost / 4

    fun = Counted(sphere)
    result = minimize_swarm(fun, SQUARE, rng=0, max_iterations=20, on_leader=halve, callback=seen.append)
    first = ParticleSwarm(SQUARE, rng=0, horizon=20).ask()
    np.testing.assert_array_equal(given[0], first[np.argmin(sphere(first))])  # the best of the sample
    bests = np.array([progress.x for progress in seen])
    assert len(given) == 1 + np.count_nonzero(np.any(np.diff(bests, axis=0) != 0, axis=1)) > 3
    np.testing.assert_array_equal(result.x, given[-1] / 2)
    assert result.fun == result.history[-1] == sphere(result.x[None])[0]
    assert np.all(np.diff(result.history) <= 0)
    assert result.nfev == sum(fun.calls)  # what it evaluates is its own affair


def test_a_leader_that_comes_back_as_it_was_changes_nothing_and_is_not_handed_over_again():
    given = []

    def keep(x, cost):
        given.append(x)
        return x, cost

    plain = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=20)
    same = minimize_swarm(sphere, SQUARE, rng=0, max_iterations=20, on_leader=keep)
    assert len(given) == np.unique(plain.history).size < 20
    np.testing.assert_array_equal(same.history, plain.history)
    np.testing.assert_array_equal(same.x, plain.x)


def test_what_improves_a_leader_is_a_leader_too():
    given = []

    def seen(x, cost):
        given.append(x)
        return x, cost

    minimize_swarm(
        sphere, SQUARE, rng=0, max_iterations=4, improve=lambda x: np.zeros(2), improve_every=2, on_leader=seen
    )
    np.testing.assert_array_equal(given[-1], [0, 0])


def test_a_leader_waits_for_a_finite_cost():
    def never(x, cost):
        raise AssertionError("on_leader was called")

    assert not minimize_swarm(nowhere, SQUARE, rng=0, max_iterations=4, on_leader=never).success


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda x, cost: (x, cost + 1), "is above that of the global best"),
        (lambda x, cost: (x, np.nan), "is above that of the global best"),
        (lambda x, cost: (x + 100, cost), "outside its bounds"),
        (lambda x, cost: (x[None], cost), r"x has shape \(1, 2\)"),
    ],
)
def test_a_leader_that_is_none_is_refused(answer, words):
    with pytest.raises(InputError, match=words):
        minimize_swarm(sphere, SQUARE, rng=0, on_leader=answer)


# Mistakes


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"max_iterations": 0}, "max_iterations is 0; give 1 or above"),
        ({"max_iterations": 1.5}, "max_iterations is 1.5; give a whole number"),
        ({"max_evaluations": 9}, "max_evaluations is 9, too few for the first 10 particles"),
        ({"max_evaluations": 0}, "max_evaluations is 0"),
        ({"max_time": -1}, "max_time = -1: zero or more seconds"),
        ({"max_time": float("nan")}, "max_time = nan"),
        ({"target": float("nan")}, "target = nan: a number that a cost can reach"),
        ({"stall_iterations": 0}, "stall_iterations is 0"),
        ({"stall_tolerance": -0.1}, "stall_tolerance = -0.1"),
        ({"improve_every": 3}, "improve is not given"),
        ({"improve": lambda x: x, "improve_every": -1}, "improve_every is -1"),
        ({"n_particles": 1}, "n_particles is 1"),
        ({"rng": "x"}, "rng is 'x'"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        minimize_swarm(sphere, SQUARE, **arguments)


@pytest.mark.parametrize(
    ("fun", "words"),
    [
        (lambda rows: 1.0, r"that fun returned have shape \(\) for 10 rows"),
        (lambda rows: rows, r"that fun returned have shape \(10, 2\) for 10 rows"),
        (lambda rows: rows[:, 0] + 1j, "that fun returned have type complex128"),
    ],
)
def test_a_cost_of_the_wrong_shape_or_type_is_refused(fun, words):
    with pytest.raises(InputError, match=words):
        minimize_swarm(fun, SQUARE, rng=0)


def test_an_improvement_of_the_wrong_shape_is_refused():
    with pytest.raises(InputError, match=r"improve returned shape \(1, 2\)"):
        minimize_swarm(sphere, SQUARE, rng=0, improve=lambda x: x[None], improve_every=1)


def test_mistakes_are_value_errors():
    with pytest.raises(ValueError, match="exchange"):
        minimize_swarm(sphere, [(1, 0)])
