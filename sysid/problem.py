"""An identification problem: a measurement, a model of each matrix, and the search space that they span."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.damping import DampingModel, ModalDamping
from sysid.errors import InputError
from sysid.layout import Layout
from sysid.mass import FullMass, KnownMass, LumpedMass, MassModel
from sysid.measurement import Measurement
from sysid.poles import Poles, find_poles
from sysid.response import columns, weighed_mass
from sysid.stiffness import SpectralStiffness, StiffnessModel
from sysid.structure import Array, Structure, finite_array
from sysid.variables import Variable, split


class Parts(NamedTuple):
    """Where each matrix's unknowns stand in x."""

    mass: slice
    stiffness: slice
    damping: slice


class Matrices(NamedTuple):
    """Everything that a vector of unknowns stands for, as numbers or expressions.

    ``factor`` is L, the Cholesky factor of M_SS (n, n); ``coupling`` M_S0 (n, d); ``base`` M_00 (d, d);
    ``mass_normalised`` H = L^-1 K_SS L^-T (n, n); ``damping`` the damping model's unknowns.
    """

    factor: ca.SX | Array
    coupling: ca.SX | Array
    base: ca.SX | Array
    mass_normalised: ca.SX | Array
    damping: ca.SX | Array


@dataclass(frozen=True, eq=False, repr=False)
class Problem:
    """What to identify, and from what.

    Parameters
    ----------
    measurement : Measurement
    mass : FullMass, LumpedMass, KnownMass or array_like
        An array is a known mass matrix.
    stiffness : SpectralStiffness or ChainStiffness
    damping : ModalDamping or ProportionalDamping
    reference : Structure, optional
        The truth, where it is known: for scores and pictures only.
    validation : sequence of Measurement
        Tests that are predicted and never fitted.
    goal : float, optional
        Relative residual at which the identification counts as a success.

    Attributes
    ----------
    variables : tuple of Variable
        Of the mass, the stiffness and the damping, in this order (eq. 34).
    lower, upper : (n_variables,)
        The search space, in the variables' own units.
    totals : (d,)
        Total mass in each base direction: stated, else weighed by the base force, else 1 kg.
    layout : Layout
        Geometry of the test, as the matrix models see it.
    poles : Poles or None
        What was found in the data where a spectral stiffness came without natural frequencies.
    """

    measurement: Measurement
    mass: MassModel = field(kw_only=True)
    stiffness: StiffnessModel = field(default_factory=SpectralStiffness, kw_only=True)
    damping: DampingModel = field(default_factory=ModalDamping, kw_only=True)
    reference: Structure | None = field(default=None, kw_only=True)
    validation: Sequence[Measurement] = field(default=(), kw_only=True)
    goal: float | None = field(default=None, kw_only=True)

    layout: Layout = field(init=False, repr=False)
    variables: tuple[Variable, ...] = field(init=False, repr=False)
    totals: Array = field(init=False, repr=False)
    poles: Poles | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 - a frozen class fills itself
        if not isinstance(self.measurement, Measurement):
            raise InputError(f"Problem: measurement is a {type(self.measurement).__name__}, not a sysid.Measurement")
        if not isinstance(self.mass, FullMass | LumpedMass | KnownMass):
            put("mass", KnownMass(_as_matrix("mass", self.mass)))
        for name, kinds in (("stiffness", StiffnessModel), ("damping", DampingModel)):
            if not isinstance(getattr(self, name), kinds):
                raise InputError(
                    f"Problem: {name} is a {type(getattr(self, name)).__name__}, not a {name} model of sysid"
                )
        if self.goal is not None and not finite_array("goal", self.goal) > 0:
            raise InputError(f"goal = {self.goal}: a positive relative residual is needed")
        test = self.measurement
        if isinstance(self.stiffness, SpectralStiffness) and self.stiffness.natural_frequencies is None:
            put("poles", find_poles(test))
            assert self.poles is not None
            found, n = self.poles.omega / (2 * np.pi), test.n_sensors
            # With fewer modes than sensors the model's other frequencies are anybody's guess.
            limit = self.stiffness.max_frequency or (None if found.size >= n else max(test.freq[-1], found[-1]))
            put("stiffness", SpectralStiffness(found[:n], limit))
        layout = Layout(test.rigid_body, test.translational)
        if test.force is not None and not np.all(np.any(test.force, axis=(0, 2))):
            at = np.flatnonzero(~np.any(test.force, axis=(0, 2)))
            names = ", ".join(test.base_axes[i] if test.base_axes else f"direction {i + 1}" for i in at)
            raise InputError(
                f"the base force is zero in {names}: is a load cell dead? Leave the force or that axis out"
            )
        if np.linalg.norm(test.relative) <= 1e-12 * np.linalg.norm(test.response):
            raise InputError("no sensor moves relative to the base: there is nothing to identify from")
        if test.force is not None and not isinstance(self.mass, KnownMass) and self.mass.total_mass is None:
            layout = replace(layout, weighed=_weigh(test, self.stiffness))
        put("layout", layout)
        put("validation", tuple(self.validation))
        for other in self.validation:
            if other.rigid_body.shape != test.rigid_body.shape:
                raise InputError("a validation measurement has other sensors or base directions than the one fitted")
        if self.reference is not None and self.reference.rigid_body.shape != test.rigid_body.shape:
            raise InputError("the reference structure has other sensors or base directions than the measurement")
        put("variables", tuple(v for group in self._groups() for v in group))
        # A total mass that does not fit is refused here, not in the search.
        put("totals", self.mass.totals(layout))
        _ = self.known_mass  # so are known entries

    def __repr__(self) -> str:
        models = ", ".join(type(model).__name__ for model in (self.mass, self.stiffness, self.damping))
        return f"<Problem: {models}; {self.n_variables} unknowns; {self.measurement!r}>"

    def _groups(self) -> tuple[tuple[Variable, ...], ...]:
        return tuple(model.variables(self.layout) for model in (self.mass, self.stiffness, self.damping))

    @property
    def lower(self) -> Array:
        """Lower bounds, (n_variables,)."""
        return np.concatenate([v.lower for v in self.variables])

    @property
    def upper(self) -> Array:
        """Upper bounds, (n_variables,)."""
        return np.concatenate([v.upper for v in self.variables])

    @property
    def n_variables(self) -> int:
        """Number of scalar unknowns (the paper's D)."""
        return sum(v.size for v in self.variables)

    @property
    def parts(self) -> Parts:
        """Slices of x that belong to each matrix."""
        ends = np.cumsum([0, *(count for _, count in self.unknowns)]).tolist()
        return Parts(*(slice(a, b) for a, b in pairwise(ends)))

    @property
    def unknowns(self) -> tuple[tuple[str, int], ...]:
        """Number of unknowns a matrix: the paper's Table 1, with the n·d entries of M_S0 that it leaves out."""
        names = ("mass", "stiffness", "damping")
        return tuple((name, sum(v.size for v in group)) for name, group in zip(names, self._groups(), strict=True))

    @property
    def unit_mass(self) -> bool:
        """Whether no number with a unit of mass is given, so that masses are normalised to 1 kg a direction."""
        unstated = not isinstance(self.mass, KnownMass) and self.mass.total_mass is None
        weighed = self.measurement.force is not None or np.nansum(np.abs(self.known_mass)) > 0
        return unstated and not weighed

    @property
    def known_mass(self) -> Array:
        """Entries of ``[M_SS, M_S0]`` that a full mass states to be known, (n, n + d); NaN elsewhere."""
        if isinstance(self.mass, FullMass):
            return self.mass.known_entries(self.layout)
        return np.full((self.layout.n, self.layout.n + self.layout.d), np.nan)

    @property
    def rigid_total(self) -> Array | None:
        """Rigid-body mass (d, d) where a full mass states all of it, else None."""
        return self.layout.rigid_total(self.mass.total_mass) if isinstance(self.mass, FullMass) else None

    def matrices(self, x: ca.SX) -> Matrices:
        """Expressions of the blocks that the unknowns `x` stand for."""
        y_mass, y_stiffness, y_damping = (x[part] for part in self.parts)
        blocks = self.mass.blocks(self.layout, y_mass)
        H = self.stiffness.mass_normalised(self.layout, y_stiffness, blocks.factor)
        return Matrices(*blocks, H, y_damping)

    def structure(self, x: ArrayLike) -> Structure:
        """The structure that the unknowns `x`, (n_variables,) in the variables' own units, stand for."""
        values = np.asarray(x, dtype=float)
        if values.shape != (self.n_variables,):
            raise InputError(f"x has shape {values.shape}; this problem has ({self.n_variables},) unknowns")
        symbols = ca.SX.sym("x", self.n_variables)
        function = ca.Function("matrices", [symbols], list(self.matrices(symbols)))
        L, coupling, base, H, c = (np.asarray(m) for m in function(values))
        omega = np.sqrt(np.linalg.eigvalsh((H + H.T) / 2))
        ratios = np.asarray(ca.evalf(self.damping.ratios(ca.DM(c), ca.DM(omega)))).ravel()
        return assemble(
            L @ L.T, coupling, base, L @ H @ L.T, ratios, self.layout.rigid_body, sensors=self.measurement.sensors
        )

    def values(self, structure: Structure) -> Array:
        """Unknowns that stand for `structure`, (n_variables,); inverse of `structure` where the models can hold it."""
        n = self.layout.n
        L = np.linalg.cholesky(structure.mass[:n, :n])
        half = np.linalg.solve(L, structure.stiffness[:n, :n])
        H = np.linalg.solve(L, half.T)
        omega = 2 * np.pi * structure.natural_frequencies
        return np.concatenate(
            [
                self.mass.values(self.layout, structure.mass),
                self.stiffness.values(self.layout, (H + H.T) / 2, structure.stiffness),
                self.damping.values(structure.damping_ratios, omega),
            ]
        )

    def from_sampling(self, s: ca.SX) -> ca.SX:
        """Unknowns of the swarm's coordinates, which have the same bounds (eq. 18)."""
        pieces = split(self.variables, s)
        return ca.vertcat(
            *(p if v.sampling is None else v.sampling(p) for v, p in zip(self.variables, pieces, strict=True))
        )

    def to_sampling(self, x: Array) -> Array:
        """Swarm coordinates of the unknowns `x`, clipped to the box."""
        x = np.clip(x, self.lower, self.upper)
        pieces = split(self.variables, x)
        s = [p if v.unsampling is None else v.unsampling(p) for v, p in zip(self.variables, pieces, strict=True)]
        return np.clip(np.concatenate(s), self.lower, self.upper)


def assemble(
    M_SS: Array, M_S0: Array, M_00: Array, K_SS: Array, ratios: Array, G: Array, *, sensors: Sequence | None = None
) -> Structure:
    """Structure from its blocks; the base rows of K follow from ``K_S0 = -K_SS G``."""
    K_S0 = -K_SS @ G
    return Structure(
        np.block([[M_SS, M_S0], [M_S0.T, M_00]]),
        np.block([[K_SS, K_S0], [K_S0.T, -G.T @ K_S0]]),
        ratios,
        n_base=G.shape[1],
        sensors=sensors,
    )


def _as_matrix(name: str, value: object) -> Array:
    try:
        matrix = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.ndim != 2:
        raise InputError(f"Problem: {name} is a {type(value).__name__}; give a model such as FullMass(kg) or a matrix")
    return matrix


def _weigh(test: Measurement, stiffness: StiffnessModel) -> Array:
    """Rough rigid-body mass of each base direction from the base force, (d,): it only places the search."""
    assert test.force is not None
    moved = np.linalg.norm(columns(test.base), axis=1)
    if np.any(moved == 0):
        raise InputError(
            f"the base moves in only {np.count_nonzero(moved)} of {test.n_base} independent directions: the base force "
            "weighs nothing in the others; add runs that move them, describe the test by the directions that move, "
            "or state total_mass"
        )
    omega = stiffness.targets if isinstance(stiffness, SpectralStiffness) else np.zeros(0)
    freq = omega / (2 * np.pi)
    # Away from resonance the damping, which is not known yet, hardly matters.
    away = np.all(np.abs(test.freq / freq[:, None] - 1) > 0.1, axis=0)
    quiet = test if np.count_nonzero(away) < 2 * (freq.size + 1) else test.at(away)
    mass = np.diag(weighed_mass(quiet, omega, np.full(omega.size, 0.01)))
    if np.all(mass > 0):
        return mass
    if freq.size and test.freq[0] < 0.3 * freq[0]:
        raise InputError(
            f"the base force gives a mass of {mass.min():.3g} kg, with lines well below the first mode: check its sign "
            "(it is the base's on the structure, in phase with the base acceleration at low frequency) and its unit"
        )
    return np.linalg.norm(columns(test.force), axis=1) / moved
