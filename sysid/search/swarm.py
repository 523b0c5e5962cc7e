"""Strategy "swarm", the paper's hPSO-LS: swarm, eigenvalue refinement, local phase, and again while there is no fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import SolverError, Stop, as_float, choice, flag, instance, text, whole_number
from sysid.modal_analysis.response import error_of_accelerations
from sysid.problem.prepared import Prepared
from sysid.problem.terms import TestTerm
from sysid.search import local
from sysid.search.continuation import descend, smoothed_tests
from sysid.search.local import Coordinates
from sysid.search.modal_coordinates import fits_worse_than_free_residues
from sysid.search.session import Part, Session, in_time
from sysid.search.strategy import DoesNotApplyError, History, Outcome, Phase, as_unknowns, search_note
from sysid.search.swarm_objective import WORST, RefineBy, Refiner, SwarmObjective, Tally
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, NEGLIGIBLE
from sysid.swarm import SwarmProgress, SwarmSettings, minimize_swarm

_SETTINGS = SwarmSettings(inertia_b1=0.8, inertia_b2=0.5, acceleration_lower=0.5, acceleration_sum=3.0, guides=3)
_IDLE = (
    "mass and stiffness are free, so the modal local phase finds this answer from wherever the swarm ends, two random "
    "candidates too: what the swarm itself found stands in the history"
)
_TRAPPED = "that is a local minimum, as free residues at these poles fit clearly better"
_MANY, _FEW = 256, 1  # candidates between two looks at the clock; few where IPOPT refines each
_SAMPLE = 1.6e-7  # s of a processor, that a coordinate of a particle of the first sample takes
_DOUBTFUL = 0.1  # objective above which a problem without free modes is searched again
_PUBLISHED_FORM = "hpso-ls searched the model's own unknowns, by the published swarm first, then through IPOPT"


@dataclass(frozen=True)
class Swarm:
    """Strategy "swarm": particle swarm, eigenvalue refinement, local phase, and again while there is no fit.

    `Swarm.published` gives the paper's hPSO-LS; the defaults differ from it in the constants, in what draws a particle
    (`settings`) and in the coordinates of the local phase.

    Parameters
    ----------
    max_iterations : int
        Iterations of the swarm.
    n_particles : int, optional
        5·D by default.
    stall_iterations, stall_tolerance :
        The swarm ends where its best has not improved by this fraction in so many iterations.
    refine : bool
        Give each candidate the measured spectrum, from its own L_H (eq. 31).
    refine_by : {"closed-form", "ipopt", "leaders"}
        The nearest matrix of that spectrum; or the paper's nonlinear programme by IPOPT with exact derivatives for each
        candidate, which is for small problems (some 20 ms a candidate with 4 or 6 sensors, 40 ms with 10); or the
        closed form, and IPOPT on each new leader of the swarm: the better of both is written back to the leader.
        Where IPOPT does not succeed the closed form stands; the history counts how it ended.
    write_back : bool
        Whether the refined L_H takes the candidate's place in the swarm, or serves its objective alone. The paper does
        not say; alone, the swarm keeps its own motion.
    gradient_every : int
        Refine the swarm's best by a few iterations of the local phase every so many iterations; 0: never.
    local : {"modal", "cholesky", "entries"} or None
        Coordinates of the local phase by IPOPT where mass and stiffness are free: mode shapes and participations
        (Gauss-Newton Hessian); the inverse of the mass's Cholesky factor, the spectrum of H and log zeta (exact
        Hessian); the paper's plain x, for comparison. Problems with a form of their own are searched in their own
        unknowns. None: no local phase; no solver then vouches for the result, and `success` is False.
    restarts : int
        How many further swarms may follow where IPOPT did not succeed or the goal is missed, or, without a goal, where
        the local phase ended in a local minimum or, where modes are not free, the objective is above 0.1.
    settings : SwarmSettings
        Constants of the swarm itself. The paper leaves b1 and b2 of its eq. 11 to the user; with the usual 0.3 and 0.2
        and c1 + c2 up to 4 (``SwarmSettings()``) the swarm of this problem contracts too early. These keep it moving,
        and draw each particle to the mean of three random ones of the best quarter (as Mendes, Kennedy, Neves 2004,
        IEEE Trans. Evol. Comput. 8, 204-210, to that of its neighbours): what is wrong in one alone averages out, and
        no single best ends the search. On a tower with
        400 iterations of the swarm alone, 20 seeds end at a median residual of 0.05 with 6 sensors (worst 0.14), 0.12
        with 10 (worst 0.17); drawn to the global best, at 0.23 (worst 0.63) and around 0.6. Means with the usual
        constants leave 0.20 and 0.65; 2 or 5 guides, or the best 15 or 50 %, 0.05 to 0.13 (6 sensors, 4 seeds each).
        ``python -m benchmarks swarm_alone`` measures it.
    name : str
        As results call it.

    Notes
    -----
    The swarm earns its time where nothing else reaches the fit. Of 100 chains and branched structures without noise,
    their masses, springs and dampers searched within two decades, it found 98, two random points with the same local
    phase and restarts 98, one continuation 91: peaks that are widened first do most of the work there
    (``python -m benchmarks structured``).

    References
    ----------
    Cerini, Yotov, Aglietti, Mech. Syst. Signal Process. 209 (2024) 111084.
    """

    max_iterations: int = 150
    n_particles: int | None = None
    stall_iterations: int = 40
    stall_tolerance: float = 1e-3
    refine: bool = True
    refine_by: RefineBy = "closed-form"
    write_back: bool = False
    gradient_every: int = 0
    local: Coordinates | None = "modal"
    restarts: int = 4
    settings: SwarmSettings = _SETTINGS
    name: str = "swarm"

    def __post_init__(self) -> None:
        choice("Swarm: local", self.local, (*get_args(Coordinates), None))
        choice("Swarm: refine_by", self.refine_by, get_args(RefineBy))
        least = {"max_iterations": 1, "n_particles": 2, "stall_iterations": 1, "gradient_every": 0, "restarts": 0}
        for field, at_least in least.items():
            value = getattr(self, field)
            if value is not None or field not in ("n_particles", "stall_iterations"):  # None has a meaning there
                whole_number(f"Swarm: {field}", value, at_least=at_least)
        as_float("Swarm: stall_tolerance", self.stall_tolerance, "a part of it, in [0, 1),", at_least=0, below=1)
        for field in ("refine", "write_back"):
            flag(f"Swarm: {field}", getattr(self, field))
        instance("Swarm: settings", self.settings, SwarmSettings)
        text("Swarm: name", self.name)

    @classmethod
    def published(cls, **changes: Any) -> Swarm:
        """The paper's hPSO-LS, under the name "hpso-ls"; `changes` are fields that shall differ.

        The usual constants of the sources that the paper names (b1 = 0.3, b2 = 0.2; c1 + c2 up to 4), the spectrum of
        each candidate refined from its own L_H, and a local phase in the inverse of the mass's Cholesky factor, where
        the paper's own entries end on IPOPT's iteration limit with noise. What the paper leaves open, or its printed
        text has lost, is chosen here: refinement in closed form, not written back, and by IPOPT of each new leader
        alone (``refine_by="ipopt"`` refines every candidate so, as the paper does); 150 iterations, the stop rules, and
        up to four restarts; a particle stops at a bound and its velocity there is reversed; the state of the swarm is
        estimated with the leader's present position (`sysid.swarm.ParticleSwarm`).
        """
        return cls(
            **{"settings": SwarmSettings(), "local": "cholesky", "name": "hpso-ls", "refine_by": "leaders", **changes}
        )

    def refusal(self, problem: Prepared, start: ArrayLike | Structure | None) -> str | None:
        """Why it cannot search a problem: what healing cannot meet, or more modes than degrees of freedom."""
        mass = problem.formulation.mass
        if mass.weighs or (mass.free and problem.rigid_total is not None):
            return (
                "the swarm cannot hold known entries of the mass or a whole rigid-body mass: state their diagonals as "
                "total_mass only, or take strategy 'modal'"
            )
        n, poles = problem.geometry.n, problem.poles
        # What stands out above the lines is a residual mode where modes are free, or these are asked for.
        beyond = problem.free_modes or problem.formulation.residual_modes
        last = 2 * np.pi * problem.measurement.freq[-1] if beyond else np.inf
        omega = np.zeros(0) if poles is None else poles.omega[poles.omega <= last]
        if omega.size <= n:
            return None
        found = ", ".join(f"{w / (2 * np.pi):.4g}" for w in omega)
        return (
            f"{omega.size} modes stand out of the data ({found} Hz) for {n} sensors, but the swarm's models have "
            "one a sensor: narrow the band, or use strategy 'modal'"
        )

    def searched(self, problem: Prepared, session: Session) -> tuple[SwarmObjective, list[tuple[TestTerm, ...]]]:
        """Objective of the swarm, and the tests with widened peaks, if any, through which the local phase goes."""
        formulation = problem.formulation
        # With wide peaks more of the swarm is on a slope that leads somewhere.
        steps = [] if formulation.refinable else smoothed_tests(problem, session.preparing).steps[1:]
        spectrum = formulation.stiffness.spectrum if self.refine and formulation.refinable else None
        return SwarmObjective(problem, steps[0] if steps else (), spectrum), steps

    def run(self, problem: Prepared, session: Session, start: ArrayLike | Structure | None) -> Outcome:
        """Search, and again from another swarm while there is no good fit; the best."""
        refusal = self.refusal(problem, start)
        if refusal:
            raise DoesNotApplyError(refusal)
        best: _Search | None = None
        evaluations, restarts, most, tally = 0, -1, session.max_evaluations, Tally()
        for child in session.random.spawn(1 + self.restarts):
            search = _Search(problem, self, session)
            restarts += 1
            stopped: BaseException | None = None
            try:
                search.run(child, start, None if most is None else most - evaluations)
            except (Stop, KeyboardInterrupt) as stop:
                stopped, search.success, search.message = stop, False, str(stop) or "interrupted"
                search.stopped()
            evaluations += search.history.evaluations
            tally.add(search.tally)
            if search.x is not None and (best is None or search.beats(best)):
                best = search
            if best is None:
                if isinstance(stopped, KeyboardInterrupt):
                    raise stopped
                raise SolverError("the search ended before it had a single candidate; give it more time")
            spent = most is not None and 2 * evaluations > most
            if stopped or not session.time_for_more or spent or self.local is None or best.good_enough:
                break
            session.log(f"{best.objective:.4g} is no good fit, or no solution: another swarm")
        assert best is not None
        if stopped is not None:
            best.success, best.message = False, str(stopped) or "interrupted"
        history = replace(best.history, evaluations=evaluations, restarts=restarts, phases=tuple(best.phases))
        history = replace(history, **tally.of_history)
        idle = problem.free_modes and self.local == "modal" and best.success
        return Outcome(
            problem.structure(best.found), best.found, self.name, best.success, best.message, history, stopped,
            findings=(search_note(_IDLE),) * idle
            + (search_note(_PUBLISHED_FORM),) * (self.local == "cholesky" and not problem.free_modes),
        )  # fmt: skip


class _Search:
    """One swarm and its local phase: the best so far and its history."""

    def __init__(self, problem: Prepared, options: Swarm, session: Session) -> None:
        self.problem, self.options, self.session = problem, options, session
        self.x: Array | None = None
        self.tally = Tally()
        self.refiner: Refiner | None = None  # where each candidate is given the measured spectrum
        self.steps: list[tuple[TestTerm, ...]] = []
        self.history = History()
        self.phases: list[Phase] = []
        self.trapped = False
        self.success, self.message = False, "ended before the local phase, as asked"

    @property
    def found(self) -> Array:
        """The best unknowns so far."""
        assert self.x is not None
        return self.x

    @property
    def objective(self) -> float:
        """At the best so far."""
        return self.problem.objective(self.found)

    @property
    def meets_goal(self) -> bool:
        """True where there is a goal, and the residual is at or below it."""
        goal = self.problem.stated.goal
        return goal is not None and self.problem.residual(self.found) <= goal

    @property
    def good_enough(self) -> bool:
        """True where another swarm is not worth its time; never while no solver vouches for the best."""
        if self.problem.stated.goal is not None:
            return self.success and self.meets_goal
        return self.success and (not self.trapped if self.problem.free_modes else self.objective <= _DOUBTFUL)

    def beats(self, other: _Search) -> bool:
        """True where it ended better, by constraints, then by objective; of two alike, what a solver vouches for."""
        ours, theirs = self.problem.rank_of(self.found), self.problem.rank_of(other.found)
        if self.success != other.success and ours[0] == theirs[0] and np.isclose(ours[1], theirs[1], rtol=NEGLIGIBLE):
            return self.success
        return ours < theirs

    def run(
        self, random: np.random.SeedSequence, start: ArrayLike | Structure | None, max_evaluations: int | None
    ) -> None:
        """All phases."""
        self.swarm(random, start, max_evaluations)
        if self.options.local is not None:
            self.local(self.options.local)

    def ended(self, phase: str, evaluations: int) -> None:
        """Add a phase that ended at the best so far."""
        self.phases.append(Phase(phase, self.objective, self.found, self.session.seconds, evaluations))

    def swarm(
        self, random: np.random.SeedSequence, start: ArrayLike | Structure | None, max_evaluations: int | None
    ) -> None:
        """The swarm itself."""
        problem, options, session = self.problem, self.options, self.session
        self._check_time()
        objective, self.steps = options.searched(problem, session)
        if objective.spectrum is not None:
            self.refiner = Refiner(problem, options.refine_by, objective.spectrum, session, self.tally)
        self._log_start()
        record = _SwarmRecord(self, objective, session.journal.part("swarm"))
        evaluate, repair = self._functions(objective)
        result = minimize_swarm(
            evaluate,
            np.column_stack(problem.formulation.box),
            rng=np.random.default_rng(random),
            n_particles=options.n_particles,
            max_iterations=options.max_iterations,
            max_evaluations=max_evaluations,
            max_time=None if session.left is None else session.left * 2 / 3,
            target=self._target(),
            stall_iterations=options.stall_iterations,
            stall_tolerance=options.stall_tolerance,
            callback=record.take,
            improve=self._improver(objective) if options.gradient_every else None,
            improve_every=options.gradient_every,
            on_leader=self.refiner.of_leader(objective) if self.refiner and options.refine_by == "leaders" else None,
            repair=repair,
            x0=None if start is None else problem.formulation.to_sampling(as_unknowns(problem, start)),
            settings=options.settings,
            resume=record.resumed(),
        )
        record.keep()
        if self.x is None:
            raise SolverError(f"the swarm found no candidate that is a structure: {result.message}")
        states = tuple((state.lower().replace("_", " "), int(n)) for state, n in result.state_counts.items())
        self.history = replace(self.history, states=states)
        session.log(f"swarm ended after {result.nit} iterations at {result.fun:.4e}: {result.message}")
        if self.steps:
            session.log(f"its best leaves {self.objective:.4e} of the records themselves")
            self.history = replace(self.history, swarm=self.objective)
        if result.n_nan:
            session.log(f"{result.n_nan} of {result.nfev} candidates were no structure (not a number)")
        if self.refiner is not None:
            error = self.refiner.error(self.found)
            self.history = replace(self.history, refinement_error=error, **self.tally.of_history)
            session.log(f"eigenvalues of its best within {error:.1e} of the given ones")
        if self.history.refinement_in_words:
            session.log(self.history.refinement_in_words)
        self.ended("swarm", result.nfev - sum(phase.evaluations for phase in self.phases))

    def _functions(self, objective: SwarmObjective) -> tuple[Callable[[Array], Array], Callable[[Array], Array] | None]:
        """Functions of rows for their objectives, and to write refined entries of L_H back to them; both in time."""
        session, options, refiner = self.session, self.options, self.refiner
        slow = refiner is not None and options.refine_by == "ipopt"
        repair, at_once = None, _FEW if slow else _MANY
        if refiner is not None and options.write_back:
            repair = in_time(refiner.rows, lambda rows: rows, session, at_once)

        def evaluate(rows: Array) -> Array:
            return objective(refiner.rows(rows) if refiner is not None and slow and repair is None else rows)

        return in_time(evaluate, lambda rows: np.full(len(rows), WORST), session, at_once), repair

    def _check_time(self) -> None:
        """Stop where the time cannot suffice for the first sample."""
        problem, options = self.problem, self.options
        particles = options.n_particles or 5 * problem.n_variables
        seconds = _SAMPLE * particles * problem.n_variables
        if not self.session.allows(seconds):
            raise Stop(f"a swarm of {particles} particles takes some {seconds:.1g} s to begin: too little time")

    def _target(self) -> float | None:
        """The objective at which the swarm may end: the goal, where objective and residual are one."""
        test, formulation = self.problem.measurement, self.problem.formulation
        alike = test.response_std is None and test.force is None and len(formulation.terms) == 1 and not self.steps
        return self.problem.stated.goal if alike else None

    def _log_start(self) -> None:
        problem = self.problem
        unknowns = ", ".join(f"{name} {count}" for name, count in problem.unknowns)
        if problem.poles is not None:
            found = ", ".join(f"{f:.4g}" for f in problem.poles.omega / (2 * np.pi))
            self.session.log(
                f"natural frequencies found in the data: {found} Hz (modal fit within {problem.poles.residual:.2e})"
            )
        self.session.log(f"swarm over {problem.n_variables} unknowns ({unknowns})")

    def _improver(self, objective: SwarmObjective) -> Callable[[Array], Array]:
        """The refinement of the swarm's best by gradients, in the swarm's coordinates."""

        def improve(s: Array) -> Array:
            at, coordinates = self.refined(objective.unknowns(s)), self.options.local or "modal"
            better = local.solve(
                self.problem, at, max_iterations=30, max_time=self.session.left, coordinates=coordinates
            )
            return self.problem.formulation.to_sampling(better.x)

        return improve

    def stopped(self) -> None:
        """Add the swarm where it was stopped, which is then the last phase."""
        if self.x is not None and [phase.name for phase in self.phases] == ["start"]:
            self.ended("swarm", self.history.evaluations - self.phases[0].evaluations)

    def refined(self, x: Array) -> Array:
        """The unknowns of the structure that `x` was given its objective for: its spectrum replaced."""
        return x if self.refiner is None else self.refiner.one(x)

    def local(self, coordinates: Coordinates) -> None:
        """Run the local phase; keep its answer where it is better."""
        before = self.objective
        answer = descend(self.problem, self.found, self.steps, self.session, coordinates)
        after = self.problem.objective(answer.x)
        self.session.log(f"local phase: {answer.message}, {answer.curve.size} iterates, objective {after:.4e}")
        self.success, self.message = answer.success, answer.message
        better = self.problem.rank_of(answer.x) < self.problem.rank_of(self.found)
        # A start that is a solution already can only end beside itself by round-off.
        alike = answer.success and after <= max((1 + NEGLIGIBLE) * before, EXACT)
        if better or (alike and self.problem.keeps_constraints(answer.x)):
            self.x = answer.x
        else:
            self.success = False
            self.message += f"; it did not improve on {before:.3g}, so its start is kept"
        self.history = replace(self.history, local=min(after, before), local_curve=answer.curve)
        self.ended("local phase", answer.curve.size)
        if answer.stopped is not None:
            raise answer.stopped
        # Modal coordinates notice their local minima themselves, and start again.
        ended = not self.session.cut_short
        self.trapped = ended and self.problem.free_modes and coordinates != "modal" and self._in_local_minimum()
        if self.trapped:
            self.success = self.success and self.meets_goal
            self.message += f"; {_TRAPPED}"
            if self.problem.measurement.force is not None and self.problem.formulation.mass.totals is not None:
                self.message += ", or the stated total contradicts the base force"

    def _in_local_minimum(self) -> bool:
        test, structure = self.problem.measurement, self.problem.structure(self.found)
        return fits_worse_than_free_residues(test, structure, error_of_accelerations(test, structure))


class _SwarmRecord:
    """Record of a swarm while it runs: its best, its curve, its state."""

    def __init__(self, search: _Search, objective: SwarmObjective, part: Part) -> None:
        self.search, self.objective, self.part = search, objective, part
        self.curve: list[float] = []
        self.last: SwarmProgress | None = None

    def resumed(self) -> dict[str, Any] | None:
        """The state of an earlier run's swarm, whose record is taken up; None where there was none."""
        found = self.part.found
        if found is None:
            return None
        swarm = found["search"]["swarm"]
        self.search.phases = [Phase(**found["start"])]
        self.search.tally.resume(found["refinements"])
        self.curve = swarm["history"].tolist()
        self._tell(swarm["best_x"], swarm["best_cost"], swarm["nfev"])
        return dict(found["search"])

    def take(self, state: SwarmProgress) -> None:
        """Take an iteration."""
        self.last = state
        self.curve.append(state.fun)
        self._tell(state.x, state.fun, state.nfev)
        if self.search.phases:
            self.part.running(self._content)
        try:
            self.search.session.report("swarm", state.nit, self.search.options.max_iterations, state.fun)
        except (Stop, KeyboardInterrupt):
            self.keep()
            raise

    def keep(self) -> None:
        """Keep the state after the last iteration."""
        if self.last is not None and self.search.phases:
            self.part.ended(self._content)

    def _tell(self, x: Array, objective: float, evaluations: int) -> None:
        search, curve = self.search, self.curve
        if np.isfinite(objective):
            search.x = search.refined(self.objective.unknowns(x))
            if not search.phases:
                search.ended("start", evaluations)
        start, best = (np.nan, np.nan) if search.steps else (curve[0], curve[-1])  # the steps' are not the records' own
        search.history = replace(
            search.history, start=start, swarm=best, swarm_curve=np.array(curve), evaluations=evaluations
        )

    def _content(self) -> dict[str, Any]:
        assert self.last is not None
        start = dict(vars(self.search.phases[0]))
        return {"search": self.last.snapshot(), "start": start, "refinements": self.search.tally.to_tree()}
