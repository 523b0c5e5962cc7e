"""The tower without noise: how exact a run of the swarm strategy ends, seed by seed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.problem_modules import load_module
from benchmarks.swarm import controls


def lines(reduced: bool) -> Iterator[Line]:
    """cantilever_tower without noise."""
    seeds = range(1 if reduced else 5)
    module = load_module("cantilever_tower")
    problem = module.problem(noise=0.0, force=False)
    truth = problem.reference.natural_frequencies
    results = [sysid.identify(problem, strategy="swarm", rng=seed) for seed in seeds]
    figures = []
    for result in results:
        s, n = result.structure, result.structure.n
        blocks = (s.mass[:n, :n], s.stiffness[:n, :n])
        figures.append(
            (
                result.residual,
                np.max(np.abs(np.diag(s.rigid_body_mass) / problem.mass.total_mass - 1)),
                np.max(np.abs(s.natural_frequencies / truth - 1)),
                result.history.refinement_error,
                min(np.linalg.eigvalsh(block)[0] / np.linalg.eigvalsh(block)[-1] for block in blocks),
                result.history.wall_time,
                result.success,
            )
        )
    worst = np.array(figures, dtype=float)
    what = f"cantilever_tower, no noise, {len(seeds)} seeds: "
    yield below(what + "largest relative residual", worst[:, 0].max(), 1e-6)
    yield below(what + "largest relative error of the total mass", worst[:, 1].max(), 1e-9)
    yield below(what + "largest relative distance of the final frequencies from the true ones", worst[:, 2].max(), 1e-7)
    yield below(
        what + "largest relative distance of the refined eigenvalues from the given ones", worst[:, 3].max(), 1e-8
    )
    yield Line(
        what + "M_SS and K_SS positive definite (least ratio of extreme eigenvalues)",
        f"{worst[:, 4].min():.3g}", "> 0", bool(worst[:, 4].min() > 0),
    )  # fmt: skip
    if not reduced:
        yield from controls.lines(what, sysid.Swarm(), results, seeds)
    yield Line(what + "seconds a run, and successes", f"{worst[:, 5].round(1).tolist()}, {int(worst[:, 6].sum())}")
