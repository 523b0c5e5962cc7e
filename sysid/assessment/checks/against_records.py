"""Checks of a fit against its records: signs that the model is not the structure's, whatever its residual."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.assessment.checks.context import Context, Ended, of_tests
from sysid.assessment.checks.gains import (
    MIMICKED,
    NUMBERS_A_RESIDUE,
    below_lines,
    distinct_poles,
    gain_errors,
    wrong_gains,
)
from sysid.assessment.checks.stated import MISFIT, force_misfit, pressure_of
from sysid.errors import InputError
from sysid.finding import MOST_OF_A_KIND, Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import of_run
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.residues import Records, ResidueFit, linear_residues
from sysid.modal_analysis.response import columns, modes_above
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure
from sysid.structure.superelement import ResidualModes
from sysid.structure.thresholds import CANDIDATES, EXACT, FREE, MENDED, NEGLIGIBLE, beyond_chance

_ALIKE = 0.5  # of the power of a motion; another that differs by more, noise included, is not the same
_SEEN = 3.0  # times the noise, the least motion that two sensors can share
_FEW = 2  # sensors that may be wrong each by itself, where these are most of them
_GAIN = 0.03  # of the base's motion; smaller errors of a sensor's gain are usual
_SAME_SHAPE = 0.95  # modal assurance criterion
_FEWEST = 8.0  # lines in a half-power width; a Hann window then takes 2 % off a peak, and more with fewer
_RESOLVED = 2.5  # distances of lines; narrower peaks are mostly the window's
_TWICE = 2.0  # distances of lines, within which a peak that was smeared over them is taken for two modes
_MISSED = 3.0  # times the relative misfit elsewhere, beyond which spectra of unknown origin show a peak flattened
_NEAR = 1.5  # half-power widths, or distances of lines, about a peak
_CLEARLY = 2.0  # times the least residual, that the next best exchange leaves
_FREQUENCY, _DAMPING = 5.0, 0.1  # weights of errors of log w and log zeta; residues are relative to all of them


def records_of_fit(context: Context) -> Iterator[Finding]:
    """Records show that the model, its damping, its sensors or its force are not what they are said to be."""
    if context.is_explained:
        return
    problem, end = context.problem.screened, context.end
    formulation, changing = problem.formulation, context.has("changing")
    fits = problem.fits(end.structure, end.x)
    found = [_of_records(formulation, modal, its, changing) for modal, its in fits]
    yield from of_tests([[one for one in of_one if one not in context.found] for of_one in found])


def _of_records(formulation: Formulation, modal: ModalEstimate, structure: Structure, changing: bool) -> list[Finding]:
    """Signs in the records of one test that a structure is not theirs."""
    test = modal.records
    records, poles = Records(test), distinct_poles(structure)
    leaks = list(leakage(test, structure)) if test.averaged else []
    velocity = not structure.modal_damping
    if records.data.shape[0] <= NUMBERS_A_RESIDUE * poles[0].size * records.n_base * (1 + velocity):
        return leaks
    free = records.fit(*poles, velocity=velocity)
    fit = modal.record_fit
    taken = fit is not None and np.any(fit.constants != fit.of_axes)  # what was taken off has to be told
    errors = gain_errors(modal, structure) if taken or not changing else None  # which changes would explain
    misses = list(_misfit(formulation, test, structure, records, free))
    rigid = list(_rigid(modal, records, free, changing or below_lines(test, structure).size > 0, structure.residual))
    gains = [] if (rigid and not taken) or errors is None else list(wrong_gains(test, errors, structure))
    gains = [one for one in gains if one.channel not in {it.channel for it in rigid}]  # a sign or an axis is no gain
    of_force = force_misfit(formulation, test, structure, modal.calibration)
    found = [*_at_rest(modal), *leaks, *misses, *of_force, *rigid, *gains]
    # Beside what those say, quadrature and likeness mean nothing.
    if structure.modal_damping and not (leaks or rigid or gains or changing):
        found += _damping(records, poles, free)
    if not found:  # spectra of unknown origin, whose misfit nothing else explains
        found = leaks = list(leakage(test, structure))
    if not (leaks or misses or rigid):
        found += _twins(modal, structure)
    return [*found, *_couplings(modal, structure)]


def _at_rest(modal: ModalEstimate) -> Iterator[Finding]:
    """Runs of whole records are not at rest at both ends, where it is stated."""
    runs = modal.records.n_runs
    for run in modal.in_motion:
        yield Finding(
            "in motion", Severity.CONTRADICTS,
            f"the records{of_run(run, runs)} are stated to begin and end at rest (at_rest), but show the free "
            "vibration of a structure that was in motion at one end",
            "leave the statement out for this run, so that its transients are fitted", run=run + 1,
        )  # fmt: skip


def _misfit(
    formulation: Formulation, test: Measurement, structure: Structure, records: Records, free: ResidueFit
) -> Iterator[Finding]:
    """The structure leaves clearly more of the accelerations than free residues, at its poles or the data's."""
    mass = formulation.mass
    stated = "the written model" if mass.entries is None else "the stated mass model"
    model = "the structure" if mass.free else stated
    left = Records(replace(test, response=test.response - test.predict(structure)))
    misfit = float(np.sqrt(left.size / records.size))
    misses = f"{model} misses {100 * misfit:.3g} % of the accelerations"
    possible = max(float(np.sqrt(free.squared_error / records.size)), EXACT)
    whose, figure = "its poles", "free residues"
    wrong = "the model, a sign or axis in rigid_body, or a record is not what it is said to be"
    if misfit <= MISFIT * possible:
        poles = None if formulation.free_modes else PolesAndResidues.of(test)
        if poles is None:
            return
        possible = max(poles.of_accelerations, EXACT)
        whose, figure = "the poles of the data", "poles of the data"
        wrong = "the form of its mass, stiffness or damping, recovery, or a bound is not the structure's"
    if misfit > MISFIT * possible:
        yield Finding(
            "misfit", Severity.CONTRADICTS,
            f"{misses}, {whose} with free residues {100 * possible:.3g} %: {wrong}",
            numbers={"misfit": misfit, figure: possible},
        )  # fmt: skip


def _rigid(
    modal: ModalEstimate, records: Records, free: ResidueFit, others: bool, residual: ResidualModes
) -> Iterator[Finding]:
    """Sensors move in a constant proportion to the base beside their modes: then rigid_body is wrong.

    Where `others` make all move so, as modes below the lines do, what is of one sensor alone.
    """
    test, fit = modal.records, modal.record_fit
    if others:
        moved = fit.of_axes if fit is not None else _of_one_sensor(residual, test.freq)
        chi2 = np.full(test.n_sensors, np.inf)
    elif modal.of_records:  # beside the noise of the base, which biases what follows
        moved, chi2 = modal.gain.rigid.copy(), modal.gain.rigid_chi2
    else:
        found = _along_the_base(test, records, free)
        if found is None:
            return
        moved, chi2 = found
    reach = np.abs(test.rigid_body).max(axis=0)
    moved /= np.where(reach > 0, reach, np.inf)
    most, size = np.abs(moved).argmax(axis=1), np.abs(moved).max(axis=1)
    wrong = np.flatnonzero((chi2 > beyond_chance(test.n_base, CANDIDATES)) & (size > _GAIN))
    for direction in np.unique(most[wrong]):
        count, show = np.count_nonzero(most[wrong] == direction), np.count_nonzero(test.rigid_body[:, direction])
        if count > _FEW and 2 * count > show:
            yield Finding(
                "modes below", Severity.CONTRADICTS,
                f"{count} of {show} sensors move with base direction {direction + 1} beside their modes and what "
                "rigid_body says: a mode below the lines that has no pole does so, or positions are wrong",
                "let the lines begin below the lowest mode", numbers={"sensors": float(count)},
            )  # fmt: skip
            return
    for i in wrong[np.argsort(-size[wrong])][:MOST_OF_A_KIND]:
        yield Finding(
            "rigid motion", Severity.CONTRADICTS,
            f"{test.sensor_names[i]} moves with the base beside its modes and what rigid_body says, by "
            f"{moved[i, most[i]]:.2g} times base direction {most[i] + 1} ({wrong.size} of {test.n_sensors} sensors do)",
            "its sign, gain or axis is wrong, or its accelerations are not absolute", channel=test.sensor_names[i],
            numbers={"times": float(moved[i, most[i]]), "direction": most[i] + 1.0, "sensors": float(wrong.size)},
        )  # fmt: skip


def _of_one_sensor(modes: ResidualModes, freq: Array, alone: float = 0.99, far: float = 0.1) -> Array:
    """Share of the base's motion, (n_sensors, d), that modes `far` below the lines stand for, by one sensor `alone`.

    Of at least three, by the squares of their shapes: no structure has such a mode.
    """
    squares = modes.shapes**2 / np.maximum(np.sum(modes.shapes**2, axis=0), np.finfo(float).tiny)
    below = (modes.natural_frequencies < far * freq[freq > 0][0]) & (len(squares) > 2)
    return np.asarray(-np.where(below & (squares > alone), modes.shapes, 0.0) @ modes.participation)


def _along_the_base(test: Measurement, records: Records, free: ResidueFit) -> tuple[Array, Array] | None:
    """Share of the base's motion in what each sensor's modes leave, (n_sensors, d), and its chi-squared.

    Beside what modes above the lines add, which residual modes may miss. None where modes answer for all of it.
    """
    ones = records.basis(np.ones((1, test.freq.size), dtype=complex))
    above = np.linalg.qr(np.hstack([free.Q, records.basis(modes_above(test.freq, test.freq[-1]) + 0j)]))[0]
    extra = ones - above @ (above.T @ ones)
    if np.linalg.norm(extra) < MIMICKED * np.linalg.norm(ones):
        return None
    Q, R = np.linalg.qr(extra)
    beside = free.left - above @ (above.T @ free.left)
    along = Q.T @ beside
    left = beside - Q @ along
    gained = np.sum(along**2, axis=0).reshape(-1, test.n_sensors).sum(axis=0)
    noise = records.noise(left, (above.shape[1] + len(along)) * left.shape[1], least=EXACT)
    return records.by_sensor(np.linalg.solve(R, along)[None])[0], gained / noise


def _damping(records: Records, poles: tuple[Array, Array], free: ResidueFit) -> Iterator[Finding]:
    """Residues in quadrature, which normal modes have not, stand out: on the basis {g, i w g}."""
    if records.data.shape[0] <= 4 * poles[0].size * records.n_base:
        return
    both = records.fit(*poles, velocity=True)
    extra = poles[0].size * records.n_base * records.n_sensors
    # Beside what gains and modes above the lines leave, which pass for motion in quadrature.
    freq = records.freq
    beside = records.basis(np.vstack([np.ones(freq.size), modes_above(freq, freq[-1])]) + 0j)
    plain, left = (_beside(one, beside) for one in (free, both))
    noise = records.noise(left, 2 * extra + beside.shape[1] * left.shape[1], least=EXACT)
    gained = float(np.sum(plain**2) - np.sum(left**2))
    # What is smaller than half of what remains may be noise, or errors of channels.
    if gained > max(noise * beyond_chance(extra, CANDIDATES), float(np.sum(left**2)) / 4):
        share = float(np.sqrt(gained / records.size))
        yield Finding(
            "damping", Severity.CONTRADICTS,
            f"residues in quadrature explain {100 * share:.2g} % of the response: the damping is not classical, or a "
            "mode is missing; modal damping ratios are then an approximation",
            numbers={"share": share},
        )  # fmt: skip


def _beside(fit: ResidueFit, columns: Array) -> Array:
    """What is left of the records beside the fit's residues and some columns."""
    added = np.linalg.qr(columns - fit.Q @ (fit.Q.T @ columns))[0]
    return np.asarray(fit.left - added @ (added.T @ fit.left))


def _couplings(modal: ModalEstimate, structure: Structure) -> Iterator[Finding]:
    """Dampers couple modes, and the damping matrix holds it: its share, and the coupling that stands out most."""
    found, test = modal.coupling, modal.records
    if found is None or structure.modal_damping:
        return
    twin = Structure.from_tree(structure.to_tree() | {
        "damping_ratios": structure.damping_ratios, "damping_matrix": None
    })  # fmt: skip
    share = float(np.linalg.norm(test.predict(structure) - test.predict(twin)) / np.linalg.norm(test.relative))
    values = found.values[*found.pairs.T]
    most = int(np.argmax(np.abs(values) / modal.coupling_std))
    (first, second), deviations = modal.omega[found.pairs[most]] / (2 * np.pi), values[most] / modal.coupling_std[most]
    poles = sorted((one for one in np.linalg.eigvals(structure.to_state_space().A) if one.imag > 0), key=abs)[:6]
    decays = ", ".join(f"{abs(one) / (2 * np.pi):.5g} ({-100 * one.real / abs(one):.3g} %)" for one in poles)
    yield Finding(
        "damping", Severity.NOTE,
        f"the damping is not classical: dampers couple the modes, by {100 * share:.2g} % of the response, most surely "
        f"those at {first:.4g} and {second:.4g} Hz ({abs(deviations):.2g} deviations); the damping matrix holds it, "
        "and frequencies and ratios in the table are those of M, K and the diagonal of C: free motion decays at its "
        f"poles, {decays} Hz",
        numbers={"share": share, "deviations": float(abs(deviations)), "first": float(first), "second": float(second),
                 **{f"pole {at}": float(abs(one) / (2 * np.pi)) for at, one in enumerate(poles, 1)}},
    )  # fmt: skip


def _twins(modal: ModalEstimate, structure: Structure) -> Iterator[Finding]:
    """Sensors whose motions differ by no more than noise does, line by line."""
    test = modal.records
    lines, names = np.concatenate(test.own_lines), test.sensor_names
    moves, noise = columns(test.relative)[:, lines], _noise_variance(modal)
    left = moves - columns(test.predict(structure))[:, lines]
    gram = (moves @ moves.conj().T).real
    size, most = np.diag(gram), beyond_chance(2 * moves.shape[1], CANDIDATES) / (2 * moves.shape[1])
    for i, j in zip(*np.tril_indices(test.n_sensors, -1), strict=True):
        sign, smaller = np.sign(gram[i, j]), min(size[i], size[j])
        if size[i] + size[j] - 2 * abs(gram[i, j]) > _ALIKE * smaller or smaller == 0:
            continue
        each = _smooth(np.abs(left[i] - sign * left[j]) ** 2) if noise is None else (noise[i] + noise[j])[lines]
        both = each + (EXACT**2 * (size[i] + size[j])) / lines.sum()
        apart = np.mean(np.abs(moves[i] - sign * moves[j]) ** 2 / both)
        if apart <= most and np.mean(np.abs(moves[[i, j]]) ** 2 / both, axis=1).min() > _SEEN**2:
            # Of more sensors than modes, or fewer, one of both is no degree of freedom, and no harm is done.
            spare = structure.n != test.n_sensors and not np.isin([i, j], structure.dof_sensors).all()
            yield Finding(
                "one motion", Severity.NOTE if spare else Severity.CONTRADICTS,
                f"sensors {names[j]} and {names[i]} record one motion but for noise"
                + (f" in the {structure.n} modes" if spare else " and are one degree of freedom"),
                "" if spare else "leave one out", channel=names[j], numbers={"sensor": float(j), "other": float(i)},
            )  # fmt: skip


def _noise_variance(modal: ModalEstimate) -> Array | None:
    """Variance of the sensors' own noise, (n_sensors, runs * n_freq); None where it is neither stated nor found.

    Of whole records without the base's noise, which sensors in one motion share.
    """
    test = modal.records
    if modal.noise is not None:
        levels = np.broadcast_to(modal.noise.response, (test.n_runs, test.n_sensors))
        by_run = max(modal.reduced, 1.0) * modal.density[:, None] * levels**2
        return np.repeat(by_run.T, test.freq.size, axis=1)
    if test.response_std is not None:
        return columns(np.broadcast_to(test.response_std, test.response.shape) + 0j).real ** 2
    return None


def _smooth(power: Array, lines: int = 11) -> Array:
    """Mean of each line's power and that of its neighbours, so many lines in all."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(power, lines, mode="nearest"))


class Peaks(NamedTuple):
    """Modes within the lines: numbers as users count them, Hz, half-power widths and distances of lines there, Hz."""

    number: NDArray[np.intp]
    frequency: Array
    width: Array
    spacing: Array


def leakage(test: Measurement, structure: Structure) -> Iterator[Finding]:
    """Lines are too coarse for the modes that were found, and modes that may be none.

    Averages over segments (`Measurement.averaged`) are judged by their lines alone. Frequency response functions of
    unknown origin may be exact at any lines, so that they must miss more at the peak than elsewhere. Spectra of whole
    records are no averages, and never judged.
    """
    if test.freq.size < 2 or not (test.averaged or test.has_unit_runs):
        return
    peaks = _peaks(test, structure)
    fewest = _least_lines(test, _FEWEST)
    coarse = peaks.spacing * fewest > peaks.width
    averaged = "" if test.averaged else "if these spectra are averages over segments, "
    groups = _found_twice(peaks, coarse, structure)
    if groups:
        of_groups = ", ".join(" and ".join(f"{f:.4g}" for f in peaks.frequency[group]) for group in groups)
        most = np.max(peaks.spacing[[group[0] for group in groups]])
        yield Finding(
            "one mode twice", Severity.CONTRADICTS,
            f"modes at {of_groups} Hz have the same shape, and lines are up to {most:.2g} Hz apart: {averaged}one mode "
            "found twice is leakage of segments that are too short, no second mode",
            numbers={"frequency": float(peaks.frequency[groups[0][0]]), "spacing": float(most)},
        )  # fmt: skip
    if not np.any(coarse):
        return
    k = int(np.argmax(np.where(coarse, peaks.spacing / peaks.width, 0.0)))
    missed = "" if test.averaged else _missed(test, structure, float(peaks.frequency[k]), float(peaks.width[k]))
    if missed is None:
        return
    seconds = fewest / float(peaks.width[k])
    why = "their window flattens its peak" if fewest == _FEWEST else "noise at one line makes its peak"
    yield Finding(
        "coarse lines", Severity.CONTRADICTS,
        f"lines are {peaks.spacing[k]:.2g} Hz apart, mode {peaks.number[k]} is {peaks.width[k]:.2g} Hz wide{missed}: "
        f"{averaged}{why}, and damping and masses come out wrong",
        f"take whole records (from_time with estimator='records'), or segments of {seconds:.3g} s or longer",
        numbers={
            "mode": float(peaks.number[k]), "spacing": float(peaks.spacing[k]), "width": float(peaks.width[k]),
            "seconds": seconds,
        },
    )  # fmt: skip


def _least_lines(test: Measurement, under_window: float) -> float:
    """Lines that a half-power width holds at least; without what a window makes of peaks, more than one line of it."""
    return 1.0 if test.window == "taken off" else under_window


def unresolved(test: Measurement, omega: Array, ratios: Array) -> Iterator[Finding]:
    """Averages over segments have too few lines in most peaks of poles found in them, in rad/s and ratios, (m,) each.

    Where only some are so narrow `leakage` tells it of the structure that was fitted. The window itself makes a narrow
    peak about one and a half distances of lines wide.
    """
    f = omega / (2 * np.pi)
    inside = (f >= test.freq[0]) & (f <= test.freq[-1])
    if not test.averaged or test.freq.size < 2 or not np.any(inside):
        return
    f, width = f[inside], 2 * ratios[inside] * f[inside]
    spacing = np.interp(f, test.freq, np.gradient(test.freq))
    k = int(np.argmax(spacing / width))
    if 2 * np.count_nonzero(width < _least_lines(test, _RESOLVED) * spacing) >= f.size:
        yield Finding(
            "short segments", Severity.CONTRADICTS,
            f"the segments are too short: lines are {spacing[k]:.2g} Hz apart ({1 / spacing[k]:.3g} s a segment), and "
            f"the peak at {f[k]:.4g} Hz is no wider than their window makes any peak, so that damping and masses are "
            "the window's",
            "take whole records (from_time with estimator='records'), or segments several times as long",
            numbers={"spacing": float(spacing[k]), "frequency": float(f[k])},
        )  # fmt: skip


def _peaks(test: Measurement, structure: Structure) -> Peaks:
    """Modes within the lines."""
    freq, f = test.freq, structure.natural_frequencies
    inside = np.flatnonzero((f >= freq[0]) & (f <= freq[-1]))
    width = 2 * structure.damping_ratios[inside] * f[inside]
    return Peaks(inside + 1, f[inside], width, np.interp(f[inside], freq, np.gradient(freq)))


def _found_twice(peaks: Peaks, coarse: NDArray[np.bool_], structure: Structure) -> list[list[int]]:
    """Groups of modes of one shape, each within two distances of lines from the next."""
    groups: list[list[int]] = []
    for i, j in pairwise(range(peaks.number.size)):
        near = peaks.frequency[j] - peaks.frequency[i] < _TWICE * peaks.spacing[i]
        if not (near and coarse[i] and coarse[j] and _mac(structure, *peaks.number[[i, j]] - 1) > _SAME_SHAPE):
            continue
        if groups and groups[-1][-1] == i:
            groups[-1].append(j)
        else:
            groups.append([i, j])
    return groups


def _mac(structure: Structure, i: int, j: int) -> float:
    """Modal assurance criterion of two modes at the sensors, 0 to 1."""
    a, b = (structure.mode_shapes[:, [i, j]]).T
    return float((a @ b) ** 2 / max((a @ a) * (b @ b), np.finfo(float).tiny))


def _missed(test: Measurement, structure: Structure, frequency: float, width: float) -> str | None:
    """Misfit of a fit about a peak, in words; None where that is no more than elsewhere.

    Noise as large at all lines is more of a weak mode's response, but no larger there; noise in proportion to the
    response is no more of it. Only a peak itself that is not what modes make of it stands out both ways.
    """
    distance = np.gradient(test.freq)
    near = np.abs(test.freq - frequency) < _NEAR * np.maximum(width, distance)
    if not np.any(near) or np.all(near):
        return None
    left = test.relative - test.predict(structure)
    size = lambda record, at: float(np.sqrt(np.mean(np.abs(record[..., at]) ** 2)))  # noqa: E731
    missed, missed_elsewhere = size(left, near), size(left, ~near)
    there, elsewhere = missed / size(test.relative, near), missed_elsewhere / size(test.relative, ~near)
    if there < max(_MISSED * elsewhere, NEGLIGIBLE) or missed < _MISSED * missed_elsewhere:
        return None
    return f", and the fit misses {100 * there:.3g} % of the response there ({100 * elsewhere:.3g} % elsewhere)"


def exchanged_sensors(problem: Prepared, end: Ended) -> tuple[Finding, ...]:
    """Two sensors that stand in each other's place, so that no other search would do better; none where none can tell.

    Where bounds explain the misfit as well, the exchange must leave no more than free residues do.
    """
    formulation, test, structure = problem.formulation, problem.measurement, end.structure
    distinguishable = formulation.fits_records and not formulation.stiffness.free and structure.n == test.n_sensors
    pairs = list(_alike(test))
    if not distinguishable or not 0 < len(pairs) <= 15:  # those of six sensors
        return ()
    try:
        omega, ratios = problem.geometry.poles.omega, problem.geometry.poles.ratios
        found = [(_residual_of(problem, omega, ratios, pair), pair) for pair in pairs]
        floor = linear_residues(test, omega, ratios)[1]
    except (InputError, np.linalg.LinAlgError):
        return ()
    found.sort()
    (least, (i, j)), others = found[0], [residual for residual, _ in found[1:]]
    kept = test.residual(structure)
    if least > MENDED * kept or (others and others[0] < _CLEARLY * least):
        return ()
    if least > FREE * floor and pressure_of(problem, end)[1].explains:
        return ()
    names = test.sensor_names
    swapped = Finding(
        "swapped sensors", Severity.CONTRADICTS,
        f"{names[i]} and {names[j]} are swapped: the model misses {100 * kept:.3g} % of the accelerations as they are, "
        f"and {100 * least:.3g} % with these two in each other's place",
        "exchange their records, or their names", channel=names[i],
        numbers={"sensor": float(i), "other": float(j), "residual": kept, "residual exchanged": least},
    )  # fmt: skip
    return (swapped,)


def _alike(test: Measurement) -> Iterator[tuple[int, int]]:
    """Pairs of sensors that move alike with the base."""
    for i, j in combinations(range(test.n_sensors), 2):
        if np.allclose(test.rigid_body[i], test.rigid_body[j]):
            yield i, j


def _residual_of(problem: Prepared, omega: Array, ratios: Array, pair: tuple[int, int]) -> float:
    """Relative residual of the records with two sensors exchanged, fitted by poles and residues alone."""
    from scipy.optimize import least_squares

    test, formulation = problem.measurement, problem.formulation
    order = np.arange(test.n_sensors)
    order[list(pair)] = pair[::-1]
    test = replace(test, response=test.response[:, order])
    residues, _ = linear_residues(test, omega, ratios)
    size, count = np.linalg.norm(residues), min(omega.size, test.n_sensors)
    lower, upper = formulation.lower, formulation.upper
    in_log = (lower > 0) & (upper > 10 * lower)
    to = lambda x: np.where(in_log, np.log(np.where(in_log, x, 1.0)), x)  # noqa: E731
    back = lambda z: np.clip(np.where(in_log, np.exp(np.where(in_log, z, 0.0)), z), lower, upper)  # noqa: E731

    def errors(z: Array) -> Array:
        s = formulation.matrices.structure(back(z), test)
        w, zeta = 2 * np.pi * s.natural_frequencies[:count], s.damping_ratios[:count]
        modelled = np.einsum("nk,kd->knd", s.mode_shapes[:, :count], s.participation[:count])
        return np.concatenate([
            ((modelled - residues[:count]) / size).ravel(), _FREQUENCY * np.log(w / omega[:count]),
            _DAMPING * np.log(zeta / ratios[:count]),
        ])  # fmt: skip

    low, high = to(lower), to(upper)
    start = np.clip(to(formulation.guess), low, high)
    end = least_squares(errors, start, bounds=(low - 1e-9, high + 1e-9), x_scale=high - low + 1e-12, max_nfev=40)
    return test.residual(formulation.matrices.structure(back(end.x), test))
