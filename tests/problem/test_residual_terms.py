"""Modes beyond the lines beside a written model: eliminated by least squares, exact derivatives, the answer."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.jobs.changes import WithoutSensor
from sysid.jobs.score import scored
from sysid.modal_analysis.response import gains, weighted_error
from sysid.problem.residual_terms import ResidualTerms

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
FREQ = np.linspace(1.0, 9.0, 40)
LAST = 2 * np.pi * FREQ[-1]
G = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
STRETCH = np.array([[1.0, 0.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, -1.0, 0.0]])
SPRINGS = np.array([3000.0, 6000.0, 4000.0])
MASS = np.diag([4.0, 5.0, 3.0, 2.0, 1.0])


def truth(*, ratios, loads=((1.5, 0.2), (0.3, 1.0)), times=1.0):
    """Three masses in two directions, and two modes above the lines, whose shapes may be so many times as large."""
    K = STRETCH.T @ np.diag(SPRINGS) @ STRETCH
    damping = {"damping_ratios": [0.02, 0.03, 0.02]} if ratios else {"damping_matrix": 3e-3 * K[:3, :3]}
    own = sysid.Structure(MASS, K, n_base=2, **damping)
    shapes = times * np.array([[0.2, 0.05], [-0.1, 0.2], [0.15, 0.1]])
    beyond = sysid.ResidualModes(1.0 * np.array([14.0, 21.0]), np.array([0.01, 0.02]), shapes, np.array(loads))
    return own.with_residual(beyond)


def measured(structure, *, force, noise=0.01, seed=0):
    """Two runs in which the base moves along both axes, with noise that the runs have of their own."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(2, 2, FREQ.size)) + 1j * rng.normal(size=(2, 2, FREQ.size)) + 3 * np.eye(2)[:, :, None]
    records, given = {}, {}
    for name, transfer in (("response", structure.transmissibility(FREQ)), ("force", structure.base_force(FREQ))):
        clean = np.einsum("cdf,rdf->rcf", transfer, u)
        std = noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=2, keepdims=True)) * np.ones(FREQ.size)
        error = rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)
        records[name], given[name + "_std"] = clean + std * error / np.sqrt(2), std
    if not force:
        del records["force"], given["force_std"]
    response = records.pop("response")
    return sysid.Measurement(FREQ, u, response, rigid_body=G, base_axes=("x", "y"), **records, **given)


def problem(test, *, ratios, residual_modes=True, **given):
    k = sysid.Variable("k", 3, lower=500.0, upper=2e4, guess=SPRINGS * [1.05, 0.97, 1.02], unit="N/m")
    b = sysid.Variable("b", lower=1e-4, upper=1e-2, guess=2.9e-3)
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    damping = sysid.ModalDamping() if ratios else b * K
    return sysid.Problem(test, mass=MASS, stiffness=K, damping=damping, residual_modes=residual_modes, **given)


def by_hand(made):
    """What is left of all weighted rows where residues at the poles of the problem are free, by one dense design.

    A function of the unknowns.
    """
    test, terms = made.measurement, made.formulation.matrices.beyond
    plain = problem(test, ratios=made.formulation.by_ratios, residual_modes=False)
    g = gains(test.freq, terms.omega, terms.ratios)
    sizes = [np.linalg.norm(test.relative / test.response_std)] * 2 if test.force is not None else []
    sizes = sizes or [np.linalg.norm(test.relative / test.response_std)]

    def column(record, answer):
        parts = [np.zeros((channels, 2, FREQ.size), complex) for channels in (3, 2)[: len(sizes)]]
        std = (test.response_std, test.force_std)[record]
        parts[record] = np.moveaxis(answer / std, 0, 1) / sizes[record]
        flat = [part.ravel() for part in parts]
        return np.concatenate([np.concatenate([part.real, part.imag]) for part in flat])

    columns = []
    for pole in g:
        moved = pole * test.base  # (runs, d, lines)
        for i, j in np.ndindex(3, 2):
            answer = np.zeros((2, 3, FREQ.size), complex)
            answer[:, i] = moved[:, j]
            columns.append(column(0, answer))
        for i, j in ((0, 0), (0, 1), (1, 1)) if test.force is not None else ():
            D = np.zeros((2, 2))
            D[i, j] = D[j, i] = 1.0
            columns.append(column(1, np.einsum("ij,rjf->rif", D, moved)))
    design = np.array(columns).T

    def left(x):
        rows = plain.formulation.own_test.linearised(x).residuals
        return rows - design @ np.linalg.lstsq(design, rows, rcond=None)[0]

    return left


@pytest.fixture(params=[(True, True), (True, False), (False, True), (False, False)], ids=str)
def case(request):
    """The problem, and unknowns that are off."""
    ratios, force = request.param
    made = problem(measured(truth(ratios=ratios), force=force), ratios=ratios)
    return made, made.formulation.guess


def test_the_objective_is_what_least_squares_leave(case):
    made, x = case
    left = by_hand(made)(x)
    expected = np.linalg.norm(left)
    assert made.objective(x) == pytest.approx(expected, rel=1e-9)
    rows = made.formulation.own_test.linearised(x)
    np.testing.assert_allclose(rows.residuals, left, atol=1e-10)
    # Of the swarm's candidates too.
    many = np.stack([x, 1.01 * x, x])
    found = made.formulation.own_test.squared(many)
    np.testing.assert_allclose(found, [made.objective(row) ** 2 for row in many], rtol=1e-9)


def test_derivatives_agree_with_differences_of_the_eliminated_rows(case):
    made, x = case
    J = made.formulation.own_test.linearised(x).jacobian
    steps = 1e-5 * x * np.eye(x.size)
    left = by_hand(made)
    differences = [(left(x + step) - left(x - step)) / 2 / step.sum() for step in steps]
    np.testing.assert_allclose(J * x, np.array(differences).T * x, atol=1e-7 * np.abs(J * x).max())
    if made.formulation.by_ratios:
        return
    symbol = ca.MX.sym("x", x.size)
    rows = made.formulation.own_test.rows(symbol)
    slopes = ca.Function("slopes", [symbol], [rows, ca.jacobian(rows, symbol)])
    values, exact = (np.asarray(ca.densify(part)) for part in slopes(x))
    np.testing.assert_allclose(np.linalg.norm(values), np.linalg.norm(left(x)), rtol=1e-9)
    np.testing.assert_allclose(exact.T @ exact, J.T @ J, rtol=1e-7)


def test_the_structure_holds_the_residual_modes_that_are_best(case):
    made, x = case
    structure = made.structure(x)
    test, beyond = made.measurement, structure.residual
    assert beyond.static == beyond.count == 2 * made.formulation.matrices.beyond.omega.size
    assert np.all(beyond.natural_frequencies > FREQ[-1])
    if test.force is None:
        assert weighted_error(test, structure) == pytest.approx(made.objective(x), rel=1e-9)
        totals = np.diag(structure.rigid_body_mass)
        assert np.all(np.sum(beyond.participation**2 / totals, axis=1) < 1.1e-6)
    else:
        assert weighted_error(test, structure) >= (1 - 1e-9) * made.objective(x)


def test_masses_of_residual_modes_are_the_best_that_are_not_negative():
    """Conditions of Karush, Kuhn and Tucker: D and the slope by it are positive semidefinite, their product zero."""
    structure = truth(ratios=True, loads=((1.5, 0.2), (0.0, 0.0)))
    made = problem(measured(structure, force=True, noise=0.05), ratios=True)
    test, s = made.measurement, made.structure(made.formulation.guess)
    terms = made.formulation.matrices.beyond
    own = s.with_residual(sysid.ResidualModes.none(3, 2))
    left = test.force - test.predict_force(own)
    moved = gains(test.freq, terms.omega, terms.ratios)[:, None, None] * test.base
    found = s.residual.participation.reshape(-1, 2, 2)
    D = np.einsum("pki,pkj->pij", found, found)
    misfit = (np.einsum("pij,prjf->rif", D, moved) - left) / test.force_std**2
    slope = 2 * np.einsum("rif,prjf->pij", misfit, moved.conj()).real
    slope = (slope + slope.swapaxes(1, 2)) / 2
    size = np.abs(slope).max() * np.abs(D).max()
    curvature = np.einsum("prjf,rjf->p", np.abs(moved) ** 2, 1 / test.force_std**2)
    assert np.linalg.eigvalsh(D).min() < 1e-3 * np.abs(D).max()  # at a bound
    least = 1e-6 * np.diag(s.rigid_body_mass).max()
    assert np.all(np.linalg.eigvalsh(slope) > -10 * curvature[:, None] * least)
    assert np.all(np.abs(np.einsum("pij,pji->p", slope, D)) < 1e-2 * size + 10 * curvature * least * np.abs(D).max())


@pytest.mark.parametrize("ratios", [True, False])
def test_a_model_without_the_higher_modes_has_its_springs_within_deviations(ratios, from_one_start):
    far = []
    for seed in range(2):
        made = problem(measured(truth(ratios=ratios, times=3.0), force=True, seed=seed), ratios=ratios)
        with from_one_start():
            result = sysid.identify(made, rng=0)
        assert result.judgement == "determined"
        far.append((result.values["k"] - SPRINGS) / result.uncertainty.variables["k"])
        assert result.structure.residual.count
    assert np.sqrt(np.mean(np.square(far))) < 1.7
    assert np.abs(far).max() < 4
    plain = problem(made.measurement, ratios=ratios, residual_modes=False)
    with from_one_start():
        without = sysid.identify(plain, strategy="continuation", rng=0)  # "auto" would go on with swarms
    assert without.judgement == "no fit"


def test_a_further_test_has_residual_modes_of_its_own():
    made = problem(measured(truth(ratios=False), force=False), ratios=False)
    k, b = made.variables
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    second = sysid.FurtherTest(
        measured(truth(ratios=False), force=False, seed=5), mass=MASS, stiffness=K, damping=b * K
    )
    both = sysid.Problem(
        made.measurement, mass=MASS, stiffness=K, damping=b * K, residuals=[second], residual_modes=True
    )
    x = both.formulation.guess
    alone = problem(second.measurement, ratios=False).objective(x)
    term = both.formulation.further_tests[0]
    assert term.error(x) == pytest.approx(term.weight * alone, rel=1e-9)


def test_a_stored_problem_and_its_result_keep_them(tmp_path):
    made = problem(measured(truth(ratios=False), force=True), ratios=False)
    result = sysid.identify(made, rng=0)
    result.save(tmp_path / "result.h5")
    again = sysid.load(tmp_path / "result.h5")
    assert again.problem.residual_modes
    np.testing.assert_array_equal(again.structure.residual.shapes, result.structure.residual.shapes)
    assert again.objective == pytest.approx(result.objective, rel=1e-12)


def test_poles_far_above_and_below_the_lines_are_left_to_the_chosen_ones():
    test = measured(truth(ratios=True), force=False)
    none = ResidualTerms.above(test, LAST * np.array([0.5, 1.9, 3.0]), np.full(3, 0.02))
    assert np.all(none.omega > LAST)
    assert none.omega.size == 2
    one = ResidualTerms.above(test, LAST * np.array([0.5, 1.2]), np.array([0.02, 0.03]))
    np.testing.assert_allclose(one.omega[0], 1.2 * LAST)
    assert one.ratios[0] == 0.03
    assert one.size == 3 * 2 * 2


def test_a_switch_is_true_or_false():
    with pytest.raises(sysid.InputError):
        problem(measured(truth(ratios=True), force=False), ratios=True, residual_modes="yes")


def test_a_misfit_of_the_users_own_has_no_residual_modes():
    with pytest.raises(sysid.InputError, match="residual_modes"):
        problem(
            measured(truth(ratios=True), force=False), ratios=True,
            misfit=lambda structure: ca.MX(1) * structure.frequencies[0],
        )  # fmt: skip


def test_criteria_count_the_residues_and_no_sensor_is_predicted_by_residues_of_its_own():
    test = measured(truth(ratios=True), force=False)
    with_them, without = (
        sysid.identify(problem(test, ratios=True, residual_modes=given), strategy="continuation", rng=0)
        for given in (True, False)
    )
    beyond = with_them.prepared.formulation.own_test.matrices.beyond.size
    assert beyond >= 3 * 2
    assert scored(with_them).parameters == scored(without).parameters + beyond
    assert np.isnan(WithoutSensor(0).predicted(with_them.prepared, with_them))
