"""Fits of laws of amplitude that are stopped at random times: the best so far is kept, and it is told."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.amplitude.softening_storeys import LEVELS, recorded, shaken, storeys
from benchmarks.line import Line, above
from sysid.errors import Stop
from sysid.modal_analysis.amplitude_fit import with_laws
from sysid.modal_analysis.fit import fit_modes
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.structure.thresholds import ROUND_OFF


def lines(reduced: bool) -> Iterator[Line]:
    """Twenty stops of one fit, by Ctrl-C and by the time limit in turn; reduced: two of a shorter test."""
    rng = np.random.default_rng(30)
    structure = storeys("law", rng, 2)
    bases = np.array([shaken(level, 16.0 if reduced else 40.0, rng) for level in LEVELS])
    test = recorded(list(zip(bases, structure.under(bases), strict=True)), 0.01, rng)
    linear, asked = fit_modes(test).record_fit, sysid.AmplitudeLaw(exponents=(0.5, 1.0) if reduced else "auto")
    steps = 0

    def counted(iteration: int, residual: float, doing: str) -> None:
        nonlocal steps
        steps += 1

    begun = time.perf_counter()
    with_laws(linear, asked, monitor=FitMonitor(counted))
    whole, wrong = time.perf_counter() - begun, set()
    ends = [KeyboardInterrupt if i % 2 == 0 else Stop for i in range(2 if reduced else 20)]
    good = 0
    for end in ends:
        at = int(rng.integers(1, steps))

        def stop(iteration: int, residual: float, doing: str, left: list[int] = [at], end: type = end) -> None:  # noqa: B006
            left[0] -= 1
            if left[0] <= 0:
                raise end("stopped")

        found = with_laws(linear, asked, monitor=FitMonitor(stop))
        laws = found.parameters.laws
        faults = {
            "not told": not found.stopped,
            "a law that is not likelier": any(not law.likelier for law in laws),
            "neither a law nor the linear fit": not laws and abs(found.likelihood / linear.likelihood - 1) > ROUND_OFF,
        }
        wrong |= {fault for fault, there in faults.items() if there}
        good += not any(faults.values())
    text = f"{len(ends)} stops of a fit of a law of {whole:.1f} s and {steps} steps: the best so far, told"
    yield above("; ".join([text, *sorted(wrong)]), good, len(ends))
