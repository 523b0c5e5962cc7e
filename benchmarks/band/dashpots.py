"""Structures with a dashpot between two floors: modes counted, C within its intervals; classical ones as they were.

``python -m benchmarks.band.dashpots NUMBER SECONDS`` prints the figures of one and of its classical twin.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.band.damped_structures import Damped, damped, test_of
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.line import Line, above, below

STRUCTURES, SHORT = 20, (0, 3, 7)  # numbers of three that take few seconds
PATIENCE, SHORT_PATIENCE = 60, 15  # s of processor time each
SHARE = 0.95  # of so many structures, one may fail
HELD, HELD_FEW = (0.93, 0.97), (0.85, 1.0)  # share of 95 % intervals; of so few numbers as in the short form
KINDS = {"dashpot": "with a dashpot", "classical": "without"}


def lines(reduced: bool) -> Iterator[Line]:
    """20 structures with a dashpot and the same without, one draw each; or three."""
    numbers = SHORT if reduced else range(STRUCTURES)
    cases = figures_of_each("dashpots", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    low, high = HELD_FEW if reduced else HELD
    said = [f"{number}: {it['said'][:80]}" for number, it in zip(numbers, cases, strict=True) if "said" in it]
    yield below(f"{len(cases)} structures without a result {'; '.join(said)}", len(said), 0)
    for kind, name in KINDS.items():
        found = [it.get(kind, {}) for it in cases]
        what = f"{len(cases)} structures {name}: "
        yield above(what + _wrong("share with as many modes", numbers, found, "counted"), _share(found, "counted"), SHARE)
        told = "told of damping in quadrature"
        if kind == "classical":
            yield below(what + told, sum(it.get("told", True) for it in found), 0)
        else:
            yield above(what + _wrong(f"share {told}", numbers, found, "told"), _share(found, "told"), SHARE)
        text = _wrong("share judged determined", numbers, found, "determined")
        yield above(what + text, _share(found, "determined"), SHARE)
        held = [flag for it in found for flag in it.get("held", [])]
        text = f"{what}share of {len(held)} 95 % intervals of C that hold the truth"
        share = float(np.mean(held)) if held else np.nan
        yield Line(text, f"{share:.4f}", f"{low:g} to {high:g}", bool(low <= share <= high))
        yield Line(what + "largest error of C, over the root of two diagonal entries",
                   f"{max(it.get('error', 0.0) for it in found):.3g}")  # fmt: skip


def _share(found: list[dict], what: str) -> float:
    return float(np.mean([it.get(what, False) for it in found]))


def _wrong(text: str, numbers: Iterator[int], found: list[dict], what: str) -> str:
    wrong = [f"{number} ({it.get('against', '')})" for number, it in zip(numbers, found, strict=True) if not it.get(what)]
    return f"{text}{': not ' * bool(wrong)}{'; '.join(wrong)}"


def figures(truth: Damped, number: int) -> dict:
    """Figures of one structure, identified from its test alone."""
    begun = time.process_time()
    result = sysid.identify(sysid.Problem(test_of(truth, number), mass=sysid.FullMass()), rng=0)
    against = [it for it in result.findings if it.severity in ("contradicts", "caution")]
    found = {
        "counted": result.structure.n == len(truth.damping), "determined": result.determined,
        "told": bool(result.of_kind("damping")), "against": against[0].sentence[:100] if against else "",
        "seconds": time.process_time() - begun,
    }  # fmt: skip
    if found["counted"]:
        once = np.tril_indices(len(truth.damping))
        low, high = result.uncertainty.interval("damping")
        size = np.sqrt(np.diag(truth.damping))
        found["held"] = ((low <= truth.damping) & (truth.damping <= high))[once].tolist()
        found["error"] = float(np.max(np.abs(result.structure.damping - truth.damping) / np.outer(size, size)))
    return found


def case(number: int) -> dict:
    """Figures of a structure with a dashpot, and of the same without."""
    return {kind: figures(damped(number, classical=kind == "classical"), number) for kind in KINDS}


if __name__ == "__main__":
    answer(case)
