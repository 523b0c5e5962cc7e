"""Text tables as loggers write them: preamble, header, units, decimal points or commas, any usual delimiter."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from sysid.errors import InputError, shown
from sysid.files import units
from sysid.files.recording import Column, Recording, part_of
from sysid.structure.structure import Array

_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]]*)[\])]\s*$")
_BLANKS = re.compile(r"[ \t]+")
_DIGITS = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_COMPLEX = re.compile(rf"\(?\s*({_DIGITS})\s*([+-])\s*\+?({_DIGITS})\s*\*?\s*[ij]\s*\)?")
_DATE = r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}"
_ZONE = r"[AaPp][Mm]|Z|[+-]\d\d:?\d\d"
_CLOCK = re.compile(rf"(?:{_DATE}[ T]\s*)?(?:(\d{{1,2}}):)?(\d{{1,2}}):(\d{{2}}(?:\.\d*)?)\s*({_ZONE})?")


@dataclass(frozen=True)
class Form:
    """Form of the numbers in a line."""

    delimiter: str
    comma: bool  # decimal comma

    def fields(self, line: str) -> list[str]:
        """The fields of a line, without blanks and quotes around them."""
        parts = _BLANKS.split(line.strip()) if self.delimiter == " " else line.split(self.delimiter)
        if '"' in line and self.delimiter != " ":  # a delimiter within quotes is none
            parts = next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True))
        return [part.strip().strip('"').strip() for part in parts]

    def numbers(self, fields: list[str]) -> list[complex] | None:
        """The numbers of the fields, NaN where one is empty, s where it is a time of day; None where one is none."""
        plain = [(field.replace(",", ".") if self.comma else field) or "nan" for field in fields]
        try:
            return [float(field) for field in plain]
        except ValueError:
            found = [_number(field) for field in plain]
            return None if None in found else [one for one in found if one is not None]


def _number(field: str) -> complex | None:
    """A number, complex such as 1.5-2j too; the seconds of a time of day such as 12:30:01.005; NaN for a date alone.

    A date may stand before the time, AM or PM behind it, and its hours may be left out.
    """
    try:
        return float(field)
    except ValueError:
        if match := _CLOCK.fullmatch(field):
            hours, half = int(match[1] or 0), (match[4] or "").upper()
            if half in ("AM", "PM") and match[1] is None:  # hours and minutes
                return None
            hours = hours % 12 + 12 * (half == "PM") if half in ("AM", "PM") else hours
            return 3600.0 * hours + 60.0 * int(match[2]) + float(match[3])
        if re.fullmatch(_DATE, field):
            return math.nan
        if match := _COMPLEX.fullmatch(field):
            return complex(float(match[1]), float(match[3]) * (-1 if match[2] == "-" else 1))
    return None


def read_delimited(path: Path) -> list[Recording]:
    """Columns of a text table; a last line that was cut short is left out, and said.

    Refused is a file without a table, a line in the middle with another number of fields or a word, a second table.
    """
    lines = text_of(path).splitlines()
    form, width = _form(lines, path)
    rows = [(number, form.fields(line)) for number, line in enumerate(lines, 1) if line.strip(" \t\r\x1a\0")]
    first = next(
        at for at, (_, row) in enumerate(rows) if len(row) == width and np.any(np.isfinite(form.numbers(row) or np.nan))
    )
    body, remarks = rows[first:], []
    number, last = body[-1]
    if len(body) > 1 and (len(last) < width or form.numbers(last) is None):
        body, remarks = body[:-1], [f"line {number}, the last, is cut short and left out"]
    table = table_of(body, form, width, path)
    values = [column if np.any(column.imag) else column.real for column in table.T]
    # NumPy, MATLAB and others write a sign of comments before the header.
    heads = [form.fields(re.sub(r"^\s*[#%]\s*(?=[^\W\d])", "", lines[number - 1])) for number, _ in rows[:first]]
    names, given = _header(heads, width, bool(np.all(np.isnan(values[-1]))))
    kept = [at for at in range(width) if not (names[at] == "" and np.all(np.isnan(values[at])))]
    places = [f"column {at + 1} ({name or 'no name'})" for at, name in enumerate(names)]
    lines_of = np.array([number for number, _ in body])
    columns = tuple(
        Column(names[at] or f"column {at + 1}", values[at], given[at], places[at], lines=lines_of) for at in kept
    )
    return [Recording(path, columns, remarks=tuple(remarks))]


def text_of(path: Path) -> str:
    """The text of a file in any usual encoding; an empty one is refused."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from None
    if not content.strip():
        raise InputError(f"{path} is empty")
    for size in (32, 16):  # in this order: the longer mark begins as the shorter one
        if content.startswith(tuple(getattr(codecs, f"BOM_UTF{size}_{order}") for order in ("LE", "BE"))):
            return content.decode(f"utf-{size}", "replace")
    head = content[:4000]
    if head.count(0) > len(head) // 4:  # Latin letters in UTF-16 without its mark: every other byte is zero
        return content.decode("utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be", "replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _form(lines: list[str], path: Path, looked_at: int = 200) -> tuple[Form, int]:
    """Delimiter, decimal sign and number of fields by which most of some lines from the middle on are numbers."""
    filled = [line for line in lines if line.strip()]
    middle = filled[len(filled) // 3 :][:looked_at]
    best, score = None, (0, 0)
    for delimiter, comma in product(";\t,| ", (False, True)):  # quotes may hold decimal commas beside commas
        form = Form(delimiter, comma)
        rows = [form.fields(line) for line in middle]
        widths = Counter(len(row) for row in rows if form.numbers(row) is not None and any(row))
        if widths:
            width, count = widths.most_common(1)[0]
            if (count, width) > score:
                best, score = (form, width), (count, width)
    if best is None:
        line = middle[0] if middle else ""
        found = f"{shown(line)} stands in its middle" if line.isprintable() else "it is no text"
        raise InputError(f"{path} holds no table of numbers: {found}; export it as text, a row a sample")
    return best


def table_of(body: list[tuple[int, list[str]]], form: Form, width: int, path: Path) -> Array:
    """The numbers of rows with the numbers of their lines, (rows, width); the first that is none is refused."""
    table = []
    for number, row in body:
        values = form.numbers(row) if len(row) == width else None
        if values is None:
            wrong = next((field for field in row if form.numbers([field]) is None), None)
            fault = f"holds {shown(wrong)}" if wrong is not None else f"has {len(row)} fields where {width} are needed"
            raise InputError(
                f"{path}, line {number}: {fault}, where a table of numbers goes on: mend or delete the line; where a "
                "second test begins, write it to a file of its own"
            )
        table.append(values)
    return np.array(table)


def _header(rows: list[list[str]], width: int, empty_end: bool) -> tuple[list[str], list[str]]:
    """Names and units of the columns from the lines above the numbers, those next to them first."""
    names, given = [""] * width, [""] * width
    for row in reversed(rows):
        # A trailing delimiter may stand behind the header and not behind the numbers, or the other way.
        fields = (row + [""] * empty_end)[:width] if not any(row[width:]) else row
        if len(fields) != width or not any(fields):
            break
        bare = [field.strip("[]() ") for field in fields]
        if sum(units.find(field) is not None for field in bare) > sum(bool(field) for field in bare) / 2:
            given = bare
            continue
        found = [None if part_of(field)[1] else _IN_BRACKETS.match(field) for field in fields]
        names = [match[1] if match else field for match, field in zip(found, fields, strict=True)]
        given = [(match[2].strip() if match else "") or old for match, old in zip(found, given, strict=True)]
        break
    return names, given
