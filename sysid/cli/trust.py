"""``--trust`` and ``--module FILE``: which code may run that a file names.

A result or the state of an unfinished run names its problem module, and whoever made the file chose the name. Problems
that come with the package run freely; all else has to be named, or trusted, by the user.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from sysid import catalogue
from sysid.cli.output import Output
from sysid.errors import InputError, shown
from sysid.results.identification import Recipe

TRUST = "--trust"


def add_argument(command: argparse.ArgumentParser, of: str) -> None:
    """Give a command ``--trust``; `of` is the file that names a module."""
    command.add_argument(
        TRUST,
        action="store_true",
        help=f"run the problem module that {of} names, with your rights on this machine: its code may do anything, so "
        "say this of files of your own alone. Problems that come with the package need it not",
    )


def add_module(command: argparse.ArgumentParser) -> None:
    """Give a command that runs the module of RESULT ``--module`` and ``--trust``."""
    command.add_argument(
        "--module",
        metavar="FILE",
        help="the problem module of RESULT, in the place of the one that RESULT names; a bundled one need not be named",
    )
    add_argument(command, "RESULT")


def typed_module(name: str, out: Output) -> str:
    """A problem as the user typed it, for a recipe; that an own problem hides a bundled one is told."""
    module, remark = catalogue.typed(name)
    if remark:
        out.warn(remark)
    return module


def check_trust(recipe: Recipe, source: Path, instead: str, options: argparse.Namespace) -> None:
    """Refuse a recipe that a file holds, where its module may not run.

    Parameters
    ----------
    recipe : Recipe
    source : Path
        The file.
    instead : str
        How the module is named by the user, for the message.
    options : Namespace
        With `trust`.

    Raises
    ------
    InputError
        Where the module is not of the package, and nobody said that it may run.
    """
    if catalogue.is_bundled(recipe.module) or options.trust:
        return
    file = catalogue.file_of(recipe.module)
    place = shown(recipe.module) if file is None else file.absolute()
    if file is not None and not file.exists():
        raise InputError(
            f"{source} names the problem module {place}, which is not here: get it, and name it: {instead}"
        )
    raise InputError(
        f"{source} names the problem module {place}, whose code would run: say {TRUST} where you know what stands in "
        f"it, or name the module yourself: {instead}"
    )
