"""Damaged samples of records that are made by hand: what is told, where, and what sound records have by chance."""

import numpy as np
import pytest
import scipy.signal

import sysid
from sysid.errors import InputError
from sysid.measurement.damaged_samples import damaged_samples

N, RATE = 6000, 100.0


def moving(seed=0, channels=4, n=N):
    """Gaussian motion of some eight samples a period, with noise of 1 % of its own in each channel."""
    rng = np.random.default_rng(seed)
    low = scipy.signal.butter(4, [0.05, 0.4], "bandpass", output="sos")
    shared = scipy.signal.sosfilt(low, rng.standard_normal((2, n)), axis=1)
    records = rng.standard_normal((channels, 2)) @ shared
    return records + 0.01 * records.std(axis=1, keepdims=True) * rng.standard_normal(records.shape)


def rounded(records, bits):
    step = np.abs(records).max(axis=1, keepdims=True) / 2 ** (bits - 1)
    return step * np.round(records / step)


def shaken(base):
    """A base and the absolute accelerations of three sensors on a structure that it shakes, without noise."""
    K = 4e3 * np.array([[2.0, -1.0, 0.0, -1.0], [-1.0, 2.0, -1.0, 0.0], [0.0, -1.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 1.0]])
    structure = sysid.Structure(np.diag([1.0, 1.0, 2.0, 0.0]), K, [0.02] * 3, n_base=1)
    return np.vstack([base, structure.simulate(base[None], RATE)])


def slow(n=N):
    """Motion of forty samples a period and more."""
    low = scipy.signal.butter(4, [0.005, 0.05], "bandpass", output="sos")
    return scipy.signal.sosfilt(low, np.random.default_rng(1).standard_normal(n))


def told(records, n_base=1):
    return [(one.kind, one.channel) for one in damaged_samples(records, n_base)]


@pytest.mark.parametrize("bits", [8, 12, 24])
def test_nothing_is_told_of_sound_records_however_coarse_their_steps(bits):
    assert [told(rounded(moving(seed), bits)) for seed in range(5)] == [[]] * 5


@pytest.mark.parametrize("level", [1.0, 2.0, 2.8])
@pytest.mark.parametrize("bits", [12, 24])
def test_flat_tops_are_told_with_their_samples_and_level(level, bits):
    records = rounded(moving(), bits)
    top = level * records[2].std()
    beyond = np.flatnonzero(np.abs(records[2]) >= top)
    np.clip(records[2], -top, top, out=records[2])
    (one,) = damaged_samples(records, 1)
    assert (one.kind, one.channel, one.count, one.value) == ("clipped", 2, beyond.size, top)
    at = np.concatenate([np.arange(first, last + 1) for first, last in one.stretches])
    np.testing.assert_array_equal(at, beyond)


@pytest.mark.parametrize("samples_a_period", [8, 10, 10.3, 40])
@pytest.mark.parametrize("bits", [8, 16])
def test_peaks_of_a_steady_sine_are_no_flat_tops(samples_a_period, bits):
    """A sine in step with the samples has the same values in each period; its tops share a step of 8 bits."""
    t = np.arange(N) / samples_a_period
    assert told(rounded(np.array([np.sin(2 * np.pi * t + phase) for phase in (0.0, 0.3, np.pi / 8, 1.0)]), bits)) == []


def test_flat_tops_of_a_sine_are_told():
    t, rng = np.arange(N) / 40, np.random.default_rng(0)
    records = np.array([np.sin(2 * np.pi * t + phase) for phase in (0.0, 0.3, 0.6, 1.0)])
    records += 1e-3 * rng.standard_normal(records.shape)
    np.clip(records[1], -0.8, 0.8, out=records[1])
    assert told(rounded(records, 16)) == [("clipped", 1)]


@pytest.mark.parametrize(("kind", "value"), [("dropout", 0.0), ("held value", None)])
@pytest.mark.parametrize("first", [0, 2000, N - 40])
def test_a_gap_and_a_held_value_are_told_with_their_place(kind, value, first):
    records = moving()
    value = records[3, first] if value is None else value
    records[3, first : first + 40] = value
    (one,) = damaged_samples(records, 1)
    assert (one.kind, one.channel, one.count, one.value) == (kind, 3, 40, value)
    np.testing.assert_array_equal(one.stretches, [[first, first + 39]])


def test_a_rest_is_no_gap():
    """A recorder that waits for motion, a base that stops while sensors ring, and a rest between two events."""
    records = moving()
    records[:, :900] = records[:, -700:] = 0.0
    assert told(records) == []
    records = moving()
    records[0, 4000:] = 0.0
    assert told(records) == []
    assert told(records, n_base=0) == [("dropout", 0)]
    records = moving()
    records[[1, 3], :2500] = 0.0  # a second axis of the base that starts later, and the sensor that it moves
    assert told(records, n_base=2) == []
    records = rounded(moving() * (1 - np.exp(-(((np.arange(N) - 3000) / 300.0) ** 4))), 8)
    assert np.count_nonzero(np.all(records == 0, axis=0)) > 100
    assert told(records) == []


@pytest.mark.parametrize("offset", [0.0, 0.03])
@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("ramp", [1, 50])
def test_a_base_that_rests_between_bursts_has_no_gap(bits, offset, ramp):
    on = np.convolve(np.arange(N) % 2000 < 1000, np.ones(ramp) / ramp)[:N]
    base = moving(channels=1)[0] * on
    assert told(rounded(shaken(base) + offset * np.ptp(base), bits)) == []


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("offset", [0.0, 0.03])
def test_pulses_of_the_base_to_one_side_are_not_clipped(sign, offset):
    base = np.zeros(N)
    for first in range(200, N, 700):
        base[first : first + 20] = np.sin(np.pi * np.arange(20) / 20)
    assert told(sign * shaken(base) + offset) == []


@pytest.mark.parametrize("times", [3, 4, 8])
@pytest.mark.parametrize("held", [1, 4])
@pytest.mark.parametrize("bits", [12, 24])
def test_records_of_a_slow_converter_are_sound(times, held, bits):
    records = rounded(moving(), bits)
    records[:held] = np.repeat(records[:held, ::times], times, axis=1)[:, :N]
    assert told(records) == []


def test_a_channel_of_one_value_is_let_pass():
    records = moving()
    records[2] = 3.3
    assert told(records) == []


@pytest.mark.parametrize("width", [1, 2])
def test_spikes_are_told_one_by_one(width):
    records = moving()
    for at in (700, 2500, 2530):
        records[1, at : at + width] += 6 * records[1].std()
    (one,) = damaged_samples(records, 1)
    assert (one.kind, one.channel) == ("spikes", 1)
    np.testing.assert_array_equal(one.stretches, [[at, at + width - 1] for at in (700, 2500, 2530)])
    assert one.value == pytest.approx(6 * moving()[1].std(), rel=0.1)


@pytest.mark.parametrize("height", [5, 15, 40, 100])
@pytest.mark.parametrize("bits", [16, 24])
def test_beside_large_spikes_of_slow_motion_no_sound_sample_is_told(height, bits):
    """The filter of errors has waves beside each, which stand out too where the spike is large."""
    records = shaken(slow())
    at = np.array([367, 2952, 4100, 4500, 5700])
    records[2, at] += height * records[2].std() * np.array([1, -1, 1, 1, -1])
    records = rounded(records + 1e-3 * np.random.default_rng(2).standard_normal(records.shape), bits)
    (one,) = damaged_samples(records, 1)
    assert (one.kind, one.channel) == ("spikes", 2)
    np.testing.assert_array_equal(one.stretches, np.column_stack([at, at]))


def test_a_structure_that_is_hit_has_no_spikes():
    records = moving()
    records[:, 3000] += 10 * records.std(axis=1)
    assert told(records) == []


@pytest.mark.parametrize("width", [1, 2, 4, 8])
@pytest.mark.parametrize("height", [5, 20, 60])
def test_knocks_of_the_base_are_no_spikes(width, height):
    base = slow()
    for first in (700, 1900, 2800, 4100, 5300):
        base[first : first + width] += height * base.std() * np.sin(np.pi * (np.arange(width) + 0.5) / width)
    assert told(rounded(shaken(base), 24)) == []


def test_hum_of_one_channel_is_told_with_its_frequency_and_a_tone_of_all_is_not():
    records = moving()
    hum = np.sin(2 * np.pi * 0.1234 * np.arange(N))
    alone = records.copy()
    alone[2] += 0.1 * records[2].std() * hum
    (one,) = damaged_samples(alone, 1)
    assert (one.kind, one.channel) == ("tone", 2)
    assert one.value == pytest.approx(0.1234, abs=0.1 / N)
    assert told(records + records.std(axis=1, keepdims=True) * hum) == []


def test_equal_channels_are_told_but_none_is_held_against_the_base():
    records = moving()
    records[3] = records[1]
    (one,) = damaged_samples(records, 1)
    assert (one.kind, one.channel, one.value) == ("equal channels", 3, 1.0)
    records = moving()
    records[1] = records[0]
    assert told(records, n_base=2) == told(records, n_base=1) == []


def run(records):
    return records[:1], records[1:3], records[3:]


def from_time(records, **options):
    return sysid.Measurement.from_time([run(records)], RATE, rigid_body=[[1.0], [1.0]], **options)


def test_a_run_is_cut_at_a_short_gap_and_the_rest_is_kept_to_the_bit():
    records = moving()
    records[2, 2000:2030] = 0.0
    test = from_time(records, at_rest=True, noise=sysid.NoiseLevels([[0.1, 0.2]], [[0.3]], [[0.4]]))
    pieces = [run(records[:, :2000]), run(records[:, 2030:])]
    plain = sysid.Measurement.from_time(pieces, RATE, rigid_body=[[1.0], [1.0]])
    for name in ("freq", "base", "response", "force"):
        np.testing.assert_array_equal(getattr(test, name), getattr(plain, name))
    assert test.whole.samples == (2000, N - 2030)
    assert test.whole.at_rest == (False, False)
    np.testing.assert_array_equal(test.whole.noise.response, [[0.1, 0.2], [0.1, 0.2]])
    (one,) = test.damage
    assert (one.kind, one.run, one.channel, one.count, one.left_out) == ("dropout", 1, "sensor 2", 30, True)
    np.testing.assert_allclose(one.stretches, [[20.0, 20.29]])


def test_damage_is_stored_with_a_measurement():
    records = moving()
    records[2, 2000:2030] = 0.0
    test = from_time(records)
    again = sysid.Measurement.from_tree(test.to_tree())
    (one,), (other,) = test.damage, again.damage
    assert {**vars(one), "stretches": one.stretches.tolist()} == {**vars(other), "stretches": other.stretches.tolist()}


@pytest.mark.parametrize("estimator", ["spectra", "h1"])
def test_averages_and_plain_spectra_are_not_cut(estimator):
    records = moving()
    records[2, 2000:2030] = 0.0
    test = from_time(records, estimator=estimator)
    assert [(one.kind, one.left_out) for one in test.damage] == [("dropout", False)]
    np.testing.assert_array_equal(test.freq, from_time(moving(), estimator=estimator).freq)


def test_long_clipping_is_refused():
    records = moving()
    np.clip(records[2], -records[2].std(), records[2].std(), out=records[2])
    with pytest.raises(InputError):
        from_time(records)


def test_what_is_too_long_to_be_left_out_and_not_clipped_is_told():
    records = moving()
    records[2, 1000:3500] = 0.0
    (one,) = from_time(records).damage
    assert (one.kind, one.channel, one.count, one.left_out) == ("dropout", "sensor 2", 2500, False)


def test_sensors_that_are_equal_by_symmetry_are_taken_and_told():
    K = 800 * np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0], [-1.0, -1.0, 2.0]])
    structure = sysid.Structure(np.diag([2.0, 2.0, 0.0]), K, [0.01, 0.01], n_base=1)
    base = moving(channels=1)
    records = np.vstack([base, structure.simulate(base, RATE), moving(1, channels=1)])
    np.testing.assert_array_equal(records[1], records[2])
    test = from_time(records)
    assert [(one.kind, one.channel, one.other) for one in test.damage] == [("equal channels", "sensor 2", "sensor 1")]


def test_a_piece_that_is_too_short_to_be_shifted_is_left_out():
    """Between samples by 32 of them to either side: a run is cut once, before the gap nothing is taken."""
    records = moving(n=400)
    records[2, 45:49] = 0.0
    sensors = [sysid.Sensor(name, (0, 0, 1), "x", delay=delay) for name, delay in (("a", 0.0), ("b", 0.5 / RATE))]
    test = sysid.Measurement.from_time([run(records)], RATE, sensors=sensors)
    assert test.whole.samples == (400 - 49 - 64,)


def test_a_short_record_and_one_that_never_moves_are_let_pass():
    assert told(moving()[:, :10]) == []
    records = moving()
    records[2] = 0.0
    assert told(records) == []
