"""The geometry of a test, as the matrix models see it."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError
from sysid.models.unknowns import Block
from sysid.structure.structure import Array, finite_array

# A Cholesky diagonal of zero makes the mode shapes infinite; one of 1e-3 already spans a
# condition number of 1e6, more than any test resolves.
FACTOR_FLOOR = 1e-3


@dataclass(frozen=True, eq=False)
class Layout:
    """What the matrix models must know of a test.

    Parameters
    ----------
    rigid_body : ndarray, shape (n, d)
        G, motion of the sensors for unit base motion.
    translational : ndarray of bool, shape (d,)
        Which base directions are translations.
    weighed : ndarray, shape (d,), optional
        Rigid-body mass a direction that a measured base force suggests. A total that is not
        stated is then an unknown, searched around it.
    """

    rigid_body: Array
    translational: NDArray[np.bool_]
    weighed: Array | None = None

    @property
    def n(self) -> int:
        """Number of sensors."""
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

    def total_variables(self, total_mass: ArrayLike | None) -> tuple[Block, ...]:
        """The totals as unknowns, where they are not stated and the base force tells them."""
        if total_mass is not None or self.weighed is None:
            return ()
        # Skew sensors may all belong to one direction, which then carries what the force weighs in all.
        upper = np.where(self.translational, self.weighed[self.translational].sum(), self.weighed)
        return (Block("total_mass", self.weighed / 4, upper * 4, unit="kg"),)

    def split_totals(self, total_mass: ArrayLike | None, y: ca.SX) -> tuple[ca.SX | Array, ca.SX]:
        """Totals, stated or the first of the unknowns `y`, and the unknowns left."""
        if self.total_variables(total_mass):
            return y[: self.d], y[self.d :]
        return self.totals(total_mass), y

    def totals(self, total_mass: ArrayLike | None) -> Array:
        """Total mass in each base direction, (d,): kg, or kg m² where the direction is a rotation."""
        if total_mass is None and self.weighed is not None:
            return self.weighed
        if total_mass is None:
            # Unit mass; a rotation carries it at the radius of gyration of the sensors.
            lever = np.sqrt(np.mean(self.rigid_body**2, axis=0))
            return np.where(self.translational, 1.0, np.where(lever > 0, lever**2, 1.0))
        whole = self.rigid_total(total_mass)
        given = finite_array("total_mass", total_mass) if whole is None else np.diag(whole)
        if given.ndim == 0:
            if not np.all(self.translational):
                raise InputError(
                    f"total_mass = {given:g} kg is one number but the base also rotates; "
                    f"give {self.d} numbers, kg for translations and kg m² for rotations"
                )
            given = np.full(self.d, float(given))
        if given.shape != (self.d,):
            raise InputError(
                f"total_mass has shape {given.shape}; one number, ({self.d},) or ({self.d}, {self.d}) is needed"
            )
        if np.any(given <= 0):
            raise InputError(f"total_mass = {np.array2string(given)}: masses must be positive")
        return given

    def rigid_total(self, total_mass: ArrayLike | None) -> Array | None:
        """The rigid-body mass (d, d) where all of it is stated, else None."""
        if total_mass is None:
            return None
        given = finite_array("total_mass", total_mass)
        if given.ndim < 2:
            return None
        if given.shape != (self.d, self.d):
            raise InputError(f"total_mass has shape {given.shape}; ({self.d}, {self.d}) is needed of a rigid-body mass")
        if np.any(np.diag(given) <= 0):
            raise InputError(f"total_mass = {np.array2string(np.diag(given))} on its diagonal: masses must be positive")
        size = np.sqrt(np.diag(given))
        scaled = given / np.outer(size, size)
        if np.abs(scaled - scaled.T).max() > 1e-9 or np.linalg.eigvalsh(scaled)[0] <= 0:
            raise InputError("total_mass is no rigid-body mass: it must be symmetric and positive definite")
        return given
