"""Errors of the sensors' gains that whole records show, beside all that was fitted."""

from __future__ import annotations

import numpy as np

from sysid.measurement.whole import Gains
from sysid.modal_analysis.record_fit import RecordFit
from sysid.structure.structure import Array

_SEEN = 1e-10  # of the largest eigenvalue of the scaled information; less is round-off


def gain_errors_of(fit: RecordFit) -> Gains:
    """A step of all unknowns from the end of a fit, the gains and what modes above the lines make among them.

    Once with that part and once without it: by how much the two differ counts among the errors of the second, and the
    better known of both is taken.
    """
    made = fit.equations
    size = np.sqrt(np.maximum(np.diag(made.normal), 1e-300))
    normal, gradient = made.normal / np.outer(size, size), made.gradient / size
    n, at = fit.model.n, fit.model.size  # gains come behind all that was fitted
    beyond = max(fit.reduced, 1.0)

    def estimate(count: int) -> tuple[Array, Array]:
        part = slice(0, count)
        lam, V = np.linalg.eigh(normal[part, part])
        seen = lam > _SEEN * lam[-1]
        half = V[:, seen] / np.sqrt(lam[seen])
        step = half @ (half.T @ gradient[part])
        std = np.sqrt(beyond / 2) * np.linalg.norm(half, axis=1)
        return step[at : at + n] / size[at : at + n], std[at : at + n] / size[at : at + n]

    (plain, plain_std), (error, std) = estimate(at + n), estimate(size.size)
    plain_std = np.hypot(plain_std, plain - error)
    better = plain_std < std
    # A sensor that reads too much records `1 + error` times all its motion, transients included: its rows of what is
    # linear in it take the factor, and G u beside them pulls the fit.
    lam, V = np.linalg.eigh(normal[:at, :at])
    seen = lam > _SEEN * lam[-1]
    half = V[:, seen] / np.sqrt(lam[seen])
    pulled = half @ (half.T @ normal[:at, at : at + n]) / size[:at, None] * size[at : at + n]
    moves = np.zeros((fit.model.index.size, n))
    moves[: fit.model.kept] = pulled[: fit.model.kept]
    by_sensor = moves[fit.model.index.phi].reshape(n, -1, n)
    by_sensor[np.arange(n), :, np.arange(n)] += fit.parameters.modes.phi
    return Gains(np.where(better, plain, error), np.where(better, plain_std, std), fit.freedom, moves)
