"""The bound of the benchmarks against finite differences of the whole way from modes to records and matrices."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import sysid

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "modal" / "cramer_rao.py"


@pytest.fixture(scope="module")
def cramer_rao():
    """The benchmark's file, whatever is on the path."""
    spec = importlib.util.spec_from_file_location("cramer_rao_under_test", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(params=[1, 2, 3])
def case(request, random_structure):
    """A structure, and a test of two runs with random base motion."""
    d = request.param
    rng = np.random.default_rng(d)
    truth = random_structure(rng, n=3, d=d)
    freq = np.geomspace(0.7 * truth.natural_frequencies[0], 1.3 * truth.natural_frequencies[-1], 40)
    base = rng.normal(size=(2, d, 40)) + 1j * rng.normal(size=(2, d, 40))
    unit = sysid.simulate(truth, freq)
    response = np.einsum("dsf,rdf->rsf", unit.response, base)
    force = np.einsum("edf,rdf->ref", truth.base_force(freq), base)
    sigma = {"response_std": rng.uniform(0.01, 0.02, response.shape), "force_std": rng.uniform(0.1, 0.2, force.shape)}
    return truth, sysid.Measurement(freq, base, response, rigid_body=truth.rigid_body, force=force, **sigma)


def parameters(truth):
    return np.concatenate(
        [
            truth.mode_shapes.ravel(),
            truth.participation.ravel(),
            np.log(2 * np.pi * truth.natural_frequencies),
            np.log(truth.damping_ratios),
            truth.rigid_body_mass[np.triu_indices(truth.n_base)],
        ]
    )


def parts(theta, n, d):
    ends = np.cumsum([n * n, n * d, n, n])
    phi, gamma, log_w, log_zeta, rigid = np.split(theta, ends)
    mass = np.zeros((d, d))
    mass[np.triu_indices(d)] = rigid
    mass = mass + mass.T - np.diag(np.diag(mass))
    return phi.reshape(n, n), gamma.reshape(n, d), np.exp(log_w), np.exp(log_zeta), mass


def records(theta, truth, test):
    """All records over their standard deviations, real and imaginary parts: unit noise on each complex number."""
    phi, gamma, w, zeta, mass = parts(theta, truth.n, truth.n_base)
    line = 2 * np.pi * test.freq
    g = line**2 / (w[:, None] ** 2 - line**2 + 2j * (zeta * w)[:, None] * line)
    a = np.einsum("sk,kf,kj,rjf->rsf", phi, g, gamma, test.base) / test.response_std
    f = np.einsum("ki,kf,kj,rjf->rif", gamma, g, gamma, test.base) + np.einsum("ij,rjf->rif", mass, test.base)
    f = f / test.force_std
    flat = np.concatenate([a.ravel(), f.ravel()])
    return np.concatenate([flat.real, flat.imag]) * np.sqrt(2)  # each part has half the variance


def matrices(theta, n, d):
    phi, gamma, w, zeta, mass = parts(theta, n, d)
    P = np.linalg.inv(phi)
    return {
        "natural_frequencies": w / (2 * np.pi),
        "damping_ratios": zeta,
        "mass": P.T @ P,
        "stiffness": P.T @ np.diag(w**2) @ P,
        "damping": P.T @ np.diag(2 * zeta * w) @ P,
        "effective_masses": np.einsum("ki,kj->kij", gamma, gamma),
        "rigid_body_mass": mass,
    }


def slopes(function, theta):
    """Central differences, (..., p)."""
    columns = []
    for i in range(theta.size):
        step = np.zeros_like(theta)
        step[i] = 1e-6 * max(1.0, abs(theta[i]))
        columns.append((function(theta + step) - function(theta - step)) / (2 * step[i]))
    return np.stack(columns, axis=-1)


def test_the_modal_sums_are_the_structures_own(case):
    truth, test = case
    answer = records(parameters(truth), truth, test)
    relative = test.relative / test.response_std
    both = np.concatenate([relative.ravel(), (test.force / test.force_std).ravel()])
    np.testing.assert_allclose(answer, np.sqrt(2) * np.concatenate([both.real, both.imag]), atol=1e-6)


def test_information_is_that_of_a_differenced_jacobian(case, cramer_rao):
    truth, test = case
    J = slopes(lambda theta: records(theta, truth, test), parameters(truth))
    expected = J.T @ J
    scale = np.sqrt(np.diag(expected))
    mine = cramer_rao.fisher_information(truth, test)
    np.testing.assert_allclose(mine / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6)


def test_standard_deviations_are_those_of_the_differenced_map(case, cramer_rao):
    truth, test = case
    theta = parameters(truth)
    bound = cramer_rao.cramer_rao(truth, test)
    for name in matrices(theta, truth.n, truth.n_base):
        J = slopes(lambda x, name=name: matrices(x, truth.n, truth.n_base)[name], theta)
        expected = np.sqrt(np.einsum("...p,pq,...q->...", J, bound.covariance, J))
        np.testing.assert_allclose(getattr(bound, name), expected, rtol=1e-5, err_msg=name)
