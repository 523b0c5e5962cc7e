"""Errors of the sensors' gains and axes that whole records show, beside all that was fitted."""

from __future__ import annotations

import numpy as np
import scipy

from sysid.modal_analysis.modal_estimate import Gains
from sysid.modal_analysis.record_fit import RecordFit, half_inverse, unit_diagonal
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF


def gain_errors_of(fit: RecordFit) -> Gains:
    """A step of all unknowns from the end of a fit, the gains and what modes above the lines make among them.

    Once with that part and once without it: by how much the two differ counts among the errors of the second, and the
    better known of both is taken. Motion with the base in any of its directions is asked for without it.
    """
    equations, G = fit.equations, fit.test.rigid_body
    (n, d), at = G.shape, fit.model.size  # what is asked for comes behind all that was fitted
    beyond = max(fit.reduced, 1.0)
    along = scipy.linalg.block_diag(np.eye(at), scipy.linalg.block_diag(*G[:, :, None]), np.eye(n * d))
    normal, size = unit_diagonal(along.T @ equations.normal @ along)
    gradient = along.T @ equations.gradient / size

    def estimate(count: int) -> tuple[Array, Array]:
        half = half_inverse(normal[:count, :count], ROUND_OFF)
        step = half @ (half.T @ gradient[:count])
        std = np.sqrt(beyond / 2) * np.linalg.norm(half, axis=1)
        return step[at : at + n] / size[at : at + n], std[at : at + n] / size[at : at + n]

    (plain, plain_std), (error, std) = estimate(at + n), estimate(size.size)
    plain_std = np.hypot(plain_std, plain - error)
    better = plain_std < std
    # A sensor that reads too much records `1 + error` times all its motion, transients included: its rows of what is
    # linear in it take the factor, and G u beside them pulls the fit.
    half = half_inverse(normal[:at, :at], ROUND_OFF)
    pulled = half @ (half.T @ normal[:at, at : at + n]) / size[:at, None] * size[at : at + n]
    moves = np.zeros((fit.model.index.size, n))
    moves[: fit.model.kept] = pulled[: fit.model.kept]
    by_sensor = moves[fit.model.index.phi].reshape(n, -1, n)
    by_sensor[np.arange(n), :, np.arange(n)] += fit.parameters.modes.phi
    rigid, chi2 = _rigid(fit, beyond)
    return Gains(
        np.where(better, plain, error), np.where(better, plain_std, std), fit.freedom, moves, rigid, chi2
    )  # fmt: skip


def _rigid(fit: RecordFit, beyond: float) -> tuple[Array, Array]:
    """Share of the base's motion in each sensor beside what G says, (n_sensors, d), and its chi-squared of each."""
    equations, (n, d), at = fit.equations, fit.test.rigid_body.shape, fit.model.size
    count = at + n * d
    normal, size = unit_diagonal(equations.normal[:count, :count])
    half = half_inverse(normal, ROUND_OFF)
    step = (half @ (half.T @ (equations.gradient[:count] / size)))[at:].reshape(n, d)
    inverse_rows = half[at:].reshape(n, d, -1)
    covariance = beyond / 2 * inverse_rows @ inverse_rows.swapaxes(1, 2)
    chi2 = np.einsum("ni,nij,nj->n", step, np.linalg.pinv(covariance, rcond=ROUND_OFF, hermitian=True), step)
    return step / size[at:].reshape(n, d), chi2
