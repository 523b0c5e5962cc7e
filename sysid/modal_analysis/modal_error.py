"""Squared error of a record in modal coordinates, with exact gradient and Hessian.

A record is ``A q + B u`` with modal accelerations ``q_k = g_k gamma_k u``: relative accelerations have the mode shapes
for A and no B, base forces ``A = Gamma'`` and the rigid-body mass for B. Each q_k depends on its own participations,
frequency and damping ratio alone, so all second derivatives are products of small matrices and sums over lines:
nothing that holds the lines is differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from sysid.measurement.measurement import ComplexArray
from sysid.modal_analysis.response import columns
from sysid.structure.structure import Array

Pair = tuple[ca.MX, ca.MX]  # real and imaginary part


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
        c, m, d = record.shape[1], modes, base.shape[1]
        y = ca.MX.sym("y", c * (m + d * with_base) + m * (d + 2))
        flat_A, flat_B, flat_gamma, log_w, log_zeta = ca.vertsplit(
            y, np.cumsum([0, c * m, c * d * with_base, m * d, m, m]).tolist()
        )
        A, gamma = ca.reshape(flat_A, c, m), ca.reshape(flat_gamma, m, d)
        motion = _Motion(base * line[:, None], np.tile(2 * np.pi * freq, len(base)), gamma, log_w, log_zeta)
        rows = ca.vertcat(motion.q, motion.u) if with_base else motion.q
        B = ca.reshape(flat_B, c, d * with_base)
        target = columns(record * line[:, None])
        weight = ca.diag(ca.DM(channel))
        left = weight @ (ca.horzcat(A, B) @ rows - ca.DM(np.hstack([target.real, target.imag])))
        value, seen = ca.sumsqr(left), 2 * weight @ left
        pull = A.T @ seen
        gradient = ca.vertcat(ca.vec(seen @ rows.T), *(ca.sum2(pull * slope) for slope in motion.slopes))

        slopes, blocks = ca.vertcat(*motion.slopes), len(motion.slopes)
        of_factors = ca.kron(rows @ rows.T, 2 * weight**2)
        onto, own = rows @ slopes.T, seen @ slopes.T
        across = 2 * weight**2 @ ca.horzcat(*([A] * blocks))
        mixed = [
            across * ca.repmat(onto[k, :], c, 1) + own * ca.DM(np.tile(np.arange(m) == k, (c, blocks)).astype(float))
            for k in range(rows.size1())
        ]
        mixed = ca.vertcat(*mixed)
        alike = ca.repmat(A.T @ (2 * weight**2) @ A, blocks, blocks)
        of_motion = (slopes @ slopes.T) * alike + motion.curvature(pull)
        hessian = ca.vertcat(ca.horzcat(of_factors, mixed), ca.horzcat(mixed.T, of_motion))
        self.gradient = ca.Function("gradient", [y], [value, gradient])
        self.hessian = ca.Function("hessian", [y], [ca.densify(hessian)])


class _Motion:
    """Modal accelerations of a test, their slopes and their curvature; real parts beside imaginary ones.

    ``q`` (m, 2 L) and ``u`` (d, 2 L); ``slopes`` of q by the participations in each direction, by log w and by
    log zeta, (m, 2 L) each.
    """

    def __init__(self, base: ComplexArray, w: Array, gamma: ca.MX, log_w: ca.MX, log_zeta: ca.MX) -> None:
        m, d = gamma.shape
        u = columns(base)
        u_re, u_im = (ca.sparsify(ca.DM(part)) for part in (u.real, u.imag))
        squared = ca.repmat(ca.DM(w**2).T, m, 1)
        stiff = ca.exp(2 * log_w) @ ca.DM.ones(1, w.size)
        loss = ca.MX(m, w.size), 2 * ca.exp(log_zeta + log_w) @ ca.DM(w).T
        by_w = 2 * stiff, loss[1]  # slope of the denominator w_k² - w² + 2 i zeta_k w_k w by log w
        size = (stiff - squared) ** 2 + loss[1] ** 2
        over = (stiff - squared) / size, -loss[1] / size
        g = squared * over[0], squared * over[1]
        g_over = _times(g, over)
        slope_w, slope_z = _scaled(_times(g_over, by_w), -1.0), _scaled(_times(g_over, loss), -1.0)
        push = gamma @ u_re, gamma @ u_im
        self.q, self.u = ca.horzcat(*_times(g, push)), ca.horzcat(u_re, u_im)
        single = [(ca.repmat(u_re[i, :], m, 1), ca.repmat(u_im[i, :], m, 1)) for i in range(d)]
        self.slopes = [ca.horzcat(*pair) for pair in (
            *(_times(g, one) for one in single), _times(slope_w, push), _times(slope_z, push)
        )]  # fmt: skip
        # Second slopes: 2 (D')² g / D² - D'' g / D, with D'' = 4 w_k² + loss by log w twice, else the loss.
        twice = _times(_scaled(g_over, 2.0), over)
        bends = [
            _plus(_times(_times(twice, first), second), _scaled(_times(g_over, bend), -1.0))
            for first, second, bend in (
                (by_w, by_w, (4 * stiff, loss[1])), (by_w, loss, loss), (loss, loss, loss)
            )
        ]  # fmt: skip
        self._by_gamma = [[ca.horzcat(*_times(slope, one)) for slope in (slope_w, slope_z)] for one in single]
        self._by_pole = [ca.horzcat(*_times(bend, push)) for bend in bends]

    def curvature(self, pull: ca.MX) -> ca.MX:
        """Sum over lines of `pull` (m, 2 L) times the second slopes of q, over (Gamma by columns, log w, log zeta)."""
        d, zero = len(self._by_gamma), ca.MX(pull.size1(), pull.size1())
        sums = [[ca.diag(ca.sum2(pull * bend)) for bend in pair] for pair in self._by_gamma]
        ww, wz, zz = (ca.diag(ca.sum2(pull * bend)) for bend in self._by_pole)
        blocks = [[*([zero] * d), *pair] for pair in sums]
        blocks += [[*(pair[0] for pair in sums), ww, wz], [*(pair[1] for pair in sums), wz, zz]]
        return ca.vertcat(*(ca.horzcat(*row) for row in blocks))


def _times(a: Sequence[ca.MX], b: Sequence[ca.MX]) -> Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _plus(a: Pair, b: Pair) -> Pair:
    return a[0] + b[0], a[1] + b[1]


def _scaled(a: Pair, by: float) -> Pair:
    return by * a[0], by * a[1]
