"""Records that were tapered or padded are refused; what a structure's own motion explains is not."""

import numpy as np
import pytest
from scipy import signal

import sysid

RATE, SAMPLES = 50.0, 3000
T = np.arange(SAMPLES) / RATE


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def response(base, frequency, ratio, start=(0.0, 0.0)):
    """Absolute accelerations (2, n) of two oscillators of which the second is a half of the first's frequency."""
    rows = []
    for w in 2 * np.pi * frequency * np.array([1.0, 0.5]):
        A, B = [[0, 1], [-(w**2), -2 * ratio * w]], [[0], [-1]]
        C = [[-(w**2), -2 * ratio * w]]
        rows.append(signal.lsim((A, B, C, [[0]]), base, T, X0=start)[1])
    return np.array(rows)


def measured(base, absolute, **options):
    return sysid.Measurement.from_time([(base[None], absolute, None)], RATE, rigid_body=np.ones((2, 1)), **options)


def right_records(rng):
    """Name, base and responses of records as laboratories make them, without noise and with it."""
    random = rng.standard_normal(SAMPLES)
    event = np.where(T > 10, random * np.exp(-np.maximum(T - 20, 0) / 3), 0.0)
    ramp = random * np.clip(np.minimum(T, T[-1] - T) / 15, 0, 1)
    stepped = np.sin(2 * np.pi * np.cumsum(0.8 + 0.4 * (T // 10)) / RATE) * (T < 50)
    for name, base, start in (
        ("random, cut in motion", random, (0.02, 0.3)), ("an event after quiet", event, (0.0, 0.0)),
        ("a ramped drive", ramp, (0.0, 0.0)), ("stepped sines and free decay", stepped, (0.0, 0.0)),
        ("free decay alone", 1e-9 * random, (0.05, 0.0)), ("motion that stops", random * (T < 30), (0.0, 0.0)),
    ):  # fmt: skip
        for ratio in (0.004, 0.02, 0.08):
            absolute = response(base, 3.0, ratio, start)
            for noise in (0.0, 0.01):
                noisy = [x + noise * np.std(x) * rng.standard_normal(x.shape) for x in (base, absolute)]
                yield f"{name}, damping {ratio}, noise {noise}", *noisy


def test_right_records_are_taken_as_they_are(rng):
    told = []
    for name, base, absolute in right_records(rng):
        try:
            measured(base, absolute)
        except sysid.InputError as error:
            told.append((name, str(error)))
    assert not told


@pytest.mark.parametrize(
    "taper", [signal.windows.hann(SAMPLES), signal.windows.tukey(SAMPLES, 0.6)], ids=["Hann", "Tukey"]
)
def test_tapered_records_are_refused(rng, taper):
    base = rng.standard_normal(SAMPLES)
    absolute = response(base, 3.0, 0.02)
    measured(base, absolute)
    with pytest.raises(sysid.InputError, match="^all channels, the base's too.*a window or a fade was laid over the "):
        measured(base * taper, absolute * taper)
    both = [(base[None] * factor, absolute * factor, None) for factor in (1.0, taper)]
    with pytest.raises(sysid.InputError, match="^all channels of run 2, the base's too"):
        sysid.Measurement.from_time(both, RATE, rigid_body=np.ones((2, 1)))


def test_zeros_after_the_record_are_refused_unless_the_run_is_at_rest(rng):
    base = rng.standard_normal(SAMPLES)
    absolute = response(base, 3.0, 0.02)
    padded = [np.concatenate([x, np.zeros((*x.shape[:-1], 500))], axis=-1) for x in (base, absolute)]
    with pytest.raises(sysid.InputError, match="the last 500 samples hold one value in every channel"):
        measured(*padded)
    measured(*padded, at_rest=True)


def test_zeros_after_the_motion_died_out_are_taken():
    base = np.where(T < 10, np.sin(2 * np.pi * 1.3 * T), 0.0)
    absolute = np.round(response(base, 3.0, 0.05), 4)  # as a recorder of few digits gives it
    assert np.all(absolute[:, -100:] == 0)
    measured(base, absolute)
