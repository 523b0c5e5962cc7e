r"""Modal accelerations in time under a base acceleration that is given by samples, and their fitted first state.

The state is ``y = [w q; q']``, so that its matrix ``A = [[0, W], [-W, D]]``, with ``W = diag(w)`` and ``-D`` the modal
damping matrix, has entries of one unit; ``y' = A y - [0; Gamma] u``. Between two samples the base acceleration is the
cubic spline through all of them, and the step over it is exact: one matrix exponential holds the transition and the
integrals of the four powers of time (C. F. Van Loan, IEEE Trans. Automat. Contr. 23 (1978) 395-404).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

_BLOCK = 1024  # samples whose rows are reduced together
_DECAYED = 1e-12  # free vibration below this share of its first acceleration explains nothing more


class ModalModel(NamedTuple):
    """Modes in time: natural frequencies (n,) rad/s, modal damping matrix (n, n), participation (n, d)."""

    omega: Array
    damping: Array
    participation: Array

    @property
    def state_matrix(self) -> Array:
        """A, (2n, 2n)."""
        W = np.diag(self.omega)
        return np.block([[np.zeros_like(W), W], [-W, -self.damping]])

    @property
    def to_acceleration(self) -> Array:
        """Takes the state to the modal accelerations that it makes by itself, (n, 2n)."""
        return self.state_matrix[self.omega.size :]


def modal_accelerations(modes: ModalModel, base: Array, sample_rate: float, initial: Array) -> Array:
    """Modal accelerations (n, n_samples) under base accelerations (d, n_samples).

    `initial`, (2, n), holds modal displacements and velocities at the first sample.
    """
    transition, loads = _step(modes, 1 / sample_rate)
    driven = np.einsum("pxd,pdi->ix", loads, _spline_derivatives(base))
    states = np.empty((base.shape[1], 2 * modes.omega.size))
    states[0] = state = np.concatenate([modes.omega * initial[0], initial[1]])
    for i, load in enumerate(driven, start=1):
        states[i] = state = transition @ state + load
    return modes.to_acceleration @ states.T - modes.participation @ base


def fitted_state(modes: ModalModel, shapes: Array, residual: Array, sample_rate: float) -> Array:
    """First state (2, n) whose free vibration is nearest to `residual` (n_sensors, n_samples), in least squares."""
    transition = scipy.linalg.expm(modes.state_matrix / sample_rate)
    scale = np.concatenate([modes.omega, modes.omega])  # a state y makes accelerations of w y
    row = shapes @ modes.to_acceleration / scale
    transition = transition * (scale[:, None] / scale)
    size = np.linalg.norm(row)
    reduced: Any = np.zeros((0, scale.size + 1))
    for begin in range(0, residual.shape[1], _BLOCK):
        block = residual[:, begin : begin + _BLOCK].T
        rows = np.empty((*block.shape, scale.size))
        for i in range(len(block)):
            rows[i] = row
            row = row @ transition
        equations = np.column_stack([rows.reshape(-1, scale.size), block.ravel()])
        reduced = np.linalg.qr(np.vstack([reduced, equations]), mode="r")
        if np.linalg.norm(row) <= _DECAYED * size:
            break
    # Of motion that no sensor sees the least is taken: none.
    state = np.linalg.lstsq(reduced[:, :-1], reduced[:, -1], rcond=1e-10)[0] / scale
    n = modes.omega.size
    return np.array([state[:n] / modes.omega, state[n:]])


def _step(modes: ModalModel, step: float) -> tuple[Array, Array]:
    """Transition (2n, 2n) over a step, and (4, 2n, d) what a load and its derivatives at the beginning add to it."""
    n, d = modes.participation.shape
    size = 2 * n
    A = np.zeros((size + 4 * d, size + 4 * d))
    A[:size, :size] = step * modes.state_matrix
    A[n:size, size : size + d] = -step * modes.participation
    A[size : size + 3 * d, size + d :] = np.eye(3 * d)  # each derivative integrates the next one
    exponential = scipy.linalg.expm(A)
    return exponential[:size, :size], np.moveaxis(exponential[:size, size:].reshape(size, 4, d), 1, 0)


def _spline_derivatives(base: Array) -> Array:
    """Cubic spline at the beginning of each step, its derivatives 0 to 3 by steps: (4, d, n_samples - 1)."""
    from scipy.interpolate import CubicSpline

    coefficients = CubicSpline(np.arange(base.shape[1]), base, axis=1).c  # highest power first
    return np.moveaxis(coefficients[::-1], 2, 1) * np.array([1, 1, 2, 6])[:, None, None]
