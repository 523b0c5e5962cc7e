"""A wrong change of the package."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """A wrong change.

    Attributes
    ----------
    identifier : str
    idea : str
        What is wrong with it.
    code, replacement : str
        What stands in the package, and what takes its place, on one line.
    tests : str
        Names of the test files that are to notice it, without ``.py``, or ``FILE::TEST``; the quickest first.
    """

    identifier: str
    idea: str
    code: str
    replacement: str
    tests: str
