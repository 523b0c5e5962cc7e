"""Frequencies that change along, between or with the level of records are told; those of linear structures are not."""

import re

import numpy as np
import pytest
import scipy.linalg

import sysid
from benchmarks.mistakes.changing import (
    DAMPERS,
    MASSES,
    RATE,
    SECONDS,
    SPRINGS,
    frequencies,
    motion,
    noisy,
    of_lines,
    tuned_mass,
)
from benchmarks.mistakes.changing import measured as as_test
from benchmarks.mistakes.changing import response as answer
from sysid.assessment.checks.model_error import Change, Seen, changes, changing
from sysid.modal_analysis.stretches import stretches_of


def identified(test, **options):
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass(), **options), rng=0)


def numbers(text, unit="Hz"):
    return [float(number) for number in re.findall(rf"([\d.]+) {unit}", text)]


def test_poles_of_stretches_are_those_of_the_structure_within_their_deviations():
    rng = np.random.default_rng(0)
    base = motion(rng)
    right = as_test(noisy(rng, base, answer(base)))
    true = frequencies(SPRINGS)
    found = stretches_of(right, 2 * np.pi * true * 1.002, np.array([0.01, 0.02]))
    assert len(found) == 12 and found[-1].end == pytest.approx(SECONDS, abs=0.5)
    chain = np.array([[1, 1], [0, -1]])  # forces of springs on the floors, signs aside
    stiffness, damping = (chain @ np.diag(part) @ chain.T for part in (SPRINGS, DAMPERS))
    _, phi = scipy.linalg.eigh(stiffness, np.diag(MASSES))
    widths = np.einsum("ik,ij,jk->k", phi, damping, phi) / (2 * np.pi)  # 2 zeta f
    errors = np.array([one.frequency for one in found]) - true
    assert np.abs(errors / widths).max() < 0.03
    assert 0.6 < np.sqrt(np.mean((errors / [one.std for one in found]) ** 2)) < 1.5
    assert all(one.left <= one.left_by_all for one in found)


@pytest.fixture(scope="module")
def softened():
    """Records of a structure that softens: two of small motion, one of large motion."""
    rng = np.random.default_rng(1)
    bases = [size * motion(rng, 40.0) for size in (0.3, 0.3, 2.0)]
    return [noisy(rng, base, answer(base, softening=100.0)) for base in bases]


@pytest.mark.parametrize("estimator", ["records", "spectra"])
def test_a_structure_that_softens_is_told_with_its_frequencies_at_the_ends(softened, estimator):
    fitted, unseen = (as_test(softened[i], estimator=estimator) for i in (0, 2))
    it = identified(fitted, validation=[unseen])
    (told,) = it.of_kind("changing")
    low, high = told.numbers["lowest"], told.numbers["highest"]
    assert told.numbers["trend"] < 0
    assert high == pytest.approx(frequencies(SPRINGS)[0], rel=0.003) and low < 0.995 * high
    assert [one.numbers["test"] for one in it.of_kind("level")] == [1]
    assert not it.of_kind("gain", "damping")


def test_runs_of_different_structures_are_told_with_the_frequencies_of_each():
    rng, factor = np.random.default_rng(2), 0.93
    first, second = motion(rng, 25.0), motion(rng, 25.0)
    runs = noisy(rng, first, answer(first)), noisy(rng, second, answer(second, lambda t: factor))
    test = as_test(*runs, estimator="spectra")  # of whole records "runs" of benchmarks/mistakes/model_errors.py
    it = identified(test)
    assert it.judgement == "no fit" and not it.success
    assert it.findings[0].kind == "changing" and it.of_kind("beyond noise", severity="contradicts")
    told = it.findings[0].sentence
    (near,) = [k for k, f in enumerate(frequencies(SPRINGS)) if abs(numbers(told.partition("(")[2])[-2] / f - 1) < 0.02]
    both = frequencies(SPRINGS)[near] * np.array([1, np.sqrt(factor)])
    np.testing.assert_allclose(numbers(told)[-2:], both, rtol=0.003)
    assert re.findall(r"Hz in run (\d)", told) == ["1", "2"]


def test_a_drift_along_a_record_is_told_with_when_and_what():
    rng = np.random.default_rng(3)
    base, factor = motion(rng, 40.0), lambda t: 1 - 0.04 * t / 40.0
    it = identified(as_test(noisy(rng, base, answer(base, factor)), estimator="spectra"))
    told = it.of_kind("changing")[0].sentence
    spans = [(float(a) + float(b)) / 2 for a, b in re.findall(r"at ([\d.]+) to ([\d.]+) s", told)]
    expected = [frequencies(factor(t) * SPRINGS) for t in spans]
    for value, of_modes in zip(numbers(told)[-2:], expected, strict=True):
        assert np.min(np.abs(value / of_modes - 1)) < 0.003
    assert it.findings[0].kind == "changing"


def test_two_close_modes_of_one_shape_are_no_mode_that_changes():
    rng = np.random.default_rng(0)
    base = motion(rng)
    records = noisy(rng, base, of_lines(tuned_mass(0.002), base[None])[:2])
    test = as_test(records).in_band(0.5, 12.0)
    problem = sysid.Problem(test, mass=sysid.FullMass())
    assert problem.prepared.modal[0].omega.size == 3
    assert changes(problem.prepared) == []


def test_a_base_direction_that_does_not_move_in_an_unfitted_test_is_no_error():
    rng = np.random.default_rng(10)
    M, K = np.diag([2.0, 1.0, 0.0, 0.0]), np.zeros((4, 4))
    K[:2, :2], K[2, 2], K[3, 3], K[0, 2], K[2, 0], K[1, 3], K[3, 1] = np.diag(SPRINGS), *SPRINGS, *-SPRINGS.repeat(2)
    structure = sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=2)
    base = np.vstack([motion(rng, 40.0), motion(rng, 40.0)])
    made = {"rigid_body": structure.rigid_body, "base_axes": "xy", "band": (0.5, 20.0)}
    alone = base * [[1.0], [0.0]]
    spoil = lambda record: record + 0.02 * record.std() * rng.standard_normal(record.shape)  # noqa: E731
    fitted, unseen = (
        sysid.Measurement.from_time([(u, spoil(of_lines(structure, u)), None)], RATE, **made) for u in (base, alone)
    )
    assert changing(sysid.Problem(fitted, mass=sysid.FullMass(), validation=[unseen]).prepared) == ()


def test_unfitted_tests_keep_their_numbers(softened):
    """Of two, spectra without a known unit and whole records, the second alone is looked at."""
    fitted, other, large = map(as_test, softened)
    given = sysid.Measurement(other.freq, other.base, other.response, rigid_body=other.rigid_body)
    problem = sysid.Problem(fitted, mass=sysid.FullMass(), validation=[given, large])
    records = {one.record for change in changes(problem.prepared) for one in change.seen}
    assert records == {"the record", "the record of unfitted test 2"}


def _seen(frequencies, levels, std):
    return [
        Seen("the record", f"stretch {i}", f, std, level)
        for i, (f, level) in enumerate(zip(frequencies, levels, strict=True))
    ]


RISING, SHUFFLED = [5.00, 5.01, 5.02, 5.03, 5.04, 5.05], [5.02, 5.00, 5.05, 5.01, 5.04, 5.03]
BY_LEVEL = [30.0 - 500 * (f - 5.0) for f in SHUFFLED]  # the higher the level, the lower the frequency
CHANCE = [3.0, 3.1, 2.9, 3.05, 2.95, 3.02]


@pytest.mark.parametrize(
    ("frequencies", "levels", "std", "explained", "told"),
    [
        (SHUFFLED, CHANCE, 0.001, True, True),  # beyond noise, and poles that change explain the records
        (SHUFFLED, CHANCE, 0.001, False, False),  # beyond noise alone
        (SHUFFLED, CHANCE, 0.020, True, False),  # noise explains the differences
        (SHUFFLED, BY_LEVEL, 0.001, False, True),  # beyond noise, in the order of the level
        (SHUFFLED, BY_LEVEL, 0.020, False, False),
        ([5 + (f - 5) / 10 for f in SHUFFLED], BY_LEVEL, 0.0001, True, False),  # by a twentieth of the width
    ],
)
def test_a_change_is_told_by_two_signs_of_three(frequencies, levels, std, explained, told):
    """Of a mode with a half-power width of 0.1 Hz, in six stretches."""
    assert Change(5.0, 0.1, _seen(frequencies, levels, std), scaled=True).is_significant(explained) is told


def test_an_order_by_level_that_time_makes_as_well_is_no_trend():
    assert Change(5.0, 0.1, _seen(SHUFFLED, BY_LEVEL, 0.001), scaled=True).trend == pytest.approx(-1.0)
    falling = sorted(BY_LEVEL, reverse=True)
    assert Change(5.0, 0.1, _seen(RISING, falling, 0.001), scaled=True).trend == 0.0
    assert Change(5.0, 0.1, _seen(SHUFFLED[:4], BY_LEVEL[:4], 0.001), scaled=True).trend == 0.0  # too few to tell
