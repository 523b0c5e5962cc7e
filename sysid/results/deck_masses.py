"""The masses of a lumped model, sensor by sensor, for summary and report."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.results.answer import Answer

_MOST = 6  # masses that are told


class DeckMass(NamedTuple):
    """A mass on a sensor, kg, and its standard deviation; NaN where it is `one_of_many` or not computed."""

    name: str
    mass: float
    std: float
    one_of_many: bool


def deck_masses(it: Answer) -> tuple[DeckMass, ...]:
    """The diagonal of M_SS of a lumped model, where it is short."""
    n = it.structure.n
    if not it.facts.mass_is_lumped or n > _MOST:
        return ()
    masses, std = np.diag(it.structure.mass)[:n], np.diag(it.quick_std("mass"))[:n]
    many = np.isnan(std) & (it.quick_uncertainty is not None)
    return tuple(map(DeckMass, it.degrees_of_freedom, masses.tolist(), std.tolist(), many.tolist()))
