"""An identification problem: a measurement, its matrices as models, numbers or expressions, and the search space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, choice, instance, number, refuse
from sysid.files.tree import check
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.outliers import Outlier, outliers, predicted, pseudo_values, screened
from sysid.modal_analysis.vector_fitting import Poles
from sysid.modal_analysis.whole_records import without_transients
from sysid.models.damping import ModalDamping
from sysid.models.geometry import Geometry
from sysid.models.model import MatrixModel
from sysid.models.stiffness import SpectralStiffness
from sysid.models.unknowns import Unknown, Variable, user_site
from sysid.problem import stored
from sysid.problem.feasibility import HELD, LOOSE, check_constraints, check_matrices, points_of, scale_of  # fmt: skip
from sysid.problem.formulation import Formulation
from sysid.problem.given import MATRICES, as_models, geometry_of, rough_mass
from sysid.problem.terms import FurtherTest
from sysid.structure.structure import Array, Structure


@dataclass(frozen=True, eq=False, repr=False)
class Problem:
    """What to identify, and from what.

    The constructor checks types, shapes and what is written. Poles, weights and feasibility are found when they are
    first asked for, once; `check` refuses what cannot be searched.

    Parameters
    ----------
    measurement : Measurement
    mass : FullMass, LumpedMass, KnownMass, MatrixModel, array_like or expression
        An array is a known mass matrix. An expression is written in `Variable` s, (n, n) or with the base's rows last
        (n + d, n + d).
    stiffness : SpectralStiffness, ChainStiffness, MatrixModel, array_like or expression
        A matrix is (n, n) or (n + d, n + d).
    damping : ModalDamping, ProportionalDamping, MatrixModel, array_like or expression
        (n, n) is C on the motion relative to the base; (n,) is one damping ratio a mode, in ascending frequency.
    residuals : sequence of FurtherTest, Prior or expressions
        Minimised in the least-squares sense beside the misfit of the measurement, whose norm is 1 where nothing is
        explained: a further test (`sysid.FurtherTest`), or what is known to some accuracy (`sysid.Prior`). The rows of
        an expression count like one number of the test each, as exact as its noise.
    constraints : sequence of relations
        Such as ``k[0] <= k[1]`` or ``ca.sum1(m) == 900``. IPOPT holds them exactly; in the swarm a candidate that
        breaks them less is better, whatever its residual, and any that keeps them is better than these.
    misfit : expression, optional
        What is minimised in the place of the misfit of the measurement: a column of relative residuals.
    recovery : array_like (n_sensors, n), optional
        Takes n degrees of freedom to the sensors, where they are not one and the same.
    rigid_body_dofs : array_like (n, d), optional
        Motion of the degrees of freedom with a rigid base; needed beside `recovery` where the stiffness has no base
        columns to tell it.
    healing : mapping of Variable to expression
        What each candidate of the swarm passes through: the way to meet an equality before IPOPT does, such as
        ``{m: 900 * m / ca.sum1(m)}``.
    reference : Structure, optional
        The truth, where it is known: for scores and pictures only.
    validation : sequence of Measurement
        Tests that are predicted and never fitted.
    goal : float, optional
        `residual` at which the identification counts as a success; by default what is left must be within the noise.
    loss : {"squares", "huber"}
        "huber" makes numbers of the records count little that are far from the fit: for spikes and drop-outs at some
        lines of some channels, which `Identification.outliers` then lists. What else is fitted counts by its squares.
        A mode must show at more than one line. `objective` and `residual` are of the records as `screened`.

    Attributes
    ----------
    variables : tuple of Unknown
        Of the models of mass, stiffness and damping, in this order (eq. 34), then `Variable` s as declared.
    lower, upper : (n_variables,)
        The search space, in the variables' own units.
    totals : (d,)
        Total mass in each base direction: stated, else weighed by the base force, else 1 kg; of a problem written in
        expressions what moves with the base at the guess.
    geometry : Geometry
        Geometry of the test, as the matrix models see it.
    tolerance : (rows,)
        By how much a candidate of the swarm may break each row of the constraints.
    poles : Poles or None
        What was found in the data where a spectral stiffness came without natural frequencies.
    site : str
        File and line where the problem was put together, for messages.
    """

    measurement: Measurement
    mass: Any = field(kw_only=True)
    stiffness: Any = field(default_factory=SpectralStiffness, kw_only=True)
    damping: Any = field(default_factory=ModalDamping, kw_only=True)
    residuals: Sequence[Any] = field(default=(), kw_only=True)
    constraints: Sequence[Any] = field(default=(), kw_only=True)
    misfit: Any = field(default=None, kw_only=True)
    recovery: ArrayLike | None = field(default=None, kw_only=True)
    rigid_body_dofs: ArrayLike | None = field(default=None, kw_only=True)
    healing: Mapping[Variable, Any] = field(default_factory=dict, kw_only=True)
    reference: Structure | None = field(default=None, kw_only=True)
    validation: Sequence[Measurement] = field(default=(), kw_only=True)
    goal: float | None = field(default=None, kw_only=True)
    loss: Literal["squares", "huber"] = field(default="squares", kw_only=True)
    site: str = field(init=False, default="?")

    def __post_init__(self) -> None:
        instance("Problem: measurement", self.measurement, Measurement)
        if self.reference is not None:
            instance("Problem: reference", self.reference, Structure)
        if self.goal is not None:
            number("Problem: goal", self.goal, "a positive relative residual", above=0)
        choice("Problem: loss", self.loss, ("squares", "huber"))
        if self.loss == "huber" and self.misfit is not None:
            raise InputError("Problem: loss='huber' is of records, and this problem fits a misfit of its own instead")
        if not isinstance(self.healing, Mapping) or not all(isinstance(v, Variable) for v in self.healing):
            raise InputError("Problem: healing is a dictionary from variables to expressions: {m: 9 * m / ca.sum1(m)}")
        for name, model in zip(MATRICES, as_models(self.mass, self.stiffness, self.damping), strict=True):
            object.__setattr__(self, name, model)
        for name in ("residuals", "constraints", "validation"):
            given = getattr(self, name)
            if not isinstance(given, list | tuple):
                kind = "MX" if isinstance(given, ca.MX) else type(given).__name__
                raise InputError(f"Problem: {name} is a {kind}; give a list of them: {name}=[...]")
            object.__setattr__(self, name, tuple(given))
        for at, test in enumerate(self.validation):
            instance(f"Problem: validation[{at}]", test, Measurement)
        object.__setattr__(self, "site", user_site())
        self._check_records()
        self._check_declarations()

    def _check_records(self) -> None:
        """Refuse records from which nothing can be identified, and tests and structures of other sensors."""
        test = self.measurement
        dead = [] if test.force is None else np.flatnonzero(~np.any(test.force, axis=(0, 2))).tolist()
        axes = test.base_axes or [f"direction {i + 1}" for i in range(test.n_base)]
        others, shape = [other.rigid_body.shape for other in self.validation], test.rigid_body.shape
        refuse(
            (
                dead,
                f"the base force is zero in {', '.join(axes[i] for i in dead)}: is a load cell dead? Leave the force "
                "or that axis out",
            ),
            (
                np.linalg.norm(test.relative) <= 1e-12 * np.linalg.norm(test.response),
                "no sensor moves relative to the base: there is nothing to identify from",
            ),
            (
                any(other != shape for other in others),
                "a validation measurement has other sensors or base directions than the one fitted",
            ),
            (
                self.reference is not None and self.reference.rigid_body.shape != shape,
                "the reference structure has other sensors or base directions than the measurement",
            ),
        )

    def _check_declarations(self) -> None:
        """Refuse models that do not fit the test, and what is written wrong; nothing is searched for it."""
        declared = self.formulate(self.unsearched)
        for model in declared.models:
            model.stated(declared.geometry)
        declared.check()

    def to_tree(self) -> dict[str, Any]:
        """Give all as dictionaries, lists, arrays and texts, but expressions that `sysid.problem.stored` cannot."""
        return {
            "measurement": self.measurement.to_tree(),
            "given": self._given,
            "poles": None if self._changed else self._geometry.found,  # those of what is screened
            "reference": None if self.reference is None else self.reference.to_tree(),
            "validation": [test.to_tree() for test in self.validation],
            "goal": self.goal,
            "loss": self.loss,
        }

    @cached_property
    def _given(self) -> dict[str, Any]:
        """Models, numbers and expressions as a tree, for which expressions are compared with what is read again."""
        return stored.to_tree(vars(self))

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Problem:
        """Make the problem of a tree that `to_tree` made: the same models, expressions, bounds and guesses.

        Models and matrices, expressions and their variables go through the constructor, as when they are written.

        Raises
        ------
        InputError
            Where the tree is damaged; NotRebuiltError where it lacks expressions, or the class of a model is not found.
        """
        problem = cls(
            Measurement.from_tree(tree["measurement"]),
            **stored.from_tree(tree["given"]),
            reference=None if tree["reference"] is None else Structure.from_tree(tree["reference"]),
            validation=[Measurement.from_tree(test) for test in tree["validation"]],
            goal=tree["goal"],
            loss=tree["loss"],
        )
        if tree["poles"] is not None:
            problem.geometry.found = tree["poles"]
        return problem

    @cached_property
    def at_rest(self) -> Problem:
        """The problem with the transients of whole records taken off; itself where no record is whole."""
        return self._at_rest(None)

    def _at_rest(self, monitor: Callable[[int, float], object] | None) -> Problem:
        if not self._in_motion:
            return self
        return self._with_tests(lambda test: without_transients(test, monitor=monitor), self.loss)

    @property
    def _in_motion(self) -> bool:
        """Whether any test that is fitted is of whole records."""
        tests = [self.measurement, *(r.measurement for r in self.residuals if isinstance(r, FurtherTest))]
        return any(test.whole is not None for test in tests)

    @property
    def _changed(self) -> bool:
        """Whether other records are fitted than were given: `screened` is not the problem itself."""
        return self._in_motion or self.loss != "squares"

    @cached_property
    def screened(self) -> Problem:
        """The problem in squares, its records without transients and, but with squares, numbers that stand alone."""
        return self.at_rest if self.loss == "squares" else self.at_rest._with_tests(screened)

    def fits(self, structure: Structure, x: Array | None) -> list[tuple[Measurement, Structure]]:
        """Each test that is fitted, as it was given, and what the structure was in it at an answer."""
        problem = self.at_rest
        own = [(problem.measurement, structure)] if self.formulation.fits_records else []
        further = [r.measurement for r in problem.residuals if isinstance(r, FurtherTest) and x is not None]
        terms = zip(further, self.formulation.further_tests, strict=False)
        return own + [(test, term.matrices.structure(x, test)) for test, term in terms if x is not None]

    @property
    def first_test(self) -> int:
        """Number of the first fitted test: 1 is the problem's own, 2 a further one beside a misfit of one's own."""
        return 1 if self.formulation.fits_records else 2

    def outliers(self, structure: Structure, x: Array | None) -> list[Outlier]:
        """Numbers of the fitted records that are far from an answer: see `Identification.outliers`."""
        alone, fits = self.loss != "huber", enumerate(self.fits(structure, x), start=self.first_test)
        found = [outliers(test, its, self.n_variables, alone=alone, number=i) for i, (test, its) in fits]
        return sorted((one for of_test in found for one in of_test), key=lambda one: -one.size)

    def pseudo_values(self, structure: Structure, x: Array | None) -> Problem:
        """The problem in squares, with pseudo-values about an answer in the place of its records.

        See `sysid.modal_analysis.outliers`; poles that were found stay.
        """
        fits = [(test, predicted(test, its)) for test, its in self.fits(structure, x)]
        made = iter(pseudo_values(fits, self.n_variables))
        other = self._with_tests(lambda test: next(made))  # whole records too: what they tell of the modes is gone
        other.geometry.found = self.geometry.found
        return other

    def _with_tests(
        self, change: Callable[[Measurement], Measurement], loss: Literal["squares", "huber"] = "squares"
    ) -> Problem:
        """The same, in squares unless stated, with other records of all tests that are fitted."""
        own = change(self.measurement)
        residuals = [
            replace(given, measurement=change(given.measurement)) if isinstance(given, FurtherTest) else given
            for given in self.residuals
        ]
        return replace(self, measurement=own, residuals=residuals, loss=loss)

    @property
    def geometry(self) -> Geometry:
        """The geometry of the degrees of freedom."""
        return self.screened._geometry

    @cached_property
    def _geometry(self) -> Geometry:
        """That of the records as they are given."""
        weighed = None if self.measurement.force is None else self._weigh
        return geometry_of(self.measurement, self.stiffness, self.recovery, self.rigid_body_dofs, weighed)

    @property
    def unsearched(self) -> Geometry:
        """The geometry with made-up poles and weights, for what is asked before the records are searched."""
        return self._geometry.unsearched()

    @cached_property
    def formulation(self) -> Formulation:
        """Matrices, terms and constraints as CasADi functions of the unknowns."""
        return self.formulate(self.geometry) if self.screened is self else self.screened.formulation

    @property
    def models(self) -> tuple[MatrixModel, MatrixModel, MatrixModel]:
        """Of mass, stiffness and damping."""
        return self.mass, self.stiffness, self.damping

    def formulate(self, geometry: Geometry) -> Formulation:
        """The same with another geometry."""
        return Formulation(
            self.measurement, self.models, geometry, self.residuals, self.constraints, self.misfit, self.healing
        )

    def prepare(self, monitor: Callable[[int, float], object] | None = None) -> None:
        """Find what the records tell before any fit, once: poles, weights, levels of noise.

        Parameters
        ----------
        monitor : callable, optional
            Called with (iteration, relative residual) while poles are looked for; what it raises passes through.
        """
        if "at_rest" not in vars(self):
            vars(self)["at_rest"] = self._at_rest(monitor)
        if self.loss == "huber" and "screened" not in vars(self):
            vars(self)["screened"] = self.at_rest._with_tests(lambda test: screened(test, monitor=monitor))
        geometry, formulation = self.geometry, self.formulation
        geometry.monitor = formulation.monitor = monitor
        try:
            _ = formulation.unknowns
            if not formulation.free_modes:
                _ = formulation.terms
        finally:
            geometry.monitor = formulation.monitor = None

    def check(self) -> None:
        """Refuse what cannot be searched, before any search.

        Raises
        ------
        InputError
            Where no point of the search space makes a structure, no point keeps the constraints, or a model cannot be
            stored.
        """
        formulation = self.formulation
        if not formulation.variables and formulation.free_modes:
            return
        points = points_of(formulation)
        if not formulation.free_modes:  # with them every point makes a structure
            check_matrices(formulation, points, self.measurement, self.site)
        check(self._given)  # before a search what could not be stored at its end
        check_constraints(formulation, points, self.site)

    @cached_property
    def tolerance(self) -> Array:
        """By how much a candidate of the swarm may break each row of the constraints, (rows,)."""
        formulation = self.formulation
        if not formulation.constraints.lower.size:
            return np.zeros(0)
        scale = scale_of(formulation, points_of(formulation))
        return scale * np.where(formulation.constraints.equal, LOOSE, HELD)

    def __repr__(self) -> str:
        models = ", ".join(type(model).__name__ for model in self.models)
        return f"<Problem: {models}; {self.measurement!r}>"

    @property
    def variables(self) -> tuple[Unknown, ...]:
        """All that is searched."""
        return self.formulation.unknowns

    @property
    def poles(self) -> Poles | None:
        """Poles found in the data, where the stiffness is free and states no frequencies."""
        stated = self.formulation.stiffness
        return self.geometry.poles if stated.spectrum is not None and not self.states_frequencies else None

    @property
    def states_frequencies(self) -> bool:
        """Whether the stiffness states natural frequencies of its own, so that none are looked for."""
        return getattr(self.stiffness, "natural_frequencies", None) is not None

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

    @property
    def unknowns(self) -> tuple[tuple[str, int], ...]:
        """Number of unknowns a matrix: the paper's Table 1, with the n·d entries of M_S0 that it leaves out.

        Models count their own, a written matrix all variables that enter it.
        """
        sizes = {v.name: v.size for v in self.variables}
        entering = {name: sum(sizes[v] for v in names) for name, names in self.formulation.members}
        return tuple((dict.fromkeys(MATRICES, 0) | entering).items())

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
        """Whether no number with a unit of mass is given, so that masses are normalised to 1 kg a direction."""
        told = self.measurement.force is not None or np.nansum(np.abs(self.known_mass)) > 0
        return self._leaves_total and not told

    @property
    def _leaves_total(self) -> bool:
        """Whether the mass model could state a total, and does not: any other mass has the size that it is given."""
        return getattr(self.mass, "total_mass", np.nan) is None

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

    @property
    def free_modes(self) -> bool:
        """Whether mode shapes and participations are free: see `Formulation`."""
        return self.formulation.free_modes

    def structure(self, x: ArrayLike) -> Structure:
        """The structure that the unknowns `x`, (n_variables,) in the variables' own units, stand for."""
        values = np.asarray(x, dtype=float)
        if values.shape != (self.n_variables,):
            raise InputError(f"x has shape {values.shape}; this problem has ({self.n_variables},) unknowns")
        return self.formulation.matrices.structure(values, self.measurement)

    def values(self, structure: Structure) -> Array:
        """Unknowns that stand for `structure`, (n_variables,); inverse of `structure` where the models can hold it."""
        return self.formulation.values(structure)

    def residual(self, x: Array) -> float:
        """``‖predicted - measured‖ / ‖measured‖`` over all fitted tests: see `Formulation.residual`."""
        return self.formulation.residual(x)

    def objective(self, x: Array) -> float:
        """What is minimised, at `x`: see `Formulation.objective`."""
        return self.formulation.objective(x)

    def keeps_constraints(self, x: Array) -> bool:
        """Whether constraints hold, to round-off beside what they make over the search space."""
        constraints = self.formulation.constraints
        allowed = self.tolerance * np.where(constraints.equal, HELD / LOOSE, 1.0)
        return bool(np.all(constraints.violation(x) <= allowed))

    def rank_of(self, x: Array) -> tuple[bool, float]:
        """By which answers are compared: constraints first, then the objective."""
        objective = self.objective(x)
        return not self.keeps_constraints(x), objective if np.isfinite(objective) else np.inf

    def _weigh(self) -> Array:
        """Rough rigid-body mass of each base direction from the base force, (d,): it only places the search."""
        stated = self.stiffness.stated(self.geometry).spectrum if self.states_frequencies else None
        return rough_mass(self.measurement, self.geometry, stated)
