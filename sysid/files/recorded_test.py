"""A test as it was recorded, in SI units and with its sensors: what ``test.h5`` holds.

Records in time stay records, so that whoever identifies from them chooses the estimator and the band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors import InputError, as_float, finite_array, refuse
from sysid.files.tree import Tree, from_bytes, is_tree, to_bytes
from sysid.measurement.damaged_runs import DamagedChannel, damage_of_runs, names_of_channels
from sysid.measurement.excited_band import excited_band
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import TimeRun
from sysid.structure.sensor import (
    BASE_AXES,
    BaseSensor,
    Sensor,
    base_columns,
    rigid_body,
    sensors_from_tree,
    sensors_to_tree,
)
from sysid.structure.structure import Array

_FORMAT = 1
_CONTENT = "recorded test"

Run = tuple[Array, Array, Array | None]


@dataclass(frozen=True)
class ChannelRow:
    """One channel in the table of what was read; `unit`, `factor` to SI are the file's, `rms` is SI, without a mean."""

    column: str
    sensor: str
    role: str
    axis: str
    unit: str
    factor: float
    rms: float
    source: str


@dataclass(frozen=True, eq=False)
class RecordedTest:
    """Runs of a base-shake test.

    Attributes
    ----------
    runs : tuple of (base, response, force or None)
        (d, n), (n_sensors, n), (d, n): m/s² and N in time, or complex spectra.
    sensors : tuple of Sensor
        Of the responses.
    base_axes : tuple of str
    origin : tuple of float
        The base point, m.
    sample_rate, freq : float or None, (n,) or None
        Hz: one of both, of records in time or of spectra.
    table : tuple of ChannelRow
        Of all channels, file by file.
    remarks : tuple of str
        What was left out, recognised or mended.
    base_gain_std, force_gain_std : (d,) or None
        Tolerances of gains: see `Measurement`; sensors state theirs.
    base_sensors : tuple of BaseSensor
        In time: see `Measurement`.
    response_std, force_std : (runs, n_sensors, n), (runs, d, n) or None
        Standard deviations of spectra, by the coherences of their files.
    averaged : bool
        Whether spectra are averages over segments under a window.
    window : str
        See `Measurement`.
    """

    runs: tuple[Run, ...]
    sensors: tuple[Sensor, ...]
    base_axes: tuple[str, ...]
    origin: tuple[float, ...]
    sample_rate: float | None
    freq: Array | None
    table: tuple[ChannelRow, ...]
    remarks: tuple[str, ...] = ()
    base_gain_std: Array | None = None
    force_gain_std: Array | None = None
    base_sensors: tuple[BaseSensor, ...] = ()
    response_std: Array | None = None
    force_std: Array | None = None
    averaged: int = False
    window: str = ""

    @property
    def excited_band(self) -> tuple[float, float] | None:
        """The band that the base excites, Hz (`sysid.excited_band`); None of spectra.

        From four periods a record on, as drift of up to two leaks into the lines below.
        """
        if self.sample_rate is None:
            return None
        low, high = excited_band(self.runs, self.sample_rate)
        longest = max(base.shape[1] for base, *_ in self.runs)
        return min(max(low, 3.999 * self.sample_rate / longest), high), high

    @property
    def damage(self) -> list[DamagedChannel]:
        """Damaged samples of the records in time; none of spectra."""
        if self.sample_rate is None:
            return []
        G = rigid_body(sensors=self.sensors, base_axes=self.base_axes, origin=self.origin)
        names = names_of_channels(self.sensors, G, self.base_axes)
        return damage_of_runs([TimeRun(*run) for run in self.runs], self.sample_rate, names)

    def measurement(self, **options: Any) -> Measurement:
        """The measurement; `options` are those of `Measurement.from_time`, of spectra ``band`` alone.

        Without a band whole records are fitted in that which the base excites.
        """
        G = rigid_body(sensors=self.sensors, base_axes=self.base_axes, origin=self.origin)
        given: Any = {"rigid_body": G, "sensors": self.sensors, "base_axes": self.base_axes}
        tolerances: Any = {"base_gain_std": self.base_gain_std, "force_gain_std": self.force_gain_std}
        if self.freq is None:
            assert self.sample_rate is not None
            if options.get("estimator", "records") == "records" and options.get("band") is None:
                options["band"] = self.excited_band
            test = Measurement.from_time(self.runs, self.sample_rate, **given, **options)
            return replace(test, base_sensors=self.base_sensors, **tolerances)
        band = options.pop("band", None)
        if options:
            raise InputError(f"{', '.join(options)}: only records in time take it, and these are spectra")
        parts: Any = zip(*self.runs, strict=True)
        base, response, force = (None if part[0] is None else np.stack(part) for part in parts)
        given |= dict(response_std=self.response_std, force_std=self.force_std)
        given |= dict(averaged=self.averaged, window=self.window)
        test = Measurement(self.freq, base, response, force=force, **given, **tolerances)  # type: ignore[arg-type]
        return test if band is None else test.in_band(*band)

    def in_words(self) -> str:
        """The table of channels, and what there is of them."""
        heads = ("column", "sensor", "role", "axis", "unit", "factor to SI", "rms (SI)", "file")
        rows = [
            (row.column, row.sensor, row.role, row.axis, row.unit, f"{row.factor:.6g}", f"{row.rms:.4g}", row.source)
            for row in self.table
        ]
        widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
        lines = ["  ".join(f"{word:{size}}" for word, size in zip(row, widths, strict=True)) for row in (heads, *rows)]
        return "\n".join([*(line.rstrip() for line in lines), "", *self.remarks, self._size()])

    def _size(self) -> str:
        runs = f"{len(self.runs)} run{'s' if len(self.runs) > 1 else ''}"
        force = "with base force" if self.runs[0][2] is not None else "without base force"
        parts = f"{len(self.sensors)} sensors, base moving along {' '.join(self.base_axes)}, {force}"
        if self.freq is not None:
            return f"{runs} of spectra: {parts}, {self.freq.size} lines from {self.freq[0]:g} to {self.freq[-1]:g} Hz"
        lengths = ", ".join(f"{run[0].shape[1] / (self.sample_rate or 1):.4g}" for run in self.runs[:5])
        return f"{runs} in time: {parts}, {lengths}{', ...' if len(self.runs) > 5 else ''} s at {self.sample_rate:g} Hz"

    def to_bytes(self) -> bytes:
        """The file ``test.h5``."""
        return to_bytes(
            {
                "content": _CONTENT,
                "runs": [{"base": base, "response": response, "force": force} for base, response, force in self.runs],
                "sensors": sensors_to_tree(self.sensors),
                "base_axes": self.base_axes,
                "origin": np.array(self.origin),
                "sample_rate": self.sample_rate,
                "freq": self.freq,
                "table": [vars(row) for row in self.table],
                "remarks": list(self.remarks),
                "base_gain_std": self.base_gain_std,
                "force_gain_std": self.force_gain_std,
                "base_sensors": [one._asdict() for one in self.base_sensors],
                "std": {"response": self.response_std, "force": self.force_std},
                "averaged": self.averaged,
                "window": self.window,
            },
            _FORMAT,
        )

    @classmethod
    def from_tree(cls, tree: Tree) -> RecordedTest:
        """The test of the tree that a file holds."""
        runs = tuple((run["base"], run["response"], run["force"]) for run in tree["runs"])
        table, std = tuple(ChannelRow(**row) for row in tree["table"]), tree.get("std", {})
        test = cls(
            runs, sensors_from_tree(tree["sensors"]) or (),
            tuple(BASE_AXES[column] for column in base_columns(tree["base_axes"])), tuple(tree["origin"].tolist()),
            tree["sample_rate"], tree["freq"], table, tuple(tree["remarks"]), tree.get("base_gain_std"),
            tree.get("force_gain_std"), tuple(BaseSensor(**one) for one in tree.get("base_sensors", ())),
            std.get("response"), std.get("force"), tree.get("averaged", False), tree.get("window", ""),
        )  # fmt: skip
        test._check()
        return test

    def _check(self) -> None:
        """Refuse a test whose records do not fit each other: a file may be of somebody else's writing."""
        freq, wanted = self.freq, (len(self.base_axes), len(self.sensors), len(self.base_axes))
        if freq is None:
            as_float("sample_rate", self.sample_rate, "a positive number in Hz", above=0)
        refuse((not self.runs or any(run[0] is None or run[1] is None for run in self.runs), "a run has no records"))
        for run in self.runs:
            n = np.shape(run[0])[-1] if freq is None else len(freq)
            for name, record, rows in zip(("base", "response", "force"), run, wanted, strict=True):
                if record is not None:
                    shape = finite_array(f"{name} of a run", record, float if freq is None else complex).shape
                    refuse((shape != (rows, n), f"{name} of a run is {shape}: ({rows}, {n}) is needed"))


def is_recorded_test(path: str | Path) -> bool:
    """True where a file of sysid's holds a test, False where it holds something else; errors as of `load`."""
    return _tree(Path(path)).get("content") == _CONTENT


def load(path: str | Path) -> RecordedTest:
    """Read a ``test.h5`` again.

    Raises
    ------
    InputError
        Where it is missing, damaged, or something else.
    """
    file = Path(path)
    tree = _tree(file)
    content = tree.get("content", "result")
    refuse((content != _CONTENT, f"{file} holds a {content}, not a test: give what 'sysid read' wrote"))
    try:
        return RecordedTest.from_tree(tree)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    except Exception as error:  # what is sound HDF5 and no test may lack anything
        raise InputError(f"{file} holds no whole test ({type(error).__name__}: {error}): write it again") from error


def _tree(file: Path) -> dict[str, Any]:
    refuse((file.exists() and not file.is_file(), f"{file} is no file"))
    try:
        image = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}") from None
    makes = f"'sysid read {file} --sensors SENSORS.toml --out test.h5' makes one"
    refuse((not is_tree(image), f"{file} is not a test that sysid wrote: {makes}"))
    try:
        return from_bytes(image)[0]
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
