"""The swarm's objective without lines, beside the one by lines on compiled CasADi functions."""

import dataclasses

import numpy as np
import pytest

import sysid
from sysid.search.swarm_objective import HeldSpectrumObjective, SwarmObjective, chunk_ends

N, D = 5, 2
FREQ = np.linspace(1.0, 25.0, 60)
G = np.eye(D)[[0, 1, 0, 1, 0]]
TURN = np.array([[0.96, 0.28], [-0.28, 0.96]])


def truth(rigid_body=G):
    """Frequencies of 2 to 20 Hz, with coupling to a base of mass."""
    rng = np.random.default_rng(4)
    factor = np.tril(rng.normal(size=(N + D, N + D))) + 4 * np.eye(N + D)
    M = factor @ factor.T
    L = np.linalg.cholesky(M[:N, :N])
    half = L @ np.linalg.qr(rng.normal(size=(N, N)))[0] * (2 * np.pi * np.array([2.0, 5.0, 9.0, 14.0, 20.0]))
    K = half @ half.T
    whole = np.block([[K, -K @ rigid_body], [-rigid_body.T @ K, rigid_body.T @ K @ rigid_body]])
    return sysid.Structure(M, whole, np.linspace(0.01, 0.03, N), n_base=D)


def measured(structure, base="unit", *, force=False, noise=False):
    """A test of the structure; `base` names how its base moves."""
    rng = np.random.default_rng(1)
    if base == "unit":
        return sysid.simulate(structure, FREQ, force=force, noise=0.02 if noise else 0.0, rng=0)
    runs = {"one run": 1, "three runs": 3, "loud and quiet": 2}[base]
    u = rng.normal(size=(runs, D, FREQ.size)) + 1j * rng.normal(size=(runs, D, FREQ.size))
    if base == "loud and quiet":  # each run moves one direction, as it likes over the lines
        u = np.eye(D)[:, :, None] * u
    absolute = np.einsum("ndf,rdf->rnf", structure.transmissibility(FREQ), u)
    of_base = np.einsum("edf,rdf->ref", structure.base_force(FREQ), u) if force else None
    lines = rng.uniform(0.01, 0.02, (runs, 1, FREQ.size))
    std = {"response_std": lines * np.ones((N, 1))} if noise else {}
    std |= {"force_std": 3 * lines * np.ones((D, 1))} if noise and force else {}
    return sysid.Measurement(FREQ, u, absolute, rigid_body=structure.rigid_body, force=of_base, **std)


def problem(base="unit", *, healing="trace", total=True, rigid_body=G, given=N, residual_modes=False, **records):
    structure = truth(rigid_body)
    mass = sysid.FullMass(np.diag(structure.rigid_body_mass) if total else None, healing=healing)
    return sysid.Problem(
        measured(structure, base, **records),
        mass=mass,
        stiffness=sysid.SpectralStiffness(structure.natural_frequencies[:given], max_frequency=21.0),
        damping=sysid.ModalDamping(0.005, 0.05),
        residual_modes=residual_modes,
    )


def objective(made):
    return SwarmObjective(made.prepared, spectrum=made.formulation.stiffness.spectrum)


def particles(made, count, seed=0):
    return np.random.default_rng(seed).uniform(made.lower, made.upper, (count, made.n_variables))


def by_lines(made, cost, rows):
    """Squared objective from compiled CasADi functions."""
    x = np.array([cost.unknowns(s) for s in rows])
    return made.formulation.own_test.squared(x, made.formulation.stiffness.spectrum)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"healing": "rigid_body"},
        {"healing": "rigid_body", "rigid_body": G @ TURN},  # scales that are coupled
        {"noise": True},
        {"force": True},
        {"force": True, "noise": True},
        {"force": True, "total": False},
        {"base": "one run"},
        {"base": "one run", "force": True, "noise": True},
        {"base": "three runs"},
        {"base": "loud and quiet"},
        {"base": "loud and quiet", "noise": True, "force": True},
        {"residual_modes": True},
        {"residual_modes": True, "base": "one run", "noise": True},
        {"residual_modes": True, "base": "loud and quiet"},
    ],
    ids=str,
)
def test_it_agrees_with_the_sum_over_lines(options):
    made = problem(**options)
    cost, rows = objective(made), particles(made, 70)
    assert cost._held is not None
    expected, found = by_lines(made, cost, rows), cost(rows) ** 2
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))  # scales that no candidate can have
    made_one = ~np.isnan(expected)
    assert np.count_nonzero(made_one) > 35
    assert np.all(np.abs(found - expected)[made_one] <= 1e-9 * np.maximum(expected[made_one], 1.0))


def test_sensors_that_are_no_degrees_of_freedom_are_recovered():
    structure, R = truth(), np.eye(N)[[4, 0, 1]]
    test = measured(structure)
    seen = sysid.Measurement(FREQ, test.base, np.einsum("sn,rnf->rsf", R, test.response), rigid_body=R @ G)
    made = sysid.Problem(
        seen,
        mass=sysid.FullMass(10.0),
        stiffness=sysid.SpectralStiffness(structure.natural_frequencies),
        damping=sysid.ModalDamping(0.005, 0.05),
        recovery=R,
        rigid_body_dofs=G,
    )
    cost, rows = objective(made), particles(made, 9)
    assert cost._held is not None
    np.testing.assert_allclose(cost(rows) ** 2, by_lines(made, cost, rows), rtol=1e-9)


def test_frequencies_that_are_free_go_by_lines():
    made = problem(given=3)
    cost, rows = objective(made), particles(made, 5)
    assert cost._held is None
    np.testing.assert_allclose(cost(rows) ** 2, by_lines(made, cost, rows), rtol=1e-12)


def test_candidates_near_the_records_go_by_lines():
    made = problem(healing="rigid_body")
    cost, exact = objective(made), made.formulation.to_sampling(made.values(truth()))
    rows = particles(made, 3)
    rows[1] = exact
    costs = cost(rows)
    assert costs[1] == np.sqrt(by_lines(made, cost, rows[1:2])[0]) < 1e-9
    assert np.all(costs[[0, 2]] > 1e-3)


def test_candidates_near_a_record_that_weighs_more_than_the_accelerations_go_by_lines():
    """The square of a force that is a thousand times as exact is a difference of numbers a million times as large."""
    made = problem("three runs", healing="rigid_body", force=True)
    test = made.measurement
    std = np.sqrt(np.mean(np.abs(test.relative) ** 2)), 1e-3 * np.sqrt(np.mean(np.abs(test.force) ** 2))
    stated = dataclasses.replace(
        test, response_std=std[0] * np.ones((N, FREQ.size)), force_std=std[1] * np.ones((D, FREQ.size))
    )
    made = dataclasses.replace(made, measurement=stated)
    cost, exact = objective(made), made.formulation.to_sampling(made.values(truth()))
    rows = exact * (1 + 1e-5 * np.random.default_rng(0).normal(size=(4, exact.size)))
    expected = by_lines(made, cost, rows)
    assert np.all((expected > 1e-6) & (expected < 1.0))
    np.testing.assert_allclose(cost(rows) ** 2, expected, rtol=1e-9)


def test_ratios_outside_of_the_range_go_by_lines_and_no_number_stays_none():
    made = problem()
    cost, rows = objective(made), particles(made, 3)
    rows[1, -1], rows[2, made.formulation.parts.stiffness.start] = 0.2, np.nan
    costs = cost(rows)
    np.testing.assert_array_equal(np.isnan(costs), [False, False, True])
    np.testing.assert_allclose(costs[:2] ** 2, by_lines(made, cost, rows[:2]), rtol=1e-9)


@pytest.mark.parametrize(
    ("count", "ends"), [(1, [16]), (17, [32]), (480, [256, 480]), (496, [256, 496]), (600, [128, 320, 448, 608])]
)
def test_chunks_are_nearly_equal_and_as_many_for_each_of_two_threads(count, ends):
    assert chunk_ends(count, 250) == ends


def test_neither_threads_nor_the_place_among_candidates_change_a_bit():
    made = problem(force=True)
    cost, rows = objective(made), particles(made, 2601)  # of four chunks
    formulation = made.formulation
    given = made, formulation.own_test, formulation.stiffness.spectrum, cost._held.expansion
    alone = HeldSpectrumObjective(*given, threads=1)
    expected = alone(rows, None)
    many = HeldSpectrumObjective(*given, threads=5)
    np.testing.assert_array_equal(many(rows, None), expected)
    order = np.random.default_rng(0).permutation(len(rows))
    np.testing.assert_array_equal(alone(rows[order], None), expected[order])
    for count in (1, 15, 16, 63, 65, 130, 1000):
        np.testing.assert_array_equal(alone(rows[:count], None), expected[:count])
    np.testing.assert_allclose(cost(rows), np.sqrt(expected), rtol=1e-15)


def test_residuals_and_constraints_in_variables_of_their_own_count_beside_it():
    q = sysid.Variable("q", lower=0.0, upper=2.0)
    plain = problem()
    given = {"mass": plain.mass, "stiffness": plain.stiffness, "damping": plain.damping}
    made = sysid.Problem(plain.measurement, **given, residuals=[0.1 * (q - 1.0)], constraints=[q <= 1.5])
    cost, rows = objective(made), particles(made, 6)
    rows[:, -1] = [0.0, 0.5, 1.0, 1.4, 1.6, 1.9]
    assert cost._held is not None
    kept = np.sqrt(objective(plain)(rows[:4, :-1]) ** 2 + 0.01 * (rows[:4, -1] - 1) ** 2)
    costs = cost(rows)
    np.testing.assert_allclose(costs[:4], kept, rtol=1e-12)
    assert kept.max() < costs[4] < costs[5]
