"""Adaptation of the swarm's coefficients, as pure functions: they hold no state and draw no random numbers.

Two separate mechanisms, both fed with positions scaled to the range of each variable:

- the inertia weight follows the focusing distance (Cerini et al. 2024, MSSP 209, 111084, eq. 8-11);
- the acceleration coefficients follow evolutionary state estimation, ESE (Zhan, Zhang, Li, Chung 2009, "Adaptive
  particle swarm optimization", IEEE Trans. SMC-B 39(6), 1362-1381).
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


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
    """Change rate of the focusing distance, kappa = (D_max - D_mean) / D_max (eq. 8-10).

    Parameters
    ----------
    positions : (n_particles, n_dim) array
        Positions, scaled to the range of each variable.
    best : (n_dim,) array
        The global best, scaled likewise: the best position visited so far, at which no particle need be now.

    Returns
    -------
    float
        kappa in [0, 1); 0 where every particle sits on the best (D_max = 0).
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
    kappa > 1 is left out, since kappa is below 1 by construction.

    Parameters
    ----------
    kappa : float
        Change rate of the focusing distance, in [0, 1].
    r : float
        A number drawn from the uniform distribution on [0, 1].
    b1, b2 : float
        The equation's constants.

    Returns
    -------
    float
        The weight; 0 at kappa = 0, the limit of the second branch.
    """
    if kappa >= 0.05:
        return b1 * b2 + abs(r) / 2
    if kappa <= 0.0:
        return 0.0
    return (b2 + abs(r) / 2) / abs(math.log(kappa))


def mean_distances(positions: FloatArray) -> FloatArray:
    """Mean distance of each particle to the others, d_i (Zhan et al. 2009, eq. 7).

    Parameters
    ----------
    positions : (n_particles, n_dim) array
        Positions, scaled to the range of each variable; at least two particles.

    Returns
    -------
    (n_particles,) array
        d_i = sum_j |p_i - p_j| / (n_particles - 1), the mean of roots, not the root of a sum.

    Notes
    -----
    |p_i - p_j|² = |p_i|² + |p_j|² - 2 p_i·p_j needs one matrix product and no (n, n, n_dim) array.
    """
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
    """Evolutionary factor f = (d_best - d_min) / (d_max - d_min) (Zhan et al. 2009, eq. 8).

    Parameters
    ----------
    distances : (n_particles,) array
        Mean distances d_i of `mean_distances`.
    leader : int
        Index of the particle whose own best is the global best. Its present position counts, as that of all others; the
        source's "globally best particle" could also be read as the global best itself.

    Returns
    -------
    float
        f in [0, 1]; 0 where all d_i are equal: a collapsed swarm has converged.
    """
    smallest, largest = float(distances.min()), float(distances.max())
    if largest == smallest:
        return 0.0
    return (float(distances[leader]) - smallest) / (largest - smallest)


def memberships(f: float) -> dict[EvolutionaryState, float]:
    """Fuzzy memberships of the four states (Zhan et al. 2009, eq. 9).

    Parameters
    ----------
    f : float
        Evolutionary factor, in [0, 1].

    Returns
    -------
    dict
        One number in [0, 1] for each state. At most two, of neighbouring states, are above zero; they do not sum to 1.
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
    """State of the swarm; where two memberships overlap, the previous state decides.

    Parameters
    ----------
    f : float
        Evolutionary factor, in [0, 1].
    previous : EvolutionaryState
        The state one iteration ago.

    Returns
    -------
    EvolutionaryState
    """
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

    Parameters
    ----------
    c1, c2 : float
        The present cognitive and social coefficient.
    state : EvolutionaryState
        Of this iteration, just estimated. Exploration moves (c1, c2) by (+, -) a step, exploitation by (+½, -½),
        convergence by (+½, +½), jumping out by (-, +); the source's "slightly" is half a step.
    step : float
        A number drawn from the uniform distribution on [0.05, 0.1], the same for both.
    lower, upper : float
        Each coefficient is clamped to this interval.
    largest_sum : float
        Where c1 + c2 passes this, both are scaled back to it.

    Returns
    -------
    c1, c2 : float
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

    Parameters
    ----------
    done : float
        Fraction of the run that is over; above 1 counts as 1.
    start, end : float
        Values at `done` = 0 and 1; linear between.

    Returns
    -------
    float
    """
    done = min(done, 1.0)
    return start * (1.0 - done) + end * done
