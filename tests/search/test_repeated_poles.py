"""Structures with equal frequencies in several directions: two or three modes at one pole."""

import re

import numpy as np
import pytest

import sysid

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
FREQ = np.linspace(0.4, 8.0, 200)
ONE = (np.array([100.0]), np.array([[4e4]]))
TWO = (np.array([100.0, 80.0]), 4e4 * np.array([[2.0, -1], [-1, 1]]))


def alike(storey, d, split):
    """The same storeys in d directions, their frequencies apart by `split`."""
    masses, K = storey
    n = masses.size
    K_SS = np.kron(np.diag((1 + split * np.arange(d)) ** 2), K)
    G = np.kron(np.eye(d), np.ones((n, 1)))
    mass = np.diag(np.concatenate([np.tile(masses, d), np.zeros(d)]))
    stiffness = np.block([[K_SS, -K_SS @ G], [-G.T @ K_SS, G.T @ K_SS @ G]])
    return sysid.Structure(mass, stiffness, np.full(n * d, 0.01), n_base=d)


def assert_found(result, truth):
    n = truth.n
    for name in ("mass", "stiffness", "damping"):
        true, found = (getattr(s, name)[:n, :n] for s in (truth, result.structure))
        np.testing.assert_allclose(found, true, atol=1e-7 * np.abs(true).max())


@pytest.mark.parametrize(("storey", "d"), [(ONE, 2), (ONE, 3), (TWO, 2)])
@pytest.mark.parametrize("split", [0.0, 1e-6])
def test_with_base_force_the_structure_itself_is_found(storey, d, split):
    truth = alike(storey, d, split)
    test = sysid.simulate(truth, FREQ, force=True)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), strategy="modal", rng=0)
    assert_found(result, truth)
    assert result.determined


@pytest.mark.parametrize(("storey", "d"), [(ONE, 2), (ONE, 3), (TWO, 2)])
@pytest.mark.parametrize("split", [0.0, 1e-6])
def test_a_lumped_mass_of_stated_total_is_found_without_force(storey, d, split):
    truth = alike(storey, d, split)
    test = sysid.simulate(truth, FREQ)
    result = sysid.identify(sysid.Problem(test, mass=sysid.LumpedMass(storey[0].sum())), strategy="modal", rng=0)
    assert_found(result, truth)


def test_without_force_a_full_mass_is_called_open_with_its_poles_as_one():
    truth = alike(ONE, 2, 0.0)
    test = sysid.simulate(truth, FREQ)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(100.0)), strategy="modal", rng=0)
    assert result.residual < 1e-10
    assert not result.determined
    assert result.open_masses == (0, 1)
    merged = [one.sentence for one in result.of_kind("open") if "sum" in one.sentence]
    assert [re.findall(r"mode (\d)", sentence) for sentence in merged] == [["1", "2"]]


def test_a_pole_counts_as_often_as_its_residue_has_rank():
    truth = alike(TWO, 2, 0.0)
    problem = sysid.Problem(sysid.simulate(truth, FREQ, noise=0.01, rng=1), mass=sysid.LumpedMass(180.0))
    stated = problem.formulation.stiffness.spectrum
    np.testing.assert_allclose(stated / (2 * np.pi), truth.natural_frequencies, rtol=1e-3)


def test_a_stiffness_at_the_limit_of_the_search_space_is_not_cut():
    # The noise puts the found frequencies, which limit the entries of L_H, below one of the true ones.
    truth = alike(ONE, 2, 1e-4)
    test = sysid.simulate(truth, FREQ, noise=1e-4, rng=1)
    result = sysid.identify(sysid.Problem(test, mass=sysid.LumpedMass(100.0)), strategy="modal", rng=0)
    assert result.residual < 1.2e-4
