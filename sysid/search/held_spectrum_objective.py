"""The records' part of a swarm's objective where the spectrum is held and shapes and ratios are free.

The frequencies are then the same for all candidates, so that all sums over lines are made once, before the search
(`sysid.modal_analysis.gain_series`), and matrices and modes of a candidate are a few products of small arrays.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from sysid.measurement.noise import separable
from sysid.modal_analysis.gain_series import GainSeries, SummedRecord
from sysid.modal_analysis.response import records_of, weights_of, weights_of_test
from sysid.problem.batch_modes import BatchModes, batch_modes
from sysid.problem.given import MATRICES
from sysid.problem.problem import Problem
from sysid.problem.terms import Term, TestTerm
from sysid.structure.structure import Array

_MOST = 60_000  # coordinates a chunk: fewer take more calls of NumPy for each, and more leave a processor's cache
_STEP = 16  # chunks are multiples of it, because BLAS's products round alike at each of so many places
_MOST_THREADS = 8
# Relative squared error below which lines are summed: the difference of large numbers that stands for it has lost
# half of its digits at 1e-12.
_LEAST = 1e-6


def held_spectrum_objective(problem: Problem, term: Term, spectrum: Array | None) -> HeldSpectrumObjective | None:
    """The fast objective of the problem's own test; None where it does not apply.

    It does where all natural frequencies are held and the models of mass, stiffness and damping have their factors and
    ratios in numbers (``batch``, see `sysid.models.model.MatrixModel`).
    """
    formulation = problem.formulation
    if spectrum is None or not isinstance(term, TestTerm) or len(spectrum) != problem.geometry.n:
        return None
    makers = [model.batch for model in formulation.models if hasattr(model, "batch")]
    batches = [batch for maker in makers if (batch := maker(formulation.geometry)) is not None]
    return HeldSpectrumObjective(problem, term, spectrum, batches) if len(batches) == len(MATRICES) else None


class HeldSpectrumObjective:
    """Squared relative residual of the records, (count, n_variables) swarm coordinates to (count,).

    Parameters
    ----------
    problem : Problem
    term : TestTerm
        The problem's own test, or one in its place.
    spectrum : (n,), rad/s
        All natural frequencies, which take the place of each candidate's own.
    batches : sequence of callable
        The ``batch`` of the models of mass, stiffness and damping.
    threads : int, optional
        The result does not depend on it, to the last bit; the machine's processors, at most eight, by default.
    """

    def __init__(
        self,
        problem: Problem,
        term: TestTerm,
        spectrum: Array,
        batches: Sequence[Callable[[Array], Array]],
        threads: int | None = None,
    ) -> None:
        formulation, test = problem.formulation, term.test
        self._batches, self._parts, self._rigid_body = batches, formulation.parts, formulation.geometry.rigid_body
        self._share = term.weight**2
        low, high = (end[self._parts.damping] for end in formulation.box)
        self._series = GainSeries(test.freq, np.sort(spectrum), low, high, shift=term.shift)
        recovery = term.matrices.recovery, np.eye(formulation.geometry.d)
        self._records: list[tuple[SummedRecord, float]] = []
        sizes: list[tuple[float, float]] = []
        scales = weights_of_test(test, weighted=True)
        for (record, std), (_, scale), seen in zip(records_of(test), scales, recovery, strict=False):
            weights = separable(std, record.shape)
            summed = SummedRecord(record, test.base, *weights, seen, self._series, static=bool(self._records))
            self._records.append((summed, scale**2))
            sizes.append((weights_of(record, std)[1], scale))
        # A record that weighs more than the accelerations loses its digits earlier.
        self._least = _LEAST * max(1.0, *(weighed**2 / scale**2 for weighed, scale in sizes))
        self._pool = ThreadPoolExecutor(threads or min(os.cpu_count() or 1, _MOST_THREADS))

    def __call__(self, particles: Array, by_lines: Callable[[Array], Array]) -> Array:
        """Of each candidate.

        Parameters
        ----------
        particles : (count, n_variables)
            Coordinates of the swarm.
        by_lines : callable
            The same summed over lines, for candidates near the records and those outside of the range of damping.
        """
        ends = chunk_ends(*particles.shape)
        squared = np.concatenate(list(self._pool.map(partial(self._chunk, particles), [0, *ends[:-1]], ends)))
        held = np.logical_and(self._series.holds(particles[:, self._parts.damping]), squared > self._least)
        if not np.all(held):
            squared[~held] = by_lines(particles[~held]) / self._share
        return self._share * squared

    def _chunk(self, particles: Array, start: int, end: int) -> Array:
        count = len(particles)
        full = particles[np.minimum(np.arange(start, end), count - 1)]  # the last one again and again fills the last
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return self._squared(full)[: count - start]

    def _squared(self, particles: Array) -> Array:
        pieces = zip(self._batches, self._parts, strict=True)
        mass, stiffness, damping = (batch(particles[:, part]) for batch, part in pieces)
        modes = batch_modes(mass, stiffness, self._rigid_body)
        polynomials = self._series.polynomials(damping.T)
        parts = zip(self._records, (_accelerations, _force), strict=False)
        return np.sum([record.squared(*made(modes), polynomials) / size for (record, size), made in parts], axis=0)


def chunk_ends(count: int, size: int) -> list[int]:
    """Where chunks of candidates of this size end: an even number, nearly equal, the same for any number of threads.

    >>> chunk_ends(781, 156), chunk_ends(3, 156)
    ([192, 384, 576, 784], [16])
    """
    steps = math.ceil(count / _STEP)
    chunks = min(2 * math.ceil(count * size / (2 * _MOST)), steps)
    return [_STEP * (i * steps // chunks) for i in range(1, chunks + 1)]


def _accelerations(modes: BatchModes) -> tuple[Array, Array]:
    """Shapes and participations."""
    return modes.shapes, modes.loads


def _force(modes: BatchModes) -> tuple[Array, Array]:
    """The same of the base force, with the rigid-body mass behind the modes."""
    rigid = modes.rigid_body_mass
    still = np.broadcast_to(np.eye(rigid.shape[1]), rigid.shape)
    return np.concatenate([modes.loads, still], axis=1), np.concatenate([modes.loads, rigid], axis=1)
