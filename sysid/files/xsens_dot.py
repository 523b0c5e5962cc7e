"""Xsens DOT wireless inertial units: their CSV export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sysid.errors import InputError, refuse
from sysid.files.alignment import UnitColumns, clock_moves
from sysid.files.assembly import runs_of_files
from sysid.files.description import Description
from sysid.files.recording import Column, Recording
from sysid.measurement.spectra import resample
from sysid.structure.structure import Array

_TIME = "SampleTimeFine"
_ACCELERATION = ("Acc_X", "Acc_Y", "Acc_Z")
_ROTATION = ("Gyr_X", "Gyr_Y", "Gyr_Z")


@dataclass(frozen=True, eq=False)
class UnitRecord:
    """One unit's record.

    Attributes
    ----------
    time : (n,)
        s, on the clock that the units share.
    acceleration : (3, n)
        m/s² along the unit's own axes, gravity included.
    rotation_rate : (3, n)
        rad/s.
    """

    time: Array
    acceleration: Array
    rotation_rate: Array

    @property
    def sample_rate(self) -> float:
        """Mean rate of the samples, Hz."""
        return float((self.time.size - 1) / (self.time[-1] - self.time[0]))


def read_xsens_dot(path: str | Path) -> UnitRecord:
    """Read one unit's CSV file.

    The first row of a record holds zeros where accelerations should be, and is dropped.

    Raises
    ------
    InputError
        A file that is missing, cut off, has other columns, or samples that are not finite or not in order of time.
    """
    file = Path(path)
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {file}: {getattr(error, 'strerror', None) or error}") from None
    header = next((i for i, line in enumerate(lines) if _TIME in line.split(",")), None)
    if header is None:
        raise InputError(f"{file} has no header line with {_TIME}: is it an Xsens DOT export?")
    columns = lines[header].split(",")
    missing = [name for name in (*_ACCELERATION, *_ROTATION) if name not in columns]
    refuse(
        (missing, f"{file} lacks the columns {', '.join(missing)}"),
        (not any(line.strip() for line in lines[header + 1 :]), f"{file} has a header but no rows"),
    )
    try:
        table = np.loadtxt(lines[header + 1 :], delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None
    rows, width = table.shape
    counts = f"{file} has {rows} rows of {width} values under {len(columns)} column names"
    refuse((rows < 3 or width != len(columns), counts))
    pick = lambda names: table[1:, [columns.index(name) for name in names]].T  # noqa: E731
    time = pick((_TIME,))[0] * 1e-6
    acceleration, rotation = pick(_ACCELERATION), np.deg2rad(pick(_ROTATION))
    falls = np.diff(time) <= 0
    bad = np.flatnonzero(~np.all(np.isfinite([time, *acceleration, *rotation]), axis=0))
    refuse(
        (bad.size, f"{file} holds NaN or infinite samples at row {[*bad, 0][0] + 2} ({bad.size} such)"),
        (np.any(falls), f"{file}: {_TIME} does not rise at row {int(np.argmax(falls)) + 2}"),
    )
    return UnitRecord(time, acceleration, rotation)


def is_export(path: Path) -> bool:
    """True where a text file begins like an export of a unit."""
    try:
        with path.open("rb") as file:
            return f"{_TIME},".encode() in file.read(4000)
    except OSError:
        return False


def together(paths: Sequence[Path], said: Description) -> list[Recording]:
    """The units of each run, a file each, on one clock: columns such as ``ground.Acc_X``, without their means.

    Files of one name are of several runs; those of runs at nearly one rate come at the slowest.
    """
    again = len({path.stem for path in paths}) < len(paths)
    runs = runs_of_files(paths, said) if again else [{path: path.stem for path in paths}]
    units = [{path: read_xsens_dot(path) for path in run} for run in runs]
    rates = [min(one.sample_rate for one in run.values()) for run in units]
    rate = min(rates) if max(rates) < 1.01 * min(rates) else None
    return [_on_one_clock(named, list(run.values()), rate, said) for named, run in zip(runs, units, strict=True)]


def _on_one_clock(
    named: Mapping[Path, str], records: Sequence[UnitRecord], rate: float | None, said: Description
) -> Recording:
    """The units of a run at a rate, that of the slowest unless given."""
    paths, names = list(named), list(named.values())
    times, moved = [record.time for record in records], list[str]()
    if said.align:
        parts = zip(named.items(), records, strict=True)
        units = [
            UnitColumns(path.name, one.time[0], one.sample_rate, _columns(name, one.acceleration))
            for (path, name), one in parts
        ]
        offsets, moved = clock_moves(units, said)
        times = [time + offset for time, offset in zip(times, offsets, strict=True)]
    apart = max(time[0] for time in times) >= min(time[-1] for time in times)
    remedy = "" if said.align else ": units on clocks of their own are brought to one with --align (align = true)"
    refuse((apart, f"{', '.join(map(str, paths))} have no time in common{remedy}"))
    time, found = resample([(own, record.acceleration) for own, record in zip(times, records, strict=True)], rate)
    columns = tuple(one for name, unit in zip(names, found, strict=True) for one in _columns(name, unit))
    remark = f"{len(paths)} units are brought to one clock; gravity and offsets are taken off: the mean of each channel"
    return Recording(paths[0], columns, rate or float(1 / (time[1] - time[0])), remarks=(*moved, remark))


def _columns(unit: str, acceleration: Array) -> list[Column]:
    """The channels of a unit without their means."""
    return [
        Column(f"{unit}.{name}", values - values.mean(), "m/s²", f"{unit}.{name}")
        for name, values in zip(_ACCELERATION, acceleration, strict=True)
    ]
