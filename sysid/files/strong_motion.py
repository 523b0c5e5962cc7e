"""Corrected strong-motion records (.V2): Volume 2 of the CSMIP format, in which the CESMD gives them out.

A. F. Shakal and M. J. Huang, "Standard Tape Format for CSMIP Strong-Motion Data Tapes", California Division of Mines
and Geology, report OSMS 85-03, 1985. For each channel there are lines of text, 100 integers (16I5), 100 reals (8F10),
and then acceleration, velocity and displacement, each below a line with their number, interval, unit and FORTRAN
format; a line ends the channel. The 61st real is the interval with more digits than that line has.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sysid.errors import InputError, refuse, shown
from sysid.files.delimited import text_of
from sysid.files.recording import Column, Recording
from sysid.structure.structure import Array

_START = re.compile(r"\s*(\d+)\s+points of (accel|veloc|displ)\S* data equally spaced at\s*([\d.]+)\s*sec", re.I)
_UNIT = re.compile(r"\bin\s+([a-z]\S*?)\.?(?:\s|$)|units?\s*[:=]\s*([^\s)]+)", re.IGNORECASE)
_FORTRAN = re.compile(r"\(\s*\d+f(\d+)\.\d+\s*\)", re.IGNORECASE)
_END = re.compile(r"end[- ]of[- ]data\s+for\s+chan", re.IGNORECASE)
_CHANNEL = re.compile(r"^\s*chan(?:nel)?\s*(\d+)\s*:\s*(.*)", re.IGNORECASE)
_FILTER = re.compile(r"filtered.* at\s*([\d.]+)\s*and\s*([\d.]+)\s*(?:cyc/sec|hz)", re.IGNORECASE)
_STATION = re.compile(r"\s*station (?:no\.|id\.?)\s*(\S+)", re.IGNORECASE)


class _Channel(NamedTuple):
    """Acceleration of a channel, its interval in s, and the text above it."""

    column: Column
    step: float
    text: list[str]


def read_strong_motion(path: Path) -> list[Recording]:
    """The accelerations of all channels of a file, called ``Chan 1`` and so on; velocities are passed over.

    Refused is a file without corrected accelerations, cut short, with another number of values than it states, or with
    channels of unlike intervals or lengths.
    """
    lines = text_of(path).splitlines()
    ends = [at for at, line in enumerate(lines) if _END.search(line)]
    kind = "corrected accelerations of the CSMIP format, Volume 2 (.V2): is it Volume 1, or of another format? Download"
    starts = [at for at, line in enumerate(lines) if _START.match(line)]
    refuse((not starts, f"{path} holds no {kind} the processed file"))
    cut = not ends or starts[-1] > ends[-1]
    refuse((cut, f"{path} is cut short: its last channel does not end; download it again"))
    parts = zip([0, *(at + 1 for at in ends)], ends, strict=False)
    found = [_channel(lines, begin, end, at, path) for at, (begin, end) in enumerate(parts, 1)]
    steps, lengths = {one.step for one in found}, {one.column.values.size for one in found}
    apart = f"{path}: its channels have intervals of {', '.join(f'{one:g}' for one in steps)} s and lengths of "
    apart += f"{', '.join(map(str, lengths))} samples: write those of one recorder to a file of their own"
    damaged = f"{path} states an interval of {min(steps):g} s: is it damaged? Download it again"
    refuse((min(steps) <= 0, damaged), (len(steps) * len(lengths) > 1, apart))
    return [Recording(path, tuple(one.column for one in found), 1 / steps.pop(), remarks=tuple(_remarks(found)))]


def _channel(lines: Sequence[str], begin: int, end: int, number: int, path: Path) -> _Channel:
    """The channel of some lines; `number` is its place in the file."""
    starts = [at for at in range(begin, end) if _START.match(lines[at])]
    match = _START.match(lines[starts[0]]) if starts else None
    if match is None or match[2].lower() != "accel":
        words = f"channel {number} of the file has no accelerations: download the processed file (Volume 2)"
        raise InputError(f"{path}, line {begin + 1}: {words}")
    text = list(lines[begin : starts[0]])
    named = next(filter(None, map(_CHANNEL.match, [*text, f"Chan {number}: "])))
    name, words = f"Chan {int(named[1])}", " ".join(named[2].split())
    values = _values(lines, starts[0], [*starts, end][1], int(match[1]), path)
    unit = "".join("".join(pair) for pair in _UNIT.findall(lines[starts[0]])[:1])
    axis = {"up": "z", "down": "-z"}.get(words.partition(" ")[0].lower(), "")
    column = Column(name, values, unit, f"{name} ({words})", axis=axis)
    return _Channel(column, _interval(text, float(match[3])), text)


def _values(lines: Sequence[str], start: int, end: int, count: int, path: Path) -> Array:
    """The numbers between two lines, in fields of the width that the first one states."""
    width = int(next(iter(_FORTRAN.findall(lines[start])), "10"))
    values: list[float] = []
    for at in range(start + 1, end):
        line = lines[at].rstrip()
        for field in (line[place : place + width] for place in range(0, len(line), width)):
            try:
                values.append(float(field))
            except ValueError:
                words = f"holds {shown(field)} in the place of a number: is it damaged? Download it again"
                raise InputError(f"{path}, line {at + 1}: {words}") from None
    words = f"it states {count} accelerations, and {len(values)} stand below it: is it cut, or damaged?"
    refuse((len(values) != count, f"{path}, line {start + 1}: {words} Download it again"))
    return np.array(values)


def _interval(text: Sequence[str], stated: float) -> float:
    """Interval of the samples, s: of the reals at the end of the text, where it is that which is stated, rounded."""
    try:
        exact = float(text[-6][40:50])
    except (ValueError, IndexError):
        return stated
    return exact if abs(exact - stated) <= 0.0005 else stated


def _remarks(found: Sequence[_Channel]) -> list[str]:
    """Station and channels, and the band beyond which the records are filtered."""
    text = found[0].text
    station = next((match[1] for match in map(_STATION.match, text) if match), "of no number")
    remarks = [f"station {station}: {', '.join(one.column.place for one in found)}"]
    bands = [f"{float(low):g} to {float(high):g} Hz" for low, high in _FILTER.findall("\n".join(text))[:1]]
    return remarks + [
        f"the records were filtered to {one}: lines outside hold no motion of the structure" for one in bands
    ]
