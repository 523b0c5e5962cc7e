"""An identification problem: a measurement, its matrices as models, numbers or expressions, and the search space."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from types import FrameType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import columns, weighed_mass
from sysid.modal_analysis.vector_fitting import Poles, find_poles
from sysid.models.damping import DampingModel, ModalDamping
from sysid.models.geometry import Layout
from sysid.models.mass import FullMass, KnownMass, LumpedMass, MassBlocks, MassModel
from sysid.models.stiffness import SpectralStiffness, StiffnessModel
from sysid.models.unknowns import Block, Variable, call_site, split, user_frame
from sysid.problem.blocks import Given, is_expression
from sysid.problem.feasibility import HELD, LOOSE, check_constraints, check_matrices, points_of, unused, violation_of
from sysid.problem.formulation import Formulation, formulate, relative_error
from sysid.problem.stored import check_storable
from sysid.structure.structure import Array, Structure, finite_array


class Parts(NamedTuple):
    """Where each matrix's unknowns stand in x."""

    mass: slice
    stiffness: slice
    damping: slice


class ModelMatrices(NamedTuple):
    """Everything that the unknowns of models stand for, as expressions.

    ``factor`` is L, the Cholesky factor of M_SS (n, n); ``coupling`` M_S0 (n, d); ``base`` M_00 (d, d);
    ``mass_normalised`` H = L^-1 K_SS L^-T (n, n); ``damping`` the damping model's unknowns.
    """

    factor: ca.SX
    coupling: ca.SX
    base: ca.SX
    mass_normalised: ca.SX
    damping: ca.SX


@dataclass(frozen=True, eq=False, repr=False)
class Problem:
    """What to identify, and from what.

    Parameters
    ----------
    measurement : Measurement
    mass : FullMass, LumpedMass, KnownMass, array_like or expression
        An array is a known mass matrix. An expression is written in `Variable` s, (n, n) or with the base's rows last
        (n + d, n + d).
    stiffness : SpectralStiffness, ChainStiffness, array_like or expression
        A matrix is (n, n) or (n + d, n + d).
    damping : ModalDamping, ProportionalDamping, array_like or expression
        (n, n) is C on the motion relative to the base; (n,) is one damping ratio a mode, in ascending frequency.
    residuals : sequence of Misfit, Known or expressions
        Minimised in the least-squares sense beside the misfit of the measurement, whose norm is 1 where nothing is
        explained: a further test (`sysid.Misfit`), or what is known to some accuracy (`sysid.Known`). The rows of an
        expression count like one number of the test each, as exact as its noise.
    constraints : sequence of relations
        Such as ``k[0] <= k[1]`` or ``ca.sum1(m) == 900``. IPOPT holds them exactly; in the swarm a candidate that
        breaks them less is better, whatever its residual, and any that keeps them is better than these.
    misfit : expression, optional
        What is minimised in the place of the misfit of the measurement: a column of relative residuals.
    recovery : array_like (n_sensors, n), optional
        Takes n degrees of freedom to the sensors, where they are not one and the same.
    rigid_body_dofs : array_like (n, d), optional
        Motion of the degrees of freedom with a rigid base; needed beside `recovery` where the stiffness has no base
        columns to tell it.
    healing : mapping of Variable to expression
        What each candidate of the swarm passes through: the way to meet an equality before IPOPT does, such as
        ``{m: 900 * m / ca.sum1(m)}``.
    reference : Structure, optional
        The truth, where it is known: for scores and pictures only.
    validation : sequence of Measurement
        Tests that are predicted and never fitted.
    goal : float, optional
        Relative residual at which the identification counts as a success.

    Attributes
    ----------
    variables : tuple of Block or Variable
        Of the models of mass, stiffness and damping, in this order (eq. 34), then those of expressions as declared.
    lower, upper : (n_variables,)
        The search space, in the variables' own units.
    totals : (d,)
        Total mass in each base direction: stated, else weighed by the base force, else 1 kg; of a problem written in
        expressions what moves with the base at the guess.
    layout : Layout
        Geometry of the test, as the matrix models see it.
    tolerance : (rows,)
        By how much a candidate of the swarm may break each row of the constraints.
    poles : Poles or None
        What was found in the data where a spectral stiffness came without natural frequencies.
    """

    measurement: Measurement
    mass: MassModel | Any = field(kw_only=True)
    stiffness: StiffnessModel | Any = field(default_factory=SpectralStiffness, kw_only=True)
    damping: DampingModel | Any = field(default_factory=ModalDamping, kw_only=True)
    residuals: Sequence[Any] = field(default=(), kw_only=True)
    constraints: Sequence[Any] = field(default=(), kw_only=True)
    misfit: Any = field(default=None, kw_only=True)
    recovery: ArrayLike | None = field(default=None, kw_only=True)
    rigid_body_dofs: ArrayLike | None = field(default=None, kw_only=True)
    healing: Mapping[Variable, Any] = field(default_factory=dict, kw_only=True)
    reference: Structure | None = field(default=None, kw_only=True)
    validation: Sequence[Measurement] = field(default=(), kw_only=True)
    goal: float | None = field(default=None, kw_only=True)

    layout: Layout = field(init=False, repr=False)
    tolerance: Array = field(init=False, repr=False, default_factory=lambda: np.zeros(0))
    variables: tuple[Block | Variable, ...] = field(init=False, repr=False)
    totals: Array = field(init=False, repr=False)
    poles: Poles | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 - a frozen class fills itself
        if not isinstance(self.measurement, Measurement):
            raise InputError(f"Problem: measurement is a {type(self.measurement).__name__}, not a sysid.Measurement")
        if not isinstance(self.mass, FullMass | LumpedMass | KnownMass) and not is_expression(self.mass):
            put("mass", KnownMass(_as_matrix("mass", self.mass)))
        for name, kinds in (("stiffness", StiffnessModel), ("damping", DampingModel)):
            given = getattr(self, name)
            if not (isinstance(given, kinds) or is_expression(given)):
                least = 1 if name == "damping" else 2
                put(name, _as_matrix(name, given, f"a {name} model of sysid, an expression or a matrix", least))
        for name in ("residuals", "constraints", "validation"):
            given = getattr(self, name)
            if not isinstance(given, list | tuple):
                raise InputError(f"Problem: {name} is a {type(given).__name__}; give a list of them: {name}=[...]")
            put(name, tuple(given))
        if not isinstance(self.healing, Mapping) or not all(isinstance(v, Variable) for v in self.healing):
            raise InputError(
                "Problem: healing is a dictionary from variables to expressions: healing={m: 9 * m / ca.sum1(m)}"
            )
        if self.reference is not None and not isinstance(self.reference, Structure):
            raise InputError(f"Problem: reference is a {type(self.reference).__name__}, not a sysid.Structure")
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
        if test.force is not None and isinstance(self.mass, FullMass | LumpedMass) and self.mass.total_mass is None:
            layout = replace(layout, weighed=_weigh(test, self.stiffness))
        put("layout", layout)
        for other in self.validation:
            if other.rigid_body.shape != test.rigid_body.shape:
                raise InputError("a validation measurement has other sensors or base directions than the one fitted")
        if self.reference is not None and self.reference.rigid_body.shape != test.rigid_body.shape:
            raise InputError("the reference structure has other sensors or base directions than the measurement")
        if self.is_written:
            self._check_written(user_frame())
            put("variables", self.formulation.variables)
            M, M_S0, M_00, *_ = self.formulation.matrices.numbers(self.formulation.guess)
            G = self.formulation.matrices.rigid_body_dofs
            put("totals", np.diag(G.T @ M @ G + G.T @ M_S0 + M_S0.T @ G + M_00).copy())
            return
        put("variables", tuple(v for group in self._groups() for v in group))
        # A total mass that does not fit is refused here, not in the search.
        put("totals", self.mass.totals(layout))
        _ = self.known_mass  # so are known entries

    @property
    def is_written(self) -> bool:
        """Whether anything is written in expressions or numbers, beyond the models of the matrices."""
        models = isinstance(self.mass, FullMass | LumpedMass | KnownMass)
        models = models and isinstance(self.stiffness, StiffnessModel) and isinstance(self.damping, DampingModel)
        return (
            not models
            or bool(self.residuals or self.constraints or self.healing)
            or any(given is not None for given in (self.misfit, self.recovery, self.rigid_body_dofs))
        )

    @property
    def free_modes(self) -> bool:
        """Whether mode shapes and participations are free: a full mass with a spectral stiffness, and nothing else."""
        models = isinstance(self.mass, FullMass) and isinstance(self.stiffness, SpectralStiffness)
        return models and not self.is_written

    @cached_property
    def formulation(self) -> Formulation:
        """Matrices, residuals and constraints as CasADi functions of the unknowns."""
        return self.formulate(self.layout)

    def formulate(self, layout: Layout) -> Formulation:
        """The same with another layout."""
        given = Given(
            self.mass, self.stiffness, self.damping, self.residuals, self.constraints, self.misfit, self.recovery,
            self.rigid_body_dofs, self.healing,
        )  # fmt: skip
        return formulate(given, layout, self.measurement)

    def _check_written(self, frame: FrameType | None) -> None:
        """Refuse what cannot be searched, before anything runs."""
        if isinstance(self.mass, FullMass) and not self.mass.healable:
            raise InputError("known entries of a FullMass go with the modal strategy only: write them as constraints")
        formulation, site = self.formulation, call_site(frame)
        points = points_of(formulation)
        check_matrices(formulation, points, self.measurement, site)
        check_storable(formulation)
        tolerance = check_constraints(formulation, points, site) if formulation.constraints else np.zeros(0)
        object.__setattr__(self, "tolerance", tolerance)
        for variable in (*formulation.variables, *formulation.fixed):
            if isinstance(variable, Variable):
                variable.used = True
        idle = unused(frame, formulation)
        if idle:
            told = ", ".join(f"{v.name!r} ({v.declared})" for v in idle)
            told = f"variable {told} enters no matrix, residual or constraint of this problem ({site})"
            assert frame is not None
            if frame.f_code.co_name != "<module>":
                raise InputError(f"{told}: use it, or take it out")
            warnings.warn(told, stacklevel=2)  # a notebook may keep it for a problem to come

    def __repr__(self) -> str:
        models = ", ".join(type(model).__name__ for model in (self.mass, self.stiffness, self.damping))
        return f"<Problem: {models}; {self.n_variables} unknowns; {self.measurement!r}>"

    def _groups(self) -> tuple[tuple[Block, ...], ...]:
        return tuple(model.variables(self.layout) for model in (self.mass, self.stiffness, self.damping))

    @property
    def lower(self) -> Array:
        """Lower bounds, (n_variables,)."""
        return np.concatenate([np.zeros(0), *(v.lower for v in self.variables)])

    @property
    def upper(self) -> Array:
        """Upper bounds, (n_variables,)."""
        return np.concatenate([np.zeros(0), *(v.upper for v in self.variables)])

    @property
    def n_variables(self) -> int:
        """Number of scalar unknowns (the paper's D)."""
        return sum(v.size for v in self.variables)

    @property
    def parts(self) -> Parts:
        """Slices of x that belong to each matrix, for a problem of models alone."""
        if self.is_written:
            raise InputError("unknowns of a problem in expressions belong to no one matrix: see formulation.members")
        ends = np.cumsum([0, *(count for _, count in self.unknowns)]).tolist()
        return Parts(*(slice(a, b) for a, b in pairwise(ends)))

    @property
    def unknowns(self) -> tuple[tuple[str, int], ...]:
        """Number of unknowns a matrix: the paper's Table 1, with the n·d entries of M_S0 that it leaves out."""
        if self.is_written:
            sizes = {v.name: v.size for v in self.variables}
            return tuple((name, sum(sizes[v] for v in members)) for name, members in self.formulation.members)
        names = ("mass", "stiffness", "damping")
        return tuple((name, sum(v.size for v in group)) for name, group in zip(names, self._groups(), strict=True))

    @property
    def unit_mass(self) -> bool:
        """Whether no number with a unit of mass is given, so that masses are normalised to 1 kg a direction."""
        if not isinstance(self.mass, FullMass | LumpedMass | KnownMass):
            return False
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

    def matrices(self, x: ca.SX) -> ModelMatrices:
        """Expressions of the blocks that the unknowns `x` stand for, in a problem of models alone."""
        y_mass, y_stiffness, y_damping = (x[part] for part in self.parts)
        blocks: MassBlocks = self.mass.blocks(self.layout, y_mass)
        H = self.stiffness.mass_normalised(self.layout, y_stiffness, blocks.factor)
        return ModelMatrices(*blocks, H, y_damping)

    def structure(self, x: ArrayLike) -> Structure:
        """The structure that the unknowns `x`, (n_variables,) in the variables' own units, stand for."""
        values = np.asarray(x, dtype=float)
        if values.shape != (self.n_variables,):
            raise InputError(f"x has shape {values.shape}; this problem has ({self.n_variables},) unknowns")
        if self.is_written:
            return self.formulation.matrices.structure(values, self.measurement)
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
        if self.is_written:
            raise InputError("a problem written in expressions has no inverse: give the unknowns, not a Structure")
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

    def residual_of(self, x: Array) -> float:
        """Relative residual of the measurement at `x`, or, where the problem has one, of its own misfit."""
        if self.is_written and self.formulation.misfit is not None:
            return float(np.linalg.norm(self.formulation.misfit(x)))
        return self.measurement.residual(self.structure(x))

    def misfit_of(self, x: Array) -> float:
        """Root of the sum of squares of all relative residuals: of accelerations, force, and what else was stated."""
        if not self.is_written:
            structure, test = self.structure(x), self.measurement
            return float(np.hypot(test.residual(structure), test.force_residual(structure) or 0.0))
        f = self.formulation
        parts = [float(np.sqrt(self.own_squares(x)))]
        parts += [] if f.misfit is None else [float(np.linalg.norm(f.misfit(x)))]
        parts += [] if f.misfit is not None else [relative_error(self.measurement, f.matrices, x)]
        parts += [s * relative_error(test, m, x) for s, (test, m) in zip(f.shares, f.others, strict=True)]
        return float(np.linalg.norm(parts))

    def keeps_constraints(self, x: Array) -> bool:
        """Whether constraints hold, to round-off beside what they make over the search space."""
        constraints = self.formulation.constraints if self.is_written else None
        if constraints is None:
            return True
        over = violation_of(constraints.lower, constraints.upper, np.asarray(constraints.function(x)).ravel())
        equal = constraints.lower == constraints.upper
        return bool(np.all(over <= self.tolerance * np.where(equal, HELD / LOOSE, 1.0)))

    def rank_of(self, x: Array) -> tuple[bool, float]:
        """By which answers are compared: constraints first, then the misfit."""
        misfit = self.misfit_of(x)
        return not self.keeps_constraints(x), misfit if np.isfinite(misfit) else np.inf

    def own_squares(self, x: Array) -> float:
        """Sum of squares of the residuals that are stated beside the tests."""
        f = self.formulation
        own = 0.0 if f.residuals is None else float(np.sum(np.square(f.residuals(x))))
        return own if f.known is None else own + float(np.sum(np.square(f.level * f.known(x))))

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


def _as_matrix(
    name: str, value: object, wanted: str = "a model such as FullMass(kg) or a matrix", least: int = 2
) -> Array:
    try:
        matrix = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(())
    if not least <= matrix.ndim <= 2:
        raise InputError(f"Problem: {name} is a {type(value).__name__}; give {wanted}")
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
