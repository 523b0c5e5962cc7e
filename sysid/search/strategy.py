"""Contract of the strategies, where a search ended, and what a start stands for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array
from sysid.finding import Finding, Severity
from sysid.problem.prepared import Prepared
from sysid.search.session import Session
from sysid.structure.structure import Array, Structure

# Counted words of a history, and what their numbers are called in its tree.
_COUNTED = {"states": "state_counts", "refinement_statuses": "refinement_counts"}


@dataclass(frozen=True, eq=False)
class Phase:
    """Where a phase of a search ended.

    Attributes
    ----------
    name : str
        "start", "swarm", "continuation", "local phase" or "Huber's loss" (its rounds together).
    objective : float
    x : (n_variables,)
        The best unknowns then; empty where the phase had none.
    seconds : float
        Since the start of the identification.
    evaluations : int
        Of the phase: candidates, or iterates of a local solver.
    """

    name: str
    objective: float
    x: Array
    seconds: float
    evaluations: int


@dataclass(frozen=True, eq=False)
class History:
    """Phases that ran, one after the other; NaN where a phase did not run.

    The objective counts all that is fitted, base force and further tests too: the root of the sum of all squared
    rows, each record relative and weighed by its noise. The modal strategy has the local phase only, continuation
    start and local phase.

    Attributes
    ----------
    start, swarm, local : float
        Objective of the best candidate after each phase: the Latin hypercube (or the start that was given; of
        continuation the guess), the swarm, the local phase.
    swarm_curve, local_curve : ndarray
        Best objective after each iteration of the swarm, and objective of each local iterate. Where the swarm searched
        responses with widened peaks its curve is theirs, and `start` is NaN. Where modes are free and
        the noise of a force is not stated, IPOPT weighs the force by what free residues leave of it.
    refinement_error : float
        Largest relative difference of a refined eigenvalue (w²) of the swarm's best from the one that was given.
    leaders_tried, leaders_won : int
        Leaders of the swarm that IPOPT refined beside the closed form, and those of them that it left at a lower
        objective; over all swarms.
    refinement_statuses : tuple of (str, int)
        How often IPOPT ended with each status when it refined eigenvalues, of leaders or of every candidate; over all
        swarms.
    states : tuple of (str, int)
        How often the swarm was in each evolutionary state.
    evaluations : int
        Candidates that the swarm evaluated, over all swarms.
    wall_time : float
        s.
    log : tuple of str
        What ran, one line a step.
    restarts : int
        Further swarms after the first.
    phases : tuple of Phase
        In their order, of the swarm that gave the answer.
    """

    start: float = np.nan
    swarm: float = np.nan
    local: float = np.nan
    swarm_curve: Array = field(default_factory=lambda: np.zeros(0))
    local_curve: Array = field(default_factory=lambda: np.zeros(0))
    refinement_error: float = np.nan
    leaders_tried: int = 0
    leaders_won: int = 0
    refinement_statuses: tuple[tuple[str, int], ...] = ()
    states: tuple[tuple[str, int], ...] = ()
    evaluations: int = 0
    wall_time: float = 0.0
    log: tuple[str, ...] = ()
    restarts: int = 0
    phases: tuple[Phase, ...] = ()

    @property
    def refinement_in_words(self) -> str:
        """Counts of IPOPT's refinement of eigenvalues, in words; empty where it did not run."""
        if not self.refinement_statuses:
            return ""
        ended = ", ".join(f"{status} {count}" for status, count in self.refinement_statuses)
        if not self.leaders_tried:
            return f"IPOPT refined {sum(count for _, count in self.refinement_statuses)} candidates ({ended})"
        leaders = f"{self.leaders_tried} leader" + "s" * (self.leaders_tried != 1)
        return f"IPOPT refined {leaders} of the swarm, {self.leaders_won} better than the closed form ({ended})"

    def to_tree(self) -> dict[str, Any]:
        """Give all of it as numbers, arrays and texts; `from_tree` takes them back."""
        phases = [vars(phase) for phase in self.phases]
        tree = {**vars(self), "phases": phases}
        for names, numbers in _COUNTED.items():
            counted = tree[names]
            tree[names] = tuple(name for name, _ in counted)
            tree[numbers] = np.array([number for _, number in counted], dtype=np.int64)
        return tree

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> History:
        """Give the history of a tree that `to_tree` made."""
        given = dict(tree)
        for names, numbers in _COUNTED.items():
            given[names] = tuple(zip(tree[names], given.pop(numbers).tolist(), strict=True))
        return cls(**{**given, "phases": tuple(Phase(**phase) for phase in tree["phases"])})


@dataclass(frozen=True, eq=False)
class Outcome:
    """Where a search ended.

    `x` (n_variables,) stands for the structure; it is None where the modal strategy chose other degrees of freedom than
    the sensors. No other strategy needs to follow where the fit is as `good` as the data let it be, as far as the
    strategy can tell, or where every start ended there (`unanimous`): what is left is then no local minimum's.
    """

    structure: Structure
    x: Array | None
    strategy: str
    success: bool  # of the last solver
    message: str
    history: History
    stopped: BaseException | None = None  # what ended it early
    alternatives: tuple[Array, ...] = ()  # other unknowns that explain the data as well
    good: bool = True
    unanimous: bool = False
    findings: tuple[Finding, ...] = ()  # mistakes and contradictions that were met, and what should be known of it

    def with_note(self, sentence: str) -> Outcome:
        """The same, and a sentence on how it was done."""
        return replace(self, findings=(*self.findings, search_note(sentence)))


def search_note(sentence: str) -> Finding:
    """Finding on how a search was done."""
    return Finding("search", Severity.NOTE, sentence)


class Strategy(Protocol):
    """A way to look for the best unknowns; its fields are its settings."""

    @property
    def name(self) -> str:
        """As ``strategy=`` and results call it."""

    def refusal(self, problem: Prepared, start: ArrayLike | Structure | None) -> str | None:
        """Why "auto" does not take it for a problem; None where it does."""

    def run(self, problem: Prepared, session: Session, start: ArrayLike | Structure | None) -> Outcome:
        """Search; a `DoesNotApplyError` where it cannot be used for the problem."""


class DoesNotApplyError(InputError):
    """A strategy does not apply to a problem; another may."""


class NoStrategyError(InputError):
    """No strategy applies to a problem."""


def as_unknowns(problem: Prepared, start: ArrayLike | Structure) -> Array:
    """Unknowns of a start that the user gave."""
    if isinstance(start, Structure):
        geometry = problem.geometry
        if (start.n, start.n_base, start.n_sensors) != (geometry.n, geometry.d, problem.measurement.n_sensors):
            raise InputError("start: the structure has other degrees of freedom or base directions than the problem")
        return problem.values(start)
    x = finite_array("start", start)
    if x.shape != (problem.n_variables,):
        raise InputError(
            f"start has shape {x.shape}; ({problem.n_variables},) finite unknowns, or a Structure, is needed"
        )
    return x
