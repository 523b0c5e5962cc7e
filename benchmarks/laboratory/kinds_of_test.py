"""Kinds of test that laboratories run, as their files, by ``sysid read`` and ``sysid run`` alone, beside the truth.

Finite-element structures that move in closed form; the channels of each test have gains, noise, hum, drift, a clock and
16 bits of their own (`spoiling`). What is in the lines is what the base excites; modes above are residual ones. Of a
structure with a dashpot the modes are those that the lines show, with the answer of those above (`Rig.shown`).

``python -m benchmarks.laboratory.kinds_of_test NUMBER SECONDS`` prints the figures of draw NUMBER % 100 of kind
NUMBER // 100.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.laboratory.judged import figures
from benchmarks.laboratory.kinds import KINDS
from benchmarks.line import Line, above, below

DRAWS, DRAWN = 20, 100
SHORT = {"building": (1,), "weighed": (2,), "stepped": (3,)}  # draws of those that take few seconds
PATIENCE, SHORT_PATIENCE = 240, 40  # s of processor time of one command
SECONDS = 60.0  # of processor time, a run
SHARE, OF_NUMBERS = 0.95, 0.99
FAR = {"f": 4.0, "zeta": 4.0, "drift": 4.0, "M": 5.0, "K": 5.0}  # deviations
NAMES = {"f": "frequencies", "zeta": "damping ratios", "drift": "drifts", "M": "entries of M", "K": "entries of K"}
SIZE, SIZE_OF_H1 = (0.8, 1.3), (0.5, 1.5)  # rms of errors over deviations


def lines(reduced: bool) -> Iterator[Line]:
    """Twenty draws of each kind; or one of three kinds."""
    asked = SHORT if reduced else dict.fromkeys(KINDS, range(DRAWS))
    patience = SHORT_PATIENCE if reduced else PATIENCE
    for kind, draws in asked.items():
        numbers = [DRAWN * list(KINDS).index(kind) + draw for draw in draws]
        every = figures_of_each("laboratory.kinds_of_test", numbers, patience)
        yield from _of_kind(kind, [{"draw": draw} | one for draw, one in zip(draws, every, strict=True)], reduced)


def _of_kind(kind: str, every: list[dict[str, Any]], reduced: bool) -> Iterator[Line]:
    """Lines of one kind; its spread is judged of the full form alone."""
    what = f"{kind}, {len(every)} draws: "
    failed = [f"{it['draw']}: {it.get('said', it.get('refused', ''))[:120]}" for it in every if "word" not in it]
    yield below(f"{what}without an answer{_examples(failed)}", len(failed), 0)
    found = [it for it in every if "word" in it]
    if not found:
        return
    wrong = [f"{it['draw']}: {_rounded(it['found'])} of {_rounded(it['true'])}" for it in found if not it["counted"]]
    yield above(f"{what}share with as many modes as in the lines{_examples(wrong)}", 1 - len(wrong) / len(every), SHARE)
    wrong = [f"{it['draw']}: {it['word']}, {'; '.join(it['against'][:1])}" for it in found if not it["right"]]
    yield above(f"{what}share judged rightly{_examples(wrong)}", 1 - len(wrong) / len(every), SHARE)
    wrong = [f"{it['draw']}: {it['accused'][0]}" for it in found if it["accused"]]
    yield below(f"{what}right records accused{_examples(wrong)}", len(wrong), 0)
    yield below(f"{what}longest run, s of processor time", max(it["seconds"] for it in found), SECONDS)
    for name, most in FAR.items():
        off = np.array([one for it in found for one in it["off"].get(name, [])])
        if off.size:
            text = f"{what}share of {off.size} {NAMES[name]} within {most:g} deviations"
            yield above(text, float(np.mean(np.abs(off) <= most)), OF_NUMBERS)
    off = np.array([one for it in found for name in ("f", "zeta") for one in it["off"].get(name, [])])
    least, widest = SIZE_OF_H1 if kind == "H1" else SIZE
    size, text = float(np.sqrt(np.mean(off**2))), f"{what}rms of errors of f and zeta over deviations"
    bound = ("", None) if reduced else (f"{least:g} to {widest:g}", bool(least <= size <= widest))
    yield Line(text, f"{size:.3g}", *bound)


def _rounded(values: list[float]) -> str:
    return " ".join(f"{one:.4g}" for one in values)


def _examples(texts: list[str], most: int = 4) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""


def case(number: int) -> dict[str, Any]:
    """Figures of one draw."""
    kind, draw = divmod(number, DRAWN)
    return figures(list(KINDS)[kind], draw)


if __name__ == "__main__":
    answer(case)
