r"""Fisher information of a base-shake test about the modal parameters, and moves that make up its inverse.

The parameters are ``theta = (Phi, Gamma, log w, log zeta, M_rb)``, Phi the shapes at the sensors. The records are

.. math:: a = \sum_k \phi_k g_k \gamma_k u_0, \qquad f_0 = \Big(\sum_k \gamma_k' g_k \gamma_k + M_{rb}\Big) u_0,

so that every column of their Jacobian is a few numbers times a few spectra (`spectra_of`): the information is put
together from the Gram matrix of these, and the Jacobian itself is never formed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Index, Modes, force_columns, mode_of_slopes
from sysid.modal_analysis.response import columns, motion_and_slopes
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import ROUND_OFF


def spectra_of(test: Measurement, modes: Modes) -> ComplexArray:
    """Spectra of which all columns of the Jacobian are made, (m + m d + 2m + d, runs * n_freq).

    ``q_k = g_k gamma_k u``; ``g_k u_j``; the slopes of q_k by log w_k, then by log zeta_k; ``u_j``.
    """
    u = columns(test.base)
    motion = motion_and_slopes(np.tile(test.freq, test.n_runs), modes.omega, modes.ratios, modes.gamma, u)
    return np.concatenate([motion, u])


def information(modes: Modes, index: Index, grams: list[Iterator[Array]]) -> Array:
    """``Re J' W J`` over theta, from the Gram matrix of the spectra of each sensor and each direction of the force."""
    phi, gamma = modes.phi, modes.gamma
    m, d = gamma.shape
    A = np.zeros((index.size, index.size))
    common, mode = np.arange(index.gamma.start, index.log_ratios.stop), mode_of_slopes(m, d)
    for i, gram in enumerate(grams[0]):
        at = np.concatenate([np.arange(i * m, (i + 1) * m), common])
        factor = np.concatenate([np.ones(m), phi[i, mode]])
        A[np.ix_(at, at)] += np.outer(factor, factor) * gram[: at.size, : at.size]
    at = np.concatenate([common, index.rigid])
    for of_force in grams[1:]:
        for i, gram in enumerate(of_force):
            mix = force_columns(gamma, index, i)
            A[np.ix_(at, at)] += mix.T @ gram @ mix
    return A


def gain_gradients(modes: Modes, index: Index, rigid_body: Array, grams: Iterator[Array]) -> Array:
    """``Re J' W y`` over theta, y the motion ``G u + a`` of one sensor alone, (size of theta, n_sensors).

    So far the fit is pulled by a relative error of that sensor's gain; parameters as in `information`.
    """
    phi, gamma = modes.phi, modes.gamma
    (s, m), d = phi.shape, gamma.shape[1]
    pulls = np.zeros((index.size, s))
    common = np.arange(index.gamma.start, index.log_ratios.stop)
    for i, gram in enumerate(grams):
        at = np.concatenate([np.arange(i * m, (i + 1) * m), common])
        factor = np.concatenate([np.ones(m), np.repeat(phi[i], d), phi[i], phi[i]])
        pulls[at, i] = factor * (gram[: at.size, :m] @ phi[i] + gram[: at.size, -d:] @ rigid_body[i])
    return pulls


class Parametrisation(NamedTuple):
    """Slopes of theta by a problem's unknowns.

    ``slope`` (size of theta, unknowns); ``unit`` (unknowns,), a large step of each; ``gauge`` (unknowns, count),
    directions that are known to change no record, one of a mode's own each.
    """

    slope: Array
    unit: Array
    gauge: Array


def spread(A: Array, B: Array | None, path: Parametrisation) -> tuple[Array, Array]:
    """Moves of theta, in columns: what one standard normal each makes, and what no record sees.

    The first are a factor of the covariance: ``A^-1 / 2``, or ``A^-1 B A^-1 / 2`` where the weights are not those of
    the noise (half, as half of a complex error's variance is in its real part). The second are steps of order one.
    """
    unit, gauge = path.unit, path.gauge
    slope = scipy.sparse.csr_array(path.slope)  # mostly an identity, often nothing else
    whole = np.array_equal(path.slope, np.eye(unit.size))
    of_unknowns = lambda matrix: matrix if whole else slope.T @ matrix @ slope  # noqa: E731
    A = of_unknowns(A)
    size = np.sqrt(np.maximum(np.diag(A), 0.0))
    seen = size * unit > ROUND_OFF * np.max(size * unit)
    # The gauge of a mode whose shape is not seen is no direction beside that shape.
    gauge = gauge[:, np.linalg.norm(gauge[~seen] / unit[~seen, None], axis=0) < 0.5]
    fixed = gauge[seen] * size[seen, None]
    fixed = fixed / np.linalg.norm(fixed, axis=0)
    size = size[seen]
    factor, lost = _inverse_factor(A[np.ix_(seen, seen)] / np.outer(size, size) + fixed @ fixed.T)
    factor = factor - fixed @ (fixed.T @ factor)
    if B is not None:
        B = of_unknowns(B)[np.ix_(seen, seen)] / np.outer(size, size)
        variances, turn = np.linalg.eigh(factor.T @ B @ factor)
        factor = (factor @ turn) * np.sqrt(np.maximum(variances, 0.0))
    normals = np.zeros((unit.size, factor.shape[1]))
    normals[seen] = factor / size[:, None] / np.sqrt(2)
    blind = np.zeros((unit.size, lost.shape[1]))
    blind[seen] = lost / size[:, None]
    unseen = np.hstack([blind, np.eye(unit.size)[:, ~seen], gauge])
    unseen = unseen / np.linalg.norm(unseen / unit[:, None], axis=0)
    return slope @ normals, slope @ unseen


def _inverse_factor(matrix: Array) -> tuple[Array, Array]:
    """F with ``F F'`` the inverse of a semidefinite matrix on its range, and an orthonormal basis of the rest."""
    least = len(matrix) * np.finfo(float).eps
    triangle, singular = scipy.linalg.lapack.dpotrf(matrix, lower=1)
    # Where it is regular this takes a tenth of the time of eigenvalues.
    if not singular and scipy.linalg.lapack.dpocon(triangle, np.linalg.norm(matrix, 1), uplo="L")[0] > least:
        inverse, _ = scipy.linalg.lapack.dtrtri(triangle, lower=1, overwrite_c=1)
        return inverse.T, np.zeros((len(matrix), 0))
    lam, vectors = np.linalg.eigh(matrix)
    known = lam > least * lam[-1]
    return vectors[:, known] / np.sqrt(lam[known]), vectors[:, ~known]
