"""Functions, modes and responses of many candidates at once, on CasADi's virtual machine and batched LAPACK.

All take matrices of ``count`` candidates: mass M and stiffness K (count, n, n), load vectors B (count, n, d), lines in
Hz and a shift of the complex frequencies ``s = shift + i w``, 1/s; all return relative accelerations for unit base
motion, (count, n, d, n_freq). What one candidate gives does not depend on the others, to the last bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from itertools import chain
from typing import NamedTuple

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import columns, residual, weights_of_test
from sysid.models.spectrum import replace_spectrum
from sysid.problem.matrices import Matrices
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EPSILON, ROUND_OFF

CHUNK = 64  # candidates a call by lines: fixed, so that the bits do not depend on the swarm's size
_IN_STEP = 128  # candidates that go in step: with more, the virtual machine's memory leaves a processor's cache


class Batch:
    """A CasADi function of one candidate over many candidates, without conversions.

    A function in scalar operations is replayed for a chunk of candidates in step (`elementwise`), another is called for
    one after the other, by so many `threads` of CasADi's own, 0 for none. What a candidate gives does not depend on the
    others, to the last bit. An instance is for one thread at a time; ``copy`` makes one for another thread.
    """

    def __init__(self, function: ca.Function, threads: int = 0) -> None:
        self._in_step = _is_scalar(function)
        # One after the other a chunk that few candidates fill costs as much as a full one.
        self._chunk = _IN_STEP if self._in_step else CHUNK if threads else 8
        if self._in_step:
            function = _without_zeros(function)
            self._compiled = elementwise(function, self._chunk)
        else:
            self._compiled = function.map(self._chunk, "thread", threads) if threads else function.map(self._chunk)
        self._inputs = [function.sparsity_in(i) for i in range(function.n_in())]
        self._outputs = [function.sparsity_out(i) for i in range(function.n_out())]
        self._allocate()

    def __copy__(self) -> Batch:
        """The same compiled function with memory of its own."""
        other = object.__new__(Batch)
        other.__dict__.update(self.__dict__)
        other._allocate()
        return other

    def _allocate(self) -> None:
        """Memory of inputs and outputs, which CasADi reads and writes in place."""
        self._buffer, self._run = self._compiled.buffer()
        self._given, read = self._places(self._inputs)
        self._results, written = self._places(self._outputs)
        for i, memory in enumerate(read):
            self._buffer.set_arg(i, memory.data)
        for i, memory in enumerate(written):
            self._buffer.set_res(i, memory.data)

    def _places(self, matrices: list[ca.Sparsity]) -> tuple[list[Array], list[Array]]:
        """Memory of inputs or outputs of a chunk, seen as (candidates, rows, columns); and that of each part."""
        if not self._in_step:
            memory = [np.zeros((self._chunk, *matrix.shape[::-1])) for matrix in matrices]
            return [array.swapaxes(1, 2) for array in memory], memory
        # A power of two between entries would put them in the same lines of a cache.
        places = [np.zeros((*matrix.shape, self._chunk + 8))[..., : self._chunk] for matrix in matrices]
        entries = [place[i, j] for place, matrix in zip(places, matrices, strict=True)
                   for i, j in zip(*matrix.get_triplet(), strict=True)]  # fmt: skip
        return [np.moveaxis(place, -1, 0) for place in places], entries

    def __call__(self, *arrays: Array) -> list[Array]:
        """Outputs (count, rows, columns) of inputs (count, rows) or (count, rows, columns)."""
        outputs = [np.empty((len(arrays[0]), *matrix.shape)) for matrix in self._outputs]
        for start in range(0, len(arrays[0]), self._chunk):
            chunk = slice(start, start + self._chunk)
            for place, array in zip(self._given, arrays, strict=True):
                part = array[chunk]
                place[: len(part)] = part.reshape(len(part), *place.shape[1:])
                place[len(part) :] = place[len(part) - 1]  # the last one fills up the chunk
            self._run()
            for output, result in zip(outputs, self._results, strict=True):
                output[chunk] = result[: len(output[chunk])]
        return outputs


def elementwise(function: ca.Function, count: int) -> ca.Function:
    """A function in scalar operations (SX) as one of `count` candidates, each of its operations done for all at once.

    CasADi's virtual machine then spends its time on numbers, not on reading instructions. Inputs are columns (count,),
    one an entry of an input, one input after the other; outputs likewise. Columns of their own because the virtual
    machine then reads and writes each where it is needed, and holds fewer.
    """
    inputs = [[ca.MX.sym("i", count) for _ in range(function.nnz_in(i))] for i in range(function.n_in())]
    outputs = [[ca.MX()] * function.nnz_out(i) for i in range(function.n_out())]
    work = [ca.MX()] * function.sz_w()
    for k in range(function.n_instructions()):
        operation, read, write = (of(k) for of in (function.instruction_id, function.instruction_input,
                                                   function.instruction_output))  # fmt: skip
        if operation == ca.OP_INPUT:
            work[write[0]] = inputs[read[0]][read[1]]
        elif operation == ca.OP_OUTPUT:
            value = work[read[0]]
            outputs[write[0]][write[1]] = value if value.numel() == count else ca.repmat(value, count)
        elif operation == ca.OP_CONST:
            work[write[0]] = ca.MX(function.instruction_constant(k))
        elif len(read) == 1:
            work[write[0]] = ca.MX.unary(operation, work[read[0]])
        else:
            work[write[0]] = ca.MX.binary(operation, work[read[0]], work[read[1]])
    return ca.Function(function.name(), list(chain(*inputs)), list(chain(*outputs)))


def _without_zeros(function: ca.Function) -> ca.Function:
    """The same function, outputs without the entries that are always zero."""
    symbols = function.sx_in()
    return ca.Function(function.name(), symbols, [ca.sparsify(part) for part in function.call(symbols)])


def _is_scalar(function: ca.Function) -> bool:
    """True where a function is all scalar operations, and not too many to be replayed."""
    # Each instruction takes some ten microseconds to set up.
    if not function.is_a("SXFunction") or function.n_instructions() > 50_000:
        return False
    return all(function.instruction_id(k) != ca.OP_CALL for k in range(function.n_instructions()))


def in_chunks(function: Callable[[Array], Array], particles: Array) -> Array:
    """A function of a chunk of candidates over all of them."""
    return np.concatenate([function(particles[at : at + CHUNK]) for at in range(0, len(particles), CHUNK)])


def expanded(function: ca.Function) -> ca.Function:
    """The same in scalar operations where all of it can be: several times faster for small matrices."""
    try:
        return function.expand()
    except RuntimeError:  # a linear solver or an interpolant inside has no scalar form
        return function


class BatchModes(NamedTuple):
    """Mass-normalised modes of many candidates, those of a candidate in ascending order of frequency.

    Shapes (count, n, n), one mode a row; participations (count, n, d); rigid-body mass ``[G; I]' M [G; I]`` (count, d,
    d).
    """

    shapes: Array
    loads: Array
    rigid_body_mass: Array


def batch_modes(H: Array, right: Array, rigid: Array, *base: Array) -> tuple[Array, BatchModes]:
    """Squared circular frequencies (count, n), ascending, and modes; a candidate that is no structure has NaN.

    With ``H = Psi Lambda Psi'``, (count, n, n), and L the Cholesky factor of M_SS, the modes are ``Phi = L^-T Psi`` and
    their participations ``Phi' B = Psi' L^-1 B``, ``B = M_SS G + M_S0``. H is overwritten where it is not finite; its
    lower triangle counts. `right` is ``[L^-1, L^-1 B]`` (count, n, n + d), `rigid` the rigid-body mass (count, d, d);
    `base`, where the whole mass may be indefinite, ``L^-1 M_S0`` (count, n, d) and M_00 (count, d, d).
    """
    n = H.shape[1]
    broken = ~np.isfinite(np.einsum("pij->p", H))
    H[broken] = np.eye(n)  # must not stop the eigensolver for the others
    lam, psi = np.linalg.eigh(H)
    if base:
        broken |= base_is_light(*base)
    lam[broken], psi[broken] = np.nan, np.nan
    projected = psi.swapaxes(1, 2) @ right
    return lam, BatchModes(projected[..., :n], projected[..., n:], rigid)


def base_is_light(low: Array, base: Array) -> Array:
    """True where M_00 is less than ``M_S0' M_SS^-1 M_S0``, ``low = L^-1 M_S0``, which no structure's is, (count,)."""
    size = np.abs(base).max(axis=(1, 2)) + np.abs(low).max(axis=(1, 2)) ** 2
    return least(base - low.swapaxes(1, 2) @ low) < -ROUND_OFF * size


def least(stack: Array) -> Array:
    """Least eigenvalue of each symmetric matrix; minus infinity where it is no number."""
    bad = ~np.all(np.isfinite(stack), axis=(1, 2))
    clean = np.where(bad[:, None, None], 0.0, (stack + stack.swapaxes(1, 2)) / 2)
    return np.where(bad, -np.inf, np.linalg.eigvalsh(clean)[:, 0])


def by_states(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Response from the eigenvalues of the state space, ``a = s² v``, the damping a matrix (count, n, n).

    Candidates whose eigenvectors (nearly) fall together are solved `by_lines`.
    """
    count, n, d = B.shape
    rates = -np.linalg.solve(M, np.concatenate([K, C, B], axis=2))
    A = np.zeros((count, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:] = rates[..., : 2 * n]
    s = shift + 2j * np.pi * freq
    lam, vectors = np.linalg.eig(A)
    right = np.zeros((count, 2 * n, d + 2 * n), dtype=complex)
    right[:, n:, :d] = rates[..., 2 * n :]
    right[..., d:] = np.eye(2 * n)
    solved = _solved(vectors, right)  # of the load vectors, and the inverse
    strength, inverse = solved[..., :d], solved[..., d:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        poles = s**2 / (s - lam[:, :, None])
        response = np.einsum("pik,pkd,pkf->pidf", vectors[:, :n], strength, poles, optimize=True)
        # Structures have some hundreds; the condition of the eigenvectors of a state matrix, its rows scaled, rises
        # without bound where they fall together, as at critical damping.
        ill = ~(_squared_condition(vectors, inverse) < (ROUND_OFF / EPSILON) ** 2)
    if np.any(ill):
        response[ill] = by_lines(M[ill], K[ill], C[ill], B[ill], freq, shift)
    return response


def by_lines(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Response by one linear system a line, the damping a matrix: slower, and exact for every damping.

    NaN where a candidate without damping has a natural frequency on a line.
    """
    s = (shift + 2j * np.pi * freq)[:, None, None]
    response = np.full((*B.shape, freq.size), np.nan, dtype=complex)
    for p in range(len(M)):  # one candidate at a time: the systems of all lines of all would fill the memory
        with contextlib.suppress(np.linalg.LinAlgError):
            v = np.linalg.solve(s**2 * M[p] + s * C[p] + K[p], -B[p, None].astype(complex))
            response[p] = np.moveaxis(s**2 * v, 0, -1)
    return response


def _solved(matrices: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Solutions of each system; NaN where a matrix is singular."""
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:  # one among them, which must not stop the others
        out = np.full_like(right, np.nan)
        for p in range(len(matrices)):
            with contextlib.suppress(np.linalg.LinAlgError):
                out[p] = np.linalg.solve(matrices[p], right[p])
        return out


def _squared_condition(vectors: ComplexArray, inverse: ComplexArray) -> Array:
    """Square of the condition number in the Frobenius norm, each row of the vectors scaled to a largest entry of one.

    So that it depends on no unit: displacements stand above velocities.
    """
    squares = vectors.real**2 + vectors.imag**2
    size = squares.max(axis=2, keepdims=True)
    of_inverse = (inverse.real**2 + inverse.imag**2).sum(axis=1)
    return (squares / size).sum(axis=(1, 2)) * (of_inverse * size[..., 0]).sum(axis=1)


_THREADS = 2  # of CasADi's own; the bits do not depend on it


class TestObjective:
    """Squared relative residual of one test: (count, size) to (count,), as `TestTerm.rows` has it.

    Responses follow from LAPACK's batched eigensolvers: of the undamped structure where damping is by ratios, else of
    the state space. `shift`, 1/s, is that of the complex frequencies from the imaginary axis.
    """

    __test__ = False  # pytest takes names in Test for its own

    def __init__(self, test: Measurement, matrices: Matrices, shift: float) -> None:
        self.test, self.matrices, self.shift = test, matrices, shift
        self.beyond = matrices.beyond.of(test, shift)
        x = ca.MX.sym("x", matrices.function.numel_in(0))
        if matrices.by_ratios:
            parts = matrices.of_modes(x)
            self._evaluate = Batch(self._error_of_modes(), _THREADS)
        else:
            m = matrices.motion(x)
            parts = [m.mass, m.stiffness, m.damping, m.push, m.rigid_body_mass, m.coupling, m.base]
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
        miss = self.beyond.without_in(miss)
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
        every = zip(records, weights_of_test(test, weighted=True), strict=True)
        for i, ((record, predicted), (weight, scale)) in enumerate(every):
            miss = weight / scale * (predicted - columns(record))
            miss = np.moveaxis(self.beyond.without(i, np.moveaxis(miss, 0, -1)), -1, 0)
            squared += np.sum(np.abs(miss) ** 2, axis=(1, 2))
        squared[broken | light] = np.nan
        return squared
