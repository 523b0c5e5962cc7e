"""Levels of noise that vary over the lines are found where the noise asks for it, and let intervals hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import approx_fprime

import sysid
from benchmarks.records.simulated import four_storeys
from sysid.modal_analysis.modal_model import Run, segments
from sysid.modal_analysis.noise_levels import KNOTS, ErrorSpectra, _likelihood, designs

SETTING = four_storeys()
RISE = 5.0


def coloured(record: np.ndarray, rng: np.random.Generator, level: np.ndarray) -> np.ndarray:
    """With noise of a standard deviation `level` (lines of rfft) where white noise has one for all."""
    noise = np.fft.irfft(np.fft.rfft(rng.standard_normal(record.shape)) * level, record.shape[1])
    return np.asarray(record + 0.01 * np.sqrt(np.mean(record**2, axis=1, keepdims=True)) * noise)


def test_pieces_hold_all_lines_in_order() -> None:
    for count in (3, 9, 40, 2000):
        w = np.linspace(1.0, 90.0, count)
        cut = segments(w)
        assert np.array_equal(np.concatenate([w[one] for one in cut]), w)
        assert count < 8 or min(w[one].size for one in cut) >= 4


def test_logarithms_are_linear_in_the_root_of_frequency_between_knots() -> None:
    middles = np.linspace(4.0, 100.0, 7)
    D = designs(middles, (4.0, 100.0), np.array([True, False]))
    x = np.concatenate([np.linspace(1.0, 3.0, KNOTS), [7.0]])  # one straight line in the root of frequency
    made = np.array([one @ x for one in D])
    np.testing.assert_allclose(made[:, 0], 1 + 2 * (np.sqrt(middles) - 2) / 8)
    np.testing.assert_allclose(made[:, 1], 7.0)


def test_the_score_of_varying_levels_is_the_slope_of_the_likelihood() -> None:
    rng = np.random.default_rng(0)
    middles = np.array([5.0, 20.0, 60.0])
    D = dict(enumerate(designs(middles, (4.0, 64.0), np.array([False, True, True]))))
    z = rng.standard_normal((2, 3, 2, 2, 30))
    run = Run(np.ones(30), np.zeros((1, 30), complex), np.zeros((2, 30), complex), 0.7, 0, np.ones(30), 0)
    parts = [
        ErrorSpectra(z[0, i, 0] + 1j * z[1, i, 0], (z[0, i, 1] + 1j * z[1, i, 1])[:, None], run._replace(piece=i))
        for i in range(3)
    ]
    x = 0.3 * rng.standard_normal(1 + 2 * KNOTS)
    slope = approx_fprime(x, lambda x: _likelihood(parts, D, x)[0], 1e-6)
    np.testing.assert_allclose(_likelihood(parts, D, x)[1], slope, rtol=1e-4, atol=1e-3)


def test_noise_that_rises_over_the_band_is_found_and_told() -> None:
    """Three of the channels rise, three are white: 60 s, from 1 to 20 Hz."""
    rng = np.random.default_rng(4)
    records = SETTING.run(rng, 60.0).records()
    freq = np.clip(np.fft.rfftfreq(records.base.shape[1], 1 / SETTING.sample_rate), 1.0, 20.0)
    rising, flat = RISE ** (np.log(freq) / np.log(20.0)), np.ones(freq.size)
    response = np.vstack([
        coloured(records.response[:2], rng, rising), coloured(records.response[2:], rng, flat)
    ])  # fmt: skip
    test = sysid.Measurement.from_time(
        [(coloured(records.base, rng, flat), response, coloured(records.force, rng, rising))],
        SETTING.sample_rate, rigid_body=np.ones((4, 1)), band=SETTING.lines,
    )  # fmt: skip
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    modal = result.modal[0]
    assert modal is not None
    ratios = {one.channel: one.largest / one.least for one in modal.varying}
    # The base too: what it holds was first told beside wrong levels of the others.
    assert {0, 1, 4} <= set(ratios) <= {0, 1, 4, 5}
    assert modal.excess == ()
    for channel in (0, 1, 4):
        assert ratios[channel] == pytest.approx(RISE, rel=0.25)  # 1,140 lines in 5 numbers: some 10 % at the ends
    rms = 0.01 * np.sqrt(np.mean(records.response**2, axis=1))
    inside = (freq > 1) & (freq < 20)
    mean = np.sqrt(np.mean(rising[inside] ** 2))
    assert result.noise is not None
    np.testing.assert_allclose(result.noise.response, rms * [mean, mean, 1, 1], rtol=0.08)
    told = {one.channel for one in result.of_kind("coloured noise")}
    assert "sensor 1" in told and "sensor 3" not in told
