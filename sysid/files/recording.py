"""Content of a file before it is known what measured it: named columns in time or over frequency."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, listed, refuse
from sysid.files import units
from sysid.files.description import Description
from sysid.structure.structure import Array

_TIMES = (
    "time", "t", "zeit", "temps", "tiempo", "tempo", "time stamp", "timestamp", "elapsed time", "x_value", "date/time",
    "date time", "datetime",
)  # fmt: skip
_FREQUENCIES = (
    "freq", "frequency", "frequencies", "freq_hz", "f_hz", "frequenz", "fréquence", "frequence", "frecuencia",
    "frequenza",
)  # fmt: skip
_PARTS = {
    "re": "real", "real": "real", "im": "imaginary", "imag": "imaginary", "imaginary": "imaginary",
    "mag": "magnitude", "magnitude": "magnitude", "abs": "magnitude", "amplitude": "magnitude", "amp": "magnitude",
    "phase": "phase", "ph": "phase", "angle": "phase", "arg": "phase",
    "coherence": "coherence", "coh": "coherence",
}  # fmt: skip
_NAMED_LAST = re.compile(rf"(.+?)[\s_.,:\-]+\(?({'|'.join(_PARTS)})\)?", re.IGNORECASE)
_NAMED_FIRST = re.compile(rf"({'|'.join(_PARTS)})(?:[\s_.,:\-]+([^\[\]()]+)|\(([^()]+)\))", re.IGNORECASE)
_SECOND = {"real": "imaginary", "magnitude": "phase"}
_FIRST = {second: first for first, second in _SECOND.items()}


@dataclass(frozen=True, eq=False)
class Column:
    """One channel as its file has it.

    Attributes
    ----------
    name : str
    values : (n,)
        In `unit`; complex over frequency.
    unit : str
        "" where the file states none.
    place : str
        Where it stands, for messages.
    reference : str
        Of a frequency response: what it is per unit of, such as "5+X"; "" where the file does not say.
    position : tuple of float or None
        m, where the file holds the geometry.
    axis : str
        Where the file states it.
    lines : (n,) or None
        Lines of the file that hold the values, where it is a table of text.
    """

    name: str
    values: NDArray[Any]
    unit: str
    place: str
    reference: str = ""
    position: tuple[float, float, float] | None = None
    axis: str = ""
    lines: NDArray[np.intp] | None = None

    def part(self, begin: int, end: int) -> Column:
        """The column with some of its values."""
        lines = None if self.lines is None else self.lines[begin:end]
        return replace(self, values=self.values[begin:end], lines=lines)


@dataclass(frozen=True, eq=False)
class Recording:
    """The columns of a file, which share their samples.

    Attributes
    ----------
    path : Path
    columns : tuple of Column
    sample_rate : float or None
        Hz, of records in time; None where the file does not tell it.
    freq : (n,) or None
        Hz, of spectra.
    remarks : tuple of str
        What was left out or mended.
    """

    path: Path
    columns: tuple[Column, ...]
    sample_rate: float | None = None
    freq: Array | None = None
    remarks: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Of its columns."""
        return [column.name for column in self.columns]

    def column(self, wanted: str | int) -> Column:
        """The column of a name, or of a number from 1; refused where there is none, or several of the name."""
        found = [column for column in self.columns if column.name == wanted]
        if isinstance(wanted, int) or (wanted.isdecimal() and not found):
            found = [column for at, column in enumerate(self.columns, 1) if at == int(wanted)]
        if len(found) != 1:
            several = f"{len(found)} columns named {wanted!r}: name them by their numbers from 1"
            raise InputError(f"{self.path} has {several if found else f'no column {wanted!r}: {self.in_words()}'}")
        return found[0]

    def in_words(self) -> str:
        """Number of columns, and what they are called."""
        left_out = "".join(f" ({remark})" for remark in self.remarks[:1])
        plural = "s" * (len(self.names) != 1)
        return f"it has {len(self.names)} column{plural}, {listed([*map(repr, self.names)])}{left_out}"


def check_column(column: Column, path: Path) -> None:
    """Refuse a column with a number that is NaN, infinite or of no size that sensors read, with its place."""
    bad = np.flatnonzero(~(np.abs(column.values) < 1e30))
    if bad.size:
        line = "" if column.lines is None else f" (line {column.lines[bad[0]]})"
        words = f"sample {bad[0] + 1} of {column.values.size}{line} is {column.values[bad[0]]} ({bad.size} such)"
        raise InputError(f"{path}, {column.place}: {words}: cut the record there, or leave this sensor out")


def rate_of(time: Array, path: Path, place: str) -> float:
    """Sample rate of a time column in s, Hz; numbers rounded to a quarter of a step are even.

    A time of day may pass midnight; day numbers of a spreadsheet are days. Refused is time that does not rise, or whose
    steps are uneven, with its sample.
    """
    refuse((time.size < 3, f"{path}: {time.size} samples are no record: is it the right file, and whole?"))
    day = 86400.0
    if time[0] > 1e4 and 0 < time[-1] - time[0] < 1e-5 * time.size:  # days, as spreadsheets count them
        time = time * day
    time = time + day * np.cumsum(np.diff(time, prepend=time[0]) < -0.99 * day)
    falls = np.flatnonzero(np.diff(time) <= 0)
    if falls.size:
        before, after = time[falls[0]], time[falls[0] + 1]
        cause = "two tests in one file? Write each to a file of its own"
        if after == before:
            cause = "a sample twice, or times that are rounded? State sample_rate in place of time (--rate)"
        elif falls.size > time.size / 2:
            cause = "it runs backwards: is it the right column?"
        words = f"time does not rise at sample {falls[0] + 2} ({before:g}, then {after:g} s)"
        raise InputError(f"{path}, {place}: {words}: {cause}")
    step = (time[-1] - time[0]) / (time.size - 1)
    late = np.abs(time - time[0] - step * np.arange(time.size))
    at = int(np.argmax(np.abs(np.diff(time) - np.median(np.diff(time)))))
    refuse(
        (
            np.max(late) > max(0.25 * step, 1e-6),
            f"{path}, {place}: steps of time are uneven, most at sample {at + 2} ({time[at + 1] - time[at]:g} s "
            f"after the one before, {step:g} s on average): samples are missing, or bring it to one clock with "
            "sysid.resample",
        )
    )
    return float(1 / step)


def recognised(recording: Recording, said: Description) -> Recording:
    """The recording as spectra where it has a column of frequencies, stated or named so; else as it is.

    Raises
    ------
    InputError
        Complex numbers without frequencies; frequencies that do not rise; a part of complex numbers without the other.
    """
    if recording.freq is not None:
        return replace(recording, freq=_rising(recording.freq, str(recording.path)))
    column = recording.column(said.frequency) if said.frequency is not None else _named(recording, said)
    if column is None:
        found = any(np.iscomplexobj(one.values) or part_of(one.name)[1] == "imaginary" for one in recording.columns)
        words = f"holds complex numbers, but no frequencies that are named so; {recording.in_words()}: state"
        refuse((found, f'{recording.path} {words} frequency = "ITS NAME" (--frequency)'))
        return recording
    place = f"{recording.path}, {column.place}"
    check_column(column, recording.path)
    known = units.unit(column.unit or "Hz", place)
    other = known.quantity != "frequency"
    refuse((other, f"{place}: frequencies in {column.unit!r} are not understood: Hz, kHz, rad/s are"))
    others = [one for one in recording.columns if one is not column]
    freq = _rising(np.real(column.values) * known.factor, place)
    plain = not column.unit and column.name.rpartition(".")[2].lower() not in _FREQUENCIES
    remarks = (*recording.remarks, *([f"{column.place}: frequencies have no unit, and are taken as Hz"] * plain))
    return Recording(recording.path, tuple(_joined(others, str(recording.path))), None, freq, remarks)


def is_time(name: str) -> bool:
    """True where a column is named as time is."""
    return name.lower() in _TIMES


def is_abscissa(name: str) -> bool:
    """True where an array is named as time or frequency is."""
    return name.rpartition(".")[2].lower() in (*_TIMES, *_FREQUENCIES, "f")


def _named(recording: Recording, said: Description) -> Column | None:
    """The column that is named as frequencies are, in a file that tells no time."""
    timed = any(is_time(column.name) for column in recording.columns)
    if timed or said.sample_rate is not None or said.time is not None:
        return None  # a sweep may be recorded with its frequency
    used = {str(channel.column) for channel in said.channels}
    free = [column for column in recording.columns if column.name not in used]
    last = {column.name: column.name.rpartition(".")[2] for column in free}
    found = [column for column in free if last[column.name].lower() in _FREQUENCIES]
    # A force may be named f; it does not rise.
    found += [column for column in free if last[column.name] == "f" and np.all(np.diff(np.real(column.values)) > 0)]
    return next(iter(found), None)


def _rising(freq: Array, place: str) -> Array:
    falls = np.flatnonzero(~(np.diff(freq) > 0))
    if falls.size:
        at = int(falls[0])
        words = f"frequencies do not rise at line {at + 2} ({freq[at]:g}, then {freq[at + 1]:g} Hz)"
        raise InputError(f"{place}: {words}: two tests in one file? Write each to a file of its own")
    return freq


def part_of(name: str) -> tuple[str, str]:
    """Name of the function and which part of it a column is, such as ("H1", "real"); (name, "") where it is whole."""
    if match := _NAMED_LAST.fullmatch(name):
        return match[1], _PARTS[match[2].lower()]
    if match := _NAMED_FIRST.fullmatch(name):
        return match[2] or match[3], _PARTS[match[1].lower()]
    return name, ""


def _joined(columns: list[Column], path: str) -> Iterator[Column]:
    """The columns with each pair of parts as one of complex numbers, where its first part stands."""
    parts = {part_of(column.name): column for column in columns}
    for column in columns:
        name, part = part_of(column.name)
        first, second = _FIRST.get(part), parts.get((name, _SECOND.get(part, part)))
        alone = first is not None and (name, first) not in parts
        refuse((alone, f"{path}, {column.place}: the {part} part stands there, and no {first} part of {name!r}"))
        if part in _SECOND and second is not None:
            yield replace(column, name=name, values=_complex(column, second, path), place=f"{column.place} and after")
        elif first is None:
            yield column  # whole, or of real numbers alone: whoever takes it says so


def _complex(first: Column, second: Column, path: str) -> Any:
    """Complex numbers of a real and an imaginary part, or of magnitude and phase."""
    place = f"{path}, {second.place}"
    if part_of(second.name)[1] == "imaginary":
        unlike = second.unit not in ("", first.unit)
        refuse((unlike, f"{place}: real part in {first.unit!r}, imaginary part in {second.unit!r}: mend the header"))
        return first.values + 1j * second.values
    angle = units.find(second.unit) or units.Unit("", 1.0)
    decibels, unsaid = first.unit.lower().startswith("db"), angle.quantity != "angle"
    refuse(
        (decibels, f"{path}, {first.place}: magnitudes in dB have no unit here: export them linear"),
        (unsaid, f"{place}: is the phase in degrees or in radians? State it in the header, such as [deg]"),
    )
    return first.values * np.exp(1j * angle.factor * second.values)
