"""Processor time of a law of amplitude: three floors, 100 s at 120 Hz, three runs of levels 1 : 3 : 10."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.amplitude.softening_storeys import LEVELS, recorded, shaken, storeys
from benchmarks.line import Line, above, below
from benchmarks.machine import at_full_speed, fixed_work


def lines(reduced: bool) -> Iterator[Line]:
    """Seconds of a whole identification; reduced: of 20 s at 60 Hz, to the same bound."""
    seconds, rate = (20.0, 60.0) if reduced else (100.0, 120.0)
    rng = np.random.default_rng(0)
    structure = storeys("law", rng, 3)
    bases = np.array([shaken(level, seconds, rng, rate) for level in LEVELS])
    test = recorded(list(zip(bases, structure.under(bases, rate), strict=True)), 0.01, rng, rate)
    begun = time.process_time()
    result = sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw()), rng=0)
    words, spent = at_full_speed(time.process_time() - begun, fixed_work())
    text = f"three floors, {seconds:g} s at {rate:g} Hz, three runs: seconds of processor time {words}"
    yield below(text, spent, 60.0)
    yield above("of these, modes with a law", len(result.structure.laws), 1)
