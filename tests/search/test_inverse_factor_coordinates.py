"""The published local phase: its error against the problem's own, exact derivatives, totals, and where it ends."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

from sysid.models.mass import total_of
from sysid.nlp import NonlinearProgram
from sysid.search import inverse_factor_coordinates as room
from sysid.search import local
from sysid.search.inverse_factor_coordinates import (
    InverseFactorError,
    cayley,
    coordinates_of,
    half_newton_decrement,
    skew_symmetric,
)
from sysid.structure.triangular import triangle_entries

CASES = {
    "trace": {"mass": "trace"},
    "rigid body": {"mass": "rigid_body"},
    "force": {"mass": "trace", "force": True},
    "force and rigid body": {"mass": "rigid_body", "force": True},
    "force weighs": {"mass": "rigid_body", "force": True, "total": False},
}


@pytest.fixture(params=CASES)
def case(request, random_case):
    """Truth, problem, and the truth's coordinates with its eigenvectors as Psi_0."""
    truth, problem = random_case(np.random.default_rng(3), **CASES[request.param], n=3, d=2)
    return truth, problem, *column_of(problem, truth)


def column_of(problem, structure):
    """One column of coordinates, and Psi_0, from the structure's matrices."""
    n, d, M = structure.n, structure.n_base, structure.mass
    G = problem.geometry.rigid_body
    R = np.linalg.inv(np.linalg.cholesky(M[:n, :n]))
    P = R @ (M[:n, :n] @ G + M[:n, n:])
    rigid = np.vstack([G, np.eye(d)])
    N = np.linalg.cholesky(rigid.T @ M @ rigid - P.T @ P)
    poles = np.log([2 * np.pi * structure.natural_frequencies, structure.damping_ratios]).ravel()
    of_mass = [triangle_entries(R), P.ravel(order="F")]
    if problem.measurement.force is not None:
        of_mass.append(triangle_entries(N))
    return np.concatenate([*of_mass, np.zeros(n * (n - 1) // 2), poles]), np.linalg.inv(R).T @ structure.normal_modes


def perturbed(problem, rng, by=0.3):
    x = problem.values(problem.reference)
    return np.clip(x * rng.uniform(1 - by, 1 + by, x.size), problem.lower, problem.upper)


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
    error = InverseFactorError(problem.prepared)
    assert float(error.gradient(y, psi)[0]) < 1e-20
    other = perturbed(problem, np.random.default_rng(0))
    objective = problem.objective(other)
    assert objective > 0.01
    at = column_of(problem, problem.structure(other))
    for value in (error.value(*at), error.gradient(*at)[0]):
        assert float(value) == pytest.approx(objective**2, rel=1e-9)


def test_the_coordinates_of_a_structure_are_those_of_its_matrices(case):
    truth, problem, y, psi = case
    made = coordinates_of(truth)
    own = [triangle_entries(made.inverse), made.loads.ravel(order="F")]
    own += [triangle_entries(made.base)] * (problem.measurement.force is not None)
    np.testing.assert_allclose(np.concatenate(own), y[: sum(map(len, own))], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(made.psi, psi, atol=1e-10)


def test_a_massless_base_begins_with_a_little_mass(random_case):
    """A factor of zero has no slope: the rigid-body mass it stands for is raised by a millionth."""
    truth, _ = random_case(np.random.default_rng(3), "lumped", n=3, d=2)
    made = coordinates_of(truth)
    own = truth.rigid_body_mass - made.loads.T @ made.loads
    assert abs(np.linalg.eigvalsh(own)[0]) < 1e-9 * np.trace(truth.rigid_body_mass)
    size = np.sqrt(np.diag(truth.rigid_body_mass))
    raised = (made.base @ made.base.T) / np.outer(size, size)
    assert np.linalg.eigvalsh(raised)[0] == pytest.approx(1e-6, rel=1e-3)


def test_gradient_and_exact_hessian_agree_with_differences_at_random_points(case):
    _, problem, y, psi = case
    error, rng, h = InverseFactorError(problem.prepared), np.random.default_rng(1), 1e-5
    for _ in range(3):
        at = y + 0.05 * rng.standard_normal(y.size)
        along = rng.standard_normal(y.size)
        steps = [error.gradient(at + k * h * along, psi) for k in (-2, -1, 1, 2)]
        values, slopes = ([np.asarray(step[i]).ravel() for step in steps] for i in (0, 1))
        gradient, hessian = np.asarray(error.gradient(at, psi)[1]).ravel(), np.asarray(error.hessian(at, psi))
        assert central(values, h).item() == pytest.approx(gradient @ along, rel=1e-7)
        assert np.linalg.norm(central(slopes, h) - hessian @ along) < 1e-6 * np.linalg.norm(hessian @ along)


def central(v, h):
    """Slope by differences of fourth order."""
    return (v[0] - 8 * v[1] + 8 * v[2] - v[3]) / (12 * h)


@pytest.mark.parametrize("kind", ["trace", "rigid_body"])
def test_totals_are_those_of_the_structures_mass_and_zero_at_the_truth(random_case, kind):
    """Tr M over a direction's sensors and its base row, or the diagonal of [G; I]' M [G; I], over what is stated."""
    truth, problem = random_case(np.random.default_rng(5), kind, n=4, d=2, force=True)
    error, d = InverseFactorError(problem.prepared), truth.n_base
    other, _ = random_case(np.random.default_rng(6), kind, n=4, d=2, force=True)
    assert not np.allclose(other.mass, truth.mass)
    for structure in (truth, other):
        M, G = structure.mass, problem.geometry.rigid_body
        rigid = np.vstack([G, np.eye(d)])
        strongest = np.argmax(np.abs(rigid), axis=1)
        traces = np.array([np.diag(M)[strongest == i].sum() for i in range(d)])
        total = {"trace": traces, "rigid_body": np.diag(rigid.T @ M @ rigid)}[kind]
        y, _ = column_of(problem, structure)
        rows = np.asarray(error.totals(*np.split(y[: sum(error.sizes[:3])], np.cumsum(error.sizes[:2])))).ravel()
        np.testing.assert_allclose(rows, total / problem.mass.total_mass - 1, atol=1e-10)


@pytest.mark.parametrize("kind", ["trace", "rigid_body"])
@pytest.mark.parametrize("force", [True, False])
def test_with_noise_stated_totals_are_met_and_the_fit_is_better_than_the_truth(random_case, kind, force):
    truth, problem = random_case(np.random.default_rng(8), kind, n=4, d=2, force=force, noise=0.01)
    start = perturbed(problem, np.random.default_rng(9), 0.1)
    end = local.solve(problem.prepared, start, coordinates="cholesky")
    assert end.success, end.message
    total = total_of(problem.geometry, problem.structure(end.x).mass, kind)
    np.testing.assert_allclose(total, problem.mass.total_mass, rtol=1e-9)
    assert problem.objective(end.x) < problem.objective(problem.values(truth))
    assert end.curve[-1] == pytest.approx(problem.objective(end.x), rel=1e-9)  # nothing was scaled afterwards


@pytest.mark.parametrize("coordinates", ["modal", "cholesky"])
@pytest.mark.parametrize("kind", ["trace", "rigid_body"])
def test_without_force_and_total_masses_are_scaled_and_the_response_is_kept(random_case, coordinates, kind):
    """1 kg a direction, of the kind that the mass model is healed by: its unknowns stand for what was fitted."""
    _, problem = random_case(np.random.default_rng(8), kind, n=4, d=2, total=False, noise=0.01)
    start = perturbed(problem, np.random.default_rng(9), 0.1)
    end = local.solve(problem.prepared, start, coordinates=coordinates)
    assert end.success, end.message
    assert end.curve[-1] == pytest.approx(problem.objective(end.x), rel=1e-6)


def test_from_near_the_truth_it_ends_at_an_exact_fit(case):
    truth, problem, *_ = case
    start = perturbed(problem, np.random.default_rng(2), 0.05)
    before = problem.objective(start)
    end = local.solve(problem.prepared, start, coordinates="cholesky")
    assert end.success, end.message
    assert problem.objective(end.x) < 1e-7 < 1e-2 < before
    found = problem.structure(end.x)
    np.testing.assert_allclose(found.natural_frequencies, truth.natural_frequencies, rtol=1e-7)
    np.testing.assert_allclose(found.damping_ratios, truth.damping_ratios, rtol=1e-5)
    assert np.linalg.eigvalsh(found.mass[: truth.n, : truth.n])[0] > 0


def test_the_plain_entries_find_the_truth_of_a_small_structure(random_case):
    """With more sensors they mostly stop far from it: tower, n = 6, 0.35 to 2.5 after 150 iterations."""
    truth, problem = random_case(np.random.default_rng(4), n=3, d=1)
    x = problem.values(truth)
    start = np.clip(x * np.random.default_rng(5).uniform(0.6, 1.4, x.size), problem.lower, problem.upper)
    end = local.solve(problem.prepared, start, coordinates="entries", max_iterations=60)
    assert end.success, end.message
    assert problem.objective(end.x) < 1e-7


@pytest.mark.parametrize("coordinates", ["modal", "cholesky"])
@pytest.mark.parametrize("n", [1, 2])
def test_proportional_damping_ends_where_it_is_said_to(random_case, coordinates, n):
    """One ratio has many alpha and beta; those of the answer lie in the search space and make it."""
    _, problem = random_case(np.random.default_rng(7), damping="proportional", n=n, d=1)
    start = np.clip(problem.values(problem.reference), problem.lower, problem.upper)
    start[problem.formulation.parts.damping] *= 0.9
    end = local.solve(problem.prepared, start, coordinates=coordinates)
    assert end.success, end.message
    assert problem.objective(end.x) < 1e-6
    damping = problem.formulation.parts.damping
    assert np.all((end.x[damping] >= problem.lower[damping]) & (end.x[damping] <= problem.upper[damping]))


@pytest.fixture
def rounds(random_case, monkeypatch):
    """A problem, a start, and a function that lets the rounds of IPOPT end as they are given."""
    _, problem = random_case(np.random.default_rng(4), n=2, d=1)
    x = np.clip(problem.values(problem.reference) * 1.3, problem.lower, problem.upper)

    def ending(*ends):
        left, limits = iter(ends), []

        def fit(problem, x, error, monitor, limit):
            limits.append(limit)
            share, status = next(left)
            return room.End(x, share * problem.objective(x), status, "")

        monkeypatch.setattr(room, "_fit_about", fit)
        return limits

    return problem, x, ending


def test_a_status_stays_with_the_point_that_it_was_given_for(rounds):
    """A further round that solves but ends worse vouches for nothing."""
    problem, x, ending = rounds
    ending((0.5, "Maximum_Iterations_Exceeded"), (9.0, "Solve_Succeeded"))
    end = local.solve(problem.prepared, x, coordinates="cholesky")
    assert not end.success
    assert "Maximum_Iterations_Exceeded" in end.message
    ending((9.0, "Solve_Succeeded"))
    end = local.solve(problem.prepared, x, coordinates="cholesky")
    assert not end.success
    assert "above the start" in end.message


def test_rounds_follow_while_the_limit_alone_ends_them_and_the_objective_falls(rounds):
    problem, x, ending = rounds
    limit = "Maximum_Iterations_Exceeded"
    limits = ending((0.9, limit), (0.899, limit), (0.5, "Solve_Succeeded"))
    assert local.solve(problem.prepared, x, coordinates="cholesky").success
    assert limits == [150, 150, 150]
    limits = ending((0.9, limit), (0.9, limit), (0.5, "Solve_Succeeded"))
    assert not local.solve(problem.prepared, x, coordinates="cholesky").success  # it no longer falls
    limits = ending((0.9, "Restoration_Failed"), (0.5, "Solve_Succeeded"))
    assert "Restoration_Failed" in local.solve(problem.prepared, x, coordinates="cholesky").message
    assert limits == [150]
    limits = ending((0.9, limit), (0.8, limit), (0.7, "Solve_Succeeded"))
    assert not local.solve(problem.prepared, x, coordinates="cholesky", max_iterations=200).success
    assert limits == [150, 50]


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
    other = perturbed(problem, rng)
    at = column_of(noisy, noisy.structure(other))
    assert noisy.objective(other) != pytest.approx(problem.objective(other), rel=1e-2)
    assert float(InverseFactorError(noisy.prepared).gradient(*at)[0]) == pytest.approx(
        noisy.objective(other) ** 2, rel=1e-9
    )


def test_derivatives_by_the_programs_unknowns_agree_with_differences(random_case):
    """Where the coordinates bend with the unknowns, as logarithms do, and equalities have multipliers."""
    truth, problem = random_case(np.random.default_rng(3), "trace", n=2, d=1, force=True)
    y, psi = column_of(problem, truth)
    z = NonlinearProgram()
    v = z.variable("v", np.zeros(y.size))
    rows = ca.vertcat(ca.sumsqr(v), ca.sin(v[0]) * v[1])
    z.constrain(rows)
    made = room._derivatives(z, ca.DM(y) + v + v**2, InverseFactorError(problem.prepared), psi)
    rng, h = np.random.default_rng(1), 1e-5
    at, along, multipliers = 0.05 * rng.standard_normal(y.size), rng.standard_normal(y.size), np.array([300.0, -700.0])
    constraint = ca.Function("g", [v], [ca.jacobian(rows, v).T @ ca.DM(multipliers)])

    def slope(at):
        return np.asarray(2 * made["grad_f"](at, [])[1] + constraint(at)).ravel()

    change = central([slope(at + k * h * along) for k in (-2, -1, 1, 2)], h)
    upper = np.asarray(made["hess_lag"](at, [], 2.0, multipliers))
    hessian = upper + np.triu(upper, 1).T
    assert np.linalg.norm(change - hessian @ along) < 1e-6 * np.linalg.norm(hessian @ along)


def test_half_the_newton_decrement_is_what_a_quadratic_has_to_gain():
    """(z - c)'A(z - c)/2 with z0 + z1 = 1 held and z3 on its bound: the least by hand, from the reduced equations."""
    A = np.diag([4.0, 2.0, 5.0, 3.0])
    A[0, 2] = A[2, 0] = 1.0
    c, at = np.array([0.3, -0.4, 2.0, -1.0]), np.array([0.25, 0.75, 0.0, 0.0])
    z = NonlinearProgram()
    v = z.variable("v", at, np.array([-np.inf, -np.inf, -np.inf, 0.0]))
    z.constrain(v[0] + v[1] - 1)
    value = (v - ca.DM(c)).T @ ca.DM(A) @ (v - ca.DM(c)) / 2
    hessian, gradient = ca.hessian(value, v)
    p, factor, multipliers = ca.MX.sym("p", 0), ca.MX.sym("factor"), ca.MX.sym("m", 1)
    made = {
        "grad_f": ca.Function("g", [v, p], [value, gradient]),
        "hess_lag": ca.Function("h", [v, p, factor, multipliers], [ca.triu(factor * hessian)]),
    }
    # With z1 = 1 - z0 and z3 = 0: stationary in z0 and z2.
    K = np.array([[A[0, 0] + A[1, 1], A[0, 2]], [A[0, 2], A[2, 2]]])
    rhs = np.array([A[0, 0] * c[0] + A[1, 1] * (1 - c[1]) + A[0, 2] * c[2], A[0, 2] * c[0] + A[2, 2] * c[2]])
    z0, z2 = np.linalg.solve(K, rhs)
    f = lambda x: (x - c) @ A @ (x - c) / 2  # noqa: E731
    found, gain = half_newton_decrement(z, made, at)
    assert found == pytest.approx(f(at))
    assert gain == pytest.approx(f(at) - f(np.array([z0, 1 - z0, z2, 0.0])))


def test_an_end_on_the_limit_says_how_much_chi_squared_is_left(random_case):
    """Beside what a fit that goes on gains: in units of what it leaves for each degree of freedom."""
    _, problem = random_case(np.random.default_rng(8), "trace", n=3, d=2, force=True, total=False, noise=0.01)
    start = perturbed(problem, np.random.default_rng(9), 0.02)
    solved = local.solve(problem.prepared, start, coordinates="cholesky")
    taken = solved.curve.size
    short = local.solve(problem.prepared, start, coordinates="cholesky", max_iterations=taken // 2)
    assert not short.success
    told = [float(word) for word in short.message.split("about ")[1].split(" chi²")[0].split(" of ")]
    before, after = (problem.objective(end.x) ** 2 for end in (short, solved))
    assert before > (1 + 1e-6) * after
    assert told[0] == pytest.approx((before - after) / before * told[1], rel=0.1)
    numbers = 2 * problem.measurement.freq.size * 2 * (3 + 2)  # real and imaginary, two runs, sensors and forces
    unknowns = 6 + 6 + 3 + 3 + 6
    assert told[1] == numbers - unknowns


def test_modes_that_changed_places_are_put_in_order(random_case):
    from sysid.modal_analysis.modal_fit import Modes
    from sysid.search.modal_coordinates import unknowns_of

    truth, problem = random_case(np.random.default_rng(6), "trace", n=3, d=1, force=True)
    mixed = [2, 0, 1]
    modes = Modes(
        truth.mode_shapes[:, mixed], truth.participation[mixed], 2 * np.pi * truth.natural_frequencies[mixed],
        truth.damping_ratios[mixed],
    )  # fmt: skip
    found = problem.structure(unknowns_of(problem, modes, truth.rigid_body_mass, truth, problem.values(truth)))
    for name in ("mass", "stiffness", "damping"):
        a, b = getattr(found, name)[:3, :3], getattr(truth, name)[:3, :3]
        np.testing.assert_allclose(a, b, atol=1e-8 * np.abs(b).max())
