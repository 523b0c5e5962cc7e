"""A modal model as numbers, where its parameters stand in theta, what a fit of it gives, and its masses by a force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import columns, gains, stacked
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.superelement import ResidualModes, in_band

# Pole of modes that stand for all above the lines: times the last line, where masses stay positive, and damping ratio.
STATIC_POLE = 2.0, 0.01
_TURNED = 0.25  # of what a base force leaves; of one with a wrong sign less is left when it is turned
_MOST = 0.5  # of the power of a base force, the least that a fit must explain to tell its sign


class Modes(NamedTuple):
    """A modal model as numbers: shapes at the sensors (n, m), participations (m, d), rad/s (m,), ratios (m,)."""

    phi: Array
    gamma: Array
    omega: Array
    ratios: Array

    def at(self, which: NDArray[Any] | slice) -> Modes:
        """Some of the modes, or all in another order, by flags or numbers."""
        return Modes(self.phi[:, which], self.gamma[which], self.omega[which], self.ratios[which])

    def joined(self, others: Modes) -> Modes:
        """These modes, and others behind them."""
        return Modes(np.hstack([self.phi, others.phi]), *map(np.concatenate, zip(self[1:], others[1:], strict=True)))


def modes_within(omega: Array, ends: Array, stated: Array, window: float = np.inf) -> NDArray[np.bool_]:
    """True for modes within lines from `ends[0]` to `ends[1]`, all where there is none; or the nearest to stated ones.

    Frequencies `omega` (m,), `ends` and `stated` (k,) are rad/s; a mode stands for one that is stated, from which it is
    off by `window` at most, relative. Without any stated one lines count.
    """
    if not stated.size:
        inside = (omega >= ends[0]) & (omega <= ends[1])
        return inside if np.any(inside) else np.ones(omega.size, bool)
    apart = np.abs(np.log(omega / stated[:, None]))
    rows, columns = scipy.optimize.linear_sum_assignment(apart)
    near = np.zeros(omega.size, bool)
    near[columns[apart[rows, columns] <= np.log1p(window)]] = True
    return near


def too_few(found: int, asked: int) -> str:
    """Why so many modes cannot be given, in words."""
    there = f"{found} mode{'s' * int(found != 1)} stand{'s' * int(found == 1)}"
    return f"{there} out of the noise, fewer than the {asked} asked for"


def separate_poles(modes: Modes) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The first mode of each pole, in ascending order of these modes, and the pole of each mode, (m,)."""
    _, first, pole = np.unique(modes.omega + 1j * modes.ratios, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[pole]


class Index:
    """Where the modal parameters stand in theta."""

    def __init__(self, s: int, m: int, d: int) -> None:
        self.shapes = ((s, m), (m, d), (m,), (m,))
        ends = np.cumsum([np.prod(shape) for shape in self.shapes]).tolist()
        self.phi, self.gamma, self.log_omega, self.log_ratios = map(slice, [0, *ends], ends)
        self.pairs = [(i, j) for i in range(d) for j in range(i, d)]  # of M_rb, which is symmetric
        self.size = ends[-1] + len(self.pairs)
        self.rigid = np.arange(ends[-1], self.size)

    def split(self, theta: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Phi, Gamma, log w, log zeta and M_rb of columns of theta, (..., columns)."""
        d = self.shapes[1][1]
        rigid = np.empty((d, d, theta.shape[1]))
        for (i, j), row in zip(self.pairs, theta[self.rigid], strict=True):
            rigid[i, j] = rigid[j, i] = row
        phi, gamma = theta[self.phi].reshape(*self.shapes[0], -1), theta[self.gamma].reshape(*self.shapes[1], -1)
        return phi, gamma, theta[self.log_omega], theta[self.log_ratios], rigid


def mode_of_slopes(m: int, d: int) -> NDArray[np.intp]:
    """The mode of each derivative of a modal motion, in the order of `motion_and_slopes`, (m (d + 2),)."""
    k = np.arange(m)
    return np.concatenate([np.repeat(k, d), k, k])


def slopes_of_modes(m: int, d: int) -> NDArray[np.intp]:
    """Where the derivatives of each mode stand in the order of `motion_and_slopes`, (m, d + 2)."""
    count = m * d
    return np.hstack([np.arange(count).reshape(m, d), count + np.arange(2 * m).reshape(2, m).T])


def by_columns(m: int, d: int) -> NDArray[np.intp]:
    """Where these derivatives stand with participations direction by direction, (m (d + 2),)."""
    return np.concatenate([np.arange(m * d).reshape(m, d).T.ravel(), m * d + np.arange(2 * m)])


def force_columns(gamma: Array, index: Index, i: int) -> Array:
    """Derivatives of the force in direction i as sums of spectra, (m (d + 3) + d, m (d + 2) + pairs).

    Rows are those of `motion_and_slopes`, then the motion of the base; columns the entries of theta behind the shapes.
    """
    m, d = gamma.shape
    mode = mode_of_slopes(m, d)
    mix = np.zeros((m + mode.size + d, mode.size + len(index.pairs)))
    mix[m + np.arange(mode.size), np.arange(mode.size)] = gamma[mode, i]
    mix[np.arange(m), np.arange(m) * d + i] += 1.0  # gamma_ki is also the share of q_k in direction i
    for column, (a, b) in enumerate(index.pairs, start=mode.size):
        if i in (a, b):
            mix[m + mode.size + (b if i == a else a), column] = 1.0
    return mix


def modes_in_band(
    modes: Modes, residual: ResidualModes, coupling: Array | None, across: Array | None
) -> tuple[Modes, ResidualModes, Array | None, Array | None]:
    """Modes that dampers couple with static ones as the band shows them (`in_band`), with couplings in their terms.

    Without couplings across where these are as large as the modes' own mass: no structure has them.
    """
    if coupling is None or across is None or not (residual.static and np.any(across)):
        return modes, residual, coupling, across
    m, loss = modes.omega.size, np.diag(2 * modes.ratios * modes.omega) + coupling
    try:
        omega, T, C = in_band(modes.omega, loss, *replace(residual, coupling=across).above(np.eye(m)))
    except np.linalg.LinAlgError:
        return modes, residual, coupling, None
    told = Modes(modes.phi @ T, T.T @ modes.gamma, omega, np.diag(C) / (2 * omega))
    return told, residual, C - np.diag(np.diag(C)), np.hstack([across[:, :m] @ T, across[:, m:]])


def held_gauge(first: Modes, unit: Array, weighed: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Participations in one of the equivalent forms, and which of them are held to keep it.

    Accelerations leave the scale of each mode open: its largest participation is held. Of modes that share a pole they
    leave every mixture open, and the block in as many directions is held to a unit matrix; a force leaves only
    rotations of these modes into each other, and the block is held triangular. More modes at a pole than directions, as
    where a guess has them all at one, are held in blocks of so many.
    """
    gauge, held = first.gamma / unit, np.zeros(first.gamma.shape, dtype=bool)
    _, start = np.unique(first.omega + 1j * first.ratios, return_index=True)
    at_poles = np.split(np.arange(first.omega.size), np.sort(start)[1:])
    for same in chain.from_iterable(np.split(one, range(unit.size, one.size, unit.size)) for one in at_poles):
        pivots = scipy.linalg.qr(gauge[same], pivoting=True, mode="r")[1]  # directions best conditioned together first
        block = np.ix_(same, pivots[: same.size])
        if weighed:
            gauge[same] = np.linalg.qr(gauge[block])[0].T @ gauge[same]
            lower = np.tril(np.ones((same.size, same.size), dtype=bool), -1)
            gauge[block] = np.where(lower, 0.0, gauge[block])
            held[block] = lower
        else:
            gauge[same] = np.linalg.solve(gauge[block], gauge[same])
            held[block] = True
    return gauge, held


def rank_one(residues: Array, omega: Array, ratios: Array, size: Array) -> Modes:
    """Modal model nearest to residues (m, n, d); `size` (m,) of the shapes, as the split of a residue is free."""
    u, s, vt = np.linalg.svd(residues)
    return Modes(u[:, :, 0].T * size, vt[:, 0] * (s[:, 0] / size)[:, None], omega, ratios)


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of plain spectra: in each run one factor a channel and one a line.

    With them the sum of squares of the accelerations' errors is relative to that of the weighted accelerations.

    Attributes
    ----------
    sensors : (runs, n)
    lines : (runs, n_freq)
        Of the accelerations.
    force : (runs, d) or None
    force_lines : (runs, n_freq)
        Of the force; the same array as `lines` where both weigh their lines alike.
    """

    sensors: Array
    lines: Array
    force: Array | None
    force_lines: Array


@dataclass(frozen=True, eq=False)
class ModalFit:
    """Result of a fit in modal coordinates.

    Attributes
    ----------
    modes : Modes
    rigid : (d, d)
        Rigid-body mass; of no meaning where no force was measured.
    residual : float
        Root of the weighted squared error of all records, in units of the weighted accelerations.
    of_accelerations : float
        That of the accelerations alone.
    status : str
        Return status of IPOPT; of an estimate in words.
    bounds : str
        Bounds that the solution presses on, in words.
    weights : Weights or None
        Of channels and lines, where they are those of plain spectra.
    static : int
        So many modes, the last, stand at one pole above the lines that is held: their static answer is that of all
        modes there.
    """

    modes: Modes
    rigid: Array
    residual: float
    of_accelerations: float
    status: str
    bounds: str
    weights: Weights | None = None
    static: int = 0


def weigh(test: Measurement, modes: Modes, ends: Array | None = None) -> tuple[Array, Array]:
    """Modal masses t (m,) > 0 and rigid-body mass (d, d): the base force is linear in both.

    Parameters
    ----------
    test : Measurement
    modes : Modes
    ends : (m, inputs - d), optional
        What motion at the ends of whole records pushes each mode by, see `Measurement.inputs`.

    Raises
    ------
    InputError
        Where the force wants negative masses: a wrong sign.
    """
    from scipy.optimize import lsq_linear

    d, m = test.n_base, modes.omega.size
    assert test.force is not None
    base, force = columns(test.base), columns(test.force)
    g = np.tile(gains(test.freq, modes.omega, modes.ratios), test.n_runs)
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    pushes = (modes.gamma @ base if ends is None else np.hstack([modes.gamma, ends]) @ columns(test.inputs)) * g
    parts = [np.outer(modes.gamma[k], pushes[k]) for k in range(m)]
    for i, j in pairs:
        unit = np.zeros((d, d))
        unit[i, j] = unit[j, i] = 1.0
        parts.append(unit @ base)
    # Moments and forces count in units of their own records.
    size = np.linalg.norm(force, axis=1, keepdims=True)
    size[size == 0] = 1.0
    design = np.array([(part / size).ravel() for part in parts]).T
    wanted = (force / size).ravel()
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    rows = np.vstack([design.real, design.imag]) / scale
    target = np.concatenate([wanted.real, wanted.imag])
    lower = np.concatenate([np.zeros(m), np.full(len(pairs), -np.inf)])
    # The triangular factor stands for all lines.
    Q, R = np.linalg.qr(rows)
    plain = Q.T @ target
    free = np.linalg.lstsq(R, plain, rcond=None)[0]
    negative = np.sum(free[:m] * np.abs(free[:m])) < -0.5 * np.sum(free[:m] ** 2)
    together = negative and _fits_turned(R, plain, range(m))
    _check_signs(test, modes.gamma, pushes, force / size, bool(together))
    answer = (free if np.all(free[:m] > 0) else lsq_linear(R, plain, (lower, np.inf), tol=1e-14).x) / scale
    rigid = np.zeros((d, d))
    for (i, j), mass in zip(pairs, answer[m:], strict=True):
        rigid[i, j] = rigid[j, i] = mass
    t = answer[:m]
    return np.maximum(t, 1e-9 * t.max()), rigid


def _fits_turned(X: Array, wanted: Array, masses: Sequence[int]) -> bool:
    """True where a force of the other sign is much better explained by unknowns of which `masses` are not negative.

    Of modes far below all lines free masses cancel each other and the base's, and their signs say nothing.
    """
    from scipy.optimize import lsq_linear

    lower = np.full(X.shape[1], -np.inf)
    lower[list(masses)] = 0.0
    Q, R = np.linalg.qr(X)
    left = []
    for sign in (1.0, -1.0):
        found = lsq_linear(R, Q.T @ (sign * wanted), (lower, np.inf), method="bvls").x
        left.append(np.sum((X @ found - sign * wanted) ** 2))
    return bool(left[1] < _TURNED * left[0])


def _check_signs(test: Measurement, gamma: Array, pushes: ComplexArray, force: ComplexArray, together: bool) -> None:
    """Refuse a base force (d, lines) that wants negative masses, `together` or in one direction taken by itself.

    In each direction the modes, by the squares of their shares, and the rigid-body mass must be negative in a fit that
    explains most of the force: what is hardly moved says nothing.
    """
    base, wrong = columns(test.base), []
    for i in range(test.n_base):
        design = np.vstack([gamma[:, i, None] * pushes, base])
        scale = np.linalg.norm(design, axis=1)
        scale[scale == 0] = 1.0
        X, wanted = stacked(design / scale[:, None]), stacked(force[i : i + 1])[:, 0]
        found = np.linalg.lstsq(X, wanted, rcond=None)[0]
        masses, rigid = found[: len(gamma)], found[len(gamma) + i]
        explained = np.sum((X @ found) ** 2) > _MOST * np.sum(wanted**2)
        negative = rigid < 0 and np.sum(masses * np.abs(masses)) < -0.5 * np.sum(masses**2)
        if explained and negative and _fits_turned(X, wanted, [*range(len(gamma)), len(gamma) + i]):
            wrong.append(test.base_axes[i] if test.base_axes else f"base direction {i + 1}")
    if together or wrong:
        where = f" in {' and '.join(wrong)}" if 0 < len(wrong) < test.n_base else ""
        raise InputError(
            f"the base force{where} answers to the modes with negative masses: check its sign (it is the base's on the "
            "structure, in phase with the base acceleration at low frequency)"
        )
