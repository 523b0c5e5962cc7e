"""Statements of a user about an identification problem: a measurement, its matrices, and what else is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, as_float, choice, flag, instance, refuse
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.models.mass import FullMass
from sysid.models.model import Geometry, MatrixModel
from sysid.models.stiffness_and_damping import ModalDamping, SpectralStiffness
from sysid.models.unknowns import Variable, user_site
from sysid.problem import stored
from sysid.problem.formulation import Formulation
from sysid.problem.matrices import MATRICES, as_models, geometry_of
from sysid.problem.terms import FurtherTest
from sysid.structure.amplitude import AmplitudeLaw
from sysid.structure.structure import Array, Structure


@dataclass(frozen=True, eq=False, repr=False)
class StatedProblem:
    """The fields of `Problem`, which documents them, and what follows from them without a look at the records' modes.

    The constructor checks types, shapes and what is written.
    """

    measurement: Measurement
    mass: Any = field(default=FullMass(healing="rigid_body"), kw_only=True)
    stiffness: Any = field(default=SpectralStiffness(), kw_only=True)
    damping: Any = field(default=ModalDamping(), kw_only=True)
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
    residual_modes: bool = field(default=False, kw_only=True)
    amplitude: AmplitudeLaw | None = field(default=None, kw_only=True)
    site: str = field(init=False, default="?")

    def __post_init__(self) -> None:
        instance("Problem: measurement", self.measurement, Measurement)
        if self.reference is not None:
            instance("Problem: reference", self.reference, Structure)
        if self.goal is not None:
            as_float("Problem: goal", self.goal, "a positive relative residual", above=0)
        choice("Problem: loss", self.loss, ("squares", "huber"))
        flag("Problem: residual_modes", self.residual_modes)
        if self.amplitude is not None:
            instance("Problem: amplitude", self.amplitude, AmplitudeLaw)
        own = self.misfit is not None
        refuse(
            (
                own and self.loss == "huber",
                "Problem: loss='huber' is of records, and this problem fits a misfit of its own",
            ),
            (own and self.residual_modes, "Problem: residual_modes=True is of records, not of a misfit of one's own"),
            (
                self.amplitude is not None and (own or not self.measurement.is_whole),
                "Problem: amplitude is of modes of whole records (Measurement.from_time, estimator='records'), and "
                + ("this problem fits a misfit of its own" if own else "this test holds spectra"),
            ),
        )
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
        timeless = self.amplitude is not None and not all(test.is_in_time for test in self.validation)
        refuse((
            timeless,
            "Problem: modes that follow their amplitude predict records alone, and a validation test holds spectra "
            "without a sample rate: make it of records (Measurement.from_time)",
        ))  # fmt: skip
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
        declared = self.declared
        for model in declared.models:
            model.stated(declared.geometry)
        declared.check()

    def to_tree(self) -> dict[str, Any]:
        """Give all as dictionaries, lists, arrays and texts, but expressions that `sysid.problem.stored` cannot."""
        return {
            "measurement": self.measurement.to_tree(),
            "given": self.as_given,
            "poles": None,
            "fits": [],
            "delays": [],
            "calibrations": [],
            "reference": self.reference and self.reference.to_tree(),
            "validation": [test.to_tree() for test in self.validation],
            "goal": self.goal,
            "loss": self.loss,
            "residual_modes": self.residual_modes,
            "amplitude": self.amplitude and self.amplitude.to_tree(),
        }

    @cached_property
    def as_given(self) -> dict[str, Any]:
        """Models, numbers and expressions as a tree, for which expressions are compared with what is read again."""
        return stored.to_tree(vars(self))

    @property
    def tests(self) -> tuple[Measurement, ...]:
        """The problem's own test, and the further ones among its residuals, as they were given."""
        further = (one.measurement for one in self.residuals if isinstance(one, FurtherTest))
        return self.measurement, *further

    @property
    def models(self) -> tuple[MatrixModel, MatrixModel, MatrixModel]:
        """Of mass, stiffness and damping."""
        return self.mass, self.stiffness, self.damping

    @property
    def frequencies(self) -> Array:
        """Natural frequencies that the stiffness states, Hz, so that none are looked for; (0,) where it states none."""
        given = getattr(self.stiffness, "natural_frequencies", None)
        return np.zeros(0) if given is None else np.atleast_1d(np.array(given, dtype=float))

    @property
    def states_frequencies(self) -> bool:
        """True where the stiffness states natural frequencies of its own."""
        return self.frequencies.size > 0

    @cached_property
    def declared(self) -> Formulation:
        """The formulation with made-up poles and weights, for what is asked before the records are searched."""
        modal = [ModalEstimate.of_lines(test) for test in self.tests]
        weighed = None if self.measurement.force is None else lambda: np.ones(self.measurement.n_base)
        geometry = geometry_of(modal[0], self.stiffness, self.recovery, self.rigid_body_dofs, weighed)
        return self.formulate(geometry.unsearched(), modal)

    def formulate(self, geometry: Geometry, modal: Sequence[ModalEstimate]) -> Formulation:
        """Matrices, terms and constraints as CasADi functions of the unknowns, for a geometry and modal estimates."""
        return Formulation(
            modal, self.models, geometry, self.residuals, self.constraints, self.misfit, self.healing,
            residual_modes=self.residual_modes,
        )  # fmt: skip

    def __repr__(self) -> str:
        models = ", ".join(type(model).__name__ for model in self.models)
        return f"<Problem: {models}; {self.measurement!r}>"
