"""Tests whose files hold functions of frequency: blocks of an analyser, and dwells of a stepped sine."""

from __future__ import annotations

import numpy as np
import scipy.signal

from benchmarks.laboratory.motions import channels, transfer
from benchmarks.laboratory.rigs import Rig
from benchmarks.laboratory.spoiling import Spoiled
from benchmarks.records.simulated import random_motion

BLOCK, LINES, AVERAGES = 2048, 801, 40
SETTLED = 0.003  # what is left of a mode's free vibration where a dwell is read
CYCLES, SHORTEST = 20, 0.5  # of a dwell that are read, s at least
SPREAD, PEAK, WIDTHS = 25, 11, 4.0  # lines a mode, about its peak, within so many half widths
READ = 0.003  # errors of an amplitude that a controller reads, over it


def analysed(rig: Rig, spoiled: Spoiled, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines, Hz, H1 per acceleration of the base, and coherences, of 40 blocks under Hann's window that do not overlap.

    The base moves at all lines that are written, which end where the rig's do.
    """
    rate = 2.56 * rig.end
    motion = random_motion(rng, BLOCK * AVERAGES / rate, rate, (0.5 * rate / BLOCK, 1.2 * rig.end))
    rows = spoiled.recorded(channels(rig, motion, spoiled.late / rate), rate, rng)
    window = scipy.signal.get_window("hann", BLOCK)
    blocks = rows[:, : BLOCK * AVERAGES].reshape(len(rows), AVERAGES, BLOCK)
    spectra = np.fft.rfft(window * (blocks - blocks.mean(axis=2, keepdims=True)), axis=2)[:, :, :LINES]
    base, outputs = spectra[0], spectra[1:]
    own = np.mean(np.abs(base) ** 2, axis=0)
    H1 = np.mean(outputs * base.conj(), axis=1) / own
    coherence = np.abs(H1) ** 2 * own / np.mean(np.abs(outputs) ** 2, axis=1)
    return np.arange(LINES) * rate / BLOCK, H1, coherence


def lines_of_dwells(rig: Rig) -> np.ndarray:
    """Uneven lines, Hz, closer about the peaks."""
    f, zeta = rig.frequencies[: rig.count, None], rig.modes.zeta[: rig.count, None]
    peaks = f * (1 + zeta * np.tan(np.linspace(-1, 1, PEAK) * np.arctan(WIDTHS)))
    return np.unique(np.concatenate([np.geomspace(rig.start, rig.end, SPREAD * rig.count), peaks.ravel()]))


def dwelled(rig: Rig, freq: np.ndarray, size: float, spoiled: Spoiled, rng: np.random.Generator) -> np.ndarray:
    """Amplitudes (channels, lines) that a controller reads of a base moved by `size`, m/s², at one line after another.

    A mode goes on from where the dwell before left it, until what is left of that is small; each dwell is read by the
    sine that fits it best in least squares.
    """
    modes, rate = rig.modes, 8 * rig.end
    poles = modes.omega * (-modes.zeta + 1j * np.sqrt(1 - modes.zeta**2))
    wait = -np.log(SETTLED) / np.min(modes.zeta[: rig.count] * modes.omega[: rig.count])
    answer = np.vstack([np.ones((1, freq.size)), transfer(rig, 2 * np.pi * freq)[:, 0]])
    answer = answer * np.exp(-2j * np.pi * np.outer(spoiled.late, freq))
    rows = np.vstack([0 * modes.gamma.T, modes.shapes, modes.gamma.T])
    free, q, v, parts = np.zeros(poles.size, complex), np.zeros(poles.size), np.zeros(poles.size), []
    for at, f in enumerate(freq):
        w = 2 * np.pi * f
        steady = -size * modes.gamma[:, 0] / (modes.omega**2 - w**2 + 2j * modes.zeta * modes.omega * w)
        x, y = q - steady.real, v - (1j * w * steady).real
        free = x + 1j * (poles.real * x - y) / poles.imag  # Re(c) = x, Re(pole c) = y
        time = wait + np.arange(round(max(CYCLES / f, SHORTEST) * rate)) / rate
        parts.append(size * (answer[:, [at]] * np.exp(1j * w * time)).real
                     + rows @ ((free * poles**2)[:, None] * np.exp(np.outer(poles, time))).real)  # fmt: skip
        end = time[-1] + 1 / rate
        turned, fallen = steady * np.exp(1j * w * end), free * np.exp(poles * end)
        q, v = (turned + fallen).real, (1j * w * turned + poles * fallen).real
    records = spoiled.recorded(np.hstack(parts), rate, rng)
    at, read = 0, np.empty((len(records), freq.size), complex)
    for line, (f, part) in enumerate(zip(freq, parts, strict=True)):
        time = wait + np.arange(part.shape[1]) / rate
        basis = np.array([np.cos(2 * np.pi * f * time), -np.sin(2 * np.pi * f * time), np.ones(time.size)]).T
        cosine, sine, _ = np.linalg.lstsq(basis, records[:, at : at + time.size].T, rcond=None)[0]
        read[:, line], at = cosine + 1j * sine, at + time.size
    return read * (1 + READ * (rng.standard_normal((2, *read.shape)) * [[[1]], [[1j]]]).sum(axis=0) / np.sqrt(2))
