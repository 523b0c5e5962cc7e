r"""Whole records as a modal model with transients, and its derivatives: everything the fit of records needs a line.

A run of a test is, at its lines,

.. math:: a = \sum_k \phi_k g_k (\gamma_k u + \alpha_k / w^2 + i \beta_k / w), \quad y = G u + a + p, \quad
          f = M_{rb} u + \sum_k \gamma_k' g_k (\ldots) + p,

with two real numbers alpha, beta a mode and run for its motion at the ends, and p the traces of sampling and
detrending: real multiples of 1, i w and 1 / (i w), a channel and run. Each column of the Jacobian is a few real numbers
times a few spectra, so that normal equations come from products of spectra, and no Jacobian of all lines is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
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
    weight: Array
    """(L,): of how many lines each stands for."""

    def at(self, lines: Any) -> Run:
        """Some of its lines."""
        return self._replace(
            w=self.w[lines], base=self.base[:, lines], outputs=self.outputs[:, lines], weight=self.weight[lines]
        )


class Columns(NamedTuple):
    """How the columns of a run's Jacobian are made of its spectra: ``sum of values[:, channel] * spectra[spectrum]``.

    `unknowns` (k,) are those that show in this run; the entries of each begin at `starts` (k,) and name their spectrum
    (entries,) and what each channel takes of it, (entries, c).
    """

    unknowns: NDArray[np.intp]
    starts: NDArray[np.intp]
    spectrum: NDArray[np.intp]
    values: Array

    def of_channel(self, channel: int, spectra: int) -> Array:
        """The same as a matrix, (k, spectra)."""
        matrix = np.zeros((self.unknowns.size, spectra))
        row = np.repeat(np.arange(self.starts.size), np.diff(self.starts, append=self.spectrum.size))
        matrix[row, self.spectrum] = self.values[:, channel]
        return matrix

    def summed(self, spectra: ComplexArray, weight: ComplexArray) -> ComplexArray:
        """Sums of all columns (k, L) over the channels, with weights (c, L)."""
        return np.add.reduceat((self.values @ weight) * spectra[self.spectrum], self.starts, axis=0)


class Weighed(NamedTuple):
    """Errors by the inverse of their covariance: ``S^-1 e`` (c, L), ``e' S^-1 e`` (L,), the likeliest base (d, L)."""

    seen: ComplexArray
    power: Array
    base: ComplexArray


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
            Run(
                2 * np.pi * test.freq[own], test.base[r][:, own], outputs[r][:, own], float(self.whole.density[r]), r,
                np.ones(np.count_nonzero(own)),
            )
            for r, own in enumerate(test.own_lines)
        ]  # fmt: skip
        self.n_fit = self.kept + self.n_ends + test.n_runs * self.channels * TRACES
        self.gains = gains
        self.size = self.n_fit + gains * self.n * (1 + self.d)
        self.numbers = 2 * sum(run.outputs.size for run in self.runs)

    def thinned(self, step: int) -> RecordModel:
        """The same with every `step`-th line, for steps that need not be exact."""
        other = copy(self)
        other.runs = [run.at(slice(None, None, step)) for run in self.runs]
        other.numbers = 2 * sum(run.outputs.size for run in other.runs)
        return other

    def weighed_as_all(self) -> RecordModel:
        """The same, each line of a coarse test standing for those around it that were left out."""
        other = copy(self)
        other.runs = [
            run._replace(weight=np.gradient(run.w) / (2 * np.pi * self.whole.spacing[run.number])) for run in self.runs
        ]
        return other

    def weighed_by(self, weights: Sequence[Array]) -> RecordModel:
        """The same, each line of each run standing for so many."""
        other = copy(self)
        other.runs = [run._replace(weight=weight) for run, weight in zip(self.runs, weights, strict=True)]
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
                yield Chunk(self, p, run.at(slice(at, at + _AT_ONCE)))

    def normal_equations(self, p: Parameters, levels: Array) -> Shift:
        """Products with the base as the records of all channels make it likely, for noise of these levels.

        `levels` are variances of a sample in time, of the outputs and then of the base, (runs, c + d).
        """
        return self._products(p, lambda chunk, columns: chunk.products(levels, columns))

    def gradient(self, p: Parameters, levels: Array) -> Shift:
        """The same without the normal matrix, which stays zero: several times as fast."""
        return self._products(p, lambda chunk, columns: chunk.gradient(levels, columns))

    def _products(self, p: Parameters, of_chunk: Callable[[Chunk, Columns], Shift]) -> Shift:
        normal, gradient, chi2 = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        columns: dict[int, Columns] = {}
        for chunk in self.chunks(p):
            number = chunk.run.number
            if number not in columns:
                columns[number] = chunk.columns()
            made, at = of_chunk(chunk, columns[number]), columns[number].unknowns
            if made.normal.size:
                normal[np.ix_(at, at)] += made.normal
            gradient[at] += made.gradient
            chi2 += made.chi2
        return Shift(normal, gradient, chi2)

    def chi2(self, p: Parameters, levels: Array) -> float:
        """Sum of ``e' S^-1 e`` over all lines, half a chi-squared of `numbers` degrees."""
        return float(sum(chunk.run.weight @ chunk.weighed(levels).power for chunk in self.chunks(p)))


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

    def _base_noise(self, levels: Array) -> tuple[ComplexArray, ComplexArray]:
        """``B = D T sqrt(v_u)`` (L, c, d), D the inverse deviations of the outputs, and ``(I + B' B)^-1`` (L, d, d)."""
        scale, root = self.deviations(levels)
        B = np.moveaxis(scale[:, None, None] * self.H * root[:, None], -1, 0)
        return B, np.linalg.inv(B.conj().transpose(0, 2, 1) @ B + np.eye(B.shape[2]))

    def weighed(self, levels: Array, error: ComplexArray | None = None) -> Weighed:
        """Errors, or other spectra (c, L), weighed by their full covariance."""
        scale, root = self.deviations(levels)
        B, inverse = self._base_noise(levels)
        e = (scale[:, None] * (self.error if error is None else error)).T[..., None]
        # What is likeliest of the base's noise, in its own units; what it makes of the errors is taken off them.
        noise = inverse @ (B.conj().transpose(0, 2, 1) @ e)
        left = (e - B @ noise)[..., 0].T
        noise = noise[..., 0].T
        power = np.sum(np.abs(left) ** 2, axis=0) + np.sum(np.abs(noise) ** 2, axis=0)
        return Weighed(scale[:, None] * left, power, self.run.base + root[:, None] * noise)

    def covered(self, levels: Array) -> ComplexArray:
        """V (d, c, L) with ``S^-1 = D² - V V'``: what the noise of the base hides."""
        B, inverse = self._base_noise(levels)
        V = self.deviations(levels)[0][:, None] * np.matmul(B, np.linalg.cholesky(inverse), dtype=complex)
        return V.transpose(2, 1, 0)

    def weighed_errors(self, levels: Array) -> tuple[Array, ComplexArray, ComplexArray, ComplexArray]:
        """Lines (L,), rad/s, likeliest inputs (d + 2 r, L), ``S^-1 e`` (c, L) and ``S^-1`` (c, c, L)."""
        weighed, V = self.weighed(levels), self.covered(levels)
        inverse = -np.einsum("jcl,jel->cel", V, V.conj())
        c = np.arange(self.model.channels)
        inverse[c, c] += self.deviations(levels)[0][:, None] ** 2
        base = weighed.base
        ends = np.zeros((2 * len(self.model.moving), base.shape[1]), complex)
        if self.at_ends is not None:
            ends[self.at_ends] = self.transients
        return self.run.w, np.concatenate([base, ends]), weighed.seen, inverse

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

    def columns(self) -> Columns:
        """How the columns of all channels are made of the spectra."""
        every = np.array([self.coefficients(channel) for channel in range(self.model.channels)])
        row, spectrum = np.nonzero(np.any(every != 0, axis=0))
        unknowns, starts = np.unique(row, return_index=True)
        return Columns(unknowns, starts, spectrum, every[:, row, spectrum].T.copy())

    def coefficients(self, channel: int) -> Array:
        """How the columns of a channel's Jacobian are made of the spectra, (p, spectra)."""
        model = self.model
        n, m, d, index = model.n, model.m, model.d, model.index
        k = np.arange(m)
        shown = self.shown[channel]
        spectra = m + m * d + 2 * m + d + 2 * m * (self.at_ends is not None) + TRACES + d * model.gains
        C = np.zeros((model.size, spectra))

        def put(row: NDArray[Any], col: NDArray[Any], value: Array) -> None:
            C[row, col] += value

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
        return C

    def gradient(self, levels: Array, columns: Columns) -> Shift:
        """Products of the Jacobian of these lines with the errors; unknowns as in `columns`."""
        weighed = self.weighed(levels)
        return Shift(np.zeros((0, 0)), self._gradient(weighed, columns), float(self.run.weight @ weighed.power))

    def _gradient(self, weighed: Weighed, columns: Columns) -> Array:
        spectra = self.spectra(weighed.base)
        cross = (spectra.conj() @ (self.run.weight * weighed.seen).T).real  # (spectra, c)
        return np.add.reduceat(np.sum(columns.values * cross[columns.spectrum], axis=1), columns.starts)

    def products(self, levels: Array, columns: Columns) -> Shift:
        """Products of the Jacobian of these lines; unknowns as in `columns`."""
        weighed = self.weighed(levels)
        spectra = np.sqrt(self.run.weight) * self.spectra(weighed.base)
        gram = _squares(spectra)
        normal = np.zeros((columns.unknowns.size,) * 2)
        for i, scale in enumerate(self.deviations(levels)[0]):
            C = columns.of_channel(i, len(spectra))
            normal += scale**2 * (C @ gram @ C.T)
        for part in self.covered(levels):
            normal -= _squares(columns.summed(spectra, part.conj()))
        return Shift(normal, self._gradient(weighed, columns), float(self.run.weight @ weighed.power))


def _squares(rows: ComplexArray) -> Array:
    """``Re X X'`` of rows (k, L)."""
    flat = np.ascontiguousarray(rows).view(float)
    return flat @ flat.T
