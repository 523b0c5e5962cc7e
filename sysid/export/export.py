"""The format of an exported file by its ending, and the file whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sysid.errors import InputError, flag, instance, needed, path_of
from sysid.export.content import Content, statements
from sysid.export.other_programs import write_dmig, write_op4, write_uff55
from sysid.export.tables import write_matlab, write_text
from sysid.results.identification import Identification
from sysid.results.storage import atomically


@dataclass(frozen=True)
class Format:
    """A format, its writer, and what its files can hold."""

    write: Callable[[Content, tuple[str, ...], Path], None]  # of the sentences of the file too
    name: str
    note: str  # where its files say what they are worth
    precision: str
    deviations: bool = False  # whether it has a place for them
    needs: str = ""  # a package, of the extra
    extra: str = ""


_BYTES = "exact: the file holds the 8 bytes of each double-precision number"
_DIGITS = "exact: each number has the up to 17 digits that give the same double-precision number when read"
_FIELD = "10 significant digits: what 16 characters, the widest field of bulk data, hold beside sign and exponent"
_DMIG = Format(write_dmig, "Nastran DMIG superelement", "its first lines", _FIELD)
_MODES = Format(
    write_uff55, "universal file of mode shapes", "its first lines",
    "6 significant digits: dataset 55 prescribes the number format E13.5",
)  # fmt: skip
FORMATS = {
    ".csv": Format(write_text, "table of M, K and C with deviations", "its first lines", _DIGITS, deviations=True),
    ".mat": Format(write_matlab, "MATLAB file", "its variable 'about'", _BYTES, deviations=True),
    ".op4": Format(write_op4, "Nastran OUTPUT4 file", "its matrix NOTE", _BYTES, needs="pyyeti", extra="nastran"),
    ".dmig": _DMIG,
    ".bdf": _DMIG,
    ".unv": _MODES,
    ".uff": _MODES,
}


def export(
    identification: Identification, path: str | Path, *, positive_axes: bool = False, level: float | None = None
) -> Path:  # fmt: skip
    """Write an identified structure for another program; the ending of the file tells the format.

    Parameters
    ----------
    identification : Identification
        What `identify` gives, or `load` reads.
    path : str or Path
        The file. It is written whole or not at all, over an earlier one; folders are made. By its ending it holds:

        - ``.csv``: M, K and C with deviations, one entry a row; exact
        - ``.mat``: M, K, C with deviations, modes, state space, for MATLAB; exact
        - ``.op4``: M, K, C, Craig-Bampton superelement (extra ``nastran``); exact
        - ``.bdf`` or ``.dmig``: the superelement as Nastran's DMIG; 10 digits
        - ``.unv`` or ``.uff``: mode shapes, universal file dataset 55; 6 digits
    positive_axes : bool
        Whether rows of sensors along -x, -y or -z are turned to +x, +y, +z. By default they stay as recorded; names of
        rows tell the axis: "floor 2 (-x)". Mode shapes in universal files are along x, y, z in any case.
    level : float, optional
        m/s², at which modes that follow their amplitude move: see `Structure.at_level`. By default at rest.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        Where the ending is none of these, a package is missing, or the file cannot be written; where no mode follows
        its amplitude at a stated level.

    Notes
    -----
    Each file says within itself what the matrices are worth, what speaks against them, what the data do not determine,
    its units, the order of its rows, and its precision.
    For everything else, and to go on with sysid, `Identification.save` writes HDF5.
    """
    instance("identification", identification, Identification)
    target = path_of("path", path)
    chosen = format_of(target)
    if chosen.needs:
        needed(chosen.needs, chosen.extra, f"{target}: a {chosen.name}")
    content = Content.of(identification, flag("positive_axes", positive_axes), level)
    with atomically(target) as temporary:
        chosen.write(content, statements(content, chosen.precision), temporary)
    return target


def format_of(path: Path) -> Format:
    """The format that the ending of a file stands for; InputError names all where it is none of them."""
    found = FORMATS.get(path.suffix.lower())
    if found is None:
        known = ", ".join(f"{ending} ({form.name})" for ending, form in FORMATS.items())
        raise InputError(f"{path}: no format has the ending {path.suffix!r}; there are {known}")
    return found


def precision(path: str | Path) -> str:
    """Precision of the numbers in a file of this ending, in words."""
    return format_of(Path(path)).precision
