"""Stated delays are taken off exactly in the band: of sensors, base and force, with no sample that was not recorded."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import Run, four_storeys
from sysid.measurement.spectra import on_one_clock

RATE = 100.0
SETTING = replace(four_storeys(150.0), duration=60.0)
DELAYS = np.array([0.0, 0.00186, -0.0337, 0.4, -0.0021, 0.05])  # of four sensors, the base, the force


def late_records(delays, seed=0):
    """Motion cut anywhere: each channel in closed form at times earlier by its delay, s; of sensors, base, force."""
    run = SETTING.run(np.random.default_rng(seed))

    def earlier(delay):
        turned = run.motion.amplitudes * np.exp(-1j * run.motion.omega * delay)
        motion = replace(run.motion, amplitudes=turned)
        return Run(run.modes, motion, run.free * np.exp(-run.modes.poles * delay)).records()

    *sensors, base, force = (earlier(delay) for delay in delays)
    return base.base, np.stack([part.response[i] for i, part in enumerate(sensors)]), force.force


def stated(delays):
    """Sensors that state their delays, and those of base and force."""
    sensors = [sysid.Sensor(f"floor {i}", (0, 0, float(i)), "x", delay=delay) for i, delay in enumerate(delays[:-2])]
    return {"sensors": sensors, "base_delay": delays[-2], "force_delay": delays[-1]}


@pytest.mark.parametrize("frequency, error", [(1.0, 1e-9), (17.3, 1e-9), (40.0, 1e-8), (45.0, 0.04)])
def test_a_sine_is_earlier_by_its_delay(frequency, error):
    times, delays = np.arange(900) / RATE, np.array([0.0, 0.0031, -0.0049, 0.37, -1.2345, 0.005])
    records = np.sin(2 * np.pi * frequency * (times - delays[:, None]) + 0.3)
    found = on_one_clock(records, delays, RATE)
    assert np.ptp(found - found[0], axis=0).max() < error
    # The first is as it was recorded, at times that all have: 2.0 s less, and 32 samples at each end.
    kept = times.size - 37 - 123 - 64
    assert found.shape == (6, kept)
    start = int(np.argmin(np.abs(records[0][:400] - found[0, 0])))
    np.testing.assert_array_equal(found[0], records[0][start : start + kept])


def test_delays_of_whole_samples_cut_no_more_than_they_must():
    records = np.random.default_rng(0).standard_normal((3, 50))
    found = on_one_clock(records, np.array([0.0, 3 / RATE, -2 / RATE]), RATE)
    np.testing.assert_array_equal(found, [records[0, 2:47], records[1, 5:50], records[2, 0:45]])


def test_a_delay_of_the_whole_record_is_refused():
    with pytest.raises(sysid.InputError, match="seconds"):
        on_one_clock(np.zeros((2, 100)), np.array([0.0, 2.0]), RATE)


@pytest.mark.parametrize("estimator", ["records", "spectra", "h1"])
def test_records_whose_delays_are_stated_are_those_of_one_clock(estimator):
    rate, options = SETTING.sample_rate, {"estimator": estimator, "band": SETTING.lines}
    late = sysid.Measurement.from_time([late_records(DELAYS)], rate, **stated(DELAYS), **options)
    early, later = (np.rint(rate * np.array([DELAYS.min(), DELAYS.max()]))).astype(int)
    clean = [part[:, 32 - early : -32 - later] for part in late_records(0 * DELAYS)]
    right = sysid.Measurement.from_time([clean], rate, **stated(0 * DELAYS), **options)
    for name in ("base", "response", "force"):
        a, b = getattr(late, name), getattr(right, name)
        assert np.abs(a - b).max() < 1e-7 * np.abs(b).max(), name
    assert late.sensors == right.sensors


def test_stated_delays_give_the_modes_of_one_clock_and_no_late_channel():
    rng, rate = np.random.default_rng(3), SETTING.sample_rate
    noise = [0.01 * np.std(part) * rng.standard_normal(part.shape) for part in late_records(0 * DELAYS)]
    found = {}
    for name, delays, said in (
        ("late", DELAYS, 0 * DELAYS),
        ("stated", DELAYS, DELAYS),
        ("right", 0 * DELAYS, 0 * DELAYS),
    ):
        runs = [part + error for part, error in zip(late_records(delays), noise, strict=True)]
        test = sysid.Measurement.from_time([runs], rate, **stated(said), band=SETTING.lines)
        found[name] = sysid.identify(sysid.Problem(test), rng=0)
    kinds = {name: [one.kind for one in result.findings] for name, result in found.items()}
    assert "late sensor" in kinds["late"] and "late sensor" not in [*kinds["stated"], *kinds["right"]]
    stated_, right = (found[name].structure for name in ("stated", "right"))
    np.testing.assert_allclose(stated_.natural_frequencies, right.natural_frequencies, rtol=1e-3)
    f = SETTING.structure.natural_frequencies
    np.testing.assert_allclose(stated_.natural_frequencies, f, rtol=2e-3)


def test_spectra_are_turned_by_the_delay_of_a_sensor_once():
    freq, structure = np.linspace(1.3, 16.0, 90), SETTING.structure
    clean = sysid.simulate(structure, freq, force=True)
    late = clean.response * np.exp(-2j * np.pi * freq * DELAYS[:4, None])
    test = sysid.Measurement(freq, clean.base, late, force=clean.force, sensors=stated(DELAYS)["sensors"])
    np.testing.assert_allclose(test.response, clean.response, rtol=1e-12)
    again = replace(test, force=None)
    np.testing.assert_array_equal(again.response, test.response)
    assert not any(sensor.delay for sensor in again.sensors)
    frf = sysid.Measurement.from_frf(freq, late[0], sensors=stated(DELAYS)["sensors"])
    np.testing.assert_allclose(frf.response, clean.response, rtol=1e-12)


def test_a_delay_that_is_no_number_is_refused():
    with pytest.raises(sysid.InputError, match="delay"):
        sysid.Sensor("top", (0, 0, 1), "x", delay="late")
