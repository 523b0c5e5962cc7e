"""Measured records: stated deviations of frequencies against a jackknife over blocks of lines, refitted here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.problem_modules import load_module
from benchmarks.swarm.shake_table import DATA

EVENTS = ("sine_1p5", "sine_2p0")
WITHIN = 1.5
BLOCKS = 40  # some half a Hz each


def lines(reduced: bool) -> Iterator[Line]:
    """mini_shake_table, fitted on either event, in the reduced form on one; `swarm.shake_table` holds its scores.

    The variable SYSID_DATA names the folder of both events; by default it is looked for beside the checkout.
    """
    data = Path(os.environ.get("SYSID_DATA") or DATA)
    if not data.is_dir():
        yield Line("mini_shake_table", "records absent: not run (set SYSID_DATA to their folder)")
        return
    event = load_module("mini_shake_table").event
    for name in EVENTS[: 1 if reduced else None]:
        yield _jackknife(name, event(data / name, "records"), BLOCKS)


def _jackknife(name: str, test: sysid.Measurement, blocks: int) -> Line:
    """Deviations of frequencies by leaving out one block of neighbouring lines at a time.

    B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982), chapter 3.
    """
    whole = _fit(test)
    count = whole.structure.n
    parts = np.array_split(np.arange(test.freq.size), blocks)
    refitted = []
    for part in parts:
        keep = np.ones(test.freq.size, dtype=bool)
        keep[part] = False
        found = _fit(test.at(keep)).structure.natural_frequencies
        if found.size == count:
            refitted.append(found)
    text = f"{name}: stated deviations of {count} frequencies over those of a jackknife of {blocks} blocks of lines"
    if len(refitted) < blocks:
        return Line(text, f"{blocks - len(refitted)} refits find other modes", f"within {WITHIN:g}", False)
    left = np.array(refitted) - np.mean(refitted, axis=0)
    std = np.sqrt((blocks - 1) / blocks * np.sum(left**2, axis=0))
    ratios = whole.uncertainty.natural_frequencies / std
    met = bool(np.all((ratios <= WITHIN) & (ratios >= 1 / WITHIN)))
    shown = " / ".join(f"{r:.2f}" for r in ratios)
    return Line(text, shown, f"{1 / WITHIN:.2f} to {WITHIN:g}", met)


def _fit(test: sysid.Measurement) -> sysid.Identification:
    """The model of the problem module, its frequencies found in the lines that are left."""
    problem = sysid.Problem(
        test,
        mass=sysid.FullMass(healing="rigid_body"),
        stiffness=sysid.SpectralStiffness([3.75, 11.2, 16.6]),
        damping=sysid.ModalDamping(0.0005, 0.05),
    )
    return sysid.identify(problem, rng=0)
