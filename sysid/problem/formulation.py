"""The one least-squares problem: matrices, terms and constraints as functions of the vector x of all unknowns.

::

    models, arrays, expressions --> Blocks (MX)  --symbols--> unknowns, in the order of x
                                                 --Function-> matrices(x), terms, constraints(x), healing(x)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, refuse
from sysid.modal_analysis.complex_frequency import noise_level
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.models.expressions import as_matrix, variables_of, written_in
from sysid.models.model import Geometry, MatrixModel, Stated, ratios_of
from sysid.models.unknowns import Unknown, Variable, expression_of, lower_of, split, upper_of, user_site
from sysid.problem.matrices import MATRICES, Blocks, Matrices, blocks_of, symbols_in
from sysid.problem.residual_terms import ResidualTerms
from sysid.problem.terms import (
    Builder,
    ComplexResidual,
    ExpressionTerm,
    FurtherTest,
    Prior,
    Residual,
    Term,
    TermSource,
    TestTerm,
    column_of,
)
from sysid.structure.structure import Array, Structure


class Constraints(NamedTuple):
    """``lower <= function(x) <= upper``; `sources` names the constraint of each row, and its variables.

    Without constraints it has no rows.
    """

    function: ca.Function
    lower: Array
    upper: Array
    sources: tuple[str, ...]

    @property
    def equal(self) -> Array:
        """Which rows are equalities, (rows,)."""
        return self.lower == self.upper

    def at(self, x: Array) -> Array:
        """Values at `x`, (rows,)."""
        return np.asarray(self.function(x)).ravel()

    def violation(self, x: Array) -> Array:
        """By how much they leave their bounds at `x`, (rows,)."""
        values = self.at(x)
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)


class ConstraintRow(NamedTuple):
    """A constraint ``lower <= expression <= 0``, an equality where `lower` is 0, and what messages call it."""

    expression: ca.MX
    lower: float
    source: str


def constraint_row(number: int, value: Any) -> ConstraintRow:
    """The row of a constraint that was given."""
    relation = expression_of(value)
    name = f"constraint {number}"
    kinds = {ca.OP_LE: -np.inf, ca.OP_LT: -np.inf, ca.OP_EQ: 0.0}
    lower = next((low for k, low in kinds.items() if isinstance(relation, ca.MX) and relation.is_op(k)), None)
    if lower is None:
        what = type(value).__name__ if not isinstance(value, ca.MX) else f"the expression {str(value)[:60]}"
        raise InputError(
            f"{name} is {what} ({user_site()}): a constraint is a relation of variables, such as "
            f"k[0] <= k[1] or ca.sum1(m) == 9{written_in(relation) if isinstance(relation, ca.MX) else ''}"
        )
    row = column_of(name, relation.dep(0) - relation.dep(1))
    return ConstraintRow(row, lower, name + written_in(relation, ","))


class Parts(NamedTuple):
    """Where the unknowns of each matrix's model stand in x; empty for a matrix written in variables or numbers."""

    mass: slice
    stiffness: slice
    damping: slice


class Formulation:
    """Unknowns and objective of a search, of what a `Problem` states; each part is made when it is first asked for.

    `modal` are the modal estimates of the problem's own test and of further ones among the residuals, `models` those of
    mass, stiffness and damping. With `residual_modes` what modes beyond the lines add is fitted to every test.
    """

    def __init__(
        self,
        modal: Sequence[ModalEstimate],
        models: tuple[MatrixModel, MatrixModel, MatrixModel],
        geometry: Geometry,
        residuals: Sequence[Any] = (),
        constraints: Sequence[Any] = (),
        misfit: Any = None,
        healing: Mapping[Variable, Any] | None = None,
        *,
        residual_modes: bool = False,
    ) -> None:
        self.models, self.geometry, self.residual_modes = models, geometry, residual_modes
        self.sources: list[tuple[str, TermSource]] = []
        if misfit is not None:
            own = misfit if isinstance(misfit, ComplexResidual) else Residual(misfit)
            self.sources.append(("misfit", replace(own, is_misfit=True)))
        self.sources += [
            (f"residual {i}", given if isinstance(given, TermSource) else Residual(given))
            for i, given in enumerate(residuals, start=1)
        ]
        further = [source for _, source in self.sources if isinstance(source, FurtherTest)]
        self._modal, self._of_further = modal[0], dict(zip(further, modal[1:], strict=True))
        self.fits_records = misfit is None
        self._constraints, self._healing = constraints, healing or {}
        self.monitor: Callable[[int, float], object] | None = None  # of a search for poles

    def check(self) -> None:
        """Refuse what is declared wrong: a matrix, residual or constraint; the message names the variables in it."""
        _check_names([*(unknown for group in self.of_models for unknown in group), *self.variables])
        _check_healing(self.healed, self.unknowns)
        known = self.mass.weighs or self.mass.rigid_total is not None
        refuse(
            (not self.unknowns, "this problem has no unknowns: nothing is to be identified"),
            (
                not self.fits_records and any(isinstance(source, Prior) for _, source in self.sources),
                "Prior beside a misfit of your own: put it into that misfit, in the units of its rows",
            ),
            (
                self.mass.free and known and not (self.free_modes and self.damping.free),
                "known entries of a FullMass, a total_std, and a total_mass that is a matrix, go with the modal "
                "strategy only, and that with SpectralStiffness and ModalDamping alone: write them as constraints, or "
                "as Prior",
            ),
        )

    # -- what is searched --------------------------------------------------------------------------

    @cached_property
    def of_models(self) -> tuple[tuple[Unknown, ...], ...]:
        """Unknowns of the models of mass, stiffness and damping."""
        return tuple(tuple(model.unknowns(self.geometry)) for model in self.models)

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables that anything is written in, in the order of their declaration."""
        expressions = [*(s for group in self._in_matrices for s in group), *(e for g in self._in_sources for e in g)]
        return _variables([*expressions, *(row.expression for row in self._relations), *self.healed.values()])

    @cached_property
    def fixed(self) -> tuple[Variable, ...]:
        """Variables that are held at their guess."""
        return tuple(v for v in self.variables if v.fixed)

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Unknowns: x is their entries, one after the other; the models' first, then the variables."""
        return (*(u for group in self.of_models for u in group), *(v for v in self.variables if not v.fixed))

    @cached_property
    def parts(self) -> Parts:
        """Where the unknowns of each model stand in x."""
        ends = np.cumsum([0, *(sum(unknown.size for unknown in group) for group in self.of_models)]).tolist()
        return Parts(*(slice(a, b) for a, b in pairwise(ends)))

    @cached_property
    def outside(self) -> NDArray[np.bool_]:
        """Which entries of x enter no matrix of the problem, (size,): some variables of residuals and constraints."""
        apart = [isinstance(u, Variable) and not self._touches([u.symbol]) for u in self.unknowns]
        return np.repeat(apart, [u.size for u in self.unknowns])

    @property
    def size(self) -> int:
        """Number of scalar unknowns."""
        return sum(unknown.size for unknown in self.unknowns)

    @cached_property
    def lower(self) -> Array:
        """Lower bounds, (size,)."""
        return lower_of(self.unknowns)

    @cached_property
    def upper(self) -> Array:
        """Upper bounds, (size,)."""
        return upper_of(self.unknowns)

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper ends of what a swarm searches, within the bounds, (size,) each."""
        low, high = (np.concatenate([np.zeros(0), *(v.box[end] for v in self.unknowns)]) for end in (0, 1))
        return low, high

    @property
    def guess(self) -> Array:
        """Guesses, the middle of the box where none is given, (size,)."""
        return np.concatenate([np.zeros(0), *(v.guess for v in self.unknowns)])

    @property
    def labels(self) -> tuple[str, ...]:
        """A name an entry of x."""
        return tuple(label for v in self.unknowns for label in v.labels)

    # -- what is stated ----------------------------------------------------------------------------

    @cached_property
    def mass(self) -> Stated:
        """Statement about the mass."""
        return self.models[0].stated(self.geometry)

    @cached_property
    def stiffness(self) -> Stated:
        """Statement about the stiffness."""
        return self.models[1].stated(self.geometry)

    @cached_property
    def damping(self) -> Stated:
        """Statement about the damping."""
        return self.models[2].stated(self.geometry)

    @cached_property
    def by_ratios(self) -> bool:
        """True where the damping of each mode is a function of its frequency."""
        symbol = ca.SX if self.of_models[2] else ca.MX
        y, omega = symbol.sym("y", sum(v.size for v in self.of_models[2])), symbol.sym("omega", self.geometry.n)
        return self.ratios(y, omega) is not None

    def ratios(self, y: Any, omega: Any) -> Any:
        """Damping ratios of the damping model's unknowns `y` at circular frequencies; None where it has a matrix."""
        return ratios_of(self.models[2], self.geometry, y, omega)

    @property
    def test_alone(self) -> bool:
        """True where nothing but the problem's own records tells about the matrices."""
        return self.fits_records and all(self.apart) and not self._touches([r.expression for r in self._relations])

    @cached_property
    def tells_damping(self) -> bool:
        """True where anything that is fitted depends on an unknown of the damping alone; records always do."""
        if self.fits_records or self.further_tests:
            return True
        *others, alone = ({symbol.__hash__() for symbol in group} for group in self._in_matrices)
        alone = alone.difference(*others, (v.symbol.__hash__() for v in self.fixed))
        return any(symbol.__hash__() in alone for group in self._in_sources for e in group for symbol in ca.symvar(e))

    @property
    def free_modes(self) -> bool:
        """True where mode shapes and participations are free, so that modal coordinates can replace the unknowns."""
        free_ratios = self.by_ratios and bool(self.of_models[2])
        free = self.mass.free and self.stiffness.free and free_ratios
        return free and self.geometry.at_sensors and self.test_alone and not self.healed

    @property
    def refinable(self) -> bool:
        """True where the spectrum of each candidate can be replaced by the measured one."""
        return (
            self.stiffness.free
            and self.with_spectrum is not None
            and self.by_ratios
            and self.test_alone
            and not self.healed
        )

    @property
    def with_spectrum(self) -> Any:
        """Setter of a spectrum in the stiffness's unknowns, see `SpectralStiffness`; None where its model cannot."""
        return getattr(self.models[1], "with_spectrum", None)

    # -- matrices, terms, constraints --------------------------------------------------------------

    @cached_property
    def _blocks(self) -> Blocks:
        return blocks_of(self.models, self.geometry, self._of_models)

    @cached_property
    def matrices(self) -> Matrices:
        """The problem's matrices of x."""
        return self._matrices(self._blocks, self.geometry)

    @cached_property
    def own_test(self) -> TestTerm:
        """The problem's own records, fitted or not."""
        return TestTerm(self._modal, self.matrices)

    @cached_property
    def beside(self) -> tuple[Term, ...]:
        """The terms beside the problem's own records, or in their place."""
        build = Builder(
            self._function, self._matrices, lambda: self.matrices, lambda: self.noise,
            self._of_further.__getitem__, lambda test: noise_level(test, monitor=self.monitor), not self.fits_records,
            lambda: self._modal.records,
        )  # fmt: skip
        return tuple(source.term(name, build) for name, source in self.sources)

    @property
    def terms(self) -> tuple[Term, ...]:
        """All that is fitted: the problem's own test, or the misfit in its place, then what stands beside it."""
        return (self.own_test, *self.beside) if self.fits_records else self.beside

    @cached_property
    def apart(self) -> tuple[bool, ...]:
        """Which of the terms beside touch nothing that the matrices are written in."""
        return tuple(bool(group) and not self._touches(group) for group in self._in_sources)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a real number of the measurement's relative, weighted residual."""
        return noise_level(self._modal.records, monitor=self.monitor)

    @property
    def further_tests(self) -> tuple[TestTerm, ...]:
        """The tests beside the problem's own."""
        return tuple(term for term in self.beside if isinstance(term, TestTerm))

    @property
    def tests(self) -> tuple[TestTerm, ...]:
        """The tests that are fitted."""
        return (self.own_test, *self.further_tests) if self.fits_records else self.further_tests

    @property
    def priors(self) -> tuple[ExpressionTerm, ...]:
        """The terms that are values known to some accuracy."""
        return tuple(term for term in self.beside if isinstance(term, ExpressionTerm) and term.labels)

    @cached_property
    def constraints(self) -> Constraints:
        """The constraints; no rows where there are none."""
        relations = [(row, row.expression.numel()) for row in self._relations]
        return Constraints(
            self._function("constraints", [ca.vertcat(ca.MX(0, 1), *(row.expression for row, _ in relations))]),
            np.repeat([row.lower for row, _ in relations], [size for _, size in relations]),
            np.zeros(sum(size for _, size in relations)),
            tuple(row.source for row, size in relations for _ in range(size)),
        )

    @cached_property
    def healed(self) -> dict[Variable, ca.MX]:
        """Replacements of variables in the swarm."""
        return {v: as_matrix("healing", expression) for v, expression in self._healing.items()}

    @cached_property
    def healing(self) -> ca.Function:
        """Function that x of the swarm's candidates passes through; the identity where nothing is healed."""
        columns = [self.healed.get(u, s) if isinstance(u, Variable) else s for u, s in self._symbols]
        return self._function("healing", [ca.veccat(*columns)])

    @cached_property
    def members(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Which unknowns enter each matrix, and residuals, misfit and constraints where there are any."""
        groups = zip(self._of_models, self._in_matrices, strict=True)
        of = {name: [*modelled, *written] for name, (modelled, written) in zip(MATRICES, groups, strict=True)}
        for (name, source), expressions in zip(self.sources, self._in_sources, strict=True):
            kind = "misfit" if name == "misfit" else getattr(source, "kind", "residuals")
            of.setdefault(kind, []).extend(expressions)
        of["constraints"] = [row.expression for row in self._relations]
        inside = [(kind, {s.__hash__() for e in part for s in ca.symvar(e)}) for kind, part in of.items()]
        found = [(kind, tuple(u.name for u, s in self._symbols if s.__hash__() in there)) for kind, there in inside]
        return tuple((kind, names) for kind, names in found if names)

    @property
    def declarations(self) -> dict[str, str]:
        """For each matrix the variables that it is written in, for messages."""
        groups = zip(MATRICES, self._in_matrices, strict=True)
        return {name: written_in(ca.veccat(ca.MX(0, 1), *symbols)) for name, symbols in groups}

    # -- at one point ------------------------------------------------------------------------------

    def objective(self, x: Array) -> float:
        """Root of the sum of squares of all rows of all terms: what is minimised. NaN where x is no structure."""
        return float(np.linalg.norm([term.error(x) for term in self.terms]))

    def residuals(self, x: Array) -> tuple[float, ...]:
        """``‖predicted - measured‖ / ‖measured‖`` of each fitted test: relative accelerations, unweighted."""
        return tuple(left / size for left, size in (term.relative(x) for term in self.tests))

    def residual(self, x: Array) -> float:
        """The same over all fitted tests; where the user's own misfit alone is fitted, its norm."""
        if not self.tests:
            return self.terms[0].error(x)
        left, size = np.linalg.norm([term.relative(x) for term in self.tests], axis=0)
        return float(left / size)

    def from_sampling(self, s: ca.SX | ca.MX) -> ca.SX | ca.MX:
        """Unknowns of the swarm's coordinates, which have the same box (eq. 18)."""
        pieces = zip(self.unknowns, split(self.unknowns, s), strict=True)
        return ca.vertcat(*(unknown.sampled()(piece) for unknown, piece in pieces))

    def to_sampling(self, x: Array) -> Array:
        """Swarm coordinates of the unknowns `x`, clipped to the box."""
        pieces = zip(self.unknowns, split(self.unknowns, np.clip(x, *self.box)), strict=True)
        return np.clip(np.concatenate([v.unsampling(piece) for v, piece in pieces]), *self.box)

    def values(self, structure: Structure) -> Array:
        """Unknowns that stand for a structure; variables that enter no matrix at their guess.

        Refused where a matrix is written in expressions, or a model has no inverse.
        """
        found = [model.values(self.geometry, structure) for model in self.models]
        return np.concatenate([*found, self.guess[self.parts.damping.stop :]])

    # -- how it is put together --------------------------------------------------------------------

    @cached_property
    def _in_matrices(self) -> list[list[ca.MX]]:
        """Symbols of the variables that mass, stiffness and damping are written in; models have their unknowns."""
        return symbols_in(self.models, self.of_models, self.geometry)

    @cached_property
    def _in_sources(self) -> list[tuple[ca.MX, ...]]:
        return [tuple(source.expressions(name)) for name, source in self.sources]

    @cached_property
    def _relations(self) -> list[ConstraintRow]:
        return [constraint_row(i, constraint) for i, constraint in enumerate(self._constraints, start=1)]

    @cached_property
    def _of_models(self) -> list[list[ca.MX]]:
        """Symbols of the models' unknowns."""
        return [[ca.MX.sym(unknown.name, unknown.size) for unknown in group] for group in self.of_models]

    @property
    def _symbols(self) -> list[tuple[Unknown, ca.MX]]:
        """The unknowns with their symbols."""
        symbols = [symbol for group in self._of_models for symbol in group]
        symbols += [v.symbol for v in self.variables if not v.fixed]
        return list(zip(self.unknowns, symbols, strict=True))

    def _touches(self, expressions: Sequence[ca.MX]) -> bool:
        symbols = {symbol.__hash__() for group in self._in_matrices for symbol in group}
        return any(symbol.__hash__() in symbols for e in expressions for symbol in ca.symvar(e))

    def _matrices(self, blocks: Blocks, geometry: Geometry) -> Matrices:
        functions = self._function("matrices", blocks.outputs), self._function("ratios", [blocks.ratios], blocks.omega)
        whole = self._function("whole_factor", [blocks.whole_factor])
        # Where modes are free, and nothing is asked for, a search that is made for their frequencies finds those above.
        asked, found = self.residual_modes, getattr(self.models[1], "natural_frequencies", None) is None
        beyond = ResidualTerms.of_geometry(geometry, free=self.free_modes, asked=asked, found=found)
        return Matrices(*functions, geometry.rigid_body, geometry.recovery, whole, blocks.mass.mass is None, beyond)

    def _function(self, name: str, expressions: Sequence[ca.MX], *further: ca.MX) -> ca.Function:
        """Expressions of the unknowns as a function of the vector x; fixed variables are numbers in it."""
        symbols = [symbol for _, symbol in self._symbols]
        inner = ca.Function(name, [*symbols, *further, *(v.symbol for v in self.fixed)], list(expressions))
        x = ca.MX.sym("x", self.size)
        pieces = [ca.reshape(piece, *s.shape) for piece, s in zip(split(self.unknowns, x), symbols, strict=True)]
        constants = [ca.reshape(ca.MX(ca.DM(v.guess)), *v.symbol.shape) for v in self.fixed]
        return ca.Function(name, [x, *further], inner.call([*pieces, *further, *constants], True, False))


def _variables(expressions: Sequence[ca.MX]) -> tuple[Variable, ...]:
    """The variables of expressions, in the order of their declaration; refused where a symbol is none."""
    found = {variable for e in expressions for variable in variables_of("healing", ca.symvar(e))}
    return tuple(sorted(found, key=lambda variable: variable.order))


def _check_names(unknowns: Sequence[Unknown]) -> None:
    first: dict[str, Unknown] = {}
    for unknown in unknowns:
        same = first.setdefault(unknown.name, unknown)
        if same is not unknown:
            there, here = (getattr(u, "declared", "of a matrix model") for u in (same, unknown))
            raise InputError(f"two unknowns are called {unknown.name!r} ({there}; {here}): rename one of them")


def _check_healing(healed: Mapping[Variable, ca.MX], free: Sequence[Unknown]) -> None:
    for variable, expression in healed.items():
        refuse(
            (not any(variable is v for v in free), f"healing: {variable!r} is no unknown of this problem"),
            (
                expression.shape != variable.symbol.shape,
                f"healing of {variable.name!r} ({variable.declared}) has the shape {expression.shape}; that of the "
                f"variable is {variable.symbol.shape}",
            ),
        )
