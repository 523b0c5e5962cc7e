"""Problem variants as modules: published cases at noise, variants by newcomers, authors' mistakes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.line import Line
from benchmarks.mistakes import mistakes
from benchmarks.newcomers import newcomers
from benchmarks.storeys import five_storeys, six_springs


def lines(reduced: bool, data: Path, only: str) -> Iterator[Line]:
    """All lines, group by group; nothing here needs measured records."""
    draws = range(3 if reduced else 20)
    groups = {
        "six": lambda: six_springs(draws, judged=not reduced),
        "five": lambda: five_storeys(range(3 if reduced else 60), judged=not reduced),  # errors hang together
        "newcomers": newcomers,
        "mistakes": mistakes,
    }
    for name, group in groups.items():
        if only in name:
            yield from group()
