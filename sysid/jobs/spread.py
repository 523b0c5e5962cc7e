"""Spread of an answer over many draws of noise, beside the linear one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.errors import InputError
from sysid.jobs.job import JobResult
from sysid.results.identification import Identification
from sysid.results.tables import labelled, quantities
from sysid.structure.thresholds import LIKELY


@dataclass(frozen=True)
class Spread:
    """A quantity in many draws beside its linear uncertainty.

    Attributes
    ----------
    name : str
    value : float
        As identified.
    std : float
        Standard deviation to first order; NaN where it is not known.
    drawn : float
        Standard deviation of the draws about `value`.
    inside : float
        Share of the draws within 1.96 of `std` about `value`: 0.95 where the linear interval is right.
    """

    name: str
    value: float
    std: float
    drawn: float
    inside: float

    @property
    def ratio(self) -> float:
        """Of both standard deviations, 1 where the linear one is right; NaN where it is not known."""
        return self.drawn / self.std if self.std > 0 else np.nan


def spreads(result: Identification, ends: Sequence[JobResult]) -> list[Spread]:
    """Frequencies, damping ratios and unknowns of a result in the draws that succeeded.

    Raises
    ------
    InputError
        Where fewer than two draws did.
    """
    found = [end for end in ends if end.success]
    if len(found) < 2:
        raise InputError(f"{len(found)} of {len(ends)} draws have a result; two are needed for a spread")
    u = result.uncertainty
    stds = labelled(u.natural_frequencies, u.damping_ratios, u.variables)
    structures = [result.problem.structure(end.x) for end in found]
    draws = [quantities(replace(result, x=end.x, structure=s)) for end, s in zip(found, structures, strict=True)]
    rows = []
    for name, value in quantities(result).items():
        off, std = np.array([draw[name] for draw in draws]) - value, stds.get(name, np.nan)
        inside = float(np.mean(np.abs(off) <= LIKELY * std)) if np.isfinite(std) else np.nan
        rows.append(Spread(name, value, std, float(np.sqrt(np.mean(off**2))), inside))
    return rows
