"""Constants of the swarm, and adaptation of its coefficients.

The functions are pure: they hold no state and draw no random numbers.

Two separate mechanisms, both fed with positions scaled to the range of each variable:

- the inertia weight follows the focusing distance (Cerini et al. 2024, MSSP 209, 111084, eq. 8-11);
- the acceleration coefficients follow evolutionary state estimation, ESE (Zhan, Zhang, Li, Chung 2009, "Adaptive
  particle swarm optimization", IEEE Trans. SMC-B 39(6), 1362-1381).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sysid.errors import as_float, refuse, whole_number

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class SwarmSettings:
    """Constants of the adaptive swarm; the defaults are those of the sources.

    Attributes
    ----------
    max_velocity : float
        Largest step of a particle in one iteration, in parts of a variable's range. Essential: without it
        c1 + c2 = 4 is unstable in mean square.
    inertia_b1, inertia_b2 : float
        Constants of the inertia weight (Cerini et al. 2024, eq. 11).
    acceleration_start : float
        c1 and c2 at the start (Zhan et al. 2009).
    acceleration_lower, acceleration_upper : float
        Interval to which c1 and c2 are clamped.
    acceleration_sum : float
        Largest c1 + c2.
    acceleration_step_lower, acceleration_step_upper : float
        The step of c1 and c2 is uniform between these.
    elitist_sigma_start, elitist_sigma_end : float
        Standard deviation of elitist learning at the start and end of the run, in parts of the range.
    guides : int
        Above 0, the social term of eq. 7 draws each particle to the mean of the own bests of so many particles, instead
        of to the global best; they are drawn anew for each particle and iteration, independently, from the best ones.
    guide_share : float
        Part of the swarm that they are drawn from, in (0, 1].

    Raises
    ------
    InputError
        If a number is negative or not finite, an upper number lies below its lower one, `guides` is not whole, or
        `guide_share` is 0 or above 1.
    """

    max_velocity: float = 0.4
    inertia_b1: float = 0.3
    inertia_b2: float = 0.2
    acceleration_start: float = 2.0
    acceleration_lower: float = 1.5
    acceleration_upper: float = 2.5
    acceleration_sum: float = 4.0
    acceleration_step_lower: float = 0.05
    acceleration_step_upper: float = 0.1
    elitist_sigma_start: float = 1.0
    elitist_sigma_end: float = 0.1
    guides: int = 0
    guide_share: float = 0.25

    def __post_init__(self) -> None:
        for field in fields(self):
            as_float(f"SwarmSettings.{field.name}", getattr(self, field.name), "a finite number >= 0", at_least=0)
        still = "SwarmSettings.max_velocity is 0, so no particle could move; give a number above zero."
        refuse((self.max_velocity == 0, still))
        whole_number("SwarmSettings.guides", self.guides, at_least=0)
        no_part = f"SwarmSettings.guide_share is {self.guide_share!r}; give a part of the swarm, in (0, 1]."
        refuse((not 0 < self.guide_share <= 1, no_part))
        for name in ("acceleration", "acceleration_step"):
            lower, upper = getattr(self, f"{name}_lower"), getattr(self, f"{name}_upper")
            crossed = f"SwarmSettings.{name}_lower = {lower} is above {name}_upper = {upper}; exchange the two."
            refuse((lower > upper, crossed))


class EvolutionaryState(IntEnum):
    """The four states of a swarm (Zhan et al. 2009), numbered as there."""

    EXPLORATION = 1
    EXPLOITATION = 2
    CONVERGENCE = 3
    JUMPING_OUT = 4


_S1, _S2, _S3, _S4 = EvolutionaryState

# Where two memberships overlap the previous state decides; the entry at position p - 1 follows previous state p.
_OVERLAP = {
    (_S1, _S2): (_S1, _S2, _S2, _S1),
    (_S1, _S4): (_S1, _S4, _S4, _S4),
    (_S2, _S3): (_S2, _S2, _S3, _S2),
}

# Direction of (c1, c2) in units of the step.
_DIRECTION = {
    _S1: (1.0, -1.0),
    _S2: (0.5, -0.5),
    _S3: (0.5, 0.5),
    _S4: (-1.0, 1.0),
}


def focusing_change_rate(positions: FloatArray, best: FloatArray) -> float:
    """Change rate of the focusing distance, kappa = (D_max - D_mean) / D_max in [0, 1) (eq. 8-10).

    Of positions (n_particles, n_dim) and the best position visited so far, (n_dim,), at which no particle need be now.
    0 where every particle sits on it.
    """
    distances = np.linalg.norm(positions - best, axis=1)
    largest = float(distances.max())
    if largest == 0.0:
        return 0.0
    # Equal distances can have a mean a rounding above their maximum.
    return max(0.0, (largest - float(distances.mean())) / largest)


def inertia_weight(kappa: float, r: float, b1: float = 0.3, b2: float = 0.2) -> float:
    """Inertia weight w from the change rate of the focusing distance (eq. 11).

    w = b1 b2 + |r|/2 for 0.05 <= kappa <= 1, and (b2 + |r|/2) / |ln kappa| below 0.05. The equation's branch for
    kappa > 1 is left out, since kappa is below 1 by construction; at kappa = 0 the weight is 0, the limit of the second
    branch. r is drawn from the uniform distribution on [0, 1].
    """
    if kappa >= 0.05:
        return b1 * b2 + abs(r) / 2
    if kappa <= 0.0:
        return 0.0
    return (b2 + abs(r) / 2) / abs(math.log(kappa))


def mean_distances(positions: FloatArray) -> FloatArray:
    """Mean distance of each particle to the others, (n_particles,) (Zhan et al. 2009, eq. 7).

    d_i = sum_j |p_i - p_j| / (n_particles - 1), the mean of roots, not the root of a sum.
    """
    # |p_i - p_j|² = |p_i|² + |p_j|² - 2 p_i·p_j needs one matrix product and no (n, n, n_dim) array.
    # About their mean, because the products cancel badly when a tight swarm sits far from the origin.
    centred = positions - positions.mean(axis=0)
    squares = np.einsum("ij,ij->i", centred, centred)
    distances: FloatArray = centred @ centred.T
    distances *= -2.0
    distances += squares[:, None]
    distances += squares
    # Coinciding particles come out a rounding below zero.
    np.maximum(distances, 0.0, out=distances)
    np.fill_diagonal(distances, 0.0)
    np.sqrt(distances, out=distances)
    means: FloatArray = distances.sum(axis=1) / (len(positions) - 1)
    return means


def evolutionary_factor(distances: FloatArray, leader: int) -> float:
    """Evolutionary factor f = (d_best - d_min) / (d_max - d_min) in [0, 1] (Zhan et al. 2009, eq. 8).

    d_best is of the particle whose own best is the global best, where it is now; the source's "globally best particle"
    could also be read as the global best itself. 0 where all d_i are equal: a collapsed swarm has converged.
    """
    smallest, largest = float(distances.min()), float(distances.max())
    if largest == smallest:
        return 0.0
    return (float(distances[leader]) - smallest) / (largest - smallest)


def memberships(f: float) -> dict[EvolutionaryState, float]:
    """Fuzzy memberships of the four states (Zhan et al. 2009, eq. 9), in [0, 1].

    At most two, of neighbouring states, are above zero; they do not sum to 1.
    """
    return {
        _S1: _trapezoid(5 * f - 2, -10 * f + 8),
        _S2: _trapezoid(10 * f - 2, -5 * f + 3),
        _S3: _trapezoid(1.0, -5 * f + 1.5),
        _S4: _trapezoid(5 * f - 3.5, 1.0),
    }


def _trapezoid(rising: float, falling: float) -> float:
    return max(0.0, min(rising, falling, 1.0))


def next_state(f: float, previous: EvolutionaryState) -> EvolutionaryState:
    """State of the swarm; where two memberships overlap, the previous state decides."""
    active = tuple(state for state, degree in memberships(f).items() if degree > 0)
    if len(active) == 1:
        return active[0]
    first, second = active
    return _OVERLAP[first, second][previous - 1]


def next_accelerations(
    c1: float,
    c2: float,
    state: EvolutionaryState,
    step: float,
    *,
    lower: float = 1.5,
    upper: float = 2.5,
    largest_sum: float = 4.0,
) -> tuple[float, float]:
    """Cognitive and social coefficients of the next iteration (Zhan et al. 2009, section III-C).

    Both move by the step, in the directions of the state; then each is clamped; then, where their sum is too large,
    both are multiplied by the same factor. They are not clamped again: with the source's constants no need is left, but
    where `lower` + `upper` > `largest_sum` one of them can end below `lower`.

    Exploration moves (c1, c2) by (+, -) a step, exploitation by (+½, -½), convergence by (+½, +½), jumping out by
    (-, +); the source's "slightly" is half a step. The step is drawn from the uniform distribution on [0.05, 0.1], one
    for both.
    """
    to_personal_best, to_global_best = _DIRECTION[state]
    c1 = min(max(c1 + to_personal_best * step, lower), upper)
    c2 = min(max(c2 + to_global_best * step, lower), upper)
    total = c1 + c2
    if total > largest_sum:
        c1, c2 = c1 * largest_sum / total, c2 * largest_sum / total
    return c1, c2


def elitist_sigma(done: float, start: float = 1.0, end: float = 0.1) -> float:
    """Standard deviation of elitist learning, in parts of the range (Zhan et al. 2009, eq. 15).

    From `start` to `end`, linear in the fraction of the run that is done; above 1 counts as 1.
    """
    done = min(done, 1.0)
    return start * (1.0 - done) + end * done
