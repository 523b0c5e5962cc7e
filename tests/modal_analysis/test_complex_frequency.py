"""Responses at complex frequencies from poles and residues of the data: against the structure's own, and what for."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.search.continuation import SHIFTS, Continuation, descend, smoothed_tests
from sysid.search.session import DeferredInterrupt, Session

FREQ = np.linspace(1.0, 70.0, 240)


def at(structure, freq, shift):
    """Relative accelerations for unit base motion at s = shift + 2 pi i freq, (n_sensors, d, n_freq)."""
    n, G = structure.n, structure.rigid_body_dofs
    M, K, C = structure.mass[:n, :n], structure.stiffness[:n, :n], structure.damping
    B = M @ G + structure.mass[:n, n:]
    s = (shift + 2j * np.pi * freq)[:, None, None]
    a = -(s**2) * np.linalg.solve(s**2 * M + s * C + K, np.broadcast_to(B.astype(complex), (freq.size, *B.shape)))
    return np.moveaxis(structure.recovery @ a, 0, -1)


@pytest.mark.parametrize(("damping", "d"), [("ratios", 1), ("ratios", 2), ("ratios", 3), ("matrix", 1), ("matrix", 3)])
def test_what_the_records_would_be_is_what_the_structure_does_there(random_structure, damping, d):
    rng = np.random.default_rng(10 + d)
    structure = random_structure(rng, 4, d, damping=damping, frequencies=[7.0, 16.0, 30.0, 50.0])
    poles = PolesAndResidues.of(sysid.simulate(structure, FREQ))
    assert poles.residual < 1e-9
    for shift in (0.0, 2.0, 30.0, 150.0):
        expected = at(structure, FREQ[::5], shift)
        np.testing.assert_allclose(poles.response(FREQ[::5], shift), expected, atol=1e-6 * np.abs(expected).max())


def test_one_run_in_a_fixed_direction_is_answered_along_it(random_structure):
    rng = np.random.default_rng(3)
    structure = random_structure(rng, 3, 2, frequencies=[8.0, 20.0, 45.0])
    along = np.array([0.6, -0.8])
    u = along[None, :, None] * (rng.normal(size=(1, 1, FREQ.size)) + 1j * rng.normal(size=(1, 1, FREQ.size)))
    record = np.einsum("sdf,rdf->rsf", structure.transmissibility(FREQ), u)
    test = sysid.Measurement(FREQ, u, record, rigid_body=structure.rigid_body, base_axes="xy")
    poles = PolesAndResidues.of(test)
    assert poles.inputs.shape == (2, 1)
    smooth = poles.smoothed(test, 0.2)
    expected = np.einsum("sdf,rdf->rsf", at(structure, smooth.test.freq, smooth.shift), smooth.test.base)
    np.testing.assert_allclose(smooth.test.relative, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("share", SHIFTS)
def test_a_smoothed_test_has_that_share_of_the_mean_frequency_and_reaches_beyond_the_ends(random_structure, share):
    structure = random_structure(np.random.default_rng(4), 3, 2, frequencies=[8.0, 20.0, 45.0])
    test = sysid.simulate(structure, FREQ)
    smooth = PolesAndResidues.of(test).smoothed(test, share)
    assert smooth.shift == pytest.approx(share * 2 * np.pi * (8 * 20 * 45.0) ** (1 / 3), rel=1e-9)
    assert smooth.test.freq[0] < 8 < 45 < smooth.test.freq[-1]
    assert smooth.test.n_runs == 2
    expected = np.einsum("sdf,rdf->rsf", at(structure, smooth.test.freq, smooth.shift), smooth.test.base)
    np.testing.assert_allclose(smooth.test.relative, expected, atol=1e-6 * np.abs(expected).max())


def test_noise_is_left_in_the_residual(random_structure):
    structure = random_structure(np.random.default_rng(5), 3, 1, frequencies=[8.0, 20.0, 45.0])
    test = sysid.simulate(structure, FREQ, noise=0.02, rng=0)
    poles = PolesAndResidues.of(test)
    assert poles.residual == pytest.approx(test.residual(structure), rel=0.05)


MASSES, SPRINGS = np.array([4.0, 3.0, 3.0, 2.0]), np.array([4e4, 3e4, 2.5e4, 1.5e4])


def chain(k):
    T = ca.DM(np.eye(4) - np.eye(4, k=-1))
    return T.T @ ca.diag(k) @ T


def storeys():
    """Four storeys of known mass, their springs and dampers unknown by a factor of 30 and 100."""
    K = np.asarray(ca.DM(chain(ca.DM(SPRINGS))))
    one = np.ones((4, 1))
    whole = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    structure = sysid.Structure(np.diag([*MASSES, 0]), whole, damping_matrix=1.5e-4 * K, n_base=1)
    k = sysid.Variable("k", 4, lower=6e3, upper=1.8e5, log=True)
    c = sysid.Variable("c", 4, lower=0.5, upper=50.0, log=True)
    test = sysid.simulate(structure, np.linspace(3.0, 35.0, 80))
    return sysid.Problem(test, mass=np.diag(MASSES), stiffness=chain(k), damping=chain(c))


def test_continuation_finds_the_truth_of_four_storeys_from_random_starts():
    problem = storeys()
    steps, session = smoothed_tests(problem.prepared).steps, Session([], DeferredInterrupt())
    assert [step[0].shift for step in steps] == sorted((step[0].shift for step in steps), reverse=True)
    rng = np.random.default_rng(0)
    truth = np.concatenate([SPRINGS, 1.5e-4 * SPRINGS])
    starts = problem.lower * (problem.upper / problem.lower) ** rng.random((4, 8))
    ends = np.array([descend(problem.prepared, x, steps, session).x for x in starts])
    np.testing.assert_allclose(ends, np.broadcast_to(truth, ends.shape), rtol=1e-6)


def test_identify_does_so_too_and_names_its_strategy():
    result = sysid.identify(storeys(), strategy=Continuation(starts=2), rng=1)
    assert result.success
    assert result.strategy == "continuation"
    assert result.residual < 1e-9
    np.testing.assert_allclose(result.values["k"], SPRINGS, rtol=1e-6)


def test_a_problem_with_its_own_misfit_has_no_tests_to_smooth():
    k = sysid.Variable("k", 4, lower=6e3, upper=1.8e5)
    test = storeys().measurement
    K = chain(k)
    problem = sysid.Problem(test, mass=np.diag(MASSES), stiffness=K, damping=1e-4 * K, misfit=k / 1e5 - 0.5)
    assert not smoothed_tests(problem.prepared).steps
