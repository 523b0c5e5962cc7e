"""Gains within stated tolerances, and gains that are wrong, of continuous structures.

Each channel's record, base and force included, is multiplied by one and an error of its gain. Structures are those of
`benchmarks.band`, with modes above the lines, that take a few seconds each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

import sysid
from benchmarks.band.cramer_rao import bound
from benchmarks.band.one_structure import accusations, intervals_held
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import Continuous, structure
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread
from benchmarks.records.coupled_records import NEAR, matched

TOLERANCE = 0.005
WRONG, MISREAD = 0.04, 0.02  # beyond tolerances, and beside exact gains
KNOWN = 0.002  # deviation of a gain, below which a wrong one is to be told
MASS = 0.1  # deviation of M by the bound, below which it is to be determined
DRAWS, SHORT = 100, 3
MODES = 6  # in the lines, at most
STRUCTURES = tuple(range(48))
QUICK = (7, 25, 7)  # which take a second each
COVERED, DETERMINED, ACCUSED, NAMED, OF_BASE = (0.93, 0.97), 0.97, 0.05, 0.97, 0.95
CASES = ("within", "beyond", "one sensor", "base")


@dataclass(frozen=True)
class Found:
    """What came of one test; `right` as its case asks, None where its gain is not known closely enough."""

    name: str
    case: str
    right: bool | None
    determined: bool | None
    accused: list[str]
    held: dict[str, list[bool]]
    said: str


def lines(reduced: bool) -> Iterator[Line]:
    """A hundred tests a case; or a few."""
    count, numbers = (SHORT, QUICK) if reduced else (DRAWS, STRUCTURES)
    found = spread(one_test, [(case, number, numbers) for case in CASES for number in range(count)])
    within, beyond, misread, of_base = ([one for one in found if one.case == case] for case in CASES)
    text = f"{len(within)} tests with gains within {TOLERANCE:.1%}: "
    for name in within[0].held:
        every = [inside for one in within for inside in one.held.get(name, [])]
        yield Line(text + f"intervals of 95 % that hold, {name}", f"{np.mean(every):.4f} of {len(every)}")
    every = [inside for one in within for of_one in one.held.values() for inside in of_one]
    if not reduced:
        share, (least, most) = float(np.mean(every)), COVERED
        met = least <= share <= most
        yield Line(text + f"{len(every)} intervals of 95 % that hold", f"{share:.4f}", f"{least}-{most}", met)
    accused = [f"{one.name}: {one.accused[0][:80]}" for one in within if one.accused]
    yield below(text + f"share accused{_examples(accused)}", len(accused) / len(within), ACCUSED)
    asked = [one for one in within if one.determined is not None]
    open_ = [f"{one.name}: {one.said[:100]}" for one in asked if not one.determined]
    yield above(text + f"{len(asked)} whose bound allows it determined{_examples(open_)}",
                float(np.mean([one.determined for one in asked])), DETERMINED)  # fmt: skip
    for some, what, least in (
        (beyond, f"{WRONG:.0%} on one sensor, others within {TOLERANCE:.1%}", NAMED),
        (misread, f"{MISREAD:.0%} on one sensor, nothing stated", NAMED),
        (of_base, f"{MISREAD:.0%} on the base, nothing stated", OF_BASE),
    ):
        told = [one for one in some if one.right is not None]
        missed = [f"{one.name}: {one.said[:100]}" for one in told if not one.right]
        if told:
            share = float(np.mean([one.right for one in told]))
            yield above(f"{what}, {len(told)} gains known within {KNOWN:.1%}: named{_examples(missed)}", share, least)


def one_test(task: tuple[str, int, tuple[int, ...]]) -> Found:
    """One test of a case, of structures of these numbers in turn."""
    case, number, numbers = task
    every = _of(numbers)
    truth = every[number % len(every)]
    given = draw(truth, number // len(every))
    test, rng = given.measurement, np.random.default_rng((number, CASES.index(case), 57))
    n, d = test.rigid_body.shape
    std = TOLERANCE if case in ("within", "beyond") else 0.0
    errors = std * rng.standard_normal(n + 2 * d)
    driven = np.flatnonzero(np.max(np.abs(test.rigid_body), axis=1) > 0.3)
    wrong, channel = int(rng.choice(driven)), ""
    if case in ("beyond", "one sensor"):
        errors[wrong] += rng.choice([-1, 1]) * (WRONG if std else MISREAD)
        channel = test.sensor_names[wrong]
    if case == "base":
        axis = int(rng.integers(d))
        errors[n + axis] = rng.choice([-1, 1]) * MISREAD
        channel = f"base {test.base_axes[axis]}"
    read = _misread(test, 1 + errors)
    if std:
        read = replace(read, gain_std=std, base_gain_std=std, force_gain_std=std)
    result = sysid.identify(sysid.Problem(read, mass=sysid.FullMass()), rng=0)
    said = next((f"{one.kind}: {one.sentence}" for one in result.findings if one.severity != "note"), "nothing")
    name, known = f"{truth.name} (test {number})", np.where(np.isnan(result.gains.std), np.inf, result.gains.std)
    if case == "within":
        least = bound(truth, given)
        mine = _mine(result, truth, least)
        determined = result.determined if least.of_mass < MASS else None
        inside = {} if mine is None else intervals_held(result, least, mine)
        return Found(name, case, None, determined, accusations(result), inside, said)
    told = {one.channel for one in result.contradictions}
    at = [wrong] if case != "base" else np.flatnonzero(np.abs(test.rigid_body[:, axis]) > 0.7)
    closely = len(at) > 0 and np.sum(known[at] ** -2.0) ** -0.5 < KNOWN and (case != "base" or len(at) > 2)
    return Found(name, case, channel in told if closely else None, None, [], {}, said)


@lru_cache
def _of(numbers: tuple[int, ...]) -> list[Continuous]:
    """Those with few modes in the lines, and sensors for all of them."""
    return [one for one in map(structure, numbers) if one.count <= MODES and len(one.modes.shapes) >= one.count]


def _misread(test: sysid.Measurement, factor: np.ndarray) -> sysid.Measurement:
    """The test as channels with these gains record it."""
    n, d = test.rigid_body.shape
    sensors, base, force = np.split(factor[:, None], [n, n + d])
    std, force_std = test.response_std, test.force_std
    return replace(
        test, response=sensors * test.response, base=base * test.base, force=force * test.force,
        response_std=None if std is None else sensors * std, force_std=None if force_std is None else force * force_std,
    )  # fmt: skip


def _mine(result: sysid.Identification, truth: Continuous, least) -> np.ndarray | None:
    """Modes found that are those in the lines, in their order; None where they are not."""
    found = result.structure.natural_frequencies
    inside = np.flatnonzero(found <= truth.lines[1])
    f = least.values["natural_frequencies"]
    near = np.maximum(NEAR[0] * least.std["natural_frequencies"], NEAR[1] * least.values["damping_ratios"] * f)
    pairs = matched(f, found[inside], near)
    return inside[[j for _, j in pairs]] if len(pairs) == len(inside) == truth.count else None


def _examples(texts: list[str], most: int = 3) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""
