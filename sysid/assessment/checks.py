"""Checks of a fit against its records: signs that the model is not the structure's, whatever its residual."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import scipy

from sysid.assessment.gains import distinct_poles, gain_errors, told
from sysid.assessment.leakage import leakage
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import of_run
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.residues import Records, ResidueFit, beyond_chance, force_residual_left
from sysid.modal_analysis.response import columns, weighed_mass, weighed_mass_std
from sysid.models.mass import total_of
from sysid.problem.formulation import Formulation
from sysid.problem.problem import Problem
from sysid.structure.structure import Array, Structure

_ROUND_OFF = 1e-8  # of the records: what counts as noise where there is none
_ALIKE = 0.5  # of the power of a motion; another that differs by more, noise included, is not the same
_NEIGHBOURS = 11  # lines that tell the noise about one, where it is not stated
_SEEN = 3.0  # times the noise, the least motion that two sensors can share
_EQUAL = 1e-9  # of a sensor's motion: what counts as noise where there is none
_MISFIT = 1.5  # times what free residues leave, beyond which a record is not what the modes make of it
_LINES = 2  # times the free residues: fewer numbers than these tell nothing beside noise
_MIMICKED = 1e-2  # of a constant; less of it is left where a mode far below the lines answers like one
_CHANCE = 1e-4  # that errors as stated are so large together
_FAR = 4.0  # standard deviations from a stated value, beyond which it is told by itself
_GAIN = 0.03  # of the base's motion; smaller errors of a sensor's gain are usual


def doubts(problem: Problem, structure: Structure, x: Array | None, *, changing: bool = False) -> tuple[str, ...]:
    """What speaks against an answer, in sentences; nothing counts as determined beside one.

    Parameters
    ----------
    problem : Problem
    structure : Structure
        The answer, with the sensors of the problem's own test.
    x : (n_variables,) or None
        The unknowns that stand for it; None where it has other degrees of freedom than the sensors.
    changing : bool
        Frequencies change between stretches of the records, which looks like quadrature and wrong gains too.
    """
    formulation = problem.formulation
    found: list[str] = []
    tests: list[tuple[Measurement, Structure]] = []
    if x is not None:
        found += [*_priors(formulation, x), *(sentence for term in formulation.beside for sentence in term.doubts(x))]
        tests += [(term.test, term.matrices.structure(x, term.test)) for term in formulation.further_tests]
    if formulation.fits_records:
        found += contradictions(problem, structure)
        tests.insert(0, (problem.measurement, structure))
    for i, (test, its) in enumerate(tests, start=1):
        told = _of_records(formulation, test, its, changing)
        further = [sentence for sentence in told if sentence not in found]
        found += further if len(tests) == 1 else [f"test {i}: {sentence}" for sentence in further]
    return tuple(found)


def contradictions(problem: Problem, structure: Structure) -> tuple[str, ...]:
    """Stated masses that the records of the problem's own test contradict, and a force that they do not explain."""
    if not problem.formulation.fits_records:
        return ()
    told = [
        sentence for check in (_stated_mass, _known_entries, _lumped_total) for sentence in check(problem, structure)
    ]
    return (*told, *_force(problem.formulation, problem.measurement, structure))


def _of_records(formulation: Formulation, test: Measurement, structure: Structure, changing: bool) -> list[str]:
    """Signs in the records of one test that a structure is not theirs, in sentences."""
    records, poles = Records(test), distinct_poles(structure)
    leaks = list(leakage(test, structure)) if test.averaged else []
    velocity = not structure.modal_damping
    if records.data.shape[0] <= _LINES * poles[0].size * records.n_base * (2 if velocity else 1):
        return leaks
    free = records.fit(*poles, velocity=velocity)
    misses, rigid = list(_misfit(formulation, test, structure, records, free)), []
    if not changing:
        rigid = list(_rigid(test, records, free))
    gains = [] if rigid or changing else list(told(test, gain_errors(test, structure)))
    found = [*_at_rest(test), *leaks, *misses, *_force(formulation, test, structure), *rigid, *gains]
    # Beside what those say, quadrature and likeness mean nothing.
    if structure.modal_damping and not (leaks or rigid or gains or changing):
        found += _damping(records, poles, free)
    if not found:  # spectra of unknown origin, whose misfit nothing else explains
        found = leaks = list(leakage(test, structure))
    if not (leaks or misses or rigid):
        found += _twins(test, structure)
    return found


def _at_rest(test: Measurement) -> Iterator[str]:
    """Whether runs of whole records are at rest at both ends where it is stated."""
    for run in () if test.modal is None else test.modal.in_motion:
        yield (
            f"the records{of_run(run, test.n_runs)} are stated to begin and end at rest (at_rest), but show the free "
            "vibration of a structure that was in motion at one end: leave the statement out for this run, so that its "
            "transients are fitted"
        )


def _priors(formulation: Formulation, x: Array) -> Iterator[str]:
    """Values that are stated as known, where errors as stated do not miss them all so far."""
    names = [name for term in formulation.priors for name in term.labels]
    off = np.concatenate([np.zeros(0), *(term.numbers(x) for term in formulation.priors)])
    if np.sum(off**2) > scipy.special.chdtri(max(off.size, 1), _CHANCE) and np.all(np.abs(off) <= _FAR):
        told = ", ".join(f"{name} by {z:+.2g}" for name, z in zip(names, off, strict=True))
        yield (
            f"the values that are stated as known are missed together, in standard deviations: {told}; they, another "
            "number, or the model is wrong"
        )


def _misfit(
    formulation: Formulation, test: Measurement, structure: Structure, records: Records, free: ResidueFit
) -> Iterator[str]:
    """Whether the structure leaves clearly more of the accelerations than free residues, at its poles or the data's."""
    mass = formulation.mass
    stated = "the written model" if mass.entries is None else "the stated mass model"
    model = "the structure" if mass.free else stated
    left = Records(replace(test, response=test.response - test.predict(structure)))
    misfit = float(np.sqrt(left.size / records.size))
    misses = f"{model} misses {100 * misfit:.3g} % of the accelerations"
    possible = max(float(np.sqrt(free.squared_error / records.size)), _ROUND_OFF)
    if misfit > _MISFIT * possible:
        yield (
            f"{misses}, its poles with free residues {100 * possible:.3g} %: the model, a sign or axis in rigid_body, "
            "or a record is not what it is said to be"
        )
        return
    poles = None if formulation.free_modes else PolesAndResidues.of(test)
    if poles is None:
        return
    possible = max(poles.of_accelerations, _ROUND_OFF)
    if misfit > _MISFIT * possible:
        yield (
            f"{misses}, the poles of the data with free residues {100 * possible:.3g} %: the form of its mass, "
            "stiffness or damping, recovery, or a bound is not the structure's"
        )


def _stated_mass(problem: Problem, structure: Structure) -> Iterator[str]:
    """What the base force weighs, where a stated mass says otherwise."""
    test, stated = problem.measurement, problem.formulation.mass
    whole = stated.totals is not None or np.all(np.isfinite(problem.known_mass))
    if test.force is None or stated.weighs or not whole or not structure.modal_damping:
        return
    poles = distinct_poles(structure)
    weighed, own = np.diag(weighed_mass(test, *poles)), np.diag(structure.rigid_body_mass)
    noise = _FAR * weighed_mass_std(test, *poles) / own  # a direction beside a rotation may be weighed worse
    usual = max(0.01, 3 * force_residual_left(test, *poles) / np.sqrt(test.freq.size))
    if np.any(np.abs(weighed / own - 1) >= np.maximum(usual, noise)):
        given, told = (", ".join(f"{m:.4g}" for m in masses) for masses in (own, weighed))
        yield (
            f"the stated mass makes {given} kg in the base directions, but the base force weighs {told} kg: one of "
            "them, or the unit of the force, is wrong; the force weighs an adapter or base plate on its cells too"
        )


def _known_entries(problem: Problem, structure: Structure) -> Iterator[str]:
    """Whether known entries are used, and leave the base what is left of the total."""
    geometry, mass = problem.geometry, problem.formulation.mass
    if not mass.free or mass.entries is None:
        return
    if not structure.at_sensors:
        yield "the known entries of the mass are not used: the degrees of freedom are not the sensors alone"
        return
    if mass.totals is not None and problem.measurement.force is None:
        makes = total_of(geometry, structure.mass, mass.totals.kind)
        std = mass.totals.std_by_direction
        if np.any(makes > problem.totals * (1 + 1e-6) + _FAR * std):
            given, told = (", ".join(f"{m:.4g}" for m in masses) for masses in (problem.totals, makes))
            yield f"the known entries of the mass make {told} kg or more, and {given} kg are stated in all"


def _lumped_total(problem: Problem, structure: Structure) -> Iterator[str]:
    """Whether the total of a lumped mass, a sum over the sensors of a direction, is what moves in that direction."""
    totals, geometry = problem.formulation.mass.totals, problem.geometry
    if totals is None or totals.kind != "sensors":
        return
    moves = np.einsum("j,ji->i", np.diag(structure.mass)[: geometry.n], geometry.rigid_body**2)
    has_sensors = np.isin(np.arange(geometry.d), geometry.directions[: geometry.n])
    off = np.abs(moves / totals.values - 1) > 1e-6
    for i in np.flatnonzero(geometry.translational & has_sensors & off):
        yield (
            f"{totals.values[i]:.4g} kg are stated over the sensors of base direction {i + 1}, but their masses "
            f"make {moves[i]:.4g} kg in it: a lumped mass needs sensors along the base directions, not skew ones"
        )


def _force(formulation: Formulation, test: Measurement, structure: Structure) -> Iterator[str]:
    """Whether the base force is that of the modes that the accelerations show."""
    if test.force is None:
        return
    entries, n = formulation.mass.entries, formulation.geometry.n
    # Masses are open, and none of them is below the sensors.
    lumped = not formulation.mass.free and entries is not None and np.isnan(entries).any() and not entries[:, n:].any()
    fixture = (
        ", and mass below the sensors (base ring, fixture), which a full mass may have, a lumped one not"
        if lumped
        else ""
    )
    # Both misfits in units of the stated noise: what is left at a noisy peak speaks against nothing.
    left = replace(test, force=test.force - test.predict_force(structure))
    misfit = float(np.sqrt(Records(left, force=True).size / Records(test, force=True).size))
    possible = max(force_residual_left(test, *distinct_poles(structure)), _ROUND_OFF)
    if misfit > max(_MISFIT * possible, 1e-6):
        yield (
            f"the base force misses what the modes of the accelerations make of it by {100 * misfit:.3g} % "
            f"(free residues leave {100 * possible:.3g} %): check its sign, unit, axes and point of reference{fixture}"
        )


def _rigid(test: Measurement, records: Records, free: ResidueFit) -> Iterator[str]:
    """Whether sensors move in a constant proportion to the base beside their modes: then rigid_body is wrong."""
    if test.modal is not None:  # beside the noise of the base, which biases what follows
        moved, chi2 = test.modal.gain.rigid.copy(), test.modal.gain.rigid_chi2
    else:
        found = _along_the_base(test, records, free)
        if found is None:
            return
        moved, chi2 = found
    reach = np.abs(test.rigid_body).max(axis=0)
    moved /= np.where(reach > 0, reach, np.inf)
    most, size = np.abs(moved).argmax(axis=1), np.abs(moved).max(axis=1)
    wrong = np.flatnonzero((chi2 > beyond_chance(test.n_base)) & (size > _GAIN))
    if wrong.size:
        told = ", ".join(
            f"{test.sensor_names[i]} by {moved[i, most[i]]:.2g} times base direction {most[i] + 1}"
            for i in wrong[np.argsort(-size[wrong])][:3]
        )
        yield (
            f"{wrong.size} of {test.n_sensors} sensors move with the base beside their modes and what rigid_body says "
            f"({told}): their sign, gain or axis is wrong, or their accelerations are not absolute"
        )


def _along_the_base(test: Measurement, records: Records, free: ResidueFit) -> tuple[Array, Array] | None:
    """Share of the base's motion in what each sensor's modes leave, (n_sensors, d), and its chi-squared.

    None where modes answer for all of it.
    """
    ones = records.basis(np.ones((1, test.freq.size), dtype=complex))
    extra = ones - free.Q @ (free.Q.T @ ones)
    if np.linalg.norm(extra) < _MIMICKED * np.linalg.norm(ones):
        return None
    Q, R = np.linalg.qr(extra)
    along = Q.T @ free.left
    left = free.left - Q @ along
    gained = np.sum(along**2, axis=0).reshape(-1, test.n_sensors).sum(axis=0)
    noise = records.noise(left, free.residues.size + along.size, least=_ROUND_OFF)
    return records.by_sensor(np.linalg.solve(R, along)[None])[0], gained / noise


def _damping(records: Records, poles: tuple[Array, Array], free: ResidueFit) -> Iterator[str]:
    """Whether residues in quadrature, which normal modes have not, stand out: on the basis {g, i w g}."""
    if records.data.shape[0] <= 4 * poles[0].size * records.n_base:
        return
    both = records.fit(*poles, velocity=True)
    extra = poles[0].size * records.n_base * records.n_sensors
    noise = records.noise(both.left, 2 * extra, least=_ROUND_OFF)
    gained = free.squared_error - both.squared_error
    if gained > noise * beyond_chance(extra):
        yield (
            f"residues in quadrature explain {100 * np.sqrt(gained / records.size):.2g} % of the response: the damping "
            "is not classical, or a mode is missing; modal damping ratios are then an approximation"
        )


def _twins(test: Measurement, structure: Structure) -> Iterator[str]:
    """Sensors whose motions differ by no more than noise does, line by line."""
    lines, names = np.concatenate(test.own_lines), test.sensor_names
    moves, noise = columns(test.relative)[:, lines], _own_noise(test)
    left = moves - columns(test.predict(structure))[:, lines]
    gram = (moves @ moves.conj().T).real
    size, most = np.diag(gram), beyond_chance(2 * moves.shape[1]) / (2 * moves.shape[1])
    for i, j in zip(*np.tril_indices(test.n_sensors, -1), strict=True):
        sign, smaller = np.sign(gram[i, j]), min(size[i], size[j])
        if size[i] + size[j] - 2 * abs(gram[i, j]) > _ALIKE * smaller or smaller == 0:
            continue
        each = _smooth(np.abs(left[i] - sign * left[j]) ** 2) if noise is None else (noise[i] + noise[j])[lines]
        both = each + (_EQUAL**2 * (size[i] + size[j])) / lines.sum()
        apart = np.mean(np.abs(moves[i] - sign * moves[j]) ** 2 / both)
        if apart <= most and np.mean(np.abs(moves[[i, j]]) ** 2 / both, axis=1).min() > _SEEN**2:
            told = f"sensors {names[j]} and {names[i]} record one motion but for noise"
            if structure.n < test.n_sensors:
                # A fit of fewer modes than there are leaves all that would tell its sensors apart.
                yield (
                    f"{told}: they are one degree of freedom (leave one out), or modes are missing: "
                    f"{structure.n} tell no more than {structure.n} of {test.n_sensors} sensors apart"
                )
            else:
                yield f"{told} and are one degree of freedom: leave one out"


def _own_noise(test: Measurement) -> Array | None:
    """Variance of the sensors' own noise, (n_sensors, runs * n_freq); None where it is neither stated nor found.

    Of whole records without the base's noise, which sensors in one motion share.
    """
    if test.modal is not None:
        levels = np.broadcast_to(test.modal.noise.response, (test.n_runs, test.n_sensors))
        by_run = max(test.modal.reduced, 1.0) * test.modal.density[:, None] * levels**2
        return np.repeat(by_run.T, test.freq.size, axis=1)
    if test.response_std is not None:
        return columns(np.broadcast_to(test.response_std, test.response.shape) + 0j).real ** 2
    return None


def _smooth(power: Array) -> Array:
    """Mean of each line's power and that of its neighbours."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(power, _NEIGHBOURS, mode="nearest"))
