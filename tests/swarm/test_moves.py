"""One iteration of the swarm: a transcription of the sources in plain loops, and what each coefficient and draw does.

Eq. 7 to 11 are those of Cerini et al. 2024 (MSSP 209, 111084); states and accelerations follow Zhan, Zhang, Li, Chung
2009 (IEEE Trans. SMC-B 39(6), 1362-1381).
"""

import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import kstest

from sysid.swarm import EvolutionaryState, ParticleSwarm, SwarmSettings

EXPLORATION, EXPLOITATION, CONVERGENCE, JUMPING_OUT = EvolutionaryState
DIRECTIONS = {EXPLORATION: (1.0, -1.0), EXPLOITATION: (0.5, -0.5), CONVERGENCE: (0.5, 0.5), JUMPING_OUT: (-1.0, 1.0)}


def factor_of(positions, leader):
    """Evolutionary factor of points in the unit cube."""
    distances = cdist(positions, positions).sum(axis=1) / (len(positions) - 1)
    return (distances[leader] - distances.min()) / (distances.max() - distances.min())


def state_after(f, previous):
    """The supports of the trapezoids, and the table that decides where two of them overlap."""
    overlaps = {(0.2, 0.3): (2, 2, 3, 2), (0.4, 0.6): (1, 2, 2, 1), (0.7, 0.8): (1, 4, 4, 4)}
    for (lower, upper), by_previous in overlaps.items():
        if lower < f < upper:
            return EvolutionaryState(by_previous[previous - 1])
    return EvolutionaryState(3 if f <= 0.2 else 2 if f <= 0.4 else 1 if f <= 0.7 else 4)


class Transcription:
    """The swarm in the unit cube, particle by particle and variable by variable."""

    def __init__(self, first_rows, seed, horizon, guides=0, among=0):
        self.rng = np.random.default_rng(seed)
        self.rng.integers(2**63)  # the seed of the first sample
        self.p, self.horizon, self.nit = first_rows.copy(), horizon, 0
        self.v, self.own = np.zeros_like(self.p), self.p.copy()
        self.own_costs, self.best_cost, self.best, self.leader = np.full(len(self.p), np.inf), np.inf, None, 0
        self.state, self.c1, self.c2, self.w, self.candidate = EXPLORATION, 2.0, 2.0, 0.0, None
        self.guides, self.among = guides, among

    def move(self):
        rng, p = self.rng, self.p
        self.state = state_after(factor_of(p, self.leader), self.state)
        step = rng.uniform(0.05, 0.1)
        self.c1, self.c2 = (
            min(max(c + sign * step, 1.5), 2.5)
            for c, sign in zip((self.c1, self.c2), DIRECTIONS[self.state], strict=True)
        )
        if self.c1 + self.c2 > 4.0:
            self.c1, self.c2 = (4.0 * c / (self.c1 + self.c2) for c in (self.c1, self.c2))
        focusing = [math.dist(row, self.best) for row in p]
        kappa = (max(focusing) - sum(focusing) / len(p)) / max(focusing)
        r = rng.random()
        self.w = 0.3 * 0.2 + r / 2 if kappa >= 0.05 else (0.2 + r / 2) / abs(math.log(kappa))
        self.candidate = None
        if self.state is CONVERGENCE:
            self.candidate = self.best.copy()
            j = rng.integers(p.shape[1])
            sigma = 1.0 - 0.9 * min(self.nit / self.horizon, 1.0)
            self.candidate[j] = min(max(self.candidate[j] + rng.normal(0.0, sigma), 0.0), 1.0)
        towards = [self.best] * len(p)
        if self.guides:
            best = sorted(range(len(p)), key=lambda i: self.own_costs[i])[: self.among]
            drawn = rng.integers(self.among, size=(self.guides, len(p)))
            towards = [sum(self.own[best[k]] for k in drawn[:, i]) / self.guides for i in range(len(p))]
        r, s = rng.random(p.shape), rng.random(p.shape)
        for i, j in np.ndindex(*p.shape):
            cognitive = self.c1 * r[i, j] * (self.own[i, j] - p[i, j])
            social = self.c2 * s[i, j] * (towards[i][j] - p[i, j])
            v = min(max(self.w * self.v[i, j] + cognitive + social, -0.4), 0.4)
            p[i, j] += v
            if p[i, j] <= 0.0:
                p[i, j], v = 0.0, abs(v)
            elif p[i, j] >= 1.0:
                p[i, j], v = 1.0, -abs(v)
            self.v[i, j] = v

    def remember(self, costs):
        self.nit += 1
        now = costs[: len(self.p)].copy()
        for i, cost in enumerate(now):
            if cost < self.own_costs[i]:
                self.own[i], self.own_costs[i] = self.p[i], cost
        if self.own_costs.min() < self.best_cost:
            self.leader = int(self.own_costs.argmin())
            self.best, self.best_cost = self.own[self.leader].copy(), self.own_costs[self.leader]
        if self.candidate is None:
            return
        cost = costs[-1]
        if cost < self.best_cost:
            self.best, self.best_cost = self.candidate.copy(), cost
            self.p[self.leader] = self.own[self.leader] = self.candidate
            self.own_costs[self.leader] = cost
        else:
            worst = int(now.argmax())
            self.p[worst] = self.candidate
            if cost < self.own_costs[worst]:
                self.own[worst], self.own_costs[worst] = self.candidate, cost


@pytest.mark.parametrize(("seed", "guides"), [(0, 0), (1, 0), (2, 0), (0, 3), (1, 1)])
def test_sixty_iterations_are_those_of_a_transcription_with_the_same_random_stream(seed, guides):
    """With guides too: 4 of the 12 particles are the best 30 %, rounded up."""
    settings = SwarmSettings(guides=guides, guide_share=0.3)
    swarm = ParticleSwarm([(0.0, 1.0)] * 3, rng=seed, n_particles=12, horizon=40, settings=settings)
    expected, noise = Transcription(swarm.ask(), seed, 40, guides, among=4), np.random.default_rng(100 + seed)
    for k in range(60):
        rows = swarm.ask()
        if k:
            expected.move()
        states = (swarm.state, swarm.cognitive, swarm.social, swarm.inertia)
        assert states == pytest.approx((expected.state, expected.c1, expected.c2, expected.w), rel=1e-11), k
        np.testing.assert_allclose(rows[:12], expected.p, rtol=0, atol=1e-12)
        np.testing.assert_allclose(swarm.velocities, expected.v, rtol=0, atol=1e-12)
        assert len(rows) == 12 + (expected.candidate is not None)
        if expected.candidate is not None:
            np.testing.assert_allclose(rows[12], expected.candidate, rtol=0, atol=1e-12)
        # Costs by chance that fall slowly lead through all states, and leave most particles behind their own best.
        costs = noise.random(len(rows)) - 0.05 * k
        swarm.tell(costs)
        expected.remember(costs)
    assert all(swarm.state_counts.values())
    np.testing.assert_allclose(swarm.best_x, expected.best, rtol=0, atol=1e-12)


# The same by its parts, whatever the order in which random numbers are drawn


class Move(NamedTuple):
    """State before a move, and after it."""

    positions: np.ndarray
    best: np.ndarray
    previous: EvolutionaryState
    state: EvolutionaryState
    step: np.ndarray  # of (c1, c2)
    inertia: float
    elitist: bool


def followed(seed, settings=None, count=200):
    """Moves of a swarm whose best jumps about at random."""
    swarm, noise = (
        ParticleSwarm([(0.0, 1.0)] * 2, rng=seed, n_particles=10, settings=settings),
        np.random.default_rng(7),
    )
    moves = []
    for k in range(1 + count):
        before = swarm.positions, swarm.best_x, swarm.state
        accelerations = swarm.cognitive, swarm.social
        rows = swarm.ask()
        if k:
            step = np.subtract((swarm.cognitive, swarm.social), accelerations)
            moves.append(Move(*before, swarm.state, step, swarm.inertia, len(rows) > 10))
        # Each cost is below all before it, so that the leader of the moment stands at the best.
        swarm.tell(noise.random(len(rows)) - k)
    return moves


@pytest.fixture(scope="module")
def moves():
    return followed(seed=1)


def test_the_state_follows_from_the_factor_and_in_overlaps_from_the_state_before(moves):
    decided_by_the_previous = 0
    for move in moves:
        f = factor_of(move.positions, int(cdist(move.positions, move.best[None]).argmin()))
        assert move.state is state_after(f, move.previous), f
        decided_by_the_previous += move.state is not state_after(f, EXPLORATION)
    assert decided_by_the_previous > 10
    assert {move.state for move in moves} == set(EvolutionaryState)


def test_each_iteration_moves_both_accelerations_by_a_new_step_in_the_direction_of_its_state():
    """Limits so wide that none is met."""
    limits = {"acceleration_lower": 0.0, "acceleration_upper": 100.0, "acceleration_sum": 200.0}
    moves, steps = followed(seed=2, settings=SwarmSettings(acceleration_start=50.0, **limits)), []
    for move in moves:
        direction = np.array(DIRECTIONS[move.state])
        steps.append(move.step @ direction / (direction @ direction))
        np.testing.assert_allclose(move.step, steps[-1] * direction, rtol=0, atol=1e-12)
    assert {move.state for move in moves} == set(EvolutionaryState)
    assert kstest(steps, "uniform", (0.05, 0.05)).pvalue > 1e-3


def test_the_inertia_draws_a_new_random_number_each_iteration(moves):
    """Solved for r in eq. 11 (b1 = 0.3, b2 = 0.2)."""
    drawn = []
    for move in moves:
        distances = np.linalg.norm(move.positions - move.best, axis=1)
        kappa = 1 - distances.mean() / distances.max()
        constant, factor = (0.3 * 0.2, 1.0) if kappa >= 0.05 else (0.2, abs(math.log(kappa)))
        drawn.append(2 * (move.inertia * factor - constant))
    assert kstest(drawn, "uniform").pvalue > 1e-3


def test_elitist_learning_offers_its_row_in_the_convergence_state_and_in_no_other(moves):
    assert all(move.elitist == (move.state is CONVERGENCE) for move in moves)
    assert {move.state for move in moves} == set(EvolutionaryState)


@pytest.mark.parametrize("state", [EXPLORATION, JUMPING_OUT])
def test_c1_weighs_the_own_best_and_c2_the_global_best(state):
    """With steps of 2 the first move has (c1, c2) = (4, 0) in exploration and (0, 4) in jumping out, where it is from
    rest, every particle at its own best.
    """
    ends = {"acceleration_lower": 0.0, "acceleration_upper": 4.0}
    steps = {"acceleration_step_lower": 2.0, "acceleration_step_upper": 2.0}
    swarm = ParticleSwarm([(0.0, 1.0)] * 2, rng=5, n_particles=30, settings=SwarmSettings(**ends, **steps))
    start = swarm.ask()
    factors = np.array([factor_of(start, leader) for leader in range(30)])
    leader = int(np.argmin(np.abs(factors - (0.65 if state is EXPLORATION else 1.0))))
    swarm.tell((np.arange(30) != leader).astype(float))
    moved = swarm.ask() - start
    assert swarm.state is state
    if state is EXPLORATION:
        assert not moved.any()
    else:
        assert np.count_nonzero(moved) == 58


def test_every_particle_and_variable_has_an_own_draw_towards_either_best():
    """The variance is that of two independent uniform numbers, (c1² a² + c2² b²) / 12, and no two variables share one.

    With c1 = c2 = 0.5 nobody comes to a wall: a particle moves from its own best, at rest, towards the global best in
    the centre, and is then drawn by both.
    """
    half = {"acceleration_start": 0.5, "acceleration_lower": 0.5, "acceleration_upper": 0.5}
    n, d = 1000, 6
    swarm = ParticleSwarm(
        [(0.0, 1.0)] * d, rng=6, n_particles=n, x0=np.full(d, 0.5), settings=SwarmSettings(**half, max_velocity=1.0)
    )
    start = swarm.ask()
    swarm.tell((np.arange(n) > 0).astype(float))
    rows, first = swarm.ask(), swarm.velocities[1:]
    towards_best = 0.5 - start[1:]
    s = first / (0.5 * towards_best)
    assert kstest(s.ravel(), "uniform").pvalue > 1e-3

    costs = np.full(len(rows), 2.0)
    costs[n:] = np.nan  # a candidate of elitist learning takes nobody's place
    swarm.tell(costs)
    a, b = start[1:] - rows[1:n], 0.5 - rows[1:n]
    swarm.ask()
    assert np.all(np.abs(swarm.positions - 0.5) < 0.5)
    drawn = swarm.velocities[1:] - swarm.inertia * first
    centred = (drawn - 0.25 * (a + b)) / np.sqrt((a**2 + b**2) / 48)
    assert np.mean(centred) == pytest.approx(0.0, abs=0.05)
    assert np.mean(centred**2) == pytest.approx(1.0, abs=0.05)
    for draws in (s, centred):
        shared = np.corrcoef(draws.T)[np.triu_indices(d, 1)]
        assert np.mean(shared) == pytest.approx(0.0, abs=0.03)  # four standard deviations of 15 pairs


def test_guides_draw_to_the_mean_of_own_bests_among_the_best_quarter():
    """Eight particles on the diagonal of a cube, at rest: of the two that are best, at 0.2 and 0.6, two draws have the
    mean 0.2, 0.4 or 0.6, with 1, 2 and 1 of 4 chances. The mean step over all variables is c2 / 2 of the way there.
    """
    size, at = 1500, np.array([0.9, 0.2, 0.8, 0.1, 0.6, 0.3, 1.0, 0.5])
    half = {"acceleration_start": 0.5, "acceleration_lower": 0.5, "acceleration_upper": 0.5}
    means = []
    for seed in range(12):
        settings = SwarmSettings(**half, guides=2, guide_share=0.25, max_velocity=1.0)
        swarm = ParticleSwarm([(0.0, 1.0)] * size, rng=seed, n_particles=8, settings=settings)
        swarm.ask()
        swarm.tell([7.0, 1.0, 5.0, 6.0, 2.0, 4.0, np.inf, 3.0], np.repeat(at[:, None], size, axis=1))
        means.extend(at + (swarm.ask()[:8].mean(axis=1) - at) / 0.25)
    nearest = np.array([0.2, 0.4, 0.6])[np.abs(np.subtract.outer(means, [0.2, 0.4, 0.6])).argmin(axis=1)]
    np.testing.assert_allclose(means, nearest, rtol=0, atol=0.055)  # four standard deviations of 2 · 0.9 s over 1500
    assert [np.mean(nearest == mean) for mean in (0.2, 0.4, 0.6)] == pytest.approx([0.25, 0.5, 0.25], abs=0.15)


def test_a_particle_without_a_finite_cost_guides_nobody():
    """One particle of six has a cost: with all six as guides, it alone is drawn to, in steps of its own side."""
    swarm = ParticleSwarm(
        [(0.0, 1.0)] * 3, rng=3, n_particles=6, settings=SwarmSettings(guides=3, guide_share=1.0, max_velocity=1.0)
    )
    start = swarm.ask()
    swarm.tell([np.nan, np.inf, 1.0, np.nan, np.inf, np.nan])
    step = swarm.ask()[:6] - start
    assert not step[2].any()
    assert np.all(step * (start[2] - start) >= 0)
    assert np.delete(step, 2, axis=0).all()
