"""Modes outside the lines: their tails are part of the records, and modes beyond the band answer for them."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from sysid import FullMass, Problem, catalogue, identify, simulate
from sysid.modal_analysis.vector_fitting import find_poles


@pytest.fixture
def truth(random_structure):
    """Eight modes; the lines of `band` end between the sixth and the seventh."""
    return random_structure(np.random.default_rng(5), 8, 2)


@pytest.fixture
def band(truth):
    f = truth.natural_frequencies
    return np.linspace(0.5 * f[0], np.sqrt(f[5] * f[6]), 600)


def test_without_noise_all_modes_are_found_from_a_part_of_the_band(truth, band):
    poles = find_poles(simulate(truth, band))
    np.testing.assert_allclose(poles.omega, 2 * np.pi * truth.natural_frequencies, rtol=1e-6)


def test_modes_above_and_below_the_lines(truth):
    f = truth.natural_frequencies
    poles = find_poles(simulate(truth, np.linspace(np.sqrt(f[1] * f[2]), np.sqrt(f[6] * f[7]), 600)))
    np.testing.assert_allclose(poles.omega, 2 * np.pi * f, rtol=1e-5)


@pytest.mark.parametrize("noise", [0.001, 0.01])
def test_with_noise_the_modes_in_the_band_are_as_good_as_if_the_others_were_known(truth, band, noise):
    test = simulate(truth, band, noise=noise, force=True, rng=0)
    result = identify(Problem(test, mass=FullMass()))
    s, inside = result.structure, truth.natural_frequencies < band[-1]
    np.testing.assert_allclose(s.natural_frequencies, truth.natural_frequencies[inside], rtol=0.03 * noise)
    assert result.residual == pytest.approx(test.residual(truth), rel=0.03)
    # Six modes on six of eight sensors are determined; those above answer beside them.
    assert result.determined and s.residual.count and np.all(s.residual.natural_frequencies > band[-1])
    chosen = s.dof_sensors
    T = np.linalg.inv(truth.mode_shapes[np.ix_(chosen, inside)])
    size = np.sqrt(np.diag(T.T @ T))
    np.testing.assert_allclose(s.mass[:6, :6] / size / size[:, None], T.T @ T / size / size[:, None], atol=5 * noise)


def test_the_force_is_answered_too(truth, band):
    test = simulate(truth, band, force=True)
    result = identify(Problem(test, mass=FullMass()))
    np.testing.assert_allclose(result.structure.rigid_body_mass, truth.rigid_body_mass, rtol=1e-6)
    assert result.force_residual < 1e-8


def test_the_cantilever_in_band_is_found_within_its_deviations(identified):
    result = identified("cantilever_in_band")
    truth = runpy.run_path(str(catalogue.bundled_folder() / "cantilever_in_band.py"))["mast"]()
    s, u, freq = result.structure, result.uncertainty, result.measurement.freq
    assert result.determined and (s.n, s.n_sensors) == (4, 8)
    for name in ("natural_frequencies", "damping_ratios", "effective_masses"):
        off = (getattr(s, name) - getattr(truth, name)[:4]) / getattr(u, name)
        assert np.abs(off).max() < 4, name
    for found, right in ((s.transmissibility, truth.transmissibility), (s.base_force, truth.base_force)):
        assert np.linalg.norm(found(freq) - right(freq)) < 2e-3 * np.linalg.norm(right(freq))
