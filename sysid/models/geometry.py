"""The geometry of a test, as the matrix models see it."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import asdict
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array, refuse, shown
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate, estimated_poles
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.vector_fitting import Poles
from sysid.models.unknowns import Unknown
from sysid.structure.structure import Array

# A Cholesky diagonal of zero makes the mode shapes infinite; one of 1e-3 already spans a
# condition number of 1e6, more than any test resolves.
FACTOR_FLOOR = 1e-3
_LIGHTEST, _HEAVIEST = 1e-12, 1e15  # kg or kg m²: beyond them no unit is right, and squares leave the range of floats


def check_total_mass(total_mass: ArrayLike | None) -> None:
    """Refuse a stated total that is wrong for any base: see `Geometry.totals` and `Geometry.rigid_total`."""
    if total_mass is None:
        return
    given = finite_array("total_mass", total_mass)
    masses = np.diag(given) if given.ndim == 2 else given
    refuse(
        (given.ndim > 2 or not given.size, f"total_mass has shape {given.shape}; one number, (d,) or (d, d) is needed"),
        (np.any(masses <= 0), f"total_mass = {shown(masses.tolist())}: masses must be positive"),
    )
    check_sane("total_mass", masses)


def check_sane(name: str, masses: Array) -> None:
    """Refuse masses that no structure has; zeros pass."""
    if np.any((masses != 0) & ((np.abs(masses) < _LIGHTEST) | (np.abs(masses) > _HEAVIEST))):
        raise InputError(
            f"{name} = {shown(masses.tolist())} is outside {_LIGHTEST:g} to {_HEAVIEST:g}; the unit is kg "
            "(kg m² where the base rotates)"
        )


class Geometry:
    """The geometry of a test's degrees of freedom, and what its records tell before any model is fitted.

    Poles and weights are found when they are first asked for, once.

    Parameters
    ----------
    modal : ModalEstimate
        Of the test.
    rigid_body : ndarray, shape (n, d), optional
        G, motion of the degrees of freedom for unit base motion; those of the sensors where it is not given.
    recovery : ndarray, shape (n_sensors, n), optional
        From degrees of freedom to sensors, where they are not one and the same.
    weighed : ndarray, shape (d,) or callable, optional
        Rigid-body mass a direction, or what finds it, that a measured base force suggests. A total that is not
        stated is then an unknown, searched around it.
    """

    def __init__(
        self,
        modal: ModalEstimate,
        rigid_body: Array | None = None,
        recovery: Array | None = None,
        weighed: Array | Callable[[], Array] | None = None,
    ) -> None:
        self.modal, test = modal, modal.records
        self.rigid_body = test.rigid_body if rigid_body is None else rigid_body
        self.recovery = np.eye(len(self.rigid_body)) if recovery is None else recovery
        self.translational = test.translational
        self._weighed = weighed
        self.monitor: Callable[[int, float], object] | None = None  # of a search for poles

    @property
    def test(self) -> Measurement:
        """The records that are fitted."""
        return self.modal.records

    @cached_property
    def poles(self) -> Poles:
        """Poles that stand out of the records."""
        return estimated_poles(self.modal, self.monitor)

    @cached_property
    def pole_ratios(self) -> Array:
        """Damping ratios of the poles that stand out of the records, by ascending frequency; (0,) where none does."""
        try:
            return self.poles.ratios
        except InputError:  # too few lines, or none stands out: who needs poles asks for them, and is told
            return np.zeros(0)

    @cached_property
    def natural_frequencies(self) -> Array:
        """Circular frequencies of the modes that stand out of the records, rad/s, ascending, at most n.

        A pole counts as often as its residue has rank, where the model has room for all.
        """
        omega, test = self.poles.omega, self.test
        if omega.size < self.n and test.n_base > 1 and not self.modal.by_modes:
            records = Records(test)
            free = records.fit(omega, self.poles.ratios)
            ranks = free.ranks(records.noise(free.left, free.residues.size), test.n_sensors, test.n_base)
            omega = np.repeat(omega, ranks) if ranks.sum() <= self.n else omega
        return omega[: self.n]

    @property
    def found(self) -> dict[str, Any] | None:
        """The poles where they were found already, for storing; None where they were not."""
        poles: Poles | None = self.__dict__.get("poles")
        return None if poles is None else asdict(poles)

    @found.setter
    def found(self, tree: dict[str, Any] | None) -> None:
        if tree is not None:
            self.__dict__["poles"] = Poles(**tree)

    @cached_property
    def weighed(self) -> Array | None:
        """Rigid-body mass a direction that the base force suggests, (d,); None where nothing is weighed."""
        return self._weighed() if callable(self._weighed) else self._weighed

    def unsearched(self) -> Geometry:
        """The same with made-up poles and weights, to check what is declared before anything is searched."""
        other = Geometry(self.modal, self.rigid_body, self.recovery, None if self._weighed is None else np.ones(self.d))
        low = 1e-6 * self.test.freq[-1]  # within any limit that is stated
        other.__dict__["poles"] = Poles(np.full(self.n, low), np.full(self.n, 0.01), 0.0)
        return other

    def weighing(self, totals: Array) -> Geometry:
        """The same with totals, where none are stated, as unknowns that are searched around these (d,)."""
        other = copy(self)
        other.__dict__.pop("weighed", None)
        other._weighed = totals
        return other

    @property
    def weighs(self) -> bool:
        """True where a total that is not stated is an unknown."""
        return self._weighed is not None

    @property
    def at_sensors(self) -> bool:
        """True where the degrees of freedom are the sensors."""
        return np.array_equal(self.recovery, np.eye(len(self.rigid_body)))

    @property
    def n(self) -> int:
        """Number of degrees of freedom."""
        return int(self.rigid_body.shape[0])

    @property
    def d(self) -> int:
        """Number of base directions."""
        return int(self.rigid_body.shape[1])

    @property
    def directions(self) -> Array:
        """Base direction of each row of the full mass matrix, (n + d,); -1 for none.

        A sensor belongs to the translation that moves it most, the first on a tie; a sensor that
        no translation moves belongs to none. A base row belongs to its own direction.
        """
        strength = np.abs(self.rigid_body) * self.translational
        # Direction cosines that differ by round-off are a tie.
        ties = strength >= strength.max(axis=1, keepdims=True) * (1 - 1e-9)
        groups = np.where(strength.max(axis=1) > 0, np.argmax(ties, axis=1), -1)
        return np.concatenate([groups, np.arange(self.d)])

    def total_unknowns(self, total_mass: ArrayLike | None) -> tuple[Unknown, ...]:
        """The totals as unknowns, where they are not stated and the base force tells them."""
        if total_mass is not None or not self.weighs:
            return ()
        moved = np.any(self.test.base, axis=(0, 2))
        if self.test.force is not None and not np.all(moved):
            raise InputError(
                f"the base moves in only {np.count_nonzero(moved)} of {self.d} independent directions: the base force "
                "weighs nothing in the others; add runs that move them, describe the test by the directions that move, "
                "or state total_mass"
            )
        assert self.weighed is not None
        # Skew sensors may all belong to one direction, which then carries what the force weighs in all.
        upper = np.where(self.translational, self.weighed[self.translational].sum(), self.weighed)
        return (Unknown("total_mass", self.weighed / 4, upper * 4, unit="kg"),)

    def split_totals(self, total_mass: ArrayLike | None, y: ca.SX) -> tuple[ca.SX | Array, ca.SX]:
        """Totals, stated or the first of the unknowns `y`, and the unknowns left."""
        if total_mass is None and self.weighs:
            return y[: self.d], y[self.d :]
        return self.totals(total_mass), y

    def totals(self, total_mass: ArrayLike | None) -> Array:
        """Total mass in each base direction, (d,): kg, or kg m² where the direction is a rotation."""
        if total_mass is None:
            return self._unstated_totals if self.weighed is None else self.weighed
        check_total_mass(total_mass)
        given = np.array(total_mass, dtype=float)
        whole = self.rigid_total(given)
        if whole is not None:
            return np.diag(whole)
        if given.ndim == 0 and not np.all(self.translational):
            raise InputError(
                f"total_mass = {given:g} kg is one number but the base also rotates; "
                f"give {self.d} numbers, kg for translations and kg m² for rotations"
            )
        if given.shape not in ((), (self.d,)):
            raise InputError(
                f"total_mass has shape {given.shape}; one number, ({self.d},) or ({self.d}, {self.d}) is needed"
            )
        return np.full(self.d, given)

    @property
    def _unstated_totals(self) -> Array:
        """Unit mass, (d,); a rotation carries it at the radius of gyration of the sensors."""
        lever = np.where(self.translational, 1.0, np.sqrt(np.mean(self.rigid_body**2, axis=0)))
        return np.where(lever > 0, lever**2, 1.0)

    def rigid_total(self, total_mass: ArrayLike | None) -> Array | None:
        """The rigid-body mass (d, d) where all of it is stated, else None."""
        if total_mass is None or np.ndim(total_mass) < 2:
            return None
        check_total_mass(total_mass)
        given = np.array(total_mass, dtype=float)
        if given.shape != (self.d, self.d):
            raise InputError(f"total_mass has shape {given.shape}; ({self.d}, {self.d}) is needed of a rigid-body mass")
        size = np.sqrt(np.diag(given))
        scaled = given / np.outer(size, size)
        if np.abs(scaled - scaled.T).max() > 1e-9 or np.linalg.eigvalsh(scaled)[0] <= 0:
            raise InputError("total_mass is no rigid-body mass: it must be symmetric and positive definite")
        return given
