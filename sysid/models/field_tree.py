"""Trees of models whose fields are all that they are."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Self

import numpy as np


class FieldTree:
    """`to_tree` and `from_tree` of a dataclass whose fields are numbers, arrays of them, texts or None."""

    def to_tree(self) -> dict[str, Any]:
        """Give the fields as numbers, arrays and texts; `from_tree` takes them back."""
        return {field.name: plain(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Self:
        """Give the model of a tree that `to_tree` made."""
        return cls(**tree)


def plain(value: Any) -> Any:
    """A number, an array of numbers, a text or None as a tree holds it.

    Raises
    ------
    TypeError, ValueError
        Where it is none of these.
    """
    if value is None or isinstance(value, str):
        return value
    numbers = np.asarray(value, dtype=float)
    return numbers if numbers.ndim else float(numbers)
