"""The band that the base excites: of motion whose band is known, beside noise and drift."""

import numpy as np
import pytest
import scipy.signal

import sysid

RATE, N = 100.0, 12000
FREQ = np.fft.rfftfreq(N, 1 / RATE)
ALL = FREQ[1], FREQ[FREQ <= 0.4 * RATE][-1]


def random(size, seed=0):
    """Gaussian motion with an amplitude spectrum of this size at `FREQ`, of rms 1, (1, n)."""
    motion = np.fft.irfft(size * np.fft.rfft(np.random.default_rng(seed).standard_normal(N)))
    return motion[None] / motion.std()


def between(low, high, n=N):
    freq = np.fft.rfftfreq(n, 1 / RATE)
    return ((freq >= low) & (freq <= high)).astype(float)


def power_law(exponent):
    return np.append(0.0, FREQ[1:] ** exponent)


def swept(low, high, method):
    t = np.arange(N) / RATE
    return scipy.signal.chirp(t, low, t[-1], high, method)[None]


def stepped(steps):
    """A sine at one frequency after the other, and rest before and after."""
    t = np.arange(N // (len(steps) + 2)) / RATE
    parts = [scipy.signal.windows.tukey(t.size, 0.2) * np.sin(2 * np.pi * f * t) for f in steps]
    motion = np.concatenate([np.zeros(t.size), *parts])
    return np.append(motion, np.zeros(N - motion.size))[None]


def earthquake(seed=0):
    """Motion of a ground that resonates at 2 Hz (Kanai-Tajimi, Clough-Penzien), strong for a third of the record."""
    r, q, t = FREQ / 2, FREQ / 0.3, np.arange(N) / N
    ground = np.sqrt((1 + 1.44 * r**2) / ((1 - r**2) ** 2 + 1.44 * r**2))
    motion = random(ground * q**2 / np.sqrt((1 - q**2) ** 2 + 1.44 * q**2) / (1 + (FREQ / 8) ** 4), seed)
    return motion * np.interp(t, [0, 0.1, 0.2, 0.4, 0.7, 1], [0, 0, 1, 1, 0.05, 0.01])


def noise(size, seed=1):
    return size * np.random.default_rng(seed).standard_normal((1, N))


def drift(size, seed=2):
    walk = np.cumsum(np.random.default_rng(seed).standard_normal(N))
    return size * (walk - walk.mean())[None] / walk.std()


def band(*bases, rate=RATE):
    return sysid.excited_band([(base, base, None) for base in bases], rate)


@pytest.mark.parametrize("level", [1e-3, 1e-2, 3e-2])
@pytest.mark.parametrize("slow", [0.0, 0.02])
@pytest.mark.parametrize(
    "motion, low, high",
    [
        (random(between(0.5, 5)), 0.5, 5),
        (random(between(5, 20)), 5, 20),
        (swept(1, 20, "linear"), 1, 20),
        (swept(1, 20, "logarithmic"), 1, 20),
        (stepped(np.geomspace(1, 10, 10)), 1, 10),
        (stepped([3.0]), 3, 3),
    ],
    ids=["low", "high", "linear sweep", "logarithmic sweep", "steps", "sine"],
)
def test_motion_within_a_band_is_found_beside_noise_and_drift(motion, low, high, slow, level):
    found = band(motion + noise(level) + drift(slow))
    assert low / 4 < found[0] <= low
    assert high <= found[1] < 2.5 * high


@pytest.mark.parametrize("level", [1e-3, 1e-2, 5e-2])
@pytest.mark.parametrize("seed", range(3))
def test_an_earthquake_is_excited_up_to_where_its_noise_begins(seed, level):
    motion = earthquake(seed)
    low, high = band(motion + noise(level, seed + 10))
    freq, density = scipy.signal.welch(motion[0], RATE, nperseg=2048)
    drowned = freq[(freq > 2) & (density < level**2 / (RATE / 2))][0]
    assert low < 0.3 and drowned / 1.6 < high < 1.25 * drowned


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("exponent", [0.0, -0.5])
def test_white_and_pink_motion_lose_no_line(exponent, seed):
    motion = random(power_law(exponent), seed)
    assert band(motion + noise(1e-4)) == pytest.approx(ALL)
    assert band(motion + drift(0.01)) == pytest.approx(ALL)


def test_a_notch_within_an_octave_cuts_nothing_off():
    """A table gives way at the frequencies of what stands on it."""
    size = between(1, 20) * np.where(np.abs(FREQ / 6 - 1) < 0.15, 1e-3, 1.0)
    assert band(random(size) + noise(1e-3)) == pytest.approx((1, 20), rel=0.3)


def test_runs_excite_what_any_of_them_does_and_directions_what_any_does():
    low, high = (random(between(*ends)) + noise(1e-3) for ends in ((1, 4), (10, 25)))
    assert band(low) == pytest.approx((1, 4), rel=0.3)
    assert band(low, high) == pytest.approx((1, 25), rel=0.3)
    still = noise(1e-3, 7)
    assert band(np.vstack([low, still]), np.vstack([still, high])) == pytest.approx((1, 25), rel=0.3)


def test_scale_and_offset_change_nothing_and_the_rate_scales_it():
    motion = random(between(1, 10)) + noise(0.01)
    found = band(motion)
    np.testing.assert_allclose(band(1e-6 * motion + 1e-3), found, rtol=1e-12)
    np.testing.assert_allclose(band(motion, rate=10 * RATE), 10 * np.array(found), rtol=1e-12)


@pytest.mark.parametrize("n", [2, 3, 11, 12, 13, 30])
def test_short_records_have_a_band_of_their_lines(n):
    base = np.random.default_rng(0).standard_normal((1, n))
    test = sysid.Measurement.from_time([(base, base, None)], RATE, rigid_body=[[1.0]])
    assert sysid.excited_band([(base, base, None)], RATE) == (test.freq[0], test.freq[-1])


def test_too_few_lines_of_records_are_refused():
    base = np.random.default_rng(0).standard_normal((1, 200))
    for high in (10.0, 11.0):
        test = sysid.Measurement.from_time([(base, 2 * base, None)], RATE, rigid_body=[[1.0]], band=(10.0, high))
        with pytest.raises(sysid.InputError, match="lines from 10 to .* are too few"):
            sysid.identify(sysid.Problem(test))


def test_a_base_at_rest_and_no_records_are_no_accident():
    still = np.zeros((1, 100))
    assert sysid.excited_band([(still, still, None)], RATE) == pytest.approx((1.0, 40.0))
    for runs in ([], [(still[:, :1], still[:, :1], None)], [(still, still[:, 1:], None)]):
        with pytest.raises(sysid.InputError):
            sysid.excited_band(runs, RATE)


def test_a_run_in_which_the_base_rests_widens_nothing():
    moved, rest = random(between(1.0, 4.0)) + noise(0.01), noise(0.01, 7)
    alone, both = (
        sysid.excited_band([(base, base, None) for base in bases], RATE) for bases in ([moved], [moved, rest])
    )
    assert both == alone
    assert both[0] > 0.5 and both[1] < 8


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("high", [5.0, 11.3, 19.0, 23.7])
def test_the_band_ends_close_above_the_motion(high, seed):
    """A mode between the end of the motion and that of the band would hardly be shaken, and its mass be open."""
    found = band(random(between(1, high), seed) + noise(3e-3, seed + 20))
    assert high <= found[1] < 1.12 * high


def test_hum_above_the_motion_is_no_motion_and_steps_of_a_sine_are():
    motion, rng, t = random(between(2, 20)), np.random.default_rng(1), np.arange(N) / RATE
    noise = 0.003 * rng.standard_normal((1, N))
    hum = 0.003 * np.sin(2 * np.pi * 35.003 * t)
    quiet, humming = (sysid.excited_band([(one, one, None)], RATE) for one in (motion + noise, motion + noise + hum))
    assert humming == pytest.approx(quiet, abs=0.02)
    louder = motion + noise + 20 * hum  # of which the base has six hundredths: it moves so
    assert sysid.excited_band([(louder, louder, None)], RATE)[1] > 35
