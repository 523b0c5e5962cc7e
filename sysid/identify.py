"""The pipeline: global phase, eigenvalue refinement, local phase → `Identification`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from sysid import local
from sysid._desk import DeferredInterrupt, Desk, Progress, Stop
from sysid.errors import InputError, SolverError
from sysid.identification import History, Identification
from sysid.layout import triangle, triangle_entries
from sysid.mass import KnownMass
from sysid.modal import modes_from_data
from sysid.modal_masses import determination
from sysid.problem import Problem
from sysid.refinement import by_ipopt, closed_form
from sysid.response import weighed_mass
from sysid.stiffness import SpectralStiffness
from sysid.structure import Array, Structure
from sysid.swarm import SwarmProgress, SwarmSettings, minimize_swarm
from sysid.swarm_cost import SwarmCost

_SETTINGS = SwarmSettings(inertia_b1=0.8, inertia_b2=0.5, acceleration_lower=0.5, acceleration_sum=3.0)
_NO_FIT = 0.5  # relative residual above which nothing is explained
_DOUBTFUL = 0.1  # relative residual above which a structured problem is searched again
STRATEGIES = ("auto", "swarm", "modal")


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
        Whether the local phase follows. Without it no solver vouches for the result, and `success` is False.
    restarts : int
        How many further swarms may follow where the goal is missed, or, without a goal and with a structured
        mass or stiffness, the residual is above 0.1.
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
    restarts: int = 4
    settings: SwarmSettings = _SETTINGS


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
        "swarm" is the paper's hPSO-LS, and a `Swarm` object is that with other settings. "modal" takes
        the poles and residues from the data, needs no swarm and no frequencies, and takes a second;
        it is for a full mass with spectral stiffness and modal damping, with as many modes as
        sensors in the lines. "auto" at present always takes "swarm".
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
    if max_time is not None and not max_time > 0:
        raise InputError(f"max_time = {max_time}: a positive number of seconds is needed")
    listeners = [f for f in (progress, callback) if f is not None]
    with threadpool_limits(limits=1), DeferredInterrupt() as interrupt:
        desk = Desk(listeners, interrupt, max_time)
        if strategy == "modal":
            best, stopped = _modal_search(problem, desk)
        else:
            best, stopped = _best_of_searches(problem, options, desk, random, start, max_evaluations)
        return _finish(problem, best, stopped, seed, desk)


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


def _best_of_searches(
    problem: Problem,
    options: Swarm,
    desk: Desk,
    random: np.random.SeedSequence,
    start: ArrayLike | Structure | None,
    max_evaluations: int | None,
) -> tuple[_Search, BaseException | None]:
    """Search, and again from another swarm while the goal is missed; the best, and what stopped it early."""
    best: _Search | None = None
    evaluations = 0
    for child in random.spawn(1 + options.restarts):
        search = _Search(problem, options, desk)
        stopped: BaseException | None = None
        try:
            search.run(child, start, None if max_evaluations is None else max_evaluations - evaluations)
        except (Stop, KeyboardInterrupt) as stop:
            stopped, search.success, search.message = stop, False, str(stop) or "interrupted"
        evaluations += search.history.evaluations
        if search.x is not None and (best is None or search.misfit < best.misfit):
            best = search
        if best is None:
            if isinstance(stopped, KeyboardInterrupt):
                raise stopped
            raise SolverError("the search ended before it had a single candidate; give it more time")
        late = desk.max_time is not None and desk.seconds > desk.max_time / 2
        spent = max_evaluations is not None and 2 * evaluations > max_evaluations
        if stopped or late or spent or not options.local_phase or best.good_enough:
            break
        desk.note(f"{best.misfit:.4g} is no good fit: another swarm")
    assert best is not None
    if stopped is not None:
        best.success, best.message = False, str(stopped) or "interrupted"
    best.history = replace(best.history, evaluations=evaluations)
    return best, stopped


def _modal_search(problem: Problem, desk: Desk) -> tuple[_Search, BaseException | None]:
    """Modes from the data, and the fit in modal coordinates."""
    modes, remainder = modes_from_data(problem)
    desk.note(f"{modes.omega.size} modes found in the data")
    search = _Search(problem, Swarm(), desk)
    search.strategy = "modal"
    answer = local.fit_modes(
        problem, modes, remainder, held=False, max_time=desk.left,
        monitor=lambda i, cost: desk.tell("local phase", i, 0, cost),
    )  # fmt: skip
    search.x, search.success, search.message = answer.x, answer.success, answer.message
    curve = answer.curve
    search.history = replace(search.history, start=float(curve[0]), local=search.misfit, local_curve=curve)
    desk.note(f"local phase: {answer.message}, {curve.size} iterates, residual {search.misfit:.4e}")
    stopped = answer.stopped
    if stopped is not None:
        if not isinstance(stopped, Stop | KeyboardInterrupt):
            raise stopped
        search.success, search.message = False, str(stopped) or "interrupted"
    return search, stopped


def _finish(problem: Problem, best: _Search, stopped: BaseException | None, seed: int, desk: Desk) -> Identification:
    """Judge the best candidate, and say what it is worth."""
    assert best.x is not None
    structure = problem.structure(best.x)
    success, message = best.success, best.message
    residual = problem.measurement.residual(structure)
    if best.meets_goal is False:
        success = False
        message += f"; the residual {residual:.3g} is above the goal {problem.goal:.3g}"
    elif success and problem.goal is None and residual > _NO_FIT:
        success = False
        message += (
            f"; the residual {residual:.3g} is no fit: are the frequencies in Hz, the responses absolute and complex "
            "with exp(+iwt), the axes and signs of rigid_body right, the bounds wide enough?"
        )
    desk.note(f"done: residual {best.misfit:.4e}, {message}")
    known = determination(problem, structure)
    open_ = known.undetermined
    if disagreement := _disagreement(problem, structure):
        open_ = (disagreement, *open_)
        message += f"; {disagreement}"
    if not success:
        open_ = ("the search did not end in a fit, so this is not yet any structure that explains the data", *open_)
    return Identification(
        structure=structure,
        problem=problem,
        x=best.x,
        strategy=best.strategy,
        seed=seed,
        success=success,
        message=message,
        history=replace(best.history, log=tuple(desk.log), wall_time=desk.seconds),
        determined=not open_,
        closed_by=() if open_ else known.closed_by,
        undetermined=open_,
        interrupted=isinstance(stopped, KeyboardInterrupt),
    )


def _disagreement(problem: Problem, structure: Structure) -> str:
    """What the base force weighs, where a stated mass says otherwise."""
    test = problem.measurement
    if test.force is None or (not isinstance(problem.mass, KnownMass) and problem.mass.total_mass is None):
        return ""
    poles = 2 * np.pi * structure.natural_frequencies, structure.damping_ratios
    weighed, stated = np.diag(weighed_mass(test, *poles)), np.diag(structure.rigid_body_mass)
    off = np.abs(weighed / stated - 1)
    if np.all(off < max(0.01, 3 * (test.force_residual(structure) or 0.0) / np.sqrt(test.freq.size))):
        return ""
    given, told = (", ".join(f"{m:.4g}" for m in masses) for masses in (stated, weighed))
    return f"the stated mass makes {given} kg in the base directions, but the base force weighs {told} kg"


class _Search:
    """One swarm, its refinement and its local phase: the best so far and its history."""

    def __init__(self, problem: Problem, options: Swarm, desk: Desk) -> None:
        self.problem, self.options, self.desk = problem, options, desk
        self.strategy = "swarm"
        self.x: Array | None = None
        self.raw: Array = np.zeros(0)
        self.history = History()
        self.success, self.message = False, "ended before the local phase, as asked"

    @property
    def misfit(self) -> float:
        """What all phases minimise, at the best so far."""
        assert self.x is not None
        return self.misfit_of(self.x)

    @property
    def meets_goal(self) -> bool | None:
        """Whether the residual is at or below the goal; None where none is given."""
        if self.problem.goal is None or self.x is None:
            return None
        return self.problem.measurement.residual(self.problem.structure(self.x)) <= self.problem.goal

    @property
    def good_enough(self) -> bool:
        """Whether another swarm is not worth its time."""
        if self.problem.goal is not None:
            return self.meets_goal is True
        # Without a goal: modal coordinates notice their local minima themselves, structured ones cannot.
        return local.is_modal(self.problem) or self.misfit <= _DOUBTFUL

    def misfit_of(self, x: Array) -> float:
        """Root of the sum of the squared relative residuals of accelerations and force."""
        structure, test = self.problem.structure(x), self.problem.measurement
        return float(np.hypot(test.residual(structure), test.force_residual(structure) or 0.0))

    def run(
        self, random: np.random.SeedSequence, start: ArrayLike | Structure | None, max_evaluations: int | None
    ) -> None:
        self.swarm(random, start, max_evaluations)
        self.refine()
        if self.options.local_phase:
            self.local()

    def swarm(
        self, random: np.random.SeedSequence, start: ArrayLike | Structure | None, max_evaluations: int | None
    ) -> None:
        problem, options, desk = self.problem, self.options, self.desk
        cost = SwarmCost(problem, refine=options.refine)
        x0 = None if start is None else problem.to_sampling(_as_unknowns(problem, start))
        unknowns = ", ".join(f"{name} {count}" for name, count in problem.unknowns)
        if problem.poles is not None:
            found = ", ".join(f"{f:.4g}" for f in problem.poles.omega / (2 * np.pi))
            desk.note(
                f"natural frequencies found in the data: {found} Hz (modal fit within {problem.poles.residual:.2e})"
            )
        desk.note(f"swarm over {problem.n_variables} unknowns ({unknowns})")
        curve: list[float] = []

        def watch(state: SwarmProgress) -> None:
            if np.isfinite(state.fun):
                self.raw, self.x = cost.unknowns(state.x), cost.refined(state.x)
            curve.append(state.fun)
            self.history = replace(
                self.history, start=curve[0], swarm=curve[-1], swarm_curve=np.array(curve), evaluations=state.nfev
            )
            desk.tell("swarm", state.nit, options.max_iterations, state.fun)

        result = minimize_swarm(
            cost,
            np.column_stack([problem.lower, problem.upper]),
            rng=np.random.default_rng(random),
            n_particles=options.n_particles,
            max_iterations=options.max_iterations,
            max_evaluations=max_evaluations,
            max_time=None if desk.left is None else desk.left * 2 / 3,
            target=problem.goal,
            stall_iterations=options.stall_iterations,
            stall_tolerance=options.stall_tolerance,
            callback=watch,
            improve=self.improver(cost) if options.gradient_every else None,
            improve_every=options.gradient_every,
            x0=x0,
            settings=options.settings,
        )
        if self.x is None:
            raise SolverError(f"the swarm found no candidate that is a structure: {result.message}")
        states = tuple((state.name.lower().replace("_", " "), int(n)) for state, n in result.state_counts.items())
        self.history = replace(self.history, states=states)
        desk.note(f"swarm ended after {result.nit} iterations at {result.fun:.4e}: {result.message}")
        if result.n_nan:
            desk.note(f"{result.n_nan} of {result.nfev} candidates were no structure (not a number)")

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
        self.desk.tell("refinement", 0, 1, self.history.swarm)
        part = self.problem.parts.stiffness
        factor = triangle(self.raw[part], n)
        chosen, solved = closed_form(factor, stiffness.targets), by_ipopt(factor, stiffness.targets)
        x = self.x.copy()
        x[part] = triangle_entries(solved.factor)
        misfit, other = self.misfit, self.misfit_of(x)
        self.desk.note(
            f"refinement of eigenvalues 1 to {stiffness.targets.size} of {n}: {solved.message}, within "
            f"{solved.error:.1e} of the given ones, residual {other:.4e} (closed form {misfit:.4e})"
        )
        if solved.success and other < misfit:
            self.x, chosen, misfit = x, solved, other
        self.history = replace(self.history, refinement=misfit, refinement_error=chosen.error)

    def local(self) -> None:
        """Run the local phase; keep its answer where it is better."""
        assert self.x is not None
        before = self.misfit
        answer = local.solve(
            self.problem,
            self.x,
            max_time=self.desk.left,
            monitor=lambda i, cost: self.desk.tell("local phase", i, 0, cost),
        )
        after = self.misfit_of(answer.x)
        self.desk.note(f"local phase: {answer.message}, {answer.curve.size} iterates, residual {after:.4e}")
        self.success, self.message = answer.success, answer.message
        if after < before:
            self.x = answer.x
        else:
            # A start that meets the goal needs no improvement; any other was not made by a solver that succeeded.
            self.success = self.meets_goal is True
            self.message += f"; it did not improve on {before:.3g}, so its start is kept"
        self.history = replace(self.history, local=min(after, before), local_curve=answer.curve)
        if answer.stopped is not None:
            raise answer.stopped


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
