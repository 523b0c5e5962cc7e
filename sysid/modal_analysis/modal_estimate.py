"""Modes of whole records as statistics: what a structure's modes miss them by, in units of the noise."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import ModalEstimate
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.modal_analysis.response import columns, gains, weights_of
from sysid.structure.structure import Array
from sysid.structure.thresholds import round_off

_BELOW = 1e-3  # of the rigid-body mass; the least remainder to begin with, as a factor of zero has no slope


def residual_of(test: Measurement) -> float:
    """Relative, weighted residual of the accelerations that the modes of whole records leave."""
    modal = test.modal
    assert modal is not None
    q = gains(test.freq, modal.omega, modal.ratios) * np.einsum("md,rdf->rmf", modal.gamma, test.base)
    weight, size = weights_of(test.relative, test.response_std)
    left = weight * columns(test.relative - np.einsum("nm,rmf->rnf", modal.phi, q))
    return float(np.linalg.norm(left)) / size


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
    """What an error of one of each sensor's gain makes of the parameters, in the scale and sign of `modes`."""
    return estimate.gain.moves / _scale_of(estimate, modes)[:, None]


def _scale_of(estimate: ModalEstimate, modes: Modes) -> Array:
    """The estimate's parameters over those of nearly the same modes in another scale, (p,)."""
    index = index_of(estimate)
    scale = np.sum(modes.gamma * estimate.gamma, axis=1) / np.sum(estimate.gamma**2, axis=1)
    factor = np.ones(index.size)
    factor[index.phi] = np.tile(scale, estimate.phi.shape[0])
    factor[index.gamma] = np.repeat(1 / scale, estimate.gamma.shape[1])
    return factor


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
    at = ca.DM(estimate.gamma)
    scale = ca.sum2(gamma * at) / ca.sum2(at * at)
    if weighed:
        scale = ca.sign(scale)
    phi, gamma = phi * ca.repmat(scale.T, n, 1), gamma / ca.repmat(scale, 1, d)
    corner = ca.vertcat(*(rigid[i, j] for i, j in index.pairs))
    theta = ca.vertcat(ca.vec(phi.T), ca.vec(gamma.T), ca.log(omega), ca.log(ratios), corner)
    own = theta_of(Modes(estimate.phi, estimate.gamma, estimate.omega, estimate.ratios), estimate.rigid, index)
    assert theta.numel() == own.size and phi.shape == (n, m)
    return ca.DM(factor_of(estimate)) @ (theta - ca.DM(own))


def matched(estimate: ModalEstimate, omega: Array) -> NDArray[np.intp] | None:
    """For each mode of the estimate the nearest of a structure's, each once; None where it has fewer."""
    from scipy.optimize import linear_sum_assignment

    if omega.size < estimate.omega.size:
        return None
    apart = np.abs(np.log(omega[None] / estimate.omega[:, None]))
    return np.asarray(linear_sum_assignment(apart)[1])


def above_modes(estimate: ModalEstimate) -> tuple[Modes, Array]:
    """The likeliest modes and rigid-body mass whose remainder, what no mode carries, is no negative mass.

    Least squares over participations and a factor L of the remainder ``L L'``; all else follows them linearly.
    """
    from scipy.optimize import least_squares

    index = index_of(estimate)
    modes, rigid = Modes(estimate.phi, estimate.gamma, estimate.omega, estimate.ratios), estimate.rigid
    size = np.sqrt(np.maximum(np.diag(rigid), np.diag(modes.gamma.T @ modes.gamma)))
    size[size == 0] = 1.0
    scaled = lambda gamma: (rigid - gamma.T @ gamma) / np.outer(size, size)  # noqa: E731
    lam, V = np.linalg.eigh(scaled(modes.gamma))
    if lam[0] >= 0:
        return modes, rigid
    own = theta_of(modes, rigid, index)
    mass = np.concatenate([np.arange(index.gamma.start, index.gamma.stop), index.rigid])
    others = np.setdiff1d(np.arange(index.size), mass)
    A = estimate.information
    inverse = np.linalg.pinv(A[np.ix_(others, others)], rcond=round_off(len(A)), hermitian=True)
    follow = -inverse @ A[np.ix_(others, mass)]
    unit = np.concatenate([np.tile(size, len(modes.gamma)), [size[i] * size[j] for i, j in index.pairs]])
    inner = (A[np.ix_(mass, mass)] + A[np.ix_(mass, others)] @ follow) * np.outer(unit, unit)
    values, turn = np.linalg.eigh((inner + inner.T) / 2)
    R = np.sqrt(np.maximum(values, 0.0))[:, None] * turn.T
    (m, d), lower = modes.gamma.shape, np.tril_indices(len(size))

    def parts(z: Array) -> tuple[Array, Array]:
        L = np.zeros((d, d))
        L[lower] = z[m * d :]
        return z[: m * d].reshape(m, d), L

    def moved(z: Array) -> Array:
        gamma, L = parts(z)
        whole = gamma.T @ gamma + L @ L.T  # in units of `size`
        corner = np.array([whole[i, j] for i, j in index.pairs])
        return np.concatenate([gamma.ravel(), corner]) - own[mass] / unit

    def slope(z: Array) -> Array:
        gamma, L = parts(z)
        J = np.zeros((m * d + len(index.pairs), z.size))
        J[: m * d, : m * d] = np.eye(m * d)
        for row, (i, j) in enumerate(index.pairs, start=m * d):
            by_gamma = np.zeros((m, d))
            by_gamma[:, i] += gamma[:, j]
            by_gamma[:, j] += gamma[:, i]
            by_L = np.zeros((d, d))
            by_L[i] += L[j]
            by_L[j] += L[i]
            J[row] = np.concatenate([by_gamma.ravel(), by_L[lower]])
        return R @ J

    root = np.linalg.cholesky((V * np.maximum(lam, _BELOW * max(lam[-1], 1.0))) @ V.T)
    start = np.concatenate([(modes.gamma / size).ravel(), root[lower]])
    end = least_squares(lambda z: R @ moved(z), start, slope, xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=200)
    theta, step = own.copy(), moved(end.x) * unit
    theta[mass] += step
    theta[others] += follow @ step
    phi, gamma, log_omega, log_ratios, rigid = (part[..., 0] for part in index.split(theta[:, None]))
    return Modes(phi, gamma, np.exp(log_omega), np.exp(log_ratios)), rigid
