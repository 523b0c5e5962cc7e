"""Findings: what checks find of records, statements and fits, as data from which page, screen, file and docs are drawn.

Judgements follow from severities alone (`judgement_of`), so that no code has to read a sentence.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

Kind = Literal[
    # Mistakes in records, or in what is stated of them; the first of them explains what else speaks against a fit.
    "conjugated spectra", "late sensor", "relative responses", "positions", "unit", "sign", "swapped sensors", "gain",
    "supports differ", "table rocks", "soft bracket", "force sign", "force unit", "frequencies in rad/s",
    "short segments",
    # Damaged samples that are left in the records, or were left out.
    "clipped", "dropout", "held value", "spikes", "tone", "equal channels",
    # What speaks against a fit.
    "stopped", "bounds", "changing", "stated mass", "known entries", "lumped total", "constraint", "goal", "residual",
    "beyond noise", "least squares", "unpredicted", "changes not judged", "stated masses", "stated values",
    "stated value", "in motion", "one mode twice", "coarse lines", "misfit", "force misfit", "rigid motion", "damping",
    "one motion", "own term", "no solution",
    # What leaves the matrices open.
    "not judged", "other answers", "open", "noise", "modes not all tried", "amplitude open",
    # What is to be known besides.
    "fixed", "strategy", "search", "ending", "on a bound", "search box", "level", "lines left out",
    "coloured noise", "noise level", "noise left", "outliers", "own misfit", "no damping ratio",
    "gain not shown", "base sensors", "noise not judged", "modes below", "amplitude law", "linear",
    # What an answer takes for granted.
    "assumed total", "assumed mass", "assumed gain", "assumed force gain", "assumed mounting", "assumed base",
]  # fmt: skip
KINDS: tuple[Kind, ...] = get_args(Kind)
Judgement = Literal["determined", "one of many", "doubtful", "no fit"]

# A search ended without a fit: its solver failed, or what is left is more than the goal or the noise.
_NO_FIT = ("stopped", "constraint", "goal", "residual", "beyond noise", "no solution")


class Severity(StrEnum):
    """Weight of a finding, the heaviest first.

    Nothing is searched beside a blocking one; what contradicts an answer makes it doubtful; a caution leaves its
    matrices open, or not known closely enough; a note changes no judgement.
    """

    BLOCKING = "blocking"
    CONTRADICTS = "contradicts"
    CAUTION = "caution"
    NOTE = "note"


MOST_OF_A_KIND = 3  # findings that one check makes of one kind


class Finding(NamedTuple):
    """One fact that a check found.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    severity : Severity
    sentence : str
        What was found, by what it shows.
    remedy : str
        What to do about it; empty where the sentence says so, or nothing is to be done.
    run : int or None
        Number of the run, from 1, where one alone shows it.
    channel : str or None
        Name of the sensor or other channel, where one alone shows it.
    numbers : mapping from str to float
        The figures in the sentence, in SI units and fractions.
    """

    kind: Kind
    severity: Severity
    sentence: str
    remedy: str = ""
    run: int | None = None
    channel: str | None = None
    numbers: Mapping[str, float] = {}  # never changed

    def __str__(self) -> str:
        return "; ".join(filter(None, (self.sentence, self.remedy)))

    def of_test(self, number: int) -> Finding:
        """The same, of one of several tests."""
        return self._replace(
            sentence=f"test {number}: {self.sentence}", numbers={**self.numbers, "test": float(number)}
        )

    def to_tree(self) -> dict[str, Any]:
        """Give the fields by their names, figures beside theirs, which may be any text; `from_tree` takes them back."""
        values = np.array(list(self.numbers.values()), dtype=float)
        return {**self._asdict(), "severity": str(self.severity), "numbers": tuple(self.numbers), "values": values}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Finding:
        """Give the finding of a tree that `to_tree` made."""
        given = dict(tree)
        numbers = dict(zip(tree["numbers"], given.pop("values").tolist(), strict=True))
        return cls(**{**given, "severity": Severity(tree["severity"]), "numbers": numbers})


def weightiest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by severity, each once; those of one severity in the order in which they were found.

    Delays come first: they were taken off before all else was found.
    """
    each: list[Finding] = []
    for finding in findings:
        if finding not in each:
            each.append(finding)
    return tuple(sorted(each, key=lambda one: (one.kind != "late sensor", list(Severity).index(one.severity))))


def contradicting(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Those that speak against an answer."""
    return tuple(one for one in findings if one.severity in (Severity.BLOCKING, Severity.CONTRADICTS))


def cautions(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Those that leave matrices open."""
    return tuple(one for one in findings if one.severity is Severity.CAUTION)


def is_fit(findings: Iterable[Finding]) -> bool:
    """True where none of the findings says that the search ended without a fit."""
    return not any(one.kind in _NO_FIT for one in contradicting(findings))


def judgement_of(findings: Iterable[Finding]) -> Judgement:
    """Judgement of an answer by its findings, in a word."""
    every = tuple(findings)
    if not is_fit(every):
        return "no fit"
    if contradicting(every):
        return "doubtful"
    return "one of many" if cautions(every) else "determined"
