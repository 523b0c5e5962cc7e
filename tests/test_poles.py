"""Poles from the data against structures whose poles are known."""

import numpy as np
import pytest

import sysid
from sysid import InputError, Measurement, Problem, simulate
from sysid.poles import find_poles


def structure(rng, n, d, *, near=0.0):
    """Random full mass and stiffness; `near` > 0 puts two modes that fraction apart."""
    axes = rng.integers(0, d, n)
    G = np.zeros((n, d))
    G[np.arange(n), axes] = 1.0
    root = rng.normal(size=(n + d, n + d))
    M = root @ root.T + np.eye(n + d)
    f = np.sort(10 ** rng.uniform(0.5, 1.8, n))
    if near:
        f[n // 2] = f[n // 2 - 1] * (1 + near)
        f.sort()
    L = np.linalg.cholesky(M[:n, :n])
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    K = L @ (Q * (2 * np.pi * f) ** 2) @ Q.T @ L.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return sysid.Structure(M, full, rng.uniform(0.004, 0.04, n), n_base=d)


def lines(truth, count=60):
    f = truth.natural_frequencies
    return np.geomspace(0.7 * f[0], 1.3 * f[-1], count * truth.n)


@pytest.mark.parametrize("near", [0.0, 0.01])
@pytest.mark.parametrize(("n", "d"), [(3, 1), (6, 2), (9, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_without_noise_number_and_poles_are_exact(seed, n, d, near):
    truth = structure(np.random.default_rng([seed, n]), n, d, near=near)
    found = find_poles(simulate(truth, lines(truth)))
    assert found.omega.size == n
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=1e-9)
    np.testing.assert_allclose(found.ratios, truth.damping_ratios, rtol=1e-7)
    assert found.residual < 1e-10


@pytest.mark.parametrize("seed", range(8))
def test_with_noise_no_mode_is_invented_and_no_strong_one_is_missed(seed):
    """A mode is strong where its part of the records is ten times the noise; 1 % noise."""
    rng = np.random.default_rng(seed)
    truth = structure(rng, int(rng.integers(4, 9)), int(rng.integers(1, 4)))
    test = simulate(truth, lines(truth), noise=0.01, rng=rng)
    found, omega, w = find_poles(test), 2 * np.pi * truth.natural_frequencies, 2 * np.pi * test.freq
    g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (truth.damping_ratios * omega)[:, None] * w)
    size = np.linalg.norm(truth.mode_shapes, axis=0) * np.linalg.norm(truth.participation, axis=1)
    part = np.linalg.norm(g, axis=1) * size
    noise = np.sqrt(test.relative.size) * test.response_std.flat[0]
    distance = np.abs(found.omega[:, None] / omega - 1)
    assert np.all(distance.min(axis=0)[part >= 10 * noise] < 0.01)
    assert np.all(distance.min(axis=1) < 0.02)
    assert found.omega.size <= truth.n


def test_runs_whose_base_moves_in_all_directions_at_once():
    rng = np.random.default_rng(0)
    truth = structure(rng, 5, 2)
    freq = lines(truth)
    base = rng.normal(size=(3, 2, freq.size)) + 1j * rng.normal(size=(3, 2, freq.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    found = find_poles(Measurement(freq, base, response, rigid_body=truth.rigid_body))
    np.testing.assert_allclose(found.omega, 2 * np.pi * truth.natural_frequencies, rtol=1e-9)


def test_a_problem_finds_the_frequencies_that_it_is_not_given():
    truth = structure(np.random.default_rng(3), 4, 1)
    problem = Problem(simulate(truth, lines(truth)), mass=sysid.FullMass(10.0), goal=1e-6)
    np.testing.assert_allclose(problem.stiffness.natural_frequencies, truth.natural_frequencies, rtol=1e-9)
    result = sysid.identify(problem, rng=0, strategy=sysid.Swarm(max_iterations=20))
    assert result.success
    assert any("found in the data" in line for line in result.history.log)


def test_a_band_without_a_mode_is_refused():
    truth = structure(np.random.default_rng(4), 4, 1)
    f = truth.natural_frequencies
    test = simulate(truth, np.linspace(0.05 * f[0], 0.1 * f[0], 200), noise=0.05, rng=0)
    with pytest.raises(InputError, match="no mode stands out"):
        find_poles(test)


def test_too_few_lines_are_refused():
    truth = structure(np.random.default_rng(5), 4, 1)
    with pytest.raises(InputError, match="too few"):
        find_poles(simulate(truth, np.linspace(1, 60, 12)))
