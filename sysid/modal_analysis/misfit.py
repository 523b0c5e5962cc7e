"""Noise and misfit of the records of a test: what a structure or a fit leaves of them, stated or inferred noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import products
from sysid.modal_analysis.law_spectra import without_laws
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.record_model import Chunk
from sysid.modal_analysis.residues import line_correlation
from sysid.modal_analysis.response import columns, misfits, real_times, stacked, states_noise, weights_of_numbers
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import EPSILON, beyond_chance

SUSPECT = 1.2  # reduced chi-squared above which the stated noise does not explain the misfit, unless chance does:


_FAR_BELOW = 0.1  # reduced chi-squared of a misfit, as of round-off, that tells nothing of the noise


@dataclass(frozen=True, eq=False)
class Record:
    """Noise and misfit of the responses or of the force, (channels, runs * n_freq), and the weights of the fit.

    `weights` are those of `products`, whose runs share one Gram matrix but for a factor a channel.
    """

    std: Array
    misfit: ComplexArray
    weight: Array
    weights: list[tuple[NDArray[np.intp], Array, Array]]

    @property
    def shared(self) -> bool:
        """True where the weights of the fit are those of the noise."""
        return bool(np.all(np.abs(self.weight * self.std - 1) < 1e-9))

    def grams(self, spectra: ComplexArray) -> Iterator[Array]:
        """``Re V' W V`` of each channel, W the squared weights."""
        n_runs = sum(runs.size for runs, _, _ in self.weights)
        by_run = spectra.reshape(len(spectra), n_runs, -1)
        parts = [(by_run[:, runs] * line).reshape(len(spectra), -1) for runs, _, line in self.weights]
        together, channels = np.array([_gram(part) for part in parts]), np.array([one for _, one, _ in self.weights])
        return (np.tensordot(each**2, together, 1) for each in channels.T)

    def sandwich_grams(self, spectra: ComplexArray) -> Iterator[Array]:
        """``Re V' W S W V`` of each channel, S the variances of the noise."""
        return (_gram(spectra * row) for row in self.weight**2 * self.std)


def misfits_of(test: Measurement, structure: Structure, unknowns: int) -> list[tuple[ComplexArray, Array]]:
    """Misfit and standard deviations of the noise, stated or inferred from the misfit, of each number of the records.

    Of the responses and, where measured, of the force, (runs, channels, n_freq); inferred noise allows for the number
    of unknowns.
    """
    lines = np.count_nonzero(test.own_lines)  # of all runs
    left = max(1 - unknowns / (2 * test.numbers), 0.5)
    found: list[tuple[ComplexArray, Array]] = []
    recorded = [record for record in (test.response, test.force) if record is not None]
    for record, (misfit, stated) in zip(recorded, misfits(test, structure), strict=True):
        numbers = lines * record.shape[1]
        noise = np.sqrt(np.sum(np.abs(misfit) ** 2) / numbers / left) if stated is None else stated
        least = EPSILON * np.sqrt(np.sum(np.abs(record) ** 2) / numbers)
        found.append((misfit, np.broadcast_to(np.maximum(noise, least), record.shape)))
    return found


def noise_records(test: Measurement, structure: Structure, unknowns: int) -> list[Record]:
    """Records of the responses and, where measured, of the force; inferred noise allows for the number of unknowns."""
    records = []
    for misfit, std in misfits_of(test, structure, unknowns):
        weight, weights = weights_of_numbers(std, std.shape), products(std, std.shape)
        records.append(Record(columns(std + 0j).real, columns(misfit), weight, weights))
    return records


def inflation_of(test: Measurement, records: list[Record], unknowns: int, scattered: float | None = None) -> float:
    """Factor by which errors exceed what the stated noise explains; NaN where the noise is unknown.

    From the size of the misfit, and from its correlation between neighbouring lines, as in averaged spectra. Where
    modes have a scatter of their own, `scattered` times the noise, it holds the size of what the modes leave, and what
    neighbours share of it.
    """
    freedom = 2 * test.numbers - unknowns
    if freedom <= 0:
        return 1.0 if states_noise(test) else np.nan
    reduced = 2 * sum(np.sum(np.abs(record.misfit / record.std) ** 2) for record in records) / freedom
    if reduced < _FAR_BELOW:
        return 1.0
    if scattered is not None:
        reduced /= scattered
    beyond = reduced if reduced > max(SUSPECT, beyond_chance(freedom) / freedom) else 1.0
    if scattered is not None:
        return float(np.sqrt(beyond))
    error = np.concatenate([(r.misfit / r.std).reshape(-1, test.n_runs, test.freq.size) for r in records])
    return float(np.sqrt(beyond * line_correlation(error, unknowns)))


def _gram(vectors: ComplexArray) -> Array:
    real = stacked(vectors)
    return real.T @ real


def without_transients_of(test: Measurement, structure: Structure) -> Measurement:
    """Whole records with the transients taken off that a structure can have had, by least squares; others as they are.

    Changes of displacement q and velocity v over a run make ``Z^-1 (f + i w g)`` of the degrees of freedom, with Z the
    dynamic stiffness, ``f = K v`` and ``g = K q + C v``: two real numbers a degree of freedom and run, whatever the
    damping. Traces of sampling and detrending are real multiples of 1, i w and 1 / (i w) a channel and run,
    also of one at rest at both ends. What laws of the amplitude add is taken off first.
    """
    test = without_laws(test, structure)
    if test.whole is None:
        return test
    n = structure.n
    w = 2 * np.pi * test.freq
    M, K = structure.mass[:n, :n], structure.stiffness[:n, :n]
    square, once = (w**2)[:, None, None], w[:, None, None]
    X = np.linalg.inv(-square * M + 1j * once * structure.damping + K)  # (L, n, n)
    both = np.concatenate([X, 1j * once * X], axis=2)
    transients = structure.recovery @ both
    if test.force is not None:
        push = M @ structure.rigid_body_dofs + structure.mass[:n, n:]
        transients = np.concatenate([transients, push.T @ both], axis=1)
    left = np.concatenate([one for one, _ in misfits(test, structure)], axis=1)
    taken = np.zeros_like(left)
    transients = np.moveaxis(transients, 0, -1)  # (c, 2 n, L)
    for run, (lines, rest) in enumerate(zip(test.own_lines, test.whole.at_rest, strict=True)):
        of_ends = transients[:, :0] if rest else transients
        traces = test.whole.traces(test.freq[lines], test.freq[-1])[: test.whole.of_sampling]
        taken[run][:, lines] = _fitted(left[run][:, lines], of_ends[..., lines], traces)
    return test.less(taken, whole=None)


def _fitted(left: ComplexArray, transients: ComplexArray, traces: ComplexArray) -> ComplexArray:
    """The part of what is left (c, L) that transients (c, p, L) and traces of each channel explain."""
    _, p, lines = transients.shape
    Q = np.linalg.qr(stacked(traces))[0]
    size = np.linalg.norm(left, axis=1)
    size[size == 0] = 1.0
    rows = np.array([stacked(part) for part in transients]) / size[:, None, None]  # (c, 2 L, p)
    wanted = stacked(left).T / size[:, None]  # (c, 2 L)
    plain_rows, plain = rows - Q @ (Q.T @ rows), wanted - (wanted @ Q) @ Q.T
    scale = np.linalg.norm(plain_rows, axis=(0, 1))
    scale[scale == 0] = 1.0
    x = np.linalg.lstsq((plain_rows / scale).reshape(plain.size, p), plain.ravel(), rcond=1e-10)[0] / scale
    explained = rows @ x
    explained = (explained + (wanted - explained) @ Q @ Q.T) * size[:, None]
    return explained[:, :lines] + 1j * explained[:, lines:]


def left_of(fit: RecordFit) -> float:
    """What a fit leaves of the accelerations against the base, over these: a rigid body leaves one."""
    left = size = 0.0
    for chunk in fit.model.chunks(fit.parameters):
        moved = chunk.run.outputs[: fit.model.n] - real_times(fit.test.rigid_body, chunk.run.base)
        left += float(np.sum(np.abs(chunk.error[: fit.model.n]) ** 2))
        size += float(np.sum(np.abs(moved) ** 2))
    return float(np.sqrt(left / size)) if size else 0.0


def misses_much(left: float, much: float = 0.1) -> bool:
    """True of what `left_of` says where the model may be wrong, and not the noise large."""
    return left >= much


def without_transients(fit: RecordFit) -> Measurement:
    """The records as they would be at rest at both ends, were there no laws of amplitude; with their noise stated."""
    test, model, p = fit.test, fit.model, fit.parameters

    def transients(chunk: Chunk) -> ComplexArray:
        at_rest = chunk if not p.laws else model.chunk(replace(p, laws=()), chunk.run)
        return np.asarray(chunk.run.outputs - chunk.error - np.einsum("cdl,dl->cl", at_rest.H, chunk.run.base))

    taken = at_lines(fit, transients)
    std, force_std = deviations(fit)
    return test.less(taken, whole=None, response_std=std, force_std=force_std)


def deviations(fit: RecordFit) -> tuple[Array, Array | None]:
    """Standard deviations ``sqrt(E|e|²)`` of responses and force at each line: their own noise and the base's."""
    test, c, n = fit.test, fit.model.channels, fit.test.n_sensors

    def noise(chunk: Chunk) -> Array:
        variances = chunk.run.variances(fit.levels)
        return np.sqrt(variances[:c] + np.sum(np.abs(chunk.H) ** 2 * variances[c:], axis=1))

    std = at_lines(fit, noise)
    for run, lines in zip(std, test.own_lines, strict=True):  # where a run has no line its weight is of no meaning
        run[:, ~lines] = np.median(run[:, lines], axis=1, keepdims=True)
    return std[:, :n], std[:, n:] if fit.model.force else None


def at_lines(fit: RecordFit, values: Callable[[Chunk], NDArray[Any]]) -> NDArray[Any]:
    """What is found in parts of each run's own lines, as (runs, channels, n_freq), zero at the lines of others."""
    test, parts = fit.test, [list[NDArray[Any]]() for _ in range(fit.test.n_runs)]
    for chunk in fit.model.chunks(fit.parameters):
        parts[chunk.run.number].append(values(chunk))
    joined = [np.concatenate(run, axis=1) for run in parts]
    out = np.zeros((test.n_runs, joined[0].shape[0], test.freq.size), joined[0].dtype)
    for at, lines, run in zip(out, test.own_lines, joined, strict=True):
        at[:, lines] = run
    return out
