"""One measured line: a figure, its bound, and whether it is met."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

HEADER = ("what was measured", "figure", "bound", "met")
WIDTHS = (62, 32, 18, 7)  # characters


@dataclass(frozen=True)
class Line:
    """A figure beside its bound.

    Attributes
    ----------
    text : str
        What was measured.
    figure : str
        The figure, as it is printed.
    bound : str
        What is asked for; empty where the figure is only printed.
    met : bool or None
        None where there is nothing to meet.
    """

    text: str
    figure: str
    bound: str = ""
    met: bool | None = None

    def __str__(self) -> str:
        verdict = {True: "met", False: "NOT MET", None: "-"}[self.met]
        return row((self.text, self.figure, self.bound, verdict), WIDTHS)


def below(text: str, value: float, bound: float) -> Line:
    """A figure that must not pass its bound."""
    return Line(text, f"{value:.4g}", f"<= {bound:g}", bool(value <= bound))


def above(text: str, value: float, bound: float) -> Line:
    """A figure that must reach its bound."""
    return Line(text, f"{value:.4g}", f">= {bound:g}", bool(value >= bound))


def row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """One row of a table with columns of fixed widths; a long cell is wrapped."""
    columns = [textwrap.wrap(cell, width) for cell, width in zip(cells, widths, strict=True)]
    return "\n".join(
        "  ".join(part.ljust(width) for part, width in zip(parts, widths, strict=True)).rstrip()
        for parts in zip_longest(*columns, fillvalue="")
    )


def rule(widths: Sequence[int]) -> str:
    """The line between a table's header and its rows."""
    return "  ".join("-" * width for width in widths)
