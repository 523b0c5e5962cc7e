"""The swarm's objective: that of each candidate, and the order in which constraints put them."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.search.swarm_objective import SwarmObjective

FREQ = np.linspace(1.0, 30.0, 31)


def chain(k):
    n = 3
    T = ca.DM(np.eye(n) - np.eye(n, k=-1))
    return T.T @ ca.diag(k) @ T


def truth(masses=(3.0, 2.0, 1.0)):
    K = np.asarray(ca.DM(chain(ca.DM([2e4, 1.5e4, 1e4]))))
    one = np.ones((3, 1))
    whole = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    return sysid.Structure(np.diag([*masses, 0.5]), whole, damping_matrix=2e-4 * K + 0.3 * np.eye(3), n_base=1)


def make(damping="states", *, force=False, log=False, recovery=False, **build):
    """Three floors, all of them unknown, damped by a matrix ("states") or by ratios ("modes")."""
    m = sysid.Variable("m", 3, lower=0.5, upper=5)
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5, log=log)
    c = sysid.Variable("c", 3, lower=0.001, upper=0.2)
    test = sysid.simulate(truth(), FREQ, noise=0.05, force=force, rng=0)
    given = {name: value(m, k, c) for name, value in build.items()}
    if recovery:
        R = np.eye(3)[[2, 0]]
        test = sysid.Measurement(test.freq, test.base, test.response[:, [2, 0]], rigid_body=R @ np.ones((3, 1)))
        given |= {"recovery": R, "rigid_body_dofs": np.ones((3, 1))}
    mass = ca.diag(ca.vertcat(m, 0.5))
    return sysid.Problem(
        test, mass=mass, stiffness=chain(k), damping=c if damping == "modes" else chain(99 * c), **given
    )


def particles(problem, count, seed=0):
    return np.random.default_rng(seed).uniform(problem.lower, problem.upper, (count, problem.n_variables))


@pytest.mark.parametrize("options", [{}, {"force": True}, {"log": True}, {"recovery": True}], ids=str)
@pytest.mark.parametrize("damping", ["states", "modes"])
def test_the_cost_is_the_objective_the_unknowns_that_a_candidate_stands_for(damping, options):
    problem = make(damping, **options)
    cost, rows = SwarmObjective(problem.prepared), particles(problem, 70)
    expected = [problem.objective(cost.unknowns(s)) for s in rows]
    np.testing.assert_allclose(cost(rows), expected, rtol=1e-9)


@pytest.mark.parametrize("damping", ["states", "modes"])
def test_residuals_further_tests_and_an_own_misfit_count(damping):
    def further(m, k, c):
        second = sysid.simulate(truth((3.0, 2.0, 1.7)), FREQ[::2], noise=0.05, force=True, rng=1)
        added = ca.diag(ca.vertcat(m[:2], m[2] + 0.7, 0.5))
        return [ca.sum1(m) / 6 - 1, sysid.FurtherTest(second, mass=added, stiffness=chain(k), damping=chain(99 * c))]

    for build in ({"residuals": further}, {"misfit": lambda m, k, c: ca.vertcat(m - 1, c)}):
        problem = make(damping, **build)
        rows = particles(problem, 9)
        np.testing.assert_allclose(
            SwarmObjective(problem.prepared)(rows), [problem.objective(s) for s in rows], rtol=1e-9
        )


def test_sampling_is_on_the_logarithm_and_to_sampling_its_inverse():
    problem = make(log=True)
    cost, rows = SwarmObjective(problem.prepared), particles(problem, 5)
    for s in rows:
        x = cost.unknowns(s)
        share = (s[3:6] - 1e3) / (1e5 - 1e3)
        np.testing.assert_allclose(x[3:6], 1e3 * 100**share, rtol=1e-12)
        np.testing.assert_array_equal(x[[0, 1, 2, 6, 7, 8]], s[[0, 1, 2, 6, 7, 8]])
        np.testing.assert_allclose(problem.formulation.to_sampling(x), s, rtol=1e-9)


def test_healing_meets_an_equality_and_stays_in_the_box():
    problem = make(healing=lambda m, k, c: {m: 6.0 * m / ca.sum1(m)}, constraints=lambda m, k, c: [ca.sum1(m) == 6.0])
    cost, rows = SwarmObjective(problem.prepared), particles(problem, 40)
    for s, value in zip(rows, cost(rows), strict=True):
        x = cost.unknowns(s)
        np.testing.assert_array_equal(x[3:], s[3:])
        healed = 6.0 * s[:3] / s[:3].sum()
        np.testing.assert_allclose(x[:3], np.clip(healed, 0.5, 5), rtol=1e-12)
        if np.all((healed > 0.5) & (healed < 5)):
            assert value == pytest.approx(problem.objective(x))


def test_whatever_keeps_the_constraints_comes_before_what_breaks_them_and_less_broken_before_more():
    problem = make(constraints=lambda m, k, c: [m[0] <= m[1], ca.sum1(m) == 6.0])
    base = np.array([1.5, 2.5, 2.0, 5e4, 5e4, 5e4, 0.1, 0.1, 0.1])
    kept, less, more = (base + np.eye(9)[0] * step for step in (0.0, 1.1, 1.5))
    poor = base.copy()
    poor[3:6] = 1.0e3  # keeps them, and explains nothing
    costs = SwarmObjective(problem.prepared)(np.array([kept, poor, less, more]))
    np.testing.assert_allclose(costs[:2], [problem.objective(kept), problem.objective(poor)], rtol=1e-9)
    assert costs[:2].max() < costs[2] < costs[3]


def test_an_inequality_lets_through_what_is_at_its_bound():
    problem = make(constraints=lambda m, k, c: [m[0] <= m[1]])
    at = np.array([2.0, 2.0, 2.0, 5e4, 5e4, 5e4, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(SwarmObjective(problem.prepared)(at[None]), problem.objective(at), rtol=1e-9)


@pytest.mark.filterwarnings("ignore:invalid")
def test_a_constraint_that_is_no_number_is_not_kept():
    problem = make(constraints=lambda m, k, c: [ca.log(m[0] - 1.0) <= 0.0])
    kept = np.array([1.5, 2.5, 2.0, 5e4, 5e4, 5e4, 0.1, 0.1, 0.1])
    nowhere = kept.copy()
    nowhere[0] = 0.6
    costs = SwarmObjective(problem.prepared)(np.array([kept, nowhere]))
    assert costs[0] < 10
    assert not costs[1] < costs[0] + 1e3


def indefinite(damping):
    """Entries of the stiffness, and of the mass, that may make no structure."""
    a = sysid.Variable("a", 3, lower=1e3, upper=5e4)
    b = sysid.Variable("b", lower=-4e4, upper=4e4)
    e = sysid.Variable("e", lower=-3, upper=3)
    K = ca.blockcat([[a[0], b, 0], [b, a[1], b], [0, b, a[2]]])
    M = ca.blockcat([[3, e, 0], [e, 2, 0], [0, 0, 1]])
    C = sysid.Variable("z", 3, lower=0.001, upper=0.1) if damping == "modes" else a[0] * 1e-4 * ca.DM.eye(3)
    return sysid.Problem(sysid.simulate(truth(), FREQ), mass=M, stiffness=K, damping=C)


@pytest.mark.parametrize("damping", ["states", "modes"])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_candidate_without_a_mass_matrix_is_no_number_and_leaves_the_others_alone(damping):
    problem = indefinite(damping)
    good = np.array([2e4, 2e4, 2e4, 0.0, 0.1, *([0.01] * (problem.n_variables - 5))])
    bad = good.copy()
    bad[4] = 2.9
    costs = SwarmObjective(problem.prepared)(np.array([good, bad, good]))
    np.testing.assert_array_equal(np.isnan(costs), [False, True, False])
    np.testing.assert_allclose(costs[[0, 2]], problem.objective(good), rtol=1e-9)


@pytest.mark.parametrize(
    "damping",
    [
        pytest.param("states"),
        pytest.param("modes"),
    ],
)
def test_a_candidate_without_a_stiffness_matrix_is_no_number(damping):
    problem = indefinite(damping)
    bad = np.array([2e4, 2e4, 2e4, 4e4, 0.1, *([0.01] * (problem.n_variables - 5))])
    with pytest.raises(sysid.InputError):
        problem.structure(bad)
    assert np.isnan(SwarmObjective(problem.prepared)(bad[None])[0])


@pytest.mark.parametrize("damping", ["states", "modes"])
def test_a_candidate_whose_base_is_lighter_than_its_coupling_is_no_number(damping):
    """M_00 below M_S0' M_SS^-1 M_S0 = 0.8² / 3 + 0.8² / 2 + 0.8² / 1: a mass that is not positive semidefinite."""
    base = sysid.Variable("base", lower=0.5, upper=5)
    coupled = np.pad(np.diag([3.0, 2, 1]), (0, 1))
    coupled[:3, 3] = coupled[3, :3] = 0.8
    corner = np.diag([0.0, 0, 0, 1])
    c = sysid.Variable("c", 3, lower=0.001, upper=0.2)
    problem = sysid.Problem(
        sysid.simulate(truth(), FREQ, force=True), mass=coupled + base * corner,
        stiffness=chain(ca.DM([2e4, 1.5e4, 1e4])), damping=c if damping == "modes" else chain(99 * c),
    )  # fmt: skip
    least = 0.8**2 * (1 / 3 + 1 / 2 + 1)
    order = [problem.formulation.labels.index(name) for name in ("base", "c[0]", "c[1]", "c[2]")]
    rows = np.empty((2, 4))
    rows[:, order] = np.array([[0.99 * least, 0.1, 0.1, 0.1], [1.01 * least, 0.1, 0.1, 0.1]])
    costs = SwarmObjective(problem.prepared)(rows)
    with pytest.raises(sysid.InputError):
        problem.structure(rows[0])
    assert np.isnan(costs[0])
    assert costs[1] == pytest.approx(problem.objective(rows[1]), rel=1e-9)


def test_a_candidate_whose_damping_feeds_energy_in_is_no_number():
    """Dampers of 5 and c between three floors; one of less than nothing makes C indefinite."""
    c = sysid.Variable("c", lower=-9.0, upper=9.0)
    problem = sysid.Problem(
        sysid.simulate(truth(), FREQ), mass=np.diag([3.0, 2, 1]), stiffness=chain(ca.DM([2e4, 1.5e4, 1e4])),
        damping=chain(ca.vertcat(5.0, 5.0, c)),
    )  # fmt: skip
    costs = SwarmObjective(problem.prepared)(np.array([[2.0], [-2.0]]))
    with pytest.raises(sysid.InputError):
        problem.structure(np.array([-2.0]))
    assert np.isnan(costs[1])
    assert costs[0] == pytest.approx(problem.objective(np.array([2.0])), rel=1e-9)


@pytest.mark.parametrize("damping", ["states", "modes"])
def test_bits_do_not_depend_on_who_else_is_in_the_batch(damping):
    problem = make(damping, force=True, constraints=lambda m, k, c: [m[0] <= m[1]])
    cost, rows = SwarmObjective(problem.prepared), particles(problem, 150)
    whole = cost(rows)
    for cuts in ([1, 2, 66], [64], [149], [17, 130]):
        np.testing.assert_array_equal(np.concatenate([cost(part) for part in np.split(rows, cuts)]), whole)
    order = np.random.default_rng(1).permutation(len(rows))
    np.testing.assert_array_equal(cost(rows[order]), whole[order])
    np.testing.assert_array_equal(SwarmObjective(problem.prepared)(rows), whole)


def critically_damped():
    """Critically damped masses without springs between them: eigenvectors of the state space that fall together."""
    m = sysid.Variable("m", 2, lower=0.5, upper=5)
    w = sysid.Variable("w", 2, lower=1.0, upper=100.0)
    z = sysid.Variable("z", 2, lower=0.01, upper=2.0)
    one = sysid.Structure(np.diag([1.0, 1, 0]), 1e4 * np.array([[1, 0, -1], [0, 1.5, -1.5], [-1, -1.5, 2.5]]),
                          [0.02, 0.02], n_base=1)  # fmt: skip
    problem = sysid.Problem(
        sysid.simulate(one, FREQ), mass=ca.diag(m), stiffness=ca.diag(m * w * w), damping=ca.diag(2 * m * z * w)
    )
    return problem


CRITICAL = np.array([1.0, 2.0, 16.0, 16.0, 1.0, 1.0])


def test_a_defective_candidate_changes_the_bits_of_no_other():
    problem = critically_damped()
    cost, rows = SwarmObjective(problem.prepared), particles(problem, 12)
    alone = cost(rows)
    together = cost(np.array([*rows[:5], CRITICAL, *rows[5:]]))
    np.testing.assert_array_equal(np.delete(together, 5), alone)


def test_a_defective_candidate_has_its_misfit():
    problem = critically_damped()
    np.testing.assert_allclose(SwarmObjective(problem.prepared)(CRITICAL[None]), problem.objective(CRITICAL), rtol=1e-5)
