"""Errors of noisy tests against the Cramér-Rao bound, and whether 95 % intervals hold the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.stats import chi2

import sysid
from benchmarks.line import Line, below
from benchmarks.modal.cramer_rao import CramerRao, cramer_rao, unknowns_of
from benchmarks.modal.identification import error_text, identify_records
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.modal.spread import spread

NOISE, LEVEL = 0.01, 0.95
RATIO, POOLED, EACH = 1.2, (0.93, 0.97), (0.90, 0.99)
CHANCE = 1e-3  # that a few right draws pass the bound on chi², on either side
STATED = (0.95, 1.05)  # stated deviations over those of the bound, geometric mean of a kind in one draw
KINDS = {
    "natural_frequencies": "frequencies",
    "damping_ratios": "damping ratios",
    "mass": "entries of M_SS",
    "stiffness": "entries of K_SS",
    "damping": "entries of C",
    "effective_masses": "effective masses",
}


@dataclass(frozen=True)
class Draw:
    """One noisy test.

    Attributes
    ----------
    structure : int
        Seed of the structure.
    found : int
        Modes found; the rest stays empty where they are not all.
    squared : dict
        Squared Frobenius errors of M_SS and K_SS.
    held : dict
        A kind of quantity: how many of its intervals hold the truth, and how many there are.
    stated : dict
        A kind of quantity: geometric mean of its stated deviations over those of the bound.
    chi_square : float
        Of the errors of the modal unknowns, by the covariance of the bound.
    said : str
        The error, where there was one.
    """

    structure: int
    found: int = 0
    squared: dict[str, float] = field(default_factory=dict)
    held: dict[str, tuple[int, int]] = field(default_factory=dict)
    stated: dict[str, float] = field(default_factory=dict)
    chi_square: float = np.nan
    said: str = ""


def lines(reduced: bool) -> Iterator[Line]:
    """RMS errors and coverage over noise draws of some structures; of few, chi² of all unknowns and what is stated."""
    structures, draws = (range(9, 10), 6) if reduced else (range(10), 200)
    answers = spread(draw, [(seed, number) for seed in structures for number in range(draws)])
    what = f"1 % noise, base force, {len(structures)} structures x {draws} draws: "
    complete = [a for a in answers if a.held]
    yield _left_out(what, answers, structures)
    if not complete:
        yield Line(what + "nothing to compare", "no complete draw", "", False)
        return
    if reduced:  # one structure whose modes stand well apart: errors are in proportion to the noise
        yield _chi_square(what, complete)
        yield from _stated(what, complete)
    else:
        yield from _errors(what, complete, structures)
        yield from _coverages(what, complete)


def _left_out(what: str, answers: list[Draw], structures: range) -> Line:
    missing = []
    for seed in structures:
        reasons = [a.said or f"{a.found} modes" for a in answers if a.structure == seed and not a.held]
        if reasons:
            missing.append(f"structure {seed}, n = {random_structure(seed).n}: {_tally(reasons)}")
    return Line(
        what + f"draws without a result of all n modes, left out of what follows ({'; '.join(missing) or 'none'})",
        f"{sum(not a.held for a in answers)} of {len(answers)}",
    )


def _chi_square(what: str, complete: list[Draw]) -> Line:
    """Errors of all modal unknowns, whitened by the bound: chi² with one degree of freedom each."""
    count = sum(_setting(a.structure)[2].covariance.shape[0] for a in complete)
    ratio = sum(a.chi_square for a in complete) / count
    low, high = chi2.ppf([CHANCE, 1 - CHANCE], count) / count
    text = what + f"chi² of the errors of all {count} modal unknowns, by the Cramér-Rao covariance, over their number"
    return Line(text, f"{ratio:.4f}", f"{low:.2f} to {high:.2f}", bool(low <= ratio <= high))


def _stated(what: str, complete: list[Draw]) -> Iterator[Line]:
    """Stated deviations over those of the bound, the least and the largest draw of each kind."""
    for name, label in KINDS.items():
        ratios = [a.stated[name] for a in complete]
        yield Line(
            what + f"stated deviations over the Cramér-Rao bound's, {label}, least and largest mean of a draw",
            f"{min(ratios):.4f}, {max(ratios):.4f}", f"{STATED[0]:g} to {STATED[1]:g}",
            bool(STATED[0] <= min(ratios) and max(ratios) <= STATED[1]),
        )  # fmt: skip


def _errors(what: str, complete: list[Draw], structures: range) -> Iterator[Line]:
    for name, label in (("mass", "M_SS"), ("stiffness", "K_SS")):
        ratios = {}
        for seed in structures:
            squared = [a.squared[name] for a in complete if a.structure == seed]
            if squared:
                least = float(np.linalg.norm(getattr(_setting(seed)[2], name)))
                ratios[seed] = np.sqrt(np.mean(squared)) / least
        text = what + f"largest ratio of rms error to the Cramér-Rao bound, {label} (" + ", ".join(
            f"{seed}: {ratio:.3f} of {100 * _relative_bound(seed, name):.2g} %" for seed, ratio in ratios.items()
        ) + ")"  # fmt: skip
        yield below(text, float(max(ratios.values())), RATIO)


def _coverages(what: str, complete: list[Draw]) -> Iterator[Line]:
    text = what + "share of 95 % intervals that hold the truth, "
    yield _coverage(text + "pooled", _share(complete, [*KINDS]), POOLED)
    for name, label in KINDS.items():
        yield _coverage(text + label, _share(complete, [name]), EACH)
    products = _share(complete, ["effective_mass_products"])
    yield Line(what + "the same for the products of two participations (off the diagonals)", f"{products:.4f}")
    lowest = {
        (seed, label): _share([a for a in complete if a.structure == seed], [name])
        for seed in {a.structure for a in complete}
        for name, label in KINDS.items()
    }
    worst_at = min(lowest, key=lambda key: lowest[key])
    yield Line(
        what + f"lowest share of one kind in one structure (structure {worst_at[0]}, {worst_at[1]})",
        f"{lowest[worst_at]:.4f}",
    )


def _tally(reasons: list[str]) -> str:
    return ", ".join(f"{reasons.count(reason)} x {reason}" for reason in sorted(set(reasons)))


def _coverage(text: str, share: float, bounds: tuple[float, float]) -> Line:
    return Line(text, f"{share:.4f}", f"{bounds[0]:.2f} to {bounds[1]:.2f}", bounds[0] <= share <= bounds[1])


def _share(answers: list[Draw], names: list[str]) -> float:
    held = np.sum([a.held[name] for a in answers for name in names], axis=0)
    return float(held[0] / held[1]) if held[1] else np.nan


def _relative_bound(seed: int, name: str) -> float:
    truth, _, best = _setting(seed)
    n = truth.n
    return float(np.linalg.norm(getattr(best, name)) / np.linalg.norm(getattr(truth, name)[:n, :n]))


@cache
def _setting(seed: int) -> tuple[sysid.Structure, np.ndarray, CramerRao]:
    """Structure, lines, and the bound in its test; the noise's standard deviation is the same in every draw."""
    truth = random_structure(seed)
    freq = frequency_lines(truth)
    return truth, freq, cramer_rao(truth, sysid.simulate(truth, freq, noise=NOISE, force=True, rng=0))


def draw(task: tuple[int, int]) -> Draw:
    """One draw of the noise on the test of one structure: seed of the structure, number of the draw."""
    try:
        return _draw(*task)
    except Exception as error:  # a crash is an answer too, and must not end the others
        return Draw(task[0], said=error_text(error))


def _draw(seed: int, number: int) -> Draw:
    truth = random_structure(seed)
    n, d = truth.n, truth.n_base
    rng = np.random.default_rng((seed, number))
    test = sysid.simulate(truth, frequency_lines(truth), noise=NOISE, force=True, rng=rng)
    result = identify_records(test)
    found = result.structure
    if found.n != n:
        return Draw(seed, found.n)
    blocks = {name: (getattr(found, name)[:n, :n], getattr(truth, name)[:n, :n]) for name in ("mass", "stiffness")}
    below_diagonal, diagonal = np.tril_indices(n), np.arange(d)
    best = _setting(seed)[2]
    held, stated = {}, {}
    for name in KINDS:
        spreads = [getattr(it, name) for it in (result.uncertainty, best)]
        if name == "effective_masses":
            spreads = [std[:, diagonal, diagonal] for std in spreads]
        elif name in (*blocks, "damping"):
            spreads = [std[:n, :n] for std in spreads]
        stated[name] = float(np.exp(np.mean(np.log(spreads[0] / spreads[1]))))
        low, high = result.uncertainty.interval(name, level=LEVEL)
        exact = getattr(truth, name)
        exact = exact[:n, :n] if name in blocks else exact
        inside = (low <= exact) & (exact <= high)
        if name == "effective_masses":
            held["effective_mass_products"] = _count(inside[:, *np.triu_indices(d, 1)])
            inside = inside[:, diagonal, diagonal]
        elif inside.ndim == 2:
            inside = inside[below_diagonal]  # each entry of a symmetric matrix once
        held[name] = _count(inside)
    squared = {name: float(np.sum((a - b) ** 2)) for name, (a, b) in blocks.items()}
    off = unknowns_of(found, like=truth) - unknowns_of(truth, like=truth)
    return Draw(seed, found.n, squared, held, stated, float(off @ np.linalg.solve(best.covariance, off)))


def _count(inside: np.ndarray) -> tuple[int, int]:
    return int(np.count_nonzero(inside)), int(inside.size)
