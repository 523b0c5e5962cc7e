"""Context of checks: a problem, its modes, where a search ended, and by how many times its noise a record is missed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sysid.finding import Finding, Severity, contradicting
from sysid.measurement.in_time import cut_in_motion, quiet_levels
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.noise_levels import quietest
from sysid.modal_analysis.outliers import Outlier
from sysid.modal_analysis.response import misfits, records_of
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, ComplexArray, Structure

BEYOND = 3.0  # times the noise, from which a model is not within it
_UNKNOWN = 0.1  # relative residual, up to which spectra without a stated noise may hold as much of it at some lines
_NEAR = 5.0  # half-power widths, or distances of lines, about a mode
_TRACE = 1e-4  # of the records; smaller ones are no noise of an instrument

_FORCE = "the base force"


class Miss(NamedTuple):
    """By how many times its noise a model misses a record; by as many at least where quiet lines tell the noise."""

    times: float
    at_least: bool
    record: str
    share: float
    """Of the record."""
    cut: bool
    """Whether it holds spectra of a record that neither begins nor ends at rest, with its transients."""

    @property
    def whose(self) -> str:
        """The pronoun of the record."""
        return "its" if self.record.startswith(_FORCE) else "their"


class JudgedRecord(NamedTuple):
    """Accelerations or base force of a test, (runs, channels, n_freq), and what a structure leaves of them."""

    name: str
    channels: tuple[str, ...]
    measured: ComplexArray
    left: ComplexArray
    std: Array | None
    """Of the noise at each line; None where it is neither stated nor found."""


def misses_of(problem: Prepared, structure: Structure, x: Array | None) -> list[Miss]:
    """Misfit of the structure to accelerations and base force of each test that is fitted.

    Records whose noise is neither stated nor to be found are left out; numbers that stand alone are not counted.
    """
    misses = list(_misses(problem, structure, x, []))
    if problem.stated.loss == "squares" and any(miss.times > BEYOND for miss in misses):  # spikes may be all there is
        return list(_misses(problem, structure, x, problem.outliers(structure, x)))
    return misses


def _misses(problem: Prepared, structure: Structure, x: Array | None, alone: list[Outlier]) -> Iterator[Miss]:
    fits = problem.screened.fits(structure, x)
    for i, (modal, its) in enumerate(fits, start=problem.first_test):
        of, test = "" if len(fits) == 1 else f" of test {i}", modal.records
        for record in _records(modal, its):
            for one in alone:
                if one.test == i and one.channel in record.channels:
                    at = int(np.argmin(np.abs(test.freq - one.freq)))
                    record.left[one.run - 1, record.channels.index(one.channel), at] = 0.0
            yield from _miss(record._replace(name=record.name + of), test, modal.found_noise, _near_modes(modal, its))


def _records(modal: ModalEstimate, structure: Structure) -> Iterator[JudgedRecord]:
    """Records of a test without its transients."""
    test, noise, quiet = modal.records, modal.noise, _quiet_base(modal)
    names = ("the accelerations", test.sensor_names), (_FORCE, tuple(f"force {axis}" for axis in test.base_axes or ()))
    levels = (None, None) if noise is None else (noise.response, noise.force)
    every = zip(names, records_of(test), misfits(test, structure), levels, strict=False)
    for (name, channels), (record, _), (left, std), level in every:
        if std is not None and quiet is not None and level is not None:
            std = _bounded(modal, std, level, left, quiet)
        yield JudgedRecord(name, channels, record, left, std)


def _quiet_base(modal: ModalEstimate) -> Array | None:
    """Share of the base's level that its quietest parts hold, (runs,), where levels were found; else None.

    Levels are found with modes of constant poles: what these leave at the peaks passes for noise of the base.
    """
    if modal.noise is None or not modal.found_noise or modal.varying or modal.shares is not None:
        return None
    quiet = quiet_levels(modal.given)
    return None if quiet is None else np.minimum(quiet.base / modal.noise.base, 1.0).max(axis=1)


def _bounded(modal: ModalEstimate, std: Array, level: Array, left: ComplexArray, passed: Array) -> Array:
    """Deviations (runs, channels, n_freq) of which a channel's own is at most what quiet lines hold of what is left.

    Hum and error of a model raise the level that was found. Of the base's share of the noise, `passed` is left, or less
    where quiet lines hold less.
    """
    test = modal.records
    of_channel = np.minimum(std**2, (modal.density[:, None] * np.broadcast_to(level, std.shape[:2]) ** 2)[..., None])
    base, share = std**2 - of_channel, passed**2
    quiet = _quiet(left, np.ones(left.shape), test.own_lines)
    if quiet is not None:
        of_base = _quiet(left, np.maximum(base, np.finfo(float).tiny), test.own_lines)
        share = np.minimum(share, np.asarray(of_base).min(axis=1))
        of_channel = np.minimum(of_channel, quiet[..., None])
    return np.asarray(np.sqrt(of_channel + share[:, None, None] * base))


def _near_modes(modal: ModalEstimate, structure: Structure) -> NDArray[np.bool_]:
    """Lines near a mode of a structure or of its records, (n_freq,)."""
    test, modes = modal.records, modal.modes if modal.record_fit is None else modal.record_fit.parameters.modes
    f = np.concatenate([structure.natural_frequencies, modes.omega / (2 * np.pi)])
    ratio = np.concatenate([structure.damping_ratios, modes.ratios])
    reach = np.maximum(2 * _NEAR * ratio * f, _NEAR * np.median(np.diff(test.freq))) if test.freq.size > 1 else np.inf
    return np.asarray(np.any(np.abs(test.freq - f[:, None]) < np.broadcast_to(reach, f.shape)[:, None], axis=0))


def _miss(record: JudgedRecord, test: Measurement, found: bool, near: NDArray[np.bool_]) -> Iterator[Miss]:
    """Misfit to one record in units of its noise; `found`: with the fit, so that it holds errors of the model.

    Of noise that is not stated, what stands out far from all modes is a part, such as hum.
    """
    in_run, size, missed = test.own_lines, float(np.linalg.norm(record.measured)), float(np.linalg.norm(record.left))
    variance = np.ones(record.left.shape) if record.std is None else record.std**2
    # Noise that is not stated may be in proportion to the record.
    if record.std is None and (test.has_unit_runs or missed < _UNKNOWN * size):
        return
    bounded = record.std is None or found
    if bounded:
        quiet = _quiet(record.left, variance, in_run)
        if quiet is None:
            return
        variance = variance if found else variance * quiet[..., None]
    variance = variance * in_run[:, None]
    noise = float(np.sqrt(np.sum(variance)))
    left = np.abs(record.left) ** 2
    if bounded:
        left = np.where(near, left, np.minimum(left, variance))
    if noise > _TRACE * size:
        times = float(np.sqrt(np.sum(left))) / noise
        yield Miss(times, bounded, record.name, missed / size, times > BEYOND and cut_in_motion(test))


def _quiet(
    left: ComplexArray, variance: Array, in_run: NDArray[np.bool_], least: int = 128, share: float = 0.25
) -> Array | None:
    """Power over the variance in the quietest `share` of blocks of lines, (runs, channels); None with few lines."""
    out = np.ones(left.shape[:2])
    for run, lines in enumerate(in_run):
        power = np.abs(left[run][:, lines]) ** 2 / variance[run][:, lines]
        if power.shape[1] < least:
            return None
        out[run] = np.minimum(quietest(power, share), power.mean(axis=1))
    return out


def noise_at_most(test: Measurement, left: ComplexArray) -> Array | None:
    """Noise that is not known, at most: what a fit leaves of the quietest quarter of the lines.

    Standard deviations (runs, channels, 1) by what is left (runs, channels, n_freq); None with few lines, and of
    transmissibilities, whose noise may be in proportion to them.
    """
    quiet = None if test.has_unit_runs else _quiet(left, np.ones(left.shape), test.own_lines)
    return None if quiet is None else np.asarray(np.sqrt(quiet)[..., None])


def misses_of_test(test: Measurement, structure: Structure) -> list[Miss]:
    """Misfit of a structure to a test that was not fitted."""
    modal = ModalEstimate.of_lines(test)
    near = _near_modes(modal, structure)
    return [miss for record in _records(modal, structure) for miss in _miss(record, test, False, near)]


class Ended(Protocol):
    """Where a search ended, as far as checks ask: see `sysid.search.strategy.Outcome`."""

    @property
    def structure(self) -> Structure:
        """The best structure."""

    @property
    def x(self) -> Array | None:
        """The unknowns that stand for it."""

    @property
    def success(self) -> bool:
        """Of the last solver."""

    @property
    def message(self) -> str:
        """The solver's message."""

    @property
    def stopped(self) -> BaseException | None:
        """The exception that ended it early."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of the search."""

    @property
    def history(self) -> Any:
        """The phases that ran."""


@dataclass(frozen=True, eq=False)
class Context:
    """A problem with the end of its search, and the findings of the checks that ran before.

    `cut_short`: the time was over, and a poor fit is blamed on nothing else. What was `found` may explain what a later
    check would tell.
    """

    problem: Prepared
    end: Ended
    cut_short: bool = False
    found: list[Finding] = field(default_factory=list)

    @property
    def modal(self) -> ModalEstimate:
        """The modal estimate of the problem's own records."""
        return self.problem.modal[0]

    @property
    def is_judged(self) -> bool:
        """True where a search ended by itself; what was stopped on its way has misfits of another kind."""
        end = self.end
        return end.stopped is None and (end.success or (self.problem.free_modes and not self.cut_short))

    @cached_property
    def named(self) -> tuple[Finding, ...]:
        """Mistakes that were named before or by the search: they explain what else speaks against the fit."""
        return tuple(one for one in contradicting(self.end.findings) if one.kind != "stated masses")

    @property
    def is_explained(self) -> bool:
        """True where nothing more is to be told: no fit to judge, bounds that keep it, or a mistake that was named.

        Beside one named before the search averages over segments are looked at all the same, for their leakage.
        """
        heavy = any(one.kind == "supports differ" and one.severity != Severity.NOTE for one in self.found)
        if not self.is_judged or heavy or self.has("bounds", "table rocks", "soft bracket"):
            return True
        return bool(self.named) and not self.problem.screened.measurement.averaged

    def has(self, *kinds: str) -> bool:
        """True where a check before has found one of these."""
        return any(one.kind in kinds for one in self.found)

    @cached_property
    def residual(self) -> float:
        """Relative residual of the accelerations, or of the user's own misfit."""
        problem, end = self.problem, self.end
        if end.x is None or problem.free_modes:
            return problem.screened.measurement.residual(end.structure)
        return problem.residual(end.x)

    @cached_property
    def misses(self) -> list[Miss]:
        """Misfit of the answer to each record in units of its noise; none of a search that was stopped."""
        end = self.end
        return misses_of(self.problem, end.structure, end.x) if end.stopped is None else []

    @property
    def weight(self) -> Severity:
        """Severity of an error of the model: a stated goal that is met accepts it."""
        goal = self.problem.stated.goal
        return Severity.CAUTION if goal is not None and self.residual <= goal else Severity.CONTRADICTS

    @cached_property
    def fits(self) -> list[tuple[int, ModalEstimate, Structure]]:
        """Number, from 1, and modal estimate of each test that is fitted, and the structure as it was in it."""
        problem, end = self.problem, self.end
        pairs = problem.fits(end.structure, end.x)
        return [(i, *pair) for i, pair in enumerate(pairs, start=problem.first_test)]


Check = Callable[[Context], Iterator[Finding]]


def run(context: Context, checks: Iterable[Check]) -> list[Finding]:
    """Run checks one after the other; what they found is added to the context, each finding once."""
    for check in checks:
        for one in check(context):
            if one not in context.found:
                context.found.append(one)
    return context.found


def of_tests(found: Sequence[Iterable[Finding]]) -> Iterator[Finding]:
    """Findings of each test, with its number where there are several."""
    for i, of_one in enumerate(found, start=1):
        yield from (one.of_test(i) if len(found) > 1 else one for one in of_one)
