"""``sysid refine RESULT``: jobs about a result (starts, draws of noise, parts of its test, other models)."""

from __future__ import annotations

import argparse
import functools
import textwrap
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sysid import catalogue
from sysid.cli.output import Output, alone_in, png, results_folder, table_as_csv, write_files
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
from sysid.modal_analysis.modal_fit import too_few
from sysid.problem.problem import Problem
from sysid.problem.terms import FurtherTest
from sysid.results.identification import Identification, Recipe, load
from sysid.results.summary import WIDTH
from sysid.results.tables import counted, in_columns, quantities
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
    asked = _submitted(folder, result, recipe, options, out)
    count = len(asked.titles)
    out.write(f"{recipe.title}: {count} {asked.kind.format(s='' if count == 1 else 's')}\n")
    out.flush()
    try:
        ends, interrupted = _ends(asked, out)
        if ends or not interrupted:
            asked.report(ends)
        out.wrote(folder / LEDGER)
    except KeyboardInterrupt:
        out.complain(f"interrupted while saving; results are in {folder / LEDGER}: the same command writes the files")
        return INTERRUPTED
    if interrupted:
        out.complain(f"interrupted after {len(ends)} of {count} jobs; the same command goes on from there")
        return INTERRUPTED
    return SUCCESS if any(map(asked.is_reached, ends)) else NOT_REACHED


@dataclass(frozen=True)
class _Submitted:
    """Jobs that were submitted: what they are, and what is told of all of them."""

    titles: Sequence[str]
    kind: str  # in words; "{s}" is put in for the plural
    jobs: Generator[JobResult, None, None]
    report: Callable[[list[JobResult]], None]
    is_reached: Callable[[JobResult], bool]


def _submitted(
    folder: Path, result: Identification, recipe: Recipe, options: argparse.Namespace, out: Output
) -> _Submitted:
    """Submit the jobs that the command line asks for."""
    send, source = functools.partial(submit, executor=_executor(options), out=folder), Path(options.result)
    check_same_records(result, recipe)
    sweep = sweep_of(options, result, recipe, out)
    if sweep is not None:
        jobs = send(sweep.recipes, changes=sweep.changes, strategy="auto")
        # A model that is too simple is what a comparison may show.
        return _Submitted(
            sweep.titles, sweep.kind, jobs, lambda ends: report_sweep(folder, result, recipe, sweep, ends, out),
            lambda end: end.has_result,
        )  # fmt: skip
    if options.draws is not None:
        if result.residual < EXACT:
            raise InputError(f"{source} fits its records exactly: without noise there is nothing to draw")
        word, count, kind = "draw", options.draws, "draw{s} of noise, each fitted from the result"
        by = "modal" if recipe.start is None else ""
        jobs, report = send(recipe, draws=count, strategy=by), report_draws
    else:
        word, count, kind = "start", options.starts or 16, "start{s}, the first at the result"
        jobs, report = send(_started(recipe, source), starts=count), report_minima
    titles = [f"{word} {i:4d}" for i in range(count)]
    return _Submitted(
        titles, kind, jobs, lambda ends: report(folder, result, recipe, ends, out), lambda end: end.success
    )


def _ends(asked: _Submitted, out: Output) -> tuple[list[JobResult], bool]:
    """Tell the ends of jobs as they come, and give them by index; whether Ctrl-C ended that."""
    ends: list[JobResult] = []
    interrupted = False
    try:
        with closing(asked.jobs):  # also where Ctrl-C strikes while an end is told
            for end in asked.jobs:
                ends.append(end)
                left = f"residual {end.residual:.4e}" if end.has_result else "no result"
                count, title = f"{len(ends):4d} of {len(asked.titles)}", asked.titles[end.index]
                out.progress(f"{count}  {title}  {left}  {end.message}\n")
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
        why = "its degrees of freedom are not the sensors, so it has no unknowns to start from"
        raise InputError(f"{source}: {why}; --draws, --leave-out, --bands and --orders need none")
    return recipe


def _executor(options: argparse.Namespace) -> Callable[[], Executor] | None:
    if options.scheduler is not None:
        if options.workers is not None:
            raise InputError("--workers and --scheduler exclude each other: a cluster has its own workers")
        return cluster(options.scheduler)
    return None if options.workers == 1 else processes(options.workers)


def report_minima(folder: Path, result: Identification, recipe: Recipe, ends: list[JobResult], out: Output) -> None:
    """Print the minima of all starts, and write the starts and the picture."""
    from sysid.plot.comparison import minima as picture

    minima = distinct(result.prepared, ends)
    out.write(f"\n{minima_table(minima, len(ends))}\n\n")
    figures = [
        {"residual": it.residual, "reached": len(it.results), "success": it.best.success, "best_start": it.best.index,
         "unknowns": it.best.x.tolist()}
        for it in minima
    ]  # fmt: skip
    out.answer(minima=figures)
    of = {end.index: i + 1 for i, minimum in enumerate(minima) for end in minimum.results}
    drawn = png(picture, minima, recipe.title, goal=result.problem.goal) if minima else None
    table = _as_rows("start", ends, result, minimum=[of.get(end.index, "") for end in ends])
    write_files(folder, {"starts.csv": table, "minima.png": drawn}, out)


def _as_rows(what: str, ends: list[JobResult], result: Identification, **more: Sequence[object]) -> bytes:
    """A row an end as CSV, with `more` columns; its unknowns, or what an answer without unknowns tells."""
    told = list(quantities(result)) if result.x is None else []
    names = told or result.problem.formulation.labels
    rows: list[Sequence[object]] = [(what, "seed", "success", "residual", *more, "message", *names)]
    for end, *others in zip(ends, *more.values(), strict=True):
        left = repr(end.residual) if end.has_result else ""
        values = end.x.tolist() if end.score is None else [end.score.values[name] for name in told]
        rows.append((end.index, end.seed, end.success, left, *others, end.message, *map(repr, values)))
    return table_as_csv(rows)


def report_draws(folder: Path, result: Identification, recipe: Recipe, ends: list[JobResult], out: Output) -> None:
    """Write all draws; where two of them or more are fits, print their spreads and write these and the picture."""
    from sysid.plot.comparison import draws as picture

    count = sum(end.success for end in ends)
    files: dict[str, bytes | None] = {"spreads.csv": None, "draws.png": None}
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
    write_files(folder, {"draws.csv": _as_rows("draw", ends, result), **files}, out)


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
    """Identifications beside a result."""

    name: str  # of its files
    kind: str  # of the jobs, for the first line; "{s}" is put in for the plural
    recipes: tuple[Recipe, ...]
    changes: tuple[Change, ...] = ()  # of the one recipe; empty where the recipes differ

    @property
    def titles(self) -> tuple[str, ...]:
        """Of the jobs, in their order."""
        return tuple(one.title for one in self.changes or self.recipes)

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
        return Sweep("variants", "other model{s} of the same records", recipes)
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
    return Sweep(name, kind, (recipe,), changes)


def _orders(low: int, high: int, problem: Problem) -> tuple[tuple[Change, ...], str]:
    """Numbers of modes up to those that stand out of the noise, and what the jobs are."""
    changes, kind = tuple(map(NumberOfModes, range(low, high + 1))), "identification{s}, each of so many modes"
    _check_possible(changes, problem)
    prepared = problem.prepared.screened
    found = int(np.count_nonzero(prepared.of_structure(poles_of(prepared).omega)))
    if low > found:
        raise InputError(too_few(found, low))
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
