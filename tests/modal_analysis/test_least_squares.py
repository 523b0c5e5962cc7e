"""Damped Gauss-Newton steps beside problems whose end is known."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.modal_analysis.least_squares import SumOfSquares, minimise, over_root_of_rest
from sysid.modal_analysis.modal_model import NormalEquations

STEEP = 1e3  # of the walls of the valley


def errors(x):
    """Of H. H. Rosenbrock's valley (Computer J. 3 (1960) 175-184), with steeper walls; its end is (1, 1)."""
    return np.array([STEEP * (x[1] - x[0] ** 2), 1 - x[0]])


def slopes(x):
    """Minus the derivative of the errors, (2, 2)."""
    return np.array([[2 * STEEP * x[0], -STEEP], [1.0, 0.0]])


def valley(*, bent):
    """The problem from (-1, 1), with or without the bend of its errors, which is exact."""

    def equations(x):
        J, e = slopes(x), errors(x)
        return NormalEquations(J.T @ J, J.T @ e, float(e @ e))

    def bend(x, _, step):
        return slopes(x).T @ np.array([-2 * STEEP * step[0] ** 2, 0.0])

    return SumOfSquares(
        np.array([-1.0, 1.0]), lambda x: x, lambda x: float(errors(x) @ errors(x)), equations,
        bent=bend if bent else None,
    )  # fmt: skip


def steps_of(problem):
    """Where it ends, and steps until there."""
    counts = []
    x, chi2, settled = minimise(problem, lambda i, *_: bool(counts.append(i)), 2000, lambda _: 1e-16)
    assert settled and chi2 < 1e-12
    return x, len(counts)


def test_a_curved_valley_is_followed_to_its_end():
    x, _ = steps_of(valley(bent=True))
    assert x == pytest.approx([1.0, 1.0], abs=1e-5)


def test_bent_steps_are_fewer():
    assert 2 * steps_of(valley(bent=True))[1] < steps_of(valley(bent=False))[1]


def test_an_unknown_that_is_held_stays_while_the_other_one_settles_beside_it():
    free, held = valley(bent=True), np.array([True, False])
    start = np.array([-1.5, 0.3])
    problem = replace(free, start=start, equations=lambda x: free.equations(x).holding(held))
    x, _, settled = minimise(problem, lambda *_: False, 100, lambda _: 1e-16)
    assert settled and x[0] == start[0] and x[1] == pytest.approx(start[0] ** 2)


def test_a_score_over_the_root_of_the_rest_is_that_of_all_eigenvalues() -> None:
    """Of which none counts for more than .98, and most may be next to none."""
    rng = np.random.default_rng(0)
    half, rows = rng.standard_normal((50, 40)), rng.standard_normal((50, 12)) * np.geomspace(1e-3, 1.0, 12)
    inner = half.T @ rows @ rows.T @ half
    rows *= np.sqrt(1.05 / np.linalg.eigvalsh(inner)[-1])
    taken, turn = np.linalg.eigh(half.T @ rows @ rows.T @ half)
    score = half.T @ rows @ rng.standard_normal(12)
    assert over_root_of_rest(half, rows @ rows.T, score, 0.98) == pytest.approx(
        turn @ ((turn.T @ score) / np.sqrt(1 - np.clip(taken, 0.0, 0.98))), rel=1e-6
    )
    assert not np.any(over_root_of_rest(half, rows @ rows.T, np.zeros(40), 0.98))
