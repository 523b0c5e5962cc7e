"""From columns and what is said of them to the runs of a test, in SI units."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, refuse
from sysid.files import units
from sysid.files.alignment import UnitColumns, clock_moves
from sysid.files.description import ROLES, Channel, Description
from sysid.files.recorded_test import ChannelRow, RecordedTest, Run
from sysid.files.recording import Column, Recording, check_column, is_abscissa, is_time, rate_of
from sysid.measurement.spectra import FORCE_NEEDED, TimeRun, on_one_clock
from sysid.measurement.whole import tapered
from sysid.structure.sensor import BASE_AXES, BaseSensor, Sensor, base_columns, rigid_body, rigid_motion, sensor_row
from sysid.structure.structure import Array

_CLEAR_POWER = 0.5  # of the power of all lines, whatever its sign
# What a sensor records in time, by whether it is of a force and of a rotation.
_QUANTITIES = {
    (False, False): "acceleration", (False, True): "angular acceleration",
    (True, False): "force", (True, True): "moment",
}  # fmt: skip


def assembled_in_time(recordings: Sequence[Recording], said: Description) -> RecordedTest:
    """The test of recordings in time, a run each.

    Raises
    ------
    InputError
        Where roles or axes are not said, a column or a rate is missing, a unit is unknown or of something else.
    """
    said, remarks = described(recordings, said)
    spectral = [word for word in ("frf", "convention", "window", "averages") if getattr(said, word)]
    refuse((spectral, f"{said.place}: {', '.join(spectral)}: said of spectra, and the files hold records in time"))
    axes = base_directions(said)
    runs, table, rates, of_base = list[Run](), [], [], list[tuple[BaseSensor, ...]]()
    for recording in recordings:
        rates.append(recorded_rate(recording, said))
        records, rows = _records(recording, said)
        late = np.array([channel.delay for channel in said.channels])
        if np.any(late):
            records = list(on_one_clock(np.array(records), late, rates[-1], f" of {recording.path}"))
        table += rows
        plain = [column for column in _time_columns(recording, said) if not column.unit]
        remarks += [f"{recording.path}, {column.place}: time has no unit, and is taken as s" for column in plain]
        with contextlib.suppress(InputError):  # where the file tells no rate
            told = recorded_rate(recording, replace(said, sample_rate=None))
            words = f"{recording.path} tells {told:g} Hz, and the {rates[-1]:g} Hz that are stated are taken"
            remarks += [words] * (abs(told / rates[-1] - 1) > 0.01)
        parts = list(zip(said.channels, records, strict=True))
        run = run_of(parts, said, axes, str(recording.path))
        twice = [one.path for one, other in zip(recordings, runs, strict=False) if np.array_equal(other[1], run[1])]
        words = "holds the same records: a run that counts twice makes intervals too narrow"
        remarks += [f"{recording.path}, beside {one}, {words}" for one in twice[:1]]
        runs.append(run)
        moving = [(channel, record - record.mean()) for channel, record in parts]  # an offset is no motion
        of_base.append(base_differences(moving, said, axes, str(recording.path)))
        remarks += _differences_in_words(of_base[-1], axes, str(recording.path))
    slow, fast = (recordings[int(at(rates))].path for at in (np.argmin, np.argmax))
    words = f"{fast} is sampled at {max(rates):g} Hz and {slow} at {min(rates):g} Hz: bring them to one rate, or read"
    refuse((max(rates) - min(rates) > 1e-6 * max(rates), f"{words} them apart"))
    remarks += [*delays_in_words(said), *work_of_force(*_spectra(runs, rates[0])), *_ends(runs, said, axes)]
    return RecordedTest(
        tuple(runs), sensors_of(said), axes, said.origin, rates[0], None, tuple(table), tuple(remarks),
        base_sensors=max(of_base, key=lambda run: max((abs(one.gain - 1) for one in run), default=0.0)),
        **tolerances_of(said, axes),
    )  # fmt: skip


def delays_in_words(said: Description) -> list[str]:
    """A remark on each channel whose delay is stated, and taken off."""
    late = [channel for channel in said.channels if channel.delay]
    return [f"{one.column} is {1e3 * one.delay:.6g} ms late as stated; that is taken off" for one in late]


def _ends(runs: Sequence[Run], said: Description, axes: Sequence[str]) -> list[str]:
    """A remark where a window seems to lie over a run, else where all records begin and end at rest.

    At rest: they hardly move in their first and last hundredth, in which short fades move still.
    """
    G = rigid_body(sensors=sensors_of(said), base_axes=axes, origin=said.origin)
    words = "a window seems to have been laid over the records, which are then no motion of the structure"
    if any(tapered(_without_padding(TimeRun(*run)), G) for run in runs):
        return [f"{words}; export them without it"]
    records = [row for run in runs for part in run if part is not None for row in part]
    ends = [np.delete(row, slice(n, -n)) for row in records if (n := max(row.size // 100, 5))]
    still = all(np.std(end) < 0.01 * np.std(row) for end, row in zip(ends, records, strict=True))
    return ["the records begin and end at rest: 'sysid run --at-rest' takes them so"] * still


def _without_padding(run: TimeRun) -> TimeRun:
    """The run without the samples at its ends where all channels are zero, as windows leave them too."""
    moves = np.flatnonzero(np.any(np.vstack([run.base, run.outputs]), axis=0))
    return TimeRun(*(None if part is None else part[:, moves[0] : moves[-1] + 1] for part in run))  # type: ignore[arg-type]


def _spectra(runs: Sequence[Run], rate: float) -> tuple[list[Any], Array]:
    """Spectra of base and force over the length of the shortest run, and their lines in Hz, without 0 and the last."""
    n = min(run[0].shape[1] for run in runs)
    both = [(base, force) for base, _, force in runs if force is not None]
    spectra = [[np.fft.rfft(part[:, :n])[:, 1:-1] for part in pair] for pair in both]
    return [(base, base, force) for base, force in spectra], np.fft.rfftfreq(n, 1 / rate)[1:-1]


def described(recordings: Sequence[Recording], said: Description) -> tuple[Description, list[str]]:
    """The description with axes and positions that the first file tells and it does not, and all remarks so far.

    Raises
    ------
    InputError
        Nothing is said of the channels; a column that is missing; an axis that neither tells; a sensor without position
        on a base that turns.
    """
    recording = recordings[0]
    words = f"which column is which sensor is not said; {recording.in_words()}. Say it in a TOML file (--sensors FILE)"
    words += ", or with --sensor COLUMN role=response axis=x position=0,0,3 unit=g for each; 'sysid read --help' shows "
    refuse((not said.channels, f"{recording.path}: {words}such a file"))
    channels, remarks = [], []
    for at, channel in enumerate(said.channels, 1):
        named = [column for column in recording.columns if column.name == str(channel.column)]
        column = named[0] if named else recording.column(channel.column)
        axis = channel.axis or column.axis
        words = f"axis is missing, and {recording.path} does not tell it: x, y, z, a sign first where it points back"
        refuse((not axis, f"{said.place}, sensor {at} (column {channel.column}): {words}, or a vector"))
        other = column.axis and isinstance(axis, str) and axis.lstrip("+") != column.axis
        conflict = f"the file says axis {column.axis}, the description {axis}, which is taken"
        remarks += [f"{recording.path}, {column.place}: {conflict}"] * bool(other)
        # Of several columns of a name one is told by its number, or by the reference.
        called = column.name if recording.names.count(column.name) == 1 else channel.column
        channels.append(replace(channel, column=called, axis=axis, position=channel.position or column.position))
    turns = "r" in (said.base_axes or "".join(str(one.axis) for one in channels if one.role == "base"))
    lost = next((one.name for one in channels if turns and one.role == "response" and one.position is None), None)
    refuse((lost, f"{said.place}: the base turns, and the position of {lost!r} is missing: position, in m"))
    lost = next((one.name for one in channels if one.part and one.position is None), None)
    refuse((lost, f"{said.place}: {lost!r} is on a rigid part, and its position is missing: position, in m"))
    placed = [replace(one, position=one.position or (0.0, 0.0, 0.0)) for one in channels]
    remarks += [f"{one.path}: {remark}" for one in recordings for remark in one.remarks]
    return replace(said, channels=tuple(placed)), remarks


def sensors_of(said: Description) -> tuple[Sensor, ...]:
    """The sensors of the responses, each once."""
    found = {channel.name: channel for channel in said.channels if channel.role == "response"}
    points = {name: channel.position or (0.0, 0.0, 0.0) for name, channel in found.items()}
    return tuple(
        Sensor(name, points[name], channel.axis, gain_std=channel.gain_std, part=channel.part)
        for name, channel in found.items()
    )


def tolerances_of(said: Description, axes: Sequence[str]) -> dict[str, Any]:
    """Tolerances of the gains of base and force in each direction, (d,), by their names in `RecordedTest`.

    Several sensors of the base, each independent of the others, share theirs: each counts by its part of the base's
    motion. Of load cells the largest is that of all.
    """
    base = [(channel, channel.gain_std) for channel in said.channels if channel.role == "base"]
    force = [channel.gain_std for channel in said.channels if channel.role == "force"]
    share = None
    if any(std for _, std in base):
        moved = motions(base, said, axes)
        share = np.linalg.pinv(moved) * moved.T
    return {
        "base_gain_std": None if share is None else np.sqrt(share**2 @ np.array([std**2 for _, std in base])),
        "force_gain_std": np.full(len(axes), max(force)) if any(force) else None,
    }


def base_directions(said: Description, channels_needed: bool = True) -> tuple[str, ...]:
    """Names of the base's directions: stated, or those of the base channels, which functions per base motion lack."""
    base = [channel for channel in said.channels if channel.role == "base"]
    along = 'along which axes does the base move? State base_axes, such as "x" (--base-axes x), or channels of the base'
    absent = not any(channel.role == "response" for channel in said.channels)
    refuse(
        (channels_needed and not base, f'{said.place}: no sensor has role = "base": the motion of the table is needed'),
        (not base and said.base_axes is None, f"{said.place}: {along}"),
        (absent, f'{said.place}: no sensor has role = "response": a sensor on the structure is needed'),
    )
    if said.base_axes is not None:
        return tuple(BASE_AXES[column] for column in base_columns(said.base_axes))
    oblique = next((channel for channel in base if not isinstance(channel.axis, str)), None)
    refuse((oblique is not None, f"{said.place}: base_axes is needed where a base sensor stands along a vector"))
    letters = {str(channel.axis).lstrip("+-") for channel in base}
    return tuple(name for name in BASE_AXES if name in letters)


def recorded_rate(recording: Recording, said: Description) -> float:
    """Samples a second, Hz: by the column of time, else stated or of the file."""
    column = next(iter(_time_columns(recording, said)), None)
    if column is None:
        rate = said.sample_rate or recording.sample_rate
        words = f'{recording.path} has no column of time that is named so: state time = "ITS NAME" or sample_rate, in'
        if rate is None or not 0 < rate < np.inf:
            raise InputError(f"{words} Hz (--time, --rate); {recording.in_words()}")
        return rate
    place, known = f"{recording.path}, {column.place}", units.find(column.unit or "s")
    if known is None or known.quantity != "time":
        raise InputError(f"{place}: time in {column.unit!r} is not understood: s, ms, us are")
    check_column(column, recording.path)
    rate = rate_of(np.real(column.values) * known.factor, recording.path, column.place)
    stated, of = (said.sample_rate, "sample_rate") if said.sample_rate else (recording.sample_rate, "the file's rate")
    near = stated or float(f"{rate:.6g}")  # without what rounding of the times in a file adds to it
    words = f"time tells {rate:g} Hz and {of} {near:g} Hz; is time in another unit than s? State one of them"
    refuse((abs(rate / near - 1) > 0.01, f"{place}: {words}"))
    return said.sample_rate or (near if abs(near / rate - 1) * column.values.size < 0.05 else rate)


def _time_columns(recording: Recording, said: Description) -> list[Column]:
    """The column of time, stated or named so; none where there are several, or a rate is stated."""
    if said.time is not None:
        return [recording.column(said.time)]
    used = {str(channel.column) for channel in said.channels}
    found = [column for column in recording.columns if is_time(column.name) and column.name not in used]
    return found if len(found) == 1 and said.sample_rate is None else []


def _records(recording: Recording, said: Description) -> tuple[list[Array], list[ChannelRow]]:
    """The record of each channel in SI units, and its row of the table."""
    records: list[Array] = []
    rows: list[ChannelRow] = []
    for channel in said.channels:
        column = recording.column(channel.column)
        check_column(column, recording.path)
        factor, unit = _factor(recording, column, channel)
        record = factor * np.real(column.values)
        rms = float(np.std(record))
        words = f"the record of {channel.name!r} never moves: is it the right column? Else leave it out"
        refuse((channel.role != "force" and rms == 0.0, f"{recording.path}, {column.place}: {words}"))
        records.append(record)
        rows.append(row_of(column, channel, unit, factor, rms, recording))
    return records, rows


def row_of(column: Column, channel: Channel, unit: str, factor: float, rms: float, recording: Recording) -> ChannelRow:
    """A row of the table of channels."""
    axis = channel.axis if isinstance(channel.axis, str) else " ".join(f"{part:g}" for part in channel.axis)
    return ChannelRow(column.name, channel.name, channel.role, axis, unit, factor, rms, recording.path.name)


def _factor(recording: Recording, column: Column, channel: Channel) -> tuple[float, str]:
    """Factor of a channel to SI, and its unit; what is said and what stands in the file must agree."""
    place = f"{recording.path}, {column.place}"
    text = channel.unit or column.unit
    refuse((not text, f'{place}: no unit is stated: add unit = "g", "m/s²", "N" or the like to the sensor'))
    known = units.unit(text, place)
    force, turns = channel.role == "force", isinstance(channel.axis, str) and "r" in channel.axis
    wanted = _QUANTITIES[force, turns]
    unlike = f"the file says {column.unit!r} and the description {channel.unit!r}: mend one, or leave unit out of"
    words = f"{text!r} measures {known.quantity}, and a {channel.role} sensor along {channel.axis} reads {wanted}"
    refuse(
        (units.find(column.unit) not in (None, known), f"{place}: {unlike} the description"),
        (known.quantity != wanted, f"{place}: {words}{'; sysid takes accelerations in time' * (not force)}"),
    )
    return known.factor / channel.gain, text


def run_of(
    parts: Sequence[tuple[Channel, Any]], said: Description, axes: Sequence[str], place: str, moved: Any = None
) -> Run:
    """A run of channels with their records or spectra in SI units: base point, sensors, total force.

    `moved` (d, n) is the motion of the base point where no channel has it.
    """
    base, response, force = ([part for part in parts if part[0].role == role] for role in ROLES)
    named = {channel.name: values for channel, values in response}
    responses = np.array([named[sensor.name] for sensor in sensors_of(said)])
    motion = moved if moved is not None else _base_motion(base, said, axes, place)
    return motion, responses, _total_force(force, said, axes, place) if force else None


def _base_motion(parts: Sequence[tuple[Channel, Any]], said: Description, axes: Sequence[str], place: str) -> Array:
    """Motion of the base point from its sensors by least squares, (d, n)."""
    seen, values = motions(parts, said, axes), np.array([values for _, values in parts])
    words = f"the base's sensors do not show its motion along {' '.join(axes)}: each direction needs one"
    refuse((np.linalg.matrix_rank(seen) < len(axes), f"{place}: {words}"))
    return values if np.array_equal(seen, np.eye(len(axes))) else np.linalg.pinv(seen) @ values


def base_differences(
    parts: Sequence[tuple[Channel, Any]], said: Description, axes: Sequence[str], place: str
) -> tuple[BaseSensor, ...]:
    """Readings of more sensors of the base than it has directions, as shares of the motion that is taken for it.

    Records are without their means. Refused are such that have less than half in common.
    """
    base = [part for part in parts if part[0].role == "base"]
    if len(base) <= len(axes):
        return ()
    values = np.array([one for _, one in base])
    taken = motions(base, said, axes) @ _base_motion(base, said, axes, place)
    sizes, off = (np.linalg.norm(one, axis=1) for one in (values, values - taken))
    words = f"{place}: {len(base)} base sensors along {' '.join(axes)}"
    apart = "share less than half of what they record: mend a sign (axis), a unit or a gain; state how"
    names = ", ".join(repr(one.name) for one, _ in base)
    wrong = np.linalg.norm(off) > 0.5 * np.linalg.norm(sizes)
    other = 'else the base moves, such as base_axes = "x rz"; or keep one alone of supports that move for themselves'
    refuse((wrong, f"{words} ({names}) {apart} {other}"))
    gains = [float(np.real(np.vdot(b, a) / np.vdot(b, b))) for a, b in zip(values, taken, strict=True)]
    shares = zip(base, gains, off / sizes, strict=True)
    return tuple(BaseSensor(one.name, gain, float(share)) for (one, _), gain, share in shares)


def _differences_in_words(read: Sequence[BaseSensor], axes: Sequence[str], place: str) -> list[str]:
    """A remark on what `base_differences` found."""
    each = ", ".join(f"{one.name!r} {one.gain:.4g} times (off by {100 * one.off:.2g} %)" for one in read)
    words = f"{place}: {len(read)} base sensors along {' '.join(axes)} read the motion taken for that of the base"
    return [f"{words}: {each}"] * bool(read)


def _total_force(parts: Sequence[tuple[Channel, Any]], said: Description, axes: Sequence[str], place: str) -> Array:
    """The sum of the load cells along the base's directions, (d, n)."""
    cells = motions(parts, said, axes)
    known = np.linalg.matrix_rank(cells)
    unseen = [axis for axis, column in zip(axes, cells.T, strict=True) if not np.any(column)]
    where = f"along {' '.join(unseen)}" if unseen else f"apart enough: they tell {known} of {' '.join(axes)}"
    refuse((known < len(axes), f"{place}: no force sensor acts {where}: {FORCE_NEEDED}"))
    return cells.T @ np.array([values for _, values in parts])


def motions(parts: Sequence[tuple[Channel, Any]], said: Description, axes: Sequence[str]) -> Array:
    """Readings of channels at unit motions of the base in its directions, (channels, d)."""
    points = np.array([channel.position or (0.0, 0.0, 0.0) for channel, _ in parts])
    rows = rigid_motion(points, said.origin).reshape(len(points), 6, 6)
    ways = [sensor_row(channel.axis, channel.name) for channel, _ in parts]
    return np.array([way @ row for way, row in zip(ways, rows, strict=True)])[:, base_columns(list(axes))]


def work_of_force(runs: Sequence[Run], freq: Array) -> list[str]:
    """Remark on the sign of the base force: the table's force gives a damped structure power at every line."""
    moved = [(base, force) for base, _, force in runs if force is not None]
    power = [np.sum(np.real(force * np.conj(base / (2j * np.pi * freq))), axis=0) for base, force in moved]
    share = float(np.sum(power) / max(np.sum(np.abs(power)), np.finfo(float).tiny))
    right = "the base force gives power to the structure, as the force of the table on it does"
    reversed_ = (
        "the base force takes power from the structure: it seems to be the force of the structure on the table; where "
        'it is, turn the axes of the load cells (axis = "-x" for "x")'
    )
    return [right] * (share > _CLEAR_POWER) + [reversed_] * (share < -_CLEAR_POWER)


def runs_of_files(files: Sequence[Path], said: Description) -> list[dict[Path, str]]:
    """The files of each run with what they are called there, in the order of the files.

    A folder is a run. Where the names of its files are more than those of the sensors, such as ``run2_top`` of ``top``,
    files with the same rest are one.
    """
    columns = [one.column for one in said.channels if isinstance(one.column, str) and not one.column.isdecimal()]
    known = {".".join(parts[:n]) for parts in (name.split(".") for name in columns) for n in range(1, len(parts) + 1)}
    runs = []
    for folder in dict.fromkeys(file.parent for file in files):
        groups: dict[str, dict[Path, str]] = {}
        whole = {file: file.stem for file in files if file.parent == folder}
        for file in whole:
            rests = {name: re.split(rf"(?:^|[-_. ]){re.escape(name)}(?:[-_. ]|$)", file.stem) for name in known}
            if name := max((one for one in known if len(rests[one]) > 1), key=len, default=""):
                groups.setdefault("|".join(rests[name]), {})[file] = name
        # Names of sensors alone are a run, beside which other names are its further files, unless they are as complete.
        complete = len({frozenset(one.values()) for one in groups.values()}) == 1 < len(groups)
        runs += list(groups.values()) if groups and ("|" not in groups or complete) else [whole]
    return runs


def joined(recordings: Sequence[Recording], said: Description) -> list[Recording]:
    """The recordings of the files of each run as one.

    A column is called by its file, or ``FILE.COLUMN`` where that has several beside time or frequency. Refused are
    files of other times or rates, or longer than others by more than a hundredth, unless their clocks are aligned.
    """
    runs, every = [], runs_of_files(list(dict.fromkeys(one.path for one in recordings)), said)
    columns = [part for one in said.channels for part in (str(one.column), str(one.column).partition(".")[0])]
    for names in every:
        lost = [one for other in every for one in other.values() if one in columns and one not in names.values()]
        words = f"its run has no file of {', '.join(map(repr, dict.fromkeys(lost)))}, as another has: name it too"
        refuse((lost, f"{next(iter(names))}: {words}"))
        held = [[one for one in recordings if one.path == file] for file in names]
        counts = {len(one) for one in held}
        words = "hold other numbers of runs, and are to be joined: write each run to files of its own"
        refuse((len(counts) > 1, f"{', '.join(map(str, names))} {words}"))
        runs += [_together(files, list(names.values()), said) for files in zip(*held, strict=True)]
    return runs


def _together(recordings: Sequence[Recording], names: Sequence[str], said: Description) -> Recording:
    both = zip(recordings, names, strict=True)
    first, parts = recordings[0], [_channels(recording, name, said) for recording, name in both]
    remarks = [f"{one.path.name}: {remark}" for one in recordings for remark in one.remarks]
    lengths = np.array([recording.columns[0].values.size for recording in recordings])
    if said.align:
        begins, moved = _begins(recordings, parts, said)
        remarks += moved
    else:
        begins = np.zeros(lengths.size, int)
        for recording in recordings:
            _check_same(first, recording, said, min(lengths), max(lengths))
        cut = f"{max(lengths)} samples of the longest file are cut to the {min(lengths)} of the shortest"
        remarks += [cut] * bool(np.ptp(lengths))
    n = min(lengths - begins)
    columns = [one.part(0, n) for one in _abscissa(first, said)]
    columns += [one.part(begin, begin + n) for begin, part in zip(begins, parts, strict=True) for one in part]
    return Recording(first.path, tuple(columns), first.sample_rate, first.freq, tuple(remarks))


def _channels(recording: Recording, stem: str, said: Description) -> list[Column]:
    """The columns of a file beside time or frequency, called as they are in the run."""
    shared = [id(column) for column in _abscissa(recording, said)]
    others = [column for column in recording.columns if id(column) not in shared]
    named = [stem if len(others) == 1 else f"{stem}.{column.name}" for column in others]
    places = [f"{column.place} of {recording.path.name}" for column in others]
    return [replace(one, name=name, place=at) for one, name, at in zip(others, named, places, strict=True)]


def _begins(
    recordings: Sequence[Recording], parts: Sequence[list[Column]], said: Description
) -> tuple[NDArray[np.intp], list[str]]:
    """First sample of each file that all have, once their clocks are one, (files,), and their moves in words.

    Whole samples: the rest is a delay, which is found with the modes.
    """
    clocks = []
    for recording, part in zip(recordings, parts, strict=True):
        rate = recorded_rate(recording, said)  # refuses a time of another unit
        begin = sum(
            units.unit(one.unit or "s", one.place).factor * one.values[0] for one in _time_columns(recording, said)
        )
        clocks.append(UnitColumns(recording.path.name, begin, rate, part))
    rates = [clock.rate for clock in clocks]
    empty = [str(recording.path) for recording, part in zip(recordings, parts, strict=True) if not part]
    refuse((empty, f"{', '.join(empty)}: no column is described, so that it cannot be aligned (--align): leave it out"))
    longest = max(part[0].values.size for part in parts)
    words = f"{recordings[0].path}: the files of its run have rates of {min(rates):g} to {max(rates):g} Hz: bring them"
    refuse((longest * (max(rates) / min(rates) - 1) > 0.5, f"{words} to one with sysid.resample"))
    offsets, remarks = clock_moves(clocks, said)
    begun = np.array([clock.begin for clock in clocks]) + offsets
    begins = np.rint((begun.max() - begun) * rates[0]).astype(int)
    left = min(part[0].values.size - begin for part, begin in zip(parts, begins, strict=True))
    refuse((left < 3, f"{recordings[0].path}: the files of its run have no time in common on one clock"))
    return begins, remarks


def _abscissa(recording: Recording, said: Description) -> list[Column]:
    """The column of time or frequency of a file, stated or the first named so; none where there is none."""
    stated = [recording.column(name) for name in (said.time, said.frequency) if name is not None]
    return (stated or [column for column in recording.columns if is_abscissa(column.name)])[:1]


def _check_same(first: Recording, other: Recording, said: Description, n: int, longest: int) -> None:
    abscissas = _abscissa(first, said), _abscissa(other, said)
    size = other.columns[0].values.size
    together = "are these files of one run? Clocks of their own are brought to one with --align (align = true); else "
    together += "read them apart, or bring them to one rate with sysid.resample"
    alike = f"{other.path}, beside {first.path}: one has a column of time or frequency, one has none"
    rates = f"{other.path} has another sample rate than {first.path}: {together}"
    refuse(
        (longest - size > 0.01 * longest, f"{other.path} has {size} samples, another file {longest}: {together}"),
        (len(abscissas[0]) != len(abscissas[1]), alike),
        (first.sample_rate != other.sample_rate, rates),
    )
    for a, b in zip(*abscissas, strict=True):
        step = float(np.median(np.abs(np.diff(np.real(a.values)))))
        off = np.abs(np.real(a.values[:n]) - np.real(b.values[:n])) > 0.01 * step
        at = int(np.argmax(off))
        times = [f"{np.real(one.values[at]):g} {one.unit}".strip() for one in (b, a)]
        words = f"sample {at + 1} is at {times[0]}, that of {first.path.name} at {times[1]}: {together}"
        refuse((np.any(off) or a.unit != b.unit, f"{other.path}, {b.place}: {words}"))
