"""LabVIEW measurement files (.lvm): a header of the file, and segments of a header and a table each.

The format: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)", version 2.0 (ni.com, tutorial
4139). Each line is a tag and its values, in a segment a value a column; the column of x-values may be blank, one, or
one a channel. Special blocks are passed over.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sysid.errors import refuse, shown
from sysid.files import units
from sysid.files.delimited import Form, read_delimited, table_of, text_of
from sysid.files.recording import Column, Recording

_BEGINS, _ENDS = "LabVIEW Measurement", "***End_of_Header***"
_X = "X_Value"
_TAGS = ("Channels", "Notes", "Test_Name", "Test_Numbers", "Test_Series", "UUT_M/N", "UUT_Name", "UUT_S/N", "Samples")
_SHARED = ("Samples", "Delta_X", "X0")  # tags that are the same of channels of one record

Rows = list[tuple[int, list[str]]]


class _Segment(NamedTuple):
    """Channels of a segment, its columns of x-values first, their increment, and when it begins and ends, s."""

    columns: tuple[Column, ...]
    step: float
    begin: float
    end: float
    remarks: tuple[str, ...]


def read_lvm(path: Path) -> list[Recording]:
    """The segments of a file, a run each; those that follow each other without a gap are one.

    A file without headers, which LabVIEW writes too, is a plain table. Refused is a header that does not end, or whose
    numbers of channels or samples are not those of its table, and what `read_delimited` refuses.
    """
    lines = text_of(path).splitlines()
    if not lines[0].startswith(_BEGINS):
        return read_delimited(path)
    separator = next((line[9:10] for line in lines if line.startswith("Separator")), "\t")
    form = Form(separator, comma=separator != ",")
    rows = [row for row in _without_special(lines, form, path) if any(row[1])]
    ends = [at for at, (_, row) in enumerate(rows) if row[0] == _ENDS]
    words = f"it has {len(ends)} lines {_ENDS}, and two are needed at least; export it again"
    refuse((len(ends) < 2, f"{path} is cut short: {words}"))
    several = any(row[:2] == ["X_Columns", "Multi"] for _, row in rows[: ends[0]])
    parts, ended = [Rows()], False
    for number, row in rows[ends[0] + 1 :]:
        if ended and row[0] in _TAGS:
            parts.append([])
        ended = row[0] == _ENDS or (ended and row[0] not in _TAGS)
        parts[-1].append((number, row))
    return [_recording(path, run) for run in _runs([_segment(part, form, several, path) for part in parts])]


def _without_special(lines: Sequence[str], form: Form, path: Path) -> Iterator[tuple[int, list[str]]]:
    """The fields of each line outside of special blocks, with its number."""
    inside = 0
    for number, line in enumerate(lines, 1):
        row = form.fields(line)
        inside = number if row[0] == "***Start_Special***" else inside
        if not inside:
            yield number, row
        inside *= row[0] != "***End_Special***"
    words = "the special block that begins there does not end: it is cut short; export it again"
    refuse((inside, f"{path}, line {inside}: {words}"))


def _segment(rows: Rows, form: Form, several: bool, path: Path) -> _Segment:
    """A segment of its header, the names of its columns, and its table."""
    place = f"{path}, line {rows[0][0]}" if rows else str(path)
    end = next((at for at, (_, row) in enumerate(rows) if row[0] == _ENDS), len(rows))
    words = "the segment that begins there has no table: it is cut short; export it again"
    refuse((len(rows) < end + 3, f"{place}: {words}"))
    head, labels = {row[0]: row for _, row in rows[:end]}, rows[end + 1][1]

    def stated(tag: str, at: int) -> str:
        return "".join(head.get(tag, [])[at : at + 1])

    def number(tag: str, at: int) -> float:
        found = form.numbers([stated(tag, at) or "0"])
        words = f"{tag} of its header is {shown(stated(tag, at))}, which is no number: is it damaged? Export it again"
        refuse((found is None, f"{place}: {words}"))
        return float(np.real((found or [0.0])[0]))

    # Behind the names stand that of comments, and separators.
    width = max((at for at, label in enumerate(labels, 1) if label not in ("", "Comment")), default=1)
    channels = range(1, width, 1 + several)
    words = f"channels, and its table has {len(channels)}: export it again"
    refuse((number("Channels", 1) != len(channels), f"{place}: its header states {stated('Channels', 1)} {words}"))
    body = [(line, row[:width]) for line, row in rows[end + 2 :]]
    table, lines = table_of(body, form, width, path).real, np.array([line for line, _ in body])
    first = max(channels, key=lambda at: number("Samples", at))  # its x-values are those that stand there
    words = f"its header states {number('Samples', first):g} samples, and {len(body)} are there: it is cut short"
    dimension, needed = stated("X_Dimension", first) or "Time", "time or frequency is needed: export that"
    refuse(
        (len(body) < number("Samples", first), f"{place}: {words}; export it again"),
        (dimension not in ("Time", "Frequency"), f"{place}: its x-values are {shown(dimension)}: {needed}"),
    )
    step, x = number("Delta_X", first), table[:, (first - 1) * several]
    if dimension == "Frequency":
        x = number("X0", first) + step * np.arange(len(body))
    name, unit = {"Time": (_X, "s"), "Frequency": (dimension, "Hz")}[dimension]
    columns = [Column(name, x, stated("X_Unit_Label", first) or unit, f"the column of {name}", lines=lines)]
    columns *= not np.all(np.isnan(x))
    alike = [at for at in channels if all(stated(one, at) == stated(one, first) for one in _SHARED)]
    for at in alike:
        where = f"column {at + 1} ({labels[at]})"
        columns.append(Column(labels[at], table[:, at], stated("Y_Unit_Label", at), where, lines=lines))
    other = ", ".join(labels[at] for at in channels if at not in alike)
    remarks = (f"channels of another number of samples, rate or begin are left out: {other}",) * bool(other)
    scale = units.unit(stated("X_Unit_Label", first) or unit, f"{place}: x-values").factor
    begin = _clock(stated("Date", first), form.numbers([stated("Time", first)])) + scale * number("X0", first)
    step = scale * _increment(step) * (dimension == "Time")
    return _Segment(tuple(columns), step, begin, begin + step * len(body), remarks)


def _increment(step: float) -> float:
    """An increment in time, of which LabVIEW may write few digits: that of the shortest rate that they allow."""
    last = Decimal(str(step)).as_tuple().exponent
    if not step > 0 or not isinstance(last, int) or last > -6:
        return step  # all of it stands there
    shortest = (float(f"{1 / step:.{n}g}") for n in range(1, 18))
    return 1 / next((rate for rate in shortest if abs(1 / rate - step) <= 0.50001 * 10.0**last), 1 / step)


def _clock(date: str, time: Sequence[complex] | None) -> float:
    """Seconds of a date and a time of day; NaN where they are not understood."""
    try:
        days = (datetime.strptime(date, "%Y/%m/%d") - datetime(2000, 1, 1)).days
        return days * 86400.0 + float(np.real((time or [np.nan])[0]))
    except ValueError:
        return float("nan")


def _runs(segments: list[_Segment]) -> list[list[_Segment]]:
    """Segments of one run: the next begins where the last ends, to half a sample, and has the same channels."""
    runs = [segments[:1]]
    for last, one in pairwise(segments):
        same = [(a.name, a.unit) for a in last.columns] == [(a.name, a.unit) for a in one.columns]
        goes_on = same and one.step == last.step and abs(one.begin - last.end) < 0.5 * one.step
        runs = [*runs[:-1], [*runs[-1], one]] if goes_on else [*runs, [one]]
    return runs


def _recording(path: Path, run: list[_Segment]) -> Recording:
    """Recording of the segments of a run."""
    first, remarks = run[0], run[0].remarks
    columns = list(first.columns)
    if len(run) > 1:  # each counts its x-values anew
        remarks += (f"{len(run)} segments that follow each other without a gap are one run",)
        parts = [[one for one in segment.columns if one.name != _X] for segment in run]
        columns = [
            replace(
                one[0], **{name: np.concatenate([getattr(part, name) for part in one]) for name in ("values", "lines")}
            )
            for one in zip(*parts, strict=True)
        ]
    return Recording(path, tuple(columns), 1 / first.step if first.step > 0 else None, remarks=remarks)
