r"""Tables that rock: the base turns in proportion to its motion along an axis, and no record says so.

A sensor at r then moves by ``(G_e + s R_t) u``, R_t its row for rotation about t and s the turn, rad/m. The modes are
loaded by the rotation too, which no record tells from other loads; what is left beside them, ``s R_t u``, has the same
s at all sensors. No mode above the lines answers so; one below them does: a fit that does not know of the rotation may
hold one that is none, so that poles are looked for anew with each estimate of s.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.context import BEYOND, Context, of_tests
from sysid.assessment.checks.gains import distinct_poles, errors_along, tolerated_errors
from sysid.errors import InputError
from sysid.finding import Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.structure.sensor import BASE_AXES, rigid_body
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import LIKELY, NEGLIGIBLE, beyond_chance, most_deviations


class Rocking(NamedTuple):
    """Turn of the base about `turn` as it moves along direction `axis`, by number: `slope`, rad/m, and its deviation.

    `rows` (n_sensors,) are the sensors' for unit rotation; `moved` and `noise` what they move by beside their modes and
    G, over the motion along the axis, and its deviations.
    """

    axis: int
    turn: str
    slope: float
    std: float
    rows: Array
    moved: Array
    noise: Array

    def holds(self, G: Array, most: float = 0.5) -> bool:
        """True where it is certain, explains what all sensors move by, and an error of the base's gain does not.

        `G` (n_sensors,) are the rows for its axis. Without any one sensor too, which might be wrong by itself. A
        rotation of the size of the motion is a mode.
        """
        rows, moved, likely = self.rows / self.noise, self.moved / self.noise, most_deviations(self.rows.size)
        others, size = rows @ moved - rows * moved, np.maximum(rows @ rows - rows**2, np.finfo(float).tiny)
        left, base = moved - self.slope * rows, G / self.noise
        by_gain = moved - base * (base @ moved) / (base @ base)
        explains = np.all(np.abs(left) < likely) and by_gain @ by_gain - left @ left > beyond_chance(1)
        certain = rows.size > 2 and np.all(np.abs(others) > likely * np.sqrt(size))
        return bool(certain and explains and np.abs(self.slope * self.rows).max() < most)


def rocking_tables(context: Context) -> Iterator[Finding]:
    """The table turns as it moves along an axis: what sensors move by beside their modes rises with their places."""
    if not (context.is_explained or context.named or context.has("changing")):
        suspected = any(miss.times > BEYOND for miss in context.misses)
        yield from of_tests([list(_findings(modal, its, suspected)) for _, modal, its in context.fits])


def _findings(modal: ModalEstimate, structure: Structure, suspected: bool) -> Iterator[Finding]:
    test = modal.records
    for one in _found(modal, structure, suspected):
        along, slope = test.base_axes[one.axis], f"{one.slope:.2g}"
        if one.holds(test.rigid_body[:, one.axis]):
            yield Finding(
                "table rocks", Severity.CONTRADICTS,
                "what the sensors move by beside their modes rises with their places: your table rocks about "
                f"{one.turn[1]} by about {slope} rad/m (standard deviation {one.std:.1g}) as it moves along {along}",
                f"stiffen its guides; or record its rotation and state it as a base axis ({one.turn}); or, without "
                f"a force, add {slope} of its row for {one.turn} to each sensor's row for {along} in rigid_body",
                channel=f"base {along}", numbers={"slope": one.slope, "std": one.std},
            )  # fmt: skip


def _found(modal: ModalEstimate, structure: Structure, suspected: bool, rounds: int = 5) -> list[Rocking]:
    """The rotation of each base direction that explains most, once another round changes none; none without positions.

    The first round takes the poles of the structure in and above the lines; where it shows nothing, there are no
    others, unless the model misses more than noise (`suspected`).
    """
    test, errors = modal.as_recorded, tolerated_errors(modal)  # rocking makes constants too, as a wrong gain does
    if test.sensors is None:
        return []
    rows, along = rigid_body(sensors=test.sensors, base_axes=BASE_AXES), np.zeros(test.rigid_body.shape)
    plain, (omega, ratios), found = replace(test, sensors=None), distinct_poles(structure), list[Rocking]()
    for count in range(rounds):
        turned, before = replace(plain, rigid_body=test.rigid_body + along), along
        if count:
            try:
                poles = find_poles(turned)
            except InputError:  # too few lines
                return []
            omega, ratios = poles.omega, poles.ratios
        kept = omega >= 2 * np.pi * test.freq[test.freq > 0][0]
        inside, velocity = (omega[kept], ratios[kept]), not structure.modal_damping
        every = [_of_axis(turned, inside, axis, rows, along[:, axis], errors, velocity) for axis in range(test.n_base)]
        found, along = [one for one in every if one is not None], np.zeros(along.shape)
        for one in found:
            along[:, one.axis] = one.slope * one.rows
        steps = [np.max(np.abs(along - before)[:, one.axis]) / np.max(np.abs(one.std * one.rows)) for one in found]
        if (count or not suspected) and max(steps, default=0.0) < 0.1:
            break
    return found


def _of_axis(
    test: Measurement, poles: tuple[Array, Array], axis: int, rows: Array, along: Array, within: tuple[Array, Array],
    velocity: bool,
) -> Rocking | None:  # fmt: skip
    """The rotation beside motion along an axis that explains most of what sensors move by; None where chance does."""
    G, ones, (taken, tolerance) = test.rigid_body[:, axis] - along, np.zeros(test.rigid_body.shape), within
    ones[:, axis] = 1.0
    errors = errors_along(test, poles, ones, velocity=velocity)
    if errors is None or not np.all(np.isfinite(errors[1])):
        return None
    moved, noise = errors[0] + along + taken * G, np.hypot(errors[1], tolerance * np.abs(G))
    found = []
    for turn in BASE_AXES[3:]:
        its = rows[:, BASE_AXES.index(turn)]
        if turn not in test.base_axes and np.count_nonzero(np.abs(its * G) > NEGLIGIBLE) > 1:  # it moves some along it
            size = float(np.sum((its / noise) ** 2))
            slope = float(np.sum(its * moved / noise**2)) / size
            found.append(Rocking(axis, turn, slope, size**-0.5, its, moved, noise))
    best = max(found, key=lambda one: abs(one.slope / one.std), default=None)
    return best if best and abs(best.slope) > LIKELY * best.std else None
