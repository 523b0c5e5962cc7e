"""The result of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.models.unknowns import by_name
from sysid.problem.problem import Problem
from sysid.search.strategy import History
from sysid.structure.structure import Array, ComplexArray, Structure

if TYPE_CHECKING:
    from sysid.assessment.modal_mass_cone import Intervals
    from sysid.assessment.uncertainty import Uncertainty

_QUICK_SHAPES = 1000  # entries of the mode shapes up to which uncertainty takes a second or less
_QUICK_DOFS = 20  # degrees of freedom up to which intervals take a few seconds or less


@dataclass(frozen=True)
class Recipe:
    """What rebuilds a problem elsewhere: its module and what was passed to ``problem()``.

    Attributes
    ----------
    module : str
        As given on the command line: a name, a path, or a dotted module.
    data : str or None
    rng : int
    """

    module: str
    data: str | None = None
    rng: int = 0


@dataclass(frozen=True, eq=False, repr=False)
class Identification:
    """A structure identified from a base-shake test, and how far it can be trusted.

    Attributes
    ----------
    structure : Structure
    problem : Problem
    x : (n_variables,) or None
        The problem's unknowns that stand for the structure; None where the modal strategy chose other degrees of
        freedom than the sensors.
    strategy : str
    seed : int or None
    success : bool
        The last solver's status is good, and the residual meets the goal; where none is given it must
        at least be below one half.
    message : str
    history : History
    determined : bool
        Every entry of M_SS, K_SS and C is fixed by the data and the stated model, nothing speaks against the fit, and
        noise leaves each entry known to a tenth of the root of its two diagonal entries (standard deviation).
    closed_by, undetermined : tuple of str
        What fixes it, empty where anything is open; and what is open, in sentences.
    remarks : tuple of str
        How it was done, and why so, in sentences.
    interrupted : bool
        The search was stopped by Ctrl-C, and this is the best until then.
    recipe : Recipe or None
        Set where the problem came from a module.
    """

    structure: Structure
    problem: Problem
    x: Array | None
    strategy: str
    seed: int | None
    success: bool
    message: str
    history: History
    determined: bool
    closed_by: tuple[str, ...]
    undetermined: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    interrupted: bool = False
    recipe: Recipe | None = None

    def __repr__(self) -> str:
        word = "success" if self.success else "no success"
        known = "determined" if self.determined else "not determined"
        return f"<Identification: {word}, residual {self.residual:.3g}, {known}; {self.structure!r}>"

    @property
    def measurement(self) -> Measurement:
        """The test that was fitted."""
        return self.problem.measurement

    @property
    def residual(self) -> float:
        """``‖predicted - measured‖ / ‖measured‖`` over relative accelerations of all runs, sensors and lines.

        Of the problem's own misfit, where it has one.
        """
        if self.x is not None and self.problem.is_written:
            return self.problem.residual_of(self.x)
        return self.measurement.residual(self.structure)

    @cached_property
    def values(self) -> dict[str, Array]:
        """The problem's variables at the answer, by name and in their shapes, fixed ones too; empty where x is None."""
        if self.x is None:
            return {}
        found = by_name(self.problem.variables, self.x)
        if self.problem.is_written:
            found |= {v.name: v.shaped(v.guess) for v in self.problem.formulation.fixed}
        return found

    @property
    def further_tests(self) -> tuple[tuple[Measurement, Structure], ...]:
        """Tests that were fitted beside the problem's own (`sysid.Misfit`), and the structure as it was in each."""
        if self.x is None or not self.problem.is_written:
            return ()
        return tuple((test, matrices.structure(self.x, test)) for test, matrices in self.problem.formulation.others)

    @property
    def force_residual(self) -> float | None:
        """The same over the base force; None where none was measured."""
        return self.measurement.force_residual(self.structure)

    def predict(self, measurement: Measurement) -> ComplexArray:
        """Relative accelerations under another test's base motion, (runs, n_sensors, n_freq)."""
        return measurement.predict(self.structure)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Standard deviations and intervals that the measured noise makes; computed when first asked for.

        They hold where the fit is one: for the members that the data leave open see `mass_interval`.
        """
        from sysid.assessment.uncertainty import uncertainty
        from sysid.assessment.written_uncertainty import written_uncertainty

        if self.problem.is_written:
            assert self.x is not None
            return written_uncertainty(self.problem, self.x)
        return uncertainty(self.problem, self.structure)

    @property
    def covariance(self) -> Array:
        """Covariance of ``uncertainty.parameters``, (p, p)."""
        return self.uncertainty.covariance

    @property
    def mass_interval(self) -> Array:
        """Least and largest M_SS, entry by entry, over all models that explain the data and keep to what was stated.

        (2, n, n), kg; infinite where unbounded, equal where determined. Noise is not in it: see `uncertainty`.
        """
        return self._intervals.mass

    @property
    def stiffness_interval(self) -> Array:
        """The same of K_SS, (2, n, n), N/m."""
        return self._intervals.stiffness

    @cached_property
    def open_masses(self) -> tuple[int, ...]:
        """Modes, counted from 0, whose modal mass neither the records nor the stated models fix."""
        from sysid.assessment.modal_mass_cone import open_masses

        if self.problem.is_written:
            return ()
        return tuple(open_masses(self.problem, self.structure))

    @property
    def is_one_of_many(self) -> bool:
        """Whether other matrices explain the same data within what was stated."""
        if not self.problem.is_written:
            return bool(self.open_masses)
        ends = self._intervals
        return not (np.all(np.isfinite(ends.mass)) and np.all(np.isfinite(ends.stiffness)))

    @cached_property
    def _intervals(self) -> Intervals:
        from sysid.assessment.modal_mass_cone import intervals

        if self.problem.is_written:
            from sysid.assessment.determination import written_intervals

            assert self.x is not None
            return written_intervals(self.problem, self.x)
        return intervals(self.problem, self.structure)

    @property
    def mac(self) -> Array:
        """Modal assurance criterion against the reference where one is known, else against itself."""
        other = self.problem.reference or self.structure
        return modal_assurance(self.structure.mode_shapes, other.mode_shapes)

    @property
    def degrees_of_freedom(self) -> tuple[str, ...]:
        """What the rows of M_SS, K_SS and C stand for: a sensor's name, or "coordinate of mode 7"."""
        names, structure = self.measurement.sensor_names, self.structure
        return tuple(
            names[sensor] if sensor >= 0 else f"coordinate of mode {mode + 1}" if mode >= 0 else f"coordinate {j + 1}"
            for j, (sensor, mode) in enumerate(zip(structure.dof_sensors, structure.dof_modes, strict=True))
        )

    @property
    def quick_uncertainty(self) -> Uncertainty | None:
        """`uncertainty` where it is known already or takes no longer than about a second; else None."""
        known = "uncertainty" in self.__dict__
        return self.uncertainty if known or self.structure.mode_shapes.size <= _QUICK_SHAPES else None

    @property
    def quick_intervals(self) -> Intervals | None:
        """Both intervals where they are known already or take no longer than a few seconds; else None."""
        known = "_intervals" in self.__dict__
        return self._intervals if known or self.structure.n <= _QUICK_DOFS else None

    def summary(self) -> str:
        """Table of the result, for a terminal."""
        from sysid.results.summary import summary  # it reads Identifications, so it cannot be above this room

        return summary(self)

    def to_dict(self) -> dict[str, Any]:
        """The figures of ``summary.json``."""
        from sysid import __version__

        u, n = self.quick_uncertainty, self.structure.n
        return {
            "problem": self.recipe.module if self.recipe else None,
            "strategy": self.strategy,
            "seed": self.seed,
            "success": bool(self.success),
            "message": self.message,
            "residual": self.residual,
            "force_residual": self.force_residual,
            "natural_frequencies_hz": self.structure.natural_frequencies.tolist(),
            "natural_frequencies_std_hz": _known(None if u is None else u.natural_frequencies, n),
            "damping_ratios": self.structure.damping_ratios.tolist(),
            "damping_ratios_std": _known(None if u is None else u.damping_ratios, n),
            "unknowns": {} if not self.problem.is_written else {k: v.tolist() for k, v in self.values.items()},
            "unknowns_std": {}
            if not self.problem.is_written or u is None
            else {k: v.tolist() for k, v in u.variables.items()},
            "total_mass_kg": np.diag(self.structure.rigid_body_mass).tolist(),
            "determined": bool(self.determined),
            "closed_by": list(self.closed_by),
            "undetermined": list(self.undetermined),
            "remarks": list(self.remarks),
            "evaluations": int(self.history.evaluations),
            "wall_time_s": float(self.history.wall_time),
            "version": __version__,
        }

    def save(self, path: str | Path) -> Path:
        """Write everything to an HDF5 file (no pickle inside); `sysid.load` reads it back."""
        from sysid.results.storage import save  # storage builds Identifications, so it cannot be above this room

        return save(self, path)


def modal_assurance(phi: Array, other: Array) -> Array:
    """``|phi_i' phi_j|² / (phi_i' phi_i · phi_j' phi_j)``, (modes, other modes)."""
    if phi.shape[0] != other.shape[0]:
        raise InputError(f"mode shapes at {phi.shape[0]} and {other.shape[0]} sensors cannot be compared")
    return (phi.T @ other) ** 2 / np.outer(np.sum(phi**2, axis=0), np.sum(other**2, axis=0))


def _known(std: Array | None, n: int) -> list[float | None]:
    return [None] * n if std is None else [value if np.isfinite(value) else None for value in std.tolist()]
