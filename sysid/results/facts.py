"""Facts of a problem that readers of a result ask for, its records, and the table of the phases of its search."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sysid.assessment.assumptions import assumptions
from sysid.assessment.sensitivity import system_matrices
from sysid.errors import InputError
from sysid.finding import Finding
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.calibration import Calibration
from sysid.modal_analysis.delays import Delays
from sysid.modal_analysis.record_fit import RecordFit
from sysid.models.mass import LumpedMass
from sysid.models.unknowns import Unknown
from sysid.problem.formulation import Formulation
from sysid.problem.matrices import MATRICES
from sysid.problem.prepared import Prepared
from sysid.problem.stored import stored_fits
from sysid.problem.terms import FurtherTest
from sysid.search.strategy import History, Phase
from sysid.structure.structure import Array, Structure

_TOTALS = {"trace": "total of the diagonal", "rigid_body": "rigid-body total", "sensors": "total on the sensors"}
COLUMNS = ("after", "objective", "residual", "frequencies, %", "1 - MAC", "M, %", "K, %", "C, %", "candidates", "s")


class ReportedUnknown(NamedTuple):
    """An unknown that means something by itself; bounds are (size,). A free damping ratio stands in tables of modes."""

    name: str
    unit: str
    shape: tuple[int, ...]
    labels: tuple[str, ...]
    lower: Array
    upper: Array
    fixed: bool
    is_ratio: bool

    @property
    def size(self) -> int:
        """Number of its scalars."""
        return len(self.labels)


class Facts(NamedTuple):
    """Facts of a problem for readers of a result.

    `unit_mass`, `fits_records` and `tells_damping` are those of the problem and its formulation. `by_accelerations`:
    these alone are fitted, which leave a common factor of M, K and C open. `misses`: what was stated as known to some
    accuracy, and by how many standard deviations the answer misses it. `counts`: scalar unknowns a matrix. `models`: a
    matrix, and its model with what that states. `stated_rigid_body`: which entries of the rigid-body mass are stated.
    `assumed`: what no record can test.
    """

    unit_mass: bool
    fits_records: bool
    mass_is_free: bool
    mass_is_lumped: bool
    by_accelerations: bool
    misses: tuple[tuple[str, float], ...]
    unknowns: tuple[ReportedUnknown, ...]
    counts: tuple[tuple[str, int], ...]
    n_variables: int
    models: tuple[tuple[str, str], ...]
    stated_rigid_body: Array
    assumed: tuple[Finding, ...]
    tells_damping: bool

    def to_tree(self) -> dict[str, Any]:
        """Give all as dictionaries, lists, arrays, numbers and texts; `from_tree` takes it back."""
        lists = {
            "misses": [{"name": name, "deviations": z} for name, z in self.misses],
            "counts": [{"name": name, "count": count} for name, count in self.counts],
            "models": [{"name": name, "words": words} for name, words in self.models],
            "assumed": [one.to_tree() for one in self.assumed],
        }
        unknowns = [{**one._asdict(), "shape": np.array(one.shape, dtype=np.int64)} for one in self.unknowns]
        return self._asdict() | lists | {"unknowns": unknowns}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Facts:
        """Give the facts of a tree that `to_tree` made."""
        lists = {
            "misses": tuple((one["name"], one["deviations"]) for one in tree["misses"]),
            "counts": tuple((one["name"], one["count"]) for one in tree["counts"]),
            "models": tuple((one["name"], one["words"]) for one in tree["models"]),
            "assumed": tuple(map(Finding.from_tree, tree["assumed"])),
        }
        unknowns = tuple(ReportedUnknown(**{**one, "shape": tuple(one["shape"].tolist())}) for one in tree["unknowns"])
        return cls(**{name: tree[name] for name in cls._fields} | lists | {"unknowns": unknowns})


def facts_of(problem: Prepared, x: Array | None) -> Facts:
    """The facts of a problem and of its unknowns at an answer."""
    formulation, test = problem.formulation, problem.measurement
    further = [one.measurement.force is None for one in problem.stated.residuals if isinstance(one, FurtherTest)]
    misses = [
        (name, float(z))
        for prior in formulation.priors
        if x is not None
        for name, z in zip(prior.labels, prior.numbers(x), strict=True)
    ]
    unknowns = [
        ReportedUnknown(one.name, one.unit, one.shape, one.labels, one.lower, one.upper, bool(one.fixed), is_ratio)
        for one, is_ratio in _reported_unknowns(formulation)
    ]
    return Facts(
        unit_mass=bool(problem.unit_mass),
        fits_records=bool(formulation.fits_records),
        mass_is_free=bool(formulation.mass.free),
        mass_is_lumped=isinstance(problem.stated.mass, LumpedMass),
        by_accelerations=test.force is None
        and problem.stated.misfit is None
        and len(further) == len(problem.stated.residuals)
        and all(further),
        misses=tuple(misses),
        unknowns=tuple(unknowns),
        counts=problem.unknowns,
        n_variables=problem.n_variables,
        models=tuple(_models(problem)),
        stated_rigid_body=_stated_rigid_body(problem),
        assumed=assumptions(problem),
        tells_damping=bool(formulation.tells_damping),
    )


def _reported_unknowns(formulation: Formulation) -> Iterator[tuple[Unknown, bool]]:
    """Unknowns that mean something by themselves, and which are free damping ratios, that stand in the table of modes.

    Those of models with a form of their own, and variables, fixed too. The entries of a free matrix's factor are none,
    nor are shares of which only the ratios count.
    """
    of_a_form = (not formulation.mass.free, not formulation.stiffness.free, True)
    ratios = (False, False, formulation.damping.free)
    for group, among, are_ratios in zip(formulation.of_models, of_a_form, ratios, strict=True):
        yield from ((one, are_ratios) for one in group if among and not one.relative)
    yield from ((one, False) for one in formulation.variables)


def _models(problem: Prepared) -> Iterator[tuple[str, str]]:
    """A matrix each: its model, and what that states; or that it is written in variables or numbers."""
    formulation, counts = problem.formulation, dict(problem.unknowns)
    stated = (formulation.mass, formulation.stiffness, formulation.damping)
    for name, model, group, known in zip(MATRICES, problem.stated.models, formulation.of_models, stated, strict=True):
        kind = type(model).__name__ if group else "written in variables" if counts[name] else "numbers"
        total = "" if known.totals is None else _TOTALS[known.totals.kind]
        yield name, "; ".join(filter(None, (kind, total, known.sentence)))


def _stated_rigid_body(problem: Prepared) -> Array:
    totals, d = problem.formulation.mass.totals, problem.measurement.n_base
    if totals is None or totals.kind != "rigid_body":
        return np.zeros((d, d), dtype=bool)
    return np.ones((d, d), dtype=bool) if totals.values.ndim == 2 else np.eye(d, dtype=bool)


@dataclass(frozen=True, eq=False)
class StoredRecords:
    """The records of a problem without its matrices; the attributes are those of `Problem`."""

    measurement: Measurement
    reference: Structure | None
    validation: tuple[Measurement, ...]
    goal: float | None
    loss: str
    delays: Delays
    calibration: Calibration | None
    fit: RecordFit | None
    """Of whole records, which the file holds."""

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> StoredRecords:
        """Give the records of a tree that `Problem.to_tree` made."""
        test, reference = Measurement.from_tree(tree["measurement"]), tree["reference"]
        (delays,), (calibration,), (fit,) = stored_fits(tree, [test])
        validation = tuple(map(Measurement.from_tree, tree["validation"]))
        known = reference and Structure.from_tree(reference)
        return cls(test, known, validation, tree["goal"], tree["loss"], delays, calibration, fit)


@dataclass(frozen=True, eq=False)
class PartOfProblem:
    """Part of a problem in a file that does not hold it whole.

    `tree` and `readings` as `Problem.to_tree` and `sysid.results.readings` made them; `attributes` are those of
    `Answer`, by name, for which readers ask the problem; `without` is why the problem cannot be made of it, for a
    message.
    """

    tree: dict[str, Any]
    readings: dict[str, Any]
    records: StoredRecords
    attributes: dict[str, Any]
    without: str


def seconds_in_words(seconds: float) -> str:
    """A time with two digits, or whole seconds: "0.031 s", "4.2 s", "123 s"."""
    return f"{seconds:.2g} s" if not seconds >= 99.5 else f"{seconds:.0f} s"


def rows_of_phases(problem: Prepared, history: History, structure: Structure, x: Array | None) -> list[list[str]]:
    """A row of `COLUMNS` for each phase of the search that gave the answer; the truth's columns "-" without one.

    Frequencies: largest relative error; MAC: of the mode that is told least; M_SS, K_SS and C: relative error in
    Frobenius norm, "-" for C where the truth has no damping. An iterate of a local solver counts as a candidate. Of a
    phase that ended at no structure, and of a result that tells no unknowns, only objectives are known.
    """
    rows = [_row(problem, phase, structure, x) for phase in history.phases if phase.x.size]
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


def _row(problem: Prepared, phase: Phase, answer: Structure, x: Array | None) -> list[str]:
    truth = problem.stated.reference
    # The graph of the matrices, which a hundred sensors cannot wait for, is not built for the answer itself.
    answered = x is not None and np.array_equal(phase.x, x)
    try:
        structure = answer if answered else problem.structure(phase.x)
    except (InputError, np.linalg.LinAlgError):
        left = [f"{phase.objective:.4g}", "no structure", *["-"] * 5]
        return [phase.name, *left, str(phase.evaluations), f"{phase.seconds:.1f}"]
    known = truth is not None and truth.n == structure.n and truth.n_base == structure.n_base
    off = errors(structure, truth) if known and truth is not None else np.full(5, np.nan)
    of_truth = [f"{value:.2g}" if np.isfinite(value) else "-" for value in off * [100, 1, 100, 100, 100]]
    residual = problem.screened.measurement.residual(structure) if problem.free_modes else problem.residual(phase.x)
    objective = [f"{value:.4g}" for value in (phase.objective, residual)]
    return [phase.name, *objective, *of_truth, str(phase.evaluations), f"{phase.seconds:.1f}"]
