"""Answers of a test of random structures or of coupled records, in a process of its own.

``python one_answer.py`` takes the package on its path, reads a case, ``[what, seed]``, and answers each with the
judgement, M, K and C, and their deviations.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import sysid
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.older import answer_cases
from benchmarks.records import trial
from benchmarks.records.simulated import coupled

NOISE = 0.01
MATRICES = ("mass", "stiffness", "damping")


def test_of(what: str, seed: int) -> sysid.Measurement:
    """Spectra of a random structure ("spectra"), or records of a coupled one ("records"), with force and noise."""
    if what == "spectra":
        truth = random_structure(seed)
        return sysid.simulate(truth, frequency_lines(truth), force=True, noise=NOISE, rng=seed)
    setting, rng = coupled(seed), np.random.default_rng((seed, 0, 5))
    records, _ = setting.with_noise(setting.run(rng).records(), rng)
    return trial.measurement([records], setting, force=True)


def answer(what: str, seed: int) -> dict[str, Any]:
    """Judgement, matrices (n, n) of the sensors and their deviations, and what contradicts them; or the error."""
    try:
        found: Any = sysid.identify(sysid.Problem(test_of(what, seed), mass=sysid.FullMass()), rng=0)
    except (sysid.InputError, sysid.SolverError) as error:
        return {"judgement": f"error: {error}", "against": [], **{name: [[]] for name in MATRICES}}
    n, against = found.structure.n, getattr(found, "against", None)  # the older commit has sentences
    if against is None:
        against = found.contradictions
    # The older commit had no word for a fit that something contradicts.
    word = "doubtful" if found.success and against and not found.determined else found.judgement
    matrices = {name: getattr(found.structure, name)[:n, :n].tolist() for name in MATRICES}
    deviations = {f"{name} std": getattr(found.uncertainty, name).tolist() for name in MATRICES}
    return {"judgement": word, "against": [str(one) for one in against], **matrices, **deviations}


if __name__ == "__main__":
    answer_cases(answer)
