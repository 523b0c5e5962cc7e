r"""Tests of continuous structures from the sum over all their modes: spectra, and records in time that start at rest.

.. math:: a = G u_0'' + \sum_k \phi_k g_k \gamma_k u_0'', \qquad
    f_0 = M_{rb} u_0'' + \sum_k \gamma_k' g_k \gamma_k u_0'', \qquad
    g_k = \frac{w^2}{w_k^2 - w^2 + 2 i \zeta_k w_k w}

The motion of a record is a sum of cosines that are no lines of it, none above 1.2 times the last line, raised from zero
by half a cosine, and cut in motion. Cosines so raised are sums of cosines again: each mode is known in closed form
(steady state and free vibration), before the end of the rise and after it, and nothing folds back at the sample rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import sysid
from benchmarks.band.structures import RECORDS, Continuous, log_uniform
from benchmarks.records.simulated import Modes, Motion, Records, Run, random_motion, with_noise

SPREAD_LINES, PEAK_LINES = 30, 13  # lines of spectra a mode: over all frequencies, and about its peak
PEAK = 4.0  # half widths: up to there on either side
CROSS = 0.2  # motion of the other base axes over that of the one that is driven, in spectra
PERIODS = (40, 80)  # of the first mode, in a record
RATE = 3.2  # samples a period of the last line
ABOVE = 1.2  # of the last line: up to there the base of records moves
RISE = 0.05  # of the record's duration


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw of a test, and what its Cramér-Rao bound needs.

    Attributes
    ----------
    measurement : sysid.Measurement
        As a laboratory hands it over, with noise.
    omega : (lines,)
        rad/s.
    base : (runs, d, lines), complex
        Spectra of the true base acceleration.
    ends : (runs, n, 2)
        (alpha, beta) of every mode: ``alpha + i w beta`` is added to ``w² gamma_k u_0''``; zero for spectra.
    own_std : (runs, n_sensors + d)
        Of the complex noise of a line of each response and force.
    base_std : (d,)
        Of the base; zero for spectra.
    """

    measurement: sysid.Measurement
    omega: np.ndarray
    base: np.ndarray
    ends: np.ndarray
    own_std: np.ndarray
    base_std: np.ndarray


def draw(structure: Continuous, number: int = 0) -> Draw:
    """Test a structure; another number gives other motion and noise."""
    rng = np.random.default_rng((number, structure.count, 11))
    return (of_records if structure.kind == RECORDS else of_spectra)(structure, rng)


def transfer(modes: Modes, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Absolute accelerations (n_sensors, d, lines) and forces (d, d, lines) for unit base accelerations."""
    w = np.asarray(omega)
    g = w**2 / (modes.omega[:, None] ** 2 - w**2 + 2j * (modes.zeta * modes.omega)[:, None] * w)
    H = np.einsum("sk,kf,kd->sdf", modes.shapes, g, modes.gamma, optimize=True) + modes.rigid_body[..., None]
    Z = np.einsum("ke,kf,kd->edf", modes.gamma, g, modes.gamma, optimize=True) + modes.rigid_body_mass[..., None]
    return H, Z


def of_spectra(structure: Continuous, rng: np.random.Generator) -> Draw:
    """Draw stepped sines, one run a base axis, closer lines about the peaks; noise on responses and forces."""
    modes, (low, high), m = structure.modes, structure.lines, structure.count
    widths = modes.zeta[:m, None] * np.tan(np.linspace(-1, 1, PEAK_LINES) * np.arctan(PEAK))
    lines = np.concatenate([
        np.geomspace(low, high, SPREAD_LINES * m), (structure.frequencies[:m, None] * (1 + widths)).ravel(),
    ])  # fmt: skip
    freq = np.unique(lines[(lines >= low) & (lines <= high)])
    d = len(structure.base)
    cross = CROSS * (rng.uniform(-1, 1, (d, d)) + 1j * rng.uniform(-1, 1, (d, d)))
    base = np.where(np.eye(d, dtype=bool), 1.0, cross)[..., None] * np.ones(freq.size)
    H, Z = transfer(modes, 2 * np.pi * freq)
    clean = np.einsum("cdf,rdf->rcf", np.concatenate([H, Z]), base)
    std = structure.noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=-1, keepdims=True))
    parts = rng.standard_normal((2, *clean.shape)) / np.sqrt(2)
    noisy = clean + std * (parts[0] + 1j * parts[1])
    n = len(modes.shapes)
    measurement = sysid.Measurement(
        freq, base, noisy[:, :n], rigid_body=modes.rigid_body, force=noisy[:, n:], response_std=std[:, :n],
        force_std=std[:, n:], base_axes=structure.base,
    )  # fmt: skip
    ends = np.zeros((d, modes.omega.size, 2))
    return Draw(measurement, 2 * np.pi * freq, base, ends, std[..., 0], np.zeros(d))


def of_records(structure: Continuous, rng: np.random.Generator) -> Draw:
    """Draw one run of random motion along all base axes; noise on all channels, the base included."""
    f, (_, high) = structure.frequencies, structure.lines
    rate, duration = RATE * high, float(log_uniform(rng, PERIODS)) / f[0]
    band = (0.9 * structure.lines[0], ABOVE * high)
    motion = random_motion(rng, duration, rate, band, correlation=np.eye(len(structure.base)))
    run = FromRest.of(structure.modes, motion)
    clean = run.records()
    noisy, levels = with_noise(clean, rng, structure.noise)
    measurement = sysid.Measurement.from_time(
        [(noisy.base, noisy.response, noisy.force)], rate, rigid_body=structure.modes.rigid_body,
        band=structure.lines, base_axes=structure.base,
    )  # fmt: skip
    lines = np.rint(measurement.freq * motion.samples / rate).astype(int)
    q, v = run.at_end()
    w, zeta = structure.modes.omega, structure.modes.zeta
    ends = rate * np.column_stack([w**2 * v, w**2 * q + 2 * zeta * w * v])  # it starts from rest
    root = np.sqrt(motion.samples)  # of a Fourier transform without a factor
    return Draw(
        measurement, 2 * np.pi * measurement.freq, np.fft.rfft(clean.base)[None, :, lines], ends[None],
        root * np.concatenate([levels.response, levels.force])[None], root * levels.base,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FromRest:
    """A structure at rest whose base begins to move.

    Attributes
    ----------
    rising, moving : Run
        Until the end of the rise, and from the first sample after it.
    samples : int
        Of the first.
    """

    rising: Run
    moving: Run
    samples: int

    @classmethod
    def of(cls, modes: Modes, motion: Motion) -> FromRest:
        """Raise a motion from zero by ``(1 - cos(k w_1 t))/2``, w_1 that of its period, until its half period."""
        k = round(motion.period / (2 * RISE * motion.samples))
        A = motion.amplitudes
        assert not np.any(A[:, :k])  # else differences of frequencies would be negative
        assert not np.any(A[:, A.shape[1] - k :])
        raised = replace(motion, amplitudes=A / 2 - (np.roll(A, k, axis=1) + np.roll(A, -k, axis=1)) / 4)
        end = motion.period / (2 * k * motion.sample_rate)
        samples = int(np.ceil(end * motion.sample_rate))
        rising = _going_on(modes, replace(raised, samples=samples), np.zeros((2, modes.omega.size)))
        risen = _going_on(modes, _later(motion, end), np.array(rising.state(end)))
        first = samples / motion.sample_rate
        rest = replace(_later(motion, first), samples=motion.samples - samples)
        return cls(rising, _going_on(modes, rest, np.array(risen.state(first - end))), samples)

    def records(self) -> Records:
        """Both parts, one after the other."""
        parts = self.rising.records(), self.moving.records()
        joined = {name: np.hstack([getattr(part, name) for part in parts]) for name in ("base", "response", "force")}
        return Records(**joined, sample_rate=self.moving.motion.sample_rate)

    def at_end(self) -> tuple[np.ndarray, np.ndarray]:
        """Modal displacements and velocities one sample after the last."""
        motion = self.moving.motion
        return self.moving.state(motion.samples / motion.sample_rate)


def _later(motion: Motion, time: float) -> Motion:
    """The same motion, seen from a later time, s."""
    return replace(motion, amplitudes=motion.amplitudes * np.exp(1j * motion.omega * time))


def _going_on(modes: Modes, motion: Motion, state: np.ndarray) -> Run:
    """A run whose modal displacements and velocities, (2, n), at its first sample are those of `state`."""
    steady = Run(modes, motion, np.zeros(modes.omega.size, dtype=complex))
    q, v = state - np.array(steady.state(0.0))
    poles = modes.poles  # Re(c) = q, Re(pole c) = v
    return replace(steady, free=q + 1j * (poles.real * q - v) / poles.imag)
