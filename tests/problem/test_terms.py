"""Terms: many candidates at once against one by one, residuals of several tests, expressions and priors."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.problem.terms import ModeSymbols

FREQ = np.linspace(1.0, 12.0, 16)
G = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
SPRINGS = np.array([3000.0, 2000.0, 1000.0])
RECOVERY = np.array([[1.0, 0, 0], [0, 0.4, 0.6]])


def chain(k):
    """Sensors 1 and 3 above each other along x, sensor 2 alone along y."""
    return ca.blockcat([[k[0] + k[2], 0, -k[2]], [0, k[1], 0], [-k[2], 0, k[2]]])


def variable(name, centre, **options):
    centre = np.asarray(centre, dtype=float)
    return sysid.Variable(name, centre.shape, lower=centre / 3, upper=centre * 3, guess=centre, **options)


def measured(rng, *, rigid_body=G, force=False, noisy=False):
    """Random records of two runs; noise that differs by channel, line and run."""
    draw = lambda *size: rng.normal(size=size) + 1j * rng.normal(size=size)  # noqa: E731
    n, d = rigid_body.shape
    options = {"base_axes": ["x", "y"][:d]}
    if noisy:
        options["response_std"] = rng.uniform(0.3, 3, (1, n, 1)) * rng.uniform(0.3, 3, (2, 1, FREQ.size))
    if force:
        options["force"] = 30 * draw(2, d, FREQ.size)
    if force and noisy:
        options["force_std"] = rng.uniform(3, 30, (1, d, 1)) * rng.uniform(0.3, 3, (2, 1, FREQ.size))
    return sysid.Measurement(FREQ, draw(2, d, FREQ.size), draw(2, n, FREQ.size), rigid_body=rigid_body, **options)


def written_mass(base):
    """Coupled to the base; where its own mass is little, many candidates are no structure."""
    m = variable("m", [3.0, 2.0, 1.0])
    coupling = ca.vertcat(ca.horzcat(0.9, 0), ca.horzcat(0, 0.7), ca.MX(1, 2))
    return ca.blockcat([[ca.diag(m) + 0.1, coupling], [coupling.T, base * ca.DM.eye(2)]])


def damper():
    c = variable("c", [5.0, 3.0, 2.0])
    return ca.diag(c) + 0.1 * c[0]


MODELS = {
    "lumped, chain": lambda: {"mass": sysid.LumpedMass(6.0), "stiffness": sysid.ChainStiffness(300.0, 9e3)},
    "full, spectral": lambda: {
        "mass": sysid.FullMass(6.0, healing="rigid_body"), "stiffness": sysid.SpectralStiffness([3.0, 5.0, 8.0])
    },
    "known, written": lambda: {"mass": np.diag([3.0, 2, 1]), "stiffness": chain(variable("k", SPRINGS))},
    "written, chain": lambda: {"mass": written_mass(0.4), "stiffness": sysid.ChainStiffness(300.0, 9e3)},
}  # fmt: skip
DAMPING = {
    "modal": lambda: sysid.ModalDamping(0.005, 0.1),
    "proportional": lambda: sysid.ProportionalDamping((0.0, 2.0), (0.0, 2e-3)),
    "written ratios": lambda: 0.01 * variable("z", [1.0, 2.0, 3.0]) - 0.008,  # below zero for some
    "matrix": damper,
}


def candidates(problem, count):
    rng = np.random.default_rng(0)
    s = rng.uniform(problem.lower, problem.upper, (count, problem.n_variables))
    symbol = ca.MX.sym("s", problem.n_variables)
    sampling = ca.Function("sampling", [symbol], [problem.formulation.from_sampling(symbol)])
    return np.array([np.asarray(sampling(row)).ravel() for row in s])


def is_structure(problem, x):
    try:
        problem.structure(x)
    except sysid.InputError:
        return False
    return True


def compare(problem, term, x):
    """Squares of a batch against those of each candidate; NaN exactly where there is no structure."""
    squared = term.squared(x)
    there = np.array([is_structure(problem, row) for row in x])
    np.testing.assert_array_equal(np.isfinite(squared), there)
    one_by_one = [term.error(row) ** 2 for row in x[there]]
    np.testing.assert_allclose(squared[there], one_by_one, rtol=1e-8)
    if term.matrices.by_ratios:
        assert np.all(np.isnan([term.error(row) for row in x[~there]]))
    return there


RECORDS = ["", "force", "noise", "force and noise"]


@pytest.mark.parametrize(
    ("matrices", "damping", "record", "shift"),
    [
        *((matrices, damping, "force and noise", 0.0) for matrices in MODELS for damping in DAMPING),
        *(("full, spectral", "proportional", record, shift) for record in RECORDS for shift in (0.0, 4.0)),
        *(("written, chain", "matrix", record, shift) for record in RECORDS for shift in (0.0, 4.0)),
    ],
)
def test_a_batch_is_each_of_its_candidates(matrices, damping, record, shift):
    rng = np.random.default_rng(len(matrices + damping + record))
    test = measured(rng, force="force" in record, noisy="noise" in record)
    problem = sysid.Problem(test, **MODELS[matrices](), damping=DAMPING[damping]())
    term = replace(problem.formulation.own_test, shift=shift, weight=1.7)
    there = compare(problem, term, candidates(problem, 66))  # more than a chunk
    assert there.sum() > 8
    if matrices == "written, chain" or damping == "written ratios":
        assert there.sum() < 66


@pytest.mark.parametrize("damping", ["modal", "proportional", "matrix"])
@pytest.mark.parametrize("force", [False, True])
def test_sensors_that_combine_degrees_of_freedom(damping, force):
    dofs = np.array([[1.0], [1.0], [1.0]])
    test = measured(np.random.default_rng(3), rigid_body=RECOVERY @ dofs, force=force, noisy=True)
    problem = sysid.Problem(
        test, mass=ca.diag(variable("m", [3.0, 2.0, 1.0])), stiffness=sysid.ChainStiffness(300.0, 9e3),
        damping=DAMPING[damping](), recovery=RECOVERY, rigid_body_dofs=dofs,
    )  # fmt: skip
    assert np.all(compare(problem, problem.formulation.own_test, candidates(problem, 20)))


@pytest.mark.parametrize("damping", ["modal", "matrix"])
def test_an_error_is_that_of_the_structure_in_numpy(damping):
    """Weighed by the stated noise, accelerations and force by each other's."""
    test = measured(np.random.default_rng(4), force=True, noisy=True)
    problem = sysid.Problem(test, **MODELS["known, written"](), damping=DAMPING[damping]())
    for x in candidates(problem, 3):
        structure = problem.structure(x)
        scale = np.linalg.norm(test.relative / test.response_std)
        left = [(test.predict(structure) - test.relative) / test.response_std]
        left.append((test.predict_force(structure) - test.force) / test.force_std)
        expected = np.linalg.norm([np.linalg.norm(part) for part in left]) / scale
        assert problem.objective(x) == pytest.approx(expected, rel=1e-9)


def further(measurement, m, k, c, added):
    return sysid.FurtherTest(
        measurement, mass=ca.diag(m + np.asarray(added)), stiffness=chain(k), damping=ca.diag(c) + 0.1 * c[0]
    )


def several(damping, **given):
    """Three tests of one structure with masses added; their own damping is C, that of the problem either kind."""
    rng = np.random.default_rng(5)
    tests = [measured(rng, force=force, noisy=True) for force in (False, True, False)]
    m, k, c = variable("m", [3.0, 2.0, 1.0]), variable("k", SPRINGS), variable("c", [5.0, 3.0, 2.0])
    residuals = [further(tests[1], m, k, c, [0, 0, 1.0]), ca.sum1(m) / 6 - 1, further(tests[2], m, k, c, [1.0, 0, 0])]
    own = {"matrix": ca.diag(c) + 0.1 * c[0], "ratios": [0.01, 0.02, 0.03]}[damping]
    problem = sysid.Problem(tests[0], mass=ca.diag(m), stiffness=chain(k), damping=own, residuals=residuals, **given)
    return problem, tests


def structure_of(x, added, damping):
    m, k, c = x[:3] + added, x[3:6], x[6:]
    K = np.asarray(ca.DM(chain(ca.DM(k))))
    whole = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    by = {"damping_matrix": np.diag(c) + 0.1 * c[0]} if damping == "matrix" else {"damping_ratios": [0.01, 0.02, 0.03]}
    return sysid.Structure(np.diag([*m, 0, 0]), whole, n_base=2, **by)


@pytest.mark.parametrize("damping", ["matrix", "ratios"])
def test_the_residual_is_that_of_all_tests_together(damping):
    """Relative accelerations of all tests below each other, unweighted; each test's own beside it."""
    problem, tests = several(damping)
    x = problem.formulation.guess * np.linspace(0.9, 1.2, 9)
    added = ([0, 0, 0], [0, 0, 1.0], [1.0, 0, 0])
    kinds = (damping, "matrix", "matrix")
    structures = [structure_of(x, np.array(a), kind) for a, kind in zip(added, kinds, strict=True)]
    left = [test.predict(s) - test.relative for test, s in zip(tests, structures, strict=True)]
    flat = lambda records: np.concatenate([np.ravel(record) for record in records])  # noqa: E731
    expected = np.linalg.norm(flat(left)) / np.linalg.norm(flat([test.relative for test in tests]))
    assert problem.residual(x) == pytest.approx(expected, rel=1e-9)
    own = [np.linalg.norm(part) / np.linalg.norm(test.relative) for part, test in zip(left, tests, strict=True)]
    np.testing.assert_allclose(problem.formulation.residuals(x), own, rtol=1e-9)


@pytest.mark.parametrize("damping", ["matrix", "ratios"])
def test_the_objective_weighs_tests_by_their_noise_and_an_expression_like_a_number_of_the_test(damping):
    problem, tests = several(damping)
    x = problem.formulation.guess * np.linspace(0.9, 1.2, 9)

    def level(test):
        """Standard deviation of a real number of the weighed, relative record: the noise is 1 in units of itself."""
        return 1 / np.sqrt(2) / np.linalg.norm(test.relative / test.response_std)

    def weighed(test, structure):
        scale = np.linalg.norm(test.relative / test.response_std)
        parts = [(test.predict(structure) - test.relative) / test.response_std]
        if test.force is not None:
            parts.append((test.predict_force(structure) - test.force) / test.force_std)
        return np.linalg.norm([np.linalg.norm(part) for part in parts]) / scale

    rows = [weighed(tests[0], structure_of(x, np.zeros(3), damping))]
    rows += [level(tests[0]) / level(tests[1]) * weighed(tests[1], structure_of(x, np.array([0, 0, 1.0]), "matrix"))]
    rows += [level(tests[0]) / level(tests[2]) * weighed(tests[2], structure_of(x, np.array([1.0, 0, 0]), "matrix"))]
    rows += [x[:3].sum() / 6 - 1]
    assert problem.objective(x) == pytest.approx(np.linalg.norm(rows), rel=1e-9)
    assert [term.name for term in problem.formulation.terms] == ["the test", "residual 1", "residual 2", "residual 3"]
    batch = sum(term.squared(x[None])[0] for term in problem.formulation.terms)
    assert batch == pytest.approx(np.sum(np.square(rows)), rel=1e-8)


def test_a_further_test_has_rows_of_its_own_matrices_beside_modes_of_the_problem():
    problem, _ = several("ratios")
    x = problem.formulation.guess * np.linspace(0.9, 1.2, 9)
    s = problem.structure(x)
    symbol, modes = ca.MX.sym("x", 9), ModeSymbols(ca.MX.sym("shapes", 3, 3), ca.MX.sym("omega", 3))
    for term in problem.formulation.tests:
        norm = ca.Function("norm", [symbol, *modes], [ca.norm_2(term.rows(symbol, modes))])
        value = float(norm(x, s.normal_modes, 2 * np.pi * s.natural_frequencies))
        assert value == pytest.approx(term.error(x), rel=1e-9)


class TestExpressions:
    def problem(self, *residuals, **given):
        k = variable("k", SPRINGS)
        test = measured(np.random.default_rng(6), noisy=True)
        given = {"damping": damper(), **{name: make(k) for name, make in given.items()}}
        return sysid.Problem(
            test, mass=np.diag([3.0, 2, 1]), stiffness=chain(k), residuals=[make(k) for make in residuals], **given
        )

    def test_a_prior_is_a_number_of_the_test_that_is_as_exact_as_it_says(self):
        problem = self.problem(lambda k: sysid.Prior(k[1:] / 1000, [2.1, 1.3], [0.1, 0.2]))
        (prior,) = problem.formulation.priors
        test, x = problem.measurement, problem.formulation.guess
        off = np.array([(2.0 - 2.1) / 0.1, (1.0 - 1.3) / 0.2])
        level = 1 / np.sqrt(2) / np.linalg.norm(test.relative / test.response_std)
        np.testing.assert_allclose(prior.numbers(x), off, rtol=1e-12)
        assert prior.error(x) == pytest.approx(level * np.linalg.norm(off), rel=1e-9)
        rows = prior.linearised(x, np.nan)
        np.testing.assert_allclose(rows.residuals, level * off, rtol=1e-9)
        # In units of their deviations rows have slopes 1e-3 / std by k[1] and k[2].
        expected = np.zeros((2, 6))
        expected[0, 1], expected[1, 2] = 1e-3 / 0.1, 1e-3 / 0.2
        np.testing.assert_allclose(rows.jacobian, level * expected, rtol=1e-9)
        np.testing.assert_allclose(rows.std, level, rtol=1e-9)
        assert prior.labels == ("k[1]", "k[2]")
        assert prior.findings(x) == []
        far = x.copy()
        far[1] = 2700.0
        (found,) = prior.findings(far)
        assert found.kind == "stated value" and found.numbers == pytest.approx({"k[1]": 6.0})

    def test_rows_of_a_residual_are_as_exact_as_numbers_of_the_test(self):
        problem = self.problem(lambda k: ca.vertcat(k[0] / 1000 - 2.9, k[1] * k[2] / 1e6 - 1))
        term, x = problem.formulation.terms[1], problem.formulation.guess
        rows = term.linearised(x, 0.003)
        np.testing.assert_allclose(rows.residuals, [0.1, 1.0], rtol=1e-9)
        np.testing.assert_allclose(rows.jacobian[:, :3], [[1e-3, 0, 0], [0, 1e-3, 2e-3]], rtol=1e-12)
        np.testing.assert_allclose(rows.std, 0.003)
        assert problem.formulation.priors == ()

    def test_a_misfit_of_one_s_own_has_the_noise_that_it_leaves(self):
        misfit = lambda k: ca.vertcat(*(k / 1000 - j for j in range(4)))  # noqa: E731
        problem = self.problem(misfit=misfit, damping=lambda k: [0.01, 0.02, 0.03])
        formulation, x = problem.formulation, problem.formulation.guess
        left = np.concatenate([SPRINGS / 1000 - j for j in range(4)])
        assert not formulation.fits_records
        assert formulation.tests == ()
        assert problem.objective(x) == problem.residual(x) == pytest.approx(np.linalg.norm(left), rel=1e-12)
        # Twelve rows and three unknowns.
        (term,) = formulation.terms
        np.testing.assert_allclose(term.linearised(x, np.nan).std, np.linalg.norm(left) / 3, rtol=1e-12)

    def test_a_whole_swarm_at_once(self):
        problem = self.problem(lambda k: ca.log(k[0] / 3000), lambda k: sysid.Prior(k, SPRINGS, 100.0))
        x = candidates(problem, 5)
        for term in problem.formulation.beside:
            np.testing.assert_allclose(term.squared(x), [term.error(row) ** 2 for row in x], rtol=1e-12)
            assert term.squared(x[:1]).shape == (1,)


@pytest.mark.parametrize("damping", ["matrix", "ratios"])
def test_noise_that_is_larger_than_stated_counts_as_large_as_it_is(damping):
    """Three times as large: so the misfit of the truth says, to the few per cent that so many numbers tell it."""
    lines = np.linspace(1.0, 12.0, 300)
    x = np.array([3.0, 2.0, 1.0, *SPRINGS, 5.0, 3.0, 2.0])
    truth = structure_of(x, np.zeros(3), damping)
    noisy = sysid.simulate(truth, lines, noise=0.03, force=True, rng=0)
    m, k, c = variable("m", x[:3]), variable("k", x[3:6]), variable("c", x[6:])
    own = {"matrix": ca.diag(c) + 0.1 * c[0], "ratios": [0.01, 0.02, 0.03]}[damping]

    def factor(stated):
        test = replace(noisy, response_std=noisy.response_std * stated, force_std=noisy.force_std * stated)
        problem = sysid.Problem(test, mass=ca.diag(m), stiffness=chain(k), damping=own)
        term, at = problem.formulation.own_test, problem.formulation.guess
        return term.linearised(at).std / term.linearised(at, as_stated=True).std

    np.testing.assert_allclose(factor(1 / 3), 3.0, rtol=0.1)
    np.testing.assert_allclose(factor(1.0), 1.0, rtol=0.1)
    # Smaller than stated it counts as stated.
    np.testing.assert_allclose(factor(3.0), 1.0, rtol=0.1)
