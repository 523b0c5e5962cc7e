"""Two runs of 40 and 80 s, one three times as strong, against one run of 120 s: errors of the same structure."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.modal.spread import spread
from benchmarks.records import trial
from benchmarks.records.cramer_rao import Bound, all_entries, bound
from benchmarks.records.simulated import Levels, Records, Run, four_storeys
from benchmarks.records.trial import Trial

RUNS = {"one run": ((120.0, 1.0),), "two runs": ((40.0, 3.0), (80.0, 1.0))}  # durations, s, and strengths
WITHIN = 1.2  # ratio of rms errors, either way
FEW = 1.6  # the same of fewer draws than prove anything


def lines(reduced: bool) -> Iterator[Line]:
    """Full mass, with force; 100 draws of each, or 2."""
    draws = 2 if reduced else 100
    trials = spread(draw, [(name, number) for name in RUNS for number in range(draws)])
    rms = {}
    for name in RUNS:
        own = [t for t in trials if t.group == name]
        yield trial.verdicts(name, own, determined=True)
        errors = np.array([r for t in own for ratios in t.ratios.values() for r in ratios])
        rms[name] = float(np.sqrt(np.mean(errors**2))) if errors.size else np.nan
        yield from trial.coverages(name, own, cells=False)
    most = FEW if reduced else WITHIN
    ratio = rms["two runs"] / rms["one run"]
    two, one = _reference("two runs"), _reference("one run")
    squares = [np.ravel((getattr(two, kind) / getattr(one, kind)) ** 2) for kind in trial.KINDS]
    expected = float(np.sqrt(np.mean(np.concatenate(squares))))
    text = f"rms error of two runs over that of one, in units of one bound (of the bounds themselves {expected:.3f})"
    yield Line(text, f"{ratio:.4f}", f"{1 / most:.3g} to {most:g}", bool(1 / most <= ratio <= most))


def draw(task: tuple[str, int]) -> Trial:
    """One draw: which runs, and number."""
    return trial.attempt(task[0], lambda: _draw(*task))


def _draw(name: str, number: int) -> Trial:
    setting = four_storeys()
    tests, records = _runs(name, number)
    test = trial.measurement(records, setting, force=True)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    return trial.judged(name, result, setting.structure, _reference("one run"), tests[0][1])


def _runs(name: str, number: int) -> tuple[list[tuple[Run, Levels]], list[Records]]:
    setting, rng = four_storeys(), np.random.default_rng((number, len(RUNS[name]), 6))
    tests, noisy = [], []
    for duration, strength in RUNS[name]:
        run = setting.run(rng, duration, strength)
        records, levels = setting.with_noise(run.records(), rng)
        tests.append((run, levels))
        noisy.append(records)
    return tests, noisy


@cache
def _reference(name: str) -> Bound:
    """Bound of the first draw; errors of all draws are counted in that of the one run."""
    setting = four_storeys()
    unknowns = all_entries(setting.structure.n, setting.structure.n_base)
    return bound(setting.structure, _runs(name, 0)[0], setting.lines, unknowns, force=True)
