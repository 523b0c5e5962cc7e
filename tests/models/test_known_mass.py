"""A full mass that is known in part: entries, and the whole rigid-body mass."""

from __future__ import annotations

import numpy as np
import pytest

import sysid
from sysid import FullMass, InputError, Problem, Structure, identify, simulate
from sysid.search.session import DeferredInterrupt, Session

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MASSES, SPRINGS = np.array([12.0, 9.0, 15.0]), np.array([4e4, 3e4, 2e4])


def building(coupling: float = 0.0) -> Structure:
    """Three floors on a chain of springs; `coupling` is an off-diagonal mass, kg, of the upper two."""
    k1, k2, k3 = SPRINGS
    K_SS = np.array([[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]])
    M = np.zeros((4, 4))
    M[:3, :3] = np.diag(MASSES)
    M[1, 2] = M[2, 1] = coupling
    r = np.ones((3, 1))
    K = np.block([[K_SS, -K_SS @ r], [-(r.T @ K_SS), r.T @ K_SS @ r]])
    return Structure(M, K, [0.01, 0.012, 0.015], n_base=1)


FREQ = np.linspace(1.0, 25.0, 400)
NOTHING = np.full((3, 3), np.nan)


def with_entries(*entries: tuple[int, int, float], shape: tuple[int, int] = (3, 3)) -> np.ndarray:
    known = np.full(shape, np.nan)
    for i, j, value in entries:
        known[i, j] = value
    return known


@pytest.mark.parametrize("coupling", [0.0, 2.0])
def test_three_weighed_floors_close_the_cone(coupling):
    truth = building(coupling)
    known = with_entries(*((i, i, m) for i, m in enumerate(MASSES)))
    result = identify(Problem(simulate(truth, FREQ), mass=FullMass(known=known)), strategy="modal")
    assert result.determined, result.undetermined
    assert result.closed_by == ("3 entries of the mass matrix stated to be known",)
    np.testing.assert_allclose(result.structure.mass[:3, :3], truth.mass[:3, :3], rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(result.structure.stiffness[:3, :3], truth.stiffness[:3, :3], rtol=1e-8, atol=1e-3)


def test_known_uncoupled_sensors_and_one_mass_close_it_too():
    truth = building()
    known = with_entries((0, 1, 0.0), (0, 2, 0.0), (1, 2, 0.0), (0, 0, MASSES[0]))
    result = identify(Problem(simulate(truth, FREQ), mass=FullMass(known=known)), strategy="modal")
    assert result.determined, result.undetermined
    np.testing.assert_allclose(np.diag(result.structure.mass)[:3], MASSES, rtol=1e-8)


def test_known_coupling_to_the_base_closes_the_cone(random_structure):
    truth = random_structure(np.random.default_rng(3), 4, 1)
    freq = np.geomspace(0.5 * truth.natural_frequencies[0], 1.5 * truth.natural_frequencies[-1], 400)
    known = np.full((4, 5), np.nan)
    known[:, 4] = truth.mass[:4, 4]
    problem = Problem(simulate(truth, freq), mass=FullMass(known=known))
    result = identify(problem, strategy="modal")
    assert result.determined, result.undetermined
    np.testing.assert_allclose(result.structure.mass[:4, :4], truth.mass[:4, :4], rtol=1e-7, atol=1e-9)


def test_no_coupling_to_the_base_says_nothing_where_the_data_show_that_there_is_none():
    known = with_entries((0, 3, 0.0), (1, 3, 0.0), (2, 3, 0.0), shape=(3, 4))
    result = identify(Problem(simulate(building(), FREQ), mass=FullMass(known=known)), strategy="modal")
    assert result.of_kind("open") and result.open_masses == (0, 1, 2)


def drawn(truth: Structure, freq: np.ndarray, known: np.ndarray, noise: float) -> tuple[Problem, list[Structure]]:
    """The first problem of 30 draws of noise, and the answer of each, not judged."""
    problems = [Problem(simulate(truth, freq, noise=noise, rng=i), mass=FullMass(known=known)) for i in range(30)]
    session = Session([], DeferredInterrupt())
    return problems[0], [sysid.Modal().run(problem.prepared, session, None).structure for problem in problems]


def test_what_known_masses_leave_uncertain_is_what_scatters():
    known = with_entries(*((i, i, m) for i, m in enumerate(MASSES)))
    first, draws = drawn(building(2.0), FREQ[::3], known, 0.02)
    u, n = identify(first, strategy="modal").uncertainty, 3
    for name, std in (("mass", u.mass), ("stiffness", u.stiffness)):
        scatter = np.std([getattr(draw, name)[:n, :n] for draw in draws], axis=0, ddof=1)
        moving = scatter > 1e-9 * scatter.max()
        assert np.all(np.isfinite(std))
        # 30 draws tell a standard deviation to 13 %.
        np.testing.assert_allclose(std[moving], scatter[moving], rtol=0.35)
        assert np.all(std[~moving] < 1e-6 * std.max())
    scatter = np.std([draw.participation[:, 0] for draw in draws], axis=0, ddof=1)
    np.testing.assert_allclose(u.participation[:, 0], scatter, rtol=0.35)


def test_known_coupling_gives_uncertainties_too(random_structure):
    truth = random_structure(np.random.default_rng(3), 4, 1)
    freq = np.geomspace(0.5 * truth.natural_frequencies[0], 1.5 * truth.natural_frequencies[-1], 150)
    known = np.full((4, 5), np.nan)
    known[:, 4] = truth.mass[:4, 4]
    first, draws = drawn(truth, freq, known, 0.001)
    scatter = np.std([draw.mass[:4, :4] for draw in draws], axis=0, ddof=1)
    np.testing.assert_allclose(identify(first, strategy="modal").uncertainty.mass, scatter, rtol=0.35)


def test_one_weighed_floor_is_met_and_leaves_the_rest_open_within_intervals():
    truth = building()
    known = with_entries((1, 1, MASSES[1]))
    result = identify(Problem(simulate(truth, FREQ), mass=FullMass(60.0, known=known)), strategy="modal")
    assert not result.determined
    assert result.residual < 1e-9
    assert result.structure.mass[1, 1] == pytest.approx(MASSES[1], rel=1e-8)
    lower, upper = result.mass_interval
    np.testing.assert_allclose([lower[1, 1], upper[1, 1]], MASSES[1], rtol=1e-6)
    own = truth.mass[:3, :3]
    assert np.all(lower <= own + 1e-6)
    assert np.all(own <= upper + 1e-6)
    assert upper[0, 0] > lower[0, 0] + 1.0


def test_known_entries_that_no_model_has_are_told():
    known = with_entries((0, 0, MASSES[0]), (1, 1, 3 * MASSES[1]), (2, 2, MASSES[2]), (0, 1, 0.0), (1, 2, 0.0))
    result = identify(Problem(simulate(building(), FREQ), mass=FullMass(known=known)), strategy="modal")
    assert not result.determined
    assert result.of_kind("stated masses", severity="contradicts")


def test_known_masses_above_the_stated_total_are_told():
    known = with_entries(*((i, i, m) for i, m in enumerate(MASSES)))
    result = identify(Problem(simulate(building(), FREQ), mass=FullMass(20.0, known=known)), strategy="modal")
    assert not result.determined
    assert result.of_kind("known entries", severity="contradicts")


def test_known_entries_beside_a_force_are_checked():
    test = simulate(building(), FREQ, force=True)
    right, wrong = (Problem(test, mass=FullMass(known=with_entries((0, 0, m)))) for m in (MASSES[0], 2 * MASSES[0]))
    assert identify(right, strategy="modal").determined
    assert identify(wrong, strategy="modal").of_kind("stated masses")


@pytest.mark.parametrize("force", [False, True])
def test_a_whole_rigid_body_mass_is_met(random_structure, force):
    truth = random_structure(np.random.default_rng(3), 5, 3)
    freq = np.geomspace(0.5 * truth.natural_frequencies[0], 1.5 * truth.natural_frequencies[-1], 400)
    total = truth.rigid_body_mass
    problem = Problem(simulate(truth, freq, force=force), mass=FullMass(total, healing="rigid_body"))
    result = identify(problem, strategy="modal")
    assert result.residual < 1e-9
    assert result.determined == force
    np.testing.assert_allclose(result.structure.rigid_body_mass, total, rtol=1e-9, atol=1e-9 * total.max())
    lower, upper = result.mass_interval
    own = truth.mass[:5, :5]
    tolerance = 1e-6 * np.sqrt(np.outer(np.diag(own), np.diag(own)))
    assert np.all(lower <= own + tolerance)
    assert np.all(own <= upper + tolerance)


def test_the_matrix_bounds_no_less_than_its_diagonal(random_structure):
    truth = random_structure(np.random.default_rng(3), 4, 2)
    freq = np.geomspace(0.5 * truth.natural_frequencies[0], 1.5 * truth.natural_frequencies[-1], 300)
    test, total = simulate(truth, freq), truth.rigid_body_mass
    upper = [
        identify(Problem(test, mass=FullMass(m, healing="rigid_body")), strategy="modal").mass_interval[1]
        for m in (total, np.diag(total))
    ]
    assert np.all(np.diag(upper[0]) <= np.diag(upper[1]) * (1 + 1e-6))
    assert np.any(np.diag(upper[0]) < np.diag(upper[1]) * (1 - 1e-3))


def test_the_swarm_says_that_it_cannot_hold_them():
    test = simulate(building(), FREQ)
    for mass in (FullMass(known=with_entries((0, 0, 12.0))), FullMass([[36.0]], healing="rigid_body")):
        with pytest.raises(InputError, match="strategy 'modal'"):
            identify(Problem(test, mass=mass), strategy="swarm", rng=0)


@pytest.mark.parametrize(
    ("mass", "words"),
    [
        (lambda: FullMass([[36.0]]), "healing='rigid_body'"),
        (lambda: FullMass([[36.0, 1.0], [1.0, 30.0]], healing="rigid_body"), r"\(2, 2\).*\(1, 1\)"),
        (lambda: FullMass([[-36.0]], healing="rigid_body"), "must be positive"),
        (lambda: FullMass(known=np.ones((2, 3))), r"known is \(2, 3\)"),
        (lambda: FullMass(known=with_entries((0, 0, -1.0))), "must be positive"),
        (lambda: FullMass(known=with_entries((0, 1, 1.0), (1, 0, 2.0))), "not symmetric"),
        (lambda: FullMass(known="much"), "known is not an array of real numbers"),
    ],
)
def test_mistakes_are_named(mass, words):
    test = simulate(building(), FREQ)
    with pytest.raises(InputError, match=words):
        sysid.Problem(test, mass=mass())
