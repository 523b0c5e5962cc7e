"""The swarm's constants, in one immutable object, and checks of arguments."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, as_float, whole_number

FloatArray = NDArray[np.float64]


def checked_costs(costs: ArrayLike, n_rows: int, origin: str) -> FloatArray:
    """Return the costs as an array of floats; `origin` follows "The costs" in an error.

    Raises
    ------
    InputError
        If they are not `n_rows` real numbers in one dimension.
    """
    values = np.asarray(costs)
    if values.shape != (n_rows,):
        raise InputError(
            f"The costs {origin} have shape {values.shape} for {n_rows} rows; give one a row, shape ({n_rows},)."
        )
    if values.dtype.kind not in "biuf":
        raise InputError(
            f"The costs {origin} have type {values.dtype}; give real numbers, such as the norm of a residual."
        )
    return values.astype(float)


def checked_rows(rows: ArrayLike, shape: tuple[int, ...], origin: str) -> FloatArray:
    """Return rows as finite floats; `origin` follows "The rows" in an error.

    Raises
    ------
    InputError
        If their shape is another, or one of their numbers is not finite.
    """
    values = np.asarray(rows, dtype=float)
    if values.shape != shape:
        raise InputError(f"The rows {origin} have shape {values.shape}; give one a row that was asked for, {shape}.")
    if not np.isfinite(values).all():
        raise InputError(f"The rows {origin} are not all finite; leave a row that cannot be repaired as it was.")
    return values


@dataclass(frozen=True, kw_only=True)
class SwarmSettings:
    """Constants of the adaptive swarm; the defaults are those of the sources.

    Attributes
    ----------
    max_velocity : float
        Largest step of a particle in one iteration, in parts of a variable's range. Essential: without it
        c1 + c2 = 4 is unstable in mean square.
    inertia_b1, inertia_b2 : float
        Constants of the inertia weight (Cerini et al. 2024, eq. 11).
    acceleration_start : float
        c1 and c2 at the start (Zhan et al. 2009).
    acceleration_lower, acceleration_upper : float
        Interval to which c1 and c2 are clamped.
    acceleration_sum : float
        Largest c1 + c2.
    acceleration_step_lower, acceleration_step_upper : float
        The step of c1 and c2 is uniform between these.
    elitist_sigma_start, elitist_sigma_end : float
        Standard deviation of elitist learning at the start and end of the run, in parts of the range.
    guides : int
        Above 0, the social term of eq. 7 draws each particle to the mean of the own bests of so many particles, instead
        of to the global best; they are drawn anew for each particle and iteration, independently, from the best ones.
    guide_share : float
        Part of the swarm that they are drawn from, in (0, 1].

    Raises
    ------
    InputError
        If a number is negative or not finite, an upper number lies below its lower one, `guides` is not whole, or
        `guide_share` is 0 or above 1.
    """

    max_velocity: float = 0.4
    inertia_b1: float = 0.3
    inertia_b2: float = 0.2
    acceleration_start: float = 2.0
    acceleration_lower: float = 1.5
    acceleration_upper: float = 2.5
    acceleration_sum: float = 4.0
    acceleration_step_lower: float = 0.05
    acceleration_step_upper: float = 0.1
    elitist_sigma_start: float = 1.0
    elitist_sigma_end: float = 0.1
    guides: int = 0
    guide_share: float = 0.25

    def __post_init__(self) -> None:
        for field in fields(self):
            as_float(f"SwarmSettings.{field.name}", getattr(self, field.name), "a finite number >= 0", at_least=0)
        if self.max_velocity == 0:
            raise InputError("SwarmSettings.max_velocity is 0, so no particle could move; give a number above zero.")
        whole_number("SwarmSettings.guides", self.guides, at_least=0)
        if not 0 < self.guide_share <= 1:
            raise InputError(f"SwarmSettings.guide_share is {self.guide_share!r}; give a part of the swarm, in (0, 1].")
        for name in ("acceleration", "acceleration_step"):
            lower, upper = getattr(self, f"{name}_lower"), getattr(self, f"{name}_upper")
            if lower > upper:
                raise InputError(
                    f"SwarmSettings.{name}_lower = {lower} is above {name}_upper = {upper}; exchange the two."
                )
