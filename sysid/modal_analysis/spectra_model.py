"""The modal model of plain spectra, its mode shapes eliminated sensor by sensor.

The base is exact, so that no sensor shares its errors with another: at given participations and poles the shapes are a
small linear least-squares problem of each sensor, the same matrix for all of them. What is left has (d + 2) unknowns a
mode, whatever the number of sensors (variable projection, Golub and Pereyra 1973). Its gradient is exact, and its
normal matrix is that of Kaufman (1975): the columns of the shapes projected off the others, which is the Jacobian of
the projected residual but for a term that vanishes with the residual.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import factors_of_runs
from sysid.modal_analysis.least_squares import SumOfSquares, minimise
from sysid.modal_analysis.modal_fit import (
    ModalFit,
    Modes,
    Weights,
    force_columns,
    held_gauge,
    mode_of_slopes,
    separate_poles,
    slopes_of_modes,
)
from sysid.modal_analysis.modal_model import FAR, Lines, NormalEquations, Parameters, Run, SpectralModel, dots
from sysid.modal_analysis.residues import force_residual_left, linear_residues
from sysid.modal_analysis.response import motion_curvature, real_times
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor
from sysid.structure.structure import Array
from sysid.structure.thresholds import EXACT, ROUND_OFF, round_off

_ROUND = 25  # steps in one form of the modes
_SETTLED = EXACT**1.5  # of the sum of squares: a fall that is promised, at which the fit stands still


def weights_at(test: Measurement, omega: Array, ratios: Array, *, together: bool = False) -> Weights:
    """Weights by the stated noise; a force whose noise is not stated weighs by what free residues at these poles leave.

    Parameters
    ----------
    test : Measurement
    omega, ratios : (m,)
        Circular frequencies, rad/s, and damping ratios, each pole once.
    together : bool
        Channels weigh alike in all runs, as those of `Records` that runs share do.
    """
    channel, line = factors_of_runs(test.response_std, test.response.shape, together=together)
    size = float(np.linalg.norm(test.relative * channel[..., None] * line[:, None]))
    sensors = channel / size
    if test.force is None:
        return Weights(sensors, line, None, line)
    of_force, force_line = factors_of_runs(test.force_std, test.force.shape, together=together)
    over = force_line.mean(axis=1, keepdims=True) / line.mean(axis=1, keepdims=True)
    if np.allclose(force_line, over * line, rtol=1e-12, atol=0.0):
        of_force, force_line = of_force * over, line
    if test.response_std is not None and test.force_std is not None:
        return Weights(sensors, line, of_force / size, force_line)
    force_size = float(np.linalg.norm(test.force * of_force[..., None] * force_line[:, None]))
    left = max(linear_residues(test, omega, ratios)[1], ROUND_OFF)
    force_left = max(force_residual_left(test, omega, ratios), ROUND_OFF)
    weight = left / force_left * float(np.sqrt(test.force.size / test.relative.size)) / force_size
    return Weights(sensors, line, weight * of_force, force_line)


class SpectraModel(SpectralModel):
    """Plain spectra as a sum of modes whose shapes are the best for their participations and poles.

    The unknowns are participations (mode by mode), the logarithms of frequencies and damping ratios of each pole, and
    where a force was measured the rigid-body mass, as `Index` has it. Modes may share a pole.

    Parameters
    ----------
    test : Measurement
    weights : Weights
    pole : (m,) of int
        The pole of each mode.
    """

    def __init__(self, test: Measurement, weights: Weights, pole: NDArray[np.intp]) -> None:
        every = [weights.lines] + [weights.force_lines] * (weights.force_lines is not weights.lines)
        runs = [
            Run(2 * np.pi * test.freq, base * line, records * line, 1.0, number, np.ones(line.size), 0)
            for lines in every
            for number, (base, records, line) in enumerate(zip(test.base, test.outputs, lines, strict=True))
        ]
        runs = [run._replace(piece=piece) for piece, run in enumerate(runs)]
        super().__init__(test, pole.size, runs)
        force = np.zeros((test.n_runs, 0)) if weights.force is None else weights.force
        # A channel without weight in a piece has infinite noise there; the base has none.
        scale = np.zeros((len(runs), self.channels))
        scale[: test.n_runs, : self.n], scale[-test.n_runs :, self.n :] = weights.sensors, force
        with np.errstate(divide="ignore"):
            self.levels = np.hstack([scale**-2.0, np.zeros((len(runs), self.d))])
        # Sensors that weigh the runs alike share what is to be solved for their shapes.
        over = weights.sensors / weights.sensors[0]
        _, first, group = np.unique(np.round(over, 9), axis=1, return_index=True, return_inverse=True)
        self.groups = [(over[:, at], np.flatnonzero(group.ravel() == k)) for k, at in enumerate(first)]
        self.pole, self._first = pole, np.unique(pole, return_index=True)[1]
        # Columns of the plain unknowns, of which those of modes that share a pole are one.
        count = self.m * self.d
        at = np.concatenate([np.arange(count), count + pole, count + self._first.size + pole])
        rigid = count + 2 * self._first.size + np.arange(self.kept - int(self.index.rigid[0]))
        self._at = np.concatenate([at, rigid])
        self._size = int(self._at.max()) + 1
        self._free, self._held = np.ones(self._size, bool), np.zeros(self._size)
        self._largest: NDArray[np.intp] | None = None

    def in_gauge(self, p: Parameters, unit: Array, *, by_size: bool) -> Parameters:
        """Parameters in the form of their modes that the unknowns keep from now on; `unit` (d,) of participations.

        With a force and `by_size`, the largest participation of each mode is by its logarithm, and the others are over
        it: a mode that the force gives no mass, towards which shapes grow without end, turns nothing singular on the
        way. But no participation changes its sign on the way, so that a fit begins without.
        """
        gauge, held = held_gauge(p.modes, unit, self.force)
        gamma = gauge * unit
        self._free[: gamma.size] = ~held.ravel()
        if self.force and by_size:
            largest = np.arange(self.m) * self.d + np.argmax(np.abs(gauge), axis=1)
            self._largest, self._sign = np.repeat(largest, self.d), np.sign(gamma.ravel()[largest])
        self._held[: gamma.size] = self._in_units(gamma.ravel())
        return self.with_best_shapes(p.modes._replace(gamma=gamma), p.rigid)

    def hold_last_pole(self, modes: Modes) -> None:
        """Leave the last pole as it is."""
        at = self.m * self.d + self._first.size * np.array([1, 2]) - 1
        self._free[at], self._held[at] = False, np.log([modes.omega[-1], modes.ratios[-1]])

    @property
    def levels_of_accelerations(self) -> Array:
        """Variances with which the force has no weight."""
        levels = self.levels.copy()
        levels[:, self.n : self.channels] = np.inf
        return levels

    def _in_units(self, gamma: Array) -> Array:
        """Participations (m d,) as unknowns."""
        if self._largest is None:
            return gamma
        sizes = gamma[self._largest]
        sizes = np.where(sizes == 0, 1.0, sizes)  # of a mode without any, which stays so
        own = self._largest == np.arange(gamma.size)
        return np.where(own, np.log(np.abs(sizes)), gamma / sizes)

    def _participations(self, unknowns: Array) -> Array:
        """Participations (m, d) of their unknowns (m d,)."""
        if self._largest is None:
            return unknowns.reshape(self.m, -1)
        sizes = self._sign * np.exp(np.clip(unknowns[self._largest[:: self.d]], -FAR, FAR))
        own = self._largest == np.arange(unknowns.size)
        return np.where(own, 1.0, unknowns).reshape(self.m, -1) * sizes[:, None]

    def pack(self, p: Parameters) -> Array:
        """The unknowns as one column, without the shapes."""
        modes = p.modes
        rigid = [p.rigid[i, j] for i, j in self.index.pairs] if self.force else []
        poles = np.log(modes.omega[self._first]), np.log(modes.ratios[self._first])
        return np.concatenate([self._in_units(modes.gamma.ravel()), *poles, rigid])[self._free]

    def unpack(self, x: Array) -> Parameters:
        """Parameters with the best shapes."""
        every = self._held.copy()
        every[self._free] = x
        gamma, log_omega, log_ratios, corner = np.split(
            every[self._at], np.cumsum([self.m * self.d, self.m, self.m]).tolist()
        )
        rigid = np.zeros((self.d, self.d))
        for (i, j), value in zip(self.index.pairs, corner, strict=False):
            rigid[i, j] = rigid[j, i] = value
        with np.errstate(over="ignore", invalid="ignore"):  # a step may go beyond all measure
            omega, ratios = np.exp(np.maximum(log_omega, -FAR)), np.exp(np.maximum(log_ratios, -FAR))
            modes = Modes(np.zeros((self.n, self.m)), self._participations(gamma), omega, ratios)
            return self.with_best_shapes(modes, rigid)

    def with_best_shapes(self, modes: Modes, rigid: Array) -> Parameters:
        """Parameters with the shapes that leave least of the accelerations; those of `modes` are not read."""
        start = self._parameters(modes._replace(phi=np.zeros((self.n, self.m))), rigid)
        if not (np.all(np.isfinite(modes.omega)) and np.all(modes.ratios < 1.0)):
            return start
        parts = [Lines(self, start, run) for run in self.runs[: self.test.n_runs]]
        grams = np.array([dots(part.motion, part.motion) for part in parts])
        inverses = [_inverse(np.tensordot(over**2, grams, 1)) for over, _ in self.groups]
        phi = np.zeros((self.n, self.m))
        # Once more for what round-off in the products has left.
        for _ in range(2):
            left = [part.error[: self.n] - real_times(phi, part.motion) for part in parts]
            pull = np.array([dots(error, part.motion) for error, part in zip(left, parts, strict=True)])
            for (over, sensors), inverse in zip(self.groups, inverses, strict=True):
                phi[sensors] += np.tensordot(over**2, pull[:, sensors], 1) @ inverse
        return self._parameters(modes._replace(phi=phi), rigid)

    def _parameters(self, modes: Modes, rigid: Array) -> Parameters:
        runs = self.test.n_runs
        return Parameters(modes, rigid, np.zeros((self.m, 0)), np.zeros((runs, self.channels, 0)))

    def normal_equations(self, p: Parameters, levels: Array) -> NormalEquations:
        """Half the Hessian and minus half the gradient of the sum of squares by the unknowns, and the sum.

        Of parameters with the best shapes. The Hessian is exact where it has no negative curvature, else Kaufman's.
        """
        plain, curved = self.slopes(p, levels)
        joined, bend = self.chain(p.modes.gamma.ravel(), plain.gradient)
        exact = joined @ curved @ joined.T + bend
        normal = exact
        if not _is_definite(exact):  # no step makes a participation smaller by much more than a factor e
            normal = joined @ plain.normal @ joined.T + np.diag(np.maximum(np.diag(bend), 0.0))
        return NormalEquations(normal, joined @ plain.gradient, plain.chi2)

    def chain(self, gamma: Array, gradient: Array) -> tuple[Array, Array]:
        """Slopes of theta without the shapes by the unknowns, (unknowns, p), and what bends add to half the Hessian.

        `gradient` is minus half that of the sum of squares by theta.
        """
        joined, bend = np.zeros((self._size, self._at.size)), np.zeros((self._size, self._size))
        joined[self._at, np.arange(self._at.size)] = 1.0
        if self._largest is not None:
            at, largest = np.arange(gamma.size), self._largest
            joined[at, at], joined[largest, at] = gamma[largest], gamma
            along, across = gradient[: gamma.size] * gamma, gradient[: gamma.size] * gamma[largest]
            bend[largest, at], bend[at, largest] = -across, -across
            bend[largest, largest] = -np.add.reduceat(along, at[:: self.d]).repeat(self.d)
        return joined[self._free], bend[np.ix_(self._free, self._free)]

    def slopes(self, p: Parameters, levels: Array) -> tuple[NormalEquations, Array]:
        """The same by participations, log w, log zeta of each mode, and rigid-body mass: theta without the shapes.

        First with Kaufman's normal matrix, then half the exact Hessian.
        """
        modes, m, n = p.modes, self.m, self.n
        spectra = m * (self.d + 3) + self.d
        grams = np.zeros((len(levels), spectra, spectra))
        cross, squared = np.zeros((spectra, self.channels)), 1 / levels[:, : self.channels]
        chi2, curvature = 0.0, np.zeros((m, self.d + 2, self.d + 2))
        for chunk in self.chunks(p):
            piece, weighed, spectra_there = chunk.run.piece, chunk.weighed(levels), chunk.spectra(chunk.run.base)
            grams[piece] += dots(spectra_there, spectra_there)
            cross += dots(spectra_there, weighed.whitened_residual)
            chi2 += float(np.sum(weighed.power))
            pull = real_times(chunk.shapes.T, weighed.whitened_residual)
            curvature += motion_curvature(
                chunk.run.w / (2 * np.pi), modes.omega, modes.ratios, modes.gamma, chunk.run.base, pull
            )
        mode = mode_of_slopes(m, self.d)
        count, size = mode.size, self.kept - self.index.gamma.start
        normal, bent, gradient = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
        for over, sensors in self.groups:
            gram = np.tensordot(over**2, grams[: len(over)], 1)
            parts = _eliminated(modes.phi[sensors], gram, cross[: m + count, sensors], squared[0, sensors], mode)
            for whole, part in zip(
                (normal[:count, :count], bent[:count, :count], gradient[:count]), parts, strict=True
            ):
                whole += part
        at = slopes_of_modes(m, self.d)
        np.subtract.at(bent, (at[:, :, None], at[:, None]), curvature)
        for i in range(self.channels - n):
            mix = force_columns(modes.gamma, self.index, i)
            normal += mix.T @ np.tensordot(squared[:, n + i], grams, 1) @ mix
            gradient += mix.T @ cross[:, n + i]
            # The force is the product of a participation and a motion.
            first, others = mode * self.d + i, np.arange(count)
            np.subtract.at(bent, (first, others), cross[m + others, n + i])
            np.subtract.at(bent, (others, first), cross[m + others, n + i])
        return NormalEquations(normal, gradient, chi2), normal + bent


def _eliminated(
    phi: Array, gram: Array, cross: Array, squared: Array, mode: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """Sums over the sensors with their shapes eliminated: Kaufman's normal matrix, what is exact beyond it, gradient.

    Parameters
    ----------
    phi : (n, m)
        The best shapes.
    gram : (spectra, spectra)
        Products of motions and their slopes, motions first.
    cross : (m + slopes, n)
        Of these with weighed errors.
    squared : (n,)
        Squared weights of the sensors.
    mode : (slopes,)
    """
    m, count = phi.shape[1], mode.size
    shapes, slopes = slice(m), slice(m, m + count)
    inverse = _inverse(gram[shapes, shapes])
    onto = gram[slopes, shapes] @ inverse
    inner = gram[slopes, slopes] - onto @ gram[shapes, slopes]
    alike = ((phi.T * squared) @ phi)[np.ix_(mode, mode)]
    errors = cross[slopes]
    by_shape = errors @ phi[:, mode]  # (slopes, slopes), of the second's mode
    across = onto[:, mode] * by_shape.T
    alone = inverse[np.ix_(mode, mode)] * ((errors / squared) @ errors.T)
    return inner * alike, across + across.T - alone, np.sum(errors * phi[:, mode].T, axis=1)


def _is_definite(matrix: Array) -> bool:
    """True where a symmetric matrix has positive curvature in all directions, by more than round-off."""
    size = np.diag(matrix)
    if np.any(size <= 0):
        return False
    scaled = matrix / np.sqrt(np.outer(size, size)) - len(size) * np.finfo(float).eps * np.eye(len(size))
    return scipy.linalg.lapack.dpotrf(scaled, lower=1)[1] == 0


def _inverse(gram: Array) -> Array:
    """Inverse of the Gram matrix of the modes' motions, which may be next to singular."""
    size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    lam, V = np.linalg.eigh(gram / np.outer(size, size))
    half = V / np.sqrt(np.maximum(lam, 0.0) + round_off(lam.size)) / size[:, None]
    return np.asarray(half @ half.T)


def fit_spectra(
    test: Measurement, first: Modes, rigid: Array, *, static: int = 0, together: bool = False,
    monitor: IterationMonitor, max_iterations: int,
) -> ModalFit:  # fmt: skip
    """Modes with the least weighted squared error of accelerations and, where it was measured, base force.

    The rigid-body mass is as free as the records have it: what no mode carries may come out as a negative mass.

    Parameters
    ----------
    test : Measurement
    first : Modes
        Where to start; shapes are not read. Modes whose poles are equal keep one pole.
    rigid : (d, d)
        Rigid-body mass to start with; read where a force was measured.
    static : int
        So many modes, the last, share a pole that is held.
    together : bool
        As in `weights_at`.
    """
    first = first._replace(ratios=np.maximum(first.ratios, np.exp(-FAR)))
    poles, pole = separate_poles(first)
    weights = weights_at(test, first.omega[poles], first.ratios[poles], together=together)
    model = SpectraModel(test, weights, pole)
    unit = np.sqrt(np.maximum(np.mean(first.gamma**2, axis=0), np.finfo(float).tiny))
    if static:
        model.hold_last_pole(first)

    def tell(_: int, p: Parameters, chi2: float) -> bool:
        return monitor.record(model.pack(p), OBJECTIVE_SCALE * chi2)

    # Far below the noise, so that IPOPT finds its tolerance met where it begins.
    enough = lambda chi2: _SETTLED * (chi2 + _SETTLED)  # noqa: E731
    p, settled = model.with_best_shapes(first, rigid), False
    for done in range(0, max_iterations, _ROUND):
        # Anew, as what was largest of modes at one pole may have become next to nothing.
        p = model.in_gauge(p, unit, by_size=done > 0)
        problem = SumOfSquares(
            model.pack(p), model.unpack, lambda p: model.trial_chi2(p, model.levels),
            lambda p: model.normal_equations(p, model.levels),
        )  # fmt: skip
        p, chi2, settled = minimise(problem, tell, min(_ROUND, max_iterations), enough)
        if settled or monitor.stopped is not None or monitor.is_over:
            break
    status = "settled" if settled else "stopped" if monitor.stopped is not None else "not settled"
    of_accelerations = np.sqrt(model.chi2(p, model.levels_of_accelerations))
    return ModalFit(p.modes, p.rigid, float(np.sqrt(chi2)), float(of_accelerations), status, "", weights, static)
