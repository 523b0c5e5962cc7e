"""What goes into an export, and the Craig-Bampton form with the base's degrees of freedom first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property

import numpy as np

from sysid.errors import refuse, shown_plainly
from sysid.results.identification import Identification
from sysid.results.version import __version__
from sysid.structure.sensor import BASE_AXES, Sensor, sensor_row
from sysid.structure.structure import Array, Structure
from sysid.structure.superelement import CraigBampton

_UNITS = {"M": ("kg", "kg m", "kg m2"), "K": ("N/m", "N", "N m"), "C": ("N s/m", "N s", "N s m")}


def matrices_of(structure: Structure) -> dict[str, Array]:
    """M, K and C, (n + d, n + d) each, the structure's degrees of freedom first.

    C is ``[I, -G]' C_SS [I, -G]``: zero in a rigid-body motion.
    """
    relative = np.hstack([np.eye(structure.n), -structure.rigid_body_dofs])
    return {"M": structure.mass, "K": structure.stiffness, "C": relative.T @ structure.damping @ relative}


@dataclass(frozen=True, eq=False)
class Content:
    """A result as it is written: its structure and sensors as recorded, or turned to positive axes.

    Attributes
    ----------
    it : Identification
    structure : Structure
        Whose rows are along `sensors`.
    sensors : tuple of Sensor or None
        None where they are not described.
    level : float or None
        m/s², at which the modes that follow their amplitude move; None at rest.
    """

    it: Identification
    structure: Structure
    sensors: tuple[Sensor, ...] | None
    level: float | None = None

    @classmethod
    def of(cls, it: Identification, positive_axes: bool = False, level: float | None = None) -> Content:
        """The content of a result, at a level, all its sensors along +x, +y, +z, +rx, ... where `positive_axes`."""
        linear = "no mode of this result follows its amplitude, its matrices hold at all levels (sysid run --amplitude)"
        refuse((level is not None and not it.structure.laws, f"level: {linear}"))
        structure = it.structure if level is None else it.structure.at_level(level)
        if not positive_axes:
            return cls(it, structure, it.measurement.sensors, level)
        sensors = it.measurement.sensors or ()
        undescribed = "the axes of the sensors are not known: describe them (sensors=[sysid.Sensor(...)])"
        refuse((not sensors, f"positive axes: {undescribed}"))
        signs = np.array([-1.0 if _negative(sensor) else 1.0 for sensor in sensors])
        described = zip(sensors, signs, strict=True)
        turned = tuple(replace(one, axis=_positive(one)) if sign < 0 else one for one, sign in described)
        return cls(it, _turned(structure, signs, turned), turned, level)

    @property
    def base_axes(self) -> tuple[str, ...]:
        """Directions of the base."""
        return self.it.measurement.base_axes or ()

    @cached_property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors with their axes, such as "floor 2 (-x)"; without them where they are not described."""
        axes = [f" ({_axis_in_words(sensor)})" for sensor in self.sensors or ()]
        names = self.it.measurement.sensor_names
        return tuple(name + axis for name, axis in zip(names, axes or [""] * len(names), strict=True))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the rows of the matrices: the structure's degrees of freedom, then "base x" and so on."""
        called = list(self.it.degrees_of_freedom)
        for row in np.flatnonzero(self.structure.dof_sensors >= 0):
            called[row] = self.sensor_names[self.structure.dof_sensors[row]]
        return (*called, *(f"base {axis}" for axis in self.base_axes))

    @cached_property
    def rotations(self) -> tuple[bool | None, ...]:
        """Which rows of the matrices are rotations; None for a coordinate that no sensor records."""
        axes = [sensor.axis for sensor in self.sensors or ()] or [""] * self.structure.n_sensors
        turns = [isinstance(axis, str) and "r" in axis for axis in axes]
        turned = (turns[j] if j >= 0 else None for j in self.structure.dof_sensors)
        return (*turned, *(axis.startswith("r") for axis in self.base_axes))

    @property
    def deviations(self) -> dict[str, Array]:
        """Standard deviations of `matrices_of`; NaN where not known, as in all rows and columns of the base."""
        n, size = self.structure.n, len(self.structure.mass)
        found = {}
        for letter, name in (("M", "mass"), ("K", "stiffness"), ("C", "damping")):
            found[letter] = np.full((size, size), np.nan)
            found[letter][:n, :n] = self.it.quick_std(name)[:n, :n]
        return found


def _negative(sensor: Sensor) -> bool:
    """True where a sensor points along -x, -ry or the like, by its word or its vector."""
    row = sensor_row(sensor.axis, sensor.name)
    return bool(np.count_nonzero(row) == 1 and row.sum() < 0)


def _positive(sensor: Sensor) -> str:
    return BASE_AXES[int(np.flatnonzero(sensor_row(sensor.axis, sensor.name))[0])]


def _axis_in_words(sensor: Sensor) -> str:
    axis = sensor.axis
    return axis.lstrip("+") if isinstance(axis, str) else " ".join(f"{part:.3g}" for part in axis)


def _turned(structure: Structure, signs: Array, sensors: tuple[Sensor, ...]) -> Structure:
    """The structure with sensors of these signs turned, and with them the degrees of freedom that they record."""
    recorded, beyond = structure.dof_sensors, structure.residual
    of_dofs = np.where(recorded >= 0, signs[recorded], 1.0)
    coupling = None if beyond.coupling is None else beyond.coupling * np.append(of_dofs, np.ones(beyond.count))
    both, by_ratios = np.concatenate([of_dofs, np.ones(structure.n_base)]), structure.modal_damping
    return Structure(
        structure.mass * np.outer(both, both), structure.stiffness * np.outer(both, both),
        structure.damping_ratios if by_ratios else None, n_base=structure.n_base,
        damping_matrix=None if by_ratios else structure.damping * np.outer(of_dofs, of_dofs),
        rigid_body=structure.rigid_body * signs[:, None], recovery=structure.recovery * np.outer(signs, of_dofs),
        sensors=sensors, residual=replace(beyond, shapes=beyond.shapes * signs[:, None], coupling=coupling),
    )  # fmt: skip


def entry_unit(letter: str, row: bool | None, column: bool | None) -> str:
    """Unit of an entry of M, K or C by whether row and column are rotations; "" where one is not known."""
    return "" if row is None or column is None else _UNITS[letter][row + column]


_WORTH = {
    "no fit": "NO FIT: these matrices do not explain the records as they should",
    "doubtful": "DOUBTFUL: something speaks against this model, so that these matrices may be wrong",
    "determined": "determined: data and stated model fix every entry of the matrices",
    "one of many": "ONE OF MANY: other matrices explain the records as well, or noise leaves entries open; "
    "frequencies, damping ratios and responses to base motion hold",
}
_INTERRUPTED = "the search was interrupted, these are the best matrices until then; "


def reliability(it: Identification) -> str:
    """Judgement of the matrices, in one line that names the statements which tell why."""
    parts = (("against", it.contradictions), ("open", it.open_findings))
    why = " and ".join(f"'{word}'" for word, findings in parts if findings)
    return _INTERRUPTED * it.interrupted + _WORTH[it.judgement] + (f"; see {why}" if why else "")


def statements(content: Content, precision: str) -> tuple[str, ...]:
    """Sentences of every file: origin, judgement, what is against it and open, units, order of rows, precision."""
    it, structure, base = content.it, content.structure, " ".join(content.base_axes)
    found = [
        f"written by sysid {__version__} on {datetime.now().astimezone().isoformat(timespec='seconds')}",
        f"problem: {it.recipe.title if it.recipe else 'of a script'}; strategy {it.strategy}; seed {it.seed}",
        f"judgement: {reliability(it)}; relative residual {it.residual:.3g}",
        f"search: {it.message}",
        *(f"fixed by: {text}" for text in it.closed_by),
        *(f"assumed: {text}" for text in it.assumptions),
        *(f"against: {one}" for one in it.contradictions),
        *(f"open: {one}" for one in it.open_findings),
        "units: kg, m, s, N, rad; frequencies in Hz; damping ratios are fractions of critical damping",
        f"rows and columns: {structure.n} of the structure, then {structure.n_base} of the base ({base}); motions are "
        "absolute, and moments refer to the point at which the base motion is given",
        "order: " + ", ".join(f"{at} {name}" for at, name in enumerate(content.names, 1)),
        _directions(content),
        "damping acts on the motion relative to the base",
        f"precision: {precision}",
        *_level_in_words(content),
    ]
    if structure.residual.count:
        f = ", ".join(f"{one:.6g}" for one in structure.residual.natural_frequencies)
        found.append(
            f"residual modes ({f} Hz): no modes of the structure; in the band, up to {it.measurement.freq[-1]:.6g} Hz, "
            "they answer like all modes beyond it; the Craig-Bampton form and the state space hold them, M, K, C do not"
        )
    if it.facts.unit_mass:
        found.append("all masses, stiffness and damping are relative: no mass was stated, and they are scaled to 1 kg")
    return tuple(shown_plainly(" ".join(text.split())) for text in found)


def _level_in_words(content: Content) -> Iterator[str]:
    """The level of the matrices, where modes follow their amplitude, law by law."""
    it, level = content.it, content.level
    for law in it.structure.laws:
        mode, low, high = law.mode + 1, *law.levels
        frequency, ratio = (law.frequency, law.ratio) if level is None else law.at(level)
        whose = f"mode {law.level_of + 1}'s" if law.followed else "its"
        where = f"at {level:.6g} m/s2" if level is not None else "at rest, 0 m/s2,"
        yield (
            f"level: mode {mode} follows {whose} amplitude; these matrices are those {where} of {whose} relative "
            f"acceleration at {it.measurement.sensor_names[law.sensor]} ({frequency:.6g} Hz, damping ratio "
            f"{ratio:.4g}); it was tested from {low:.3g} to {high:.3g} m/s2"
            f"{', so that they are extrapolated' * law.is_beyond(level or 0.0)}; deviations are "
            "those at rest"
        )


def _directions(content: Content) -> str:
    """Along what a row is positive, and which were turned."""
    if content.sensors is None:
        return "directions: sensors are not described; a row is positive as its sensor recorded"
    recorded = zip(content.it.measurement.sensors or (), content.sensors, strict=True)
    turned = [f"{one.name} ({_axis_in_words(one)})" for one, other in recorded if one.axis != other.axis]
    words = "directions: a row is positive along the axis in brackets behind its name"
    return words + (f"; turned to it from what was recorded: {', '.join(turned)}" if turned else "")


def one_line_each(texts: Sequence[str], width: int, mark: str = "") -> list[str]:
    """Sentences cut into lines of at most `width` characters of ASCII, each behind `mark`."""
    import textwrap

    plain = (text.encode("ascii", "replace").decode() for text in texts)
    return [line for t in plain for line in textwrap.wrap(t, width, initial_indent=mark, subsequent_indent=mark + "  ")]


def superelement_of(structure: Structure) -> CraigBampton:
    """`Structure.to_craig_bampton` with the base first: rows and columns are of [u_0; q], residual modes the last of q.

    No term is left out: the base is statically determinate, so that its constraint modes are the rigid-body motions,
    which strain nothing.
    """
    form = structure.to_craig_bampton()
    n = len(form.mass) - structure.n_base
    order = np.r_[n : n + structure.n_base, :n]
    both = np.ix_(order, order)
    return CraigBampton(form.mass[both], form.stiffness[both], form.damping[both], form.recovery[:, order])
