"""`sysid.read`: a laboratory's files, of any format that is known, as one test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid.errors import InputError, path_of
from sysid.files import assembly, delimited
from sysid.files.description import Description, asked
from sysid.files.recorded_test import RecordedTest
from sysid.files.recording import Recording
from sysid.measurement.measurement import Measurement

_READERS: dict[str, Callable[[Path], Recording]] = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".asc", ".dat"), delimited.read),
}


def read(
    paths: str | Path | Sequence[str | Path],
    sensors: str | Path | Mapping[str, Any] | None = None,
    **options: Any,
) -> Measurement:
    """A test from the files of a logger.

    Parameters
    ----------
    paths : path or sequence of paths
        CSV and other text tables; each file is a run.
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
    recordings = [recording for file in files for recording in _recordings(file, said)]
    return assembly.in_time(recordings, said)


def _recordings(file: Path, said: Description) -> list[Recording]:
    if not file.exists():
        raise InputError(f"{file}: there is no such file")
    if file.is_dir():
        raise InputError(f"{file} is a folder: name its files")
    reader = _READERS.get(file.suffix.lower())
    if reader is None:
        raise InputError(f"{file}: the ending {file.suffix!r} is not known; known are {', '.join(_READERS)}")
    return [reader(file)]
