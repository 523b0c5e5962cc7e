"""Simulated storeys whose stiffness or damping follows the motion, integrated by SciPy, never by the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy.linalg
import scipy.signal
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import sysid

Array = NDArray[np.floating[Any]]
Kind = Literal["linear", "law", "duffing", "friction", "bilinear", "bouc-wen"]
RATE, BAND = 50.0, (0.5, 18.0)  # Hz
LEVELS = (0.3, 1.0, 3.0)  # m/s² rms of the base
YIELDING = {"bouc-wen": 1, "bilinear": 16}  # Bouc and Wen's exponent: large, the spring is elastic, then plastic
FALL, RISE = 0.06, 0.012  # of a stated law, at the level AT, m/s²
AT = 12.0


@dataclass(frozen=True)
class Storeys:
    """A chain of storeys on a base that moves, with one effect that is not linear.

    `stiffness` (n,) of each storey at rest, N/m, and masses (n,), kg; `ratios` (n,) of the modes at rest; `size` is of
    the effect: the storeys' cubic stiffness over their own, 1/m², friction over stiffness, m, or the drift at which a
    fifth of the stiffness yields, m.
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

    def drift(self, level: float) -> float:
        """The largest rms drift of a storey, m, without the effect, under a base of a level, m/s² rms, as `shaken`."""
        w, phi = self.modes
        omega = 2 * np.pi * np.linspace(*BAND, 4000)
        q = (phi.T @ self.mass)[:, None] / (w[:, None] ** 2 - omega**2 + 2j * (self.ratios * w)[:, None] * omega)
        return float(level * np.sqrt(np.mean(np.abs(np.diff(phi @ q, axis=0, prepend=0.0)) ** 2, axis=1).max()))

    def under(self, bases: Array, rate: float = RATE) -> Array:
        """Absolute accelerations (r, n, N) under base accelerations (r, N) of runs, from rest, all in one system."""
        fine = scipy.signal.resample(bases, 8 * bases.shape[1], axis=1)
        t, u = np.arange(bases.shape[1]) / rate, CubicSpline(np.arange(fine.shape[1]) / (8 * rate), fine, axis=1)
        slope = self._modal_slope() if self.kind == "law" else self._slope()
        n, r = self.mass.size, len(bases)
        shape = (2 * n + n * (self.kind in YIELDING), r)
        motion = solve_ivp(
            lambda at, y: slope(y.reshape(shape), u(at)).ravel(), (0, t[-1]), np.zeros(shape[0] * r), method="DOP853",
            t_eval=t, rtol=1e-9, atol=1e-11, max_step=1 / rate,
        )  # fmt: skip
        accelerations = [slope(y.reshape(shape), now)[n : 2 * n].T for y, now in zip(motion.y.T, bases.T, strict=True)]
        relative = np.stack(accelerations, axis=-1)
        return np.asarray((self.modes[1] @ relative if self.kind == "law" else relative) + bases[:, None])

    def steady(self, levels: Array, cycles: int = 200, steps: int = 80) -> tuple[Array, Array]:
        """Frequency, Hz, and damping ratio of the first mode at levels, (l,), m/s², as steady motion shows them.

        The level is that of the mode at the floor where its shape is largest. The base moves against the velocity of
        the mode, at constant strength, until the motion is steady: at resonance by its phase, which is stable also
        where a hardening mode has two motions under one sine. Runge-Kutta steps of fourth order.
        """
        (w, phi), n = self.modes, self.mass.size
        size, load = np.abs(phi[:, 0]).max(), float(phi[:, 0] @ self.mass)  # of either sign
        slope, h = self._modal_slope() if self.kind == "law" else self._slope(), 2 * np.pi / w[0] / steps
        row = np.eye(n)[0] if self.kind == "law" else phi[:, 0] * self.mass
        strength = 2 / (load * size) * np.geomspace(0.3 * levels.min() * 0.005, 3 * levels.max() * 0.1, 24)

        def driven(y: Array) -> tuple[Array, Array, Array]:
            q, v = row @ y[:n], row @ y[n : 2 * n]
            base = -strength * v / np.hypot(w[0] * q, v)
            return slope(y, base), q, base

        y = np.zeros((2 * n + n * (self.kind in YIELDING), strength.size))
        y[n : 2 * n] = 1e-3 * (phi[:, [0]] if self.kind != "law" else row[:, None])
        motion, bases = np.empty((2, cycles * steps, strength.size))
        with np.errstate(over="ignore", invalid="ignore"):  # a spring that softens may be driven over its top
            for i in range(cycles * steps):
                a, motion[i], bases[i] = driven(y)
                b = driven(y + h / 2 * a)[0]
                c = driven(y + h / 2 * b)[0]
                y = y + h / 6 * (a + 2 * b + 2 * c + driven(y + h * c)[0])
        held = np.all(np.isfinite(motion), axis=0)
        found = np.empty((3, np.count_nonzero(held)))
        t = h * np.arange(20 * steps)
        for k, (q, base) in enumerate(zip(motion[-t.size :, held].T, bases[-t.size :, held].T, strict=True)):
            up = np.flatnonzero((q[:-1] < 0) & (q[1:] >= 0))
            at = t[up] - h * q[up] / (q[up + 1] - q[up])
            omega = 2 * np.pi * (at.size - 1) / (at[-1] - at[0])
            whole = (t >= at[0]) & (t < at[-1])
            turn = np.exp(-1j * omega * t[whole])
            amplitude, moved = (2 * np.abs(np.mean(turn * one[whole])) for one in (q, base))
            found[:, k] = (
                size * omega**2 * amplitude,
                omega / (2 * np.pi),
                abs(load) * moved / (2 * omega**2 * amplitude),
            )
        order = np.argsort(found[0])
        level, f, zeta = found[:, order]
        return np.interp(np.log(levels), np.log(level), f), np.interp(np.log(levels), np.log(level), zeta)

    def _slope(self) -> Callable[[Array, Array], Array]:
        """Of displacements, velocities and, where springs yield, their drifts, all (n, r)."""
        (w, phi), M, n, k = self.modes, np.diag(self.mass), self.mass.size, self.stiffness[:, None]
        loss = phi @ np.diag(2 * self.ratios * w) @ phi.T @ M
        drifts = np.eye(n) - np.eye(n, k=-1)
        by_force, sharp = drifts.T / self.mass[:, None], YIELDING.get(self.kind, 0)

        def slope(y: Array, u: Array) -> Array:
            x, v = drifts @ y[:n], drifts @ y[n : 2 * n]
            force, slip = k * x, y[2 * n :]
            if self.kind == "duffing":
                force = force + self.size * k * x**3
            if self.kind == "friction":
                force = force + self.size * k * np.tanh(v / 2e-3)
            if sharp:
                force = k * (0.8 * x + 0.2 * slip)
                slip = v * (1 - np.minimum(np.abs(slip / self.size), 1.5) ** sharp * (v * slip > 0))
            return np.concatenate([y[n : 2 * n], -u - loss @ y[n : 2 * n] - by_force @ force, slip])

        return slope

    def _modal_slope(self) -> Callable[[Array, Array], Array]:
        w, phi = self.modes
        load, n, ratios = (phi.T @ self.mass)[:, None], self.mass.size, self.ratios[:, None]
        first, size = w[0], np.abs(phi[:, 0]).max()

        def slope(y: Array, u: Array) -> Array:
            q, v = y[:n], y[n:]
            now, zeta = np.repeat(w[:, None], u.size, axis=1), np.repeat(ratios, u.size, axis=1)
            at, level = now[0], np.zeros(u.size)
            for _ in range(7):  # each brings it nearer by a factor of thirty
                level = size * at * np.hypot(at * q[0], v[0]) / AT
                at = first * (1 - FALL * np.sqrt(level))
            now[0] = at
            zeta[0] += RISE * level
            return np.concatenate([v, -2 * zeta * now * v - now**2 * q - load * u])

        return slope


def storeys(kind: Kind, rng: np.random.Generator, n: int) -> Storeys:
    """Storeys drawn about equal ones, the first mode at 3 Hz."""
    mass, stiffness, ratios = rng.uniform(0.8, 1.2, n), rng.uniform(0.8, 1.2, n), rng.uniform(0.008, 0.02, n)
    first = Storeys(kind, mass, stiffness, ratios, 0.0)
    linear = replace(first, stiffness=stiffness * (2 * np.pi * 3.0 / first.modes[0][0]) ** 2)
    drift = linear.drift(LEVELS[-1])
    hard = rng.random() < 0.5
    sizes = {"duffing": (0.05 if hard else -0.015) / drift**2, "friction": 0.004 * drift}
    return replace(linear, size=sizes.get(kind, 0.7 * drift))


def shaken(level: float, seconds: float, rng: np.random.Generator, rate: float = RATE) -> Array:
    """A random base acceleration in the band, of an rms level, m/s², that begins and ends softly."""
    samples = int(seconds * rate)
    spectrum, freq = np.fft.rfft(rng.standard_normal(samples)), np.fft.rfftfreq(samples, 1 / rate)
    spectrum[(freq < BAND[0]) | (freq > BAND[1])] = 0.0
    base, t = np.fft.irfft(spectrum, samples), np.arange(samples) / rate
    return level * base / base.std() * np.clip(np.minimum(t, t[-1] - t) / 2, 0.0, 1.0)


def recorded(
    runs: list[tuple[Array, Array]], noise: float, rng: np.random.Generator, rate: float = RATE
) -> sysid.Measurement:
    """The test of some runs of base and response, with noise of this share of each channel's rms."""

    def noisy(x: Array) -> Array:
        return x + noise * x.std(axis=-1, keepdims=True) * rng.standard_normal(x.shape)

    n = len(runs[0][1])
    return sysid.Measurement.from_time(
        [(noisy(base[None]), noisy(response), None) for base, response in runs], rate,
        rigid_body=np.ones((n, 1)), band=BAND,
        sensors=[sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, float(i)), "x") for i in range(n)],
    )  # fmt: skip
