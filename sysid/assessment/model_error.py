"""Model error: what records hold beside noise that no structure of constant mass, stiffness and damping makes of them.

Two signs: the model misses the records by more than their noise, and frequencies that no linear structure has, which
change along a record, from run to run, or with the level of motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from sysid.measurement.in_time import peaks, quiet_levels
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.outliers import Outlier
from sysid.modal_analysis.stretches import Stretch, stretches_of
from sysid.modal_analysis.transients import without_transients_of
from sysid.problem.problem import Problem
from sysid.problem.terms import FurtherTest
from sysid.structure.structure import Array, ComplexArray, Structure

BEYOND = 3.0  # times the noise, from which a model is not within it
_UNKNOWN = 0.1  # relative residual, up to which spectra without a stated noise may hold as much of it at some lines
_BLOCK = 16  # lines of a block ..
_BLOCKS = 8  # .. of which there are so many at least, that tell the noise by the quietest quarter
_QUIET = 0.25
_NEAR = 5.0  # half-power widths, or distances of lines, about a mode
_TRACE = 1e-4  # of the records; smaller ones are no noise of an instrument
_MOVED = 0.1  # half-power widths, by which the frequency of a mode changes at least
_KNOWN = 0.1  # the same, to which it is known at least
_SURE = 6.0  # standard deviations of a change
_EXPLAINED = 0.7  # of the squares that constant poles leave, that others leave at most
_SHOWN = 0.03  # of the largest level of a mode, at which it shows
_ENOUGH = 5  # stretches that tell a trend
_TREND = 0.03  # that chance orders frequencies so by level
_SURE_TREND = 1e-3  # the same, where poles that change explain little, as the level changes within stretches
_OF_RUNS = 0.15  # of the variance of frequencies, within runs, where runs differ
_LEAST_RATIO = 1e-4
_CLOSE = 1.06  # ratio of frequencies, within which modes ..
_ONE_SHAPE = 0.9  # .. of one shape (modal assurance criterion) are one that changes
_LEVEL = 1.25  # times the fitted levels, beyond which another is outside


class Miss(NamedTuple):
    """By how many times its noise a model misses a record; by as many at least where quiet lines tell the noise."""

    times: float
    at_least: bool
    record: str
    share: float
    """Of the record."""


class Record(NamedTuple):
    """Accelerations or base force of a test, (runs, channels, n_freq), and what a structure leaves of them."""

    name: str
    channels: tuple[str, ...]
    measured: ComplexArray
    left: ComplexArray
    variance: Array | None
    """Of the noise at each line; None where it is neither stated nor found."""


def misses_of(problem: Problem, structure: Structure, x: Array | None) -> list[Miss]:
    """What the structure misses of accelerations and base force of each test that is fitted.

    Records whose noise is neither stated nor to be found are left out; numbers that stand alone are not counted.

    Parameters
    ----------
    problem : Problem
    structure : Structure
    x : (n_variables,) or None
        The unknowns that stand for it.
    """
    misses = list(_misses(problem, structure, x, []))
    if problem.loss == "squares" and any(miss.times > BEYOND for miss in misses):  # spikes may be all there is
        return list(_misses(problem, structure, x, problem.outliers(structure, x)))
    return misses


def _misses(problem: Problem, structure: Structure, x: Array | None, alone: list[Outlier]) -> Iterator[Miss]:
    given = [problem.measurement] if problem.formulation.fits_records else []
    given += [term.measurement for term in problem.residuals if isinstance(term, FurtherTest)]
    fits = problem.screened.fits(structure, x)
    for i, (raw, (test, its)) in enumerate(zip(given, fits, strict=False), start=problem.first_test):
        of = "" if len(fits) == 1 else f" of test {i}"
        for record in _records(test, raw, its):
            for one in alone:
                if one.test == i and one.channel in record.channels:
                    at = int(np.argmin(np.abs(test.freq - one.freq)))
                    record.left[one.run - 1, record.channels.index(one.channel), at] = 0.0
            found = raw.whole is not None and raw.whole.noise is None
            yield from _miss(record._replace(name=record.name + of), test, found, _near_modes(test, its))


def _records(test: Measurement, raw: Measurement, structure: Structure) -> Iterator[Record]:
    """Records of a test without its transients; `raw` is the test with them."""
    left = test.relative - test.predict(structure)
    quiet = _quiet_base(test, raw)
    noise = None if test.modal is None else test.modal.noise
    std = test.response_std
    if std is not None and quiet is not None and noise is not None:
        std = _bounded(test, std, noise.response, left, quiet)
    yield Record("the accelerations", test.sensor_names, test.relative, left, None if std is None else std**2)
    if test.force is not None:
        axes = tuple(f"force {axis}" for axis in test.base_axes or ())
        left, std = test.force - test.predict_force(structure), test.force_std
        if std is not None and quiet is not None and noise is not None and noise.force is not None:
            std = _bounded(test, std, noise.force, left, quiet)
        yield Record("the base force", axes, test.force, left, None if std is None else std**2)


def _quiet_base(test: Measurement, raw: Measurement) -> Array | None:
    """Share of the base's level that its quietest parts hold, (runs,), where levels were found; else None.

    Levels are found with modes of constant poles: what these leave at the peaks passes for noise of the base.
    """
    if test.modal is None or raw.whole is None or raw.whole.noise is not None or test.modal.varying:
        return None
    quiet = quiet_levels(raw)
    return None if quiet is None else np.minimum(quiet.base / test.modal.noise.base, 1.0).max(axis=1)


def _bounded(test: Measurement, std: Array, level: Array, left: ComplexArray, passed: Array) -> Array:
    """Deviations (runs, channels, n_freq) of which a channel's own is at most what quiet lines hold of what is left.

    Hum and error of a model raise the level that was found. `passed` of the base's share of the noise is left.
    """
    assert test.modal is not None
    quiet = _quiet(left, np.ones(left.shape), test.own_lines)
    own = np.minimum(std**2, (test.modal.density[:, None] * np.broadcast_to(level, std.shape[:2]) ** 2)[..., None])
    least = own if quiet is None else np.minimum(own, quiet[..., None])
    return np.asarray(np.sqrt(least + passed[:, None, None] ** 2 * (std**2 - own)))


def _near_modes(test: Measurement, structure: Structure) -> NDArray[np.bool_]:
    """Lines near a mode of a structure or of whole records, (n_freq,)."""
    f, ratio = structure.natural_frequencies, structure.damping_ratios
    if test.modal is not None:
        f = np.concatenate([f, test.modal.omega / (2 * np.pi)])
        ratio = np.concatenate([ratio, test.modal.ratios])
    reach = np.maximum(2 * _NEAR * ratio * f, _NEAR * np.median(np.diff(test.freq))) if test.freq.size > 1 else np.inf
    return np.asarray(np.any(np.abs(test.freq - f[:, None]) < np.broadcast_to(reach, f.shape)[:, None], axis=0))


def _miss(record: Record, test: Measurement, found: bool, near: NDArray[np.bool_]) -> Iterator[Miss]:
    """What is left of one record in units of its noise; `found`: with the fit, so that it holds errors of the model.

    Of noise that is not stated, what stands out far from all modes is a part, such as hum.
    """
    own, size, missed = test.own_lines, float(np.linalg.norm(record.measured)), float(np.linalg.norm(record.left))
    variance = np.ones(record.left.shape) if record.variance is None else record.variance
    # Noise that is not stated may be in proportion to the record.
    if record.variance is None and (test.has_unit_runs or missed < _UNKNOWN * size):
        return
    bounded = record.variance is None or found
    if bounded:
        quiet = _quiet(record.left, variance, own)
        if quiet is None:
            return
        variance = variance if found else variance * quiet[..., None]
    variance = variance * own[:, None]
    noise = float(np.sqrt(np.sum(variance)))
    left = np.abs(record.left) ** 2
    if bounded:
        left = np.where(near, left, np.minimum(left, variance))
    if noise > _TRACE * size:
        yield Miss(float(np.sqrt(np.sum(left))) / noise, bounded, record.name, missed / size)


def _quiet(left: ComplexArray, variance: Array, own: NDArray[np.bool_]) -> Array | None:
    """What the quietest quarter of the blocks of lines holds, over the variance, (runs, channels); None with few."""
    out = np.ones(left.shape[:2])
    mean = float(gammaincinv(_BLOCK, _QUIET)) / _BLOCK
    for run, lines in enumerate(own):
        power = np.abs(left[run][:, lines]) ** 2 / variance[run][:, lines]
        blocks = power.shape[1] // _BLOCK
        if blocks < _BLOCKS:
            return None
        held = power[:, : blocks * _BLOCK].reshape(len(power), blocks, _BLOCK).mean(axis=2)
        out[run] = np.minimum(np.quantile(held, _QUIET, axis=1) / mean, power.mean(axis=1))
    return out


def noise_at_most(test: Measurement, left: ComplexArray) -> Array | None:
    """Noise that is not known, at most: what a fit leaves of the quietest quarter of the lines.

    Parameters
    ----------
    test : Measurement
    left : ndarray, shape (runs, channels, n_freq)
        Measured less predicted.

    Returns
    -------
    ndarray, shape (runs, channels, 1), or None
        Standard deviations; None with few lines, and of transmissibilities, whose noise may be in proportion to them.
    """
    quiet = None if test.has_unit_runs else _quiet(left, np.ones(left.shape), test.own_lines)
    return None if quiet is None else np.asarray(np.sqrt(quiet)[..., None])


def missed_in_words(misses: list[Miss]) -> Iterator[str]:
    """Records that the model misses by more than their noise, in one sentence."""
    told = [
        f"{miss.record} by {'at least ' * miss.at_least}{miss.times:.2g} times their noise, {100 * miss.share:.3g} %"
        for miss in misses
        if miss.times > BEYOND
    ]
    if told:
        yield f"the model misses {', '.join(told)} of them: what it leaves out is larger than what the instruments add"


class ModelErrors(NamedTuple):
    """Signs of model error, in sentences, the weightiest first, and whether frequencies change."""

    sentences: tuple[str, ...]
    changing: bool


def model_errors(problem: Problem, structure: Structure, misses: list[Miss]) -> ModelErrors:
    """Signs that no structure of constant matrices explains the records.

    Parameters
    ----------
    problem : Problem
    structure : Structure
    misses : list of Miss
        Of the structure, as `misses_of` gives them.
    """
    modal = problem.screened.measurement.modal
    unfitted = [without_transients_of(test, structure) for test in problem.validation]
    missed = [
        miss
        for test in unfitted
        for record in _records(test, test, structure)
        for miss in _miss(record, test, False, _near_modes(test, structure))
    ]
    uneven = modal is not None and bool(modal.scatter is not None or modal.excess)
    beyond = uneven or any(miss.times > BEYOND for miss in (*misses, *missed))
    drift = tuple(drift_in_words(problem)) if beyond else ()
    told = (*missed_in_words(misses), *drift, *unpredicted_in_words(unfitted, structure))
    return ModelErrors(told, bool(drift))


class Seen(NamedTuple):
    """A mode in a stretch: the record and, in words, where in it; Hz; level, m/s²."""

    record: str
    part: str
    frequency: float
    std: float
    level: float


def drift_in_words(problem: Problem) -> Iterator[str]:
    """The mode whose frequency changes most between stretches of all records, those never fitted too, in a sentence."""
    if not problem.formulation.fits_records:
        return
    tests = [problem.measurement, *problem.validation]
    modes = _modes(problem.screened.measurement)
    if not modes:
        return
    omega, ratios = np.transpose(modes)
    made = [stretches_of(test, omega, ratios) for test in tests]
    every = [one for part in made for one in part]
    explained = sum(min(one.left, one.left_by_all) ** 2 for one in every) < _EXPLAINED * sum(
        one.left_by_all**2 for one in every
    )
    found: list[tuple[float, float, list[Seen]]] = []
    for k, mode in enumerate(modes):
        width = mode.ratio * mode.omega / np.pi
        seen = [one for i, part in enumerate(made) for one in _seen(part, k, width, i, tests[i])]
        seen = [one for one in seen if one.level > _SHOWN * max(each.level for each in seen)]
        if len(seen) > 1:
            f, std = (np.array([getattr(one, name) for one in seen]) for name in ("frequency", "std"))
            change = np.abs(f[:, None] - f)
            clear = np.any(change > np.maximum(_MOVED * width, _SURE * np.hypot(std[:, None], std)))
            if clear and (explained or _trend(seen, _SURE_TREND)):
                found.append((float(np.ptp(f)) / width, mode.omega / (2 * np.pi), seen))
    if found:
        _, frequency, seen = max(found, key=lambda one: (_trend(one[2]) != 0, one[0]))
        others = ", ".join(f"{one[1]:.3g}" for one in found if one[1] != frequency)
        also = f" (and of those near {others} Hz)" if others else ""
        yield f"the frequency of the mode near {frequency:.3g} Hz{also} {_how(seen)}"


class Mode(NamedTuple):
    """A pole that records show: rad/s; damping ratio."""

    omega: float
    ratio: float


def _modes(test: Measurement) -> list[Mode]:
    """Poles of a test; those close by of one shape, as a fit makes of a mode that changes, are one."""
    if test.modal is not None:
        omega, ratios, shapes = test.modal.omega, test.modal.ratios, test.modal.phi
    else:
        poles = PolesAndResidues.of(test)
        if poles is None:
            return []
        omega, ratios, shapes = poles.omega, poles.ratios, poles.residues.reshape(poles.omega.size, -1).T
    shapes = shapes / np.maximum(np.linalg.norm(shapes, axis=0), np.finfo(float).tiny)
    groups: list[list[int]] = []
    for k in range(omega.size):
        near = [group for group in groups if omega[k] < _CLOSE * omega[group[0]] and len(shapes) > 1]
        like = [group for group in near if (shapes[:, group[0]] @ shapes[:, k]) ** 2 > _ONE_SHAPE]
        if like:
            like[-1].append(k)
        else:
            groups.append([k])
    return [Mode(float(omega[group].mean()), max(float(ratios[group].max()), _LEAST_RATIO)) for group in groups]


def _seen(stretches: list[Stretch], k: int, width: float, number: int, test: Measurement) -> list[Seen]:
    """A mode in the stretches of a test in which it is known; test 0 is the one that was fitted."""
    made = []
    for one in stretches:
        run = f"run {one.run + 1}" if test.n_runs > 1 else "the record"
        record = run if number == 0 else f"{run} of unfitted test {number}"
        if one.std[k] < _KNOWN * width and one.left <= one.left_by_all:
            part = f"{one.start:.3g} to {one.end:.3g} s"
            made.append(Seen(record, part, float(one.frequency[k]), float(one.std[k]), float(one.level[k])))
    return made


def _trend(seen: list[Seen], chance: float = _TREND) -> float:
    """Rank correlation of the frequency of a mode with its level; zero where chance or time make as large a one."""
    from scipy.stats import spearmanr

    if len(seen) < _ENOUGH:
        return 0.0
    frequency = [one.frequency for one in seen]
    found = spearmanr([one.level for one in seen], frequency)
    in_time = abs(spearmanr(np.arange(len(seen)), frequency).statistic)
    return float(found.statistic) if found.pvalue < chance and abs(found.statistic) > in_time else 0.0


def _how(seen: list[Seen]) -> str:
    """How the frequency of a mode changes, and what to do, in words."""
    trend, frequency = _trend(seen), np.array([one.frequency for one in seen])
    records = list(dict.fromkeys(one.record for one in seen))
    own = {record: [one for one in seen if one.record == record] for record in records}
    within = np.mean([np.var([one.frequency for one in part]) for part in own.values()])
    if len(records) > 1 and within < _OF_RUNS * np.var(frequency):
        means = [
            (record, np.mean([(one.frequency, one.level) for one in part], axis=0)) for record, part in own.items()
        ]
        told = ", ".join(f"{f:.4g} Hz in {record} at {level:.2g} m/s² rms" for record, (f, level) in means)
        return f"differs from record to record ({told}): fit them one by one, and find what changed between them"
    if trend != 0.0:
        by_level = sorted(seen, key=lambda one: one.level)
        least, most = (f"{one.frequency:.4g} Hz" for one in by_level[:: len(seen) - 1])
        return (
            f"{'falls' if trend < 0 else 'rises'} as the motion grows, from {least} where it moves a sensor by "
            f"{by_level[0].level:.2g} m/s² rms to {most} at {by_level[-1].level:.2g} m/s²: the structure "
            f"{'softens' if trend < 0 else 'stiffens'}, and no linear model holds at all levels; fit runs of the level "
            "of interest"
        )
    low, high = seen[int(np.argmin(frequency))], seen[int(np.argmax(frequency))]
    ends = (f"{one.frequency:.4g} Hz at {one.part} of {one.record}" for one in (low, high))
    return (
        f"changes along the records, from {' to '.join(ends)}: the structure is not the same all the time (level, "
        "temperature, joints); fit a part in which it is"
    )


def unpredicted_in_words(unfitted: list[Measurement], structure: Structure) -> Iterator[str]:
    """Tests that a structure predicts worse than a rigid body does, in sentences."""
    for i, test in enumerate(unfitted, start=1):
        residual = test.residual(structure)
        if residual > 1.0:
            yield (
                f"test {i} that was not fitted is predicted worse ({100 * residual:.3g} % missed) than by saying that "
                "the sensors move with the table (100 %)"
            )


def levels_in_words(problem: Problem) -> Iterator[str]:
    """Tests never fitted whose motion is larger or smaller than any that was fitted, in sentences."""
    if not problem.formulation.fits_records:
        return
    fitted = peaks(problem.measurement)
    for i, test in enumerate(problem.validation, start=1):
        own = peaks(test)
        if not (fitted and own):
            continue
        if max(own) > _LEVEL * max(fitted) or max(own) < min(fitted) / _LEVEL:
            span = f"{max(fitted):.3g}" if len(fitted) == 1 else f"{min(fitted):.3g} to {max(fitted):.3g}"
            yield (
                f"test {i} that was not fitted moves the sensors by up to {max(own):.3g} m/s² against the base, the "
                f"fitted {'run' if len(fitted) == 1 else 'runs'} by {span} m/s²: what holds at one level need not "
                "hold at another"
            )
