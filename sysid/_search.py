"""What the strategies share: where a search ended, and what a start stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError
from sysid.identification import History
from sysid.problem import Problem
from sysid.structure import Array, Structure


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
    rivals : tuple of (n_variables,)
        Other unknowns that explain the data as well.
    """

    structure: Structure
    x: Array | None
    strategy: str
    success: bool
    message: str
    history: History
    stopped: BaseException | None = None
    remarks: tuple[str, ...] = ()
    rivals: tuple[Array, ...] = ()


def as_unknowns(problem: Problem, start: ArrayLike | Structure) -> Array:
    """Unknowns of a start that the user gave."""
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
