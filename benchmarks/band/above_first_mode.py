"""Continuous structures whose lines begin above their first or second mode: right sensors and masses are not accused.

What modes below the lines add there is a constant, as of a wrong sign, gain or mass. In every second test the true
rigid-body mass is stated. ``python -m benchmarks.band.above_first_mode NUMBER SECONDS`` prints the figures of one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice

import numpy as np

import sysid
from benchmarks.band.one_structure import accusations
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import APART, END, Continuous, structure
from benchmarks.line import Line, below

TESTS, PATIENCE = 20, 120  # s of processor time each
SHORT, SHORT_PATIENCE = (7, 13), 20  # numbers that take few seconds
BELOW = (1, 2)  # modes below the lines
LEAST = 2  # modes in them


def lines(reduced: bool) -> Iterator[Line]:
    """Twenty tests; or two."""
    numbers = list(SHORT if reduced else islice((k for k in count() if cut(k)), TESTS))
    answers = figures_of_each("band.above_first_mode", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    found = {structure(k).name: it for k, it in zip(numbers, answers, strict=True)}
    what = f"{len(found)} tests whose lines begin above the first or second mode: "
    for text, of in (
        ("without a result", {name: it["said"] for name, it in found.items() if "said" in it}),
        ("a right sensor or mass accused", {n: it["accused"][0] for n, it in found.items() if it.get("accused")}),
        ("not told of modes below", {n: "" for n, it in found.items() if not it.get("told", True)}),
    ):
        shown = "; ".join(f"{name}: {sentence[:120]}" for name, sentence in of.items())
        yield below(what + text + f" ({shown})" * bool(of), len(of), 0)
    off = [it["mass"] for it in found.values() if "mass" in it]
    yield Line(what + "rigid-body mass off the truth, median and most", f"{np.median(off):.2g}, {max(off):.2g}")


def cut(number: int) -> Continuous | None:
    """Structure `number` with lines that begin between two modes; None where these leave no room, or too few."""
    truth, rng = structure(number), np.random.default_rng((number, 41))
    f = truth.frequencies
    room = [k for k in BELOW if truth.count >= k + LEAST and f[k] > APART * f[k - 1]]
    if not room:
        return None
    k = int(rng.choice(room))
    return replace(truth, lines=(float(f[k - 1] + rng.uniform(*END) * (f[k] - f[k - 1])), truth.lines[1]))


def case(number: int) -> dict:
    """What is told of one test."""
    truth = cut(number)
    assert truth is not None
    right = truth.modes.rigid_body_mass
    stated = sysid.FullMass(right, healing="rigid_body") if number % 2 else sysid.FullMass()
    result = sysid.identify(sysid.Problem(draw(truth).measurement, mass=stated), rng=0)
    size = np.sqrt(np.diag(right))
    off = np.max(np.abs(result.structure.rigid_body_mass - right) / np.outer(size, size))
    return {"accused": accusations(result), "told": bool(result.of_kind("modes below")), "mass": float(off)}


if __name__ == "__main__":
    answer(case)
