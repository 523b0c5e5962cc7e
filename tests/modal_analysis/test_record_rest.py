"""A run that is stated to be at rest at both ends and was cut in motion is told; a right statement is not."""

from __future__ import annotations

import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import Records, four_storeys, with_noise

SETTING = four_storeys()
RATE = SETTING.sample_rate


def event(rng: np.random.Generator, cut: bool) -> Records:
    """A shake of 20 s in 60 s, at rest at both ends by response functions over 480 s; or 30 s from its middle on."""
    samples = int(60 * RATE)
    period = 8 * samples
    freq = np.fft.rfftfreq(period, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal(period)) * ((freq > 0.5) & (freq < 50))
    time = np.arange(period) / RATE
    base = np.fft.irfft(spectrum, period) * np.where(time < 20, np.sin(np.pi * time / 20) ** 2, 0.0)
    motion, s = np.fft.rfft(base), SETTING.structure
    response = np.fft.irfft(s.transmissibility(freq)[:, 0] * motion, period)
    force = np.fft.irfft(s.base_force(freq)[0] * motion, period)
    kept = slice(int(10 * RATE), int(40 * RATE)) if cut else slice(0, samples)
    return with_noise(Records(base[None, kept], response[:, kept], force[:, kept], RATE), rng, 0.01)[0]


@pytest.mark.parametrize("cut", [(False, False), (False, True)])
def test_the_run_that_was_cut_in_motion_is_told(cut: tuple[bool, bool]) -> None:
    rng = np.random.default_rng(2)
    runs = [event(rng, one) for one in cut]
    test = sysid.Measurement.from_time(
        [(run.base, run.response, run.force) for run in runs],
        RATE, rigid_body=np.ones((4, 1)), band=SETTING.lines, at_rest=True,
    )  # fmt: skip
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    told = [one.run for one in result.of_kind("in motion")]
    assert told == [number for number, one in enumerate(cut, start=1) if one]
