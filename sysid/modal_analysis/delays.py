r"""Delays of the sensors and of the force against the base, by what their records leave beside modes.

A channel that is late by tau records :math:`e^{-i w \tau}` times its motion, which modes with real residues do not
make: beside poles, real residues, and terms without poles, a column ``i w`` times its own record tells its delay.
Delays of many periods are first looked for one channel at a time, on a grid, by what real residues leave. Damping that
couples modes turns residues too, one by one: where complex residues explain the records better than delays do, delays
are asked for beside these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, refuse
from sysid.measurement.channels import without_delays
from sysid.measurement.in_time import as_whole
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import factors_of_runs
from sysid.modal_analysis.direct_terms import (
    MOST_DAMPED,
    BesidePoles,
    BesideTerms,
    beside_poles,
    beside_poles_at,
    telling_lines,
    without_window,
)
from sysid.modal_analysis.least_squares import units_of
from sysid.modal_analysis.pole_functions import orthonormal
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.response import stacked
from sysid.modal_analysis.vector_fitting import GUESS
from sysid.nlp import one_thread
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EXACT, ROUND_OFF, UNEXPLAINED, beyond_chance, most_deviations

_PERIODS = 15  # of the last line, either way, that a delay is looked for in
_FAR = 5.0  # times errors that channels have of their own, of what the noise of the base makes in all of them
_LEAST_TURN = 1e-4  # rad at the last line: what a smaller delay does shows in no result


@dataclass(frozen=True, eq=False)
class Delays:
    """Delays against the base, s: of the sensors and then of the force, where one was measured, (k,).

    Attributes
    ----------
    values, std : (k,)
        Zero for channels that are on the base's clock.
    of_base : bool
        True where all share one: then it is the base that is early.
    """

    values: Array
    std: Array
    of_base: bool = False

    @classmethod
    def none(cls, test: Measurement) -> Delays:
        """Those of a test on one clock."""
        zero = np.zeros(test.n_sensors + (test.force is not None))
        return cls(zero, zero)

    def __bool__(self) -> bool:
        return bool(np.any(self.values))

    @property
    def beyond_chance(self) -> NDArray[np.bool_]:
        """Channels whose delay chance does not explain, (k,)."""
        return np.abs(self.values) > most_deviations(1 if self.of_base else self.values.size) * self.std

    def at(self, told: NDArray[np.intp], count: int) -> Delays:
        """These as those of some of so many channels, where the others tell none but that of the base."""
        if self.of_base:
            return Delays(np.full(count, self.values[0]), np.full(count, self.std[0]), True)
        values, std = np.zeros((2, count))
        values[told], std[told] = self.values, self.std
        return Delays(values, std, self.of_base)

    @classmethod
    def from_tree(cls, tree: dict[str, Any], test: Measurement) -> Delays:
        """Those of a test with these fields; refused where they are of another."""
        found, shape = cls(**tree), cls.none(test).values.shape
        parts = found.values, found.std
        sound = all(isinstance(one, np.ndarray) and one.shape == shape and np.all(np.isfinite(one)) for one in parts)
        refuse((not sound, "the stored delays are of another test, or hold what is no number"))
        return found


def stored_delays(tree: dict[str, Any], tests: Sequence[Measurement]) -> list[Delays]:
    """Delays of the tests of a stored problem; results of before hold none."""
    given = zip(tree.get("delays") or [None] * len(tests), tests, strict=False)
    return [Delays.none(test) if one is None else Delays.from_tree(one, test) for one, test in given]


@dataclass(frozen=True, eq=False)
class Clock:
    """A test on the clock of its base: without its delays, and what its poles leave, where these show."""

    test: Measurement
    delays: Delays | None
    """None where they are not asked for."""
    beside: BesidePoles | None

    @classmethod
    def of(cls, given: Measurement) -> Clock:
        """Take off the delays that a test shows, and what a known window makes of its poles."""
        given = without_window(given)
        try:
            beside = beside_poles(given)
            delays = find_delays(given, beside)
            if delays and (whole := as_whole(given)) is not given:
                # Of records cut in motion, transients that were left in look like delays.
                delays = find_delays(whole, beside_poles(whole))
            if not delays:
                return cls(given, delays, beside)
            test = without_delays(given, delays.values)
            return cls(test, delays, beside_poles(test))
        except (np.linalg.LinAlgError, InputError):  # records that tell nothing; the search says so
            return cls(given, Delays.none(given), None)


def delays_beyond_chance(values: Array, covariance: Array, least: float) -> Delays | None:
    """The fewest delays that explain what was found, with this covariance; None where chance or nothing does.

    One of the base is tried first, then as few channels as leave the others to chance. Delays below `least` are none.
    """
    inverse = np.linalg.pinv(covariance, hermitian=True)
    count = int(values.size)
    if not count or values @ inverse @ values < beyond_chance(count):
        return None
    ones = inverse.sum(axis=0)
    mean, error = float(ones @ values / ones.sum()), float(1 / np.sqrt(ones.sum()))
    apart = values - mean
    if count > 1 and apart @ inverse @ apart < beyond_chance(count - 1):
        of_base = Delays(np.full(count, mean), np.full(count, error), True)
        return of_base if abs(mean) > max(least, most_deviations() * error) else None
    late = np.zeros(count, bool)
    rest, left = inverse, np.inf
    while left > beyond_chance(count - int(np.count_nonzero(late))):  # nothing is left where all are late
        trials = [late | (np.arange(count) == channel) for channel in np.flatnonzero(~late)]
        inverses = [np.linalg.pinv(covariance[np.ix_(~one, ~one)], hermitian=True) for one in trials]
        squares = [values[~one] @ inner @ values[~one] for one, inner in zip(trials, inverses, strict=True)]
        best = int(np.argmin(squares))
        late, rest, left = trials[best], inverses[best], float(squares[best])
    carried = covariance[np.ix_(late, ~late)] @ rest
    found, std = np.zeros(count), np.zeros(count)
    found[late] = values[late] - carried @ values[~late]
    own = np.diag(covariance[np.ix_(late, late)] - carried @ covariance[np.ix_(~late, late)])
    std[late] = np.sqrt(np.maximum(own, 0.0))
    found[np.abs(found) < np.maximum(least, most_deviations(count) * std)] = 0.0
    std[found == 0] = 0.0
    return Delays(found, std) if np.any(found) else None


@one_thread()
def find_delays(test: Measurement, beside: BesidePoles | None) -> Delays:
    """Delays of a test, from poles beside terms without any; none where these do not tell them.

    Exact, and with deviations of their own, for spectra; of whole records, whose base has noise too, those that
    matter to a fit, which finds what is left: see `sysid.modal_analysis.fit`.
    """
    none = Delays.none(test)
    if beside is None or beside.at.misfit < EXACT:  # as no late channel is
        return none
    lines, clocks = telling_lines(test), _clocks(test)
    far = _on_grid(lines, clocks, beside)
    # What late channels leave at peaks passes for spikes as long as they are late.
    kept = [np.isin(lines.freq, at.test.freq) for at in [one for _, one in far] or [beside]]
    still = _joined(lines.at(np.all(kept, axis=0)))
    first = _with_one_above(_Late(still, clocks, np.zeros(none.values.size), beside.at.poles))
    complex_ = _Late(still, clocks, first.delays, first.poles, complex_residues=True)
    if not far and first.promise() < beyond_chance(none.values.size) and not complex_.explains_more_than(first):
        return none
    end, complex_ = _settled(first), _settled(complex_, held=True)
    # Rough poles may lack weak modes, which delays of most channels then stand for.
    for delays, poles in [*((delays, at.at.poles) for delays, at in far), (complex_.delays, complex_.poles)]:
        other = _settled(_with_one_above(_Late(still, clocks, delays, poles)))
        end = other if other.explains_more_than(end) else end
    # Few modes of a few sensors cost little more than delays: what these leave must be chance.
    open_ = complex_.shows_beyond(end) or not end.explains_more_than(complex_)
    if open_ and not (end := _settled(complex_)).explains_more_than(complex_):
        return none
    # Or they lack close ones: then further poles explain more.
    if (found := _found(end, test)) and (full := _with_further_poles(first)).explains_more_than(end):
        found = _found(end, test) if (end := _settled(full)).explains_more_than(full) else None
    return found or none


def _clocks(test: Measurement) -> NDArray[np.intp]:
    """Which delay each channel has, (n_sensors + d,): that of the force is one in all directions."""
    force = np.full((test.force is not None) * test.n_base, test.n_sensors)
    return np.concatenate([np.arange(test.n_sensors), force])


def _joined(test: Measurement) -> Measurement:
    """Sensors and force as channels of a test whose base carries nothing along, as terms without poles are free."""
    if test.force is None:
        return replace(test, rigid_body=np.zeros_like(test.rigid_body), sensors=None, gain_std=None)
    std, force_std = test.response_std, test.force_std
    if std is not None:
        if force_std is None:
            force_std = np.full(test.force.shape, np.sqrt(np.mean(np.abs(test.force) ** 2)))
        std = np.concatenate([std, force_std], axis=1)
    outputs = test.outputs
    return replace(
        test, response=outputs, rigid_body=np.zeros((outputs.shape[1], test.n_base)), sensors=None,
        response_std=std, force=None, force_std=None, gain_std=None,
    )  # fmt: skip


class _Late(BesideTerms):
    """Channels without their delays, fitted on poles, residues and terms without; what is left tells of the delays.

    The terms are 1, and w² and i w³ of modes above the lines and of their damping. With `rising` a term ``i w`` too,
    which no structure has.

    Parameters
    ----------
    still : Measurement
        As `_joined` gives it, with its delays.
    clocks : (channels,)
        Which delay each channel has.
    delays : (k,), s
    poles : (2m,)
        log w_k, then log zeta_k.
    """

    def __init__(
        self, still: Measurement, clocks: NDArray[np.intp], delays: Array, poles: Array,
        complex_residues: bool = False, *, rising: bool = False,
    ) -> None:  # fmt: skip
        self.still, self.clocks, self.delays, self.complex_residues = still, clocks, delays, complex_residues
        self.test = test = without_delays(still, delays[clocks])
        records, x = Records(test), 1j * test.freq / test.freq[-1]
        direct = records.basis(np.stack([x**0, x**2, x**3, x])[: 3 + rising], records.driven)
        super().__init__(records, poles, np.hstack([direct, _of_runs(test, records)]), velocity=complex_residues)
        self.unknowns = self.count * self.left.shape[1]

    def moved(self, poles: Array, delays: Array) -> _Late:
        """The fit after a step, in which no pole becomes one that answers like a term without poles.

        No delay moves by more than a quarter of a period of the last line: what a longer one does is not linear in it.
        """
        m, most = self.omega.size, 0.25 / self.test.freq[-1]
        poles = self.poles + np.clip(poles, -0.3, 0.3)
        poles[m:] = np.minimum(poles[m:], np.log(MOST_DAMPED))
        return _Late(self.still, self.clocks, self.delays + np.clip(delays, -most, most), poles, self.complex_residues)

    def with_pole(self, omega: float, ratio: float) -> _Late:
        """The fit beside one more pole, rad/s."""
        poles = np.insert(self.poles, [self.omega.size, self.poles.size], np.log([omega, ratio]))
        return _Late(self.still, self.clocks, self.delays, poles, self.complex_residues)

    @cached_property
    def of_clock(self) -> Array:
        """One where a channel of the records has a delay, (channels, k)."""
        return np.eye(self.delays.size)[np.tile(self.clocks, self.level.size // self.clocks.size)]

    @property
    def misfits(self) -> Array:
        """Relative residual of the channels of each clock, (k,)."""
        size = np.sum(self.records.data**2, axis=0) @ self.of_clock
        return np.sqrt(self.level**2 @ self.of_clock / np.maximum(size, np.finfo(float).tiny))

    @cached_property
    def shared_errors(self) -> float:
        """Factor by which errors that neighbouring lines share weigh more."""
        squares = float(np.sum(self.left**2))
        return self.records.noise(self.left, self.unknowns) / self.records.variance(squares, self.unknowns)

    def explains_more_than(self, other: _Late) -> bool:
        """True where the likelihood is larger, each channel with its own level of noise, than Schwarz's price says."""
        gained, more, numbers = self._gained_over(other)
        return gained > more * np.log(numbers) / 2

    def shows_beyond(self, other: _Late) -> bool:
        """True where it has more unknowns and the likelihood is larger beyond what chance makes of these.

        Of averages, whose base has noise at the peaks, and what their window blurs, the channels share their errors.
        """
        gained, more, _ = self._gained_over(other)
        shared = self.level.size if self.still.averaged else 1
        return more > 0 and 2 * gained > shared * beyond_chance(more, self.delays.size)

    def _gained_over(self, other: _Late) -> tuple[float, int, float]:
        """Likelihood over another's, its logarithm, unknowns more than it has, and independent numbers of both."""
        numbers = self.left.size / min(self.shared_errors, other.shared_errors)
        more = self.unknowns - other.unknowns + np.count_nonzero(self.delays) - np.count_nonzero(other.delays)
        return numbers * float(np.mean(np.log(other.level / self.level))), int(more), numbers

    @cached_property
    def equations(self) -> tuple[Array, Array]:
        """Normal matrix of poles and delays, each channel in units of its level, and descent."""
        records, level, late = self.records, self.level, self.late
        slopes = records.pole_slopes(self.omega, self.ratios, velocity=self.complex_residues)
        beside = self.basis.beside(slopes)
        of_left, of_late = (beside.products(beside.shared.T @ rows, rows) for rows in (self.left, late))
        normal, descent = beside.pole_equations(of_left / level, self.residues / level)
        each = np.concatenate([self.residues, self.residues]).reshape(of_late.shape)
        across = (of_late / level * (each / level)).reshape(self.poles.size, -1, level.size).sum(axis=1)
        across, size = -across @ self.of_clock, np.sum((late / level) ** 2, axis=0) @ self.of_clock
        both = np.block([[normal, across], [across.T, np.diag(size)]])
        return both, np.concatenate([descent, -np.sum(late / level * (self.left / level), axis=0) @ self.of_clock])

    @cached_property
    def late(self) -> Array:
        """What a second of delay makes of each channel beside the basis, (rows, channels)."""
        turned = replace(self.test, response=2j * np.pi * self.test.freq * self.test.response)
        late = Records(turned).data
        for _ in range(2):  # once leaves round-off of what is nearly along the basis
            late = late - self.basis.times(self.basis.answers(late))
        return late

    @property
    def uneven(self) -> Array:
        """Times the mean that what is left is where a delay shows, one at least, (k,), as of noise stated wrongly."""
        share = (self.late / self.level) ** 2
        seen = np.sum(share * (self.left / self.level) ** 2, axis=0) @ self.of_clock * len(self.left)
        every = np.sum(share, axis=0) @ self.of_clock
        return np.sqrt(np.maximum(seen / np.maximum(every, np.finfo(float).tiny), 1.0))

    def step(self, damping: float = 0.0, *, held: bool = False) -> tuple[Array, Array, Array]:
        """A damped step of poles and delays, and the covariance of the latter; zero for those that nothing tells.

        Of `held` delays as well.
        """
        normal, descent = self.equations
        if held:
            free = np.arange(descent.size) < self.poles.size
            normal, descent = normal * np.outer(free, free), descent * free
        unit = units_of(normal)
        values, vectors = np.linalg.eigh(normal * np.outer(unit, unit) + damping * np.eye(unit.size))
        root = unit[:, None] * vectors / np.sqrt(np.maximum(values, ROUND_OFF * values[-1]))
        step, m = root @ (descent @ root), self.poles.size
        freedom = max(len(self.left) - self.unknowns // self.left.shape[1], 1)
        errors = self.uneven[:, None] * root[m:]
        return step[:m], step[m:], self.shared_errors / freedom * errors @ errors.T

    def promise(self) -> float:
        """Sum of squares of the delays that one step finds, in units of their errors."""
        _, delays, covariance = self.step()
        return float(delays @ np.linalg.pinv(covariance, hermitian=True) @ delays)


def _with_one_above(fit: _Late, above: float = 1.3) -> _Late:
    """The fit with one more pole, so far above the lines, where that explains more.

    Complex residues in the lines stand for a mode close above, and what real ones leave of it looks like delays.
    """
    more = fit.with_pole(2 * np.pi * above * fit.test.freq[-1], GUESS)
    return more if more.explains_more_than(fit) else fit


def _with_further_poles(fit: _Late, most: int = 8) -> _Late:
    """The fit with further poles, so many at most, each where most is left, as long as they explain more."""
    loss, (first, last) = float(np.median(fit.ratios)), 2 * np.pi * fit.test.freq[[0, -1]] * [1.0, 1.3]
    at = np.geomspace(first, last, int(np.log(last / first) / loss) + 2)
    functions = fit.records.functions(at, np.full(at.size, loss))
    for _ in range(most):
        gain = fit.basis.explained(functions, fit.left / fit.level).reshape(at.size, -1).sum(axis=1)
        before, fit = fit, _settled(fit.with_pole(at[np.argmax(gain)], loss), held=True)
        if not fit.explains_more_than(before):
            return before
    return fit


def _of_runs(test: Measurement, records: Records) -> Array:
    """Columns of what each run of whole records holds beside its response, (rows, k).

    The traces of sampling, and what turned records hold at an end that is not theirs: see `RecordModel`.
    """
    if test.whole is None:
        return np.zeros((len(records.data), 0))
    weight = factors_of_runs(test.response_std, test.response.shape)[1][records.run, records.line]
    traces = test.whole.traces(test.freq[records.line], test.freq[-1])
    return stacked(np.concatenate([np.where(records.run == run, weight * traces, 0.0) for run in range(test.n_runs)]))


def _settled(best: _Late, steps: int = 15, near: float = 0.05, *, held: bool = False) -> _Late:
    """The fit after Levenberg-Marquardt steps, until one moves no delay by more than a small part of its deviation.

    Where delays are `held`, until one gains next to nothing.
    """
    damping = 1e-3
    for _ in range(steps):
        poles, delays, covariance = best.step(damping, held=held)
        trial = best.moved(poles, delays)
        gained = float(np.sum(np.log(best.level / trial.level)))
        if gained < 0:
            damping *= 10
            continue
        best, damping = trial, max(damping / 10, ROUND_OFF)
        small = gained < near / len(best.left) if held else np.abs(delays) <= near * np.sqrt(np.diag(covariance))
        if np.all(small):
            break
    return best


def _found(end: _Late, test: Measurement) -> Delays | None:
    """Delays beyond chance at the end of a fit, of the channels that tell them and that it explains.

    Of whole records and averages, whose base has noise that all channels share, those far beyond it.
    """
    shown = np.diag(end.equations[0])[end.poles.size :] > 0
    told = np.flatnonzero(shown & (end.misfits < UNEXPLAINED))
    covariance = end.step()[2][np.ix_(told, told)] * (_FAR**2 if test.is_whole or test.averaged else 1.0)
    found = delays_beyond_chance(end.delays[told], covariance, least_delay(test))
    if found is None:
        return None
    every = found.at(told, end.delays.size)
    return every if _agrees(end, every) else None


def _agrees(end: _Late, found: Delays, share: float = 0.2) -> bool:
    """True where delays are the same beside a term that grows as i w: what a model misses of another kind is none.

    Up to this share, or what noise leaves open beside that term, which must not hide them.
    """
    beside = _Late(end.still, end.clocks, end.delays, end.poles, end.complex_residues, rising=True)
    _, step, covariance = beside.step()
    late = found.values != 0
    size, std = np.abs(found.values[late]), np.sqrt(np.diag(covariance)[late])
    off, possible = np.abs(end.delays + step - found.values)[late], most_deviations(int(late.sum())) * std
    return bool(np.all(off < np.maximum(share * size, possible)) and np.all(possible < size))


def least_delay(test: Measurement) -> float:
    """Delay, s, below which what it does shows in no result."""
    return float(_LEAST_TURN / (2 * np.pi * test.freq[-1]))


def _on_grid(
    test: Measurement, clocks: NDArray[np.intp], beside: BesidePoles, fine: int = 8, less: float = 0.8
) -> list[tuple[Array, BesidePoles]]:
    """Delays of many periods, s, (k,), each where real residues leave least on a grid, and poles without them.

    Once of each channel by itself, and once of all together, as poles that follow the phase of all mislead single
    ones; none where no delay leaves clearly less, which is `less` of the squares. Poles are those of the accelerations,
    which a late force does not move, looked for anew once delays are taken off.
    """
    count, zero = clocks.max() + 1, fine * _PERIODS
    grid = np.arange(-zero, zero + 1)[:, None] / (fine * test.freq[-1]) + np.zeros(count)
    found, first = list[tuple[Array, BesidePoles]](), _left_at(test, clocks, grid, beside)
    for together in (False, True):
        delays, at, left = np.zeros(count), beside, first
        for _ in range(4):
            if together:
                left = np.tile(left.mean(axis=1, keepdims=True), count)
            best = np.argmin(left, axis=0)[None]
            lower = np.take_along_axis(left, best, axis=0)[0] < left[zero] + np.log(less)
            step = np.where(lower, np.take_along_axis(grid, best, axis=0)[0], 0.0)
            anew = beside_poles_at(without_delays(test, delays + step)) if np.any(step) else None
            if anew is None:
                break
            delays, at = delays + step, anew
            left = _left_at(test, clocks, delays + grid, at)
        if np.any(delays):
            found.append((delays, at))
    return found


def _left_at(test: Measurement, clocks: NDArray[np.intp], delays: Array, beside: BesidePoles, most: int = 400) -> Array:
    """Logarithm of the squares that real residues leave of each clock's channels at delays (grid, k), (grid, k).

    Of so many lines of those that poles were fitted to. A sensor moves with the base as its row of rigid_body says:
    with that open, half a period and the other sign of all residues would do as well.
    """
    lines = np.flatnonzero(np.isin(test.freq, beside.test.freq))
    test = test.at(np.isin(np.arange(test.freq.size), lines[:: -(-lines.size // most)]))
    still, carried = _joined(test), np.zeros((clocks.size, test.n_base))
    carried[: test.n_sensors] = test.rigid_body
    records, relative = Records(still), Records(replace(still, rigid_body=carried))
    along = relative.data - records.data  # less what moves with the base
    functions = records.functions(beside.at.omega, beside.at.ratios)
    square = (still.freq / still.freq[-1]) ** 2
    found = np.zeros(delays.shape)
    real, imaginary = records.data.reshape(2, -1, records.data.shape[1])
    of_clock = np.tile(clocks, records.data.shape[1] // clocks.size)
    weighs = of_clock >= test.n_sensors  # the force, whose mass is open
    for some, direct in ((~weighs, square[None]), (weighs, np.stack([np.ones_like(square), square]))):
        terms = records.basis(direct + 0j, records.driven)
        basis = orthonormal(functions._replace(shared=np.hstack([terms, functions.shared])))[0]
        for row, at in zip(found, delays, strict=True):
            each, which = np.unique(at, return_inverse=True)  # most often one of all clocks
            turn = np.exp(2j * np.pi * records.freq[records.line, None] * each)[:, which[of_clock[some]]]
            turned: ComplexArray = (real[:, some] + 1j * imaginary[:, some]) * turn
            data = np.concatenate([turned.real, turned.imag]) + along[:, some]
            squares = np.sum(data**2, axis=0) - np.sum(basis.answers(data) ** 2, axis=0)
            np.add.at(row, of_clock[some], squares)
    return np.log(np.maximum(found, np.finfo(float).tiny))
