"""Random structures at the ends of what occurs: no silent wrong answer, and determined where the records can tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.cramer_rao import cramer_rao
from benchmarks.modal.spread import spread

SEEDS = range(7000, 8000)
KINDS = ("plain", "light", "pair", "wide")
LIGHT = (-8.0, -3.0)  # decades of the least eigenvalue of M over the others
APART = (-9.0, -3.0)  # decades of the relative distance of a pair of frequencies
WIDE = (1.5, 3.0)  # decades of the last frequency over the first: stiffnesses have twice as many
UNIT = (-6.0, 6.0)  # decades of kg
NOISE = (-3.5, -1.7)  # decades, of the records' root mean square
WRONG, OFF = 5.0, 0.01  # stated deviations, and part of an entry's size, beyond which an entry is wrong
KNOWN = 0.01  # Cramér-Rao deviation, as part of an entry's size, below which the matrices should be determined
SHARE = 0.95


class End(NamedTuple):
    """How one identification ended: its verdict, and whether the records can tell all entries within 1 %."""

    verdict: str
    known: bool


def lines(reduced: bool) -> Iterator[Line]:
    """Verdicts of full structures with base force, noise stated, half of them with lines on all resonances."""
    seeds = SEEDS[:40] if reduced else SEEDS
    ends = spread(one, seeds)
    found = Counter(end.verdict for end in ends)
    told = ", ".join(f"{verdict} {count}" for verdict, count in found.most_common())
    yield below(f"{len(seeds)} structures: called determined and wrong ({told})", found["wrong"], 0)
    known = [end for end in ends if end.known]
    share = sum(end.verdict in ("right", "wrong") for end in known) / max(len(known), 1)
    text = f"share determined of the {len(known)} whose Cramér-Rao deviations are below 1 %"
    yield Line(text, f"{share:.4g}") if reduced else above(text, share, SHARE)
    yield below("errors that are none of ours", found["foreign error"], 0)


def one(seed: int) -> End:
    """Identify one structure."""
    rng = np.random.default_rng(seed)
    truth = extreme_structure(rng)
    f = truth.natural_frequencies
    freq = np.geomspace(0.4 * f[0], 1.5 * f[-1], int(rng.integers(100, 500)))
    if rng.random() < 0.5:
        freq = np.unique(np.concatenate([freq, f]))
    test = sysid.simulate(truth, freq, noise=10 ** rng.uniform(*NOISE), force=True, rng=rng)
    known = _records_tell(truth, test)
    try:
        result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    except sysid.SysidError:
        return End("refused", known)
    except Exception:  # what this looks for
        return End("foreign error", known)
    if not result.success:
        return End("no success", known)
    if not result.determined:
        return End("not determined", known)
    return End("right" if _is_right(result, truth) else "wrong", known)


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
    """Whether no entry of M_SS, K_SS and C has a Cramér-Rao deviation above a hundredth of its size."""
    try:
        bound = cramer_rao(truth, test)
    except np.linalg.LinAlgError:  # modes that the records cannot tell apart
        return False
    pairs = zip((bound.mass, bound.stiffness, bound.damping), _matrices(truth), strict=True)
    return all(bool(np.all(std <= KNOWN * _size(matrix))) for std, matrix in pairs)


def _is_right(result: sysid.Identification, truth: sysid.Structure) -> bool:
    u = result.uncertainty
    stds = u.mass, u.stiffness, u.damping
    for std, found, true in zip(stds, _matrices(result.structure), _matrices(truth), strict=True):
        if found.shape != true.shape:
            return False
        off = np.abs(found - true)
        if np.any((off > WRONG * std) & (off > OFF * _size(true))):
            return False
    return True


def _matrices(s: sysid.Structure) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return s.mass[: s.n, : s.n], s.stiffness[: s.n, : s.n], s.damping
