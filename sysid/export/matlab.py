"""Matrices, modes and state space as variables of a MATLAB file (version 5)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy

from sysid.export.content import deviations_of, matrices_of, names_of, statements
from sysid.results.identification import Identification

PRECISION = "exact: the file holds the 8 bytes of each double-precision number"


def write_matlab(it: Identification, path: Path) -> None:
    """Write M, K, C with deviations, modes, state space, names, and `about`: what the file says of itself, in lines.

    `G` (n_sensors, d): rigid-body motion of the sensors; `f_hz`, `zeta` (m, 1), `Phi` (n_sensors, m), `Gamma` (m, d):
    modes on the fixed base, mass-normalised; `A`, `B`, `Cy`, `D`: from base acceleration to absolute acceleration of
    the sensors; `recovery` (n_sensors, n): degrees of freedom to sensors.
    """
    s, system = it.structure, it.structure.to_state_space()
    variables = {
        **matrices_of(s), **{f"{letter}_std": std for letter, std in deviations_of(it).items()},
        "G": s.rigid_body, "recovery": s.recovery, "f_hz": s.natural_frequencies[:, None],
        "zeta": s.damping_ratios[:, None], "Phi": s.mode_shapes, "Gamma": s.participation,
        "A": system.A, "B": system.B, "Cy": system.C, "D": system.D,
        "determined": it.determined, "success": it.success,
        "dof_names": _cells(names_of(it)), "sensor_names": _cells(it.measurement.sensor_names),
        "about": _cells(statements(it, PRECISION)),
    }  # fmt: skip
    with path.open("wb") as file:
        scipy.io.savemat(file, variables, oned_as="column")


def _cells(texts: tuple[str, ...]) -> np.ndarray:
    """A column of texts, which MATLAB takes as a cell array."""
    column = np.empty((len(texts), 1), dtype=object)
    column[:, 0] = texts
    return column
