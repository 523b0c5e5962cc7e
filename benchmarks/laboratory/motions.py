r"""Motions of a base, and what all channels of a test then do, in closed form.

Every history of a base is made the sum of cosines of a period longer than the record, so that it is cut in motion. A
structure then moves by as many cosines, line by line

.. math:: (\Omega^2 - w^2 + i w \Phi' C \Phi) q = -\Gamma u_0''

and nothing folds back at the sample rate, as no cosine is above half of it.
"""

from __future__ import annotations

from math import gcd

import numpy as np

from benchmarks.laboratory.rigs import Rig
from benchmarks.records.simulated import Motion

CHUNK = 500  # lines at a time


def motion_of(history: np.ndarray, rate: float, longer: float = 1.4) -> Motion:
    """The motion whose first samples are a history (d, n), which then fades from its end to its beginning."""
    n = history.shape[1]
    period = int(np.ceil(longer * n))
    while gcd(period, n) > 1:
        period += 1
    share = np.linspace(0, 1, period - n + 2)[1:-1]
    fade = (1 + np.cos(np.pi * share)) / 2
    bridge = history[:, -1:] * fade * np.exp(-5 * share) + history[:, :1] * (1 - fade) * np.exp(-5 * (1 - share))
    amplitudes = np.fft.rfft(np.hstack([history, bridge]), axis=1) * 2 / period
    amplitudes[:, 0] = 0
    return Motion(amplitudes, period, n, rate)


def sweep(rate: float, band: tuple[float, float], octaves: float, notches: np.ndarray, depth: float) -> np.ndarray:
    """A sine swept up at so many octaves a minute, held down to `depth` about some frequencies, Hz, (1, n)."""
    low, high = band
    growth = np.log(2) * octaves / 60
    time = np.arange(int(np.log(high / low) / growth * rate)) / rate
    f = low * np.exp(growth * time)
    level = 1 + 0.1 * np.sin(2 * np.pi * 3 * time / time[-1])
    for notch in notches:
        level *= 1 - (1 - depth) * np.exp(-0.5 * (np.log(f / notch) / 0.08) ** 2)
    level *= np.minimum(1, np.minimum(time, time[-1] - time) / 0.5)
    return np.asarray(level * np.sin(2 * np.pi * (f - low) / growth))[None]


def earthquake(rng: np.random.Generator, rate: float, seconds: float, band: tuple[float, float]) -> np.ndarray:
    """A ground acceleration after Kanai and Tajimi that rises, and dies away; (1, n).

    Kanai, Bull. Earthquake Res. Inst. 35 (1957) 309-325, with a ground of 0.6 of critical damping.
    """
    n = int(seconds * rate)
    freq, time = np.fft.rfftfreq(n, 1 / rate), np.arange(n) / n
    ratio = freq / (0.3 * band[1])
    size = np.sqrt((1 + (1.2 * ratio) ** 2) / ((1 - ratio**2) ** 2 + (1.2 * ratio) ** 2))
    drawn = rng.standard_normal((2, freq.size))
    spectrum = np.where((freq > band[0]) & (freq < band[1]), size, 0.0) * (drawn[0] + 1j * drawn[1])
    envelope = np.minimum(time / 0.1, 1) ** 2 * np.exp(-5 * np.maximum(time - 0.25, 0))
    return np.asarray(np.fft.irfft(spectrum, n) * envelope)[None]


def transfer(rig: Rig, omega: np.ndarray) -> np.ndarray:
    """Absolute accelerations of sensors, then forces of the base, for unit base accelerations, (n + d, d, lines)."""
    modes = rig.modes
    rows = np.vstack([modes.shapes, modes.gamma.T])
    rigid = np.vstack([modes.rigid_body, modes.rigid_body_mass])
    parts = []
    for w in np.array_split(omega, max(omega.size // CHUNK, 1)):
        dynamic = np.diag(modes.omega**2) + 1j * w[:, None, None] * rig.loss
        dynamic[:, range(modes.omega.size), range(modes.omega.size)] -= w[:, None] ** 2
        q = np.linalg.solve(dynamic, np.broadcast_to(modes.gamma.astype(complex), (w.size, *modes.gamma.shape)))
        parts.append(np.einsum("ck,fkd->cdf", rows, w[:, None, None] ** 2 * q))
    return np.concatenate(parts, axis=2) + rigid[:, :, None]


def channels(rig: Rig, motion: Motion, late: np.ndarray) -> np.ndarray:
    """Records of base, sensors and forces, (d + n + d, samples), each later by `late`, s."""
    moved = np.flatnonzero(np.any(motion.amplitudes, axis=0))
    base = motion.amplitudes[:, moved]
    outputs = np.einsum("cdf,df->cf", transfer(rig, motion.omega[moved]), base)
    amplitudes = np.zeros((len(late), motion.amplitudes.shape[1]), complex)
    amplitudes[:, moved] = np.vstack([base, outputs]) * np.exp(-1j * np.outer(late, motion.omega[moved]))
    return motion.in_time(amplitudes)
