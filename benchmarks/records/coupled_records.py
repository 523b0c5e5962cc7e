"""Records of random coupled structures: modes found, intervals, and sentences that accuse a right record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread
from benchmarks.records import trial
from benchmarks.records.cramer_rao import Bound, all_entries, bound, whitened
from benchmarks.records.simulated import Levels, Run, Setting, coupled
from benchmarks.records.trial import Trial

STANDS_OUT = 50.0  # rise of chi² without a mode, beyond which it must be found
SHARE = 0.95
ACCUSATIONS = 1  # in 300 runs
MATRICES = ("mass", "stiffness", "damping")
KNOWN = 0.1  # of the root of two diagonal entries: intervals of what is known less well are not compared
NEAR = (6.0, 0.5)  # a mode is found within so many deviations of the bound, or half widths of its peak


@dataclass(frozen=True)
class Found:
    """Modes of one run, beside its `Trial`.

    Attributes
    ----------
    trial : Trial
    missed : tuple of str
        Modes that must be found and are not.
    extra : tuple of str
        Modes found that are none.
    """

    trial: Trial
    missed: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()

    @property
    def wrong(self) -> str:
        """The error, or which modes are missed and which are none."""
        return self.trial.said or ", ".join(
            [*(f"misses {m}" for m in self.missed), *(f"finds {e}" for e in self.extra)]
        )


def lines(reduced: bool) -> Iterator[Line]:
    """60 structures, five draws of motion and noise each; or 6 structures, one draw."""
    structures, draws = (6, 1) if reduced else (60, 5)
    answers = spread(draw, [(seed, number) for seed in range(structures) for number in range(draws)])
    what = f"{structures} coupled structures x {draws} draws"
    trials = [a.trial for a in answers]
    right = [not (a.trial.said or a.missed or a.extra) for a in answers]
    wrong = [f"{a.trial.group}: {a.wrong}" for a, good in zip(answers, right, strict=True) if not good]
    shown = f" ({'; '.join(w[:120] for w in wrong[:6])})" if wrong else ""
    text = f"{what}: share of runs with every mode found whose removal raises chi² by {STANDS_OUT:g}, and no other"
    yield above(text + shown, float(np.mean(right)), SHARE)
    yield from trial.coverages(what, trials, cells=False)
    yield trial.stated(what, trials)
    complete = [t for t in trials if t.held.get("mass")]
    yield Line(f"{what}: runs whose intervals of matrices are compared", f"{len(complete)} of {len(trials)}")
    told = [f"{t.group}: {sentence}" for t in trials for sentence in t.accusations]
    shown = f" ({' | '.join(s[:160] for s in told[:4])})" if told else ""
    yield below(f"{what}: sentences that accuse a right record{shown}", len(told), ACCUSATIONS)


def draw(task: tuple[int, int]) -> Found:
    """One draw of motion and noise: seed of the structure, number of the draw."""
    seed, number = task
    group = f"structure {seed}, draw {number}"
    answers: list[Found] = []

    def run() -> Trial:
        answers.append(_draw(group, seed, number))
        return answers[0].trial

    failed = trial.attempt(group, run)
    return answers[0] if answers else Found(failed)


def _draw(group: str, seed: int, number: int) -> Found:
    setting = coupled(seed)
    rng = np.random.default_rng((seed, number, 5))
    run = setting.run(rng)
    records, levels = setting.with_noise(run.records(), rng)
    test = trial.measurement([records], setting, force=True)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    truth, found = setting.structure, result.structure
    least = bound(truth, [(run, levels)], setting.lines, all_entries(truth.n, truth.n_base), force=True)
    judged = trial.judged(group, result, truth, least, levels)

    half_width = truth.damping_ratios * truth.natural_frequencies
    near = np.maximum(NEAR[0] * least.natural_frequencies, NEAR[1] * half_width)
    pairs = matched(truth.natural_frequencies, found.natural_frequencies, near)
    matrices = judged.held if _all_known(truth, least) else {}
    held = {name: matrices[name] for name in MATRICES if name in matrices}
    judged = replace(judged, held={**held, **_held(result, truth, pairs)})
    rises = chi_square_rises(setting, run, levels)
    mine = {i for i, _ in pairs}
    its = {j for _, j in pairs}
    missed = [
        f"{truth.natural_frequencies[k]:.4g} Hz (chi² {rises[k]:.3g})"
        for k in range(truth.n)
        if rises[k] > STANDS_OUT and k not in mine
    ]
    extra = [f"{f:.4g} Hz" for j, f in enumerate(found.natural_frequencies) if j not in its]
    return Found(judged, tuple(missed), tuple(extra))


def matched(true: np.ndarray, found: np.ndarray, near: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of modes, each at most once, no farther apart than `near`, (n,), Hz."""
    distance = np.abs(true[:, None] - found) / near[:, None]
    rows, columns = linear_sum_assignment(np.minimum(distance, 2.0))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if distance[i, j] <= 1]


def chi_square_rises(setting: Setting, run: Run, levels: Levels) -> np.ndarray:
    """Rise of chi², (n,), where a mode is left out and all others follow as far as they can, to first order."""
    n, d = run.modes.gamma.shape
    J, parts = whitened(run.modes, run, levels, setting.lines, force=True)
    numbers = np.hstack([J, parts])
    gram = 2 * (numbers.conj().T @ numbers).real
    p = J.shape[1]
    sensors = len(run.modes.shapes)
    owner = np.concatenate([
        np.tile(np.arange(n), sensors), np.repeat(np.arange(n), d), np.arange(n), np.arange(n),
        np.full(d * (d + 1) // 2, -1), np.arange(n), np.arange(n),
    ])  # fmt: skip
    rises = np.empty(n)
    for k in range(n):
        others = np.flatnonzero(owner != k)
        scale = np.sqrt(np.diag(gram)[others])
        inner = gram[np.ix_(others, others)] / np.outer(scale, scale)
        across = gram[others, p + k] / scale
        explained = across @ np.linalg.pinv(inner, rcond=1e-12, hermitian=True) @ across
        rises[k] = gram[p + k, p + k] - explained
    return rises


def _all_known(truth: sysid.Structure, least: Bound) -> bool:
    """True where the records tell each entry of M, K and C well enough for errors in proportion to the noise."""
    for name in MATRICES:
        size = np.sqrt(np.diag(getattr(truth, name))[: truth.n])
        if np.max(getattr(least, name) / np.outer(size, size)) > KNOWN:
            return False
    return True


def _held(result: sysid.Identification, truth: sysid.Structure, pairs: list[tuple[int, int]]) -> dict[str, list[bool]]:
    """Flags of intervals of frequencies and ratios of the modes that were found: true where they hold the truth."""
    held = {}
    for name in ("natural_frequencies", "damping_ratios"):
        low, high = result.uncertainty.interval(name, level=trial.LEVEL)
        exact = getattr(truth, name)
        held[name] = [bool(low[j] <= exact[i] <= high[j]) for i, j in pairs]
    return held
