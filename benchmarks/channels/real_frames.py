"""Real frames: delays, noise and quadrature of whole records of three wireless units on floors and one on the table.

Far below the first mode a floor over the table is ``e^{-i w tau} (r - i c w³ / (w_1² - w²)²)``, the latter by viscous
damping of that mode, r and c real: it turns the phase too, but otherwise over frequency than a delay. The steady motion
of two events, at 1.5 and 2.0 Hz, tells both. Nothing of `sysid` but the reader of files is in that.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.problem_modules import load_module
from benchmarks.swarm.shake_table import ABSENT, EVENTS, records_folder

FIRST = 3.75  # Hz, of the frame
FAR = (0.3, 2.5)  # Hz
WITHIN = 2e-4  # s
LOUDER = 2.0  # noise of the unit of the top floor over that of the others


def lines(reduced: bool) -> Iterator[Line]:
    """Both events; one of them in the reduced form."""
    data = records_folder()
    if data is None:
        yield ABSENT
        return
    module = load_module("mini_shake_table")
    tests = {name: module.event(Path(data) / name, "records") for name in EVENTS}
    shown = delays_by_phase(list(tests.values()))
    text = " / ".join(f"{1e3 * one:.2f}" for one in shown)
    for name in EVENTS[:1] if reduced else EVENTS:
        result = sysid.identify(sysid.Problem(tests[name]), rng=0)
        delays, noise = result.modal[0].delays, result.modal[0].noise
        assert delays is not None
        assert noise is not None
        off = np.abs(delays.values - shown)
        yield below(f"{name}: delays of floors beside {text} ms by phase, largest error, s", off.max(), WITHIN)
        louder = noise.response[-1] / noise.response[:-1].max()
        yield below(f"{name}: noise of floor 3 over the largest of the others", float(louder), LOUDER)
        accused = [one.kind for one in result.contradictions if one.kind == "damping"]
        yield below(f"{name}: accused of motion in quadrature", len(accused), 0)


def delays_by_phase(tests: list[sysid.Measurement]) -> np.ndarray:
    """Delays of the sensors, s, that events have in common, by what is in quadrature far below the first mode."""
    rows, sides, first = [], [], 2 * np.pi * FIRST
    for test in tests:
        far = (test.freq > FAR[0]) & (test.freq < FAR[1])
        w, table, floors = 2 * np.pi * test.freq[far], test.base[0, 0, far], test.response[0][:, far]
        over = floors / table
        # Lines count by the motion of the table.
        damped = np.broadcast_to(w**3 / (first**2 - w**2) ** 2, over.shape)
        rows.append(np.stack([-w * over.real, -damped]) * np.abs(table))
        sides.append(over.imag * np.abs(table))
    pairs = zip(np.moveaxis(np.concatenate(rows, axis=2), 1, 0), np.hstack(sides), strict=True)
    return np.array([np.linalg.lstsq(row.T, side, rcond=None)[0][0] for row, side in pairs])
