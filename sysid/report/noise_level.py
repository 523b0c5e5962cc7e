"""The noise of records in a report: as it is known, or what it is at most."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.noise_multiples import noise_at_most
from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array, ComplexArray, Structure


class NoiseLevel(NamedTuple):
    """Standard deviations of accelerations and base force, (runs, channels, n_freq or 1); None where not known.

    `at_most`: not known, but no larger than what a fit leaves of the quietest lines.
    """

    response: Array | None
    force: Array | None
    at_most: bool

    @property
    def bound(self) -> str:
        """Sign that stands behind a figure of it."""
        return " at most" * self.at_most


def noise_of_test(test: Measurement, structure: Structure) -> NoiseLevel:
    """The noise of a test: stated, found with the fit, or a bound by what `structure` leaves of it."""
    if test.response_std is not None:
        return NoiseLevel(test.response_std, test.force_std, False)
    response = noise_at_most(test, test.relative - test.predict(structure))
    force = test.force_std
    if force is None and test.force is not None:
        force = noise_at_most(test, test.force - test.predict_force(structure))
    return NoiseLevel(response, force, True)


def share_of_noise(std: Array | None, records: ComplexArray) -> Array:
    """Noise over records, (channels,), as the residual measures them; NaN where it is not known.

    A run has no noise at the lines of others, where it holds zeros.
    """
    if std is None:
        return np.full(records.shape[1], np.nan)
    size = np.linalg.norm(records, axis=(0, 2))
    recorded = np.any(records != 0, axis=1, keepdims=True)
    noise = np.sqrt(np.sum(np.where(recorded, std, 0.0) ** 2 * np.ones(records.shape), axis=(0, 2)))
    return np.divide(noise, size, out=np.full_like(size, np.nan), where=size > 0)


def share_of_all_noise(std: Array | None, records: ComplexArray) -> float:
    """Noise over records, all channels together; zero where it is not known."""
    size = np.linalg.norm(records, axis=(0, 2))
    return float(np.sqrt(np.nansum((share_of_noise(std, records) * size) ** 2)) / np.linalg.norm(size))
