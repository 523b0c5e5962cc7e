"""M, K and C with deviations as tables: comma-separated values, and variables of a MATLAB file (version 5)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import scipy

from sysid.export.content import Content, entry_unit, matrices_of

COLUMNS = ("matrix", "row", "column", "value", "deviation", "unit", "row_name", "column_name")
_EMPTY = (
    "an empty deviation: the entry is open, belongs to the base, or its deviation was not computed",
    "an empty unit: row or column is a coordinate that no sensor records, in the unit that the model gives it",
)


def write_text(content: Content, about: tuple[str, ...], path: Path) -> None:
    """Write one entry a row; what the file says of itself stands above in lines that begin with "#".

    Rows and columns are counted from 1. Numbers are written in the fewest digits that give the same number again.
    """
    names, turned, deviations = content.names, content.rotations, content.deviations
    with path.open("w", newline="", encoding="utf-8") as file:
        file.writelines(f"# {text}\n" for text in (*about, *_EMPTY))
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for letter, matrix in matrices_of(content.structure).items():
            for (i, j), value in np.ndenumerate(matrix):
                std = deviations[letter][i, j]
                known = repr(float(std)) if np.isfinite(std) else ""
                described = entry_unit(letter, turned[i], turned[j]), names[i], names[j]
                table.writerow((letter, i + 1, j + 1, repr(float(value)), known, *described))


def write_matlab(content: Content, about: tuple[str, ...], path: Path) -> None:
    """Write M, K, C with deviations, modes, state space, names, and `about`: what the file says of itself, in lines.

    `G` (n_sensors, d): rigid-body motion of the sensors; `f_hz`, `zeta` (m, 1), `Phi` (n_sensors, m), `Gamma` (m, d):
    modes on the fixed base, mass-normalised; `f_hz_residual` and so on (r of them): residual modes, beside; `A`, `B`,
    `Cy`, `D`: from base acceleration to absolute acceleration of the sensors, residual modes included; `recovery`
    (n_sensors, n): degrees of freedom to sensors.
    """
    it, s, system = content.it, content.structure, content.structure.to_state_space()
    beyond = s.residual
    variables = {
        **matrices_of(s), **{f"{letter}_std": std for letter, std in content.deviations.items()},
        "G": s.rigid_body, "recovery": s.recovery, "f_hz": s.natural_frequencies[:, None],
        "zeta": s.damping_ratios[:, None], "Phi": s.mode_shapes, "Gamma": s.participation,
        "f_hz_residual": beyond.natural_frequencies[:, None], "zeta_residual": beyond.damping_ratios[:, None],
        "Phi_residual": beyond.shapes, "Gamma_residual": beyond.participation,
        "A": system.A, "B": system.B, "Cy": system.C, "D": system.D,
        "determined": it.determined, "success": it.success,
        "dof_names": _cells(content.names), "sensor_names": _cells(content.sensor_names),
        "about": _cells(about),
    }  # fmt: skip
    with path.open("wb") as file:
        scipy.io.savemat(file, variables, oned_as="column")


def _cells(texts: tuple[str, ...]) -> np.ndarray:
    """A column of texts, which MATLAB takes as a cell array."""
    column = np.empty((len(texts), 1), dtype=object)
    column[:, 0] = texts
    return column
