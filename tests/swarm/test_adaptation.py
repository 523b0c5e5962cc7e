"""Adaptation rules against the figures of their sources, worked out by hand."""

import math

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sysid.swarm import EvolutionaryState
from sysid.swarm.adaptation import (
    elitist_sigma,
    evolutionary_factor,
    focusing_change_rate,
    inertia_weight,
    mean_distances,
    memberships,
    next_accelerations,
    next_state,
)

EXPLORATION, EXPLOITATION, CONVERGENCE, JUMPING_OUT = EvolutionaryState


@pytest.mark.parametrize(
    ("f", "exploration", "exploitation", "convergence", "jumping_out"),
    [
        # breakpoints
        (0.0, 0, 0, 1, 0),
        (0.1, 0, 0, 1, 0),
        (0.2, 0, 0, 0.5, 0),
        (0.3, 0, 1, 0, 0),
        (0.4, 0, 1, 0, 0),
        (0.6, 1, 0, 0, 0),
        (0.7, 1, 0, 0, 0),
        (0.8, 0, 0, 0, 0.5),
        (0.9, 0, 0, 0, 1),
        (1.0, 0, 0, 0, 1),
        # between them
        (0.05, 0, 0, 1, 0),
        (0.15, 0, 0, 0.75, 0),
        (0.25, 0, 0.5, 0.25, 0),
        (0.35, 0, 1, 0, 0),
        (0.45, 0.25, 0.75, 0, 0),
        (0.5, 0.5, 0.5, 0, 0),
        (0.65, 1, 0, 0, 0),
        (0.72, 0.8, 0, 0, 0.1),
        (0.75, 0.5, 0, 0, 0.25),
        (0.85, 0, 0, 0, 0.75),
        (0.95, 0, 0, 0, 1),
    ],
)
def test_memberships_take_the_values_of_the_trapezoids(f, exploration, exploitation, convergence, jumping_out):
    expected = {
        EXPLORATION: exploration,
        EXPLOITATION: exploitation,
        CONVERGENCE: convergence,
        JUMPING_OUT: jumping_out,
    }
    assert memberships(f) == pytest.approx(expected, abs=1e-14)


def test_one_or_two_states_are_active_everywhere():
    active = [sum(degree > 0 for degree in memberships(f).values()) for f in np.linspace(0, 1, 2001)]
    assert min(active) == 1
    assert max(active) == 2


@pytest.mark.parametrize(
    ("f", "after_each_previous_state"),
    [
        (0.05, (3, 3, 3, 3)),
        (0.15, (3, 3, 3, 3)),
        (0.35, (2, 2, 2, 2)),
        (0.65, (1, 1, 1, 1)),
        (0.95, (4, 4, 4, 4)),
        # overlaps, on either side of where the two memberships are equal
        (0.45, (1, 2, 2, 1)),
        (0.55, (1, 2, 2, 1)),
        (0.71, (1, 4, 4, 4)),
        (0.79, (1, 4, 4, 4)),
        (0.22, (2, 2, 3, 2)),
        (0.28, (2, 2, 3, 2)),
    ],
)
def test_the_previous_state_decides_in_overlaps_and_nowhere_else(f, after_each_previous_state):
    decided = tuple(next_state(f, previous) for previous in EvolutionaryState)
    assert decided == tuple(EvolutionaryState(number) for number in after_each_previous_state)


def test_the_factor_is_where_the_leader_stands_between_the_extremes():
    assert evolutionary_factor(np.array([2.0, 3.0, 6.0]), leader=1) == 0.25
    assert evolutionary_factor(np.array([2.0, 3.0, 6.0]), leader=0) == 0.0
    assert evolutionary_factor(np.array([2.0, 3.0, 6.0]), leader=2) == 1.0


def test_the_factor_of_equal_distances_is_convergence():
    factor = evolutionary_factor(np.full(4, 0.3), leader=2)
    assert factor == 0.0
    assert next_state(factor, JUMPING_OUT) is CONVERGENCE


def test_mean_distances_of_a_right_triangle():
    # sides 3, 4 and 5
    corners = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    np.testing.assert_allclose(mean_distances(corners), [3.5, 4.0, 4.5], rtol=1e-14)


@pytest.mark.parametrize(("centre", "spread"), [(0.0, 1.0), (0.5, 0.1), (0.9, 1e-7)])
def test_mean_distances_agree_with_scipy(centre, spread):
    positions = centre + spread * np.random.default_rng(5).normal(size=(40, 7))
    expected = cdist(positions, positions).sum(axis=1) / 39
    np.testing.assert_allclose(mean_distances(positions), expected, rtol=1e-7)


def test_mean_distances_of_coinciding_particles_are_finite():
    distances = mean_distances(np.tile(np.random.default_rng(2).random(9), (6, 1)))
    assert np.isfinite(distances).all()
    assert distances.max() < 1e-15


def test_focusing_change_rate_of_known_distances():
    # distances 1, 3 and 5 from the best: (5 - 3) / 5
    positions = np.array([[1.0, 0.0], [0.0, 3.0], [3.0, 4.0]])
    assert focusing_change_rate(positions, np.zeros(2)) == pytest.approx(0.4)


def test_focusing_change_rate_of_a_swarm_on_its_best_is_zero():
    assert focusing_change_rate(np.full((5, 3), 0.25), np.full(3, 0.25)) == 0.0


def test_focusing_change_rate_of_equal_distances_is_not_negative():
    for distance in np.random.default_rng(3).random(200):
        positions = np.full((7, 1), distance)
        assert 0.0 <= focusing_change_rate(positions, np.zeros(1)) < 1e-15


@pytest.mark.parametrize(
    ("kappa", "r", "weight"),
    [
        (1.0, 0.0, 0.06),
        (0.5, 0.5, 0.31),
        (0.05, 1.0, 0.56),
        # the second branch, 1 / |ln kappa| = 1/4 and 1/10
        (math.exp(-4), 0.0, 0.05),
        (math.exp(-4), 1.0, 0.175),
        (math.exp(-10), 0.6, 0.05),
        # its limit
        (0.0, 0.7, 0.0),
    ],
)
def test_inertia_weight_of_both_branches_and_the_guard(kappa, r, weight):
    assert inertia_weight(kappa, r) == pytest.approx(weight, rel=1e-13)


def test_inertia_weight_is_continuous_at_its_guard():
    assert inertia_weight(1e-300, 1.0) < 0.7 / 690


@pytest.mark.parametrize(
    ("state", "c1", "c2"),
    [(EXPLORATION, 2.08, 1.92), (EXPLOITATION, 2.04, 1.96), (JUMPING_OUT, 1.92, 2.08)],
)
def test_accelerations_step_in_the_direction_of_the_state(state, c1, c2):
    assert next_accelerations(2.0, 2.0, state, 0.08) == pytest.approx((c1, c2))


def test_convergence_raises_both_accelerations_by_half_a_step():
    assert next_accelerations(1.6, 1.8, CONVERGENCE, 0.1) == pytest.approx((1.65, 1.85))


def test_accelerations_are_clamped():
    assert next_accelerations(2.48, 1.51, EXPLORATION, 0.1) == (2.5, 1.5)
    assert next_accelerations(1.51, 2.48, JUMPING_OUT, 0.1) == (1.5, 2.5)


def test_accelerations_past_the_sum_are_scaled_back_in_proportion():
    c1, c2 = next_accelerations(2.3, 1.7, CONVERGENCE, 0.1)
    assert c1 + c2 == pytest.approx(4.0)
    assert c1 / c2 == pytest.approx(2.35 / 1.75)


def test_accelerations_stay_in_their_limits_whatever_the_states():
    rng = np.random.default_rng(8)
    c1 = c2 = 2.0
    for number in rng.integers(1, 5, size=2000):
        c1, c2 = next_accelerations(c1, c2, EvolutionaryState(int(number)), rng.uniform(0.05, 0.1))
        assert 1.5 <= c1 <= 2.5
        assert 1.5 <= c2 <= 2.5
        assert c1 + c2 <= 4.0 + 1e-14


@pytest.mark.parametrize(("done", "sigma"), [(0.0, 1.0), (0.5, 0.55), (1.0, 0.1), (3.0, 0.1)])
def test_sigma_falls_from_one_to_a_tenth_and_stays(done, sigma):
    assert elitist_sigma(done) == pytest.approx(sigma)
