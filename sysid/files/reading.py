"""`sysid.read`: a laboratory's files, of any format that is known, as one test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid.errors import InputError, path_of, refuse
from sysid.files import arrays, assembly, delimited, responses, universal, xsens_dot
from sysid.files.description import Description, asked
from sysid.files.recorded_test import RecordedTest
from sysid.files.recording import Recording, recognised
from sysid.measurement.measurement import Measurement

_READERS: dict[str, Callable[[Path], Recording]] = {
    ".npz": arrays.read_npz,
    ".mat": arrays.read_mat,
    **dict.fromkeys((".h5", ".hdf5"), arrays.read_hdf5),
}
_UNIVERSAL = (".uff", ".unv", ".ufb")
_LONGEST = 2**30  # bytes of a text
_TEXT = (".csv", ".txt", ".tsv", ".asc", ".dat")


def read(
    paths: str | Path | Sequence[str | Path],
    sensors: str | Path | Mapping[str, Any] | None = None,
    **options: Any,
) -> Measurement:
    """A test from the files of a logger.

    Parameters
    ----------
    paths : path or sequence of paths
        CSV and other text tables, MATLAB files, universal files with sets 58 or 58b, HDF5, NPZ; each file is a run,
        unless `sensors` has ``join = true``: then the files of a folder are.
    sensors : path or mapping, optional
        Which column is which sensor: a TOML file, or the same as dictionaries and lists. By default the TOML file
        beside the first file: of its name, or ``sensors.toml``.
    **options
        Of records in time those of `Measurement.from_time`: estimator, band, at_rest, noise, segment. Of spectra: band.

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
    if not files:
        raise InputError("paths is empty: give the files of a test")
    for file in files:
        _check_ordinary(file)
    said = asked(sensors, files)
    if all(xsens_dot.is_export(file) for file in files):
        return assembly.assembled_in_time([xsens_dot.together(files)], said)  # a unit is a file
    recordings = [recording for file in files for recording in _read_any(file)]
    if said.join:
        recordings = assembly.by_folder(recordings, said)
    else:
        _check_one_each(recordings, said)
    recordings = [recognised(recording, said) for recording in recordings]
    spectra = {recording.freq is not None for recording in recordings}
    if len(spectra) > 1:
        raise InputError("some files hold records in time and some spectra: read them apart")
    return responses.from_spectra(recordings, said) if spectra.pop() else assembly.assembled_in_time(recordings, said)


def _recordings(file: Path) -> list[Recording]:
    if not file.exists():
        raise InputError(f"{file}: there is no such file")
    if file.is_dir():
        raise InputError(f"{file} is a folder: name its files")
    ending = file.suffix.lower()
    _check_ending(file, ending)
    if ending in _UNIVERSAL:
        return universal.read_universal(file)
    if ending in _TEXT:
        return [delimited.read_delimited(file)]
    if ending not in _READERS:
        known = ", ".join((*_TEXT, *_READERS, *_UNIVERSAL))
        raise InputError(f"{file}: the ending {ending!r} is not known; known are {known}")
    return [_READERS[ending](file)]


def _check_ordinary(file: Path) -> None:
    """Refuse a device or a pipe, which may never end, and a text that would take all memory."""
    if not file.is_file():
        refuse((file.exists() and not file.is_dir(), f"{file} is no file: a device or a pipe is not read"))
        return
    size = file.stat().st_size
    refuse(
        (
            file.suffix.lower() in _TEXT and size > _LONGEST,
            f"{file} has {size / 2**30:.1f} GiB of text, which takes some ten times as much memory: export it as .mat, "
            ".h5 or .npz, or fewer channels or minutes a file",
        ),
    )


def _check_ending(file: Path, ending: str) -> None:
    """Refuse a file that begins as one of another format than its ending says."""
    with file.open("rb") as opened:
        begin = opened.read(20)
    for first, name, right, endings in _BEGINNINGS:
        wrong = begin.startswith(first) and ending not in endings
        refuse((wrong, f"{file} begins as a file of the format {name} does: give it the ending {right}"))


def _check_one_each(recordings: Sequence[Recording], said: Description) -> None:
    """Refuse files that seem to hold one sensor each, where they are read as a run each."""
    names = set(recordings[0].names)
    others = {name: other.path for other in recordings[1:] for name in (*other.names, other.path.stem)}
    elsewhere = [str(channel.column) for channel in said.channels if str(channel.column) not in names]
    found = next((name for name in elsewhere if name in others), None)
    refuse(
        (
            found is not None,
            f"{recordings[0].path} has no column {found!r}, which {others.get(str(found))} is or has: does each file "
            "hold one sensor? Then read them with --join (join = true)",
        )
    )


def _read_any(file: Path) -> list[Recording]:
    """The recordings of a file of any kind; what a library raises of a file that it cannot take is one line."""
    try:
        return _recordings(file)
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{file}: reading it takes more memory than there is: export fewer channels a file") from None
    except Exception as error:  # foreign files, foreign parsers: any type
        words = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{file} cannot be read ({words}): is it damaged? Export it again") from None
