"""Records of a file are fitted in the band that the base excites, where none is stated."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import sysid
from sysid.cli import main as cli
from sysid.files.recorded_test import RecordedTest
from sysid.modal_analysis.fit import fit_modes

RATE, N = 50.0, 4000
TRUTH = sysid.Structure(
    np.diag([3.0, 2.0, 0.0]), [[8e3, -3e3, -5e3], [-3e3, 3e3, 0], [-5e3, 0, 5e3]], [0.02, 0.02], n_base=1
)
SENSORS = tuple(sysid.Sensor(name, (0.0, 0.0, float(i)), "x") for i, name in enumerate(("low", "high")))


def recorded(low, high, slow=0.0, noise=1e-3):
    """Base motion from `low` to `high` Hz, with the structure's answer, noise and slow drift of every sensor."""
    rng = np.random.default_rng(0)
    freq = np.fft.rfftfreq(N, 1 / RATE)
    base = np.fft.irfft(np.fft.rfft(rng.standard_normal(N)) * ((freq >= low) & (freq <= high)))[None]
    channels = np.vstack([base, TRUTH.simulate(base, RATE), TRUTH.simulate_force(base, RATE)])
    size = channels.std(axis=1, keepdims=True)
    walk = np.cumsum(rng.standard_normal(channels.shape), axis=1)
    walk -= walk.mean(axis=1, keepdims=True)
    channels = channels + size * (slow * walk / walk.std(axis=1, keepdims=True) + noise * rng.standard_normal((4, N)))
    run = channels[:1], channels[1:3], channels[3:]
    return RecordedTest((run,), SENSORS, ("x",), (0.0, 0.0, 0.0), RATE, None, ())


def test_the_default_lines_are_those_that_the_base_excites_and_a_stated_band_is_obeyed():
    test = recorded(1.0, 12.0)
    low, high = test.excited_band
    assert 0.5 < low <= 1 and 12 <= high < 16
    assert test.measurement().freq[[0, -1]] == pytest.approx([low, high])
    assert test.measurement(band=(0.3, 19.0)).freq[[0, -1]] == pytest.approx([0.3, 19.0])
    plain = sysid.Measurement.from_time(test.runs, RATE, sensors=SENSORS, base_axes="x", estimator="h1")
    np.testing.assert_array_equal(test.measurement(estimator="h1").freq, plain.freq)


def test_white_motion_is_fitted_in_all_the_lines_from_four_periods_a_record_on():
    test = recorded(0.0, RATE)
    plain = sysid.Measurement.from_time(test.runs, RATE, sensors=SENSORS, base_axes="x")
    np.testing.assert_array_equal(test.measurement().freq, plain.freq[3:])  # those below hold drift
    np.testing.assert_array_equal(test.measurement().response, plain.response[..., 3:])


def test_drift_below_the_band_is_no_mode():
    test = recorded(1.0, 12.0, slow=0.05)
    result = sysid.identify(sysid.Problem(test.measurement()), rng=0)
    assert result.judgement == "determined", result.summary()
    np.testing.assert_allclose(result.structure.natural_frequencies, TRUTH.natural_frequencies, rtol=1e-3)
    np.testing.assert_allclose(result.structure.mass[:2, :2], np.diag([3.0, 2.0]), atol=0.05)


def test_read_and_run_tell_it_and_refuse_more_modes_than_stand_out_in_it(tmp_path, monkeypatch, capsys, no_pictures):
    monkeypatch.chdir(tmp_path)
    test = recorded(1.0, 12.0)
    (tmp_path / "test.h5").write_bytes(test.to_bytes())

    def told(*words):
        assert cli.main([*words, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    band = pytest.approx(test.excited_band)
    assert told("show", "test.h5")["excited_band_hz"] == band
    found = told("run", "test.h5")
    assert found["excited_band_hz"] == found["result"]["band_hz"] == band
    assert cli.main(["run", "test.h5", "--modes", "3", "--fresh", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.findall(r"\d+", line) == ["2", "3"]
    found = told("run", "test.h5", "--band", "0.5-15", "--fresh")
    assert found["excited_band_hz"] == band and found["result"]["band_hz"] == pytest.approx([0.5, 15.0])
    spectra = test.measurement()
    run = spectra.base[0], spectra.response[0], None
    none = RecordedTest((run,), SENSORS, ("x",), (0.0, 0.0, 0.0), None, spectra.freq, ())
    (tmp_path / "spectra.h5").write_bytes(none.to_bytes())
    assert none.excited_band is None and "excited_band_hz" not in told("show", "spectra.h5")


def test_drift_of_up_to_two_periods_a_record_makes_no_mode_and_no_line():
    test = recorded(0.0, 20.0)
    time, rng = np.arange(N) / N, np.random.default_rng(1)
    drifted = [part + 0.02 * part.std() * np.sin(2 * np.pi * rng.uniform(0.5, 2) * time + rng.uniform(0, 6))
               for part in test.runs[0]]  # fmt: skip
    drifting = replace(test, runs=(tuple(drifted),))
    assert drifting.measurement().freq[0] == pytest.approx(4 * RATE / N)
    for one in (drifting.measurement(), drifting.measurement(band=(RATE / N, 20.0))):
        found = np.sort(fit_modes(one).omega) / (2 * np.pi)
        within = found[found < 20.0]
        assert within == pytest.approx(TRUTH.natural_frequencies, rel=1e-3)
