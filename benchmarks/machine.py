"""Speed of the machine: a shared one can be slow for hours, and is half as fast then."""

from __future__ import annotations

import time

import numpy as np

PEER = 0.1  # s that `fixed_work` takes where a machine of this kind is at its full speed


def fixed_work(times: int = 5) -> float:
    """Processor seconds of fixed work, half of it Python's and half LAPACK's, as in an identification: the least."""
    return min(_once() for _ in range(times))


def _once() -> float:
    matrix = np.random.default_rng(0).normal(size=(1240, 41))
    begun = time.process_time()
    total = 0
    for i in range(10**6):
        total += i
    for _ in range(100):
        np.linalg.qr(matrix, mode="r")
    return time.process_time() - begun


def at_full_speed(seconds: float, beside: float) -> tuple[str, float]:
    """Words for, and seconds of, what took so long beside fixed work that took `beside`, were that `PEER` at most."""
    words = f"at the speed at which fixed work takes {PEER:g} s at most, here {beside:.3g} s"
    return words, seconds * PEER / max(beside, PEER)
