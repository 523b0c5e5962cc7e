r"""Errors of single sensors' gains, as the constant term of the transmissibility shows them.

A sensor that reads ``1 + eps`` times its motion records ``(1 + eps) (G u + a)``. Its mode shapes take the factor, and
its masses with them; ``eps G u`` is left beside all modes. Modes above the lines leave a part ``w² E u`` that grows
with frequency, so that a constant is told apart. Modes below them answer by a constant too, and where one is fitted,
nothing is told but that (`modes_below`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.assessment.checks.context import BEYOND, Context, of_tests
from sysid.finding import MOST_OF_A_KIND, Finding, Severity
from sysid.measurement.channels import seen_at_sensors
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.residues import Records, ResidueFit
from sysid.modal_analysis.response import gains_and_slopes, modes_above
from sysid.structure.simulation import ModalModel
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import COVERAGE, EXACT, FALSE_ALARM, LIKELY, NEGLIGIBLE, ROUND_OFF, most_deviations

_UNSHOWN = 2.0  # %: the error that a gain may have where no record shows it
_LEAST = 2e-3  # of a gain; smaller errors are usual
MIMICKED = 1e-2  # of a constant; less of it is left where a mode far below the lines answers like one
_BESIDE = 0.1  # of the largest error: what it leaves of itself on other sensors, as poles follow it
_BLOCKS = (8, 16, 32, 64)  # of lines, within which they may share their error
NUMBERS_A_RESIDUE = 2  # times the free residues: fewer numbers than these tell nothing beside noise


@dataclass(frozen=True, eq=False)
class GainErrors:
    """Relative errors of the sensors' gains, and what chance makes of them.

    Attributes
    ----------
    error, std : (n_sensors,)
        Of the gain against the base's, as a fraction, and its standard deviation; NaN where the records cannot show it:
        the sensor's row of G is zero, or modes answer like a constant.
    possible : (n_sensors,)
        Error that the gain may well have, beside what was taken off within tolerances, though it may be chance; zero
        where nothing speaks for one.
    freedom : int
        Degrees of freedom of the standard deviations.
    tolerance : (n_sensors,)
        Standard deviation of the gain against the base's that is stated; zero where both are exact.
    """

    error: Array
    std: Array
    possible: Array
    freedom: int
    tolerance: Array

    @property
    def wrong(self) -> NDArray[np.intp]:
        """Sensors whose gain is wrong beyond chance and by more than is usual, the worst first.

        Beyond a tolerance at one in a hundred right tests: at the chance that stands for noise, an error of 4 % beside
        tolerances of 0.5 % of all channels would pass for these in four or five tests of a hundred.
        """
        known = np.isfinite(self.error)
        off = np.where(known, np.abs(self.error) / np.where(known, np.hypot(self.std, self.tolerance), 1.0), 0.0)
        chance = 2 * scipy.special.stdtr(self.freedom, -off) * np.count_nonzero(known)
        size = np.abs(np.nan_to_num(self.error))
        rare = np.where(self.tolerance > 0, 10 * FALSE_ALARM, FALSE_ALARM)
        found = np.flatnonzero((chance < rare) & (size > max(_LEAST, _BESIDE * size.max())))
        return found[np.argsort(-off[found])]

    def of_base(self, driven: NDArray[np.bool_] | None = None) -> float | None:
        """The one error that explains those of all sensors, or of those `driven` by a base direction, (n_sensors,).

        Where three or more show one, beyond chance and tolerances without any one of them too: then it is the base's.
        """
        known = np.isfinite(self.error) & (True if driven is None else driven)
        if np.count_nonzero(known) < 3 or not np.any(known[self.wrong]):
            return None
        error, std = self.error[known], np.hypot(self.std, self.tolerance)[known]
        likely, one = most_deviations(error.size), float(np.average(error, weights=std**-2))
        alike = np.all(np.abs(error - one) < likely * std)
        weight = std**-2.0
        size = np.append(weight.sum(), weight.sum() - weight)  # of all, and without each
        without = np.append(one, (np.sum(weight * error) - weight * error) / size[1:])
        clear = np.abs(without) > likely * np.hypot(size**-0.5, self.tolerance[known].min())
        return one if alike and np.all(clear) else None


def gain_errors(modal: ModalEstimate, structure: Structure) -> GainErrors:
    """Errors of sensors' gains by the constant terms of a test, at the poles of the structure that was fitted to it.

    Each is estimated twice, beside the modes alone and beside what `modes_above` the lines may add too. The first is
    the more exact, but right only where no mode lies above the lines: by how much the two differ counts among its
    errors. The one that is then known better is taken. A record's own misfit is its noise, line by line, and lines that
    share it are counted as such; noise that is stated larger counts as stated. What was taken off the records within
    stated tolerances is a part of the errors.
    """
    found = _of_left(modal, structure)
    if modal.calibration is None:
        return found
    taken, tolerance = tolerated_errors(modal)
    return replace(found, error=(1 + found.error) * (1 + taken) - 1, tolerance=tolerance)


def tolerated_errors(modal: ModalEstimate) -> tuple[Array, Array]:
    """Errors of sensors' gains against the base that were taken off, and their tolerances, (n_sensors,) each."""
    calibration, seen = modal.calibration, seen_at_sensors(modal.records)
    if calibration is None:
        return np.zeros(len(seen)), np.zeros(len(seen))
    return calibration.seen(modal.records), np.sqrt(seen**2 @ calibration.tolerance**2)


def _of_left(modal: ModalEstimate, structure: Structure) -> GainErrors:
    """Those of what is left in the records."""
    test, gain = modal.records, modal.gain
    nothing = np.full(test.n_sensors, np.nan)
    zero = np.zeros(test.n_sensors)
    unknown = GainErrors(nothing, nothing, zero, 1, zero)
    if below_lines(test, structure).size:
        return unknown
    if modal.of_records:
        moved = np.any(test.rigid_body, axis=1)
        error, std = np.where(moved, gain.error, np.nan), np.where(moved, gain.std, np.nan)
        return GainErrors(error, std, np.nan_to_num(_beyond(error, std)), gain.freedom, zero)
    found = errors_along(test, distinct_poles(structure), test.rigid_body, velocity=not structure.modal_damping)
    return unknown if found is None else GainErrors(*found, zero)


def errors_along(
    test: Measurement, poles: tuple[Array, Array], rigid: Array, *, velocity: bool = False
) -> tuple[Array, Array, Array, int] | None:
    """By how much each sensor moves with the base as `rigid` (n_sensors, d) says beside modes at these poles.

    Times `rigid`, deviation, and how much may well be, (n_sensors,) each, and degrees of freedom; None of few lines.
    With `velocity` residues in quadrature are free too. See `gain_errors`.
    """
    records = Records(test)
    count = poles[0].size * test.n_base * (1 + velocity)
    if records.data.shape[0] <= NUMBERS_A_RESIDUE * (count + 3 * test.n_base):
        return None
    free = records.fit(*poles, velocity=velocity)
    above = modes_above(test.freq, test.freq[-1])
    ones, rising = (records.basis(part + 0j) for part in (np.ones((1, test.freq.size)), above))
    slopes = records.basis(gains_and_slopes(test.freq, *poles)[1][: 0 if velocity else None])
    plain, plain_std, least = _estimate(test, rigid, records, free, free.Q, ones, slopes)
    both = np.linalg.qr(np.hstack([free.Q, rising]))[0]
    error, std, least_beside = _estimate(test, rigid, records, free, both, ones, slopes)
    possible = np.max(np.nan_to_num([_beyond(plain, least), _beyond(error, least_beside)]), axis=0)
    plain_std = np.hypot(plain_std, plain - error)
    better = plain_std < std
    error, std = np.where(better, plain, error), np.where(better, plain_std, std)
    freedom = (len(records.data) - free.Q.shape[1] - rising.shape[1]) * (records.data.shape[1] // test.n_sensors)
    return error, std, possible, freedom


def _beyond(error: Array, std: Array) -> Array:
    """The part of errors with these deviations beyond chance, in 95 % of right tests none of any sensor."""
    likely = most_deviations(2 * error.size, 1 - COVERAGE)  # of two estimates each
    return np.sqrt(np.maximum(error**2 - (likely * std) ** 2, 0.0))


def below_lines(test: Measurement, structure: Structure) -> Array:
    """Frequencies of modes and residual modes below the lines, Hz, where they answer like a constant."""
    f = np.append(structure.natural_frequencies, structure.residual.natural_frequencies)
    return np.sort(f[f < test.freq[test.freq > 0][0]])


def base_sensors(context: Context) -> Iterator[Finding]:
    """Sensors of one motion of the base differ, by gains beyond their tolerance or as supports that move apart."""
    problem, misses = context.problem, any(miss.times > BEYOND for miss in context.misses)
    severity = context.weight if misses else Severity.NOTE
    tests = problem.modal[problem.first_test - 1 :]
    yield from of_tests([list(_unlike(one.given, severity)) or list(_differ(one)) for one in tests])


def _unlike(test: Measurement, severity: Severity, most: float = 0.02) -> Iterator[Finding]:
    """The finding, where what no gain explains is more than `most` of what a sensor reads."""
    read = test.base_sensors
    # v = g t + r, r across t, and |v - t| = off |v|: the share |r| / |v|.
    squares = [1 - one.gain**2 * (1 - one.off**2) / (2 * one.gain - 1) if one.gain > 0.5 else 0.0 for one in read]
    each = np.sqrt(np.maximum(squares, 0.0)) if read else np.zeros(0)
    if np.max(each, initial=0.0) > most:
        shares = ", ".join(f"{one.name} by {100 * share:.2g} %" for one, share in zip(read, each, strict=True))
        yield Finding(
            "supports differ", severity,
            f"{len(read)} base sensors differ from the motion that is taken for that of the base, not by gains alone "
            f"({shares} of what they read): the base bends or turns, its supports move apart, or they are noisy",
            "state how else the base moves where it turns (base_axes, such as \"x rz\"); supports that each move for "
            "themselves move alike below some frequency: end the lines there (band)",
            numbers={"sensors": float(len(read)), "most": float(np.max(each))},
        )  # fmt: skip


def _differ(modal: ModalEstimate) -> Iterator[Finding]:
    """The finding, where a gain is off by more than is usual and than its tolerance."""
    read, tolerance = modal.given.base_sensors, 0.0
    if modal.calibration is not None:
        tolerance = float(np.max(modal.calibration.tolerance[modal.given.n_sensors :][: modal.given.n_base]))
    most = max((abs(one.gain - 1) for one in read), default=0.0)
    if most > max(_LEAST, LIKELY * tolerance):
        each = ", ".join(f"{one.name} {one.gain:.4g} times" for one in read)
        yield Finding(
            "base sensors", Severity.NOTE,
            f"{len(read)} base sensors read the motion that is taken for that of the base differently: {each}. M, K "
            "and C are in proportion to that motion, and wrong where these are",
            "calibrate them and state their gains, or state their tolerance (gain_std), or leave a wrong one out",
            numbers={"sensors": float(len(read)), "most": most, "off": max(one.off for one in read)},
        )  # fmt: skip


def modes_below(context: Context) -> Iterator[Finding]:
    """Modes lie below the lines, where signs, gains and the rigid-body mass cannot be told from what they add."""
    if context.is_judged and not context.has("table rocks"):
        yield from of_tests([list(_below(modal.records, its)) for _, modal, its in context.fits])


def _below(test: Measurement, structure: Structure) -> Iterator[Finding]:
    f = below_lines(test, structure)
    if f.size:
        yield Finding(
            "modes below", Severity.NOTE,
            f"modes lie below the lines ({', '.join(f'{one:.4g}' for one in f)} Hz, by what they leave above): they "
            "answer there like a constant, as signs, gains and the rigid-body mass do, which were not judged",
            "let the lines begin below the lowest mode", numbers={"modes": float(f.size), "lowest": float(f[0])},
        )  # fmt: skip


def distinct_poles(structure: Structure) -> tuple[Array, Array]:
    """Distinct poles, rad/s and ratios, of residual modes too.

    Of a damping matrix those of the damped motion, which no undamped mode has.
    """
    omega, ratios = 2 * np.pi * structure.natural_frequencies, structure.damping_ratios
    if not structure.modal_damping:
        own = ModalModel(omega, structure.modal_damping_matrix, structure.participation)
        s = np.linalg.eigvals(own.state_matrix)
        fast, slow = np.sort(s[s.imag == 0].real).reshape(-1, 2).T  # any two real ones make the same functions
        omega = np.concatenate([np.abs(s[s.imag > 0]), np.sqrt(fast * slow)])
        ratios = -np.concatenate([s[s.imag > 0].real, (fast + slow) / 2]) / omega
    omega = np.append(omega, structure.residual.omega)
    ratios = np.append(ratios, structure.residual.damping_ratios)
    poles = omega * (1 + 1j * ratios)
    first = ~np.triu(np.abs(poles[:, None] - poles) <= NEGLIGIBLE * omega, 1).any(axis=0)
    return omega[first], ratios[first]


def wrong_gains(test: Measurement, errors: GainErrors, structure: Structure) -> Iterator[Finding]:
    """Gains that are wrong: of the base, which explains those of sensors, or of single sensors, the worst first."""
    explained = np.zeros(test.n_sensors, bool)
    for axis, name in enumerate(test.base_axes):
        driven = _driven(test, axis)
        base = errors.of_base(driven)
        if base is not None:
            explained |= driven
            yield _of_base(name, base, errors, driven)
    judged = test.n_base > 1 and np.any(np.isfinite(errors.error)) and not np.any(errors.tolerance)
    of_axes = list(_of_axes(test, structure)) if judged and not np.any(explained) else []
    explained |= bool(of_axes)
    yield from of_axes
    for i in [one for one in errors.wrong if not explained[one]][:MOST_OF_A_KIND]:
        error, name = float(errors.error[i]), test.sensor_names[i]
        yield Finding(
            "gain", Severity.CONTRADICTS,
            f"{name} reads {100 * abs(error):.2g} % {'high' if error > 0 else 'low'} against the base (standard "
            f"deviation {100 * errors.std[i]:.1g} %): M_SS, K_SS and C are wrong in its row and column",
            f"calibrate it and divide its record by {1 + error:.4f} (gain = {1 + error:.4f} in sensors.toml), or "
            f"correct its axis or its row of rigid_body{_within(error)}", channel=name,
            numbers={"gain": 1 + error, "std": float(errors.std[i])},
        )  # fmt: skip


def _of_axes(test: Measurement, structure: Structure) -> Iterator[Finding]:
    """Gains of single base directions of several, by what all sensors move by along each beside their modes."""
    for axis, name in enumerate(test.base_axes):
        along = np.where(np.arange(test.n_base) == axis, test.rigid_body, 0.0)
        found = errors_along(test, distinct_poles(structure), along, velocity=not structure.modal_damping)
        errors = found and GainErrors(*found, np.zeros(test.n_sensors))
        if errors and (base := errors.of_base()):
            yield _of_base(name, base, errors, np.isfinite(errors.error))


def _within(error: float, usual: float = 0.015) -> str:
    """The remedy beside others of an error that is usual of accelerometers."""
    return ", or state its tolerance (gain_std, --gain-std 0.005)" if abs(error) < usual else ""


def _driven(test: Measurement, axis: int) -> NDArray[np.bool_]:
    """Sensors that move with the base by one of its directions more than by all others, (n_sensors,)."""
    of_base = -seen_at_sensors(test)[:, test.n_sensors :]
    return np.asarray(of_base[:, axis] > of_base.sum(axis=1) / 2)


def _of_base(name: str, error: float, errors: GainErrors, driven: NDArray[np.bool_]) -> Finding:
    """The base reads differently from all sensors that move with it."""
    gain, std = 1 / (1 + error), float(np.sum(errors.std[driven & np.isfinite(errors.std)] ** -2.0) ** -0.5)
    return Finding(
        "gain", Severity.CONTRADICTS,
        f"the base {name} reads {100 * abs(gain - 1):.2g} % {'high' if gain > 1 else 'low'} against all sensors that "
        f"move with it (standard deviation {100 * std:.1g} %): M, K and C are wrong by as much",
        f"calibrate it and divide its record by {gain:.4f} (gain = {gain:.4f} in sensors.toml){_within(error)}",
        channel=f"base {name}",
        numbers={"gain": gain, "std": std},
    )  # fmt: skip


def worth_of(by_gain: Array, mass_std: Array) -> Array:
    """By how many of its deviations the diagonal of M_SS moves at most where it moves by `by_gain`, (n_sensors,).

    `by_gain` (n_sensors, m) is what an error of each sensor's gain makes. Of `mass_std` (m, m) what is stated exactly
    does not move; it is NaN where all that is not stated is open.
    """
    std = np.diag(mass_std)
    known = std > 0
    if not known.any() and np.isnan(std).any():
        return np.full(len(by_gain), np.nan)
    return np.max(by_gain[:, known] / std[known], axis=1, initial=0.0)


def rests_on(test: Measurement, errors: GainErrors, worth: Array) -> Iterator[Finding]:
    """Gains that M_SS rests on more closely than the records show them; none is accused.

    `worth` (n_sensors,): deviations that an error of 1 % moves M_SS by. The records leave a gain open to its estimate
    and its interval on either side. Where an error within that would move M_SS by more than noise does, which holds for
    right gains, that the gain is right is an assumption that matters.
    """
    for i in np.flatnonzero(np.any(test.rigid_body, axis=1) & (errors.tolerance == 0)):
        size, open_ = 100 * abs(errors.error[i]), 100 * LIKELY * errors.std[i]
        reach, gain = size + open_, f"{1 + errors.error[i]:.4f} ± {open_ / 100:.1g}"
        if not np.isfinite(errors.error[i]):
            reach, gain = _UNSHOWN, "not shown"
        if worth[i] * reach > most_deviations():
            yield Finding(
                "gain not shown", Severity.NOTE,
                f"the intervals of M_SS take the gain of {test.sensor_names[i]} to be exactly 1, and the records do "
                f"not show it closely enough (gain {gain}: an error of {reach:.2g} % would move M_SS by "
                f"{worth[i] * reach:.2g} standard deviations)",
                "calibrate this sensor if that matters", channel=test.sensor_names[i],
                numbers={"gain": 1 + float(errors.error[i]), "deviations": float(worth[i] * reach)},
            )  # fmt: skip


def _estimate(
    test: Measurement, rigid: Array, records: Records, free: ResidueFit, Q: Array, ones: Array, slopes: Array
) -> Array:  # fmt: skip
    """Errors along `rigid` beside functions Q (rows, columns), their deviations, and these by the noise alone.

    The poles of `slopes` (rows, 2 m inputs) move with them, in a Gauss-Newton step: they were fitted without them.
    """
    each = records.data.shape[1] // test.n_sensors
    by_sensor = lambda x: np.sum(x, axis=-2).reshape(*x.shape[:-2], each, test.n_sensors).sum(axis=-2)  # noqa: E731
    moved_so, beside = _rigid_motion(rigid, records), less(Q, free.left)
    extra, slopes = less(Q, ones), less(Q, slopes)
    column = extra @ moved_so
    size = by_sensor(column**2)
    observable = size > MIMICKED**2 * by_sensor((ones @ moved_so) ** 2)
    column *= np.tile(observable, each)
    size[~observable] = 1.0
    moved = np.tile(free.residues, (2, 1, 1))[: slopes.shape[1] // ones.shape[1]]  # (2 m, inputs, channels)
    by = lambda x: x.reshape(*moved.shape[:2], x.shape[-1])  # noqa: E731
    across = by_sensor(moved * by(slopes.T @ column))
    residues = moved.reshape(slopes.shape[1], moved.shape[-1])
    products = (slopes.T @ slopes) * (residues @ residues.T)
    together = products.reshape(*moved.shape[:2] * 2).sum(axis=(1, 3))
    inverse = np.linalg.pinv(together, rcond=ROUND_OFF, hermitian=True)
    pull = np.einsum("kic,kic->k", moved, by(slopes.T @ beside))
    normal = np.linalg.inv(np.diag(size) - across.T @ inverse @ across)
    error = normal @ (by_sensor(column * beside) - across.T @ (inverse @ pull))
    steps = inverse @ (pull - across @ error)
    along = (steps[:, None, None] * moved).reshape(residues.shape)
    left = beside - column * np.tile(error, each) - slopes @ along
    of_lines = records.in_runs(left * column)
    by_line = by_sensor((of_lines.real + of_lines.imag)[..., None, :])
    variance = _variance(by_line) / size
    noise = by_sensor(left**2) / max((len(left) - Q.shape[1]) * each - 1, 1)
    noise = np.maximum(noise, EXACT**2 * records.size / left.size)
    if test.response_std is not None and np.any(test.response_std > 0):
        stated = 0.5  # half of a complex number's variance, in units of what is stated
        # What a model misses is no noise, and pulls constants along: beyond the stated noise it counts twice.
        noise, variance = np.maximum(noise, stated), variance * np.maximum(noise / stated, 1.0)
    std, least = (np.sqrt(part * np.diag(normal)) for part in (np.maximum(variance, noise), noise))
    return np.where(observable, np.array([error, std, least]), np.nan)


def less(Q: Array, columns: Array) -> Array:
    """Columns less their part along orthonormal ones, twice, as the first time leaves round-off of what it takes."""
    columns = columns - Q @ (Q.T @ columns)
    return columns - Q @ (Q.T @ columns)


def _rigid_motion(rigid: Array, records: Records) -> Array:
    """The weighted records of sensors that move as `rigid` says, by the inputs of `records`, (inputs, channels)."""
    if records.unit:
        return rigid.T.reshape(1, -1) * records.channel
    return np.linalg.pinv(records.moving) @ rigid.T * records.channel


def _variance(products: Array) -> Array:
    """Variance of the sums (k,) of products (runs, n_freq, k) of which lines in a run may share their error.

    The largest of what single lines and blocks of them show: noise has no blocks, what a model misses has.
    """
    runs, lines = products.shape[:2]
    found = [np.sum(products**2, axis=(0, 1))]
    for count in _BLOCKS:
        blocks = max(count // runs, 1)
        if lines >= 2 * blocks and blocks * runs > 2:
            sums = np.add.reduceat(products, np.arange(blocks) * lines // blocks, axis=1)
            found.append(np.sum(sums**2, axis=(0, 1)) * blocks * runs / (blocks * runs - 1))
    return np.max(found, axis=0)
