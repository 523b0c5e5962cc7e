"""Stated masses that the records contradict, and a base force that they do not explain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sysid.assessment.checks.context import Context
from sysid.assessment.checks.gains import distinct_poles
from sysid.finding import Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.residues import Records, force_residual_left
from sysid.modal_analysis.response import weighed_mass, weighed_mass_std
from sysid.models.mass import total_of
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Structure
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, most_deviations

MISFIT = 1.5  # times what free residues leave, beyond which a force is not what the modes make of it


def stated_masses(context: Context) -> Iterator[Finding]:
    """A stated mass, or the base force, is not that of the modes that the accelerations show."""
    if context.is_explained or not context.problem.formulation.fits_records:
        return
    problem, structure = context.problem.screened, context.end.structure
    for check in (_stated_mass, _known_entries, _lumped_total):
        yield from check(problem, structure)
    yield from force_misfit(problem.formulation, problem.measurement, structure)


def _stated_mass(problem: Prepared, structure: Structure) -> Iterator[Finding]:
    """The base force weighs another mass than the stated one."""
    test, stated = problem.measurement, problem.formulation.mass
    whole = stated.totals is not None or np.all(np.isfinite(problem.known_mass))
    if test.force is None or stated.weighs or not whole or not structure.modal_damping:
        return
    poles = distinct_poles(structure)
    weighed, expected = np.diag(weighed_mass(test, *poles)), np.diag(structure.rigid_body_mass)
    # A direction beside a rotation may be weighed worse.
    noise = most_deviations(test.n_base) * weighed_mass_std(test, *poles) / expected
    usual = max(0.01, 3 * force_residual_left(test, *poles) / np.sqrt(test.freq.size))
    if np.any(np.abs(weighed / expected - 1) >= np.maximum(usual, noise)):
        given, found = (", ".join(f"{m:.4g}" for m in masses) for masses in (expected, weighed))
        numbers = {f"stated {i + 1}": float(m) for i, m in enumerate(expected)}
        yield Finding(
            "stated mass", Severity.CONTRADICTS,
            f"the stated mass makes {given} kg in the base directions, but the base force weighs {found} kg",
            "one of them, or the unit of the force, is wrong; the force weighs an adapter or base plate on its cells "
            "too",
            numbers=numbers | {f"weighed {i + 1}": float(m) for i, m in enumerate(weighed)},
        )  # fmt: skip


def _known_entries(problem: Prepared, structure: Structure) -> Iterator[Finding]:
    """Known entries of the mass are not used, or are more than the stated total."""
    geometry, mass = problem.geometry, problem.formulation.mass
    if not mass.free or mass.entries is None:
        return
    if not structure.at_sensors:
        unused = "the known entries of the mass are not used: the degrees of freedom are not the sensors alone"
        yield Finding("known entries", Severity.CONTRADICTS, unused)
        return
    if mass.totals is not None and problem.measurement.force is None:
        makes = total_of(geometry, structure.mass, mass.totals.kind)
        std = mass.totals.std_by_direction
        if np.any(makes > problem.totals * (1 + NEGLIGIBLE) + most_deviations(std.size) * std):
            given, least = (", ".join(f"{m:.4g}" for m in masses) for masses in (problem.totals, makes))
            more = f"the known entries of the mass make {least} kg or more, and {given} kg are stated in all"
            yield Finding("known entries", Severity.CONTRADICTS, more)


def _lumped_total(problem: Prepared, structure: Structure) -> Iterator[Finding]:
    """The total of a lumped mass, a sum over the sensors of a direction, is not what moves in that direction."""
    totals, geometry = problem.formulation.mass.totals, problem.geometry
    if totals is None or totals.kind != "sensors":
        return
    moves = np.einsum("j,ji->i", np.diag(structure.mass)[: geometry.n], geometry.rigid_body**2)
    has_sensors = np.isin(np.arange(geometry.d), geometry.directions[: geometry.n])
    off = np.abs(moves / totals.values - 1) > 1e-6
    for i in np.flatnonzero(geometry.translational & has_sensors & off):
        yield Finding(
            "lumped total", Severity.CONTRADICTS,
            f"{totals.values[i]:.4g} kg are stated over the sensors of base direction {i + 1}, but their masses "
            f"make {moves[i]:.4g} kg in it: a lumped mass needs sensors along the base directions, not skew ones",
            numbers={"direction": i + 1.0, "stated": float(totals.values[i]), "made": float(moves[i])},
        )  # fmt: skip


def force_misfit(formulation: Formulation, test: Measurement, structure: Structure) -> Iterator[Finding]:
    """The base force is not that of the modes that the accelerations show."""
    if test.force is None:
        return
    entries, n = formulation.mass.entries, formulation.geometry.n
    # Masses are open, and none of them is below the sensors.
    lumped = not formulation.mass.free and entries is not None and np.isnan(entries).any() and not entries[:, n:].any()
    fixture = (
        ", and mass below the sensors (base ring, fixture), which a full mass may have, a lumped one not"
        if lumped
        else ""
    )
    # Both misfits in units of the stated noise: what is left at a noisy peak speaks against nothing.
    left = replace(test, force=test.force - test.predict_force(structure))
    misfit = float(np.sqrt(Records(left, force=True).size / Records(test, force=True).size))
    possible = max(force_residual_left(test, *distinct_poles(structure), velocity=not structure.modal_damping), EXACT)
    if misfit > max(MISFIT * possible, NEGLIGIBLE):
        yield Finding(
            "force misfit", Severity.CONTRADICTS,
            f"the base force misses what the modes of the accelerations make of it by {100 * misfit:.3g} % "
            f"(free residues leave {100 * possible:.3g} %)",
            f"check its sign, unit, axes and point of reference{fixture}",
            numbers={"misfit": misfit, "free residues": possible},
        )  # fmt: skip
