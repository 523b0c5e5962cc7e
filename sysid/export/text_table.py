"""M, K and C as a table of comma-separated values, one entry a row, with its deviation."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from sysid.export.content import deviations_of, entry_unit, matrices_of, names_of, rotations_of, statements
from sysid.results.identification import Identification

PRECISION = "exact: each number has the up to 17 digits that give the same double-precision number when read"
COLUMNS = ("matrix", "row", "column", "value", "deviation", "unit", "row_name", "column_name")
_EMPTY = (
    "an empty deviation: the entry is open, belongs to the base, or its deviation was not computed",
    "an empty unit: row or column is a coordinate that no sensor records, in the unit that the model gives it",
)


def write_text_table(it: Identification, path: Path) -> None:
    """Write the table; what the file says of itself stands above it in lines that begin with "#".

    Rows and columns are counted from 1. Numbers are written in the fewest digits that give the same number again.
    """
    names, turned, deviations = names_of(it), rotations_of(it), deviations_of(it)
    with path.open("w", newline="", encoding="utf-8") as file:
        file.writelines(f"# {text}\n" for text in (*statements(it, PRECISION), *_EMPTY))
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for letter, matrix in matrices_of(it.structure).items():
            for (i, j), value in np.ndenumerate(matrix):
                std = deviations[letter][i, j]
                known = repr(float(std)) if np.isfinite(std) else ""
                described = entry_unit(letter, turned[i], turned[j]), names[i], names[j]
                table.writerow((letter, i + 1, j + 1, repr(float(value)), known, *described))
