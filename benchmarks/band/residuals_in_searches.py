"""The swarm and the paper's algorithm on structures with modes beyond the lines: fits to the noise, and what they find.

As many sensors as modes in the lines, one base axis, no base force, the total mass stated. Frequencies, damping ratios
and what each mode adds to each sensor, ``R_k = phi_k gamma_k``, which accelerations tell, are held against the true
ones in deviations of the Cramér-Rao bound, with the poles and the static residual above the lines among the unknowns.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import scipy

import sysid
from benchmarks.band.finite_elements import OnBase
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.simulated_tests import of_spectra
from benchmarks.band.structures import (
    APART,
    END,
    LEAST,
    NOISE,
    RATIOS,
    REACH,
    SPECTRA,
    START,
    Candidate,
    Continuous,
    beam,
    chosen,
    frame,
    log_uniform,
    plate,
)  # fmt: skip
from benchmarks.line import Line, above
from benchmarks.records.simulated import Modes

STRATEGIES = ("swarm", "hpso-ls")
COUNTS = (4, 6)
STRUCTURES, SHORT = 20, (0, 3)  # in turn of four and of six modes
PATIENCE, SHORT_PATIENCE = 300, 60  # s of processor time a structure, both searches
FAR = 4.0  # deviations
SHARE = 0.9
WORST_SHAPES = 50.0  # condition number of the shapes at the sensors, each of length one
POLES = 2  # above the lines, that are unknown too
TO_NOISE = 1.1  # chi² over its degrees of freedom


def lines(reduced: bool) -> Iterator[Line]:
    """Twenty structures by both searches; or two."""
    numbers = SHORT if reduced else range(STRUCTURES)
    answers = figures_of_each("band.residuals_in_searches", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    for name in STRATEGIES:
        found = [it.get(name, {"chi2": np.inf, "far": np.inf}) for it in answers]
        good = [it["chi2"] <= TO_NOISE and it["far"] <= FAR for it in found]
        far = ", ".join(f"{it['chi2']:.3g} and {it['far']:.3g}" for it in found)
        text = f"{len(found)} continuous structures by {name}: share with a fit to the noise (chi² over its degrees of "
        text += f"freedom at most {TO_NOISE:g}), and w, zeta, R_k within {FAR:g} deviations (each: {far})"
        yield above(text, float(np.mean(good)), SHARE)
        counts = [it.get("residual", 0) for it in found]
        yield Line(f"by {name}: residual modes in the answer, least and most", f"{min(counts)}, {max(counts)}")
        seconds = max(it.get("seconds", np.nan) for it in found)
        yield Line(f"by {name}: seconds of processor time of the slowest", f"{seconds:.1f}")


def searched(number: int) -> Continuous:
    """Draw structure `number`, along one axis; drawn again where there is no room for the end of the lines."""
    rng, m = np.random.default_rng((number, 41)), COUNTS[number % 2]
    draw = (beam, frame, plate)[number % 3]
    while True:
        driven, base, candidates = draw(rng, 1)
        structure = _tested(rng, driven, base, candidates, m)
        if structure is not None:
            return structure


def _tested(
    rng: np.random.Generator, driven: OnBase, base: tuple[str, ...], candidates: list[Candidate], m: int
) -> Continuous | None:
    """A structure with m sensors and m modes in the lines; None where these are not apart, or hardly driven."""
    omega, shapes = driven.modes()
    f, load = omega / (2 * np.pi), shapes.T @ driven.load
    weights = np.max(load**2 / np.diag(driven.rigid_body_mass), axis=1)
    if f[m] < APART * f[m - 1] or np.min(np.diff(f[:m]) / f[: m - 1]) < APART - 1 or np.min(weights[:m]) < LEAST:
        return None
    rows = np.array([driven.row(*sensor) for sensor in chosen(rng, candidates, m)])
    at_sensors = rows @ shapes
    if len(rows) != m or np.linalg.cond(at_sensors[:, :m] / np.linalg.norm(at_sensors[:, :m], axis=0)) > WORST_SHAPES:
        return None
    modes = Modes(
        omega, log_uniform(rng, RATIOS, omega.size), load, at_sensors, rows @ driven.rigid, driven.rigid_body_mass,
    )  # fmt: skip
    lines = float(f[0] * rng.uniform(*START)), float(f[m - 1] + rng.uniform(*END) * (f[m] - f[m - 1]))
    if f[-1] < REACH * lines[1]:
        return None
    return Continuous("", SPECTRA, base, modes, m, lines, float(log_uniform(rng, NOISE)))


def case(number: int) -> dict:
    """Figures of one structure by each search."""
    truth = searched(number)
    test = of_spectra(truth, np.random.default_rng((number, 43)))
    m = test.measurement
    alone = sysid.Measurement(
        m.freq, m.base, m.response, rigid_body=m.rigid_body, response_std=m.response_std, base_axes=m.base_axes
    )
    total = np.diag(truth.modes.rigid_body_mass)
    problem = sysid.Problem(alone, mass=sysid.FullMass(total, healing="rigid_body"))
    return {name: _figures(truth, alone, problem, name) for name in STRATEGIES}


def _figures(truth: Continuous, test: sysid.Measurement, problem: sysid.Problem, strategy: str) -> dict:
    start = time.process_time()
    result = sysid.identify(problem, strategy=strategy, rng=0)
    seconds, s = time.process_time() - start, result.structure
    left = (test.relative - test.predict(s)) / test.response_std
    count = s.n + s.residual.count
    freedom = 2 * left.size - count * (test.n_sensors + 2)
    k = truth.count
    exact = np.concatenate([
        np.log(truth.modes.omega[:k]), np.log(truth.modes.zeta[:k]),
        (truth.modes.shapes[:, :k] * truth.modes.gamma[:k, 0]).ravel(),
    ])  # fmt: skip
    found = np.concatenate([
        np.log(2 * np.pi * s.natural_frequencies), np.log(s.damping_ratios),
        (s.mode_shapes * s.participation[:, 0]).ravel(),
    ])  # fmt: skip
    far = float(np.max(np.abs(found - exact) / deviations(truth, test)))
    chi2 = float(2 * np.sum(np.abs(left) ** 2) / freedom)
    return {"chi2": chi2, "far": far, "residual": s.residual.count, "seconds": seconds, "judgement": result.judgement}


def deviations(truth: Continuous, test: sysid.Measurement) -> np.ndarray:
    """Least deviations of log w, log zeta and R_k, sensor by sensor, of the modes in the lines; one base axis.

    Unknown are their poles and those of the next modes above, all residues at these, and w² E_1: derivatives are
    written out, and the information is ``2 Re(J^H J)`` of rows in units of their noise.
    """
    w, (k, m), n = 2 * np.pi * test.freq, (truth.count, truth.count + POLES), test.n_sensors
    omega, zeta = truth.modes.omega[:m, None], truth.modes.zeta[:m, None]
    den = omega**2 - w**2 + 2j * zeta * omega * w
    g, loss = w**2 / den, 2j * zeta * omega * w
    residues = truth.modes.shapes[:, :m] * truth.modes.gamma[:m, 0]
    by_poles = np.concatenate([-g * (2 * omega**2 + loss) / den, -g * loss / den])
    own = np.concatenate([g, w[None] ** 2 / omega[0] ** 2])
    J = np.zeros((n, test.freq.size, 2 * m + n * (m + 1)), dtype=complex)
    for i in range(n):
        std = test.response_std[0, i] / test.base[0, 0]
        J[i, :, : 2 * m] = (np.tile(residues[i], 2)[:, None] * by_poles / std).T
        J[i, :, 2 * m + i * (m + 1) : 2 * m + (i + 1) * (m + 1)] = (own / std).T
    rows = J.reshape(-1, J.shape[2])
    rows = np.sqrt(2) * np.concatenate([rows.real, rows.imag])
    size = np.linalg.norm(rows, axis=0)
    std = np.sqrt(np.diag(scipy.linalg.inv((rows / size).T @ (rows / size)))) / size
    of_residues = std[2 * m :].reshape(n, m + 1)[:, :k]
    return np.concatenate([std[:k], std[m : m + k], of_residues.ravel()])


if __name__ == "__main__":
    answer(case)
