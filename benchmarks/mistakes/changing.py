"""A structure of two storeys that changes during a test: integrated step by step, independent of the package."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.linalg
from scipy.interpolate import CubicSpline

import sysid

RATE, SECONDS, BAND = 80.0, 100.0, (0.5, 20.0)
MASSES, SPRINGS, DAMPERS = np.array([2.0, 1.0]), np.array([2400.0, 1500.0]), np.array([1.2, 0.8])
SOFTENING = 100.0  # 1/m²
STEPS = 2  # of Runge and Kutta's a sample
State = tuple[float, float, float, float]  # of both floors: displacements from the base, and velocities


def frequencies(springs: np.ndarray) -> np.ndarray:
    """Natural frequencies of the two storeys with these springs, (2,), Hz."""
    k1, k2 = springs
    stiffness = [[k1 + k2, -k2], [-k2, k2]]
    return np.sqrt(scipy.linalg.eigh(stiffness, np.diag(MASSES), eigvals_only=True)) / (2 * np.pi)


def motion(rng: np.random.Generator, seconds: float = SECONDS) -> np.ndarray:
    """Random base acceleration between 1 and 15 Hz, 1 m/s² rms, (n_samples,)."""
    n = int(seconds * RATE)
    freq = np.fft.rfftfreq(n, 1 / RATE)
    drawn = rng.standard_normal(freq.size) + 1j * rng.standard_normal(freq.size)
    record = np.fft.irfft(np.where((freq > 1) & (freq < 15), drawn, 0), n)
    return np.asarray(record / record.std())


def at_rest(base: np.ndarray) -> np.ndarray:
    """Base acceleration (n,) that rises from zero and is over at three fifths of its time."""
    t = np.arange(base.size) / (0.6 * base.size)
    return np.asarray(base * np.where(t < 1, np.sin(np.pi * t) ** 2, 0.0))


def response(base: np.ndarray, factor: Callable[[float], float] = lambda t: 1.0, softening: float = 0.0) -> np.ndarray:
    """Absolute accelerations of both floors, (2, n_samples), by Runge and Kutta's fourth order from rest.

    Springs are multiplied by factor(t); the force of the lowest is ``k d / sqrt(1 + softening d²)``.
    """
    h, n = 1 / RATE / STEPS, base.size
    u = CubicSpline(np.arange(n), base)(np.arange(2 * STEPS * (n - 1) + 1) / (2 * STEPS)).tolist()
    (m1, m2), (k1, k2), (c1, c2) = MASSES.tolist(), SPRINGS.tolist(), DAMPERS.tolist()

    def rates(state: State, moved: float, t: float) -> State:  # of plain numbers, which take a tenth of arrays' time
        x1, x2, v1, v2 = state
        share = factor(t)
        f1 = share * k1 * x1 / math.sqrt(1 + softening * x1 * x1) + c1 * v1
        f2 = share * k2 * (x2 - x1) + c2 * (v2 - v1)
        return v1, v2, (f2 - f1) / m1 - moved, -f2 / m2 - moved

    def moved_by(state: State, size: float, slope: State) -> State:
        (p, q, v, w), (dp, dq, dv, dw) = state, slope
        return p + size * dp, q + size * dq, v + size * dv, w + size * dw

    state: State = (0.0, 0.0, 0.0, 0.0)
    out = np.empty((2, n))
    for i in range(n):
        out[:, i] = rates(state, u[2 * STEPS * i], i / RATE)[2:] + base[i]
        for j in range(2 * STEPS * i, min(2 * STEPS * (i + 1), 2 * STEPS * (n - 1)), 2):
            t = j * h / 2
            a = rates(state, u[j], t)
            b = rates(moved_by(state, h / 2, a), u[j + 1], t + h / 2)
            c = rates(moved_by(state, h / 2, b), u[j + 1], t + h / 2)
            d = rates(moved_by(state, h, c), u[j + 2], t + h)
            whole = [one + 2 * two + 2 * three + four for one, two, three, four in zip(a, b, c, d, strict=True)]
            state = moved_by(state, h / 6, (whole[0], whole[1], whole[2], whole[3]))
    return out


def of_lines(structure: sysid.Structure, base: np.ndarray) -> np.ndarray:
    """Absolute accelerations of a linear structure, (n_sensors, n), under periodic base motion (d, n), line by line."""
    freq = np.fft.rfftfreq(base.shape[1], 1 / RATE)
    H = np.repeat(structure.rigid_body[:, :, None], freq.size, axis=2).astype(complex)
    H[..., 1:] += structure.relative_acceleration(freq[1:])
    return np.asarray(np.fft.irfft(np.einsum("sdf,df->sf", H, np.fft.rfft(base)), base.shape[1]))


def tuned_mass(share: float = 0.001) -> sysid.Structure:
    """The two storeys with a tuned mass of this share of the second one's on it: two close modes of one shape."""
    (k1, k2), m = SPRINGS, share * MASSES[1]
    tuned = m * (2 * np.pi * frequencies(SPRINGS)[0]) ** 2
    K = np.array([[k1 + k2, -k2, 0, -k1], [-k2, k2 + tuned, -tuned, 0], [0, -tuned, tuned, 0], [-k1, 0, 0, k1]])
    return sysid.Structure(np.diag([*MASSES, m, 0.0]), K, np.array([0.01, 0.01, 0.015]), n_base=1)


def noisy(
    rng: np.random.Generator, base: np.ndarray, floors: np.ndarray, share: float = 0.02
) -> tuple[np.ndarray, np.ndarray]:
    """Records of base (1, n) and floors (2, n) with white noise of a share of the base's rms."""
    std = share * base.std()
    return base[None] + std * rng.standard_normal((1, base.size)), floors + std * rng.standard_normal(floors.shape)


def measured(*runs: tuple[np.ndarray, np.ndarray], estimator: str = "records") -> sysid.Measurement:
    """A test of these records."""
    sensors = [sysid.Sensor(f"floor {i}", (0.0, 0.0, float(i)), "x") for i in (1, 2)]
    given = [(base, floors, None) for base, floors in runs]
    return sysid.Measurement.from_time(given, RATE, sensors=sensors, band=BAND, estimator=estimator)
