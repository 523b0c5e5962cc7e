"""The matrices of a report: M_SS, K_SS and C with what noise leaves of each entry, or what is open of it."""

from __future__ import annotations

import numpy as np

from sysid import plot
from sysid.report.html import matrix, number, paragraph, picture
from sysid.results.identification import Identification
from sysid.results.summary import half_width
from sysid.structure.structure import Array

ONE_OF_MANY, CHOSEN = "one of many", "as the modal masses were chosen"
SAME = 1e-9  # of a value: a smaller difference is round-off

Lines = list[list[tuple[str, ...]]]  # below each entry of a matrix


def matrices(it: Identification) -> str:
    """HTML of heat maps and tables of M_SS, K_SS, C and the base's blocks of M."""
    structure, test = it.structure, it.measurement
    n, axes = structure.n, test.base_axes or ()
    names = it.degrees_of_freedom
    scale = "; masses normalised to 1 kg" if it.problem.unit_mass else ""
    turns = not test.translational.all()
    coupling = "kg, kg m in columns of a rotation" if turns else "kg"
    base = "kg, kg m, kg m²" if turns else "kg"
    M, K, C = structure.mass, structure.stiffness, structure.damping
    u, ends = it.quick_uncertainty, None if it.determined else it.quick_intervals
    label = "" if it.determined or (u is not None and np.all(np.isfinite(u.mass))) else ONE_OF_MANY
    words = (
        "Heat maps: each entry over the root of its two diagonal entries. Tables: entries below 10⁻¹² of a matrix's "
        "largest are round-off, and stand as 0."
    )
    lower: list[Lines | None] = [None, None, None]
    if u is not None:
        lower = [half_widths(a, std) for a, std in ((M[:n, :n], u.mass), (K[:n, :n], u.stiffness), (C, u.damping))]
    if any(lines is not None for lines in lower):
        words += " ±: half of the 95 % interval, from the noise of the records; open: the data do not tell."
    if label:
        lower[2] = None  # half-widths about one choice tell less than its mark
    if ends is not None:
        lower[:2] = [_ranges(own, lines) for own, lines in zip((ends.mass, ends.stiffness), lower[:2], strict=True)]
    if label and ends is not None:
        words += (
            " Below an entry of M_SS and K_SS: the least … and the … greatest value that it takes in any model that "
            "explains the data and holds what was stated."
        )
    elif label:
        words += " How far the entries may go is in the result's mass_interval and stiffness_interval."
    parts = [
        paragraph(words, "soft"),
        picture(
            plot.matrices(it),
            "heat maps of the mass, stiffness and damping matrices",
            CHOSEN if label else "",
            colours=None,
            label=label,
        ),
        matrix(M[:n, :n], names, names, f"Mass M_SS, kg{scale}", below=lower[0], label=label),
        matrix(M[:n, n:], names, axes, f"Coupling mass M_S0, {coupling}{scale}", label=label),
        matrix(M[n:, n:], axes, axes, f"Base mass M_00, {base}{scale}", label=label),
        matrix(K[:n, :n], names, names, f"Stiffness K_SS, N/m{scale}", below=lower[1], label=label),
        matrix(
            C, names, names, f"Damping C on the motion relative to the base, N s/m{scale}", below=lower[2], label=label
        ),
    ]
    return "".join(parts)


def half_widths(values: Array, std: Array, stated: Array | None = None) -> Lines | None:
    """Lines below the entries of a matrix: half of the 95 % interval, or "open"; nothing where it is round-off.

    None where all is open.
    """
    stated = np.zeros(std.shape, dtype=bool) if stated is None else stated
    if not np.any(np.isfinite(std) | stated):
        return None
    size = np.sqrt(np.abs(np.diag(values)))
    scale = np.outer(size, size)
    lines: Lines = [[()] * std.shape[1] for _ in std]
    for i, j in np.ndindex(*std.shape):
        width = half_width(float(std[i, j]), float(scale[i, j]))
        if stated[i, j]:
            lines[i][j] = ("stated",)
        elif width != "0":
            lines[i][j] = (width if width == "open" else f"± {width}",)
    return lines


def stated(it: Identification) -> Array:
    """Which entries of the rigid-body mass were stated, (d, d) of bool."""
    totals, d = it.problem.formulation.mass.totals, it.structure.n_base
    if totals is None or totals.kind != "rigid_body":
        return np.zeros((d, d), dtype=bool)
    return np.ones((d, d), dtype=bool) if totals.values.ndim == 2 else np.eye(d, dtype=bool)


def _ranges(ends: Array, otherwise: Lines | None) -> Lines:
    """Lines below the entries of a matrix: both ends of their range (2, n, n), or `otherwise` where they are one."""
    n = ends.shape[1]
    lines: Lines = [[()] * n for _ in range(n)] if otherwise is None else [list(line) for line in otherwise]
    for i, j in np.ndindex(n, n):
        low, high = ends[:, i, j]
        if not np.isclose(low, high, rtol=SAME, atol=0.0):
            least, most = (number(end, 3) if np.isfinite(end) else "unbounded" for end in (low, high))
            lines[i][j] = (f"{least} …", f"… {most}")
    return lines
