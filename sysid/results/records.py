"""Records of a result, which its file holds whether or not it holds all of its problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.record_fit import RecordFit
from sysid.structure.structure import Structure


@dataclass(frozen=True, eq=False)
class StoredRecords:
    """The records of a problem without its matrices; the attributes are those of `Problem`."""

    measurement: Measurement
    reference: Structure | None
    validation: tuple[Measurement, ...]
    goal: float | None
    loss: str
    fit: RecordFit | None
    """Of whole records, which the file holds."""

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> StoredRecords:
        """Give the records of a tree that `Problem.to_tree` made."""
        test, fits = Measurement.from_tree(tree["measurement"]), tree.get("fits") or [None]
        return cls(
            test,
            None if tree["reference"] is None else Structure.from_tree(tree["reference"]),
            tuple(Measurement.from_tree(test) for test in tree["validation"]),
            tree["goal"],
            tree["loss"],
            None if fits[0] is None else RecordFit.from_tree(fits[0], test),
        )


@dataclass(frozen=True, eq=False)
class PartOfProblem:
    """Part of a problem in a file that does not hold it whole.

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
    records: StoredRecords
    attributes: dict[str, Any]
    without: str
