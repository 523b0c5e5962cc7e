"""Eigenvalue refinement: both ways reach the target; the closed form is the nearest and stays in the box."""

import casadi as ca
import numpy as np
import pytest

from benchmarks.swarm.refinement_by_ipopt import derivative_errors
from sysid import InputError
from sysid.models.spectrum import SpectrumDistance, by_ipopt, nearest_factors, replace_spectrum

SIZES = range(3, 13)
PER_SIZE = 10  # candidates, 100 over n = 3 to 12 ...
LARGE = 8  # ... but above this size one alone for IPOPT, which takes up to a second: each case at one size


def factor_in_the_box(rng, n, limit):
    """As the swarm draws it: uniform, with the floor on the diagonal."""
    L = np.tril(rng.uniform(-limit, limit, (n, n)))
    np.fill_diagonal(L, rng.uniform(1e-3 * limit, limit, n))
    return L


def candidate(rng, n, case):
    """A random candidate and targets: all distinct, pairs repeated, or fewer than n."""
    low = 2 * np.pi * rng.uniform(0.5, 5)
    targets = np.sort(low * 10 ** rng.uniform(0, 1.3, n))
    if case == "repeated":
        for i in range(0, n - 1, 2):
            targets[i + 1] = targets[i]
    if case == "triple":
        targets[:3] = targets[0]
    limit = targets[-1] * 1.05
    if case == "fewer":
        targets = targets[: max(1, n - int(rng.integers(1, 3)))]
    return factor_in_the_box(rng, n, limit), targets, limit


CASES = ("distinct", "repeated", "triple", "fewer")


def off(factor, targets):
    """Largest relative error of an eigenvalue of L_H L_H', by singular values of L_H."""
    own = np.sort(np.linalg.svd(factor, compute_uv=False))
    return np.max(np.abs((own[: targets.size] / targets) ** 2 - 1))


def closed_form(factor, targets):
    return nearest_factors(factor[None], targets)[0]


def solved(factor, targets):
    """By IPOPT, which has to succeed and to tell how far it is off."""
    answer = by_ipopt(factor, targets)
    assert answer.success, answer.status
    assert answer.error == pytest.approx(off(answer.factor, targets), abs=1e-12)
    return answer.factor


@pytest.mark.parametrize("way", [closed_form, solved])
@pytest.mark.parametrize("n", SIZES)
def test_reaches_the_target_spectrum_from_random_candidates(way, n):
    for index in range(PER_SIZE) if way is closed_form or n <= LARGE else [n - LARGE - 1]:
        rng = np.random.default_rng([n, index])
        L, targets, _ = candidate(rng, n, CASES[index % 4])
        refined = way(L, targets)
        assert off(refined, targets) <= 1e-8, (index, CASES[index % 4])
        np.testing.assert_array_equal(refined, np.tril(refined))
        assert np.all(np.diag(refined) > 0)


@pytest.mark.parametrize("way", [closed_form, solved])
@pytest.mark.parametrize("case", ["distinct", "repeated"])
def test_a_candidate_whose_own_eigenvalues_repeat(random_orthogonal, way, case):
    """H with a triple eigenvalue: its eigenvectors are not unique, the target is reached all the same."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        q = random_orthogonal(rng, 5)
        H = (q * np.array([1.0, 4, 4, 4, 9]) * 100) @ q.T
        _, targets, _ = candidate(rng, 5, case)
        own = np.sort(np.linalg.svd(way(np.linalg.cholesky((H + H.T) / 2), targets), compute_uv=False))
        np.testing.assert_allclose(own**2, targets**2, rtol=1e-8)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("case", ["distinct", "repeated", "triple"])
def test_the_closed_form_is_the_nearest_matrix_of_that_spectrum(random_orthogonal, seed, case):
    """Hoffman-Wielandt: no matrix with this spectrum is nearer than sqrt(sum (lam_i - t_i)²), both sorted."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 9))
    L, targets, _ = candidate(rng, n, case)
    H, answer = L @ L.T, closed_form(L, targets)
    distance = np.linalg.norm(answer @ answer.T - H)
    bound = np.linalg.norm(np.linalg.eigvalsh(H) - targets**2)
    assert distance == pytest.approx(bound, rel=1e-9)
    _, psi = np.linalg.eigh(H)
    for _ in range(50):
        angle = rng.choice([1e-3, 1e-1, 10.0])
        q = psi @ np.linalg.qr(np.eye(n) + angle * rng.normal(size=(n, n)))[0]
        assert np.linalg.norm((q * targets**2) @ q.T - H) >= distance * (1 - 1e-12)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("case", CASES)
def test_the_closed_form_stays_in_the_box(seed, case):
    """Its rows have norm sqrt(H_ii) <= the highest frequency (eq. 37)."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 10))
    L, targets, limit = candidate(rng, n, case)
    answer = closed_form(L, targets)
    if case == "fewer":
        limit = max(limit, np.linalg.svd(L, compute_uv=False)[0])  # what is not replaced keeps its size
    assert np.all(np.abs(answer) <= limit * (1 + 1e-12))


@pytest.mark.parametrize("seed", range(10))
def test_a_target_that_is_met_already_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    L = factor_in_the_box(rng, 5, 100.0)
    own = np.sort(np.linalg.svd(L, compute_uv=False))
    answer = closed_form(L, own)
    np.testing.assert_allclose(answer @ answer.T, L @ L.T, atol=1e-9 * own[-1] ** 2)


@pytest.mark.parametrize("seed", range(10))
def test_ipopt_starts_from_the_candidates_own_factor(seed):
    """Not from a fresh diagonal, half of its norm away: a candidate that has the target already hardly moves."""
    rng = np.random.default_rng(seed)
    L = factor_in_the_box(rng, 5, 100.0)
    answer = by_ipopt(L, np.sort(np.linalg.svd(L, compute_uv=False))).factor
    assert np.linalg.norm(answer @ answer.T - L @ L.T) < 0.05 * np.linalg.norm(L @ L.T)


@pytest.mark.parametrize(("n", "m"), [(2, 1), (3, 3), (4, 2), (5, 5), (8, 7)])
def test_ipopt_is_given_exact_derivatives(n, m):
    """Against complex steps, in NumPy's complex numbers, of the objective and of a slope that is checked by it."""
    for seed in range(3):
        gradient, hessian = derivative_errors(n, m, seed)
        assert gradient < 1e-8
        assert hessian < 1e-8


def test_derivatives_are_exact_where_eigenvalues_of_one_target_coincide(random_orthogonal):
    """As at the solution for repeated frequencies: against differences of fourth order."""
    rng = np.random.default_rng(0)
    q = random_orthogonal(rng, 4)
    H = (q * np.array([1.0, 1.0, 4.0, 9.0])) @ q.T
    distance = SpectrumDistance(4, np.array([1.1, 1.1, 1.9, 3.2]))
    x, h = np.linalg.cholesky((H + H.T) / 2)[np.tril_indices(4)], 1e-3
    steps = h * np.eye(x.size)

    def differences(function):
        return [(8 * (function(x + s) - function(x - s)) - (function(x + 2 * s) - function(x - 2 * s))) / (12 * h)
                for s in steps]  # fmt: skip

    np.testing.assert_allclose(distance.gradient(x), differences(distance.value), atol=1e-9)
    np.testing.assert_allclose(distance.hessian(x), differences(distance.gradient), atol=1e-8)


class _Altered:
    """A solver that gives another status, or its start for an answer."""

    def __init__(self, solver, status, stays):
        self.solver, self.status, self.stays = solver, status, stays

    def __call__(self, **arguments):
        solution = self.solver(**arguments)
        return solution | {"x": arguments["x0"]} if self.stays else solution

    def stats(self):
        return self.solver.stats() | {"return_status": self.status}


@pytest.mark.parametrize(
    ("status", "stays", "success"),
    [
        ("Solve_Succeeded", False, True),
        ("Solved_To_Acceptable_Level", False, True),
        ("Restoration_Failed", False, False),
        ("Maximum_Iterations_Exceeded", False, False),
        ("Solve_Succeeded", True, False),
    ],
)
def test_success_is_what_ipopt_says_and_the_spectrum_shows(monkeypatch, status, stays, success):
    solver = ca.nlpsol
    L = np.array([[10.0, 0.0], [3.0, 20.0]])
    lowest = np.linalg.svd(L, compute_uv=False).min()
    with monkeypatch.context() as patched:
        patched.setattr(ca, "nlpsol", lambda *arguments: _Altered(solver(*arguments), status, stays))
        answer = by_ipopt(L, np.array([1.1 * lowest]))
    assert answer.success == success
    assert answer.status == status + ", spectrum missed" * stays
    assert answer.error == pytest.approx(1 - 1 / 1.21 if stays else 0.0, abs=1e-8)


@pytest.mark.parametrize("name", ["value", "gradient", "hessian"])
def test_ctrl_c_within_ipopt_is_not_taken_for_a_step_too_long(monkeypatch, name):
    def interrupted(self, x):
        raise KeyboardInterrupt

    monkeypatch.setattr(SpectrumDistance, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        by_ipopt(np.array([[10.0, 0.0], [3.0, 20.0]]), np.array([5.0, 9.0]))


@pytest.mark.parametrize("way", [closed_form, solved])
@pytest.mark.parametrize("seed", range(4))
def test_with_fewer_targets_the_replaced_are_the_lowest(way, seed):
    """Also where the candidate's others lie below the targets: they are lifted to the highest of them."""
    rng = np.random.default_rng(seed)
    L = factor_in_the_box(rng, 6, 100.0)
    own = np.sort(np.linalg.svd(L, compute_uv=False))
    for targets in (own[:3] * 0.9, own[[2, 4, 5]] * 1.01, own[:1] * 3):
        found = np.sort(np.linalg.svd(way(L, targets), compute_uv=False))
        np.testing.assert_allclose(found[: targets.size], targets, rtol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_replace_spectrum_leaves_the_others_alone(seed):
    rng = np.random.default_rng(seed)
    lam = np.sort(rng.uniform(1, 100, (7, 5)), axis=1)
    targets = np.array([0.5, 0.9])
    out = replace_spectrum(lam, targets)
    np.testing.assert_allclose(out[:, :2], [[0.25, 0.81]] * 7)
    np.testing.assert_array_equal(out[:, 2:], lam[:, 2:])
    lifted = replace_spectrum(lam, np.array([3.0, 20.0]))
    assert np.all(np.diff(lifted, axis=1) >= 0)
    np.testing.assert_array_equal(lifted[:, 2:], 400.0)


@pytest.mark.parametrize("way", [closed_form, solved])
def test_more_targets_than_eigenvalues(way):
    with pytest.raises(InputError, match="4 target frequencies for a model with 3"):
        way(np.eye(3), np.arange(1.0, 5))
