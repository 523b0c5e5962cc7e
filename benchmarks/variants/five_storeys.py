"""A published building of five storeys with known masses: errors of its stiffnesses at noise, beside the bound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.problem_modules import load_module
from benchmarks.variants.parameter_bound import parameter_bound
from benchmarks.variants.parameter_errors import least_percent, mean_percent, over_the_bound, relative_errors, whitened

PUBLISHED = {"GA": 5.04, "DE": 5.11, "PSO": 5.04}  # mean |error|, %, at 5 % noise (Civil Eng. J. 5830)


def lines(reduced: bool) -> Iterator[Line]:
    """Errors of storey stiffnesses at 5 % noise, over the bound; of a few draws all together."""
    draws = range(3 if reduced else 60)  # errors of one draw hang together
    module = load_module("five_storeys")
    exact = module.problem(noise=0.0).measurement
    truth, noise = module.building(), 0.05
    C = truth.damping
    w = 2 * np.pi * sysid.Structure(module.MASS, module.STIFFNESS, np.zeros(5), n_base=1).natural_frequencies
    a, b = w[module.TUNED[0]], w[module.TUNED[1]]
    alpha, beta = 2 * module.RATIO * np.array([a * b, 1.0]) / (a + b)
    assert np.allclose(alpha * module.MASS[:5, :5] + beta * module.STIFFNESS[:5, :5], C)
    true = np.concatenate([module.SPRINGS, [alpha, beta]])

    def response(unknowns: np.ndarray) -> np.ndarray:
        K = module.STRETCH.T @ np.diag(unknowns[:5]) @ module.STRETCH
        C = (unknowns[5] * module.MASS + unknowns[6] * K)[:5, :5]
        return sysid.Structure(module.MASS, K, damping_matrix=C, n_base=1).relative_acceleration(exact.freq)

    std = noise * np.sqrt(np.mean(np.abs(exact.response) ** 2))
    least_covariance = parameter_bound(response, true, std)[:5, :5]
    bound = np.sqrt(np.diag(least_covariance))
    errors, failed = relative_errors(module, ("storey stiffness",), true[:5], noise, draws)
    mean, least = mean_percent(errors), least_percent(bound)
    told = ", ".join(f"{name} {value:g}" for name, value in PUBLISHED.items())
    yield Line(
        f"five_storeys, 5 % noise, {len(draws)} draws: mean |error| of the stiffnesses, median",
        f"{np.median(mean):.3g} % (from {mean.min():.3g} to {mean.max():.3g}; published {told} %; Cramér-Rao "
        f"{least:.3g} %)",
        "< 1 %",
        bool(np.median(mean) < 1),
    )
    yield whitened(errors, least_covariance) if reduced else over_the_bound(errors, bound)
    yield Line("five_storeys: runs that were no success", str(failed), "0", failed == 0)
