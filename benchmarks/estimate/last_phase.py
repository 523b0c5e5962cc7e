"""The last phase of identifications: IPOPT's, its status read, at a point where the objective has no slope.

The gradient is CasADi's own of the objective that IPOPT was given, along what bounds and constraints leave free. A sign
that is changed in the symbolic residual alone must be noticed: no strategy may report success with it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest.mock import patch

import casadi as ca
import numpy as np
import scipy

import sysid
from benchmarks.estimate.one_answer import test_of
from benchmarks.line import Line, below
from benchmarks.problem_modules import ROOT, load_module
from sysid.modal_analysis import response
from sysid.nlp import NonlinearProgram
from sysid.problem import direct_response, terms
from sysid.search import modal_program
from sysid.structure.thresholds import EXACT

SLOPE = 1e-6  # of the gradient at 1 % off the answer
OFF = 0.01  # of an unknown, or of its unit where it is zero
OBJECTIVE = 1e-6  # relative difference of the objective of the last phase and of the answer
QUICK = ("diagonal_mass", "magnitude_only")
COUNTS = {"spectra": 48, "records": 12}  # random tests
SHORT = 24  # one of them in so many in the reduced form
# What is identified with a wrong sign, and how; the published algorithm has no symbolic residual of its own.
WRONG = (
    ("spectra 11", "modal"),
    ("records 0", "modal"),
    ("shear_building", "continuation"),
    ("diagonal_mass", "swarm"),
)
SECONDS = 15.0  # of an identification with a wrong sign


class Phase(NamedTuple):
    """A run of IPOPT: its program with all constraints that it had, objective, end and status."""

    program: NonlinearProgram
    constraints: int
    objective: ca.MX
    end: np.ndarray
    status: str

    def slope(self, at: np.ndarray) -> float:
        """Norm of the gradient along what bounds and constraints leave free."""
        z = self.program.z
        rows = ca.vertcat(ca.MX(0, 1), *self.program.constraints[: self.constraints])
        outputs = [ca.gradient(self.objective, z), rows, ca.densify(ca.jacobian(rows, z))]
        g, c, A = (np.asarray(part) for part in ca.Function("slope", [z], outputs)(at))
        (lower, upper), (low, high) = self.program.bounds, (part[: c.size] for part in self.program.limits)
        g, near = g.ravel(), 1e-6 * np.maximum(1.0, np.abs(at))
        free = ~(((at - lower < near) & (g > 0)) | ((upper - at < near) & (g < 0)))
        held = (c.ravel() - low < 1e-6) | (high - c.ravel() < 1e-6)
        A = A.reshape(-1, at.size)[np.ix_(held, free)]
        return float(np.linalg.norm(scipy.linalg.null_space(A).T @ g[free] if len(A) else g[free]))

    @property
    def value(self) -> float:
        """Root of the objective at the end."""
        return float(np.sqrt(float(ca.Function("value", [self.program.z], [self.objective])(self.end))))

    @property
    def ratio(self) -> float:
        """The gradient at the end over that at 1 % off it."""
        sign = np.random.default_rng(0).choice([-1.0, 1.0], self.end.size)
        off = self.end + OFF * sign * np.where(self.end == 0, 1.0, self.end)
        return self.slope(self.end) / self.slope(np.clip(off, *self.program.bounds))


def lines(reduced: bool) -> Iterator[Line]:
    """Bundled problems, random tests and whole records; fewer of each in the reduced form."""
    names = [*(QUICK if reduced else _bundled())]
    names += [f"{what} {seed}" for what, count in COUNTS.items() for seed in range(0, count, SHORT if reduced else 1)]
    ends = {name: last_phase(name) for name in names}
    other = [f"{name}: {end}" for name, end in ends.items() if isinstance(end, str)]
    listed = f" ({'; '.join(other)})" if other else ""
    yield below(f"{len(ends)} identifications that do not end in IPOPT with its status read{listed}", len(other), 0)
    ratios = {name: end.ratio for name, end in ends.items() if isinstance(end, Phase)}
    worst = max(ratios, key=lambda name: ratios[name])
    yield below(f"gradient at their ends over that at 1 % off, the largest, {worst}", ratios[worst], SLOPE)
    wrong = WRONG[:3] if reduced else WRONG
    unseen = [f"{name}, {strategy}" for name, strategy in wrong if _succeeds_with_wrong_sign(name, strategy)]
    listed = f" ({'; '.join(unseen)})" if unseen else ""
    text = f"{len(wrong)} identifications with one sign changed in the symbolic residual: that report success{listed}"
    yield below(text, len(unseen), 0)


def last_phase(name: str) -> Phase | str:
    """The run of IPOPT that an answer comes from, or what is not as it should be."""
    with watched() as phases:
        result = sysid.identify(_problem(name), rng=0)
    # Of whole records IPOPT's objective is what modes miss their estimate by.
    near = OBJECTIVE * result.objective + EXACT
    of_answer = [one for one in phases if result.fitted.by_modes or abs(one.value - result.objective) < near]
    read = [one for one in of_answer if one.status in result.message]
    if read:
        return read[-1]
    ends = ", ".join(f"{one.status} at {one.value:.6g}" for one in phases)
    return f"IPOPT ended with {ends or 'nothing'}, the answer is at {result.objective:.6g}: {result.message}"


def _succeeds_with_wrong_sign(name: str, strategy: str) -> bool:
    with wrong_sign(), watched():
        return sysid.identify(_problem(name), strategy=strategy, rng=0, max_time=SECONDS).success


def _bundled() -> list[str]:
    """Bundled problems whose records are here."""
    absent = {"recorded_test", "mini_shake_table"} if not os.environ.get("SYSID_DATA") else {"recorded_test"}
    return sorted({path.stem for path in (ROOT / "problems").glob("*.py")} - absent)


def _problem(name: str) -> sysid.Problem:
    what, _, seed = name.partition(" ")
    if seed:
        return sysid.Problem(test_of(what, int(seed)), mass=sysid.FullMass())
    problem: sysid.Problem = load_module(name).problem()
    return problem


@contextlib.contextmanager
def watched() -> Iterator[list[Phase]]:
    """Runs of IPOPT in what follows, in their order; other answers are not looked for."""
    phases: list[Phase] = []
    plain = NonlinearProgram.minimize

    def minimize(program: NonlinearProgram, objective: ca.MX, *args: Any, **settings: Any) -> tuple[np.ndarray, str]:
        end, status = plain(program, objective, *args, **settings)
        phases.append(Phase(program, len(program.constraints), objective, end, status))
        return end, status

    with (
        patch.object(NonlinearProgram, "minimize", minimize),
        patch("sysid.results.judgement.with_other_answers", lambda problem, end, session: end),
    ):
        yield phases


@contextlib.contextmanager
def wrong_sign() -> Iterator[None]:
    """Symbolic residuals with the sign of the damping changed: of modal gains, of direct solves, of an estimate."""
    gains, line = response.modal_gains, direct_response._one_line
    of_estimate, of_rows = modal_program.EstimateResidual, terms.misfit_rows

    def conjugated(*args: Any) -> tuple[ca.MX, ca.MX]:
        real, imaginary = gains(*args)
        return real, -imaginary

    def driven(*args: Any) -> ca.Function:
        plain = line(*args)
        w, M, C, K, B = (ca.MX.sym("it", *plain.size_in(i)) for i in range(5))
        return ca.Function("line", [w, M, C, K, B], [plain(w, M, -C, K, B)])

    def estimate(modal: Any, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid: ca.MX) -> Any:
        return of_estimate(modal, gamma, omega, 1 / ratios, rigid)  # whose logarithms count

    def rows(modal: Any, shapes: ca.MX, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, *rest: Any, **named: Any) -> ca.MX:
        return of_rows(modal, shapes, gamma, omega, 1 / ratios, *rest, **named)

    with (
        patch.object(response, "modal_gains", conjugated),
        patch.object(modal_program, "modal_gains", conjugated),
        patch.object(direct_response, "_one_line", driven),
        patch.object(modal_program, "EstimateResidual", estimate),
        patch.object(terms, "misfit_rows", rows),
    ):
        yield
