"""The adaptive particle swarm in ask and tell form."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, RandomSource, instance, random_generator, whole_number

from . import adaptation
from .adaptation import EvolutionaryState, SwarmSettings
from .box import Box, checked_costs, checked_rows, latin_hypercube

FloatArray = NDArray[np.float64]

# What changes while the swarm moves: arrays over its particles, or none, and numbers.
_ARRAYS = ("positions", "velocities", "costs", "pbest", "pbest_costs", "candidate", "asked")
_NUMBERS = ("nit", "nfev", "n_nan", "horizon", "inertia", "cognitive", "social")


class ParticleSwarm:
    """Adaptive particle swarm: ask for rows, tell their costs, repeat.

    The first rows are a Latin hypercube sample at rest. From then on each `ask` adapts the coefficients to the
    swarm's state, moves the particles by eq. 7 of Cerini et al. 2024 (MSSP 209, 111084),

        v <- w v + c1 r (own best - p) + c2 s (global best - p),    |v| <= 0.4 range,    p <- p + v

    (r, s uniform on [0, 1], one draw a particle and variable), and, in the convergence state, adds one row: the
    global best with one coordinate moved at random (elitist learning, Zhan et al. 2009, IEEE Trans. SMC-B 39(6)). That
    row becomes the global best if its cost is lower, else it takes the place of the worst particle.

    With `SwarmSettings.guides` of m > 0 a mean takes the place of the global best in eq. 7: that of the own bests of m
    particles, drawn for each particle from the best ones.

    Four things the sources leave open, or can be read in two ways; here:

    - State estimation takes the leader's present position: d_best is the mean distance of the particle whose own best
      is the global best from the others, all where they are now. The focusing distance of the inertia weight (eq. 8-10)
      is measured from the global best itself, the best position ever visited.
    - A particle that reaches or passes a bound is put on it, and its velocity in that variable, limited to 0.4 of the
      range, points back inwards with the same size. Its other variables go on as they were.
    - c1 and c2 change by one step, drawn anew each iteration, before the move; direction, clamping and the limit of
      their sum: `sysid.swarm.adaptation.next_accelerations`.
    - A particle that is moved to the row of elitist learning, or to a point of `inject`, keeps its velocity.

    Costs that are not finite are counted and read as +inf: such a point never becomes a best. While no finite cost is
    known at all, each `ask` is a new Latin hypercube, since there is no best to move towards.

    The same seed gives the same bits on one machine with one number of BLAS threads. The object may be copied
    (`copy.deepcopy`) or pickled at any moment, and the copy goes on with the same bits. If the evaluation of the rows
    is interrupted, the object is untouched: the best so far can be read, and `ask` gives the same rows again.

    Parameters
    ----------
    bounds : (n_dim, 2) array-like or scipy.optimize.Bounds
        Lower and upper bound of each variable, finite; lower == upper fixes the variable.
    rng : int, numpy.random.Generator, numpy.random.SeedSequence or None
        Source of random numbers; None is a new one.
    n_particles : int, optional
        At least 2; five for each free variable by default.
    horizon : int
        Iterations over which the steps of elitist learning shrink; more may be asked for.
    x0 : (n_dim,) array-like, optional
        A starting point inside the bounds: it takes the place of the first row of the sample.
    settings : SwarmSettings
        The constants.

    Attributes
    ----------
    box : Box
        The bounds, and the scaling to the unit cube of the free variables.
    nit : int
        Iterations whose costs are known; the sample is the first.
    nfev : int
        Rows whose cost is known.
    n_nan : int
        Costs that were not finite (NaN, inf or -inf).
    history : list of float
        Best cost after each iteration.
    state : EvolutionaryState
        The present evolutionary state.
    state_counts : dict
        Number of iterations that moved in each state; their sum is nit - 1.
    inertia, cognitive, social : float
        The present w, c1 and c2.

    Raises
    ------
    InputError
        If the bounds, the number of particles, the horizon, the starting point or the random source cannot be used.

    Examples
    --------
    >>> swarm = ParticleSwarm([(-5, 5), (-5, 5)], rng=0)
    >>> for _ in range(100):
    ...     rows = swarm.ask()
    ...     swarm.tell(((rows - 1) ** 2).sum(axis=1))
    >>> bool(abs(swarm.best_x - 1).max() < 1e-3)
    True
    """

    def __init__(
        self,
        bounds: Any,
        *,
        rng: RandomSource = None,
        n_particles: int | None = None,
        horizon: int = 1000,
        x0: ArrayLike | None = None,
        settings: SwarmSettings | None = None,
    ) -> None:
        self.box = Box(bounds)
        self._rng = random_generator(rng)
        self._settings = SwarmSettings() if settings is None else settings
        instance("settings", self._settings, SwarmSettings)
        if n_particles is None:
            n_particles = 5 * max(self.box.n_free, 1)
        self.n_particles = whole_number("n_particles", n_particles, at_least=2, at_most=10**6)
        self.horizon = whole_number("horizon", horizon, at_least=1)

        self.nit = 0
        self.nfev = 0
        self.n_nan = 0
        self.history: list[float] = []
        self.state = EvolutionaryState.EXPLORATION
        self.state_counts = dict.fromkeys(EvolutionaryState, 0)
        self.inertia = 0.0
        self.cognitive = self.social = self._settings.acceleration_start

        # All that follows is in the unit cube of the free variables.
        self._positions = self._sample()
        if x0 is not None:
            self._positions[0] = self.box.to_unit(self.box.point(x0, "x0"))
        self._velocities = np.zeros_like(self._positions)
        self._costs = np.full(self.n_particles, np.inf)
        self._pbest = self._positions.copy()
        self._pbest_costs = np.full(self.n_particles, np.inf)
        # The global best is the leader's own best.
        self._leader = 0
        self._candidate: FloatArray | None = None
        self._asked: FloatArray | None = None
        # One tuple, so that an interrupt never leaves a point with another point's cost.
        self._best: tuple[FloatArray, float] = (self.box.to_rows(self._positions[:1])[0], np.inf)

    def to_tree(self) -> dict[str, Any]:
        """Give all that changes while it moves, as numbers, arrays and texts; `resume` takes it back."""
        x, cost = self._best
        return {
            **{name: _copied(getattr(self, f"_{name}")) for name in _ARRAYS},
            **{name: getattr(self, name) for name in _NUMBERS}, "leader": self._leader, "best_x": x.copy(),
            "best_cost": cost, "history": np.array(self.history), "state": int(self.state),
            "state_counts": np.array([self.state_counts[state] for state in EvolutionaryState]),
            "random": json.dumps(self._rng.bit_generator.state, default=np.ndarray.tolist),
        }  # fmt: skip

    def resume(self, tree: dict[str, Any]) -> None:
        """Go on where `to_tree` was called of a swarm made alike: the same bits follow.

        Raises
        ------
        InputError
            Where that one had another number of particles or variables, or another kind of random source.
        """
        random = json.loads(tree["random"])
        same = tree["positions"].shape == self._positions.shape and tree["best_x"].shape == self.box.lower.shape
        if not same or random["bit_generator"] != self._rng.bit_generator.state["bit_generator"]:
            raise InputError("the swarm to go on with has other particles, variables or another random source")
        for name in _ARRAYS:
            setattr(self, f"_{name}", _copied(tree[name]))
        for name in _NUMBERS:
            setattr(self, name, tree[name])
        self._leader, self._best = tree["leader"], (np.array(tree["best_x"]), tree["best_cost"])
        self.history, self.state = tree["history"].tolist(), EvolutionaryState(tree["state"])
        self.state_counts = dict(zip(EvolutionaryState, tree["state_counts"].tolist(), strict=True))
        self._rng.bit_generator.state = random

    @property
    def best_x(self) -> FloatArray:
        """The best row so far (n_dim,), exactly as evaluated; the first row while no finite cost is known."""
        return self._best[0].copy()

    @property
    def best_cost(self) -> float:
        """The lowest cost so far; inf while no finite cost is known."""
        return self._best[1]

    @property
    def positions(self) -> FloatArray:
        """Positions of the particles (n_particles, n_dim), in the caller's units."""
        return self.box.to_rows(self._positions)

    @property
    def velocities(self) -> FloatArray:
        """Velocities of the particles (n_particles, n_dim), in the caller's units per iteration."""
        return self.box.scaled(self._velocities)

    def ask(self) -> FloatArray:
        """Rows whose costs are wanted next; the same rows until `tell`.

        Returns
        -------
        (n_particles, n_dim) or (n_particles + 1, n_dim) array
            One row a particle, inside the bounds; in the convergence state one more, of elitist learning.
        """
        if self._asked is None:
            if self.nit > 0:
                self._advance()
            unit = self._positions if self._candidate is None else np.vstack([self._positions, self._candidate])
            self._asked = self.box.to_rows(unit)
        return self._asked.copy()

    def tell(self, costs: ArrayLike, repaired: ArrayLike | None = None) -> None:
        """Take the costs of the rows that `ask` gave.

        Parameters
        ----------
        costs : (n_rows,) array-like
            One real number a row, in the order of the rows.
        repaired : (n_rows, n_dim) array-like, optional
            The rows that these are the costs of, where they are not those of `ask`: clipped to the bounds, they become
            the particles' positions.

        Raises
        ------
        InputError
            If the shape is wrong or the numbers are not real; the object is then unchanged.
        RuntimeError
            If no rows were asked for.
        """
        if self._asked is None:
            raise RuntimeError("tell was called before ask; ask for rows, evaluate them, then tell their costs.")
        rows = self._asked
        values = self._finite_or_inf(checked_costs(costs, len(rows), "told"))
        self._asked = None
        if repaired is not None:
            rows = self.box.clip(checked_rows(repaired, rows.shape, "told"))
            unit = np.ascontiguousarray(self.box.to_unit(rows))  # sums over it depend on how it lies in memory
            self._positions = unit[: self.n_particles]
            if self._candidate is not None:
                self._candidate = unit[-1]
        if self.nit > 0:
            self.state_counts[self.state] += 1
        self.nit += 1

        self._costs = values[: self.n_particles]
        better = self._costs < self._pbest_costs
        self._pbest[better] = self._positions[better]
        self._pbest_costs[better] = self._costs[better]
        # A particle that never met a finite cost has no best to be drawn back to.
        blank = np.isinf(self._pbest_costs)
        self._pbest[blank] = self._positions[blank]
        first = int(np.argmin(self._pbest_costs))
        if self._pbest_costs[first] < self.best_cost:
            self._leader = first
            self._best = (rows[first].copy(), float(self._pbest_costs[first]))
        if self._candidate is not None:
            self._learn(self._candidate, rows[-1], float(values[-1]))
            self._candidate = None
        self.history.append(self.best_cost)

    def inject(self, x: ArrayLike, cost: float) -> bool:
        """Offer a point that was found and evaluated elsewhere, between `tell` and the next `ask`.

        If it is better than the global best, the leading particle is moved there and carries it as its own best;
        else nothing but the counts changes. It counts as one evaluation.

        Parameters
        ----------
        x : (n_dim,) array-like
            The point, inside the bounds.
        cost : float
            Its cost.

        Returns
        -------
        bool
            Whether the point is the new global best.

        Raises
        ------
        InputError
            If the point has the wrong shape or lies outside the bounds.
        RuntimeError
            If rows have been asked for whose costs are not told.
        """
        self._check_idle("inject")
        point = self.box.point(x, "x")
        value = float(self._finite_or_inf(checked_costs([cost], 1, "injected"))[0])
        better = value < self.best_cost
        if better:
            self._take(point, value)
        return better

    def replace_best(self, x: ArrayLike, cost: float) -> None:
        """Put another point in the place of the global best, between `tell` and the next `ask`.

        The leading particle is moved there and carries it as its own best. Nothing is counted.

        Parameters
        ----------
        x : (n_dim,) array-like
            The point, inside the bounds.
        cost : float
            Its cost, not above that of the global best.

        Raises
        ------
        InputError
            If the point has the wrong shape or lies outside the bounds, or the cost is higher.
        RuntimeError
            If rows have been asked for whose costs are not told.
        """
        self._check_idle("replace_best")
        point, value = self.box.point(x, "x"), float(checked_costs([cost], 1, "given")[0])
        if not value <= self.best_cost:
            raise InputError(f"cost {value:g} is above that of the global best, {self.best_cost:g}; keep that one.")
        self._take(point, value)

    def _check_idle(self, name: str) -> None:
        if self._asked is not None:
            raise RuntimeError(f"{name} was called between ask and tell; tell the costs of the asked rows first.")

    def _take(self, point: FloatArray, cost: float) -> None:
        """Make a point the global best, of the last iteration too."""
        self._lead(self.box.to_unit(point), point, cost)
        if self.history:
            self.history[-1] = cost

    def _finite_or_inf(self, values: FloatArray) -> FloatArray:
        finite = np.isfinite(values)
        self.nfev += values.size
        self.n_nan += int(values.size - finite.sum())
        return np.where(finite, values, np.inf)

    def _sample(self) -> FloatArray:
        """Latin hypercube in the unit cube (n_particles, n_free): one particle in each of n_particles slices."""
        if self.box.n_free == 0:
            return np.zeros((self.n_particles, 0))
        rng = np.random.default_rng(int(self._rng.integers(2**63)))
        return latin_hypercube(self.n_particles, self.box.n_free, rng)

    def _advance(self) -> None:
        if np.isinf(self.best_cost):
            self._positions = self._sample()
            return
        self._adapt()
        if self.state is EvolutionaryState.CONVERGENCE and self.box.n_free > 0:
            self._candidate = self._elite()
        self._move()

    def _adapt(self) -> None:
        settings, rng = self._settings, self._rng
        distances = adaptation.mean_distances(self._positions)
        factor = adaptation.evolutionary_factor(distances, self._leader)
        self.state = adaptation.next_state(factor, self.state)
        self.cognitive, self.social = adaptation.next_accelerations(
            self.cognitive,
            self.social,
            self.state,
            rng.uniform(settings.acceleration_step_lower, settings.acceleration_step_upper),
            lower=settings.acceleration_lower,
            upper=settings.acceleration_upper,
            largest_sum=settings.acceleration_sum,
        )
        kappa = adaptation.focusing_change_rate(self._positions, self._pbest[self._leader])
        self.inertia = adaptation.inertia_weight(kappa, rng.random(), settings.inertia_b1, settings.inertia_b2)

    def _elite(self) -> FloatArray:
        """Move one coordinate of the global best at random, inside the box."""
        settings = self._settings
        sigma = adaptation.elitist_sigma(
            self.nit / self.horizon, settings.elitist_sigma_start, settings.elitist_sigma_end
        )
        candidate: FloatArray = self._pbest[self._leader].copy()
        i = self._rng.integers(candidate.size)
        candidate[i] = np.clip(candidate[i] + self._rng.normal(0.0, sigma), 0.0, 1.0)
        return candidate

    def _attractor(self) -> FloatArray:
        """Attractor of the social term: the global best (n_free,), or each particle's own mean, a row each."""
        count = self._settings.guides
        if count == 0:
            return self._pbest[self._leader]
        # A particle that never met a finite cost guides nobody.
        most = min(math.ceil(self._settings.guide_share * self.n_particles), int(np.isfinite(self._pbest_costs).sum()))
        best = np.argsort(self._pbest_costs, kind="stable")[:most]
        means: FloatArray = self._pbest[best[self._rng.integers(most, size=(count, self.n_particles))]].mean(axis=0)
        return means

    def _move(self) -> None:
        attractor = self._attractor()
        to_personal_best = self._rng.random(self._positions.shape)
        to_personal_best *= self._pbest - self._positions
        to_global_best = self._rng.random(self._positions.shape)
        to_global_best *= attractor - self._positions
        velocities = self.inertia * self._velocities + self.cognitive * to_personal_best + self.social * to_global_best
        np.clip(velocities, -self._settings.max_velocity, self._settings.max_velocity, out=velocities)
        positions = self._positions + velocities
        # Reversed rather than set to zero: with many variables, a swarm that loses its speed at the bounds stays there.
        inwards = np.abs(velocities)
        velocities = np.where(positions <= 0.0, inwards, np.where(positions >= 1.0, -inwards, velocities))
        self._velocities = velocities
        self._positions = np.clip(positions, 0.0, 1.0)

    def _lead(self, unit: FloatArray, x: FloatArray, cost: float) -> None:
        """Make a point the global best: position and own best of the leading particle."""
        self._positions[self._leader] = unit
        self._costs[self._leader] = cost
        self._pbest[self._leader] = unit
        self._pbest_costs[self._leader] = cost
        self._best = (x.copy(), cost)

    def _learn(self, unit: FloatArray, x: FloatArray, cost: float) -> None:
        """Keep the candidate of elitist learning if it is better, else put it in the place of the worst particle."""
        if cost < self.best_cost:
            self._lead(unit, x, cost)
        elif np.isfinite(cost):
            worst = int(np.argmax(self._costs))
            self._positions[worst] = unit
            self._costs[worst] = cost
            # The particle of the highest present cost may have a lower own best, which it keeps.
            if cost < self._pbest_costs[worst]:
                self._pbest[worst] = unit
                self._pbest_costs[worst] = cost


def _copied(array: FloatArray | None) -> FloatArray | None:
    return None if array is None else array.copy()
