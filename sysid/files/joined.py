"""Files of one sensor each as one run: their columns side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.errors import refuse
from sysid.files.description import Description
from sysid.files.recording import Column, Recording
from sysid.files.spectral import is_abscissa

_SHORTER = 0.01  # of its samples by which a file may be shorter than another


def by_folder(recordings: Sequence[Recording], said: Description) -> list[Recording]:
    """The recordings of each folder as one, in the order of the folders.

    A column is called by its file, or ``FILE.COLUMN`` where that has several beside time or frequency.

    Raises
    ------
    InputError
        Files of other times or rates, or much longer than others.
    """
    folders = dict.fromkeys(recording.path.parent for recording in recordings)
    return [_together([one for one in recordings if one.path.parent == folder], said) for folder in folders]


def _together(recordings: Sequence[Recording], said: Description) -> Recording:
    first = recordings[0]
    shared = _abscissa(first, said)
    lengths = [recording.columns[0].values.size for recording in recordings]
    n = min(lengths)
    columns = [replace(one, values=one.values[:n]) for one in (shared,) if one is not None]
    for recording in recordings:
        _check_same(first, recording, said, n, max(lengths))
        abscissa = _abscissa(recording, said)
        others = [column for column in recording.columns if column is not abscissa]
        for column in others:
            stem = recording.path.stem
            name = stem if len(others) == 1 else f"{stem}.{column.name}"
            place = f"{column.place} of {recording.path.name}"
            columns.append(replace(column, name=name, values=column.values[:n], place=place))
    remarks = [f"{one.path.name}: {remark}" for one in recordings for remark in one.remarks]
    cut = f"{max(lengths)} samples of the longest file are cut to the {n} of the shortest"
    remarks += [cut] * (max(lengths) > n)
    return Recording(first.path, tuple(columns), first.sample_rate, first.freq, tuple(remarks))


def _abscissa(recording: Recording, said: Description) -> Column | None:
    """Time or frequency of a file."""
    named = said.time if said.time is not None else said.frequency
    if named is not None:
        return recording.column(named)
    return next((column for column in recording.columns if is_abscissa(column.name)), None)


def _check_same(first: Recording, other: Recording, said: Description, n: int, longest: int) -> None:
    a, b = _abscissa(first, said), _abscissa(other, said)
    size = other.columns[0].values.size
    together = "are these files of one run, on one clock? Else read them apart, or bring them to it with sysid.resample"
    refuse(
        (
            longest - size > _SHORTER * longest,
            f"{other.path} has {size} samples, another file {longest}: {together}",
        ),
        (
            (a is None) != (b is None),
            f"{other.path}, beside {first.path}: one has a column of time or frequency, one has none",
        ),
        (
            first.sample_rate != other.sample_rate,
            f"{other.path} has another sample rate than {first.path}: {together}",
        ),
    )
    if a is not None and b is not None:
        step = float(np.median(np.abs(np.diff(np.real(a.values)))))
        off = np.abs(np.real(a.values[:n]) - np.real(b.values[:n])) > 0.01 * step
        at = int(np.argmax(off))
        times = [f"{np.real(one.values[at]):g} {one.unit}".strip() for one in (b, a)]
        words = f"sample {at + 1} is at {times[0]}, that of {first.path.name} at {times[1]}: {together}"
        refuse((np.any(off) or a.unit != b.unit, f"{other.path}, {b.place}: {words}"))
