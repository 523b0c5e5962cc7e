"""Structures that change with amplitude: unseen runs predicted, laws found, linear structures called linear."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.amplitude.softening_storeys import AT, FALL, LEVELS, RISE, Kind, recorded, shaken, storeys
from benchmarks.line import Line, above, below

NOISE = 0.01


def lines(reduced: bool) -> Iterator[Line]:
    """40 structures of five kinds, 60 linear ones, 20 tests that leave a law open; reduced: one, one and one."""
    seconds = 25.0 if reduced else 60.0
    kinds: list[Kind] = ["law", "duffing", "friction", "bilinear", "bouc-wen"]
    structures, off = 1 if reduced else 40, []
    predicted = list[float]()
    for seed in range(structures):
        ratio, deviations = _predicted(kinds[seed % 5], seed, seconds)
        predicted += ratio
        off += deviations
    if predicted:
        yield above(
            f"unseen runs of {len(predicted)} of {structures} structures, of which a linear model misses over five "
            f"times the noise: share missed at most half as much as by it (largest {max(predicted):.2g})",
            float(np.mean(np.array(predicted) <= 0.5)), 0.95,
        )  # fmt: skip
    if off:
        rms = float(np.sqrt(np.mean(np.square(off))))
        yield below(f"stated laws: rms of {len(off)} errors over their deviations", rms, 2.0 if reduced else 1.2)
    linear = [_kinds("linear", seed, LEVELS, seconds) for seed in range(1 if reduced else 60)]
    yield above("linear structures called linear: share", float(np.mean([k == "linear" for k in linear])), 59 / 60)
    open_ = [_kinds("linear", 100 + seed, (0.3,), 8.0, noise=0.3) for seed in range(1 if reduced else 20)]
    yield above(
        "one level, one short run: called open: share", float(np.mean([k == "amplitude open" for k in open_])), 1
    )


def _predicted(kind: Kind, seed: int, seconds: float) -> tuple[list[float], list[float]]:
    """Error for an unseen run over that of the linear model; errors of a stated law over their deviations.

    The first is of a linear model that misses over five times the noise that such a run is recorded with.
    """
    rng = np.random.default_rng(seed)
    structure = storeys(kind, rng, 3 + seed // 5 % 4 if seconds > 30 else 2)
    bases = np.array([shaken(level, seconds, rng) for level in (*LEVELS, 1.7)])
    runs = list(zip(bases, structure.under(bases), strict=True))
    test, unseen = recorded(runs[:3], NOISE, rng), recorded(runs[3:], 0.0, rng)
    plain = sysid.identify(sysid.Problem(test), rng=0)
    result = sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw()), rng=0)
    missed = [float(np.linalg.norm(one.predict(unseen) - unseen.relative)) for one in (result, plain)]
    noise = np.linalg.norm(recorded(runs[3:], NOISE, rng).relative - unseen.relative)
    ratio = [missed[0] / missed[1]] if missed[1] > 5 * noise else []
    if kind != "law" or not result.structure.laws:
        return ratio, []
    law = result.structure.laws[0]
    if law.form[:2] != (0.5, 1.0):
        return ratio, []
    scale = AT / law.form.level
    w, _ = structure.modes
    truth_of = np.array([*np.log([w[0] / (2 * np.pi), structure.ratios[0]]), FALL / np.sqrt(scale), RISE / scale])
    found = np.array([*np.log([law.frequency, law.ratio]), *law.values])
    return ratio, list((found - truth_of) / np.sqrt(np.diag(law.covariance)))


def _kinds(kind: Kind, seed: int, levels: tuple[float, ...], seconds: float, noise: float = NOISE) -> str:
    """What the answer calls the first mode."""
    rng = np.random.default_rng(1000 + seed)
    structure = storeys(kind, rng, 2)
    bases = np.array([shaken(level, seconds, rng) for level in levels])
    runs = list(zip(bases, structure.under(bases), strict=True))
    law = sysid.AmplitudeLaw(exponents=(0.5, 0.5))
    result = sysid.identify(sysid.Problem(recorded(runs, noise, rng), amplitude=law), rng=0)
    return next(one.kind for one in result.findings if one.kind in ("linear", "amplitude law", "amplitude open"))
