"""Results of each form of the matrices, and of constraints, healing, and fixed variables in a problem."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.problem.direct_response import relative_misfit

FREQ = np.linspace(1.0, 30.0, 25)
ONE = np.ones((3, 1))
MASSES, SPRINGS, DAMPERS = np.array([3.0, 2.0, 1.0]), np.array([2e4, 1.5e4, 1e4]), np.array([8.0, 5.0, 3.0])


def chain(k):
    """As an expression, or of numbers."""
    T = np.eye(3) - np.eye(3, k=-1)
    return T.T @ np.diag(k) @ T if isinstance(k, np.ndarray) else ca.DM(T).T @ ca.diag(k) @ ca.DM(T)


def with_base(K, G=ONE):
    """With the columns and rows of the base that its rigid motion asks for."""
    if isinstance(K, np.ndarray):
        return np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    return ca.blockcat([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])


def whole_mass(m, coupling=0.0, base=0.0):
    if isinstance(m, np.ndarray):
        return np.block([[np.diag(m), coupling * ONE], [coupling * ONE.T, np.array([[base]])]])
    return ca.blockcat([[ca.diag(m), coupling * ONE], [coupling * ONE.T, base]])


TRUTH = sysid.Structure(whole_mass(MASSES), with_base(chain(SPRINGS)), damping_matrix=chain(DAMPERS), n_base=1)
TEST = sysid.simulate(TRUTH, FREQ)
FORCED = sysid.simulate(TRUTH, FREQ, force=True)
COUPLED = sysid.Structure(
    whole_mass(MASSES, 0.1, 0.9), with_base(chain(SPRINGS)), damping_matrix=chain(DAMPERS), n_base=1
)


def unknown(name, values, **options):
    values = np.asarray(values)
    return sysid.Variable(name, values.shape, lower=values / 9, upper=values * 9, guess=values, **options)


def same(made, expected, rtol=1e-12):
    for name in ("mass", "stiffness", "damping", "damping_ratios", "recovery", "rigid_body"):
        np.testing.assert_allclose(getattr(made, name), getattr(expected, name), rtol=rtol, atol=1e-9, err_msg=name)


def m():
    return unknown("m", MASSES)


def k():
    return unknown("k", SPRINGS)


def c():
    return unknown("c", DAMPERS)


FORMS = {
    "three expressions": lambda: (ca.diag(m()), chain(k()), chain(c())),
    "mass as a number": lambda: (np.diag(MASSES), chain(k()), chain(c())),
    "mass as DM": lambda: (ca.DM(np.diag(MASSES)), chain(k()), chain(c())),
    "mass as whole numbers": lambda: (np.diag([3, 2, 1]), chain(k()), chain(c())),
    "mass as nested numbers": lambda: ([[3, 0, 0], [0, 2, 0], [0, 0, 1.0]], chain(k()), chain(c())),
    "mass as nested expressions": lambda: (
        (lambda v: [[v[0], 0, 0], [0, v[1], 0], [0, 0, v[2]]])(m()), chain(k()), chain(c())
    ),
    "stiffness as an object array": lambda: (
        np.diag(MASSES),
        (lambda v: np.array([[v[0] + v[1], -v[1], 0], [-v[1], v[1] + v[2], -v[2]], [0, -v[2], v[2]]]))(k()),
        chain(c()),
    ),
    "a scale times numbers": lambda: (np.diag(MASSES), unknown("s", 1.0) * chain(SPRINGS), chain(c())),
    "numbers times a scale": lambda: (np.diag(MASSES), chain(SPRINGS) * unknown("s", 1.0), chain(c())),
    "mass with the base": lambda: (whole_mass(m()), chain(k()), chain(c())),
    "stiffness with the base": lambda: (np.diag(MASSES), with_base(chain(k())), chain(c())),
    "both with the base": lambda: (whole_mass(m()), with_base(chain(k())), chain(c())),
    "everything with the base": lambda: (whole_mass(m()), with_base(chain(k())), with_base(chain(c()))),
    "a matrix of unknowns": lambda: (
        np.diag(MASSES), (lambda A: (A + A.T) / 2)(sysid.Variable(
            "A", (3, 3), lower=-9e4, upper=9e4, guess=chain(SPRINGS))), chain(c())
    ),
    "slices and sums in several matrices": lambda: (
        (lambda p: (ca.diag(1e-4 * ca.vertcat(1.5 * p[0], 2 * p[2], p[2])), chain(p), 1e-4 * ca.diag(p)))(k())
    ),
    "damping in terms of the others": lambda: (
        (lambda a, b: (ca.diag(a), chain(b), 0.3 * ca.diag(a) + 1e-4 * chain(b)))(m(), k())
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_the_guess_stands_for_the_matrices_as_written(form):
    mass, stiffness, damping = FORMS[form]()
    problem = sysid.Problem(TEST, mass=mass, stiffness=stiffness, damping=damping)
    made = problem.structure(problem.formulation.guess)
    if form.startswith("slices"):
        np.testing.assert_allclose(np.diag(made.mass)[:3], [3, 2, 1])
        np.testing.assert_allclose(made.stiffness, TRUTH.stiffness, atol=1e-9)
        np.testing.assert_allclose(made.damping, 1e-4 * np.diag(SPRINGS))
    elif form.startswith("damping"):
        np.testing.assert_allclose(made.damping, 0.3 * np.diag(MASSES) + 1e-4 * chain(SPRINGS))
    else:
        same(made, TRUTH)
    assert problem.n_variables == sum(v.size for v in problem.variables) == len(problem.formulation.labels)


@pytest.mark.parametrize(
    ("mass", "stiffness", "damping"),
    [
        (lambda: ca.MX(ca.DM(np.diag(MASSES))), lambda: chain(k()), lambda: chain(c())),
        (lambda: ca.diag(m()), chain(SPRINGS), chain(DAMPERS)),
        (lambda: ca.diag(m()), with_base(chain(SPRINGS)), chain(DAMPERS).tolist()),
        (lambda: np.diag(MASSES), lambda: chain(k()), chain(DAMPERS)),
        (lambda: ca.diag(m()), lambda: ca.DM(chain(SPRINGS)), ca.DM(chain(DAMPERS))),
    ],
)
def test_numbers_are_matrices_that_are_known(mass, stiffness, damping):
    given = [part() if callable(part) else part for part in (mass, stiffness, damping)]
    problem = sysid.Problem(TEST, mass=given[0], stiffness=given[1], damping=given[2])
    same(problem.structure(problem.formulation.guess), TRUTH)


def test_known_numbers_with_a_recovery():
    R = np.eye(3)[[0, 2]]
    test = sysid.Measurement(TEST.freq, TEST.base, TEST.response[:, [0, 2]], rigid_body=R @ ONE)
    problem = sysid.Problem(
        test, mass=np.diag(MASSES), stiffness=chain(k()), damping=chain(c()), recovery=R, rigid_body_dofs=ONE
    )
    assert problem.objective(problem.formulation.guess) < 1e-12


def test_coupling_and_base_mass_are_the_last_rows():
    a, b = unknown("a", 0.1), unknown("b", 0.9)
    problem = sysid.Problem(
        sysid.simulate(COUPLED, FREQ, force=True), mass=whole_mass(m(), a, b), stiffness=chain(k()), damping=chain(c())
    )
    x = problem.formulation.guess
    same(problem.structure(x), COUPLED)
    assert problem.objective(x) < 1e-12
    np.testing.assert_allclose(problem.totals, COUPLED.rigid_body_mass.diagonal())


@pytest.mark.parametrize("of", ["numbers", "a variable", "an expression", "ModalDamping"])
def test_damping_by_ratios(of):
    ratios = np.array([0.01, 0.02, 0.03])
    truth = sysid.Structure(TRUTH.mass, TRUTH.stiffness, ratios, n_base=1)
    z = {
        "numbers": lambda: ratios, "a variable": lambda: unknown("z", ratios),
        "an expression": lambda: 0.01 * ca.vertcat(1, 2, unknown("f", 3.0)),
        "ModalDamping": lambda: sysid.ModalDamping(0.001, 0.2),
    }[of]()  # fmt: skip
    problem = sysid.Problem(sysid.simulate(truth, FREQ), mass=ca.diag(m()), stiffness=chain(k()), damping=z)
    x = problem.formulation.guess
    if of == "ModalDamping":
        x[:3] = ratios  # unknowns of models come first
    assert problem.formulation.matrices.by_ratios
    same(problem.structure(x), truth, 1e-10)
    assert problem.objective(x) < 1e-12


def test_models_and_expressions_mix():
    s = unknown("s", 1.0)
    chained = sysid.Problem(
        TEST, mass=s * np.diag(MASSES), stiffness=sysid.ChainStiffness(1e3, 1e5), damping=chain(c())
    )
    # Unknowns of models first, in the order mass, stiffness, damping, then the variables as declared.
    assert [v.name for v in chained.variables] == ["spring", "s", "c"]
    same(chained.structure(np.concatenate([SPRINGS, [1.0], DAMPERS])), TRUTH, 1e-9)
    proportional = sysid.Problem(
        TEST, mass=sysid.LumpedMass(6.0), stiffness=chain(k()), damping=sysid.ProportionalDamping((0, 1), (0, 1e-3))
    )
    assert [v.name for v in proportional.variables] == ["mass_share", "rayleigh_alpha", "rayleigh_beta", "k"]
    x = np.concatenate([MASSES / 3, [0.4, 2e-4], SPRINGS])
    expected = sysid.Structure(
        TRUTH.mass, TRUTH.stiffness, n_base=1, damping_matrix=0.4 * np.diag(MASSES) + 2e-4 * chain(SPRINGS)
    )
    same(proportional.structure(x), expected, 1e-9)


def test_a_full_mass_with_springs_is_healed_to_its_total():
    problem = sysid.Problem(TEST, mass=sysid.FullMass(6.0), stiffness=chain(k()), damping=chain(c()))
    x = np.random.default_rng(0).uniform(problem.lower, problem.upper)
    np.testing.assert_allclose(np.trace(problem.structure(x).mass), 6.0)


def test_spectral_stiffness_goes_with_a_written_mass():
    problem = sysid.Problem(
        TEST, mass=ca.diag(m()), stiffness=sysid.SpectralStiffness(TRUTH.natural_frequencies), damping=chain(c())
    )
    x = problem.formulation.guess
    H = np.diag(2 * np.pi * TRUTH.natural_frequencies)[np.tril_indices(3)]
    x[:6] = H
    np.testing.assert_allclose(problem.structure(x).natural_frequencies, TRUTH.natural_frequencies, rtol=1e-10)


def test_the_base_columns_of_the_stiffness_tell_the_motion_of_degrees_of_freedom():
    G = np.array([[1.0], [0.5], [2.0]])
    R = np.array([[1.0, 0, 0], [0.2, 0, 0.8]])
    K = chain(SPRINGS)
    truth = sysid.Structure(
        whole_mass(MASSES), with_base(K, G), damping_matrix=chain(DAMPERS), n_base=1, recovery=R, rigid_body=R @ G
    )
    test = sysid.Measurement.from_frf(FREQ, truth.transmissibility(FREQ), rigid_body=R @ G, base_axes=["rx"])
    problem = sysid.Problem(test, mass=ca.diag(m()), stiffness=with_base(chain(k()), G), damping=chain(c()), recovery=R)
    np.testing.assert_allclose(problem.formulation.matrices.rigid_body, G, rtol=1e-10)
    same(problem.structure(problem.formulation.guess), truth, 1e-9)
    assert problem.objective(problem.formulation.guess) < 1e-12


def test_a_fixed_variable_is_a_number_and_no_unknown():
    free = sysid.Problem(TEST, mass=ca.diag(m()), stiffness=chain(k()), damping=chain(c()))
    held = sysid.Problem(TEST, mass=ca.diag(unknown("m", MASSES, fixed=True)), stiffness=chain(k()), damping=chain(c()))
    assert held.n_variables == free.n_variables - 3
    assert [v.name for v in held.formulation.fixed] == ["m"]
    same(held.structure(held.formulation.guess), free.structure(free.formulation.guess))


def test_unknowns_stand_in_the_order_of_declaration_and_matrices_column_by_column():
    second = unknown("b", DAMPERS)
    first = unknown("a", SPRINGS)
    problem = sysid.Problem(TEST, mass=np.diag(MASSES), stiffness=chain(first), damping=chain(second))
    assert problem.formulation.labels == ("b[0]", "b[1]", "b[2]", "a[0]", "a[1]", "a[2]")
    assert problem.unknowns == (("mass", 0), ("stiffness", 3), ("damping", 3))
    square = sysid.Variable("S", (3, 3), lower=-9e4, upper=9e4, guess=chain(SPRINGS))
    x = np.arange(1.0, 10.0)
    K = ca.DM.eye(3) * 1e6 + (square + square.T)
    problem = sysid.Problem(TEST, mass=np.diag(MASSES), stiffness=K, damping=1e-4 * K)
    S = x.reshape(3, 3, order="F")
    np.testing.assert_allclose(problem.structure(x).stiffness[:3, :3], 1e6 * np.eye(3) + S + S.T)


@pytest.mark.parametrize(
    ("relation", "rows", "equal", "at_guess"),
    [
        (lambda v: v[0] <= v[1], 1, False, SPRINGS[0] - SPRINGS[1]),
        (lambda v: v[0] >= v[1], 1, False, SPRINGS[1] - SPRINGS[0]),
        (lambda v: v[0] < v[1], 1, False, SPRINGS[0] - SPRINGS[1]),
        (lambda v: v >= 1e4, 3, False, 1e4 - SPRINGS),
        (lambda v: v <= 1e4, 3, False, SPRINGS - 1e4),
        (lambda v: v <= np.array([1e4, 2e4, 3e4]), 3, False, SPRINGS - [1e4, 2e4, 3e4]),
        (lambda v: v >= [1e4, 2e4, 3e4], 3, False, np.array([1e4, 2e4, 3e4]) - SPRINGS),
        (lambda v: ca.sum1(v) == 4e4, 1, True, SPRINGS.sum() - 4e4),
        (lambda v: ca.sum1(v) == 4e4, 1, True, 4e4 - SPRINGS.sum()),
        (lambda v: sum(v) == 4e4, 1, True, SPRINGS.sum() - 4e4),
        (lambda v: v[0] - v[1] == 0, 1, True, SPRINGS[0] - SPRINGS[1]),
        (lambda v: v[0] - v[1] <= 0, 1, False, SPRINGS[0] - SPRINGS[1]),
        (lambda v: v[0] - v[1] >= 0, 1, False, SPRINGS[1] - SPRINGS[0]),
        (lambda v: v[0] * v[1] <= v[2] ** 2, 1, False, SPRINGS[0] * SPRINGS[1] - SPRINGS[2] ** 2),
        (lambda v: np.sqrt(v[0]) <= 200, 1, False, np.sqrt(SPRINGS[0]) - 200),
    ],
)
def test_a_relation_is_rows_of_left_less_right(relation, rows, equal, at_guess):
    v = k()
    problem = sysid.Problem(
        TEST, mass=np.diag(MASSES), stiffness=chain(v), damping=1e-4 * chain(v), constraints=[relation(v)]
    )
    constraints = problem.formulation.constraints
    assert constraints.lower.size == rows == len(constraints.sources)
    np.testing.assert_array_equal(constraints.lower, np.full(rows, 0.0 if equal else -np.inf))
    np.testing.assert_array_equal(constraints.upper, 0.0)
    made = np.asarray(constraints.function(problem.formulation.guess)).ravel()
    # An equality may come with its sides exchanged.
    sign = -1.0 if equal and np.sign(made[0]) != np.sign(np.ravel(at_guess)[0]) else 1.0
    np.testing.assert_allclose(sign * made, np.ravel(at_guess), rtol=1e-12)
    assert "'k'" in constraints.sources[0]


def test_healing_changes_its_own_variable_only():
    a, b = m(), k()
    problem = sysid.Problem(
        TEST, mass=ca.diag(a), stiffness=chain(b), damping=1e-4 * chain(b), healing={a: 6 * a / ca.sum1(a)}
    )
    x = np.concatenate([[1.0, 2.0, 5.0], SPRINGS / 2])
    healed = np.asarray(problem.formulation.healing(x)).ravel()
    np.testing.assert_allclose(healed, np.concatenate([[0.75, 1.5, 3.75], SPRINGS / 2]))


def test_variables_of_different_shapes_are_healed_side_by_side():
    a, b = m(), sysid.Variable("b", lower=1e-5, upper=1e-3, unit="s")
    problem = sysid.Problem(
        TEST, mass=ca.diag(a), stiffness=chain(SPRINGS), damping=b * chain(SPRINGS),
        healing={a: 6 * a / ca.sum1(a), b: ca.fmin(b, 1e-4)},
    )  # fmt: skip
    healed = np.asarray(problem.formulation.healing([1.0, 2.0, 5.0, 5e-4])).ravel()
    np.testing.assert_allclose(healed, [0.75, 1.5, 3.75, 1e-4])


def test_two_tests_with_different_sensors_lines_and_masses():
    added = np.array([0.0, 0.0, 0.7])
    later = sysid.Structure(
        whole_mass(MASSES + added), with_base(chain(SPRINGS)), damping_matrix=chain(DAMPERS), n_base=1
    )
    R = np.eye(3)[[2, 0]]
    other = sysid.simulate(later, FREQ[::2] + 0.3, noise=0.1, force=True, rng=0)
    other = sysid.Measurement(
        other.freq, other.base, other.response[:, [2, 0]], rigid_body=np.ones((2, 1)), force=other.force
    )
    a, b, e = m(), k(), c()
    further = sysid.FurtherTest(
        other, mass=ca.diag(a + added), stiffness=chain(b), damping=chain(e), recovery=R, rigid_body_dofs=ONE
    )
    problem = sysid.Problem(TEST, mass=ca.diag(a), stiffness=chain(b), damping=chain(e), residuals=[further])
    x = problem.formulation.guess
    seen = sysid.Structure(
        later.mass, later.stiffness, damping_matrix=later.damping, n_base=1, recovery=R, rigid_body=R @ ONE
    )
    expected = np.hypot(other.residual(seen), other.force_residual(seen))
    assert problem.objective(x) == pytest.approx(expected, rel=1e-9)
    assert problem.formulation.residuals(x)[0] < 1e-12
    assert dict(problem.unknowns)["further tests"] == 9
    # Written as an expression it is the same.
    symbols = [v.symbol for v in (a, b, e)]
    function = ca.Function("f", symbols, [ca.norm_2(further.expression), *further.response, *further.force])
    norm, re, im, f_re, f_im = (np.asarray(part) for part in function(MASSES, SPRINGS, DAMPERS))
    assert norm.item() == pytest.approx(expected, rel=1e-9)
    made = np.einsum("sdf,rdf->srf", seen.transmissibility(other.freq), other.base).reshape(2, -1)
    np.testing.assert_allclose(re + 1j * im, made, rtol=1e-9)
    pulled = np.einsum("edf,rdf->erf", seen.base_force(other.freq), other.base).reshape(1, -1)
    np.testing.assert_allclose(f_re + 1j * f_im, pulled, rtol=1e-9)


def test_an_own_misfit_stands_in_the_place_of_the_measured_one():
    a, b, e = m(), k(), c()
    written = sysid.FurtherTest(FORCED, mass=ca.diag(a), stiffness=chain(b), damping=chain(e))
    size = np.linalg.norm(np.abs(FORCED.response))
    only_size = ca.vec(ca.sqrt(written.response.real**2 + written.response.imag**2) - np.abs(FORCED.response[0])) / size
    problem = sysid.Problem(FORCED, mass=ca.diag(a), stiffness=chain(b), damping=chain(e), misfit=only_size)
    x = problem.formulation.guess * 1.1
    made = np.abs(FORCED.predict(problem.structure(x)) + np.einsum("sd,rdf->rsf", FORCED.rigid_body, FORCED.base))
    expected = np.linalg.norm(made - np.abs(FORCED.response)) / size
    assert problem.objective(x) == pytest.approx(expected, rel=1e-9)
    assert problem.residual(x) == pytest.approx(expected, rel=1e-9)


def test_motion_in_symbols_is_that_of_the_numbers():
    problem = sysid.Problem(FORCED, mass=ca.diag(m()), stiffness=chain(k()), damping=chain(c()))
    x = ca.MX.sym("x", 9)
    miss = ca.Function("f", [x], [ca.norm_2(relative_misfit(FORCED, problem.formulation.matrices.motion(x)))])
    at = problem.formulation.guess * np.linspace(0.8, 1.2, 9)
    assert float(miss(at)) == pytest.approx(problem.objective(at), rel=1e-9)


@pytest.mark.parametrize("given", ["numbers", "a variable"])
def test_one_ratio_of_one_degree_of_freedom_is_a_ratio(given):
    truth = sysid.Structure(np.diag([2.0, 0]), 1e4 * np.array([[1, -1], [-1, 1.0]]), [0.02], n_base=1)
    stiffness = unknown("k", 1e4)
    damping = [0.02] if given == "numbers" else unknown("z", [0.02])
    problem = sysid.Problem(sysid.simulate(truth, FREQ), mass=[[2.0]], stiffness=stiffness, damping=damping)
    np.testing.assert_allclose(problem.structure(problem.formulation.guess).damping_ratios, [0.02])
