"""Degrees of freedom of a modal model: sensors, and modal coordinates where sensors do not suffice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.errors import InputError, refuse
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.residues import line_correlation
from sysid.modal_analysis.response import columns, gains, stacked, weights_of
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array
from sysid.structure.thresholds import CANDIDATES, NEGLIGIBLE, ROUND_OFF, beyond_chance

Integers = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class DegreesOfFreedom:
    """Degrees of freedom of a modal model: sensors (k,), ascending, and modal coordinates (m - k,) beside them."""

    sensors: Integers
    modes: Integers

    def coordinates(self, problem: Prepared, phi: Array) -> tuple[Array, Array, Array]:
        """Inverse of the mode shapes at them, (m, m), their rigid motion, (m, d), and base direction, (m,), or -1."""
        geometry, k = problem.geometry, self.modes.size
        shapes = np.vstack([phi[self.sensors], np.eye(phi.shape[1])[self.modes]])
        G = np.vstack([geometry.rigid_body[self.sensors], np.zeros((k, geometry.d))])
        return np.linalg.inv(shapes), G, np.concatenate([geometry.directions[self.sensors], np.full(k, -1)])


def degrees_of_freedom(problem: Prepared, modes: Modes, stated: Sequence[str | int] | None) -> DegreesOfFreedom:
    """Sensors, and modal coordinates where they do not suffice, whose motions tell all modes' apart.

    Sensors by a pivoted QR of the mode shapes, each mode in units of its own size, so that the chosen rows are
    best conditioned. With more modes than independent sensors the modes that the sensors tell least become coordinates.
    """
    m = modes.omega.size
    shapes = modes.phi / np.linalg.norm(modes.phi, axis=0)
    rank = _independent_sensors(problem.measurement, modes)
    if stated is not None:
        sensors = sensors_by_name(problem.measurement, stated)
        if sensors.size > m or np.linalg.svd(shapes[sensors], compute_uv=False)[-1] < NEGLIGIBLE:
            raise InputError(
                f"{sensors.size} sensors are stated as degrees of freedom, but the {m} modes do not tell them apart "
                f"(at most {rank} move independently)"
            )
    else:
        sensors = np.sort(scipy.linalg.qr(shapes.T, pivoting=True, mode="r")[1][:rank])
    order = scipy.linalg.qr(shapes[sensors], pivoting=True, mode="r")[1]
    return DegreesOfFreedom(sensors, np.sort(order[sensors.size :]))


def _independent_sensors(test: Measurement, modes: Modes) -> int:
    """Number of combinations of sensors that move in the modes by more than noise would make of them.

    Motions are judged, not shapes: two modes that nearly share a pole have shapes that are uncertain and nearly
    parallel, while their sum and their difference in the records are well known. Of r combinations the sum of all
    smaller singular values squared is (n - r) (m - r) numbers of noise, for n sensors and m modes.
    """
    n, m = modes.phi.shape
    q = gains(test.freq, modes.omega, modes.ratios) * np.einsum("md,rdf->rmf", modes.gamma, test.base)
    weight, size = weights_of(test.relative, test.response_std)
    motion = np.einsum("nm,rmf->rnf", modes.phi, q)
    error = weight * columns(test.relative - motion) / size
    unknowns = modes.phi.size + modes.gamma.size + modes.omega.size
    numbers = len(error) * int(np.count_nonzero(test.own_lines))
    variance = float(np.sum(np.abs(error) ** 2)) / max(2 * numbers - unknowns, 1)
    shared = line_correlation(error.reshape(len(error), -1, test.freq.size), unknowns)
    variance = max(variance * shared, ROUND_OFF**2)
    s = np.linalg.svd(stacked(weight * columns(motion) / size), compute_uv=False)[: min(n, m)]
    beyond = np.cumsum(s[::-1] ** 2)[::-1]
    chance = np.array([beyond_chance((n - r) * (m - r), CANDIDATES) for r in range(s.size)])
    moving = 1 + np.max(np.flatnonzero(beyond > variance * chance), initial=-1)
    shapes = np.linalg.svd(modes.phi / np.linalg.norm(modes.phi, axis=0), compute_uv=False)
    return int(min(moving, np.count_nonzero(shapes > NEGLIGIBLE * shapes[0])))


def sensors_by_name(test: Measurement, stated: Sequence[str | int]) -> Integers:
    """Numbers of sensors that are named, or numbered from 0, in ascending order, (k,)."""
    names = test.sensor_names
    chosen = []
    for one in stated:
        at = names.index(one) if one in names else one
        if not isinstance(at, int | np.integer) or not 0 <= at < len(names):
            raise InputError(f"Modal: {one!r} is no sensor; the sensors are {', '.join(names)}")
        chosen.append(int(at))
    refuse((len(set(chosen)) < len(chosen), "Modal: a sensor is named twice"))
    return np.sort(np.array(chosen, dtype=int))
