"""A published chain of six springs and dampers with known masses: errors at noise, beside the source and the bound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.problem_modules import load_module
from benchmarks.variants.parameter_bound import parameter_bound
from benchmarks.variants.parameter_errors import least_percent, mean_percent, over_the_bound, relative_errors, whitened

# Noise: mean |error| of springs and dampers that the source gives, in % (Chen, Chen and Liu 2014, ant colony; its
# test is output-only, its masses, lines, duration and input are not those of problems/six_springs.py).
PUBLISHED = {0.01: (0.06, 0.23), 0.05: (0.28, 0.77), 0.10: (1.06, 8.5), 0.15: (3.82, 13.2)}


def lines(reduced: bool) -> Iterator[Line]:
    """Errors of springs and dampers at four levels of noise, over the bound; reduced, at the least and the most.

    The same draws serve all levels: what the fit is linear in has the same errors over the bound at each.
    """
    draws = range(2 if reduced else 20)
    module = load_module("six_springs")
    true = np.concatenate([module.SPRINGS, module.DAMPERS])
    truth = module.building()
    exact = module.shake(truth, 0.0, 0)

    def response(unknowns: np.ndarray) -> np.ndarray:
        K, C = (module.STRETCH.T @ np.diag(part) @ module.STRETCH for part in (unknowns[:6], unknowns[6:]))
        structure = sysid.Structure(module.MASS, K, damping_matrix=C[:6, :6], n_base=1)
        return structure.relative_acceleration(exact.freq)[:, 0] * exact.base[0, 0]

    for noise, published in [*PUBLISHED.items()][:: len(PUBLISHED) - 1 if reduced else 1]:
        std = noise * np.sqrt(np.mean(np.abs(exact.response) ** 2))
        least_covariance = parameter_bound(response, true, std)
        bound = np.sqrt(np.diag(least_covariance))
        errors, failed = relative_errors(module, ("spring", "damper"), true, noise, draws)
        for kind, part, most in zip(("springs", "dampers"), (slice(0, 6), slice(6, 12)), published, strict=True):
            mean, least = mean_percent(errors[:, part]), least_percent(bound[part])
            yield Line(
                f"six_springs, {100 * noise:g} % noise, {len(draws)} draws: mean |error| of the {kind}, median",
                f"{np.median(mean):.3g} % (from {mean.min():.3g} to {mean.max():.3g}; published {most:g} %; "
                f"Cramér-Rao {least:.3g} %)",
                f"< {most:g} %",
                bool(np.median(mean) < most),
            )
            if not reduced:
                yield over_the_bound(errors[:, part], bound[part])
        if reduced:
            yield whitened(errors, least_covariance)
        yield Line(f"six_springs, {100 * noise:g} % noise: runs that were no success", str(failed), "0", failed == 0)
