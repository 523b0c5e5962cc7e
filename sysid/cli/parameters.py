"""Arguments that a command hands on to a problem module: ``--data`` and ``--set KEY=VALUE``."""

from __future__ import annotations

import argparse
import ast
from typing import Any

from sysid import catalogue
from sysid.cli import trust
from sysid.cli.output import Output
from sysid.errors import InputError
from sysid.results.identification import Recipe

_PROBLEM = "a path to a module (.py), else a module in ./problems, else a bundled problem, else a dotted module"


def add_arguments(command: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Give a command the problem module, which may be `optional`, and what is handed on to it."""
    command.add_argument("problem", metavar="PROBLEM", nargs="?" if optional else None, help=_PROBLEM)
    command.add_argument("--data", metavar="PATH", help="file or folder of records, for problems that read some")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="a keyword parameter of the module's problem(), such as elements=3: a number, a list or what else Python "
        "can read, else a text; may be given several times",
    )


def recipe_of(options: argparse.Namespace, out: Output, rng: int | None = None) -> Recipe:
    """The recipe that the arguments of a command make; ``data`` and ``rng`` may be set like parameters, too.

    Parameters
    ----------
    options : Namespace
        With the arguments of `add_arguments`.
    out : Output
    rng : int, optional
        The seed of the simulated noise, where the command has an option of its own for it.

    Raises
    ------
    InputError
        Where something is not KEY=VALUE or is set twice: names the parameters of the module.
    """
    module = trust.typed_module(options.problem, out)
    given: dict[str, str] = {}
    elsewhere = {"data": options.data, "rng": rng}
    for setting in options.settings:
        name, equals, text = setting.partition("=")
        if not (equals and name.isidentifier()):
            raise _mistake(module, f"--set {setting!r} is not KEY=VALUE")
        if name in given or elsewhere.get(name) is not None:
            raise _mistake(module, f"parameter {name!r} is set twice")
        given[name] = text
    data, seed = given.pop("data", options.data), _value(given.pop("rng", str(rng or 0)))
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise _mistake(module, f"rng = {seed!r} is not a nonnegative integer")
    return Recipe(module, data, seed, {name: _value(text) for name, text in given.items()})


def _value(text: str) -> Any:
    """The value of a text in Python, else the text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return text


def _mistake(module: str, what: str) -> InputError:
    return InputError(f"{what}; {catalogue.parameters_in_words(module)}")
