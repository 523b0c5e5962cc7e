"""Weights of a fit: stated standard deviations as one factor a channel times one a line of each run."""

from __future__ import annotations

import numpy as np

from sysid.structure.structure import Array

_LEAST = 1e-6  # of the median standard deviation: no sample may count for more than this allows


def separable(std: Array | None, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Weights 1/std as a product: of the channels (channels,) and of the lines of each run (runs, n_freq).

    The geometric means over the other axes: exact where the noise is a channel's times a line's, as it is where
    one number, one number a channel or one spectrum is stated. Fits with other weights than 1/std are
    unbiased all the same, and their covariance is computed with the stated noise.

    Parameters
    ----------
    std : (runs, channels, n_freq) or None
        Ones are returned where nothing is stated.
    shape : (runs, channels, n_freq)
    """
    runs, channels, lines = shape
    if std is None or not np.any(std > 0):
        return np.ones(channels), np.ones((runs, lines))
    weight = -np.log(np.maximum(std, _LEAST * np.median(std[std > 0])))
    channel = weight.mean(axis=(0, 2))
    return np.exp(channel), np.exp((weight - channel[:, None]).mean(axis=1))
