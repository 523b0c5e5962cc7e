"""Poles of whole records: noise of the base makes errors largest at the peaks, so that lines weigh by what they may hold.

Weights need no modes: the motion of a sensor over that of the base, smoothed over some lines, is what passes the noise
of the base on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array

_WIDTH = 5  # lines over which powers are smoothed


def rough_deviations(test: Measurement) -> Array:
    """Noise that each line of a response may hold where all channels have the same share of it, up to one factor.

    (runs, n_sensors, n_freq); the largest share of a direction's noise where there are several.
    """
    power = lambda record: np.abs(record) ** 2  # noqa: E731
    mean = lambda record: np.mean(power(record), axis=(0, 2))  # noqa: E731
    base, response = _smooth(power(test.base)), _smooth(power(test.response))
    gain = response / np.sum(base, axis=1, keepdims=True)
    own = mean(test.response)[:, None]
    return np.sqrt(own + gain * np.sum(mean(test.base)))


def weighed(test: Measurement) -> Measurement:
    """The test with such deviations in the place of stated ones."""
    return replace(test, response_std=rough_deviations(test))


def _smooth(power: Array) -> Array:
    """Means over neighbouring lines; fewer at the ends."""
    kernel = np.ones(_WIDTH)
    count = np.convolve(np.ones(power.shape[-1]), kernel, mode="same")
    flat = power.reshape(-1, power.shape[-1])
    return np.array([np.convolve(row, kernel, mode="same") / count for row in flat]).reshape(power.shape)
