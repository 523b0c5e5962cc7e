"""Squared error of a record in modal coordinates, with exact gradient and Hessian.

A record is ``A q + B u`` with modal accelerations ``q_k = g_k gamma_k u``: relative accelerations have the mode shapes
for A and no B, base forces ``A = Gamma'`` and the rigid-body mass for B. Each q_k depends on its own participations,
frequency and damping ratio alone, so all second derivatives are products of small matrices and sums over lines.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.measurement.measurement import ComplexArray
from sysid.modal_analysis.modal_fit import by_columns, mode_of_slopes, slopes_of_modes
from sysid.modal_analysis.modal_model import dots
from sysid.modal_analysis.response import columns, motion_and_slopes, motion_curvature, real_times
from sysid.nlp import NumpyFunction
from sysid.structure.structure import Array


class ModalError:
    """``‖weight ∘ (A q + B u - record)‖²`` as functions of modal coordinates.

    The coordinates are one column: A (c, m), B (c, d; only where it is `with_base`) and Gamma (m, d), each by columns,
    then log w (m,) and log zeta (m,); c channels, m modes, d base directions.

    Parameters
    ----------
    base, record : (n_runs, d, n_freq), (n_runs, c, n_freq) complex
    freq : (n_freq,), Hz
    channel : (c,)
        Weights of the channels.
    line : (n_runs, n_freq)
        Weights of the lines.
    modes : int
    with_base : bool
        Whether B is there.

    Attributes
    ----------
    value : casadi.Function
        Coordinates to the squared error.
    gradient : casadi.Function
        Coordinates to the squared error and its gradient.
    hessian : casadi.Function
        Coordinates to the Hessian.
    """

    def __init__(
        self,
        base: ComplexArray,
        record: ComplexArray,
        freq: Array,
        channel: Array,
        line: Array,
        *,
        modes: int,
        with_base: bool = False,
    ) -> None:
        self.base, self.target = columns(base * line[:, None]), columns(record * line[:, None])
        self.freq, self.channel = np.tile(freq, len(base)), channel
        c, m, d = record.shape[1], modes, base.shape[1]
        self.shapes = (m, c), (d * with_base, c), (d, m), (1, m), (1, m)  # each by columns, so that rows are entries
        self.ends = np.cumsum([rows * across for rows, across in self.shapes])
        size = int(self.ends[-1])
        one, column, matrix = ca.Sparsity.dense(1), ca.Sparsity.dense(size), ca.Sparsity.dense(size, size)
        self.value = NumpyFunction(lambda y: [self._value(self._at(y)[3])], [column], [one])
        self.gradient = NumpyFunction(self._gradient, [column], [one, column])
        self.hessian = NumpyFunction(self._hessian, [column], [matrix])

    def _value(self, pull: ComplexArray) -> float:
        return float(np.sum(np.abs(pull) ** 2 / self.channel[:, None] ** 2)) / 4

    def _at(self, y: Array) -> tuple[Array, tuple[Array, Array, Array], ComplexArray, ComplexArray]:
        """A, the modes (omega, ratios, Gamma), motions above their slopes, and the derivative by what is recorded."""
        flat = np.split(y, self.ends[:-1])
        A, B, gamma, log_w, log_zeta = (part.reshape(shape).T for part, shape in zip(flat, self.shapes, strict=True))
        modes = np.exp(log_w[:, 0]), np.exp(log_zeta[:, 0]), gamma
        motions = motion_and_slopes(self.freq, *modes, self.base)
        left = real_times(A, motions[: len(gamma)]) - self.target
        if B.size:
            left = left + real_times(B, self.base)
        return A, modes, motions, 2 * self.channel[:, None] ** 2 * left

    def _rows(self, motions: ComplexArray, m: int) -> ComplexArray:
        """Factors of A and B, (m [+ d], L)."""
        return np.concatenate([motions[:m], self.base]) if self.shapes[1][0] else motions[:m]

    def _gradient(self, y: Array) -> tuple[float, Array]:
        A, modes, motions, pull = self._at(y)
        m, d = modes[2].shape
        order = by_columns(m, d)
        by_factors = dots(self._rows(motions, m), pull)  # by columns of A and B
        by_motion = np.sum(dots(motions[m:], pull) * A.T[mode_of_slopes(m, d)], axis=1)
        return self._value(pull), np.concatenate([by_factors.ravel(), by_motion[order]])

    def _hessian(self, y: Array) -> tuple[Array]:
        A, modes, motions, pull = self._at(y)
        m, d = modes[2].shape
        mode, order, twice = mode_of_slopes(m, d), by_columns(m, d), 2 * self.channel**2
        rows, slopes = self._rows(motions, m), motions[m:]
        of_factors = np.kron(dots(rows, rows), np.diag(twice))
        mixed = dots(rows, slopes)[:, None] * (twice[:, None] * A)[:, mode]
        # What A multiplies is what the slopes are of.
        mixed[mode, :, np.arange(mode.size)] += dots(slopes, pull)
        alike = (A.T * twice) @ A
        curvature = motion_curvature(self.freq, *modes, self.base, real_times(A.T, pull))
        of_motion = dots(slopes, slopes) * alike[np.ix_(mode, mode)]
        at = slopes_of_modes(m, d)
        np.add.at(of_motion, (at[:, :, None], at[:, None]), curvature)
        across = mixed.reshape(-1, mode.size)[:, order]
        return (np.block([[of_factors, across], [across.T, of_motion[np.ix_(order, order)]]]),)
