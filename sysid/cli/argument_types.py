"""Numbers on the command line, each refused with an example."""

from __future__ import annotations

import argparse
import contextlib
import functools
import math


def band(text: str) -> tuple[float, float]:
    """Ends of a band, Hz, of LOW-HIGH."""
    low, _, high = text.rpartition("-")  # at the last dash, as 1e-3 has one too
    try:
        ends = float(low), float(high)
    except ValueError:
        ends = 0.0, 0.0
    if not 0 <= ends[0] < ends[1] < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no band: write its ends in Hz, such as 0.5-20")
    return ends


def orders(text: str) -> tuple[int, int]:
    """The least and the largest number of modes, of A-B."""
    low, _, high = text.partition("-")
    if not (low.isdecimal() and high.isdecimal() and 1 <= int(low) <= int(high)):
        raise argparse.ArgumentTypeError(f"{text!r} is no range of numbers of modes: write 3-8")
    return int(low), int(high)


def whole(least: int, text: str) -> int:
    """A whole number from the least one."""
    with contextlib.suppress(ValueError):
        if (given := int(text)) >= least:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")


count, seed = functools.partial(whole, 1), functools.partial(whole, 0)


def seconds(text: str) -> float:
    """A positive number of seconds."""
    with contextlib.suppress(ValueError):
        if 0 < (given := float(text)) < math.inf:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
