"""One identification from simulated records: its verdict, its intervals, its errors over the Cramér-Rao bound."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import norm

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.identification import error_text
from benchmarks.records.cramer_rao import Bound
from benchmarks.records.simulated import Levels, Records, Setting

ESTIMATOR = "records"
LEVEL = 0.95
POOLED, EACH = (0.93, 0.97), 0.87  # share of 95 % intervals that hold the truth: of all, of a cell
RATIOS = (1.10, 1.25)  # rms error over the bound: of all, of a cell
FEW = ((0.85, 1.0), 1.4)  # the same, pooled, of fewer draws than prove anything: three to four deviations away
STATED = (0.9, 1.1)  # stated deviations over those of the bound: levels of noise are found within 5 %
LEVELS_WITHIN, LEVELS_SHARE = 0.05, 0.95
VERDICTS = 0.97
PROVEN = 100  # draws; cells of fewer are printed, not judged

KINDS = {
    "natural_frequencies": "frequency",
    "damping_ratios": "damping ratio",
    "mass": "M",
    "stiffness": "K",
    "damping": "C",
}


@dataclass(frozen=True)
class Trial:
    """Outcome of one draw.

    Attributes
    ----------
    group : str
        Statement or structure that it belongs to.
    determined : bool
    found : int
        Modes.
    held : dict of str to list of bool
        Whether each 95 % interval of a kind of quantity holds the truth.
    ratios : dict of str to list of float
        Each error over its bound.
    stated : dict of str to float
        Geometric mean of the stated deviations of a kind over their bounds.
    levels : list of float
        Levels of noise found over the true ones; empty where none are told.
    accusations : tuple of str
        All sentences that speak against the answer, and remarks that doubt a record.
    open : tuple of str
        Why the matrices are not determined.
    said : str
        The error, where there was one.
    """

    group: str
    determined: bool = False
    found: int = 0
    held: dict[str, list[bool]] = field(default_factory=dict)
    ratios: dict[str, list[float]] = field(default_factory=dict)
    stated: dict[str, float] = field(default_factory=dict)
    levels: list[float] = field(default_factory=list)
    accusations: tuple[str, ...] = ()
    open: tuple[str, ...] = ()
    said: str = ""


def measurement(runs: Sequence[Records], setting: Setting, *, force: bool) -> sysid.Measurement:
    """The test as a laboratory hands it over: nothing is told but rate, axes and band."""
    return sysid.Measurement.from_time(
        [(run.base, run.response, run.force if force else None) for run in runs],
        setting.sample_rate,
        rigid_body=setting.structure.rigid_body,
        band=setting.lines,
        estimator=ESTIMATOR,
    )


def attempt(group: str, function: Callable[[], Trial]) -> Trial:
    """Give what a draw gives; a crash is an answer too, and must not end the others."""
    try:
        return function()
    except Exception as error:
        return Trial(group, said=error_text(error))


def judged(group: str, result: sysid.Identification, truth: sysid.Structure, least: Bound, levels: Levels) -> Trial:
    """Compare a result with the truth; modes' quantities only where matrices cannot be compared or are open."""
    held: dict[str, list[bool]] = {}
    ratios: dict[str, list[float]] = {}
    stated: dict[str, float] = {}
    found = result.structure
    for name in KINDS if found.n == truth.n else ():
        exact, value, std = (getattr(it, name) for it in (truth, found, least))
        part = np.tril_indices(truth.n) if std.ndim == 2 else slice(None)
        low, high = result.uncertainty.interval(name, level=LEVEL)
        free = std[part] > 1e-9 * np.max(std, initial=0.0)  # what is stated has no interval
        low, high = low[part][free], high[part][free]
        if std.ndim == 2 and not np.all(np.isfinite(low)):
            continue  # the matrices are open
        exact = exact[: truth.n, : truth.n] if std.ndim == 2 else exact
        value = value[: truth.n, : truth.n] if std.ndim == 2 else value
        exact, value = exact[part][free], value[part][free]
        held[name] = ((low <= exact) & (exact <= high)).tolist()
        ratios[name] = ((value - exact) / std[part][free]).tolist()
        if np.any(free):
            width = (high - low) / (2 * norm.ppf((1 + LEVEL) / 2))
            stated[name] = float(np.exp(np.mean(np.log(width / std[part][free]))))
    accusations = [str(one) for one in (*result.contradictions, *result.of_kind("outliers"))]
    return Trial(
        group, result.determined, found.n, held, ratios, stated, _levels(result, levels), tuple(accusations),
        result.undetermined,
    )  # fmt: skip


def _levels(result: sysid.Identification, true: Levels) -> list[float]:
    noise = getattr(result, "noise", None)
    if noise is None:
        return []
    pairs = [(getattr(noise, name), getattr(true, name)) for name in ("response", "base", "force")]
    return [float(r) for found, exact in pairs if found is not None for r in np.ravel(np.asarray(found) / exact)]


def verdicts(what: str, trials: list[Trial], *, determined: bool) -> Line:
    """Share of draws with the right verdict, and why the others have another."""
    right = [not t.said and t.determined == determined for t in trials]
    reasons = sorted({t.said or "; ".join(t.open) for t, good in zip(trials, right, strict=True) if not good} - {""})
    shown = f" ({' | '.join(r[:160] for r in reasons[:3])})" if reasons else ""
    word = "determined" if determined else "not determined"
    return above(f"{what}: share of {len(trials)} draws called {word}{shown}", float(np.mean(right)), VERDICTS)


def coverages(what: str, trials: list[Trial], *, cells: bool = True) -> Iterator[Line]:
    """Shares of 95 % intervals that hold the truth, pooled and in the worst cell."""
    table = _cells([t.held for t in trials])
    proven = len(trials) >= PROVEN
    if not table:
        yield Line(f"{what}: intervals", "none to compare", "", False)
        return
    pooled = float(np.mean(np.concatenate([*table.values()])))
    low, high = POOLED if proven else FEW[0]
    counted = " (" + ", ".join(f"{label} {_share(table, name):.3f}" for name, label in KINDS.items()) + ")"
    yield Line(
        f"{what}: share of 95 % intervals that hold the truth{counted}",
        f"{pooled:.4f}",
        f"{low:g} to {high:g}",
        low <= pooled <= high,
    )
    if cells:
        worst = min(table, key=lambda cell: float(np.mean(table[cell])))
        text = f"{what}: the same in the worst cell ({KINDS[worst[0]]}, number {worst[1] + 1} of its kind)"
        share = float(np.mean(table[worst]))
        yield above(text, share, EACH) if proven else Line(text, f"{share:.4g}")


def errors(what: str, trials: list[Trial]) -> Iterator[Line]:
    """Root mean square of errors over their Cramér-Rao bounds, pooled and in the worst cell."""
    table = _cells([t.ratios for t in trials])
    proven = len(trials) >= PROVEN
    if not table:
        yield Line(f"{what}: errors", "none to compare", "", False)
        return
    rms = {cell: float(np.sqrt(np.mean(np.square(values)))) for cell, values in table.items()}
    pooled = float(np.sqrt(np.mean(np.square(np.concatenate([*table.values()])))))
    worst = max(rms, key=lambda cell: rms[cell])
    text = f"{what}: rms error over the Cramér-Rao bound"
    yield below(text, pooled, RATIOS[0] if proven else FEW[1])
    text += f", worst cell ({KINDS[worst[0]]}, number {worst[1] + 1} of its kind)"
    yield below(text, rms[worst], RATIOS[1]) if proven else Line(text, f"{rms[worst]:.4g}")


def stated(what: str, trials: list[Trial]) -> Line:
    """Stated deviations over those of the Cramér-Rao bound: the median draw of the kind that is farthest off."""
    ratios = {
        name: float(np.median(r)) for name in KINDS if (r := [t.stated[name] for t in trials if name in t.stated])
    }
    if not ratios:
        return Line(f"{what}: stated deviations", "none to compare", "", False)
    worst = max(ratios, key=lambda name: abs(np.log(ratios[name])))
    text = f"{what}: stated deviations over the Cramér-Rao bound, median draw, {KINDS[worst]}, farthest of all kinds"
    low, high = STATED
    return Line(text, f"{ratios[worst]:.4f}", f"{low:g} to {high:g}", low <= ratios[worst] <= high)


def levels_found(what: str, trials: list[Trial]) -> Line:
    """Share of draws in which each channel's level is found within 5 %."""
    near = [bool(t.levels) and max(abs(np.array(t.levels) - 1)) <= LEVELS_WITHIN for t in trials]
    told = [r for t in trials for r in t.levels]
    spread = f", found over true {min(told):.3f} to {max(told):.3f}" if told else ", none told"
    text = f"{what}: share of draws with all levels of noise within {LEVELS_WITHIN:.0%}{spread}"
    return above(text, float(np.mean(near)), LEVELS_SHARE)


def _cells(tables: list[dict[str, list]]) -> dict[tuple[str, int], np.ndarray]:
    """Values of all draws by kind and number of the cell; cells of different structures share a number."""
    cells: dict[tuple[str, int], list] = {}
    for table in tables:
        for name, values in table.items():
            for i, value in enumerate(values):
                cells.setdefault((name, i), []).append(value)
    return {cell: np.array(values, dtype=float) for cell, values in cells.items()}


def _share(table: dict[tuple[str, int], np.ndarray], name: str) -> float:
    values = [held for (kind, _), held in table.items() if kind == name]
    return float(np.mean(np.concatenate(values))) if values else np.nan
