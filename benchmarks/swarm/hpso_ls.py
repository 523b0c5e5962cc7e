"""The paper's hPSO-LS on the tower without noise, and with it, on seeds that served no choice of a constant."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.problem_modules import load_module
from benchmarks.swarm import controls, noisy_tests
from sysid.search.inverse_factor_coordinates import InverseFactorError

SEEDS = range(9100, 9110)
WANTED = {3: 10, 5: 8}  # fits of ten, by the tower's elements; n is twice as many
EXACT = 1e-6
SECONDS = 120.0


def lines(reduced: bool) -> Iterator[Line]:
    """Fits, and whether each keeps what it must; seeds, restarts and seconds are told."""
    seeds = SEEDS[:1] if reduced else SEEDS
    for elements in (3,) if reduced else (3, 5):
        problem = load_module("cantilever_tower").problem(elements=elements, noise=0.0, force=False)
        results = [sysid.identify(problem, strategy="hpso-ls", rng=seed) for seed in seeds]
        what = f"tower, n = {2 * elements}, strategy hpso-ls, no noise, {len(seeds)} seeds: "
        fits = [result for result in results if result.residual <= EXACT]
        restarts = ", ".join(str(result.history.restarts) for result in results)
        least = WANTED[elements] * len(seeds) // len(SEEDS)
        yield above(what + f"residual at most {EXACT:g} (restarts {restarts})", len(fits), least)
        late = max(result.history.wall_time for result in results)
        yield below(what + "most seconds of a run", late, SECONDS)
        yield from _sound(what, problem, fits)
        yield _phases(what, results)
        if not reduced:
            yield from controls.lines(what, sysid.Swarm.published(), results, seeds)
    yield below("exact Hessian against differences of the gradient, 5 random points, n = 6, relative", _hessian(), 1e-6)
    yield from noisy_tests.tower_lines(reduced)


def _sound(what: str, problem: sysid.Problem, fits: list[sysid.Identification]) -> Iterator[Line]:
    """Total mass, spectrum and definiteness of what fits."""
    structures = [fit.structure for fit in fits]
    off = [np.abs(np.diag(s.rigid_body_mass) / problem.mass.total_mass - 1).max() for s in structures]
    yield below(what + "largest relative error of the total mass", max(off), 1e-9)
    f = problem.reference.natural_frequencies
    off = [np.abs(s.natural_frequencies / f - 1).max() for s in structures]
    yield below(what + "largest relative distance of a frequency from the true one", max(off), 1e-7)
    least = min(np.linalg.eigvalsh(A[: s.n, : s.n])[0] for s in structures for A in (s.mass, s.stiffness))
    yield Line(what + "least eigenvalue of M_SS and K_SS", f"{least:.3g}", "> 0", bool(least > 0))


def _phases(what: str, results: list[sysid.Identification]) -> Line:
    """Residuals after the swarm and the local phase, medians."""
    left = [{phase.name: phase.objective for phase in result.history.phases} for result in results]
    told = ", ".join(f"{name} {np.median([one[name] for one in left]):.2g}" for name in left[0])
    return Line(what + "median residual after each phase", told)


def _hessian() -> float:
    """Largest relative error along random directions, differences of fourth order."""
    problem = load_module("cantilever_tower").problem(elements=3, noise=0.0, force=True)
    error, structure = InverseFactorError(problem.prepared), problem.reference
    n, rng, h, worst = structure.n, np.random.default_rng(9100), 1e-5, 0.0
    sizes = error.sizes[:3]
    for _ in range(5):
        # Loads and base mass of the size of the tower's, in kg^½, and the inverse factor of one over it.
        factors = [rng.standard_normal(size) * unit for size, unit in zip(sizes, (0.3, 3.0, 3.0), strict=True)]
        skew = 0.3 * rng.standard_normal(error.sizes[3])
        poles = np.log([2 * np.pi * structure.natural_frequencies, structure.damping_ratios]).ravel()
        y = np.concatenate([*factors, skew, poles])
        psi, along = np.linalg.qr(rng.standard_normal((n, n)))[0], rng.standard_normal(y.size)
        slopes = [np.asarray(error.gradient(y + k * h * along, psi)[1]).ravel() for k in (-2, -1, 1, 2)]
        central = (slopes[0] - 8 * slopes[1] + 8 * slopes[2] - slopes[3]) / (12 * h)
        exact = np.asarray(error.hessian(y, psi)) @ along
        worst = max(worst, float(np.linalg.norm(central - exact) / np.linalg.norm(exact)))
    return worst
