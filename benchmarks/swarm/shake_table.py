"""Measured records of a shake table: fitted on one event, predicting another."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.problem_modules import ROOT, load_module

EVENTS = ("sine_1p5", "sine_2p0")
ABSENT = Line("mini_shake_table", "records absent: not run (set SYSID_DATA to their folder)")


def records_folder() -> Path | None:
    """Folder of both events: that which SYSID_DATA names, else one beside the checkout; None where there is none."""
    beside = ROOT.parent / "shared" / "data" / "mini_shake_table" / "flexible_3_storey"
    folder = Path(os.environ.get("SYSID_DATA") or beside)
    return folder if folder.is_dir() else None


def lines(reduced: bool) -> Iterator[Line]:
    """mini_shake_table: fitted on one event, predicting the other. Both forms are the same."""
    data = records_folder()
    if data is None:
        yield ABSENT
        return
    problem = load_module("mini_shake_table").problem(data=str(data))
    result = sysid.identify(problem, strategy="swarm", rng=0)
    given = np.array([3.75, 11.2, 16.6])
    frequencies = result.structure.natural_frequencies
    yield below(
        f"mini_shake_table: largest relative distance of {frequencies.round(3).tolist()} Hz from 3.75, 11.2, 16.6",
        float(np.max(np.abs(frequencies / given - 1))),
        0.02,
    )
    fitted, unseen = problem.measurement, problem.validation[0]
    yield _scores("fitted event, relative X", score_of(result.predict(fitted), fitted.relative), (0.79, 0.82, 0.75))
    yield _scores("unseen event, relative X", score_of(result.predict(unseen), unseen.relative), (0.38, 0.33, 0.29))
    for name, test in (("fitted", fitted), ("unseen", unseen)):
        rigid = test.response - test.relative
        yield _scores(f"{name} event, absolute X", score_of(rigid + result.predict(test), test.response))
        yield _scores(f"{name} event, absolute X, floors move with the table", score_of(rigid, test.response))


def score_of(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """One less what is missed of each sensor's record, over the record, (n_sensors,)."""
    return 1 - np.linalg.norm(predicted - measured, axis=(0, 2)) / np.linalg.norm(measured, axis=(0, 2))


def _scores(text: str, scores: np.ndarray, bounds: tuple[float, ...] = ()) -> Line:
    figure = " / ".join(f"{s:.3f}" for s in scores)
    if not bounds:
        return Line("mini_shake_table: " + text, figure)
    met = all(s >= b for s, b in zip(scores, bounds, strict=True))
    return Line("mini_shake_table: " + text, figure, ">= " + " / ".join(f"{b:g}" for b in bounds), met)
