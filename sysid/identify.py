"""The pipeline: global phase, eigenvalue refinement, local phase → `Identification`."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from sysid import local
from sysid.errors import InputError, SolverError
from sysid.identification import History, Identification
from sysid.layout import triangle, triangle_entries
from sysid.modal_masses import determination
from sysid.problem import Problem
from sysid.refinement import by_ipopt, closed_form
from sysid.stiffness import SpectralStiffness
from sysid.structure import Array, Structure
from sysid.swarm import SwarmProgress, SwarmSettings, minimize_swarm
from sysid.swarm_cost import SwarmCost

_SETTINGS = SwarmSettings(inertia_b1=0.8, inertia_b2=0.5, acceleration_sum=3.0)
STRATEGIES = ("auto", "swarm")


@dataclass(frozen=True)
class Swarm:
    """Strategy "swarm", the paper's hPSO-LS, with its settings.

    Parameters
    ----------
    max_iterations : int
        Iterations of the swarm.
    n_particles : int, optional
        5·D by default.
    stall_iterations, stall_tolerance :
        The swarm ends where its best has not improved by this fraction in so many iterations.
    refine : bool
        Give each candidate the measured spectrum (closed form).
    gradient_every : int
        Refine the swarm's best by a few iterations of the local phase every so many iterations; 0: never.
    local_phase : bool
        Whether the local phase follows.
    settings : SwarmSettings
        Constants of the swarm itself. The paper leaves b1 and b2 of its eq. 11 to the user; with the
        usual 0.3 and 0.2 and c1 + c2 up to 4 (``SwarmSettings()``) the swarm of this problem contracts
        too early. These keep it moving: see the swarm lines of ``benchmarks/lines_2.py`` for both.
    """

    max_iterations: int = 150
    n_particles: int | None = None
    stall_iterations: int = 40
    stall_tolerance: float = 1e-3
    refine: bool = True
    gradient_every: int = 0
    local_phase: bool = True
    settings: SwarmSettings = _SETTINGS


@dataclass(frozen=True, eq=False)
class Progress:
    """What a callback sees.

    Attributes
    ----------
    phase : str
        "swarm", "refinement" or "local phase".
    iteration, of : int
        The iteration, and the most there can be (0: not known).
    residual : float
        Relative residual of the best candidate so far.
    seconds : float
        Since the start.
    """

    phase: Literal["swarm", "refinement", "local phase"]
    iteration: int
    of: int
    residual: float
    seconds: float

    def __str__(self) -> str:
        return f"{self.phase:11s}  iteration {self.iteration:4d}  residual {self.residual:.3e}  {self.seconds:6.1f} s"


def identify(
    problem: Problem,
    *,
    strategy: str | Swarm = "auto",
    rng: int | np.random.Generator | None = None,
    start: ArrayLike | Structure | None = None,
    max_time: float | None = None,
    max_evaluations: int | None = None,
    callback: Callable[[Progress], object] | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Identification:
    """Identify a structure.

    Parameters
    ----------
    problem : Problem
    strategy : str or Swarm
        "swarm" is the paper's hPSO-LS; "auto" chooses, and at present always chooses "swarm". A
        `Swarm` object is strategy "swarm" with other settings.
    rng : int, numpy Generator or None
        The same seed gives the same bits. None draws one, which the result reports.
    start : array_like (n_variables,) or Structure, optional
        A guess that joins the first swarm.
    max_time : float, optional
        s; the swarm takes at most two thirds of it.
    max_evaluations : int, optional
        Candidates that the swarm may evaluate.
    callback : callable, optional
        Called with a `Progress` at each iteration; raising StopIteration ends the search, and the
        result holds the best until then.
    progress : callable, optional
        Called likewise, only to show: ``progress=print`` prints a line an iteration.

    Returns
    -------
    Identification
        Also where Ctrl-C stopped the search, with `interrupted` set.
    """
    options = _options(strategy)
    seed, random = _seed(rng)
    with threadpool_limits(limits=1), _DeferredInterrupt() as interrupt:
        run = _Run(problem, options, callback, progress, max_time, max_evaluations, interrupt)
        return run.run(seed, random, start)


def _options(strategy: str | Swarm) -> Swarm:
    if isinstance(strategy, Swarm):
        return strategy
    if strategy not in STRATEGIES:
        raise InputError(f"strategy {strategy!r} is unknown; give one of {', '.join(map(repr, STRATEGIES))}")
    return Swarm()


def _seed(rng: int | np.random.Generator | None) -> tuple[int, np.random.SeedSequence]:
    if isinstance(rng, np.random.Generator):
        seed = int(rng.integers(2**63))
    elif rng is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> 1)
    elif isinstance(rng, int | np.integer) and rng >= 0:
        seed = int(rng)
    else:
        raise InputError(f"rng = {rng!r}: a nonnegative integer, a numpy Generator or None is needed")
    return seed, np.random.SeedSequence(seed)


class _DeferredInterrupt:
    """Hold Ctrl-C back until the search next reports: raised inside compiled code it would lose the best so far.

    A second Ctrl-C acts at once. Where somebody else handles the signal, or outside the main thread, nothing changes.
    """

    def __init__(self) -> None:
        self.asked = False
        self.raised = False
        self.ours = False

    def __enter__(self) -> _DeferredInterrupt:
        self.ours = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        if self.ours:
            signal.signal(signal.SIGINT, self._hold)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if self.ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        # CasADi turns a KeyboardInterrupt that strikes inside it into some other exception.
        if self.raised and isinstance(error, Exception):
            raise KeyboardInterrupt from error

    def _hold(self, number: int, frame: object) -> None:
        if self.asked:
            self.raised = True
            raise KeyboardInterrupt
        self.asked = True

    def check(self) -> None:
        if self.asked:
            raise KeyboardInterrupt


class _Stop(Exception):  # noqa: N818 - not an error
    """The callback asked to stop, or Ctrl-C did."""


class _Run:
    """State of one identification: the best so far, the clock, the log."""

    def __init__(
        self,
        problem: Problem,
        options: Swarm,
        callback: Callable[[Progress], object] | None,
        progress: Callable[[Progress], object] | None,
        max_time: float | None,
        max_evaluations: int | None,
        interrupt: _DeferredInterrupt,
    ) -> None:
        if max_time is not None and not max_time > 0:
            raise InputError(f"max_time = {max_time}: a positive number of seconds is needed")
        self.problem, self.options = problem, options
        self.listeners = [f for f in (progress, callback) if f is not None]
        self.max_time, self.max_evaluations = max_time, max_evaluations
        self.interrupt = interrupt
        self.begun = time.perf_counter()
        self.x: Array | None = None
        self.raw: Array = np.zeros(0)
        self.history = History()
        self.log: list[str] = []

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    def note(self, line: str) -> None:
        self.log.append(f"{self.seconds:8.2f} s  {line}")

    def record(self, **figures: object) -> None:
        self.history = replace(self.history, **figures)  # type: ignore[arg-type]

    def tell(self, phase: Literal["swarm", "refinement", "local phase"], iteration: int, of: int, cost: float) -> None:
        self.interrupt.check()
        for listener in self.listeners:
            try:
                listener(Progress(phase, iteration, of, cost, self.seconds))
            except StopIteration:
                raise _Stop("the callback stopped the search") from None

    def run(self, seed: int, random: np.random.SeedSequence, start: ArrayLike | Structure | None) -> Identification:
        success, message, interrupted = False, "", False
        try:
            self.swarm(random, start)
            self.refine()
            if self.options.local_phase:
                success, message = self.local()
            else:
                success, message = True, "ended before the local phase, as asked"
        except _Stop as stop:
            message = str(stop)
        except KeyboardInterrupt:
            if self.x is None:
                raise
            message, interrupted = "interrupted", True
        if self.x is None:
            raise SolverError("the search ended before it had a single candidate; give it more time")
        structure = self.problem.structure(self.x)
        residual = self.problem.measurement.residual(structure)
        goal = self.problem.goal
        if goal is not None and residual > goal:
            success = False
            message += f"; the residual {residual:.3g} is above the goal {goal:.3g}"
        self.note(f"done: residual {residual:.4e}, {message}")
        self.record(log=tuple(self.log), wall_time=self.seconds)
        known = determination(self.problem, structure)
        return Identification(
            structure, self.problem, self.x, "swarm", seed, success, message, self.history,
            known.determined, known.closed_by, known.undetermined, interrupted,
        )  # fmt: skip

    def misfit(self, x: Array) -> float:
        """What all phases minimise: root of the sum of the squared relative residuals of accelerations and force."""
        structure, test = self.problem.structure(x), self.problem.measurement
        return float(np.hypot(test.residual(structure), test.force_residual(structure) or 0.0))

    def swarm(self, random: np.random.SeedSequence, start: ArrayLike | Structure | None) -> None:
        problem, options = self.problem, self.options
        cost = SwarmCost(problem, refine=options.refine)
        x0 = None if start is None else problem.to_sampling(_as_unknowns(problem, start))
        unknowns = ", ".join(f"{name} {count}" for name, count in problem.unknowns)
        self.note(f"swarm over {problem.n_variables} unknowns ({unknowns})")

        def watch(state: SwarmProgress) -> None:
            if np.isfinite(state.fun):
                self.raw, self.x = cost.unknowns(state.x), cost.refined(state.x)
            curve.append(state.fun)
            self.tell("swarm", state.nit, options.max_iterations, state.fun)

        curve: list[float] = []
        try:
            result = minimize_swarm(
                cost,
                np.column_stack([problem.lower, problem.upper]),
                rng=np.random.default_rng(random.spawn(1)[0]),
                n_particles=options.n_particles,
                max_iterations=options.max_iterations,
                max_evaluations=self.max_evaluations,
                max_time=None if self.max_time is None else self.max_time * 2 / 3,
                target=problem.goal,
                stall_iterations=options.stall_iterations,
                stall_tolerance=options.stall_tolerance,
                callback=watch,
                improve=self.improver(cost) if options.gradient_every else None,
                improve_every=options.gradient_every,
                x0=x0,
                settings=options.settings,
            )
        finally:
            if curve:
                self.record(start=curve[0], swarm=curve[-1], swarm_curve=np.array(curve))
        if self.x is None:
            raise SolverError(f"the swarm found no candidate that is a structure: {result.message}")
        self.record(
            evaluations=int(result.nfev),
            states=tuple((state.name.lower().replace("_", " "), int(n)) for state, n in result.state_counts.items()),
        )
        self.note(f"swarm ended after {result.nit} iterations at {result.fun:.4e}: {result.message}")
        if result.n_nan:
            self.note(f"{result.n_nan} of {result.nfev} candidates were no structure (not a number)")

    def improver(self, cost: SwarmCost) -> Callable[[Array], Array]:
        """The exact-gradient refinement of the swarm's best, in the swarm's coordinates."""

        def improve(s: Array) -> Array:
            better = local.solve(self.problem, cost.refined(s), max_iterations=30)
            return self.problem.to_sampling(better.x)

        return improve

    def refine(self) -> None:
        """Refine the swarm's best from its own L_H through IPOPT, as the paper does, beside the closed form."""
        stiffness, n = self.problem.stiffness, self.problem.layout.n
        if not (isinstance(stiffness, SpectralStiffness) and self.options.refine):
            return
        assert self.x is not None
        self.tell("refinement", 0, 1, self.history.swarm)
        part = self.problem.parts.stiffness
        factor = triangle(self.raw[part], n)
        chosen, solved = closed_form(factor, stiffness.targets), by_ipopt(factor, stiffness.targets)
        x = self.x.copy()
        x[part] = triangle_entries(solved.factor)
        misfit, other = self.misfit(self.x), self.misfit(x)
        self.note(
            f"refinement of eigenvalues 1 to {stiffness.targets.size} of {n}: {solved.message}, within "
            f"{solved.error:.1e} of the given ones, residual {other:.4e} (closed form {misfit:.4e})"
        )
        if solved.success and other < misfit:
            self.x, chosen, misfit = x, solved, other
        self.record(refinement=misfit, refinement_error=chosen.error)

    def local(self) -> tuple[bool, str]:
        """Run the local phase; keep its answer where it is better."""
        assert self.x is not None
        left = None if self.max_time is None else max(self.max_time - self.seconds, 1.0)
        before = self.misfit(self.x)
        answer = local.solve(
            self.problem, self.x, max_time=left, monitor=lambda i, cost: self.tell("local phase", i, 0, cost)
        )
        after = self.misfit(answer.x)
        self.note(f"local phase: {answer.message}, {answer.curve.size} iterates, residual {after:.4e}")
        if after < before:
            self.x = answer.x
        else:
            self.note(f"the local phase did not improve on {before:.4e}; its start is kept")
        self.record(local=min(after, before), local_curve=answer.curve)
        if answer.stopped is not None:
            raise answer.stopped
        return answer.success, answer.message


def _as_unknowns(problem: Problem, start: ArrayLike | Structure) -> Array:
    if isinstance(start, Structure):
        layout = problem.layout
        if (start.n, start.n_base, start.n_sensors) != (layout.n, layout.d, layout.n):
            raise InputError("start: the structure has other degrees of freedom or base directions than the problem")
        return problem.values(start)
    x = np.asarray(start, dtype=float)
    if x.shape != (problem.n_variables,) or not np.all(np.isfinite(x)):
        raise InputError(
            f"start has shape {x.shape}; ({problem.n_variables},) finite unknowns, or a Structure, is needed"
        )
    return x
