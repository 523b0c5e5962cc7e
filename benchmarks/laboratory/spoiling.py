"""Errors of a laboratory's channels: gains, clocks, noise, hum, drift and steps of a recorder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GAIN = 0.005  # standard deviation
NOISE, HUM, DRIFT = 0.003, 0.002, 0.01  # of each channel's rms
MAINS = 50.0  # Hz
BITS = 16
RANGE = (1.2, 4.0)  # of the recorder, over the largest value
LATE = 0.4  # samples, at most, of the channels of a second module


@dataclass(frozen=True, eq=False)
class Spoiled:
    """Errors of the channels of one test, the same in all of its runs.

    Attributes
    ----------
    gain : (channels,)
    late : (channels,)
        s.
    """

    gain: np.ndarray
    late: np.ndarray

    @classmethod
    def of(cls, rng: np.random.Generator, count: int, second: slice, rate: float) -> Spoiled:
        """Draw those of so many channels, of which some are on a `second` module with a clock of its own."""
        late = np.zeros(count)
        late[second] = rng.uniform(-LATE, LATE) / rate
        return cls(1 + GAIN * rng.standard_normal(count), late)

    def recorded(self, rows: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
        """Records (channels, n), which are late already, as they stand in a file."""
        n, time = rows.shape[1], np.arange(rows.shape[1]) / rate
        rows = rows * self.gain[:, None]
        size = np.sqrt(np.mean(rows**2, axis=1, keepdims=True))
        turns, phase, other = rng.uniform(0, 1, (3, len(rows), 1))
        rows = rows + size * NOISE * rng.standard_normal(rows.shape)
        if rate > 2 * MAINS:  # else the filter before the recorder takes it
            rows += size * HUM * np.sin(2 * np.pi * (MAINS * time + phase))
        rows += size * DRIFT * np.sin(2 * np.pi * ((0.5 + 1.5 * turns) * time * rate / n + other))
        return stepped(rows, rng)


def stepped(rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Records in the steps of a recorder whose range holds each of them."""
    step = np.abs(rows).max(axis=1, keepdims=True) * rng.uniform(*RANGE) / 2 ** (BITS - 1)
    return np.asarray(step * np.round(rows / step))
