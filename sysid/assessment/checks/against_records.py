"""Checks of a fit against its records: signs that the model is not the structure's, whatever its residual."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sysid.assessment.checks.context import Context
from sysid.assessment.checks.gains import MIMICKED, NUMBERS_A_RESIDUE, distinct_poles, gain_errors, wrong_gains
from sysid.assessment.checks.leakage import leakage
from sysid.assessment.checks.stated_mass import MISFIT, force_misfit
from sysid.finding import MOST_OF_A_KIND, Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import of_run
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.residues import Records, ResidueFit
from sysid.modal_analysis.response import columns
from sysid.problem.formulation import Formulation
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import CANDIDATES, EXACT, beyond_chance

_ALIKE = 0.5  # of the power of a motion; another that differs by more, noise included, is not the same
_SEEN = 3.0  # times the noise, the least motion that two sensors can share
_GAIN = 0.03  # of the base's motion; smaller errors of a sensor's gain are usual


def records_of_fit(context: Context) -> Iterator[Finding]:
    """Records show that the model, its damping, its sensors or its force are not what they are said to be."""
    if context.is_explained:
        return
    problem, end = context.problem.screened, context.end
    formulation, changing = problem.formulation, context.has("changing")
    fits = problem.fits(end.structure, end.x)
    for i, (modal, its) in enumerate(fits, start=1):
        found = [one for one in _of_records(formulation, modal, its, changing) if one not in context.found]
        yield from found if len(fits) == 1 else [one.of_test(i) for one in found]


def _of_records(formulation: Formulation, modal: ModalEstimate, structure: Structure, changing: bool) -> list[Finding]:
    """Signs in the records of one test that a structure is not theirs."""
    test = modal.records
    records, poles = Records(test), distinct_poles(structure)
    leaks = list(leakage(test, structure)) if test.averaged else []
    velocity = not structure.modal_damping
    if records.data.shape[0] <= NUMBERS_A_RESIDUE * poles[0].size * records.n_base * (2 if velocity else 1):
        return leaks
    free = records.fit(*poles, velocity=velocity)
    misses, rigid = list(_misfit(formulation, test, structure, records, free)), []
    if not changing:
        rigid = list(_rigid(modal, records, free))
    gains = [] if rigid or changing else list(wrong_gains(test, gain_errors(modal, structure)))
    found = [*_at_rest(modal), *leaks, *misses, *force_misfit(formulation, test, structure), *rigid, *gains]
    # Beside what those say, quadrature and likeness mean nothing.
    if structure.modal_damping and not (leaks or rigid or gains or changing):
        found += _damping(records, poles, free)
    if not found:  # spectra of unknown origin, whose misfit nothing else explains
        found = leaks = list(leakage(test, structure))
    if not (leaks or misses or rigid):
        found += _twins(modal, structure)
    return found


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
    if misfit > MISFIT * possible:
        yield Finding(
            "misfit", Severity.CONTRADICTS,
            f"{misses}, its poles with free residues {100 * possible:.3g} %: the model, a sign or axis in rigid_body, "
            "or a record is not what it is said to be",
            numbers={"misfit": misfit, "free residues": possible},
        )  # fmt: skip
        return
    poles = None if formulation.free_modes else PolesAndResidues.of(test)
    if poles is None:
        return
    possible = max(poles.of_accelerations, EXACT)
    if misfit > MISFIT * possible:
        yield Finding(
            "misfit", Severity.CONTRADICTS,
            f"{misses}, the poles of the data with free residues {100 * possible:.3g} %: the form of its mass, "
            "stiffness or damping, recovery, or a bound is not the structure's",
            numbers={"misfit": misfit, "poles of the data": possible},
        )  # fmt: skip


def _rigid(modal: ModalEstimate, records: Records, free: ResidueFit) -> Iterator[Finding]:
    """Sensors move in a constant proportion to the base beside their modes: then rigid_body is wrong."""
    test = modal.records
    if modal.by_modes:  # beside the noise of the base, which biases what follows
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
    for i in wrong[np.argsort(-size[wrong])][:MOST_OF_A_KIND]:
        yield Finding(
            "rigid motion", Severity.CONTRADICTS,
            f"{test.sensor_names[i]} moves with the base beside its modes and what rigid_body says, by "
            f"{moved[i, most[i]]:.2g} times base direction {most[i] + 1} ({wrong.size} of {test.n_sensors} sensors do)",
            "its sign, gain or axis is wrong, or its accelerations are not absolute", channel=test.sensor_names[i],
            numbers={"times": float(moved[i, most[i]]), "direction": most[i] + 1.0, "sensors": float(wrong.size)},
        )  # fmt: skip


def _along_the_base(test: Measurement, records: Records, free: ResidueFit) -> tuple[Array, Array] | None:
    """Share of the base's motion in what each sensor's modes leave, (n_sensors, d), and its chi-squared.

    None where modes answer for all of it.
    """
    ones = records.basis(np.ones((1, test.freq.size), dtype=complex))
    extra = ones - free.Q @ (free.Q.T @ ones)
    if np.linalg.norm(extra) < MIMICKED * np.linalg.norm(ones):
        return None
    Q, R = np.linalg.qr(extra)
    along = Q.T @ free.left
    left = free.left - Q @ along
    gained = np.sum(along**2, axis=0).reshape(-1, test.n_sensors).sum(axis=0)
    noise = records.noise(left, free.residues.size + along.size, least=EXACT)
    return records.by_sensor(np.linalg.solve(R, along)[None])[0], gained / noise


def _damping(records: Records, poles: tuple[Array, Array], free: ResidueFit) -> Iterator[Finding]:
    """Residues in quadrature, which normal modes have not, stand out: on the basis {g, i w g}."""
    if records.data.shape[0] <= 4 * poles[0].size * records.n_base:
        return
    both = records.fit(*poles, velocity=True)
    extra = poles[0].size * records.n_base * records.n_sensors
    noise = records.noise(both.left, 2 * extra, least=EXACT)
    gained = free.squared_error - both.squared_error
    if gained > noise * beyond_chance(extra, CANDIDATES):
        share = float(np.sqrt(gained / records.size))
        yield Finding(
            "damping", Severity.CONTRADICTS,
            f"residues in quadrature explain {100 * share:.2g} % of the response: the damping is not classical, or a "
            "mode is missing; modal damping ratios are then an approximation",
            numbers={"share": share},
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
            # A fit of fewer modes than there are leaves all that would tell its sensors apart.
            few = f", or modes are missing: {structure.n} tell no more than {structure.n} of {test.n_sensors} apart"
            yield Finding(
                "one motion", Severity.CONTRADICTS,
                f"sensors {names[j]} and {names[i]} record one motion but for noise and are one degree of freedom"
                + few * (structure.n < test.n_sensors),
                "leave one out", channel=names[j], numbers={"sensor": float(j), "other": float(i)},
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
