"""Motion of sensors with a rigid base, from their positions and axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array, sequence
from sysid.structure.sensor import BASE_AXES, Sensor, base_columns, checked_sensors, rigid_motion, sensor_row
from sysid.structure.structure import Array

_ASKEW = 0.02  # by which a sensor's axis, a unit vector, may differ from its row: about one degree


def rigid_body(
    positions: ArrayLike | None = None,
    axes: Sequence[str | Sequence[float]] | None = None,
    *,
    sensors: Sequence[Sensor] | None = None,
    base_axes: str | Sequence[str] = "xyz",
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> Array:
    """Motion of each sensor for unit rigid motion of the base (method of eq. 4 of Cerini et al. 2024).

    A sensor along the unit vector e at r from `origin` has the row ``[e', (r x e)']``.

    Parameters
    ----------
    positions : array_like, shape (n_sensors, 3)
        m.
    axes : sequence of n_sensors strings ("x", "-y", ...) or direction vectors
    sensors : sequence of Sensor
        In the place of `positions` and `axes`: they have them.
    base_axes : str or sequence of str
        Of x y z rx ry rz; a string such as "xy" is short for its letters, "x rz" names two.
    origin : sequence of float, shape (3,)
        The base point, m. Rotations of the base are in rad/s² about it.

    Returns
    -------
    ndarray, shape (n_sensors, d)

    Examples
    --------
    >>> rigid_body([[0, 0, 2.0]], ["x"], base_axes=["x", "ry"])
    array([[1., 2.]])
    >>> rigid_body(sensors=[Sensor("top", (0, 0, 2.0), "x")], base_axes=["x", "ry"])
    array([[1., 2.]])
    """
    described = checked_sensors(sensors)
    if (described is None) == (positions is None) or (positions is None) != (axes is None):
        raise InputError("rigid_body needs positions and axes, or sensors, which have both")
    if described is not None:
        positions, axes = [sensor.position for sensor in described], [sensor.axis for sensor in described]
    assert positions is not None
    points = np.atleast_2d(finite_array("positions", positions))
    given = sequence("axes", axes, "a list with one axis a sensor, such as ['x', '-y']")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) != len(given):
        raise InputError(f"positions {points.shape} and {len(given)} axes disagree; both have one row a sensor")
    columns = base_columns(base_axes)
    motion = rigid_motion(points, origin).reshape(len(points), 6, 6)
    rows = [axis_vector(axis, f"sensor {i}") @ motion[i, :3] for i, axis in enumerate(given)]
    return np.array(rows)[:, columns]


def axis_vector(axis: str | Sequence[float], label: str = "a sensor") -> Array:
    """Unit vector of "x", "-y", ... or of a direction vector."""
    row = sensor_row(axis, label)
    if np.any(row[3:]):
        raise InputError(
            f"the axis of {label} is the rotation {axis!r}; an accelerometer measures x, y or z, or a vector"
        )
    return row[:3]


def check_axes(sensors: Sequence[Sensor], rigid_body: Array, base_axes: Sequence[str]) -> None:
    """Refuse sensors whose axes are not what their rows of `rigid_body` (n_sensors, d) say.

    For unit translation of the base a sensor has its axis's part in that direction, wherever it is. A base that moves
    askew to the axes has no name: its direction may be any that all rows agree on.
    """
    moves = [i for i, name in enumerate(base_axes) if name in BASE_AXES[:3]]
    if not sensors or not moves:
        return
    names = [base_axes[i] for i in moves]
    axes = np.array([sensor_row(sensor.axis, f"sensor {sensor.name!r}")[:3] for sensor in sensors])
    rows, wanted = rigid_body[:, moves], axes[:, base_columns(names)]
    off = np.abs(rows - wanted)
    directions = np.linalg.lstsq(axes, rows)[0]
    askew = np.any(np.abs(directions).max(axis=0) < 1 - _ASKEW) and np.all(np.abs(axes @ directions - rows) < _ASKEW)
    if np.any(off > _ASKEW) and not askew:
        i, j = map(int, np.unravel_index(int(np.argmax(off)), off.shape))
        raise InputError(
            f"sensors: {sensors[i].name!r} has the axis {sensors[i].axis!r}, but by its row of rigid_body it moves by "
            f"{rows[i, j]:.3g} for unit {names[j]} of the base, in place of {wanted[i, j]:.3g}: correct axis, row or "
            "base_axes"
        )


def motion_of_sensors(sensors: Sequence[Sensor], base_axes: str | Sequence[str] | None, d: int) -> Array:
    """Motion of described sensors with a base that moves in d directions; these are told where they are in doubt.

    Three directions are x y z, one that of the sensors, all along one axis.
    """
    if base_axes is None:
        along = {sensor.axis.lstrip("+-") for sensor in sensors if isinstance(sensor.axis, str)}
        whole = len(along) == 1 and all(isinstance(sensor.axis, str) for sensor in sensors)
        if d != 3 and not (d == 1 and whole):
            raise InputError(
                f"the sensors do not tell along which {d} of x y z rx ry rz the base moves: state base_axes, such as "
                "['x'], or rigid_body"
            )
        base_axes = "xyz" if d == 3 else along.pop()
    return rigid_body(sensors=sensors, base_axes=base_axes)
