"""Weights of a fit from stated standard deviations: a factor for each channel times one for each line of each run."""

from __future__ import annotations

import numpy as np

from sysid.structure.structure import Array

_LEAST = 1e-6  # of the median standard deviation; smaller ones are raised to it, so that no sample dominates


def separable(std: Array | None, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Weights 1/std as a product: of the channels (channels,) and of the lines of each run (runs, n_freq).

    They are geometric means over the other axes: exact where the noise is a product of the two, as it is where
    one number, one number for each channel or one spectrum is stated. Fits with other weights than 1/std are
    unbiased all the same, and their covariance is computed with the stated noise.

    Parameters
    ----------
    std : (runs, channels, n_freq) or None
        Ones are returned where nothing is stated.
    shape : (runs, channels, n_freq)
    """
    runs, channels, lines = shape
    floored = raised(std)
    if floored is None:
        return np.ones(channels), np.ones((runs, lines))
    weight = -np.log(floored)
    channel = weight.mean(axis=(0, 2))
    return np.exp(channel), np.exp((weight - channel[:, None]).mean(axis=1))


def raised(std: Array | None) -> Array | None:
    """Stated deviations as fits weigh by them, the smallest raised; None where none is stated, or none above zero."""
    if std is None or not np.any(std > 0):
        return None
    return np.maximum(std, _LEAST * np.median(std[std > 0]))
