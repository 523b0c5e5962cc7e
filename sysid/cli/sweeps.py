"""``sysid refine RESULT --leave-out, --bands, --orders, --variants``: identifications beside a result."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sysid import catalogue
from sysid.cli import trust
from sysid.cli.files import png, table_as_csv, write_files
from sysid.cli.output import Output
from sysid.errors import InputError
from sysid.jobs.changes import Band, Change, NumberOfModes, WithoutRun, WithoutSensor
from sysid.jobs.job import JobResult
from sysid.jobs.score import DECISIVE, Compared, Move, moves, scored
from sysid.problem.problem import Problem
from sysid.problem.terms import FurtherTest
from sysid.results.identification import Identification, Recipe
from sysid.results.summary import WIDTH
from sysid.results.tables import in_columns
from sysid.search.modal import poles_of
from sysid.structure.thresholds import FALSE_ALARM, most_deviations


@dataclass(frozen=True)
class Sweep:
    """Identifications beside a result.

    Attributes
    ----------
    name : str
        Of its files.
    kind : str
        Kind of the jobs, for the first line; "{s}" is to be put in for the plural.
    titles : tuple of str
        Of the jobs, in their order.
    recipes : tuple of Recipe
    changes : tuple of Change
        Of the one recipe; empty where the recipes differ.
    """

    name: str
    kind: str
    titles: tuple[str, ...]
    recipes: tuple[Recipe, ...]
    changes: tuple[Change, ...] = ()

    @property
    def of_parts(self) -> bool:
        """True where each leaves some records out."""
        return bool(self.changes) and not isinstance(self.changes[0], NumberOfModes)


def sweep_of(options: argparse.Namespace, result: Identification, recipe: Recipe, out: Output) -> Sweep | None:
    """The sweep that the command line asks for; None where that is starts or draws."""
    if options.variants:
        modules = [trust.typed_module(module, out) for module in options.variants]
        recipes = tuple(Recipe(module, recipe.data, recipe.rng) for module in modules)
        for one in recipes:
            if not _same_records(result, catalogue.build(one)):
                raise InputError(
                    f"{one.title} has other records than the result: all have to read the same test (a variant is "
                    "built with the result's data, and with its own parameters as they are by default)"
                )
        return Sweep("variants", "other model{s} of the same records", tuple(one.title for one in recipes), recipes)
    changes: tuple[Change, ...] = ()
    name = kind = ""
    if options.leave_out == "run":
        changes = tuple(WithoutRun(i) for i in range(result.measurement.n_runs))
        name, kind = "without_run", "identification{s}, each without one run"
    elif options.leave_out == "sensor":
        changes = tuple(WithoutSensor(i, sensor) for i, sensor in enumerate(result.measurement.sensor_names))
        name, kind = "without_sensor", "identification{s}, each without one sensor"
    elif options.bands:
        changes = tuple(Band(low, high) for low, high in options.bands)
        name, kind = "bands", "identification{s}, each of one band"
    elif options.orders:
        name, (changes, kind) = "orders", _orders(options.orders[0], options.orders[1], result.problem)
    if not changes:
        return None
    _check_possible(changes, result.problem)
    return Sweep(name, kind, tuple(change.title for change in changes), (recipe,), changes)


def _orders(low: int, high: int, problem: Problem) -> tuple[tuple[Change, ...], str]:
    """Numbers of modes up to those that stand out of the noise, and what the jobs are."""
    changes, kind = tuple(map(NumberOfModes, range(low, high + 1))), "identification{s}, each of so many modes"
    _check_possible(changes, problem)
    found = poles_of(problem.prepared.screened).omega.size
    if low > found:
        raise InputError(f"{found} modes stand out of the noise, fewer than the {low} asked for")
    return changes[: found + 1 - low], kind if high <= found else f"{kind}: no more than {found} stand out of the noise"


def _check_possible(changes: Sequence[Change], problem: Problem) -> None:
    """Tell at once where none of the changes can be made."""
    refusals = []
    for change in changes:
        try:
            change.of(problem)
        except InputError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]


def check_same_records(result: Identification, recipe: Recipe) -> None:
    """Refuse to compare a result with jobs of other records, as its module makes them now."""
    if not _same_records(result, catalogue.build(replace(recipe, start=None))):
        raise InputError(
            f"{recipe.title} now gives other records than those of the result, as the module, its data or what it "
            "reads has changed: identify them anew by 'sysid run'"
        )


def _same_records(result: Identification, other: Problem) -> bool:
    """True where a problem is of the result's records."""
    ours, its = (
        [problem.measurement, *(one.measurement for one in problem.residuals if isinstance(one, FurtherTest))]
        for problem in (result.problem, other)
    )
    names = ("freq", "base", "response", "force")
    pairs = [(getattr(mine, name), getattr(one, name)) for mine, one in zip(ours, its, strict=False) for name in names]
    return len(ours) == len(its) and all(np.array_equal(mine, one) for mine, one in pairs)


def report_sweep(
    folder: Path, result: Identification, recipe: Recipe, sweep: Sweep, ends: Sequence[JobResult], out: Output
) -> None:
    """Print the table of all identifications, and write it, all moves and the picture."""
    from sysid.plot.refinement import sweep as picture

    part = sweep.of_parts
    score = scored(result, np.nan if part else None)
    rows = [Compared(recipe.title, result.success, result.residual, result.message, score)]
    for end in ends:
        if end.score is not None:
            moved = moves(score, end.score, part=part)
            title = sweep.titles[end.index]
            rows.append(Compared(title, end.success, end.residual, end.message, end.score, moved))
    out.write(f"\n{comparison_table(rows, part)}\n\n")
    out.answer(identifications=[asdict(row) for row in rows])
    without = [(sweep.titles[end.index], end.message) for end in ends if end.score is None]
    drawn = png(picture, rows, recipe.title, part=part) if len(rows) > 1 else None
    tables = {f"{sweep.name}.csv": _as_csv(rows, without, part), f"{sweep.name}_moves.csv": _moves_as_csv(rows)}
    write_files(folder, {**tables, f"{sweep.name}.png": drawn}, out)


def comparison_table(rows: Sequence[Compared], part: bool) -> str:
    """A line an identification, the result's own first; `part` where they are of parts of the records."""
    columns = [
        ("", [row.title for row in rows]),
        ("a fit", _fits(rows, part)),
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
    lines = in_columns(zip(*([head, *column] for head, column in columns), strict=True), (0, -1))
    return "\n".join([*lines, *_notes(rows, part)])


def _fits(rows: Sequence[Compared], part: bool) -> list[str]:
    """A word a row, "yes" for a fit; of models of the same records "worse" where another fits better, decisively."""
    figures = np.array([(row.score.deviance, row.score.aic, row.score.bic) for row in rows])
    fits = [row.success for row in rows]
    beaten = [not part and np.any(np.all(figures[fits] + DECISIVE <= scores, axis=1)) for scores in figures]
    return ["no" if not fit else "worse" if worse else "yes" for fit, worse in zip(fits, beaten, strict=True)]


def criteria(rows: Sequence[Compared]) -> dict[str, list[float]]:
    """AIC and BIC of all rows above the least."""
    found = {name: [getattr(row.score, name) for row in rows] for name in ("aic", "bic")}
    least = {name: min(filter(np.isfinite, values), default=np.nan) for name, values in found.items()}
    return {name.upper(): [value - least[name] for value in values] for name, values in found.items()}


def _farthest(steps: Sequence[Move]) -> str:
    known = [step for step in steps if np.isfinite(step.deviations)]
    relative = [step for step in steps if np.isfinite(step.relative)]
    if not (known or relative):
        return ""
    step = max(known or relative, key=lambda one: abs(one.deviations if known else one.relative))
    words = f"{step.name}: {100 * step.relative:+.2g} %"
    return f"{words}, {abs(step.deviations):.1f} std" if known else words


def _notes(rows: Sequence[Compared], part: bool) -> Iterator[str]:
    """Meaning of the columns, and what all rows say together."""
    notes = ["a fit: the search ended well, with a residual within the goal, or the noise where none is stated"]
    predicted = int(np.any(np.isfinite([row.score.predicted for row in rows])))
    if part:
        notes += ["predicted: relative residual of what was left out, where the rest tells its motion"] * predicted
        notes += [
            "farthest: of frequencies, damping ratios and unknowns, the step from the first row that is largest in the "
            "standard deviations (std) that it has by noise alone"
        ]
    else:
        notes[0] += "; worse: another one fits better, by AIC and BIC decisively"
        notes += ["predicted: relative residual of the validation tests"] * predicted
        notes += [
            f"AIC, BIC: above the least; {DECISIVE:g} and more is decisive",
            "farthest: of frequencies, damping ratios and unknowns of one name, the step from the first row that is "
            "largest in standard deviations (std), the larger of both rows at the noise that the better fit leaves",
        ]
    for note in notes:
        yield from textwrap.wrap(note, WIDTH)
    steps = [step for row in rows if row.success for step in row.moves if np.isfinite(step.deviations)]
    if steps and part:
        reach = most_deviations()
        far = sum(abs(step.deviations) > reach for step in steps)
        chance = f"noise alone makes {100 * FALSE_ALARM:g} %"
        words = f"{far} of {len(steps)} steps of fits are beyond {reach:.2g} std; {chance}"
        yield words + (": more than noise moves them" if far > max(1, 0.01 * len(steps)) else "")


def _as_csv(rows: Sequence[Compared], without: Sequence[tuple[str, str]], part: bool) -> bytes:
    """A row an identification; AIC and BIC only where the records are the same."""
    lines: list[Sequence[object]] = [
        ("identification", "success", "determined", "residual", "predicted", "parameters", "aic", "bic", "message")
    ]
    for row in rows:
        score = row.score
        criteria_of = ("", "") if part else (repr(score.aic), repr(score.bic))
        figures = (repr(row.residual), repr(score.predicted), score.parameters, *criteria_of)
        lines.append((row.title, row.success, score.determined, *figures, row.message))
    lines += [(title, False, False, "", "", "", "", "", message) for title, message in without]
    return table_as_csv(lines)


def _moves_as_csv(rows: Sequence[Compared]) -> bytes:
    lines: list[Sequence[object]] = [("identification", "quantity", "value", "relative_step", "step_in_std")]
    for row in rows:
        lines += [
            (row.title, step.name, *map(repr, (step.value, step.relative, step.deviations))) for step in row.moves
        ]
    return table_as_csv(lines)


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "-"
