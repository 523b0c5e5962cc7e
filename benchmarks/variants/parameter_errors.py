"""Errors of identified unknowns over many draws of the noise, and the same over the Cramér-Rao bound."""

from __future__ import annotations

from types import ModuleType

import numpy as np
from scipy.stats import chi2

import sysid
from benchmarks.line import Line

ABOVE = 1.3  # times the bound
CHANCE = 1e-3  # that a few right draws pass their bound, on either side
NORMAL = np.sqrt(2 / np.pi)  # mean |error| over standard deviation


def relative_errors(
    module: ModuleType, names: tuple[str, ...], true: np.ndarray, noise: float, draws: range
) -> tuple[np.ndarray, int]:
    """Relative errors of a problem module's variables, (draws, unknowns), and how many runs were no success."""
    rows, failed = [], 0
    for seed in draws:
        result = sysid.identify(module.problem(noise=noise, rng=seed), rng=seed)
        failed += not result.success
        rows.append(np.concatenate([np.atleast_1d(result.values[name]) for name in names]) / true - 1)
    return np.array(rows), failed


def mean_percent(errors: np.ndarray) -> np.ndarray:
    """Mean |error| of each draw, %, (draws,)."""
    return 100 * np.abs(errors).mean(axis=1)


def least_percent(bound: np.ndarray) -> float:
    """Mean |error| that the Cramér-Rao bound leaves, %, from relative standard deviations (unknowns,)."""
    return float(100 * NORMAL * bound.mean())


def over_the_bound(errors: np.ndarray, bound: np.ndarray) -> Line:
    """Ratio of errors (draws, unknowns) to the bound (unknowns,), of many draws."""
    median = np.median(mean_percent(errors)) / least_percent(bound)
    ratio = np.sqrt(np.mean((errors / bound) ** 2))
    return Line(
        "  the same over the bound: median of the means; root mean square of all errors",
        f"{median:.3f}; {ratio:.3f}",
        f"<= {ABOVE:g} each",
        bool(max(median, ratio) <= ABOVE),
    )


def whitened(errors: np.ndarray, covariance: np.ndarray) -> Line:
    """Sum of squares of a few draws' errors (draws, unknowns), whitened by the bound's covariance (unknowns, unknowns).

    It follows chi² with one degree of freedom a number, however the errors of one draw hang together.
    """
    squares = float(np.sum(errors * np.linalg.solve(covariance, errors.T).T))
    low, high = chi2.ppf([CHANCE, 1 - CHANCE], errors.size) / errors.size
    ratio = squares / errors.size
    return Line(
        f"  chi² of all {errors.size} errors, whitened by the Cramér-Rao covariance, over their number",
        f"{ratio:.3f}", f"{low:.2f} to {high:.2f}", bool(low <= ratio <= high),
    )  # fmt: skip
