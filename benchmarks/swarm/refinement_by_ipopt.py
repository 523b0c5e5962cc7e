"""IPOPT's refinement of eigenvalues: its derivatives against complex steps, leaders tried and won, every candidate."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.problem_modules import load_module
from benchmarks.swarm.noisy_tests import SEEDS, TOTALS, random_test
from sysid.models.spectrum import SpectrumDistance, derivatives_of

LEAST = 5  # leaders tried in a run
STEP = 1e-30  # of complex steps; nothing is subtracted, so it may be that small


def lines(reduced: bool) -> Iterator[Line]:
    """Derivatives, leaders and statuses; in full every candidate by IPOPT too."""
    sizes = ((4, 4), (4, 2), (6, 6), (6, 5), (10, 10))
    worst = np.max([derivative_errors(n, m, seed) for n, m in sizes for seed in range(2 if reduced else 10)], axis=0)
    for name, error in zip(("gradient", "Hessian"), worst, strict=True):
        yield below(f"refinement by IPOPT: exact {name} against complex steps, n = 4, 6, 10, relative", error, 1e-8)
    yield from _leaders(reduced)
    if not reduced:
        yield _every_candidate()


def derivative_errors(n: int, m: int, seed: int) -> tuple[float, float]:
    """Largest errors of the gradient and of the Hessian that IPOPT is given, relative to their largest entries.

    At a random L_H, for targets of the lowest m of n eigenvalues. The references are in NumPy's complex numbers: the
    objective by eigenpairs that solve their own equations, and its slope along them.
    """
    rng = np.random.default_rng([n, m, seed])
    factor = np.tril(rng.uniform(-1, 1, (n, n)))
    np.fill_diagonal(factor, rng.uniform(0.3, 1, n))
    targets = np.sort(rng.uniform(0.3, 1.5, m))
    rows, columns = np.tril_indices(n)
    x, unit = factor[rows, columns], 1j * STEP * np.eye(rows.size)
    start = np.linalg.eigh(factor @ factor.T)

    def at(z: np.ndarray) -> np.ndarray:
        moved = np.zeros((n, n), dtype=complex)
        moved[rows, columns] = z
        return moved

    gradient = np.array([_objective(at(x + step), targets, start).imag for step in unit]) / STEP
    hessian = np.array([_slope(at(x + step), targets, start)[rows, columns].imag for step in unit]) / STEP
    given = derivatives_of(SpectrumDistance(n, targets))
    upper = np.asarray(given["hess_lag"](x, [], 1.0, []))
    full = upper + np.triu(upper, 1).T
    off = np.abs(np.asarray(given["grad_f"](x, [])[1]).ravel() - gradient).max() / np.abs(gradient).max()
    return float(off), float(np.abs(full - hessian).max() / np.abs(hessian).max())


def _eigenpairs(matrix: np.ndarray, start: tuple[np.ndarray, np.ndarray]) -> Iterator[tuple[complex, np.ndarray]]:
    """Eigenpairs (lam, v) of a complex symmetric matrix with v'v = 1, by Newton's method from those of a near one."""
    n = len(matrix)
    for value, vector in zip(start[0], start[1].T, strict=True):
        lam, v = complex(value), vector.astype(complex)
        for _ in range(3):
            border = np.block([[matrix - lam * np.eye(n), -v[:, None]], [v[None, :], np.zeros((1, 1))]])
            change = np.linalg.solve(border, -np.append(matrix @ v - lam * v, (v @ v - 1) / 2))
            v, lam = v + change[:n], lam + change[n]
        yield lam, v


def _objective(factor: np.ndarray, targets: np.ndarray, start: tuple[np.ndarray, np.ndarray]) -> complex:
    lam = np.array([value for value, _ in _eigenpairs(factor @ factor.T, start)])
    return complex(np.sum((lam[: targets.size] / targets**2 - 1) ** 2))


def _slope(factor: np.ndarray, targets: np.ndarray, start: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Derivative of the objective by all entries of the factor: d lam = v' (dL L' + L dL') v for each eigenpair."""
    slope = np.zeros_like(factor)
    for w, (lam, v) in zip(targets, _eigenpairs(factor @ factor.T, start), strict=False):
        slope += 2 * (lam / w**2 - 1) / w**2 * 2 * np.outer(v, v @ factor)
    return slope


def _leaders(reduced: bool) -> Iterator[Line]:
    """Leaders of the first swarm of each run of `noisy_tests`; what follows it only adds to them."""
    strategy, seeds = sysid.Swarm.published(local=None), SEEDS[:1] if reduced else SEEDS
    tower = load_module("cantilever_tower").problem
    tests: dict[str, Callable[[int], sysid.Problem]] = {"README's tower": lambda seed: tower(rng=seed)}
    for n in () if reduced else (6, 10):
        for force in (True, False):
            tests[f"n = {n}, d = 3, {'with' if force else 'without'} force"] = partial(random_test, n=n, force=force)
        for kind, words in TOTALS.items():
            tests[f"n = {n}, d = 3, with force and {words}"] = partial(random_test, n=n, kind=kind)
    for name, problem in tests.items():
        histories = [sysid.identify(problem(seed), strategy=strategy, rng=seed).history for seed in seeds]
        what = f"hpso-ls, {name}, 1 % noise, {len(seeds)} seeds: "
        yield from _counts(what, histories)
        if name.startswith("n = 10"):
            won = sum(history.leaders_won for history in histories[:10])
            yield above(what + "leaders that IPOPT won, the first ten seeds together", won, 1)


def _counts(what: str, histories: list[sysid.History]) -> Iterator[Line]:
    """Leaders tried, and statuses that are not counted."""
    tried, won = ([getattr(one, name) for one in histories] for name in ("leaders_tried", "leaders_won"))
    yield above(what + f"leaders tried in a swarm, the fewest (won: {sum(won)} of {sum(tried)})", min(tried), LEAST)
    counted = [sum(count for _, count in one.refinement_statuses) for one in histories]
    statuses = sorted({status for one in histories for status, _ in one.refinement_statuses})
    lost = sum(abs(a - b) for a, b in zip(counted, tried, strict=True))
    yield below(what + f"refinements whose status is not counted (met: {', '.join(statuses)})", lost, 0)


def _every_candidate() -> Line:
    """Searches in which IPOPT refines every candidate, as the paper's does."""
    strategy = sysid.Swarm.published(refine_by="ipopt", max_iterations=20)
    fits, counted = 0, []
    for elements, seed in ((2, 0), (2, 1), (3, 0)):
        problem = load_module("cantilever_tower").problem(elements=elements)
        result = sysid.identify(problem, strategy=strategy, rng=seed)
        fits += result.success
        counted.append(f"{result.history.wall_time:.0f} s, {result.history.refinement_in_words}")
    return above(f"refine_by=ipopt, 20 iterations, towers n = 4, 4, 6: fits of three ({'; '.join(counted)})", fits, 3)
