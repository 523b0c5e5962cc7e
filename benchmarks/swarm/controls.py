"""Simpler searches beside a swarm: the same strategy with hardly a swarm, and with random points in its place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import sysid
from benchmarks.line import Line

TWO_POINTS = "two random points, the same local phase and restarts"
RANDOM = "random search with as many evaluations, the same local phase"


def two_points(strategy: sysid.Swarm) -> sysid.Swarm:
    """The same strategy, its swarm of two random points that never move: local phase and restarts are all it has."""
    return replace(strategy, n_particles=2, max_iterations=1)


def random_search(strategy: sysid.Swarm, evaluations: int) -> sysid.Swarm:
    """The same strategy, once, with so many points of a Latin hypercube in the place of the swarm."""
    return replace(strategy, n_particles=max(evaluations, 2), max_iterations=1, restarts=0)


def lines(
    what: str, strategy: sysid.Swarm, results: Sequence[sysid.Identification], seeds: Sequence[int]
) -> Iterator[Line]:
    """Residuals that both controls leave where the swarm gave these results, one a seed."""
    left: dict[str, list[float]] = {TWO_POINTS: [], RANDOM: []}
    for result, seed in zip(results, seeds, strict=True):
        controls = two_points(strategy), random_search(strategy, result.history.evaluations)
        for residuals, control in zip(left.values(), controls, strict=True):
            residuals.append(sysid.identify(result.problem, strategy=control, rng=seed).residual)
    for name, residuals in left.items():
        yield Line(
            f"{what}{name}: residuals ({', '.join(f'{residual:.2g}' for residual in residuals)}), the largest",
            f"{max(residuals):.3g}",
        )
