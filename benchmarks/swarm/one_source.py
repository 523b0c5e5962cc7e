"""Changes of a model's expressions that have to change the swarm's objective and IPOPT's rows alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import patch

import casadi as ca
import numpy as np

import sysid
from benchmarks.line import Line, above, below
from sysid.models import mass as mass_models
from sysid.problem.terms import ModeSymbols
from sysid.search.swarm_objective import SwarmObjective

CANDIDATES = 50
ALIKE = 1e-9
LEAST = 1e-6  # relative change of the objective, in the median, that counts as one
FREQ = np.linspace(1.0, 25.0, 30)
NATURAL = [3.0, 9.0, 16.0]
SKEW = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8]])  # a sensor between the directions: scales of healing are coupled
ALONG = np.ones((3, 1))


class Ring:
    """Three equal sectors: a circulant stiffness, of springs to the base and of springs between sectors."""

    def unknowns(self, geometry: Any) -> tuple[sysid.Unknown, ...]:
        """Two springs, N/m."""
        return (sysid.Unknown("spring", np.full(2, 1e3), np.full(2, 1e5)),)

    def blocks(self, geometry: Any, y: Any, mass: Any) -> Any:
        """K_SS."""
        return y[0] * np.eye(3) + y[1] * (3 * np.eye(3) - np.ones((3, 3)))

    def values(self, geometry: Any, structure: sysid.Structure) -> np.ndarray:
        """The springs of a ring."""
        K = structure.stiffness
        return np.array([K[0, :3].sum(), -K[0, 1]])

    def stated(self, geometry: Any) -> sysid.Stated:
        """A sentence."""
        return sysid.Stated(sentence="the stiffness is stated to be that of a ring")


def lines() -> Iterator[Line]:
    """Largest difference over all models, before and after each change."""
    worst, changed = 0.0, 0
    cases = _cases()
    for name, problem, other, heal in cases:
        rows = np.random.default_rng(0).uniform(problem.lower, problem.upper, (CANDIDATES, problem.n_variables))
        before, apart = _both(problem, rows)
        with patch.object(mass_models, "heal", heal or mass_models.heal):
            after, apart_after = _both(other, rows)
        worst = max(worst, apart, apart_after)
        there = np.isfinite(before) & np.isfinite(after)
        changed += bool(np.median(np.abs(after / before - 1)[there]) > LEAST and there.sum() > CANDIDATES / 2)
        if max(apart, apart_after) > ALIKE:
            yield Line(f"one source: {name} is not", f"{max(apart, apart_after):.2g}")
    what = f"{len(cases)} coefficients of models' expressions changed, {CANDIDATES} candidates each: "
    yield below(what + "largest difference of the swarm's objective from IPOPT's rows", worst, ALIKE)
    yield above(what + "changes that the objective shows", changed, len(cases))


def _cases() -> list[tuple[str, sysid.Problem, sysid.Problem, Callable | None]]:
    """Name, problem, the same with a coefficient changed, and a changed healing."""
    full, known = sysid.FullMass(30.0), sysid.KnownMass(np.diag([3.0, 2, 4, 5, 6]) + 0.5)
    unit, m = sysid.KnownMass(np.eye(5)), sysid.Variable("m", 3, lower=1.0, upper=9.0)
    written = ca.diag(ca.vertcat(m, 2.0, 2.0))
    changes: list[tuple[str, Any, Callable, dict]] = [
        ("mass", full, lambda made: made._replace(factor=1.05 * made.factor), {}),
        ("mass", full, lambda made: made._replace(coupling=0.95 * made.coupling), {}),
        ("mass", full, lambda made: made._replace(base=1.05 * made.base), {}),
        ("mass", sysid.LumpedMass(30.0), lambda made: made._replace(factor=1.05 * made.factor), {}),
        ("mass", known, lambda made: made._replace(coupling=0.95 * made.coupling), {}),
        ("stiffness", sysid.SpectralStiffness(NATURAL), _other_entry, {"mass": unit}),
        ("stiffness", sysid.ChainStiffness(1e3, 1e5), lambda made: 1.05 * made, {"rigid_body": ALONG}),
        ("stiffness", Ring(), lambda made: 1.05 * made, {"rigid_body": ALONG}),
        ("damping", sysid.ModalDamping(0.005, 0.05), lambda made: 1.05 * made, {}),
        ("damping", sysid.ProportionalDamping((0.1, 2.0), (1e-5, 1e-3)), lambda made: 1.05 * made, {}),
    ]
    found: list[tuple[str, sysid.Problem, sysid.Problem, Callable | None]] = [
        (type(model).__name__, _problem({name: model, **beside}),
         _problem({name: _changed(model, "ratios" if name == "damping" else "blocks", change), **beside}), None)
        for name, model, change, beside in changes
    ]  # fmt: skip
    found.append(("written mass", _problem({"mass": written}), _problem({"mass": 1.05 * written}), None))
    heal = mass_models.heal
    for healing in ("trace", "rigid_body"):
        mass = {"mass": sysid.FullMass(30.0, healing=healing)}
        other = lambda factor, *given: 1.02 * heal(factor, *given)  # noqa: E731
        found.append((f"healing, {healing}", _problem(mass), _problem(mass), other))
    return found


def _other_entry(made: sysid.StiffnessBlocks) -> sysid.StiffnessBlocks:
    """Another entry of K, and of H, which is the same where the mass is the unit matrix."""
    shift = ca.SX(3, 3)
    shift[1, 1] = 0.1 * made.mass_normalised[0, 0]
    return sysid.StiffnessBlocks(made.stiffness + shift, made.mass_normalised + shift)


def _changed(model: Any, method: str, change: Callable) -> Any:
    """The same model, what one of its methods gives changed."""
    own = getattr(type(model), method)
    kind = type("Changed", (type(model),), {method: lambda self, *given: change(own(self, *given))})
    made = object.__new__(kind)
    made.__dict__.update(vars(model))
    return made


def _problem(given: dict[str, Any]) -> sysid.Problem:
    rigid_body = given.pop("rigid_body", SKEW)
    parts = {"mass": sysid.FullMass(30.0), "stiffness": sysid.SpectralStiffness(NATURAL),
             "damping": sysid.ModalDamping(0.005, 0.05)} | given  # fmt: skip
    n, d = rigid_body.shape
    half = np.diag(2 * np.pi * np.array(NATURAL)) @ (np.eye(n) + 0.2)
    K = half @ half.T
    whole = np.block([[K, -K @ rigid_body], [-rigid_body.T @ K, rigid_body.T @ K @ rigid_body]])
    truth = sysid.Structure(np.eye(n + d) + 0.1, whole, np.full(n, 0.02), n_base=d)
    return sysid.Problem(sysid.simulate(truth, FREQ, force=True), **parts)


def _both(problem: sysid.Problem, rows: np.ndarray) -> tuple[np.ndarray, float]:
    """The swarm's objective, and its largest relative difference from IPOPT's rows; infinite where one alone is NaN."""
    formulation, n = problem.formulation, problem.geometry.n
    spectrum = formulation.stiffness.spectrum if formulation.refinable else None
    objective = SwarmObjective(problem.prepared, spectrum=spectrum)
    x, modes = ca.MX.sym("x", problem.n_variables), ModeSymbols(ca.MX.sym("shapes", n, n), ca.MX.sym("omega", n))
    of_rows = ca.Function("rows", [x, *modes], [ca.norm_2(formulation.own_test.rows(x, modes))])
    costs, expected = objective(rows), np.full(len(rows), np.nan)
    for i, s in enumerate(rows):
        at = objective.unknowns(s)
        try:
            structure = problem.structure(at)
        except sysid.InputError:
            continue
        omega = 2 * np.pi * structure.natural_frequencies if spectrum is None else spectrum
        expected[i] = float(of_rows(at, structure.normal_modes, omega))
    if np.any(np.isnan(costs) != np.isnan(expected)):
        return costs, np.inf
    return costs, float(np.nanmax(np.abs(costs / expected - 1)))
