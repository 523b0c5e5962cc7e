"""Scores of predicted records in time against measured ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array
from sysid.structure.structure import Array


@dataclass(frozen=True, eq=False)
class TimeScores:
    """Scores of each channel.

    Attributes
    ----------
    error : (n_channels,)
        ``‖predicted - measured‖ / ‖measured‖``; NaN where nothing was measured.
    correlation : (n_channels,)
        Of the two records about their means, -1 to 1; NaN where one does not move.
    measured_peaks, predicted_peaks : (n_channels,)
        Largest magnitudes, in the unit of the records.
    """

    error: Array
    correlation: Array
    measured_peaks: Array
    predicted_peaks: Array


def time_scores(measured: ArrayLike, predicted: ArrayLike) -> TimeScores:
    """Compare predicted records with measured ones, channel by channel.

    Parameters
    ----------
    measured, predicted : array_like, shape (n_channels, n_samples)
        Such as absolute accelerations, the second from `Structure.simulate`; of any length. One channel may be given
        without its axis.

    Returns
    -------
    TimeScores

    Raises
    ------
    InputError
        Where the shapes differ, or there is no sample.

    Notes
    -----
    Absolute accelerations of a stiff structure are near those of the base whatever the model: subtract the rigid-body
    motion ``G base`` from both to judge the structure alone.

    Examples
    --------
    >>> scores = time_scores([[0.0, 2.0, 0.0, -2.0]], [[0.0, 1.0, 0.0, -1.0]])
    >>> float(scores.error[0]), round(float(scores.correlation[0]), 6), float(scores.predicted_peaks[0])
    (0.5, 1.0, 1.0)
    """
    records = [np.atleast_2d(finite_array("measured", measured)), np.atleast_2d(finite_array("predicted", predicted))]
    a, b = records
    if a.shape != b.shape or a.ndim != 2 or a.size == 0:
        raise InputError(
            f"measured is {a.shape} and predicted {b.shape}; both must be (n_channels, n_samples), not empty"
        )
    moving, following = (record - record.mean(axis=1, keepdims=True) for record in records)
    product = np.linalg.norm(moving, axis=1) * np.linalg.norm(following, axis=1)
    return TimeScores(
        error=_ratio(np.linalg.norm(b - a, axis=1), np.linalg.norm(a, axis=1)),
        correlation=_ratio(np.einsum("ci,ci->c", moving, following), product),
        measured_peaks=np.abs(a).max(axis=1),
        predicted_peaks=np.abs(b).max(axis=1),
    )


def _ratio(numerator: Array, denominator: Array) -> Array:
    """Quotients; NaN where the denominator is zero."""
    return np.divide(numerator, denominator, out=np.full_like(denominator, np.nan), where=denominator > 0)
