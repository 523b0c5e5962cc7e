"""From columns and what is said of them to the runs of a test, in SI units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.errors import InputError, refuse
from sysid.files import units
from sysid.files.description import Channel, Description
from sysid.files.recorded_test import RecordedTest, Row, Run
from sysid.files.recording import Column, Recording, check_finite, rate_of
from sysid.structure.axes import BASE_AXES, base_columns, rigid_motion, sensor_row
from sysid.structure.sensor import Sensor
from sysid.structure.structure import Array

_TIME_NAMES = {"time", "t", "zeit", "temps", "tiempo", "tempo", "time stamp", "timestamp", "elapsed time"}
_TURNS = {True: ("angular acceleration",), False: ("acceleration",)}


def in_time(recordings: Sequence[Recording], said: Description) -> RecordedTest:
    """The test of recordings in time, a run each.

    Raises
    ------
    InputError
        Where roles or axes are not said, a column or a rate is missing, a unit is unknown or of something else.
    """
    refuse((not said.channels, undescribed(recordings[0])))
    axes = base_directions(said)
    runs, table, rates, remarks = [], [], [], []
    for recording in recordings:
        rates.append(_rate(recording, said))
        records, rows = _records(recording, said)
        table += rows
        remarks += [f"{recording.path}: {remark}" for remark in recording.remarks]
        runs.append(_run(records, said, axes, recording))
    if max(rates) - min(rates) > 1e-6 * max(rates):
        raise InputError(
            f"{recordings[int(np.argmax(rates))].path} is sampled at {max(rates):g} Hz and "
            f"{recordings[int(np.argmin(rates))].path} at {min(rates):g} Hz: bring them to one rate, or read them apart"
        )
    return RecordedTest(tuple(runs), sensors_of(said), axes, said.origin, rates[0], None, tuple(table), tuple(remarks))


def undescribed(recording: Recording) -> str:
    """What to say where nothing tells which column is which sensor."""
    return (
        f"{recording.path}: which column is which sensor is not said; {recording.in_words()}. Say it in a TOML file "
        "(--sensors FILE.toml), or with --sensor COLUMN role=response axis=x position=0,0,3 unit=g for each; 'sysid "
        "read --help' shows such a file"
    )


def sensors_of(said: Description) -> tuple[Sensor, ...]:
    """The sensors of the responses, each once."""
    found = {channel.name: channel for channel in said.channels if channel.role == "response"}
    return tuple(Sensor(channel.name, channel.position, channel.axis) for channel in found.values())


def base_directions(said: Description) -> tuple[str, ...]:
    """Names of the base's directions: stated, or those of the base channels."""
    base = [channel for channel in said.channels if channel.role == "base"]
    refuse(
        (not base, f'{said.place}: no sensor has role = "base": the motion of the table is needed'),
        (
            not any(channel.role == "response" for channel in said.channels),
            f'{said.place}: no sensor has role = "response": a sensor on the structure is needed',
        ),
    )
    if said.base_axes is not None:
        return tuple(BASE_AXES[column] for column in base_columns(said.base_axes))
    oblique = next((channel for channel in base if not isinstance(channel.axis, str)), None)
    refuse((oblique is not None, f"{said.place}: base_axes is needed where a base sensor stands along a vector"))
    letters = {str(channel.axis).lstrip("+-") for channel in base}
    return tuple(name for name in BASE_AXES if name in letters)


def _rate(recording: Recording, said: Description) -> float:
    column = _time_column(recording, said)
    if column is None:
        rate = said.sample_rate or recording.sample_rate
        if rate is None:
            raise InputError(
                f'{recording.path} has no column of time that is named so: state time = "ITS NAME" or sample_rate, in '
                f"Hz (--time, --rate); {recording.in_words()}"
            )
        return rate
    known = units.find(column.unit) if column.unit else units.UNITS["s"]
    if known is None or known.quantity != "time":
        raise InputError(f"{recording.path}, {column.place}: time in {column.unit!r} is not understood: s, ms, us are")
    check_finite(column, recording.path)
    rate = rate_of(np.real(column.values) * known.factor, recording.path, column.place)
    if said.sample_rate is not None and abs(rate / said.sample_rate - 1) > 0.01:
        raise InputError(
            f"{recording.path}, {column.place}: time tells {rate:g} Hz and sample_rate {said.sample_rate:g} Hz; is "
            "time in another unit than s? State one of them"
        )
    return said.sample_rate or _round(rate, column.values.size)


def _round(rate: float, samples: int) -> float:
    """The rate without what rounding of the times in a file adds to it."""
    near = float(f"{rate:.6g}")
    return near if abs(near / rate - 1) * samples < 0.05 else rate


def _time_column(recording: Recording, said: Description) -> Column | None:
    if said.time is not None:
        return recording.column(said.time)
    used = {str(channel.column) for channel in said.channels}
    found = [column for column in recording.columns if column.name.lower() in _TIME_NAMES and column.name not in used]
    return found[0] if len(found) == 1 and said.sample_rate is None else None


def _records(recording: Recording, said: Description) -> tuple[list[Array], list[Row]]:
    """The record of each channel in SI units, and its row of the table."""
    records: list[Array] = []
    rows: list[Row] = []
    for channel in said.channels:
        column = recording.column(channel.column)
        check_finite(column, recording.path)
        factor, unit = _factor(recording, column, channel)
        record = factor * np.real(column.values)
        rms = float(np.std(record))
        if channel.role != "force" and rms == 0.0:
            raise InputError(
                f"{recording.path}, {column.place}: the record of {channel.name!r} never moves: is it the right "
                "column? Else leave it out"
            )
        records.append(record)
        rows.append(row_of(column, channel, unit, factor, rms, recording))
    return records, rows


def row_of(column: Column, channel: Channel, unit: str, factor: float, rms: float, recording: Recording) -> Row:
    """A row of the table of channels."""
    axis = channel.axis if isinstance(channel.axis, str) else " ".join(f"{part:g}" for part in channel.axis)
    return Row(column.name, channel.name, channel.role, axis, unit, factor, rms, recording.path.name)


def _factor(recording: Recording, column: Column, channel: Channel) -> tuple[float, str]:
    """Factor of a channel to SI, and its unit; what is said and what stands in the file must agree."""
    place = f"{recording.path}, {column.place}"
    in_file = units.find(column.unit) if column.unit else None
    text = channel.unit or column.unit
    if not text:
        raise InputError(f'{place}: no unit is stated: add unit = "g", "m/s²", "N" or the like to the sensor')
    known = units.unit(text, place)
    if channel.unit and in_file is not None and in_file != known:
        raise InputError(
            f"{place}: the file says {column.unit!r} and the description {channel.unit!r}: mend one of them, or leave "
            "unit out of the description"
        )
    turns = isinstance(channel.axis, str) and "r" in channel.axis
    wanted = ("moment" if turns else "force") if channel.role == "force" else _TURNS[turns][0]
    if known.quantity != wanted:
        raise InputError(
            f"{place}: {text!r} is a {known.quantity}, and a {channel.role} sensor along {channel.axis} gives "
            f"a {wanted}{'; sysid takes accelerations in time' if channel.role != 'force' else ''}"
        )
    return known.factor, text


def motions(channels: Sequence[Channel], axes: Sequence[str], origin: Sequence[float]) -> Array:
    """What channels show of unit motions of the base in its directions, (channels, d)."""
    points = np.array([channel.position for channel in channels])
    rows = rigid_motion(points, origin).reshape(len(points), 6, 6)
    ways = [sensor_row(channel.axis, channel.name) for channel in channels]
    return np.array([way @ row for way, row in zip(ways, rows, strict=True)])[:, base_columns(list(axes))]


def base_and_force(
    said: Description, axes: Sequence[str], base: Array, force: Array | None, place: str
) -> tuple[Array, Array | None]:
    """Motion of the base point from its sensors by least squares, and the sum of the load cells, each (d, n)."""
    seen = motions([channel for channel in said.channels if channel.role == "base"], axes, said.origin)
    if np.linalg.matrix_rank(seen) < len(axes):
        raise InputError(
            f"{place}: the base's sensors do not show its motion along {' '.join(axes)}: each direction needs one"
        )
    moved = base if np.array_equal(seen, np.eye(len(axes))) else np.linalg.pinv(seen) @ base
    if force is None:
        return moved, None
    cells = motions([channel for channel in said.channels if channel.role == "force"], axes, said.origin)
    unseen = [axis for axis, column in zip(axes, cells.T, strict=True) if not np.any(column)]
    refuse((unseen, f"{place}: no force sensor acts along {' '.join(unseen)}: measure it there too, or give no force"))
    return moved, cells.T @ force


def _run(records: list[Array], said: Description, axes: Sequence[str], recording: Recording) -> Run:
    by_role = {
        role: [record for record, channel in zip(records, said.channels, strict=True) if channel.role == role]
        for role in ("base", "response", "force")
    }
    force = np.array(by_role["force"]) if by_role["force"] else None
    base, force = base_and_force(said, axes, np.array(by_role["base"]), force, str(recording.path))
    return base, np.array(by_role["response"]), force
