"""``sysid refine RESULT``: jobs about a result (starts, draws of noise, parts of its test, other models)."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.cli import sweeps, trust
from sysid.cli.files import alone_in, png, results_folder, table_as_csv, write_files
from sysid.cli.output import Output
from sysid.cli.status import INTERRUPTED, NOT_REACHED, SUCCESS
from sysid.cli.stored_result import with_problem_of
from sysid.errors import InputError
from sysid.jobs.engine import cluster, processes
from sysid.jobs.job import JobResult
from sysid.jobs.ledger import FILE_NAME as LEDGER
from sysid.jobs.minima import Minimum, as_good, distinct
from sysid.jobs.spread import Spread, spreads
from sysid.jobs.submit import submit
from sysid.problem.problem import Problem
from sysid.results.identification import Identification, Recipe, load
from sysid.results.tables import counted
from sysid.structure.thresholds import EXACT

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
    sweeps.check_same_records(result, recipe)
    sweep = sweeps.sweep_of(options, result, recipe, out)
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
            sweeps.report_sweep(folder, result, recipe, sweep, ends, out)
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
        return replace(recipe, module=trust.typed_module(options.module, out))
    trust.check_trust(recipe, source, f"sysid refine {source} --module FILE.py", options)
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
    from sysid.plot.refinement import minima as picture

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
    from sysid.plot.refinement import draws as picture

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
