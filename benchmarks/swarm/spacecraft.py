"""The spacecraft without noise: how many runs of the swarm strategy succeed, and how long one takes."""

from __future__ import annotations

from collections.abc import Iterator

import sysid
from benchmarks.line import Line, above, below
from benchmarks.problem_modules import load_module
from benchmarks.swarm import controls


def lines(reduced: bool) -> Iterator[Line]:
    """spacecraft_dummy without noise."""
    seeds = range(1 if reduced else 5)
    problem = load_module("spacecraft_dummy").problem()
    results = [sysid.identify(problem, strategy="swarm", rng=seed) for seed in seeds]
    good = sum(r.residual <= 1e-3 for r in results)
    yield above(
        f"spacecraft_dummy, {len(seeds)} seeds: runs with residual <= 1e-3 ("
        + ", ".join(f"{r.residual:.1e}" for r in results)
        + ")",
        good,
        4 if len(seeds) == 5 else len(seeds),
    )
    if not reduced:
        yield from controls.lines(f"spacecraft_dummy, {len(seeds)} seeds: ", sysid.Swarm(), results, seeds)
    yield below("spacecraft_dummy: slowest run, s", max(r.history.wall_time for r in results), 600)
