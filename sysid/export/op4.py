"""Matrices and the Craig-Bampton superelement as a binary OUTPUT4 file of Nastran, written by pyYeti."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sysid.export.content import matrices_of, one_line_each, statements, superelement_of
from sysid.results.identification import Identification
from sysid.structure.structure import Array

PRECISION = "exact: the file holds the 8 bytes of each double-precision number"
_WIDTH = 72


def write_op4(it: Identification, path: Path) -> None:
    """Write M, K, C; MCB, KCB, CCB, RCB; DETERMND and NOTE.

    M, K and C have the structure's degrees of freedom first, those of the base last. MCB, KCB and CCB have those of the
    base first, then the modal coordinates, and RCB takes these to the absolute motion of the sensors. DETERMND is 1
    where data and stated model fix every entry, else 0. The format has no place for text: NOTE holds the characters of
    what the file says of itself as numbers (ASCII), one line a row: ``char(NOTE)`` in MATLAB.
    """
    from pyyeti.nastran import op4

    form = superelement_of(it.structure)
    matrices = {
        **matrices_of(it.structure),
        "MCB": form.mass, "KCB": form.stiffness, "CCB": form.damping, "RCB": form.recovery,
        "DETERMND": np.array([[float(it.determined)]]),
        "NOTE": characters(one_line_each(statements(it, PRECISION), _WIDTH)),
    }  # fmt: skip
    op4.write(str(path), list(matrices), list(matrices.values()), sparse="dense")


def characters(lines: Sequence[str]) -> Array:
    """ASCII codes of lines of text, (lines, 72), blanks at the end of each."""
    return np.array([[float(ord(letter)) for letter in line.ljust(_WIDTH)] for line in lines])
