"""What every exported file holds: the matrices on all degrees of freedom, their names and units, and what is open."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime

import numpy as np

from sysid.results.identification import Identification
from sysid.results.version import __version__
from sysid.structure.structure import Array, Structure

_UNITS = {"M": ("kg", "kg m", "kg m2"), "K": ("N/m", "N", "N m"), "C": ("N s/m", "N s", "N s m")}


def damping_of(structure: Structure) -> Array:
    """Damping on all degrees of freedom, (n + d, n + d): ``[I, -G]' C [I, -G]``, zero in a rigid-body motion."""
    relative = np.hstack([np.eye(structure.n), -structure.rigid_body_dofs])
    return relative.T @ structure.damping @ relative


def matrices_of(structure: Structure) -> dict[str, Array]:
    """M, K and C, (n + d, n + d) each, the structure's degrees of freedom first."""
    return {"M": structure.mass, "K": structure.stiffness, "C": damping_of(structure)}


def deviations_of(it: Identification) -> dict[str, Array]:
    """Standard deviations of `matrices_of`; NaN where they are not known, as in all rows and columns of the base."""
    n, size = it.structure.n, len(it.structure.mass)
    found = {}
    for letter, name in (("M", "mass"), ("K", "stiffness"), ("C", "damping")):
        found[letter] = np.full((size, size), np.nan)
        found[letter][:n, :n] = it.quick_std(name)[:n, :n]
    return found


def names_of(it: Identification) -> tuple[str, ...]:
    """Names of the rows of the matrices: the structure's degrees of freedom, then "base x" and so on."""
    return (*it.degrees_of_freedom, *(f"base {axis}" for axis in it.measurement.base_axes or ()))


def unit(letter: str, rotations: int) -> str:
    """Unit of an entry of M, K or C of which so many of row and column are rotations."""
    return _UNITS[letter][rotations]


def rotations_of(it: Identification) -> tuple[bool, ...]:
    """Which rows of the matrices are rotations."""
    sensors, at = it.measurement.sensors, it.structure.dof_sensors
    axes = [sensors[j].axis if sensors is not None and j >= 0 else "" for j in at]
    turned = (isinstance(axis, str) and re.search("r", axis) is not None for axis in axes)
    return (*turned, *(axis.startswith("r") for axis in it.measurement.base_axes or ()))


JUDGED = {
    "no fit": "NO FIT: the search did not succeed, so these matrices do not explain the test",
    "determined": "determined: data and stated model fix every entry of the matrices",
    "one of many": "ONE OF MANY: other matrices explain the test as well, or noise leaves entries open: see 'open'",
}


def statements(it: Identification, precision: str) -> tuple[str, ...]:
    """Sentences that go into every file: origin, judgement, what is open, units, order of the rows, precision."""
    structure, base = it.structure, " ".join(it.measurement.base_axes or ())
    found = [
        f"written by sysid {__version__} on {datetime.now().astimezone().isoformat(timespec='seconds')}",
        f"problem: {it.recipe.title if it.recipe else 'of a script'}; strategy {it.strategy}; seed {it.seed}",
        f"judgement: {JUDGED[it.judgement]}; relative residual {it.residual:.3g}",
        f"search: {it.message}",
        *(f"fixed by: {text}" for text in it.closed_by),
        *(f"open: {text}" for text in it.undetermined),
        "units: kg, m, s, N, rad; frequencies in Hz; damping ratios are fractions of critical damping",
        f"rows and columns: {structure.n} of the structure, then {structure.n_base} of the base ({base}); motions are "
        "absolute, and moments refer to the point at which the base motion is given",
        "order: " + ", ".join(f"{at} {name}" for at, name in enumerate(names_of(it), 1)),
        "damping acts on the motion relative to the base",
        f"precision: {precision}",
    ]
    if it.problem.unit_mass:
        found.append("all masses, stiffness and damping are relative: no mass was stated, and they are scaled to 1 kg")
    return tuple(" ".join(text.split()) for text in found)


def one_line_each(texts: Sequence[str], width: int, mark: str = "") -> list[str]:
    """Sentences cut into lines of at most `width` characters of ASCII, each behind `mark`."""
    import textwrap

    plain = (text.encode("ascii", "replace").decode() for text in texts)
    return [line for t in plain for line in textwrap.wrap(t, width, initial_indent=mark, subsequent_indent=mark + "  ")]
