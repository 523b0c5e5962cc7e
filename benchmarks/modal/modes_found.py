"""Modes found in noisy tests, and whether a result says so where it is wrong."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.identification import error_text, identify_records
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.modal.spread import spread

COUNTS = 10.0  # a mode counts where its part of the records is so many times the noise
NEAR = 0.5  # of half the half-power bandwidth
DEVIATIONS = 3.0  # or so many of the stated standard deviations: how far a found mode may be from its true one
NO_FLOOR = 1.5  # times the noise floor: a residual above it is no fit
WRONG = 6.0  # standard deviations: an entry of M_SS farther off than that was not known


@dataclass(frozen=True)
class Run:
    """Outcome of one noisy test.

    Attributes
    ----------
    name : str
        Its seed, for the report.
    true, found, counting : int
        Modes of the structure, of the result, and of the structure that count.
    missed : int
        Modes that count and have no partner in the result.
    spurious : int
        Modes of the result that have no partner in the structure.
    certain : int
        Those of them that no sentence of the result puts in doubt by their number.
    nonsense : str
        What is wrong and was not said; empty where nothing is.
    said : str
        The error, where there was no result.
    """

    name: str
    true: int
    found: int = 0
    counting: int = 0
    missed: int = 0
    spurious: int = 0
    certain: int = 0
    nonsense: str = ""
    said: str = ""

    @property
    def right(self) -> bool:
        """Every mode that counts is found, and none that is not there."""
        return not self.said and self.missed == 0 and self.spurious == 0


def lines(reduced: bool) -> Iterator[Line]:
    """Noisy tests of random structures; no frequency and no number of modes is given."""
    seeds, levels = (range(4), (0.01,)) if reduced else (range(100), (0.001, 0.01, 0.03))
    tasks = [(seed, level, force) for level in levels for force in (False, True) for seed in seeds]
    runs = dict(zip(tasks, spread(run, tasks), strict=True))
    for level in levels:
        for force in (False, True):
            mine = [runs[seed, level, force] for seed in seeds]
            what = f"{100 * level:g} % noise, seeds 0-{seeds[-1]}, {'with' if force else 'no'} base force: "
            yield from _lines(what, mine, asked=level == 0.01)


def _lines(what: str, runs: list[Run], asked: bool) -> Iterator[Line]:
    right = sum(run.right for run in runs)
    wrong = [run for run in runs if not run.right]
    text = (
        what + "runs in which every mode that counts (>= 10 x noise) is found and each found mode is a true one; "
        f"weaker ones may be found or not ({_list(wrong)})"
    )
    # Of fewer seeds than a hundred the same share is asked.
    yield above(text, right, np.floor(0.95 * len(runs))) if asked else Line(text, f"{right} of {len(runs)}")
    shares = [f"{sum(run.found - run.true == k for run in runs)} x {k:+d}" for k in _differences(runs)]
    strict = sum(run.found == run.true for run in runs)
    counting = sum(run.counting for run in runs)
    yield Line(
        what + f"stricter: as many modes found as there are (found - true: {', '.join(shares)}; "
        f"{counting} of {sum(run.true for run in runs)} modes count)",
        f"{strict} of {len(runs)}",
    )
    spurious = [run for run in runs if run.spurious]
    yield Line(what + f"modes found that are none ({_list(spurious)})", str(sum(run.spurious for run in runs)))
    yield below(what + "modes found that are none, reported as certain", sum(run.certain for run in runs), 0)
    nonsense = [f"{run.name}: {run.nonsense}" for run in runs if run.nonsense]
    yield below(what + f"runs that end in nonsense unflagged ({'; '.join(nonsense) or 'none'})", len(nonsense), 0)


def _differences(runs: list[Run]) -> list[int]:
    return sorted({run.found - run.true for run in runs})


def _list(runs: list[Run]) -> str:
    if not runs:
        return "none"
    return "; ".join(
        f"{run.name}: {run.said or f'{run.missed} missed, {run.spurious} spurious of {run.counting}/{run.true}'}"
        for run in runs
    )


def run(task: tuple[int, float, bool]) -> Run:
    """Identify one noisy test: seed, noise, whether the base force is recorded."""
    seed, level, force = task
    truth = random_structure(seed)
    test = sysid.simulate(truth, frequency_lines(truth), noise=level, force=force, rng=seed)
    counts = strength(truth, test) >= COUNTS
    answer = {"name": f"seed {seed}", "true": truth.n, "counting": int(np.count_nonzero(counts))}
    try:
        result = identify_records(test)
        partner = partners(result, truth, counts)
        return Run(
            **answer,
            found=result.structure.n,
            missed=int(np.count_nonzero(counts & ~np.isin(np.arange(truth.n), partner))),
            spurious=int(np.count_nonzero(partner < 0)),
            certain=sum(not _doubted(result, k) for k in np.flatnonzero(partner < 0).tolist()),
            nonsense=nonsense(result, truth),
        )
    except Exception as error:  # a crash is an answer too, and must not end the others
        return Run(**answer, missed=answer["counting"], said=error_text(error))


def _doubted(result: sysid.Identification, k: int) -> bool:
    """True where a sentence about what is not known names mode k, counted from 0."""
    return any(f"mode {k + 1} (" in sentence for sentence in result.undetermined)


def strength(truth: sysid.Structure, test: sysid.Measurement) -> np.ndarray:
    """``‖R_k g_k‖`` over runs, sensors and lines against the norm of the noise that was laid on them, (n,)."""
    assert test.response_std is not None
    w, omega = 2 * np.pi * test.freq, 2 * np.pi * truth.natural_frequencies[:, None]
    g = w**2 / (omega**2 - w**2 + 2j * truth.damping_ratios[:, None] * omega * w)
    push = np.einsum("kd,rdf->rkf", truth.participation, test.base) * g
    size = np.linalg.norm(truth.mode_shapes, axis=0) * np.linalg.norm(push, axis=(0, 2))
    return size / np.linalg.norm(test.response_std)


def partners(result: sysid.Identification, truth: sysid.Structure, counts: np.ndarray) -> np.ndarray:
    """Number of the true mode that each found mode stands for, one to one; -1 for none, (m,).

    Of all ways to pair them the one that leaves the fewest counting modes alone is taken, then
    the one that pairs most, then the closest.
    """
    f, found = truth.natural_frequencies, result.structure.natural_frequencies
    near = NEAR * truth.damping_ratios * f
    std = np.nan_to_num(result.uncertainty.natural_frequencies, nan=0.0, posinf=0.0)
    allowed = np.maximum(near, DEVIATIONS * std[:, None])
    off = np.abs(found[:, None] - f) / allowed
    cost = np.where(off < 1, off - 1e3 - 1e3 * counts, 0.0)
    rows, columns = linear_sum_assignment(cost)
    partner = np.full(found.size, -1)
    partner[rows] = np.where(off[rows, columns] < 1, columns, -1)
    return partner


def nonsense(result: sysid.Identification, truth: sysid.Structure) -> str:
    """Claim of a result that is not so; empty where there is none."""
    test, n = result.measurement, truth.n
    claims = []
    floor = test.residual(truth)
    if result.success and result.residual > NO_FLOOR * floor:
        claims.append(f"success at {result.residual / floor:.3g} noise floors")
    if result.determined and result.structure.n != n:
        claims.append(f"determined with {result.structure.n} modes of {n}")
    elif result.determined:
        error = np.abs(result.structure.mass[:n, :n] - truth.mass[:n, :n])
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            off = error / result.uncertainty.mass
        # An entry without a number is no claim.
        worst = float(np.nanmax(off, initial=0.0))
        if worst > WRONG:
            claims.append(f"determined with M_SS wrong by {worst:.3g} of its standard deviations")
    return ", ".join(claims)
