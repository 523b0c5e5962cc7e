"""The format of an exported file by its ending, and the file whole or not at all."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path

from sysid.errors import InputError, instance, needed, path_of
from sysid.results.identification import Identification
from sysid.results.storage import atomically


@dataclass(frozen=True)
class Format:
    """A format: its module of this room, its name, where its files say what they are worth, and what it needs."""

    module: str
    name: str
    note: str
    deviations: bool = False
    needs: str = ""
    extra: str = ""


FORMATS = {
    ".csv": Format("text_table", "table of M, K and C with deviations", "its first lines", deviations=True),
    ".mat": Format("matlab", "MATLAB file", "its variable 'about'", deviations=True),
    ".op4": Format("op4", "Nastran OUTPUT4 file", "its matrix NOTE", needs="pyyeti", extra="nastran"),
    ".dmig": Format("dmig", "Nastran DMIG superelement", "its first lines"),
    ".bdf": Format("dmig", "Nastran DMIG superelement", "its first lines"),
    ".unv": Format("uff55", "universal file of mode shapes", "its first lines"),
    ".uff": Format("uff55", "universal file of mode shapes", "its first lines"),
}


def export(identification: Identification, path: str | Path) -> Path:
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

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        Where the ending is none of these, a package is missing, or the file cannot be written.

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
    module = importlib.import_module(f"sysid.export.{chosen.module}")
    with atomically(target) as temporary:
        getattr(module, f"write_{chosen.module}")(identification, temporary)
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
    found = importlib.import_module(f"sysid.export.{format_of(Path(path)).module}")
    return str(found.PRECISION)
