"""Residuals of whole records are told where they are more than noise, by channel, band and factor."""

from __future__ import annotations

import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import Records, four_storeys
from sysid.measurement.whole import WholeRecords
from sysid.modal_analysis.record_fit import record_modes, refitted
from sysid.modal_analysis.residual_tests import gain_errors_of, most_unlikely, unidentifiable_levels
from sysid.structure.thresholds import FALSE_ALARM

SETTING = four_storeys()


def made(seed: int, duration: float = 20.0) -> Records:
    rng = np.random.default_rng(seed)
    records, _ = SETTING.with_noise(SETTING.run(rng, duration).records(), rng)
    return records


def fitted(records: Records) -> sysid.Identification:
    test = sysid.Measurement.from_time(
        [(records.base, records.response, None)], SETTING.sample_rate, rigid_body=np.ones((4, 1)), band=SETTING.lines
    )
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)


def test_one_in_a_thousand_white_draws_is_accused() -> None:
    """Of 6 channels of 400 lines: a Poisson variable of at most 1; 7 or more are as unlikely as 1e-4."""
    rng = np.random.default_rng(3)
    bands = 6 * sum(400 // (size // 2) - 1 for size in (8, 16, 32, 64, 128, 256)) + 6
    alarms = sum(any(most_unlikely(row, bands) for row in rng.exponential(size=(6, 400))) for _ in range(1000))
    assert FALSE_ALARM == 1e-3
    assert alarms < 7


def test_white_noise_is_not_told() -> None:
    for seed in range(2):
        assert not fitted(made(seed)).of_kind("noise left")


def test_a_band_of_one_sensor_with_three_times_the_noise_is_told() -> None:
    records = made(5)
    rng = np.random.default_rng(8)
    response = records.response.copy()
    freq = np.fft.rfftfreq(response.shape[1], 1 / SETTING.sample_rate)
    more = np.fft.rfft(rng.standard_normal(response.shape[1])) * ((freq > 4) & (freq < 6))
    # White noise of this sensor has 1 % of its rms; sqrt(8) times that beside it makes three times the level.
    response[1] += np.sqrt(8) * 0.01 * np.sqrt(np.mean(response[1] ** 2)) * np.fft.irfft(more, response.shape[1])
    result = fitted(Records(records.base, response, records.force, records.sample_rate))
    assert result.modal[0] is not None
    worst = result.modal[0].excess[0]
    assert (worst.channel, worst.run) == (1, 0)
    assert 3.8 < worst.low < worst.high < 6.3
    assert worst.factor == pytest.approx(3.0 / np.sqrt(1 + 8 * 2 / 19), rel=0.2)  # of its level over all 19 Hz
    told = result.of_kind("noise left")[0]
    assert (told.channel, told.run) == ("sensor 2", 1)
    assert told.numbers == {"times": worst.factor, "low": worst.low, "high": worst.high}
    assert told.sentence[:60] in result.summary().replace("\n  ", " ")


@pytest.mark.parametrize(("noise", "told"), [(0.01, True), (0.0, False)])
def test_levels_that_the_records_leave_open_are_told_only_where_there_is_noise(noise: float, told: bool) -> None:
    """One sensor, lines far below its one mode: there the noise of the sensor and of the base look alike."""
    rng, freq = np.random.default_rng(0), np.arange(20, 101) * 0.05
    w, wk, ratio = 2 * np.pi * freq, 2 * np.pi * 10.0, 0.05
    base, *error = rng.standard_normal((3, freq.size)) + 1j * rng.standard_normal((3, freq.size))
    response = (1 + 1.2 * w**2 / (wk**2 - w**2 + 2j * ratio * wk * w)) * base
    test = sysid.Measurement(
        freq, (base + noise * error[0])[None, None], (response + noise * error[1])[None, None],
        rigid_body=np.ones((1, 1)), whole=WholeRecords((1000,), 50.0, (True,)),
    )  # fmt: skip
    fit = record_modes(test, np.array([wk]), np.array([ratio]))
    assert bool(unidentifiable_levels(refitted(fit, fit.parameters))) == told


@pytest.mark.parametrize(("gain", "modes"), [(1.0, 3), (1.02, 4)])
def test_a_model_that_misses_a_mode_names_no_gain_and_a_wrong_gain_is_no_missing_mode(gain: float, modes: int) -> None:
    """Four modes, of which three or all are fitted; what the fourth leaves made gains 4 deviations wrong."""
    records, structure = made(0, 30.0), SETTING.structure
    response = records.response * np.array([1, gain, 1, 1])[:, None]
    test = sysid.Measurement.from_time(
        [(records.base, response, records.force)], SETTING.sample_rate, rigid_body=np.ones((4, 1)), band=SETTING.lines
    )
    fit = record_modes(test, 2 * np.pi * structure.natural_frequencies[:modes], structure.damping_ratios[:modes])
    found = gain_errors_of(refitted(fit, fit.parameters))
    off = np.abs(found.error / found.std)
    assert np.all(np.delete(off, 1) < 2)
    assert off[1] > 10 if gain != 1 else off[1] < 2
    assert gain == 1 or found.error[1] == pytest.approx(gain - 1, abs=3 * found.std[1])
