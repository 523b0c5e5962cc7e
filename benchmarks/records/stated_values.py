"""Stated masses beside noisy records: whether true ones help, whether intervals hold, whether wrong ones are told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.stats import poisson

import sysid
from benchmarks.line import Line, below
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.modal.spread import spread

NOISE, LEVEL = 0.01, 0.95
ORDER = [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)]
COUNTS = (3, 4, 5, 6)
DEVIATION = 0.003  # of the root of two diagonals
RISE, COVERAGE = 1.05, (0.93, 0.97)
FEW = (0.75, 1.25)  # rms of errors over stated deviations of 10 draws, which scatters by 0.1; too few for a coverage
WRONG = 8.0  # combined deviations
STRUCTURES = (1, 2, 3, 5)  # seeds of structures that three weighed masses determine
ACCUSED = 1e-3
QUANTITIES = ("natural_frequencies", "damping_ratios", "mass", "stiffness", "damping")


@dataclass(frozen=True)
class Draw:
    """One noisy test with all numbers of statements.

    Attributes
    ----------
    structure : int
        Seed.
    errors : dict
        A number of exact statements: relative squared errors of M_SS and K_SS together.
    held : dict
        "exact" or "with deviations": how many intervals hold the truth, how many there are, and the sum of the squares
        of all errors over their stated deviations.
    accused, statements : int
        Results that call right statements contradictory, and results.
    told, named : bool
        Whether a wrong statement was, and by its name.
    """

    structure: int
    errors: dict[int, float]
    held: dict[str, tuple[int, int, float]]
    accused: int
    statements: int
    told: bool
    named: bool


def lines(reduced: bool) -> Iterator[Line]:
    """Paired draws over some structures; only the worst figures are held to bounds."""
    count = 10 if reduced else 200
    structures = STRUCTURES[:2] if reduced else STRUCTURES
    answers = spread(draw, [(structures[number % len(structures)], number) for number in range(count)])
    what = f"{count} paired draws of full 3 x 3 masses, 1 % noise, no force: "
    rises = {}
    for seed in structures:
        rms = [np.sqrt(np.mean([a.errors[c] for a in answers if a.structure == seed])) for c in COUNTS]
        rises[seed] = max(after / before for before, after in pairwise(rms))
    told = "; ".join(f"{c} entries {100 * np.sqrt(np.mean([a.errors[c] for a in answers])):.2g} %" for c in COUNTS)
    yield below(
        what + f"worst rise of the rms error of M_SS and K_SS with one entry more ({told})", max(rises.values()), RISE
    )
    for kind in ("exact", "with deviations"):
        held, all_, squares = np.sum([a.held[kind] for a in answers], axis=0)
        if reduced:
            rms = float(np.sqrt(squares / all_))
            text = what + f"rms of {all_:.0f} errors over their stated deviations, statements {kind}"
            yield Line(text, f"{rms:.4f}", f"{FEW[0]:g} to {FEW[1]:g}", FEW[0] <= rms <= FEW[1])
            continue
        text = what + f"share of 95 % intervals that hold the truth, statements {kind}"
        met = bool(COVERAGE[0] <= held / all_ <= COVERAGE[1])
        yield Line(text, f"{held / all_:.4f} of {all_:.0f}", "0.93 to 0.97", met)
    wrong = sum(a.told for a in answers)
    yield Line(
        what + f"an entry of six wrong by {WRONG:g} combined deviations is told (by its name, alone or among others, "
        f"{sum(a.named for a in answers)})",
        f"{wrong} of {count}", f"{count} of {count}", wrong == count,
    )  # fmt: skip
    accused = sum(a.accused > 0 for a in answers)
    # Results of one draw share its noise; so many draws chance passes once in a hundred such benchmarks at most.
    most = int(poisson.ppf(0.99, ACCUSED * sum(a.statements for a in answers)))
    text = what + f"draws that call right statements contradictory in any of their {answers[0].statements} results"
    yield Line(text, f"{accused} of {count}", f"<= {most}", accused <= most)


@cache
def _truth(seed: int) -> sysid.Structure:
    return random_structure(seed, n=3, d=1)


def draw(task: tuple[int, int]) -> Draw:
    """Identify one noisy test with three to six right entries, and with a wrong one."""
    seed, number = task
    truth = _truth(seed)
    test = sysid.simulate(truth, frequency_lines(truth), noise=NOISE, rng=number)
    rng = np.random.default_rng([seed, number])
    size = np.sqrt(np.diag(truth.mass)[:3])
    std = DEVIATION * np.outer(size, size)
    scatter = np.triu(rng.standard_normal((3, 3)))
    scatter = std * (scatter + np.triu(scatter, 1).T)
    errors: dict[int, float] = {}
    held, accused = {"exact": (0, 0, 0.0), "with deviations": (0, 0, 0.0)}, 0
    for count in COUNTS:
        for kind, off, given in (("exact", 0.0, None), ("with deviations", scatter, std)):
            found = _identified(test, _known(truth, count) + off, given)
            accused += _contradicted(found) != ""
            held[kind] = tuple(np.add(held[kind], _held(truth, found)))  # type: ignore[assignment]
            if kind == "exact":
                errors[count] = _squared_error(truth, found)
    told, named = _wrong(test, truth, rng, scatter, std)
    return Draw(seed, errors, held, accused, 2 * len(COUNTS), told, named)


def _wrong(
    test: sysid.Measurement, truth: sysid.Structure, rng: np.random.Generator, scatter: np.ndarray, std: np.ndarray
) -> tuple[bool, bool]:
    """True where a wrong entry among six is told, and where by its name; the five others tell what it must be."""
    i, j = ORDER[rng.integers(len(ORDER))]
    known = _known(truth, 6) + scatter
    others = known.copy()
    others[i, j] = others[j, i] = np.nan
    without = _identified(test, others, std)
    off = WRONG * np.hypot(std[i, j], without.uncertainty.mass[i, j]) * (1 if i == j else rng.choice([-1, 1]))
    known[i, j] = known[j, i] = truth.mass[i, j] + off
    said = _contradicted(_identified(test, known, std))
    return said != "", f"row sensor {i + 1}, column sensor {j + 1} is" in said


def _identified(test: sysid.Measurement, known: np.ndarray, std: np.ndarray | None) -> sysid.Identification:
    mass = sysid.FullMass(known=known, known_std=None if std is None else np.where(np.isnan(known), np.nan, std))
    return sysid.identify(sysid.Problem(test, mass=mass), strategy="modal")


def _known(truth: sysid.Structure, count: int) -> np.ndarray:
    known = np.full((3, 3), np.nan)
    for i, j in ORDER[:count]:
        known[i, j] = known[j, i] = truth.mass[i, j]
    return known


def _contradicted(found: sysid.Identification) -> str:
    return " ".join(map(str, found.of_kind("stated masses")))


def _squared_error(truth: sysid.Structure, found: sysid.Identification) -> float:
    pairs = [(getattr(found.structure, name)[:3, :3], getattr(truth, name)[:3, :3]) for name in ("mass", "stiffness")]
    return float(sum(np.linalg.norm(a - b) ** 2 / np.linalg.norm(b) ** 2 for a, b in pairs))


def _held(truth: sysid.Structure, found: sysid.Identification) -> tuple[int, int, float]:
    """Intervals that hold the truth, all, and squares of errors over deviations; exact entries have none."""
    inside = total = 0
    squares = 0.0
    u = found.uncertainty
    for name in QUANTITIES:
        low, high = u.interval(name, LEVEL)
        std, own, value = getattr(u, name), np.asarray(getattr(truth, name)), getattr(found.structure, name)
        own, value = (it[:3, :3] if it.ndim == 2 else it for it in (own, value))
        counts = std > 1e-9 * np.abs(own).max()
        if own.ndim == 2:
            counts &= np.triu(np.ones(own.shape, dtype=bool))
        inside += int(np.sum(((low <= own) & (own <= high))[counts]))
        total += int(np.sum(counts))
        squares += float(np.sum(((value - own)[counts] / std[counts]) ** 2))
    return inside, total, squares
