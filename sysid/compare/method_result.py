"""Result of one method of a comparison, and the recording of its way there."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import groupby
from typing import Any

import numpy as np

from sysid.results.phases import matrix_errors
from sysid.search.session import Progress
from sysid.structure.structure import Array, Structure

MATRICES = ("M", "K", "C")


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
    if reference is None or not _alike(structure.recovery, reference.recovery):
        return MethodResult.errors
    return tuple(100 * error for error in matrix_errors(structure, reference))


def _alike(recovery: Array, other: Array) -> bool:
    return recovery.shape == other.shape and np.allclose(recovery, other)
