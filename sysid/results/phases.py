"""Table of the phases of a search: residual and, where the truth is known, errors of modes and matrices."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sysid.assessment.sensitivity import system_matrices
from sysid.errors import InputError
from sysid.problem.prepared import Prepared
from sysid.search.strategy import History, Phase
from sysid.structure.structure import Array, Structure

COLUMNS = ("after", "objective", "residual", "frequencies, %", "1 - MAC", "M, %", "K, %", "C, %", "candidates", "s")


def seconds_in_words(seconds: float) -> str:
    """A time with two digits, or whole seconds: "0.031 s", "4.2 s", "123 s"."""
    return f"{seconds:.2g} s" if not seconds >= 99.5 else f"{seconds:.0f} s"


class Searched(Protocol):
    """A result, as far as its phases go."""

    @property
    def prepared(self) -> Prepared:
        """The problem that was identified."""

    @property
    def history(self) -> History:
        """The history of its search."""

    @property
    def structure(self) -> Structure:
        """The answer."""

    @property
    def x(self) -> Array | None:
        """Its unknowns."""


def rows_of_phases(it: Searched) -> list[list[str]]:
    """A row of `COLUMNS` for each phase of the search that gave the answer; the truth's columns "-" without one.

    Frequencies: largest relative error; MAC: of the mode that is told least; M_SS, K_SS and C: relative error in
    Frobenius norm, "-" for C where the truth has no damping. An iterate of a local solver counts as a candidate. Of a
    phase that ended at no structure, and of a result that tells no unknowns, only objectives are known.
    """
    history = it.history
    rows = [_row(it, phase) for phase in history.phases if phase.x.size]
    left = ("start", history.start), ("swarm", history.swarm), ("local phase", history.local)
    plain = [(name, value) for name, value in left if np.isfinite(value)]
    return rows or [[name, f"{value:.4g}", *["-"] * (len(COLUMNS) - 2)] for name, value in plain]


def errors(found: Structure, truth: Structure) -> Array:
    """Largest relative error of a frequency and largest 1 - MAC; relative errors of M_SS, K_SS and C: (5,)."""
    ours, other = found.mode_shapes, truth.mode_shapes
    squares, others = (np.einsum("ik,ik->k", phi, phi) for phi in (ours, other))  # zero for a shape that no sensor sees
    mac = np.einsum("ik,ik->k", ours, other) ** 2 / np.where(squares > 0, squares, 1) / np.where(others > 0, others, 1)
    return np.array([
        np.max(np.abs(found.natural_frequencies / truth.natural_frequencies - 1)),
        1 - mac.min(),
        *matrix_errors(found, truth),
    ])  # fmt: skip


def matrix_errors(found: Structure, truth: Structure) -> tuple[float, ...]:
    """Relative errors of M_SS, K_SS and C in Frobenius norm; NaN of C where the truth has no damping."""
    pairs = zip(system_matrices(found), system_matrices(truth), strict=True)
    return tuple(float(np.linalg.norm(a - b) / np.linalg.norm(b)) if np.any(b) else np.nan for a, b in pairs)


def _row(it: Searched, phase: Phase) -> list[str]:
    problem, truth = it.prepared, it.prepared.stated.reference
    # The graph of the matrices, which a hundred sensors cannot wait for, is not built for the answer itself.
    answered = it.x is not None and np.array_equal(phase.x, it.x)
    try:
        structure = it.structure if answered else problem.structure(phase.x)
    except (InputError, np.linalg.LinAlgError):
        left = [f"{phase.objective:.4g}", "no structure", *["-"] * 5]
        return [phase.name, *left, str(phase.evaluations), f"{phase.seconds:.1f}"]
    known = truth is not None and truth.n == structure.n and truth.n_base == structure.n_base
    off = errors(structure, truth) if known and truth is not None else np.full(5, np.nan)
    of_truth = [f"{value:.2g}" if np.isfinite(value) else "-" for value in off * [100, 1, 100, 100, 100]]
    residual = problem.screened.measurement.residual(structure) if problem.free_modes else problem.residual(phase.x)
    objective = [f"{value:.4g}" for value in (phase.objective, residual)]
    return [phase.name, *objective, *of_truth, str(phase.evaluations), f"{phase.seconds:.1f}"]
