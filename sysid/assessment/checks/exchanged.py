"""Sensors in each other's place: told where the model, with a form of its own, fits the records only with two swapped.

Sensors that move alike with the base leave no sign of it in the records: a full or lumped mass fits them as well, with
rows and columns in another order. A chain, or matrices that are written, do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from sysid.assessment.checks.mistakes import MENDED
from sysid.errors import InputError
from sysid.finding import Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.residues import linear_residues
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import FREE

_CLEARLY = 2.0  # times the least residual, that the next best exchange leaves
_FREQUENCY, _DAMPING = 5.0, 0.1  # weights of errors of log w and log zeta; residues are relative to all of them


def exchanged_sensors(problem: Prepared, structure: Structure, *, wholly: bool = False) -> tuple[Finding, ...]:
    """Two sensors that stand in each other's place; none where the model cannot tell.

    Parameters
    ----------
    problem : Prepared
    structure : Structure
        The best fit to the records as they are.
    wholly : bool
        Whether the exchange must leave no more than free residues do, as there is another cause of the misfit.
    """
    formulation, test = problem.formulation, problem.measurement
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
    if least > MENDED * kept or (others and others[0] < _CLEARLY * least) or (wholly and least > FREE * floor):
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
