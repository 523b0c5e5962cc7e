"""Records of a structure that changes are told to be so, with the frequencies that it has; right records never are."""

import dataclasses
import re

import numpy as np
import pytest
import scipy.linalg

import sysid
from benchmarks.mistakes.changing import DAMPERS, MASSES, RATE, SECONDS, SPRINGS, frequencies, motion, noisy
from benchmarks.mistakes.changing import measured as as_test
from benchmarks.mistakes.changing import response as answer
from sysid.assessment.changing import changes_in_words
from sysid.assessment.model_error import BEYOND, misses_of
from sysid.measurement.in_time import in_time, peaks, quiet_levels
from sysid.modal_analysis.stretches import stretches_of


def identified(test, **options):
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass(), **options), rng=0)


@pytest.fixture(scope="module")
def right():
    rng = np.random.default_rng(0)
    base = motion(rng)
    return as_test(noisy(rng, base, answer(base)))


def numbers(text, unit="Hz"):
    return [float(number) for number in re.findall(rf"([\d.]+) {unit}", text)]


def test_right_records_are_missed_by_their_noise_and_nothing_is_said_to_change(right):
    it = identified(right)
    (miss,) = misses_of(it.problem, it.structure, it.x)
    assert it.success and 0.9 < miss.times < 1.1
    assert changes_in_words(it.problem) == ()


def test_poles_of_stretches_are_those_of_the_structure_within_a_small_part_of_their_width(right):
    true = frequencies(SPRINGS)
    found = stretches_of(right, 2 * np.pi * true * 1.002, np.array([0.01, 0.02]))
    assert len(found) == 12 and found[-1].end == pytest.approx(SECONDS, abs=0.5)
    chain = np.array([[1, 1], [0, -1]])  # forces of springs on the floors, signs aside
    stiffness, damping = (chain @ np.diag(part) @ chain.T for part in (SPRINGS, DAMPERS))
    _, phi = scipy.linalg.eigh(stiffness, np.diag(MASSES))
    widths = np.einsum("ik,ij,jk->k", phi, damping, phi) / (2 * np.pi)  # 2 zeta f
    assert np.abs(([one.frequency for one in found] - true) / widths).max() < 0.03
    assert all(one.left <= one.left_by_all for one in found)


@pytest.mark.parametrize("estimator", ["records", "spectra"])
def test_a_structure_that_softens_is_told_with_its_frequencies_at_the_ends(estimator):
    rng, small, large = np.random.default_rng(1), 0.3, 2.0
    bases = [size * motion(rng) for size in (small, large)]
    fitted, unseen = (as_test(noisy(rng, base, answer(base, softening=100.0)), estimator=estimator) for base in bases)
    it = identified(fitted, validation=[unseen])
    (told,) = [sentence for sentence in it.undetermined if "falls as the motion grows" in sentence]
    low, high = sorted(float(f) for f in re.findall(r"([\d.]+) Hz (?:where|at)", told))
    assert high == pytest.approx(frequencies(SPRINGS)[0], rel=0.003) and low < 0.995 * high
    assert "never fitted" not in told and "unfitted test 1" not in told
    assert any("moves the sensors by up to" in sentence for sentence in it.remarks)
    assert not any("gain" in sentence or "quadrature" in sentence for sentence in it.undetermined)


def test_runs_of_different_structures_are_told_with_the_frequencies_of_each():
    rng, factor = np.random.default_rng(2), 0.93
    first, second = motion(rng), motion(rng)
    test = as_test(noisy(rng, first, answer(first)), noisy(rng, second, answer(second, lambda t: factor)))
    it = identified(test)
    assert it.judgement == "no fit" and not it.success
    told = it.confidence[0] + it.confidence[1]
    assert "times their noise" in told and "differs from record to record" in told
    (near,) = [k for k, f in enumerate(frequencies(SPRINGS)) if abs(numbers(told.partition("(")[2])[-2] / f - 1) < 0.02]
    both = frequencies(SPRINGS)[near] * np.array([1, np.sqrt(factor)])
    np.testing.assert_allclose(numbers(told)[-2:], both, rtol=0.003)
    assert "Hz in run 1 at" in told and "Hz in run 2 at" in told


def test_a_drift_along_a_record_is_told_with_when_and_what():
    rng = np.random.default_rng(3)
    base, factor = motion(rng), lambda t: 1 - 0.06 * t / SECONDS
    it = identified(as_test(noisy(rng, base, answer(base, factor))))
    (told,) = [sentence for sentence in it.undetermined if "changes along the records" in sentence]
    spans = [(float(a) + float(b)) / 2 for a, b in re.findall(r"at ([\d.]+) to ([\d.]+) s", told)]
    expected = [frequencies(factor(t) * SPRINGS) for t in spans]
    for value, of_modes in zip(numbers(told)[-2:], expected, strict=True):
        assert np.min(np.abs(value / of_modes - 1)) < 0.003
    assert it.confidence[0] == told or "times their noise" in it.confidence[0]


def test_what_is_missed_of_stated_noise_is_the_residual_over_it():
    M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
    truth = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1)
    test = sysid.simulate(truth, np.linspace(1, 12, 300), noise=0.02, force=True, rng=0)
    wrong = np.diag([1.0, 1.0, 0.0])
    it = sysid.identify(sysid.Problem(test, mass=wrong), rng=0)
    accelerations, force = misses_of(it.problem, it.structure, it.x)
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
    assert enough.success and any("times their noise" in sentence for sentence in enough.undetermined)


def test_spikes_are_not_counted_as_what_the_model_misses():
    M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
    truth = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1)
    test = sysid.simulate(truth, np.linspace(1, 12, 300), noise=0.01, rng=0)
    spoiled = test.response.copy()
    spoiled[0, 1, [60, 200]] += 40 * np.abs(spoiled[0, 1]).mean()
    problem = sysid.Problem(dataclasses.replace(test, response=spoiled), mass=sysid.FullMass())
    (miss,) = misses_of(problem, truth, problem.values(truth))
    assert problem.measurement.residual(truth) > 0.1 and 0.9 < miss.times < 1.1


def test_records_in_time_are_those_that_were_given(right):
    rng = np.random.default_rng(4)
    base = motion(rng, seconds=20)
    base, response = noisy(rng, base, answer(base))
    test = sysid.Measurement.from_time(
        [(base, response, None)], RATE, rigid_body=np.ones((2, 1)), band=(0.0, RATE), estimator="records"
    )
    (run,) = in_time(test)
    np.testing.assert_allclose(run.response, response - response.mean(axis=1, keepdims=True), atol=1e-10)
    assert peaks(test)[0] == pytest.approx(np.abs(run.response - run.base).max())
    assert in_time(sysid.simulate(identified(right).structure, [1.0, 2.0, 3.0])) == []


def test_quiet_parts_tell_the_noise_of_a_record_that_was_at_rest_for_a_while():
    rng = np.random.default_rng(5)
    base = motion(rng)
    base[: base.size // 4] = 0.0
    records = noisy(rng, base, answer(base), share=0.1)
    levels = quiet_levels(as_test(records))
    np.testing.assert_allclose(levels.response, 0.1 * base.std(), rtol=0.25)
    np.testing.assert_allclose(levels.base, 0.1 * base.std(), rtol=0.25)
