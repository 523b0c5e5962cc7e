"""What was recorded for a result, which its file holds whether or not it holds all of its problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.outliers import screened
from sysid.modal_analysis.whole_records import without_transients
from sysid.structure.structure import Structure


@dataclass(frozen=True, eq=False)
class Records:
    """The records of a problem without its matrices; the attributes are those of `Problem`."""

    measurement: Measurement
    reference: Structure | None
    validation: tuple[Measurement, ...]
    goal: float | None
    loss: str

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Records:
        """Give the records of a tree that `Problem.to_tree` made."""
        return cls(
            Measurement.from_tree(tree["measurement"]),
            None if tree["reference"] is None else Structure.from_tree(tree["reference"]),
            tuple(Measurement.from_tree(test) for test in tree["validation"]),
            tree["goal"],
            tree["loss"],
        )

    @cached_property
    def at_rest(self) -> Records:
        """The same without the transients of whole records."""
        test = self.measurement
        return self if test.whole is None else replace(self, measurement=without_transients(test))

    @cached_property
    def screened(self) -> Records:
        """The same without transients and, where the loss is Huber's, without numbers that stand alone."""
        rest = self.at_rest
        return rest if self.loss == "squares" else replace(rest, measurement=screened(rest.measurement))


@dataclass(frozen=True, eq=False)
class PartOfProblem:
    """What a file holds of a problem that it does not hold whole.

    Attributes
    ----------
    tree, readings : dict
        What `Problem.to_tree` and `sysid.results.readings` made.
    records : Records
    attributes : dict
        All that readers of the result ask of the problem: attributes of `Answer` by their names.
    without : str
        Why the problem cannot be made of it, for a message.
    """

    tree: dict[str, Any]
    readings: dict[str, Any]
    records: Records
    attributes: dict[str, Any]
    without: str
