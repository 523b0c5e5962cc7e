"""Misses of a model are told in units of the noise; quiet parts and lines of records bound that noise."""

import dataclasses

import numpy as np
import pytest

import sysid
from benchmarks.mistakes.changing import RATE, motion, noisy
from benchmarks.mistakes.changing import measured as as_test
from benchmarks.mistakes.changing import response as answer
from sysid.assessment.checks.context import BEYOND, misses_of, noise_at_most
from sysid.assessment.checks.model_error import changing
from sysid.measurement.in_time import as_whole, cut_in_motion, peaks, quiet_levels, runs_in_time

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


def identified(test, **options):
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass(), **options), rng=0)


@pytest.fixture(scope="module")
def right():
    rng = np.random.default_rng(0)
    base = motion(rng)
    return as_test(noisy(rng, base, answer(base)))


def test_right_records_are_missed_by_their_noise_and_nothing_is_said_to_change(right):
    it = identified(right)
    (miss,) = misses_of(it.problem.prepared, it.structure, it.x)
    assert it.success and 0.9 < miss.times < 1.1
    assert changing(it.problem.prepared) == ()


def test_what_is_missed_of_stated_noise_is_the_residual_over_it():
    M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
    truth = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1)
    test = sysid.simulate(truth, np.linspace(1, 12, 300), noise=0.02, force=True, rng=0)
    wrong = np.diag([1.0, 1.0, 0.0])
    it = sysid.identify(sysid.Problem(test, mass=wrong), rng=0)
    accelerations, force = misses_of(it.problem.prepared, it.structure, it.x)
    std = np.broadcast_to(test.response_std, test.response.shape)
    share = np.linalg.norm(std) / np.linalg.norm(test.relative)
    assert accelerations.times == pytest.approx(it.residual / share, rel=1e-12) and not accelerations.at_least
    assert force.times == pytest.approx(
        it.force_residual
        * np.linalg.norm(test.force)
        / np.linalg.norm(np.broadcast_to(test.force_std, test.force.shape))
    )
    assert max(accelerations.times, force.times) > BEYOND and not it.success and it.judgement == "no fit"
    enough = sysid.identify(sysid.Problem(test, mass=wrong, goal=1.01 * it.residual), rng=0)
    assert enough.success and [one.severity for one in enough.of_kind("beyond noise")] == ["caution"] * 2


def test_spikes_are_not_counted_as_what_the_model_misses():
    M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
    truth = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1)
    test = sysid.simulate(truth, np.linspace(1, 12, 300), noise=0.01, rng=0)
    spoiled = test.response.copy()
    spoiled[0, 1, [60, 200]] += 40 * np.abs(spoiled[0, 1]).mean()
    problem = sysid.Problem(dataclasses.replace(test, response=spoiled), mass=sysid.FullMass())
    (miss,) = misses_of(problem.prepared, truth, problem.values(truth))
    assert problem.measurement.residual(truth) > 0.1 and 0.9 < miss.times < 1.1


def test_records_in_time_are_those_that_were_given(right):
    rng = np.random.default_rng(4)
    base = motion(rng, seconds=20)
    base, response = noisy(rng, base, answer(base))
    test = sysid.Measurement.from_time(
        [(base, response, None)], RATE, rigid_body=np.ones((2, 1)), band=(0.0, RATE), estimator="records"
    )
    (run,) = runs_in_time(test)
    np.testing.assert_allclose(run.response, response - response.mean(axis=1, keepdims=True), atol=1e-10)
    assert peaks(test)[0] == pytest.approx(np.abs(run.response - run.base).max())
    assert runs_in_time(sysid.simulate(identified(right).structure, [1.0, 2.0, 3.0])) == []


def test_quiet_parts_tell_the_noise_of_a_record_that_was_at_rest_for_a_while():
    rng = np.random.default_rng(5)
    base = motion(rng, seconds=60)
    base[: base.size // 4] = 0.0
    records = noisy(rng, base, answer(base), share=0.1)
    levels = quiet_levels(as_test(records))
    np.testing.assert_allclose(levels.response, 0.1 * base.std(), rtol=0.25)
    np.testing.assert_allclose(levels.base, 0.1 * base.std(), rtol=0.25)


def test_hum_far_from_all_modes_is_no_error_of_a_model():
    """It is fitted and told, and the model misses no more than without it."""
    missed = []
    for size in (0.3, 0.0):
        rng = np.random.default_rng(6)
        base = motion(rng, seconds=30)
        records, floors = noisy(rng, base, answer(base))
        hum = size * np.sin(2 * np.pi * 16.667 * np.arange(base.size) / RATE)
        it = identified(as_test((records, floors + hum)))
        (miss,) = misses_of(it.problem.prepared, it.structure, it.x)
        tones = [one.numbers["value"] for one in it.findings if one.kind == "tone"]
        assert it.success and tones == [pytest.approx(16.667, abs=1e-3)] * (size > 0)
        missed.append(miss.times)
    assert missed[0] == pytest.approx(missed[1], rel=0.01)


def test_levels_are_told_where_their_unit_is_known_and_runs_may_differ_in_length():
    rng = np.random.default_rng(7)
    bases = [motion(rng, seconds=20), motion(rng, seconds=15)]
    both = [noisy(rng, base, answer(base)) for base in bases]
    spectra = as_test(*both, estimator="spectra")
    largest = peaks(as_test(*both))
    assert peaks(spectra) == pytest.approx(largest, rel=1e-12)
    given = sysid.Measurement(spectra.freq, spectra.base, spectra.response, rigid_body=spectra.rigid_body)
    assert peaks(given) == [] and runs_in_time(given) == []
    one = as_test(both[0], estimator="spectra")
    twice = sysid.Measurement(one.freq, 2 * one.base, 2 * one.response, rigid_body=one.rigid_body)
    assert peaks(twice) == [] and runs_in_time(twice)[0].base.shape[0] == 1


def test_plain_spectra_of_records_that_move_at_their_ends_are_told_to_be_such():
    rng = np.random.default_rng(8)
    base = motion(rng, seconds=60)
    test = as_test(noisy(rng, base, answer(base))).in_band(0.5, 12.0)
    cut = as_test(noisy(rng, base, answer(base)), estimator="spectra")
    rest = base * np.interp(np.arange(base.size) / RATE, [0, 10, 30, 40], [0, 1, 1, 0])
    whole = as_test(noisy(rng, rest, answer(rest)), estimator="spectra")
    assert cut_in_motion(cut) and not cut_in_motion(whole) and not cut_in_motion(test)


def test_noise_is_told_by_its_quiet_lines_whatever_stands_out_of_the_others():
    """White noise of 0.02 at 6400 lines, ten times as much in a fifth of them: within three of its deviations."""
    rng, lines = np.random.default_rng(0), 6400
    left = 0.02 * (rng.normal(size=(1, 3, lines)) + 1j * rng.normal(size=(1, 3, lines))) / np.sqrt(2)
    left[..., 2000:3280] *= 10.0
    freq = np.linspace(1.0, 50.0, lines)
    test = sysid.Measurement(freq, rng.normal(size=(1, 1, lines)), 5.0 + left, rigid_body=np.ones((3, 1)))
    # A quarter of 400 blocks: a quantile of the gamma law of 16, with a relative deviation of 1.7 % of its power, and
    # the louder fifth moves it up to where 31 % of the quiet ones lie, which is 4 % of the power.
    np.testing.assert_allclose(noise_at_most(test, left), 0.02, rtol=0.5 * (0.04 + 3 * 0.017))


def test_spectra_at_uneven_lines_are_no_records_however_close_two_of_them_are():
    """Stepped sines about a peak, two of them 1e-5 Hz apart, as multiples of which all lines are nearly any number."""
    truth = sysid.Structure(np.diag([2.0, 0.0]), 3200.0 * np.array([[1, -1], [-1, 1]]), [0.01], n_base=1)
    freq = np.unique([*np.geomspace(3.0, 12.0, 60), 6.3661977, 6.3662077])
    base = np.random.default_rng(0).normal(size=(2, 1, freq.size)) + 0j
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    test = sysid.Measurement(freq, base, response, rigid_body=truth.rigid_body)
    assert as_whole(test) is test
    assert runs_in_time(test) == []
