"""The objective of a swarm's candidates, all at once, and the refinement of their eigenvalues (eq. 31).

Objectives are compiled CasADi functions. Where the spectrum is held, the frequencies are the same for all candidates,
so that all sums over lines are made once, before the search (`sysid.modal_analysis.gain_series`), and matrices and
modes of a candidate are a few products of small arrays. Eigenvalues are refined in closed form, through IPOPT, or of
the leaders by both.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from queue import SimpleQueue
from typing import Any, Literal

import casadi as ca
import numpy as np

from sysid.measurement.whole import products
from sysid.modal_analysis.gain_series import GainSeries, SummedRecord
from sysid.modal_analysis.response import records_of, weights_of, weights_of_test
from sysid.models.expressions import triangle
from sysid.models.spectrum import spectrum_error
from sysid.problem.batch import CHUNK, Batch, BatchModes, batch_modes, expanded
from sysid.problem.prepared import Prepared
from sysid.problem.terms import Term, TestTerm
from sysid.search.local import terms_with
from sysid.search.session import Session
from sysid.structure.structure import Array
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF

_MOST = 65_000  # coordinates a chunk: fewer take more calls of NumPy for each, and more leave a processor's cache
_STEP = 16  # the last chunk is filled up to a multiple of it, because NumPy sums a candidate alone in another order
_NARROWEST_RANGE, _WIDEST_RANGE = 1.01, 1e4  # of a ratio, upper over lower: the series of a wider one would be long


def held_spectrum_objective(
    problem: Prepared, term: Term, spectrum: Array | None, unknowns: ca.Function
) -> HeldSpectrumObjective | None:
    """The fast objective of the problem's own test, where all natural frequencies are held; None elsewhere.

    `unknowns` takes the swarm's coordinates to x.
    """
    if spectrum is None or not isinstance(term, TestTerm) or len(spectrum) != problem.geometry.n:
        return None
    if not term.matrices.beyond.of(term.test).by_channel:
        return None
    s, matrices = ca.MX.sym("s", problem.n_variables), term.matrices
    x = unknowns(s)
    parts = [matrices.ratio_function(x, ca.DM(np.sort(spectrum))), *matrices.of_modes(x)]
    expansion = expanded(ca.Function("expansion", [s], [ca.densify(part) for part in parts]))
    return HeldSpectrumObjective(problem, term, spectrum, expansion)


class HeldSpectrumObjective:
    """Squared relative residual of the records, (count, n_variables) swarm coordinates to (count,).

    Of the problem's own test, or one in its place. `spectrum` (n,), rad/s, are all natural frequencies, which take the
    place of each candidate's own; `expansion` takes the swarm's coordinates to damping ratios, and to what
    `sysid.problem.batch.batch_modes` takes. The result does not depend on the number of threads, to the last bit; these
    are the machine's processors, at most eight, by default.
    """

    def __init__(
        self, problem: Prepared, term: TestTerm, spectrum: Array, expansion: ca.Function, threads: int | None = None
    ) -> None:
        from concurrent.futures import ThreadPoolExecutor  # brings the logging library, which the import does without

        test = term.test
        batch, workers = Batch(expansion), threads or min(os.cpu_count() or 1, 8)
        self.expansion, self._share = expansion, term.weight**2
        self._series = GainSeries(test.freq, np.sort(spectrum), *_range_of_ratios(problem, batch), shift=term.shift)
        recovery = term.matrices.recovery, np.eye(problem.geometry.d)
        # Of accelerations, and of the force where it was measured.
        self._records: tuple[list[tuple[SummedRecord, float]], list[tuple[SummedRecord, float]]] = ([], [])
        sizes: list[tuple[float, float]] = []
        scales = weights_of_test(test, weighted=True)
        every = zip(self._records, records_of(test), scales, recovery, strict=False)
        beyond = term.matrices.beyond.of(test, term.shift).functions
        for summed, (record, std), (_, scale), seen in every:
            static = summed is self._records[1]
            for runs, channel, line in products(std, record.shape):
                of_runs = record[runs], test.base[runs], channel, line
                one = SummedRecord(*of_runs, seen, self._series, static=static, beyond=beyond)
                summed.append((one, scale**2))
            sizes.append((weights_of(record, std)[1], scale))
        # Where less than this is left, lines are summed: the difference of large numbers that stands for the square has
        # lost half of its digits there. A record that weighs more than the accelerations loses its digits earlier.
        self._least = NEGLIGIBLE * max(1.0, *(weighed**2 / scale**2 for weighed, scale in sizes))
        self._pool = ThreadPoolExecutor(workers)
        self._expansions: SimpleQueue[Batch] = SimpleQueue()  # one a thread
        for _ in range(workers):
            self._expansions.put(copy(batch))

    def __call__(self, particles: Array, by_lines: Callable[[Array], Array]) -> Array:
        """Of each candidate; `by_lines` sums over lines, near the records and outside of the range of damping."""
        ends = chunk_ends(*particles.shape)
        chunks = self._pool.map(partial(self._chunk, particles), [0, *ends[:-1]], ends)
        squared, inside = map(np.concatenate, zip(*chunks, strict=True))
        held = np.logical_and(inside, squared > self._least)
        if not np.all(held):
            squared[~held] = by_lines(particles[~held]) / self._share
        return self._share * squared

    def _chunk(self, particles: Array, start: int, end: int) -> tuple[Array, Array]:
        """Squares, and whether the ratios are within the range of the series."""
        count = len(particles)
        full = particles[np.minimum(np.arange(start, end), count - 1)]  # the last chunk is filled up
        expansion = self._expansions.get()
        ratios, *parts = expansion(full)
        self._expansions.put(expansion)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            squared = self._squared(ratios[..., 0].T, batch_modes(*parts)[1])
        return squared[: count - start], self._series.holds(ratios[: count - start, :, 0])

    def _squared(self, ratios: Array, modes: BatchModes) -> Array:
        polynomials, n = self._series.polynomials(ratios), modes.shapes.shape[1]
        of_accelerations, of_force = self._records
        squared, shared = np.zeros(len(modes.loads)), None
        for force, size in of_force:
            shapes, loads = _of_force(modes)
            of_all = force.inner(loads, polynomials)
            squared += force.squared(shapes, loads, polynomials, of_all) / size
            if len(of_accelerations) == len(of_force) == 1 and of_accelerations[0][0].weighs_like(force):
                shared = np.ascontiguousarray(of_all[:, :n, :n])
        for accelerations, size in of_accelerations:
            squared += accelerations.squared(modes.shapes, modes.loads, polynomials, shared) / size
        return squared


def chunk_ends(count: int, size: int) -> list[int]:
    """Where chunks of candidates of this size end: an even number, nearly equal, the same for any number of threads.

    >>> chunk_ends(781, 300), chunk_ends(3, 300)
    ([192, 384, 576, 784], [16])
    """
    steps = math.ceil(count / CHUNK)
    chunks = min(2 * math.ceil(count * size / (2 * _MOST)), steps)
    ends = [CHUNK * (i * steps // chunks) for i in range(1, chunks)]
    return [*ends, _STEP * math.ceil(count / _STEP)]


def _range_of_ratios(problem: Prepared, expansion: Batch, count: int = 256) -> tuple[Array, Array]:
    """Least and largest damping ratios (n,) of so many candidates: the ends of a swarm's box and draws between them.

    Exact where ratios rise with every coordinate; elsewhere candidates beyond are left to the sum over lines.
    """
    lower, upper = problem.formulation.box
    draws = np.random.default_rng(0).uniform(lower, upper, (count - 2, problem.n_variables))
    ratios = expansion(np.vstack([lower, upper, draws]))[0][..., 0]
    lowest, highest = np.fmin.reduce(ratios), np.fmax.reduce(ratios)
    highest = np.where(highest > 0, highest, 1.0)  # no ratio of a structure: all goes by lines
    lowest = np.maximum(lowest, highest / _WIDEST_RANGE)
    return lowest, np.maximum(highest, lowest * _NARROWEST_RANGE)


def _of_force(modes: BatchModes) -> tuple[Array, Array]:
    """Shapes and participations of the base force, with the rigid-body mass behind the modes."""
    rigid = modes.rigid_body_mass
    still = np.broadcast_to(np.eye(rigid.shape[1]), rigid.shape)
    return np.concatenate([modes.loads, still], axis=1), np.concatenate([modes.loads, rigid], axis=1)


WORST = 1e6  # an objective that no candidate passes that keeps the constraints


class SwarmObjective:
    """Objective of a swarm: (n_particles, n_variables) → (n_particles,), the problem's objective.

    Constraints count by the feasibility rules of Deb (Comput. Methods Appl. Mech. Eng. 186 (2000) 311-338): whatever
    keeps them comes before what does not.

    The healing of the problem is applied. `smoothed` are fitted in the place of its tests, in their order; a `spectrum`
    (rad/s) takes the place of each candidate's own lowest frequencies (eigenvalue refinement in closed form).
    """

    def __init__(self, problem: Prepared, smoothed: Sequence[TestTerm] = (), spectrum: Array | None = None) -> None:
        self.problem, self.spectrum = problem, spectrum
        self.terms = terms_with(problem.formulation, smoothed)
        formulation = problem.formulation
        s = ca.MX.sym("s", formulation.size)
        x = formulation.from_sampling(s)
        if formulation.healed:
            x = ca.fmin(ca.fmax(formulation.healing(x), ca.DM(formulation.lower)), ca.DM(formulation.upper))
        self._unknowns = expanded(ca.Function("unknowns", [s], [ca.densify(x)]))
        self._all_unknowns = Batch(self._unknowns)
        self._held = held_spectrum_objective(problem, self.terms[0], spectrum, self._unknowns)

    def __call__(self, particles: Array) -> Array:
        """Objective of each row; NaN where a candidate is no structure."""
        constraints = self.problem.formulation.constraints
        if self._held is not None and len(self.terms) == 1 and not constraints.lower.size:
            return np.sqrt(self._held(particles, self._by_lines))
        x = self._x(particles)
        squared = self._by_lines(particles) if self._held is None else self._held(particles, self._by_lines)
        objective = np.sqrt(sum((term.squared(x) for term in self.terms[1:]), squared))
        if not constraints.lower.size:
            return objective
        over = np.array([constraints.violation(row) for row in x]) / self.problem.tolerance
        over = np.where(np.isfinite(over), over, np.inf)
        broken = np.sum(np.where(over > 1, over, 0.0), axis=1)
        return np.where(broken > 0, WORST * (1 + broken), np.minimum(objective, WORST))

    def _x(self, particles: Array) -> Array:
        """Unknowns of each row, (n_particles, n_variables)."""
        return self._all_unknowns(particles)[0][:, :, 0]

    def _by_lines(self, particles: Array) -> Array:
        """The first term's part of the squared objective, summed over all lines, (n_particles,)."""
        first, x = self.terms[0], self._x(particles)
        return first.squared(x, self.spectrum) if isinstance(first, TestTerm) else first.squared(x)

    def unknowns(self, s: Array) -> Array:
        """The unknowns x that the swarm coordinates `s` stand for, healed."""
        return np.asarray(self._unknowns(s)).ravel()

    def refined(self, x: Array) -> Array:
        """The unknowns of the structure whose objective `x` was given: its spectrum replaced by the measured one."""
        if self.spectrum is None:
            return x
        formulation, refined = self.problem.formulation, x.copy()
        part = formulation.parts.stiffness
        refined[part] = formulation.with_spectrum(x[None, part], self.spectrum)[0][0]
        return refined


RefineBy = Literal["closed-form", "ipopt", "leaders"]


@dataclass
class Tally:
    """Counts of the ends of IPOPT's refinements."""

    tried: int = 0  # leaders of the swarm that IPOPT refined
    won: int = 0  # those of them that it left at a lower objective than the closed form
    statuses: Counter[str] = field(default_factory=Counter)  # of all that IPOPT refined

    def add(self, other: Tally) -> None:
        """Add the counts of another swarm."""
        self.tried, self.won = self.tried + other.tried, self.won + other.won
        self.statuses.update(other.statuses)

    @property
    def of_history(self) -> dict[str, Any]:
        """The fields of `History`."""
        return {
            "leaders_tried": self.tried, "leaders_won": self.won,
            "refinement_statuses": tuple(sorted(self.statuses.items())),
        }  # fmt: skip

    def to_tree(self) -> dict[str, Any]:
        """Give the counts as numbers; `resume` takes them back."""
        return {"tried": self.tried, "won": self.won, "statuses": dict(self.statuses)}

    def resume(self, tree: dict[str, Any]) -> None:
        """Go on from the counts of an earlier run."""
        self.tried, self.won, self.statuses = tree["tried"], tree["won"], Counter(tree["statuses"])


@dataclass(frozen=True, eq=False)
class Refiner:
    """Gives candidates the measured spectrum."""

    problem: Prepared
    by: RefineBy
    spectrum: Array  # (m,), rad/s
    session: Session  # IPOPT keeps to the time that it has left
    tally: Tally

    def rows(self, rows: Array) -> Array:
        """Rows (k, n_variables), of the swarm or of unknowns alike, with refined entries of L_H; counted."""
        refined, statuses = self._refined(rows, by_solver=self.by == "ipopt")
        self.tally.statuses.update(statuses)
        return refined

    def one(self, x: Array) -> Array:
        """The unknowns of the structure that `x` was given its objective for."""
        return self._refined(x[None], by_solver=self.by == "ipopt")[0][0]

    def error(self, x: Array) -> float:
        """Largest relative difference of the unknowns' eigenvalues from those that were given."""
        part = self.problem.formulation.parts.stiffness
        return spectrum_error(triangle(x[part], self.problem.geometry.n), self.spectrum)

    def of_leader(self, objective: Callable[[Array], Array]) -> Callable[[Array, float], tuple[Array, float]]:
        """Function that refines a new leader, in the swarm's coordinates, for an objective of rows."""

        def refine(row: Array, cost: float) -> tuple[Array, float]:
            if self.session.is_over:
                return row, cost
            solved, statuses = self._refined(row[None], by_solver=True)
            self.tally.tried += 1
            self.tally.statuses.update(statuses)
            closed = self._refined(row[None], by_solver=False)[0]
            rows = np.clip(np.concatenate([closed, solved]), *self.problem.formulation.box)
            of_closed, of_solved = objective(rows)
            if of_solved < (1 - ROUND_OFF) * np.fmin(of_closed, cost):
                self.tally.won += 1
                return rows[1], float(of_solved)
            # The leader's objective is the closed form's already, unless a bound cut that off.
            return (rows[0], min(float(of_closed), cost)) if of_closed <= (1 + ROUND_OFF) * cost else (row, cost)

        return refine

    def _refined(self, rows: Array, *, by_solver: bool) -> tuple[Array, tuple[str, ...]]:
        """Rows with refined entries of L_H, and IPOPT's status of each."""
        refined, left = rows.copy(), None if self.session.max_time is None else self.session.left
        part = self.problem.formulation.parts.stiffness
        refined[:, part], statuses = self.problem.formulation.with_spectrum(
            rows[:, part], self.spectrum, by_solver=by_solver, max_time=left
        )
        return refined, statuses
