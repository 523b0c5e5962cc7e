"""Simulated storeys whose stiffness or damping follows the motion, integrated by SciPy, never by the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg
import scipy.signal
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import sysid

Array = NDArray[np.floating[Any]]
Kind = Literal["linear", "law", "duffing", "friction"]
RATE, BAND = 50.0, (0.5, 18.0)  # Hz
FALL, RISE = 0.06, 0.012  # of a stated law, at the level AT, m/s²
AT = 12.0


@dataclass(frozen=True)
class Storeys:
    """A chain of storeys on a base that moves, with one effect that is not linear.

    `stiffness` (n,) of each storey, N/m, and masses (n,), kg; `ratios` (n,) of the modes at rest; `size` is of the
    effect, which is the storeys' cubic stiffness, 1/m², or the friction of each, N.
    """

    kind: Kind
    mass: Array
    stiffness: Array
    ratios: Array
    size: float

    @property
    def K(self) -> Array:  # noqa: N802
        """Stiffness matrix, (n, n)."""
        k = self.stiffness
        return np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)

    @property
    def modes(self) -> tuple[Array, Array]:
        """Circular frequencies (n,) and mass-normalised shapes (n, n)."""
        lam, phi = scipy.linalg.eigh(self.K, np.diag(self.mass))
        return np.sqrt(lam), phi

    def under(self, base: Array) -> Array:
        """Absolute accelerations (n, N) under a base acceleration (N,), from rest."""
        fine = scipy.signal.resample(base, 8 * base.size)
        t, u = np.arange(base.size) / RATE, CubicSpline(np.arange(fine.size) / (8 * RATE), fine)
        slope = self._modal_slope() if self.kind == "law" else self._slope()
        n = self.mass.size
        motion = solve_ivp(
            lambda at, y: slope(y, float(u(at))), (0, t[-1]), np.zeros(2 * n), t_eval=t, rtol=1e-9, atol=1e-11,
            max_step=1 / RATE,
        )  # fmt: skip
        relative = np.array([slope(y, now)[n:] for y, now in zip(motion.y.T, base, strict=True)]).T
        return (self.modes[1] @ relative if self.kind == "law" else relative) + base

    def _slope(self) -> Callable[[Array, float], Array]:
        (w, phi), M = self.modes, np.diag(self.mass)
        C, n = M @ phi @ np.diag(2 * self.ratios * w) @ phi.T @ M, self.mass.size

        def storeys(drift: Array, speed: Array) -> Array:
            force = self.stiffness * drift
            if self.kind == "duffing":
                force = force + self.size * self.stiffness * drift**3
            if self.kind == "friction":
                force = force + self.size * np.tanh(speed / 2e-3)
            return force

        def slope(y: Array, u: float) -> Array:
            x, v = y[:n], y[n:]
            force = storeys(np.diff(x, prepend=0.0), np.diff(v, prepend=0.0))
            return np.append(v, -u - (C @ v + force - np.append(force[1:], 0.0)) / self.mass)

        return slope

    def _modal_slope(self) -> Callable[[Array, float], Array]:
        w, phi = self.modes
        load, n, size = phi.T @ self.mass, self.mass.size, np.abs(phi[:, 0]).max()

        def slope(y: Array, u: float) -> Array:
            q, v, now, zeta, level = y[:n], y[n:], w.copy(), self.ratios.copy(), 0.0
            for _ in range(12):
                level = size * now[0] * np.hypot(now[0] * q[0], v[0]) / AT
                now[0] = w[0] * (1 - FALL * np.sqrt(level))
            zeta[0] += RISE * level
            return np.append(v, -2 * zeta * now * v - now**2 * q - load * u)

        return slope


def storeys(kind: Kind, rng: np.random.Generator, n: int) -> Storeys:
    """Storeys drawn about equal ones, the first mode at 3 Hz."""
    mass, stiffness, ratios = rng.uniform(0.8, 1.2, n), rng.uniform(0.8, 1.2, n), rng.uniform(0.008, 0.02, n)
    first = Storeys(kind, mass, stiffness, ratios, 0.0)
    stiffness = stiffness * (2 * np.pi * 3.0 / first.modes[0][0]) ** 2
    return Storeys(kind, mass, stiffness, ratios, {"duffing": -2000.0, "friction": 0.05}.get(kind, 0.0))


def shaken(level: float, seconds: float, rng: np.random.Generator) -> Array:
    """A random base acceleration in the band, of an rms level, m/s², that begins and ends softly."""
    samples = int(seconds * RATE)
    spectrum, freq = np.fft.rfft(rng.standard_normal(samples)), np.fft.rfftfreq(samples, 1 / RATE)
    spectrum[(freq < BAND[0]) | (freq > BAND[1])] = 0.0
    base, t = np.fft.irfft(spectrum, samples), np.arange(samples) / RATE
    return level * base / base.std() * np.clip(np.minimum(t, t[-1] - t) / 2, 0.0, 1.0)


def recorded(runs: list[tuple[Array, Array]], noise: float, rng: np.random.Generator) -> sysid.Measurement:
    """The test of some runs of base and response, with noise of this share of each channel's rms."""

    def noisy(x: Array) -> Array:
        return x + noise * x.std(axis=-1, keepdims=True) * rng.standard_normal(x.shape)

    n = len(runs[0][1])
    return sysid.Measurement.from_time(
        [(noisy(base[None]), noisy(response), None) for base, response in runs], RATE,
        rigid_body=np.ones((n, 1)), band=BAND,
        sensors=[sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, float(i)), "x") for i in range(n)],
    )  # fmt: skip
