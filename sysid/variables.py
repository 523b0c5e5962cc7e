"""The unknowns of an identification problem: named, shaped, bounded, scaled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.structure import Array


@dataclass(frozen=True, eq=False)
class Variable:
    """A block of scalar unknowns.

    Parameters
    ----------
    name : str
    lower, upper : ndarray, shape (size,)
        The search space; equal where an entry is known.
    unit : str
    sampling : callable, optional
        CasADi expression of the swarm's coordinates (size,) to the variable's, both in
        [lower, upper]: where the swarm had better search another distribution than the uniform
        one (eq. 18 of the paper). Gradient methods never see it.
    unsampling : callable, optional
        Its inverse on numbers, shape (size,) to (size,).
    """

    name: str
    lower: Array
    upper: Array
    unit: str = ""
    sampling: Callable[[ca.SX], ca.SX] | None = None
    unsampling: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        lower, upper = np.atleast_1d(np.asarray(self.lower, float)), np.atleast_1d(np.asarray(self.upper, float))
        if lower.shape != upper.shape or lower.ndim != 1:
            raise InputError(f"variable {self.name}: bounds {lower.shape} and {upper.shape} disagree")
        if not (np.all(np.isfinite(lower)) and np.all(np.isfinite(upper)) and np.all(lower <= upper)):
            raise InputError(f"variable {self.name}: bounds must be finite with lower <= upper")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    @property
    def size(self) -> int:
        """Number of scalar unknowns."""
        return int(self.lower.size)


def split(variables: Sequence[Variable], x: ca.SX | Array) -> list:
    """Cut a vector of all unknowns into one piece a variable."""
    ends = np.cumsum([0, *(variable.size for variable in variables)])
    return [x[int(a) : int(b)] for a, b in pairwise(ends)]
