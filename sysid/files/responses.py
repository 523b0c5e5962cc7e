"""Frequency responses of a test: their form, their sign convention, and the runs that they stand for.

A function is per unit of its reference. Each reference is a run: where it is a base acceleration the base moves by one
unit of it, where it is a force the base channels tell how the base moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.errors import InputError, refuse
from sysid.files import units
from sysid.files.assembly import base_and_force, base_directions, motions, row_of, sensors_of, undescribed
from sysid.files.description import CONVENTIONS, Channel, Description
from sysid.files.recorded_test import RecordedTest, Row, Run
from sysid.files.recording import Column, Recording, check_finite
from sysid.structure.axes import BASE_AXES, base_columns
from sysid.structure.structure import Array, ComplexArray

# Quantity of the numerator and of the denominator; that of a transmissibility is one and the same.
FORMS = {
    "transmissibility": ("acceleration", "acceleration"),
    "accelerance": ("acceleration", "force"),
    "mobility": ("velocity", "force"),
    "receptance": ("displacement", "force"),
    "apparent mass": ("force", "acceleration"),
    "spectrum": ("acceleration", ""),
}
_ORDER = {"displacement": 2, "velocity": 1, "acceleration": 0}  # how often to differentiate
_CLEAR = 0.02  # of the sums by which the convention is told


def from_spectra(recordings: Sequence[Recording], said: Description) -> RecordedTest:
    """The test of recordings over frequency.

    Raises
    ------
    InputError
        Where form or convention are neither said nor shown, roles or axes are not said, a reference is missing.
    """
    refuse((not said.channels, undescribed(recordings[0])))
    refuse((said.frf != "" and said.frf not in FORMS, f"{said.place}: frf = {said.frf!r}; one of {', '.join(FORMS)}"))
    freq = recordings[0].freq
    assert freq is not None
    axes, runs, table, remarks = base_directions_of(said), [], [], []
    for recording in recordings:
        other = recording.freq
        if other is None or other.shape != freq.shape or not np.allclose(other, freq, rtol=1e-6):
            raise InputError(f"{recording.path} has other lines than {recordings[0].path}: read them apart")
        columns = recording.columns
        for reference in dict.fromkeys(_reference(column, said) for column in columns if _is_used(column, said)):
            run, rows = _run(recording, reference, said, axes, freq)
            runs.append(run)
            table += rows
    kept = freq > 0
    if not np.all(kept):
        freq, runs = freq[kept], [_lines(run, kept) for run in runs]
        remarks.append("the line at 0 Hz is left out")
    sign, how = _convention(runs, said)
    remarks.append(how)
    if sign < 0:
        runs = [tuple(None if part is None else part.conj() for part in run) for run in runs]
    return RecordedTest(tuple(runs), sensors_of(said), axes, said.origin, None, freq, tuple(table), tuple(remarks))


def base_directions_of(said: Description) -> tuple[str, ...]:
    """Directions of the base; where functions are per unit base motion its channel may be absent."""
    if any(channel.role == "base" for channel in said.channels):
        return base_directions(said)
    if said.base_axes is None:
        raise InputError(
            f'{said.place}: along which axes does the base move? State base_axes, such as "x" (--base-axes x), or the '
            "base's own channels"
        )
    return tuple(BASE_AXES[column] for column in base_columns(said.base_axes))


def _is_used(column: Column, said: Description) -> bool:
    return any(str(channel.column) == column.name for channel in said.channels)


def _reference(column: Column, said: Description) -> str:
    stated = {channel.reference for channel in said.channels if str(channel.column) == column.name}
    return column.reference or next(iter(stated - {""}), "")


def _run(
    recording: Recording, reference: str, said: Description, axes: Sequence[str], freq: Array
) -> tuple[Any, list[Row]]:
    """Base, responses and forces per unit of a reference, in the order of the description."""
    rows: list[Row] = []
    parts: dict[str, list[ComplexArray]] = {"base": [], "response": [], "force": []}
    quantity = ""
    for channel in said.channels:
        column = _of_reference(recording, channel, reference, said)
        if column is None:
            continue
        check_finite(column, recording.path)
        factor, upper, quantity, unit = _in_si(recording, column, channel, said)
        values = np.asarray(column.values, complex) * factor * (2j * np.pi * freq) ** _ORDER.get(upper, 0)
        parts[channel.role].append(values)
        rms = float(np.sqrt(np.mean(np.abs(values) ** 2)))
        rows.append(row_of(column, channel, unit, factor, rms, recording))
    wanted = sum(channel.role == "response" for channel in said.channels if channel.reference in ("", reference))
    if len(parts["response"]) < wanted or not parts["response"]:
        raise InputError(
            f"{recording.path}: per unit of {reference or 'the reference'} it holds {len(parts['response'])} of "
            f"{wanted} sensors; each sensor needs a function for each reference; {recording.in_words()}"
        )
    return _with_base(parts, quantity, reference, said, axes, recording), rows


def _of_reference(recording: Recording, channel: Channel, reference: str, said: Description) -> Column | None:
    found = [
        column
        for column in recording.columns
        if column.name == str(channel.column) and _reference(column, said) == reference
    ]
    if len(found) > 1:
        raise InputError(
            f"{recording.path}: {channel.column!r} stands there {len(found)} times per unit of "
            f"{reference or 'nothing'} ({', '.join(column.place for column in found)}): two tests in "
            "one file? Export each into its own"
        )
    if not found and not any(column.name == str(channel.column) for column in recording.columns):
        recording.column(channel.column)  # raises, with what there is
    return found[0] if found else None


def _in_si(recording: Recording, column: Column, channel: Channel, said: Description) -> tuple[float, str, str, str]:
    """Factor, quantity of the numerator and of the denominator ("" for none), and the unit in words."""
    place = f"{recording.path}, {column.place}"
    text = channel.unit or column.unit
    above, _, below = (part.strip() for part in text.partition(" / "))
    form = FORMS.get(said.frf, ("", ""))
    if channel.role == "force" and said.frf == "transmissibility":
        form = FORMS["apparent mass"]
    if not text and form == ("acceleration", "acceleration"):
        return 1.0, *form, "1"
    if not text:
        raise InputError(
            f"{place}: neither unit nor form of this function is stated: is it receptance, mobility, accelerance or "
            'transmissibility? State frf = "..." (--frf) and unit = "m/s² / N" or the like'
        )
    upper = units.unit(above, place)
    lower = units.unit(below, place) if below else units.Unit("", 1.0)
    if said.frf and (upper.quantity, lower.quantity) != form and not _alike(said.frf, upper, lower):
        raise InputError(
            f"{place}: a {said.frf} is {' per '.join(filter(None, form))}, but its unit is {text!r}: mend frf, or "
            "the unit"
        )
    return upper.factor / lower.factor, upper.quantity, lower.quantity, text


def _alike(form: str, upper: units.Unit, lower: units.Unit) -> bool:
    """Whether the quantities are of the form: any motion over the same is a transmissibility."""
    return form == "transmissibility" and (upper.quantity == lower.quantity or upper.quantity == "force")


def _with_base(
    parts: dict[str, list[ComplexArray]], quantity: str, reference: str, said: Description, axes: Sequence[str],
    recording: Recording,
) -> Run:  # fmt: skip
    response: Any = np.array(parts["response"])
    force: Any = np.array(parts["force"]) if parts["force"] else None
    if parts["base"]:
        return _placed(np.array(parts["base"]), response, force, said, axes, recording)
    if quantity == "force" or not quantity:
        raise InputError(
            f"{recording.path}: its functions are per unit of {quantity or 'nothing'}, so that the base's own motion "
            'is needed: describe its channels with role = "base"'
        )
    base: Any = np.zeros((len(axes), response.shape[1]), complex)
    at = _direction(reference, axes, recording)
    base[at] = 1.0
    if quantity in ("velocity", "displacement"):  # same over same: the response was differentiated, the base is not yet
        base[at] = (2j * np.pi * np.asarray(recording.freq)) ** _ORDER[quantity]
    cells = [channel for channel in said.channels if channel.role == "force"]
    if force is not None:
        force = motions(cells, axes, said.origin).T @ force
    return base, response, force


def _placed(base: Any, response: Any, force: Any, said: Description, axes: Sequence[str], recording: Recording) -> Run:
    moved, total = base_and_force(said, axes, base, force, str(recording.path))
    return moved, response, total


def _direction(reference: str, axes: Sequence[str], recording: Recording) -> int:
    """Which base direction a reference is: that of its name, or the only one."""
    if len(axes) == 1:
        return 0
    name = reference.rpartition("+")[2].lower()
    if name not in axes:
        raise InputError(
            f"{recording.path}: the reference {reference!r} is none of the base's axes {' '.join(axes)}: state "
            'reference = "x" with each function'
        )
    return list(axes).index(name)


def _lines(run: Run, kept: Any) -> Any:
    return tuple(None if part is None else part[:, kept] for part in run)


def _convention(runs: Sequence[Any], said: Description) -> tuple[int, str]:
    """1 where spectra follow exp(+iwt), -1 where exp(-iwt), and how that is known.

    Of a causal response ``h(t)`` the mean time, weighed by its energy, is positive; it is the mean over frequency of
    the group delay weighed by ``|H|²``: of ``-Im(conj(H) dH/dw)``.
    """
    if said.convention:
        return (1 if said.convention == CONVENTIONS[0] else -1), f"spectra follow {said.convention}, as stated"
    delay = size = 0.0
    for base, response, _ in runs:
        lead = base[np.argmax(np.mean(np.abs(base) ** 2, axis=1))]
        ratio = response / np.where(lead == 0, 1, lead)
        step = np.diff(ratio, axis=1)
        product = np.conj(ratio[:, :-1]) * step
        delay -= float(np.sum(product.imag))
        size += float(np.sum(np.abs(product)))
    if not abs(delay) > _CLEAR * size:
        raise InputError(
            f"{said.place}: whether spectra follow exp(+iwt) or exp(-iwt) does not show in these functions: state "
            'convention = "exp(+iwt)" (--convention "exp(+iwt)")'
        )
    sign = 1 if delay > 0 else -1
    return sign, f"spectra follow {CONVENTIONS[0 if sign > 0 else 1]}, told by responses that lag behind their cause"
