"""``sysid refine RESULT --starts N``: the local phase from many starts, and the distinct minima that it ends in."""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from sysid.cli.display import Output, complain
from sysid.cli.files import results_folder
from sysid.cli.status import INTERRUPTED, NOT_REACHED, SUCCESS
from sysid.errors import InputError
from sysid.jobs.engine import cluster, processes
from sysid.jobs.job import JobResult
from sysid.jobs.ledger import FILE_NAME as LEDGER
from sysid.jobs.minima import Minimum, as_good, distinct
from sysid.jobs.submit import submit
from sysid.problem.problem import Problem
from sysid.results.identification import Identification, Recipe, load
from sysid.results.storage import atomically

_SHOWN = 12  # minima in the table


def run(options: argparse.Namespace, out: Output) -> int:
    """Refine from the result and from fresh points, tell each end in a line, then the distinct minima."""
    source = Path(options.result)
    result = load(source)
    recipe = _recipe(result, source)
    folder = results_folder(options.out, (source if source.is_dir() else source.parent) / "refine")
    executor = _executor(options)
    ends: list[JobResult] = []
    interrupted = False
    out.write(f"{recipe.title}: {options.starts} starts, the first at the result\n")
    try:
        for end in submit(recipe, starts=options.starts, executor=executor, out=folder):
            ends.append(end)
            left = f"residual {end.residual:.4e}" if end.x.size else "no result"
            out.write(f"{len(ends):4d} of {options.starts}  start {end.index:4d}  {left}  {end.message}\n")
            out.flush()
    except KeyboardInterrupt:
        interrupted = True
    minima = distinct(result.problem, ends)
    out.write(f"\n{table(minima, len(ends))}\n\n")
    _write(folder, recipe, ends, minima, result.problem, out)
    if interrupted:
        complain(f"interrupted after {len(ends)} of {options.starts} starts; the same command goes on from there")
        return INTERRUPTED
    return SUCCESS if any(end.success for end in ends) else NOT_REACHED


def table(minima: list[Minimum], starts: int) -> str:
    """The minima, how often each was reached, and what they say together."""
    lines = ["minimum    residual  reached  a fit  best start"]
    for i, minimum in enumerate(minima[:_SHOWN]):
        best, fit = minimum.best, "yes" if minimum.best.success else "no"
        lines.append(f"{i + 1:7d}  {best.residual:10.4e}  {len(minimum.results):7d}  {fit:5s}  {best.index:10d}")
    if len(minima) > _SHOWN:
        lines.append(f"and {len(minima) - _SHOWN} more")
    without = starts - sum(len(minimum.results) for minimum in minima)
    lines += [f"{without} starts have no result"] if without else []
    alike = len(as_good(minima))
    if alike > 1:
        lines.append(f"{alike} minima with different unknowns fit alike: the data and the model do not tell them apart")
    elif minima:
        lines.append(f"the best minimum was reached from {len(minima[0].results)} of {starts} starts")
    return "\n".join(lines)


def _recipe(result: Identification, source: Path) -> Recipe:
    if result.recipe is None:
        raise InputError(
            f"{source} was not made from a problem module, so that no worker could rebuild its problem: save the "
            "problem as a module and run it with 'sysid run'"
        )
    if result.x is None:
        raise InputError(
            f"{source}: its degrees of freedom are not the sensors, so it has no unknowns of the problem to start from"
        )
    return replace(result.recipe, start=tuple(result.x.tolist()))


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
    from sysid.plot.canvas import own_style, to_png
    from sysid.plot.minima import minima as picture

    of = {end.index: i + 1 for i, minimum in enumerate(minima) for end in minimum.results}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["start", "seed", "success", "residual", "minimum", "message", *problem.formulation.labels])
    for end in sorted(ends, key=lambda one: one.index):
        writer.writerow([
            end.index, end.seed, end.success, repr(end.residual) if end.x.size else "", of.get(end.index, ""),
            end.message, *map(repr, end.x.tolist()),
        ])  # fmt: skip
    files = {"starts.csv": text.getvalue().encode()}
    if minima:
        with own_style():
            files["minima.png"] = to_png(picture(minima, recipe.title, goal=problem.goal), dpi=130)
    for name, content in files.items():
        with atomically(folder / name) as temporary:
            temporary.write_bytes(content)
        out.write(f"{folder / name}\n")
    out.write(f"{folder / LEDGER}\n")
