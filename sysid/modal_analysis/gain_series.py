"""Squared error of a record in modes of fixed frequencies, without a sum over lines.

The gain of a mode whose frequency is fixed depends on its damping ratio alone, and smoothly: it is a short Chebyshev
series in the logarithm of the ratio. All sums over lines are then made once, and what is left for each candidate are
products of small matrices.
"""

from __future__ import annotations

import numpy as np

from sysid.modal_analysis.response import gains
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF

# Candidates whose gains are made at once: those of more leave a processor's cache before they are used. Products of all
# candidates have this size, because BLAS rounds differently where the size differs.
_BLOCK = 64


class GainSeries:
    """Gains of modes with fixed frequencies, ``g_k(f; zeta) = sum_j T_j(u) b_kj(f)``, T_j Chebyshev's polynomials.

    u runs from -1 to 1 while log zeta runs over its range.

    Parameters
    ----------
    freq : (n_freq,), Hz
    omega : (n,), rad/s
    lower, upper : (n,)
        Range of each mode's damping ratio, ``0 < lower < upper``.
    shift : float, 1/s
        Of the complex frequencies, see `sysid.modal_analysis.response.modal_gains`.
    tolerance : float
        Of the gains, relative to their largest.

    Attributes
    ----------
    basis : (n, terms, n_freq) complex
        The b_kj.
    """

    def __init__(
        self, freq: Array, omega: Array, lower: Array, upper: Array, shift: float = 0.0, tolerance: float = 1e-9
    ) -> None:
        self.lower, self.upper = lower, upper
        self.terms = terms_needed(float(np.max(upper / lower)), tolerance)
        angles = np.pi * (np.arange(self.terms) + 0.5) / self.terms
        centre, half = self._range
        ratios = np.exp(centre + half * np.cos(angles)[:, None])  # at the nodes, (terms, n)
        values = np.stack([gains(freq, omega, at, shift) for at in ratios])
        weights = np.cos(np.arange(self.terms)[:, None] * angles) * 2 / self.terms
        weights[0] /= 2
        self.basis: ComplexArray = np.tensordot(weights, values, axes=1).swapaxes(0, 1)

    @property
    def _range(self) -> tuple[Array, Array]:
        """Middle of the range of log zeta, and half its length, (n,) each."""
        low, high = np.log(self.lower), np.log(self.upper)
        return (low + high) / 2, (high - low) / 2

    def polynomials(self, ratios: Array) -> Array:
        """T_j at ratios (n, count): (terms, n, count)."""
        centre, half = self._range
        u = (np.log(ratios) - centre[:, None]) / half[:, None]
        T = np.empty((self.terms, *u.shape))
        T[0], T[1] = 1.0, u
        u *= 2
        for j in range(2, self.terms):  # T_j = 2 u T_{j - 1} - T_{j - 2}
            np.multiply(u, T[j - 1], out=T[j])
            T[j] -= T[j - 2]
        return T

    def holds(self, ratios: Array) -> Array:
        """Which candidates' ratios (count, n) are all within the range, to round-off, (count,)."""
        slack = 1 + 1e-12
        return np.all((ratios >= self.lower / slack) & (ratios <= self.upper * slack), axis=1)


def terms_needed(ratio: float, tolerance: float) -> int:
    """Terms of a gain's Chebyshev series over damping ratios with this quotient of the largest to the least.

    A gain is infinite at imaginary ratios only, where log zeta is ``pi / 2`` off the real axis, and u
    ``pi / log(ratio)`` off its own: that sets the rate of convergence.

    >>> terms_needed(10.0, 1e-8), terms_needed(100.0, 1e-8)
    (21, 33)
    """
    rate = np.arcsinh(np.pi / np.log(ratio))  # asymptotic: up to four terms more are needed
    return int(np.ceil(np.log(1 / tolerance) / rate)) + 4


class SummedRecord:
    """Squared error of one record as a form of second degree in modal residues, all lines summed beforehand.

    The record is ``sum_k shape_k g_k load_k u``, relative accelerations; a base force has besides what moves with the
    base as a rigid body, which counts as d modes of gain 1.

    Parameters
    ----------
    record, base : (runs, channels, n_freq), (runs, d, n_freq) complex
    channel, line : (channels,), (runs, n_freq)
        Weights, whose product is the weight of a number of the record.
    recovery : (channels, s)
        Takes the modes' shapes to the channels.
    series : GainSeries
    static : bool
        Whether there are d modes of gain 1 behind those of the series.
    beyond : (k, runs, n_freq), complex
        Functions of which every channel has the best sum, real, on top.

    Notes
    -----
    The square of a small error is a difference of large numbers: at a relative error of 1e-6 half of its digits are
    lost.
    """

    def __init__(
        self,
        record: ComplexArray,
        base: ComplexArray,
        channel: Array,
        line: Array,
        recovery: Array,
        series: GainSeries,
        *,
        static: bool = False,
        beyond: ComplexArray,
    ) -> None:
        recovery, self._line = channel[:, None] * recovery, line
        self._metric = recovery.T @ recovery
        weighted, u = channel[:, None] * line[:, None] * record, line[:, None] * base
        self.size = float(np.sum(np.abs(weighted) ** 2))
        d, (n, terms, lines) = base.shape[1], series.basis.shape
        still = d if static else 0
        # Of all runs together; the gains are the same in each.
        spectrum = np.einsum("rdf,ref->def", u.conj(), u)
        onto_base = recovery.T @ np.einsum("rcf,rdf->dcf", weighted, u.conj())
        overlap = (_functions(series.basis, still).conj() @ onto_base.reshape(-1, lines).T).real
        self._inner = _inner_products(spectrum, series.basis, still)
        coordinates, overlap = self._inner.coordinates[:, None], overlap[..., None]
        self._gains, self._static_gains = coordinates[: n * terms].reshape(n, terms, -1), coordinates[n * terms :]
        self._overlap = np.ascontiguousarray(overlap[: n * terms].reshape(n, terms, -1).swapaxes(1, 2))
        self._static_overlap = overlap[n * terms :]
        self._beyond: tuple[Array, ...] = ()
        if len(beyond):
            basis = _orthonormal((line * beyond).reshape(len(beyond), -1), ROUND_OFF)[1].reshape(-1, *line.shape)
            moved = np.einsum("qrf,rdf->qdf", basis.conj(), u)
            onto = np.tensordot(_functions(series.basis, still), moved, (1, 2)).real  # (functions, q, d)
            of_gains = onto[: n * terms].reshape(n, terms, *onto.shape[1:])
            target = np.einsum("qrf,rcf->cq", basis.conj(), weighted).real
            self._beyond = recovery, of_gains, onto[n * terms :], target

    def squared(self, shapes: Array, loads: Array, polynomials: Array, inner: Array | None = None) -> Array:
        """Squared error of candidates, (count,).

        Parameters
        ----------
        shapes : (count, m, s)
            Of the modes, a row each; the static ones last.
        loads : (count, m, d)
            Participations of the modes, rows of the rigid-body mass of the static ones.
        polynomials : (terms, n, count)
            `GainSeries.polynomials` of the modes' ratios.
        inner : (count, m, m), optional
            `inner` of these loads and polynomials where it is known, of this record or one that `weighs_like` it.
        """
        (n, count), (m, d) = polynomials.shape[1:], loads.shape[1:]
        inner = self.inner(loads, polynomials) if inner is None else inner
        polynomials = _filled(polynomials, 2)
        overlap = np.empty((m, self._overlap.shape[1], polynomials.shape[2]))
        for at in _blocks(count):
            np.matmul(self._overlap, polynomials[..., at].swapaxes(0, 1), out=overlap[:n, :, at])
        overlap[n:] = self._static_overlap
        overlap = overlap[..., :count]
        by_mode = [np.ascontiguousarray(part.transpose(1, 2, 0)) for part in (shapes, loads)]
        onto_loads = np.einsum("kdsp,ksp->kdp", overlap.reshape(m, d, -1, count), by_mode[0])
        squared = self.size - 2 * np.einsum("kdp,kdp->p", onto_loads, by_mode[1])
        squared += np.einsum("pkl,pkl->p", shapes @ self._metric @ shapes.swapaxes(1, 2), inner)
        return squared - self._explained(shapes, loads, polynomials[..., :count]) if self._beyond else squared

    def _explained(self, shapes: Array, loads: Array, polynomials: Array) -> Array:
        """Part of the squared error that the functions beyond explain, (count,)."""
        recovery, of_gains, of_static, target = self._beyond
        n = len(of_gains)
        moved = np.einsum("jkp,kjqd->pkqd", polynomials, of_gains)
        onto = np.einsum("pkqd,pkd->pkq", moved, loads[:, :n])
        still = np.einsum("eqd,pkd->pkq", of_static, loads[:, n:])  # one function, if any
        onto_channels = np.einsum("pks,pkq->psq", shapes, np.concatenate([onto, still], axis=1))
        left = np.einsum("cs,psq->pcq", recovery, onto_channels) - target
        return np.einsum("pcq,pcq->p", left, left)

    def inner(self, loads: Array, polynomials: Array) -> Array:
        """Inner products of the modes' accelerations over all lines, (count, m, m)."""
        count, m, _ = loads.shape
        loads, polynomials = _filled(loads, 0), _filled(polynomials, 2)
        products = [self._inner.products(loads[at], self._gains_of(polynomials[..., at], m)) for at in _blocks(count)]
        return np.concatenate(products)[:count]

    def weighs_like(self, other: SummedRecord) -> bool:
        """True where the lines of both have the same weights, so that `inner` is the same."""
        return np.array_equal(self._line, other._line)

    def _gains_of(self, polynomials: Array, m: int) -> Array:
        """Coordinates of the gains of m modes, (count, m, rank)."""
        n, count = polynomials.shape[1:]
        coordinates = np.empty((m, count, self._gains.shape[2]))
        np.matmul(polynomials.transpose(1, 2, 0), self._gains, out=coordinates[:n])
        coordinates[n:] = self._static_gains
        return coordinates.swapaxes(0, 1)


def _blocks(count: int) -> list[slice]:
    """Candidates that go together."""
    return [slice(at, at + _BLOCK) for at in range(0, count, _BLOCK)]


def _filled(array: Array, axis: int) -> Array:
    """An array of candidates, those along an axis filled up to whole blocks by zeros."""
    spare = -array.shape[axis] % _BLOCK
    return np.pad(array, [(0, spare if i == axis else 0) for i in range(array.ndim)]) if spare else array


class _Proportional:
    """Inner products of modal accelerations where the base's spectrum is the same at all lines but for its size.

    As in tests where each run moves one direction, all alike, and with one direction alone always.

    Attributes
    ----------
    coordinates : (functions, rank)
        Of the gains in an orthonormal basis over the lines. What the basis leaves out is at right angles to it, so
        that its square is all that is lost.
    """

    def __init__(self, ratios: Array, power: Array, functions: ComplexArray) -> None:
        self._ratios = ratios
        self.coordinates = _orthonormal(functions * np.sqrt(power), NEGLIGIBLE)[0]

    def products(self, loads: Array, gains_of: Array) -> Array:
        """(count, m, m) from loads (count, m, d) and coordinates of the gains (count, m, rank)."""
        count, m, _ = gains_of.shape
        gram = np.empty((count, m, m))
        for half in (slice(m // 2), slice(m // 2, m)):  # because BLAS's kernel for a matrix with itself is slower
            np.matmul(gains_of[:, half], gains_of.swapaxes(1, 2), out=gram[:, half])
        gram *= loads @ self._ratios @ loads.swapaxes(1, 2)
        return gram


class _Correlated:
    """The same for a spectrum that varies over the lines as it likes: each mode has a basis of its own.

    Attributes
    ----------
    coordinates : (functions, rank)
        Of each mode's gains in that mode's basis.
    """

    def __init__(self, spectrum: ComplexArray, gains_of: ComplexArray, static: int) -> None:
        root = np.sqrt(np.einsum("ddf->f", spectrum).real)
        parts = [_orthonormal(functions * root, ROUND_OFF) for functions in gains_of]
        parts += [_orthonormal(root[None] + 0j, NEGLIGIBLE)] * min(static, 1)
        rank = max(coordinates.shape[1] for coordinates, _ in parts)
        padded = [np.pad(part, ((0, 0), (0, rank - part.shape[1]))) for part, _ in parts]
        self.coordinates = np.concatenate(padded)
        bases = [np.pad(basis, ((0, rank - len(basis)), (0, 0))) for _, basis in parts]
        bases += bases[-1:] * (static - 1)
        inside = np.divide(spectrum, root**2, out=np.zeros_like(spectrum), where=root > 0)
        # Of mode k, direction d, function i: (k, d i, l e j), k and l modes, d and e directions, i and j functions.
        basis, m = np.concatenate(bases), len(bases)
        products = np.array([[((basis.conj() * part) @ basis.T).real for part in row] for row in inside])
        products = products.reshape(*inside.shape[:2], m, rank, m, rank).transpose(2, 0, 3, 4, 1, 5)
        self._products = np.ascontiguousarray(products).reshape(m, len(inside) * rank, -1)

    def products(self, loads: Array, gains_of: Array) -> Array:
        """As above."""
        count, m, _ = gains_of.shape
        both = (loads[..., None] * gains_of[..., None, :]).reshape(count, m, -1)
        onto = (both.swapaxes(0, 1) @ self._products).reshape(m, count, m, -1)
        return np.einsum("kplq,plq->pkl", onto, both)


def _inner_products(spectrum: ComplexArray, gains_of: ComplexArray, static: int) -> _Proportional | _Correlated:
    """Inner products of modal accelerations.

    Parameters
    ----------
    spectrum : (d, d, n_freq) complex
        Of the base.
    gains_of : (n, terms, n_freq) complex
    static : int
        Number of modes of gain 1.
    """
    power = np.einsum("ddf->f", spectrum).real
    ratios = spectrum.sum(axis=2).real / power.sum()
    if np.abs(spectrum - ratios[..., None] * power).max() < ROUND_OFF * power.max():
        return _Proportional(ratios, power, _functions(gains_of, static))
    return _Correlated(spectrum, gains_of, static)


def _functions(gains_of: ComplexArray, static: int) -> ComplexArray:
    """Terms of all gains, one below the other, and 1 where there are static modes."""
    lines = gains_of.shape[-1]
    return np.concatenate([gains_of.reshape(-1, lines), np.ones((min(static, 1), lines))])


def _orthonormal(functions: ComplexArray, tolerance: float) -> tuple[Array, ComplexArray]:
    """Coordinates (count, rank) of functions (count, n_freq), real combinations of an orthonormal basis (rank, n_freq).

    Orthonormal are real and imaginary parts, side by side; the tolerance is relative to the largest singular value.
    """
    left, values, right = np.linalg.svd(np.hstack([functions.real, functions.imag]), full_matrices=False)
    kept = values > tolerance * values[0]
    real, imaginary = np.split(right[kept], 2, axis=1)
    return left[:, kept] * values[kept], real + 1j * imaginary
