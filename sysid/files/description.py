"""Which column is which sensor: from a TOML file, from the command line, or from dictionaries."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid.errors import (
    InputError,
    as_float,
    choice,
    flag,
    path_of,
    printable,
    refuse,
    sequence,
    shown,
    text,
    whole_number,
)
from sysid.structure.sensor import base_columns, sensor_row, vector3

ROLES = ("base", "response", "force")
_FIELDS = ("column", "name", "role", "position", "axis", "unit", "gain", "gain_std", "delay", "part", "reference")
_TOP = (
    "sensor", "sample_rate", "time", "frequency", "base_axes", "origin", "frf", "convention", "window", "averages",
    "join", "align",
)  # fmt: skip
CONVENTIONS = ("exp(+iwt)", "exp(-iwt)")

EXAMPLE = """\
time = "Time"                  # or: sample_rate = 200.0
[[sensor]]
column = "CH1"                 # its name in the file, or its number from 1
role = "base"                  # base, response or force
axis = "x"                     # x, -y, ..., or a direction such as [0.7, 0.7, 0]
unit = "g"                     # where the file does not state it
[[sensor]]
column = "CH2"
name = "floor 1"
role = "response"
axis = "x"
position = [0.0, 0.0, 3.0]     # m
"""


@dataclass(frozen=True)
class Channel:
    """Description of one column, which is divided by `gain`, known to `gain_std`, and earlier by `delay`, s.

    `part` is the rigid part that a sensor is fixed to, "" for none. `axis`, `position` are None where the file tells
    them.
    """

    column: str | int
    role: str
    axis: Any
    name: str
    position: tuple[float, float, float] | None
    unit: str
    reference: str
    gain: float
    delay: float = 0.0
    gain_std: float = 0.0
    part: str = ""


@dataclass(frozen=True)
class Description:
    """Description of a test's files.

    Attributes
    ----------
    channels : tuple of Channel
    sample_rate : float or None
        Hz.
    time, frequency : str or int or None
        The columns of time or frequency.
    base_axes : str or None
        Of which the base moves; those of the base channels by default.
    origin : tuple of float
        The base point, m.
    frf, convention : str
        Of frequency responses, see `sysid.files.responses`; "" where they are to be recognised.
    window : str
        "hann" where an analyser averaged segments under that window, "" where nothing is said.
    averages : int
        How many independent segments; 0 where nothing is said.
    join : bool
        Whether files hold one sensor each, those of a folder or with the same rest of their names being one run.
    align : bool
        Whether the files of a run have clocks of their own, which are brought to that of the base.
    """

    channels: tuple[Channel, ...] = ()
    sample_rate: float | None = None
    time: str | int | None = None
    frequency: str | int | None = None
    base_axes: str | None = None
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    frf: str = ""
    convention: str = ""
    window: str = ""
    averages: int = 0
    join: bool = False
    align: bool = False
    place: str = "the description"


def from_toml(path: Path) -> dict[str, Any]:
    """The dictionary that a TOML file stands for."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # of tomllib, of what is no text, of numbers of 5,000 digits
        twice = "; a sensor begins with [[sensor]], in two brackets" if "('sensor',)" in str(error) else ""
        raise InputError(f"{path} is no TOML: {error}{twice}") from None


def from_words(words: Sequence[str]) -> dict[str, Any]:
    """One sensor from the words of a command line: ``COLUMN role=response axis=x position=0,0,3 unit=g``."""
    entry: dict[str, Any] = {"column": words[0]}
    for word in words[1:]:
        name, equals, value = word.partition("=")
        known = " ".join(f"{one}=" for one in _FIELDS[1:])
        wrong = not equals or name not in _FIELDS[1:]
        refuse((wrong, f"--sensor {words[0]}: {word!r} is none of {known}; such as role=response position=0,0,3"))
        alone, listed = name in ("gain", "gain_std", "delay"), name == "position" or (name == "axis" and "," in value)
        try:
            entry[name] = float(value) if alone else [float(one) for one in value.split(",")] if listed else value
        except ValueError:
            examples = {"gain": 0.995, "gain_std": 0.005, "delay": 0.002}
            such = f"a number, such as {name}={examples[name]}" if alone else f"numbers, such as {name}=0,0,3"
            raise InputError(f"--sensor {words[0]}: {word!r} needs {such}") from None
    return entry


def description(given: Mapping[str, Any], place: str = "the description") -> Description:
    """The description of a mapping; refused is a word that is not known, a role, an axis or a position that is none."""
    for name in given:
        refuse((name not in _TOP, f"{place}: {name!r} is unknown; known are {', '.join(_TOP)}"))
    listed = given.get("sensor", ())
    channels = tuple(
        _channel(entry, f"{place}, sensor {at}")
        for at, entry in enumerate(listed and sequence(f"{place}: sensor", listed, "a list of sensors"), 1)
    )
    plain = [channel for channel in channels if not channel.reference]
    columns, names = [one.column for one in plain], [one.name for one in plain if one.role == "response"]
    twice = next((one for one in columns if columns.count(one) > 1), None)
    alike = next((one for one in names if names.count(one) > 1), None)
    refuse(
        (twice is not None, f"{place}: column {twice!r} is given to two sensors"),
        (alike is not None, f"{place}: two sensors of the responses are named {alike!r}: name them apart"),
    )
    rate, axes, convention = given.get("sample_rate"), given.get("base_axes"), given.get("convention", "")
    if axes is not None:
        base_columns(axes)
    if convention != "":
        choice(f"{place}: convention", convention, CONVENTIONS)
    window, averages = given.get("window", ""), given.get("averages", 0)
    if window != "":
        choice(f"{place}: window", window, ("hann",))
    if averages != 0:
        whole_number(f"{place}: averages", averages, at_least=2)
    join, align = (flag(f"{place}: {name}", given.get(name, False)) for name in ("join", "align"))
    for name in ("time", "frequency"):
        wrong = given.get(name) is not None and type(given[name]) not in (str, int)
        refuse((wrong, f"{place}: {name} must be the name or the number of a column, got {shown(given.get(name))}"))
    return Description(
        channels,
        None if rate is None else as_float(f"{place}: sample_rate", rate, "a positive number in Hz", above=0),
        given.get("time"), given.get("frequency"), axes if axes is None or isinstance(axes, str) else " ".join(axes),
        tuple(vector3(given.get("origin", (0.0, 0.0, 0.0)), f"{place}: origin").tolist()),
        given.get("frf", ""), convention, window, averages, join, align, place,
    )  # fmt: skip


def _channel(entry: Any, place: str) -> Channel:
    if not isinstance(entry, Mapping):
        raise InputError(f"{place}: {shown(entry)} is no table of column, role, axis, position, unit")
    for name in entry:
        refuse((name not in _FIELDS, f"{place}: {name!r} is unknown; known are {', '.join(_FIELDS)}"))
    column: Any = entry.get("column")
    refuse((type(column) not in (str, int) or column == "", f"{place}: column is missing (its name, or its number)"))
    place = f"{place} (column {printable(f'{place}: column', str(column))})"
    refuse(("role" not in entry, f"{place}: role is missing; give one of {str(ROLES)[1:-1]}"))
    choice(f"{place}: role", entry["role"], ROLES)
    axis, where = entry.get("axis"), entry.get("position")
    if axis is not None:
        sensor_row(axis, place)
        axis = axis if isinstance(axis, str) else tuple(map(float, axis))
    x, y, z = vector3((0.0, 0.0, 0.0) if where is None else where, f"{place}: position").tolist()
    name = text(f"{place}: name", entry.get("name", str(column)))
    unit, reference, part = (
        printable(f"{place}: {one}", str(entry.get(one, ""))) for one in ("unit", "reference", "part")
    )
    gain = as_float(f"{place}: gain", entry.get("gain", 1.0), "a positive number, such as 0.995,", above=0)
    gain_std = as_float(f"{place}: gain_std", entry.get("gain_std", 0.0), "a fraction, such as 0.005,", at_least=0)
    delay = as_float(f"{place}: delay", entry.get("delay", 0.0), "a number of seconds, such as 0.002,")
    at = None if where is None else (x, y, z)
    return Channel(column, entry["role"], axis, name, at, unit, reference, gain, delay, gain_std, part)


def description_file(path: Path) -> Path | None:
    """A TOML file that stands beside a file: of its name, or ``sensors.toml`` in its folder."""
    return next((near for name in (path.stem, "sensors") if (near := path.parent / f"{name}.toml").is_file()), None)


def asked(given: Any, paths: Sequence[Path]) -> Description:
    """The description from what was given: a path of a TOML, a mapping, or None for the one beside the files."""
    if isinstance(given, Description):
        return given
    if isinstance(given, Mapping):
        return description(given)
    file = description_file(paths[0]) if given is None else path_of("sensors", given)
    return Description() if file is None else description(from_toml(file), str(file))
