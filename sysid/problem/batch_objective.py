"""The records' part of the objective for many candidates at once, on compiled CasADi functions and batched LAPACK."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import columns, residual, weights_of_test
from sysid.models.spectrum import replace_spectrum
from sysid.problem.batch import Batch, expanded, in_chunks
from sysid.problem.batch_modes import batch_modes, least
from sysid.problem.batch_response import by_states
from sysid.problem.matrices import Matrices
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

_THREADS = 2  # of CasADi's own; the bits do not depend on it


class TestObjective:
    """Squared relative residual of one test: (count, size) to (count,), as `TestTerm.rows` has it.

    Responses follow from LAPACK's batched eigensolvers: of the undamped structure where damping is by ratios, else of
    the state space.

    Parameters
    ----------
    test : Measurement
    matrices : Matrices
    shift : float, 1/s
        Of the complex frequencies from the imaginary axis.
    """

    __test__ = False  # pytest takes names in Test for its own

    def __init__(self, test: Measurement, matrices: Matrices, shift: float) -> None:
        self.test, self.matrices, self.shift = test, matrices, shift
        x = ca.MX.sym("x", matrices.function.numel_in(0))
        if matrices.by_ratios:
            parts = matrices.of_modes(x)
            self._evaluate = Batch(self._error_of_modes(), _THREADS)
        else:
            M, M_S0, M_00, K, C = matrices.function(x)[:5]
            G = ca.DM(matrices.rigid_body)
            push = M @ G + M_S0
            parts = [M, K, C, push, G.T @ push + M_S0.T @ G + M_00, M_S0, M_00]
        self._expand = Batch(expanded(ca.Function("expand", [x], [ca.densify(part) for part in parts])))

    def squared(self, particles: Array, spectrum: Array | None = None) -> Array:
        """Of each candidate, (count,); NaN where it is no structure.

        Where damping is by ratios, a `spectrum`, rad/s, takes the place of each candidate's own lowest frequencies.
        """
        if self.matrices.by_ratios:
            return in_chunks(lambda chunk: self._modal(chunk, spectrum), particles)
        return in_chunks(lambda chunk: self._direct(len(chunk), self._expand(chunk)), particles)

    # -- damping by ratios: modes ------------------------------------------------------------------

    def _error_of_modes(self) -> ca.Function:
        """Squared residual of modes, rigid-body mass, and x for the ratios."""
        n, d = self.matrices.rigid_body.shape
        shapes = {"phi": (n, n), "gamma": (n, d), "omega": (n, 1), "rigid": (d, d)}
        phi, gamma, omega, rigid = (ca.MX.sym(name, *shape) for name, shape in shapes.items())
        x = ca.MX.sym("x", self.matrices.function.numel_in(0))
        ratios = self.matrices.ratio_function(x, omega)
        at_sensors = phi if self.matrices.at_sensors else ca.DM(self.matrices.recovery) @ phi
        miss = residual(self.test, at_sensors, gamma, omega, ratios, rigid, weighted=True, shift=self.shift)
        # Negative ratios are no structure's.
        squared = ca.if_else(ca.mmin(ratios) < 0, np.nan, ca.sumsqr(miss))
        return ca.Function("squared", [phi, gamma, omega, rigid, x], [squared])

    def _modal(self, particles: Array, spectrum: Array | None) -> Array:
        lam, modes = batch_modes(*self._expand(particles))
        if spectrum is not None:
            lam = replace_spectrum(lam, spectrum)
        with np.errstate(invalid="ignore"):
            omega = np.sqrt(lam)
        phi = modes.shapes.swapaxes(1, 2)
        return self._evaluate(phi, modes.loads, omega, modes.rigid_body_mass, particles)[0].ravel()

    # -- a damping matrix: state space -------------------------------------------------------------

    def _direct(self, count: int, parts: list[Array]) -> Array:
        M, K, C, B, rigid, M_S0, M_00 = parts
        freq, n = self.test.freq, M.shape[1]
        broken = ~np.all([np.all(np.isfinite(part), axis=(1, 2)) for part in (M, K, C, B)], axis=0)
        M[broken], K[broken], C[broken], B[broken] = np.eye(n), np.eye(n), 0.0, 0.0
        light = least(M) <= 0
        M[light] = np.eye(n)
        light |= least(K) <= 0
        remainder = M_00 - M_S0.swapaxes(1, 2) @ np.linalg.solve(M, M_S0)
        light |= least(remainder) < -ROUND_OFF * np.abs(M).max(axis=(1, 2))
        # A damping that feeds energy in is no structure's either.
        light |= least(C) < -ROUND_OFF * np.abs(C).max(axis=(1, 2))
        K[light] = np.eye(n)
        base, test = columns(self.test.base), self.test
        a = by_states(M, K, C, B, freq, self.shift)  # (count, n, d, n_freq)
        a = np.einsum("pndf,drf->pnrf", a, base.reshape(-1, test.n_runs, freq.size)).reshape(count, n, -1)
        records = [(test.relative, self.matrices.recovery @ a)]
        if test.force is not None:
            records.append((test.force, B.swapaxes(1, 2) @ a + rigid @ base))
        squared = np.zeros(count)
        for (record, predicted), (weight, scale) in zip(records, weights_of_test(test, weighted=True), strict=True):
            squared += np.sum(np.abs(weight * (predicted - columns(record))) ** 2, axis=(1, 2)) / scale**2
        squared[broken | light] = np.nan
        return squared
