"""Mistakes in the records of a test, named by what they leave beside all modes, before anything is fitted to a model.

What each sensor moves with the base beside its modes is its row of rigid_body, whatever mass and stiffness are (see
`sysid.modal_analysis.direct_terms`). Records that differ from it by a sign, a unit, a gain, or because two
sensors stand in each other's place, tell so. docs/mistakes.md has the table of what can be told, and what cannot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sysid.assessment.checks.against_records import unresolved
from sysid.assessment.checks.context import Context, of_tests
from sysid.assessment.checks.stated import wrong_statements
from sysid.errors import InputError, refuse
from sysid.files.units import STANDARD_GRAVITY
from sysid.finding import Finding, Kind, Severity
from sysid.measurement.in_time import as_whole
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.delays import Clock, Delays
from sysid.modal_analysis.direct_terms import DirectTerms, direct_terms
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.rough_poles import poles_of_test
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array
from sysid.structure.thresholds import CANDIDATES, MENDED, most_deviations

CONJUGATED = 0.3  # relative misfit, beyond which modes explain the records at most as conjugated ones
_GROSS = 0.15  # of a sensor's rigid-body motion: smaller errors of gains are told by what was fitted
_LIKE = 0.04  # by how much a factor may differ from that of two units, and other sensors where one alone is wrong
_NONE = 0.1  # of a sensor's rigid-body motion; as good as none, or not known where the standard deviation is larger
_CARRIED = 0.5  # of the rigid-body motion, that modes between the lines carry: there is no other below them
_UNITS = (  # what sensors over base are multiplied by, in words, and the units with the smaller and the larger numbers
    (STANDARD_GRAVITY, "9.81", "g", "m/s²"),
    (1 / STANDARD_GRAVITY, "9.81", "g", "m/s²"),
    (1000.0, "1,000", "m/s²", "mm/s²"),
    (1 / 1000.0, "1,000", "m/s²", "mm/s²"),
)
_CLEAR = (-1.0, *(unit[0] for unit in _UNITS))  # factors that no mode makes


def mistakes_of(test: Measurement, terms: DirectTerms | None) -> list[Finding]:
    """Mistakes that a test shows by itself and its direct terms, the worst first; none where it cannot tell.

    Those that spoil all channels are blocking.
    """
    if terms is None:
        return []
    if terms.misfit > CONJUGATED:
        still = [] if terms.below else [one for one in _of_motion(test, terms) if one.kind == "dropout"]
        return [*_conjugated(test, terms), *still]
    if terms.below:
        return []
    return [*_of_motion(test, terms), *_of_force(test, terms)]


def _conjugated(test: Measurement, terms: DirectTerms) -> Iterator[Finding]:
    """The conjugates of the spectra are those of modes, and the spectra are not."""
    if test.is_whole:
        return
    force = None if test.force is None else test.force.conj()
    other = direct_terms(replace(test, base=test.base.conj(), response=test.response.conj(), force=force))
    if other is not None and other.misfit < MENDED * terms.misfit:
        yield Finding(
            "conjugated spectra", Severity.BLOCKING,
            "the spectra follow exp(-i w t): modes that decay leave "
            f"{100 * terms.misfit:.3g} % of the responses, and {100 * other.misfit:.3g} % of their conjugates",
            "take the complex conjugate of response and force (numpy.conj)",
            numbers={"misfit": terms.misfit, "conjugated": other.misfit},
        )  # fmt: skip


def _reach(test: Measurement) -> Array:
    """Largest motion of any sensor for unit base motion, by direction, (d,)."""
    reach = np.abs(test.rigid_body).max(axis=0)
    return np.asarray(np.where(reach > 0, reach, 1.0))


def _names(test: Measurement, which: NDArray[np.intp]) -> str:
    return " and ".join(test.sensor_names[i] for i in which)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Rigid-body motion of the sensors whose own is known: as stated, as recorded, its error; in units of `_reach`."""

    sensors: NDArray[np.intp]
    stated: Array
    recorded: Array
    std: Array
    modal: Array

    def agree(self, stated: Array, within: float = _GROSS) -> NDArray[np.bool_]:
        """Which rows are recorded as these say, but for what is usual and for chance."""
        size = np.linalg.norm(stated, axis=1, keepdims=True)
        off = np.abs(self.recorded - stated)
        return np.asarray(np.all(off < np.maximum(within * size, most_deviations(CANDIDATES) * self.std), axis=1))


def _of_motion(test: Measurement, terms: DirectTerms) -> Iterator[Finding]:
    """Difference of recorded and stated rigid-body motion, by the simplest explanation of all of it."""
    reach = _reach(test)
    G, c, std = test.rigid_body / reach, terms.rigid / reach, terms.rigid_std / reach
    size = np.linalg.norm(G, axis=1)
    gain = np.maximum(np.linalg.norm(c, axis=1) / np.where(size > 0, size, 1.0), 1.0)
    known = np.flatnonzero((size > 0) & (np.linalg.norm(std, axis=1) < _NONE * size * gain))
    motion = _Motion(known, G[known], c[known], std[known], (terms.modal / reach)[known])
    right = motion.agree(motion.stated)
    if known.size == 0 or np.all(right):
        return
    if known.size > 1:
        found = [*_relative(motion), *_of_columns(test, motion)]
        if found:
            yield from found[:1]
            return
    for factor in (1.0, *_CLEAR):
        # One mistake in all sensors, and another in a few of them.
        of_all = replace(motion, stated=factor * motion.stated)
        right = of_all.agree(of_all.stated)
        sharp = np.max(np.linalg.norm(motion.std, axis=1)) < _LIKE * abs(factor)
        if 2 * np.count_nonzero(right) > known.size and (factor == 1.0 or sharp):
            yield from () if factor == 1.0 else _of_all(motion, factor)
            yield from _swapped(test, of_all, right) or _of_sensors(test, of_all, right)
            return
    right = motion.agree(motion.stated)
    yield from _swapped(test, motion, right) or _of_sensors(test, motion, right)


def _relative(motion: _Motion) -> Iterator[Finding]:
    """No sensor moves with the base, though their modes carry what moves with it."""
    size = np.linalg.norm(motion.stated, axis=1)
    carried = np.sum(motion.modal * motion.stated) / np.sum(motion.stated**2)
    if np.all(np.linalg.norm(motion.recorded, axis=1) < _NONE * size) and carried > _CARRIED:
        yield Finding(
            "relative responses", Severity.BLOCKING,
            "the responses are relative to the base, not absolute: beside their modes the sensors do not move with the "
            "base at all",
            "add what rigid_body makes of the base's acceleration (response + G base)",
        )  # fmt: skip


def _of_columns(test: Measurement, motion: _Motion) -> Iterator[Finding]:
    """Each base direction has one factor of its own in all sensors."""
    weight = np.sum(motion.stated**2, axis=0)
    moved = weight > 0
    several = np.count_nonzero(np.abs(motion.stated) > _NONE, axis=0) > 1
    factor = np.ones(weight.size)
    factor[moved] = np.sum(motion.stated * motion.recorded, axis=0)[moved] / weight[moved]
    if not np.all(motion.agree(motion.stated * factor)):
        return
    turns = ~test.translational & moved
    others = test.translational & moved
    alike = np.ptp(factor[moved]) < _LIKE * np.abs(factor[moved]).max()
    if alike:
        yield from _of_all(motion, float(np.mean(factor[moved])))
    elif np.all(np.abs(factor[others] - 1) < _GROSS) and np.any(turns):
        for value, words in (
            (1e-3, "mm in the place of m"),
            (1e-2, "cm in the place of m"),
            (1e3, "km in the place of m"),
        ):
            if np.all(np.abs(factor[turns] / value - 1) < _GROSS):
                yield Finding(
                    "positions", Severity.BLOCKING,
                    f"the positions behind rigid_body are in {words}, not m: for a rotation of the base the sensors "
                    f"move {value:g} times what it says, a factor of {1 / value:,.0f}, and for translations as it says",
                    "give positions in m", numbers={"factor": value},
                )  # fmt: skip
    reversed_ = [int(i) for i in np.flatnonzero(moved) if abs(factor[i] + 1) < _GROSS]
    # Where one sensor alone shows a direction, it is told of that sensor.
    if not alike and reversed_ and np.all(several[reversed_]) and np.all(np.abs(np.abs(factor[moved]) - 1) < _GROSS):
        assert test.base_axes is not None
        axes = ", ".join(test.base_axes[i] for i in reversed_)
        yield Finding(
            "sign", Severity.BLOCKING,
            f"the sign of the base in {axes} is reversed: beside their modes all sensors move against it",
            "change the sign of its record, or of its column of rigid_body", channel=f"base {axes}",
        )  # fmt: skip


def _of_all(motion: _Motion, factor: float) -> Iterator[Finding]:
    """Meaning of one factor in all sensors and directions."""
    if abs(factor + 1) < _GROSS:
        yield Finding(
            "sign", Severity.BLOCKING,
            "the sign of the base is reversed, or that of all sensors: beside their modes all move against the base",
            "change the sign of the base's record", numbers={"factor": factor},
        )  # fmt: skip
    for value, times, small, large in _UNITS:
        if abs(factor / value - 1) < _LIKE:
            first, second = ("the base is", "the sensors are") if value > 1 else ("the sensors are", "the base is")
            yield Finding(
                "unit", Severity.BLOCKING,
                f"{first} in {small} where {second} in {large}: beside their modes the sensors move {factor:.3g} times "
                f"as rigid_body says, a factor of {times}",
                "bring both to m/s²", numbers={"factor": factor},
            )  # fmt: skip


def _swapped(test: Measurement, motion: _Motion, right: NDArray[np.bool_]) -> list[Finding]:
    """Two sensors stand in each other's place, and a third is right."""
    wrong = np.flatnonzero(~right)
    if wrong.size != 2 or right.size < 3:
        return []
    there = motion.stated.copy()
    there[wrong] = there[wrong[::-1]]
    if not np.all(motion.agree(there)):
        return []
    first, second = motion.sensors[wrong].tolist()
    swapped = Finding(
        "swapped sensors", Severity.CONTRADICTS,
        f"{_names(test, motion.sensors[wrong])} are swapped: beside their modes each moves with the base as "
        "rigid_body says of the other",
        "exchange their records, or their rows of rigid_body", channel=test.sensor_names[first],
        numbers={"sensor": float(first), "other": float(second)},
    )  # fmt: skip
    return [swapped]


def _of_sensors(test: Measurement, motion: _Motion, right: NDArray[np.bool_]) -> Iterator[Finding]:
    """Which few sensors have a sign, a unit or a gain of their own, where most are right."""
    wrong = np.flatnonzero(~right)
    if 2 * wrong.size > right.size:
        return
    stated, recorded = motion.stated[wrong], motion.recorded[wrong]
    factor = np.sum(stated * recorded, axis=1) / np.sum(stated**2, axis=1)
    error = np.linalg.norm(motion.std[wrong], axis=1) / np.linalg.norm(stated, axis=1)
    scaled = motion.stated.copy()
    scaled[wrong] *= factor[:, None]
    agree = motion.agree(scaled)
    for i, value, std in zip(wrong, factor, error, strict=True):
        # Modes far below the lines move some sensors more than others, but not one alone.
        alone = wrong.size == 1 and np.count_nonzero(motion.agree(motion.stated, _LIKE)) == right.size - 1
        if agree[i] and (alone or any(abs(value / ratio - 1) < _LIKE for ratio in _CLEAR)):
            carried = np.sum(motion.modal[i] * motion.stated[i]) / np.sum(motion.stated[i] ** 2)
            value = next(
                (u[0] for u in _UNITS if abs(value - u[0]) < min(most_deviations() * std, _GROSS * u[0])), value
            )
            yield from _of_sensor(test.sensor_names[motion.sensors[i]], float(value), float(carried))


def _of_sensor(name: str, factor: float, carried: float) -> Iterator[Finding]:
    """Meaning of a factor of one sensor alone."""
    seen = "beside its modes it moves with the base"
    unit = next((one for one in _UNITS if abs(factor / one[0] - 1) < _LIKE), None)
    kind: Kind | None = None
    if abs(factor + 1) < _GROSS:
        kind, remedy = "sign", 'change its sign, or its axis in sensors.toml ("-x" in place of "x")'
        sentence = f"the sign of {name} is reversed: {seen} by {factor:.3g} times what rigid_body says"
    elif unit is not None:
        _, times, small, large = unit
        of_sensor, of_base = (small, large) if factor < 1 else (large, small)
        kind, remedy = "unit", "bring both to m/s²"
        sentence = (
            f"{name} is in another unit than the base: {seen} by {factor:.4g} times what rigid_body says, a factor of "
            f"{times}, as of a sensor in {of_sensor} and a base in {of_base}"
        )
    elif abs(factor) < _NONE and carried > _CARRIED:
        kind, remedy = "relative responses", "add the base's acceleration to its record"
        sentence = (
            f"{name} is relative to the base, where the other sensors are absolute: {seen} by {factor:.2g} times what "
            "rigid_body says"
        )
    elif abs(factor) < _NONE:
        kind, remedy = "dropout", "mend its cable or range, or leave it out"
        sentence = f"{name} records nothing of the motion: {seen} by {factor:.2g} times what rigid_body says"
    elif factor >= _NONE:
        kind, remedy = "gain", f"divide its record by {factor:.3g}, or correct its row of rigid_body"
        sentence = (
            f"the gain of {name} is {factor:.3g}: {seen} by so many times what rigid_body says, and the other sensors "
            "as it says"
        )
    if kind is not None:
        yield Finding(kind, Severity.CONTRADICTS, sentence, remedy, channel=name, numbers={"factor": factor})


def _of_force(test: Measurement, terms: DirectTerms) -> Iterator[Finding]:
    """The base force weighs a negative mass, at low frequency and by its modes."""
    if terms.mass is None or terms.mass_std is None or terms.modal_mass is None:
        return
    weighed, std, modal = (np.diag(it) for it in (terms.mass, terms.mass_std, terms.modal_mass))
    against = np.flatnonzero((weighed < -most_deviations(CANDIDATES) * std) & (modal < 0))
    if against.size:
        assert test.base_axes is not None
        masses = ", ".join(f"{weighed[i]:.4g}" for i in against)
        axes = "" if against.size == test.n_base else f" in {', '.join(test.base_axes[i] for i in against)}"
        yield Finding(
            "force sign", Severity.BLOCKING,
            f"the sign of the base force{axes} is reversed: it weighs {masses} (kg, or kg m²)",
            "give the force of the base on the structure, in phase with the base's acceleration at low frequency",
            numbers={f"weighed {i + 1}": float(weighed[i]) for i in against},
        )  # fmt: skip


def wrong_records(context: Context) -> Iterator[Finding]:
    """Records, or what is stated of them, are wrong by a sign, a unit, a swapped sensor."""
    yield from context.named


def late_channels(context: Context) -> Iterator[Finding]:
    """Sensors or the force were recorded late against the base: their delays are found, and taken off."""
    problem = context.problem
    tests = problem.modal[not problem.formulation.fits_records :]
    yield from of_tests([list(_late(one.given, one.delays or Delays.none(one.given))) for one in tests])


def _late(test: Measurement, delays: Delays) -> Iterator[Finding]:
    """One finding of a base that is early, else one of each channel, the most certain first."""
    names = [*test.sensor_names, "the base force"]
    certain = np.argsort(-np.abs(delays.values) / np.where(delays.values != 0, delays.std, 1.0), kind="stable")
    for channel in certain[: 1 if delays.of_base else np.count_nonzero(delays.values)]:
        delay, std = float(delays.values[channel]), float(delays.std[channel])
        who, whom = ("the base", "all other channels") if delays.of_base else (names[channel], "the base")
        word = "early" if (delay < 0) != delays.of_base else "late"
        yield Finding(
            "late sensor", Severity.NOTE,
            f"{who} is recorded {1e3 * abs(delay):.4g} ms {word} against {whom} (standard deviation {1e3 * std:.1g} "
            "ms), as by a clock or a filter of its own; that is taken off before anything else is judged",
            f"state it where the channel is described: delay = {_digits(delay, std, delays.of_base)}, or bring the "
            "records to one clock (sysid.resample), or filter all channels alike",
            channel=None if delays.of_base else who, numbers={"delay": delay, "std": std},
        )  # fmt: skip


def _digits(delay: float, std: float, of_base: bool) -> str:
    """A delay, s, to a tenth of its deviation at least; that of the base is the others' with the other sign."""
    digits = int(np.clip(1 - np.floor(np.log10(max(std, 1e-9))), 6, 9))
    return f"{round((-1) ** of_base * delay, digits):.9g}"


def check_records(prepared: Prepared, clocks: Sequence[Clock], monitor: FitMonitor) -> tuple[Finding, ...]:
    """Mistakes that records show before a search, the worst first; nothing is prepared that no check asks for.

    Raises InputError where one spoils all channels, or a channel of a problem whose model has a form of its own, so
    that a search would be in vain; Stop and KeyboardInterrupt of the monitor, where modes are fitted, pass through.
    """
    problem, declared = prepared.stated, prepared.stated.declared
    fitted = clocks[problem.misfit is not None :]
    found = of_tests([_of_test(prepared, declared, clock, monitor, first=clock is clocks[0]) for clock in fitted])
    every = tuple(found)
    # A gain of one sensor may be fitted so far that the rest is of use.
    fitted_all_the_same = lambda one: declared.free_modes or one.kind in ("gain", "short segments")  # noqa: E731
    in_vain = [one.severity is Severity.BLOCKING or not fitted_all_the_same(one) for one in every]
    refuse(*zip(in_vain, map(str, every), strict=True))
    return every


def _of_test(
    problem: Prepared, declared: Formulation, clock: Clock, monitor: FitMonitor, *, first: bool
) -> list[Finding]:
    test = clock.test
    try:
        terms = direct_terms(test, clock.beside)
        found = mistakes_of(test, terms)
        if found and terms is not None and terms.misfit <= CONJUGATED and not test.is_whole:
            # Of records cut in motion, transients that were left in look like gains.
            test = as_whole(test)
            if test.is_whole:
                terms = direct_terms(test)
                found = mistakes_of(test, terms)
        if first and not found and terms is not None:
            found = list(wrong_statements(problem, declared, test, terms, monitor))
        if not found and test.averaged:
            found = list(unresolved(test, *poles_of_test(test)))
    except (np.linalg.LinAlgError, InputError):  # records that tell nothing; the search says so
        return []
    return found
