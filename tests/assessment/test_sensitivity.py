"""Slopes against central differences of structures; what they say of ranks, constraints and noise, against draws."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.assessment.determination import determine, intervals
from sysid.assessment.sensitivity import directions_in_words, sensitivity
from sysid.assessment.uncertainty import uncertainty
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.problem.direct_response import response_slopes, rows_of_test, slopes_of
from sysid.search import local

FREQ = np.linspace(1.0, 30.0, 40)
MASSES, SPRINGS, DAMPERS = np.array([3.0, 2.0, 1.0]), np.array([2e4, 1.5e4, 1e4]), np.array([8.0, 5.0, 3.0])


def chain(k, n=3):
    """Stiffness, or damping, of n springs in series, as an expression."""
    T = ca.DM(np.eye(n) - np.eye(n, k=-1))
    return T.T @ ca.diag(k) @ T


def chain_structure(masses=MASSES, springs=SPRINGS, dampers=DAMPERS, base=0.0):
    n = len(masses)
    T = np.eye(n) - np.eye(n, k=-1)
    K, C = T.T @ np.diag(springs) @ T, T.T @ np.diag(dampers) @ T
    one = np.ones((n, 1))
    return sysid.Structure(
        np.diag([*masses, base]), np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]]), damping_matrix=C, n_base=1
    )


def general(by_ratios, force=True, recovery=False):
    """A problem in which every block depends nonlinearly on a few unknowns: n = 3, d = 2, with coupling and base mass.

    Also the point about which it is looked at.
    """
    rng = np.random.default_rng(1)
    n, d = 3, 2
    G = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    p = sysid.Variable("p", 3, lower=-1, upper=1, guess=[0.3, -0.2, 0.1])
    q = sysid.Variable("q", (2, 1), lower=-1, upper=1, guess=[[0.4], [0.2]])
    symmetric = [x + x.T for x in rng.normal(size=(5, n, n))]
    K0 = 1e4 * np.array([[3.0, -1, 0.5], [-1, 2, 0.2], [0.5, 0.2, 4]])
    M_SS = ca.DM(np.diag([3.0, 2, 1.5])) + p[0] * symmetric[0] / 9 + p[1] ** 2 * symmetric[1] / 9
    K = ca.DM(K0) * ca.exp(0.3 * p[1]) + 800 * ca.sin(p[2]) * symmetric[2]
    M_S0 = ca.DM(0.3 * rng.normal(size=(n, d))) * (1 + p[0] * q[0])
    M_00 = ca.DM(np.diag([2.0, 3.0])) + q[1] * p[2] * np.array([[0.2, 0.1], [0.1, 0.3]])
    M = ca.blockcat([[M_SS, M_S0], [M_S0.T, M_00]])
    if by_ratios:
        C = ca.vertcat(0.02 + 0.01 * q[0], 0.03 + 0.005 * p[0] * q[1], 0.01 * ca.exp(p[2]))
    else:
        C = 2e-4 * K + 6 * ca.DM(symmetric[3] @ symmetric[3]) * (1 + 0.5 * q[0]) + q[1] * ca.DM(np.diag([1.0, 3, 2]))
    truth = sysid.Structure(
        np.eye(5), np.block([[K0, -K0 @ G], [-(K0 @ G).T, G.T @ K0 @ G]]), [0.02, 0.03, 0.02], n_base=d
    )
    u = rng.normal(size=(2, d, FREQ.size)) + 1j * rng.normal(size=(2, d, FREQ.size))
    R = np.array([[1.0, 0, 0], [0.5, 0.5, 0], [0, 0, 1], [0, 1, 0]]) if recovery else np.eye(n)
    record = np.einsum("sdf,rdf->rsf", np.einsum("st,tdf->sdf", R, truth.transmissibility(FREQ)), u)
    pull = np.einsum("edf,rdf->ref", truth.base_force(FREQ), u) if force else None
    test = sysid.Measurement(FREQ, u, record, rigid_body=R @ G, force=pull)
    problem = sysid.Problem(
        test, mass=M, stiffness=K, damping=C,
        recovery=R if recovery else None, rigid_body_dofs=G if recovery else None,
    )  # fmt: skip
    return problem, np.array([0.25, -0.3, 0.15, 0.35, 0.1])


def differences(function, x, h=2e-4):
    """Central differences of order 4, along the last axis."""
    columns = []
    for e in h * np.eye(x.size):
        at = [np.asarray(function(x + i * e)) for i in (-2, -1, 1, 2)]
        columns.append((at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h))
    return np.stack(columns, axis=-1)


def close(made, expected, tolerance=1e-7):
    assert made.shape == expected.shape
    np.testing.assert_allclose(made, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("recovery", [False, True])
@pytest.mark.parametrize("by_ratios", [False, True])
def test_slopes_of_matrices_modes_and_damping_are_central_differences(by_ratios, recovery):
    problem, x = general(by_ratios, recovery=recovery)
    slopes = slopes_of(problem.formulation.matrices, x, problem.measurement)
    n = 3

    def push(s):
        return s.mass[:n, :n] @ s.rigid_body_dofs + s.mass[:n, n:]

    quantities = {
        "mass": lambda s: s.mass[:n, :n], "stiffness": lambda s: s.stiffness[:n, :n], "damping": lambda s: s.damping,
        "d_push": push, "d_rigid": lambda s: s.rigid_body_mass, "d_shapes": lambda s: s.normal_modes,
        "d_log_omega": lambda s: np.log(s.natural_frequencies), "d_log_ratios": lambda s: np.log(s.damping_ratios),
    }  # fmt: skip
    for name, quantity in quantities.items():
        expected = differences(lambda y, quantity=quantity: quantity(problem.structure(y)), x)
        close(getattr(slopes, name), expected, 2e-7)
    close(slopes.push, push(problem.structure(x)), 1e-13)


@pytest.mark.parametrize("by_ratios", [False, True])
def test_slopes_of_responses_are_central_differences(by_ratios):
    problem, x = general(by_ratios)
    slopes = slopes_of(problem.formulation.matrices, x, problem.measurement)
    X, dX = response_slopes(slopes, FREQ)
    response = lambda y: np.moveaxis(problem.structure(y).relative_acceleration(FREQ), -1, 0)  # noqa: E731
    close(X, response(x), 1e-11)
    close(dX, differences(response, x), 5e-7)


@pytest.mark.parametrize("recovery", [False, True])
@pytest.mark.parametrize("by_ratios", [False, True])
def test_rows_of_a_test_are_weighted_residuals_and_their_central_differences(by_ratios, recovery):
    problem, x = general(by_ratios, recovery=recovery)
    test = problem.measurement
    slopes = slopes_of(problem.formulation.matrices, x, test)
    none = problem.formulation.matrices.beyond
    accelerations, forces = rows_of_test(ModalEstimate.of_lines(test), slopes, x.size, none)

    def left(predict, record):
        def residual(y):
            miss = np.moveaxis(predict(problem.structure(y)) - record, 0, 1).ravel() / np.linalg.norm(record)
            return np.concatenate([miss.real, miss.imag])

        return residual

    for rows, residual in (
        (accelerations, left(test.predict, test.relative)), (forces, left(test.predict_force, test.force))
    ):  # fmt: skip
        close(rows.residuals, residual(x), 1e-10)
        close(rows.jacobian, differences(residual, x), 5e-7)
    np.testing.assert_allclose(
        np.hypot(np.linalg.norm(accelerations.residuals), np.linalg.norm(forces.residuals)), problem.objective(x)
    )


def everything_free(**options):
    m = sysid.Variable("m", 3, lower=0.1, upper=10, guess=MASSES)
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5, guess=SPRINGS)
    c = sysid.Variable("c", 3, lower=0.1, upper=50, guess=DAMPERS)
    force = options.pop("force", False)
    test = sysid.simulate(chain_structure(), FREQ, force=force)
    build = options.pop("build", lambda m, k, c: {})
    return sysid.Problem(test, mass=ca.diag(m), stiffness=chain(k), damping=chain(c), **build(m, k, c))


TRUTH = np.concatenate([MASSES, SPRINGS, DAMPERS])


def test_a_chain_without_a_weight_leaves_its_common_scale_open():
    problem = everything_free()
    known = sensitivity(problem.formulation, TRUTH)
    assert known.rank == 8
    direction = known.unit * known.unseen[:, 0] / TRUTH
    np.testing.assert_allclose(direction / direction[0], 1.0, rtol=1e-6)
    (words,) = directions_in_words(problem.variables, TRUTH, known.unit, known.unseen)
    assert words in ("m +1 %, k +1 %, c +1 %", "m -1 %, k -1 %, c -1 %")
    decided = determine(problem.prepared, problem.structure(TRUTH), TRUTH)
    assert not decided.determined
    assert "8 of 9 directions" in decided.undetermined[0]
    uncertain = uncertainty(problem.prepared, problem.structure(TRUTH), TRUTH)
    assert all(np.all(np.isnan(std)) for std in uncertain.variables.values())
    assert np.all(np.isfinite(uncertain.natural_frequencies))
    ends = intervals(problem.prepared, problem.structure(TRUTH), TRUTH)
    assert np.all(np.isinf(np.diagonal(ends.mass[1])))
    assert not np.any(np.diagonal(ends.mass[0]))


@pytest.mark.parametrize(
    "build",
    [
        lambda m, k, c: {"constraints": [ca.sum1(m) == 6.0]},
        lambda m, k, c: {"constraints": [m[1] == 2.0]},
        lambda m, k, c: {"residuals": [ca.sum1(m) / 6.0 - 1.0]},
    ],
    ids=["total", "one mass", "a weighed total as residual"],
)
def test_one_number_with_a_unit_of_mass_closes_the_scale(build):
    problem = everything_free(build=build)
    known = sensitivity(problem.formulation, TRUTH)
    constrained = bool(problem.constraints)
    assert known.rank == 9 - constrained
    assert known.unseen.shape[1] == 0
    assert known.free.shape == (9, 9 - constrained)
    assert determine(problem.prepared, problem.structure(TRUTH), TRUTH).determined


def test_the_base_force_closes_the_scale():
    assert sensitivity(everything_free(force=True).formulation, TRUTH).rank == 9


@pytest.mark.parametrize("limit", [7.0, 6.0], ids=["away from its bound", "at its bound, on which nothing presses"])
def test_an_inequality_closes_nothing_that_the_records_leave(limit):
    """Half of every mass, spring and damper answers alike, and keeps to it."""
    problem = everything_free(build=lambda m, k, c: {"constraints": [ca.sum1(m) <= limit]})
    known = sensitivity(problem.formulation, TRUTH)
    assert known.rank == 8
    assert known.free.shape == (9, 9)
    assert not determine(problem.prepared, problem.structure(TRUTH), TRUTH).determined
    assert problem.prepared.keeps_constraints(TRUTH / 2)
    assert problem.objective(TRUTH / 2) < 1e-10


def test_normals_stay_on_active_constraints():
    problem = everything_free(build=lambda m, k, c: {"constraints": [ca.sum1(m) == 6.0, k[0] * k[1] == 3e8]})
    known = sensitivity(problem.formulation, TRUTH)
    np.testing.assert_allclose(known.normals[:3].sum(axis=0), 0, atol=1e-10 * np.abs(known.normals[:3]).max())
    along = known.normals[3] * SPRINGS[1] + known.normals[4] * SPRINGS[0]
    np.testing.assert_allclose(along, 0, atol=1e-9 * np.abs(known.normals[3] * SPRINGS[1]).max())


def test_two_unknowns_of_which_only_the_sum_counts_are_one_null_direction():
    a, b = (sysid.Variable(name, lower=1e3, upper=1e5, guess=1e4) for name in "ab")
    test = sysid.simulate(chain_structure(), FREQ)
    k = ca.vertcat(a + b, SPRINGS[1], SPRINGS[2])
    problem = sysid.Problem(test, mass=np.diag(MASSES), stiffness=chain(k), damping=chain(DAMPERS) + 1e-9 * chain(k))
    x = np.array([1e4, 1e4])
    known = sensitivity(problem.formulation, x)
    assert known.rank == 1
    moved = known.unit * known.unseen[:, 0]
    np.testing.assert_allclose(moved[0], -moved[1], rtol=1e-6)
    # Nobody needs a and b: their sum, and so the matrices, are fixed.
    decided = determine(problem.prepared, problem.structure(x), x)
    assert decided.determined
    uncertain = uncertainty(problem.prepared, problem.structure(x), x)
    assert np.isnan(uncertain.variables["a"])
    assert np.all(np.isfinite(uncertain.stiffness))


def test_a_further_test_adds_what_it_sees():
    m = sysid.Variable("m", 3, lower=0.1, upper=10, guess=MASSES)
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5, guess=SPRINGS)
    c = sysid.Variable("c", 3, lower=0.1, upper=50, guess=DAMPERS)
    added = np.diag([0.0, 0.0, 0.7])
    second = sysid.simulate(chain_structure(MASSES + np.diag(added)), FREQ)
    problem = sysid.Problem(
        sysid.simulate(chain_structure(), FREQ), mass=ca.diag(m), stiffness=chain(k), damping=chain(c),
        residuals=[sysid.FurtherTest(second, mass=ca.diag(m) + added, stiffness=chain(k), damping=chain(c))],
    )  # fmt: skip
    assert sensitivity(problem.formulation, TRUTH).rank == 9
    assert determine(problem.prepared, problem.structure(TRUTH), TRUTH).determined


def test_an_own_misfit_has_its_own_jacobian():
    k = sysid.Variable("k", 2, lower=1.0, upper=9.0, guess=[2.0, 3.0])
    test = sysid.simulate(chain_structure(), FREQ)
    K = chain(ca.vertcat(1e4 * k[0], 1e4 * k[1], 1e4))
    problem = sysid.Problem(
        test, mass=np.diag(MASSES), stiffness=K, damping=1e-4 * K,
        misfit=ca.vertcat(k[0] * k[1] - 6, 2 * k[0] * k[1] - 12, (k[0] * k[1]) ** 2 - 36),
    )  # fmt: skip
    known = sensitivity(problem.formulation, np.array([2.0, 3.0]))
    assert known.rank == 1
    moved = known.unit * known.unseen[:, 0]
    np.testing.assert_allclose(moved[0] * 3 + moved[1] * 2, 0, atol=1e-9)


@pytest.mark.parametrize("moving", [False, True])
def test_words_name_each_null_direction(moving):
    x = np.array([2.0, 0.0, 5.0])
    unit = np.array([2.0, 1.0, 5.0])
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]) @ (
        np.array([[0.6, 0.8], [-0.8, 0.6]]) if moving else np.eye(2)
    )
    variables = [sysid.Variable(name, lower=-9, upper=9) for name in "abc"]
    words = set(directions_in_words(variables, x, unit, directions))
    assert {word.replace("+", "").replace("-", "") for word in words} == {"a 1 %, c 1 %", "b 0.01"}


# -- noise ------------------------------------------------------------------------------------------------------------

DRAWS = 30


def drawn(problem_of, truth, x, noise=0.01, force=False):
    """Fits to `DRAWS` records of `truth` with noise: unknowns, and the structures that they make."""
    problems = [problem_of(sysid.simulate(truth, FREQ, noise=noise, force=force, rng=i)) for i in range(DRAWS)]
    answers = np.array([local.solve(problem.prepared, x).x for problem in problems])
    return answers, [problems[0].structure(answer) for answer in answers]


def same(stated, values, factor=1.45):
    """A standard deviation is that of the draws; with 30 of them within 45 % in 999 of 1000 cases."""
    spread = np.std(values, axis=0, ddof=1)
    big = spread > 1e-9 * np.abs(values).max()
    ratio = np.asarray(stated)[big] / spread[big]
    assert np.all(ratio < factor), ratio
    assert np.all(ratio > 1 / factor), ratio


MASSES_2, SPRINGS_2, DAMPERS_2 = MASSES[:2], np.array([2e4, 1.5e4]), np.array([9.0, 6.0])


def weighed(test):
    """Two floors, all free, with the force of the base."""
    m = sysid.Variable("m", 2, lower=0.1, upper=10, guess=MASSES_2)
    k = sysid.Variable("k", 2, lower=1e3, upper=1e5, guess=SPRINGS_2)
    c = sysid.Variable("c", 2, lower=0.1, upper=50, guess=DAMPERS_2)
    return sysid.Problem(test, mass=ca.diag(m), stiffness=chain(k, 2), damping=chain(c, 2))


def known_total(test):
    """The same by the total of its masses, and one ratio a mode."""
    m = sysid.Variable("m", 2, lower=0.1, upper=10, guess=MASSES_2)
    k = sysid.Variable("k", 2, lower=1e3, upper=1e5, guess=SPRINGS_2)
    z = sysid.Variable("z", 2, lower=0.001, upper=0.2, guess=[0.03, 0.03])
    return sysid.Problem(
        test, mass=ca.diag(m), stiffness=chain(k, 2), damping=z, constraints=[ca.sum1(m) == MASSES_2.sum()]
    )


@pytest.mark.parametrize("kind", ["force", "total"])
def test_standard_deviations_are_those_of_draws(kind):
    truth = chain_structure(MASSES_2, SPRINGS_2, DAMPERS_2)
    by_force = kind == "force"
    problem_of = weighed if by_force else known_total
    if not by_force:
        truth = sysid.Structure(truth.mass, truth.stiffness, [0.02, 0.04], n_base=1)
    x = np.concatenate([MASSES_2, SPRINGS_2, DAMPERS_2 if by_force else [0.02, 0.04]])
    answers, structures = drawn(problem_of, truth, x, force=by_force)
    problem = problem_of(sysid.simulate(truth, FREQ, noise=0.01, force=by_force, rng=1000))
    x = local.solve(problem.prepared, x).x
    uncertain = uncertainty(problem.prepared, problem.structure(x), x)
    same(
        np.concatenate([np.ravel(uncertain.variables[name]) for name in ("m", "k", "c" if by_force else "z")]), answers
    )
    same(np.sqrt(np.diag(uncertain.covariance)), answers)
    same(uncertain.natural_frequencies, [s.natural_frequencies for s in structures])
    same(uncertain.damping_ratios, [s.damping_ratios for s in structures])
    same(uncertain.mode_shapes, [s.mode_shapes for s in structures])
    same(uncertain.participation, [s.participation for s in structures])
    same(uncertain.mass, [s.mass[:2, :2] for s in structures])
    same(uncertain.stiffness, [s.stiffness[:2, :2] for s in structures])
    same(uncertain.damping, [s.damping for s in structures])
    same(uncertain.rigid_body_mass, [s.rigid_body_mass for s in structures])
    lines = FREQ[3::6]
    for name in ("transmissibility", "base_force"):
        made = np.array([getattr(s, name)(lines) for s in structures])
        off = made - made.mean(axis=0)
        rms = np.sqrt(np.sum(np.abs(off) ** 2, axis=0) / (DRAWS - 1))
        stated = getattr(uncertain, name)(lines)
        assert stated.shape == rms.shape
        ratio = stated[rms > 1e-9 * np.abs(made).max()] / rms[rms > 1e-9 * np.abs(made).max()]
        assert np.all((ratio < 1.45) & (ratio > 1 / 1.45)), ratio


def test_twice_the_noise_is_twice_the_deviation():
    truth = chain_structure(MASSES_2, SPRINGS_2, DAMPERS_2)
    x = np.concatenate([MASSES_2, SPRINGS_2, DAMPERS_2])
    test = sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=3)

    def stated(factor):
        return weighed(
            sysid.Measurement(
                test.freq, test.base, test.response, rigid_body=test.rigid_body, force=test.force,
                response_std=np.full(test.response.shape, factor), force_std=np.full(test.force.shape, 3 * factor),
            )
        )  # fmt: skip

    once, twice = (uncertainty(p.prepared, p.structure(x), x) for p in map(stated, (1.0, 2.0)))
    for name in "mkc":
        np.testing.assert_allclose(twice.variables[name], 2 * once.variables[name], rtol=1e-9)


def test_damping_by_ratios_follows_the_mass_where_frequencies_repeat():
    """K = w² M at every p: both modes stay at w with one ratio, so C = 2 zeta w M, whatever their shapes are."""
    w, zeta, shape = 2 * np.pi * 9.0, 0.02, np.array([[1.0, 0.4], [0.4, -0.5]])
    p = sysid.Variable("p", lower=-1, upper=1, guess=0.3)
    M, G = ca.DM(np.diag([3.0, 2.0])) + p * ca.DM(shape), np.array([[1.0], [1.0]])
    unit = sysid.Measurement(FREQ, np.ones((1, 40)), np.ones((1, 2, 40)) * (1 + 1j * FREQ), rigid_body=G)
    problem = sysid.Problem(unit, mass=M, stiffness=w**2 * M, damping=np.array([zeta, zeta]))
    slopes = slopes_of(problem.formulation.matrices, np.array([0.3]), unit)
    np.testing.assert_allclose(slopes.damping[..., 0], 2 * zeta * w * shape, rtol=1e-9)
    np.testing.assert_allclose(slopes.d_log_omega, 0, atol=1e-12)
