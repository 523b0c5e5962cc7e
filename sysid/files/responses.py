"""Frequency responses of a test: their form, their sign convention, and the runs that they stand for.

A function is per unit of its reference. Each reference is a run: where it is a base acceleration the base moves by one
unit of it, where it is a force the base channels tell how the base moved.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, choice, refuse
from sysid.files import units
from sysid.files.assembly import (
    base_differences,
    base_directions,
    delays_in_words,
    described,
    motions,
    row_of,
    run_of,
    sensors_of,
    tolerances_of,
    work_of_force,
)
from sysid.files.description import CONVENTIONS, Channel, Description
from sysid.files.kind import coarse_lines
from sysid.files.recorded_test import ChannelRow, RecordedTest, Run
from sysid.files.recording import Column, Recording, check_column, part_of
from sysid.measurement.spectra import std_of_functions
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
_ORDER = {"displacement": 2, "velocity": 1}  # how often to differentiate
_OF_ROLE = {"base": "a motion", "response": "a motion", "force": "a force"}
_MOTIONS = ("acceleration", "velocity", "displacement", "angular acceleration")
_ENDS_WITH_AXIS = re.compile(r"(?:.*\d)?([+-]?)(r?[xyz])")


class _Part(NamedTuple):
    """A function of a channel, (lines,), with its coherence."""

    channel: Channel
    values: ComplexArray
    coherence: Any

    def at(self, kept: NDArray[np.bool_]) -> _Part:
        """The same at some lines."""
        return _Part(self.channel, self.values[kept], None if self.coherence is None else self.coherence[kept])


def from_spectra(recordings: Sequence[Recording], said: Description) -> RecordedTest:
    """The test of recordings over frequency.

    Raises
    ------
    InputError
        Where form or convention are neither said nor shown, roles or axes are not said, a reference is missing.
    """
    said, remarks = described(recordings, said)
    if said.frf != "":
        choice(f"{said.place}: frf", said.frf, tuple(FORMS))
    freq = recordings[0].freq
    assert freq is not None
    axes = base_directions(said, channels_needed=False)
    for recording in recordings:
        other = recording.freq
        if other is None or other.shape != freq.shape or not np.allclose(other, freq, rtol=1e-6):
            raise InputError(f"{recording.path} has other lines than {recordings[0].path}: read them apart")
    runs, table, parts = _runs(recordings, said, axes, freq)
    sign, how = _convention(runs, said)
    if sign < 0:  # conjugated as they are in the file: velocities and displacements are differentiated after it
        runs, table, parts = _runs(recordings, said, axes, freq, conjugated=True)
    kept = freq > 0
    freq, runs = freq[kept], [_at(run, kept) for run in runs]
    remarks = [few for one in recordings for few in coarse_lines(one) if said.frf != "spectrum"] + remarks
    remarks += ["the line at 0 Hz is left out"] * (not np.all(kept))
    std, words = _deviations([[part.at(kept) for part in run] for run in parts], said, axes)
    remarks += [*delays_in_words(said), *work_of_force(runs, freq), *words, how]
    return RecordedTest(
        tuple(runs), sensors_of(said), axes, said.origin, None, freq, tuple(table), tuple(remarks),
        **tolerances_of(said, axes), **std, averaged=said.averages or said.window != "", window=said.window,
    )  # fmt: skip


def _deviations(
    parts: Sequence[Sequence[_Part]], said: Description, axes: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Standard deviations of responses and forces, (runs, rows, lines), by coherences, and what is said of them.

    None where a coherence is missing, how many averages they are of, or the base's motion is a function itself.
    """
    every = [one for run in parts for one in run]
    none: dict[str, Any] = {"response_std": None, "force_std": None}
    lacking = next((one.channel.column for one in every if one.coherence is None), None)
    unused = [
        "the base's motion is a function itself, whose errors they do not tell"
    ] * any(one.channel.role == "base" for one in every)  # fmt: skip
    unused += [f"that of {lacking!r} is missing"] * (lacking is not None)
    unused += ["state of how many independent segments they are: averages = 40 (--averages)"] * (not said.averages)
    if unused:
        given = any(one.coherence is not None for one in every)
        return none, [f"coherences stand in the files and are not used: {unused[0]}"] * given
    response, force = [], []
    for run in parts:
        std = {one.channel: std_of_functions(one.values, one.coherence, said.averages) for one in run}
        named = {channel.name: values for channel, values in std.items() if channel.role == "response"}
        response.append(np.array([named[sensor.name] for sensor in sensors_of(said)]))
        cells = [(channel, values) for channel, values in std.items() if channel.role == "force"]
        if cells:
            force.append(np.sqrt(motions(cells, said, axes).T ** 2 @ np.array([values**2 for _, values in cells])))
    words = f"noise by the coherences of {said.averages} averages"
    words += "; what Hann's window makes of peaks is taken off with the poles" * (said.window == "hann")
    return {"response_std": np.array(response), "force_std": np.array(force) if force else None}, [words]


def _runs(
    recordings: Sequence[Recording], said: Description, axes: Sequence[str], freq: Array, conjugated: bool = False
) -> tuple[list[Run], list[ChannelRow], list[list[_Part]]]:
    """A run for each reference of each recording, with the functions that it is made of."""
    runs, table, every = [], [], []
    for recording in recordings:
        found = [_reference(column, said) for column in recording.columns if _is_used(column, said)]
        for reference in dict.fromkeys(found):
            run, rows, parts = _run(recording, reference, said, axes, freq, conjugated)
            runs.append(run)
            every.append(parts)
            table += rows
    return runs, table, every


def _is_used(column: Column, said: Description) -> bool:
    return any(
        str(channel.column) == column.name
        and (channel.reference or column.reference) == (column.reference or channel.reference)
        for channel in said.channels
    )


def _reference(column: Column, said: Description) -> str:
    stated = {channel.reference for channel in said.channels if str(channel.column) == column.name}
    return column.reference or next(iter(stated - {""}), "")


def _run(
    recording: Recording, reference: str, said: Description, axes: Sequence[str], freq: Array, conjugated: bool
) -> tuple[Run, list[ChannelRow], list[_Part]]:
    """Base, responses and forces per unit of a reference, in the order of the sensors."""
    found = [
        (channel, column)
        for channel in said.channels
        if (column := _of_reference(recording, channel, reference, said)) is not None
    ]
    forms = [_form(recording, column, channel, said) for channel, column in found]
    lower = _denominator(forms, reference, recording)
    parts: list[tuple[Channel, ComplexArray]] = []
    rows: list[ChannelRow] = []
    with_coherence: list[_Part] = []
    for (channel, column), form in zip(found, forms, strict=True):
        check_column(column, recording.path)
        values: Any = np.asarray(column.values, complex) * form.factor
        values = (values.conj() if conjugated else values) * (2j * np.pi * freq) ** _ORDER.get(form.upper or lower, 0)
        values = values * np.exp(2j * np.pi * freq * channel.delay)
        parts.append((channel, values))
        with_coherence.append(_Part(channel, values, _coherence(recording, column, reference)))
        rms = float(np.sqrt(np.mean(np.abs(values) ** 2)))
        rows.append(row_of(column, channel, form.unit, form.factor, rms, recording))
    _check_responses(parts, said, reference, recording)
    has_base = any(channel.role == "base" for channel, _ in parts)
    moved = None if has_base else _unit_motion(lower, reference, axes, recording, freq)
    base_differences(parts, said, axes, str(recording.path))  # refuses
    return run_of(parts, said, axes, str(recording.path), moved), rows, with_coherence


def _coherence(recording: Recording, column: Column, reference: str) -> Array | None:
    """The coherence of a function, (n,): the column of its name, such as "3+X coherence" or "Coh(h1)"."""
    for one in recording.columns:
        if part_of(one.name) == (column.name, "coherence") and one.reference in ("", reference):
            check_column(one, recording.path)
            values = np.real(one.values)
            words = "a coherence is between 0 and 1"
            refuse((bool(np.any((values < 0) | (values > 1.001))), f"{recording.path}, {one.place}: {words}"))
            return values
    return None


def _check_responses(
    parts: Sequence[tuple[Channel, ComplexArray]], said: Description, reference: str, recording: Recording
) -> None:
    """Refuse functions of responses where that of a sensor is missing, and magnitudes alone."""
    given = {channel.name: values for channel, values in parts if channel.role == "response"}
    missing = next((sensor.name for sensor in sensors_of(said) if sensor.name not in given), None)
    lacking = f"per unit of {reference or 'the reference'} that of {missing!r} is missing: each sensor needs one"
    real = "its functions are real numbers, magnitudes it seems: export complex ones, or real and imaginary part, or"
    refuse(
        (
            missing is not None,
            f"{recording.path}: {lacking} for each reference, under the same name; {recording.in_words()}",
        ),
        (
            not any(np.any(values.imag) for values in given.values()),
            f"{recording.path}: {real} magnitude and phase in columns named so",
        ),
    )


def _of_reference(recording: Recording, channel: Channel, reference: str, said: Description) -> Column | None:
    found = [
        column
        for column in recording.columns
        if column.name == str(channel.column)
        and reference == _reference(column, said)
        and channel.reference in ("", reference)
    ]
    places = f"per unit of {reference or 'nothing'} ({', '.join(column.place for column in found)})"
    words = f"{channel.column!r} stands {len(found)} times {places}: two tests in one file? Export each into its own"
    refuse((len(found) > 1, f"{recording.path}: {words}"))
    if str(channel.column) not in recording.names:
        recording.column(channel.column)  # raises, with what there is
    return next(iter(found), None)


class _Form(NamedTuple):
    """Kind of a function by its unit: its quantity ("" of a number per the same), and what it is per ("" of none)."""

    factor: float
    upper: str
    lower: str
    unit: str


def _form(recording: Recording, column: Column, channel: Channel, said: Description) -> _Form:
    """Kind of a function, by its unit and by what is stated."""
    place = f"{recording.path}, {column.place}"
    text = channel.unit or column.unit
    if not text and said.frf == "transmissibility" and channel.role != "force":
        return _Form(1 / channel.gain, "", "", "1")
    unsaid = f"no unit{' and no form' * (said.frf == '')} is stated: is it receptance, mobility, accelerance or"
    state = 'State unit = "g/g", "m/s² / N" or the like, or frf = "transmissibility" (--frf) of plain numbers'
    refuse((not text, f"{place}: of this function {unsaid} transmissibility? {state}"))
    upper, lower = units.ratio(text, place)
    form = _Form(upper.factor / lower.factor / channel.gain, upper.quantity, lower.quantity, text)
    known = f"frf = {said.frf!r}" * bool(said.frf) or "no frf (transmissibility, of motions)"
    gives = f"a {channel.role} sensor gives {_OF_ROLE[channel.role]} per unit of the reference"
    words = f"the unit {text!r} does not fit: {known} is stated, and {gives}: mend frf (--frf), or the unit"
    refuse((not _fits(form, channel.role, said.frf), f"{place}: {words}"))
    return form


def _fits(form: _Form, role: str, frf: str) -> bool:
    """True where a function can be of a sensor of this role, and is of the form that is stated."""
    known = FORMS.get(frf, ("", ""))
    if role == "force":
        return form.upper in ("force", "moment") and (frf in ("", "transmissibility") or form.lower == known[1])
    if frf == "transmissibility":
        return form.upper == form.lower and form.upper in ("", *_MOTIONS)
    return form.upper in _MOTIONS and (frf in ("", "apparent mass") or (form.upper, form.lower) == known)


def _denominator(forms: Sequence[_Form], reference: str, recording: Recording) -> str:
    """Unit that all functions of a reference are per; acceleration for numbers per the same, which are of any."""
    found = list(dict.fromkeys(form.lower for form in forms if form.upper))
    plain = any(not form.upper for form in forms)
    listed = ", ".join(dict.fromkeys(repr(form.unit) for form in forms))
    words = f"functions per unit of {reference or 'the reference'} have the units {listed}: all need one and the same"
    mixed = len(found) > 1 or (plain and not set(found) <= set(_MOTIONS))
    refuse((mixed, f"{recording.path}: {words} denominator"))
    return next(iter(found), "acceleration")


def _unit_motion(lower: str, reference: str, axes: Sequence[str], recording: Recording, freq: Array) -> ComplexArray:
    """The base's acceleration that moves by one unit of the reference."""
    per = f"functions are per unit of {lower or 'nothing'} ({reference or 'no reference'}), so the base's own motion"
    words = f'{per} per unit of it is needed: describe its channels with role = "base"'
    refuse((lower not in _MOTIONS, f"{recording.path}: {words}"))
    at, sign = _direction(reference, axes, recording)
    base: ComplexArray = np.zeros((len(axes), freq.size), complex)
    base[at] = sign * (2j * np.pi * freq) ** _ORDER.get(lower, 0)
    return base


def _direction(reference: str, axes: Sequence[str], recording: Recording) -> tuple[int, float]:
    """Which base direction a reference is, and its sign: that of its name, or the only one where it names none."""
    match = _ENDS_WITH_AXIS.fullmatch(reference.strip().lower())
    only = axes[0] if len(axes) == 1 else ""
    sign, axis = match.groups() if match else ("", only)
    words = f"the reference {reference!r} is no axis of the base ({' '.join(axes)}): state base_axes (--base-axes), or"
    refuse((axis not in axes, f'{recording.path}: {words} reference = "x" with each function'))
    return list(axes).index(axis), float(f"{sign}1")


def _at(run: Run, kept: Any) -> Any:
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
    words = "whether spectra follow exp(+iwt) or exp(-iwt) does not show in these functions: state convention = "
    refuse((not abs(delay) > 0.02 * size, f'{said.place}: {words}"exp(+iwt)" (--convention "exp(+iwt)")'))
    late = bool(delay > 0)
    return 2 * late - 1, f"spectra follow {CONVENTIONS[not late]}, told by responses that lag behind their cause"
