"""Damaged samples are told with the answer, and what is left out changes no judgement."""

import numpy as np
import pytest

import sysid
from sysid.files.recorded_test import RecordedTest
from sysid.finding import Severity

RATE, N = 50.0, 3000
KINDS = ("clipped", "dropout", "held value", "spikes", "tone", "equal channels")
TRUTH = sysid.Structure(
    np.diag([3.0, 2.0, 0.0]), [[8e3, -3e3, -5e3], [-3e3, 3e3, 0], [-5e3, 0, 5e3]], [0.02, 0.02], n_base=1
)


def records():
    """Base, two sensors and force in white motion, with 1 % noise."""
    rng = np.random.default_rng(0)
    base = rng.standard_normal((1, N))
    every = np.vstack([base, TRUTH.simulate(base, RATE), TRUTH.simulate_force(base, RATE)])
    return every + 0.01 * every.std(axis=1, keepdims=True) * rng.standard_normal(every.shape)


def identified(every):
    run = every[:1], every[1:3], every[3:]
    test = sysid.Measurement.from_time([run], RATE, rigid_body=TRUTH.rigid_body)
    result = sysid.identify(sysid.Problem(test), rng=0)
    return result, [one for one in result.findings if one.kind in KINDS]


def test_a_gap_is_left_out_and_told_as_a_note():
    every = records()
    every[2, 1500:1540] = 0.0
    result, (found,) = identified(every)
    assert result.judgement == "determined"
    assert (found.kind, found.severity, found.run, found.channel) == ("dropout", Severity.NOTE, 1, "sensor 2")
    expected = {"count": 40, "samples": N, "value": 0.0, "first": 30.0, "last": 1539 / RATE}
    assert found.numbers == pytest.approx(expected)
    assert result.modal[0].records.n_runs == 2
    np.testing.assert_allclose(result.structure.mass, TRUTH.mass, atol=0.02 * 5)


def test_hum_of_one_channel_is_fitted_and_told_as_a_note():
    every = records()
    every[1] += 0.2 * every[1].std() * np.sin(2 * np.pi * 6.3 * np.arange(N) / RATE)
    result, (found,) = identified(every)
    assert (found.kind, found.severity, found.channel) == ("tone", Severity.NOTE, "sensor 1")
    assert found.numbers["value"] == pytest.approx(6.3, abs=0.02 * RATE / N)
    size = np.sqrt(0.02 / 1.02)  # a sine of 0.2 beside an rms of one
    assert (found.numbers["channels"], found.numbers["size"]) == (1, pytest.approx(size, abs=0.01))
    assert result.judgement == "determined"
    np.testing.assert_allclose(result.structure.mass, TRUTH.mass, atol=0.02 * 5)


def test_equal_channels_are_a_caution():
    every = records()
    every[2] = every[1]
    _, (found,) = identified(every)
    assert (found.kind, found.severity, found.channel) == ("equal channels", Severity.CAUTION, "sensor 2")


def test_nothing_is_told_of_sound_records():
    assert identified(records())[1] == []


def test_a_test_that_was_read_tells_its_damage_without_refusing_it():
    every = records()
    np.clip(every[2], -every[2].std(), every[2].std(), out=every[2])
    sensors = tuple(sysid.Sensor(name, (0.0, 0.0, float(i)), "x") for i, name in enumerate(("low", "high")))
    run = every[:1], every[1:3], every[3:]
    test = RecordedTest((run,), sensors, ("x",), (0.0, 0.0, 0.0), RATE, None, ())
    assert [(one.kind, one.channel, one.left_out) for one in test.damage] == [("clipped", "high", False)]
