"""Chains of masses between two supports, both recorded, as strong-motion files: supports that move apart are named.

The second support moves later and by a part of its own, or as the first. Sums of modes at eight times the rate, each by
a recursion that is exact for loads that are linear between their samples, low-passed, decimated and spoiled.

``python -m benchmarks.laboratory.supports NUMBER SECONDS`` prints the figures of one as JSON; odd ones move as one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import sysid
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.structures import log_uniform
from benchmarks.channels.damaged import recursion
from benchmarks.channels.unfit import FASTER, RATIO, Clock
from benchmarks.laboratory.judged import TOLERANCE, accuses, command, last_line
from benchmarks.laboratory.spoiling import Spoiled
from benchmarks.laboratory.test_files import Channel, strong_motion
from benchmarks.line import Line, above, below

TESTS, SHORT = 40, (0, 1)
PATIENCE = 120  # s of processor time of one command
FIRST = (0.8, 3.0)  # Hz, first frequency
LATE = (0.003, 0.3)  # periods of the last mode
OWN = (0.02, 0.5)  # of the first support's motion
SHARE = 0.95


def lines(reduced: bool) -> Iterator[Line]:
    """Twenty tests whose supports move apart and twenty where they do not; or one of each."""
    every = figures_of_each("laboratory.supports", SHORT if reduced else range(TESTS), PATIENCE)
    failed = [one["said"] for one in every if "said" in one]
    yield below(f"{len(every)} tests: without an answer ({'; '.join(failed[:3])})", len(failed), 0)
    for what, mine in (("apart", every[::2]), ("as one", every[1::2])):
        found = [one for one in mine if "said" not in one]
        named = sum(one["named"] for one in found)
        tests = f"{len(mine)} tests whose supports move {what}"
        share = above(f"{tests}: named, share", named / len(mine), SHARE)
        yield share if what == "apart" else below(f"{tests}: named", named, 0)
        wrong = [one["accused"][0] for one in found if one["accused"]]
        yield below(f"{tests}: right records accused ({'; '.join(wrong[:3])})", len(wrong), 0)


def figures(number: int) -> dict[str, Any]:
    """Whether the supports of one test are named, and which right records are accused."""
    rng = np.random.default_rng((number // 2, 294))
    n = int(rng.integers(3, 6))
    masses, springs = rng.uniform(0.7, 1.3, n), rng.uniform(0.7, 1.3, n + 1)
    K = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    squares, shapes = scipy.linalg.eigh(K, np.diag(masses))
    f = np.sqrt(squares / squares[0]) * float(log_uniform(rng, FIRST))
    clock = Clock.of(rng, f[0], f[-1])
    moved, other = (clock.shaking(rng, (0.5 * f[0], 1.2 * f[-1]), True) for _ in range(2))
    late, own = round(float(log_uniform(rng, LATE)) / f[-1] * clock.rate), float(log_uniform(rng, OWN))
    beside = moved if number % 2 else np.concatenate([np.zeros(late), moved[: moved.size - late]]) + own * other
    by_second = np.linalg.solve(K, springs[-1] * np.eye(n)[-1])  # the static motion that it makes
    static = np.outer(1 - by_second, moved) + np.outer(by_second, beside)
    loads, ratios = -(shapes.T * masses) @ static, log_uniform(rng, RATIO, n)
    q = [recursion(2 * np.pi * one, z, load, 1 / clock.rate) for one, z, load in zip(f, ratios, loads, strict=True)]
    rows = scipy.signal.decimate(np.vstack([moved, beside, static + shapes @ q]), FASTER, ftype="fir", axis=1)
    rate = clock.rate / FASTER
    rows = Spoiled.of(rng, n + 2, slice(2 + 2 * n // 3, n + 2), rate).recorded(rows, rate, rng)
    names = [Channel("abutment 1", "base", "x"), Channel("abutment 2", "base", "x")]
    return _told([*names, *(Channel(f"a{i}", "response", "x") for i in range(1, n + 1))], rows, rate)


def _told(channels: list[Channel], rows: np.ndarray, rate: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sensors = strong_motion(folder / "bridge.V2", channels, rows, rate)
        (folder / "list.toml").write_text(sensors, encoding="utf-8")
        files = ["--sensors", str(folder / "list.toml"), "--out", str(folder / "test.h5")]
        read, _ = command("read", str(folder / "bridge.V2"), *files)
        if read.returncode:
            return {"named": "of supports" in last_line(read), "accused": []}
        run, _ = command("run", str(folder / "test.h5"), "--gain-std", TOLERANCE, "--out", str(folder / "out"))
        if run.returncode not in (0, 1):
            return {"said": last_line(run)}
        findings = sysid.load(folder / "out" / "result.h5").findings
    accused = [one.sentence[:80] for one in findings if accuses(one) and one.kind != "supports differ"]
    return {"named": any(one.kind == "supports differ" for one in findings), "accused": accused}


if __name__ == "__main__":
    answer(figures)
