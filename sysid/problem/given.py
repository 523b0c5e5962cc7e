"""Matrix models of a user's mass, stiffness and damping, and the geometry that they have."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError, finite_array, numbers, refuse
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.response import columns, weighed_mass
from sysid.models.damping import WrittenDamping
from sysid.models.expressions import at_point, check_size, is_expression, square
from sysid.models.geometry import Geometry
from sysid.models.mass import KnownMass, WrittenMass
from sysid.models.model import MatrixModel
from sysid.models.stiffness import WrittenStiffness
from sysid.models.unknowns import Variable, user_site
from sysid.structure.structure import Array

MATRICES = ("mass", "stiffness", "damping")
_WRITTEN: dict[str, Any] = {"mass": WrittenMass, "stiffness": WrittenStiffness, "damping": WrittenDamping}
_DIMENSIONS = {"mass": (2,), "stiffness": (2,), "damping": (1, 2)}  # one ratio a mode
_WANTED = {
    "mass": "a model such as FullMass(kg) or a matrix",
    "stiffness": "a stiffness model of sysid, an expression or a matrix",
    "damping": "a damping model of sysid, an expression or a matrix",
}


def as_models(mass: Any, stiffness: Any, damping: Any) -> tuple[MatrixModel, MatrixModel, MatrixModel]:
    """Models as they are, numbers and expressions as models.

    Raises
    ------
    InputError
        Where something is none of these.
    """
    if (
        isinstance(damping, tuple)
        and len(damping) == 2
        and all(isinstance(v, Variable | ca.MX) and np.prod(v.shape) == 1 for v in damping)
    ):
        names = ", ".join(str(getattr(v, "symbol", v)) for v in damping)
        raise InputError(
            f"damping=({names}) ({user_site()}) may mean one ratio a mode or two factors: "
            "write a list, [a, b], for ratios, and a * M + b * K for factors of mass and stiffness"
        )
    found: list[Any] = []
    for name, value in zip(MATRICES, (mass, stiffness, damping), strict=True):
        if _is_model(value, len(found)):
            found.append(value)
        elif is_expression(value):
            found.append(_WRITTEN[name](value))
        else:
            found.append((_WRITTEN | {"mass": KnownMass})[name](_numbers(name, value)))
    return found[0], found[1], found[2]


def _is_model(value: object, before: int) -> bool:
    """True where a value has the methods of a matrix model whose blocks follow those of so many others."""
    if isinstance(value, type) or not isinstance(value, MatrixModel):
        return False
    try:
        inspect.signature(value.blocks).bind("geometry", "y", *range(before))
    except TypeError:
        return False
    return True


def _numbers(name: str, value: Any) -> Array:
    try:
        matrix = numbers(name, value, complex)
    except InputError:
        matrix = np.zeros(())
    refuse(
        (
            np.any(matrix.imag),
            f"Problem: {name} ({user_site()}) is complex, and a matrix of a structure is real: give its real part; "
            "a loss factor eta of a complex stiffness is a damping ratio eta / 2 of each mode, damping=[eta / 2, ...]",
        ),
        (
            matrix.ndim not in _DIMENSIONS[name],
            f"Problem: {name} is a {type(value).__name__}; give {_WANTED[name]}",
        ),
    )
    return matrix.real.copy()


def geometry_of(
    modal: ModalEstimate,
    stiffness: MatrixModel,
    recovery: Any = None,
    rigid_body_dofs: Any = None,
    weighed: Callable[[], Array] | None = None,
) -> Geometry:
    """Geometry of the degrees of freedom of a problem or of a further test, of which the modal estimate is.

    Raises
    ------
    InputError
        Where recovery, rigid_body_dofs and the sensors do not fit together.
    """
    test = modal.records
    for name, given in (("recovery", recovery), ("rigid_body_dofs", rigid_body_dofs)):
        refuse(
            (
                is_expression(given),
                f"{name} ({user_site()}) is written in variables, and it must be numbers: what is not known of the "
                "degrees of freedom belongs into mass, stiffness and damping, written in those of the sensors",
            )
        )
    R = np.eye(test.n_sensors) if recovery is None else finite_array("recovery", recovery)
    if R.ndim != 2 or len(R) != test.n_sensors:
        raise InputError(f"recovery is {R.shape}; ({test.n_sensors}, n) takes n degrees of freedom to the sensors")
    G = _rigid_body_dofs(test, stiffness, R, recovery is not None, rigid_body_dofs)
    moved = np.abs(R @ G - test.rigid_body).max()
    if moved > 1e-6 * max(1.0, np.abs(test.rigid_body).max()):
        raise InputError(
            f"recovery @ rigid_body_dofs differs from the measurement's rigid_body by up to {moved:.3g}: the order of "
            "the degrees of freedom, or signs and axes of the sensors, are not what the matrices have"
        )
    return Geometry(modal, G, R, weighed)


def _rigid_body_dofs(test: Measurement, stiffness: MatrixModel, R: Array, other: bool, stated: Any) -> Array:
    """G of the degrees of freedom, (n, d): stated, or what a stiffness with its base columns has."""
    n, d = R.shape[1], test.n_base
    if stated is not None:
        G = finite_array("rigid_body_dofs", stated)
        if G.shape != (n, d):
            raise InputError(f"rigid_body_dofs is {G.shape}; ({n}, {d}) is needed")
        return G
    if not other:
        return test.rigid_body
    whole = square("stiffness", stiffness.written) if isinstance(stiffness, WrittenStiffness) else ca.MX(n, n)
    if whole.size1() <= n:
        raise InputError(
            "with recovery, and a stiffness without its base columns, state rigid_body_dofs (n, d): the motion of the "
            "degrees of freedom with a rigid base"
        )
    check_size("stiffness", whole, n, d)
    K = at_point("stiffness", whole, None)
    return -np.linalg.lstsq(K[:n, :n], K[:n, n:], rcond=None)[0]


def rough_mass(test: Measurement, geometry: Geometry, stated: Array | None) -> Array:
    """Rough rigid-body mass of each base direction from the base force, (d,): it only places the search.

    Beside modes of `stated` circular frequencies, rad/s; where there are none, of the poles in the data.

    Raises
    ------
    InputError
        Where the force weighs a negative mass, with lines far below the first mode.
    """
    assert test.force is not None
    if stated is None:
        quiet, ratios = test, geometry.pole_ratios
        omega: Array = geometry.poles.omega if ratios.size else np.zeros(0)
    else:
        omega, ratios = stated, np.full(stated.size, 0.01)
        # Away from resonance the damping, which is not known, hardly matters.
        away = np.all(np.abs(2 * np.pi * test.freq / omega[:, None] - 1) > 0.1, axis=0)
        quiet = test if np.count_nonzero(away) < 2 * (omega.size + 1) else test.at(away)
    mass = np.diag(weighed_mass(quiet, omega, ratios))
    if np.all(mass > 0):
        return mass
    if omega.size and test.freq[0] < 0.3 * omega[0] / (2 * np.pi):
        raise InputError(
            f"the base force gives a mass of {mass.min():.3g} kg, with lines well below the first mode: check its "
            "sign (it is the base's on the structure, in phase with the base acceleration at low frequency) and "
            "its unit"
        )
    return np.linalg.norm(columns(test.force), axis=1) / np.linalg.norm(columns(test.base), axis=1)
