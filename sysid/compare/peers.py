"""Optimisers of other packages on the swarm's own objective, with its budget and its local phase; results of methods.

All of them search the unit cube that stands for the search space. None is imported before it is used.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import groupby
from typing import Any

import numpy as np

from sysid.assessment.checks.context import Context
from sysid.errors import InputError, SolverError, how_to_install
from sysid.problem.prepared import Prepared
from sysid.problem.terms import TestTerm
from sysid.results.facts import matrix_errors
from sysid.results.judgement import verdict_of
from sysid.search.continuation import descend
from sysid.search.session import Progress, Session
from sysid.search.strategy import History, Outcome
from sysid.search.swarm import Swarm
from sysid.search.swarm_objective import SwarmObjective
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EPSILON

MATRICES = ("M", "K", "C")
PACKAGES = ("pymoo", "cma")  # of the extra "benchmark"
HOW_TO_INSTALL = how_to_install("benchmark")
_WORST = 1e30  # an objective in the place of what is not a number: above that of any broken constraint
Evaluate = Callable[[Array], Array]  # points of the unit cube (k, size) to objectives (k,)


class Status(Enum):
    """End of a method, in the words of the table."""

    FIT = "fit"
    NO_FIT = "no fit"
    REFUSED = "does not apply"
    FAILED = "failed"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, eq=False)
class MethodResult:
    """Where one method ended.

    Attributes
    ----------
    name : str
    status : Status
    message : str
        The solver's words, or why the method did not run.
    before, after : float
        Objective before and after the local phase; NaN where there is none. Before that of continuation is its guess.
    residual : float
        Relative residual at the end, unweighted, as `Identification.residual`.
    errors : (3,)
        Of M_SS, K_SS and C: Frobenius norm of the difference from the reference's, in % of the reference's; NaN where
        there is no reference, or one of other degrees of freedom, and of C where the reference has no damping.
    evaluations : int
        Candidates whose objective was computed before the local phase; 0 for a method without candidates.
    seconds : float
    phases : tuple of (str, (k, 2))
        Name of each phase, and what it reported: seconds since the start of the method, and objective.
    widened : bool
        The phases report of records with widened peaks, so that no step to the next is one of the records.
    """

    name: str
    status: Status
    message: str = ""
    before: float = np.nan
    after: float = np.nan
    residual: float = np.nan
    errors: tuple[float, ...] = (np.nan,) * len(MATRICES)
    evaluations: int = 0
    seconds: float = np.nan
    phases: tuple[tuple[str, Array], ...] = ()
    widened: bool = False

    @property
    def ran(self) -> bool:
        """True where it left anything."""
        return bool(np.isfinite(self.after))

    def to_dict(self) -> dict[str, Any]:
        """The row of the table, for CSV and JSON; the phases are not in it."""
        errors = {f"error_{name}_percent": value for name, value in zip(MATRICES, self.errors, strict=True)}
        figures = {name: getattr(self, name) for name in ("before", "after", "residual")}
        return {
            "method": self.name,
            "status": self.status.value,
            **figures,
            **errors,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            "message": self.message,
        }


class Recorder:
    """A listener that keeps what a search reports."""

    def __init__(self) -> None:
        self.heard: list[Progress] = []

    def __call__(self, progress: Progress) -> None:
        """Keep one report."""
        self.heard.append(progress)

    @property
    def phases(self) -> tuple[tuple[str, Array], ...]:
        """Phases in the order in which they ran, poles apart, as `MethodResult` has them."""
        groups = groupby(self.heard, key=lambda progress: progress.phase)
        curves = [(phase, np.array([(p.seconds, p.objective) for p in group])) for phase, group in groups]
        return tuple((phase, curve) for phase, curve in curves if phase != "poles")


def status_of(success: bool, interrupted: bool) -> Status:
    """The status of a method that ran."""
    return Status.INTERRUPTED if interrupted else (Status.NO_FIT, Status.FIT)[success]


def errors_of(structure: Structure, reference: Structure | None) -> tuple[float, ...]:
    """Errors of M_SS, K_SS and C in %: see `MethodResult.errors`."""
    if reference is None or structure.recovery.shape != reference.recovery.shape:
        return MethodResult.errors
    if not np.allclose(structure.recovery, reference.recovery):
        return MethodResult.errors
    return tuple(100 * error for error in matrix_errors(structure, reference))


class Spent(Exception):  # noqa: N818 - not an error
    """The evaluations or the time are spent."""


def missing_packages() -> list[str]:
    """Packages of the extra "benchmark" that are not installed."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


@dataclass(frozen=True)
class Landscape:
    """Objective that the swarm searches, and every peer with it; `steps` are tests with widened peaks."""

    problem: Prepared
    objective: SwarmObjective
    steps: list[tuple[TestTerm, ...]]

    @classmethod
    def of(cls, problem: Prepared, session: Session) -> Landscape:
        """The objective and the steps that the strategy "swarm" takes for a problem; both compiled."""
        objective, steps = Swarm().searched(problem, session)
        objective(problem.formulation.box[0][None])
        return cls(problem, objective, steps)

    def at(self, unit: Array) -> Array:
        """The swarm's coordinates of points of the unit cube."""
        lower, upper = self.problem.formulation.box
        return lower + np.clip(unit, 0.0, 1.0) * (upper - lower)


class Evaluator:
    """The objective with a count, a clock and the best so far.

    Raises `Spent` once the evaluations or the time are spent, and KeyboardInterrupt where the user asked for it.
    """

    def __init__(self, landscape: Landscape, most: int, session: Session) -> None:
        self.landscape, self.most, self.session = landscape, most, session
        self.count, self.best, self.curve = 0, np.inf, list[tuple[float, float]]()
        self.s = landscape.at(np.full(landscape.problem.n_variables, 0.5))

    def __call__(self, unit: Array) -> Array:
        """Objectives of points (k, size) of the unit cube, as many as the budget allows."""
        self.session.interrupt.check()
        rows = self.landscape.at(np.asarray(unit, dtype=float)[: self.most - self.count])
        values = self.landscape.objective(rows)
        values = np.where(np.isfinite(values), values, _WORST)
        least = int(np.argmin(values))
        if values[least] < self.best:
            self.best, self.s = float(values[least]), rows[least]
        self.count += len(rows)
        self.curve.append((self.session.seconds, self.best))
        late = self.session.max_time is not None and self.session.seconds > 2 / 3 * self.session.max_time  # as a swarm
        if late or self.count >= self.most:
            raise Spent
        return values


def run(name: str, landscape: Landscape, most: int, session: Session, recorder: Recorder) -> MethodResult:
    """Search with one of `PEERS`, `most` evaluations, then the local phase: where it ended.

    The session's random source seeds the peer; the recorder hears the session.
    """
    problem, evaluator = landscape.problem, Evaluator(landscape, most, session)
    words, stopped = _search(name, evaluator, session)
    answer = None
    try:
        start = landscape.objective.refined(landscape.objective.unknowns(evaluator.s))
        if stopped is None:
            answer = descend(problem, start, landscape.steps, session)
            words, stopped = f"{words}; {answer.message}", answer.stopped
        x = min([start] if answer is None else [start, answer.x], key=problem.rank_of)
        structure = problem.structure(x)
    except (InputError, SolverError, np.linalg.LinAlgError) as error:  # the best candidate is no structure
        return MethodResult(name, Status.FAILED, str(error), evaluations=evaluator.count, seconds=session.seconds)
    solved = answer is not None and answer.success and x is answer.x
    verdict = verdict_of(Context(problem, Outcome(structure, x, name, solved, words, History(), stopped)))
    return MethodResult(
        name,
        status_of(verdict.success, isinstance(stopped, KeyboardInterrupt) or session.interrupt.asked),
        verdict.message,
        problem.objective(start),
        problem.objective(x),
        problem.residual(x),
        errors_of(structure, problem.stated.reference),
        evaluator.count,
        session.seconds,
        (("search", np.array(evaluator.curve).reshape(-1, 2)), *recorder.phases),
        bool(landscape.steps),
    )


def _search(name: str, evaluator: Evaluator, session: Session) -> tuple[str, BaseException | None]:
    """Let a peer search: how it ended in words, and what interrupted it."""
    try:
        PEERS[name](evaluator, evaluator.landscape.problem.n_variables, np.random.default_rng(session.random))
    except Spent:
        return "spent its budget", None
    except KeyboardInterrupt as stop:
        return "interrupted before the local phase", stop
    return "ended by itself", None


# -- the peers ----------------------------------------------------------------------------------


def _population(size: int) -> int:
    return max(5 * size, 10)  # as the swarm's


def _pymoo(kind: str) -> Callable[[Evaluate, int, np.random.Generator], None]:
    """An algorithm of pymoo for one objective, with its own settings."""

    def search(evaluate: Evaluate, size: int, rng: np.random.Generator) -> None:
        from pymoo.core.problem import Problem as Box
        from pymoo.core.termination import NoTermination

        algorithm = getattr(importlib.import_module(f"pymoo.algorithms.soo.nonconvex.{kind.lower()}"), kind)
        run = algorithm(pop_size=_population(size))
        run.setup(Box(n_var=size, n_obj=1, xl=0.0, xu=1.0), termination=NoTermination(), seed=int(rng.integers(2**31)))
        while run.has_next():
            candidates = run.ask()
            candidates.set("F", evaluate(candidates.get("X"))[:, None])
            run.tell(infills=candidates)

    return search


def _cma_es(evaluate: Evaluate, size: int, rng: np.random.Generator) -> None:
    """CMA-ES from the middle of the search space; its own rules end it."""
    import cma

    run = cma.CMAEvolutionStrategy(
        np.full(size, 0.5),
        0.3,  # of the search space, from its middle
        # "seed": not a number leaves NumPy's global source alone.
        {"bounds": [0, 1], "seed": np.nan, "randn": lambda *s: rng.standard_normal(s), "verbose": -9},
    )
    while not run.stop():
        points = run.ask()
        run.tell(points, evaluate(np.array(points)).tolist())


def _scipy_de(evaluate: Evaluate, size: int, rng: np.random.Generator) -> None:
    """SciPy's differential evolution with its own settings, whole generations at a time."""
    from scipy.optimize import differential_evolution

    differential_evolution(
        lambda columns: evaluate(columns.T), [(0.0, 1.0)] * size, popsize=5, tol=0.0, maxiter=10**9, polish=False,
        init="latinhypercube", updating="deferred", vectorized=True, rng=rng,
    )  # fmt: skip


def _l_bfgs_b(evaluate: Evaluate, size: int, rng: np.random.Generator) -> None:
    """SciPy's L-BFGS-B from the best of a Latin hypercube; gradients by forward differences, all at once."""
    from scipy.optimize import minimize
    from scipy.stats import qmc

    def slope(point: Array) -> tuple[float, Array]:
        steps = np.where(point > 0.5, -1, 1) * EPSILON**0.5  # into the cube
        values = evaluate(np.vstack([point, point + np.diag(steps)]))
        return float(values[0]), (values[1:] - values[0]) / steps

    sample = qmc.LatinHypercube(size, rng=rng).random(_population(size))
    best = sample[np.argmin(evaluate(sample))]
    limits = {"maxiter": 10**9, "maxfun": 10**9}
    minimize(slope, best, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * size, options=limits)


PEERS: dict[str, Callable[[Evaluate, int, np.random.Generator], None]] = {
    "pymoo PSO": _pymoo("PSO"),
    "pymoo DE": _pymoo("DE"),
    "CMA-ES": _cma_es,
    "SciPy DE": _scipy_de,
    "SciPy L-BFGS-B": _l_bfgs_b,
}


def names() -> Sequence[str]:
    """The peers that can run: all of them or none, as the extra is installed or not."""
    return () if missing_packages() else tuple(PEERS)
