"""The records' part of a swarm's objective where the spectrum is held and shapes and ratios are free.

The frequencies are then the same for all candidates, so that all sums over lines are made once, before the search
(`sysid.modal_analysis.gain_series`), and matrices and modes of a candidate are a few products of small arrays.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sysid.measurement.noise import separable
from sysid.modal_analysis.gain_series import GainSeries, SummedRecord
from sysid.modal_analysis.response import records_of, weights_of, weights_of_test
from sysid.problem.batch_modes import BatchModes, batch_modes
from sysid.problem.given import MATRICES
from sysid.problem.problem import Problem
from sysid.problem.terms import Term, TestTerm
from sysid.structure.structure import Array

CHUNK = 64  # candidates a task: fixed, so that the bits do not depend on the number of threads or candidates
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
        self._share, self._recovery = term.weight**2, term.matrices.recovery
        ranges = formulation.lower[self._parts.damping], formulation.upper[self._parts.damping]
        self._series = GainSeries(test.freq, np.sort(spectrum), *ranges, shift=term.shift)
        self._records: list[tuple[SummedRecord, float]] = []
        sizes: list[tuple[float, float]] = []
        for (record, std), (_, scale) in zip(records_of(test), weights_of_test(test, weighted=True), strict=True):
            weights = separable(std, record.shape)
            summed = SummedRecord(record, test.base, *weights, self._series, static=bool(self._records))
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
        starts = range(0, len(particles), CHUNK)
        squared = np.concatenate(list(self._pool.map(lambda at: self._chunk(particles[at : at + CHUNK]), starts)))
        held = np.logical_and(self._series.holds(particles[:, self._parts.damping]), squared > self._least)
        if not np.all(held):
            squared[~held] = by_lines(particles[~held]) / self._share
        return self._share * squared

    def _chunk(self, particles: Array) -> Array:
        count = len(particles)
        # Products of other sizes may round otherwise: the last candidate again and again fills the chunk.
        full = particles if count == CHUNK else particles[np.minimum(np.arange(CHUNK), count - 1)]
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return self._squared(full)[:count]

    def _squared(self, particles: Array) -> Array:
        pieces = zip(self._batches, self._parts, strict=True)
        mass, stiffness, damping = (batch(particles[:, part]) for batch, part in pieces)
        modes = batch_modes(mass, stiffness, self._rigid_body)
        polynomials = self._series.polynomials(damping.T)
        parts = zip(self._records, (self._accelerations, self._force), strict=False)
        return np.sum([record.squared(*made(modes), polynomials) / size for (record, size), made in parts], axis=0)

    def _accelerations(self, modes: BatchModes) -> tuple[Array, Array]:
        """Shapes at the sensors, and participations."""
        return modes.shapes @ self._recovery.T, modes.loads

    def _force(self, modes: BatchModes) -> tuple[Array, Array]:
        """The same of the base force, with the rigid-body mass behind the modes."""
        rigid = modes.rigid_body_mass
        still = np.broadcast_to(np.eye(rigid.shape[1]), rigid.shape)
        return np.concatenate([modes.loads, still], axis=1), np.concatenate([modes.loads, rigid], axis=1)
