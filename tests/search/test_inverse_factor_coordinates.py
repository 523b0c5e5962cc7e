"""The paper's local phase: its error against the problem's own, exact derivatives, and where it ends."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

from sysid.nlp import NonlinearProgram
from sysid.search import local
from sysid.search.cholesky_coordinates import CholeskyError, _derivatives, _unknowns, cayley, skew_symmetric

CASES = {
    "trace": {"mass": "trace"},
    "rigid body": {"mass": "rigid_body"},
    "force": {"mass": "trace", "force": True},
    "force weighs": {"mass": "rigid_body", "force": True, "total": False},
}


@pytest.fixture(params=CASES)
def case(request, random_case):
    """Truth, problem, and the truth's Cholesky coordinates with its eigenvectors as Psi_0."""
    truth, problem = random_case(np.random.default_rng(3), **CASES[request.param], n=3, d=2)
    return truth, problem, *coordinates_of(problem, truth)


def coordinates_of(problem, structure):
    n = structure.n
    L = np.linalg.cholesky(structure.mass[:n, :n])
    mass = problem.values(structure)[problem.formulation.parts.mass]
    poles = np.log([2 * np.pi * structure.natural_frequencies, structure.damping_ratios]).ravel()
    return np.concatenate([mass, np.zeros(n * (n - 1) // 2), poles]), L.T @ structure.normal_modes


def test_the_transform_of_a_skew_symmetric_matrix_is_a_rotation():
    """Of S = [[0, t], [-t, 0]] the Cayley transform turns by 2 atan(t)."""
    t = 0.3
    S = np.asarray(ca.evalf(ca.densify(skew_symmetric(ca.MX(ca.DM([-t])), 2))))
    np.testing.assert_array_equal(S, [[0, t], [-t, 0]])
    angle = 2 * np.arctan(t)
    turned = np.asarray(ca.evalf(cayley(ca.MX(ca.DM(S)))))
    np.testing.assert_allclose(turned, [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], atol=1e-15)


def test_the_error_at_the_truth_is_zero_and_elsewhere_the_problems_objective(case):
    _, problem, y, psi = case
    error = CholeskyError(problem)
    assert float(error.gradient(y, psi)[0]) < 1e-20
    rng = np.random.default_rng(0)
    x = problem.values(problem.reference)
    other = np.clip(x * rng.uniform(0.7, 1.3, x.size), problem.lower, problem.upper)
    objective = problem.objective(other)
    assert objective > 0.01
    assert float(error.gradient(*coordinates_of(problem, problem.structure(other)))[0]) == pytest.approx(
        objective**2, rel=1e-9
    )


def test_gradient_and_exact_hessian_agree_with_differences_at_random_points(case):
    _, problem, y, psi = case
    error, rng, h = CholeskyError(problem), np.random.default_rng(1), 1e-5
    for _ in range(3):
        at = y + 0.05 * rng.standard_normal(y.size)
        along = rng.standard_normal(y.size)
        steps = [error.gradient(at + k * h * along, psi) for k in (-2, -1, 1, 2)]
        values, slopes = ([np.asarray(step[i]).ravel() for step in steps] for i in (0, 1))
        central = lambda v: (v[0] - 8 * v[1] + 8 * v[2] - v[3]) / (12 * h)  # noqa: E731  fourth order
        gradient, hessian = np.asarray(error.gradient(at, psi)[1]).ravel(), np.asarray(error.hessian(at, psi))
        assert central(values).item() == pytest.approx(gradient @ along, rel=1e-7)
        assert np.linalg.norm(central(slopes) - hessian @ along) < 1e-6 * np.linalg.norm(hessian @ along)


def test_from_near_the_truth_it_ends_at_an_exact_fit_with_the_mass_inside_the_box(case):
    truth, problem, *_ = case
    rng = np.random.default_rng(2)
    x = problem.values(truth)
    start = np.clip(x * rng.uniform(0.95, 1.05, x.size), problem.lower, problem.upper)
    before = problem.objective(start)
    end = local.solve(problem, start, coordinates="cholesky")
    assert end.success, end.message
    assert problem.objective(end.x) < 1e-7 < 1e-2 < before
    found = problem.structure(end.x)
    np.testing.assert_allclose(found.natural_frequencies, truth.natural_frequencies, rtol=1e-7)
    np.testing.assert_allclose(found.damping_ratios, truth.damping_ratios, rtol=1e-5)
    assert np.linalg.eigvalsh(found.mass[: truth.n, : truth.n])[0] > 0
    mass = problem.formulation.parts.mass
    assert np.all((end.x[mass] >= problem.lower[mass]) & (end.x[mass] <= problem.upper[mass]))


def test_the_plain_entries_find_the_truth_of_a_small_structure(random_case):
    """With more sensors they mostly stop far from it: tower, n = 6, 0.35 to 2.5 after 150 iterations."""
    truth, problem = random_case(np.random.default_rng(4), n=3, d=1)
    x = problem.values(truth)
    start = np.clip(x * np.random.default_rng(5).uniform(0.6, 1.4, x.size), problem.lower, problem.upper)
    end = local.solve(problem, start, coordinates="entries", max_iterations=60)
    assert end.success, end.message
    assert problem.objective(end.x) < 1e-7


@pytest.mark.parametrize("coordinates", ["modal", "cholesky"])
@pytest.mark.parametrize("n", [1, 2])
def test_proportional_damping_ends_where_it_is_said_to(random_case, coordinates, n):
    """One ratio has many alpha and beta; those of the answer lie in the search space and make it."""
    _, problem = random_case(np.random.default_rng(7), damping="proportional", n=n, d=1)
    start = np.clip(problem.values(problem.reference), problem.lower, problem.upper)
    start[problem.formulation.parts.damping] *= 0.9
    end = local.solve(problem, start, coordinates=coordinates)
    assert end.success, end.message
    assert problem.objective(end.x) < 1e-6
    damping = problem.formulation.parts.damping
    assert np.all((end.x[damping] >= problem.lower[damping]) & (end.x[damping] <= problem.upper[damping]))


def test_a_status_stays_with_the_point_that_it_was_given_for(random_case, monkeypatch):
    """A further round that solves but ends worse vouches for nothing."""
    from sysid.search import cholesky_coordinates as room

    _, problem = random_case(np.random.default_rng(4), n=2, d=1)
    x = np.clip(problem.values(problem.reference) * 1.3, problem.lower, problem.upper)
    left = problem.objective(x)
    rounds = iter([room.End(x, 0.5 * left, "Maximum_Iterations_Exceeded", ""), room.End(x, 9.0, "Solve_Succeeded", "")])
    monkeypatch.setattr(room, "_fit_about", lambda *given: next(rounds))
    end = local.solve(problem, x, coordinates="cholesky")
    assert not end.success
    assert "Maximum_Iterations_Exceeded" in end.message
    worse = iter([room.End(x, 9.0, "Solve_Succeeded", "")])
    monkeypatch.setattr(room, "_fit_about", lambda *given: next(worse))
    end = local.solve(problem, x, coordinates="cholesky")
    assert not end.success
    assert "above the start" in end.message


def test_channels_and_lines_weigh_as_in_the_objective(random_case):
    """Noise that is stated by channel and line, of accelerations and force."""
    _, problem = random_case(np.random.default_rng(8), "trace", n=3, d=2, force=True)
    rng, test = np.random.default_rng(9), problem.measurement
    stated = dataclasses.replace(
        test,
        response_std=rng.uniform(0.1, 1.0, (test.n_sensors, 1)) * rng.uniform(0.1, 1.0, test.freq.size),
        force_std=rng.uniform(1.0, 9.0, (test.n_base, 1)) * rng.uniform(0.1, 1.0, test.freq.size),
    )
    noisy = dataclasses.replace(problem, measurement=stated)
    x = problem.values(problem.reference)
    other = np.clip(x * rng.uniform(0.7, 1.3, x.size), problem.lower, problem.upper)
    at = coordinates_of(noisy, noisy.structure(other))
    assert noisy.objective(other) != pytest.approx(problem.objective(other), rel=1e-2)
    assert float(CholeskyError(noisy).gradient(*at)[0]) == pytest.approx(noisy.objective(other) ** 2, rel=1e-9)


def test_derivatives_by_the_programs_unknowns_agree_with_differences(random_case):
    """Where the coordinates bend with the unknowns, as logarithms and scaled totals do."""
    truth, problem = random_case(np.random.default_rng(3), "trace", n=2, d=1)
    y, psi = coordinates_of(problem, truth)
    z = NonlinearProgram()
    v = z.variable("v", np.zeros(y.size))
    made = _derivatives(z.z, ca.DM(y) + v + v**2, CholeskyError(problem), psi)
    rng, h = np.random.default_rng(1), 1e-5
    at, along = 0.05 * rng.standard_normal(y.size), rng.standard_normal(y.size)
    slopes = [np.asarray(made["grad_f"](at + k * h * along, [])[1]).ravel() for k in (-2, -1, 1, 2)]
    change = (slopes[0] - 8 * slopes[1] + 8 * slopes[2] - slopes[3]) / (12 * h)
    upper = np.asarray(made["hess_lag"](at, [], 1.0, []))
    hessian = upper + np.triu(upper, 1).T
    assert np.linalg.norm(change - hessian @ along) < 1e-6 * np.linalg.norm(hessian @ along)


def test_modes_that_changed_places_are_put_in_order(random_case):
    truth, problem = random_case(np.random.default_rng(6), "trace", n=3, d=1)
    y, psi = coordinates_of(problem, truth)
    mixed = [2, 0, 1]
    omega, ratios = 2 * np.pi * truth.natural_frequencies[mixed], truth.damping_ratios[mixed]
    x = problem.values(truth)
    found = problem.structure(_unknowns(problem, x, y[problem.formulation.parts.mass], psi[:, mixed], omega, ratios))
    for name in ("mass", "stiffness", "damping"):
        a, b = getattr(found, name)[:3, :3], getattr(truth, name)[:3, :3]
        np.testing.assert_allclose(a, b, atol=1e-8 * np.abs(b).max())
