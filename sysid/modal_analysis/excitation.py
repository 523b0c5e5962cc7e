"""Base motion that tells no modes: a steady sine over whole records."""

from __future__ import annotations

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array

_BESIDE = 3  # lines about that of a sine that is cut within a cycle, with most of its power


def steady_sine(test: Measurement) -> str | None:
    """Lack of whole records of a steady sine, in a sentence; None where the base moves at more than one frequency."""
    found = _sines(test)
    if found is None:
        return None
    at = ", ".join(f"{f:.4g}" for f in sorted(set(found)))
    return (
        f"the base moves in a steady sine at {at} Hz, and its other lines hold next to nothing: such records tell the "
        "response at these frequencies alone, and neither modes nor damping; record from before the motion begins "
        "until it has died away, or move the base at all frequencies of interest (random motion, sweep, stepped sines)"
    )


def at_sines_alone(test: Measurement, omega: Array) -> bool:
    """True where the base moves in steady sines, and no mode, rad/s, lies within the lines away from them."""
    found, f = _sines(test), omega / (2 * np.pi)
    if found is None:
        return False
    spacing = np.max(np.diff(test.freq))
    inside = (f > test.freq[0]) & (f < test.freq[-1])
    return not np.any(inside & np.all([np.abs(f - sine) > _BESIDE * spacing for sine in found], axis=0))


def _sines(test: Measurement, share: float = 0.9, few: float = 0.1) -> list[float] | None:
    """Frequency of the steady sine of each run, Hz; None where the base moves at more than one.

    The largest line and those beside it hold this `share` of the power; they must be `few`, a share of all.
    """
    found = []
    for base, lines in zip(test.base, test.own_lines, strict=True):
        freq, power = test.freq[lines], np.sum(np.abs(base[:, lines]) ** 2, axis=0)
        peak = int(np.argmax(power))
        near = power[max(peak - _BESIDE, 0) : peak + _BESIDE + 1]
        if near.sum() < share * power.sum() or near.size > few * power.size:
            return None
        found.append(float(freq[peak]))
    return found
