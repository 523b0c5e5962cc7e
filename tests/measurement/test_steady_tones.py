"""Steady tones of whole records: their spectra, where they are found, and modes beside them."""

import numpy as np
import pytest

import sysid
from sysid.finding import Severity
from sysid.measurement.whole import WholeRecords

RATE, N = 50.0, 6000
TRUTH = sysid.Structure(
    np.diag([3.0, 2.0, 0.0]), [[8e3, -3e3, -5e3], [-3e3, 3e3, 0], [-5e3, 0, 5e3]], [0.02, 0.02], n_base=1
)
MODES = TRUTH.natural_frequencies


def records(seed=0, hum=0.0, tone=6.3, noise=0.003):
    """Base, two sensors and force in random motion, cut in motion, with noise, and hum of any phase in each."""
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((1, 2 * N))
    every = np.vstack([base, TRUTH.simulate(base, RATE), TRUTH.simulate_force(base, RATE)])[:, N:]
    phase = rng.uniform(0, 2 * np.pi, (len(every), 1))
    size = every.std(axis=1, keepdims=True)
    every = every + noise * size * rng.standard_normal(every.shape)
    return every + hum * size * np.sin(2 * np.pi * tone * np.arange(N) / RATE + phase)


def measured(every, **options):
    return sysid.Measurement.from_time([(every[:1], every[1:3], every[3:])], RATE, rigid_body=TRUTH.rigid_body,
                                       **options)  # fmt: skip


@pytest.mark.parametrize("tone", [7.3123, 0.31, 24.93, 7.3])  # the last is a line
def test_the_spectrum_of_any_steady_sine_is_made_of_the_columns_of_its_tone(tone):
    at = np.arange(1000)
    freq, spectrum = np.fft.rfftfreq(1000, 0.01)[1:-1], np.fft.rfft(np.cos(2 * np.pi * tone * 0.01 * at + 0.7))[1:-1]
    columns = np.vstack([np.ones(freq.size), WholeRecords((1000,), 100.0, (False,)).of_tone(tone, freq)])
    real = np.hstack([columns.real, columns.imag]).T
    real = real / np.linalg.norm(real, axis=0)
    wanted = np.append(spectrum.real, spectrum.imag)

    def left(columns):
        return np.linalg.norm(columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0] - wanted) / np.linalg.norm(
            wanted
        )

    assert left(real) < (1e-12 if tone != 7.3 else 1e-8)
    wrong = WholeRecords((1000,), 100.0, (False,)).of_tone(tone + 0.02, freq)
    assert left(np.hstack([wrong.real, wrong.imag]).T) > 0.1


@pytest.mark.parametrize("tone", [6.3, 12.013, MODES[0], MODES[1]])
def test_a_tone_is_found_to_a_small_part_of_a_line_on_a_mode_and_beside_it(tone):
    (found,) = measured(records(hum=0.005, tone=tone)).whole.tones
    assert found == pytest.approx(tone, abs=0.02 * RATE / N)


@pytest.mark.parametrize("seed", range(6))
def test_no_tone_is_found_in_records_without(seed):
    assert measured(records(seed)).whole.tones == ()


def test_no_tone_is_found_where_the_base_itself_moves_steadily():
    rng = np.random.default_rng(3)
    base = rng.standard_normal((1, 2 * N)) + 3 * np.sin(2 * np.pi * MODES[0] * np.arange(2 * N) / RATE)
    every = np.vstack([base, TRUTH.simulate(base, RATE), TRUTH.simulate_force(base, RATE)])[:, N:]
    every += 0.003 * every.std(axis=1, keepdims=True) * rng.standard_normal(every.shape)
    assert measured(every).whole.tones == ()


def test_no_tone_is_found_in_a_sweep_of_eight_bits():
    time = np.arange(N) / RATE
    base = np.sin(2 * np.pi * (0.5 * time + 17 / (2 * time[-1]) * time**2))[None]
    every = np.vstack([base, TRUTH.simulate(base, RATE), TRUTH.simulate_force(base, RATE)])
    step = np.abs(every).max(axis=1, keepdims=True) / 128
    assert measured(step * np.round(every / step)).whole.tones == ()


@pytest.mark.parametrize("tone", [6.3, MODES[0], MODES[1]])
def test_mass_and_damping_are_right_beside_a_tone_which_is_told(tone):
    result = sysid.identify(sysid.Problem(measured(records(hum=0.02, tone=tone))), rng=0)
    assert result.judgement == "determined"
    (found,) = (one for one in result.findings if one.kind == "tone")
    assert (found.severity, found.numbers["channels"]) == (Severity.NOTE, 3)
    assert found.numbers["value"] == pytest.approx(tone, abs=0.02 * RATE / N)
    assert found.numbers["size"] > 0.01
    known = result.uncertainty
    assert np.all(np.abs(result.structure.damping_ratios - 0.02) < 4 * known.damping_ratios)
    assert np.all(np.abs(result.structure.natural_frequencies - MODES) < 4 * known.natural_frequencies)
    assert np.all(np.abs(result.structure.mass[:2, :2] - TRUTH.mass[:2, :2]) < 4 * known.mass[:2, :2] + 1e-9)
