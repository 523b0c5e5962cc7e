"""``sysid refine RESULT --draws N``: what many draws of noise say, beside the linear uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sysid.cli.files import png, table_as_csv, write_files
from sysid.cli.output import Output
from sysid.jobs.job import JobResult
from sysid.jobs.spread import Spread, spreads
from sysid.results.identification import Identification, Recipe
from sysid.results.tables import counted

_LARGER = (
    "draws have the noise under which least squares scatter as Huber's loss does on the records: it is some per cent\n"
    "larger than theirs, and so are the residuals"
)


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
