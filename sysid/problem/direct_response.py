r"""The response of written matrices as CasADi expressions: direct solves, line by line, for any damping.

.. math:: (-\omega^2 M_{SS} + i \omega C + K_{SS})\, a = \omega^2 B \ddot u_0, \qquad B = M_{SS} G + M_{S0}

(eq. 13 of Cerini et al. 2024, with damping), a the accelerations relative to the base.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import parts_of, weights_of_test
from sysid.models.unknowns import NO_COMPLEX, user_site
from sysid.structure.structure import Array

_SOLVER = "lapacklu"  # of the wheels' plugins the fastest on small dense systems


class Motion(NamedTuple):
    """Equations of motion: CasADi expressions, and the numbers that geometry fixes.

    ``mass`` M_SS and ``stiffness`` K_SS (n, n), N s/m ``damping`` C (n, n), ``coupling`` M_S0 (n, d), ``base`` M_00
    (d, d); ``rigid_body_dofs`` (n, d), motion of the degrees of freedom with a rigid base; ``recovery``
    (n_sensors, n) from degrees of freedom to sensors.
    """

    mass: ca.MX
    coupling: ca.MX
    base: ca.MX
    stiffness: ca.MX
    damping: ca.MX
    rigid_body_dofs: Array
    recovery: Array

    @property
    def push(self) -> ca.MX:
        """``B = M_SS G + M_S0``, (n, d)."""
        return self.mass @ ca.DM(self.rigid_body_dofs) + self.coupling

    @property
    def rigid_body_mass(self) -> ca.MX:
        """``[G; I]' M [G; I]``, (d, d)."""
        G = ca.DM(self.rigid_body_dofs)
        return G.T @ self.push + self.coupling.T @ G + self.base


class Response(NamedTuple):
    """A response as expressions: real and imaginary part, (channels, runs * n_freq), the runs side by side."""

    real: ca.MX
    imag: ca.MX

    def __array_ufunc__(self, *operation: Any, **options: Any) -> None:
        """Refuse an operation with an array, such as a complex record."""
        raise InputError(f"{user_site()}: {NO_COMPLEX}")


def relative_response(test: Measurement, motion: Motion, *, shift: float = 0.0) -> tuple[Response, Response]:
    """Accelerations of the degrees of freedom relative to the base under a test's base motion, and the base force.

    With `shift`, 1/s, at the complex frequencies ``s = shift + i w`` in the place of ``i w``: as if all poles had so
    much more decay.

    Returns
    -------
    Response, Response
        (n, runs * n_freq) in m/s², and (d, runs * n_freq) in N.
    """
    n, d = motion.rigid_body_dofs.shape
    F = test.freq.size
    per_line = _one_line(n, d, shift).map(F)
    flat = [
        ca.repmat(ca.densify(matrix), 1, F) for matrix in (motion.mass, motion.damping, motion.stiffness, motion.push)
    ]
    answer = per_line(ca.DM(2 * np.pi * test.freq).T, *flat)  # (2n, d * F), the directions of a line side by side
    u_re, u_im = parts_of(test.base)
    real: list[ca.MX] = []
    imag: list[ca.MX] = []
    for run in range(test.n_runs):
        at = slice(run * F, (run + 1) * F)
        re, im = ca.MX.zeros(n, F), ca.MX.zeros(n, F)
        for j in range(d):
            H_re, H_im = answer[:n, j::d], answer[n:, j::d]
            x_re, x_im = (ca.repmat(part[j, at], n, 1) for part in (u_re, u_im))
            re, im = re + H_re * x_re - H_im * x_im, im + H_re * x_im + H_im * x_re
        real.append(re)
        imag.append(im)
    a = Response(ca.horzcat(*real), ca.horzcat(*imag))
    push, rigid = motion.push, motion.rigid_body_mass
    return a, Response(push.T @ a.real + rigid @ u_re, push.T @ a.imag + rigid @ u_im)


def absolute_response(test: Measurement, motion: Motion) -> Response:
    """Absolute accelerations of the sensors under a test's base motion, (n_sensors, runs * n_freq), m/s²."""
    a, _ = relative_response(test, motion)
    R, G = ca.DM(motion.recovery), ca.DM(test.rigid_body)
    u_re, u_im = parts_of(test.base)
    return Response(R @ a.real + G @ u_re, R @ a.imag + G @ u_im)


def relative_misfit(test: Measurement, motion: Motion, *, weighted: bool = False, shift: float = 0.0) -> ca.MX:
    """Relative residuals, stacked, as `response.residual` has them: of accelerations, then of a measured force."""
    a, f = relative_response(test, motion, shift=shift)
    R = ca.DM(motion.recovery)
    records = [(test.relative, Response(R @ a.real, R @ a.imag))]
    records += [] if test.force is None else [(test.force, f)]
    pieces: list[ca.MX] = []
    for (record, predicted), (weight, scale) in zip(records, weights_of_test(test, weighted=weighted), strict=True):
        real, imag = parts_of(record)
        pieces += [ca.DM(weight / scale) * part for part in (predicted.real - real, predicted.imag - imag)]
    return ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in pieces))


def _one_line(n: int, d: int, shift: float) -> ca.Function:
    """Relative acceleration of one line for unit base motion, real over imaginary part, (2n, d)."""
    w = ca.MX.sym("w")
    M, C, K, B = ca.MX.sym("M", n, n), ca.MX.sym("C", n, n), ca.MX.sym("K", n, n), ca.MX.sym("B", n, d)
    # s² M + s C + K, and -s² B on the right: where nothing moves at rest, s = 0, that is zero too.
    real, imag = K + shift * C - (w**2 - shift**2) * M, w * C + 2 * shift * w * M
    dynamic = ca.blockcat([[real, -imag], [imag, real]])
    right = ca.vertcat((w**2 - shift**2) * B, -2 * shift * w * B)
    return ca.Function("line", [w, M, C, K, B], [ca.solve(dynamic, right, _SOLVER)])
