"""Pictures of an identification, for notebooks and for the report.

Each function draws into the axes that it is given and returns them; without, it makes a figure and
returns that. The figures do not belong to pyplot: nothing stays open, no display is needed, and a
notebook shows the one that a cell ends with. ``sysid.plot.mac(result).savefig("mac.png")`` writes one.

Measured is thin and dark, identified dashed and coloured above it, their difference faint.
"""

from sysid.plot.comparison import comparison, minima
from sysid.plot.plots import (
    amplitude,
    base_force,
    base_forces,
    cmif,
    convergence,
    effective_masses,
    mac,
    matrices,
    mode_shapes,
    overview,
    responses,
    stabilisation,
    transmissibility,
)

__all__ = [
    "amplitude", "base_force", "base_forces", "cmif", "comparison", "convergence", "effective_masses", "mac",
    "matrices", "minima", "mode_shapes", "overview", "responses", "stabilisation", "transmissibility",
]  # fmt: skip
