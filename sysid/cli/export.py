"""``sysid export``: the identified structure in the file of another program."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from sysid.cli.output import Output
from sysid.cli.status import SUCCESS
from sysid.cli.stored_result import add_result_arguments, read_result
from sysid.export.content import reliability
from sysid.export.export import export, format_of, precision


def run(options: argparse.Namespace, out: Output) -> int:
    """Write the file, tell its precision, and warn where the matrices are not determined."""
    target = Path(options.file)
    form = format_of(target)  # a wrong ending is told before the result is read
    result = read_result(options, out)
    out.wrote(export(result, target))
    without = "" if form.deviations else "; without deviations, which .csv and .mat have"
    out.write(f"{form.name}; precision: {precision(target)}{without}\n")
    out.answer(format=form.name, precision=precision(target), deviations=form.deviations, judgement=result.judgement)
    if result.interrupted or not result.determined:
        out.warn(f"{target.name}: {reliability(result)}. Read {form.note}, or report.html")
    return SUCCESS


def add(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command and its arguments."""
    parser = command(
        "export",
        summary="write the identified structure for another program",
        description="Write the identified structure for another program, in the format that the ending of FILE tells: "
        ".csv, M, K and C with deviations (exact); .mat, MATLAB (exact); .op4, Nastran OUTPUT4 "
        "with the Craig-Bampton superelement (exact); .bdf or .dmig, the superelement as Nastran's DMIG (10 digits); "
        ".unv or .uff, mode shapes as dataset 55 (6 digits). "
        "The file says what the matrices are worth, what speaks against them and what the data leave open; where they "
        "are not determined, a warning says so.",
        examples=tuple(
            f"sysid export results/cantilever_tower tower.{ending}" for ending in ("csv", "mat", "op4", "bdf", "unv")
        ),
    )
    add_result_arguments(parser)
    parser.add_argument("file", metavar="FILE", help="the file to write")
    parser.set_defaults(command=run)
