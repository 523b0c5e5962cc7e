"""The parser of the command line: mistakes in one line, examples in every help, numbers refused with an example."""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
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


def band(text: str) -> tuple[float, float]:
    """Ends of a band, Hz, of LOW-HIGH."""
    low, _, high = text.rpartition("-")  # at the last dash, as 1e-3 has one too
    try:
        ends = float(low), float(high)
    except ValueError:
        ends = 0.0, 0.0
    if not 0 <= ends[0] < ends[1] < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no band: write its ends in Hz, such as 0.5-20")
    return ends


def orders(text: str) -> tuple[int, int]:
    """The least and the largest number of modes, of A-B."""
    low, _, high = text.partition("-")
    if not (low.isdecimal() and high.isdecimal() and 1 <= int(low) <= int(high)):
        raise argparse.ArgumentTypeError(f"{text!r} is no range of numbers of modes: write 3-8")
    return int(low), int(high)


def whole(least: int, text: str) -> int:
    """A whole number from the least one."""
    with contextlib.suppress(ValueError):
        if (given := int(text)) >= least:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")


count, seed = functools.partial(whole, 1), functools.partial(whole, 0)


def seconds(text: str) -> float:
    """A positive number of seconds."""
    with contextlib.suppress(ValueError):
        if 0 < (given := float(text)) < math.inf:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
