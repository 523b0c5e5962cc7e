"""``sysid refine RESULT --draws N``: what many draws of noise say, beside the linear uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sysid.cli.display import Output
from sysid.cli.files import table_as_csv, write_files
from sysid.jobs.job import JobResult
from sysid.jobs.spread import Spread, spreads
from sysid.results.identification import Identification, Recipe


def tell(folder: Path, result: Identification, recipe: Recipe, ends: list[JobResult], out: Output) -> None:
    """Print the spreads, and write them, all draws and the picture."""
    from sysid.plot.canvas import own_style, to_png
    from sysid.plot.draws import draws as picture

    found, count = spreads(result, ends), sum(end.success for end in ends)
    out.write(f"\n{table(found, count, len(ends))}\n\n")
    of_all: list[Sequence[object]] = [("quantity", "value", "linear_std", "draws_std", "inside_share")]
    of_all += [(s.name, repr(s.value), repr(s.std), repr(s.drawn), repr(s.inside)) for s in found]
    each: list[Sequence[object]] = [
        ("draw", "seed", "success", "residual", "message", *result.problem.formulation.labels)
    ]
    for end in sorted(ends, key=lambda one: one.index):
        each.append((end.index, end.seed, end.success, repr(end.residual), end.message, *map(repr, end.x.tolist())))
    with own_style():
        image = to_png(picture(found, count, recipe.title), dpi=130)
    write_files(folder, {"spreads.csv": table_as_csv(of_all), "draws.csv": table_as_csv(each), "draws.png": image}, out)


def table(found: Sequence[Spread], count: int, asked: int) -> str:
    """A line a quantity: value, standard deviations to first order and of the draws, and how often it was within."""
    width = max(len(spread.name) for spread in found)
    lines = [f"{'':{width}}  {'value':>10}  {'linear std':>10}  {'draws std':>10}  ratio  within, %"]
    for spread in found:
        known = np.isfinite(spread.std) and spread.std > 0
        beside = f"{spread.drawn / spread.std:5.2f}  {100 * spread.inside:9.0f}" if known else "    -          -"
        linear = f"{spread.std:10.3g}" if known else "         -"
        lines.append(f"{spread.name:{width}}  {spread.value:10.5g}  {linear}  {spread.drawn:10.3g}  {beside}")
    lines += [
        f"std: standard deviation, to first order and of {count} draws, whose ratio chance moves by "
        f"{100 / np.sqrt(2 * count):.0f} %; within: draws",
        "in the linear interval, which should hold 95 %",
    ]
    return "\n".join(lines + ([f"{asked - count} draws have no fit and do not count"] if count < asked else []))
