"""Other answers, far from the one found, that explain the records as well: told where there are, and only there.

In a chain of two known masses whose roof alone is measured, the stretches k1 and k2 (springs and dampers alike) do what
k2 (m1 + m2) / m2 and k1 m2 / (m1 + m2) do: their product is the same, and so is (m1 + m2) k2 + m2 k1.
"""

import os
import signal

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.search import other_answers
from sysid.search.other_answers import LeastSquares, SameResponse

STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
MASS, SPRINGS, DAMPERS = np.array([5.0, 4.0]), np.array([2e4, 1.5e4]), np.array([9.0, 6.0])
EXCHANGE = MASS.sum() / MASS[1]
SEEDS_MISSED_BEFORE = (2, 4)  # continuation alone comes to one answer only


def problem(floors=(1,), *, noise=0.01, rng=0, lower=1e3, ratios=False, constraints=lambda k, c: []):
    """The chain with sensors on some floors."""
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    recovery = np.eye(2)[list(floors)]
    truth = sysid.Structure(
        np.diag([*MASS, 0.0]), K, [0.01, 0.02] if ratios else None, n_base=1, recovery=recovery,
        rigid_body=np.ones((len(floors), 1)), damping_matrix=None if ratios else C[:2, :2],
    )  # fmt: skip
    test = sysid.simulate(truth, np.linspace(2.0, 20.0, 200), noise=noise, rng=rng)
    k = sysid.Variable("spring", 2, lower=lower, upper=1e6, log=True, unit="N/m")
    c = sysid.Variable("damper", 2, lower=0.1, upper=500.0, log=True, unit="N s/m")
    zeta = sysid.Variable("ratio", 2, lower=1e-3, upper=0.2, log=True)
    return sysid.Problem(
        test, mass=np.diag([*MASS, 0.0]), stiffness=STRETCH.T @ ca.diag(k) @ STRETCH,
        damping=zeta if ratios else STRETCH.T @ ca.diag(c) @ STRETCH, recovery=recovery, constraints=constraints(k, c),
    )  # fmt: skip


def exchanged(x):
    """The other answer's unknowns: springs, then dampers."""
    k, c = x[:2], x[2:]
    return np.array([k[1] * EXCHANGE, k[0] / EXCHANGE, c[1] * EXCHANGE, c[0] / EXCHANGE])


X = np.concatenate([SPRINGS, DAMPERS])
FROM_X = {"strategy": sysid.Continuation(starts=1), "start": X}  # what is looked for afterwards is the same


def test_the_exchange_gives_the_same_transmissibility():
    posed = problem()
    freq = np.linspace(0.5, 40.0, 300)
    one, other = (posed.structure(x).transmissibility(freq) for x in (X, exchanged(X)))
    np.testing.assert_allclose(one, other, rtol=1e-10)


def test_differences_at_complex_frequencies_vanish_there_and_nowhere_about():
    same = SameResponse(problem().prepared, X)
    at, off = same(np.array([exchanged(X), 1.01 * X]))
    assert np.abs(at).max() < 1e-12
    assert np.abs(off).max() > 1e-4


def test_responses_are_those_of_direct_solves_also_with_ratios():
    """Against modes, by hand: sum of phi gamma s² / (s² + 2 zeta w s + w²), less its sign."""
    posed = problem(ratios=True)
    x, moved = np.array([*SPRINGS, 0.01, 0.02]), np.array([2.2e4, 1.4e4, 0.013, 0.017])
    same = SameResponse(posed.prepared, x)
    (term,) = same.terms
    records = []
    for at in (x, moved):
        it = posed.structure(at)
        w, s = 2 * np.pi * it.natural_frequencies, term.s[:, None]
        gamma = it.normal_modes.T @ it.mass[:2, :2] @ np.ones(2)
        modes = -(s**2) / (s**2 + 2 * it.damping_ratios * w * s + w**2)
        records.append(modes @ (it.recovery @ it.normal_modes * gamma)[0])
    expected = (records[1] - records[0]) / np.linalg.norm(records[0])
    (made,) = same(moved[None])
    direction = term.inputs.item()
    np.testing.assert_allclose(made[: expected.size] + 1j * made[expected.size :], direction * expected, atol=1e-12)


@pytest.mark.parametrize("base", [(1.0, 0.01), (0.01, 1.0)])
def test_a_difference_in_any_direction_in_which_the_base_moves_is_seen(base):
    """Two oscillators that know nothing of each other, one on either direction of the base, a run each."""
    freq = np.linspace(1.0, 9.0, 30)
    shaken = np.diag(base)[:, :, None] * np.ones(freq.size)
    test = sysid.Measurement(freq, shaken, shaken + 1.0, rigid_body=np.eye(2), base_axes="xy")
    k = sysid.Variable("k", 2, lower=100.0, upper=9e3)
    posed = sysid.Problem(test, mass=np.diag([2.0, 3.0, 0, 0]), stiffness=ca.diag(k), damping=[0.01, 0.02])
    x = np.array([900.0, 2500.0])
    for i in range(2):
        (off,) = SameResponse(posed.prepared, x)(np.where(np.arange(2) == i, 1.2 * x, x)[None])
        assert np.linalg.norm(off) > 0.01


def test_differences_do_not_depend_on_the_point_of_the_base_that_motions_are_relative_to():
    """With u' = u - A u0, M' = T' M T: base forces and relative motions are the same physics."""
    rng = np.random.default_rng(2)
    freq, G, A = np.linspace(1.0, 9.0, 30), np.array([[1.0, 0.3], [0.9, -0.4]]), np.array([[0.6, 0.2], [-0.1, 0.3]])
    shaken, force = rng.normal(size=(2, 2, 2, freq.size))
    m, k = sysid.Variable("m", 3, lower=0.1, upper=9.0), sysid.Variable("k", 2, lower=100.0, upper=9e3)
    coupling = ca.vertcat(ca.horzcat(m[2], 0.3 * m[0]), ca.horzcat(0.1 * m[1], m[2] / 2))
    M = ca.blockcat([[ca.diag(m[:2]), coupling], [coupling.T, 5 * np.eye(2)]])

    def posed(A):
        T = np.block([[np.eye(2), A], [np.zeros((2, 2)), np.eye(2)]])
        test = sysid.Measurement(
            freq, shaken, shaken + np.einsum("sd,rdf->rsf", G - A, shaken), rigid_body=G - A, force=force,
            base_axes=["x", "ry"],
        )  # fmt: skip
        return sysid.Problem(test, mass=T.T @ M @ T, stiffness=ca.diag(k) + 50, damping=[0.01, 0.02])

    x = np.array([2.0, 3.0, 0.4, 900.0, 2500.0])
    points = x * rng.uniform(0.8, 1.2, (4, x.size))
    one, other = (SameResponse(posed(by).prepared, x)(points) for by in (0 * A, A))
    assert np.linalg.norm(one) > 0.1
    np.testing.assert_allclose(other, one, atol=1e-9)


def test_another_answer_keeps_the_constraints():
    """The exchanged chain explains the records as well; a constraint that holds of the first one leaves it out."""
    other = exchanged(X)
    for constraints, explains in ((lambda k, c: [], True), (lambda k, c: [k[0] <= 2 * k[1]], False)):
        posed = problem(constraints=constraints)
        assert posed.objective(other) == pytest.approx(posed.objective(X), rel=1e-6)
        assert other_answers._explains(posed.prepared, other, posed.objective(X)) is explains


@pytest.mark.parametrize("seed", SEEDS_MISSED_BEFORE)
def test_a_second_answer_is_told_with_its_values(seed):
    result = sysid.identify(problem(rng=seed), rng=seed)
    assert result.success
    assert not result.determined
    (told,) = (*result.contradictions, *result.open_findings)
    assert told.kind == "other answers"
    np.testing.assert_allclose([*told.numbers.values()], exchanged(result.x), rtol=2e-3)


def test_nobody_accuses_unique_answers():
    """Both floors; the roof alone with bounds that leave the other answer out: k2 of the other is 8889 N/m."""
    start = np.array([2.1e4, 1.45e4, 8.0, 7.0])
    for posed in (problem((0, 1), rng=2), problem(rng=2, lower=1e4)):
        result = sysid.identify(posed, rng=2, start=start)
        assert result.determined, result.undetermined
        assert not result.of_kind("search", "other answers")


def test_no_time_is_lost_where_the_equations_are_linear(monkeypatch):
    assert other_answers.is_unique_if_rank_is_full(problem((0, 1)).prepared)
    assert other_answers.is_unique_if_rank_is_full(problem((0, 1), ratios=True).prepared)
    assert not other_answers.is_unique_if_rank_is_full(problem((1,)).prepared)
    monkeypatch.setattr(other_answers, "SameResponse", None)
    assert sysid.identify(problem((0, 1)), rng=0, **FROM_X).determined


def test_a_broken_constraint_is_a_difference_too():
    """The exchanged chain has the same response; beside it counts by how much it breaks what the first one keeps."""
    free, held = (
        SameResponse(problem(constraints=c).prepared, X) for c in (lambda k, c: [], lambda k, c: [k[0] <= 2 * k[1]])
    )
    (alike,), (broken,) = free(exchanged(X)[None]), held(exchanged(X)[None])
    assert np.linalg.norm(alike) < 1e-12
    assert np.linalg.norm(broken) > 1.0  # in units of what counts as broken at all
    assert np.linalg.norm(held(X[None])) < 1e-12


@pytest.mark.parametrize(
    ("damping", "residuals", "unique"),
    [
        (lambda z: z, lambda z: [], True),
        (lambda z: ca.vertcat(z[0] * z[1], z[1]), lambda z: [], False),
        (lambda z: z, lambda z: [sysid.Prior(z[0] ** 2, 1e-4, 1e-6)], False),
    ],
)
def test_nothing_but_records_and_equations_that_are_linear_leaves_one_answer(damping, residuals, unique):
    """A product of unknowns, or something stated beside the records, may be met in other ways far away."""
    posed, z = problem((0, 1)), sysid.Variable("z", 2, lower=-0.2, upper=0.2)
    again = sysid.Problem(
        posed.measurement, mass=posed.mass, stiffness=posed.stiffness, damping=damping(z), residuals=residuals(z)
    )
    assert other_answers.is_unique_if_rank_is_full(again.prepared) is unique


def test_structures_are_apart_by_the_entry_of_any_matrix_that_differs_most():
    """Each over the root of the other's two diagonal entries: 0.3 of sqrt(5 * 4), 900 of 1.5e4, 2 of 15."""
    M, K = np.diag([5.0, 4.0, 0.0]), STRETCH.T @ np.diag(SPRINGS) @ STRETCH
    C = (STRETCH.T @ np.diag(DAMPERS) @ STRETCH)[:2, :2]
    G = np.ones((2, 1))

    def moved(mass=0.0, stiffness=0.0, damping=0.0):
        K_SS = K[:2, :2] + np.diag([0.0, stiffness])
        full = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        coupled = M + mass * np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 0]])
        return sysid.Structure(coupled, full, damping_matrix=C + np.diag([damping, 0.0]), n_base=1)

    for change, expected in (
        ({}, 0.0), ({"mass": 0.3}, 0.3 / np.sqrt(20)), ({"stiffness": 900.0}, 900 / 1.5e4),
        ({"damping": 2.0}, 2 / 15.0), ({"mass": 0.3, "damping": 2.0}, 2 / 15.0),
    ):  # fmt: skip
        assert other_answers._matrices_apart(moved(**change), moved()) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_same_seed_finds_the_same_bits():
    one, two = (sysid.identify(problem(rng=2), rng=2, **FROM_X) for _ in range(2))
    assert one.undetermined == two.undetermined
    np.testing.assert_array_equal(one.x, two.x)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_during_the_look_keeps_the_answer_and_says_so(ctrl_c):
    def interrupt(progress):
        if progress.phase == "other answers":
            os.kill(os.getpid(), signal.SIGINT)

    result = sysid.identify(problem(rng=2), rng=2, **FROM_X, callback=interrupt)
    assert result.interrupted
    assert result.success
    assert not result.determined
    np.testing.assert_allclose(result.values["spring"], SPRINGS, rtol=0.01)
    (told,) = (*result.contradictions, *result.open_findings)
    assert told.kind == "other answers" and "interrupted" in told.sentence


def test_a_callback_may_stop_it():
    def stop(progress):
        if progress.phase == "other answers":
            raise StopIteration

    result = sysid.identify(problem(rng=2), rng=2, **FROM_X, callback=stop)
    assert not result.determined
    (told,) = (*result.contradictions, *result.open_findings)
    assert told.kind == "other answers" and "callback" in told.sentence


def test_the_time_limit_ends_it(monkeypatch):
    from sysid.search.session import Session

    inner = other_answers.with_other_answers

    def late(posed, end, session):
        monkeypatch.setattr(Session, "is_over", True)
        return inner(posed, end, session)

    monkeypatch.setattr("sysid.results.judgement.with_other_answers", late)
    result = sysid.identify(problem(rng=2), rng=2, **FROM_X)
    (told,) = (*result.contradictions, *result.open_findings)
    assert told.kind == "other answers" and "time" in told.sentence


def test_too_many_unknowns_are_a_remark(monkeypatch):
    monkeypatch.setattr(other_answers, "_FEWEST_STARTS", 65)
    result = sysid.identify(problem(rng=2), rng=2, **FROM_X)
    assert len(result.of_kind("search")) == 1


def test_least_squares_from_many_starts_finds_every_root_and_keeps_to_the_box():
    """(10 u - 2)(10 u - 7) = 0 has two roots; v = 1.3 lies outside, where the nearest is v = 1."""

    def rows(points):
        u, v = 10 * points.T
        return np.stack([(u - 2) * (u - 7), v - 13], axis=1)

    points = np.random.default_rng(0).random((40, 2))
    search = LeastSquares(rows, points.copy())
    begun = search.left.copy()
    for _ in range(60):
        search.step()
    assert np.all(search.left <= begun)
    u, v = search.points.T
    np.testing.assert_allclose(v, 1.0)
    nearest = np.where(np.abs(u - 0.2) < np.abs(u - 0.7), 0.2, 0.7)
    np.testing.assert_allclose(u, nearest, atol=1e-6)
    assert {0.2, 0.7} == set(nearest)


def test_least_squares_slide_along_a_bound_to_its_least_and_look_nowhere_else():
    """``100 (u - v / 2 - 0.2)² + (v - 1.5)²`` is least at (0.95, 1.5); within the box at (0.7, 1), from anywhere."""

    def rows(points):
        assert np.all((points >= 0) & (points <= 1))  # differences too
        u, v = points.T
        return np.stack([10 * (u - v / 2 - 0.2), v - 1.5], axis=1)

    search = LeastSquares(rows, np.random.default_rng(0).random((40, 2)))
    for _ in range(60):
        search.step()
    np.testing.assert_allclose(search.points, np.broadcast_to([0.7, 1.0], (40, 2)), atol=1e-4)
