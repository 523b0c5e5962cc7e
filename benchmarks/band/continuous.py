"""Continuous structures with more modes than the band: what is determined, counted, accused, and how exact it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from benchmarks.band.cramer_rao import Bound, bound
from benchmarks.band.own_process import figures_of_each
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import Continuous, structure
from benchmarks.line import Line, above, below

STRUCTURES, SHORT = 60, (1, 7, 10)  # numbers of three that take few seconds
PATIENCE, SHORT_PATIENCE = 120, 15  # s of processor time a structure, after which it has no result
KNOWN = 0.1  # of the root of two diagonal entries: deviations of M, where it must be determined
SHARE_KNOWN = 0.75  # of all structures: 45 of 60
SHARE = 0.97
HELD = (0.93, 0.97)  # share of 95 % intervals that hold the truth
HELD_FEW = (0.85, 1.0)  # of so few numbers as in the short form: three to four deviations away
RATIO, RATIO_FEW = 1.15, 1.4  # rms error over the bound
DRIVE = 0.02  # of a superelement's base drive
SHOWN = 4  # examples in a line

Case = tuple[Continuous, Bound, dict]


def lines(reduced: bool) -> Iterator[Line]:
    """60 structures, one draw each; or three, with little patience."""
    numbers = SHORT if reduced else range(STRUCTURES)
    truths, count = [structure(number) for number in numbers], len(numbers)
    answers = figures_of_each("band.one_structure", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    cases = [(truth, bound(truth, draw(truth)), it) for truth, it in zip(truths, answers, strict=True)]
    what = f"{count} continuous structures: "
    known = [case for case in cases if case[1].of_mass < KNOWN]
    text = what + f"share whose Cramér-Rao deviations of M are below {KNOWN:g}"
    yield above(text, len(known) / count, SHARE_KNOWN)
    yield _poles(what, cases)
    yield _without(what, cases)
    yield _determined(what, known)
    yield _counted(what, cases)
    yield _accused(what, cases)
    yield _intervals(what, cases, HELD_FEW if reduced else HELD)
    yield from _errors(what, cases, RATIO_FEW if reduced else RATIO)
    yield _superelements(what, cases)
    slowest = max(cases, key=lambda case: case[2].get("seconds", 0.0))
    yield Line(what + f"seconds of processor time of the slowest with a result ({slowest[0].name})",
               f"{slowest[2].get('seconds', np.nan):.1f}")  # fmt: skip


def _poles(what: str, cases: list[Case]) -> Line:
    poles = [least.poles for _, least, _ in cases]
    more = sum(least.poles > max(len(truth.base), 2) for truth, least, _ in cases)
    text = what + f"poles above the lines that the tests ask for, median and most; more than max(d, 2) in {more}"
    return Line(text, f"{np.median(poles):g}, {max(poles)}")


def _without(what: str, cases: list[Case]) -> Line:
    said = [f"{truth.name}: {it['said'][:100]}" for truth, _, it in cases if "said" in it]
    return Line(what + "without a result" + _examples(said), f"{len(said)} of {len(cases)}", "0", not said)


def _determined(what: str, known: list[Case]) -> Line:
    reasons = Counter(it["open"].partition(":")[0] for _, _, it in known if "said" not in it and not it["determined"])
    tally = ", ".join(f"{reason} {times}" for reason, times in reasons.most_common())
    text = what + f"share determined of these {len(known)} (first against it: {tally or 'nothing'})"
    return above(text, float(np.mean([it.get("determined", False) for _, _, it in known])), SHARE)


def _counted(what: str, cases: list[Case]) -> Line:
    right = [it.get("found") == it.get("matched") == truth.count for truth, _, it in cases]
    wrong = [
        f"{truth.name}: {it.get('found', 'no')} found, {it.get('matched', 'none')} of them true"
        for (truth, _, it), good in zip(cases, right, strict=True) if not good
    ]  # fmt: skip
    return above(what + "share with as many modes as in the lines" + _examples(wrong), float(np.mean(right)), SHARE)


def _accused(what: str, cases: list[Case]) -> Line:
    accused = [f"{truth.name}: {it['accused'][0][:120]}" for truth, _, it in cases if it.get("accused")]
    return below(what + "with a right sensor accused" + _examples(accused), len(accused), 0)


def _intervals(what: str, cases: list[Case], ends: tuple[float, float]) -> Line:
    held = _pooled(cases, "held")
    every = [flag for flags in held.values() for flag in flags]
    share = float(np.mean(every)) if every else np.nan
    each = ", ".join(f"{name} {np.mean(flags):.3f}" for name, flags in held.items() if flags)
    text = what + f"share of {len(every)} 95 % intervals in the band that hold the truth ({each})"
    return Line(text, f"{share:.4f}", f"{ends[0]:g} to {ends[1]:g}", bool(ends[0] <= share <= ends[1]))


def _errors(what: str, cases: list[Case], most: float) -> Iterator[Line]:
    ratios = _pooled(cases, "ratios")
    for name, values in ratios.items():
        text = what + f"rms error over the Cramér-Rao bound, {name}, {len(values)} numbers"
        yield below(text, float(np.sqrt(np.mean(np.square(values)))), most)
    if not ratios:
        yield Line(what + "errors", "none to compare", "", False)


def _superelements(what: str, cases: list[Case]) -> Line:
    few = [it for truth, least, it in cases if truth.count > len(least.dofs)]
    text = what + f"with fewer sensors than modes, {len(few)}: share determined, base drive within {DRIVE:g}"
    good = [it.get("determined", False) and it["drive"] <= DRIVE for it in few]
    return above(text, float(np.mean(good)), SHARE) if few else Line(text, "none")


def _pooled(cases: list[Case], what: str) -> dict[str, list]:
    """Figures of all cases by their names."""
    pooled: dict[str, list] = {}
    for _, _, it in cases:
        for name, values in it.get(what, {}).items():
            pooled.setdefault(name, []).extend(values)
    return pooled


def _examples(texts: list[str]) -> str:
    return f" ({'; '.join(texts[:SHOWN])})" if texts else ""
