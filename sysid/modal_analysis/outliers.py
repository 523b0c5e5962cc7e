r"""Outliers in the records of a test, and Huber's loss, for which they count little.

With the deviation :math:`\sigma` of a number of the records, :math:`u = (y - f(x)) / \sigma` is complex and
:math:`E|u|^2 = 1`. Least squares minimise the sum of :math:`|u|^2`, Huber's loss that of

.. math:: \rho(u) = |u|^2 \;\; (|u| \le c), \qquad 2 c |u| - c^2 \;\; (|u| > c),

so that a number counts with the weight :math:`\min(1, c/|u|)`, or pulls with :math:`\psi(u) = u \min(1, c/|u|)`.

Poles, residues and shapes are eliminated with weights that are a product of channels and lines, which weights of single
numbers are not. So the records are changed in their place: least squares of the *pseudo-values*

.. math:: y^* = f(x_0) + \sigma\, \psi(u_0) / b, \qquad b = \text{mean of the slope of } \psi,

are repeated from their last answer :math:`x_0` until it stays. There :math:`J' W (y^* - f) = 0` is
:math:`J' W \sigma \psi = 0`, as where the loss is least; a step is Newton's with the mean slope in place of each
number's own; and the covariance of least squares, with the scatter of :math:`y^* - f` for noise, is Huber's:
:math:`(J'J)^{-1} \sigma^2 \overline{|\psi|^2} / b^2`. Beyond c the slope is 0 along u and :math:`c/|u|` across it: on
average :math:`c / 2|u|`. Where deviations are stated, noise that scatters less is not taken for smaller.

What an outlier may do is bounded by its pull, not by its place: one at a line that alone decides something, such as the
highest of a peak narrower than two lines, moves that by up to three deviations.

Of normal noise :math:`|u|^2` is exponential, so :math:`\overline{|\psi|^2} = 1 - e^{-c^2}` and
:math:`b = 1 - e^{-c^2} + \tfrac12 \sqrt\pi\, c\, \mathrm{erfc}(c)`; `TUNING` makes :math:`b^2 / \overline{|\psi|^2}`
0.95, as 1.345 does for real numbers (Holland and Welsch).

References
----------
P. J. Huber, Robust Statistics (1981), sections 7.6 (covariance, with its correction for few numbers) and 7.8 (modified
residuals); P. J. Bickel, Scand. J. Statist. 3 (1976) 145-168 (pseudo-values); P. W. Holland, R. E. Welsch, Commun.
Statist. A6 (1977) 813-827.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.misfit import SUSPECT
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.response import gains, predicted, records_of
from sysid.modal_analysis.vector_fitting import Monitor, poles_from, poles_of_any_damping
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import CANDIDATES, ROUND_OFF, beyond_chance, largest_modulus

HUBER = "Huber's loss"  # the phase of its rounds
TUNING = 1.06147  # c, in units of sqrt(E|e|²): 95 % efficient where the noise is normal
_BESIDE = 5.0  # times the numbers beside it: as much as a wrong pole leaves of a peak one line wide
_CERTAIN = 10.0  # the same, where noise that differs from line to line must not be taken for outliers
_ONE_LINE = 4.0  # times its next line, that a pole's highest one may reach without being doubted
_ONE_CHANNEL = 0.9  # of the power at that line, in one channel: no motion of a structure
_LEAST_LINES = 5  # with fewer, no number has neighbours enough
_UNDAMPED, _TINY = 1e-9, np.finfo(float).tiny
_ROUNDS, _BOUNDED, _FREED = 8, 3, 8
_BEHIND = 2.0  # times the numbers beside it, from which a number need not pull: it may be what moved those
_PASSES, _STEPS = 4, 12  # after absorbed outliers; of weights
_DECIDES = 0.18  # leverage of a line, of at most 1
_NEAR_TOP = 0.3  # of a mode's height, from which it is missed at a line

Flags = NDArray[np.bool_]


class Whitened(NamedTuple):
    """Misfit of a record in units of its noise, and these units, (runs, channels, n_freq).

    `lines` are a run's own, (runs, n_freq).
    """

    u: ComplexArray
    std: Array
    lines: Flags

    @property
    def numbers(self) -> ComplexArray:
        """Those of `u` at each run's own lines, one after the other."""
        return numbers_at_lines(self.u, self.lines)


class Outlier(NamedTuple):
    """A number of the records: its test and run, both from 1, its channel, its line in Hz, its deviations from the fit.

    Test 1 is the problem's own, further ones follow. The channel is a sensor's name, or "force x".
    """

    test: int
    run: int
    channel: str
    freq: float
    size: float


def whitened(test: Measurement, fitted: Sequence[ComplexArray], unknowns: int) -> list[Whitened]:
    """Misfits of accelerations and, where measured, force, by stated deviations or a robust one of each record.

    The latter follows from the median of |u|², ln 2 for normal noise, and so does a factor of stated deviations that
    are too small. It allows for the number of unknowns.

    Parameters
    ----------
    fitted : sequence of (runs, channels, n_freq)
        What a model makes of relative accelerations and of the force.
    """
    found = [(test.response, test.relative - fitted[0], test.response_std)]
    if test.force is not None:
        found.append((test.force, test.force - fitted[1], test.force_std))
    numbers = lambda record: numbers_at_lines(record, test.own_lines)  # noqa: E731
    left = max(1 - unknowns / (2 * test.numbers), 0.5)
    squares, stds = [], []
    for record, misfit, stated in found:
        least = ROUND_OFF * float(np.sqrt(np.mean(np.abs(numbers(record)) ** 2)))
        robust = np.sqrt(np.median(np.abs(numbers(misfit)) ** 2) / np.log(2) / left) if stated is None else stated
        stds.append(np.broadcast_to(np.maximum(robust, least), record.shape))
        if stated is not None:
            squares.append(np.abs(numbers(misfit / stds[-1])) ** 2)
    # Without a jump, at which rounds of a fit would turn to and fro.
    more = np.sqrt(max(1.0, float(np.median(np.concatenate(squares))) / np.log(2) / left / SUSPECT)) if squares else 1.0
    stds = [std if stated is None else more * std for std, (*_, stated) in zip(stds, found, strict=True)]
    return [Whitened(misfit / std, std, test.own_lines) for std, (_, misfit, _) in zip(stds, found, strict=True)]


def numbers_at_lines(record: ComplexArray, lines: Flags) -> ComplexArray:
    """Numbers of a record (runs, channels, n_freq) at each run's own lines (runs, n_freq), one after the other."""
    return record.transpose(0, 2, 1)[lines].ravel()


def weight(u: ComplexArray) -> Array:
    """By how much numbers count, 1 or c / |u|."""
    size: Array = 1 / np.maximum(1.0, np.abs(u) / TUNING)
    return size


def loss(u: ComplexArray) -> float:
    """Huber's, summed over whitened numbers."""
    size = np.abs(u)
    return float(np.sum(np.where(size > TUNING, 2 * TUNING * size - TUNING**2, size**2)))


def deviance(misfit: ComplexArray) -> float:
    """-2 log likelihood of complex misfits by the density that Huber's loss is of, its scale s the likeliest.

    It is ``exp(-rho(e / s)) / (pi k s²)`` with ``k = 1 + exp(-c²) / 2c²``. Left out is ``2 N (1 + log pi)``, without
    which that of N normal misfits is ``2 N log(mean |e|²)``.
    """
    size = np.abs(misfit)
    scale = float(np.sqrt(np.mean(size**2)))
    for _ in range(60):  # each halves the error of the logarithm at least
        scale = float(np.sqrt(np.mean(np.minimum(size, TUNING * scale) * size)))
    of_scale = 2 * np.log(scale) + np.log1p(np.exp(-(TUNING**2)) / (2 * TUNING**2))
    return float(2 * (loss(misfit / scale) + size.size * (of_scale - 1)))


def pseudo_values(fits: Sequence[tuple[Measurement, list[ComplexArray]]], unknowns: int) -> list[Measurement]:
    """Tests with pseudo-values about what a model makes of each in the place of their records, and these deviations.

    Least squares of them, repeated, end where Huber's loss is least, and their covariance is its own. All tests share
    one mean slope, so that they count by their noise alone.
    """
    every = [(test, fitted, whitened(test, fitted, unknowns)) for test, fitted in fits]
    u = np.concatenate([part.numbers for *_, parts in every for part in parts])
    w = weight(u)
    slopes = np.where(w < 1, w / 2, 1.0)
    slope, share = float(slopes.mean()), unknowns / (2 * u.size)
    spread = np.sqrt(np.mean(np.abs(w * u) ** 2) / max(1 - share, 0.5)) / slope
    spread *= 1 + share * np.var(slopes) / slope**2
    changed = []
    for test, fitted, parts in every:
        values = [f + part.std * weight(part.u) * part.u / slope for f, part in zip(fitted, parts, strict=True)]
        # As in squares, what is stated is raised where the records show more, and is never lowered.
        stated = test.response_std, test.force_std
        stds = [
            part.std * (spread if std is None else max(spread, 1.0)) for part, std in zip(parts, stated, strict=False)
        ]
        other = replace(test, response=test.response - test.relative + values[0], response_std=stds[0])
        changed.append(other if test.force is None else replace(other, force=values[1], force_std=stds[1]))
    return changed


def stand_alone(
    part: Whitened, freq: Array, omega: Array, ratios: Array, *, times: float = _BESIDE, known: Flags | None = None
) -> Flags:
    """Which whitened numbers (runs, channels, n_freq) are far out, so many `times` those at the lines beside them.

    Those that are `known` outliers are not compared with.

    A misfit that a model leaves is smooth, and no outlier. Lines beside a pole that is narrower than their distance are
    not judged: its misfit stands alone too.
    """
    flags = _beyond_neighbours(part, times=times, known=known)
    for run, lines in enumerate(part.lines):
        flags[run][:, lines] &= ~_in_doubt(freq[lines], omega, ratios)
    return flags


def _beyond_neighbours(part: Whitened, *, times: float, known: Flags | None = None) -> Flags:
    """Which whitened numbers are far out, and so many `times` those at the lines of their run beside them."""
    size = np.abs(part.u)
    others = size if known is None else np.where(known, 0.0, size)
    flags: Flags = np.zeros(size.shape, dtype=bool)
    for run, lines in enumerate(part.lines):
        n_freq = np.count_nonzero(lines)
        if n_freq < _LEAST_LINES:
            continue
        here = np.arange(n_freq)
        first = np.clip(here - 2, 0, n_freq - 5)
        near_by = others[run][:, lines][:, first[:, None] + np.arange(5)]
        near_by[:, here, here - first] = np.inf
        beside = np.sort(near_by, axis=-1)[..., 2]  # of four the last but one: another outlier may be among them
        its = size[run][:, lines]
        flags[run][:, lines] = (its > largest_modulus(CANDIDATES)) & (its > times * beside)
    return flags


def _in_doubt(freq: Array, omega: Array, ratios: Array) -> Flags:
    """Which lines (n_freq,) are beside a pole so narrow that its misfit would stand alone."""
    if freq.size < _LEAST_LINES:
        return np.ones(freq.size, dtype=bool)
    lines = 2 * np.pi * freq
    distance = np.interp(omega, lines, np.gradient(lines))
    narrow = ratios * omega < distance / 2  # poles that show at one line too
    doubted: Flags = np.any(np.abs(lines - omega[narrow, None]) < 1.5 * distance[narrow, None], axis=0)
    return doubted


def one_line(freq: Array, omega: Array, ratios: Array) -> Flags:
    """Which poles (m,) reach far higher at one line than at any other."""
    if freq.size < _LEAST_LINES:
        return np.zeros(omega.size, dtype=bool)
    size = np.sort(_heights(freq, omega, ratios), axis=1)
    flags: Flags = size[:, -1] > _ONE_LINE * size[:, -2]
    return flags


def screened(test: Measurement, *, monitor: Monitor | None = None) -> Measurement:
    """The test with what the poles of its records make of it in the place of numbers that stand alone.

    No model is asked, so that what a model misses stays as it is. Poles that answer for one line only are none.
    Numbers at the lines that decide a pole or a residue are compared with what all other lines make of them.
    The monitor is called as by `find_poles`.
    """
    for _ in range(_PASSES):
        clean, fit = _screened(test, monitor)
        more = test if fit is None else _without_absorbed(test, clean, fit, monitor)
        if more is test:
            break
        test = more
    return clean


def _screened(test: Measurement, monitor: Monitor | None) -> tuple[Measurement, PolesAndResidues | None]:
    """The test without numbers that stand alone beside the poles of the rest, and these poles."""
    clean, flags = test, [np.zeros(record.shape, dtype=bool) for record in (test.response, test.base)]
    for _ in range(_ROUNDS):
        fit = _poles(clean, monitor)
        if fit is None:
            break
        fitted = _bounded_fit(test, fit)
        parts, before = whitened(test, fitted, 2 * fit.omega.size), flags
        flags = [
            stand_alone(part, test.freq, fit.omega, fit.ratios, known=known)
            for part, known in zip(parts, before, strict=False)
        ]
        clean = _replaced(test, fitted, flags)
        if clean is test or all(np.array_equal(now, then) for now, then in zip(flags, before, strict=False)):
            break
    return clean, fit


def _without_absorbed(
    test: Measurement, clean: Measurement, fit: PolesAndResidues, monitor: Monitor | None
) -> Measurement:
    """The test with others in the place of outliers that poles or residues of their own explain; itself without any.

    Each line that decides a residue is left out, and predicted by poles of what is left of the `clean` records. What
    they miss there is alike in all channels and runs, a multiple of how each mode shows in them, but for outliers.
    """
    parts = whitened(clean, _predicted(fit, test.freq, test.base), 2 * fit.omega.size)
    stds = np.concatenate([part.std for part in parts], axis=1)
    recorded = np.concatenate([record for record, _ in records_of(clean)], axis=1)
    off = np.zeros_like(recorded)
    here = np.arange(test.freq.size)
    decide = Records(clean).leverage(fit.omega, fit.ratios) > _DECIDES
    for line in np.flatnonzero(decide | _in_doubt(test.freq, fit.omega, fit.ratios)).tolist():
        rest = clean.at(here != line)
        records = Records(rest)
        omega, ratios = poles_from(records, fit.omega, fit.ratios, monitor=monitor)
        if omega.size == 0:
            continue
        other = PolesAndResidues.at(rest, records, omega, ratios)
        base, std = test.base[:, :, [line]], stds[:, :, line]
        fitted = np.concatenate(_predicted(other, test.freq[[line]], base), axis=1)
        misfit = (recorded[:, :, line] - fitted[:, :, 0]) / std
        heights = _heights(test.freq, omega, ratios)
        near = np.flatnonzero(heights[:, line] > _NEAR_TOP * heights.max(axis=1))
        contributions = other.contributions(base[:, :, 0], near) / std
        flags, left = _unlike_others(misfit.ravel(), contributions.reshape(near.size, std.size).T)
        off[:, :, line] = np.where(flags, left, 0.0).reshape(std.shape)
    # An outlier spoils what is made of the lines beside it: one in each record at a time.
    size = np.abs(off)
    flags = (size > 0) & (size == size.max(axis=2, keepdims=True))
    values, n = recorded - off * stds, test.n_sensors
    return _replaced(test, [values[:, :n], values[:, n:]], [flags[:, :n], flags[:, n:]])


def _replaced(test: Measurement, values: Sequence[ComplexArray], flags: Sequence[Flags]) -> Measurement:
    """The test with values in the place of flagged numbers of accelerations and force; itself where there are none."""
    if not any(np.any(of_record) for of_record in flags):
        return test
    response = np.where(flags[0], values[0] + test.response - test.relative, test.response)
    changed = replace(test, response=response)
    return changed if test.force is None else replace(changed, force=np.where(flags[1], values[1], test.force))


def _unlike_others(misfit: ComplexArray, contributions: ComplexArray) -> tuple[Flags, ComplexArray]:
    """Which of the whitened misfits (N,) at a line are no multiple of `contributions` (N, k); what that leaves (N,).

    Each is compared with what all others suggest by Huber's loss, the farthest first.
    """
    flags: Flags = np.zeros(misfit.size, dtype=bool)
    left = misfit
    while np.count_nonzero(~flags) > contributions.shape[1] + 3:  # too few to compare with
        farthest, size, left_by = -1, _CERTAIN, left
        for j in np.flatnonzero(~flags):
            others = ~flags
            others[j] = False
            now = misfit - contributions @ _robust(contributions[others], misfit[others])
            scale = max(1.0, float(np.median(np.abs(now[others]))) / np.sqrt(np.log(2)))
            spread = np.linalg.lstsq(contributions[others].T, contributions[j], rcond=None)[0]
            its = float(np.abs(now[j])) / (scale * float(np.hypot(1.0, np.linalg.norm(spread))))
            if its > size:
                farthest, size, left_by = int(j), its, now
        if farthest < 0:
            break
        flags[farthest], left = True, left_by
    return flags, left


def _robust(functions: ComplexArray, misfit: ComplexArray) -> ComplexArray:
    """Multiples (k,) of the columns that are nearest to a misfit by Huber's loss, with 1 in the place of `TUNING`."""
    root = np.ones(misfit.size)
    for _ in range(_STEPS):
        many: ComplexArray = np.linalg.lstsq(functions * root[:, None], misfit * root, rcond=None)[0]
        root = 1 / np.sqrt(np.maximum(np.abs(misfit - functions @ many), 1.0))
    return many


def _bounded_fit(test: Measurement, fit: PolesAndResidues) -> list[ComplexArray]:
    """Prediction of a test by poles with residues that outliers do not pull, from a first `fit`.

    First their pull is bounded, by pseudo-values. Then numbers that stay far beyond those beside them do not pull at
    all: at the lines that decide a residue even a bounded pull moves all that is near.
    """
    for step in range(_BOUNDED + _FREED):
        fitted = _predicted(fit, test.freq, test.base)
        if step < _BOUNDED:
            other = pseudo_values([(test, fitted)], 2 * fit.omega.size)[0]
        else:
            parts = whitened(test, fitted, 2 * fit.omega.size)
            other = _replaced(test, fitted, [_beyond_neighbours(part, times=_BEHIND) for part in parts])
            if other is test:
                return fitted
        fit = PolesAndResidues.at(other, Records(other), fit.omega, fit.ratios)
    return _predicted(fit, test.freq, test.base)


def _predicted(fit: PolesAndResidues, freq: Array, base: ComplexArray) -> list[ComplexArray]:
    """Prediction of relative accelerations and, where it was measured, of the force by poles and residues."""
    return [part for part in fit.records(freq, base) if part is not None]


def _poles(test: Measurement, monitor: Monitor | None) -> PolesAndResidues | None:
    """Poles of a test but those that answer for one line only, and free residues at them; None where there are none."""
    records = Records(test)
    omega, ratios = poles_of_any_damping(records, monitor=monitor)
    order = np.argsort(omega)
    omega, ratios = omega[order], ratios[order]
    doubted = one_line(test.freq, omega, ratios).nonzero()[0].tolist() if omega.size else []
    lost = [k for k in doubted if _is_one_number(test, records, omega, ratios, k)]
    omega, ratios = np.delete(omega, lost), np.delete(ratios, lost)
    return PolesAndResidues.at(test, records, omega, ratios) if omega.size else None


def _is_one_number(test: Measurement, records: Records, omega: Array, ratios: Array, k: int) -> bool:
    """True where pole k, which stands at one line, shows in one channel only, or explains nothing at other lines."""
    fit = PolesAndResidues.at(test, records, omega, ratios)
    highest = int(np.argmax(_heights(test.freq, omega[[k]], ratios[[k]])))
    residue = np.einsum("sd,rd->rs", fit.residues[k] + 1j * fit.quadrature[k], test.base[:, :, highest])
    std = 1.0 if test.response_std is None else np.maximum(test.response_std[:, :, highest], _TINY)
    power = np.abs(residue / std) ** 2
    if power.size > 1 and power.max() > _ONE_CHANNEL * power.sum():
        return True
    others = Records(test.at(np.arange(test.freq.size) != highest))
    every = others.fit(omega, ratios, velocity=True)
    left = others.size  # where it is the only pole
    if omega.size > 1:
        left = others.fit(np.delete(omega, k), np.delete(ratios, k), velocity=True).squared_error
    noise = float(np.median(every.left**2)) / scipy.special.chdtri(1, 0.5)  # that of a squared normal number
    return left - every.squared_error < noise * beyond_chance(every.residues[k].size + 2, CANDIDATES)


def _heights(freq: Array, omega: Array, ratios: Array) -> Array:
    """Heights of poles at each line, (m, n_freq)."""
    size: Array = np.abs(gains(freq, omega, np.maximum(ratios, _UNDAMPED)))
    return size


def outliers(
    test: Measurement, structure: Structure, unknowns: int, *, alone: bool = True, number: int = 1
) -> list[Outlier]:
    """Numbers of the records that are far from what a structure makes of them, the test's own `number` beside each.

    Only those that stand `alone`, or all.
    """
    names = (*test.sensor_names, *(f"force {axis}" for axis in test.base_axes or ()))
    omega, ratios = 2 * np.pi * structure.natural_frequencies, structure.damping_ratios
    first, found = 0, []
    for part in whitened(test, predicted(test, structure), unknowns):
        far = np.abs(part.u) > largest_modulus(CANDIDATES)
        if alone:
            far = stand_alone(part, test.freq, omega, ratios, times=_CERTAIN)
        for run, channel, line in np.argwhere(far).tolist():
            size = float(np.abs(part.u[run, channel, line]))
            found.append(Outlier(number, run + 1, names[first + channel], float(test.freq[line]), size))
        first += part.u.shape[1]
    return found
