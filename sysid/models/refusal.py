"""Refusal of what a user gives, by a table of possible mistakes."""

from __future__ import annotations

from typing import Any

from sysid.errors import InputError


def refuse(*mistakes: tuple[Any, str]) -> None:
    """Raise the first of these mistakes that was made.

    Parameters
    ----------
    mistakes : tuples (made, sentence)
        Whether it was made, and what was wrong, where, and what to do.

    Raises
    ------
    InputError
    """
    for made, sentence in mistakes:
        if made:
            raise InputError(sentence)
