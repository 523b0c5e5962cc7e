"""`sysid.read`: a laboratory's files, of any format that is known, as one test."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid.errors import InputError, path_of, refuse
from sysid.files import arrays, assembly, delimited, lvm, responses, strong_motion, universal, xsens_dot
from sysid.files.description import Description, asked
from sysid.files.recorded_test import RecordedTest
from sysid.files.recording import Recording, recognised
from sysid.measurement.measurement import Measurement

_TEXT = (".csv", ".txt", ".tsv", ".asc", ".dat")
_UNIVERSAL = (".uff", ".unv", ".ufb")
_READERS: dict[str, Callable[[Path], list[Recording]]] = {
    **dict.fromkeys(_TEXT, delimited.read_delimited),
    ".lvm": lvm.read_lvm,
    ".v2": strong_motion.read_strong_motion,
    ".npz": arrays.read_npz,
    ".mat": arrays.read_mat,
    **dict.fromkeys((".h5", ".hdf5"), arrays.read_hdf5),
    **dict.fromkeys(_UNIVERSAL, universal.read_universal),
}


def read(
    paths: str | Path | Sequence[str | Path], sensors: str | Path | Mapping[str, Any] | None = None, **options: Any
) -> Measurement:
    """A test from the files of a logger.

    Parameters
    ----------
    paths : path or sequence of paths
        CSV and other text tables, LabVIEW measurement files, MATLAB files, universal files with sets 58 or 58b, HDF5,
        NPZ, corrected strong-motion records (.V2); each file is a run, unless `sensors` has ``join = true``: then the
        files of a folder are, or those of a folder whose names differ by those of the sensors alone.
    sensors : path or mapping, optional
        Which column is which sensor: a TOML file, or the same as dictionaries and lists. By default the TOML file
        beside the first file: of its name, or ``sensors.toml``.
    **options
        Of records in time those of `Measurement.from_time`: estimator, band, at_rest, noise, segment. Of spectra: band.
        Without a band whole records are fitted in that which the base excites (`sysid.excited_band`).

    Returns
    -------
    Measurement

    Raises
    ------
    InputError
        What is wrong, in which file and where, and what to do.
    """
    return gather(paths, sensors).measurement(**options)


# First bytes of a format, what it is called, and what to do where the ending says something else.
_BEGINNINGS = (
    (b"\x89HDF\r\n\x1a\n", "HDF5", ".h5", (".h5", ".hdf5", ".mat")),
    (b"MATLAB 5.0 MAT-file", "MATLAB", ".mat", (".mat",)),
    (b"MATLAB 7.3 MAT-file", "MATLAB", ".mat", (".mat", ".h5", ".hdf5")),
    (b"    -1", "universal file", ".unv", _UNIVERSAL),
)


def gather(paths: str | Path | Sequence[str | Path], sensors: Any = None) -> RecordedTest:
    """The test of some files, with its records whole; arguments as of `read`."""
    files = [path_of("paths", path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    refuse((not files, "paths is empty: give the files of a test"))
    said = asked(sensors, files)
    recordings = recordings_of(files, said)
    spectra = {recording.freq is not None for recording in recordings}
    refuse((len(spectra) > 1, "some files hold records in time and some spectra: read them apart"))
    return responses.from_spectra(recordings, said) if spectra.pop() else assembly.assembled_in_time(recordings, said)


def recordings_of(files: Sequence[Path], said: Description) -> list[Recording]:
    """The runs of some files, as far as they can be told without knowing which column is which sensor."""
    for file in files:
        _check_file(file)
    if all(xsens_dot.is_export(file) for file in files):
        return xsens_dot.together(files, said)  # a unit is a file
    recordings = [recording for file in files for recording in _read_any(file)]
    if said.join:
        recordings = assembly.joined(recordings, said)
    else:
        refuse((said.align, f"{said.place}: align goes with join: a file of its own is on one clock"))
        _check_one_each(recordings, said)
    return [recognised(recording, said) for recording in recordings]


def _check_file(file: Path) -> None:
    """Refuse what is no file, a device or a pipe, which may never end, and a text that would take all memory."""
    refuse(
        (not file.exists(), f"{file}: there is no such file"),
        (file.is_dir(), f"{file} is a folder: name its files"),
        (not file.is_file(), f"{file} is no file: a device or a pipe is not read"),
    )
    size = file.stat().st_size
    words = f"{size / 2**30:.1f} GiB of text, which takes ten times as much memory: export it as .mat, .h5 or .npz,"
    long = file.suffix.lower() in (*_TEXT, ".lvm", ".v2") and size > 2**30
    refuse((long, f"{file} has {words} or fewer channels or minutes a file"))


def _check_one_each(recordings: Sequence[Recording], said: Description) -> None:
    """Refuse files that seem to hold one sensor each, where they are read as a run each."""
    names = set(recordings[0].names)
    held = [(name, one.path) for one in recordings[1:] for name in (*one.names, one.path.stem)]
    elsewhere = [str(channel.column) for channel in said.channels if str(channel.column) not in names]
    found = [
        (one, path)
        for one in elsewhere
        for name, path in held
        if one.partition(".")[0] in (name, *re.split("[-_ ]", name))
    ]
    lost, path = next(iter(found), ("", None))
    words = f"no column {lost!r}, which {path} is or has: does each file hold one sensor? Then read them"
    refuse((found, f"{recordings[0].path} has {words} with --join (join = true)"))


def _read_any(file: Path) -> list[Recording]:
    """The recordings of a file of any kind; what a library raises of a file that it cannot take is one line."""
    ending, known = file.suffix.lower(), ", ".join(_READERS)
    refuse((ending not in _READERS, f"{file}: the ending {ending!r} is not known; known are {known}"))
    try:
        with file.open("rb") as opened:
            begin = opened.read(20)
        for first, name, right, endings in _BEGINNINGS:
            other = begin.startswith(first) and ending not in endings
            refuse((other, f"{file} begins as a file of the format {name} does: give it the ending {right}"))
        return _READERS[ending](file)
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{file}: reading it takes more memory than there is: export fewer channels a file") from None
    except Exception as error:  # foreign files, foreign parsers: any type
        words = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{file} cannot be read ({words}): is it damaged? Export it again") from None
