"""Spectra among the columns of a file: its frequencies, and complex numbers that stand in two columns each."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.errors import InputError, refuse
from sysid.files import units
from sysid.files.description import Description
from sysid.files.recording import Column, Recording, check_column
from sysid.structure.structure import Array

TIME_NAMES = {"time", "t", "zeit", "temps", "tiempo", "tempo", "time stamp", "timestamp", "elapsed time"}
_FREQUENCIES = {
    "freq", "frequency", "frequencies", "freq_hz", "f_hz", "frequenz", "fréquence", "frequence", "frecuencia",
    "frequenza",
}  # fmt: skip
_PARTS = {
    "re": "real", "real": "real", "im": "imaginary", "imag": "imaginary", "imaginary": "imaginary",
    "mag": "magnitude", "magnitude": "magnitude", "abs": "magnitude", "amplitude": "magnitude", "amp": "magnitude",
    "phase": "phase", "ph": "phase", "angle": "phase", "arg": "phase",
}  # fmt: skip
_NAMED_LAST = re.compile(rf"(.+?)[\s_.,:\-]+\(?({'|'.join(_PARTS)})\)?", re.IGNORECASE)
_NAMED_FIRST = re.compile(rf"({'|'.join(_PARTS)})(?:[\s_.,:\-]+([^\[\]()]+)|\(([^()]+)\))", re.IGNORECASE)
_SECOND = {"real": "imaginary", "magnitude": "phase"}
_FIRST = {second: first for first, second in _SECOND.items()}


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


def is_abscissa(name: str) -> bool:
    """True where an array is named as time or frequency is."""
    return name.rpartition(".")[2].lower() in {*TIME_NAMES, *_FREQUENCIES, "f"}


def _named(recording: Recording, said: Description) -> Column | None:
    """The column that is named as frequencies are, in a file that tells no time."""
    timed = any(column.name.lower() in TIME_NAMES for column in recording.columns)
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
        raise InputError(
            f"{place}: frequencies do not rise at line {at + 2} ({freq[at]:g}, then {freq[at + 1]:g} Hz): two tests in "
            "one file? Write each to a file of its own"
        )
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
    refuse(
        (
            first.unit.lower().startswith("db"),
            f"{path}, {first.place}: magnitudes in dB have no unit here: export them linear",
        ),
        (
            angle.quantity != "angle",
            f"{place}: is the phase in degrees or in radians? State it in the header, such as [deg]",
        ),
    )
    return first.values * np.exp(1j * angle.factor * second.values)
