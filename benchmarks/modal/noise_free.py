"""Residual and matrices of noise-free tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import sysid
from benchmarks.line import Line, above
from benchmarks.modal.identification import error_text, identify_records, matrix_distance
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.modal.spread import spread

RESIDUAL, MATRICES = 1e-10, 1e-8


@dataclass(frozen=True)
class Run:
    """Outcome of one noise-free test; infinite where nothing came.

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


def lines(reduced: bool) -> Iterator[Line]:
    """Noise-free tests of random structures: nothing is given but the records."""
    seeds = range(4 if reduced else 100)
    for force in (False, True):
        runs = spread(_run_with_force if force else _run_without_force, seeds)
        what = f"no noise, seeds 0-{seeds[-1]}, {'with' if force else 'no'} base force: "
        residuals = np.array([max(run.residual, run.force_residual) for run in runs])
        yield _share(what + f"runs with relative residual <= {RESIDUAL:g}", runs, residuals, RESIDUAL)
        if force:
            errors = np.array([run.matrices for run in runs])
            yield _share(what + f"runs with M_SS, K_SS and C within {MATRICES:g}", runs, errors, MATRICES)


def _share(text: str, runs: list[Run], figures: np.ndarray, bound: float) -> Line:
    good = figures <= bound
    ordered = np.sort(figures)
    missed = "; ".join(
        f"seed {run.seed}: {run.said or f'{figure:.1e}'}" for run, figure in zip(runs, figures, strict=True)
        if not figure <= bound
    )  # fmt: skip
    shown = f" (median {ordered[len(ordered) // 2]:.1e}, worst {ordered[-1]:.1e}{'; missed: ' if missed else ''}"
    return above(text + shown + missed + ")", float(np.count_nonzero(good)), len(runs))


def _run_with_force(seed: int) -> Run:
    return run(seed, force=True)


def _run_without_force(seed: int) -> Run:
    return run(seed, force=False)


def run(seed: int, *, force: bool) -> Run:
    """Identify one noise-free test."""
    truth = random_structure(seed)
    try:
        result = identify_records(sysid.simulate(truth, frequency_lines(truth), force=force))
    except Exception as error:  # a crash is an answer too, and must not end the others
        return Run(seed, said=error_text(error))
    found = result.structure
    if found.n != truth.n:
        return Run(seed, result.residual, result.force_residual or 0.0, said=f"{found.n} modes of {truth.n}")
    return Run(seed, result.residual, result.force_residual or 0.0, matrix_distance(found, truth))
