"""Errors of identified unknowns over many draws of the noise, and the same over the Cramér-Rao bound."""

from __future__ import annotations

from types import ModuleType

import numpy as np

import sysid
from benchmarks.line import Line

ABOVE = 1.3  # times the bound
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


def over_the_bound(errors: np.ndarray, bound: np.ndarray, *, judged: bool) -> Line:
    """Ratio of errors (draws, unknowns) to the bound (unknowns,); a few draws do not judge it."""
    median = np.median(mean_percent(errors)) / least_percent(bound)
    ratio = np.sqrt(np.mean((errors / bound) ** 2))
    return Line(
        "  the same over the bound: median of the means; root mean square of all errors",
        f"{median:.3f}; {ratio:.3f}",
        f"<= {ABOVE:g} each" if judged else "",
        bool(max(median, ratio) <= ABOVE) if judged else None,
    )
