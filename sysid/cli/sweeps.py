"""``sysid refine RESULT --leave-out, --bands, --variants``: whole identifications beside a result, compared."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sysid import catalogue
from sysid.cli.display import Output
from sysid.cli.files import table_as_csv, write_files
from sysid.errors import InputError
from sysid.jobs.changes import Band, Change, WithoutRun, WithoutSensor
from sysid.jobs.job import JobResult
from sysid.jobs.score import Compared, Move, moves, scored
from sysid.measurement.measurement import Measurement
from sysid.results.identification import Identification, Recipe

_FAR = 3.0  # standard deviations of a step, beyond which it counts as far
_WIDTH = 120


@dataclass(frozen=True)
class Sweep:
    """Identifications beside a result.

    Attributes
    ----------
    titles : tuple of str
        Of the jobs, in their order.
    recipes : tuple of Recipe
    changes : tuple of Change
        Of the one recipe; empty where the recipes differ.
    told : str
        What they are together.
    """

    titles: tuple[str, ...]
    recipes: tuple[Recipe, ...]
    changes: tuple[Change, ...]
    told: str


def sweep_of(options: argparse.Namespace, result: Identification, recipe: Recipe) -> Sweep | None:
    """What the command line asks for; None where that is starts or draws."""
    test = result.measurement
    if options.variants:
        return _variants(options.variants, test, recipe)
    changes: tuple[Change, ...] = ()
    told = ""
    if options.leave_out == "run":
        changes = tuple(WithoutRun(i) for i in range(test.n_runs))
        told = "identifications, each without one run"
    elif options.leave_out == "sensor":
        changes = tuple(WithoutSensor(i, name) for i, name in enumerate(test.sensor_names))
        told = "identifications, each without one sensor"
    elif options.bands:
        changes = tuple(Band(low, high) for low, high in options.bands)
        told = "identifications, each of one band"
    if len(changes) == 1 and options.leave_out:
        raise InputError(f"the test has one {options.leave_out}; without it nothing is left")
    return Sweep(tuple(change.title for change in changes), (recipe,), changes, told) if changes else None


def _variants(modules: Sequence[str], test: Measurement, own: Recipe) -> Sweep:
    """Other modules with the data and the noise of a result's."""
    recipes = tuple(Recipe(module, own.data, own.rng) for module in modules)
    for one in recipes:
        other = catalogue.build(one).measurement
        pairs = [(getattr(test, name), getattr(other, name)) for name in ("freq", "base", "response", "force")]
        if not all(np.array_equal(mine, its) for mine, its in pairs):
            raise InputError(
                f"{one.module} has other records than the result of {own.module}: variants are compared on one test, "
                "so let both modules read the same data"
            )
    return Sweep(tuple(one.title for one in recipes), recipes, (), "other models of the same records")


def tell(
    folder: Path, result: Identification, recipe: Recipe, sweep: Sweep, ends: Sequence[JobResult], out: Output
) -> None:
    """Print the table of all identifications, and write it, all moves and the picture."""
    from sysid.plot.canvas import own_style, to_png
    from sysid.plot.sweep import sweep as picture

    own, part = scored(result), bool(sweep.changes)
    at = {end.index: end for end in ends if end.score is not None}
    rows = [Compared(recipe.title, result.success, result.residual, own)]
    for index, title in enumerate(sweep.titles):
        if index in at and (score := at[index].score) is not None:
            moved = moves(own, score, part=part)
            rows.append(Compared(title, at[index].success, at[index].residual, score, moved))
    out.write(f"\n{table(rows, part)}\n\n")
    files = {"identifications.csv": _as_csv(rows, sweep, ends), "moves.csv": _moves_as_csv(rows)}
    if len(rows) > 1:
        with own_style():
            files["identifications.png"] = to_png(picture(rows, recipe.title, part=part), dpi=130)
    write_files(folder, files, out)


def table(rows: Sequence[Compared], part: bool) -> str:
    """A line an identification, the result's own first; `part` where they are of parts of the records."""
    columns = [
        ("", [row.title for row in rows]),
        ("a fit", ["yes" if row.success else "no" for row in rows]),
        ("determined", ["yes" if row.score.determined else "no" for row in rows]),
        ("residual", [f"{row.residual:.3e}" for row in rows]),
    ]
    predicted = [row.score.predicted for row in rows]
    if np.any(np.isfinite(predicted)):
        columns.append(("predicted", [_number(value, ".3e") for value in predicted]))
    if not part:
        columns.append(("parameters", [f"{row.score.parameters}" for row in rows]))
        for name, values in criteria(rows).items():
            columns.append((name, [_number(value, ".1f") for value in values]))
    columns.append(("farthest", [_farthest(row.moves) for row in rows]))
    cells = [[head, *column] for head, column in columns]
    widths = [max(map(len, column)) for column in cells]
    lines = []
    for first, *others, last in zip(*cells, strict=True):
        middle = "  ".join(f"{cell:>{width}}" for cell, width in zip(others, widths[1:-1], strict=True))
        lines.append(f"{first:{widths[0]}}  {middle}  {last}".rstrip())
    return "\n".join([*lines, *_notes(rows, part)])


def criteria(rows: Sequence[Compared]) -> dict[str, list[float]]:
    """AIC and BIC of all rows above the least."""
    made = {}
    for name in ("aic", "bic"):
        values = [getattr(row.score, name) for row in rows]
        least = min((value for value in values if np.isfinite(value)), default=np.nan)
        made[name.upper()] = [value - least for value in values]
    return made


def _farthest(steps: Sequence[Move]) -> str:
    if not steps:
        return ""
    known = [step for step in steps if np.isfinite(step.deviations)]
    step = max(known or steps, key=lambda one: abs(one.deviations if known else one.relative))
    told = f", {abs(step.deviations):.1f} std" if known else ""
    return f"{step.name}: {100 * step.relative:+.2g} %{told}"


def _notes(rows: Sequence[Compared], part: bool) -> Iterator[str]:
    """What the columns are, and what all rows say together."""
    steps = [step for row in rows if row.success for step in row.moves if np.isfinite(step.deviations)]
    if part:
        yield "predicted: relative residual of what was left out, where the structure tells its motion"
        text = (
            "farthest: of frequencies, damping ratios and unknowns, the step from the first row that is largest in "
            "standard deviations (std) of what noise alone would make of it"
        )
    else:
        yield "predicted: relative residual of the validation tests; AIC, BIC: above the least, 10 and more is decisive"
        text = "farthest: of frequencies, damping ratios and unknowns of one name, the largest step from the first row"
    yield from textwrap.wrap(text, _WIDTH)
    if steps and part:
        far = sum(abs(step.deviations) > _FAR for step in steps)
        told = f"{far} of {len(steps)} steps of fits are beyond {_FAR:g} std; noise alone makes 0.3 %"
        yield told + (": more than noise moves them" if far > max(1, 0.01 * len(steps)) else "")


def _as_csv(rows: Sequence[Compared], sweep: Sweep, ends: Sequence[JobResult]) -> bytes:
    head: list[Sequence[object]] = [
        ("identification", "success", "determined", "residual", "predicted", "parameters", "aic", "bic", "message")
    ]
    messages = {sweep.titles[end.index]: end.message for end in ends}
    for row in rows:
        figures = (row.residual, row.score.predicted, row.score.parameters, row.score.aic, row.score.bic)
        told = messages.get(row.title, "")
        head.append((row.title, row.success, row.score.determined, *map(repr, figures), told))
    for end in ends:
        if end.score is None:
            head.append((sweep.titles[end.index], False, False, "", "", "", "", "", end.message))
    return table_as_csv(head)


def _moves_as_csv(rows: Sequence[Compared]) -> bytes:
    head: list[Sequence[object]] = [("identification", "quantity", "value", "relative_step", "step_in_std")]
    for row in rows:
        head += [
            (row.title, step.name, repr(step.value), repr(step.relative), repr(step.deviations)) for step in row.moves
        ]
    return table_as_csv(head)


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "-"
