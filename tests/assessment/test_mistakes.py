"""Mistakes in records are named, with what they amount to; right records are accused of nothing."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.mistakes.wrong_tests import CAUSES, SPECTRA, problem, right
from benchmarks.modal.random_structures import frequency_lines, random_structure
from sysid import FullMass, InputError, LumpedMass, Problem, SpectralStiffness, identify, simulate
from sysid.assessment.checks import stated
from sysid.assessment.checks.mistakes import check_records, mistakes_of
from sysid.modal_analysis.direct_terms import direct_terms
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.problem.prepared import clocks_of

BY_RECORDS = [
    name for name, cause in CAUSES.items()
    if SPECTRA in cause.kinds and not cause.untold and cause.finding != "late sensor"  # which is taken off before
]  # fmt: skip


def told(test):
    return mistakes_of(test, direct_terms(test))


def random_test(seed=3, noise=0.01):
    """Seven sensors in two directions, a full and coupled mass."""
    truth = random_structure(seed, n=7, d=2)
    return simulate(truth, frequency_lines(truth), noise=noise, force=True, rng=seed)


def with_sensor(test, factor, sensor=2):
    response = test.response.copy()
    response[:, sensor] = response[:, sensor] * factor
    return replace(test, response=response)


@pytest.mark.parametrize("name", BY_RECORDS)
def test_each_cause_is_named_and_nothing_else(name):
    cause = CAUSES[name]
    test = cause.made(right(SPECTRA, force=cause.force is True, axes=cause.axes)).test
    found = mistakes_of(test, direct_terms(test))
    assert [one.kind for one in found] == [cause.finding]


@pytest.mark.parametrize(
    ("change", "kind", "severity", "channel", "numbers"),
    [
        (lambda t: with_sensor(t, -1.0), "sign", "contradicts", "sensor 3", {"factor": -1.0}),
        (lambda t: with_sensor(t, 1000.0), "unit", "contradicts", "sensor 3", {"factor": 1000.0}),
        (lambda t: with_sensor(t, 0.7), "gain", "contradicts", "sensor 3", {"factor": 0.7}),
        (lambda t: replace(t, response=1000 * t.response), "unit", "blocking", None, {"factor": 1000.0}),
        (lambda t: replace(t, response=-t.response), "sign", "blocking", None, {"factor": -1.0}),
        (lambda t: replace(t, rigid_body=t.rigid_body * [1.0, -1.0]), "sign", "blocking", "base y", {}),
        (lambda t: replace(t, force=-t.force), "force sign", "blocking", None, {}),
    ],
)  # fmt: skip
def test_mistakes_of_two_directions(change, kind, severity, channel, numbers):
    first = told(change(replace(random_test(noise=0.002), base_axes=("x", "y"))))[0]
    assert (first.kind, first.severity, first.channel) == (kind, severity, channel)
    for name, value in numbers.items():
        assert first.numbers[name] == pytest.approx(value, rel=0.03)


@pytest.mark.parametrize(
    "test", [simulate(random_structure(1, n=3, d=1), np.linspace(0.5, 60, 400), rng=1), random_test()]
)
def test_a_channel_of_noise_alone_is_named_whatever_it_makes_of_the_misfit(test):
    rng, response = np.random.default_rng(5), test.response.copy()
    response[:, 1] = 1e-3 * np.std(response) * (rng.standard_normal((2, test.freq.size)).T @ [1.0, 1j])
    dead = replace(test, response=response)
    terms = direct_terms(dead)
    for misfit in (terms.misfit, 0.7):  # of records in time each channel counts alike
        assert [(one.kind, one.channel) for one in mistakes_of(dead, replace(terms, misfit=misfit))] == [
            ("dropout", test.sensor_names[1])
        ]


def test_swapped_sensors_of_two_directions_are_told_without_any_model():
    test = random_test()
    order = [6, *range(1, 6), 0]
    assert abs(test.rigid_body[0] @ test.rigid_body[6]) < 0.1  # along y and along x
    (swapped,) = told(replace(test, response=test.response[:, order]))
    assert swapped.kind == "swapped sensors" and swapped.numbers == {"sensor": 0, "other": 6}


def test_a_mistake_in_all_sensors_and_another_in_one_are_both_told():
    test = random_test(noise=0.002)
    found = told(with_sensor(replace(test, response=test.response / 9.80665), -1.0))
    assert [(one.kind, one.channel) for one in found] == [("unit", None), ("sign", "sensor 3")]
    assert found[0].numbers["factor"] == pytest.approx(1 / 9.80665, rel=0.03)


@pytest.mark.parametrize("seed", range(6))
def test_right_records_are_accused_of_nothing(seed):
    truth = random_structure(seed, n=3 + seed % 6, d=1 + seed % 3)
    f, noise = truth.natural_frequencies, (0.0, 0.003, 0.03)[seed % 3]
    assert not told(simulate(truth, frequency_lines(truth), noise=noise, force=True, rng=seed))
    above = np.geomspace(1.02 * f[0], 1.3 * f[-1], 300)  # a mode below the lines answers like a constant
    assert not told(simulate(truth, above, noise=noise, force=True, rng=seed))


def test_a_building_on_soft_springs_is_not_relative():
    k, n = np.array([2e4, 1e6, 1e6]), 3  # all of it hardly moves at the lines
    E = np.eye(n) - np.eye(n, k=-1)
    K, G = E.T @ np.diag(k) @ E, np.ones((n, 1))
    full = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    truth = sysid.Structure(np.diag([500.0, 400.0, 300.0, 0.0]), full, [0.02, 0.02, 0.02], n_base=1)
    f = truth.natural_frequencies
    assert not told(simulate(truth, np.geomspace(0.5 * f[1], 1.3 * f[2], 400), noise=0.01, force=True, rng=0))


def test_a_sign_is_the_first_sentence_and_refused_where_the_model_has_a_form():
    test = CAUSES["one sign"].made(right(SPECTRA, force=True)).test
    result = identify(problem("full", test), rng=0)
    first = result.findings[0]
    assert (first.kind, first.channel) == ("sign", "storey 2") and result.confidence[0] == str(first)
    assert result.judgement in ("doubtful", "no fit")
    with pytest.raises(InputError, match="the sign of storey 2 is reversed"):
        identify(problem("chain", test), rng=0)


@pytest.mark.parametrize(
    ("factor", "words"), [(1e-3, "1,000: the base force is in kN"), (1 / 9.80665, "9.81: the base force is in kgf")]
)
def test_a_force_in_another_unit_is_told_by_a_stated_total_alone(factor, words):
    test = random_test()
    wrong, totals = replace(test, force=factor * test.force), random_structure(3, n=7, d=2).rigid_body_mass.diagonal()
    with pytest.raises(InputError, match=words):
        identify(Problem(wrong, mass=FullMass(totals, healing="rigid_body")), rng=0)
    assert not identify(Problem(wrong, mass=FullMass()), rng=0).of_kind("force unit")


def test_a_heavy_fixture_is_no_unit():
    """Load cells below a table of nine times the mass of what stands on it."""
    data = right(SPECTRA, force=True)
    table = 8.80665 * 1940.0 * data.base
    heavy = replace(data, force=data.force + table).test
    with pytest.raises(InputError, match="9.81"):
        identify(problem("lumped", replace(heavy, force=9.80665 * data.test.force)), rng=0)
    assert not identify(problem("lumped", heavy), rng=0).of_kind("force unit", "unit")


@pytest.mark.parametrize(("factor", "words"), [(2 * np.pi, "stated natural"), (1 / (2 * np.pi), "lines")])
def test_stated_frequencies_and_lines_in_rad_per_s(factor, words):
    test = right(SPECTRA, force=False).test
    stated = SpectralStiffness(factor * np.array([2.688, 6.682, 10.054, 12.838]))
    with pytest.raises(InputError, match=f"{words}.* in rad/s, not Hz: .*2 pi"):
        identify(Problem(test, mass=LumpedMass(1940.0), stiffness=stated), rng=0)


@pytest.mark.parametrize(("form", "force"), [("chain", False), ("written", True)])
def test_right_units_show_in_the_first_structures_that_a_model_allows(monkeypatch, form, force):
    seen, structures = [], stated._structures
    monkeypatch.setattr(stated, "_structures", lambda of: (seen.append(one) or one for one in structures(of)))
    stated_problem = problem(form, right(SPECTRA, force=force).test)
    assert check_records(stated_problem.prepared, clocks_of(stated_problem), FitMonitor()) == ()
    assert 1 <= len(seen) <= 6


def test_sensors_that_are_swapped_in_a_written_model_are_told(no_other_answers):
    test = CAUSES["swapped"].made(right(SPECTRA, force=False)).test
    result = identify(problem("written", test), strategy=sysid.Continuation(1), rng=0)
    first = result.findings[0]
    assert first.kind == "swapped sensors" and (first.numbers["sensor"], first.numbers["other"]) == (1, 2)
    assert not result.determined
