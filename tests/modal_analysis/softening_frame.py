"""Records of two masses whose modes follow an amplitude, or rub, integrated by Runge-Kutta steps in plain floats."""

import math

import numpy as np
import scipy.signal

import sysid

RATE, FALL, RISE, LEVEL = 40.0, 0.06, 0.012, 12.0
OMEGA, RATIOS = 2 * np.pi * np.array([3.0, 8.0]), np.array([0.012, 0.01])
PHI = np.array([[0.5, 0.85], [0.85, -0.5]])  # two equal masses of 1 kg
GAMMA = PHI.T @ np.ones(2)
STEPS = 12  # of a sample


def _further(y, times, by):
    """Numbers a step on, of so many times their slopes."""
    return [one + times * other for one, other in zip(y, by, strict=True)]


def moved(base, *, law=True, both=False, by_first=False):
    """Absolute accelerations by a Runge-Kutta method of fourth order, the base band-limited.

    With `both` the second mode falls too, by the first power of its level; `by_first` as the first one does.
    """
    n = base.size * STEPS
    fine = scipy.signal.resample(base, 2 * n).tolist()
    h, sizes = 1 / (RATE * STEPS), np.abs(PHI).max(axis=0).tolist()
    at_rest, damped_at_rest, gamma = OMEGA.tolist(), RATIOS.tolist(), GAMMA.tolist()

    def slopes_of(k, q, v, u, level=None):
        """Slopes of one mode, (q', v'), and the level by which it moves: its own, where none is given."""
        w, zeta, power = at_rest[k], damped_at_rest[k], 0.5 if k == 0 or by_first else 1.0
        if law and (k == 0 or both or by_first):
            for _ in range(1 if level is not None else 8):
                own = sizes[k] * w * math.hypot(w * q, v) / LEVEL if level is None else level
                w = at_rest[k] * (1 - FALL * own**power)
            level, zeta = own, zeta + RISE * own
        return v, -2 * zeta * w * v - w * w * q - gamma[k] * u, level

    def slope(y, u):
        *first, level = slopes_of(0, y[0], y[1], u)
        return *first, *slopes_of(1, y[2], y[3], u, level if by_first else None)[:2]

    y, out = [0.0] * 4, []  # (q, v) of each mode
    for k in range(n - 1):
        u, middle, then = fine[2 * k : 2 * k + 3]
        a = slope(y, u)
        if k % STEPS == 0:
            out.append([a[1], a[3], u])
        b = slope(_further(y, h / 2, a), middle)
        c = slope(_further(y, h / 2, b), middle)
        d = slope(_further(y, h, c), then)
        y = [one + h / 6 * (p + 2 * (q + r) + s) for one, p, q, r, s in zip(y, a, b, c, d, strict=True)]
    motions = np.array(out).T
    return PHI @ motions[:2] + motions[2]


def rubbing(base, size=0.06, smooth=0.003):
    """Absolute accelerations of the same, linear but for friction in both storeys, N, as `moved` has them."""
    n, h = base.size * STEPS, 1 / (RATE * STEPS)
    fine, drifts = scipy.signal.resample(base, 2 * n), np.array([PHI[0], PHI[1] - PHI[0]]).tolist()
    (a, b), (c, d) = drifts
    loss, rise, load = (2 * RATIOS * OMEGA).tolist(), (OMEGA**2).tolist(), np.outer(fine, GAMMA).tolist()

    def slope(q, r, v, w, u):
        first, second = size * math.tanh((a * v + b * w) / smooth), size * math.tanh((c * v + d * w) / smooth)
        of_first = -loss[0] * v - rise[0] * q - a * first - c * second - u[0]
        return v, w, of_first, -loss[1] * w - rise[1] * r - b * first - d * second - u[1]

    y, out = [0.0] * 4, []
    for k in range(n - 1):
        one = slope(*y, load[2 * k])
        if k % STEPS == 0:
            out.append(one[2:])
        two = slope(*_further(y, h / 2, one), load[2 * k + 1])
        three = slope(*_further(y, h / 2, two), load[2 * k + 1])
        four = slope(*_further(y, h, three), load[2 * k + 2])
        y = [at + h / 6 * (p + 2 * (q + r) + s) for at, p, q, r, s in zip(y, one, two, three, four, strict=True)]
    return PHI @ np.transpose(out) + base


def shaken(level, seed, samples=1200):
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft(rng.standard_normal(samples))
    freq = np.fft.rfftfreq(samples, 1 / RATE)
    spectrum[(freq < 0.8) | (freq > 11.0)] = 0
    base = np.fft.irfft(spectrum, samples)
    t = np.arange(samples) / RATE
    return level * base / base.std() * np.clip(np.minimum(t, t[-1] - t) / 2, 0, 1)


def recorded(levels, *, noise=0.005, seed=0, samples=1200, by=moved, **how):
    rng, runs = np.random.default_rng([seed, 1]), []  # not the numbers of which the base is made
    for number, level in enumerate(levels):
        base = shaken(level, 10 * seed + number, samples)
        response = by(base, **how)
        noisy = response + noise * response.std(axis=1, keepdims=True) * rng.standard_normal(response.shape)
        runs.append((base[None] + noise * base.std() * rng.standard_normal(base.size), noisy, None))
    sensors = [sysid.Sensor(f"floor {i}", (0, 0, float(i)), "x") for i in (1, 2)]
    return sysid.Measurement.from_time(runs, RATE, rigid_body=np.ones((2, 1)), band=(0.8, 12.0), sensors=sensors)
