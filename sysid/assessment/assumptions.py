"""Assumptions of an answer that its records cannot test: nothing speaks against them, and the matrices rest on them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sysid.assessment.checks.brackets import parts_with_spare
from sysid.finding import Finding, Severity
from sysid.measurement.channels import tolerance_of
from sysid.models.mass import LumpedMass
from sysid.problem.prepared import Prepared
from sysid.structure.sensor import BASE_AXES


def assumptions(problem: Prepared) -> tuple[Finding, ...]:
    """What the answer of a problem takes for granted, as notes; none of what a check would find to be wrong."""
    found = [*_total_at_sensors(problem), *_diagonal(problem)]
    if problem.formulation.fits_records:
        found += [*_gains(problem), *_mountings(problem), *_base(problem)]
    return tuple(found)


def _total_at_sensors(problem: Prepared) -> Iterator[Finding]:
    """A stated total of a lumped mass is taken to sit at the sensors, which accelerations cannot contradict."""
    totals, geometry = problem.formulation.mass.totals, problem.geometry
    if totals is None or totals.kind != "sensors" or problem.measurement.force is not None:  # which contradicts
        return
    held = geometry.translational & np.isin(np.arange(geometry.d), geometry.directions[: geometry.n])
    masses = {f"direction {i + 1}": float(totals.by_direction[i]) for i in np.flatnonzero(held)}
    if masses:
        yield Finding(
            "assumed total", Severity.NOTE,
            f"all of the stated {', '.join(dict.fromkeys(f'{mass:.5g}' for mass in masses.values()))} kg is taken to "
            "sit at the sensors. Mass that moves with the table, such as an adapter or a base ring, must not be in it: "
            "no record can show it, and M, K and C are in proportion to it",
            numbers=masses,
        )  # fmt: skip


def _diagonal(problem: Prepared) -> Iterator[Finding]:
    """A lumped mass is diagonal."""
    if isinstance(problem.stated.mass, LumpedMass):
        yield Finding(
            "assumed mass", Severity.NOTE,
            "the mass is taken to be diagonal, as stated: M, K and C are as right as that. Records contradict it only "
            "where they show all modes closely",
        )  # fmt: skip


def _gains(problem: Prepared) -> Iterator[Finding]:
    """Gains on which masses rest and that no record can show to be wrong."""
    test, mass = problem.measurement, problem.formulation.mass
    if mass.entries is not None and np.all(np.isfinite(mass.entries)):
        return
    moved, tolerance = np.any(test.rigid_body, axis=1), tolerance_of(problem.stated.measurement)
    still = [test.sensor_names[i] for i in np.flatnonzero(~moved & (tolerance[: moved.size] == 0))]
    for name in still:
        yield Finding(
            "assumed gain", Severity.NOTE,
            f"no record can show whether the gain of {name} is right, as its row of rigid_body is zero. An error of "
            "1 % in it makes 2 % in the diagonal of M_SS, K_SS and C there",
            channel=name,
        )  # fmt: skip
    if test.force is not None and mass.totals is None and not np.any(tolerance[-test.n_base :]):
        yield Finding(
            "assumed force gain", Severity.NOTE,
            "no record can show whether the gain of the base force is right. M, K and C are in proportion to it: an "
            "error of 1 % in it makes 1 % in them",
        )  # fmt: skip


def _mountings(problem: Prepared) -> Iterator[Finding]:
    """Sensors beside a free mass are mounted rigidly, but for those that others on a rigid part would tell."""
    test = problem.measurement
    if not problem.formulation.mass.free:
        return
    spare = parts_with_spare(test)
    count = test.n_sensors - sum(int(np.sum(mine)) for mine, _ in spare.values())
    if count:
        which = "the sensors" if not spare else f"{count} of {test.n_sensors} sensors"
        yield Finding(
            "assumed mounting", Severity.NOTE,
            f"{which} are taken to be mounted rigidly: one on a bracket of five times the last frequency reads 4 % too "
            "much there, which makes up to 8 % in M_SS, and no record can show it",
            "tap them; or put one sensor more on a rigid part than its motion needs, and state the part",
            numbers={"sensors": float(count)},
        )  # fmt: skip


def _base(problem: Prepared) -> Iterator[Finding]:
    """The base moves along the axes that are recorded alone."""
    axes = problem.measurement.base_axes or ()
    if 0 < len(axes) < len(BASE_AXES):
        yield Finding(
            "assumed base", Severity.NOTE,
            f"the base is taken to be rigid and to move along {' '.join(axes)} alone: motion of it that is not "
            "recorded counts as the structure's",
            numbers={"axes": float(len(axes))},
        )  # fmt: skip
