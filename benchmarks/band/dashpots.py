"""Structures with a dashpot between two floors: modes counted, C within its intervals; classical ones as they were.

``python -m benchmarks.band.dashpots 5007 SECONDS`` prints figures of five draws of number 7, and of its classical twin.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.band.damped_structures import Damped, damped, draw_of
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.line import Line, above, below

STRUCTURES, SHORT = 20, (0, 3, 7)  # numbers of three that take few seconds
DRAWS = 5  # of each: errors of the entries of one C go together
DRAWN = 1000  # times the draws, and the number of the structure: what one process is asked for
PATIENCE, SHORT_PATIENCE = 120, 15  # s of processor time each
SHARE = 0.95  # of so many structures, one may fail
HELD, HELD_FEW = (0.93, 0.97), (0.85, 1.0)  # share of 95 % intervals; of so few numbers as in the short form
KINDS = {"dashpot": "with a dashpot", "classical": "without"}


def lines(reduced: bool) -> Iterator[Line]:
    """20 structures with a dashpot and the same without, some draws each; or three, one draw each."""
    numbers, draws = (SHORT, 1) if reduced else (range(STRUCTURES), DRAWS)
    cases = figures_of_each(
        "band.dashpots", [DRAWN * draws + it for it in numbers], SHORT_PATIENCE if reduced else PATIENCE
    )
    said = [f"{number}: {it['said'][:80]}" for number, it in zip(numbers, cases, strict=True) if "said" in it]
    yield below(f"{len(cases)} structures, {draws} draws each: without a result {'; '.join(said)}", len(said), 0)
    for kind, name in KINDS.items():
        found = [one for it in cases for one in it.get(kind, [])]
        what = f"{len(found)} tests of structures {name}: share "
        yield above(what + "with as many modes" + _wrong(found, "counted"), _share(found, "counted"), SHARE)
        if kind == "classical":
            yield below(what + "told of damping in quadrature", _share(found, "told"), 0)
        else:
            text = what + "told of damping in quadrature" + _wrong(found, "told")
            yield above(text, _share(found, "told"), SHARE)
        yield above(what + "judged determined" + _wrong(found, "determined"), _share(found, "determined"), SHARE)
        held = [flag for it in found for flag in it.get("held", [])]
        share, (low, high) = float(np.mean(held)) if held else np.nan, HELD_FEW if reduced else HELD
        text = f"{what}of {len(held)} 95 % intervals of C that hold the truth"
        yield Line(text, f"{share:.4f}", f"{low:g} to {high:g}", bool(low <= share <= high))
        most = max((it.get("error", 0.0) for it in found), default=np.nan)
        yield Line(f"structures {name}: largest error of C, over the root of two diagonal entries", f"{most:.3g}")


def _share(found: list[dict], what: str) -> float:
    return float(np.mean([it[what] for it in found])) if found else np.nan


def _wrong(found: list[dict], what: str) -> str:
    wrong = [f"{it['number']} ({it['against']})" for it in found if not it[what]]
    return f"{': not ' * bool(wrong)}{'; '.join(wrong)}"


def figures(truth: Damped, number: int, draw: int) -> dict:
    """Figures of one structure, identified from one draw of its test alone."""
    result = sysid.identify(sysid.Problem(draw_of(truth, number, draw), mass=sysid.FullMass()), rng=0)
    against = [it for it in result.findings if it.severity in ("contradicts", "caution")]
    found = {
        "number": number, "counted": result.structure.n == len(truth.damping), "determined": result.determined,
        "told": bool(result.of_kind("damping")), "against": against[0].sentence[:100] if against else "",
    }  # fmt: skip
    if found["counted"]:
        once = np.tril_indices(len(truth.damping))
        low, high = result.uncertainty.interval("damping")
        size = np.sqrt(np.diag(truth.damping))
        found["held"] = ((low <= truth.damping) & (truth.damping <= high))[once].tolist()
        found["error"] = float(np.max(np.abs(result.structure.damping - truth.damping) / np.outer(size, size)))
    return found


def case(asked: int) -> dict:
    """Figures of a structure with a dashpot, and of the same without; `asked` is its number and how many draws."""
    draws, number = divmod(asked, DRAWN)
    return {
        kind: [figures(damped(number, classical=kind == "classical"), number, draw) for draw in range(draws)]
        for kind in KINDS
    }


if __name__ == "__main__":
    answer(case)
