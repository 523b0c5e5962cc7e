"""Modal estimate of a test, and the same as statistics: what a structure misses it by, in units of the noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.measurement.channels import without_constants
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels
from sysid.modal_analysis.calibration import Calibration
from sysid.modal_analysis.delays import Delays
from sysid.modal_analysis.modal_fit import Index, ModalFit, Modes
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.response import columns, coupled_flexibility, gains, weights_of
from sysid.modal_analysis.vector_fitting import Poles, find_poles
from sysid.structure.amplitude import FittedLaw
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF, most_deviations, round_off


@dataclass(frozen=True, eq=False)
class Gains:
    """Relative errors of the sensors' gains that whole records show, (n_sensors,), and their deviations.

    `moves` (p, n_sensors + 2 d) is what an error of one of each gain makes of the fitted modal parameters, to first
    order: of the sensors', then of the base's and of the force's in each direction. `rigid` (n_sensors, d) is the share
    of the base's motion in each sensor beside what its row of G says, as a wrong sign, axis or gain makes it, and
    `rigid_chi2` (n_sensors,) how far it stands out, with d degrees of freedom.
    """

    error: Array
    std: Array
    freedom: int
    moves: Array
    rigid: Array
    rigid_chi2: Array

    @property
    def certain(self) -> Array:
        """Errors beyond chance, (n_sensors,); zero for the others."""
        return np.where(np.abs(self.error) > most_deviations(self.error.size) * self.std, self.error, 0.0)


class Excess(NamedTuple):
    """A band, Hz, where a fit leaves `factor` times the noise of a channel (of sensors, forces, base) of a run.

    `channel` and `run` are indices.
    """

    channel: int
    run: int
    low: float
    high: float
    factor: float


class VaryingLevel(NamedTuple):
    """Noise of a channel of a run, indices as in `Excess`, that varies over the lines: least and largest deviation."""

    channel: int
    run: int
    least: float
    largest: float


class Coupling(NamedTuple):
    """Off-diagonal entries of ``Phi' C Phi`` of modes that dampers couple, rad/s, and their errors beside the modes'.

    `values` (m, m); `pairs` (k, 2) of modes, first below second. Where the modal parameters are off by a step, the
    couplings are likeliest off by `follows` (k, p) times it; what they are off beside has `covariance` (k, k).
    """

    values: Array
    pairs: NDArray[np.intp]
    follows: Array
    covariance: Array

    def about(self, step: Array) -> Array:
        """The likeliest couplings, (m, m), of modal parameters that are off by a step, (p,)."""
        moved = self.values.copy()
        first, second = self.pairs.T
        moved[first, second] += (change := self.follows @ step)
        moved[second, first] += change
        return moved

    def at(self, kept: NDArray[np.bool_], ours: NDArray[np.bool_], inverse: Array, across: Array) -> Coupling:
        """Those of some modes, (m,), with parameters `ours` (p,); the others are off by ``-inverse across step``."""
        inside, place = np.all(kept[self.pairs], axis=1), np.cumsum(kept) - 1
        lost = self.follows[inside][:, ~ours]
        return Coupling(
            self.values[np.ix_(kept, kept)], place[self.pairs[inside]],
            self.follows[inside][:, ours] - lost @ inverse @ across,
            self.covariance[np.ix_(inside, inside)] + lost @ inverse @ lost.T / 2,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ModalEstimate:
    """Modes of a test before any matrices are fitted, how exactly they are known, and its noise.

    Attributes
    ----------
    given : Measurement
        The test as it was given, without its delays and errors of gains.
    records : Measurement
        What is fitted: whole records as they would be at rest at both ends, their noise stated; others as given.
    phi : (n_sensors, m)
    gamma : (m, d)
        Shapes at the sensors and participations; without a force only their products mean something.
    omega, ratios : (m,)
        rad/s; damping ratios. Of spectra and frequency responses, whose lines stand for themselves, none, m = 0, where
        nothing needed them: see `fit_modes_of_lines`.
    rigid : (d, d)
        Rigid-body mass; of no meaning where no force was measured.
    information : (p, p)
        ``Re J' S^-1 J`` over phi, gamma, log omega, log ratios and the upper triangle of the rigid-body mass, with what
        the transients take away of it: half the inverse of the covariance. Zero for the mass without a force; (0, 0)
        where lines stand for themselves.
    noise : NoiseLevels or None
        Of whole records, stated or found with the fit.
    reduced : float
        Chi-squared over its degrees of freedom.
    density : (runs,)
        Of `WholeRecords`.
    gain : Gains
        Of whole records; NaN where they are not known.
    scatter : (p, p) or None
        B, where what is left is no white noise and the covariance is ``A^-1 B A^-1 / 2``, A the information.
    settled : bool
        Whether modes and levels of noise stood still at the end of the fit.
    excess : tuple of Excess
        Where the fit leaves more than the noise; empty where what it leaves is white.
    varying : tuple of VaryingLevel
        Levels that were let vary smoothly over the lines; `noise` holds their means.
    untold : tuple of (run, channel)
        Indices, as in `Excess`. Levels of `noise` that the records do not determine.
    fit : ModalFit or None
        Of the modes of lines that stand for themselves.
    static : int
        So many modes, the last, stand for all above the lines: see `ModalFit`.
    lacking : str
        Why these lines cannot fix their modes; empty where they can, or nothing asked.
    in_motion : tuple of int
        Indices of runs stated to be at rest at both ends that the records show were not.
    record_fit : RecordFit or None
        Of whole records, of which all else can be made again.
    coupling : Coupling or None
        Of modes that dampers couple, where a force was measured; None where the damping is classical.
    delays : Delays or None
        Taken off sensors and force; None where none were asked for.
    calibration : Calibration or None
        Errors of gains that were taken off, and what tolerances leave of them; None where all gains are exact.
    laws : tuple of FittedLaw
        Of modes that follow their amplitude, where this was asked for. Where none of them is certain the modes are
        those without.
    poles : Poles or None
        Of lines that stand for themselves, where they were looked for already.
    """

    given: Measurement
    records: Measurement
    phi: Array
    gamma: Array
    omega: Array
    ratios: Array
    rigid: Array
    information: Array
    noise: NoiseLevels | None
    reduced: float
    density: Array
    gain: Gains
    scatter: Array | None = None
    settled: bool = True
    excess: tuple[Excess, ...] = ()
    varying: tuple[VaryingLevel, ...] = ()
    in_motion: tuple[int, ...] = ()
    untold: tuple[tuple[int, int], ...] = ()
    fit: ModalFit | None = None
    static: int = 0
    lacking: str = ""
    record_fit: RecordFit | None = None
    coupling: Coupling | None = None
    delays: Delays | None = None
    calibration: Calibration | None = None
    laws: tuple[FittedLaw, ...] = ()
    poles: Poles | None = None

    @classmethod
    def of_lines(cls, test: Measurement) -> ModalEstimate:
        """That of a test whose lines stand for themselves."""
        (n, d), none, unknown = test.rigid_body.shape, np.zeros(0), np.full(test.n_sensors, np.nan)
        gain = Gains(unknown, unknown, 1, np.zeros((0, n + 2 * d)), np.zeros((n, d)), np.zeros(n))
        return cls(
            test, test, np.zeros((n, 0)), np.zeros((0, d)), none, none, np.eye(d), np.zeros((0, 0)), None, 1.0,
            np.zeros(test.n_runs), gain,
        )  # fmt: skip

    def without_errors(self, calibration: Calibration) -> ModalEstimate:
        """That of lines from which nothing was taken off yet, without these errors of their gains."""
        turned = ModalEstimate.of_lines(calibration.taken_off(self.records))
        return replace(turned, delays=self.delays, calibration=calibration)

    @property
    def as_recorded(self) -> Measurement:
        """Its records with what wrong gains add to them, where that was taken off."""
        return self.records if self.record_fit is None else without_constants(self.records, -self.record_fit.constants)

    @property
    def by_modes(self) -> bool:
        """True where the statistics of its modes stand for the lines."""
        return self.information.size > 0

    @property
    def of_records(self) -> bool:
        """True where these are the statistics of whole records, or of lines whose errors grow with the signal."""
        return self.by_modes and self.record_fit is not None

    @property
    def stopped(self) -> bool:
        """True where the search for modes was stopped, so that not all were tried."""
        return self.record_fit is not None and self.record_fit.stopped

    @property
    def found_noise(self) -> bool:
        """True where the levels of its noise were found with the fit, so that they hold what the modes miss."""
        fit = self.record_fit
        return self.noise is not None and fit is not None and fit.model.whole.noise is None

    @property
    def shares(self) -> Array | None:
        """Shares of the signal in the noise of sensors, forces and base, (runs, c + d); None where it holds none."""
        return None if self.record_fit is None else self.record_fit.shares

    @property
    def channel_deviations(self) -> Array:
        """Standard deviations of each channel's own noise at the lines, (runs, c + d, n_freq or 1)."""
        assert self.noise is not None
        fit = self.record_fit
        if fit is not None and fit.shares is not None:
            return np.sqrt([run.variances(fit.levels) for run in fit.model.runs])
        levels = np.concatenate([self.noise.outputs, self.noise.base], axis=-1)
        return np.asarray((np.sqrt(self.density)[:, None] * levels)[..., None])

    @property
    def scattered(self) -> float | None:
        """Times the noise that `scatter` holds; None where what is left is white."""
        return None if self.scatter is None else max(self.reduced, 1.0)

    @property
    def modes(self) -> Modes:
        """The likeliest modes."""
        return Modes(self.phi, self.gamma, self.omega, self.ratios)

    @property
    def coupling_std(self) -> Array:
        """Standard deviations of the couplings, (k,), rad/s, of all errors together."""
        assert self.coupling is not None
        size = np.sqrt(np.maximum(np.diag(self.information), np.finfo(float).tiny))
        inverse = np.linalg.pinv(self.information / np.outer(size, size), rcond=ROUND_OFF, hermitian=True)
        turned = self.coupling.follows / size
        return np.sqrt(self.reduced * np.diag(self.coupling.covariance + turned @ inverse @ turned.T / 2))

    def at(self, kept: NDArray[np.bool_]) -> ModalEstimate:
        """The estimate of some of the modes, (m,), whatever the others are: those of whole records."""
        n, d = self.records.rigid_body.shape
        ours = np.concatenate([np.tile(kept, n), np.repeat(kept, d), kept, kept, np.ones(d * (d + 1) // 2, bool)])
        A, B = self.information, self.scatter
        size = np.sqrt(np.maximum(np.diag(A)[~ours], np.finfo(float).tiny))
        inner = np.linalg.pinv(A[np.ix_(~ours, ~ours)] / np.outer(size, size), hermitian=True) / np.outer(size, size)
        turn = np.eye(ours.size)[ours]
        turn[:, ~ours] = -A[np.ix_(ours, ~ours)] @ inner
        coupling = self.coupling and self.coupling.at(kept, ours, inner, A[np.ix_(~ours, ours)])
        return replace(
            self, coupling=coupling, **self.modes.at(kept)._asdict(), information=turn @ A @ turn.T,
            scatter=None if B is None else turn @ B @ turn.T, gain=replace(self.gain, moves=self.gain.moves[ours]),
        )  # fmt: skip


def residual_of(estimate: ModalEstimate, modes: Modes) -> float:
    """Relative, weighted residual of the accelerations that modes leave."""
    test = estimate.records
    loads = np.einsum("md,rdf->rmf", modes.gamma, test.base)
    if estimate.coupling is None:
        q = gains(test.freq, modes.omega, modes.ratios) * loads
    else:
        flexibility = coupled_flexibility(test.freq, modes.omega, modes.ratios, estimate.coupling.values)
        q = (2 * np.pi * test.freq) ** 2 * np.einsum("jkf,rkf->rjf", flexibility, loads)
    weight, size = weights_of(test.relative, test.response_std)
    left = weight * columns(test.relative - np.einsum("nm,rmf->rnf", modes.phi, q))
    return float(np.linalg.norm(left)) / size


def estimated_poles(estimate: ModalEstimate, monitor: Callable[[int, float], object] | None = None) -> Poles:
    """Poles of the modes, or, where none were fitted, those that stand out of the lines: see `find_poles`."""
    if estimate.by_modes:
        return Poles(estimate.omega, estimate.ratios, residual_of(estimate, estimate.modes))
    if estimate.poles is None:
        return find_poles(estimate.records, monitor=monitor)
    if monitor is not None:
        monitor(1, estimate.poles.residual)
    return estimate.poles


def index_of(estimate: ModalEstimate) -> Index:
    """Where the modal parameters stand."""
    n, m = estimate.phi.shape
    return Index(n, m, estimate.gamma.shape[1])


def factor_of(estimate: ModalEstimate) -> Array:
    """R (rank, p) with ``R' R`` the information: ``R (theta - estimate)`` has variance one half each."""
    A = estimate.information
    size = np.sqrt(np.maximum(np.diag(A), 0.0))
    seen = size > 0
    lam, V = np.linalg.eigh(A[np.ix_(seen, seen)] / np.outer(size[seen], size[seen]))
    known = lam > round_off(len(A)) * lam[-1]
    factor = np.zeros((int(known.sum()), size.size))
    factor[:, seen] = (V[:, known] * np.sqrt(lam[known])).T * size[seen]
    return factor


def independent_rows(estimate: ModalEstimate) -> tuple[Array, Array]:
    """`factor_of` turned so that its rows have independent errors, and their standard deviations, (rank,)."""
    factor = factor_of(estimate)
    if estimate.scatter is None:
        return factor, np.full(len(factor), np.sqrt(0.5))
    inverse = np.linalg.pinv(factor)  # moves that each row makes
    lam, V = np.linalg.eigh(inverse.T @ estimate.scatter @ inverse)
    return V.T @ factor, np.sqrt(np.maximum(lam, 0.0) / 2)


def theta_of(modes: Modes, rigid: Array, index: Index) -> Array:
    """Modal parameters as one column."""
    corner = np.array([rigid[i, j] for i, j in index.pairs])
    return np.concatenate([modes.phi.ravel(), modes.gamma.ravel(), np.log(modes.omega), np.log(modes.ratios), corner])


def information_about(estimate: ModalEstimate, modes: Modes) -> tuple[Array, Array | None]:
    """Information, and scatter, over modal parameters in the scale and sign of `modes`, nearly the estimate's."""
    factor = _scale_of(estimate, modes)
    scale_of = np.outer(factor, factor)
    B = estimate.scatter
    return estimate.information * scale_of, None if B is None else B * scale_of


def shifts_about(estimate: ModalEstimate, modes: Modes) -> Array:
    """Shifts of the parameters by an error of one of each gain, in the scale and sign of `modes`."""
    return estimate.gain.moves / _scale_of(estimate, modes)[:, None]


def _scale_of(estimate: ModalEstimate, modes: Modes) -> Array:
    """The estimate's parameters over those of nearly the same modes in another scale, (p,)."""
    index = index_of(estimate)
    scale = np.sum(modes.gamma * estimate.gamma, axis=1) / np.sum(estimate.gamma**2, axis=1)
    factor = np.ones(index.size)
    factor[index.phi] = np.tile(scale, estimate.phi.shape[0])
    factor[index.gamma] = np.repeat(1 / scale, estimate.gamma.shape[1])
    return factor


def scale_in(estimate: ModalEstimate, gamma: ca.MX) -> ca.MX:
    """Participations (m, d) over those of an estimate, (m, 1): accelerations leave the scale of a mode open."""
    at = ca.DM(estimate.gamma)
    return ca.sum2(gamma * at) / ca.sum2(at * at)


def misfit_rows(
    estimate: ModalEstimate, phi: ca.MX, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX, *, weighed: bool
) -> ca.MX:
    """``R (theta - estimate)`` as an expression, a column whose sum of squares is what ``e' S^-1 e`` rises by.

    Parameters
    ----------
    phi, gamma, omega, ratios, rigid :
        Of as many modes as the estimate's, in ascending order.
    weighed : bool
        Whether a force was measured; without one each mode is brought to the scale of the estimate.
    """
    index, (n, m), d = index_of(estimate), estimate.phi.shape, estimate.gamma.shape[1]
    scale = scale_in(estimate, gamma)
    if weighed:
        scale = ca.sign(scale)
    phi, gamma = phi * ca.repmat(scale.T, n, 1), gamma / ca.repmat(scale, 1, d)
    corner = ca.vertcat(*(rigid[i, j] for i, j in index.pairs))
    theta = ca.vertcat(ca.vec(phi.T), ca.vec(gamma.T), ca.log(omega), ca.log(ratios), corner)
    estimated = theta_of(estimate.modes, estimate.rigid, index)
    assert theta.numel() == estimated.size and phi.shape == (n, m)
    return ca.DM(factor_of(estimate)) @ (theta - ca.DM(estimated))


def matched(estimate: ModalEstimate, omega: Array) -> NDArray[np.intp] | None:
    """For each mode of the estimate the nearest of a structure's, each once; None where one of both has too few."""
    from scipy.optimize import linear_sum_assignment

    if not estimate.by_modes or omega.size < estimate.omega.size:
        return None
    apart = np.abs(np.log(omega[None] / estimate.omega[:, None]))
    return np.asarray(linear_sum_assignment(apart)[1])


def coupling_about(estimate: ModalEstimate, modes: Modes) -> Coupling | None:
    """The couplings, with steps of modal parameters and signs as those of `modes`, nearly the estimate's."""
    found = estimate.coupling
    if found is None:
        return None
    sign = np.sign(np.sum(modes.gamma * estimate.gamma, axis=1))
    turn = np.prod(sign[found.pairs], axis=1)
    return found._replace(
        values=found.values * np.outer(sign, sign), follows=turn[:, None] * found.follows * _scale_of(estimate, modes),
        covariance=found.covariance * np.outer(turn, turn),
    )  # fmt: skip
