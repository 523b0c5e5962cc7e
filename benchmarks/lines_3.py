"""Machine precision from the data themselves, and the truth about what they determine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.bound import bound
from benchmarks.building import building
from benchmarks.exact import exact
from benchmarks.large import large
from benchmarks.line import Line
from benchmarks.negative import negative
from benchmarks.noise import noise
from benchmarks.published import published


def lines(reduced: bool, data: Path, only: str) -> Iterator[Line]:
    """All lines, group by group; nothing here needs measured records."""
    groups = {
        "exact": lambda: exact(range(4 if reduced else 100), reduced),
        "noise": lambda: noise(range(4 if reduced else 100), (0.01,) if reduced else (0.001, 0.01, 0.03)),
        "bound": lambda: bound(range(9, 10) if reduced else range(10), 6 if reduced else 200, printed=reduced),
        "building": building,
        "published": lambda: published(range(1 if reduced else 5)),
        "large": lambda: large(reduced),
        "negative": negative,
    }
    for name, group in groups.items():
        if only in name:
            yield from group()
