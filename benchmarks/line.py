"""One measured line: a figure, its bound, and whether it is met."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Line:
    """A figure beside its bound.

    Attributes
    ----------
    text : str
        What was measured.
    figure : str
        What came.
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
        return f"{verdict:8s} {self.text}\n         figure: {self.figure}" + (
            f"    bound: {self.bound}" if self.bound else ""
        )


def below(text: str, value: float, bound: float) -> Line:
    """A figure that must not pass its bound."""
    return Line(text, f"{value:.4g}", f"<= {bound:g}", bool(value <= bound))


def above(text: str, value: float, bound: float) -> Line:
    """A figure that must reach its bound."""
    return Line(text, f"{value:.4g}", f">= {bound:g}", bool(value >= bound))


def show(lines: Iterable[Line]) -> int:
    """Print lines as they come; how many are not met."""
    unmet = 0
    for line in lines:
        print(line, flush=True)
        unmet += line.met is False
    return unmet
