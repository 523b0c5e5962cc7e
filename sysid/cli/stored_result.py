"""The result that a command reads, with the problem module that ``--module`` names."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from sysid import catalogue
from sysid.cli import read, trust
from sysid.cli.output import Output
from sysid.cli.status import SUCCESS
from sysid.errors import InputError, refuse
from sysid.files import recorded_test
from sysid.results.identification import Identification, Recipe, load


def add_result_arguments(command: argparse.ArgumentParser) -> None:
    """Add RESULT and ``--module``."""
    command.add_argument("result", metavar="RESULT", help="a result.h5, or the folder that holds it")
    command.add_argument(
        "--module",
        metavar="FILE",
        help="the problem module that RESULT was made by, which is run: where RESULT does not hold all of its problem, "
        "and more is wanted than figures, report and matrices, which it always holds",
    )


def read_result(options: argparse.Namespace, out: Output) -> Identification:
    """The result; its problem made anew where a module is named.

    Raises
    ------
    InputError
        As of `load`; or where the module makes another problem than that of the result.
    """
    result = load(options.result)
    if options.module is None:
        return result
    module = trust.typed_module(options.module, out)
    return with_problem_of(result, replace(result.recipe or Recipe(module), module=module), options.result)


def with_problem_of(result: Identification, recipe: Recipe, source: str | Path) -> Identification:
    """The result with the problem that a recipe makes."""
    problem = catalogue.build(replace(recipe, start=None))
    try:
        return result.with_problem(problem)
    except InputError as error:
        raise InputError(f"{source}, with {recipe.title}: {error}") from error


def tell(options: argparse.Namespace, out: Output) -> int:
    """Write the summary of a stored result, or the channels of a test that ``sysid read`` wrote; the exit status."""
    file = options.problem
    refuse(
        (
            options.settings or options.data or options.seed is not None,
            f"{file}: --set, --data and --seed are for problems",
        )
    )
    if recorded_test.is_recorded_test(file):
        read.tell_channels(recorded_test.load(file), out)
    else:
        result = load(file)
        out.write(f"{result.summary()}\n")
        out.answer(result=result.to_dict())
    return SUCCESS
