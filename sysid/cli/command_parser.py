"""The parser of the command line: mistakes in one line, examples in every help, and what all commands take."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable
from typing import Any, NoReturn

from sysid.errors import InputError

JSON, QUIET = "--json", "--quiet"


class Parser(argparse.ArgumentParser):
    """Mistakes become an InputError, so that they are one line like all others."""

    def error(self, message: str) -> NoReturn:
        """Raise it."""
        raise InputError(f"{message} (see '{self.prog} --help')")


def epilog(examples: tuple[str, ...], more: str = "") -> str:
    """The end of a help: examples, a line each, then text that keeps its lines."""
    listing = "\n".join(f"  {example}" for example in examples)
    return f"examples:\n{listing}\n" + (f"\n{more}" if more else "")


def adder(parser: argparse.ArgumentParser) -> Callable[..., argparse.ArgumentParser]:
    """A function that adds a command to a parser.

    Its arguments: the name; `summary`, for the list of commands; `description`; `examples`, a line each, which a test
    runs; `more`, text below them that keeps its lines.
    """
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def add(
        name: str, *, summary: str, examples: tuple[str, ...], description: str = "", more: str = ""
    ) -> argparse.ArgumentParser:
        command: Any = commands.add_parser(
            name,
            help=summary,
            description=textwrap.fill(description or f"{summary[0].upper()}{summary[1:]}.", 79),
            epilog=epilog(examples, more),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        command.add_argument(
            JSON, action="store_true", help="print one JSON document in the place of words: of a mistake too"
        )
        command.add_argument(
            QUIET, action="store_true", help="print nothing but warnings and mistakes: exit status and files tell"
        )
        return command

    return add
