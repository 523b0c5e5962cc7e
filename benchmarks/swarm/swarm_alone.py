"""The particle swarm alone, without a gradient step: how low it brings the residual."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.line import Line, below
from benchmarks.problem_modules import load_module
from sysid.search.swarm_objective import SwarmObjective
from sysid.swarm import SwarmSettings

SEEDS = range(5)


def lines(reduced: bool) -> Iterator[Line]:
    """The swarm alone: no gradient step, closed-form refinement; the usual constants beside those of `sysid.Swarm`."""
    module = load_module("cantilever_tower")
    for elements, bound in ((3, 0.45), (5, 0.70)):
        if reduced and elements == 5:
            continue
        problem = module.problem(elements=elements)
        cost = SwarmObjective(problem, spectrum=problem.formulation.stiffness.spectrum)
        box = np.column_stack([problem.lower, problem.upper])
        what = f"swarm alone, n = {2 * elements}, D = {problem.n_variables}, 400 iterations"
        costs = _swarm_costs(cost, box, sysid.Swarm().settings)
        yield below(f"{what}: median residual over seeds 0-4 ({_list(costs)})", float(np.median(costs)), bound)
        if not reduced:
            costs = _swarm_costs(cost, box, SwarmSettings())
            yield Line(
                f"{what}, usual constants b1 = 0.3, b2 = 0.2, c1 + c2 <= 4 ({_list(costs)})", f"{np.median(costs):.4g}"
            )


def _swarm_costs(cost: SwarmObjective, box: np.ndarray, settings: SwarmSettings) -> list[float]:
    with threadpool_limits(limits=1):
        return [
            sysid.minimize_swarm(cost, box, rng=seed, max_iterations=400, stall_iterations=None, settings=settings).fun
            for seed in SEEDS
        ]


def _list(values: list[float]) -> str:
    return ", ".join(f"{value:.3f}" for value in values)
