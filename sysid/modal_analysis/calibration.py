"""Gains within their stated tolerances: what records and tolerances together make likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.errors import refuse
from sysid.measurement.channels import seen_at_sensors, tolerance_of, without_gains
from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array
from sysid.structure.thresholds import most_deviations


@dataclass(frozen=True, eq=False)
class Calibration:
    """Relative errors of the gains of sensors, base directions and force, (n_sensors + 2 d,), normally distributed.

    Attributes
    ----------
    tolerance : (k,)
        Their standard deviations as stated.
    values : (k,)
        The likeliest, which are taken off the records.
    covariance : (k, k)
        Of what is left.
    """

    tolerance: Array
    values: Array
    covariance: Array

    @classmethod
    def stated(cls, test: Measurement) -> Calibration | None:
        """That of the tolerances alone; None where all gains are exact."""
        std = tolerance_of(test)
        return cls(std, np.zeros(std.size), np.diag(std**2)) if np.any(std) else None

    def seen(self, test: Measurement) -> Array:
        """What was taken off the sensors' gains against the base, (n_sensors,)."""
        n, d = test.rigid_body.shape
        of_base = seen_at_sensors(test)[:, n : n + d] @ -self.values[n : n + d]
        return np.asarray((1 + self.values[:n]) / (1 + of_base) - 1)

    def recorded(self, test: Measurement, rng: np.random.Generator) -> Measurement:
        """The test as channels with other errors within the tolerances record it, which it states again."""
        n, d = test.rigid_body.shape
        errors = self.tolerance * rng.standard_normal(self.tolerance.size)
        sensors, base, force = np.split(self.tolerance, [n, n + d])
        given = without_gains(test, 1 / (1 + errors) - 1)
        return replace(given, gain_std=sensors, base_gain_std=base, force_gain_std=force)

    def taken_off(self, test: Measurement) -> Measurement:
        """The test without these errors."""
        return without_gains(test, self.values) if np.any(self.values) else test

    def given(self, test: Measurement, error: Array, std: Array) -> Calibration:
        """The same beside errors of the sensors' gains against the base that records show, (n_sensors,), NaN for none.

        Both are normally distributed: the likeliest errors are linear in what is shown. Sensors that are wrong beyond
        both tell nothing of the others.
        """
        H = seen_at_sensors(test)
        chance = np.sqrt(std**2 + np.einsum("ik,kl,il->i", H, self.covariance, H))
        known = np.isfinite(error) & np.isfinite(std)
        known &= np.abs(np.nan_to_num(error)) < most_deviations(error.size) * np.nan_to_num(chance)
        H = H[known]
        across = self.covariance @ H.T
        gain = across @ np.linalg.pinv(H @ across + np.diag(std[known] ** 2), hermitian=True)
        return replace(
            self, values=self.values + gain @ (error[known] - H @ self.values),
            covariance=self.covariance - gain @ across.T,
        )  # fmt: skip

    @property
    def moves(self) -> Array:
        """A factor (k, k) of the covariance."""
        lam, V = np.linalg.eigh(self.covariance)
        return np.asarray(V * np.sqrt(np.maximum(lam, 0.0)))


def calibrated(test: Measurement, calibration: Calibration | None) -> Measurement:
    """The test without errors of its gains; as it is where all are exact."""
    return test if calibration is None else calibration.taken_off(test)


def stored_calibrations(tree: dict[str, Any], tests: Sequence[Measurement]) -> list[Calibration | None]:
    """Gains of the tests of a stored problem, those of their tolerances where none were found."""
    found: list[Calibration | None] = []
    for one, test in zip(tree.get("calibrations") or [None] * len(tests), tests, strict=False):
        stated = Calibration.stated(test)
        if one is not None:
            k = test.n_sensors + 2 * test.n_base
            sound = [np.shape(one[name]) for name in ("tolerance", "values", "covariance")] == [(k,), (k,), (k, k)]
            sound = sound and all(np.all(np.isfinite(part)) for part in one.values())
            refuse((not sound or stated is None, "the stored gains are of another test, or hold what is no number"))
            stated = Calibration(**one)
        found.append(stated)
    return found
