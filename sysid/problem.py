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
from sysid.mass import FullMass, KnownMass, Layout, LumpedMass, MassModel
from sysid.measurement import Measurement
from sysid.refinement import closed_form, replace_spectrum
from sysid.response import Target, residual
from sysid.stiffness import SpectralStiffness, StiffnessModel
from sysid.structure import Array, Structure
from sysid.variables import Variable, split

_CHUNK = 64  # particles a compiled call: fixed, so that the bits do not depend on the swarm's size


class Parts(NamedTuple):
    """Where each matrix's unknowns stand in x."""

    mass: slice
    stiffness: slice
    damping: slice


class Matrices(NamedTuple):
    """Everything that a vector of unknowns stands for, as numbers or expressions.

    ``factor`` is L, the Cholesky factor of M_SS (n, n); ``coupling`` M_S0 (n, d); ``base`` M_00 (d, d);
    ``normalised`` H = L^-1 K_SS L^-T (n, n); ``damping`` the damping model's unknowns.
    """

    factor: ca.SX | Array
    coupling: ca.SX | Array
    base: ca.SX | Array
    normalised: ca.SX | Array
    damping: ca.SX | Array


@dataclass(frozen=True, eq=False)
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
        if self.goal is not None and not 0 < self.goal < np.inf:
            raise InputError(f"goal = {self.goal}: a positive relative residual is needed")
        test = self.measurement
        layout = Layout(test.rigid_body, test.translational)
        if test.force is not None:
            layout = replace(layout, weighed=_weigh(test, self.stiffness))
        put("layout", layout)
        put("validation", tuple(self.validation))
        for other in self.validation:
            if other.rigid_body.shape != test.rigid_body.shape:
                raise InputError("a validation measurement has other sensors or base directions than the one fitted")
        if self.reference is not None and self.reference.rigid_body.shape != test.rigid_body.shape:
            raise InputError("the reference structure has other sensors or base directions than the measurement")
        put("variables", tuple(v for group in self._groups() for v in group))
        self.totals  # noqa: B018 - a total mass that does not fit is refused here, not in the search

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
    def totals(self) -> Array:
        """Total mass in each base direction, (d,): stated, else weighed by the base force, else 1 kg."""
        if isinstance(self.mass, KnownMass):
            rigid = np.vstack([self.layout.rigid_body, np.eye(self.layout.d)])
            return np.einsum("ni,nm,mi->i", rigid, self.mass.full(self.layout), rigid)
        return self.layout.totals(self.mass.total_mass)

    @property
    def normalised(self) -> bool:
        """Whether no number with a unit of mass is given, so that masses are normalised to 1 kg a direction."""
        unstated = not isinstance(self.mass, KnownMass) and self.mass.total_mass is None
        return unstated and self.measurement.force is None

    @property
    def target(self) -> Target:
        """The records that the residual compares with."""
        test = self.measurement
        return Target(test.freq, test.base, test.relative, test.force)

    def matrices(self, x: ca.SX) -> Matrices:
        """Expressions of the blocks that the unknowns `x` stand for."""
        y_mass, y_stiffness, y_damping = (x[part] for part in self.parts)
        blocks = self.mass.blocks(self.layout, y_mass)
        H = self.stiffness.normalised(self.layout, y_stiffness, blocks.factor)
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


class SwarmCost:
    """Relative residual of a whole swarm at once: (n_particles, n_variables) → (n_particles,).

    Two compiled CasADi functions with LAPACK's batched eigensolver between them, which also does
    the eigenvalue refinement in closed form.

    Parameters
    ----------
    problem : Problem
    refine : bool
        Replace the spectrum of each candidate by the measured one, where the stiffness has one.
    threads : int
        The result does not depend on it.
    """

    def __init__(self, problem: Problem, *, refine: bool = True, threads: int = 2) -> None:
        self.problem = problem
        layout, D = problem.layout, problem.n_variables
        n, d = layout.n, layout.d
        s = ca.SX.sym("s", D)
        x = problem.from_sampling(s)
        blocks = problem.matrices(x)
        L, G = blocks.factor, ca.SX(layout.rigid_body)
        L_inverse = ca.densify(ca.solve(L, ca.SX.eye(n)))
        push = L @ (L.T @ G) + blocks.coupling
        rigid = G.T @ push + blocks.coupling.T @ G + blocks.base
        outputs = [ca.densify(block) for block in (L_inverse, push, blocks.normalised, rigid, blocks.damping)]
        self._expand = ca.Function("expand", [s], outputs).map(_CHUNK)
        self._unknowns = ca.Function("unknowns", [s], [x])

        shapes = {"phi": (n, n), "gamma": (n, d), "omega": (n, 1), "rigid": (d, d), "c": blocks.damping.shape}
        phi, gamma, omega, rigid_mx, c = (ca.MX.sym(name, *shape) for name, shape in shapes.items())
        forced = problem.target.force is not None
        miss = residual(
            problem.target, phi, gamma, omega, problem.damping.ratios(c, omega), rigid_mx if forced else None
        )
        cost = ca.sqrt(ca.sumsqr(miss))
        self._evaluate = ca.Function("cost", [phi, gamma, omega, rigid_mx, c], [cost]).map(
            _CHUNK, "thread" if threads > 1 else "serial", threads
        )
        stiffness = problem.stiffness
        self._targets = stiffness.targets if refine and isinstance(stiffness, SpectralStiffness) else None

    def __call__(self, particles: Array) -> Array:
        """Relative residual of each row; NaN where a candidate is no structure."""
        return np.concatenate(
            [self._chunk(particles[start : start + _CHUNK]) for start in range(0, len(particles), _CHUNK)]
        )

    def unknowns(self, s: Array) -> Array:
        """The unknowns x that the swarm coordinates `s` stand for."""
        return np.asarray(self._unknowns(s)).ravel()

    def refined(self, s: Array) -> Array:
        """The unknowns of the structure that `s` was given its cost for: its spectrum replaced."""
        x = self.unknowns(s)
        if self._targets is not None:
            n, part = self.problem.layout.n, self.problem.parts.stiffness
            factor = np.zeros((n, n))
            factor[np.tril_indices(n)] = x[part]
            x[part] = closed_form(factor, self._targets).factor[np.tril_indices(n)]
        return x

    def _chunk(self, particles: Array) -> Array:
        count = len(particles)
        padded = np.concatenate([particles, np.repeat(particles[-1:], _CHUNK - count, axis=0)])
        n = self.problem.layout.n
        flat = [np.asarray(block) for block in self._expand(padded.T)]
        L_inverse, push, H = (_stack(block, n) for block in flat[:3])
        # A candidate that is no structure must not stop the eigensolver for the others.
        broken = ~np.all(np.isfinite(H), axis=(1, 2))
        H[broken] = np.eye(n)
        lam, psi = np.linalg.eigh((H + H.transpose(0, 2, 1)) / 2)
        if self._targets is not None:
            lam = replace_spectrum(lam, self._targets)
        with np.errstate(invalid="ignore"):
            omega = np.sqrt(lam)
        phi = L_inverse.transpose(0, 2, 1) @ psi
        gamma = phi.transpose(0, 2, 1) @ push
        cost = self._evaluate(_wide(phi), _wide(gamma), omega.T, flat[3], flat[4])
        out = np.array(cost).ravel()[:count]
        out[broken[:count]] = np.nan
        return out


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


def _stack(wide: Array, rows: int) -> Array:
    """CasADi's side-by-side blocks (rows, count * columns) → (count, rows, columns)."""
    return np.ascontiguousarray(wide.reshape(rows, _CHUNK, -1).transpose(1, 0, 2))


def _wide(stack: Array) -> Array:
    """Inverse of `_stack`."""
    return stack.transpose(1, 0, 2).reshape(stack.shape[1], -1)


def _as_matrix(name: str, value: object) -> Array:
    try:
        matrix = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.ndim != 2:
        raise InputError(f"Problem: {name} is a {type(value).__name__}; give a model of sysid or a matrix")
    return matrix


def _weigh(test: Measurement, stiffness: StiffnessModel) -> Array:
    """Rough rigid-body mass of each base direction from the force at the lowest lines, (d,).

    Well below the first mode ``f_0 = (M_rb + w² E) u_0''``; it only places the search.
    """
    assert test.force is not None
    first = np.inf
    if isinstance(stiffness, SpectralStiffness):
        first = stiffness.targets[0] / (2 * np.pi)
    below = max(int(np.sum(test.freq < 0.5 * first)) if np.isfinite(first) else 0, 2 * test.n_base)
    u = np.moveaxis(test.base[..., :below], 1, 0).reshape(test.n_base, -1)
    f = np.moveaxis(test.force[..., :below], 1, 0).reshape(test.n_base, -1)
    w2 = np.tile((test.freq[:below] / test.freq[min(below, test.freq.size) - 1]) ** 2, test.n_runs)
    basis = np.vstack([u, u * w2])
    solution = np.linalg.lstsq(basis.T, f.T, rcond=None)[0]
    mass = np.diag(solution[: test.n_base].real)
    if np.any(mass <= 0):
        raise InputError(
            f"the base force at the lowest lines gives a mass of {mass.min():.3g} kg: check its sign (the force is the "
            "base's on the structure, in phase with the base acceleration at low frequency) and its unit"
        )
    return mass
