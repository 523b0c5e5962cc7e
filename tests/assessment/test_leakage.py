"""Lines too coarse for the modes, and modes that leakage doubles, are told; exact spectra are not accused."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import four_storeys
from sysid import Measurement, Structure, simulate
from sysid.assessment.checks.against_records import leakage

SETTING = four_storeys()
TRUTH = SETTING.structure
RATE = SETTING.sample_rate
WIDTH = 2 * TRUTH.damping_ratios[0] * TRUTH.natural_frequencies[0]


def records(seed):
    rng = np.random.default_rng(seed)
    made, _ = SETTING.with_noise(SETTING.run(rng).records(), rng)
    return [(made.base, made.response, None)]


def h1(segment, seed=0):
    return Measurement.from_time(
        records(seed), RATE, rigid_body=np.ones((4, 1)), estimator="h1", segment=segment, band=(1.0, 20.0)
    )


def frf(test):
    return Measurement.from_frf(test.freq, test.response[0], rigid_body=test.rigid_body)


def test_an_average_over_short_segments_is_told_its_lines_and_the_width_of_its_narrowest_mode():
    result = sysid.identify(sysid.Problem(h1(4000), mass=sysid.FullMass()), rng=0)
    (told,) = result.of_kind("coarse lines")
    expected = {"mode": 1, "spacing": RATE / 4000, "width": WIDTH, "seconds": 8 / WIDTH}
    assert told.numbers == pytest.approx(expected, rel=0.1)
    assert not result.of_kind("one motion")


def test_nothing_is_told_of_lines_that_are_fine_enough_or_of_whole_records():
    fine = replace(simulate(TRUTH, np.arange(1.0, 20.0, WIDTH / 8.1)), averaged=True)
    assert list(leakage(fine, TRUTH)) == []
    coarse = replace(simulate(TRUTH, np.arange(1.0, 20.0, WIDTH / 7.9)), averaged=True)
    assert len(list(leakage(coarse, TRUTH))) == 1
    assert list(leakage(replace(coarse, averaged=False, base=2 * coarse.base), TRUTH)) == []  # no unit runs


@pytest.mark.parametrize("noise", ["none", "white", "in proportion"])
def test_exact_response_functions_on_coarse_lines_have_no_leakage(noise):
    rng = np.random.default_rng(1)
    test = simulate(TRUTH, np.arange(1.0, 20.0, 2 * WIDTH), noise=0.02 if noise == "white" else 0.0, rng=rng)
    if noise == "in proportion":
        error = rng.standard_normal((2, *test.response.shape))
        test = replace(test, response=test.response * (1 + 0.02 * (error[0] + 1j * error[1])))
    assert list(leakage(test, TRUTH)) == []


@pytest.mark.parametrize("seed", range(5))
def test_noise_as_large_at_all_lines_is_no_flattened_peak_of_a_mode_that_hardly_moves_the_sensors(seed):
    stretch = np.array([[1.0, 0, -1], [-1, 1, 0]])  # of a frame and of water sloshing in its tank, which no sensor sees
    K = stretch.T @ np.diag([9e4, 900.0]) @ stretch
    C = (stretch.T @ np.diag([100.0, 7.0]) @ stretch)[:2, :2]
    truth = Structure(np.diag([80.0, 36.0, 0.0]), K, damping_matrix=C, n_base=1, recovery=np.eye(2)[:1])
    test = simulate(truth, np.arange(0.4, 12.0, 0.012), noise=0.01, rng=seed)
    assert list(leakage(test, truth)) == []


def test_an_analysers_averages_are_told_where_the_fit_misses_their_peak():
    test = frf(h1(4000))
    assert not test.averaged
    (told,) = leakage(test, TRUTH)
    assert told.kind == "coarse lines" and told.numbers["mode"] == 1


def test_a_frequency_found_twice_within_two_lines_is_leakage():
    test = h1(2000, seed=1)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    f = result.structure.natural_frequencies
    assert np.diff(f).min() < 2 * RATE / 2000  # the first mode of four
    (told,) = result.of_kind("one mode twice")
    assert told.numbers["frequency"] == pytest.approx(f[0])


def test_two_modes_as_close_with_other_shapes_are_two():
    f = TRUTH.natural_frequencies.copy()
    M, n = TRUTH.mass, TRUTH.n
    phi = TRUTH.mode_shapes
    f[1] = f[0] + WIDTH / 2
    half = M[:n, :n] @ phi
    K = half @ np.diag((2 * np.pi * f) ** 2) @ half.T
    G = TRUTH.rigid_body
    close = Structure(M, np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]]), TRUTH.damping_ratios, n_base=1)
    test = replace(simulate(close, np.arange(1.0, 20.0, WIDTH)), averaged=True)
    assert not any(one.kind == "one mode twice" for one in leakage(test, close))


def test_averages_stay_averages_in_files():
    test = h1(4000)
    assert Measurement.from_tree(test.to_tree()).averaged
    assert not Measurement.from_tree(frf(test).to_tree()).averaged
