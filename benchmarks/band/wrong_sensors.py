"""Continuous structures with one wrong sensor each, by its sign, its axis or a gain of 5 %: it is named.

``python -m benchmarks.band.wrong_sensors NUMBER SECONDS`` prints the figures of one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import sysid
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import structure
from benchmarks.line import Line, above

MISTAKES = ("sign", "axis", "gain")  # in turn; each structure has all of them
TESTS, PATIENCE = 100, 120  # s of processor time each
SHORT, SHORT_PATIENCE = (21, 22, 23), 20  # numbers of structure 7, which takes few seconds
GAIN = 1.05
NAMED = 0.95
MOVING = 0.3  # of the largest motion with the base: what moves less tells little of its own


def lines(reduced: bool) -> Iterator[Line]:
    """A hundred tests; or three."""
    numbers = list(SHORT if reduced else range(TESTS))
    found = figures_of_each("band.wrong_sensors", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    named = [it.get("named", False) for it in found]
    missed = Counter(MISTAKES[k % len(MISTAKES)] for k, right in zip(numbers, named, strict=True) if not right)
    tally = ", ".join(f"{kind} {times}" for kind, times in missed.items())
    what = f"{len(found)} continuous structures with one wrong sensor: "
    yield above(
        what + f"share of them named (missed: {tally or 'none'})",
        float(np.mean(named)),
        NAMED,
    )
    others = sum(it.get("others", 0) > 0 for it in found)
    yield Line(what + "tests in which others are accused beside it", f"{others} of {len(found)}")
    said = [f"{k}: {it['said'][:100]}" for k, it in zip(numbers, found, strict=True) if "said" in it]
    yield Line(what + "without a result" + f" ({'; '.join(said[:4])})" * bool(said), str(len(said)))


def wrong_test(number: int) -> tuple[sysid.Measurement, str]:
    """A test with one mistake, and the name of its sensor."""
    test, mistake = draw(structure(number // len(MISTAKES))).measurement, MISTAKES[number % len(MISTAKES)]
    G, rng = test.rigid_body, np.random.default_rng((number, 43))
    moved = np.max(np.abs(G) / np.maximum(np.max(np.abs(G), axis=0), 1e-300), axis=1)
    sensor = int(rng.choice(np.flatnonzero(moved > MOVING)))
    if mistake == "axis":  # stated along another axis of the base, or along one that the base does not move
        stated = G.copy()
        stated[sensor] = np.roll(G[sensor], 1) if test.n_base > 1 else 0.0
        return replace(test, rigid_body=stated), test.sensor_names[sensor]
    factor = np.ones((test.n_sensors, 1))
    factor[sensor] = -1.0 if mistake == "sign" else GAIN
    std = None if test.response_std is None else np.abs(factor) * test.response_std
    return replace(test, response=factor * test.response, response_std=std), test.sensor_names[sensor]


def case(number: int) -> dict:
    """True where the wrong sensor is named; how many others are, and what is said."""
    test, wrong = wrong_test(number)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    names = {one.channel for one in result.contradictions if one.channel is not None}
    return {
        "named": wrong in names,
        "others": len(names - {wrong}),
        "kinds": [one.kind for one in result.contradictions],
    }


if __name__ == "__main__":
    answer(case)
