r"""Sensors on soft brackets, as redundancy shows them: a mass of a stated form, or sensors to spare on a rigid part.

A bracket of frequency w_b makes of the motion of its place ``1 / (1 - w²/w_b² + 2 i zeta_b w/w_b)`` times as much. The
record times ``1 - b w²``, ``b = 1/w_b²``, is that motion again, but for a delay: what records miss is linear in b. Free
modes take it up as shapes, ``1 + b w_k²`` times as large. A mass of a stated form, in which shapes are orthogonal,
does not, nor do sensors on one rigid part, which at each line move as a rigid body.

The test is Rao's score test of b = 0 of each sensor, beside all that is free (C. R. Rao, Proc. Camb. Phil. Soc. 44
(1948) 50-57), along the motion as it is fitted: noise of the records would lean towards brackets.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.assessment.checks.context import Context
from sysid.assessment.checks.gains import GainErrors, gain_errors, less
from sysid.assessment.sensitivity import KNOWN, largest_deviations, left_by_constraints, rows_of
from sysid.errors import InputError, listed
from sysid.finding import Finding
from sysid.measurement.channels import tolerance_of
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.misfit import Record, noise_records
from sysid.modal_analysis.modal_estimate import independent_rows, index_of, matched
from sysid.modal_analysis.residues import line_correlation
from sysid.modal_analysis.response import columns, weights_of_test
from sysid.models.unknowns import scales_of
from sysid.problem.direct_response import stacked_rows
from sysid.problem.prepared import Prepared
from sysid.problem.terms import TestTerm
from sysid.structure.sensor import BASE_AXES, rigid_body
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import LIKELY, MENDED, NEGLIGIBLE, ROUND_OFF, beyond_chance


class Misfit(NamedTuple):
    """Misfits of what is stated, in standard deviations (rows,), and what they change by.

    `softness` (rows, n_sensors): by each sensor's b, s², of the motion that is fitted; `mended`: likewise, of what was
    recorded. `beside` (rows, k): by all that is free beside. `others` (rows, l): by what else may be wrong, one by one.
    """

    left: Array
    softness: Array
    mended: Array
    beside: Array
    others: Array


class SoftBracket(NamedTuple):
    """The sensor whose bracket explains a misfit, b and its standard deviation, s², by how many deviations it does.

    `others` do so nearly as well.
    """

    sensor: int
    softness: float
    std: float
    deviations: float
    others: tuple[int, ...]


def soft_brackets(context: Context, largest: int = 400) -> Iterator[Finding]:
    """A sensor's mounting is soft: its record grows with frequency against a stated mass, or its rigid part.

    Beside a stated mass, shapes of up to the `largest` number of entries are looked at, which takes a second or two.
    """
    problem, end = context.problem.screened, context.end
    if context.is_explained or context.named or context.has("changing"):
        return
    top = 2 * np.pi * _highest(context)
    if problem.answers_in_band:
        for part, misfit in misfits_of_parts(problem, end.structure):
            found = softest(misfit, top)
            if found is not None:
                yield _finding(context, found, f"its rigid part {part!r} moves")
    elif end.x is not None and problem.formulation.fits_records and end.structure.mode_shapes.size <= largest:
        found = _beside_model(problem, end.structure, end.x, top)
        if found is not None and _is_known(problem, end.structure, end.x):
            yield _finding(context, found, "the stated model allows, if that is right")


def _highest(context: Context) -> float:
    """Frequency of the highest mode within the lines, Hz."""
    freq, frequencies = context.problem.measurement.freq, context.end.structure.natural_frequencies
    return float(np.max(frequencies, where=frequencies <= freq[-1], initial=freq[0]))


def softest(misfit: Misfit, top: float, least: float = 2e-3, most: float = 1 / 3) -> SoftBracket | None:
    """The bracket that explains a misfit; None where chance does, or anything else that may be wrong.

    Of sensors whose motion is from `least` to `most` less than they read at the highest mode, `top`, rad/s: a bracket
    nearer to it shows as a mode of its own.
    """
    U, s, _ = np.linalg.svd(misfit.beside / _size(misfit.beside), full_matrices=False)
    U = U[:, s > ROUND_OFF * s.max(initial=0.0)]
    left, softness, mended, wrong = (less(U, rows) for rows in (*misfit[:3], misfit.others))
    size, products = _size(softness), np.sum(softness * mended, axis=0)
    seen = size > np.maximum(NEGLIGIBLE * _size(misfit.softness), np.finfo(float).tiny)
    along = np.where(seen & (products > 0), -(softness.T @ left) / size, 0.0)
    i, freedom = int(np.argmax(along)), left.size - U.shape[1] - 1
    if freedom < 1 or along[i] <= 0:
        return None
    b, gained = float(along[i] * size[i] / products[i]), float(along[i] ** 2)
    before, after = float(left @ left), float(np.sum((left + b * mended[:, i]) ** 2))
    noise = max(after / freedom, 1.0)
    wrong = wrong[:, _size(wrong) > NEGLIGIBLE * _size(misfit.others)]
    elsewhere = float(np.max(((wrong / _size(wrong)).T @ left) ** 2, initial=0.0))
    by_chance = beyond_chance(1, int(np.count_nonzero(seen)) // 2)  # on one side
    explained = after < beyond_chance(freedom) or after - freedom < MENDED**2 * (before - freedom)
    clear = gained > noise * by_chance and gained > elsewhere + noise * beyond_chance(1)
    if not (clear and explained and least < b * top**2 < most):
        return None
    others = np.flatnonzero((along > 0) & (along**2 > gained - LIKELY**2 * noise))
    std = float(np.sqrt(noise) * size[i] / products[i])
    return SoftBracket(i, b, std, float(np.sqrt(gained / noise)), tuple(others[others != i].tolist()))


def _size(rows: Array) -> Array:
    return np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)


def _finding(context: Context, found: SoftBracket, against: str) -> Finding:
    """The finding of a bracket."""
    test, top = context.problem.measurement, _highest(context)
    i, names, frequency = found.sensor, test.sensor_names, found.softness**-0.5 / (2 * np.pi)
    std = frequency * found.std / (2 * found.softness)
    high = 1 / (1 - (top / frequency) ** 2) - 1
    which = listed([names[one] for one in (i, *found.others)], " or ")
    numbers = {"frequency": frequency, "std": std, "deviations": found.deviations, "error": high, "sensor": float(i)}
    return Finding(
        "soft bracket", context.weight,
        f"{which} seems to be on a soft bracket of {frequency:.4g} Hz (standard deviation {std:.2g} Hz): it reads more "
        f"than {against}, the more so the higher the frequency, {100 * high:.2g} % too much at {top:.4g} Hz. M_SS, "
        "K_SS and C are wrong in its row and column",
        f"stiffen its mounting, or leave the sensor out (of a record at hand: times 1 - (f / {frequency:.4g} Hz)²)",
        channel=None if found.others else names[i],
        numbers=numbers | {f"other {k}": float(one) for k, one in enumerate(found.others, 1)},
    )  # fmt: skip


def _is_known(problem: Prepared, structure: Structure, x: Array) -> bool:
    """True where the matrices are known: beside a mode that hardly shows, and may have any shape, chance finds one."""
    from sysid.assessment.uncertainty import uncertainty  # which takes gains from the checks

    u = uncertainty(problem, structure, x)
    return all(one <= KNOWN for one in largest_deviations(structure, (u.mass, u.stiffness, u.damping)).values())


def _beside_model(problem: Prepared, structure: Structure, x: Array, top: float, rounds: int = 3) -> SoftBracket | None:
    """The bracket that explains the misfit of a model, by Gauss-Newton steps of its unknowns and b."""
    found = None
    for _ in range(rounds):
        misfit, directions = misfit_of_model(problem, structure, x)
        better = softest(misfit, top)
        if better is None:
            break
        found, bracket = better, misfit.mended[:, [better.sensor]]
        free = np.hstack([bracket / _size(bracket), misfit.beside])
        x = x + directions @ np.linalg.lstsq(free, -misfit.left, rcond=ROUND_OFF)[0][-directions.shape[1] :]
        try:
            structure = problem.structure(x)
        except InputError:  # a step too far
            break
    return found


def misfit_of_model(problem: Prepared, structure: Structure, x: Array) -> tuple[Misfit, Array]:
    """Misfit to all that is fitted beside the unknowns, and gains and delays of the sensors of one's own test.

    And the moves of x, (n_variables, q), by the last q columns of `beside`.
    """
    formulation, modal = problem.formulation, problem.modal[0]
    rows = stacked_rows(rows_of(formulation, x, as_stated=True))
    unit, every = scales_of(formulation.unknowns, x), np.full(x.size, True)
    J = rows.jacobian * unit
    free = left_by_constraints(formulation, x, unit, J, every)
    changes = _by_channels(formulation.own_test, structure)
    softness, mended, beside = (np.pad(part, ((0, len(J) - len(part)), (0, 0))) for part in changes)
    std, errors = rows.std[:, None], None
    if modal.by_modes:
        errors = gain_errors(modal, structure)
    else:
        std = std * _shared(noise_records(modal.records, structure, x.size)[0], modal.records, x.size)
    known = std[:, 0] > 0  # scatter of fewer stretches than rows is none along some
    left, softness, mended, beside = (
        part[known] / std[known] for part in (rows.residuals[:, None], softness, mended, np.hstack([beside, J @ free]))
    )
    there = (left[:, 0] != 0) | np.any(beside != 0, axis=1)  # runs of other lengths have no records at some lines
    found = Misfit(left[there, 0], softness[there], mended[there], beside[there], np.zeros((np.sum(there), 0)))
    return _with_gains(problem, found, errors), unit[:, None] * free


def _by_channels(term: TestTerm, structure: Structure) -> tuple[Array, Array, Array]:
    """Changes of a test's rows by b of each sensor, as fitted and as recorded, and by gains, then delays, if any."""
    modal = term.estimate
    test = modal.records
    s, (weight, scale) = test.n_sensors, weights_of_test(test, weighted=True)[0]
    if structure.modal_damping and matched(modal, 2 * np.pi * structure.natural_frequencies) is not None:
        factor = term.weight / scale * independent_rows(modal)[0][:, index_of(modal).phi]
        by = (modal.phi * part for part in (modal.omega**2, 1.0))
        softness, gains = (np.einsum("rsk,sk->rs", factor.reshape(-1, s, modal.omega.size), part) for part in by)
        return softness, softness, gains
    found = []
    for record in _changes(test, structure):
        alone = np.moveaxis(np.eye(s)[..., None] * (term.weight * weight / scale * record), 1, 2)  # (channel, line, s)
        flat = term.matrices.beyond.of(test).without(0, alone).reshape(-1, s)
        found.append(np.concatenate([flat.real, flat.imag]))
    return found[0], found[1], np.hstack(found[2:])


def _changes(test: Measurement, structure: Structure) -> list[ComplexArray]:
    """Changes of the sensors by b, as fitted and as recorded, by gain and delay, (n_sensors, runs * n_freq) each."""
    w = 2 * np.pi * np.tile(test.freq, test.n_runs)
    moves = columns(np.einsum("sd,rdf->rsf", test.rigid_body, test.base) + test.predict(structure))
    return [moves * w**2, columns(test.response) * w**2, moves, 1j * w * moves]


def _with_gains(problem: Prepared, misfit: Misfit, errors: GainErrors | None, usual: float = 0.01) -> Misfit:
    """The same with what records show of the gains, the first columns of `beside`, and how far off is `usual`.

    The records are those from which a calibration has taken errors off: what they show still holds these, and gains
    that are as usual are off by as much the other way.
    """
    n, calibration = misfit.softness.shape[1], problem.modal[0].calibration
    error, std = (np.full(n, np.nan),) * 2 if errors is None else (errors.error, errors.std)
    taken = np.zeros(n) if calibration is None else calibration.seen(problem.modal[0].records)
    error = (1 + error) / (1 + taken) - 1
    usually = np.hypot(usual, tolerance_of(problem.stated.measurement)[:n])
    known = np.flatnonzero(np.isfinite(error) & np.isfinite(std) & (std > 0))
    rows = np.vstack([np.eye(n)[known] / std[known, None], np.diag(1 / usually)])
    values = np.concatenate([error[known] / std[known], (1 / (1 + taken) - 1) / usually])
    none, size = np.zeros((values.size, n)), misfit.left.size + values.size
    rows = np.pad(rows, ((0, 0), (0, misfit.beside.shape[1] - n)))
    others = np.pad(misfit.others, ((0, values.size), (0, 0)))
    return Misfit(
        np.concatenate([misfit.left, -values]), np.vstack([misfit.softness, none]), np.vstack([misfit.mended, none]),
        np.vstack([misfit.beside, rows]), np.hstack([others, np.eye(size, n, n - size)]),
    )  # fmt: skip


def misfits_of_parts(problem: Prepared, structure: Structure) -> Iterator[tuple[str, Misfit]]:
    """Each rigid part with sensors to spare, and by how far these do not move as a rigid body, line by line."""
    test, unknowns = problem.measurement, structure.mode_shapes.size
    parts = parts_with_spare(test)
    if not parts:
        return
    noise, inside = noise_records(test, structure, unknowns)[0], np.concatenate(test.own_lines)
    shared, changes, errors = (
        _shared(noise, test, unknowns), _changes(test, structure), gain_errors(problem.modal[0], structure)
    )  # fmt: skip
    for part, (mine, sums) in parts.items():
        std = shared * np.sqrt(sums**2 @ noise.std[:, inside] ** 2 / 2)  # of a real number
        # A sensor that is not where it is said to be reads a rotation of the part besides.
        turns = np.linalg.pinv(_rigid_rows(test, mine), NEGLIGIBLE)[3:] @ changes[2][mine]
        far = np.linalg.norm(turns, axis=1) > NEGLIGIBLE * np.linalg.norm(changes[2][mine])
        places = [np.tile(turn, (test.n_sensors, 1)) for turn in turns[far]]
        every = [
            (sums[:, None] * record.T[inside] / std[..., None]).reshape(-1, test.n_sensors)
            for record in (columns(problem.modal[0].as_recorded.response), *changes, *places)
        ]
        left, softness, mended, gains, delays, *turned = (np.concatenate([one.real, one.imag]) for one in every)
        others = np.hstack([np.zeros((len(left), 0)), *turned])
        found = Misfit(left.sum(axis=1), -softness, -mended, -np.hstack([gains, delays]), others)
        yield part, _with_gains(problem, found, errors)


def _shared(noise: Record, test: Measurement, unknowns: int) -> float:
    """Factor of deviations as neighbouring lines share their errors."""
    error = (noise.misfit / noise.std).reshape(test.n_sensors, test.n_runs, -1)
    return float(np.sqrt(line_correlation(error, unknowns)))


def _rigid_rows(test: Measurement, mine: NDArray[np.bool_]) -> Array:
    """Motion of some sensors (count, 6) with a rigid body about their centre, its rotations in units of their reach."""
    sensors = [sensor for sensor, its in zip(test.sensors or (), mine, strict=True) if its]
    places = np.array([sensor.position for sensor in sensors], dtype=float)
    centre = places.mean(axis=0)
    rows = rigid_body(sensors=sensors, base_axes=BASE_AXES, origin=tuple(centre.tolist()))
    rows[:, 3:] /= max(float(np.abs(places - centre).max()), np.finfo(float).tiny)
    return rows


def parts_with_spare(test: Measurement) -> dict[str, tuple[NDArray[np.bool_], Array]]:
    """Rigid parts with more sensors than their motion needs: which these are, (n_sensors,), and `beside_rigid`."""
    parts = [sensor.part for sensor in test.sensors or ()]
    masks = {part: np.array([one == part for one in parts]) for part in dict.fromkeys(filter(None, parts))}
    every = {part: (mine, beside_rigid(test, mine)) for part, mine in masks.items()}
    return {part: (mine, sums) for part, (mine, sums) in every.items() if len(sums)}


def beside_rigid(test: Measurement, mine: NDArray[np.bool_]) -> Array:
    """Sums of the sensors `mine` (n_sensors,) that no rigid motion of all of them makes, orthonormal (k, n_sensors)."""
    sums = scipy.linalg.null_space(_rigid_rows(test, mine).T, rcond=NEGLIGIBLE).T
    found = np.zeros((len(sums), mine.size))
    found[:, mine] = sums
    return found
