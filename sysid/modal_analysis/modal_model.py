r"""The modal model of the spectra of a test, some lines at a time: predictions, errors and how these are weighed.

A run of a test is, at its lines,

.. math:: a = \sum_k \phi_k g_k (\gamma_k u + \alpha_k / w^2 + i \beta_k / w), \quad y = G u + a + p, \quad
          f = M_{rb} u + \sum_k \gamma_k' g_k (\ldots) + p,

with two real numbers alpha, beta a mode and run for its motion at the ends, and p the traces of sampling and
detrending: real multiples of 1, i w and 1 / (i w), a channel and run. Plain spectra have neither. Where dampers couple
the modes, :math:`w^2 (W^2 - w^2 + i w \Phi' C \Phi)^{-1}` stands in the place of the gains g.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.modal_analysis.response import coupled_flexibility, gains, modes_above, motion_and_slopes, real_times
from sysid.structure.amplitude import LawForm
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EPSILON

FAR = 30.0  # logarithms of frequencies and damping ratios: no step of use leads beyond


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
    signal: Array | None = None
    """(c + d, L): squares of what outputs and base hold at each line, where noise is a share of it; held in a fit."""
    profile: Array | float = 1.0
    """(L,): what is no share of it, over its level: see `SteadyLines`."""

    def at(self, lines: Any) -> Run:
        """Some of its lines."""
        return self._replace(
            w=self.w[lines], base=self.base[:, lines], outputs=self.outputs[:, lines], weight=self.weight[lines],
            signal=None if self.signal is None else self.signal[:, lines],
            profile=self.profile if isinstance(self.profile, float) else self.profile[lines],
        )  # fmt: skip

    def among(self, freq: Array) -> NDArray[np.intp]:
        """Which of all lines of a test, Hz, its own are, (L,)."""
        return np.searchsorted(freq, self.w / (2 * np.pi) * (1 - EPSILON))

    def variances(self, levels: Array) -> Array:
        """Variances of the noise of outputs and base at its lines, (c + d, L), or (c + d, 1) where all are alike.

        `levels` (pieces, c + d) are variances of a sample, (pieces, 2 (c + d)) where squared shares of the signal stand
        behind them.
        """
        of_piece = levels[self.piece][:, None]
        if self.signal is None:
            return np.asarray(of_piece * self.density)
        plain, shares = np.split(of_piece, 2)
        return np.asarray(plain * self.density * self.profile + shares * self.signal)


class Weighed(NamedTuple):
    """Errors by the inverse of their covariance: ``S^-1 e`` (c, L), ``e' S^-1 e`` (L,), the likeliest base (d, L)."""

    whitened_residual: ComplexArray
    power: Array
    base: ComplexArray


class NormalEquations(NamedTuple):
    """Products of the Jacobian with errors: ``Re J' S^-1 J`` (p, p), ``Re J' S^-1 e`` (p,) and ``e' S^-1 e``."""

    normal: Array
    gradient: Array
    chi2: float

    def at(self, unknowns: Any) -> NormalEquations:
        """Those of some of the unknowns, the others held."""
        return self._replace(normal=self.normal[unknowns][:, unknowns], gradient=self.gradient[unknowns])

    def holding(self, unknowns: NDArray[np.bool_]) -> NormalEquations:
        """The same where some unknowns, (p,), are held: they show nowhere."""
        free = ~unknowns
        return self._replace(normal=self.normal * np.outer(free, free), gradient=self.gradient * free)


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of a run's Jacobian by its spectra: sums of entries ``value * spectra[spectrum]`` of channels, (e,) each.

    `unknowns` (k,) are those that show in this run; `column` is which of these an entry is of. Each has one at least.
    Without entries columns are summed channel by channel: what comes of their sums are products already.
    """

    unknowns: NDArray[np.intp]
    channel: NDArray[np.intp]
    column: NDArray[np.intp]
    spectrum: NDArray[np.intp]
    value: Array

    @cached_property
    def layers(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """The same, all channels together (k, c), at most one of each column and, in the first, one of every column."""
        width = int(self.spectrum.max()) + 1
        places, at = np.unique(self.column * width + self.spectrum, return_inverse=True)
        every = np.zeros((places.size, int(self.channel.max()) + 1))
        every[at, self.channel] = self.value
        starts, count = np.unique(places // width, return_index=True, return_counts=True)[1:]
        layers = []
        for depth in range(count.max()):
            column = np.flatnonzero(count > depth)
            entry = starts[column] + depth
            layers.append((column, places[entry] % width, every[entry]))
        return layers

    def seen(self, weights: ComplexArray, spectra: ComplexArray) -> ComplexArray:
        """Sums of all columns (k, L) over the channels, with weights (c, L)."""
        (_, first, every), *others = self.layers
        out = real_times(every, weights)
        out *= spectra[first]
        for column, spectrum, values in others:
            out[column] += real_times(values, weights) * spectra[spectrum]
        return out

    def products(self, sums: Sums, scale: Array) -> NormalEquations:
        """Products of the Jacobian from those of its spectra, for outputs of these inverse deviations, (c,)."""
        if not self.value.size:
            return NormalEquations(sums.gram, sums.cross, sums.chi2)
        normal, gradient = -sums.hidden, np.zeros(self.unknowns.size)
        np.add.at(gradient, self.column, self.value * sums.cross[self.spectrum, self.channel])
        for channel, size in enumerate(scale if normal.size else ()):
            mine = self.channel == channel
            at, row = np.unique(self.column[mine], return_inverse=True)
            A = np.zeros((at.size, len(sums.gram)))
            A[row, self.spectrum[mine]] = size * self.value[mine]
            normal[np.ix_(at, at)] += A @ sums.gram @ A.T
        return NormalEquations(normal, gradient, sums.chi2)


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


class Moves(NamedTuple):
    """Columns (k,) that all channels feel: their unknowns, the modes that are loaded, and the loads (k, L)."""

    unknowns: NDArray[np.intp]
    modes: NDArray[np.intp]
    loads: ComplexArray


class ModeLaw(NamedTuple):
    """A mode that follows the amplitude of one at a sensor, by number, the form of its law and the law's numbers.

    The amplitude is its own, or that of the mode `level_of`.
    `equivalent`, (runs, 2), is by what frequency and damping ratio are multiplied for the linear mode that noise of the
    base moves in each run. `likelier` tells that the laws of a fit are likelier than none beyond chance.
    """

    mode: int
    sensor: int
    form: LawForm
    values: Array
    equivalent: Array
    likelier: bool = False
    level_of: int | None = None

    @property
    def followed(self) -> int:
        """Number of the mode whose level counts."""
        return self.mode if self.level_of is None else self.level_of

    def moving(self, laws: Sequence[ModeLaw]) -> ModeLaw:
        """How that mode moves: its law among these, or one that changes nothing."""
        linear = self._replace(mode=self.followed, values=0 * self.values, level_of=None)
        return next((law for law in laws if law.mode == self.followed), linear)


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
    coupling : (m, m) or None
        rad/s, off the diagonal of ``Phi' C Phi``, of modes that dampers couple; None where damping is classical.
    gains : (k,)
        Errors of gains within their tolerances, in units of these; empty where none are stated.
    laws : tuple of ModeLaw
        Of modes that follow their amplitude.
    """

    modes: Modes
    rigid: Array
    ends: Array
    traces: Array
    coupling: Array | None = None
    gains: Array = field(default_factory=lambda: np.zeros(0))
    laws: tuple[ModeLaw, ...] = ()

    def at(self, kept: NDArray[Any]) -> Parameters:
        """Those of some of the modes, by flags (m,) or numbers."""
        coupling = None if self.coupling is None else self.coupling[np.ix_(kept, kept)]
        number: dict[int | None, int] = {was: at for at, was in enumerate(np.arange(len(self.ends))[kept].tolist())}
        whole = [law for law in self.laws if {law.mode, law.followed} <= number.keys()]
        laws = tuple(law._replace(mode=number[law.mode], level_of=number.get(law.level_of)) for law in whole)
        return replace(self, modes=self.modes.at(kept), ends=self.ends[kept], coupling=coupling, laws=laws)

    def with_modes(self, modes: Modes, ends: Array) -> Parameters:
        """The same with further modes behind its own, which no damper couples to these; `modes` and `ends` are all."""
        more = modes.omega.size - self.modes.omega.size
        coupling = None if self.coupling is None else np.pad(self.coupling, (0, more))
        return replace(self, modes=modes, ends=ends, coupling=coupling)


class SpectralModel:
    """A test as m modes, without transients or traces: what plain spectra and whole records have in common.

    Attributes
    ----------
    n, d, m, channels : int
        Sensors, base directions, modes; sensors and, where a force was measured, its directions.
    kept : int
        How many of the unknowns of `Index` there are: without a force the rigid-body mass is left out.
    laws : tuple of ModeLaw
        Of modes that follow their amplitude.
    """

    laws: tuple[ModeLaw, ...] = ()

    def __init__(self, test: Measurement, m: int, runs: list[Run]) -> None:
        self.test, self.m, self.runs = test, m, runs
        self.n, self.d, self.force = test.n_sensors, test.n_base, test.force is not None
        self.channels = self.n + self.d * self.force
        self.index = Index(self.n, m, self.d)
        self.kept = self.index.size if self.force else int(self.index.rigid[0])
        self.moving: dict[int, int] = {}
        self.n_ends = 0
        self.gains = False
        self.by_gains: Array = np.zeros((self.channels, self.d, 0))

    @property
    def numbers(self) -> int:
        """Real numbers of the records."""
        return 2 * sum(run.outputs.size for run in self.runs)

    def transients(self, freq: Array) -> ComplexArray:
        """Loads of a mode by the motion at the ends of a run, (2, L), each times a number of that mode."""
        raise NotImplementedError

    def trace_spectra(self, freq: Array) -> ComplexArray:
        """Spectra of which the traces of a channel are multiples, (traces, L)."""
        return np.zeros((0, freq.size), complex)

    def parts(self, at_once: int = 4096) -> Iterator[Run]:
        """Lines of all runs, as many at once as memory holds derivatives of."""
        for run in self.runs:
            for at in range(0, run.w.size, at_once):
                yield run.at(slice(at, at + at_once))

    def chunks(self, p: Parameters) -> Iterator[Lines]:
        """The same at given parameters."""
        return (Lines(self, p, run) for run in self.parts())

    def chi2(self, p: Parameters, levels: Array) -> float:
        """Sum of ``e' S^-1 e`` over all lines, half a chi-squared of `numbers` degrees, and of gains by tolerances."""
        of_gains = float(p.gains @ p.gains) / 2
        return of_gains + float(sum(chunk.run.weight @ chunk.weighed(levels).power for chunk in self.chunks(p)))

    def trial_chi2(self, p: Parameters, levels: Array) -> float:
        """The same of a step's end; infinite where it went beyond all measure."""
        if not np.all(np.isfinite(p.modes.omega)) or np.any(p.modes.ratios >= 1.0):
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            value = self.chi2(p, levels)
        return value if np.isfinite(value) else np.inf


class Lines:
    """Some lines of one run at given parameters."""

    def __init__(self, model: SpectralModel, p: Parameters, run: Run) -> None:
        self.model, self.p, self.run = model, p, run
        freq = run.w / (2 * np.pi)
        modes = self.modes = self.linear_modes(p, run)
        self.g = gains(freq, modes.omega, modes.ratios)
        self.shapes = modes.phi if not model.force else np.vstack([modes.phi, modes.gamma.T])  # (c, m)
        self.direct = model.test.rigid_body if not model.force else np.vstack([model.test.rigid_body, p.rigid])
        self.reads = np.ones(self.direct.shape)  # what gains make of the channels' parts, (c, d)
        if p.gains.size:
            self.reads = 1 + model.by_gains @ p.gains
            self.direct = self.reads * self.direct
            self.shapes = np.vstack([modes.phi, self.reads[model.n :, :1] * self.shapes[model.n :]])
        at = model.moving.get(run.number)
        self.at_ends = None if at is None else slice(2 * at, 2 * at + 2)
        self.transients = np.zeros((0, run.w.size), complex) if at is None else model.transients(freq)
        self.pushed_by_ends = 0.0 if at is None else real_times(p.ends[:, self.at_ends], self.transients)  # (m, L)
        self.trace_spectra = model.trace_spectra(freq)
        self.motion = self.motion_of(run.base)
        self.error = run.outputs - self.predicted(run.base, self.motion)

    def linear_modes(self, p: Parameters, run: Run) -> Modes:
        """The modes by which noise of the base moves the structure."""
        return p.modes

    def motion_of(self, base: ComplexArray) -> ComplexArray:
        """Motions of the modes that this of the base makes, (m, L)."""
        return self.answer(real_times(self.p.modes.gamma, base) + self.pushed_by_ends)

    def predicted(self, base: ComplexArray, motion: ComplexArray) -> ComplexArray:
        """Outputs of these motions of base and modes, with their traces, (c, L)."""
        predicted = real_times(self.shapes, motion) + real_times(self.direct, base)
        if len(self.trace_spectra):
            predicted += real_times(self.p.traces[self.run.number], self.trace_spectra)
        return predicted

    def beside_the_fit(self, base: ComplexArray) -> ComplexArray:
        """Spectra of what is only asked for: motion by modes above the lines, and what a delay makes of each output."""
        freq = self.run.w / (2 * np.pi)
        above = modes_above(freq, self.model.test.freq[-1])[:, None] * base
        return np.concatenate([
            *above, -1j * self.run.w * self.predicted(base, self.motion_of(base)),
        ])  # fmt: skip

    @cached_property
    def flexibility(self) -> ComplexArray:
        """See `coupled_flexibility`, (m, m, L)."""
        modes, m = self.p.modes, self.p.modes.omega.size
        coupling = np.zeros((m, m)) if self.p.coupling is None else self.p.coupling
        return coupled_flexibility(self.run.w / (2 * np.pi), modes.omega, modes.ratios, coupling)

    def answer(self, loads: ComplexArray) -> ComplexArray:
        """Motions of the modes under loads (m, L)."""
        if self.p.coupling is None:
            return self.g * loads
        return self.run.w**2 * np.einsum("jkl,kl->jl", self.flexibility, loads)

    @cached_property
    def H(self) -> ComplexArray:  # noqa: N802
        """From base to outputs, (c, d, L)."""
        gamma = self.p.modes.gamma
        if self.p.coupling is None:
            pushed = (self.g[:, None] * gamma[:, :, None]).reshape(len(self.g), -1)
        else:
            pushed = (self.run.w**2 * np.einsum("jkl,kd->jdl", self.flexibility, gamma)).reshape(len(self.g), -1)
        return real_times(self.shapes, pushed).reshape(len(self.direct), -1, self.run.w.size) + self.direct[:, :, None]

    def deviations(self, levels: Array) -> tuple[Array, Array]:
        """Inverse deviations of the outputs' own noise, (c, L or 1), and deviations of the base's, (d, L or 1)."""
        variances, c = self.run.variances(levels), self.model.channels
        return 1 / np.sqrt(variances[:c]), np.sqrt(variances[c:])

    def weighed(self, levels: Array, error: ComplexArray | None = None) -> Weighed:
        """Errors, or other spectra (c, L), weighed by their full covariance."""
        scale, root = self.deviations(levels)
        if not np.any(root):
            e = scale * (self.error if error is None else error)
            return Weighed(scale * e, _power(e), self.run.base)
        V, factor = base_noise(self.H, scale, root)
        e = scale * (self.error if error is None else error)
        # What is likeliest of the base's noise, in its own units; what it makes of the errors is taken off them.
        noise = np.array([np.sum(part.conj() * e, axis=0) for part in V])
        for part, v in zip(V, noise, strict=True):
            e -= part * v
        for j in reversed(range(len(V))):
            for i in range(j + 1, len(V)):
                noise[j] -= factor[i, j].conj() * noise[i]
            noise[j] /= factor[j, j].real
        power = _power(e) + _power(noise)
        return Weighed(scale * e, power, self.run.base + root * noise)

    def covered(self, levels: Array) -> ComplexArray:
        """V (d, c, L) with ``S^-1 = D² - V V'``: what the noise of the base hides."""
        scale, root = self.deviations(levels)
        return scale * base_noise(self.H, scale, root)[0]

    def inputs(self, base: ComplexArray) -> ComplexArray:
        """Likeliest motion of the base and loads by the motion at the ends of all runs, (d + 2 r, L)."""
        ends = np.zeros((2 * len(self.model.moving), base.shape[1]), complex)
        if self.at_ends is not None:
            ends[self.at_ends] = self.transients
        return np.concatenate([base, ends])

    def spectra(self, base: ComplexArray) -> ComplexArray:
        """Spectra of which all columns of the Jacobian are made, (spectra, L)."""
        modes, g = self.modes, self.g
        freq = self.run.w / (2 * np.pi)
        parts = [
            motion_and_slopes(freq, modes.omega, modes.ratios, modes.gamma, base, self.pushed_by_ends),
            base,
        ]
        if self.at_ends is not None:
            parts.append((g[:, None] * self.transients).reshape(-1, base.shape[1]))
        parts.append(self.trace_spectra)
        if self.model.gains:
            parts.append(self.beside_the_fit(base))
        return np.concatenate(parts)


def base_noise(H: ComplexArray, scale: Array, root: Array) -> tuple[ComplexArray, ComplexArray]:
    """Noise of the base in units of the outputs' own, and its factor.

    With ``B = D H sqrt(v_u)``, D the inverse deviations `scale` of the outputs (c, L or 1) and `root` the deviations of
    the base (d, L or 1), and ``L L' = I + B' B``: ``B L'^-1`` (d, c, L) and L (d, d, L), all lines at once, as d is
    at most a few. Then ``S^-1 = D (I - V V') D``.
    """
    B = np.asarray(scale * H.transpose(1, 0, 2) * root[:, None], dtype=complex)
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


def _power(rows: ComplexArray) -> Array:
    """Sums of squares of the moduli over the rows, (L,)."""
    return np.asarray(np.sum(rows.real**2 + rows.imag**2, axis=0))


def dots(rows: ComplexArray, others: ComplexArray) -> Array:
    """``Re X Y'`` of rows (k, L), (l, L)."""
    one = np.ascontiguousarray(rows).view(float)
    two = one if others is rows else np.ascontiguousarray(others).view(float)
    return np.asarray(one @ two.T)


def trace_count(test: Measurement) -> int:
    """Real numbers of each channel and run beside the response and its transients."""
    assert test.whole is not None
    return test.whole.of_sampling + test.whole.pulses(test.freq[-1])[0].size


def pairs_of(m: int, *, both: bool) -> NDArray[np.intp]:
    """Pairs of different modes, (k, 2), each once or, with `both`, in both orders."""
    apart = np.argwhere(~np.eye(m, dtype=bool))
    return apart if both else apart[apart[:, 0] < apart[:, 1]]


def segments(w: Array, most: int = 20, lines: int = 4) -> list[slice]:
    """Stretches of the lines of a run, (L,), rad/s, `most` at most and of so many lines at least: of one level each."""
    root = np.sqrt(w)
    bounds = np.unique(np.searchsorted(root, np.linspace(root[0], root[-1], most + 1)[1:-1]))
    cuts = [0]
    for bound in bounds:
        if bound - cuts[-1] >= lines and w.size - bound >= lines:
            cuts.append(int(bound))
    return [slice(a, b) for a, b in zip(cuts, [*cuts[1:], w.size], strict=True)]
