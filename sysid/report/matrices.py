"""The matrices of a report: M_SS, K_SS and C with what noise leaves of each entry, or what is open of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.assessment.sensitivity import system_matrices
from sysid.plot.plots import normalised
from sysid.report.html import heat_maps, matrix, no_lines, number, paragraph
from sysid.results.identification import Identification
from sysid.results.tables import half_width
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

ONE_OF_MANY, CHOSEN = "one of many", "as the modal masses were chosen"
_NO_FIT = "of a model that does not fit"
_ENDS_ELSEWHERE = " How far the entries may go is in the result's mass_interval and stiffness_interval."
_ENDS_BELOW = (
    " Below an entry of M_SS and K_SS: from where to where it goes in the models that explain the data and hold what "
    "was stated."
)

Lines = list[list[tuple[str, ...]]]  # below each entry of a matrix


def matrix_tables(it: Identification) -> str:
    """HTML of heat maps and tables of M_SS, K_SS, C and the base's blocks of M."""
    structure, test = it.structure, it.measurement
    n, axes, names = structure.n, test.base_axes or (), it.degrees_of_freedom
    scale = "; masses normalised to 1 kg" if it.facts.unit_mass else ""
    coupling, base = "kg", "kg"
    if not test.translational.all():
        coupling, base = "kg, kg m in columns of a rotation", "kg, kg m, kg m²"
    (M, K, C), M_full = system_matrices(structure), structure.mass
    stds = [it.quick_std(name)[:n, :n] for name in ("mass", "stiffness", "damping")]
    ends = None if it.determined else it.quick_intervals
    label = "" if it.determined or np.all(np.isfinite(stds[0])) else ONE_OF_MANY
    mark = _NO_FIT * (not it.success) or label
    words = (
        "Heat maps: each entry over the root of its two diagonal entries. Tables: entries below 10⁻¹² of a matrix's "
        "largest are round-off, and stand as 0."
    )
    if np.any(np.isfinite(stds)):
        words += " ±: half of the 95 % interval, from the noise of the records; open: the data do not tell."
        words += " It holds for a model that fits: this one does not." * (not it.success)
    lower = list(map(half_widths, (M, K, C), stds))
    if label:
        lower[2] = no_lines(C.shape)  # half-widths about one choice tell less than its mark
        words += _ENDS_ELSEWHERE * (ends is None)
    if ends is not None:
        words += _ENDS_BELOW
        lower[:2] = map(_ranges, (ends.mass, ends.stiffness), lower[:2])
    parts = [
        paragraph(words, "soft"),
        heat_maps(
            {name: normalised(A) for name, A in (("M_SS", M), ("K_SS", K), ("C", C))}, "RdBu_r", -1.0,
            CHOSEN if label else "", label=mark,
        ),
        matrix(M, names, names, f"Mass M_SS, kg{scale}", below=lower[0], label=mark),
        _of_base(M_full[:n, n:], names, axes, f"Coupling mass M_S0, {coupling}{scale}", mark),
        _of_base(M_full[n:, n:], axes, axes, f"Base mass M_00, {base}{scale}", mark),
        matrix(K, names, names, f"Stiffness K_SS, N/m{scale}", below=lower[1], label=mark),
        matrix(
            C, names, names, f"Damping C on the motion relative to the base, N s/m{scale}", below=lower[2], label=mark
        ),
    ]  # fmt: skip
    return "".join(parts)


def _of_base(block: Array, rows: Sequence[str], columns: Sequence[str], caption: str, label: str) -> str:
    """HTML of a block of the base in the mass, (rows, columns); a line where it is zero, as of masses at sensors."""
    return matrix(block, rows, columns, caption, label=label) if block.any() else paragraph(f"{caption}: zero", "soft")


def half_widths(values: Array, std: Array, stated: Array | bool = False) -> Lines:
    """Lines below the entries of a matrix: half of the 95 % interval, or "open"; nothing where it is round-off.

    `stated` tells the entries that were stated. No lines at all where everything is open.
    """
    stated = np.broadcast_to(stated, std.shape)
    lines = no_lines(std.shape)
    if not np.any(np.isfinite(std) | stated):
        return lines
    size = np.sqrt(np.abs(np.diag(values)))
    for i, j in np.ndindex(*std.shape):
        width = width_text(half_width(float(std[i, j]), float(size[i] * size[j])))
        if stated[i, j] or width == "open":
            lines[i][j] = ("stated" if stated[i, j] else "open",)
        elif width != "0":
            lines[i][j] = (f"± {width}",)
    return lines


def width_text(width: str) -> str:
    """A half-width as "110", not "1.1e+02"; words stay."""
    return width if width == "open" else f"{float(width):.6g}"


def stated(it: Identification) -> Array:
    """Which entries of the rigid-body mass were stated, (d, d) of bool."""
    return it.facts.stated_rigid_body


def _ranges(ends: Array, otherwise: Lines) -> Lines:
    """Lines below the entries of a matrix: both ends of their range (2, n, n), or `otherwise` where they look alike."""
    lines = [list(line) for line in otherwise]
    for i, j in np.argwhere(~np.isclose(ends[0], ends[1], rtol=ROUND_OFF, atol=0.0)):
        least, most = (number(end, 3) for end in ends[:, i, j])
        if least == most != "–":
            continue
        bounded = np.isfinite(ends[:, i, j])
        words_of = {
            (True, True): (f"{least} to", most),
            (True, False): (f"from {least}",),
            (False, True): (f"to {most}",),
        }
        lines[i][j] = words_of.get((bool(bounded[0]), bool(bounded[1])), ("any value",))
    return lines
