"""Files as other programs write them, by the published descriptions of their formats, and nothing of `sysid`.

Every number is written with so many decimals; what stands in the file is what is to be read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

SAMPLES = 240


def rounded(values: np.ndarray, decimals: int = 6) -> np.ndarray:
    """Values as they stand in a file of so many decimals."""
    return np.array([float(f"{one:.{decimals}f}") for one in np.ravel(values)]).reshape(np.shape(values))


@dataclass(frozen=True)
class Lvm:
    """A LabVIEW measurement file: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)"."""

    names: Sequence[str]
    units: Sequence[str]
    segments: Sequence[np.ndarray]  # (channels, n) each
    rate: float = 128.0
    separator: str = "\t"
    comma: bool = False
    x_columns: str = "One"
    gaps: Sequence[float] = ()  # s before each segment but the first
    headings: bool = True  # one a segment
    special: str = ""
    comment: str = ""
    samples: Sequence[int] | None = None
    steps: Sequence[float | str] | None = None
    x_unit: str = ""
    dimension: str = "Time"
    replaced: dict[str, str] = field(default_factory=dict)
    end: str = "\r\n"

    def text(self) -> str:
        """The content of the file."""
        s = self.separator
        named = {"\t": "Tab", ",": "Comma"}[s]
        head = ["LabVIEW Measurement", "Writer_Version|2", "Reader_Version|2", f"Separator|{named}",
                f"Decimal_Separator|{',' if self.comma else '.'}", f"Multi_Headings|{'Yes' if self.headings else 'No'}",
                f"X_Columns|{self.x_columns}", "Time_Pref|Relative", "Operator|Müller", "Date|2026/03/17",
                "Time|10:45:47.0352557312499836422", "***End_of_Header***|", "|"]  # fmt: skip
        lines, begin, x0 = [line.replace("|", s) for line in head], 0.0, 0.0
        for at, values in enumerate(self.segments):
            begin += self.gaps[at - 1] if at and self.gaps else 0.0
            if at == 0 or self.headings:
                lines += self._heading(values, begin)
                x0 = 0.0
            lines += self._rows(values, x0)
            lines += [""] * self.headings
            begin += values.shape[1] / self.rate
            x0 += values.shape[1] / self.rate
        text = self.end.join([*lines, ""])
        for old, new in self.replaced.items():
            assert old in text, old
            text = text.replace(old, new, 1)
        return text

    def _heading(self, values: np.ndarray, begin: float) -> list[str]:
        count, s = len(self.names), self.separator
        gap = s if self.x_columns == "Multi" else ""
        per = lambda tag, each: f"{tag}{s}" + f"{s}{gap}".join(map(str, each)) + s  # noqa: E731
        scale = {"": 1.0, "ms": 1e3}[self.x_unit]
        steps = self.steps or [scale / self.rate] * count
        seconds = 47.0352557312499836422 + begin
        time = f"10:{45 + int(seconds // 60)}:{seconds % 60:.13f}"
        numbers = [
            per("X0", ["0.0000000000000000E+0"] * count),
            per("Delta_X", [step if isinstance(step, str) else f"{step:.9E}" for step in steps]),
        ]
        tags = [f"Channels{s}{count}{s * count}", per("Samples", self.samples or [values.shape[1]] * count),
                per("Date", ["2026/03/17"] * count), per("Time", [time] * count),
                *([per("X_Unit_Label", [self.x_unit] * count)] if self.x_unit else []),
                per("Y_Unit_Label", self.units), per("X_Dimension", [self.dimension] * count), *numbers]  # fmt: skip
        tags = [line.replace(".", ",") if self.comma and not line.startswith("Y_") else line for line in tags]
        special = ["***Start_Special***", *self.special.split("\n"), "***End_Special***"] if self.special else []
        labels = f"{s}X_Value{s}".join(self.names) if gap else s.join(self.names)
        return [*special, *tags, f"***End_of_Header***{s * (count + 1)}", f"X_Value{s}{labels}{s}Comment"]

    def _rows(self, values: np.ndarray, x0: float) -> list[str]:
        scale, lines = {"": 1.0, "ms": 1e3}[self.x_unit], []
        for at, row in enumerate(values.T):
            x = "" if self.x_columns == "No" else f"{scale * (x0 + at / self.rate):.6f}"
            cells = ["" if np.isnan(one) else f"{one:.6f}" for one in row]
            line = f"{self.separator}{x}{self.separator}" if self.x_columns == "Multi" else self.separator
            text = x + self.separator + line.join(cells) + (self.separator + self.comment if self.comment else "")
            lines.append(text.replace(".", ",") if self.comma else text)
        return lines


@dataclass(frozen=True)
class StrongMotion:
    """A Volume 2 file of the CSMIP format: OSMS 85-03 by Shakal and Huang, and as the CESMD gives them out.

    25 lines of text, 100 integers in 16I5, 100 reals in 8F10, then acceleration, velocity, displacement in 8F10.
    """

    channels: Sequence[str]  # what stands behind "Chan  1:"
    values: np.ndarray  # (channels, n), cm/s²
    step: float = 0.01
    old: bool = False  # in capitals, without a FORTRAN format, as in the eighties
    unit: str = "cm/sec2"
    count: int | None = None
    first: int = 1
    end: str = "\n"

    def text(self) -> str:
        """The content of the file."""
        lines: list[str] = []
        for at, (name, row) in enumerate(zip(self.channels, self.values, strict=True), self.first):
            lines += self._channel(at, name, row)
        return self.end.join([*lines, ""])

    def _channel(self, number: int, name: str, row: np.ndarray) -> list[str]:
        n = row.size
        chan = f"Chan {number:2d}:  {name}"
        text = [f"Corrected accelerogram   24386-C0133-94017.01       {chan:<18}from", "Uncorrected Accelerogram Data",
                "Rcrd of Mon Jan 17, 1994 04:30:55.0 PST", "Northridge Earthquake", "24386-C0133-94017.01",
                "Station No. 24386   34.221N, 118.471W   CRA-1   s/n 133  (16 Chns of 16 at Sta)",
                "Van Nuys - 7-story Hotel                  CGS   Data: Acceleration", chan,
                "Rcrd of Mon Jan 17, 1994", "Hypocenter: 34.209 118.541 H=18km", "Instr Period =  .0102 sec",
                f"                        Record length = {n * self.step:.3f} sec.", "", "",
                "Accelerogram bandpass filtered with 3 dB pts at   .12 and 46.00 cyc/sec",
                f"{n:6d} points of instrument- and baseline-corrected accel, veloc and displ data",
                f"At equally-spaced intervals of {self.step:7.3f}  sec.", "", "", "", "", "", "", "", ""]  # fmt: skip
        integers = [number, 100, number, *[0] * 49, n, *[0] * 10, n, 0, n, *[-999] * 34]
        reals = [*[-999.0] * 60, self.step, *[0.0] * 39]
        lines = [line.ljust(80) for line in text] + _fields(integers, 16, lambda one: f"{one:5d}")
        lines += _fields(reals, 8, lambda one: _fortran(one, 7))
        velocity = np.cumsum(row) * self.step
        for what, values, unit in (
            ("accel", row, self.unit), ("veloc", velocity, "cm/sec"), ("displ", np.cumsum(velocity) * self.step, "cm"),
        ):  # fmt: skip
            count = self.count if what == "accel" and self.count is not None else n
            start = f"{count:6d} points of {what} data equally spaced at {_fortran(self.step, 3).strip():>5} sec"
            modern = f"{start}, in {unit}. (8f10.6)" if unit else f"{start}. (8f10.6)"
            lines.append(f"{start}. (UNITS: {unit})".upper() if self.old else modern.ljust(80))
            lines += _fields(values.tolist(), 8, lambda one: _fortran(one, 6))
        end = f"/&  ----------  End of data for channel {number:2d}  ----------"
        lines.append(end.upper() if self.old else end)
        return lines


def _fields(values: Sequence[Any], each: int, form: Any) -> list[str]:
    return ["".join(map(form, values[at : at + each])) for at in range(0, len(values), each)]


def _fortran(value: float, decimals: int) -> str:
    """As F10 of FORTRAN: no zero before the point, fewer decimals where they do not fit."""
    while decimals >= 0:
        text = f"{value:.{decimals}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{decimals}f}"
        if len(text) <= 10:
            break
        decimals -= 1
    return text.rjust(10)


def strong_motion_values(values: np.ndarray) -> np.ndarray:
    """Accelerations as they stand in a file, cm/s²."""
    return np.array([float(_fortran(one, 6)) for one in np.ravel(values)]).reshape(np.shape(values))


def matlab_7_3(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """A MATLAB file of version 7.3: HDF5 behind 512 bytes of text, arrays column by column."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            data = file.create_dataset(name, data=np.atleast_2d(array).T)
            data.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Tue Mar 17 10:45:47 2026 HDF5 schema 1.00 .")


def xsens_dot(time: np.ndarray, acceleration: np.ndarray) -> str:
    """An export of an Xsens DOT unit, gravity along z; its first row holds zeros."""
    head = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    rows = [
        f"{at},{1e6 * t:.0f},{a:.6f},0.000000,9.806650,0,0,0"
        for at, (t, a) in enumerate(zip(time, acceleration, strict=True))
    ]
    return "\n".join(["DeviceTag:,1", "", head, "0,0,0,0,0,0,0,0", *rows, ""])
