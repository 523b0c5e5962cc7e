"""Whole records as a modal model with transients, and its derivatives: everything the fit of records needs a line.

Each column of the Jacobian is a few real numbers times a few spectra, so that normal equations come from products of
spectra, and no Jacobian of all lines is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.channels import read_by_gains
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.law_spectra import LawMotions, add_laws, law_entries, linear_modes
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import (
    FAR,
    Columns,
    Lines,
    ModeLaw,
    Moves,
    NormalEquations,
    Parameters,
    Run,
    SpectralModel,
    Sums,
    dots,
    pairs_of,
    segments,
    trace_count,
)
from sysid.modal_analysis.response import real_times
from sysid.structure.structure import Array, ComplexArray


class RecordModel(SpectralModel):
    """The model of a test of whole records with m modes.

    The unknowns are those of `Index`, without a force but for its mass, then ``ends`` and ``traces``, in their order.

    With `gains` there are further columns, to be asked of at an end, (n_sensors, d) of each kind: a constant share of
    the base's motion ``u`` in each sensor, which a wrong gain makes as ``G u``, and what `modes_above` the lines make;
    then a delay of each sensor and of the force.

    The last `static` modes share a pole that is held, and do not move at the ends of runs. Where the others are
    `coupled` by dampers, entries of ``Phi' C Phi`` off the diagonal are the last unknowns before those of gains: each
    once, or, without a force, where modes have no scale of their own, on both sides of the diagonal. Where gains have
    tolerances, errors in units of these stand there too, with a chi-squared of their own: see `read_by_gains`.

    Attributes
    ----------
    held : (size,) of bool
        Unknowns that stay as they are.
    coupled : (k, 2) of int
        The modes that each coupling acts between.
    """

    def __init__(
        self, test: Measurement, m: int, *, gains: bool = False, static: int = 0, coupled: bool = False,
        laws: tuple[ModeLaw, ...] = (),
    ) -> None:  # fmt: skip
        assert test.whole is not None
        self.whole, self.laws = test.whole, laws
        self.law_motions = LawMotions(test) if laws else None
        outputs = test.response if test.force is None else np.concatenate([test.response, test.force], axis=1)
        runs = [
            Run(
                2 * np.pi * test.freq[mask], test.base[r][:, mask], outputs[r][:, mask], float(self.whole.density[r]),
                r, np.ones(np.count_nonzero(mask)), r, profile=self.whole.profile_at(mask),
            )
            for r, mask in enumerate(test.own_lines)
        ]  # fmt: skip
        if self.whole.varying is not None:
            cut = (run.at(lines) for run in runs for lines in segments(run.w))
            runs = [run._replace(piece=piece) for piece, run in enumerate(cut)]
        super().__init__(test, m, runs)
        self.moving = {run: at for at, run in enumerate(self.whole.moving)}
        self.by_gains = read_by_gains(test)
        reached = self.whole.pulses(test.freq[-1])[1]
        self._place(static, trace_count(test), gains=gains, coupled=coupled)
        if reached.size:  # a run that begins and ends at rest has none
            of_channels = np.append(reached, np.repeat(reached[self.n :], self.d - 1, axis=0), axis=0)
            own = of_channels & np.isin(np.arange(test.n_runs), self.whole.moving)[:, None, None]
            traces = np.concatenate([np.ones((*own.shape[:2], self.whole.of_sampling), bool), own], axis=2)
            self.held[self.kept + self.n_ends : self.coupling.start] = ~traces.ravel()

    def _place(self, static: int, traces: int, *, gains: bool, coupled: bool, across: bool = True) -> None:
        """Set where the unknowns stand: `traces` a channel and run; couplings with static modes, alike, if `across`."""
        test, m = self.test, self.m
        self.traces, self.n_ends = traces, m * 2 * len(self.moving)
        before = self.kept + self.n_ends + test.n_runs * self.channels * traces
        self.coupled = pairs_of(m, both=not self.force) if coupled else np.zeros((0, 2), dtype=int)
        self.coupled = self.coupled[np.sort(self.coupled, axis=1)[:, 0 if across else 1] < m - static]
        self.coupling = slice(before, before + len(self.coupled))
        self.of_laws = slice(self.coupling.stop, self.coupling.stop + sum(law.form.size for law in self.laws))
        self.of_gains = slice(self.of_laws.stop, self.of_laws.stop + self.by_gains.shape[2])
        self.n_fit = self.of_gains.stop
        self.gains = gains
        self.delays = self.n_fit + 3 * self.n * self.d  # where they begin
        self.size = self.delays + self.n + self.force if gains else self.n_fit
        self.static, self.held = static, np.zeros(self.size, bool)
        if static:
            ends = self.held[self.kept : self.kept + self.n_ends].reshape(m, -1)
            poles = self.held[self.index.log_omega], self.held[self.index.log_ratios]
            for part in (ends, *poles):
                part[m - static :] = True

    def transients(self, freq: Array) -> ComplexArray:
        """See `SpectralModel`."""
        return self.whole.transients(freq)

    def trace_spectra(self, freq: Array) -> ComplexArray:
        """See `SpectralModel`."""
        return self.whole.traces(freq, self.test.freq[-1])

    def at_signal(self, p: Parameters) -> RecordModel:
        """The same, shares of the signal in the noise being those of what these parameters predict."""
        if not self.whole.grows:
            return self
        other, each = copy(self), [Lines(self, p, run) for run in self.runs]
        other.runs = [
            run._replace(signal=np.abs(np.vstack([run.outputs - lines.error, run.base])) ** 2)
            for run, lines in zip(self.runs, each, strict=True)
        ]
        return other

    def thinned(self, step: int) -> RecordModel:
        """The same with every `step`-th line, for steps that need not be exact."""
        other = copy(self)
        other.runs = [run.at(slice(None, None, step)) for run in self.runs]
        return other

    def weighed_as_all(self) -> RecordModel:
        """The same, each line of a coarse test standing for those around it that were left out."""
        spacing = 2 * np.pi * self.whole.spacing
        return self.weighed_by([np.gradient(run.w) / spacing[run.number] for run in self.runs])

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
        coupling = np.zeros(len(self.coupled)) if p.coupling is None else p.coupling[*self.coupled.T]
        of_gains = p.gains if p.gains.size else np.zeros(self.by_gains.shape[2])
        laws = [law.values for law in p.laws]
        return np.concatenate([theta, rigid, p.ends.ravel(), p.traces.ravel(), coupling, *laws, of_gains])

    def unpack(self, x: Array) -> Parameters:
        """The inverse of `pack`."""
        index = self.index
        theta = np.zeros((index.size, 1))
        theta[: self.kept, 0] = x[: self.kept]
        phi, gamma, log_omega, log_ratios, rigid = (part[..., 0] for part in index.split(theta))
        # No step of use leads beyond these.
        omega, ratios = np.exp(np.clip(log_omega, -FAR, FAR)), np.exp(np.clip(log_ratios, -FAR, FAR))
        modes = Modes(phi, gamma, omega, ratios)
        ends, traces = np.split(x[self.kept : self.coupling.start], [self.n_ends])
        shape = (self.test.n_runs, self.channels, self.traces)
        coupling = None
        if len(self.coupled):
            coupling = np.zeros((self.m, self.m))
            coupling[*self.coupled.T] = x[self.coupling]
            coupling = coupling + coupling.T if self.force else coupling
        numbers = np.split(x[self.of_laws], np.cumsum([law.form.size for law in self.laws])[:-1])
        laws = tuple(law._replace(values=values) for law, values in zip(self.laws, numbers, strict=False))
        ends, traces = ends.reshape(self.m, -1), traces.reshape(shape)
        return Parameters(modes, rigid, ends, traces, coupling, x[self.of_gains], laws)

    def moved(self, x: Array, step: Array, most: float = 1.0) -> Array:
        """Unknowns after a step, to first order their sum: a mode's scale, shape against load, changes by a factor.

        Only the force tells a scale, which a light mode has hardly any of, while sums would change large motions by the
        product of both moves. `most` is of the logarithm of a factor.
        """
        index, m = self.index, self.m
        phi, moves = (one[index.phi].reshape(self.n, m).T for one in (x, step))
        gamma, turns = (one[index.gamma].reshape(m, self.d) for one in (x, step))
        grown = [np.sum(a * b, axis=1) / np.sum(a**2 + 1e-300, axis=1) for a, b in ((phi, moves), (gamma, turns))]
        scale, by = np.clip((grown[0] - grown[1]) / 2, -most, most), np.zeros(self.size)
        by[index.phi] = np.tile(scale, self.n)
        by[index.gamma] = -np.repeat(scale, self.d)
        by[self.kept : self.kept + self.n_ends] = -np.repeat(scale, self.n_ends // m)
        return np.asarray(np.exp(by) * (x + step - by * x))

    @property
    def unknowns(self) -> int:
        """Numbers that the records determine: not those within tolerances, nor, without a force, scales of modes."""
        turns = self.static * (self.static - 1) // (2 if self.force else 1)
        return self.size - int(np.sum(self.held)) - (0 if self.force else self.m) - turns - self.by_gains.shape[2]

    def of_others(self, p: Parameters) -> NDArray[np.bool_]:
        """True for modes above the lines beside static modes, (m,), which stand for others."""
        above = p.modes.omega > 2 * np.pi * self.test.freq[-1]
        return above & (np.arange(self.m) < self.m - self.static) & (self.static > 0)

    def scales(self, p: Parameters) -> Array:
        """Moves of all unknowns that change nothing, (k, size): without a force, shape against load of each mode."""
        rows, index = np.zeros((0 if self.force else self.m, self.size)), self.index
        for k, row in enumerate(rows):
            row[index.phi][k :: self.m] = p.modes.phi[:, k]
            row[index.gamma][k * self.d : (k + 1) * self.d] = -p.modes.gamma[k]
            row[self.kept : self.kept + self.n_ends].reshape(self.m, -1)[k] = -p.ends[k]
            if p.coupling is not None:
                sides = (self.coupled == k) * p.coupling[*self.coupled.T][:, None]
                row[self.coupling] = sides[:, 1] - sides[:, 0]
        return rows

    def chunks(self, p: Parameters) -> Iterator[Chunk]:
        """See `SpectralModel`."""
        return (self.chunk(p, run) for run in self.parts())

    def chunk(self, p: Parameters, run: Run) -> Chunk:
        """Some lines at given parameters."""
        if p.laws:
            return LawChunk(self, p, run)
        return Chunk(self, p, run) if p.coupling is None and run.signal is None else SummedChunk(self, p, run)

    def normal_equations(self, p: Parameters, levels: Array) -> NormalEquations:
        """Products with the base as the records of all channels make it likely, for noise of these levels.

        `levels` are variances of a sample in time, of the outputs and then of the base, (pieces, c + d).
        """
        return self._products(p, levels, lambda chunk, *given: chunk.sums(*given))

    def gradient(self, p: Parameters, levels: Array) -> NormalEquations:
        """The same without the normal matrix, which stays zero: several times as fast."""
        return self._products(p, levels, lambda chunk, *given: chunk.sums_of_errors(*given))

    def bent(self, p: Parameters, levels: Array, x: Array, step: Array, share: float = 0.1) -> Array:
        """``Re J' S^-1 e''``, e'' the second derivative of errors along a step, by differences over a share of it."""
        back, ahead = (self.unpack(self.moved(x, times * step)) for times in (-share, share))

        def each(chunk: Chunk, levels: Array, columns: Columns) -> Sums:
            aside = self.chunk(back, chunk.run).error + self.chunk(ahead, chunk.run).error
            return chunk.sums_of_errors(levels, columns, (aside - 2 * chunk.error) / share**2)

        # Errors in units of the tolerances of gains do not bend.
        return self._products(p, levels, each).gradient + np.r_[np.zeros(self.of_gains.start), p.gains / 2]

    def _products(self, p: Parameters, levels: Array, each: Callable[[Chunk, Array, Columns], Sums]) -> NormalEquations:
        normal, gradient, chi2 = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        found: dict[int, tuple[Columns, Array, Sums]] = {}
        for chunk in self.chunks(p):
            if (piece := chunk.run.piece) in found:
                columns, scale, before = found[piece]
                found[piece] = columns, scale, before.plus(each(chunk, levels, columns))
            else:
                columns = chunk.columns()
                found[piece] = columns, chunk.deviations(levels)[0][:, 0], each(chunk, levels, columns)
        for columns, scale, sums in found.values():
            products, at = columns.products(sums, scale), columns.unknowns
            if products.normal.size:
                normal[np.ix_(at, at)] += products.normal
            gradient[at] += products.gradient
            chi2 += products.chi2
        if p.gains.size:  # in units of their tolerances
            np.einsum("ii->i", normal)[self.of_gains] += 0.5
            gradient[self.of_gains] -= p.gains / 2
            chi2 += float(p.gains @ p.gains) / 2
        normal[self.held], normal[:, self.held], gradient[self.held] = 0.0, 0.0, 0.0
        return NormalEquations(normal, gradient, chi2)


class Chunk(Lines):
    """Some lines of one run at given parameters, with the columns of their Jacobian."""

    def __init__(self, model: RecordModel, p: Parameters, run: Run) -> None:
        self.records = model
        super().__init__(model, p, run)

    def columns(self) -> Columns:
        """Columns of all channels by the spectra."""
        channels = range(self.records.channels)
        entries = [(np.full(row.size, at), row, *rest) for at in channels for row, *rest in self.entries(at)]
        channel, row, spectrum, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        unknowns, column = np.unique(row, return_inverse=True)
        return Columns(unknowns, channel, column, spectrum, value)

    def entries(self, channel: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """Entries of the columns of a channel's Jacobian by the spectra: unknowns, spectra and values, (k,) each."""
        model = self.records
        m, d, index = model.m, model.d, model.index
        k = np.arange(m)
        shapes = self.shapes[channel]
        first = np.cumsum([0, m, m * d, 2 * m, d])  # of q, g u, slopes, u; then transients, traces
        yield from self.of_motion(channel, first[3])
        yield index.gamma.start + np.arange(m * d), first[1] + np.arange(m * d), np.repeat(shapes, d)
        yield index.log_omega.start + k, first[2] + k, shapes
        yield index.log_ratios.start + k, first[2] + m + k, shapes
        last = first[4]
        if self.at_ends is not None:
            runs, pair = 2 * len(model.moving), np.tile([0, 1], m)
            row = model.kept + np.repeat(k, 2) * runs + self.at_ends.start + pair
            yield row, last + np.arange(2 * m), np.repeat(shapes, 2)
            last = last + 2 * m
        yield from self.of_sensor(channel, first[3], last)
        beside = last + len(self.trace_spectra) + (2 * d + model.channels) * model.gains
        for side, mode in enumerate(model.coupled.T[: 1 + model.force]):
            pairs = np.arange(mode.size)
            yield model.coupling.start + pairs, beside + side * mode.size + pairs, shapes[mode]

    def spectra(self, base: ComplexArray) -> ComplexArray:
        """Spectra of which all columns are made, those of couplings that are still zero at last."""
        plain, pairs = super().spectra(base), self.records.coupled
        if not len(pairs):
            return plain
        moved, moving = np.vstack([pairs, pairs[:, ::-1]])[: len(pairs) * (1 + self.records.force)].T
        by = -1j * np.divide(self.g, self.run.w, out=np.zeros_like(self.g), where=self.run.w > 0)
        return np.concatenate([plain, by[moved] * plain[moving]])

    def of_motion(self, channel: int, base: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """Entries of what multiplies the motions of the modes, and that of the base, whose spectra begin at `base`.

        Gains within tolerances included.
        """
        model, k, one = self.records, np.arange(self.records.m), np.ones(1)
        n, d, index = model.n, model.d, model.index
        gains = np.arange(model.of_gains.start, model.of_gains.stop)
        by_gains, shapes = model.by_gains[channel], self.shapes[channel] / self.reads[channel, 0]
        for j, direct in enumerate(self.direct[channel] / self.reads[channel]):
            yield gains, np.full(gains.size, base + j), direct * by_gains[j]
        for mode in k if channel >= n and gains.size else ():
            yield gains, np.full(gains.size, mode), shapes[mode] * by_gains[0]
        if channel < n:
            yield index.phi.start + channel * model.m + k, k, np.ones(model.m)
            return
        reads = self.reads[channel, 0]
        yield index.gamma.start + k * d + channel - n, k, np.full(model.m, reads)
        for at, (a, b) in enumerate(index.pairs):
            if channel - n in (a, b):
                yield index.rigid[[at]], np.array([base + (b if channel - n == a else a)]), reads * one

    def of_sensor(
        self, channel: int, base: int, last: int
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """Entries of a channel's traces, whose spectra begin at `last`, of its delay, and of a sensor's gain."""
        model, n, d = self.records, self.records.n, self.records.d
        beside, traces = np.arange(d), np.arange(len(self.trace_spectra))
        first_trace = model.kept + model.n_ends + (self.run.number * model.channels + channel) * traces.size
        yield first_trace + traces, last + traces, np.ones(traces.size)
        if model.gains:
            late = last + traces.size + 2 * d + channel
            yield np.array([model.delays + min(channel, n)]), np.array([late]), np.ones(1)
        if model.gains and channel < n:
            yield model.n_fit + channel * d + beside, base + beside, np.ones(d)
            for kind in (1, 2):
                column = model.n_fit + (kind * n + channel) * d + beside
                yield column, last + traces.size + (kind - 1) * d + beside, np.ones(d)

    def sums_of_errors(self, levels: Array, columns: Columns, error: ComplexArray | None = None) -> Sums:
        """Products of the spectra of these lines with the errors alone, or with others (c, L)."""
        weighed = self.weighed(levels)
        left = weighed if error is None else self.weighed(levels, error)
        cross = dots(self.spectra(weighed.base), self.run.weight * left.whitened_residual)
        return Sums(np.zeros((0, 0)), cross, np.zeros((0, 0)), float(self.run.weight @ weighed.power))

    def sums(self, levels: Array, columns: Columns) -> Sums:
        """All products of these lines; unknowns as in `columns`."""
        weighed, root = self.weighed(levels), np.sqrt(self.run.weight)
        spectra = root * self.spectra(weighed.base)
        hidden, covered = np.zeros((columns.unknowns.size,) * 2), self.covered(levels).conj()
        step = 1 + 2**16 // columns.unknowns.size  # lines, of which columns stay in a processor's cache
        for at in range(0, self.run.w.size, step):
            near = slice(at, at + step)
            seen = np.hstack([columns.seen(part, spectra[:, near]) for part in covered[:, :, near]])
            hidden += dots(seen, seen)
        cross = dots(spectra, root * weighed.whitened_residual)
        return Sums(dots(spectra, spectra), cross, hidden, float(self.run.weight @ weighed.power))

    def products(self, levels: Array, columns: Columns) -> NormalEquations:
        """Products of the Jacobian of these lines; unknowns as in `columns`."""
        return columns.products(self.sums(levels, columns), self.deviations(levels)[0][:, 0])


class LawChunk(Chunk):
    """The same with modes that follow their amplitude: to motions and columns comes what their laws add."""

    def linear_modes(self, p: Parameters, run: Run) -> Modes:
        """See `Lines`."""
        return linear_modes(p, run.number)

    def added(self, *, slopes: bool) -> list[ComplexArray]:
        """What each law adds, with derivatives or, as where a step is tried, without."""
        run, motions = self.run, self.records.law_motions
        return [motions.added(self.p, run, law, slopes=slopes) for law in self.p.laws if motions is not None]

    def motion_of(self, base: ComplexArray) -> ComplexArray:
        """See `Lines`."""
        motion = super().motion_of(base)
        for law, added in zip(self.p.laws, self.added(slopes=False), strict=True):
            motion[law.mode] += added[0]
        return motion

    def spectra(self, base: ComplexArray) -> ComplexArray:
        """See `Chunk`; last, law by law, come derivatives by the logarithm of the size of the shape, and by the law."""
        plain, ends, added = super().spectra(base), self.at_ends is not None, self.added(slopes=True)
        return np.concatenate([plain, *add_laws(plain, self.p.laws, added, self.p.modes.gamma.shape, ends=ends)])

    def entries(self, channel: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """See `Chunk`."""
        yield from super().entries(channel)
        model, d = self.records, self.records.d
        at = 3 * model.m + model.m * d + d + len(self.trace_spectra) + (2 * d + model.channels) * model.gains
        at += 0 if self.at_ends is None else 2 * model.m
        yield from law_entries(model, self.p, model.of_laws.start, at, self.shapes[channel], self.at_ends)


class SummedChunk(Chunk):
    """The same of modes that dampers couple, each load moving all of them, and of noise that grows with the signal.

    With A the flexibility, a change D of what it is the inverse of moves the motions q by ``-A D q``. So a column of a
    load, a pole or a coupling is a spectrum times the responses of all channels to a load of one mode, (c, L), those of
    ``shapes @ A``; or the sum of two such. Other columns show in a few channels, and are spectra there.
    """

    def columns(self) -> Columns:
        """See `Chunk`."""
        none = np.zeros(0, np.intp)
        return Columns(np.arange(self.records.size), none, none, none, np.zeros(0))

    def sums_of_errors(self, levels: Array, columns: Columns, error: ComplexArray | None = None) -> Sums:
        """See `Chunk`."""
        weighed, none = self.weighed(levels), np.zeros((0, 0))
        left = weighed if error is None else self.weighed(levels, error)
        weights = (self.run.weight * left.whitened_residual).conj()
        gradient = self._seen(weights, *self._parts(weighed.base)).real.sum(axis=1)
        return Sums(none, gradient, none, float(self.run.weight @ weighed.power))

    def sums(self, levels: Array, columns: Columns) -> Sums:
        """See `Chunk`."""
        scale, root = self.deviations(levels)[0], np.sqrt(self.run.weight)
        moves, alone = self._parts(self.weighed(levels).base)
        normal = np.zeros((self.records.size,) * 2)
        for channel, shape in enumerate(self.shapes):
            rows, spectra = self._of_channel(channel, alone)
            at = np.union1d(moves[0].unknowns, rows)
            J = np.zeros((at.size, root.size), complex)
            self._add(J, np.einsum("k,kjl->jl", shape, self.flexibility), moves, at)
            np.add.at(J, np.searchsorted(at, rows), spectra)
            J *= scale[channel] * root
            normal[np.ix_(at, at)] += dots(J, J)
        for part in self.covered(levels):
            seen = self._seen(root * part.conj(), moves, alone)
            normal -= dots(seen, seen)
        return self.sums_of_errors(levels, columns)._replace(gram=normal)

    def _parts(self, base: ComplexArray) -> tuple[list[Moves], ComplexArray]:
        """Columns that all channels feel; spectra of those of one: of modes, base, traces, and of modes above."""
        model, modes, w, k = self.records, self.p.modes, self.run.w, np.arange(self.records.m)
        d, index, (one, other) = model.d, model.index, model.coupled.T
        q = self.answer(real_times(modes.gamma, base) + self.pushed_by_ends)
        loss = 2j * (modes.ratios * modes.omega)[:, None] * w
        rows = [np.arange(index.gamma.start, index.log_ratios.stop), np.r_[model.coupling]]
        acting = [np.repeat(k, d), k, k, one]
        loads = [np.tile(w**2 * base, (k.size, 1)), -(2 * modes.omega[:, None] ** 2 + loss) * q, -loss * q]
        loads.append(-1j * w * q[other])
        alone = [q, base, self.trace_spectra]
        if self.at_ends is not None:
            runs = 2 * len(model.moving)
            rows.append((model.kept + k[:, None] * runs + self.at_ends.start + np.arange(2)).ravel())
            acting.append(np.repeat(k, 2))
            loads.append(np.tile(w**2 * self.transients, (k.size, 1)))
        if model.gains:
            alone.append(self.beside_the_fit(base))
        moves = [Moves(*map(np.concatenate, (rows, acting, loads)))]
        if model.force:
            moves.append(Moves(np.r_[model.coupling], other, -1j * w * q[one]))
        return moves, np.concatenate(alone)

    def _of_channel(self, channel: int, alone: ComplexArray) -> tuple[NDArray[np.intp], ComplexArray]:
        """Unknowns (k,) that show in a channel beside what all of them feel, and their columns there."""
        m = self.records.m
        entries = [*self.of_motion(channel, m), *self.of_sensor(channel, m, m + self.records.d)]
        rows, spectra, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        return rows, values[:, None] * alone[spectra]

    def _seen(self, weights: ComplexArray, moves: list[Moves], alone: ComplexArray) -> ComplexArray:
        """Sums of all columns (size, L) over the channels, with weights (c, L)."""
        out = np.zeros((self.records.size, self.run.w.size), complex)
        felt = np.einsum("kl,kjl->jl", real_times(self.shapes.T, weights), self.flexibility)
        self._add(out, felt, moves, np.arange(self.records.size))
        for channel, weight in enumerate(weights):
            rows, spectra = self._of_channel(channel, alone)
            np.add.at(out, rows, weight * spectra)
        return out

    @staticmethod
    def _add(out: ComplexArray, felt: ComplexArray, moves: list[Moves], at: NDArray[np.intp]) -> None:
        """Add columns that all channels feel to rows of the unknowns `at`; `felt` (m, L) is what loads of modes do."""
        for unknowns, acting, loads in moves:
            out[np.searchsorted(at, unknowns)] += felt[acting] * loads
