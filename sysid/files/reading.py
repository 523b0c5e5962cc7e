"""`sysid.read`: a laboratory's files, of any format that is known, as one test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid.errors import InputError, path_of
from sysid.files import arrays, assembly, delimited, responses, universal, xsens_dot
from sysid.files.description import asked
from sysid.files.recorded_test import RecordedTest
from sysid.files.recording import Recording
from sysid.measurement.measurement import Measurement

_READERS: dict[str, Callable[[Path], Recording]] = {
    ".npz": arrays.read_npz,
    ".mat": arrays.read_mat,
    **dict.fromkeys((".h5", ".hdf5"), arrays.read_hdf5),
}
_UNIVERSAL = (".uff", ".unv", ".ufb")
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
        CSV and other text tables, MATLAB files, universal files with sets 58 or 58b, HDF5, NPZ; each file is a run.
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


def gather(paths: str | Path | Sequence[str | Path], sensors: Any = None) -> RecordedTest:
    """The test of some files, with its records whole; arguments as of `read`."""
    files = [path_of("paths", path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    if not files:
        raise InputError("paths is empty: give the files of a test")
    said = asked(sensors, files)
    if all(xsens_dot.is_export(file) for file in files):
        return assembly.in_time([xsens_dot.together(files)], said)  # a unit is a file
    recordings = [recording for file in files for recording in _read_or_told(file)]
    spectra = {recording.freq is not None for recording in recordings}
    if len(spectra) > 1:
        raise InputError("some files hold records in time and some spectra: read them apart")
    return responses.from_spectra(recordings, said) if spectra.pop() else assembly.in_time(recordings, said)


def _recordings(file: Path) -> list[Recording]:
    if not file.exists():
        raise InputError(f"{file}: there is no such file")
    if file.is_dir():
        raise InputError(f"{file} is a folder: name its files")
    ending = file.suffix.lower()
    if ending in _UNIVERSAL:
        return universal.read(file)
    if ending in _TEXT:
        return [delimited.read(file)]
    if ending not in _READERS:
        known = ", ".join((*_TEXT, *_READERS, *_UNIVERSAL))
        raise InputError(f"{file}: the ending {ending!r} is not known; known are {known}")
    return [_READERS[ending](file)]


def _read_or_told(file: Path) -> list[Recording]:
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
