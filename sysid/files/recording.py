"""Content of a file before it is known what measured it: named columns in time or over frequency."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, listed, refuse
from sysid.structure.structure import Array


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
    form : str
        Of a frequency response, where the file says it: see `sysid.files.responses`.
    position : tuple of float or None
        m, where the file holds the geometry.
    axis : str
        Where the file states it.
    """

    name: str
    values: NDArray[Any]
    unit: str
    place: str
    reference: str = ""
    form: str = ""
    position: tuple[float, float, float] | None = None
    axis: str = ""


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
    remarks: tuple[str, ...] = field(default=())

    @property
    def names(self) -> list[str]:
        """Of its columns."""
        return [column.name for column in self.columns]

    def column(self, wanted: str | int) -> Column:
        """The column of a name, or of a number from 1.

        Raises
        ------
        InputError
            Where there is none, or several of the name; lists what there is.
        """
        if isinstance(wanted, int) or (wanted.isdecimal() and wanted not in self.names):
            number = int(wanted)
            if not 1 <= number <= len(self.columns):
                raise InputError(f"{self.path} has no column {number}: {self.in_words()}")
            return self.columns[number - 1]
        found = [column for column in self.columns if column.name == wanted]
        if not found:
            raise InputError(f"{self.path} has no column {wanted!r}: {self.in_words()}")
        if len(found) > 1:
            raise InputError(
                f"{self.path} has {len(found)} columns named {wanted!r}: name them by their numbers from 1"
            )
        return found[0]

    def in_words(self) -> str:
        """Number of columns, and what they are called."""
        left_out = "".join(f" ({remark})" for remark in self.remarks[:1])
        plural = "s" * (len(self.names) != 1)
        return f"it has {len(self.names)} column{plural}, {listed([*map(repr, self.names)])}{left_out}"


def check_column(column: Column, path: Path) -> None:
    """Refuse a column with a number that is NaN or infinite, with its place."""
    bad = np.flatnonzero(~np.isfinite(column.values))
    if bad.size:
        raise InputError(
            f"{path}, {column.place}: sample {bad[0] + 1} of {column.values.size} is {column.values[bad[0]]} "
            f"({bad.size} such): cut the record there, or leave this sensor out"
        )


def rate_of(time: Array, path: Path, place: str) -> float:
    """Sample rate of a time column in s, Hz; numbers rounded to a quarter of a step are even.

    Raises
    ------
    InputError
        Where time does not rise, or its steps are uneven: says at which sample.
    """
    refuse((time.size < 3, f"{path}: {time.size} samples are no record: is it the right file, and whole?"))
    falls = np.flatnonzero(np.diff(time) <= 0)
    if falls.size:
        before, after = time[falls[0]], time[falls[0] + 1]
        cause = "two tests in one file? Write each to a file of its own"
        if after == before:
            cause = "a sample twice, or times that are rounded? State sample_rate in place of time (--rate)"
        elif falls.size > time.size / 2:
            cause = "it runs backwards: is it the right column?"
        raise InputError(
            f"{path}, {place}: time does not rise at sample {falls[0] + 2} ({before:g}, then {after:g} s): {cause}"
        )
    step = (time[-1] - time[0]) / (time.size - 1)
    late = np.abs(time - time[0] - step * np.arange(time.size))
    if np.max(late) > max(0.25 * step, 1e-6):
        at = int(np.argmax(np.abs(np.diff(time) - np.median(np.diff(time)))))
        raise InputError(
            f"{path}, {place}: steps of time are uneven, most at sample {at + 2} ({time[at + 1] - time[at]:g} s after "
            f"the one before, {step:g} s on average): samples are missing, or bring it to one clock with sysid.resample"
        )
    return float(1 / step)
