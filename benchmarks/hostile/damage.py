"""Bytes with something wrong."""

from __future__ import annotations

import numpy as np

KINDS = ("flipped", "cut", "appended", "zeroed", "moved", "noise")
_ATTEMPTS = 20


def damaged(data: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """Other bytes: bits flipped, an end missing or too much, a block of zeros, of noise or from elsewhere."""
    for _ in range(_ATTEMPTS):
        broken = bytearray(data)
        start = int(rng.integers(len(data)))
        size = min(int(rng.integers(1, 2000)), len(data) - start)
        if kind == "flipped":
            for at in rng.choice(len(data), rng.integers(1, 4)):
                broken[at] ^= 1 << int(rng.integers(8))
        elif kind == "cut":
            del broken[start:]
        elif kind == "appended":
            broken += rng.bytes(size)
        elif kind == "zeroed":
            broken[start : start + size] = bytes(size)
        elif kind == "moved":
            other = int(rng.integers(len(data) - size + 1))
            broken[start : start + size] = data[other : other + size]
        else:
            broken[start : start + size] = rng.bytes(size)
        if broken != data:
            return bytes(broken)
    return data + b"0"  # such as zeros, which zeroes do not change
