"""Records that tell no modes, or not the noise of each channel, are told as such."""

from __future__ import annotations

import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import Records, four_storeys, with_noise
from sysid.modal_analysis.rough_poles import at_sines_alone, steady_sine

SETTING = four_storeys()
RATE = SETTING.sample_rate


def measured(records: Records) -> sysid.Measurement:
    return sysid.Measurement.from_time(
        [(records.base, records.response, records.force)],
        RATE, rigid_body=np.ones((4, 1)), band=SETTING.lines,
    )  # fmt: skip


def at_a_sine(cycles: float, noise: float) -> sysid.Measurement:
    """Half a minute of so many cycles."""
    f, rng = cycles / 30.0, np.random.default_rng(0)
    turn = np.exp(2j * np.pi * f * np.arange(30 * int(RATE)) / RATE)
    H, Z = SETTING.structure.transmissibility([f])[:, 0], SETTING.structure.base_force([f])[0]
    records = Records(turn.real[None], (H * turn).real, (Z * turn).real, RATE)
    return measured(with_noise(records, rng, noise)[0])


@pytest.mark.parametrize(("cycles", "noise"), [(129, 0.01), (129.4, 0)])
def test_a_steady_sine_is_told_and_no_unit_or_sign_is_accused(cycles: float, noise: float) -> None:
    with pytest.raises(sysid.InputError, match=r"steady sine at 4\.3.* Hz") as caught:
        sysid.identify(sysid.Problem(at_a_sine(cycles, noise), mass=sysid.FullMass()), rng=0)
    assert "exp(-iwt)" not in str(caught.value)


@pytest.mark.parametrize(
    ("at", "alone"), [([4.3], True), ([4.3, 7.9], False), ([4.3, 7.9, 7.95], True), ([4.3, 7.9, 7.95, 9.0], False)]
)
def test_two_modes_at_one_frequency_beside_a_sine_are_noise(at: list[float], alone: bool) -> None:
    """They cancel each other; a mode by itself is one that the noise of the base may have shown."""
    test, omega = at_a_sine(129, 0.01), 2 * np.pi * np.array(at)
    assert at_sines_alone(test, omega, np.full(omega.size, 0.02)) is alone
    assert at_sines_alone(at_a_sine(129, 0.0), omega, np.full(omega.size, 0.02))


def test_random_motion_is_no_steady_sine() -> None:
    rng = np.random.default_rng(0)
    assert steady_sine(measured(SETTING.run(rng, 30.0).records())) is None


@pytest.mark.parametrize("base_noise", [0.0, 0.01])
def test_noise_of_a_base_without_any_is_told_not_to_be_determined(base_noise: float) -> None:
    rng = np.random.default_rng(1)
    records, levels = with_noise(SETTING.run(rng, 30.0).records(), rng, 0.01, base_noise)
    result = sysid.identify(sysid.Problem(measured(records), mass=sysid.FullMass()), rng=0)
    told = [one.channel for one in result.of_kind("noise level")]
    assert told.count("base x") == (base_noise == 0.0)
    assert result.noise is not None
    np.testing.assert_allclose(result.noise.response, levels.response, rtol=0.15)
