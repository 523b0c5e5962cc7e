"""The table of a comparison: as text for a terminal, and as CSV."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Iterator

import numpy as np

from sysid.compare.comparison import Comparison
from sysid.compare.method_result import MATRICES, MethodResult, Status
from sysid.results.phases import seconds_in_words
from sysid.results.summary import WIDTH
from sysid.results.tables import in_columns


def comparison_text(comparison: Comparison) -> str:
    """Table for a terminal: a line a method, below it what the columns are, and why a method is no fit."""
    results = comparison.results
    columns = [
        ("method", [result.name for result in results]),
        ("before", [_number(result.before, ".2e") for result in results]),
        ("after", [_number(result.after, ".2e") for result in results]),
        *_residual(comparison),
        *_errors(comparison),
        ("evaluations", [_number(result.evaluations or np.nan, ",.0f") for result in results]),
        ("seconds", [_number(result.seconds, ".2f") for result in results]),
        ("status", [result.status.value for result in results]),
    ]
    rows = zip(*([head, *column] for head, column in columns), strict=True)
    return "\n".join([*in_columns(rows, (0, -1)), *_notes(comparison)])


def line(result: MethodResult) -> str:
    """One method in a line, as it has ended."""
    if not result.ran:
        return f"{result.name}: {result.status.value}"
    before = f"{_number(result.before, '.2e')} -> " if np.isfinite(result.before) else ""
    return f"{result.name}: {result.status.value}, {before}{result.after:.2e}, {seconds_in_words(result.seconds)}"


def as_csv(comparison: Comparison) -> str:
    """Rows of `MethodResult.to_dict`, below their names; empty cells for what is not known."""
    rows = [result.to_dict() for result in comparison.results]
    out = io.StringIO()
    writer = csv.DictWriter(out, list(MethodResult("", Status.FAILED).to_dict()), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value != value else value for name, value in row.items()} for row in rows)
    return out.getvalue()


def _residual(comparison: Comparison) -> Iterator[tuple[str, list[str]]]:
    """The residual in a column of its own, where another quantity is minimised."""
    if comparison.quantity != "residual":
        yield "residual", [_number(result.residual, ".2e") for result in comparison.results]


def _errors(comparison: Comparison) -> Iterator[tuple[str, list[str]]]:
    """Columns of the errors, where there is a reference."""
    if comparison.problem.reference is not None:
        for i, name in enumerate(MATRICES):
            yield f"{name}, %", [_number(result.errors[i], ".2g") for result in comparison.results]


def _notes(comparison: Comparison) -> Iterator[str]:
    """Meaning of the columns, and the words of the methods that are no fit."""
    what = {
        "residual": "relative residual",
        "objective": "objective (all that is fitted, weighed by its stated noise)",
    }[comparison.quantity]
    truth, errors = comparison.problem.reference, ""
    if truth is not None:
        undamped = ", which has no damping, so that C has no relative error" * (not np.any(truth.damping))
        errors = f"; M, K, C: error against the reference{undamped}"
    yield from _folded(f"before, after: {what} before and after the local phase{errors}", "")
    for result in comparison.results:
        if result.status is not Status.FIT:
            yield from _folded(f"{result.name}: {' '.join(result.message.split())}", "  - ")


def _folded(words: str, mark: str) -> list[str]:
    indent = " " * (len(mark) or 2)
    return textwrap.wrap(words, WIDTH, initial_indent=mark, subsequent_indent=indent, break_on_hyphens=False)


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "-"
