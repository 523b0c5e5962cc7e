"""Simulated stepped sines, whose errors grow with the signal: of frames, by their matrices line by line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid import Measurement

Array = NDArray[np.float64]

KINDS = ("white", "stepped", "two levels", "dashpot")


@dataclass(frozen=True)
class Truth:
    """A frame: mass, damping and stiffness matrices (n, n), kg, N s/m, N/m."""

    mass: Array
    damping: Array
    stiffness: Array

    @property
    def poles(self) -> tuple[Array, Array]:
        """Natural frequencies, Hz, and damping ratios by the diagonal of modal damping, (n,) each, ascending."""
        lam, phi = scipy.linalg.eigh(self.stiffness, self.mass)
        omega = np.sqrt(lam)
        return omega / (2 * np.pi), np.diag(phi.T @ self.damping @ phi) / (2 * omega)

    def answers(self, freq: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Absolute acceleration of the floors (n, L) and base force (L,) for unit base acceleration."""
        w, ones = 2 * np.pi * freq[:, None, None], np.ones(len(self.mass))
        dynamic = self.stiffness + 1j * w * self.damping - w**2 * self.mass
        relative = np.linalg.solve(dynamic, w**2 * (self.mass @ ones)[:, None])[..., 0].T
        return relative + 1, ones @ self.mass @ (relative + 1)


def frame(rng: np.random.Generator, *, dashpot: bool = False) -> Truth:
    """A shear frame of three or four floors, classically damped, or with one damper between its lowest floors."""
    n = int(rng.integers(3, 5))
    m, k = rng.uniform(2.0, 4.0, n), rng.uniform(0.8, 1.25, n) * 3 * (2 * np.pi * rng.uniform(8.0, 12.0)) ** 2
    mass, stiffness = np.diag(m), np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
    lam, phi = scipy.linalg.eigh(stiffness, mass)
    modal = mass @ phi
    damping = modal @ np.diag(2 * rng.uniform(0.008, 0.02, n) * np.sqrt(lam)) @ modal.T
    if dashpot:
        between = np.zeros(n)
        between[:2] = -1.0, 1.0
        damping = damping + rng.uniform(0.02, 0.04) * np.sqrt(k[0] * m[0]) * np.outer(between, between)
    return Truth(mass, damping, stiffness)


def uneven_lines(truth: Truth, rng: np.random.Generator) -> Array:
    """Dwells in geometric steps, and closer about the peaks, as a controller takes them, Hz."""
    f, zeta = truth.poles
    about = [f[i] * (1 + zeta[i] * np.linspace(-4, 4, 17)) for i in range(f.size)]
    lines = np.concatenate([np.geomspace(0.35 * f[0], 1.12 * f[-1], 120), *about])
    lines = np.sort(lines * (1 + rng.uniform(-2e-4, 2e-4, lines.size)))
    return lines[np.append(True, np.diff(lines) > 1e-4 * lines[1:])]


def spoiled(kind: str, seed: int, *, gains: float = 0.005) -> tuple[Truth, Measurement]:
    """A frame and a test of one of the `KINDS`.

    Of stepped sines each channel reads each line with an error of 0.4 % of its own, base and force too, and noise 1e-4
    of its rms; gains are off by `gains` of the signal.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    truth = frame(rng, dashpot=kind == "dashpot")
    n = len(truth.mass)
    white = kind == "white"
    freq = np.linspace(0.35 * truth.poles[0][0], 1.12 * truth.poles[0][-1], 700) if white else uneven_lines(truth, rng)
    levels = np.array([0.5, 2.0]) if kind == "two levels" else np.array([1.0])
    base = levels[:, None, None] * np.exp(2j * np.pi * rng.uniform(size=(levels.size, 1, freq.size)))
    H, Z = truth.answers(freq)
    clean = base * np.vstack([np.ones((1, freq.size)), H, Z])  # (runs, 1 + n + 1, L)
    noise = lambda: rng.standard_normal([*clean.shape, 2]) @ [1, 1j] / np.sqrt(2)  # noqa: E731
    rms = np.sqrt(np.mean(np.abs(clean) ** 2, axis=(0, 2)))[:, None]
    if white:
        records = clean + np.where(np.arange(n + 2)[:, None] == 0, 0.0, 0.01 * rms) * noise()
        tolerance = None
    else:
        factor = 1 + np.append(0.0, gains * rng.standard_normal(n + 1))[:, None]
        records = factor * clean * (1 + 0.004 * noise()) + 1e-4 * rms * noise()
        tolerance = gains or None
    return truth, Measurement(
        freq, records[:, :1], records[:, 1:-1], rigid_body=np.ones((n, 1)), force=records[:, -1:], base_axes=("x",),
        gain_std=tolerance, force_gain_std=tolerance,
    )  # fmt: skip
