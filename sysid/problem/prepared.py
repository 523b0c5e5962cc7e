"""A problem as it is searched: records, modes and the least-squares problem; checks that it can be searched at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, Stop
from sysid.files.tree import check_tree
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.calibration import Calibration, calibrated
from sysid.modal_analysis.delays import Clock, Delays
from sysid.modal_analysis.fit import estimate, fit_modes, fit_tests
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.modal_fit import modes_within
from sysid.modal_analysis.model_order import with_so_many_modes
from sysid.modal_analysis.outliers import Outlier, outliers, pseudo_values, screened
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.response import predicted
from sysid.modal_analysis.spectra_modes import fit_modes_of_lines
from sysid.modal_analysis.static_modes import with_static_modes, without_static_modes
from sysid.modal_analysis.vector_fitting import Poles
from sysid.models.model import Geometry
from sysid.models.stiffness_and_damping import FREQUENCY_WINDOW
from sysid.models.unknowns import Unknown
from sysid.nlp import IterationMonitor
from sysid.problem.feasible import HELD, check_constraints, scale_of
from sysid.problem.formulation import Formulation
from sysid.problem.matrices import MATRICES, geometry_of, rough_mass
from sysid.problem.stated import StatedProblem
from sysid.problem.stored import stored_fits
from sysid.structure.amplitude import FittedLaw
from sysid.structure.structure import Array, Structure
from sysid.swarm import box

LOOSE = 1e-2  # likewise for the swarm, which meets no equality exactly


def clocks_of(stated: StatedProblem) -> list[Clock]:
    """Each test without its delays; the problem's own as it is where a misfit stands in its place."""
    first, *further = stated.tests
    own = Clock.of(first) if stated.misfit is None else Clock(first, None, None)
    return [own, *map(Clock.of, further)]


def points_of(formulation: Formulation) -> Array:
    """The guess, and points spread over the search space, (128, size)."""
    return np.array([formulation.guess, *spread_points(formulation, 127, np.random.default_rng(0))])


def spread_points(formulation: Formulation, count: int, rng: np.random.Generator) -> list[Array]:
    """Points spread over the search space as the swarm's are."""
    low, high = formulation.box
    rows = low + box.latin_hypercube(count, formulation.size, rng) * (high - low)
    s = ca.MX.sym("s", formulation.size)
    unknowns = ca.Function("unknowns", [s], [formulation.from_sampling(s)])
    return list(np.asarray(unknowns(rows.T)).T)  # a column each


def check_matrices(formulation: Formulation, points: Array, test: Measurement, site: str) -> None:
    """Refuse matrices that are those of a structure nowhere."""
    names = formulation.declarations
    for name in ("mass", "stiffness"):
        if not any(_positive(getattr(formulation.matrices.numbers(x), name)) for x in points):
            raise InputError(
                f"{name} is not positive definite over the structure's degrees of freedom, neither at the guess nor at "
                f"any of {len(points) - 1} points of the search space{names[name]}"
            )
    wrong: InputError | None = None
    for x in points:
        try:
            formulation.matrices.structure(x, test)
        except InputError as error:
            wrong = wrong or error
        else:
            return
    raise InputError(
        f"the matrices (problem at {site}) are those of a structure nowhere, neither at the guess ({wrong}) nor at any "
        f"of {len(points) - 1} points of the search space{names['damping']}"
    )


def _positive(matrix: Array) -> bool:
    if not np.all(np.isfinite(matrix)) or np.any(np.diag(matrix) <= 0):
        return False
    size = np.sqrt(np.diag(matrix))
    return bool(scipy.linalg.eigvalsh(matrix / np.outer(size, size), subset_by_index=(0, 0))[0] > 1e-13)


Monitor = Callable[[int, float], object]


class SearchSpace:
    """Search space and objective of a problem: what is read off its `formulation`."""

    @property
    def formulation(self) -> Formulation:
        """Matrices, terms and constraints as CasADi functions of the unknowns."""
        raise NotImplementedError

    @property
    def variables(self) -> tuple[Unknown, ...]:
        """All that is searched."""
        return self.formulation.unknowns

    @property
    def lower(self) -> Array:
        """Lower bounds, (n_variables,)."""
        return self.formulation.lower

    @property
    def upper(self) -> Array:
        """Upper bounds, (n_variables,)."""
        return self.formulation.upper

    @property
    def n_variables(self) -> int:
        """Number of scalar unknowns (the paper's D)."""
        return self.formulation.size

    def values(self, structure: Structure) -> Array:
        """Unknowns that stand for `structure`, (n_variables,); inverse of `structure` where the models can hold it."""
        return self.formulation.values(structure)

    def residual(self, x: Array) -> float:
        """``‖predicted - measured‖ / ‖measured‖`` over all fitted tests: see `Formulation.residual`."""
        return self.formulation.residual(x)

    def objective(self, x: Array) -> float:
        """Objective at `x`: see `Formulation.objective`."""
        return self.formulation.objective(x)


class Prepared(SearchSpace):
    """Statements of a user, and the modal estimate of each fitted test: what strategies search and checks judge.

    `modal` are the estimates of the tests, the problem's own first, found when first asked for where none are given;
    `delays` and `calibrations` of the tests, and `fits` of whole records, are what they are then made of. With
    `in_squares` squares are fitted, whatever loss is stated.
    """

    def __init__(
        self, stated: StatedProblem, modal: Sequence[ModalEstimate] = (), *, in_squares: bool = False,
        delays: Sequence[Delays | None] = (), fits: Sequence[RecordFit | None] = (),
        calibrations: Sequence[Calibration | None] = (),
    ) -> None:  # fmt: skip
        self.stated, self.in_squares = stated, in_squares or stated.loss == "squares"
        none = (None,) * len(stated.tests)
        self._fits, self._calibrations = tuple(fits) or none, tuple(calibrations) or none
        if delays:
            self.delays = tuple(delays)
        if modal:
            self.modal = tuple(modal)

    def prepare(self, monitor: Monitor | None = None) -> None:
        """Find what the records tell beside the modes before any search: noise, poles, weights where they are needed.

        `monitor` is called with (iteration, relative residual) while poles are looked for; what it raises passes
        through.
        """
        try:
            self.screened = self._screened(monitor)
        except (Stop, KeyboardInterrupt):
            if not self._stop_screening():
                raise
            self.screened, monitor = self._screened(None), None
        geometry, formulation = self.geometry, self.formulation
        geometry.monitor = formulation.monitor = monitor
        try:
            _ = formulation.unknowns
            if not formulation.free_modes:
                _ = formulation.terms
        finally:
            geometry.monitor = formulation.monitor = None

    @classmethod
    def from_tree(cls, stated: StatedProblem, tree: dict[str, Any]) -> Prepared:
        """Make what `to_tree` made a tree of, with the fits of its whole records."""
        delays, calibrations, fits = stored_fits(tree, stated.tests)
        return cls(stated, delays=delays, fits=fits, calibrations=calibrations)

    @cached_property
    def delays(self) -> tuple[Delays | None, ...]:
        """Delays of each test's sensors and force, as they are found before its modes."""
        return tuple(clock.delays for clock in clocks_of(self.stated))

    @cached_property
    def validation(self) -> tuple[Measurement, ...]:
        """Tests that are predicted and never fitted, without delays of their own, and without errors of gains."""
        gains, tests = self.modal[0].calibration, (Clock.of(test).test for test in self.stated.validation)
        return tuple(calibrated(test, gains) for test in tests)

    @cached_property
    def modal(self) -> tuple[ModalEstimate, ...]:
        """The modal estimate of each test that is fitted."""
        laws = [self.stated.amplitude, *[None] * (len(self._fits) - 1)]
        given = zip(self.stated.tests, self.delays, self._calibrations, self._fits, laws, strict=True)
        return tuple(  # a stored fit has its laws
            fit_modes(test, delays, calibration, amplitude=law) if fit is None else estimate(fit, calibration)
            for test, delays, calibration, fit, law in given
        )

    def fit_lines(
        self, poles: Poles, count: int | None, monitor: IterationMonitor, max_iterations: int
    ) -> ModalEstimate:
        """Fit modes to the lines of the problem's own test, which are its modal estimate from then on.

        See `fit_modes_of_lines`.
        """
        modal = fit_modes_of_lines(
            self.modal[0], poles, np.sqrt(self.totals), count=count, inside=self.of_structure(poles.omega),
            residual=self.answers_in_band, monitor=monitor, max_iterations=max_iterations,
        )  # fmt: skip
        self.modal = (modal, *self.modal[1:])
        return modal

    def fit_records(self, count: int | None, monitor: FitMonitor) -> None:
        """Finish the fit of the problem's own whole records: so many modes, where that is asked for.

        Modes stand for all above the lines, where the answer is in the band and the records ask for it.
        """
        fit = self.modal[0].record_fit
        if fit is None:
            return
        monitor.keep(fit)
        try:
            with monitor.at_work():
                more = (with_static_modes if self.answers_in_band else without_static_modes)(fit, monitor=monitor)
        except (Stop, KeyboardInterrupt):
            more = replace(fit, stopped=True)
        if count is not None:
            more = with_so_many_modes(more, count, self.of_structure(more.parameters.modes.omega))
        if more is not fit:
            self.modal = (estimate(more, self.modal[0].calibration), *self.modal[1:])

    def fit_modes(self, monitor: FitMonitor) -> None:
        """Fit the modes of each test, and laws to the problem's own whole records, if no check asked for them yet."""
        if "modal" not in vars(self):
            self.modal = fit_tests(zip(self.stated.tests, self.delays, strict=True), monitor, self.stated.amplitude)

    @property
    def laws(self) -> tuple[FittedLaw, ...]:
        """Of the modes that follow their amplitude beyond chance."""
        return tuple(law for law in self.modal[0].laws if law.is_certain)

    @property
    def answers_in_band(self) -> bool:
        """True where modes beyond the lines are no modes of the structure.

        Stated entries of the mass, and a mass or stiffness of a form of its own are of as many modes as degrees of
        freedom, wherever these are.
        """
        mass = self.formulation.mass
        return mass.free and mass.entries is None and not mass.weighs and self.formulation.stiffness.free

    def of_structure(self, omega: Array) -> NDArray[np.bool_]:
        """True for modes of the structure, by their frequencies, rad/s, (m,): see `answers_in_band`.

        They are those that stand for stated frequencies, or, without any, those within the lines: with a law of
        amplitude, at some level that they moved at.
        """
        if not self.answers_in_band:
            return np.ones(omega.size, bool)
        lines, stated = self.measurement.freq[[0, -1]], 2 * np.pi * self.stated.frequencies
        # A stated frequency may be off by the window, and a fit may move by it.
        inside = modes_within(omega, 2 * np.pi * lines, stated, 2 * FREQUENCY_WINDOW)
        followed = [law.mode_among(omega / (2 * np.pi)) for law in self.laws if law.reaches(*lines) and not stated.size]
        inside[[mode for mode in followed if mode is not None]] = True
        return inside

    @cached_property
    def screened(self) -> Prepared:
        """The same in squares: with Huber's loss without numbers that stand alone, else itself.

        Where a fit of modes was stopped there is no time to look for such numbers, and squares are fitted.
        """
        return self._screened(None)

    def _screened(self, monitor: Monitor | None) -> Prepared:
        if self.in_squares:
            return self
        modal = list(self.modal)
        if not self.stopped:
            modal = [replace(one, records=screened(one.records, monitor=monitor)) for one in modal]
        return Prepared(self.stated, modal, in_squares=True)

    def _stop_screening(self) -> bool:
        """Fit squares of whole records from now on, as where the fit of their modes was stopped; False without any."""
        if self.in_squares or not any(one.by_modes for one in self.modal):
            return False
        self.modal = tuple(
            replace(one, record_fit=one.record_fit and replace(one.record_fit, stopped=True)) for one in self.modal
        )
        return True

    @property
    def stopped(self) -> bool:
        """True where the fit of the modes of a test was stopped."""
        return any(one.stopped for one in self.modal)

    # -- records and where they are fitted ---------------------------------------------------------

    @property
    def measurement(self) -> Measurement:
        """The problem's own test, as it is fitted: of whole records without their transients."""
        return self.modal[0].records

    def fits(self, structure: Structure, x: Array | None) -> list[tuple[ModalEstimate, Structure]]:
        """Each test that is fitted, and what the structure was in it at an answer."""
        formulation = self.formulation
        fitted = [(self.modal[0], structure)] if formulation.fits_records else []
        if x is None:
            return fitted
        further = zip(self.modal[1:], formulation.further_tests, strict=True)
        return fitted + [(modal, term.matrices.structure(x, modal.records)) for modal, term in further]

    @property
    def first_test(self) -> int:
        """Number of the first fitted test: 1 is the problem's own, 2 a further one beside a misfit of one's own."""
        return 1 if self.formulation.fits_records else 2

    def outliers(self, structure: Structure, x: Array | None) -> list[Outlier]:
        """Numbers of the fitted records that are far from an answer: see `Identification.outliers`."""
        alone, fits = self.in_squares, enumerate(self.fits(structure, x), start=self.first_test)
        found = [outliers(modal.records, its, self.n_variables, alone=alone, number=i) for i, (modal, its) in fits]
        return sorted((one for of_test in found for one in of_test), key=lambda one: -one.size)

    def pseudo_values(self, structure: Structure, x: Array | None) -> Prepared:
        """The problem in squares, with pseudo-values about an answer in the place of its records.

        See `sysid.modal_analysis.outliers`; poles that were found stay. What whole records tell of the modes is gone.
        """
        fits = [(modal.records, predicted(modal.records, its)) for modal, its in self.fits(structure, x)]
        tests = iter(pseudo_values(fits, self.n_variables))
        measurement = next(tests) if self.formulation.fits_records else self.measurement
        other = self.of_lines((measurement, *tests))
        if self.geometry.found is not None:
            other.geometry.poles = self.geometry.found
        return other

    def of_lines(self, tests: Iterable[Measurement]) -> Prepared:
        """The problem in squares with other tests, whose lines stand for themselves."""
        modal = [
            replace(ModalEstimate.of_lines(test), calibration=one.calibration)
            for test, one in zip(tests, self.modal, strict=False)
        ]
        return Prepared(self.stated, modal, in_squares=True)

    # -- what is searched --------------------------------------------------------------------------

    @cached_property
    def geometry(self) -> Geometry:
        """The geometry of the degrees of freedom, of the records in squares."""
        if not self.in_squares:
            return self.screened.geometry
        stated = self.stated
        weighed = None if self.measurement.force is None else self._weigh
        return geometry_of(self.modal[0], stated.stiffness, stated.recovery, stated.rigid_body_dofs, weighed)

    def _weigh(self) -> Array:
        """Rough rigid-body mass of each base direction from the base force, (d,): it only places the search."""
        spectrum = None
        if self.stated.states_frequencies:
            spectrum = self.stated.stiffness.stated(self.geometry).spectrum
        return rough_mass(self.measurement, self.geometry, spectrum)

    @cached_property
    def formulation(self) -> Formulation:
        """Matrices, terms and constraints as CasADi functions of the unknowns."""
        return self.formulate(self.geometry) if self.in_squares else self.screened.formulation

    def formulate(self, geometry: Geometry) -> Formulation:
        """The same with another geometry."""
        return self.stated.formulate(geometry, self.modal)

    def check(self) -> None:
        """Refuse what cannot be searched, before any search.

        Where no point of the search space makes a structure, none keeps the constraints, or a model cannot be stored.
        """
        formulation, site = self.formulation, self.stated.site
        if not formulation.variables and formulation.free_modes:
            return
        points = points_of(formulation)
        if not formulation.free_modes:  # with them every point makes a structure
            check_matrices(formulation, points, self.measurement, site)
        check_tree(self.stated.as_given)  # before a search what could not be stored at its end
        check_constraints(formulation, points, site)

    @cached_property
    def tolerance(self) -> Array:
        """By how much a candidate of the swarm may break each row of the constraints, (rows,)."""
        formulation = self.formulation
        if not formulation.constraints.lower.size:
            return np.zeros(0)
        scale = scale_of(formulation, points_of(formulation))
        return scale * np.where(formulation.constraints.equal, LOOSE, HELD)

    @property
    def poles(self) -> Poles | None:
        """Poles found in the data, where the stiffness is free and states no frequencies."""
        stated = self.formulation.stiffness
        return self.geometry.poles if stated.spectrum is not None and not self.stated.states_frequencies else None

    @property
    def unknowns(self) -> tuple[tuple[str, int], ...]:
        """Number of unknowns a matrix: the paper's Table 1, with the n·d entries of M_S0 that it leaves out.

        Models count their own, a written matrix all variables that enter it.
        """
        sizes = {v.name: v.size for v in self.variables}
        entering = {name: sum(sizes[v] for v in names) for name, names in self.formulation.members}
        return tuple((dict.fromkeys(MATRICES, 0) | entering).items())

    @property
    def free_modes(self) -> bool:
        """True where mode shapes and participations are free: see `Formulation`."""
        return self.formulation.free_modes

    # -- masses that are stated --------------------------------------------------------------------

    @cached_property
    def totals(self) -> Array:
        """Total mass in each base direction, (d,): stated, else weighed by the base force, else 1 kg.

        Of a mass with a form of its own, what moves with the base at the guess.
        """
        stated, geometry = self.formulation.mass, self.geometry
        if stated.totals is not None:
            return stated.totals.by_direction
        if self._leaves_total:
            return geometry.totals(None)
        M, M_S0, M_00, *_ = self.formulation.matrices.numbers(self.formulation.guess)
        G = geometry.rigid_body
        return np.diag(G.T @ M @ G + G.T @ M_S0 + M_S0.T @ G + M_00).copy()

    @property
    def unit_mass(self) -> bool:
        """True where no number with a unit of mass is given, so that masses are normalised to 1 kg a direction."""
        has_unit = self.measurement.force is not None or np.nansum(np.abs(self.known_mass)) > 0
        return self._leaves_total and not has_unit

    @property
    def _leaves_total(self) -> bool:
        """True where the mass model could state a total, and does not: any other mass has the size that it is given."""
        return getattr(self.stated.mass, "total_mass", np.nan) is None

    @property
    def known_mass(self) -> Array:
        """Entries of ``[M_SS, M_S0]`` that are stated, (n, n + d); NaN elsewhere."""
        entries = self.formulation.mass.entries
        n, d = self.geometry.n, self.geometry.d
        return np.full((n, n + d), np.nan) if entries is None else entries

    @property
    def rigid_total(self) -> Array | None:
        """Rigid-body mass (d, d) where all of it is stated, else None."""
        return self.formulation.mass.rigid_total

    # -- at one point ------------------------------------------------------------------------------

    def structure(self, x: ArrayLike) -> Structure:
        """The structure that the unknowns `x`, (n_variables,) in the variables' own units, stand for."""
        values = np.asarray(x, dtype=float)
        if values.shape != (self.n_variables,):
            raise InputError(f"x has shape {values.shape}; this problem has ({self.n_variables},) unknowns")
        return self.formulation.matrices.structure(values, self.measurement)

    def keeps_constraints(self, x: Array) -> bool:
        """True where constraints hold, to round-off beside what they make over the search space."""
        constraints = self.formulation.constraints
        allowed = self.tolerance * np.where(constraints.equal, HELD / LOOSE, 1.0)
        return bool(np.all(constraints.violation(x) <= allowed))

    def rank_of(self, x: Array) -> tuple[bool, float]:
        """By which answers are compared: constraints first, then the objective."""
        objective = self.objective(x)
        return not self.keeps_constraints(x), objective if np.isfinite(objective) else np.inf

    def to_tree(self) -> dict[str, Any]:
        """That of the stated problem, with the poles that were found where the same records show them again."""
        given = all(one.records is one.given for one in self.screened.modal)
        poles = self.geometry.found if given else None
        fits = [one.record_fit and one.record_fit.to_tree() for one in self.modal]
        fields = lambda one: None if one is None else dict(vars(one))  # noqa: E731
        delays, gains = ([fields(getattr(one, name)) for one in self.modal] for name in ("delays", "calibration"))
        return {**self.stated.to_tree(), "poles": fields(poles), "fits": fits, "delays": delays, "calibrations": gains}
