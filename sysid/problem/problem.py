"""An identification problem: a measurement, its matrices as models, numbers or expressions, and the search space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from numpy.typing import ArrayLike

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.vector_fitting import Poles
from sysid.models.model import Geometry
from sysid.problem import stored
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared, SearchSpace
from sysid.problem.stated import StatedProblem
from sysid.structure.amplitude import AmplitudeLaw
from sysid.structure.structure import Array, Structure


@dataclass(frozen=True, eq=False, repr=False)
class Problem(StatedProblem, SearchSpace):
    """A problem of identification: a measurement, and what is stated of the structure.

    The measurement alone states nothing: as ``sysid run test.h5``, its answer is of the modes within the lines, and
    without a measured base force their modal masses stay open, in units of 1 kg of rigid-body mass a direction.

    The constructor checks types, shapes and what is written. Attributes that need the modes of the records find them
    when they are first asked for, once; an identification finds its own.

    Parameters
    ----------
    measurement : Measurement
    mass : FullMass, LumpedMass, KnownMass, MatrixModel, array_like or expression
        A full mass of any total by default. An array is a known mass matrix. An expression is written in
        `Variable` s, (n, n) or with the base's rows last (n + d, n + d).
    stiffness : SpectralStiffness, ChainStiffness, MatrixModel, array_like or expression
        Free by default. A matrix is (n, n) or (n + d, n + d).
    damping : ModalDamping, ProportionalDamping, MatrixModel, array_like or expression
        (n, n) is C on the motion relative to the base; (n,) is one damping ratio a mode, in ascending frequency, which
        are free by default.
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
        A mode must show at more than one line. `objective` and `residual` are of the records without numbers that stand
        alone.

    residual_modes : bool
        Fit what modes above the lines add to each test beside a model that has none of them, as one of fewer elements
        than the structure: `Structure.residual`. With a mass and a stiffness that are free they come by themselves.
    amplitude : AmplitudeLaw, optional
        Modes whose frequency and damping follow their own amplitude, in whole records: `Structure.laws`.

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

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Problem:
        """Make the problem of a tree that `to_tree` made: the same models, expressions, bounds and guesses.

        Models and matrices, expressions and their variables go through the constructor, as when they are written.
        Refused where the tree is damaged; a NotRebuiltError where it lacks expressions, or the class of a model is not
        found.
        """
        problem = cls(
            Measurement.from_tree(tree["measurement"]),
            **stored.from_tree(tree["given"]),
            reference=tree["reference"] and Structure.from_tree(tree["reference"]),
            validation=[Measurement.from_tree(test) for test in tree["validation"]],
            goal=tree["goal"],
            loss=tree["loss"],
            residual_modes=tree.get("residual_modes", False),  # results of before have none
            amplitude=tree.get("amplitude") and AmplitudeLaw(**tree["amplitude"]),
        )
        vars(problem)["prepared"] = Prepared.from_tree(problem, tree)
        if tree["poles"] is not None:
            problem.prepared.geometry.poles = Poles(**tree["poles"])
        return problem

    @cached_property
    def prepared(self) -> Prepared:
        """The problem with what its records tell of the modes, where that is asked for outside an identification."""
        return Prepared(self)

    @property
    def geometry(self) -> Geometry:
        """The geometry of the degrees of freedom."""
        return self.prepared.geometry

    @property
    def formulation(self) -> Formulation:
        """Matrices, terms and constraints as CasADi functions of the unknowns."""
        return self.prepared.formulation

    @property
    def tolerance(self) -> Array:
        """By how much a candidate of the swarm may break each row of the constraints, (rows,)."""
        return self.prepared.tolerance

    @property
    def poles(self) -> Poles | None:
        """Poles found in the data, where the stiffness is free and states no frequencies."""
        return self.prepared.poles

    @property
    def unknowns(self) -> tuple[tuple[str, int], ...]:
        """Number of unknowns a matrix: see `Prepared.unknowns`."""
        return self.prepared.unknowns

    @property
    def totals(self) -> Array:
        """Total mass in each base direction, (d,): see `Prepared.totals`."""
        return self.prepared.totals

    def check(self) -> None:
        """Refuse what cannot be searched, before any search: see `Prepared.check`."""
        self.prepared.check()

    def structure(self, x: ArrayLike) -> Structure:
        """The structure that the unknowns `x`, (n_variables,) in the variables' own units, stand for."""
        return self.prepared.structure(x)
