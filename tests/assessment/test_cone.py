"""Extremes of linear functions over convex sets of modal masses, against vertices, scans and another optimiser."""

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from sysid.assessment.cone import Cone, forms, null_space, unknowns


def random_functions(rng, q, n):
    p, r = rng.normal(size=(2, q, n))
    C = np.einsum("qi,qj->qij", p, r) / np.linalg.norm(p, axis=1)[:, None, None]
    return (C + np.swapaxes(C, 1, 2)) / 2


def own_limits(rng, n, d):
    """Weights of d limits that T = I meets, the first with equality."""
    weights = [rng.normal(size=(n, 2)) for _ in range(d)]
    return [W / np.linalg.norm(W) / (1 if i == 0 else rng.uniform(1, 2)) for i, W in enumerate(weights)]


def below(rng, n, d, room):
    """Weights with W' W <= I, with `room` (0: equality in every direction)."""
    W = rng.normal(size=(n, d))
    L = np.linalg.cholesky(W.T @ W + room * np.diag(rng.uniform(0.1, 2, d)))
    return np.linalg.solve(L, W.T).T


def check_members(cone, C, values, members, tolerance=1e-9):
    """Each value is attained by a T that is in the set."""
    finite = np.isfinite(values)
    assert np.all(np.isnan(members[~finite]))
    for T, c, value in zip(members[finite], C[finite], values[finite], strict=True):
        assert np.isclose(np.sum(c * T), value, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(T).max()))
        inside = np.zeros(T.shape, dtype=bool)
        for cluster in cone.clusters:
            inside[np.ix_(cluster, cluster)] = True
        assert not np.any(T[~inside])
        assert np.linalg.eigvalsh(T)[0] > -tolerance * max(1.0, np.abs(T).max())
        for W in cone.traces:
            assert np.trace(W.T @ T @ W) < 1 + 1e-8
        for W in cone.matrices:
            assert np.linalg.eigvalsh(W.T @ T @ W)[-1] < 1 + 1e-8
        for W in cone.fixed:
            assert np.allclose(W.T @ T @ W, W.T @ W, atol=1e-8)


def vertices(A, b):
    """All vertices of ``t >= 0, A t <= b``."""
    d, n = A.shape
    rows, right = np.vstack([A, -np.eye(n)]), np.concatenate([b, np.zeros(n)])
    found = []
    for active in combinations(range(n + d), n):
        part = rows[list(active)]
        if abs(np.linalg.det(part)) > 1e-12:
            t = np.linalg.solve(part, right[list(active)])
            if np.all(rows @ t <= right + 1e-9):
                found.append(t)
    return np.array(found)


@pytest.mark.parametrize(("n", "d"), [(1, 1), (2, 3), (4, 1), (4, 2), (5, 3)])
def test_sums_are_extreme_at_vertices(n, d):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        limits, C = own_limits(rng, n, d), random_functions(rng, 12, n)
        cone = Cone([[k] for k in range(n)], traces=limits)
        values, members = cone.largest(C)
        corners = vertices(np.array([np.sum(W**2, axis=1) for W in limits]), np.ones(d))
        expected = (np.einsum("qkk->qk", C) @ corners.T).max(axis=1)
        assert np.allclose(values, expected, rtol=1e-8, atol=1e-10)
        check_members(cone, C, values, members)


@pytest.mark.parametrize("room", [0.0, 0.3, 30.0])
def test_a_bounding_matrix_of_two_directions_against_a_scan_of_all_directions(room):
    """``W' T W <= I`` means ``u' W' T W u <= 1`` for every unit u: linear in t, one row a direction."""
    rng = np.random.default_rng(int(room))
    n = 4
    W, C = below(rng, n, 2, room), random_functions(rng, 4, n)
    cone = Cone([[k] for k in range(n)], matrices=[W])
    values, members = cone.largest(C)
    angle = np.linspace(0, np.pi, 2000, endpoint=False)
    rows = (W @ np.array([np.cos(angle), np.sin(angle)])).T ** 2
    scan = [-linprog(-np.diag(c), A_ub=rows, b_ub=np.ones(angle.size)).fun for c in C]
    assert np.allclose(values, scan, rtol=5e-6, atol=1e-8)  # the scan is a little too wide
    check_members(cone, C, values, members)


@pytest.mark.parametrize("room", [0.0, 1.0])
@pytest.mark.parametrize(("n", "d"), [(3, 3), (5, 3), (8, 6)])
def test_a_bounding_matrix_has_no_member_outside_and_a_multiplier_that_proves_it(n, d, room):
    """Weak duality: any Y >= 0 with ``w_k Y w_k' >= c_k`` for each mode shows ``c t <= trace Y``."""
    rng = np.random.default_rng(n)
    W, C = below(rng, n, d, room), random_functions(rng, 8, n)
    cone = Cone([[k] for k in range(n)], matrices=[W])
    values, members = cone.largest(C)
    check_members(cone, C, values, members)
    for c, value, T in zip(C, values, members, strict=True):
        # At the end of a barrier's central path such a Y is nearly the inverse of the slack, in some scale; a small
        # change x of it, of least norm in its own metric, makes the forms of the modes that take part equal to c_k.
        lam, V = np.linalg.eigh(np.eye(d) - W.T @ T @ W)
        B = W @ (V / np.sqrt(lam))
        heaviest = np.argmax(np.diag(T))
        B = B * np.sqrt(max(0.0, c[heaviest, heaviest]) / np.sum(B[heaviest] ** 2))
        active, pairs = np.diag(T) > 1e-5, unknowns([list(range(d))])
        one = forms(np.eye(d), np.eye(d), pairs)
        design = np.einsum("ka,abu,kb->ku", B, one, B)[active]
        x = one @ np.linalg.lstsq(design, (np.diag(c) - np.sum(B**2, axis=1))[active], rcond=1e-10)[0]
        assert np.linalg.eigvalsh(x)[0] > -1
        Y = np.linalg.lstsq(W, B, rcond=None)[0]  # its root: B = W Y
        Y = Y @ (np.eye(d) + x) @ Y.T
        short = np.maximum(np.diag(c) - np.einsum("ka,ab,kb->k", W, Y, W), 0.0)
        # What Y lacks for a mode is made up by that mode's own bound, t_k <= 1 / |w_k|².
        proof = np.trace(Y) + np.sum(short / np.sum(W**2, axis=1))
        assert value <= proof + 1e-9
        assert proof - value < 1e-6 * max(1.0, abs(value)), (proof, value)


def test_the_same_limit_twice_changes_nothing():
    """One limit has a closed form; stated twice it goes through a linear programme or the barrier."""
    rng = np.random.default_rng(3)
    for clusters in ([[0], [1], [2], [3]], [[0], [1, 2], [3]], [[0, 1, 2], [3]]):
        W, C = own_limits(rng, 4, 1), random_functions(rng, 10, 4)
        once, members = Cone(clusters, traces=W).largest(C)
        twice, _ = Cone(clusters, traces=[*W, *W]).largest(C)
        check_members(Cone(clusters, traces=W), C, once, members)
        finite = np.isfinite(once)
        assert np.array_equal(finite, np.isfinite(twice))
        assert np.allclose(once[finite], twice[finite], rtol=1e-7, atol=1e-7 * np.abs(once[finite]).max())


@pytest.mark.parametrize("clusters", [[[0, 1], [2]], [[0], [1, 2], [3]], [[0, 1, 2]]])
def test_open_clusters_against_another_optimiser(clusters):
    """T = L L' block by block, maximised by SciPy's SLSQP from several starts."""
    rng = np.random.default_rng(len(clusters))
    n = sum(map(len, clusters))
    limits, C = own_limits(rng, n, 2), random_functions(rng, 5, n)
    cone = Cone(clusters, traces=limits)
    values, members = cone.largest(C)
    check_members(cone, C, values, members)
    pairs = unknowns(clusters)

    def T(x):
        L = np.zeros((n, n))
        for (k, m), value in zip(pairs, x, strict=True):
            L[m, k] = value
        return L @ L.T

    rules = [{"type": "ineq", "fun": lambda x, W=W: 1 - np.trace(W.T @ T(x) @ W)} for W in limits]
    for c, value in zip(C, values, strict=True):
        runs = [
            minimize(lambda x, c=c: -np.sum(c * T(x)), start, constraints=rules, method="SLSQP",
                     options={"ftol": 1e-13, "maxiter": 500})
            for start in rng.normal(size=(6, len(pairs)))
        ]  # fmt: skip
        best = max(-run.fun for run in runs if max(-rule["fun"](run.x) for rule in rules) < 1e-9)
        assert np.isclose(value, best, rtol=1e-6, atol=1e-7)


class TestPartlyKnownCluster:
    """Two modes at one pole, of which a force in one direction weighs one combination: T11 = 1, T22 >= T12²."""

    cone = Cone([[0, 1]], fixed=[np.array([[1.0], [0.0]])])

    @pytest.mark.parametrize(("c12", "c22"), [(0.3, -1.0), (-2.0, -0.1), (0.0, 0.0), (0.0, -1.0)])
    def test_a_bounded_function_against_a_scan(self, c12, c22):
        C = np.array([[[0.7, c12], [c12, c22]]])
        values, members = self.cone.largest(C)
        x = np.linspace(-50, 50, 1_000_001)
        assert np.isclose(values[0], (0.7 + 2 * c12 * x + c22 * x**2).max(), rtol=1e-9)
        check_members(self.cone, C, values, members)

    @pytest.mark.parametrize(("c12", "c22"), [(0.3, 1.0), (0.0, 1e-3), (0.5, 0.0)])
    def test_an_unbounded_function_grows_along_members(self, c12, c22):
        values, members = self.cone.largest(np.array([[[0.7, c12], [c12, c22]]]))
        assert values[0] == np.inf and np.all(np.isnan(members))
        x = 1e10
        assert 0.7 + 2 * c12 * x + c22 * x**2 > 1e6

    def test_the_combination_that_is_weighed_is_known(self):
        C = np.array([[[1.0, 0.0], [0.0, 0.0]], [[-1.0, 0.0], [0.0, 0.0]]])
        assert np.allclose(self.cone.largest(C)[0], [1, -1], rtol=1e-12)

    def test_a_limit_beside_it_against_a_scan(self):
        """T11 = 1, T22 >= T12², and a trace: all on a plane of two unknowns."""
        W = np.array([[0.3, 0.2], [-0.4, 0.5]])
        W /= np.linalg.norm(W) * 1.3
        cone = Cone([[0, 1]], fixed=[np.array([[0.8], [0.6]])], traces=[W])
        C = random_functions(np.random.default_rng(0), 6, 2)
        values, members = cone.largest(C)
        check_members(cone, C, values, members)
        turn = np.array([[0.8, -0.6], [0.6, 0.8]])  # its first column is weighed
        w, c = turn.T @ W @ W.T @ turn, turn.T @ C @ turn
        corners = np.roots([w[1, 1], 2 * w[0, 1], w[0, 0] - 1])
        x = np.append(np.linspace(*corners, 100_001), corners)
        most = (1 - w[0, 0] - 2 * w[0, 1] * x) / w[1, 1]  # T22 from x² to this
        can = most >= x**2 - 1e-9
        for value, one in zip(values, c, strict=True):
            ends = [(one[0, 0] + 2 * one[0, 1] * x + one[1, 1] * t22)[can].max() for t22 in (x**2, most)]
            assert np.isclose(value, max(ends), rtol=1e-6)


def test_without_any_limit_functions_are_zero_or_without_end():
    cone = Cone([[0], [1], [2, 3]])
    C = np.zeros((4, 4, 4))
    C[0] = -np.diag([1, 0, 2, 3])
    C[1] = np.diag([-1, 1e-3, 0, 0])
    C[2, 2, 3] = C[2, 3, 2] = 0.5  # an off-diagonal entry of a cluster goes both ways
    values, members = cone.largest(C)
    assert np.array_equal(values, [0, np.inf, np.inf, 0])
    check_members(cone, C, values, members)


def test_a_mode_that_no_limit_weighs_has_no_upper_end():
    W = np.array([[0.6], [0.0], [0.5]])
    cone = Cone([[0], [1], [2]], traces=[W])
    C = np.array([np.diag(c) for c in ([1.0, 0, 0], [0, 1.0, 0], [1, -1.0, 1], [0, 0, -1.0])])
    values, members = cone.largest(C)
    assert np.allclose(values, [1 / 0.36, np.inf, 1 / 0.25, 0])
    check_members(cone, C, values, members)


def test_equations_leave_a_scale_and_a_limit_ends_it():
    """t1 = t2 and t2 = 2 t3 - t1: one ray; its sign is that of any mode."""
    equations = np.array([[1.0, -1, 0], [1, 1, -2]])
    C = np.array([np.diag(c) for c in ([1.0, 2, 3], [-1, 0, 0], [1, -1, 0.0], [0.0, 1, 0])])
    free = Cone([[0], [1], [2]], equations=equations, signs=np.eye(3))
    values, _ = free.largest(C)
    assert np.allclose(values, [np.inf, 0, 0, np.inf])
    W = np.full((3, 1), 0.5)
    values, members = Cone([[0], [1], [2]], traces=[W], equations=equations, signs=np.eye(3)).largest(C)
    assert np.allclose(values, [8, 0, 0, 4 / 3], atol=1e-9)
    assert np.allclose(members[0], np.eye(3) * 4 / 3)
    for matrix in (below(np.random.default_rng(0), 3, 2, 0.5), below(np.random.default_rng(1), 3, 3, 0.0)):
        reach = 1 / np.linalg.eigvalsh(matrix.T @ matrix)[-1]
        values, _ = Cone([[0], [1], [2]], matrices=[matrix], equations=equations, signs=np.eye(3)).largest(C)
        assert np.allclose(values, [6 * reach, 0, 0, reach], rtol=1e-7, atol=1e-6)


def test_a_bounding_matrix_that_misses_a_mode_beside_equations():
    """t1 = t2 with a bound on both, t3 free: functions of t3 go on, those of t1 do not."""
    W = np.array([[0.5, 0.1], [0.2, 0.4], [0.0, 0.0]])
    cone = Cone([[0], [1], [2]], matrices=[W], equations=np.array([[1.0, -1, 0]]), signs=np.eye(3))
    C = np.array([np.diag(c) for c in ([1.0, 1, 0], [0, 1, 1.0], [1, 1, -1.0], [-1.0, 0, 0])])
    values, members = cone.largest(C)
    reach = 1 / np.linalg.eigvalsh(W.T @ W)[-1]
    assert np.allclose(values, [2 * reach, np.inf, 2 * reach, 0], rtol=1e-6, atol=1e-6)
    check_members(cone, C, values, members)


def test_a_remainder_without_room_is_met_through_what_varies():
    """The bound on the weighed modes is met with equality; what is open may still move under it."""
    rng = np.random.default_rng(5)
    own = rng.normal(size=(4, 3))
    rest = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.0]])  # singular
    L = np.linalg.cholesky(own.T @ own + rest)
    W = np.linalg.solve(L, own.T).T
    fixed = [np.eye(4)[:, [k]] for k in range(3)]
    cone = Cone([[k] for k in range(4)], fixed=fixed, matrices=[W])
    C = np.zeros((2, 4, 4))
    C[0, 3, 3], C[1, 3, 3] = 1.0, -1.0
    values, members = cone.largest(C)
    # t4 w4' w4 <= I - sum of the others: the largest generalised t.
    gap = np.eye(3) - W[:3].T @ W[:3]
    assert np.allclose(values, [1 / (W[3] @ np.linalg.solve(gap, W[3])), 0], rtol=1e-7, atol=1e-9)
    check_members(cone, C, values, members)


def test_forms_are_the_coefficients_of_a_symmetric_matrix():
    rng = np.random.default_rng(0)
    clusters = [[0], [1, 2], [3, 4, 5]]
    pairs = unknowns(clusters)
    x = rng.normal(size=len(pairs))
    T = np.zeros((6, 6))
    for (k, m), value in zip(pairs, x, strict=True):
        T[k, m] = T[m, k] = value
    left, right = rng.normal(size=(6, 3)), rng.normal(size=(6, 2))
    assert np.allclose(forms(left, right, pairs) @ x, left.T @ T @ right, rtol=1e-13)


def test_the_null_space_is_orthonormal_and_solves_the_equations():
    A = np.random.default_rng(0).normal(size=(3, 5))
    N = null_space(A)
    assert N.shape == (2, 5) and np.allclose(N @ N.T, np.eye(2)) and np.allclose(A @ N.T, 0)
    assert np.array_equal(null_space(np.zeros((0, 4))), np.eye(4))
