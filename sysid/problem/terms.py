"""The terms of the least-squares problem: what is fitted, and how each term weighs.

The objective is the sum of squares of all rows of all terms. A term of a new kind is one class with the methods of
`Term`, and what a user gives for it, among the `residuals` of a problem, one with those of `TermSource`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from sysid.errors import InputError, finite_array, flag, instance, refuse
from sysid.finding import Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate, misfit_rows
from sysid.modal_analysis.response import residual, weights_of_test
from sysid.models.complex_expressions import ComplexExpression
from sysid.models.expressions import as_matrix, at_point, check_finite, written_in
from sysid.models.model import Geometry
from sysid.models.unknowns import Expression, user_site, variable_of
from sysid.problem.batch import TestObjective
from sysid.problem.direct_response import (
    Rows,
    Slopes,
    absolute_response,
    relative_misfit,
    relative_response,
    rows_of_test,
    slopes_of,
    stacked_rows,
)
from sysid.problem.matrices import MATRICES, Blocks, Matrices, as_models, blocks_of, geometry_of
from sysid.structure.structure import Array
from sysid.structure.thresholds import most_deviations


class ModeSymbols(NamedTuple):
    """Modes as unknowns of their own: mass-normalised shapes (n, n) at the degrees of freedom, and w (n,), rad/s."""

    shapes: ca.MX
    omega: ca.MX


class Term(Protocol):
    """Something that is fitted."""

    @property
    def name(self) -> str:
        """Name in messages."""

    def rows(self, x: ca.MX, modes: ModeSymbols | None = None) -> ca.MX:
        """Weighted residuals, a column; `modes` are those of the problem's own matrices where they are unknowns too."""

    def error(self, x: Array) -> float:
        """Root of the sum of squares of the rows at x; NaN where x is no structure."""

    def squared(self, particles: Array) -> Array:
        """Sum of squares of the rows for many x at once, (count, size) to (count,); NaN where x is no structure."""

    def linearised(self, x: Array, noise: float, *, as_stated: bool = False) -> Rows:
        """Rows, Jacobian and standard deviations at x; `noise` is that of the first term's rows.

        Noise of records that is larger than stated counts as the misfit shows it, unless `as_stated`.
        """

    def findings(self, x: Array) -> Sequence[Finding]:
        """Findings against the fit at x."""


@dataclass(frozen=True, eq=False)
class TestTerm:
    """The records of a test, each weighed by its noise.

    The weight of a record's channel and line is the inverse of its stated standard deviation, in each run as a product
    of one factor a channel and one a line (`products`): a diagonal weight matrix a line. `matrices` are those of
    the structure as it was in this test; `weight` is that of the whole test, so that all tests count by their noise;
    `shift`, 1/s, that of the complex frequencies s = shift + i w at which the records are given.
    """

    __test__ = False  # pytest takes names in Test for its own

    modal: ModalEstimate
    matrices: Matrices
    weight: float = 1.0
    shift: float = 0.0
    name: str = "the test"

    @property
    def test(self) -> Measurement:
        """The records that are fitted."""
        return self.modal.records

    def rows(self, x: ca.MX, modes: ModeSymbols | None = None) -> ca.MX:
        """Relative residuals of accelerations and, where measured, of the force; modes are read with ratios only."""
        return self.weight * self.matrices.beyond.of(self.test, self.shift).without_in(self._rows(x, modes))

    def _rows(self, x: ca.MX, modes: ModeSymbols | None) -> ca.MX:
        """The same before the weight of the test, of the model's own modes alone."""
        motion = self.matrices.motion(x)
        if not self.matrices.by_ratios:
            return relative_misfit(self.test, motion, weighted=True, shift=self.shift)
        assert modes is not None
        phi, omega = modes
        ratios = self.matrices.ratio_function(x, omega)
        shapes = ca.DM(motion.recovery) @ phi
        modes_here = shapes, phi.T @ motion.push, omega, ratios, motion.rigid_body_mass
        if self.estimate.by_modes and self.estimate.omega.size == omega.numel():
            size, weighed = weights_of_test(self.test, weighted=True)[0][1], self.test.force is not None
            return misfit_rows(self.estimate, *modes_here, weighed=weighed) / size
        return residual(self.test, *modes_here, weighted=True, shift=self.shift)

    @cached_property
    def estimate(self) -> ModalEstimate:
        """The estimate of its modes; of lines alone where modes beyond them are fitted, which are not told there."""
        lines = replace(ModalEstimate.of_lines(self.test), calibration=self.modal.calibration)
        return lines if self.matrices.beyond.omega.size else self.modal

    @cached_property
    def batch(self) -> TestObjective:
        """The compiled objective of many candidates."""
        return TestObjective(self.test, self.matrices, self.shift)

    def squared(self, particles: Array, spectrum: Array | None = None) -> Array:
        """As in `Term`; where a `spectrum`, rad/s, is given it takes the place of each candidate's own."""
        return self.weight**2 * self.batch.squared(particles, spectrum)

    def error(self, x: Array) -> float:
        """Root of the sum of squares of the rows at `x`; NaN where modes are needed and `x` is no structure."""
        if not self.matrices.by_ratios:
            return float(self._norm(x))
        try:
            s = self.matrices.own_structure(x, self.test)
        except InputError:
            return float("nan")
        return float(self._norm(x, s.normal_modes, 2 * np.pi * s.natural_frequencies))

    @cached_property
    def _norm(self) -> ca.Function:
        """Norm of the rows at x, and at the modes where damping is by ratios."""
        x, n = ca.MX.sym("x", self.matrices.function.numel_in(0)), len(self.matrices.rigid_body)
        if not self.matrices.by_ratios:
            return ca.Function("norm", [x], [ca.norm_2(self.rows(x))])
        modes = ModeSymbols(ca.MX.sym("shapes", n, n), ca.MX.sym("omega", n))
        return ca.Function("norm", [x, *modes], [ca.norm_2(self.rows(x, modes))])

    def relative(self, x: Array) -> tuple[float, float]:
        """Norms of ``predicted - measured`` and of ``measured``: relative accelerations, unweighted."""
        size = float(np.linalg.norm(self.test.relative))
        return self.test.residual(self.matrices.structure(x, self.test)) * size, size

    def linearised(
        self, x: Array, noise: float = np.nan, slopes: Slopes | None = None, *, as_stated: bool = False
    ) -> Rows:
        """As in `Term`; `slopes` are those at x where they are known."""
        slopes = slopes or slopes_of(self.matrices, x, self.test)
        return stacked_rows(self.rows_of(slopes, x.size, as_stated=as_stated))

    def rows_of(self, slopes: Slopes, unknowns: int, *, as_stated: bool = False) -> list[Rows]:
        """Rows of each record, see `rows_of_test`."""
        beyond = self.matrices.beyond.of(self.test)
        return rows_of_test(self.estimate, slopes, unknowns, beyond, share=self.weight, as_stated=as_stated)

    def findings(self, x: Array) -> Sequence[Finding]:
        """None of its own: records are checked in `sysid.assessment.checks`."""
        return ()


@dataclass(frozen=True, eq=False)
class ExpressionTerm:
    """A column of expressions, `function` of x.

    `std` is the standard deviation of each row before it is weighed, None where it is not stated: then a row is as
    exact as a number of the records where `like_records`, else what the column leaves is its noise. `labels` are what
    each row is called where rows are values known to some accuracy, less these, in standard deviations.
    """

    name: str
    function: ca.Function
    weight: float = 1.0
    std: float | None = None
    like_records: bool = True
    labels: tuple[str, ...] = ()

    def rows(self, x: ca.MX, modes: ModeSymbols | None = None) -> ca.MX:
        """The weighted column."""
        return self.weight * self.function(x)

    def numbers(self, x: Array) -> Array:
        """The column at `x`, not weighed."""
        return np.asarray(self.function(x)).ravel()

    def error(self, x: Array) -> float:
        """Root of the sum of squares of the rows at `x`."""
        return self.weight * float(np.linalg.norm(self.numbers(x)))

    def squared(self, particles: Array) -> Array:
        """As in `Term`."""
        rows = np.asarray(ca.densify(self.function(particles.T)))  # a column each
        return np.sum((self.weight * rows) ** 2, axis=0)

    def linearised(self, x: Array, noise: float, *, as_stated: bool = False) -> Rows:
        """As in `Term`."""
        symbol = ca.MX.sym("x", x.size)
        column = self.function(symbol)
        function = ca.Function("rows", [symbol], [ca.densify(column), ca.densify(ca.jacobian(column, symbol))])
        left, slope = (np.asarray(part) for part in function(x))
        left = left.ravel()
        std = noise / self.weight if self.std is None else self.std
        if self.std is None and not self.like_records:
            std = max(float(np.linalg.norm(left)) / np.sqrt(max(left.size - x.size, 1)), 1e-15)
        return Rows(self.weight * left, self.weight * slope, np.full(left.size, self.weight * std))

    def findings(self, x: Array) -> Sequence[Finding]:
        """Values known to some accuracy from which the fit is far."""
        return [
            Finding(
                "stated value",
                Severity.CONTRADICTS,
                f"{name} ends {abs(off):.3g} of the stated standard deviations from the value that is stated as known",
                "that value, its deviation, or the model is wrong",
                numbers={name: float(off)},
            )
            for name, off in zip(self.labels, self.numbers(x) if self.labels else (), strict=True)
            if abs(off) > most_deviations(len(self.labels))
        ]


class Builder(NamedTuple):
    """Builder of terms from what a user gives.

    ``function(name, expressions)`` is a CasADi function of x; ``matrices(blocks, geometry)`` are matrices of x;
    ``problem_matrices()`` are the problem's; ``noise()`` is the standard deviation of a number of the measurement's
    relative residual, ``noise_of(test)`` of a further test's; ``modal_of(given)`` is the modal estimate of a further
    test; ``replaced`` tells whether a misfit stands in the place of the measurement's; ``records()`` are the problem's
    own.
    """

    function: Callable[[str, Sequence[ca.MX]], ca.Function]
    matrices: Callable[[Blocks, Geometry], Matrices]
    problem_matrices: Callable[[], Matrices]
    noise: Callable[[], float]
    modal_of: Callable[[FurtherTest], ModalEstimate]
    noise_of: Callable[[Measurement], float]
    replaced: bool
    records: Callable[[], Measurement]


@runtime_checkable
class TermSource(Protocol):
    """Source of a term, which a user gives among the `residuals` of a problem."""

    def expressions(self, name: str) -> Sequence[ca.MX]:
        """Expressions of the term; none where it is about the problem's own matrices. `name` is for messages."""

    def term(self, name: str, build: Builder) -> Term:
        """Its term."""


@dataclass(frozen=True, eq=False)
class FurtherTest:
    """A further test, for the `residuals` of a problem: of the structure as it was then.

    Parameters
    ----------
    measurement : Measurement
        May have other sensors, lines and base motion than the problem's own.
    mass, stiffness, damping : expression or array_like
        (n, n), or (n + d, n + d) with the base's rows last, in the variables of the problem; damping (n, n).
    recovery, rigid_body_dofs : array_like, optional
        As in `Problem`.
    """

    measurement: Measurement
    mass: Any = field(kw_only=True)
    stiffness: Any = field(kw_only=True)
    damping: Any = field(kw_only=True)
    recovery: Any = field(default=None, kw_only=True)
    rigid_body_dofs: Any = field(default=None, kw_only=True)

    kind: ClassVar[str] = "further tests"  # what its unknowns are listed under

    def __post_init__(self) -> None:
        instance("FurtherTest: measurement", self.measurement, Measurement)
        _ = self.blocks

    @cached_property
    def blocks(self) -> tuple[Blocks, Geometry]:
        """The blocks of its matrices, and their geometry."""
        models = as_models(self.mass, self.stiffness, self.damping)
        geometry = geometry_of(ModalEstimate.of_lines(self.measurement), models[1], self.recovery, self.rigid_body_dofs)
        for name, model in zip(MATRICES, models, strict=True):
            if model.unknowns(geometry.unsearched()):
                raise InputError(f"FurtherTest: {name} is a model; write the matrix in the variables of the problem")
        blocks = blocks_of(models, geometry)
        if blocks.ratios.numel():
            raise InputError("FurtherTest: damping must be a matrix (n, n)")
        return blocks, geometry

    def expressions(self, name: str) -> Sequence[ca.MX]:
        """Its matrices."""
        return self.blocks[0].by_matrix

    def term(self, name: str, build: Builder) -> TestTerm:
        """Its records, weighed by their noise beside that of the problem's own."""
        modal = build.modal_of(self)
        weight = 1.0 if build.replaced else build.noise() / build.noise_of(modal.records)
        return TestTerm(modal, build.matrices(*self.blocks), weight, name=name)

    @property
    def response(self) -> ComplexExpression:
        """Absolute accelerations of the sensors as expressions, (n_sensors, runs * n_freq)."""
        return _as_expressions(absolute_response(self.measurement, self.blocks[0].motion(self.blocks[1])))

    @property
    def force(self) -> ComplexExpression:
        """The base force as expressions, (d, runs * n_freq)."""
        return _as_expressions(relative_response(self.measurement, self.blocks[0].motion(self.blocks[1]))[1])

    @property
    def expression(self) -> ca.MX:
        """Relative residuals of accelerations and, where measured, of force, one below the other."""
        return relative_misfit(self.measurement, self.blocks[0].motion(self.blocks[1]), weighted=True)


@dataclass(frozen=True, eq=False)
class Prior:
    """Something known to some accuracy, for the `residuals` of a problem: it counts as one more measurement.

    Parameters
    ----------
    expression : Variable or expression
        What is known: a variable, or any column of numbers written in variables.
    value : array_like
        Its value, broadcast to it.
    std : array_like
        Standard deviation of the value, in the same unit.

    Examples
    --------
    >>> import sysid
    >>> m = sysid.Variable("floor", 2, lower=100.0, upper=900.0, unit="kg")
    >>> weighed = sysid.Prior(m, [410.0, 395.0], std=12.0)
    """

    expression: Any
    value: Any
    std: Any

    def __post_init__(self) -> None:
        self.column("Prior")

    def column(self, name: str) -> tuple[ca.MX, Array, Array]:
        """The expression as a column, its values and standard deviations, (rows,) each."""
        column = ca.vec(ca.densify(as_matrix(name, self.expression)))
        if not ca.symvar(column):
            raise InputError(f"{name}: expression holds no variable: there is nothing that its value could tell")
        given = []
        for what, numbers in (("value", self.value), ("std", self.std)):
            array = finite_array(f"{name}: {what}", numbers).ravel(order="F")
            if array.size not in (1, column.numel()):
                raise InputError(f"{name}: {what} holds {array.size} numbers for {column.numel()}{written_in(column)}")
            given.append(np.broadcast_to(array, (column.numel(),)))
        if np.any(given[1] <= 0):
            raise InputError(
                f"{name}: std = {given[1].min():g}; standard deviations must be positive{written_in(column)}"
            )
        return column, given[0], given[1]

    def expressions(self, name: str) -> Sequence[ca.MX]:
        """Known expressions less their values, in standard deviations."""
        column, value, std = self.column(name)
        return [(column - ca.DM(value)) / ca.DM(std)]

    def term(self, name: str, build: Builder) -> ExpressionTerm:
        """Rows in units of the noise of the records."""
        column = self.column(name)[0]
        labels = tuple(_label(column, i) for i in range(column.numel()))
        function = build.function("prior", self.expressions(name))
        return ExpressionTerm(name, function, weight=build.noise(), std=1.0, labels=labels)


@dataclass(frozen=True, eq=False)
class Residual:
    """A column of relative residuals written by the user: each row counts like one number of the test."""

    expression: Any
    is_misfit: bool = False

    def expressions(self, name: str) -> Sequence[ca.MX]:
        """The column."""
        return [column_of(name, self.expression)]

    def term(self, name: str, build: Builder) -> ExpressionTerm:
        """The column as it is."""
        function = build.function("residuals", self.expressions(name))
        return ExpressionTerm(name, function, like_records=not self.is_misfit)


@dataclass(frozen=True, eq=False)
class ComplexResidual:
    """A complex residual of accelerations, m/s², or of the force, N, weighed as the records of the problem's own test.

    `stacked` are real and, below, imaginary parts, (2 n_sensors or 2 d, runs * n_freq).
    """

    stacked: Any
    force: bool = False
    is_misfit: bool = False

    def expressions(self, name: str) -> Sequence[ca.MX]:
        """The parts in one column, not weighed."""
        return [column_of(name, self.stacked)]

    def term(self, name: str, build: Builder) -> ExpressionTerm:
        """Rows relative to the record, each channel and line by its noise."""
        test, stacked = build.records(), as_matrix(name, self.stacked)
        refuse((self.force and test.force is None, f"{name}: force=True, and the test has no base force"))
        weight, size = weights_of_test(test, weighted=True)[self.force]
        wanted, given = weight.shape, (stacked.shape[0] // 2, stacked.shape[1])
        words = f"a row a {'direction' if self.force else 'sensor'} and a column a line, runs side by side, are needed"
        refuse((given != wanted, f"{name}: its complex residual is {given}; {wanted}, {words}{written_in(stacked)}"))
        column = column_of(name, ca.DM(np.vstack([weight, weight]) / size) * stacked)
        return ExpressionTerm(name, build.function("residuals", [column]), like_records=not self.is_misfit)


def real_and_imaginary(expression: Any, *, force: bool = False) -> ComplexResidual:
    """One term of a complex residual, with the records' noise: for `misfit` or among the `residuals` of a problem.

    Parameters
    ----------
    expression : complex expression, (n_sensors, runs * n_freq)
        Of accelerations, m/s², such as ``record - gain * response``: variables, complex numbers and the `response` of a
        `FurtherTest` take + - * / @, `numpy.exp` and `numpy.conj`. Runs stand side by side.
    force : bool
        True for a residual of the base force, N, (d, runs * n_freq).

    Returns
    -------
    ComplexResidual
        Real and imaginary part of each channel and line count by the noise of that record, as those of the test do.

    Raises
    ------
    InputError
        Where the expression is real.

    Examples
    --------
    A delay of all sensors as an unknown:

    >>> import numpy as np
    >>> import sysid
    >>> truth = sysid.Structure(np.diag([2.0, 0.0]), [[800.0, -800.0], [-800.0, 800.0]], [0.02], n_base=1)
    >>> test = sysid.simulate(truth, np.linspace(1, 6, 40))
    >>> k = sysid.Variable("k", lower=500.0, upper=1500.0)
    >>> tau = sysid.Variable("tau", lower=-0.01, upper=0.01)
    >>> a = sysid.FurtherTest(test, mass=[[2.0]], stiffness=k, damping=[[1.6]]).response
    >>> late = np.exp(-2j * np.pi * test.freq[None] * tau) * a
    >>> term = sysid.real_and_imaginary(late - test.response[0])
    """
    if not isinstance(expression, ComplexExpression):
        raise InputError(f"real_and_imaginary ({user_site()}): the expression is real; it is a residual as it stands")
    return ComplexResidual(Expression(ca.vertcat(*expression)), flag("force", force))


def _as_expressions(response: ComplexExpression) -> ComplexExpression:
    """The same response, whose parts tell where complex numbers meet them."""
    return ComplexExpression(*map(Expression, response))


def column_of(name: str, value: Any) -> ca.MX:
    """A column of expressions, refused where it is not finite at the guess or holds no variable."""
    refuse(
        (
            isinstance(value, Measurement),
            f"{name} ({user_site()}) is a test: sysid.FurtherTest(test, mass=M, stiffness=K, damping=C) fits it beside "
            "the first, validation=[test] predicts it",
        )
    )
    column = ca.vec(ca.densify(as_matrix(name, value)))
    check_finite(name, at_point(name, column, None).ravel(), column)
    if not ca.symvar(column):
        raise InputError(f"{name} ({user_site()}) holds no variable: there is nothing that it could move")
    return column


def _label(column: ca.MX, row: int) -> str:
    """Label of a row of something known: its variable's entry, or the variables that it is written in."""
    entry = column[row]
    names = [v for v in map(variable_of, ca.symvar(entry)) if v is not None]
    if len(names) == 1:
        _, entries = ca.jacobian_sparsity(entry, names[0].symbol).get_triplet()
        if len(entries) == 1:
            return names[0].labels[entries[0]]
    return "a relation of " + ", ".join(v.name for v in names)
