r"""Covariances and intervals of an identified structure, from exact Jacobians and the measured noise.

The fit is weighted least squares over the modal parameters ``theta = (Phi, Gamma, log w, log zeta, M_rb)``. The inverse
of its information is kept as a factor: columns of theta, each the move that one independent standard normal makes.
Moves that no record sees stand beside them. A quantity follows both by its chain rule: its variance is a sum of
squares, and it is NaN where something unseen moves it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.assessment.information import (
    Index,
    Path,
    gains_of,
    inflation_of,
    information,
    records_of,
    spectra_of,
    spread,
)
from sysid.assessment.modal_mass_cone import open_masses
from sysid.assessment.sensitivity import slopes_of
from sysid.errors import InputError
from sysid.modal_analysis.modal_fit import Modes
from sysid.models.damping import ModalDamping
from sysid.models.mass import FullMass
from sysid.models.unknowns import steps_of
from sysid.problem.problem import Problem
from sysid.structure.structure import Array, Structure, check_frequencies

MOVED = 1e-6  # of a quantity's size, by which an unseen move of order one must change it to count
_SAME = 1e-6  # relative distance that is put between repeated frequencies
_LEAST_RATIO = 1e-8  # a damping ratio of zero has no logarithm

_POSITIVE = ("natural_frequencies", "damping_ratios")
_MATRICES = ("mass", "stiffness", "damping")
_QUANTITIES = (*_POSITIVE, "mode_shapes", "participation", "effective_masses", "rigid_body_mass", *_MATRICES)


class Spectra(Protocol):
    """What predicts spectra where modes do not."""

    def transmissibility(self, freq: Array) -> Array:
        """Standard deviations, (n_sensors, d, n_freq)."""

    def base_force(self, freq: Array) -> Array:
        """Standard deviations, (d, d, n_freq)."""


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty:
    """Standard deviations of what was identified; NaN where data and stated model leave a quantity open.

    Attributes
    ----------
    structure : Structure
        What they belong to: n_sensors sensors, m modes, d base directions.
    natural_frequencies : (m,)
        Hz.
    damping_ratios : (m,)
    mode_shapes : (n_sensors, m)
        kg^-1/2.
    participation : (m, d)
        kg^1/2 (kg^1/2 m for a rotation of the base).
    effective_masses : (m, d, d)
        kg; of products of two jointly normal participations, so that they hold also where these are about zero.
    rigid_body_mass : (d, d)
    mass, stiffness, damping : (m, m)
        M_SS, K_SS and C at the structure's degrees of freedom.
    parameters : tuple of str
        Frequencies, damping ratios, and the participations that are known; the unknowns of a problem that has its own.
    covariance : (p, p)
        Of `parameters`.
    inflation : float
        Factor by which all standard deviations were raised because the misfit is larger than the stated noise
        explains; 1 otherwise, NaN where the lines are too few to tell a noise that is not stated.
    values, variables : dict of str to ndarray
        Values, and their standard deviations, of the variables of a problem in its own unknowns: by name, in their
        shapes.

    Notes
    -----
    First order in the noise. Degrees of freedom at a sensor move with its row of the mode shapes; others are known
    only where they are modal coordinates, which stand still.

    References
    ----------
    S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), section 15.7 (complex
    noise); H. White, Econometrica 50 (1982) 1-25 (weights other than the noise's).
    """

    structure: Structure
    natural_frequencies: Array
    damping_ratios: Array
    mode_shapes: Array
    participation: Array
    effective_masses: Array
    rigid_body_mass: Array
    mass: Array
    stiffness: Array
    damping: Array
    parameters: tuple[str, ...]
    covariance: Array
    inflation: float
    _modes: Modes = field(repr=False)
    _moves: Moves = field(repr=False)
    values: dict[str, Array] = field(default_factory=dict)
    variables: dict[str, Array] = field(default_factory=dict)
    _direct: Spectra | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        worst = 100 * np.max(self.natural_frequencies / self.structure.natural_frequencies)
        known = "known" if np.all(np.isfinite(self.mass)) else "not all known"
        return f"<Uncertainty: frequencies within {worst:.2g} % (one standard deviation), masses {known}>"

    def interval(self, name: str, level: float = 0.95) -> Array:
        """Interval around the structure's value that holds the true one with probability `level`.

        Parameters
        ----------
        name : str
            One of the quantities above, "natural_frequencies" for instance, or a variable of a problem of its own.
        level : float
            Between 0 and 1.

        Returns
        -------
        ndarray, shape (2, ...)
            Lower and upper ends, from a normal law: of the logarithm for frequencies, damping ratios and the diagonals
            of M_SS, K_SS and C, which stay positive; of the participation for diagonal effective masses,
            which may be zero; of the value itself for all others. Bounds of variables are not counted.

        Raises
        ------
        InputError
            For another name, or a level that is no probability.
        """
        from scipy.stats import norm

        if name not in (*_QUANTITIES, *self.variables):
            raise InputError(f"no uncertainty of {name!r}; give one of {', '.join((*_QUANTITIES, *self.variables))}")
        if not 0 < level < 1:
            raise InputError(f"level = {level}: a probability between 0 and 1 is needed")
        z = float(norm.ppf((1 + level) / 2))
        if name in self.variables:
            return np.stack(
                [self.values[name] - z * self.variables[name], self.values[name] + z * self.variables[name]]
            )
        n, value, std = self.structure.n, np.asarray(getattr(self.structure, name)), getattr(self, name)
        value = value[:n, :n] if name in _MATRICES else value
        ends = np.stack([value - z * std, value + z * std])
        if name == "effective_masses":
            i = np.arange(self.structure.n_base)
            size, spread = np.abs(self.structure.participation), z * self.participation
            ends[:, :, i, i] = np.stack([np.maximum(size - spread, 0.0), size + spread]) ** 2
        positive = value > 0
        if name in _MATRICES:
            positive &= np.eye(n, dtype=bool)
        if name in _POSITIVE + _MATRICES:
            with np.errstate(over="ignore"):  # what is hardly known may be anything above zero
                factor = np.exp(z * std[positive] / value[positive])
            ends[:, positive] = np.stack([value[positive] / factor, value[positive] * factor])
        return ends

    def transmissibility(self, freq: ArrayLike) -> Array:
        """Standard deviation ``sqrt(E|e|²)`` of the transmissibility at lines in Hz, (n_sensors, d, n_freq)."""
        if self._direct is not None:
            return self._direct.transmissibility(check_frequencies(freq, increasing=False))
        (phi, gamma, _, _), moves = self._modes, self._moves
        g, slopes = gains_of(check_frequencies(freq, increasing=False), self._modes)
        size = float(np.max(np.abs(np.einsum("ik,kj,kf->ijf", phi, gamma, g))))
        std = np.empty((len(phi), gamma.shape[1], g.shape[1]))
        for i, j in np.ndindex(*std.shape[:2]):
            residue = np.tile(phi[i] * gamma[:, j], 2)[:, None]
            change = np.vstack([moves.phi[i], moves.gamma[:, j], moves.log_omega, moves.log_ratios])
            std[i, j] = moves.std_of_lines(change, [gamma[:, [j]] * g, phi[i, :, None] * g, residue * slopes], size)
        return std

    def base_force(self, freq: ArrayLike) -> Array:
        """Standard deviation ``sqrt(E|e|²)`` of the apparent mass at lines in Hz, kg, (d, d, n_freq)."""
        if self._direct is not None:
            return self._direct.base_force(check_frequencies(freq, increasing=False))
        gamma, moves = self._modes.gamma, self._moves
        g, slopes = gains_of(check_frequencies(freq, increasing=False), self._modes)
        weight = np.sqrt(np.diag(self.structure.rigid_body_mass)).tolist()
        std = np.empty((len(weight), len(weight), g.shape[1]))
        for i, j in np.ndindex(*std.shape[:2]):
            residue = np.tile(gamma[:, i] * gamma[:, j], 2)[:, None]
            change = np.vstack(
                [moves.gamma[:, i], moves.gamma[:, j], moves.log_omega, moves.log_ratios, moves.rigid[i, [j]]]
            )
            factors = [gamma[:, [j]] * g, gamma[:, [i]] * g, residue * slopes, np.ones((1, g.shape[1]))]
            std[i, j] = moves.std_of_lines(change, factors, weight[i] * weight[j])
        return std


def uncertainty(problem: Problem, structure: Structure) -> Uncertainty:
    """Standard deviations of everything that was identified.

    Parameters
    ----------
    problem : Problem
        The standard deviations that its measurement states are the noise; where none are stated, the misfit that
        `structure` leaves is.
    structure : Structure
        The fit of `problem`. Its mode shapes and participations are free for a full mass with spectral
        stiffness; otherwise it moves as the problem's unknowns let it.

    Returns
    -------
    Uncertainty
    """
    test, modes = problem.measurement, modes_of(structure)
    index = Index(structure.n_sensors, structure.n, structure.n_base)
    path = _free(problem, modes, index) if problem.free_modes else _structured(problem, structure, modes, index)
    unknowns = path.unit.size - path.gauge.shape[1]
    records, spectra = records_of(test, structure, unknowns), spectra_of(test, modes)
    A = information(modes, index, [record.grams(spectra) for record in records])
    B = None
    if not all(record.shared for record in records):
        B = information(modes, index, [record.sandwich_grams(spectra) for record in records])
    normals, unseen = spread(A, B, path)
    if _masses_known(problem, structure):
        normals, unseen = (_held(problem, modes, index, path, part) for part in (normals, unseen))
    inflation = inflation_of(test, records, unknowns)
    moves = Moves(*index.split(np.hstack([inflation * normals, unseen])), normals.shape[1])
    return quantities(problem, structure, modes, moves, inflation)


def modes_of(structure: Structure) -> Modes:
    """The modal model, repeated frequencies a little apart.

    At one frequency the shapes are open to a rotation that no record sees and K_SS does not feel; a small distance
    gives both a finite part, and K_SS keeps the variance of its off-diagonal modal entries.
    """
    omega = 2 * np.pi * structure.natural_frequencies
    for k in range(1, omega.size):
        omega[k] = max(omega[k], omega[k - 1] * (1 + _SAME))
    ratios = np.maximum(structure.damping_ratios, _LEAST_RATIO)
    return Modes(structure.mode_shapes, structure.participation, omega, ratios)


def _free(problem: Problem, modes: Modes, index: Index) -> Path:
    """A full mass with spectral stiffness: theta itself, less what the damping model and stated totals tie."""
    test, (phi, gamma, _, _) = problem.measurement, modes
    m, d = gamma.shape
    slope, unit, keep = np.eye(index.size), np.ones(index.size), np.ones(index.size, bool)
    strength = np.linalg.norm(phi, axis=0)
    unit[index.phi] = np.tile(strength, len(phi))
    # Only the product of shape and participation has a size of its own.
    unit[index.gamma] = np.repeat(np.max(strength * np.linalg.norm(gamma, axis=1)) / strength, d)
    weight = np.sqrt(problem.totals)
    unit[index.rigid] = [weight[i] * weight[j] for i, j in index.pairs]
    if not isinstance(problem.damping, ModalDamping):
        at = index.log_ratios
        by_unknowns, by_log_omega, unknowns = _damping_slopes(problem, modes)
        slope[at, at], slope[at, index.log_omega] = 0.0, by_log_omega
        slope[at, at.start : at.start + unknowns.size] = by_unknowns
        unit[at.start : at.start + unknowns.size], keep[at.start + unknowns.size : at.stop] = unknowns, False
    gauge = np.zeros((index.size, 0))
    if test.force is None:
        gauge = np.zeros((index.size, m))
        modes_of = np.eye(m)
        gauge[index.phi] = -(phi[:, :, None] * modes_of).reshape(-1, m)
        gauge[index.gamma] = (gamma[:, :, None] * modes_of[:, None]).reshape(-1, m)
    elif isinstance(problem.mass, FullMass) and problem.mass.total_mass is not None:
        for entry, row in _tied_masses(problem, modes, index):
            slope[entry], keep[entry] = row, False
    return Path(slope[:, keep], unit[keep], gauge[keep])


def _tied_masses(problem: Problem, modes: Modes, index: Index) -> Iterator[tuple[int, Array]]:
    """Entries of M_rb that a stated total mass ties, and how they follow theta, (size of theta,)."""
    mass, layout, (phi, gamma, _, _) = problem.mass, problem.layout, modes
    assert isinstance(mass, FullMass)
    every = np.asarray(mass.total_mass).ndim == 2  # the whole matrix is stated
    for at, (i, j) in zip(index.rigid.tolist(), index.pairs, strict=True):
        row = np.zeros(index.size)
        if i != j and not every:
            continue
        # With other degrees of freedom than the sensors the fit ties M_rb itself.
        if mass.healing == "trace" and phi.shape[0] == phi.shape[1]:
            # M_rb,ii = total - sum of the sensors' M_jj - (delta' delta)_ii + (Gamma' Gamma)_ii, delta = Gamma - P G
            P, own = np.linalg.inv(phi), layout.directions[: layout.n] == i
            drawn = P @ layout.rigid_body[:, i]
            delta = gamma[:, i] - drawn
            by_phi = 2 * (P.T @ P)[:, own] @ P[:, own].T - 2 * np.outer(P.T @ delta, drawn)
            row[index.phi] = by_phi.ravel()
            row[index.gamma].reshape(gamma.shape)[:, i] = 2 * (gamma[:, i] - delta)
        yield at, row


def _masses_known(problem: Problem, structure: Structure) -> bool:
    """Whether known entries of a full mass, not a force, set the scale of the modes."""
    stated = problem.free_modes and problem.measurement.force is None and np.any(np.isfinite(problem.known_mass))
    return bool(stated and structure.at_sensors)


def _held(problem: Problem, modes: Modes, index: Index, path: Path, moves: Array) -> Array:
    """Moves of theta (size of theta, moves) with the scale of each mode moved so that known entries of the mass stay.

    With P the inverse of Phi the entries are those of ``M_SS = P' P`` and ``M_S0 = P' (Gamma - P G)``.
    """
    phi, gamma, _, _ = modes
    n, G, known = len(phi), problem.layout.rigid_body, problem.known_mass
    P = np.linalg.inv(phi)
    M, push = P.T @ P, P.T @ gamma
    size = np.sqrt(np.diag(M))
    rows = []
    for i, j in np.argwhere(np.isfinite(known)):
        row = np.zeros(index.size)
        if j < n:
            by_phi = -(np.outer(M[i], P[:, j]) + np.outer(M[j], P[:, i]))
        else:
            # M_S0 = P' Gamma - M G
            by_phi = (
                -np.outer(push[:, j - n], P[:, i])
                + np.outer(M[i], P @ G[:, j - n])
                + np.outer(M @ G[:, j - n], P[:, i])
            )
            row[index.gamma].reshape(gamma.shape)[:, j - n] = P[:, i]
        row[index.phi] = by_phi.ravel()
        rows.append(row / (size[i] * (size[j] if j < n else size.max())))
    C, gauge = np.array(rows), path.slope @ path.gauge
    return moves - gauge @ (np.linalg.pinv(C @ gauge, rcond=1e-9) @ (C @ moves))


def _damping_slopes(problem: Problem, modes: Modes) -> tuple[Array, Array, Array]:
    """Slopes of log zeta by the damping's unknowns (m, unknowns) and by log w (m, m), and large steps of the first."""
    damping, omega, ratios = problem.damping, modes.omega, modes.ratios
    (variable,) = damping.variables(problem.layout)
    at = damping.values(ratios, omega)
    y, w = ca.SX.sym("y", variable.size), ca.SX.sym("w", omega.size)
    answer = damping.ratios(y, w)
    slopes = ca.Function("slopes", [y, w], [ca.jacobian(answer, y), ca.jacobian(answer, w)])
    by_unknowns, by_omega = (ca.densify(part).full() / ratios[:, None] for part in slopes(at, omega))
    return by_unknowns, by_omega * omega, steps_of((variable,), at)


def _structured(problem: Problem, structure: Structure, modes: Modes, index: Index) -> Path:
    """Mass or stiffness with unknowns of their own: modes move as the matrices do (`sysid.sensitivity`)."""
    layout, x = problem.layout, problem.values(structure)
    if problem.unit_mass:
        # Nobody stated the totals, to which masses are normalised: they are unknowns that no record sees.
        layout = replace(layout, weighed=problem.totals)
        x = np.concatenate([problem.mass.values(layout, structure.mass), x[problem.parts.stiffness.start :]])
    formulation = problem.formulate(layout)
    s = slopes_of(formulation.matrices, x, problem.measurement, modes.omega)
    rigid = np.stack([s.d_rigid[i, j] for i, j in index.pairs])
    changes = (s.d_shapes, s.d_participation, s.d_log_omega, s.d_log_ratios, rigid)
    slope = np.concatenate([change.reshape(-1, x.size) for change in changes])
    return Path(slope, steps_of(formulation.variables, x), np.zeros((x.size, 0)))


class Moves(NamedTuple):
    """Moves of the modal parameters in the last axis: `normals` of a standard normal each, then those unseen."""

    phi: Array
    gamma: Array
    log_omega: Array
    log_ratios: Array
    rigid: Array
    normals: int

    def std(self, change: Array, size: ArrayLike) -> Array:
        """Standard deviations of quantities with this change, (..., moves); `size` (...) tells what is much."""
        std = np.linalg.norm(change[..., : self.normals], axis=-1)
        unseen = np.abs(change[..., self.normals :]).max(axis=-1, initial=0.0)
        return np.where(unseen > MOVED * np.asarray(size), np.nan, std)

    def std_of_lines(self, change: Array, factors: Sequence[NDArray[np.inexact[Any]]], size: float) -> Array:
        """Of a spectrum that changes by the sum of `change` (rows, moves) times `factors` (rows, n_freq)."""
        weight, seen, unseen = np.vstack(factors), change[:, : self.normals], change[:, self.normals :]
        variance = np.sum(weight.conj() * ((seen @ seen.T) @ weight), axis=0).real
        moved = np.abs(unseen.T @ weight).max(axis=0, initial=0.0)
        return np.where(moved > MOVED * size, np.nan, np.sqrt(np.maximum(variance, 0.0)))


def quantities(
    problem: Problem,
    structure: Structure,
    modes: Modes,
    moves: Moves,
    inflation: float,
    matrices: tuple[Array, ...] | None = None,
) -> Uncertainty:
    """Everything that follows from the moves; `matrices` are those of M_SS, K_SS and C where they are known."""
    phi, gamma, omega, ratios = modes
    frequencies, n = omega / (2 * np.pi), structure.n
    d_frequencies, d_ratios = frequencies[:, None] * moves.log_omega, ratios[:, None] * moves.log_ratios
    frequency_std, ratio_std = moves.std(d_frequencies, frequencies), moves.std(d_ratios, ratios)
    shape_std = moves.std(moves.phi, np.abs(phi).max(axis=0))
    hidden = np.isnan(shape_std).any(axis=0)  # a shape of unknown scale leaves its participation unknown
    push_std = moves.std(moves.gamma, np.abs(gamma).max())
    shape_std[:, hidden], push_std[hidden] = np.nan, np.nan

    normal = moves.gamma[:, :, : moves.normals]
    together = np.einsum("kic,kjc->kij", normal, normal)
    each = np.einsum("kii->ki", together)
    first = np.einsum("ki,kjc->kijc", gamma, moves.gamma)
    first = first + first.swapaxes(1, 2)
    size = np.sqrt(np.diag(structure.rigid_body_mass))
    size = np.outer(size, size)
    effective = np.sqrt(moves.std(first, size) ** 2 + each[:, :, None] * each[:, None] + together**2)
    effective[hidden] = np.nan

    loss, none = 2 * ratios * omega, np.zeros_like(d_ratios)
    diagonals = (
        (np.ones(n), none),
        (omega**2, 2 * omega[:, None] ** 2 * moves.log_omega),
        (loss, loss[:, None] * (moves.log_omega + moves.log_ratios)),
    )
    mass, stiffness, damping = matrices or (
        _matrix_std(structure, moves, diagonal, change) for diagonal, change in diagonals
    )
    if problem.free_modes and problem.measurement.force is None and open_masses(problem, structure):
        mass, stiffness, damping = np.full((3, n, n), np.nan)  # zeros that a decoupled structure keeps included

    known = np.isfinite(push_std)
    changes = np.concatenate([d_frequencies, d_ratios, moves.gamma[known]])[:, : moves.normals]
    covariance = changes @ changes.T
    lost = np.isnan(np.concatenate([frequency_std, ratio_std, push_std[known]]))
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    names = [f"frequency {k + 1}, Hz" for k in range(n)] + [f"damping ratio {k + 1}" for k in range(n)]
    axes = problem.measurement.base_axes or ()
    names += [f"participation {k + 1} {axes[j]}" for k, j in np.argwhere(known)]
    return Uncertainty(
        structure=structure,
        natural_frequencies=frequency_std,
        damping_ratios=ratio_std,
        mode_shapes=shape_std,
        participation=push_std,
        effective_masses=effective,
        rigid_body_mass=moves.std(moves.rigid, size),
        mass=mass,
        stiffness=stiffness,
        damping=damping,
        parameters=tuple(names),
        covariance=covariance,
        inflation=inflation,
        _modes=modes,
        _moves=moves,
    )


def _matrix_std(structure: Structure, moves: Moves, diagonal: Array, change: Array) -> Array:
    """Of ``T^-T diag(diagonal) T^-1``, T the modes at the degrees of freedom, where `diagonal` (m,) changes too."""
    T = structure.normal_modes
    dT = np.zeros((*T.shape, change.shape[1]))
    for j, (sensor, mode) in enumerate(zip(structure.dof_sensors, structure.dof_modes, strict=True)):
        if sensor >= 0:
            dT[j] = moves.phi[sensor]
        elif mode < 0:
            return np.full(T.shape, np.nan)
    P = np.linalg.inv(T)
    X = (P.T * diagonal) @ P
    half = np.einsum("ia,abc,bj->ijc", X, dT, P, optimize=True)
    own = np.einsum("ki,kc,kj->ijc", P, change, P, optimize=True)
    size = np.sqrt(np.diag(X))
    return moves.std(own - half - half.swapaxes(0, 1), np.outer(size, size))
