"""A sensor whose gain is 2 % wrong: whether results say so, and whether right sensors are left alone.

Each case is one test with base force, with and without noise, of which the record of one sensor, whose row of G is not
zero, is 2 % too large. A case is silent where the result is called determined, though a diagonal entry of M_SS is
further than three stated deviations from the truth, and no sentence tells of that sensor's gain in figures: neither one
that calls it wrong nor one that says M_SS rests on it. The latter accuses nothing; for how many sensors of right tests
it comes is told and bounded, since a sentence that always comes would tell nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.random_structures import frequency_lines, random_structure

ERROR, NOISE = 0.02, (0.0, 0.01)
FAR = 3.0  # stated deviations
RANDOM, STOREYS, RIGHT = 36, 4, 300  # structures of each kind, and right tests with 1 % noise
CHANCE = 1 / 300  # of right records that may be accused
COMMON = 70  # % of the sensors of right tests whose gain may be told as one that M_SS rests on


class Case(NamedTuple):
    """A structure, its test, and the models that it is identified by."""

    truth: sysid.Structure
    test: sysid.Measurement
    models: dict[str, object]

    @property
    def problem(self) -> sysid.Problem:
        """Of the test as it is."""
        return sysid.Problem(self.test, **self.models)


class Outcome(NamedTuple):
    """Judgement of a result, gains that it calls wrong, and how far M_SS is off in stated deviations.

    And the names of the sensors whose gain it tells in figures, with how many there are.
    """

    determined: bool
    named: bool
    off: float
    told: frozenset[str] = frozenset()
    sensors: int = 0


def lines(reduced: bool) -> Iterator[Line]:
    """Wrong gains that are silent and that are named, and right tests that are accused."""
    wrong = [(sensor, outcome(case)) for sensor, case in wrong_cases(reduced)]
    silent = [it.off for sensor, it in wrong if it.determined and it.off > FAR and sensor not in it.told]
    yield below(f"{len(wrong)} tests, one sensor 2 % wrong: silent, M off by over 3 deviations", len(silent), 0)
    yield above(
        "the same: % in which the gain is called wrong", 100 * float(np.mean([it.named for _, it in wrong])), 75
    )
    right = [outcome(case) for case in right_cases(reduced)]
    accused = [it.named for it in right]
    yield Line(
        f"{len(right)} right tests: gains that are accused", str(sum(accused)), f"<= 1 in {1 / CHANCE:.0f}",
        float(np.mean(accused)) <= CHANCE,
    )  # fmt: skip
    share = 100 * sum(len(it.told) for it in right) / sum(it.sensors for it in right)
    yield below("the same: % of the sensors that M_SS is said to rest on", share, COMMON)


def outcome(case: Case) -> Outcome:
    """Identify, and compare with the truth; no structure, or one of other degrees of freedom, is nowhere."""
    sensors = case.test.n_sensors
    try:
        result = sysid.identify(case.problem, rng=0)
    except sysid.InputError as error:
        return Outcome(False, "gain" in str(error), np.inf, sensors=sensors)
    accused = result.of_kind("gain")
    told = frozenset(one.channel for one in (*accused, *result.of_kind("gain not shown")) if one.channel)
    n = case.truth.n
    if result.structure.n != n:
        return Outcome(result.determined, bool(accused), np.inf, told, sensors)
    off = np.abs(np.diag(result.structure.mass) - np.diag(case.truth.mass))[:n]
    off = float(np.max(off / np.diag(result.uncertainty.mass)[:n]))
    return Outcome(result.determined, bool(accused), off, told, sensors)


def misread(case: Case, sensor: int) -> tuple[str, Case]:
    """The same case with the record of one sensor 2 % too large, and the sensor's name."""
    response = case.test.response.copy()
    response[:, sensor] *= 1 + ERROR
    return case.test.sensor_names[sensor], case._replace(test=replace(case.test, response=response))


def wrong_cases(reduced: bool) -> Iterator[tuple[str, Case]]:
    """Random structures with full masses; buildings with lumped masses and as chains; and which sensor is wrong."""
    for seed in range(1, 4) if reduced else range(RANDOM):
        # Without noise poles are sought down to round-off, which takes ten times as long.
        for noise in NOISE[1:] if reduced and seed < 3 else NOISE:
            case = of_random(seed, noise)
            yield misread(case, seed % case.truth.n)
    for seed in range(1 if reduced else STOREYS):
        for noise in NOISE:
            for chain in (False,) if reduced else (False, True):
                case = of_storeys(seed, noise, chain=chain)
                yield misread(case, seed % case.truth.n)


def right_cases(reduced: bool) -> Iterator[Case]:
    """Random structures with full masses and 1 % noise, and a building."""
    yield of_storeys(0, NOISE[-1], chain=False)
    for seed in range(1000, 1012 if reduced else 1000 + RIGHT):
        yield of_random(seed, NOISE[-1])


def of_random(seed: int, noise: float) -> Case:
    """A full, coupled mass of 4 to 10 sensors in 1 to 3 directions."""
    rng = np.random.default_rng(seed)
    truth = random_structure(seed, n=int(rng.integers(4, 11)), d=int(rng.integers(1, 4)))
    test = sysid.simulate(truth, frequency_lines(truth), noise=noise, force=True, rng=seed)
    return Case(truth, test, {"mass": sysid.FullMass()})


def of_storeys(seed: int, noise: float, *, chain: bool) -> Case:
    """Two to four storeys, each a mass on columns; as springs in a row with the total mass stated, or by its modes."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    k, masses = rng.uniform(3e3, 8e3, n), rng.uniform(2, 5, n)
    across = np.eye(n, n + 1) - np.eye(n, n + 1, -1)
    across[0, n] = -1.0  # the base comes last
    stiffness = (across.T * k) @ across
    truth = sysid.Structure(np.diag([*masses, 0.0]), stiffness, rng.uniform(0.01, 0.02, n), n_base=1)
    test = sysid.simulate(truth, frequency_lines(truth, 300), noise=noise, force=True, rng=seed)
    if not chain:
        return Case(truth, test, {"mass": sysid.LumpedMass()})
    total = float(masses.sum())
    return Case(truth, test, {"mass": sysid.LumpedMass(total), "stiffness": sysid.ChainStiffness(1e3, 2e4)})
