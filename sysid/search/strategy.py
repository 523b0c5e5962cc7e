"""What the strategies have in common: their contract, where a search ended, and what a start stands for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array
from sysid.problem.problem import Problem
from sysid.search.session import Session
from sysid.structure.structure import Array, Structure

HUBER = "Huber's loss"  # the phase of its rounds


@dataclass(frozen=True, eq=False)
class Phase:
    """Where a phase of a search ended.

    Attributes
    ----------
    name : str
        "start", "swarm", "refinement", "continuation", "local phase" or "Huber's loss" (its rounds together).
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
    """What ran, phase by phase; NaN where a phase did not run.

    The objective counts all that is fitted, base force and further tests too: the root of the sum of all squared
    rows, each record relative and weighed by its noise. The modal strategy has the local phase only, continuation
    start and local phase.

    Attributes
    ----------
    start, swarm, refinement, local : float
        Objective of the best candidate after each phase: the Latin hypercube (or the start that was given; of
        continuation the guess), the swarm, the eigenvalue refinement, the local phase.
    swarm_curve, local_curve : ndarray
        Best objective after each iteration of the swarm, and objective of each local iterate. Where the swarm searched
        responses with widened peaks its curve is theirs, and `start` is NaN. Where modes are free and
        the noise of a force is not stated, IPOPT weighs the force by what free residues leave of it.
    refinement_error : float
        Largest relative difference of a refined eigenvalue (w²) from the one that was given.
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
        In their order, of the swarm that gave the answer; none in results of older versions.
    """

    start: float = np.nan
    swarm: float = np.nan
    refinement: float = np.nan
    local: float = np.nan
    swarm_curve: Array = field(default_factory=lambda: np.zeros(0))
    local_curve: Array = field(default_factory=lambda: np.zeros(0))
    refinement_error: float = np.nan
    states: tuple[tuple[str, int], ...] = ()
    evaluations: int = 0
    wall_time: float = 0.0
    log: tuple[str, ...] = ()
    restarts: int = 0
    phases: tuple[Phase, ...] = ()

    def to_tree(self) -> dict[str, Any]:
        """Give all of it as numbers, arrays and texts; `from_tree` takes them back."""
        names, counts = tuple(name for name, _ in self.states), [count for _, count in self.states]
        phases = [vars(phase) for phase in self.phases]
        return {**vars(self), "states": names, "state_counts": np.array(counts, dtype=np.int64), "phases": phases}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> History:
        """Give the history of a tree that `to_tree` made."""
        given = dict(tree)
        counts = given.pop("state_counts").tolist()
        phases = tuple(Phase(**phase) for phase in given.pop("phases", ()))  # files made before have none
        return cls(**{**given, "states": tuple(zip(tree["states"], counts, strict=True)), "phases": phases})


@dataclass(frozen=True, eq=False)
class Outcome:
    """Where a search ended.

    Attributes
    ----------
    structure : Structure
    x : (n_variables,) or None
        The problem's unknowns that stand for the structure; None where the modal strategy chose other degrees of
        freedom than the sensors.
    strategy : str
    success : bool
        Of the last solver.
    message : str
    history : History
    stopped : BaseException or None
        What ended it early.
    remarks : tuple of str
        What the user should know of how it was done.
    alternatives : tuple of (n_variables,)
        Other unknowns that explain the data as well.
    good : bool
        The fit is as good as the data let it be, as far as the strategy can tell: no other needs to follow.
    unanimous : bool
        Every start ended there: what is left is no local minimum's, and no other strategy needs to follow.
    doubts : tuple of str
        Stated values that contradict the records.
    mistakes : tuple of str
        What is wrong with the records or with what is stated of them, by name; it explains whatever else speaks against
        the fit.
    """

    structure: Structure
    x: Array | None
    strategy: str
    success: bool
    message: str
    history: History
    stopped: BaseException | None = None
    remarks: tuple[str, ...] = ()
    alternatives: tuple[Array, ...] = ()
    good: bool = True
    unanimous: bool = False
    doubts: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()


class Strategy(Protocol):
    """A way to look for the best unknowns; its fields are its settings."""

    @property
    def name(self) -> str:
        """As ``strategy=`` and results call it."""

    def refusal(self, problem: Problem, start: ArrayLike | Structure | None) -> str | None:
        """Why "auto" does not take it for a problem; None where it does."""

    def run(self, problem: Problem, session: Session, start: ArrayLike | Structure | None) -> Outcome:
        """Search.

        Raises
        ------
        DoesNotApplyError
            Where the strategy cannot be used for the problem.
        InputError, SolverError
            Where data or models are wrong, or nothing came out.
        """


class DoesNotApplyError(InputError):
    """A strategy does not apply to a problem; another may."""


class NoStrategyError(InputError):
    """No strategy applies to a problem."""


def as_unknowns(problem: Problem, start: ArrayLike | Structure) -> Array:
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
