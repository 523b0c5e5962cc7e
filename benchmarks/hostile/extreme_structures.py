"""Random structures at the ends of what occurs: no silent wrong answer, and determined where the records can tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.stats import binom

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.cramer_rao import cramer_rao
from benchmarks.modal.spread import spread

SEEDS = range(7000, 8000)
CASES = ("full", "holes", "spikes", "chain", "written")  # all but the first with a tenth of the seeds
HOLES, SPIKES = 0.1, 0.015  # shares of lines that are NaN somewhere, and of numbers that are far off
SPIKE = (20.0, 100.0)  # deviations
KINDS = ("plain", "light", "pair", "wide")
LIGHT = (-8.0, -3.0)  # decades of the least eigenvalue of M over the others
APART = (-9.0, -3.0)  # decades of the relative distance of a pair of frequencies
WIDE = (1.5, 3.0)  # decades of the last frequency over the first: stiffnesses have twice as many
UNIT = (-6.0, 6.0)  # decades of kg
NOISE = (-3.5, -1.7)  # decades, of the records' root mean square
WRONG, OFF = 5.0, 0.01  # stated deviations, and part of an entry's size, beyond which an entry is wrong
KNOWN = 0.01  # Cramér-Rao deviation, as part of an entry's size, below which the matrices should be determined
SHARE = 0.95
CHANCE = 1e-3  # that so few of a few structures are called determined, where 95 % of all are


class End(NamedTuple):
    """End of one identification: its verdict, and whether the records can tell all entries within 1 %."""

    verdict: str
    known: bool


def lines(reduced: bool) -> Iterator[Line]:
    """Verdicts of random structures, noise stated, half of them with lines on all resonances, case by case."""
    shares = {case: (1 if case == CASES[0] else 10) * (100 if reduced else 1) for case in CASES}
    tasks = [(seed, case) for case in CASES for seed in SEEDS[: len(SEEDS) // shares[case]]]
    all_ends = spread(one, tasks)
    for case in CASES:
        ends = [end for task, end in zip(tasks, all_ends, strict=True) if task[1] == case]
        found = Counter(end.verdict for end in ends)
        told = ", ".join(f"{verdict} {count}" for verdict, count in found.most_common())
        yield below(f"{case}: {len(ends)} structures: called determined and wrong ({told})", found["wrong"], 0)
        if not reduced:
            yield _share(case, ends, SHARE)
        yield below(f"{case}: errors that are none of ours", found["foreign error"], 0)
    if reduced:  # a case alone has too few to judge
        known = sum(end.known for end in all_ends)
        yield _share("all", all_ends, float(binom.ppf(CHANCE, known, SHARE)) / known)


def _share(case: str, ends: list[End], least: float) -> Line:
    """Share of determined answers among those that the records tell."""
    known = [end for end in ends if end.known]
    share = sum(end.verdict in ("right", "wrong") for end in known) / max(len(known), 1)
    return above(
        f"{case}: share determined of the {len(known)} whose Cramér-Rao deviations are below 1 %", share, least
    )


def one(task: tuple[int, str]) -> End:
    """Identify one structure in one of the cases."""
    seed, case = task
    rng = np.random.default_rng(seed)
    truth = extreme_structure(rng) if case in ("full", "holes", "spikes") else extreme_chain(rng)
    f = truth.natural_frequencies
    freq = np.geomspace(0.4 * f[0], 1.5 * f[-1], int(rng.integers(100, 500)))
    if rng.random() < 0.5:
        freq = np.unique(np.concatenate([freq, f]))
    test = sysid.simulate(truth, freq, noise=10 ** rng.uniform(*NOISE), force=True, rng=rng)
    known = _records_tell(truth, test)
    try:
        result = sysid.identify(_problem(case, truth, test, rng), rng=0)
    except sysid.SysidError:
        return End("refused", known)
    except Exception:  # what this looks for
        return End("foreign error", known)
    if not result.success:
        return End("no success", known)
    if not result.determined:
        return End("not determined", known)
    return End("right" if _is_right(result, truth) else "wrong", known)


def _problem(case: str, truth: sysid.Structure, test: sysid.Measurement, rng: np.random.Generator) -> sysid.Problem:
    """The case's problem: records with holes or spikes for a full mass, and models with a form of their own."""
    if case == "holes":
        response = np.where(rng.random(test.freq.size) < HOLES, np.nan, test.response)
        return sysid.Problem(replace(test, response=response, missing="drop"), mass=sysid.FullMass())
    if case == "spikes":
        return sysid.Problem(_spoiled(test, rng), mass=sysid.FullMass(), loss="huber")
    if case == "full":
        return sysid.Problem(test, mass=sysid.FullMass())
    springs, n = -np.diag(truth.stiffness, 1)[: truth.n - 1], truth.n
    springs = np.append(springs, -truth.stiffness[0, -1])
    low, high = 0.3 * springs.min(), 3 * springs.max()
    if case == "chain":
        mass = sysid.LumpedMass(float(np.trace(truth.mass)))
        return sysid.Problem(test, mass=mass, stiffness=sysid.ChainStiffness(low, high))
    k = sysid.Variable("spring", n, lower=low, upper=high, log=True)
    T = np.hstack([np.eye(n) - np.eye(n, k=-1), -np.eye(n)[:, :1]])
    zeta = sysid.Variable("damping ratio", n, lower=1e-4, upper=0.2, log=True)
    return sysid.Problem(test, mass=truth.mass, stiffness=T.T @ ca.diag(k) @ T, damping=zeta)


def _spoiled(test: sysid.Measurement, rng: np.random.Generator) -> sysid.Measurement:
    """Some numbers of the response and of the force far off, each by itself."""
    changed = {}
    for name in ("response", "force"):
        record, std = getattr(test, name), getattr(test, f"{name}_std")
        hit = rng.random(record.shape) < SPIKES
        turn = np.exp(2j * np.pi * rng.random(record.shape))
        changed[name] = record + hit * rng.uniform(*SPIKE, record.shape) * std * turn
    return replace(test, **changed)


def extreme_chain(rng: np.random.Generator) -> sysid.Structure:
    """2 to 4 lumped masses on springs in series, both over a decade."""
    n, unit = int(rng.integers(2, 5)), 10 ** rng.uniform(*UNIT)
    T = np.hstack([np.eye(n) - np.eye(n, k=-1), -np.eye(n)[:, :1]])
    springs = 10 ** rng.uniform(3, 4, n) * 10 ** rng.uniform(-2, 6)
    mass = np.append(10 ** rng.uniform(0, 1, n), 0.0)
    both = unit * np.diag(mass), unit * (T.T * springs) @ T
    return sysid.Structure(*both, rng.uniform(0.003, 0.05, n), n_base=1)


def extreme_structure(rng: np.random.Generator) -> sysid.Structure:
    """2 to 7 degrees of freedom, 1 to 3 base directions, full mass and stiffness, of one of the kinds."""
    n = int(rng.integers(2, 8))
    d, kind = min(int(rng.integers(1, 4)), n), KINDS[rng.integers(len(KINDS))]
    eigenvalues = rng.uniform(0.5, 3, n)
    if kind == "light":
        eigenvalues[0] = 10 ** rng.uniform(*LIGHT)
    decades = rng.uniform(*WIDE) if kind == "wide" else rng.uniform(0.3, 1.3)
    f = np.sort(10 ** rng.uniform(0, decades, n)) * 10 ** rng.uniform(-1, 3)
    if kind == "pair":
        i = int(rng.integers(n - 1))
        f[i + 1] = f[i] * (1 + 10 ** rng.uniform(*APART))
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    M = (Q * eigenvalues) @ Q.T
    half = np.linalg.cholesky(M) @ np.linalg.qr(rng.normal(size=(n, n)))[0]
    K = (half * (2 * np.pi * f) ** 2) @ half.T
    G = np.eye(d)[rng.permutation(np.concatenate([np.arange(d), rng.integers(d, size=n - d)]))]
    M_S0, w = 0.2 * rng.normal(size=(n, d)), rng.normal(size=(d, d))
    M_00 = M_S0.T @ np.linalg.solve(M, M_S0) + w @ w.T + 0.2 * np.eye(d)
    mass = np.block([[M, M_S0], [M_S0.T, M_00]])
    stiffness = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    unit = 10 ** rng.uniform(*UNIT)
    both = [unit * (part + part.T) / 2 for part in (mass, stiffness)]
    return sysid.Structure(*both, rng.uniform(0.003, 0.05, n), n_base=d)


def _size(matrix: np.ndarray) -> np.ndarray:
    return np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))


def _records_tell(truth: sysid.Structure, test: sysid.Measurement) -> bool:
    """True where no entry of M_SS, K_SS and C has a Cramér-Rao deviation above a hundredth of its size."""
    try:
        bound = cramer_rao(truth, test)
    except np.linalg.LinAlgError:  # modes that the records cannot tell apart
        return False
    pairs = zip((bound.mass, bound.stiffness, bound.damping), _matrices(truth), strict=True)
    return all(bool(np.all(std <= KNOWN * _size(matrix))) for std, matrix in pairs)


def _is_right(result: sysid.Identification, truth: sysid.Structure) -> bool:
    if not result.structure.at_sensors:  # with modal coordinates: no entries of the truth's matrices
        return result.structure.n <= truth.n and _answers_alike(result, truth)
    u = result.uncertainty
    stds = u.mass, u.stiffness, u.damping
    for std, found, true in zip(stds, _matrices(result.structure), _matrices(truth), strict=True):
        off = np.abs(found - true)
        if np.any((off > WRONG * std) & (off > OFF * _size(true))):
            return False
    return True


def _answers_alike(result: sysid.Identification, truth: sysid.Structure) -> bool:
    """The base-driven answer within the same limits."""
    freq, u, found = result.measurement.freq, result.uncertainty, result.structure
    pairs = (
        (found.transmissibility(freq), truth.transmissibility(freq), u.transmissibility(freq)),
        (found.base_force(freq), truth.base_force(freq), u.base_force(freq)),
    )
    off = [(np.abs(mine - right), std, np.abs(right).max(axis=-1, keepdims=True)) for mine, right, std in pairs]
    return not any(np.any((gap > WRONG * std) & (gap > OFF * size)) for gap, std, size in off)


def _matrices(s: sysid.Structure) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return s.mass[: s.n, : s.n], s.stiffness[: s.n, : s.n], s.damping
