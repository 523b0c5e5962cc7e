"""The tower with noise: how near to the noise floor a run of the swarm strategy ends."""

from __future__ import annotations

from collections.abc import Iterator

import sysid
from benchmarks.line import Line, below
from benchmarks.problem_modules import load_module
from benchmarks.swarm import controls


def lines(reduced: bool) -> Iterator[Line]:
    """cantilever_tower with 1 % noise, a new draw each seed."""
    seeds = range(1 if reduced else 5)
    module = load_module("cantilever_tower")
    results = [sysid.identify(module.problem(force=False, rng=seed), strategy="swarm", rng=seed) for seed in seeds]
    ratios = [r.residual / r.problem.measurement.residual(r.problem.reference) for r in results]
    worst = max(abs(ratio - 1) for ratio in ratios)
    yield below(
        f"cantilever_tower, 1 % noise, {len(seeds)} draws: |residual / noise floor - 1| (ratios "
        + ", ".join(f"{ratio:.4f}" for ratio in ratios)
        + ")",
        worst,
        0.05,
    )
    if not reduced:
        yield from controls.lines(f"cantilever_tower, 1 % noise, {len(seeds)} draws: ", sysid.Swarm(), results, seeds)
