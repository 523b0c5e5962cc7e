"""What a fit leaves of its records: errors of the model, frequencies that change, noise that is not white, outliers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.context import BEYOND, Context, misses_of_test
from sysid.errors import InputError
from sysid.finding import MOST_OF_A_KIND, Finding, Severity
from sysid.measurement.in_time import levels_are_known, peaks
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import of_run
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.law_spectra import without_laws
from sysid.modal_analysis.misfit import without_transients_of
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.outliers import HUBER
from sysid.modal_analysis.stretches import Stretch, stretches_of
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array
from sysid.structure.thresholds import COVERAGE, FALSE_ALARM, LIKELY, most_deviations

LEVEL = 1.25  # times the fitted levels, beyond which another is outside
_CUT = (
    "these are plain spectra of records that move at their ends, which hold transients too: take whole records "
    "(from_time's estimator='records')"
)
_MOVED = 0.1  # half-power widths, by which the frequency of a mode changes at least
_EXPLAINED = 0.7  # of the squares that constant poles leave: poles that change leave no more
_LEAST_LEVEL = 0.03  # of the largest level of a mode, at which it shows
_OF_RUNS = 0.15  # of the variance of frequencies, that is left within runs where runs differ
_CLOSE = 0.06  # of their frequency, within which modes ..
_ONE_SHAPE = 0.9  # .. of one shape (modal assurance criterion) may be one that changes


def beyond_noise(context: Context) -> Iterator[Finding]:
    """The model misses the records by more than their noise."""
    unjudged = context.problem.stated.goal is not None and (context.named or not context.is_judged)
    if unjudged or context.has("table rocks"):
        return
    for miss in context.misses:
        if miss.times > BEYOND:
            yield Finding(
                "beyond noise", context.weight,
                f"the model misses {miss.record} by {'at least ' * miss.at_least}{miss.times:.2g} times {miss.whose} "
                f"noise ({100 * miss.share:.3g} %): what it leaves out is larger than what the instruments add",
                _CUT * miss.cut, numbers={"times": miss.times, "share": miss.share},
            )  # fmt: skip


def least_squares(context: Context) -> Iterator[Finding]:
    """No modes with noise in all channels explain whole records, and squares of what is left were fitted instead."""
    if context.named or not context.is_judged or context.has("supports differ", "table rocks"):
        return
    for i, modal, structure in context.fits:
        whole = modal.given.whole
        if whole is not None and whole.plain:
            left = modal.records.residual(structure)
            which = "the records" if len(context.fits) == 1 else f"the records of test {i}"
            yield Finding(
                "least squares", context.weight,
                f"no modal model explains {which}, even with noise in every channel: the modes were fitted by least "
                f"squares instead, with the recorded motion of the base taken as exact ({100 * left:.3g} % of the "
                "response is missed; a rigid body misses 100 %)",
                "look for what moves the structure beside the recorded base (another support, a load), and for parts "
                "that yield, slip or rattle", numbers={"test": float(i), "residual": left},
            )  # fmt: skip


def unpredicted_tests(context: Context) -> Iterator[Finding]:
    """A test that was not fitted is predicted worse than by a rigid body."""
    if not context.is_judged or context.named:
        return
    for i, test in _unfitted(context):
        residual = test.residual(context.end.structure)
        if residual > 1.0:
            yield Finding(
                "unpredicted", Severity.CONTRADICTS,
                f"test {i} that was not fitted is predicted worse ({100 * residual:.3g} % missed) than by saying that "
                "the sensors move with the table (100 %)",
                numbers={"test": float(i), "residual": residual},
            )  # fmt: skip


def _unfitted(context: Context) -> Iterator[tuple[int, Measurement]]:
    """Tests that were not fitted, without transients, at the lines that the answer is for, and their numbers from 1.

    The modes of an answer in the band are said to hold at its lines alone.
    """
    first, last = context.problem.stated.measurement.freq[[0, -1]]
    for i, test in enumerate(context.problem.validation, start=1):
        inside = (test.freq >= first) & (test.freq <= last) | (not context.problem.answers_in_band)
        if np.any(test.base[..., inside]) and np.any(test.response[..., inside]):
            structure = context.end.structure  # a law moves under the base at all lines
            yield i, without_transients_of(without_laws(test, structure).at(inside), structure.with_laws(()))


def other_levels(context: Context) -> Iterator[Finding]:
    """A test that was not fitted moves more or less than any that was."""
    problem = context.problem
    if not problem.formulation.fits_records:
        return
    fitted = peaks(problem.stated.measurement)
    for i, test in enumerate(problem.stated.validation, start=1):
        levels = peaks(test)
        if not (fitted and levels):
            continue
        if max(levels) > LEVEL * max(fitted) or max(levels) < min(fitted) / LEVEL:
            span = " to ".join(dict.fromkeys(f"{end:.3g}" for end in (min(fitted), max(fitted))))
            yield Finding(
                "level", Severity.NOTE,
                f"test {i} that was not fitted moves the sensors by up to {max(levels):.3g} m/s² against the base, the "
                f"fitted run{'s' * (len(fitted) > 1)} by {span} m/s²: what holds at one level need not "
                "hold at another",
                numbers={"test": float(i), "peak": float(max(levels)), "fitted": float(max(fitted))},
            )  # fmt: skip


class Seen(NamedTuple):
    """A mode in a stretch: the record and, in words, where in it; Hz; root mean square of its motion."""

    record: str
    part: str
    frequency: float
    std: float
    level: float


class Change:
    """A mode in the stretches of all records: its frequency over all of them and half-power width, Hz.

    `scaled` tells that levels are in m/s².
    """

    def __init__(self, mode: float, width: float, seen: list[Seen], scaled: bool) -> None:
        self.mode, self.width, self.scaled = mode, width, scaled
        largest = max((one.level for one in seen), default=0.0)
        self.seen = [one for one in seen if one.level > _LEAST_LEVEL * largest]
        self.frequency = np.array([one.frequency for one in self.seen])

    def is_significant(self, explained: bool) -> bool:
        """True where it changes by a part of the width, with two signs of three.

        Two stretches differ beyond what noise makes of them; the order by level is no chance; poles that change have
        `explained` the records, which they do little where the level changes within stretches.
        """
        std = np.array([one.std for one in self.seen])
        change = np.abs(self.frequency[:, None] - self.frequency)
        moved = change > _MOVED * self.width
        differ = bool(np.any(moved & (change > most_deviations(change.size) * np.hypot(std[:, None], std))))
        return bool(np.any(moved)) and explained + differ + (self.trend_of(FALSE_ALARM) != 0) >= 2

    @property
    def size(self) -> float:
        """In half-power widths."""
        return float(np.ptp(self.frequency)) / self.width

    @cached_property
    def trend(self) -> float:
        """Rank correlation of frequency and level; zero where chance or time make as large a one."""
        return self.trend_of(1 - COVERAGE)

    def trend_of(self, chance: float) -> float:
        """The same, where chance makes as large a one no more often than stated."""
        from scipy.stats import spearmanr

        if len(self.seen) < 5:  # fewer stretches tell no trend
            return 0.0
        found = spearmanr([one.level for one in self.seen], self.frequency)
        in_time = abs(spearmanr(np.arange(len(self.seen)), self.frequency).statistic)
        return float(found.statistic) if found.pvalue < chance and abs(found.statistic) > in_time else 0.0

    def in_words(self) -> tuple[str, str]:
        """The way in which the frequency changes, and what to do."""
        records = list(dict.fromkeys(one.record for one in self.seen))
        by_record = {record: [one for one in self.seen if one.record == record] for record in records}
        within = np.mean([np.var([one.frequency for one in part]) for part in by_record.values()])
        if len(records) > 1 and within < _OF_RUNS * np.var(self.frequency):
            return self._by_record(by_record)
        if self.trend != 0.0:
            return self._by_level()
        low, high = self.seen[int(np.argmin(self.frequency))], self.seen[int(np.argmax(self.frequency))]
        ends = (f"{one.frequency:.4g} Hz at {one.part} of {one.record}" for one in (low, high))
        return (
            f"changes along the records, from {' to '.join(ends)}: the structure is not the same all the time (level, "
            "temperature, joints)",
            "fit a part in which it is",
        )

    def _by_record(self, of_records: dict[str, list[Seen]]) -> tuple[str, str]:
        means = {r: np.mean([(one.frequency, one.level) for one in part], axis=0) for r, part in of_records.items()}
        words = ", ".join(f"{f:.4g} Hz in {record} at {self._motion(level)}" for record, (f, level) in means.items())
        return f"differs from record to record ({words})", "fit them one by one, and find what changed between them"

    def _by_level(self) -> tuple[str, str]:
        first, *_, last = sorted(self.seen, key=lambda one: one.level)
        rises, softens = ("falls", "softens") if self.trend < 0 else ("rises", "stiffens")
        return (
            f"{rises} as the motion grows, from {first.frequency:.4g} Hz at {self._motion(first.level)} to "
            f"{last.frequency:.4g} Hz at {self._motion(last.level)} of the sensor that it moves most: the structure "
            f"{softens}, and no linear model holds at all levels",
            "let it follow its amplitude, or fit runs of the level of interest",
        )

    def _motion(self, level: float) -> str:
        """A level in words."""
        least = min(one.level for one in self.seen)
        return f"{level:.2g} m/s² rms" if self.scaled else f"{level / least:.2g} times the least motion"


def changing_frequencies(context: Context) -> Iterator[Finding]:
    """Frequencies change along the records, from run to run, or with level."""
    if not context.is_judged or context.named:
        return
    structure, modal = context.end.structure, context.modal
    missed = [miss for _, test in _unfitted(context) for miss in misses_of_test(test, structure)]
    uneven = bool(modal.scatter is not None or modal.excess)
    if not (uneven or any(miss.times > BEYOND for miss in (*context.misses, *missed))):
        return
    try:
        yield from changing(context.problem, context.weight)
    except (InputError, np.linalg.LinAlgError) as error:
        why = f"whether frequencies change along the records was not judged: {error}"
        yield Finding("changes not judged", context.weight, why)


def changing(problem: Prepared, severity: Severity = Severity.CONTRADICTS) -> tuple[Finding, ...]:
    """The mode whose frequency changes most between stretches of all records; none where none does.

    Tests that were never fitted are looked at too, where the levels of all are known.
    """
    found = changes(problem)
    if not found:
        return ()
    most = max(found, key=lambda one: (one.trend != 0, one.size))
    others = ", ".join(f"{one.mode:.3g}" for one in found if one is not most)
    also = f" (and that of others near {others} Hz)" if others else ""
    how, remedy = most.in_words()
    numbers = {
        "frequency": most.mode, "lowest": float(most.frequency.min()), "highest": float(most.frequency.max()),
        "trend": most.trend,
    }  # fmt: skip
    sentence = f"the frequency of the mode near {most.mode:.3g} Hz{also} {how}"
    return (Finding("changing", severity, sentence, remedy, numbers=numbers),)


def laws_of_amplitude(context: Context) -> Iterator[Finding]:
    """Modes that were asked to follow their amplitude: they do, they are linear, or the records do not tell."""
    asked = context.problem.stated.amplitude
    if asked is None:
        return
    stopped = context.modal.stopped and not context.end.structure.laws
    if stopped or not context.modal.laws:
        why, remedy = "the answer has not the modes that they need", "ask for more modes"
        if stopped:
            why, remedy = "the search was stopped", "let it end"
        sentence = f"laws of amplitude are left out, as {why}"
        yield Finding("amplitude open", Severity.CAUTION, sentence, remedy)
    frequencies = context.end.structure.natural_frequencies
    near = [(law, law.mode_among(frequencies, 0.25)) for law in context.modal.laws]
    for law, mode in ((law, k + 1) for law, k in near if k is not None):  # `judge` tells of the others
        low, high = law.levels
        numbers = {"mode": float(mode), "lowest": low, "highest": high}
        (f, zeta), (std, of_damping) = law.change()
        numbers |= {"change of frequency": f, "its deviation": std, "change of damping": zeta}
        over = f"over the levels tested ({low:.2g} to {high:.2g} m/s²)"
        other = law.mode_among(frequencies, followed=True)
        numbers["level of mode"] = float(mode if other is None else other + 1)
        whose = f"the amplitude of mode {other + 1}" if law.followed and other is not None else "its amplitude"
        if law.is_certain:
            yield Finding(
                "amplitude law", Severity.NOTE,
                f"mode {mode} follows {whose}: from {low:.2g} to {high:.2g} m/s² its frequency changes by "
                f"{100 * f:.2g} % (+- {100 * LIKELY * std:.2g} %) and its damping ratio by {100 * zeta:.2g} % of "
                f"critical (+- {100 * LIKELY * of_damping:.2g}); at level A they are {law.formula}", numbers=numbers,
            )  # fmt: skip
        elif 4 * (most := abs(f) + LIKELY * std) < law.ratio:  # an eighth of the half-power width
            yield Finding(
                "linear", Severity.NOTE,
                f"mode {mode} is linear {over}: its frequency changes by less than {100 * most:.2g} %",
                numbers=numbers,
            )  # fmt: skip
        else:
            yield Finding(
                "amplitude open", Severity.CAUTION,
                f"whether mode {mode} follows its amplitude is not determined {over}: its frequency may change by up "
                f"to {100 * most:.2g} %, which is more than an eighth of its half-power width",
                "test at several levels, the lowest a tenth of the highest, each for longer", numbers=numbers,
            )  # fmt: skip


def changes(problem: Prepared) -> list[Change]:
    """Modes whose frequencies change between stretches of all records, by more than noise makes of them."""
    if not problem.formulation.fits_records:
        return []
    given = problem.modal[0].given
    scaled = levels_are_known(given)
    unfitted = [(i, test) for i, test in enumerate(problem.validation, start=1) if scaled and levels_are_known(test)]
    tests = [(0, given), *unfitted]
    every = _modes(problem.screened.modal[0])
    if every is None:
        return []
    modes, apart = every.joined(_CLOSE * every.omega), every.joined(2 * every.ratios * every.omega)
    stretches = [stretches_of(test, modes.omega, modes.ratios) for _, test in tests]
    # Modes of one shape that are close may be two, with constant poles that explain the records.
    held = stretches
    if modes.omega.size < apart.omega.size:
        held = [stretches_of(test, apart.omega, apart.ratios) for _, test in tests]
    constant = sum(one.left_by_all**2 for part in held for one in part)
    changing = sum(min(one.left, one.left_by_all) ** 2 for part in stretches for one in part)
    if 0 < constant < changing:
        return []
    found = []
    with_law = [law.frequency for law in problem.laws]  # what changes by a law is told there
    for k, (f, ratio) in enumerate(zip(modes.omega / (2 * np.pi), modes.ratios, strict=True)):
        width = 2 * ratio * f
        beyond = not given.freq[0] <= f <= given.freq[-1]  # a pole there stands for what the lines hardly show
        if beyond or any(abs(f / one - 1) < _CLOSE for one in with_law):
            continue
        seen = [one for part, named in zip(stretches, tests, strict=True) for one in _seen(part, k, width, *named)]
        change = Change(f, width, seen, scaled)
        if change.is_significant(changing < _EXPLAINED * constant):
            found.append(change)
    return found


class ObservedPoles(NamedTuple):
    """Poles that records show: rad/s, damping ratios, (m,); unit shapes of all that they move, (.., m)."""

    omega: Array
    ratios: Array
    shapes: Array

    def joined(self, reach: Array) -> ObservedPoles:
        """Merge those of one shape within `reach`, rad/s, (m,): a fit makes several of one mode that changes."""
        groups: list[list[int]] = []
        for k, omega in enumerate(self.omega):
            near = [group for group in groups if omega - self.omega[group[0]] < reach[[k, *group]].max()]
            one = [(self.shapes[:, group[0]] @ self.shapes[:, k]) ** 2 > _ONE_SHAPE for group in near]
            like = [group for group, same in zip(near, one, strict=True) if same and len(self.shapes) > 1]
            if like:
                like[-1].append(k)
            else:
                groups.append([k])
        omega = np.array([self.omega[group].mean() for group in groups])
        ratios = np.array([self.ratios[group].max() for group in groups])
        return ObservedPoles(omega, ratios, self.shapes[:, [group[0] for group in groups]])


def _modes(modal: ModalEstimate) -> ObservedPoles | None:
    """Poles of a test; None where it shows none."""
    if modal.by_modes:
        omega, ratios, shapes = modal.omega, modal.ratios, modal.phi
    else:
        poles = PolesAndResidues.of(modal.records)
        if poles is None:
            return None
        omega, ratios, shapes = poles.omega, poles.ratios, poles.residues.reshape(poles.omega.size, -1).T
    if not omega.size:
        return None
    shapes = shapes / np.maximum(np.linalg.norm(shapes, axis=0), np.finfo(float).tiny)
    return ObservedPoles(omega, np.maximum(ratios, 1e-4), shapes)  # a pole without damping would have no width


def _seen(stretches: list[Stretch], k: int, width: float, number: int, test: Measurement) -> list[Seen]:
    """A mode in the stretches of a test in which it is known; test 0 is the one that was fitted."""
    seen = []
    for one in stretches:
        run = f"run {one.run + 1}" if test.n_runs > 1 else "the record"
        record = run if number == 0 else f"{run} of unfitted test {number}"
        if one.std[k] < width and one.left <= one.left_by_all:
            part = f"{one.start:.3g} to {one.end:.3g} s"
            seen.append(Seen(record, part, float(one.frequency[k]), float(one.std[k]), float(one.level[k])))
    return seen


def noise_of_records(context: Context) -> Iterator[Finding]:
    """Noise of whole records that is not white or not told, and what a fit leaves beside it."""
    for _, modal, _ in context.fits:
        yield from noise_findings(modal)


def noise_findings(modal: ModalEstimate) -> Iterator[Finding]:
    """Where the noise of whole records, their transients taken off, is not white, and what the fit leaves beside it."""
    test = modal.records
    axes = test.base_axes or ()
    names = [*test.sensor_names]
    names += [f"force {axis}" for axis in axes] * (test.force is not None)
    names += [f"base {axis}" for axis in axes]
    name = lambda one: names[one.channel] + of_run(one.run, test.n_runs)  # noqa: E731
    for one in modal.varying:
        times = float(one.largest / one.least)
        yield Finding(
            "coloured noise", Severity.NOTE,
            f"the noise of {name(one)} is not white: its level varies smoothly over the lines, {times:.2g} times from "
            "least to largest",
            run=one.run + 1, channel=names[one.channel], numbers={"times": times},
        )  # fmt: skip
    for run, channel in modal.untold:
        yield Finding(
            "noise level", Severity.NOTE,
            f"the records do not tell the noise level of {names[channel]}{of_run(run, test.n_runs)}, as it is small "
            "beside that of other channels or shows as theirs does: the level given is one of many that explain them "
            "as well",
            run=run + 1, channel=names[channel],
        )  # fmt: skip
    source = "intervals are by its scatter" if modal.scatter is not None else "intervals are as if it were white"
    for excess in modal.excess[:MOST_OF_A_KIND]:
        yield Finding(
            "noise left", Severity.NOTE,
            f"what the fit leaves in {name(excess)} is {excess.factor:.2g} times the noise level between "
            f"{excess.low:.3g} and {excess.high:.3g} Hz: the noise there is not white, or the model misses something; "
            f"{source}",
            run=excess.run + 1, channel=names[excess.channel],
            numbers={"times": float(excess.factor), "low": float(excess.low), "high": float(excess.high)},
        )  # fmt: skip


def numbers_far_off(context: Context) -> Iterator[Finding]:
    """Numbers far from the fit: all where they count little, else those that stand alone."""
    end, problem = context.end, context.problem
    remedy = ""
    if problem.stated.loss == "squares":
        what, remedy = (
            ", while the lines beside them fit",
            ("if they are spikes or drop-outs, state Problem(..., loss='huber'), or leave these lines out"),
        )
    elif any(phase.name == HUBER for phase in end.history.phases):
        what = ": they count little, by Huber's loss"
    else:
        what = (
            ": the search ended before Huber's loss, so they count in full; those that stand alone were left out from "
            "the beginning"
        )
    every = problem.outliers(end.structure, end.x)
    for i, modal, _ in context.fits:
        found = [one for one in every if one.test == i]
        if not found:
            continue
        numbers = modal.records.numbers
        which = "the records" if len(context.fits) == 1 else f"test {i}"
        channels = ", ".join(f"{name} {count}" for name, count in Counter(one.channel for one in found).most_common(4))
        yield Finding(
            "outliers", Severity.NOTE,
            f"{len(found)} of {numbers} numbers of {which} are up to {found[0].size:.3g} deviations from the fit "
            f"({found[0].channel} at {found[0].freq:.5g} Hz; by channel {channels}){what}",
            remedy, run=found[0].run, channel=found[0].channel,
            numbers={
                "count": float(len(found)), "deviations": float(found[0].size), "frequency": float(found[0].freq),
                "test": float(i),
            },
        )  # fmt: skip
