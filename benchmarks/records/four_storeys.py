"""One record of four storeys, cut in motion, 1 % noise on all channels: verdicts, intervals, errors, levels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.modal.spread import spread
from benchmarks.records import trial
from benchmarks.records.cramer_rao import Unknowns, all_entries, bound, symmetric
from benchmarks.records.simulated import STOREY_MASSES, TABLE_MASS, four_storeys
from benchmarks.records.trial import Trial

N = len(STOREY_MASSES)
# Elongation of each storey: the floor above less the one below; the table, last, is below the first.
T = np.eye(N, N + 1) - np.eye(N, N + 1, k=-1) - np.outer(np.eye(N)[0], np.eye(N + 1)[N])


@dataclass(frozen=True)
class Statement:
    """Statement about the structure.

    Attributes
    ----------
    problem : callable
        Gives the `sysid.Problem` of a test.
    force : bool
        Whether the base force is recorded.
    table : float
        Mass between load cells and first storey, kg; a lumped mass has none.
    unknowns : Unknowns
        What the statement leaves open.
    determined : bool
        Whether records and statement determine the matrices.
    """

    problem: Callable[[sysid.Measurement], sysid.Problem]
    force: bool
    table: float
    unknowns: Unknowns
    determined: bool = True


def lines(reduced: bool) -> Iterator[Line]:
    """By statement: 100 draws of motion and noise each, or one."""
    draws = 1 if reduced else 100
    trials = spread(draw, [(name, number) for name in STATEMENTS for number in range(draws)])
    for name, statement in STATEMENTS.items():
        own = [t for t in trials if t.group == name]
        yield trial.verdicts(name, own, determined=statement.determined)
        yield from trial.coverages(name, own)
        yield from trial.errors(name, own)
        yield trial.stated(name, own)
        yield trial.levels_found(name, own)


def draw(task: tuple[str, int]) -> Trial:
    """One draw: name of the statement, and number; the records of a number are the same whatever is stated."""
    return trial.attempt(task[0], lambda: _draw(*task))


def _draw(name: str, number: int) -> Trial:
    statement = STATEMENTS[name]
    setting = four_storeys(statement.table)
    rng = np.random.default_rng((number, 4))
    run = setting.run(rng)
    records, levels = setting.with_noise(run.records(), rng)
    test = trial.measurement([records], setting, force=statement.force)
    result = sysid.identify(statement.problem(test), rng=0)
    truth = setting.structure
    least = bound(truth, [(run, levels)], setting.lines, statement.unknowns, force=statement.force)
    return trial.judged(name, result, truth, least, levels)


def _chain(test: sysid.Measurement) -> sysid.Problem:
    k = sysid.Variable("spring", N, lower=1e5, upper=1e7, log=True, unit="N/m")
    return sysid.Problem(
        test, mass=np.diag(STOREY_MASSES), stiffness=T.T @ ca.diag(k) @ T, damping=sysid.ModalDamping()
    )


def _weighed(count: int, *, zeros: bool) -> Callable[[sysid.Measurement], sysid.Problem]:
    """Full mass with so many floors weighed from the ground, and zeros between floors and table where stated."""
    known = np.full((N, N + 1), np.nan)
    if zeros:
        known[~np.eye(N, N + 1, dtype=bool)] = 0
    floors = np.arange(count)
    known[floors, floors] = STOREY_MASSES[:count]
    return lambda test: sysid.Problem(test, mass=sysid.FullMass(known=known))


_NO_MASS, _NO_COUPLING, _NO_BASE = np.zeros((0, N, N)), np.zeros((0, N, 1)), np.zeros((0, 1, 1))
_FLOORS = symmetric(N, [(i, i) for i in range(N)])
_STOREYS = np.einsum("ki,kj->kij", T[:, :N], T[:, :N])
STATEMENTS = {
    "lumped, force": Statement(
        lambda test: sysid.Problem(test, mass=sysid.LumpedMass()), True, 0.0,
        Unknowns(_FLOORS, _NO_COUPLING, symmetric(N), _NO_BASE),
    ),
    "full, force": Statement(
        lambda test: sysid.Problem(test, mass=sysid.FullMass()), True, TABLE_MASS, all_entries(N, 1)
    ),
    "chain with its masses": Statement(
        _chain, False, TABLE_MASS, Unknowns(_NO_MASS, _NO_COUPLING, _STOREYS, _NO_BASE)
    ),
    "full, three floors weighed and zeros stated": Statement(
        _weighed(3, zeros=True), False, TABLE_MASS, Unknowns(_FLOORS[3:], _NO_COUPLING, symmetric(N), _NO_BASE)
    ),
    "full, two floors weighed": Statement(
        _weighed(2, zeros=False), False, TABLE_MASS, all_entries(N, 1), determined=False
    ),
}  # fmt: skip
