"""Terms without poles of a test are the rigid-body motion and mass of the structure, whatever rigid_body says."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.records.simulated import coupled
from benchmarks.records.trial import measurement
from sysid import Measurement, simulate
from sysid.modal_analysis.direct_terms import AtPoles, _fitted, direct_terms
from sysid.modal_analysis.residues import Records
from sysid.structure.thresholds import most_deviations


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
    assert 0.9 < np.sqrt(np.mean(np.concatenate(off) ** 2)) < 1.1


@pytest.mark.parametrize("seed", range(2))
def test_deviations_are_those_of_least_squares_in_poles_and_coefficients_together(seed):
    """The inverse of the normal matrix of all unknowns, poles by central differences; base directions correlated."""
    rng = np.random.default_rng(seed)
    freq = np.linspace(1.0, 20.0, 200)
    base = rng.standard_normal((3, 2, freq.size)) + 1j * rng.standard_normal((3, 2, freq.size))
    base[:, 1] = np.where(freq < 8, 1.0, 0.2) * (0.9 * base[:, 0] + 0.4 * base[:, 1])
    poles = np.log([2 * np.pi * np.array([3.0, 7.0, 12.0]), [0.01, 0.015, 0.02]]).ravel()
    w = 2 * np.pi * freq

    def design(poles):
        omega, ratios = np.exp(poles.reshape(2, 3))
        g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)[:, None] * w)
        functions = [np.ones_like(w), 1j * w / w[-1], (w / w[-1]) ** 2, *g, *(1j * w / omega[:, None] * g)]
        X = np.array([(f * base[:, i]).ravel() for f in functions for i in range(2)]).T
        return np.vstack([X.real, X.imag])

    X, channels = design(poles), 4
    residues = rng.standard_normal((X.shape[1], channels))
    noise = rng.standard_normal((len(X), channels)) * [0.1, 0.2, 0.3, 0.4]
    y = X @ residues + noise
    response = (y[: len(y) // 2] + 1j * y[len(y) // 2 :]).T.reshape(channels, 3, -1).swapaxes(0, 1)
    at = AtPoles(Records(Measurement(freq, base, response, rigid_body=np.zeros((channels, 2)))), poles)
    found = _fitted(at, at.errors[:, :-1])  # noise alone

    best = np.linalg.lstsq(X, y)[0]
    left = y - X @ best
    level = np.linalg.norm(left, axis=0) / np.sqrt(len(X) - X.shape[1])
    step = 1e-6
    slopes = np.array([(design(poles + s) - design(poles - s)) / (2 * step) @ best for s in step * np.eye(6)])
    size = X.shape[1]
    J = np.zeros((channels * len(X), channels * size + 6))
    for c in range(channels):
        rows = slice(c * len(X), (c + 1) * len(X))
        J[rows, c * size : (c + 1) * size], J[rows, -6:] = X / level[c], slopes[..., c].T / level[c]
    std = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:-6].reshape(channels, size)[:, :4].reshape(channels, 2, 2)
    np.testing.assert_allclose(found.std, std.swapaxes(0, 1) / np.array([1, w[-1]])[:, None, None], rtol=1e-5)


@pytest.mark.parametrize("seed", [0, 12, 39])
def test_poles_that_were_first_found_beside_their_places_leave_no_error(seed):
    """Tests of which the terms were off by up to 12 deviations with poles as relocation leaves them."""
    truth = random_structure(seed)
    terms = direct_terms(simulate(truth, frequency_lines(truth), noise=0.01, force=True, rng=seed))
    off = np.concatenate([(terms.rigid - truth.rigid_body) / terms.rigid_std, terms.slope / terms.slope_std])
    assert np.sqrt(np.mean(off**2)) < 1.5
    assert np.max(np.abs(off)) < most_deviations(off.size)


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
