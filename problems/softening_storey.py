"""Two-storey frame whose first mode softens and is damped more as it moves more, shaken at three levels (simulated).

Frequency and damping ratio of the first mode follow the envelope of its own acceleration; the second mode is linear.
One test holds runs of levels 1 : 3 : 10. A fourth run, of a level between, is predicted and never fitted:
`--set amplitude=False` gives the best linear model, which predicts it far worse.
"""

import numpy as np

import sysid
from sysid.structure.amplitude import FittedLaw, LawForm

RATE, SECONDS, BAND = 40.0, 16.0, (0.5, 14.0)  # Hz, s, Hz
LEVELS, UNSEEN = (0.3, 1.0, 3.0), 1.7  # m/s² rms of the base
MASS, STIFFNESS = (
    np.diag([100.0, 100.0, 0.0]),
    9.0e4 * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]),
)
RATIOS = (0.01, 0.012)  # damping at rest
FALL, RISE, AT = 0.04, 0.012, 12.0  # of the frequency, as a share, and of the damping ratio at this level, m/s²


def frame():
    """The true structure, with its law: the frequency falls by the root of the level, the damping ratio rises by it."""
    sensors = [sysid.Sensor(f"floor {i}", (0.0, 0.0, 3.0 * i), "x") for i in (1, 2)]
    linear = sysid.Structure(MASS, STIFFNESS, RATIOS, n_base=1, sensors=sensors)
    law = FittedLaw(
        linear.natural_frequencies[0], RATIOS[0], 1, LawForm(0.5, 1.0, AT), np.array([FALL, RISE]), (0.1, 40.0),
        np.zeros((4, 4)), True,
    )  # fmt: skip
    return linear.with_laws([law])


def shaken(truth, level, noise, rng):
    """Base and floors, m/s², under a random motion of the base in the band, with noise of a share of each channel."""
    samples = int(RATE * SECONDS)
    freq = np.fft.rfftfreq(samples, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal(samples)) * ((freq > BAND[0]) & (freq < BAND[1]))
    base, t = np.fft.irfft(spectrum, samples)[None], np.arange(samples) / RATE
    base *= level / base.std() * np.clip(np.minimum(t, t[-1] - t) / 2, 0.0, 1.0)  # begins and ends softly
    records = base, truth.simulate(base, RATE)
    return tuple(x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape) for x in records)


def problem(*, data=None, rng=0, noise=0.01, amplitude=True):
    if data is not None:
        raise sysid.InputError("softening_storey is simulated and takes no --data")
    truth, rng = frame(), np.random.default_rng(rng)
    runs = [(*shaken(truth, level, noise, rng), None) for level in (*LEVELS, UNSEEN)]
    fitted, unseen = (
        sysid.Measurement.from_time(
            part, RATE, rigid_body=np.ones((2, 1)), band=BAND, sensors=truth.sensors, estimator="records"
        )
        for part in (runs[:3], runs[3:])
    )
    return sysid.Problem(
        fitted,
        mass=sysid.LumpedMass(),
        amplitude=sysid.AmplitudeLaw(modes=[1], exponents=(0.5, 1.0)) if amplitude else None,
        validation=[unseen],
    )
