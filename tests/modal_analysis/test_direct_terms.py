"""Terms without poles of a test are the rigid-body motion and mass of the structure, whatever rigid_body says."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.records.simulated import coupled
from benchmarks.records.trial import measurement
from sysid import Measurement, simulate
from sysid.modal_analysis.direct_terms import _fitted, direct_terms
from sysid.modal_analysis.residues import Records


def lied(test):
    """The same with nonsense for G, which is not read."""
    return replace(test, rigid_body=np.roll(test.rigid_body, 1, axis=0) * -0.7, base_axes=test.base_axes)


@pytest.mark.parametrize("seed", range(4))
def test_without_noise_they_are_the_matrices_of_the_structure(seed):
    truth = random_structure(seed, n=3 + seed, d=1 + seed % 3)
    terms = direct_terms(lied(simulate(truth, frequency_lines(truth), force=True)))
    # Poles are relocated a few times, and then left as they are.
    np.testing.assert_allclose(terms.rigid, truth.rigid_body, atol=1e-6)
    size = np.sqrt(np.diag(truth.rigid_body_mass))
    np.testing.assert_allclose(
        terms.mass / np.outer(size, size), truth.rigid_body_mass / np.outer(size, size), atol=1e-6
    )
    np.testing.assert_allclose(2 * np.pi * truth.natural_frequencies[-1] * terms.slope, 0.0, atol=1e-5)
    assert not terms.below


def test_a_line_at_0_hz_which_no_mode_below_the_others_answers_changes_nothing():
    truth = random_structure(0, n=3, d=1)
    lines = np.concatenate([[0.0], frequency_lines(truth)])
    terms = direct_terms(simulate(truth, lines, force=True))
    np.testing.assert_allclose(terms.rigid, truth.rigid_body, atol=1e-6)
    assert not terms.below
    with_mode_below = lines[(lines == 0) | (lines > 1.5 * truth.natural_frequencies[0])]
    assert direct_terms(simulate(truth, with_mode_below, noise=1e-4, rng=0)).below


def test_errors_are_of_the_size_of_their_deviations():
    truth = random_structure(1, n=5, d=2)
    off = []
    for seed in range(40):
        terms = direct_terms(simulate(truth, frequency_lines(truth), noise=0.01, force=True, rng=seed))
        off.append(((terms.rigid - truth.rigid_body) / terms.rigid_std).ravel())
        off.append(((terms.mass - truth.rigid_body_mass) / terms.mass_std).ravel())
        off.append((terms.slope / terms.slope_std).ravel())
    assert 0.8 < np.sqrt(np.mean(np.concatenate(off) ** 2)) < 1.5


@pytest.mark.parametrize("seed", range(2))
def test_deviations_are_those_of_least_squares_in_the_base_directions_themselves(seed):
    """Correlated, of unequal spectra: the inputs that are fitted are combinations of both."""
    rng = np.random.default_rng(seed)
    freq = np.linspace(1.0, 20.0, 200)
    base = rng.standard_normal((3, 2, freq.size)) + 1j * rng.standard_normal((3, 2, freq.size))
    base[:, 1] = np.where(freq < 8, 1.0, 0.2) * (0.9 * base[:, 0] + 0.4 * base[:, 1])
    omega, ratios = 2 * np.pi * np.array([3.0, 7.0, 12.0]), np.array([0.01, 0.015, 0.02])
    noise = rng.standard_normal((3, 4, freq.size)) + 1j * rng.standard_normal((3, 4, freq.size))
    records = Records(Measurement(freq, base, noise, rigid_body=np.zeros((4, 2))))
    found = _fitted(records, omega, ratios)
    w = 2 * np.pi * freq
    g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)[:, None] * w)
    functions = [np.ones_like(w), 1j * w, w**2, *g, *(1j * w * g)]
    X = np.array([(f * base[:, i]).ravel() for f in functions for i in range(2)]).T
    X, y = np.vstack([X.real, X.imag]), noise.swapaxes(0, 1).reshape(4, -1)
    y = np.hstack([y.real, y.imag]).T
    size = np.linalg.norm(X, axis=0)
    left = y - X / size @ np.linalg.lstsq(X / size, y)[0]
    own = np.sqrt(np.diag(np.linalg.inv((X / size).T @ (X / size)))) / size
    level = np.linalg.norm(left, axis=0) / np.sqrt(len(X) - X.shape[1])
    expected = (own[:4, None] * level).reshape(2, 2, 4).swapaxes(1, 2)
    np.testing.assert_allclose(found.std, expected, rtol=1e-6)


@pytest.mark.parametrize("seed", [0, 2])
def test_whole_records_tell_them_beside_their_transients(seed):
    setting, rng = coupled(seed), np.random.default_rng(seed)
    records, _ = setting.with_noise(setting.run(rng).records(), rng)
    terms = direct_terms(measurement([records], setting, force=True))
    assert np.all(np.abs(terms.rigid - setting.structure.rigid_body) < 6 * terms.rigid_std)
    assert np.median(terms.rigid_std) < 0.1


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_modes_below_the_lines_are_seen(noise):
    truth = random_structure(2, n=5, d=2)
    f = truth.natural_frequencies
    test = simulate(truth, np.geomspace(np.sqrt(f[1] * f[2]), 1.3 * f[-1], 300), noise=noise, rng=0)
    assert direct_terms(test).below


def test_lines_that_hold_spikes_are_left_out():
    truth = random_structure(1, n=5, d=2)
    test = simulate(truth, frequency_lines(truth), noise=0.01, rng=0)
    rng = np.random.default_rng(0)
    hit = rng.random(test.response.shape) < 0.005
    terms = direct_terms(replace(test, response=test.response + 60 * hit * test.response_std))
    assert np.all(np.abs(terms.rigid - truth.rigid_body) < 5 * terms.rigid_std)
    assert np.max(terms.rigid_std) < 2 * np.max(direct_terms(test).rigid_std)
