"""Where an identification ended: a structure, and all that follows from it, its problem and its search."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sysid.errors import InputError
from sysid.finding import (
    KINDS,
    Finding,
    Judgement,
    Severity,
    cautions,
    contradicting,
    is_fit,
    judgement_of,
    weightiest_first,
)
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels
from sysid.modal_analysis.calibration import calibrated
from sysid.modal_analysis.delays import Clock
from sysid.modal_analysis.fit import estimate, fit_modes
from sysid.modal_analysis.law_spectra import added_by_laws
from sysid.modal_analysis.misfit import without_transients_of
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.outliers import Outlier, screened
from sysid.modal_analysis.response import weighted_error
from sysid.models.unknowns import by_name
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.problem.stated import StatedProblem
from sysid.results.facts import PartOfProblem, StoredRecords
from sysid.search.strategy import History
from sysid.structure.structure import Array, ComplexArray, Structure

if TYPE_CHECKING:
    from sysid.assessment.checks.gains import GainErrors
    from sysid.assessment.determination import Intervals
    from sysid.assessment.uncertainty import Uncertainty
    from sysid.results.facts import Facts

_QUICK_SHAPES = 1000  # entries of the mode shapes up to which uncertainty takes a second or less
_QUICK_DOFS = 20  # degrees of freedom up to which intervals take a few seconds or less
_DOFS_AT_ONCE = 6  # the same for a tenth of a second: 84 linear programmes


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """A structure identified from a base-shake test, and how far it can be trusted.

    Attributes
    ----------
    structure : Structure
    problem : Problem
    x : (n_variables,) or None
        The problem's unknowns that stand for the structure; None where the modal strategy chose other degrees of
        freedom than the sensors.
    strategy : str
    seed : int or None
    history : History
    findings : tuple of Finding
        All that checks found, the weightiest first: what speaks against the answer, what is open, what fixes it, and
        what is to be known besides. `judgement`, `success`, `determined` and all sentences follow from them.
    interrupted : bool
        The search was stopped by Ctrl-C, and this is the best until then.
    hurried : bool
        For want of time summaries leave out what is not computed yet; not stored.
    prepared : Prepared
        The problem with what its records tell of the modes; found when it is first asked for where it is not given, and
        not stored.
    """

    structure: Structure
    problem: Problem
    x: Array | None
    strategy: str
    seed: int | None
    history: History
    findings: tuple[Finding, ...]
    interrupted: bool = False
    hurried: bool = field(default=False, kw_only=True)
    prepared: Prepared = field(default=None, kw_only=True)  # type: ignore[assignment] # filled below

    def __post_init__(self) -> None:
        if isinstance(self.problem, PartOfProblem):  # as it comes of a file: `problem` then tells what is missing
            part: PartOfProblem = vars(self).pop("problem")
            vars(self).update(part.attributes, _part=part)
            del vars(self)["prepared"]
        elif self.prepared is None or self.prepared.stated is not self.problem:
            vars(self)["prepared"] = self.problem.prepared

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Tell what is missing where the problem is asked for and the file does not hold it whole."""
            if name in ("problem", "prepared") and "_part" in vars(self):
                raise InputError(
                    f"the file of this result does not hold its problem: {self.part.without}. Give it by "
                    "sysid.load(path, problem=...), or --module FILE at the command line"
                )
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)

    @property
    def part(self) -> PartOfProblem | None:
        """Content of this result's file of its problem, where it does not hold it whole; else None."""
        part: PartOfProblem | None = vars(self).get("_part")
        return part

    @property
    def judgement(self) -> Judgement:
        """Worth of the matrices, in a word.

        "determined": nothing speaks against the fit, data and stated model fix every entry of M_SS, K_SS and C, and
        noise leaves each known to a tenth of the root of its two diagonal entries (standard deviation). "one of many":
        other matrices explain the records as well, noise leaves entries open, or that was not judged. "doubtful": a
        fit, but a finding contradicts it. "no fit" without `success`.
        """
        return judgement_of(self.findings)

    @property
    def success(self) -> bool:
        """True where there is a fit, doubtful ones among them: all but "no fit".

        The last solver's status is good, and the residual meets the goal; where none is given, what is left is at most
        three times the noise of the records, and below one half of them.
        """
        return is_fit(self.findings)

    @property
    def determined(self) -> bool:
        """True where the judgement is "determined"."""
        return self.judgement == "determined"

    @property
    def contradictions(self) -> tuple[Finding, ...]:
        """Findings that speak against the answer."""
        return contradicting(self.findings)

    @property
    def open_findings(self) -> tuple[Finding, ...]:
        """Findings of what is open besides."""
        return cautions(self.findings)

    @property
    def notes(self) -> tuple[Finding, ...]:
        """Findings to be known besides, but for why the strategy was taken, and how it ended."""
        return self.of_kind(*(set(KINDS) - {"fixed", "strategy", "ending"}), severity=Severity.NOTE)

    @property
    def assumptions(self) -> tuple[Finding, ...]:
        """Assumptions that the matrices rest on and no record of this test can show to be wrong; none without a fit."""
        return self.facts.assumed if self.success else ()

    def of_kind(self, *kinds: str, severity: Severity | None = None) -> tuple[Finding, ...]:
        """Findings of these kinds, and of one severity if it is given."""
        return tuple(one for one in self.findings if one.kind in kinds and severity in (None, one.severity))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Sentences on what speaks against the answer and what leaves it open."""
        return tuple(map(str, (*self.contradictions, *self.open_findings)))

    @property
    def closed_by(self) -> tuple[str, ...]:
        """Reasons that fix the matrices, in sentences; empty where anything is open."""
        return tuple(map(str, self.of_kind("fixed")))

    @property
    def confidence(self) -> tuple[str, ...]:
        """Sentences on how far the answer can be trusted, the weightiest first.

        Delays that were taken off before all else; why there is no fit; what speaks against it, and what is open; what
        fixes the matrices where nothing is; and what else is to be known of records, bounds and sensors.
        """
        late = tuple(map(str, self.of_kind("late sensor")))
        every = (*late, *self.undetermined, *self.closed_by, *map(str, self.notes))
        return tuple(dict.fromkeys(every))

    @property
    def message(self) -> str:
        """Message of the solver and the search about how they ended."""
        return "; ".join(map(str, self.of_kind("ending")))

    def with_findings(self, findings: Iterable[Finding]) -> Self:
        """The same with further findings; what fixes the matrices is left out where they leave any open."""
        every = (*self.findings, *findings)
        if judgement_of(every) != "determined":
            every = tuple(one for one in every if one.kind != "fixed")
        return replace(self, findings=weightiest_first(every))

    @property
    def measurement(self) -> Measurement:
        """The test that was fitted; of whole records without their transients."""
        return self.modal[0].records

    @cached_property
    def modal(self) -> tuple[ModalEstimate, ...]:
        """Modal estimate of each fitted test, the problem's own first."""
        part = self.part
        if part is None:
            return self.prepared.modal
        fit, calibration = part.records.fit, part.records.calibration
        if fit is not None:
            return (estimate(fit, calibration),)
        return (fit_modes(part.records.measurement, part.records.delays, calibration),)

    @cached_property
    def fitted(self) -> ModalEstimate:
        """That of the problem's own test in squares: with Huber's loss without numbers that stand alone."""
        if self.part is None:
            return self.prepared.screened.modal[0]
        first = self.modal[0]
        return first if self.part.records.loss == "squares" else replace(first, records=screened(first.records))

    @property
    def records(self) -> StatedProblem | StoredRecords:
        """Records: the attributes of a problem that tell them, wherever they come from."""
        part = self.part
        return self.problem if part is None else part.records

    @cached_property
    def facts(self) -> Facts:
        """Facts that readers ask of the problem beside its records."""
        from sysid.results.facts import facts_of

        return facts_of(self.prepared, self.x)

    @cached_property
    def phases(self) -> list[list[str]]:
        """Table of the phases of the search: see `sysid.results.facts.rows_of_phases`."""
        from sysid.results.facts import rows_of_phases

        return rows_of_phases(self.prepared, self.history, self.structure, self.x)

    @property
    def noise(self) -> NoiseLevels | None:
        """Noise of all channels of whole records, stated or found with the fit; None for other records."""
        return self.modal[0].noise

    @cached_property
    def gains(self) -> GainErrors:
        """By how much each sensor's gain differs from the base's, as the records show it, and how exactly they do."""
        from sysid.assessment.checks.gains import gain_errors

        return gain_errors(self.fitted, self.structure)

    @property
    def gain_worth(self) -> Array:
        """By how many stated deviations an error of 1 % of each sensor's gain moves the diagonal of M_SS, (n_sensors,).

        Of the entry that moves by most of them.
        """
        from sysid.assessment.checks.gains import worth_of

        return worth_of(0.01 * self.uncertainty.mass_by_gain, self.uncertainty.mass)

    @cached_property
    def validation(self) -> tuple[Measurement, ...]:
        """The problem's validation tests without their delays; of whole records without this structure's transients.

        Without errors of gains, which are those of the sensors of the problem's own test.
        """
        gains, clocks = self.modal[0].calibration, map(Clock.of, self.records.validation)
        tests = (calibrated(clock.test, gains) for clock in clocks)
        return tuple(without_transients_of(test, self.structure) for test in tests)

    @property
    def _in_modes(self) -> bool:
        """True where the records are all that is fitted and the structure tells all of it: no expression is asked for.

        With free modes a graph of the matrices has some n³ operations, which a hundred sensors cannot wait for.
        """
        return self.x is None or (self.prepared.free_modes and not self.prepared.formulation.sources)

    @cached_property
    def residual(self) -> float:
        """``‖predicted - measured‖ / ‖measured‖`` over all tests that are fitted, unweighted.

        Of the accelerations relative to the base, over all runs, sensors and lines. Where the problem states a misfit
        of its own and no test is fitted beside it, the norm of that misfit.
        """
        if self._in_modes:
            return self.fitted.records.residual(self.structure)
        return self.prepared.residual(self._unknowns)

    @cached_property
    def residuals(self) -> tuple[float, ...]:
        """`residual` of each test that is fitted: the problem's own first, then further ones."""
        if self._in_modes:
            return (self.residual,)
        return self.prepared.formulation.residuals(self._unknowns)

    @cached_property
    def objective(self) -> float:
        """Objective at the answer: the root of the sum of squares of all that is fitted.

        Accelerations and force, each relative to its size and weighted by its stated noise, further tests and whatever
        else the problem states among its residuals.
        """
        if self._in_modes:
            return weighted_error(self.fitted.records, self.structure)
        return self.prepared.objective(self._unknowns)

    @cached_property
    def values(self) -> dict[str, Array]:
        """The problem's unknowns at the answer, by name and in their shapes, fixed ones too; empty where x is None."""
        if self.x is None:
            return {}
        fixed = {v.name: v.shaped(v.guess) for v in self.prepared.formulation.fixed}
        return by_name(self.prepared.variables, self.x) | fixed

    @property
    def _unknowns(self) -> Array:
        assert self.x is not None
        return self.x

    @cached_property
    def further_tests(self) -> tuple[tuple[Measurement, Structure], ...]:
        """Tests that were fitted beside the problem's own (`sysid.FurtherTest`), each with the structure as it was."""
        if self._in_modes:
            return ()
        terms = self.prepared.formulation.further_tests
        return tuple((term.test, term.matrices.structure(self._unknowns, term.test)) for term in terms)

    @property
    def force_residual(self) -> float | None:
        """``‖predicted - measured‖ / ‖measured‖`` over the base force; None where none was measured."""
        return self.fitted.records.force_residual(self.structure)

    def predict(self, measurement: Measurement) -> ComplexArray:
        """Relative accelerations under another test's base motion, (runs, n_sensors, n_freq).

        Modes that follow their amplitude do so from rest, which needs lines of records (`Measurement.from_time`).
        """
        return measurement.predict(self.structure) + added_by_laws(measurement, self.structure)[0]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Standard deviations and intervals that the measured noise makes; computed when first asked for.

        They hold where the fit is one: for the members that the data leave open see `mass_interval`.
        """
        from sysid.assessment.uncertainty import uncertainty

        fitted = self.prepared
        if not fitted.in_squares:
            fitted = fitted.pseudo_values(self.structure, self.x)
        known = self.gains if fitted is self.prepared and fitted.free_modes else None
        return uncertainty(fitted, self.structure, self.x, known)

    @cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """Numbers of the fitted records that are far from the fit, the farthest first.

        With ``loss="huber"`` all beyond five deviations, which count little; else those that stand alone, beside lines
        that fit: spikes and drop-outs. Each tells its `test` and `run` (from 1; test 1 is the problem's own, further
        ones follow), its `channel` (a sensor's name, or "force x"), `freq` in Hz, and `size` in deviations.
        """
        return tuple(self.prepared.outliers(self.structure, self.x))

    @property
    def covariance(self) -> Array:
        """Covariance of ``uncertainty.parameters``, (p, p)."""
        return self.uncertainty.covariance

    @property
    def mass_interval(self) -> Array:
        """Least and largest M_SS, entry by entry, over all models that explain the data and keep to what was stated.

        (2, n, n), kg; infinite where unbounded, equal where determined. Noise is not in it: see `uncertainty`.
        """
        return self._intervals.mass

    @property
    def stiffness_interval(self) -> Array:
        """The same of K_SS, (2, n, n), N/m."""
        return self._intervals.stiffness

    @cached_property
    def open_masses(self) -> tuple[int, ...]:
        """Modes, counted from 0, whose modal mass neither the records nor the stated models fix.

        None of a problem in unknowns of its own: what is open there are directions of these.
        """
        from sysid.assessment.determination import open_masses

        return tuple(open_masses(self.prepared.screened, self.structure))

    @cached_property
    def scale_is_open(self) -> bool:
        """True where the answer explains the data, and one factor common to M, K and C is all that they leave open."""
        from sysid.assessment.determination import scale_is_open

        return self.success and scale_is_open(self.prepared.screened, self.structure, self.x)

    @property
    def asks_for_others(self) -> bool:
        """True where a summary asks for other matrices that explain the data: nothing else leaves the answer open."""
        return self.judgement == "one of many" and not self.of_kind("not judged", "modes not all tried")

    @cached_property
    def is_one_of_many(self) -> bool:
        """True where other matrices explain the same data within what was stated."""
        from sysid.assessment.modal_mass_cone import applies

        if applies(self.prepared.formulation):
            return bool(self.open_masses)
        ends = self._intervals
        return not (np.all(np.isfinite(ends.mass)) and np.all(np.isfinite(ends.stiffness)))

    @cached_property
    def _intervals(self) -> Intervals:
        from sysid.assessment.determination import intervals

        return intervals(self.prepared.screened, self.structure, self.x)

    @property
    def mac(self) -> Array:
        """Modal assurance criterion against the reference where one is known, else against itself."""
        other = self.records.reference or self.structure
        return modal_assurance(self.structure.mode_shapes, other.mode_shapes)

    @property
    def identified_ratios(self) -> Array:
        """Damping ratios of the modes, (n,); NaN where nothing that is fitted tells of the damping."""
        return np.where(self.facts.tells_damping, self.structure.damping_ratios, np.nan)

    @property
    def degrees_of_freedom(self) -> tuple[str, ...]:
        """Names of the rows of M_SS, K_SS and C: a sensor's, or "coordinate of mode 7"."""
        names, structure = self.measurement.sensor_names, self.structure
        called = [f"coordinate {j + 1}" for j in range(structure.n)]
        for j in np.flatnonzero(structure.dof_modes >= 0):
            called[j] = f"coordinate of mode {structure.dof_modes[j] + 1}"
        for j in np.flatnonzero(structure.dof_sensors >= 0):
            called[j] = names[structure.dof_sensors[j]]
        return tuple(called)

    @property
    def quick_uncertainty(self) -> Uncertainty | None:
        """`uncertainty` where it is known already or takes no longer than about a second; else None."""
        known = "uncertainty" in self.__dict__
        quick = self.structure.mode_shapes.size <= _QUICK_SHAPES and not self.hurried and self.part is None
        return self.uncertainty if known or quick else None

    def quick_std(self, name: str) -> Array:
        """Standard deviations of a quantity of the structure, in its shape, by `quick_uncertainty`; NaN without it."""
        u = self.quick_uncertainty
        return np.asarray(np.full_like(getattr(self.structure, name), np.nan) if u is None else getattr(u, name))

    @property
    def quick_intervals(self) -> Intervals | None:
        """Both intervals where they are known already or take no longer than a few seconds; else None."""
        return self._intervals_up_to(_QUICK_DOFS)

    @property
    def intervals_at_once(self) -> Intervals | None:
        """Both intervals where they are known already or take no longer than a tenth of a second; else None."""
        return self._intervals_up_to(_DOFS_AT_ONCE)

    def _intervals_up_to(self, dofs: int) -> Intervals | None:
        known = "_intervals" in self.__dict__
        quick = self.structure.n <= dofs and not self.hurried and self.part is None
        return self._intervals if known or quick else None


def modal_assurance(phi: Array, other: Array) -> Array:
    """``|phi_i' phi_j|² / (phi_i' phi_i · phi_j' phi_j)``, (modes, other modes); 0 for a shape that no sensor sees."""
    if phi.shape[0] != other.shape[0]:
        raise InputError(f"mode shapes at {phi.shape[0]} and {other.shape[0]} sensors cannot be compared")
    size = np.outer(np.sum(phi**2, axis=0), np.sum(other**2, axis=0))
    return (phi.T @ other) ** 2 / np.where(size > 0, size, 1.0)
