"""Structures without modes above the lines: what the freedom of residual modes costs their matrices, draw by draw.

Each noisy test of a random structure, whose modes are all in the lines, is identified three times: by its records
alone, which may ask for residual modes; told that there are none, by an entry of the mass that is known to no more than
`LOOSE` times itself, as stated entries are of as many modes as sensors; and by an older commit, which had none.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.older import COMMIT, answer_cases, workers

STRUCTURES, DRAWS = range(8), 5
SHORT, SHORT_DRAWS = (1, 6), 2
NOISE, LOOSE = 0.01, 1e3
LOSS = 1.05  # rms errors over those of an answer without residual modes
MATRICES = ("mass", "stiffness", "damping")


def lines(reduced: bool) -> Iterator[Line]:
    """Five draws of each of eight structures; or two of two."""
    structures, draws = (SHORT, SHORT_DRAWS) if reduced else (STRUCTURES, DRAWS)
    tasks = [(seed, number) for seed in structures for number in range(draws)]
    with workers(Path(__file__)) as both:
        if not both:
            yield Line(f"errors beside those of {COMMIT}", f"no git history with {COMMIT} here")
            return
        today, older = both
        found = {
            "free": [today((*task, False)) for task in tasks],
            "told that there are none": [today((*task, True)) for task in tasks],
            f"of {COMMIT}": [older((*task, False)) for task in tasks],
        }
    what = f"{len(structures)} structures without modes above the lines x {draws} draws: "
    free = found.pop("free")
    for name, other in found.items():
        missed = [sum(not answer for answer in answers) for answers in (free, other)]
        text = what + f"without as many modes as there are, and of answers {name}"
        yield Line(text, f"{missed[0]}, {missed[1]}", f"<= {missed[1]}", missed[0] <= missed[1])
        for k, matrix in enumerate(MATRICES):
            ratios = paired_ratios(tasks, free, other, k)
            if not ratios:
                yield Line(what + f"{matrix}, answers {name}", "none to compare", "", False)
                continue
            worst = max(ratios, key=lambda seed: ratios[seed])
            text = f"rms error of {matrix} over that of answers {name} (most: structure {worst}, {ratios[worst]:.3f})"
            yield below(what + text, float(np.sqrt(np.mean(np.square([*ratios.values()])))), LOSS)


def paired_ratios(
    tasks: list[tuple[int, int]], free: list[list[float]], other: list[list[float]], of: int
) -> dict[int, float]:
    """Rms errors of one matrix over those of other answers, by structure, over draws where both have all modes."""
    ratios = {}
    for seed in dict(tasks):
        pairs = [(a[of], b[of]) for (at, _), a, b in zip(tasks, free, other, strict=True) if at == seed and a and b]
        if pairs:
            squares = np.sum(np.square(pairs), axis=0)
            ratios[seed] = float(np.sqrt(squares[0] / squares[1]))
    return ratios


def answer(seed: int, number: int, told: bool) -> list[float]:
    """Relative errors (Frobenius) of M_SS, K_SS and C in one draw of a test; empty where modes are not all there."""
    truth = random_structure(seed)
    n, rng = truth.n, np.random.default_rng((seed, number))
    test = sysid.simulate(truth, frequency_lines(truth), noise=NOISE, force=True, rng=rng)
    known = np.full((n, n), np.nan)
    known[0, 0] = truth.mass[0, 0]
    mass = sysid.FullMass(known=known, known_std=LOOSE * truth.mass[0, 0]) if told else sysid.FullMass()
    try:
        found = sysid.identify(sysid.Problem(test, mass=mass), strategy="modal").structure
    except (sysid.InputError, sysid.SolverError):
        return []
    if found.n != n:
        return []
    pairs = ((getattr(found, name)[:n, :n], getattr(truth, name)[:n, :n]) for name in MATRICES)
    return [float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs]


if __name__ == "__main__":
    answer_cases(answer)
