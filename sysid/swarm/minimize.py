"""A complete search with the swarm: budgets, stop rules, refinement of the best, the result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, RandomSource, as_float, function, refuse, whole_number

from .adaptation import EvolutionaryState, SwarmSettings
from .box import checked_costs, checked_rows
from .particles import ParticleSwarm

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult


class StopReason(Enum):
    """Why a search ended."""

    TARGET = "target"
    STALL = "stall"
    MAX_ITERATIONS = "max_iterations"
    MAX_EVALUATIONS = "max_evaluations"
    MAX_TIME = "max_time"
    CALLBACK = "callback"


@dataclass(frozen=True, kw_only=True)
class StopRules:
    """The stop rules of one search; see `minimize_swarm` for each."""

    max_iterations: int
    max_evaluations: int | None
    max_time: float | None
    target: float | None
    stall_iterations: int | None
    stall_tolerance: float

    def __post_init__(self) -> None:
        whole_number("max_iterations", self.max_iterations, at_least=1)
        counts = {"max_evaluations": self.max_evaluations, "stall_iterations": self.stall_iterations}
        for name, count in counts.items():
            if count is not None:
                whole_number(name, count, at_least=1)
        if self.max_time is not None:
            as_float("max_time", self.max_time, "zero or more seconds, or None for no limit,", at_least=0, finite=False)
        if self.target is not None:
            as_float("target", self.target, "a number that a cost can reach, or None for no target,", finite=False)
        as_float("stall_tolerance", self.stall_tolerance, "a part of the cost, in [0, 1),", at_least=0, below=1)

    def room_for(self, n_rows: int, nfev: int) -> bool:
        """True where `n_rows` more rows may be evaluated after `nfev`."""
        return self.max_evaluations is None or nfev + n_rows <= self.max_evaluations

    def reason(self, swarm: ParticleSwarm, seconds: float) -> StopReason | None:
        """Return the first rule that ends the search after an iteration, or None to go on."""
        best, idle = swarm.best_cost, self.stall_iterations
        holds = {
            StopReason.TARGET: self.target is not None and math.isfinite(best) and best <= self.target,
            StopReason.STALL: idle is not None and stalled(swarm.history, idle, self.stall_tolerance),
            StopReason.MAX_ITERATIONS: swarm.nit >= self.max_iterations,
            StopReason.MAX_TIME: self.max_time is not None and seconds >= self.max_time,
        }
        return next((reason for reason, applies in holds.items() if applies), None)

    def message(self, reason: StopReason, swarm: ParticleSwarm) -> str:
        """Message that says why the search ended, and what to do next."""
        if math.isinf(swarm.best_cost):
            return (
                f"None of the {swarm.nfev} costs was finite: evaluate fun at a point that should work, "
                "and narrow the bounds to where it is defined."
            )
        happened = {
            StopReason.TARGET: f"Reached the target {self.target}.",
            StopReason.STALL: (
                f"The best cost has not fallen by more than {self.stall_tolerance} of itself in "
                f"{self.stall_iterations} iterations: refine x locally, or start again with another rng "
                "or more particles."
            ),
            StopReason.MAX_ITERATIONS: (
                f"Spent max_iterations = {self.max_iterations}: if the history still falls, raise it, "
                "or refine x locally."
            ),
            StopReason.MAX_EVALUATIONS: (
                f"Spent max_evaluations = {self.max_evaluations}, as far as whole iterations fit: if the history "
                "still falls, raise it, or refine x locally."
            ),
            StopReason.MAX_TIME: (
                f"Spent max_time = {self.max_time} s: if the history still falls, raise it, or refine x locally."
            ),
            StopReason.CALLBACK: "The callback stopped the search; x is the best point until then.",
        }[reason]
        if self.target is not None and reason is not StopReason.TARGET:
            happened += f" The target {self.target} was not reached; the best cost is {swarm.best_cost:.6g}."
        return happened


def stalled(history: list[float], iterations: int, tolerance: float) -> bool:
    """True where the best cost fell by no more than `tolerance` times itself over the last `iterations`."""
    if len(history) <= iterations:
        return False
    before, now = history[-1 - iterations], history[-1]
    if math.isinf(before):
        return math.isinf(now)
    return before - now <= tolerance * abs(before)


FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SwarmProgress:
    """Progress of a search, given to the callback after each iteration.

    Attributes
    ----------
    x : (n_dim,) array
        The best point so far (a copy).
    fun : float
        Its cost; inf while no finite cost is known.
    nit, nfev : int
        Iterations and evaluations so far.
    state : EvolutionaryState
        The present evolutionary state of the swarm.
    snapshot : callable
        Gives the whole search as a dictionary of numbers, arrays and texts, for ``resume=`` of `minimize_swarm`; to be
        called within the callback.
    """

    x: FloatArray
    fun: float
    nit: int
    nfev: int
    state: EvolutionaryState
    snapshot: Callable[[], dict[str, Any]]


def minimize_swarm(
    fun: Callable[[FloatArray], ArrayLike],
    bounds: Any,
    *,
    rng: RandomSource = None,
    n_particles: int | None = None,
    max_iterations: int = 1000,
    max_evaluations: int | None = None,
    max_time: float | None = None,
    target: float | None = None,
    stall_iterations: int | None = 100,
    stall_tolerance: float = 1e-8,
    callback: Callable[[SwarmProgress], object] | None = None,
    improve: Callable[[FloatArray], ArrayLike] | None = None,
    improve_every: int = 0,
    on_leader: Callable[[FloatArray, float], tuple[ArrayLike, float]] | None = None,
    repair: Callable[[FloatArray], ArrayLike] | None = None,
    x0: ArrayLike | None = None,
    settings: SwarmSettings | None = None,
    resume: dict[str, Any] | None = None,
) -> OptimizeResult:
    """Minimise a batched function over a box with the adaptive particle swarm.

    The algorithm is that of `ParticleSwarm` (Cerini et al. 2024, MSSP 209, 111084, section 2.2; Zhan et al. 2009,
    IEEE Trans. SMC-B 39(6), 1362-1381); this function adds the stop rules and the refinement of the best.

    Parameters
    ----------
    fun : callable
        Cost of each row of an array (k, n_dim): returns (k,) real numbers. k is the number of particles, one more when
        elitist learning offers a row, and 1 after `improve`. Costs that are not finite are counted and read as +inf.
    bounds : (n_dim, 2) array-like or scipy.optimize.Bounds
        Lower and upper bound of each variable, finite; lower == upper fixes the variable.
    rng : int, numpy.random.Generator, numpy.random.SeedSequence or None
        Source of random numbers. The same seed gives the same bits, unless `max_time` ends the search.
    n_particles : int, optional
        At least 2; five for each free variable by default.
    max_iterations : int
        Largest number of iterations; the Latin hypercube sample is the first.
    max_evaluations : int, optional
        Largest number of rows given to `fun`, never exceeded; evaluations inside `improve` do not count. At least
        `n_particles`.
    max_time : float, optional
        Seconds after which no further iteration starts.
    target : float, optional
        Stop as soon as the best cost is at or below this.
    stall_iterations : int or None
        Stop when the best cost has not fallen by more than `stall_tolerance` times itself over so many iterations;
        None never stops for this.
    stall_tolerance : float
        See above.
    callback : callable, optional
        Called with a `SwarmProgress` after each iteration; StopIteration from it ends the search with the best so far.
    improve : callable, optional
        Called with the best point (n_dim,), returns a better one (n_dim,), found by exact gradients for instance. It
        is clipped to the bounds, evaluated with `fun`, and becomes the global best if it is better; a point that is
        not finite is dropped. It is called once for each best point.
    improve_every : int
        Iterations between two calls of `improve`; with 0 it is never called.
    on_leader : callable, optional
        Called with each new global best (n_dim,) and its cost, at the end of the iteration that found it, the sample's
        too; returns the point (n_dim,), inside the bounds, and the cost that take its place in the swarm: the same ones
        or others whose cost is not higher. What it evaluates is not counted.
    repair : callable, optional
        Takes the rows (k, n_dim) of an iteration to finite rows of the same shape, which are clipped to the bounds,
        evaluated, and become the particles' positions: a correction that is written back.
    x0 : (n_dim,) array-like, optional
        A starting point inside the bounds: it takes the place of the first row of the sample.
    settings : SwarmSettings, optional
        The constants of the swarm.
    resume : dict, optional
        A `SwarmProgress.snapshot` of a search with the same other arguments: the search goes on from there, and ends
        with the bits that it would have ended with. The callback is not called again for what is past.

    Returns
    -------
    scipy.optimize.OptimizeResult
        `x` (n_dim,) and `fun`: the best point and its cost, inf if no cost was finite; `nfev`, `nit`; `success`: some
        cost was finite, the target was reached where one was given, and the callback did not cut the search short (a
        swarm has no test of optimality, so a spent budget is its normal end); `message`; `reason`, a `StopReason`;
        `history` (nit,), the best cost after each iteration; `n_nan`, the number of costs that were not finite;
        `n_improved`, how often `improve` gave a better point; `state_counts`, a dict from names of states to the
        iterations moved in it.

    Raises
    ------
    InputError
        If an argument cannot be used, `fun`, `improve` or `on_leader` returns the wrong shape, or the last one a point
        outside the bounds or of a higher cost.

    Notes
    -----
    Any other exception of `fun`, `improve`, `on_leader` or `callback`, and KeyboardInterrupt, is passed on to the
    caller. To keep the best so far then, keep the last `SwarmProgress` that the callback was given, or drive a
    `ParticleSwarm`.

    The steps of elitist learning shrink over `max_iterations`, or over as many as `max_evaluations` allows.

    Examples
    --------
    >>> def paraboloid(rows):
    ...     return ((rows - [1, 2]) ** 2).sum(axis=1)
    >>> result = minimize_swarm(paraboloid, [(-5, 5), (-5, 5)], rng=0, target=1e-6)
    >>> result.success, result.reason.value, result.x.round(2).tolist()
    (True, 'target', [1.0, 2.0])
    """
    from scipy.optimize import OptimizeResult

    rules = StopRules(
        max_iterations=max_iterations,
        max_evaluations=max_evaluations,
        max_time=max_time,
        target=target,
        stall_iterations=stall_iterations,
        stall_tolerance=stall_tolerance,
    )
    for name, given in (
        ("callback", callback), ("improve", improve), ("on_leader", on_leader), ("repair", repair),
    ):  # fmt: skip
        function(name, given)
    refuse((not callable(fun), f"fun is {fun!r}; give a function of rows (k, n_dim) that returns their costs."))
    improve_every = whole_number("improve_every", improve_every, at_least=0)
    if improve_every and improve is None:
        raise InputError(f"improve_every is {improve_every} but improve is not given; give improve, or leave both out.")
    swarm = ParticleSwarm(bounds, rng=rng, n_particles=n_particles, horizon=max_iterations, x0=x0, settings=settings)
    if max_evaluations is not None:
        if max_evaluations < swarm.n_particles:
            raise InputError(
                f"max_evaluations is {max_evaluations}, too few for the first {swarm.n_particles} particles; "
                "raise it or lower n_particles."
            )
        swarm.horizon = min(max_iterations, max_evaluations // swarm.n_particles)
    search = _Search(swarm, fun, repair, rules, improve if improve_every else None, improve_every, on_leader)
    if resume is not None:
        search.resume(resume)
    reason = search.run(callback)
    found = math.isfinite(swarm.best_cost)
    reached = target is None or swarm.best_cost <= target
    return OptimizeResult(
        x=swarm.best_x, fun=swarm.best_cost, nfev=swarm.nfev, nit=swarm.nit,
        success=found and reached and reason is not StopReason.CALLBACK,
        message=rules.message(reason, swarm), reason=reason, history=np.array(swarm.history), n_nan=swarm.n_nan,
        n_improved=search.n_improved, state_counts={state.name: count for state, count in swarm.state_counts.items()},
    )  # fmt: skip


@dataclass
class _Search:
    """The iterations of a swarm, until a stop rule or the callback ends them."""

    swarm: ParticleSwarm
    fun: Callable[[FloatArray], ArrayLike]
    repair: Callable[[FloatArray], ArrayLike] | None
    rules: StopRules
    improve: Callable[[FloatArray], ArrayLike] | None
    improve_every: int
    on_leader: Callable[[FloatArray, float], tuple[ArrayLike, float]] | None
    n_improved: int = 0  # how often `improve` found better
    refined: FloatArray | None = None  # the last point that it was given, or gave
    led: FloatArray | None = None  # the last point that `on_leader` gave

    def snapshot(self) -> dict[str, Any]:
        counts = {name: getattr(self, name) for name in ("n_improved", "refined", "led")}
        return {"swarm": self.swarm.to_tree(), **counts}

    def resume(self, snapshot: dict[str, Any]) -> None:
        self.swarm.resume(snapshot["swarm"])
        self.n_improved, self.refined, self.led = (snapshot[name] for name in ("n_improved", "refined", "led"))

    def run(self, callback: Callable[[SwarmProgress], object] | None) -> StopReason:
        """Iterate; why it ended."""
        swarm, rules = self.swarm, self.rules
        started = time.perf_counter()
        reason = rules.reason(swarm, 0.0) if swarm.nit else None  # what is resumed may have been at its end
        while reason is None:
            rows = swarm.ask()
            if not rules.room_for(len(rows), swarm.nfev):
                return StopReason.MAX_EVALUATIONS
            self._tell(rows)
            self._follow_leader()
            if self.improve is not None and swarm.nit % self.improve_every == 0 and math.isfinite(swarm.best_cost):
                seen = self.refined is not None and np.array_equal(self.refined, swarm.best_x)
                if not seen and rules.room_for(1, swarm.nfev):
                    self.n_improved += self._refine(self.improve)
                    self.refined = swarm.best_x
            reason = rules.reason(swarm, time.perf_counter() - started)
            if callback is not None:
                state = SwarmProgress(swarm.best_x, swarm.best_cost, swarm.nit, swarm.nfev, swarm.state, self.snapshot)
                try:
                    callback(state)
                except StopIteration:
                    # A stop rule that holds as well comes first: the search was not cut short.
                    reason = reason or StopReason.CALLBACK
        return reason

    def _tell(self, rows: FloatArray) -> None:
        """Give the swarm the costs of its rows, or of what they are repaired to."""
        swarm, repaired = self.swarm, None
        if self.repair is not None:
            repaired = swarm.box.clip(checked_rows(self.repair(rows), rows.shape, "that repair returned"))
            rows = repaired.copy()
        swarm.tell(checked_costs(self.fun(rows), len(rows), "that fun returned"), repaired)

    def _refine(self, improve: Callable[[FloatArray], ArrayLike]) -> bool:
        """Evaluate and inject the improved best point; return whether it was better."""
        swarm = self.swarm
        point = np.asarray(improve(swarm.best_x), dtype=float)
        if point.shape != swarm.best_x.shape:
            raise InputError(f"improve returned shape {point.shape}; return one point, shape {swarm.best_x.shape}.")
        if not np.isfinite(point).all():
            return False
        point = swarm.box.clip(point)
        cost = checked_costs(self.fun(point[None, :].copy()), 1, "that fun returned")[0]
        return swarm.inject(point, float(cost))

    def _follow_leader(self) -> None:
        """Let `on_leader` put another point in the place of a new global best."""
        swarm = self.swarm
        if self.on_leader is None or not math.isfinite(swarm.best_cost):
            return
        if self.led is None or not np.array_equal(self.led, swarm.best_x):
            point, cost = self.on_leader(swarm.best_x, swarm.best_cost)
            if cost != swarm.best_cost or not np.array_equal(point, swarm.best_x):
                swarm.replace_best(point, cost)
            self.led = swarm.best_x
