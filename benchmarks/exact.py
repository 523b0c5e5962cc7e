"""Lines of capability 3 without noise: residual, matrices, and how long it takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.attempt import identified, named
from benchmarks.line import Line, above, below
from benchmarks.random_structures import lines, random_structure
from benchmarks.spread import spread

RESIDUAL, MATRICES = 1e-10, 1e-8
SECONDS = {10: 0.3, 20: 2.0}
TIMED = 10  # structures that a median is taken over


@dataclass(frozen=True)
class Run:
    """What came of one noise-free test; infinite where nothing came.

    Attributes
    ----------
    seed : int
    residual, force_residual : float
        Relative; the force's is zero where none was measured.
    matrices : float
        Largest relative distance of M_SS, K_SS and C from the true ones (Frobenius).
    said : str
        The error, where there was one.
    """

    seed: int
    residual: float = np.inf
    force_residual: float = np.inf
    matrices: float = np.inf
    said: str = ""


def exact(seeds: range, reduced: bool) -> Iterator[Line]:
    """Noise-free tests of random structures: nothing is given but the records."""
    for force in (False, True):
        runs = spread(_run_with_force if force else _run_without_force, seeds)
        what = f"no noise, seeds 0-{seeds[-1]}, {'with' if force else 'no'} base force: "
        residuals = np.array([max(run.residual, run.force_residual) for run in runs])
        yield _share(what + f"runs with relative residual <= {RESIDUAL:g}", runs, residuals, RESIDUAL)
        if force:
            errors = np.array([run.matrices for run in runs])
            yield _share(what + f"runs with M_SS, K_SS and C within {MATRICES:g}", runs, errors, MATRICES)
    yield from timing(
        3 if reduced else TIMED, {"d = 3": 3} if reduced else {"d = 3": 3, "d = 1 to 3": None}, 3 if reduced else 1
    )


def _share(text: str, runs: list[Run], figures: np.ndarray, bound: float) -> Line:
    good = figures <= bound
    ordered = np.sort(figures)
    missed = "; ".join(
        f"seed {run.seed}: {run.said or f'{figure:.1e}'}" for run, figure in zip(runs, figures, strict=True)
        if not figure <= bound
    )  # fmt: skip
    shown = f" (median {ordered[len(ordered) // 2]:.1e}, worst {ordered[-1]:.1e}{'; missed: ' if missed else ''}"
    return above(text + shown + missed + ")", float(np.count_nonzero(good)), len(runs))


def timing(count: int, kinds: dict[str, int | None], repeats: int) -> Iterator[Line]:
    """Wall-clock medians of `Problem` and `identify` together, nothing else running here; by kinds of tests.

    Of each structure the least of so many repeats counts: where others share the machine it says most about the code.
    """
    for n, bound in SECONDS.items():
        medians = {}
        for label, d in kinds.items():
            for force in (False, True):
                tests = [_test(seed, n=n, d=d, force=force) for seed in range(count)]
                with threadpool_limits(limits=1):
                    _seconds(tests[0])  # what is imported at the first call is not counted
                    least = [min(_seconds(test) for _ in range(repeats)) for test in tests]
                    medians[f"{label}, {'with' if force else 'no'} force"] = float(np.median(least))
        shown = "; ".join(f"{label} {value:.2f}" for label, value in medians.items())
        what = f"largest median over {count} structures, least of {repeats}, s"
        text = f"no noise, n = {n}, {60 * n} lines: {what} ({shown})"
        yield below(text, max(medians.values()), bound)


def _seconds(test: sysid.Measurement) -> float:
    begun = time.perf_counter()
    try:
        identified(test)
    except Exception:
        return np.inf  # no answer is not a fast answer
    return time.perf_counter() - begun


def _test(seed: int, *, n: int | None = None, d: int | None = None, force: bool) -> sysid.Measurement:
    structure = random_structure(seed, n=n, d=d)
    return sysid.simulate(structure, lines(structure), force=force)


def _run_with_force(seed: int) -> Run:
    return run(seed, force=True)


def _run_without_force(seed: int) -> Run:
    return run(seed, force=False)


def run(seed: int, *, force: bool) -> Run:
    """Identify one noise-free test."""
    truth = random_structure(seed)
    try:
        result = identified(_test(seed, force=force))
    except Exception as error:  # a crash is an answer too, and must not end the others
        return Run(seed, said=named(error))
    found = result.structure
    if found.n != truth.n:
        return Run(seed, result.residual, result.force_residual or 0.0, said=f"{found.n} modes of {truth.n}")
    return Run(seed, result.residual, result.force_residual or 0.0, distance(found, truth))


def distance(found: sysid.Structure, truth: sysid.Structure) -> float:
    """Largest relative distance of M_SS, K_SS and C (Frobenius)."""
    n = truth.n
    pairs = (
        (found.mass[:n, :n], truth.mass[:n, :n]),
        (found.stiffness[:n, :n], truth.stiffness[:n, :n]),
        (found.damping, truth.damping),
    )
    return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)
