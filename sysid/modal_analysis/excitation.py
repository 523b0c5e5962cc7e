"""Base motion that tells no modes: a steady sine over whole records."""

from __future__ import annotations

import numpy as np

from sysid.measurement.measurement import Measurement


def steady_sine(test: Measurement, beside: int = 3, share: float = 0.9, few: float = 0.1) -> str | None:
    """Lack of whole records of a steady sine, in a sentence; None where the base moves at more than one frequency.

    Of a sine that is cut within a cycle the largest line and those `beside` it hold this `share` of the power; they
    must be `few`, a share of all.
    """
    found = []
    for base, lines in zip(test.base, test.own_lines, strict=True):
        freq, power = test.freq[lines], np.sum(np.abs(base[:, lines]) ** 2, axis=0)
        peak = int(np.argmax(power))
        near = power[max(peak - beside, 0) : peak + beside + 1]
        if near.sum() < share * power.sum() or near.size > few * power.size:
            return None
        found.append(float(freq[peak]))
    at = ", ".join(f"{f:.4g}" for f in sorted(set(found)))
    return (
        f"the base moves in a steady sine at {at} Hz, and its other lines hold next to nothing: such records tell the "
        "response at these frequencies alone, and neither modes nor damping; record from before the motion begins "
        "until it has died away, or move the base at all frequencies of interest (random motion, sweep, stepped sines)"
    )
