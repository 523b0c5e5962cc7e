"""Processor seconds of one identification, or of its modal fit alone, on one thread, in a process of its own.

``python one_estimate.py`` takes the package on its path, reads a case, ``[what, n, d, lines, seed]``, and answers
each with processor seconds: of ``identify``, of the ``fit`` of modes at poles that are found before, or of ``records``
from samples to a judged answer.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import sysid
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.older import answer_cases
from benchmarks.records import record_speed, trial
from benchmarks.records.simulated import coupled_structure
from sysid.nlp import IterationMonitor
from sysid.search.modal import Modal, modal_structure, poles_of

NOISE = 0.01
MOST = 40  # modes; more of them at random have pairs that the lines do not tell apart


def spectra(n: int, d: int, count: int, seed: int) -> sysid.Problem:
    """A test with force and noise of a structure with full matrices."""
    if n > MOST:
        truth = coupled_structure(np.random.default_rng(seed), n, d, np.geomspace(2.0, 80.0, n))
    else:
        truth = random_structure(seed, n=n, d=d)
    test = sysid.simulate(truth, frequency_lines(truth, count), force=True, noise=NOISE, rng=seed)
    return sysid.Problem(test, mass=sysid.FullMass())


def seconds_of(what: str, *case: int) -> float:
    """Processor seconds of one case."""
    if what == "records":
        setting, rng = record_speed.ten_minutes(), np.random.default_rng(0)
        records, _ = setting.with_noise(setting.run(rng).records(), rng)
        begun = time.process_time()
        test = trial.measurement([records], setting, force=True)
        sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
        return time.process_time() - begun
    problem = spectra(*case)
    if what == "fit":
        prepared: Any = getattr(problem, "prepared", problem)  # the older commit searches problems as they are stated
        poles_of(prepared)
        begun = time.process_time()
        modal_structure(prepared, Modal(), IterationMonitor(None, None))
        return time.process_time() - begun
    begun = time.process_time()
    sysid.identify(problem, rng=0)
    return time.process_time() - begun


if __name__ == "__main__":
    answer_cases(seconds_of)
