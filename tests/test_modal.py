"""Strategy "modal": no swarm, no frequencies; checked against structures that are known."""

import numpy as np
import pytest

import sysid
from sysid.damping import ProportionalDamping


def structure(seed, n, d):
    """Random full, coupled mass and stiffness, damping from 0.3 % (below the swarm's box) to 4 %."""
    rng = np.random.default_rng([seed, n, d])
    G = np.zeros((n, d))
    G[np.arange(n), rng.integers(0, d, n)] = 1.0
    root = rng.normal(size=(n + d, n + d))
    M = root @ root.T + np.eye(n + d)
    f = np.cumsum(rng.uniform(1.5, 8.0, n)) + 2.0
    L = np.linalg.cholesky(M[:n, :n])
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    K = L @ (Q * (2 * np.pi * f) ** 2) @ Q.T @ L.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return sysid.Structure(M, full, rng.uniform(0.003, 0.04, n), n_base=d)


def lines(truth):
    f = truth.natural_frequencies
    return np.geomspace(0.7 * f[0], 1.3 * f[-1], 60 * truth.n)


@pytest.mark.parametrize(("n", "d"), [(3, 1), (5, 2), (8, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_with_base_force_the_structure_itself_is_found(seed, n, d):
    truth = structure(seed, n, d)
    test = sysid.simulate(truth, lines(truth), force=True)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert result.success
    assert result.strategy == "modal"
    assert result.residual < 1e-10
    for name in ("mass", "stiffness", "damping"):
        true, found = getattr(truth, name), getattr(result.structure, name)
        np.testing.assert_allclose(found[:n, :n], true[:n, :n], atol=1e-8 * np.abs(true).max())


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
@pytest.mark.parametrize("seed", range(3))
def test_accelerations_alone_are_matched_with_the_stated_total_and_called_open(seed, healing):
    truth = structure(seed, 6, 2)
    test = sysid.simulate(truth, lines(truth))
    problem = sysid.Problem(test, mass=sysid.FullMass(40.0, healing=healing))
    result = sysid.identify(problem, strategy="modal", rng=0)
    assert result.success
    assert result.residual < 1e-10
    assert not result.determined
    np.testing.assert_allclose(problem.mass.total(problem.layout, result.structure.mass), 40.0, rtol=1e-9)
    n = truth.n
    invariant = np.linalg.solve(truth.mass[:n, :n], truth.stiffness[:n, :n])
    found = np.linalg.solve(result.structure.mass[:n, :n], result.structure.stiffness[:n, :n])
    np.testing.assert_allclose(found, invariant, atol=1e-7 * np.abs(invariant).max())


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_fitted_to_its_floor(seed):
    truth = structure(seed, 5, 2)
    test = sysid.simulate(truth, lines(truth), noise=0.01, force=True, rng=seed)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert result.success
    assert result.residual == pytest.approx(test.residual(truth), rel=0.05)


def test_given_frequencies_do_not_matter_and_seeds_neither():
    truth = structure(0, 4, 1)
    test = sysid.simulate(truth, lines(truth))
    given = sysid.SpectralStiffness(truth.natural_frequencies.round(2))
    problem = sysid.Problem(test, mass=sysid.FullMass(10.0), stiffness=given)
    first, second = (sysid.identify(problem, strategy="modal", rng=seed) for seed in (0, 1))
    assert first.residual < 1e-10
    np.testing.assert_array_equal(first.x, second.x)


def test_other_models_are_refused_by_name():
    truth = structure(1, 4, 1)
    problem = sysid.Problem(
        sysid.simulate(truth, lines(truth)),
        mass=sysid.FullMass(10.0),
        damping=ProportionalDamping((0.0, 1.0), (0.0, 0.01)),
    )
    with pytest.raises(sysid.InputError, match="modal"):
        sysid.identify(problem, strategy="modal")


def test_as_many_modes_as_sensors_are_demanded():
    truth = structure(2, 5, 1)
    full = sysid.simulate(truth, lines(truth))
    few = sysid.Measurement(full.freq, full.base, full.response[:, :3], rigid_body=full.rigid_body[:3])
    stiffness = sysid.SpectralStiffness(truth.natural_frequencies[:3])
    with pytest.raises(sysid.InputError, match="5 modes stand out of the data .* for 3 sensors"):
        sysid.identify(sysid.Problem(few, mass=sysid.FullMass(10.0), stiffness=stiffness), strategy="modal")


def test_a_callback_can_stop_it():
    truth = structure(0, 4, 1)
    problem = sysid.Problem(sysid.simulate(truth, lines(truth), noise=0.02, rng=0), mass=sysid.FullMass(10.0))

    def stop(progress):
        raise StopIteration

    result = sysid.identify(problem, strategy="modal", callback=stop)
    assert not result.success
    assert result.message == "the callback stopped the search"
