"""The noise level of records that state none: no more than what a fit leaves of the quietest lines."""

import dataclasses

import numpy as np

import sysid
from sysid.report.opening import noise_of_test, share_of_noise

FREQ = np.linspace(1.0, 40.0, 2000)


def recorded(truth, rng, std):
    """Spectra of one run with noise of `std` on each sensor, and none stated."""
    base = rng.standard_normal((1, 2, FREQ.size)) + 1j * rng.standard_normal((1, 2, FREQ.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(FREQ), base)
    noise = rng.standard_normal(response.shape) + 1j * rng.standard_normal(response.shape)
    return sysid.Measurement(FREQ, base, response + std / np.sqrt(2) * noise, rigid_body=truth.rigid_body)


def test_it_is_the_noise_where_a_model_misses_some_lines_only(random_structure):
    rng = np.random.default_rng(2)
    truth = random_structure(rng, 3, 2)
    test = recorded(truth, rng, 0.03)
    bent = np.where(FREQ < 15.0, 1.3, 1.0) * test.response  # what no model explains
    for records in (test, dataclasses.replace(test, response=bent)):
        level = noise_of_test(records, truth)
        assert level.at_most and level.force is None and level.response.shape == (1, 3, 1)
        np.testing.assert_allclose(level.response, 0.03, rtol=0.15)


def test_levels_that_are_stated_are_taken_and_transmissibilities_have_no_bound(random_structure):
    truth = random_structure(np.random.default_rng(2), 3, 2)
    stated = sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)
    level = noise_of_test(stated, truth)
    assert not level.at_most and level.response is stated.response_std and level.force is stated.force_std
    without = dataclasses.replace(stated, response_std=None, force_std=None)
    assert noise_of_test(without, truth)[:2] == (None, None)


def test_its_share_is_measured_as_the_residual():
    records = np.zeros((2, 2, 5), complex)
    records[:, 0] = 3 + 4j
    np.testing.assert_allclose(share_of_noise(np.full((2, 2, 1), 0.5), records), [0.1, np.nan])
    assert np.isnan(share_of_noise(None, records)).all()
