"""Rows that are repaired before they are evaluated, and written back as the particles' positions."""

import numpy as np
import pytest

from sysid.errors import InputError
from sysid.swarm import ParticleSwarm, minimize_swarm

BOUNDS = [(-2.0, 6.0), (0.0, 10.0), (-1.0, 1.0)]


def sphere(rows):
    return ((rows - [1.0, 2.0, 0.0]) ** 2).sum(axis=1)


def rounded(rows):
    """The nearest whole numbers: idempotent, as a repair is."""
    return np.round(rows)


def test_told_rows_become_the_positions_and_the_best():
    swarm = ParticleSwarm(BOUNDS, rng=0, n_particles=6)
    rows = rounded(swarm.ask())
    swarm.tell(sphere(rows), rows)
    np.testing.assert_allclose(swarm.positions, rows, atol=1e-12)
    assert swarm.best_x.tolist() == rows[np.argmin(sphere(rows))].tolist()


def test_told_rows_are_clipped_to_the_bounds():
    swarm = ParticleSwarm(BOUNDS, rng=0, n_particles=4)
    rows = swarm.ask()
    swarm.tell(sphere(rows), rows + np.array([0.0, 100.0, 0.0]))
    assert np.all(swarm.positions[:, 1] == 10.0)


def test_a_search_sees_and_keeps_only_repaired_rows():
    seen = []

    def fun(rows):
        seen.append(rows)
        return sphere(rows)

    result = minimize_swarm(fun, BOUNDS, rng=1, n_particles=10, max_iterations=30, repair=rounded)
    every = np.vstack(seen)
    assert np.array_equal(every, np.round(every))
    assert np.array_equal(result.x, [1.0, 2.0, 0.0])
    assert result.fun == 0.0


def test_elitist_learning_places_the_repaired_candidate():
    """In the convergence state one row more is asked for; it replaces the worst particle as it was repaired."""
    swarm = ParticleSwarm(BOUNDS, rng=3, n_particles=8)
    for _ in range(60):
        rows = rounded(swarm.ask())
        if len(rows) == 9:
            rows[-1] = [5.25, 9.75, 0.5]  # where no whole number is, and so no other particle
        swarm.tell(sphere(rows), rows)
        if len(rows) == 9:
            assert np.count_nonzero(np.all(np.abs(swarm.positions - rows[-1]) < 1e-9, axis=1)) == 1
            return
    raise AssertionError("elitist learning never came")


@pytest.mark.parametrize(
    ("repair", "words"),
    [
        (lambda rows: rows[:, :2], r"rows that repair returned have shape \(5, 2\)"),
        (lambda rows: rows * np.nan, "rows that repair returned are not all finite"),
    ],
)
def test_what_repair_may_not_return(repair, words):
    with pytest.raises(InputError, match=words):
        minimize_swarm(sphere, BOUNDS, rng=0, n_particles=5, max_iterations=3, repair=repair)
