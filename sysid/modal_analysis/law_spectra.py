"""Modes whose frequency and damping follow their amplitude, as a term of the model of whole records.

Such a mode moves as its law says under the base as it was recorded, from a first state that the two numbers of its ends
are; noise of the base moves it as the linear mode of the same frequency and damping. So its motion is that of the
linear mode and what the law adds, and so is every derivative.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import ModeLaw, Parameters, Run, SpectralModel
from sysid.modal_analysis.response import gains_and_slopes
from sysid.structure.amplitude import motion
from sysid.structure.structure import Array, ComplexArray, Structure


class LawMotions:
    """Motions of the modes that follow a law, of all runs of a test, and what they add to the linear ones.

    An addition, (6 + d + k, L), is that to the motion at the lines of a run, and its derivatives by two ends, d
    participations, the logarithms of frequency, damping ratio and size of the shape, and the k numbers of the law; then
    those by all these of the mode whose level counts, where it is another.
    Steps in time are so short that a mode has `per_period` in a period, by its frequency when it is first asked for,
    and that there are `per_line` in one of the highest line.
    """

    def __init__(self, test: Measurement, per_period: float = 16.0, per_line: float = 3.0) -> None:
        self.per_period, self.least = per_period, per_line * test.freq[-1]
        self.rate, self.samples, self.at_rest = _clock_of(test)
        self.lines = [test.freq[lines] for lines in test.own_lines]
        self.base = [base[:, lines] for base, lines in zip(test.base, test.own_lines, strict=True)]
        self._steps: dict[int, float] = {}
        self._series, self._last = _motions_of(test)

    def places(self, run: int) -> NDArray[np.intp]:
        """Numbers of the lines of a run among all of its Fourier transform."""
        return np.round(self.lines[run] * self.samples[run] / self.rate).astype(int)

    def in_time(self, run: int, mode: int, omega: float) -> tuple[float, Array]:
        """Length of a step, s, and motion of the base (d, n) whose straight lines over steps have the run's lines."""
        finer = max(math.log2(self.per_period * omega / (2 * np.pi) / self.least), 0.0)
        # Within a twelfth of an octave they stay the same from fit to fit.
        rate = self._steps.setdefault(mode, self.least * 2 ** (math.ceil(12 * finer) / 12))
        duration = self.samples[run] / self.rate
        steps = math.ceil(duration * rate)
        if (run, steps) not in self._series:
            spectrum = np.zeros((len(self.base[run]), steps // 2 + 1), complex)
            straight = np.sinc(self.lines[run] * duration / steps) ** 2
            spectrum[:, self.places(run)] = self.base[run] / straight * steps / duration
            self._series[run, steps] = np.fft.irfft(spectrum, steps)
        return duration / steps, self._series[run, steps]

    def added(self, p: Parameters, run: Run, law: ModeLaw, *, slopes: bool) -> ComplexArray:
        """What a law adds at the lines of a part of a run, with derivatives or without."""
        return self.of_run(p, run.number, law, slopes=slopes)[:, run.among(self.lines[run.number])]

    def of_run(self, p: Parameters, run: int, law: ModeLaw, *, slopes: bool = False) -> ComplexArray:
        """What a law adds at all lines of a run, with derivatives or, (1, L), without."""
        modes, k, d, rest = p.modes, law.mode, p.modes.gamma.shape[1], self.at_rest[run]
        step, rows, _ = self._moved(p, run, law, slopes)
        spectra = np.fft.rfft(rows)[:, self.places(run)] * step
        freq, base, ends = self.lines[run], self.base[run], self._ends(p, run, k)
        pole = np.array([[modes.omega[k]], [modes.ratios[k]]]) * law.equivalent[run][:, None]
        g, by_pole = gains_and_slopes(freq, *pole)
        moved, moved_by_pole = _in_steps(freq, pole, step)
        w, load = 2 * np.pi * freq, modes.gamma[k] @ base
        transients = np.zeros((2, w.size)) if rest else np.stack([1 / w**2, 1j / w])
        linear = moved * load + g[0] * (ends @ transients)
        if not slopes:
            return np.asarray(spectra - linear)
        for at in (1, 6 + d + law.form.size)[: 2 - (law.level_of is None)]:
            spectra[at : at + 2] = np.zeros((2, w.size)) if rest else spectra[[at + 1, at]]
        spectra[: 3 + d] -= [linear, *g[0] * transients, *moved * base]
        spectra[3 + d : 5 + d] -= moved_by_pole * load + by_pole * (ends @ transients)
        return np.asarray(spectra)

    def in_run(self, p: Parameters, run: int, law: ModeLaw) -> tuple[Array, Array]:
        """Level that a law follows, m/s², and restoring acceleration of its mode, both (n,) at the steps of a run."""
        _, rows, levels = self._moved(p, run, law, slopes=False)
        return levels[0], rows[0]

    def _moved(self, p: Parameters, run: int, law: ModeLaw, slopes: bool) -> tuple[float, Array, Array]:
        """Length of a step, s, and both that `motion` gives; those of the last numbers are kept."""
        modes, k, level = p.modes, law.mode, None
        step, series = self.in_time(run, k, float(modes.omega[k]))
        if law.level_of is not None:  # straight from step to step of the mode that it is of
            level, fine = self._moved(p, run, law.moving(p.laws), slopes)[2], np.arange(series.shape[1])
            at = np.minimum(fine / fine.size * level.shape[1], level.shape[1] - 1.0)
            first = at.astype(int)
            rest = at - first
            level = (1 - rest) * level[:, first] + rest * level[:, np.minimum(first + 1, level.shape[1] - 1)]
        pole = np.log([modes.omega[k], modes.ratios[k], abs(modes.phi[law.sensor, k])])
        numbers, ends = np.append(pole, law.values), self._ends(p, run, k)
        key = np.concatenate([[step, *law.form], modes.gamma[k], ends, numbers, *(() if level is None else level[:2])])
        which = run, k, slopes
        if which not in self._last or not np.array_equal(self._last[which][0], key):
            load = modes.gamma[k] @ series
            found = motion(law.form, load, step, numbers, ends[::-1], series if slopes else None, level)
            self._last[which] = key, *found
        return step, *self._last[which][1:]

    def _ends(self, p: Parameters, run: int, mode: int) -> Array:
        """Numbers of the ends of a run of a mode, (2,)."""
        first = 2 * sum(not one for one in self.at_rest[:run])
        return np.zeros(2) if self.at_rest[run] else p.ends[mode, first : first + 2]


@functools.lru_cache(maxsize=1)
def _motions_of(
    test: Measurement,
) -> tuple[dict[tuple[int, int], Array], dict[tuple[int, int, bool], tuple[Array, Array, Array]]]:
    """Motions of the base, by run and number of steps; last ones of modes, by run, mode, and whether with slopes."""
    return {}, {}


def _in_steps(freq: Array, pole: Array, step: float, images: int = 2) -> tuple[ComplexArray, ComplexArray]:
    """Restoring acceleration of a linear mode under a load of one that is straight over steps, (L,); slopes, (2, L).

    At its ends they show such a load's `images`, about multiples of the rate of steps, at the line that it is of.
    """
    fold = np.arange(-images, images + 1)[:, None] / step
    share = (freq / (freq + fold)) ** 2
    g, slopes = gains_and_slopes((freq + fold).ravel(), *pole)
    moved = np.sum(share * (1 + g[0]).reshape(share.shape), axis=0)
    return moved, np.sum(share * slopes.reshape(2, *share.shape), axis=1)


def linear_modes(p: Parameters, run: int) -> Modes:
    """The modes by which noise of the base moves the structure in a run: those with a law at its equivalent pole."""
    omega, ratios = p.modes.omega.copy(), p.modes.ratios.copy()
    for law in p.laws:
        omega[law.mode] *= law.equivalent[run, 0]
        ratios[law.mode] *= law.equivalent[run, 1]
    return p.modes._replace(omega=omega, ratios=ratios)


def add_laws(
    plain: ComplexArray, laws: Sequence[ModeLaw], added: Sequence[ComplexArray], shape: tuple[int, ...], *, ends: bool
) -> list[ComplexArray]:
    """Add what laws add to the spectra of the linear modes, in place; give all other derivatives, law by law.

    `shape`, (m, d), is that of participations; the spectra are those of `Lines.spectra`.
    """
    m, d = shape
    first = np.cumsum([0, m, m * d, m, m, d])  # of motions, by gamma, by log omega, by log zeta; of the base, of ends
    beside = []
    for law, one in zip(laws, added, strict=True):
        k = law.mode
        plain[k] += one[0]
        plain[first[1] + k * d : first[1] + (k + 1) * d] += one[3 : 3 + d]
        plain[first[2] + k] += one[3 + d]
        plain[first[3] + k] += one[4 + d]
        if ends:
            plain[first[5] + 2 * k : first[5] + 2 * k + 2] += one[1:3]
        beside.append(one[5 + d :])
    return beside


def law_entries(
    model: SpectralModel, p: Parameters, laws: int, at: int, shapes: Array, ends: slice | None
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
    """Entries of a channel's columns by the spectra that `add_laws` gives, which begin at `at`.

    Numbers of the laws begin at the unknown `laws`; `shapes`, (m,), are the channel's, `ends` its run's among all ends.
    """
    index, m, d, moving = model.index, model.m, model.d, 2 * len(model.moving)
    starts = laws + np.cumsum([0, *(law.form.size for law in p.laws)])
    first = {law.mode: start for law, start in zip(p.laws, starts.tolist(), strict=False)}
    for law in p.laws:
        shape = shapes[law.mode]
        for part in (law, law.moving(p.laws))[: 2 - (law.level_of is None)]:
            k, unknowns = part.mode, list[int]()
            if part is not law:
                by_ends = -np.ones(2, int) if ends is None else model.kept + k * moving + np.r_[ends]
                unknowns += [*by_ends, *range(index.gamma.start + k * d, index.gamma.start + (k + 1) * d)]
                unknowns += [index.log_omega.start + k, index.log_ratios.start + k]
            values = np.full(len(unknowns) + 1 + part.form.size, shape)
            values[len(unknowns)] /= p.modes.phi[part.sensor, k] or 1.0
            unknowns.append(index.phi.start + part.sensor * m + k)
            unknowns += [first[k] + i if k in first else -1 for i in range(part.form.size)]
            there = np.array(unknowns) >= 0
            yield np.array(unknowns)[there], at + np.flatnonzero(there), values[there]
            at += len(unknowns)


def _clock_of(test: Measurement) -> tuple[float, tuple[int, ...], tuple[bool, ...]]:
    """Sample rate, Hz, number of samples of each run, and whether it is at rest at both ends."""
    if test.whole is not None:
        return test.whole.sample_rate, test.whole.samples, test.whole.at_rest
    if test.sample_rate is None:
        raise InputError(
            "modes that follow their amplitude move as the records in time say, and of these lines the sample rate is "
            "not known: make the test of records (Measurement.from_time)"
        )
    samples = tuple(round(test.sample_rate / np.diff(test.freq[lines]).min()) for lines in test.own_lines)
    return test.sample_rate, samples, (True,) * test.n_runs


def added_by_laws(test: Measurement, structure: Structure) -> tuple[ComplexArray, ComplexArray]:
    """What the laws of a structure add under a test's base motion, from rest.

    To accelerations of the sensors, (runs, n_sensors, n_freq), and to the base force, (runs, d, n_freq).
    """
    response, force = np.zeros_like(test.response), np.zeros_like(test.base)
    if not structure.laws:
        return response, force
    modes = Modes(
        structure.mode_shapes, structure.participation, 2 * np.pi * structure.natural_frequencies,
        structure.damping_ratios,
    )  # fmt: skip
    ones = np.ones((test.n_runs, 2))
    laws = tuple(
        ModeLaw(law.mode, law.sensor, law.form, law.values, ones, level_of=law.level_of if law.followed else None)
        for law in structure.laws
    )
    motions = LawMotions(test)
    ends = np.zeros((structure.n, 2 * sum(not rest for rest in motions.at_rest)))
    p = Parameters(modes, structure.rigid_body_mass, ends, np.zeros(0), laws=laws)
    for run, lines in enumerate(test.own_lines):
        for law in laws:
            added = motions.of_run(p, run, law)[0]
            response[run][:, lines] += modes.phi[:, [law.mode]] * added
            force[run][:, lines] += modes.gamma[law.mode][:, None] * added
    return response, force


def without_laws(test: Measurement, structure: Structure) -> Measurement:
    """The records as they would be if no mode followed its amplitude."""
    if not structure.laws:
        return test
    response, force = added_by_laws(test, structure)
    return test.less(response if test.force is None else np.concatenate([response, force], axis=1))
