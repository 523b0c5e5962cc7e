"""The swarm's objective: one source with IPOPT's rows, microseconds a candidate, and the swarm itself."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.swarm import older_commit, one_source
from benchmarks.swarm.by_lines import ByLines, ByLinesBySubstitution, ByLinesOfUnitRuns
from sysid.compare import peers
from sysid.search.swarm_objective import SwarmObjective

SEED = 3
DIRECTIONS = 3
BY_LINE = 256  # candidates that are evaluated line by line; all 5·D without lines
CASES = ((10, 200, 20.0), (10, 1000, 22.0), (20, 200, 90.0))  # degrees of freedom, lines, bound in microseconds
FASTER = 3.0
AGREES = 1e-9  # of the records' or the candidate's square, whichever is larger
WELL_POSED = 100.0  # relative residual: beyond it candidates are worthless, and their mass so ill-conditioned that
# round-off in it is all that a comparison would show
AGREEING = 200  # candidates, whatever their mass
SIZES = (6, 10, 20)
CHEAPER = 2.0  # than the sum over 200 lines in NumPy, in processor time of all threads, n = 10
SPHERE = 100  # variables of the sphere function, which takes next to no time
ITERATIONS = 5  # of both swarms on it
LIGHTER = 5.0  # than pymoo's swarm, at least

Objective = Callable[[np.ndarray], np.ndarray]


def lines(reduced: bool) -> Iterator[Line]:
    """All particles of a swarm, 5·D, BLAS on one thread, two threads in all.

    The reduced form judges one source, agreement, and processor time beside a sum over lines: wall-clock microseconds
    on two shared processors are judged in full, and there beside an older commit too.
    """
    yield from one_source.lines()
    yield from _agreement()
    yield from [_processor_time()] if reduced else older_commit.lines()
    repeats = 10 if reduced else 40
    with threadpool_limits(limits=1):
        for n, count, bound in CASES[:1] if reduced else CASES:
            problem = _problem(n, count)
            fast = SwarmObjective(problem.prepared, spectrum=problem.formulation.stiffness.spectrum)
            slow, real = ByLines(problem), ByLinesOfUnitRuns(problem)
            swarm = np.random.default_rng(0).uniform(
                problem.lower, problem.upper, (5 * problem.n_variables, problem.n_variables)
            )
            what = f"n = {n}, d = {DIRECTIONS}, {count} lines"
            took = _alternated(((fast, swarm), (slow, swarm[:BY_LINE]), (real, swarm[:BY_LINE])), repeats)
            quartiles = np.quantile(took, [0.25, 0.5, 0.75], axis=0)
            spread = ", ".join(f"{low:.0f}-{high:.0f}" for low, _, high in quartiles.T[:2])
            least = took.min(axis=0)
            text = f"{what}: microseconds a candidate, least of {repeats}"
            yield Line(text, f"{least[0]:.4g}") if reduced else below(text, float(least[0]), bound)
            yield Line(f"{what}: by line in batched NumPy, least of {repeats}", f"{least[1]:.4g}")
            yield Line(f"{what}: the same in real arithmetic, as unit runs allow", f"{least[2]:.4g}")
            ratio = float(quartiles[1, 1] / quartiles[1, 0])
            text = f"{what}: times faster, alternated, by medians (quartiles {spread})"
            yield Line(text, f"{ratio:.3g}") if reduced else above(text, ratio, FASTER)
            yield below(f"{what}: largest difference from the sum over lines", _difference(fast, slow, swarm), AGREES)
        yield from _overhead(reduced)


def _agreement() -> Iterator[Line]:
    """Difference from the sum over lines, of a test with force."""
    for n in SIZES:
        problem = _problem(n, 200, force=True)
        fast = SwarmObjective(problem.prepared, spectrum=problem.formulation.stiffness.spectrum)
        rows = np.random.default_rng(1).uniform(problem.lower, problem.upper, (AGREEING, problem.n_variables))
        expected = ByLinesBySubstitution(problem)(rows) ** 2
        apart = np.abs(fast(rows) ** 2 - expected) / np.maximum(expected, 1.0)
        text = f"n = {n}, full mass, with force: largest difference from the sum over lines, {AGREEING} candidates"
        yield below(text, float(apart.max()), AGREES)


def _processor_time() -> Line:
    """Processor time of a sum over lines over that of the objective."""
    problem = _problem(10, 200)
    fast = SwarmObjective(problem.prepared, spectrum=problem.formulation.stiffness.spectrum)
    rows = np.random.default_rng(0).uniform(problem.lower, problem.upper, (BY_LINE, problem.n_variables))
    took = _alternated(((fast, rows), (ByLines(problem), rows)), 10, time.process_time)
    ratio = float(np.median(took[:, 1]) / np.median(took[:, 0]))
    return above(
        "n = 10, 200 lines: processor time of the sum over lines in NumPy over the objective's", ratio, CHEAPER
    )


def _overhead(reduced: bool) -> Iterator[Line]:
    """Time of the swarm a particle and iteration beside the objective, and of pymoo's with as many particles.

    In process time of one thread, which other work on the machine changes little.
    """
    what = f"sphere of {SPHERE} variables, {5 * SPHERE} particles, {ITERATIONS} iterations: "
    repeats = 1 if reduced else 5
    if "pymoo PSO" not in peers.names():
        yield Line(what + "the swarm beside pymoo's", "pymoo is not there: sysid[benchmark]")
        return
    took = np.zeros((repeats + 1, 2))
    for seed, row in enumerate(took):
        for i, swarm in enumerate((_own_swarm, _pymoo_swarm)):
            start = time.process_time()
            swarm(seed)
            row[i] = 1e6 * (time.process_time() - start) / (ITERATIONS * 5 * SPHERE)
    took = took[1:]  # what is imported and made once is made
    own, other = np.median(took, axis=0)
    low, ratio, high = np.quantile(took[:, 1] / took[:, 0], [0.25, 0.5, 0.75])
    yield Line(what + f"microseconds a particle and iteration, median of {repeats}", f"{own:.3g}, pymoo {other:.4g}")
    text = what + f"times less than pymoo's, alternated (quartiles {low:.3g}-{high:.3g})"
    yield Line(text, f"{ratio:.3g}") if reduced else above(text, float(ratio), LIGHTER)


def _own_swarm(seed: int) -> None:
    box = np.tile([0.0, 1.0], (SPHERE, 1))
    sysid.minimize_swarm(_sphere, box, rng=seed, max_iterations=ITERATIONS, stall_iterations=None)


def _pymoo_swarm(seed: int) -> None:
    left = ITERATIONS

    def evaluate(rows: np.ndarray) -> np.ndarray:
        nonlocal left
        left -= 1
        if left < 0:
            raise peers.Spent
        return _sphere(rows)

    with contextlib.suppress(peers.Spent):
        peers.PEERS["pymoo PSO"](evaluate, SPHERE, np.random.default_rng(seed))


def _sphere(rows: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", rows, rows)


def _problem(n: int, count: int, *, force: bool = False) -> sysid.Problem:
    truth = random_structure(SEED, n=n, d=DIRECTIONS)
    test = sysid.simulate(truth, frequency_lines(truth, count), force=force)
    return sysid.Problem(
        test,
        mass=sysid.FullMass(np.diag(truth.rigid_body_mass)),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
        damping=sysid.ModalDamping(0.005, 0.05),
    )


def _alternated(
    objectives: Sequence[tuple[Objective, np.ndarray]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> np.ndarray:
    """Microseconds a candidate, (repeats, objectives), one objective after the other in each repeat."""
    took = np.zeros((repeats, len(objectives)))
    for objective, swarm in objectives:
        objective(swarm)  # what is made once is made
    for row in took:
        for i, (objective, swarm) in enumerate(objectives):
            start = clock()
            objective(swarm)
            row[i] = 1e6 * (clock() - start) / len(swarm)
    return took


def _difference(fast: Objective, slow: Objective, swarm: np.ndarray) -> float:
    """Largest difference of squares over the candidates that count, relative to the larger of 1 and the square."""
    found = swarm[:BY_LINE]
    expected = slow(found) ** 2
    difference = np.abs(fast(found) ** 2 - expected) / np.maximum(expected, 1.0)
    well_posed = expected < max(WELL_POSED**2, float(np.quantile(expected, 0.1)))
    return float(difference[well_posed].max())
