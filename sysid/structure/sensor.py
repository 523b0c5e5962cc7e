"""Sensors: name, place and direction; the axes of sensors and base, and how a rigid base moves them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, as_float, finite_array, instance, refuse, sequence, shown, text

Array = NDArray[np.floating[Any]]
BASE_AXES = ("x", "y", "z", "rx", "ry", "rz")


class BaseSensor(NamedTuple):
    """A sensor of the base among more than its directions need: how it reads the motion that is taken for the base's.

    `gain` times that motion, and by the share `off` of its record beside it.
    """

    name: str
    gain: float
    off: float


def unit_vector(value: ArrayLike, label: str) -> Array:
    """`value` as a vector (3,) of length one."""
    vector = vector3(value, label)
    size = float(np.linalg.norm(vector))
    if size == 0.0:
        raise InputError(f"{label} is the zero vector")
    return vector / size


def vector3(value: ArrayLike, label: str) -> Array:
    """`value` as a finite vector (3,)."""
    vector = finite_array(label, value)
    if vector.shape != (3,):
        raise InputError(f"{label} must be three finite numbers, got {shown(value)}")
    return vector


def sensor_row(axis: str | ArrayLike, label: str) -> Array:
    """Factors of a node's six motions in the signal of a sensor on it, (6,).

    `axis` is a vector (3,), of any length, or a string: "x", "-y", and "rx", "-rz" for rotations.
    """
    row = np.zeros(6)
    if isinstance(axis, str):
        match = re.fullmatch(r"([+-]?)(r?[xyz])", axis)
        if match is None:
            raise InputError(
                f"the axis of {label} must be a vector or one of x y z rx ry rz (signed), got {shown(axis)}"
            )
        sign, name = match.groups()
        row[BASE_AXES.index(name)] = float(f"{sign}1")
    else:
        row[:3] = unit_vector(axis, f"the axis of {label}")
    return row


def base_columns(base_axes: str | Iterable[str]) -> list[int]:
    """Return the indices 0 to 5 of the base axes: "xyz", "x rz" or ["x", "rz"]."""
    text = base_axes
    if not isinstance(text, str):
        text = " ".join(map(str, sequence("base_axes", base_axes, "names such as ['x', 'rz']")))
    if re.fullmatch(r"([\s,]*r?[xyz])+[\s,]*", text) is None:
        raise InputError(f"base_axes must be any of x y z rx ry rz, got {shown(base_axes)}")
    columns = [BASE_AXES.index(axis) for axis in re.findall(r"r?[xyz]", text)]
    if len(set(columns)) < len(columns):
        raise InputError(f"base_axes names an axis twice: {base_axes!r}")
    return columns


def rigid_motion(points: Array, origin: ArrayLike) -> Array:
    """Motion of `points` (n, 3) for unit motions of `origin` in x y z rx ry rz, (6 n, 6)."""
    arms = points - vector3(origin, "origin")
    motion = np.tile(np.eye(6), (len(arms), 1, 1))
    motion[:, :3, 3:] = np.cross(np.eye(3), arms[:, None]).swapaxes(1, 2)  # theta × r
    return motion.reshape(-1, 6)


@dataclass(frozen=True)
class Sensor:
    """One accelerometer axis.

    Parameters
    ----------
    name : str
        Shown in tables and figures.
    position : tuple of float, shape (3,)
        m.
    axis : str or tuple of float, shape (3,)
        "x", "-y", ..., or a direction vector.
    delay : float
        s, by which its records are late. A `Measurement` takes it off when it is made: its sensors have none.
    gain_std : float
        Tolerance of its gain: standard deviation of the relative error, such as 0.005; exact by default.
    part : str
        Name of the rigid part that it is fixed to, such as "deck": its sensors move as one rigid body. None by default.

    Raises
    ------
    InputError
        Where the name is no text, or another field is not as above.
    """

    name: str
    position: tuple[float, float, float]
    axis: str | tuple[float, float, float]
    delay: float = 0.0
    gain_std: float = 0.0
    part: str = ""

    def __post_init__(self) -> None:
        label = f"sensor {text('the name of a Sensor', self.name)!r}"
        vector3(self.position, f"the position of {label}")
        sensor_row(self.axis, label)
        as_float(f"the delay of {label}", self.delay, "a number of seconds, such as 0.002")
        as_float(f"gain_std of {label}", self.gain_std, "a fraction, such as 0.005", at_least=0)
        if self.part != "":
            text(f"the part of {label}", self.part)

    def to_tree(self) -> dict[str, Any]:
        """Name, position and axis as strings and arrays, for `from_tree`; those of a test have no delay."""
        axis = self.axis if isinstance(self.axis, str) else np.array(self.axis, dtype=float)
        own = {name: value for name in ("gain_std", "part") if (value := getattr(self, name))}
        return {"name": self.name, "position": np.array(self.position, dtype=float), "axis": axis, **own}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Sensor:
        """Sensor from a dictionary that `to_tree` made."""
        axis = tree["axis"] if isinstance(tree["axis"], str) else tuple(tree["axis"].tolist())
        own = {name: tree[name] for name in ("gain_std", "part") if name in tree}
        return cls(tree["name"], tuple(tree["position"].tolist()), axis, **own)


def checked_sensors(given: Sequence[Any] | None) -> tuple[Sensor, ...] | None:
    """The sensors of a test or a structure, each a `Sensor`, as a tuple; None where they are not described."""
    sensors = None if given is None else sequence("sensors", given, "a list of sysid.Sensor")
    for at, sensor in enumerate(sensors or ()):
        instance(f"sensors[{at}]", sensor, Sensor)
    return sensors


def without_delay(sensors: Sequence[Sensor] | None) -> tuple[Sensor, ...] | None:
    """The sensors as those of records on one clock; None where they are not described."""
    return None if sensors is None else tuple(replace(sensor, delay=0.0) for sensor in sensors)


def sensors_to_tree(sensors: Sequence[Any] | None) -> list[dict[str, Any]] | None:
    """Dictionaries of the sensors of a test or a structure; None where they are not described."""
    return None if sensors is None else [sensor.to_tree() for sensor in sensors]


def sensors_from_tree(trees: Sequence[dict[str, Any]] | None) -> tuple[Sensor, ...] | None:
    """Sensors from what `sensors_to_tree` made."""
    return None if trees is None else tuple(Sensor.from_tree(tree) for tree in trees)


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


def motion_of_sensors(given: ArrayLike | None, sensors: Any, base_axes: Any, d: int) -> Array:
    """Motion of sensors with a base that moves in d directions, (n_sensors, d): as given, or as they are described.

    Where directions are not named, three are x y z, and one is that of the sensors, all along one axis.
    """
    if given is not None:
        return np.atleast_2d(finite_array("rigid_body", given))
    described = checked_sensors(sensors)
    if described is None:
        raise InputError("rigid_body is missing: give it (sysid.rigid_body), or sensors=[sysid.Sensor(...), ...]")
    if base_axes is None:
        along = {sensor.axis.lstrip("+-") if isinstance(sensor.axis, str) else "" for sensor in described}
        base_axes = {1: "".join(along) if len(along) == 1 else "", 3: "xyz"}.get(d)
        if not base_axes:
            raise InputError(
                f"the sensors do not tell along which {d} of x y z rx ry rz the base moves: state base_axes, such as "
                "['x'], or rigid_body"
            )
    return rigid_body(sensors=described, base_axes=base_axes)


def axes_of_base(given: Any, sensors: Sequence[Sensor], rigid_body: Array) -> tuple[str, ...]:
    """Names of the columns of `rigid_body` (n_sensors, d): as given, told by the sensors' axes, or x y z.

    Refused where sensors' axes are not what their rows say.
    """
    d = rigid_body.shape[1]
    if given is None:
        names = _axes_of_sensors(sensors, rigid_body)
    else:
        names = tuple(BASE_AXES[column] for column in base_columns(given))
    turns = not names and d <= 3 and np.any(np.linalg.norm(rigid_body, axis=1) > 1 + 1e-6)
    refuse(
        (given is not None and len(names) != d, f"base_axes names {len(names)} directions but base has {d}"),
        (d > 6, f"base has {d} directions; a rigid base has at most six"),
        (
            turns,
            "rigid_body has rows longer than 1, as only a rotation gives (a unit axis under translations has a row "
            "of at most 1): state base_axes, such as ['x', 'ry']",
        ),
    )
    names = names or BASE_AXES[:d]
    _check_axes(sensors, rigid_body, names)
    return names


def _axes_of_sensors(sensors: Sequence[Sensor], rigid_body: Array) -> tuple[str, ...]:
    """Names of the columns of G as translations along the sensors' axes; none where no or several names fit."""
    if not sensors:
        return ()
    axes = np.array([axis_vector(sensor.axis, sensor.name) for sensor in sensors])
    alike = np.array(
        [[np.any(column) and np.allclose(axis, column, atol=1e-6) for axis in axes.T] for column in rigid_body.T]
    )
    unique = np.all(alike.sum(axis=1) == 1) and np.all(alike.sum(axis=0) <= 1)
    return tuple(BASE_AXES[i] for i in np.argmax(alike, axis=1)) if unique else ()


def _check_axes(
    sensors: Sequence[Sensor], given: Array, base_axes: Sequence[str], most: float = 0.5
) -> None:  # fmt: skip
    """Refuse sensors whose axes are not what their `given` rows of rigid_body (n_sensors, d) say.

    For unit translation of the base a sensor has its axis's part in that direction, wherever it is. A base that moves
    askew to the axes has no name: its direction may be any that all rows agree on. One that rocks turns besides.
    """
    moves = [i for i, name in enumerate(base_axes) if name in BASE_AXES[:3]]
    if not sensors or not moves:
        return
    names = [base_axes[i] for i in moves]
    axes = np.array([sensor_row(sensor.axis, f"sensor {sensor.name!r}")[:3] for sensor in sensors])
    rows, wanted = given[:, moves], axes[:, base_columns(names)]
    off = np.abs(rows - wanted)
    directions = np.linalg.lstsq(axes, rows)[0]
    askew = np.any(np.abs(directions).max(axis=0) < 1 - _ASKEW) and np.all(np.abs(axes @ directions - rows) < _ASKEW)
    rotations = rigid_body(sensors=sensors, base_axes=BASE_AXES[3:])
    turned = rotations @ np.linalg.lstsq(rotations, rows - wanted)[0]
    rocks = off.max() < most and np.all(np.abs(wanted + turned - rows) < _ASKEW)
    if np.any(off > _ASKEW) and not (askew or rocks):
        i, j = map(int, np.unravel_index(int(np.argmax(off)), off.shape))
        raise InputError(
            f"sensors: {sensors[i].name!r} has the axis {sensors[i].axis!r}, but by its row of rigid_body it moves by "
            f"{rows[i, j]:.3g} for unit {names[j]} of the base, in place of {wanted[i, j]:.3g}: correct axis, row or "
            "base_axes"
        )


def tolerances(name: str, given: Any, count: int, most: float = 0.3) -> Array | None:
    """Stated tolerances of so many gains, (count,); None where none are stated.

    One beyond `most` is none, and likely in per cent.
    """
    if given is None:
        return None
    array = finite_array(name, given)
    if array.shape not in ((), (1,), (count,)):
        raise InputError(f"{name} has shape {array.shape}; one number, or ({count},), is needed")
    if np.any((array < 0) | (array > most)):
        raise InputError(f"{name} is a fraction from 0 to {most:g}, such as 0.005 for half a per cent")
    return np.broadcast_to(array, (count,)).copy()
