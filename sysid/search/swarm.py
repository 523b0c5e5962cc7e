"""Strategy "swarm", the paper's hPSO-LS: swarm, eigenvalue refinement, local phase, and again while there is no fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, SolverError
from sysid.modal_analysis.complex_frequency import Smoothed
from sysid.models.mass import FullMass
from sysid.models.spectrum import by_ipopt, closed_form
from sysid.models.stiffness import SpectralStiffness
from sysid.problem.problem import Problem
from sysid.search import local
from sysid.search.continuation import descend, levels_of, tests_of
from sysid.search.direct_objective import WrittenCost
from sysid.search.session import Desk, Stop
from sysid.search.strategy import History, Outcome, as_unknowns
from sysid.search.swarm_objective import SwarmCost
from sysid.structure.structure import Array, Structure
from sysid.structure.triangular import triangle, triangle_entries
from sysid.swarm import SwarmProgress, SwarmSettings, minimize_swarm

_SETTINGS = SwarmSettings(inertia_b1=0.8, inertia_b2=0.5, acceleration_lower=0.5, acceleration_sum=3.0)
_DOUBTFUL = 0.1  # relative residual above which a structured problem is searched again


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
        too early. These keep it moving: ``python -m benchmarks swarm_alone`` measures both.
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


def by_swarm(
    problem: Problem,
    options: Swarm,
    desk: Desk,
    random: np.random.SeedSequence,
    start: ArrayLike | Structure | None,
    max_evaluations: int | None,
) -> Outcome:
    """Search, and again from another swarm while the goal is missed; the best.

    Raises
    ------
    InputError
        Where more modes were found in the data than sensors, or known entries or a whole rigid-body mass are stated.
    """
    if isinstance(problem.mass, FullMass) and not problem.mass.healable:
        raise InputError(
            "the swarm cannot hold known entries of the mass or a whole rigid-body mass: state their diagonals as "
            "total_mass only, or take strategy 'modal'"
        )
    _check_modes(problem)
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
        if search.x is not None and (best is None or problem.rank_of(search.x) < problem.rank_of(best.found)):
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
    assert best.x is not None
    return Outcome(problem.structure(best.x), best.x, "swarm", best.success, best.message, best.history, stopped)


def _check_modes(problem: Problem) -> None:
    """The swarm's models have one mode a sensor."""
    n, poles = problem.layout.n, problem.poles
    if poles is not None and poles.omega.size > n:
        found = ", ".join(f"{w / (2 * np.pi):.4g}" for w in poles.omega)
        raise InputError(
            f"{poles.omega.size} modes stand out of the data ({found} Hz) for {n} sensors, but the swarm's models have "
            "one a sensor: narrow the band, or use strategy 'modal'"
        )


class _Search:
    """One swarm, its refinement and its local phase: the best so far and its history."""

    def __init__(self, problem: Problem, options: Swarm, desk: Desk) -> None:
        self.problem, self.options, self.desk = problem, options, desk
        self.x: Array | None = None
        self.raw: Array = np.zeros(0)
        self.steps: list[tuple[Smoothed, ...]] = []
        self.history = History()
        self.success, self.message = False, "ended before the local phase, as asked"

    @property
    def found(self) -> Array:
        """The best unknowns so far."""
        assert self.x is not None
        return self.x

    @property
    def misfit(self) -> float:
        """At the best so far."""
        assert self.x is not None
        return self.problem.misfit_of(self.x)

    @property
    def meets_goal(self) -> bool | None:
        """Whether the residual is at or below the goal; None where none is given."""
        if self.problem.goal is None or self.x is None:
            return None
        return self.problem.residual_of(self.x) <= self.problem.goal

    @property
    def good_enough(self) -> bool:
        """Whether another swarm is not worth its time."""
        if self.problem.goal is not None:
            return self.meets_goal is True
        # Without a goal: modal coordinates notice their local minima themselves, structured ones cannot.
        return self.problem.free_modes or self.misfit <= _DOUBTFUL

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
        cost: SwarmCost | WrittenCost
        if problem.is_written:
            # With wide peaks more of the swarm is on a slope that leads somewhere.
            self.steps = levels_of(problem, poles)[1:] if (poles := tests_of(problem)) else []
            cost = WrittenCost(problem, self.steps[0] if self.steps else None)
        else:
            cost = SwarmCost(problem, refine=options.refine)
        x0 = None if start is None else problem.to_sampling(as_unknowns(problem, start))
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
        if problem.is_written:
            desk.note(f"its best leaves {self.misfit:.4e} of the records themselves")
            self.history = replace(self.history, start=np.nan, swarm=self.misfit)
        if result.n_nan:
            desk.note(f"{result.n_nan} of {result.nfev} candidates were no structure (not a number)")

    def improver(self, cost: SwarmCost | WrittenCost) -> Callable[[Array], Array]:
        """The exact-gradient refinement of the swarm's best, in the swarm's coordinates."""

        def improve(s: Array) -> Array:
            better = local.solve(self.problem, cost.refined(s), max_iterations=30)
            return self.problem.to_sampling(better.x)

        return improve

    def refine(self) -> None:
        """Refine the swarm's best from its own L_H through IPOPT, as the paper does, beside the closed form."""
        stiffness, n = self.problem.stiffness, self.problem.layout.n
        if self.problem.is_written or not (isinstance(stiffness, SpectralStiffness) and self.options.refine):
            return
        assert self.x is not None
        self.desk.tell("refinement", 0, 1, self.history.swarm)
        part = self.problem.parts.stiffness
        factor = triangle(self.raw[part], n)
        chosen, solved = closed_form(factor, stiffness.targets), by_ipopt(factor, stiffness.targets)
        x = self.x.copy()
        x[part] = triangle_entries(solved.factor)
        misfit, other = self.misfit, self.problem.misfit_of(x)
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
        monitor = lambda i, cost: self.desk.tell("local phase", i, 0, cost)  # noqa: E731 - for both ways
        if self.problem.is_written:
            answer = descend(self.problem, self.x, self.steps, left=lambda: self.desk.left, monitor=monitor)
        else:
            answer = local.solve(self.problem, self.x, max_time=self.desk.left, monitor=monitor)
        after = self.problem.misfit_of(answer.x)
        self.desk.note(f"local phase: {answer.message}, {answer.curve.size} iterates, residual {after:.4e}")
        self.success, self.message = answer.success, answer.message
        if self.problem.rank_of(answer.x) < self.problem.rank_of(self.x):
            self.x = answer.x
        else:
            # A start that meets the goal needs no improvement; any other was not made by a solver that succeeded.
            self.success = self.meets_goal is True
            self.message += f"; it did not improve on {before:.3g}, so its start is kept"
        self.history = replace(self.history, local=min(after, before), local_curve=answer.curve)
        if answer.stopped is not None:
            raise answer.stopped
