"""What can go wrong, as a tree.

::

    SysidError                  anything this package raises on purpose
    ├── InputError (ValueError) the caller's mistake: what, where, what to do
    └── SolverError             a solver ended in a state that its caller cannot use

The command line turns an ``InputError`` into one line and exit status 2.
"""

from __future__ import annotations

from typing import Any


class SysidError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(SysidError, ValueError):
    """A mistake in what was given: data, a model, a file, an option."""


class SolverError(SysidError):
    """A numerical solver ended without a usable answer; the message has its status."""


def refuse(*mistakes: tuple[Any, str]) -> None:
    """Raise an `InputError` with the sentence of the first of ``(whether it was made, sentence)`` that was made."""
    for made, sentence in mistakes:
        if made:
            raise InputError(sentence)
