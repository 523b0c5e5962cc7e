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
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.modal_analysis.record_colour import pieces
from sysid.modal_analysis.response import gains, motion_and_slopes, real_times
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
    piece: int
    """Row of the levels of noise: runs are cut where levels vary over the lines."""

    def at(self, lines: Any) -> Run:
        """Some of its lines."""
        return self._replace(
            w=self.w[lines], base=self.base[:, lines], outputs=self.outputs[:, lines], weight=self.weight[lines]
        )


class Layer(NamedTuple):
    """One entry of each of some columns of a Jacobian: ``values[:, channel] * spectra[spectrum]``, (k,) and (k, c)."""

    column: NDArray[np.intp]
    spectrum: NDArray[np.intp]
    values: Array


class Columns(NamedTuple):
    """How the columns of a run's Jacobian are made of its spectra, each the sum of its entries in all layers.

    `unknowns` (k,) are those that show in this run. The first layer has an entry of each.
    """

    unknowns: NDArray[np.intp]
    layers: list[Layer]

    def seen(self, weights: ComplexArray, spectra: ComplexArray) -> ComplexArray:
        """Sums of all columns (k, L) over the channels, with weights (c, L)."""
        first, *others = self.layers
        out = real_times(first.values, weights)
        out *= spectra[first.spectrum]
        for column, spectrum, values in others:
            out[column] += real_times(values, weights) * spectra[spectrum]
        return out

    def products(self, sums: Sums, scale: Array) -> Shift:
        """Products of the Jacobian from those of its spectra, for outputs of these inverse deviations, (c,)."""
        normal, gradient = -sums.hidden, np.zeros(self.unknowns.size)
        for column, spectrum, values in self.layers:
            gradient[column] += np.sum(values * sums.cross[spectrum], axis=1)
            if normal.size == 0:
                continue
            for other, beside, theirs in self.layers:
                normal[np.ix_(column, other)] += (scale**2 * values) @ theirs.T * sums.gram[np.ix_(spectrum, beside)]
        return Shift(normal, gradient, sums.chi2)


class Sums(NamedTuple):
    """Products over some lines of a run, of which those of the Jacobian are made.

    Of its spectra (s, s), of these with errors by their covariance (s, c), of what the noise of the base hides of the
    columns (k, k), and ``e' S^-1 e``; the first and the third are empty where only a gradient is asked for.
    """

    gram: Array
    cross: Array
    hidden: Array
    chi2: float

    def plus(self, other: Sums) -> Sums:
        """Those of the lines of both."""
        return Sums(
            self.gram + other.gram, self.cross + other.cross, self.hidden + other.hidden, self.chi2 + other.chi2
        )  # fmt: skip


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


class ModalModel:
    """A test as m modes, without transients or traces: what plain spectra and whole records have in common.

    Attributes
    ----------
    n, d, m, channels : int
        Sensors, base directions, modes; sensors and, where a force was measured, its directions.
    kept : int
        How many of the unknowns of `Index` there are: without a force the rigid-body mass is left out.
    """

    def __init__(self, test: Measurement, m: int, runs: list[Run]) -> None:
        self.test, self.m, self.runs = test, m, runs
        self.n, self.d, self.force = test.n_sensors, test.n_base, test.force is not None
        self.channels = self.n + self.d * self.force
        self.index = Index(self.n, m, self.d)
        self.kept = self.index.size if self.force else int(self.index.rigid[0])
        self.moving: dict[int, int] = {}
        self.n_ends = 0
        self.gains = False

    @property
    def numbers(self) -> int:
        """Real numbers of the records."""
        return 2 * sum(run.outputs.size for run in self.runs)

    def transients(self, freq: Array) -> ComplexArray:
        """What the motion at the ends of a run adds to the load of a mode, (2, L), each times a number of that mode."""
        raise NotImplementedError

    def trace_spectra(self, freq: Array) -> ComplexArray:
        """What the traces of a channel are multiples of, (traces, L)."""
        return np.zeros((0, freq.size), complex)

    def chunks(self, p: Parameters) -> Iterator[Chunk]:
        """Lines of all runs, some thousand at a time."""
        for run in self.runs:
            for at in range(0, run.w.size, _AT_ONCE):
                yield Chunk(self, p, run.at(slice(at, at + _AT_ONCE)))

    def chi2(self, p: Parameters, levels: Array) -> float:
        """Sum of ``e' S^-1 e`` over all lines, half a chi-squared of `numbers` degrees."""
        return float(sum(chunk.run.weight @ chunk.weighed(levels).power for chunk in self.chunks(p)))


class RecordModel(ModalModel):
    """The model of a test of whole records with m modes.

    The unknowns are those of `Index`, then ``ends`` and ``traces``, each in the order of its entries; without a force
    the rigid-body mass is left out.

    With `gains` there are further columns, to be asked of at an end, (n_sensors, d) of each kind: a constant share of
    the base's motion ``u`` in each sensor, which a wrong gain makes as ``G u``, and what modes above the lines make,
    ``w² u``.
    """

    def __init__(self, test: Measurement, m: int, *, gains: bool = False) -> None:
        assert test.whole is not None
        self.whole = test.whole
        outputs = test.response if test.force is None else np.concatenate([test.response, test.force], axis=1)
        runs = [
            Run(
                2 * np.pi * test.freq[own], test.base[r][:, own], outputs[r][:, own], float(self.whole.density[r]), r,
                np.ones(np.count_nonzero(own)), r,
            )
            for r, own in enumerate(test.own_lines)
        ]  # fmt: skip
        if self.whole.varying is not None:
            cut = [run.at(lines) for run in runs for lines in pieces(run.w)]
            runs = [run._replace(piece=piece) for piece, run in enumerate(cut)]
        super().__init__(test, m, runs)
        self.moving = {run: at for at, run in enumerate(self.whole.moving)}
        self.n_ends = m * 2 * len(self.moving)
        self.n_fit = self.kept + self.n_ends + test.n_runs * self.channels * TRACES
        self.gains = gains
        self.size = self.n_fit + gains * 2 * self.n * self.d

    def transients(self, freq: Array) -> ComplexArray:
        """See `ModalModel`."""
        return self.whole.transients(freq)

    def trace_spectra(self, freq: Array) -> ComplexArray:
        """What the traces of a channel are multiples of, (TRACES, L)."""
        unit = freq / self.test.freq[-1]
        return np.stack([np.ones_like(unit) + 0j, 1j * unit, -1j / unit])

    def thinned(self, step: int) -> RecordModel:
        """The same with every `step`-th line, for steps that need not be exact."""
        other = copy(self)
        other.runs = [run.at(slice(None, None, step)) for run in self.runs]
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

    @property
    def unknowns(self) -> int:
        """Numbers that the records determine: without a force the scale of each mode is none."""
        return self.size - (0 if self.force else self.m)

    def normal_equations(self, p: Parameters, levels: Array) -> Shift:
        """Products with the base as the records of all channels make it likely, for noise of these levels.

        `levels` are variances of a sample in time, of the outputs and then of the base, (pieces, c + d).
        """
        return self._products(p, levels, Chunk.sums)

    def gradient(self, p: Parameters, levels: Array) -> Shift:
        """The same without the normal matrix, which stays zero: several times as fast."""
        return self._products(p, levels, Chunk.sums_of_errors)

    def _products(self, p: Parameters, levels: Array, of_chunk: Callable[[Chunk, Array, Columns], Sums]) -> Shift:
        normal, gradient, chi2 = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        found: dict[int, tuple[Columns, Array, Sums]] = {}
        for chunk in self.chunks(p):
            piece = chunk.run.piece
            if piece in found:
                columns, scale, before = found[piece]
                found[piece] = columns, scale, before.plus(of_chunk(chunk, levels, columns))
            else:
                columns = chunk.columns()
                found[piece] = columns, chunk.deviations(levels)[0], of_chunk(chunk, levels, columns)
        for columns, scale, sums in found.values():
            made, at = columns.products(sums, scale), columns.unknowns
            if made.normal.size:
                normal[np.ix_(at, at)] += made.normal
            gradient[at] += made.gradient
            chi2 += made.chi2
        return Shift(normal, gradient, chi2)


class HeldShapes(RecordModel):
    """The same with shapes, participations and rigid-body mass held, and with `poles` these too.

    What is left to be found are poles, transients and traces.
    """

    def __init__(self, test: Measurement, m: int, *, poles: bool = False) -> None:
        super().__init__(test, m)
        self.held = np.ones(self.size, bool)
        self.held[self.index.log_omega] = self.held[self.index.log_ratios] = poles
        self.held[self.kept :] = False

    @property
    def unknowns(self) -> int:
        """Numbers that are not held."""
        return int(np.sum(~self.held))

    def _products(self, p: Parameters, levels: Array, of_chunk: Callable[[Chunk, Array, Columns], Sums]) -> Shift:
        normal, gradient, chi2 = super()._products(p, levels, of_chunk)
        normal[self.held], normal[:, self.held], gradient[self.held] = 0.0, 0.0, 0.0
        return Shift(normal, gradient, chi2)


class Chunk:
    """Some lines of one run at given parameters."""

    def __init__(self, model: ModalModel, p: Parameters, run: Run) -> None:
        self.model, self.p, self.run = model, p, run
        freq = run.w / (2 * np.pi)
        modes = p.modes
        self.g = gains(freq, modes.omega, modes.ratios)
        self.shown = modes.phi if not model.force else np.vstack([modes.phi, modes.gamma.T])  # (c, m)
        self.direct = model.test.rigid_body if not model.force else np.vstack([model.test.rigid_body, p.rigid])
        at = model.moving.get(run.number)
        self.at_ends = None if at is None else slice(2 * at, 2 * at + 2)
        self.transients = np.zeros((0, run.w.size)) if at is None else model.transients(freq)
        self.pushed_by_ends = 0.0 if at is None else real_times(p.ends[:, self.at_ends], self.transients)  # (m, L)
        self.trace_spectra = model.trace_spectra(freq)
        self.motion = self.g * (real_times(modes.gamma, run.base) + self.pushed_by_ends)
        made = real_times(self.shown, self.motion) + real_times(self.direct, run.base)
        if len(self.trace_spectra):
            made += real_times(p.traces[run.number], self.trace_spectra)
        self.error = run.outputs - made

    @cached_property
    def H(self) -> ComplexArray:  # noqa: N802
        """From base to outputs, (c, d, L)."""
        pushed = (self.g[:, None] * self.p.modes.gamma[:, :, None]).reshape(len(self.g), -1)
        return real_times(self.shown, pushed).reshape(len(self.direct), -1, self.run.w.size) + self.direct[:, :, None]

    def deviations(self, levels: Array) -> tuple[Array, Array]:
        """Inverse deviations of the outputs' own noise at a line, (c,), and deviations of the base's, (d,)."""
        own, c = levels[self.run.piece] * self.run.density, self.model.channels
        return 1 / np.sqrt(own[:c]), np.sqrt(own[c:])

    def _base_noise(self, levels: Array) -> tuple[ComplexArray, ComplexArray]:
        """What the noise of the base hides in units of the outputs' own, and its factor.

        With ``B = D H sqrt(v_u)``, D the inverse deviations of the outputs, and ``L L' = I + B' B``: ``B L'^-1``
        (d, c, L) and L (d, d, L), a line of vectors at a time as d is at most a few.
        """
        scale, root = self.deviations(levels)
        B = np.asarray(scale[:, None] * self.H.transpose(1, 0, 2) * root[:, None, None], dtype=complex)
        d = len(B)
        factor = np.zeros((d, d, B.shape[2]), dtype=complex)
        for j in range(d):
            for i in range(j + 1):
                product = np.sum(B[j].conj() * B[i], axis=0) + (i == j)  # of the rows of B' B + I
                for k in range(i):
                    product -= factor[j, k] * factor[i, k].conj()
                # Never less than one on the diagonal, round-off aside.
                factor[j, i] = np.sqrt(np.maximum(product.real, 1.0)) if i == j else product / factor[i, i].real
        for j in range(d):
            for i in range(j):
                B[j] -= B[i] * factor[j, i].conj()
            B[j] /= factor[j, j].real
        return B, factor

    def weighed(self, levels: Array, error: ComplexArray | None = None) -> Weighed:
        """Errors, or other spectra (c, L), weighed by their full covariance."""
        scale, root = self.deviations(levels)
        if not np.any(root):
            e = scale[:, None] * (self.error if error is None else error)
            return Weighed(scale[:, None] * e, _power(e), self.run.base)
        V, factor = self._base_noise(levels)
        e = scale[:, None] * (self.error if error is None else error)
        # What is likeliest of the base's noise, in its own units; what it makes of the errors is taken off them.
        noise = np.array([np.sum(part.conj() * e, axis=0) for part in V])
        for part, own in zip(V, noise, strict=True):
            e -= part * own
        for j in reversed(range(len(V))):
            for i in range(j + 1, len(V)):
                noise[j] -= factor[i, j].conj() * noise[i]
            noise[j] /= factor[j, j].real
        power = _power(e) + _power(noise)
        return Weighed(scale[:, None] * e, power, self.run.base + root[:, None] * noise)

    def covered(self, levels: Array) -> ComplexArray:
        """V (d, c, L) with ``S^-1 = D² - V V'``: what the noise of the base hides."""
        V = self._base_noise(levels)[0]
        V *= self.deviations(levels)[0][:, None]
        return V

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
        parts = [
            motion_and_slopes(freq, modes.omega, modes.ratios, modes.gamma, base, self.pushed_by_ends),
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
        unknowns, starts, count = np.unique(row, return_index=True, return_counts=True)
        layers = []
        for depth in range(count.max()):
            column = np.flatnonzero(count > depth)
            entry = starts[column] + depth
            layers.append(Layer(column, spectrum[entry], every[:, row[entry], spectrum[entry]].T.copy()))
        return Columns(unknowns, layers)

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
                put(model.n_fit + channel * d + beside, first[3] + beside, np.ones(d))
                put(model.n_fit + (n + channel) * d + beside, last + beside, np.ones(d))
        return C

    def sums_of_errors(self, levels: Array, columns: Columns) -> Sums:
        """Products of the spectra of these lines with the errors alone."""
        weighed = self.weighed(levels)
        cross = dots(self.spectra(weighed.base), self.run.weight * weighed.seen)
        return Sums(np.zeros((0, 0)), cross, np.zeros((0, 0)), float(self.run.weight @ weighed.power))

    def sums(self, levels: Array, columns: Columns) -> Sums:
        """All products of these lines; unknowns as in `columns`."""
        weighed, root = self.weighed(levels), np.sqrt(self.run.weight)
        spectra = root * self.spectra(weighed.base)
        hidden = np.zeros((columns.unknowns.size,) * 2)
        for part in self.covered(levels):
            seen = columns.seen(part.conj(), spectra)
            hidden += dots(seen, seen)
        cross = dots(spectra, root * weighed.seen)
        return Sums(dots(spectra, spectra), cross, hidden, float(self.run.weight @ weighed.power))

    def products(self, levels: Array, columns: Columns) -> Shift:
        """Products of the Jacobian of these lines; unknowns as in `columns`."""
        return columns.products(self.sums(levels, columns), self.deviations(levels)[0])


def _power(rows: ComplexArray) -> Array:
    """Sums of squares of the moduli over the rows, (L,)."""
    return np.asarray(np.sum(rows.real**2 + rows.imag**2, axis=0))


def dots(rows: ComplexArray, others: ComplexArray) -> Array:
    """``Re X Y'`` of rows (k, L), (l, L)."""
    one = np.ascontiguousarray(rows).view(float)
    two = one if others is rows else np.ascontiguousarray(others).view(float)
    return np.asarray(one @ two.T)
