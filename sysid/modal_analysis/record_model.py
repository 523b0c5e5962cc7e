r"""Whole records as a modal model with transients, and its derivatives: everything the fit of records needs a line.

A run of a test is, at its lines,

.. math:: a = \sum_k \phi_k g_k (\gamma_k u + \alpha_k / w^2 + i \beta_k / w), \quad y = G u + a + p, \quad
          f = M_{rb} u + \sum_k \gamma_k' g_k (\ldots) + p,

with two real numbers alpha, beta a mode and run for its motion at the ends, and p the traces of sampling and
detrending: real multiples of 1, i w and 1 / (i w), a channel and run. Each column of the Jacobian is a few real numbers
times a few spectra, so that normal equations come from products of spectra, and no Jacobian of all lines is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.modal_analysis.response import gain_slopes, gains
from sysid.structure.structure import Array, ComplexArray

_AT_ONCE = 4096  # lines whose derivatives are held in memory together
_FAR = 30.0  # logarithms of frequencies and damping ratios
TRACES = 3  # real numbers a channel and run: of 1, i w and 1 / (i w)


class Run(NamedTuple):
    """Spectra of one run: lines (L,), rad/s; base (d, L); outputs (c, L); `density` of `WholeRecords`; its number."""

    w: Array
    base: ComplexArray
    outputs: ComplexArray
    density: float
    number: int


class Shift(NamedTuple):
    """Products of the Jacobian with errors: ``Re J' S^-1 J`` (p, p), ``Re J' S^-1 e`` (p,) and ``e' S^-1 e``."""

    normal: Array
    gradient: Array
    chi2: float


@dataclass(frozen=True, eq=False)
class Parameters:
    """All that is fitted to whole records, beside the levels of the noise.

    Attributes
    ----------
    modes : Modes
    rigid : (d, d)
        Rigid-body mass, kg; zero where no force was measured.
    ends : (m, 2 r)
        alpha, beta of each mode and moving run.
    traces : (runs, c, 3)
    """

    modes: Modes
    rigid: Array
    ends: Array
    traces: Array


class RecordModel:
    """The model of a test of whole records with m modes.

    The unknowns are those of `Index`, then ``ends`` and ``traces``, each in the order of its entries; without a force
    the rigid-body mass is left out.

    With `gains` there are further columns, to be asked of at an end: an error of each sensor's gain, which shows beside
    its modes as ``G u``, and what modes above the lines make of each sensor, as ``w² u``.
    """

    def __init__(self, test: Measurement, m: int, *, gains: bool = False) -> None:
        assert test.whole is not None
        self.test, self.whole, self.m = test, test.whole, m
        self.n, self.d, self.force = test.n_sensors, test.n_base, test.force is not None
        self.channels = self.n + self.d * self.force
        self.index = Index(self.n, m, self.d)
        self.kept = self.index.size if self.force else int(self.index.rigid[0])
        self.moving = {run: at for at, run in enumerate(self.whole.moving)}
        self.n_ends = m * 2 * len(self.moving)
        outputs = test.response if test.force is None else np.concatenate([test.response, test.force], axis=1)
        self.runs = [
            Run(2 * np.pi * test.freq[own], test.base[r][:, own], outputs[r][:, own], float(self.whole.density[r]), r)
            for r, own in enumerate(test.own_lines)
        ]
        self.n_fit = self.kept + self.n_ends + test.n_runs * self.channels * TRACES
        self.gains = gains
        self.size = self.n_fit + gains * self.n * (1 + self.d)
        self.numbers = 2 * sum(run.outputs.size for run in self.runs)

    def thinned(self, step: int) -> RecordModel:
        """The same with every `step`-th line, for steps that need not be exact."""
        other = RecordModel(self.test, self.m)
        other.runs = [
            run._replace(w=run.w[::step], base=run.base[:, ::step], outputs=run.outputs[:, ::step]) for run in self.runs
        ]
        other.numbers = 2 * sum(run.outputs.size for run in other.runs)
        return other

    def pack(self, p: Parameters) -> Array:
        """The unknowns as one column."""
        modes, index = p.modes, self.index
        theta = np.concatenate([modes.phi.ravel(), modes.gamma.ravel(), np.log(modes.omega), np.log(modes.ratios)])
        rigid = np.array([p.rigid[i, j] for i, j in index.pairs]) if self.force else np.zeros(0)
        return np.concatenate([theta, rigid, p.ends.ravel(), p.traces.ravel()])

    def unpack(self, x: Array) -> Parameters:
        """The inverse of `pack`."""
        index = self.index
        theta = np.zeros((index.size, 1))
        theta[: self.kept, 0] = x[: self.kept]
        phi, gamma, log_omega, log_ratios, rigid = (part[..., 0] for part in index.split(theta))
        # No step of use leads beyond these.
        omega, ratios = np.exp(np.clip(log_omega, -_FAR, _FAR)), np.exp(np.clip(log_ratios, -_FAR, _FAR))
        modes = Modes(phi, gamma, omega, ratios)
        ends, traces = np.split(x[self.kept :], [self.n_ends])
        shape = (len(self.whole.samples), self.channels, TRACES)
        return Parameters(modes, rigid, ends.reshape(self.m, -1), traces.reshape(shape))

    def chunks(self, p: Parameters) -> Iterator[Chunk]:
        """Lines of all runs, some thousand at a time."""
        for run in self.runs:
            for at in range(0, run.w.size, _AT_ONCE):
                part = slice(at, at + _AT_ONCE)
                yield Chunk(self, p, run._replace(w=run.w[part], base=run.base[:, part], outputs=run.outputs[:, part]))

    def normal_equations(self, p: Parameters, levels: Array) -> Shift:
        """Products with the base as the records of all channels make it likely, for noise of these levels.

        `levels` are variances of a sample in time, of the outputs and then of the base, (runs, c + d).
        """
        size = self.size
        normal, gradient, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
        for chunk in self.chunks(p):
            made = chunk.products(levels)
            normal += made.normal
            gradient += made.gradient
            chi2 += made.chi2
        return Shift(normal, gradient, chi2)

    def chi2(self, p: Parameters, levels: Array) -> float:
        """Sum of ``e' S^-1 e`` over all lines, half a chi-squared of `numbers` degrees."""
        return float(sum(np.sum(np.abs(chunk.whitened(levels)[0]) ** 2) for chunk in self.chunks(p)))


class Chunk:
    """Some lines of one run at given parameters."""

    def __init__(self, model: RecordModel, p: Parameters, run: Run) -> None:
        self.model, self.p, self.run = model, p, run
        freq = run.w / (2 * np.pi)
        modes = p.modes
        self.g = gains(freq, modes.omega, modes.ratios)
        self.shown = modes.phi if not model.force else np.vstack([modes.phi, modes.gamma.T])  # (c, m)
        direct = model.test.rigid_body if not model.force else np.vstack([model.test.rigid_body, p.rigid])
        # From base to outputs, (c, d, L).
        self.H = np.einsum("ck,kl,kd->cdl", self.shown, self.g, modes.gamma, optimize=True) + direct[:, :, None]
        at = model.moving.get(run.number)
        self.at_ends = None if at is None else slice(2 * at, 2 * at + 2)
        self.transients = model.whole.transients(freq)
        self.pushed_by_ends = 0.0 if at is None else p.ends[:, self.at_ends] @ self.transients  # (m, L)
        unit = freq / model.test.freq[-1]
        self.trace_spectra = np.stack([np.ones_like(run.w) + 0j, 1j * unit, -1j / unit])
        free = self.shown @ (self.g * self.pushed_by_ends) + p.traces[run.number] @ self.trace_spectra
        self.error = run.outputs - np.einsum("cdl,dl->cl", self.H, run.base) - free

    def deviations(self, levels: Array) -> tuple[Array, Array]:
        """Inverse deviations of the outputs' own noise at a line, (c,), and deviations of the base's, (d,)."""
        own, c = levels[self.run.number] * self.run.density, self.model.channels
        return 1 / np.sqrt(own[:c]), np.sqrt(own[c:])

    def whitened(self, levels: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Errors of unit variance (c, L), W (c, d, L) with ``S^-1 = D (I - W W') D``, and the likeliest base (d, L).

        D are the inverse roots of the outputs' own variances. A column of the errors is ``F D e`` with ``F F' = I - W
        W'`` nowhere formed: what is given is ``D e`` and what products with S^-1 need.
        """
        scale, root = self.deviations(levels)
        B = scale[:, None, None] * self.H * root[:, None]  # (c, d, L)
        d = B.shape[1]
        BB = np.einsum("cil,cjl->lij", B.conj(), B) + np.eye(d)
        inverse = np.linalg.inv(BB)
        e = scale[:, None] * self.error
        Be = np.einsum("cil,cl->li", B.conj(), e)
        pulled = np.einsum("lij,lj->li", inverse, Be)
        base = self.run.base + root[:, None] * pulled.T
        L = np.linalg.cholesky(inverse)
        W = np.einsum("cil,lij->cjl", B, L)
        # With W = U s V' (s < 1) the square root of I - W W' acts on W's range alone.
        Wh = np.einsum("cjl,cl->jl", W.conj(), e)
        gram = np.einsum("cil,cjl->lij", W.conj(), W)
        lam, V = np.linalg.eigh(gram)
        lam = np.clip(lam, 1e-300, 1.0)
        shrink = (1 - np.sqrt(np.maximum(1 - lam, 0.0))) / lam
        pulled = np.einsum("lij,lj,lkj,kl->il", V, shrink, V.conj(), Wh, optimize=True)
        return e - np.einsum("cjl,jl->cl", W, pulled), W, base

    def weighed_errors(self, levels: Array) -> tuple[Array, ComplexArray, ComplexArray, ComplexArray]:
        """Lines (L,), rad/s, likeliest inputs (d + 2 r, L), ``S^-1 e`` (c, L) and ``S^-1`` (c, c, L)."""
        _, W, base = self.whitened(levels)
        scale = self.deviations(levels)[0]
        inverse = -np.einsum("cjl,ejl->cel", W, W.conj()) * scale[:, None, None] * scale[:, None]
        c = np.arange(len(scale))
        inverse[c, c] += scale[:, None] ** 2
        ends = np.zeros((2 * len(self.model.moving), base.shape[1]), complex)
        if self.at_ends is not None:
            ends[self.at_ends] = self.transients
        return self.run.w, np.concatenate([base, ends]), np.einsum("cel,el->cl", inverse, self.error), inverse

    def spectra(self, base: ComplexArray) -> ComplexArray:
        """What all columns of the Jacobian are made of, (spectra, L)."""
        modes, g = self.p.modes, self.g
        freq = self.run.w / (2 * np.pi)
        push = modes.gamma @ base + self.pushed_by_ends
        parts = [
            g * push,
            (g[:, None] * base).reshape(-1, base.shape[1]),
            gain_slopes(freq, modes.omega, modes.ratios) * np.tile(push, (2, 1)),
            base,
        ]
        if self.at_ends is not None:
            parts.append((g[:, None] * self.transients).reshape(-1, base.shape[1]))
        parts.append(self.trace_spectra)
        if self.model.gains:
            parts.append((freq / self.model.test.freq[-1]) ** 2 * base)
        return np.concatenate(parts)

    def coefficients(self, channel: int) -> scipy.sparse.csr_array:
        """How the columns of a channel's Jacobian are made of the spectra, (p, spectra)."""
        model = self.model
        n, m, d, index = model.n, model.m, model.d, model.index
        k = np.arange(m)
        shown = self.shown[channel]
        rows, cols, values = [], [], []

        def put(row: NDArray[Any], col: NDArray[Any], value: Array) -> None:
            rows.append(np.ravel(row))
            cols.append(np.ravel(col))
            values.append(np.broadcast_to(value, np.shape(row)).ravel())

        first = np.cumsum([0, m, m * d, 2 * m, d])  # of q, g u, slopes, u; then transients, traces
        if channel < n:
            put(index.phi.start + channel * m + k, k, np.ones(m))
        else:
            put(index.gamma.start + k * d + channel - n, k, np.ones(m))
            for at, (a, b) in enumerate(index.pairs):
                if channel - n in (a, b):
                    put(index.rigid[[at]], np.array([first[3] + (b if channel - n == a else a)]), np.ones(1))
        put(index.gamma.start + np.arange(m * d), first[1] + np.arange(m * d), np.repeat(shown, d))
        put(index.log_omega.start + k, first[2] + k, shown)
        put(index.log_ratios.start + k, first[2] + m + k, shown)
        last = first[4]
        if self.at_ends is not None:
            two = np.arange(2)
            runs = 2 * len(model.moving)
            row = model.kept + k[:, None] * runs + self.at_ends.start + two
            put(row, last + 2 * k[:, None] + two, np.repeat(shown, 2).reshape(m, 2))
            last = last + 2 * m
        own = model.kept + model.n_ends + (self.run.number * model.channels + channel) * TRACES
        put(own + np.arange(TRACES), last + np.arange(TRACES), np.ones(TRACES))
        last = last + TRACES
        if model.gains:
            beside = np.arange(d)
            if channel < n:
                put(np.full(d, model.n_fit + channel), first[3] + beside, model.test.rigid_body[channel])
                put(model.n_fit + n + channel * d + beside, last + beside, np.ones(d))
            last = last + d
        shape = (model.size, int(last))
        data = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
        return scipy.sparse.csr_array(scipy.sparse.coo_array(data, shape=shape))

    def products(self, levels: Array) -> Shift:
        """Products of the Jacobian of these lines."""
        model, c = self.model, self.model.channels
        error, W, base = self.whitened(levels)
        scale = self.deviations(levels)[0]
        spectra = self.spectra(base)
        gram = (spectra @ spectra.conj().T).real
        # S^-1 e, in the same units: D (I - W W') D e.
        plain = scale[:, None] * self.error
        pulled = np.einsum("cjl,cl->jl", W.conj(), plain)
        seen = scale[:, None] * (plain - np.einsum("cjl,jl->cl", W, pulled))
        normal, gradient = np.zeros((model.size, model.size)), np.zeros(model.size)
        through = [np.zeros((model.size, error.shape[1]), complex) for _ in range(W.shape[1])]
        for i in range(c):
            C = self.coefficients(i)
            dense = C.toarray()
            used = np.flatnonzero(np.any(dense != 0, axis=1))
            dense = dense[used]
            normal[np.ix_(used, used)] += scale[i] ** 2 * (dense @ gram @ dense.T)
            gradient[used] += dense @ (spectra.conj() @ seen[i]).real
            for j, rows in enumerate(through):
                rows[used] += C[used] @ (spectra * (W[i, j].conj() * scale[i]))
        for rows in through:
            both = np.hstack([rows.real, rows.imag])
            normal -= both @ both.T
        return Shift(normal, gradient, float(np.sum(np.abs(error) ** 2)))
