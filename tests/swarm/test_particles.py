"""The swarm in ask and tell form: moves, memory, elitist learning, points from elsewhere."""

import numpy as np
import pytest

from sysid.swarm import EvolutionaryState, ParticleSwarm, SwarmSettings

BOUNDS = np.array([[-1.0, 3.0], [0.0, 10.0], [-2.0, -1.0], [5.0, 5.5]])
CENTRE = BOUNDS.mean(axis=1)
RANGE = BOUNDS[:, 1] - BOUNDS[:, 0]


def bowl(rows):
    return (((rows - CENTRE) / RANGE - 0.1) ** 2).sum(axis=1)


def run(swarm, iterations, fun=bowl):
    for _ in range(iterations):
        swarm.tell(fun(swarm.ask()))
    return swarm


def asked_for_elitist_learning(seed=0):
    """Bring a swarm to the convergence state; return it with the rows it asks for."""
    swarm = ParticleSwarm(BOUNDS, rng=seed)
    for _ in range(200):
        rows = swarm.ask()
        if len(rows) > swarm.n_particles:
            return swarm, rows
        swarm.tell(bowl(rows))
    raise AssertionError("the swarm never came to the convergence state")


def test_the_first_rows_are_a_latin_hypercube():
    rows = ParticleSwarm(BOUNDS, rng=4, n_particles=30).ask()
    slices = np.floor((rows - BOUNDS[:, 0]) / RANGE * 30).astype(int)
    for column in slices.T:
        assert sorted(column) == list(range(30))


def test_columns_of_the_first_rows_are_shuffled_independently():
    rows = ParticleSwarm([(0, 1)] * 2, rng=4, n_particles=400).ask()
    assert abs(np.corrcoef(rows.T)[0, 1]) < 0.2


def test_five_particles_a_free_variable_by_default():
    assert ParticleSwarm([(0, 1)] * 7).n_particles == 35
    assert ParticleSwarm([(0, 1), (2, 2), (0, 1)]).n_particles == 10


def test_the_swarm_starts_at_rest():
    assert not ParticleSwarm(BOUNDS, rng=1).velocities.any()


def test_ask_gives_the_same_rows_until_tell():
    swarm = run(ParticleSwarm(BOUNDS, rng=3), 5)
    first = swarm.ask()
    kept = first.copy()
    first[:] = 0.0
    np.testing.assert_array_equal(swarm.ask(), kept)


def test_the_first_move_is_towards_the_global_best_only():
    # At rest, each particle on its own best: v = c2 s (best - p), c2 at most 2.5, s in [0, 1].
    swarm = ParticleSwarm(BOUNDS, rng=9)
    start = swarm.ask()
    swarm.tell(bowl(start))
    step = (swarm.ask()[: swarm.n_particles] - start) / RANGE
    wanted = (swarm.best_x - start) / RANGE
    assert np.all(step * wanted >= 0)
    assert np.all(np.abs(step) <= 2.5 * np.abs(wanted) + 1e-12)
    leader = np.argmin(bowl(start))
    assert not step[leader].any()
    assert np.abs(np.delete(step, leader, axis=0)).min() > 0


def test_without_accelerations_no_particle_moves():
    still = SwarmSettings(acceleration_start=0, acceleration_lower=0, acceleration_upper=0)
    swarm = ParticleSwarm(BOUNDS, rng=1, settings=still)
    start = swarm.ask()
    swarm.tell(bowl(start))
    np.testing.assert_array_equal(swarm.ask()[: swarm.n_particles], start)


@pytest.mark.parametrize("largest", [0.4, 0.05])
def test_no_particle_moves_more_than_the_largest_velocity(largest):
    swarm = ParticleSwarm(BOUNDS, rng=6, settings=SwarmSettings(max_velocity=largest))
    noise = np.random.default_rng(1)
    longest = 0.0
    for _ in range(60):
        before = swarm.positions
        rows = swarm.ask()
        steps = np.abs(rows[: swarm.n_particles] - before) / RANGE
        longest = max(longest, steps.max())
        assert steps.max() <= largest * (1 + 1e-9)
        assert (np.abs(swarm.velocities) / RANGE).max() <= largest * (1 + 1e-9)
        # random costs keep the swarm spread out and fast
        swarm.tell(noise.random(len(rows)))
    assert longest > 0.99 * largest


def test_rows_stay_in_the_box_and_the_walls_are_reached():
    swarm = ParticleSwarm(BOUNDS, rng=2)
    touched = 0
    for _ in range(60):
        rows = swarm.ask()
        assert np.all((rows >= BOUNDS[:, 0]) & (rows <= BOUNDS[:, 1]))
        touched += np.sum((rows == BOUNDS[:, 0]) | (rows == BOUNDS[:, 1]))
        swarm.tell(rows.sum(axis=1))
    assert touched > 0


def test_rounding_takes_no_row_out_of_the_box():
    lower, upper = np.sort(np.random.default_rng(1).normal(size=(2, 500)), axis=0)
    assert np.any(lower + (upper - lower) > upper)
    first = ParticleSwarm(np.column_stack([lower, upper]), rng=0, n_particles=2, x0=upper).ask()[0]
    assert np.all(first <= upper)


def test_no_particle_at_a_wall_goes_on_outwards():
    swarm = ParticleSwarm([(0.0, 1.0)] * 6, rng=2)
    noise = np.random.default_rng(7)
    hits = 0
    for _ in range(60):
        rows = swarm.ask()
        upper, lower = swarm.positions == 1.0, swarm.positions == 0.0
        assert np.all(swarm.velocities[upper] <= 0)
        assert np.all(swarm.velocities[lower] >= 0)
        hits += np.sum(swarm.velocities[upper | lower] != 0)
        swarm.tell(noise.random(len(rows)))
    assert hits > 0


def test_the_best_is_the_lowest_cost_told_and_its_very_row():
    swarm = ParticleSwarm(BOUNDS, rng=5)
    rows_seen, costs_seen = [], []
    for _ in range(40):
        rows = swarm.ask()
        costs = bowl(rows)
        swarm.tell(costs)
        rows_seen.append(rows)
        costs_seen.append(costs)
    costs = np.concatenate(costs_seen)
    assert swarm.best_cost == costs.min()
    np.testing.assert_array_equal(swarm.best_x, np.vstack(rows_seen)[np.argmin(costs)])
    assert swarm.nfev == costs.size
    assert swarm.history == list(np.minimum.accumulate([c.min() for c in costs_seen]))


def test_scaling_a_variable_scales_its_column_and_nothing_else():
    # A power of two is exact, so every decision must come out the same.
    factors = np.array([2.0**40, 1.0, 2.0**-30, 4.0])
    plain = ParticleSwarm([(0, 1)] * 4, rng=7)
    scaled = ParticleSwarm([(0, factor) for factor in factors], rng=7)
    noise = np.random.default_rng(1)
    for k in range(60):
        rows = plain.ask()
        np.testing.assert_array_equal(scaled.ask(), rows * factors)
        # A best that jumps about at random leads the swarm through every state.
        costs = noise.random(len(rows)) - k
        plain.tell(costs)
        scaled.tell(costs)
    assert scaled.state_counts == plain.state_counts
    assert all(plain.state_counts.values())


def test_only_the_order_of_costs_matters():
    plain, warped = ParticleSwarm(BOUNDS, rng=7), ParticleSwarm(BOUNDS, rng=7)
    for _ in range(40):
        np.testing.assert_array_equal(warped.ask(), plain.ask())
        plain.tell(bowl(plain.ask()))
        warped.tell(np.sqrt(bowl(warped.ask())) - 5)


def test_states_are_counted_once_for_each_move():
    swarm = run(ParticleSwarm(BOUNDS, rng=7), 50)
    assert set(swarm.state_counts) == set(EvolutionaryState)
    assert sum(swarm.state_counts.values()) == 49
    swarm.ask()
    assert sum(swarm.state_counts.values()) == 49


def test_the_inertia_follows_the_distances_to_the_global_best():
    # With a large b2 the random part of eq. 11 vanishes, so w tells kappa, small where many dimensions make all
    # distances nearly equal.
    constants = SwarmSettings(inertia_b1=0.3, inertia_b2=1e9)
    for n_dim, branch in ((2, "first"), (4000, "second")):
        swarm = ParticleSwarm([(0, 1)] * n_dim, rng=1, n_particles=60, settings=constants)
        rows = swarm.ask()
        swarm.tell(np.abs(np.arange(60.0) - 33))
        swarm.ask()
        distances = np.linalg.norm(rows - rows[33], axis=1)
        kappa = 1 - distances.mean() / distances.max()
        assert (kappa < 0.05) == (branch == "second")
        expected = 1e9 / abs(np.log(kappa)) if branch == "second" else 0.3e9
        assert swarm.inertia == pytest.approx(expected, rel=1e-8)


# Elitist learning


def next_candidate(swarm):
    """Tell high costs until elitist learning offers its next row; return that."""
    for _ in range(200):
        rows = swarm.ask()
        if len(rows) > swarm.n_particles:
            return rows[-1]
        swarm.tell(np.full(len(rows), 1e12))
    raise AssertionError("the swarm never came back to the convergence state")


def coordinates_off_the_best(swarm, row):
    return np.sum(~np.isclose(row, swarm.best_x, rtol=1e-12))


def test_the_candidate_is_the_best_with_one_coordinate_moved():
    swarm, rows = asked_for_elitist_learning()
    assert swarm.state is EvolutionaryState.CONVERGENCE
    assert len(rows) == swarm.n_particles + 1
    assert coordinates_off_the_best(swarm, rows[-1]) == 1


@pytest.mark.parametrize("done", [False, True])
def test_the_candidate_moves_by_the_whole_range_at_first_and_a_tenth_at_the_end(done):
    swarm = ParticleSwarm([(0.0, 1.0)] * 2, rng=3, horizon=1 if done else 10**9)
    swarm.inject([0.5, 0.5], -1.0)
    moves = []
    for _ in range(600):
        rows = swarm.ask()
        if len(rows) > swarm.n_particles:
            moves.append((rows[-1] - 0.5)[np.argmax(np.abs(rows[-1] - 0.5))])
        swarm.tell(np.zeros(len(rows)))
    assert len(moves) > 200
    if done:
        assert np.std(moves) == pytest.approx(0.1, rel=0.2)
    else:
        # sigma = 1: a normal number passes half the range, where the walls are, in 61.7 % of draws
        assert np.mean(np.abs(moves) == 0.5) == pytest.approx(0.617, abs=0.08)


def test_a_better_candidate_becomes_the_global_best():
    swarm, rows = asked_for_elitist_learning()
    costs = bowl(rows)
    costs[-1] = -1.0
    swarm.tell(costs)
    assert swarm.best_cost == -1.0
    np.testing.assert_array_equal(swarm.best_x, rows[-1])
    assert coordinates_off_the_best(swarm, next_candidate(swarm)) == 1


def test_a_better_candidate_leaves_every_particle_but_the_leader_in_place():
    swarm, rows = asked_for_elitist_learning()
    costs = np.arange(10.0, 10.0 + len(rows))
    costs[-1] = -1.0
    swarm.tell(costs)
    changed = np.flatnonzero(~np.isclose(swarm.positions, rows[:-1], rtol=1e-12).all(axis=1))
    assert changed.size == 1
    np.testing.assert_allclose(swarm.positions[changed[0]], rows[-1], rtol=1e-12)


@pytest.mark.parametrize("worst", range(20))
@pytest.mark.parametrize("candidate_cost", [50.0, 1e9])
def test_another_candidate_takes_the_place_of_the_worst_particle(worst, candidate_cost):
    swarm, rows = asked_for_elitist_learning()
    best = swarm.best_x
    costs = np.arange(100.0, 100.0 + len(rows))
    costs[worst] = 1000.0
    costs[-1] = candidate_cost
    swarm.tell(costs)
    np.testing.assert_allclose(swarm.positions[worst], rows[-1], rtol=1e-12)
    others = np.arange(swarm.n_particles) != worst
    np.testing.assert_allclose(swarm.positions[others], rows[:-1][others], rtol=1e-12)
    # Even where the worst of the moment once found the global best, it is not forgotten.
    np.testing.assert_array_equal(swarm.best_x, best)
    assert coordinates_off_the_best(swarm, next_candidate(swarm)) == 1


def test_a_candidate_without_finite_cost_replaces_nobody():
    swarm, rows = asked_for_elitist_learning()
    costs = bowl(rows)
    costs[-1] = np.nan
    swarm.tell(costs)
    np.testing.assert_allclose(swarm.positions, rows[:-1], rtol=1e-12)


# Costs that are not finite


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_costs_that_are_not_finite_are_counted_and_never_best(bad):
    swarm = ParticleSwarm(BOUNDS, rng=5)
    wrong = 0
    for _ in range(60):
        rows = swarm.ask()
        costs = bowl(rows)
        costs[rows[:, 0] > CENTRE[0] + 0.5] = bad
        wrong += np.sum(~np.isfinite(costs))
        swarm.tell(costs)
    assert swarm.n_nan == wrong > 0
    assert np.isfinite(swarm.best_cost)
    assert swarm.best_x[0] <= CENTRE[0] + 0.5
    assert bowl(swarm.best_x[None])[0] == swarm.best_cost < 1e-6


def test_while_no_cost_is_finite_each_ask_is_a_fresh_latin_hypercube():
    swarm = ParticleSwarm(BOUNDS, rng=5)
    seen = []
    for _ in range(3):
        rows = swarm.ask()
        assert len(rows) == swarm.n_particles
        slices = np.floor((rows - BOUNDS[:, 0]) / RANGE * swarm.n_particles).astype(int)
        assert all(sorted(column) == list(range(swarm.n_particles)) for column in slices.T)
        seen.append(rows)
        swarm.tell(np.full(len(rows), np.nan))
    assert not np.array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[1], seen[2])
    assert swarm.best_cost == np.inf
    assert swarm.best_x.shape == (4,)


def test_a_particle_without_finite_cost_is_drawn_to_the_global_best_alone():
    # The best is the corner, which nobody passes: a pull back to an own best would show as a step down.
    swarm = ParticleSwarm([(0.0, 1.0)] * 30, rng=5, x0=np.ones(30), n_particles=50)
    for _ in range(2):
        before = swarm.ask()[:50]
        costs = np.full(len(swarm.ask()), np.nan)
        costs[0] = 1.0
        swarm.tell(costs)
    steps = swarm.ask()[:50] - before
    assert np.all(steps[before < 1.0] >= 0)
    assert steps.max() > 0.1


def test_a_swarm_recovers_when_costs_become_finite():
    swarm = ParticleSwarm(BOUNDS, rng=5)
    swarm.tell(np.full(len(swarm.ask()), np.inf))
    assert run(swarm, 80).best_cost < 1e-6


# Points from elsewhere


def test_a_better_point_is_injected_exactly():
    swarm = run(ParticleSwarm(BOUNDS, rng=1), 3)
    point = CENTRE + 0.1 * RANGE
    assert swarm.inject(point, -7.0)
    assert swarm.best_cost == -7.0
    np.testing.assert_array_equal(swarm.best_x, point)
    assert swarm.history[-1] == -7.0
    assert any(np.allclose(position, point, rtol=1e-12) for position in swarm.positions)
    assert coordinates_off_the_best(swarm, next_candidate(swarm)) == 1


@pytest.mark.parametrize("cost", [1e6, np.nan])
def test_a_point_that_is_no_better_changes_only_the_counts(cost):
    swarm, quiet = (run(ParticleSwarm(BOUNDS, rng=1), 3) for _ in range(2))
    assert not swarm.inject(CENTRE, cost)
    assert swarm.nfev == quiet.nfev + 1
    assert run(swarm, 5).history == run(quiet, 5).history


def test_the_best_is_replaced_by_a_point_of_the_same_cost_and_nothing_is_counted():
    swarm = run(ParticleSwarm(BOUNDS, rng=1), 3)
    point, cost, evaluations = CENTRE + 0.1 * RANGE, swarm.best_cost, swarm.nfev
    swarm.replace_best(point, cost)
    np.testing.assert_array_equal(swarm.best_x, point)
    assert (swarm.best_cost, swarm.history[-1], swarm.nfev) == (cost, cost, evaluations)
    assert any(np.allclose(position, point, rtol=1e-12) for position in swarm.positions)
    assert coordinates_off_the_best(swarm, next_candidate(swarm)) == 1


def test_the_best_is_not_replaced_between_ask_and_tell():
    swarm = run(ParticleSwarm(BOUNDS, rng=1), 3)
    swarm.ask()
    with pytest.raises(RuntimeError, match="between ask and tell"):
        swarm.replace_best(CENTRE, -7.0)


def test_a_point_injected_before_the_start_leads_the_swarm():
    swarm = ParticleSwarm(BOUNDS, rng=1)
    assert swarm.inject(CENTRE, -3.0)
    run(swarm, 2)
    assert swarm.best_cost == -3.0
    assert swarm.history == [-3.0, -3.0]


def test_a_start_guess_is_the_first_row():
    rows = ParticleSwarm(BOUNDS, rng=1, x0=CENTRE).ask()
    np.testing.assert_allclose(rows[0], CENTRE, rtol=1e-14)


# Fixed variables


def test_a_fixed_variable_keeps_its_value_and_changes_nothing_else():
    fixed = ParticleSwarm([(0, 1), (0.1, 0.1), (0, 1)], rng=3)
    without = ParticleSwarm([(0, 1), (0, 1)], rng=3)
    for _ in range(40):
        rows = fixed.ask()
        assert np.all(rows[:, 1] == 0.1)
        np.testing.assert_array_equal(rows[:, [0, 2]], without.ask())
        costs = ((rows - 0.4) ** 2).sum(axis=1)
        fixed.tell(costs)
        without.tell(costs)
    assert not fixed.velocities[:, 1].any()


def test_a_box_of_fixed_variables_only_is_survived():
    swarm = run(ParticleSwarm([(1, 1), (2, 2)], rng=3), 5, fun=lambda rows: rows.sum(axis=1))
    np.testing.assert_array_equal(swarm.best_x, [1, 2])
    assert swarm.best_cost == 3
