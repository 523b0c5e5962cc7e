"""The state space of an identified structure as an object of python-control."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sysid.errors import needed
from sysid.export.content import Content
from sysid.results.identification import Identification

if TYPE_CHECKING:
    from control import StateSpace


def control_system(identification: Identification, *, positive_axes: bool = False) -> StateSpace:
    """`Structure.to_state_space` for python-control (extra ``control``), with names; exact, double precision.

    Returns
    -------
    control.StateSpace
        2n states ``[v, v']`` (the relative motion of the degrees of freedom), d inputs (base accelerations, "base x"
        and so on), n_sensors outputs (absolute accelerations, by the sensors' names and axes: "floor 2 (-x)"; turned
        to +x, +y, +z where `positive_axes`).

    Raises
    ------
    InputError
        Where python-control is not installed.
    """
    needed("control", "control", "control_system")
    import control

    content = Content.of(identification, positive_axes)
    system = content.structure.to_state_space()
    return control.ss(
        system.A, system.B, system.C, system.D,
        inputs=[f"base {axis}" for axis in content.base_axes], outputs=_plain(content.sensor_names),
    )  # fmt: skip


def _plain(names: tuple[str, ...]) -> list[str]:
    """Names without ".", by which python-control separates systems from signals."""
    return [name.replace(".", "_") for name in names]
