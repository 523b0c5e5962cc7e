"""The records' part of the objective for many candidates at once, on compiled CasADi functions and batched LAPACK."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import columns, residual, weights_of_test
from sysid.models.spectrum import replace_spectrum
from sysid.problem.batch_response import by_states
from sysid.problem.matrices import Matrices
from sysid.structure.structure import Array

CHUNK = 64  # candidates a compiled call: fixed, so that the bits do not depend on the swarm's size
_THREADS = 2  # of CasADi's own; the bits do not depend on it
_ROUND_OFF = 1e-9  # of the largest entry


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
        M, M_S0, M_00, K, C, L, H = matrices.function(x)
        G = ca.DM(matrices.rigid_body)
        if matrices.by_ratios:
            push = L @ (L.T @ G) + M_S0
            parts = [matrices.inverse(L), push, H, G.T @ push + M_S0.T @ G + M_00]
            parts += [] if matrices.semidefinite else [M_S0, M_00]
            self._evaluate = Batch(self._error_of_modes(), _THREADS)
        else:
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
        L_inverse, push, H, rigid, *base = self._expand(particles)
        # A candidate that is no structure must not stop the eigensolver for the others.
        broken = ~np.all(np.isfinite(H), axis=(1, 2))
        H[broken] = np.eye(H.shape[1])
        lam, psi = np.linalg.eigh((H + H.transpose(0, 2, 1)) / 2)
        if spectrum is not None:
            lam = replace_spectrum(lam, spectrum)
        if base:
            broken |= _base_is_light(L_inverse, *base)
        with np.errstate(invalid="ignore"):
            omega = np.sqrt(lam)
        phi = L_inverse.transpose(0, 2, 1) @ psi
        gamma = phi.transpose(0, 2, 1) @ push
        squared = self._evaluate(phi, gamma, omega, rigid, particles)[0].ravel()
        squared[broken] = np.nan
        return squared

    # -- a damping matrix: state space -------------------------------------------------------------

    def _direct(self, count: int, parts: list[Array]) -> Array:
        M, K, C, B, rigid, M_S0, M_00 = parts
        freq, n = self.test.freq, M.shape[1]
        broken = ~np.all([np.all(np.isfinite(part), axis=(1, 2)) for part in (M, K, C, B)], axis=0)
        M[broken], K[broken], C[broken], B[broken] = np.eye(n), np.eye(n), 0.0, 0.0
        light = _least(M) <= 0
        M[light] = np.eye(n)
        light |= _least(K) <= 0
        remainder = M_00 - M_S0.swapaxes(1, 2) @ np.linalg.solve(M, M_S0)
        light |= _least(remainder) < -_ROUND_OFF * np.abs(M).max(axis=(1, 2))
        # A damping that feeds energy in is no structure's either.
        light |= _least(C) < -_ROUND_OFF * np.abs(C).max(axis=(1, 2))
        K[light] = np.eye(n)
        base, test = columns(self.test.base), self.test
        a = by_states(M, K, C, B, freq, self.shift)  # (count, n, d, n_freq)
        a = np.einsum("pndf,drf->pnrf", a, base.reshape(-1, test.n_runs, freq.size)).reshape(count, n, -1)
        records = [(test.relative, self.matrices.recovery @ a)]
        if test.force is not None:
            records.append((test.force, B.swapaxes(1, 2) @ a + rigid @ base))
        squared = np.zeros(count)
        for (record, made), (weight, scale) in zip(records, weights_of_test(test, weighted=True), strict=True):
            squared += np.sum(np.abs(weight * (made - columns(record))) ** 2, axis=(1, 2)) / scale**2
        squared[broken | light] = np.nan
        return squared


class Batch:
    """A CasADi function of one candidate, over a chunk of candidates at once and without conversions.

    Parameters
    ----------
    function : casadi.Function
        Dense; of the arrays of one candidate.
    threads : int
        CasADi's own; 0 for none.
    """

    def __init__(self, function: ca.Function, threads: int = 0) -> None:
        mapped = function.map(CHUNK, "thread", threads) if threads else function.map(CHUNK)
        # CasADi stands columns side by side: (rows, CHUNK * columns) is (CHUNK, columns, rows) here.
        self._given = [np.zeros((CHUNK, *function.size_in(i)[::-1])) for i in range(function.n_in())]
        self._made = [np.zeros((CHUNK, *function.size_out(i)[::-1])) for i in range(function.n_out())]
        self._buffer, self._run = mapped.buffer()
        for i, array in enumerate(self._given):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self._made):
            self._buffer.set_res(i, array.data)

    def __call__(self, *arrays: Array) -> list[Array]:
        """Outputs (count, rows, columns) of inputs (count, rows) or (count, rows, columns), count up to CHUNK."""
        count = len(arrays[0])
        for place, array in zip(self._given, arrays, strict=True):
            place[:count] = array.reshape(count, *place.shape[:0:-1]).swapaxes(1, 2)
            place[count:] = place[count - 1]  # the last one again and again fills the chunk
        self._run()
        return [np.array(made[:count].swapaxes(1, 2), order="C") for made in self._made]


def in_chunks(function: Callable[[Array], Array], particles: Array) -> Array:
    """A function of a chunk of candidates over all of them."""
    return np.concatenate([function(particles[at : at + CHUNK]) for at in range(0, len(particles), CHUNK)])


def _base_is_light(L_inverse: Array, coupling: Array, base: Array) -> Array:
    """Whether M_00 is less than ``M_S0' M_SS^-1 M_S0``, which no structure's is, (count,)."""
    low = L_inverse @ coupling
    size = np.abs(base).max(axis=(1, 2)) + np.abs(low).max(axis=(1, 2)) ** 2
    return _least(base - low.swapaxes(1, 2) @ low) < -_ROUND_OFF * size


def _least(stack: Array) -> Array:
    """Least eigenvalue of each symmetric matrix; minus infinity where it is no number."""
    bad = ~np.all(np.isfinite(stack), axis=(1, 2))
    clean = np.where(bad[:, None, None], 0.0, (stack + stack.swapaxes(1, 2)) / 2)
    return np.where(bad, -np.inf, np.linalg.eigvalsh(clean)[:, 0])


def expanded(function: ca.Function) -> ca.Function:
    """The same in scalar operations where all of it can be: several times faster for small matrices."""
    try:
        return function.expand()
    except RuntimeError:  # a linear solver or an interpolant inside has no scalar form
        return function
