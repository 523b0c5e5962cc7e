"""Base motion that tells no modes: a steady sine over whole records."""

from __future__ import annotations

import numpy as np

from sysid.measurement.measurement import Measurement

_BESIDE = 3  # lines on either side of the largest, over which a sine that is cut within a cycle spreads most
_ALL = 0.9  # share of the power
_FEW = 0.1  # share of the lines, at most, that these are


def steady_sine(test: Measurement) -> str | None:
    """What whole records of a steady sine lack, in a sentence; None where the base moves at more than one frequency."""
    found = []
    for base, own in zip(test.base, test.own_lines, strict=True):
        freq, power = test.freq[own], np.sum(np.abs(base[:, own]) ** 2, axis=0)
        peak = int(np.argmax(power))
        near = power[max(peak - _BESIDE, 0) : peak + _BESIDE + 1]
        if near.sum() < _ALL * power.sum() or near.size > _FEW * power.size:
            return None
        found.append(float(freq[peak]))
    at = ", ".join(f"{f:.4g}" for f in sorted(set(found)))
    return (
        f"the base moves in a steady sine at {at} Hz, and its other lines hold next to nothing: such records tell the "
        "response at these frequencies alone, and neither modes nor damping; record from before the motion begins "
        "until it has died away, or move the base at all frequencies of interest (random motion, sweep, stepped sines)"
    )
