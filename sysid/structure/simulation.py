r"""Modal accelerations in time under a base acceleration that is given by samples, and their fitted first state.

The state is ``y = [w q; q']``, so that its matrix ``A = [[0, W], [-W, D]]``, with ``W = diag(w)`` and ``-D`` the modal
damping matrix, has entries of one unit; ``y' = A y - [0; Gamma] u``. Between two samples the base acceleration is the
natural spline of degree 11 through all of them, and the step over it is exact: one matrix exponential holds the
transition and the integrals of all powers of time (C. F. Van Loan, IEEE Trans. Automat. Contr. 23 (1978) 395-404).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.structure.thresholds import ROUND_OFF

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

Array = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complexfloating[Any, Any]]


class ModalModel(NamedTuple):
    """Modes in time: natural frequencies (n,) rad/s, modal damping matrix (n, n), participation (n, d)."""

    omega: Array
    damping: Array
    participation: Array

    def motion(self, freq: Array) -> ComplexArray:
        """Modal accelerations at lines in Hz per unit base acceleration, (n, d, n_freq)."""
        w = 2 * np.pi * freq[:, None, None]
        dynamic = np.diag(self.omega**2) - w**2 * np.eye(self.omega.size) + 1j * w * self.damping
        return np.moveaxis(np.linalg.solve(dynamic, w**2 * self.participation + 0j), 0, -1)

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
    derivatives = _spline_derivatives(base)
    transition, loads = _step(modes, 1 / sample_rate, len(derivatives) - 1)
    driven = np.einsum("pxd,pdi->ix", loads, derivatives)
    states = np.empty((base.shape[1], 2 * modes.omega.size))
    states[0] = state = np.concatenate([modes.omega * initial[0], initial[1]])
    for i, load in enumerate(driven, start=1):
        states[i] = state = transition @ state + load
    return modes.to_acceleration @ states.T - modes.participation @ base


def fitted_state(modes: ModalModel, shapes: Array, residual: Array, sample_rate: float, n: int) -> Array:
    """First state (2, n) of the first n modes whose free vibration is nearest to `residual` (n_sensors, n_samples)."""
    transition = scipy.linalg.expm(modes.state_matrix / sample_rate)
    scale = np.concatenate([modes.omega, modes.omega])  # a state y makes accelerations of w y
    row = shapes @ modes.to_acceleration / scale
    transition = transition * (scale[:, None] / scale)
    size = np.linalg.norm(row)
    reduced: Any = np.zeros((0, scale.size + 1))
    at_once = 1024  # samples whose rows are reduced together
    for begin in range(0, residual.shape[1], at_once):
        block = residual[:, begin : begin + at_once].T
        rows = np.empty((*block.shape, scale.size))
        for i in range(len(block)):
            rows[i] = row
            row = row @ transition
        equations = np.column_stack([rows.reshape(-1, scale.size), block.ravel()])
        reduced = np.linalg.qr(np.vstack([reduced, equations]), mode="r")
        if np.linalg.norm(row) <= ROUND_OFF * size:
            break
    # Of motion that no sensor sees the least is taken: none.
    moved = np.append(np.arange(n), modes.omega.size + np.arange(n))
    state = np.linalg.lstsq(reduced[:, moved], reduced[:, -1], rcond=1e-10)[0] / scale[moved]
    return np.array([state[:n] / modes.omega[:n], state[n:]])


def _step(modes: ModalModel, step: float, degree: int) -> tuple[Array, Array]:
    """Transition (2n, 2n) over a step, and (degree + 1, 2n, d) what a load and its derivatives at its beginning add."""
    n, d = modes.participation.shape
    size, loads = 2 * n, (degree + 1) * d
    A = np.zeros((size + loads, size + loads))
    A[:size, :size] = step * modes.state_matrix
    A[n:size, size : size + d] = -step * modes.participation
    A[size:-d, size + d :] = np.eye(loads - d)  # each derivative integrates the next one
    exponential = scipy.linalg.expm(A)
    return exponential[:size, :size], np.moveaxis(exponential[:size, size:].reshape(size, -1, d), 1, 0)


def _spline_derivatives(base: Array) -> Array:
    """The spline at the beginning of each step, and its derivatives by steps: (degree + 1, d, n_samples - 1)."""
    spline = spline_of(base)
    return np.stack([spline(np.arange(base.shape[1] - 1), nu=order).T for order in range(spline.k + 1)])


def spline_of(base: Array, degree: int = 11) -> BSpline:
    """Natural spline through samples (d, n_samples), by their number, of a lower degree where they are few."""
    from scipy.interpolate import make_interp_spline

    m = min(degree // 2 + 1, base.shape[1])
    still = [(order, np.zeros(len(base))) for order in range(m, 2 * m - 1)]  # at both ends
    return make_interp_spline(np.arange(base.shape[1]), base.T, k=2 * m - 1, bc_type=(still, still))
