"""What goes into an export, and the Craig-Bampton form with the base's degrees of freedom first."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np

from sysid.errors import shown_plainly
from sysid.results.identification import Identification
from sysid.results.version import __version__
from sysid.structure.structure import Array, Structure
from sysid.structure.superelement import CraigBampton

_UNITS = {"M": ("kg", "kg m", "kg m2"), "K": ("N/m", "N", "N m"), "C": ("N s/m", "N s", "N s m")}


def matrices_of(structure: Structure) -> dict[str, Array]:
    """M, K and C, (n + d, n + d) each, the structure's degrees of freedom first.

    C is ``[I, -G]' C_SS [I, -G]``: zero in a rigid-body motion.
    """
    relative = np.hstack([np.eye(structure.n), -structure.rigid_body_dofs])
    return {"M": structure.mass, "K": structure.stiffness, "C": relative.T @ structure.damping @ relative}


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


def entry_unit(letter: str, row: bool | None, column: bool | None) -> str:
    """Unit of an entry of M, K or C by whether row and column are rotations; "" where one is not known."""
    return "" if row is None or column is None else _UNITS[letter][row + column]


def rotations_of(it: Identification) -> tuple[bool | None, ...]:
    """Which rows of the matrices are rotations; None for a coordinate that no sensor records, which may be anything."""
    axes = [sensor.axis for sensor in it.measurement.sensors or ()] or [""] * it.structure.n_sensors
    turns = [isinstance(axis, str) and "r" in axis for axis in axes]
    turned = (turns[j] if j >= 0 else None for j in it.structure.dof_sensors)
    return (*turned, *(axis.startswith("r") for axis in it.measurement.base_axes or ()))


_WORTH = {
    "no fit": "NO FIT: these matrices do not explain the records as they should",
    "doubtful": "DOUBTFUL: something speaks against this model, so that these matrices may be wrong",
    "determined": "determined: data and stated model fix every entry of the matrices",
    "one of many": "ONE OF MANY: other matrices explain the records as well, or noise leaves entries open; "
    "frequencies, damping ratios and responses to base motion hold",
}
_INTERRUPTED = "the search was interrupted, these are the best matrices until then; "


def reliability(it: Identification) -> str:
    """Judgement of the matrices, in one line that names the statements which tell why."""
    parts = (("against", it.contradictions), ("open", it.open_findings))
    why = " and ".join(f"'{word}'" for word, findings in parts if findings)
    return _INTERRUPTED * it.interrupted + _WORTH[it.judgement] + (f"; see {why}" if why else "")


def statements(it: Identification, precision: str) -> tuple[str, ...]:
    """Sentences of every file: origin, judgement, what is against it and open, units, order of rows, precision."""
    structure, base = it.structure, " ".join(it.measurement.base_axes or ())
    found = [
        f"written by sysid {__version__} on {datetime.now().astimezone().isoformat(timespec='seconds')}",
        f"problem: {it.recipe.title if it.recipe else 'of a script'}; strategy {it.strategy}; seed {it.seed}",
        f"judgement: {reliability(it)}; relative residual {it.residual:.3g}",
        f"search: {it.message}",
        *(f"fixed by: {text}" for text in it.closed_by),
        *(f"assumed: {text}" for text in it.facts.assumed),
        *(f"against: {one}" for one in it.contradictions),
        *(f"open: {one}" for one in it.open_findings),
        "units: kg, m, s, N, rad; frequencies in Hz; damping ratios are fractions of critical damping",
        f"rows and columns: {structure.n} of the structure, then {structure.n_base} of the base ({base}); motions are "
        "absolute, and moments refer to the point at which the base motion is given",
        "order: " + ", ".join(f"{at} {name}" for at, name in enumerate(names_of(it), 1)),
        "damping acts on the motion relative to the base",
        f"precision: {precision}",
    ]
    if structure.residual.count:
        f = ", ".join(f"{one:.6g}" for one in structure.residual.natural_frequencies)
        found.append(
            f"residual modes ({f} Hz): no modes of the structure; in the band, up to {it.measurement.freq[-1]:.6g} Hz, "
            "they answer like all modes beyond it; the Craig-Bampton form and the state space hold them, M, K, C do not"
        )
    if it.facts.unit_mass:
        found.append("all masses, stiffness and damping are relative: no mass was stated, and they are scaled to 1 kg")
    return tuple(shown_plainly(" ".join(text.split())) for text in found)


def one_line_each(texts: Sequence[str], width: int, mark: str = "") -> list[str]:
    """Sentences cut into lines of at most `width` characters of ASCII, each behind `mark`."""
    import textwrap

    plain = (text.encode("ascii", "replace").decode() for text in texts)
    return [line for t in plain for line in textwrap.wrap(t, width, initial_indent=mark, subsequent_indent=mark + "  ")]


def superelement_of(structure: Structure) -> CraigBampton:
    """`Structure.to_craig_bampton` with the base first: rows and columns are of [u_0; q], residual modes the last of q.

    No term is left out: the base is statically determinate, so that its constraint modes are the rigid-body motions,
    which strain nothing.
    """
    form = structure.to_craig_bampton()
    n = len(form.mass) - structure.n_base
    order = np.r_[n : n + structure.n_base, :n]
    both = np.ix_(order, order)
    return CraigBampton(form.mass[both], form.stiffness[both], form.damping[both], form.recovery[:, order])
