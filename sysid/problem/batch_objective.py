"""The records' part of the objective for many candidates at once, on compiled CasADi functions and batched LAPACK."""

from __future__ import annotations

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
        motion, L = matrices.motion(x), matrices.function(x)[5]
        if matrices.by_ratios:
            G = ca.DM(motion.rigid_body_dofs)
            push = L @ (L.T @ G) + motion.coupling
            rigid = G.T @ push + motion.coupling.T @ G + motion.base
            parts = [matrices.factors(x)[1], push, matrices.function(x)[6], rigid, motion.coupling, motion.base]
            self._evaluate = self._by_modes()
        else:
            parts = [motion.mass, motion.stiffness, motion.damping, motion.push, motion.rigid_body_mass]
            parts += [motion.coupling, motion.base]
        self._expand = _expanded(ca.Function("expand", [x], [ca.densify(part) for part in parts])).map(CHUNK)

    def squared(self, particles: Array, spectrum: Array | None = None) -> Array:
        """Of each candidate, (count,); NaN where it is no structure.

        Where damping is by ratios, a `spectrum`, rad/s, takes the place of each candidate's own lowest frequencies.
        """
        return in_chunks(lambda chunk: self._chunk(chunk, spectrum), particles)

    def _chunk(self, particles: Array, spectrum: Array | None) -> Array:
        flat = [np.asarray(part) for part in self._expand(padded(particles))]
        if self.matrices.by_ratios:
            return self._modal(particles, flat, spectrum)
        return self._direct(len(particles), [stacked(part)[: len(particles)] for part in flat])

    # -- damping by ratios: modes ------------------------------------------------------------------

    def _by_modes(self) -> ca.Function:
        """Squared residual of modes, rigid-body mass, and x for the ratios."""
        n, d = self.matrices.rigid_body.shape
        shapes = {"phi": (n, n), "gamma": (n, d), "omega": (n, 1), "rigid": (d, d)}
        phi, gamma, omega, rigid = (ca.MX.sym(name, *shape) for name, shape in shapes.items())
        x = ca.MX.sym("x", self.matrices.function.numel_in(0))
        ratios = self.matrices.ratio_function(x, omega)
        at_sensors = phi if self.matrices.at_sensors else ca.DM(self.matrices.recovery) @ phi
        miss = residual(self.test, at_sensors, gamma, omega, ratios, rigid, weighted=True, shift=self.shift)
        return ca.Function("squared", [phi, gamma, omega, rigid, x], [ca.sumsqr(miss)]).map(CHUNK, "thread", _THREADS)

    def _modal(self, particles: Array, flat: list[Array], spectrum: Array | None) -> Array:
        L_inverse, push, H = (stacked(block) for block in flat[:3])
        # A candidate that is no structure must not stop the eigensolver for the others.
        broken = ~np.all(np.isfinite(H), axis=(1, 2))
        H[broken] = np.eye(H.shape[1])
        lam, psi = np.linalg.eigh((H + H.transpose(0, 2, 1)) / 2)
        if spectrum is not None:
            lam = replace_spectrum(lam, spectrum)
        if not self.matrices.semidefinite:
            broken |= _base_is_light(L_inverse, stacked(flat[4]), stacked(flat[5]))
        with np.errstate(invalid="ignore"):
            omega = np.sqrt(lam)
        phi = L_inverse.transpose(0, 2, 1) @ psi
        gamma = phi.transpose(0, 2, 1) @ push
        squared = self._evaluate(_wide(phi), _wide(gamma), omega.T, flat[3], padded(particles))
        out = np.array(squared).ravel()[: len(particles)]
        out[broken[: len(particles)]] = np.nan
        return out

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
            squared += np.sum(np.abs(np.asarray(weight) * (made - columns(record))) ** 2, axis=(1, 2)) / scale**2
        squared[broken | light] = np.nan
        return squared


def in_chunks(function: object, particles: Array) -> Array:
    """A function of a chunk of candidates over all of them."""
    assert callable(function)
    return np.concatenate([function(particles[at : at + CHUNK]) for at in range(0, len(particles), CHUNK)])


def padded(particles: Array) -> Array:
    """Candidates side by side, as a compiled call takes them: the last one again and again fills the chunk."""
    return np.concatenate([particles, np.repeat(particles[-1:], CHUNK - len(particles), axis=0)]).T


def stacked(wide: Array) -> Array:
    """CasADi's side-by-side blocks (rows, CHUNK * columns) → (CHUNK, rows, columns)."""
    return np.ascontiguousarray(wide.reshape(wide.shape[0], CHUNK, -1).transpose(1, 0, 2))


def _wide(stack: Array) -> Array:
    """Inverse of `stacked`."""
    return stack.transpose(1, 0, 2).reshape(stack.shape[1], -1)


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


def _expanded(function: ca.Function) -> ca.Function:
    """The same in scalar operations where all of it can be: several times faster for small matrices."""
    try:
        return function.expand()
    except RuntimeError:  # a linear solver or an interpolant inside has no scalar form
        return function
