"""Processor microseconds of the swarm's objective a candidate, on one thread, in a process of its own.

``python one_worker.py`` takes the package on its path, reads a case a line, ``[n, lines]``, and answers each with a
number: the first time with the processor seconds in which the objective was made, then with the microseconds of whole
swarms.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable
from unittest.mock import patch

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.modal.random_structures import frequency_lines, random_structure
from sysid.search.swarm_objective import SwarmObjective

SEED, DIRECTIONS = 3, 3
TIMED = 10_000  # candidates at least: shorter times are too uneven


def objective_of(n: int, count: int) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray, float]:
    """The objective of a test with force in the paper's search box, a swarm of 5·D, and how long it took to be made."""
    truth = random_structure(SEED, n=n, d=DIRECTIONS)
    problem = sysid.Problem(
        sysid.simulate(truth, frequency_lines(truth, count), force=True),
        mass=sysid.FullMass(np.diag(truth.rigid_body_mass)),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
        damping=sysid.ModalDamping(0.005, 0.05),
    )
    start = time.process_time()
    with patch("os.cpu_count", lambda: 1):  # so that the objective makes one worker
        objective = SwarmObjective(problem.prepared, spectrum=problem.formulation.stiffness.spectrum)
    seconds = time.process_time() - start
    size = problem.n_variables
    swarm = np.random.default_rng(0).uniform(problem.lower, problem.upper, (5 * size, size))
    objective(swarm)  # what is made once is made
    return objective, swarm, seconds


def main() -> None:
    """Answer case after case."""
    if hasattr(os, "sched_setaffinity"):  # both packages on the same processor, beside the same other work
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cases: dict[tuple[int, int], tuple] = {}
    with threadpool_limits(limits=1):
        for line in sys.stdin:
            case = tuple(json.loads(line))
            if case not in cases:
                cases[case] = objective_of(*case)
                print(json.dumps(cases[case][2]), flush=True)
                continue
            objective, swarm, _ = cases[case]
            swarms = math.ceil(TIMED / len(swarm))
            start = time.process_time()
            for _ in range(swarms):
                objective(swarm)
            print(json.dumps(1e6 * (time.process_time() - start) / (swarms * len(swarm))), flush=True)


if __name__ == "__main__":
    main()
