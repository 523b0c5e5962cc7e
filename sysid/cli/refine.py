"""``sysid refine RESULT``: jobs about a result (starts, draws of noise, parts of its test, other models)."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid import catalogue
from sysid.cli.files import alone_in, png, results_folder, table_as_csv, write_files
from sysid.cli.output import Output
from sysid.cli.requests import check_trust, typed_module, with_problem_of
from sysid.cli.starting import INTERRUPTED, NOT_REACHED, SUCCESS
from sysid.errors import InputError
from sysid.jobs.changes import Band, Change, NumberOfModes, WithoutRun, WithoutSensor
from sysid.jobs.engine import cluster, processes
from sysid.jobs.job import JobResult
from sysid.jobs.minima import Minimum, Spread, as_good, distinct, spreads
from sysid.jobs.score import DECISIVE, Compared, Move, moves, scored
from sysid.jobs.submission import FILE_NAME as LEDGER
from sysid.jobs.submission import submit
from sysid.problem.problem import Problem
from sysid.problem.terms import FurtherTest
from sysid.results.identification import Identification, Recipe, load
from sysid.results.summary import WIDTH
from sysid.results.tables import counted, in_columns
from sysid.search.modal import poles_of
from sysid.structure.thresholds import EXACT, FALSE_ALARM, most_deviations

_LARGER = (
    "draws have the noise under which least squares scatter as Huber's loss does on the records: it is some per cent\n"
    "larger than theirs, and so are the residuals"
)


def run(options: argparse.Namespace, out: Output) -> int:
    """Run the jobs that are asked for; tell each end in a line, then all of them together."""
    source = Path(options.result)
    result = load(source)
    recipe = _recipe(result, options, source, out)
    if result.part is not None:
        result = with_problem_of(result, recipe, source)
    folder = results_folder(options.out, (source if source.is_dir() else source.parent) / "refine")
    with alone_in(folder, "wait for its end, or write elsewhere with --out DIR"):
        return _run_in(folder, result, recipe, options, out)


def _run_in(folder: Path, result: Identification, recipe: Recipe, options: argparse.Namespace, out: Output) -> int:
    source = Path(options.result)
    executor = _executor(options)
    check_same_records(result, recipe)
    sweep = sweep_of(options, result, recipe, out)
    if sweep is not None:
        titles, kind = [*sweep.titles], sweep.kind
        jobs = submit(sweep.recipes, changes=sweep.changes, strategy="auto", executor=executor, out=folder)
    elif options.draws is not None:
        if result.residual < EXACT:
            raise InputError(f"{source} fits its records exactly: without noise there is nothing to draw")
        titles, kind = [f"draw {i:4d}" for i in range(options.draws)], "draw{s} of noise, each fitted from the result"
        jobs = submit(_started(recipe, source), draws=options.draws, executor=executor, out=folder)
    else:
        count = options.starts or 16
        titles, kind = [f"start {i:4d}" for i in range(count)], "start{s}, the first at the result"
        jobs = submit(_started(recipe, source), starts=count, executor=executor, out=folder)
    out.write(f"{recipe.title}: {len(titles)} {kind.format(s='' if len(titles) == 1 else 's')}\n")
    out.flush()
    try:
        ends, interrupted = _ends(jobs, titles, out)
        if interrupted and not ends:
            pass  # there is nothing to tell
        elif sweep is not None:
            report_sweep(folder, result, recipe, sweep, ends, out)
        elif options.draws is not None:
            report_draws(folder, result, recipe, ends, out)
        else:
            minima = distinct(result.prepared, ends)
            out.write(f"\n{minima_table(minima, len(ends))}\n\n")
            out.answer(minima=[_figures(minimum) for minimum in minima])
            _write(folder, recipe, ends, minima, result.problem, out)
        out.wrote(folder / LEDGER)
    except KeyboardInterrupt:
        out.complain(f"interrupted while saving; results are in {folder / LEDGER}: the same command writes the files")
        return INTERRUPTED
    if interrupted:
        out.complain(f"interrupted after {len(ends)} of {len(titles)} jobs; the same command goes on from there")
        return INTERRUPTED
    # A model that is too simple is what a comparison may show.
    reached = any(end.has_result if sweep is not None else end.success for end in ends)
    return SUCCESS if reached else NOT_REACHED


def _ends(jobs: Generator[JobResult, None, None], titles: Sequence[str], out: Output) -> tuple[list[JobResult], bool]:
    """Tell the ends of jobs as they come, and give them by index; whether Ctrl-C ended that."""
    ends: list[JobResult] = []
    interrupted = False
    try:
        with closing(jobs):  # also where Ctrl-C strikes while an end is told
            for end in jobs:
                ends.append(end)
                left = f"residual {end.residual:.4e}" if end.has_result else "no result"
                out.progress(f"{len(ends):4d} of {len(titles)}  {titles[end.index]}  {left}  {end.message}\n")
    except KeyboardInterrupt:
        interrupted = True
    return sorted(ends, key=lambda one: one.index), interrupted


def minima_table(minima: list[Minimum], starts: int, most: int = 12) -> str:
    """The minima, `most` of them, how often each was reached, and what they say together."""
    lines = ["minimum    residual  reached  a fit  best start"]
    for i, minimum in enumerate(minima[:most]):
        best, fit = minimum.best, "yes" if minimum.best.success else "no"
        lines.append(f"{i + 1:7d}  {best.residual:10.4e}  {len(minimum.results):7d}  {fit:5s}  {best.index:10d}")
    if len(minima) > most:
        lines.append(f"and {len(minima) - most} more")
    without = starts - sum(len(minimum.results) for minimum in minima)
    lines += [f"{counted(without, 'start')} without a result"] if without else []
    alike = len(as_good(minima))
    if alike > 1:
        lines.append(
            f"{alike} minima with different matrices or unknowns fit alike: data and model do not tell them apart"
        )
    elif minima:
        lines.append(f"the best minimum was reached from {len(minima[0].results)} of {starts} starts")
    return "\n".join(lines)


def _figures(minimum: Minimum) -> dict[str, Any]:
    """A minimum for the JSON document."""
    best = minimum.best
    return {
        "residual": best.residual, "reached": len(minimum.results), "success": best.success, "best_start": best.index,
        "unknowns": best.x.tolist(),
    }  # fmt: skip


def _recipe(result: Identification, options: argparse.Namespace, source: Path, out: Output) -> Recipe:
    """The recipe of the problem of a result: by a module that the user names, or that may run."""
    if result.recipe is None:
        raise InputError(
            f"{source} was not made from a problem module, so that no worker could rebuild its problem: save the "
            "problem as a module and run it with 'sysid run'"
        )
    x = result.x
    recipe = replace(result.recipe, start=None if x is None else tuple(x.tolist()))
    if options.module is not None:
        return replace(recipe, module=typed_module(options.module, out))
    check_trust(recipe, source, f"sysid refine {source} --module FILE.py", options)
    return recipe


def _started(recipe: Recipe, source: Path) -> Recipe:
    """The recipe, where it has a start."""
    if recipe.start is None:
        raise InputError(
            f"{source}: its degrees of freedom are not the sensors, so it has no unknowns of the problem to start from"
        )
    return recipe


def _executor(options: argparse.Namespace) -> Callable[[], Executor] | None:
    if options.scheduler is not None:
        if options.workers is not None:
            raise InputError("--workers and --scheduler exclude each other: a cluster has its own workers")
        return cluster(options.scheduler)
    return None if options.workers == 1 else processes(options.workers)


def _write(
    folder: Path, recipe: Recipe, ends: list[JobResult], minima: list[Minimum], problem: Problem, out: Output
) -> None:
    """Write the ends of all starts as CSV, and the picture."""
    from sysid.plot.comparison import minima as picture

    of = {end.index: i + 1 for i, minimum in enumerate(minima) for end in minimum.results}
    names = ("start", "seed", "success", "residual", "minimum", "message", *problem.formulation.labels)
    rows: list[Sequence[object]] = [names]
    for end in ends:
        left, minimum = repr(end.residual) if end.has_result else "", of.get(end.index, "")
        rows.append((end.index, end.seed, end.success, left, minimum, end.message, *map(repr, end.x.tolist())))
    drawn = png(picture, minima, recipe.title, goal=problem.goal) if minima else None
    write_files(folder, {"starts.csv": table_as_csv(rows), "minima.png": drawn}, out)


def report_draws(folder: Path, result: Identification, recipe: Recipe, ends: list[JobResult], out: Output) -> None:
    """Write all draws; where two of them or more are fits, print their spreads and write these and the picture."""
    from sysid.plot.comparison import draws as picture

    names = ("draw", "seed", "success", "residual", "message", *result.problem.formulation.labels)
    each: list[Sequence[object]] = [names]
    for end in ends:
        left = repr(end.residual) if end.has_result else ""
        each.append((end.index, end.seed, end.success, left, end.message, *map(repr, end.x.tolist())))
    count = sum(end.success for end in ends)
    files: dict[str, bytes | None] = {"draws.csv": table_as_csv(each), "spreads.csv": None, "draws.png": None}
    if count < 2:
        out.write(f"\n{count} of {len(ends)} draws ended in a fit; two are needed for a spread\n\n")
    else:
        found = spreads(result, ends)
        out.write(f"\n{spread_table(found, count, len(ends))}\n\n")
        if result.problem.loss == "huber":
            out.write(f"{_LARGER}\n\n")
        out.answer(spreads=[vars(spread) for spread in found])
        of_all: list[Sequence[object]] = [("quantity", "value", "linear_std", "draws_std", "inside_share")]
        of_all += [(s.name, repr(s.value), repr(s.std), repr(s.drawn), repr(s.inside)) for s in found]
        files["spreads.csv"] = table_as_csv(of_all)
        if any(np.isfinite(spread.ratio) for spread in found):
            files["draws.png"] = png(picture, found, count, recipe.title)
    write_files(folder, files, out)


def spread_table(found: Sequence[Spread], count: int, asked: int) -> str:
    """A line a quantity: value, standard deviations to first order and of the draws, and how often it was within."""
    width = max(len(spread.name) for spread in found)
    lines = [f"{'':{width}}  {'value':>10}  {'linear std':>10}  {'draws std':>10}  ratio  within, %"]
    for spread in found:
        known = np.isfinite(spread.ratio)
        beside = f"{spread.ratio:5.2f}  {100 * spread.inside:9.0f}" if known else "    -          -"
        linear = f"{spread.std:10.3g}" if known else "         -"
        lines.append(f"{spread.name:{width}}  {spread.value:10.5g}  {linear}  {spread.drawn:10.3g}  {beside}")
    lines += [
        f"std: standard deviation, to first order and of {count} draws, whose ratio chance moves by "
        f"{100 / np.sqrt(2 * count):.0f} %; within: draws",
        "in the linear interval, which should hold 95 %",
    ]
    if count < asked:
        lines.append(f"{counted(asked - count, 'draw')} without a fit: not counted")
    return "\n".join(lines)


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
        modules = [typed_module(module, out) for module in options.variants]
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
    from sysid.plot.comparison import sweep as picture

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
