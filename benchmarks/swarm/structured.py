"""Springs, dampers and masses from bounds of two decades: what the swarm finds, and what simpler searches find."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

import sysid
from benchmarks.line import Line, above
from benchmarks.modal.spread import spread
from benchmarks.swarm.controls import RANDOM, TWO_POINTS, random_search, two_points

SEEDS = range(9300, 9320)
LEAST = 19  # of twenty
BOUNDS, SCATTER = 10.0, 3.0  # factors either way of the nominal value: of the bounds, and of the truth at most
MASS, SPRING, DAMPER = 1000.0, 1e6, 600.0  # kg, N/m, N s/m: nominal
LINES = 250
GOAL = 1e-6  # relative residual
FOUND = 1e-3  # relative, the largest error of any unknown


@dataclass(frozen=True)
class Case:
    """A kind of structure.

    Attributes
    ----------
    name : str
    links : (n, 2)
        Masses that each spring and damper connects; -1 is the base.
    weighed : tuple of int
        Masses that are known; where there is none the total is.
    sensed : tuple of int
        Masses with a sensor; all where there is none.
    magnitudes : bool
        Whether only magnitudes are measured.
    """

    name: str
    links: tuple[tuple[int, int], ...]
    weighed: tuple[int, ...] = ()
    sensed: tuple[int, ...] = ()
    magnitudes: bool = False


def _chain(n: int) -> tuple[tuple[int, int], ...]:
    return tuple((i - 1, i) for i in range(n))


CASES = (
    Case("chain of 5", _chain(5)),
    Case("chain of 10", _chain(10)),
    Case("branched, 7 masses", ((-1, 0), (0, 1), (1, 2), (2, 3), (0, 4), (1, 5), (1, 6)), weighed=(6,)),
    Case("chain of 6, sensors on 2 floors", _chain(6), weighed=(0, 1, 2, 3, 4), sensed=(0, 5)),
    Case("chain of 4, magnitudes only", _chain(4), weighed=(0, 1, 2), magnitudes=True),
)


class End(NamedTuple):
    """End of one search: residual, largest relative error of an unknown, evaluations of the swarm, s."""

    residual: float
    error: float
    evaluations: int
    seconds: float


def lines(reduced: bool) -> Iterator[Line]:
    """Number of the truths that each search finds; that the swarm finds nearly all is judged."""
    seeds = SEEDS[:2] if reduced else SEEDS
    for number, case in enumerate(CASES[:1] if reduced else CASES):
        ends = spread(searches, [(number, seed, not reduced) for seed in seeds])
        for name in ends[0]:
            found = [one[name] for one in ends]
            count = sum(end.residual <= GOAL and end.error <= FOUND for end in found)
            seconds = np.median([end.seconds for end in found])
            missed = sorted(end.residual for end in found if end.error > FOUND or end.residual > GOAL)
            text = f"{case.name}, {len(seeds)} truths: found by {name} (median {seconds:.1f} s"
            text += f"; residuals elsewhere {', '.join(f'{left:.1g}' for left in missed)})" if missed else ")"
            if name == "swarm":
                yield above(text, count, LEAST * len(seeds) // len(SEEDS))
            else:
                yield Line(text, f"{count}")


def searches(task: tuple[int, int, bool]) -> dict[str, End]:
    """Swarm and, where they are asked for, its controls on one truth: number of the case, seed, whether."""
    number, seed, controls = task
    problem, true = problem_of(CASES[number], seed)
    swarm = sysid.Swarm()
    ends = {"swarm": _search(problem, true, swarm, seed)}
    if not controls:
        return ends
    ends[TWO_POINTS] = _search(problem, true, two_points(swarm), seed)
    spent = random_search(swarm, ends["swarm"].evaluations)
    ends[RANDOM] = _search(problem, true, spent, seed)
    ends["one continuation, from the middle"] = _search(problem, true, sysid.Continuation(starts=1), seed)
    return ends


def _search(problem: sysid.Problem, true: np.ndarray, strategy: sysid.Swarm | sysid.Continuation, seed: int) -> End:
    try:
        result = sysid.identify(problem, strategy=strategy, rng=seed)
    except sysid.SolverError:
        return End(np.inf, np.inf, 0, np.nan)
    error = np.inf if result.x is None else float(np.max(np.abs(result.x / true - 1)))
    return End(result.residual, error, result.history.evaluations, result.history.wall_time)


def problem_of(case: Case, seed: int) -> tuple[sysid.Problem, np.ndarray]:
    """A noise-free problem, and its unknowns' true values, (n_variables,)."""
    rng = np.random.default_rng((seed, len(case.links)))
    n = len(case.links)
    nominal = np.repeat([MASS, SPRING, DAMPER], n)
    masses, springs, dampers = (nominal * SCATTER ** rng.uniform(-1, 1, 3 * n)).reshape(3, n)
    stretch = np.zeros((n, n + 1))  # the base is last
    for row, (lower, upper) in zip(stretch, case.links, strict=True):
        row[upper], row[lower] = 1.0, -1.0
    sensed = list(case.sensed or range(n))
    truth = sysid.Structure(
        np.diag(np.append(masses, 0.0)), stretch.T @ np.diag(springs) @ stretch,
        damping_matrix=stretch[:, :n].T @ np.diag(dampers) @ stretch[:, :n], n_base=1,
        recovery=np.eye(n)[sensed] if case.sensed else None, rigid_body=np.ones((len(sensed), 1)),
    )  # fmt: skip
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.geomspace(0.4 * f[0], 1.5 * f[-1], LINES))
    free = [i for i in range(n) if i not in case.weighed]
    m, k, c = (
        sysid.Variable(name, size, lower=value / BOUNDS, upper=value * BOUNDS, log=True)
        for name, size, value in (("mass", len(free), MASS), ("spring", n, SPRING), ("damper", n, DAMPER))
    )
    everywhere = ca.MX(ca.DM(masses))
    everywhere[free] = m
    matrices = {
        "mass": ca.diag(ca.vertcat(everywhere, 0.0)),
        "stiffness": stretch.T @ ca.diag(k) @ stretch,
        "damping": stretch.T @ ca.diag(c) @ stretch,
    }
    stated: dict = {"recovery": np.eye(n)[sensed]} if case.sensed else {}
    if not case.weighed:
        total = masses.sum()
        stated |= {"constraints": [ca.sum1(m) == total], "healing": {m: m * total / ca.sum1(m)}}
    if case.magnitudes:
        measured = np.abs(test.response[0])
        a = sysid.FurtherTest(test, **matrices).response
        stated["misfit"] = (np.sqrt(a.real**2 + a.imag**2) - measured) / np.linalg.norm(measured)
        test = replace(test, response=measured[None])
    problem = sysid.Problem(test, **matrices, **stated, goal=GOAL)
    return problem, np.concatenate([masses[free], springs, dampers])
