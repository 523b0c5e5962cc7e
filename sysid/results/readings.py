"""Tree of what summary, report and export ask of a problem: for files that do not hold all of their problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from sysid.assessment.determination import Intervals
from sysid.assessment.information import DirectSpectra, ModalSpectra, Perturbations
from sysid.assessment.uncertainty import Uncertainty
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.outliers import Outlier
from sysid.problem.direct_response import Slopes
from sysid.results.answer import Answer
from sysid.results.facts import Facts
from sysid.structure.structure import Array, Structure

Tree = dict[str, Any]


def answer_to_tree(it: Answer) -> Tree:
    """Give all that readers of a result ask of its problem; `answer_from_tree` takes it back.

    Standard deviations and intervals where summaries compute them too; what no reader of this result asks, None.
    """
    return {
        "facts": it.facts.to_tree(),
        "residual": it.residual,
        "residuals": np.array(it.residuals, dtype=float),
        "objective": it.objective,
        "values": _named(it.values),
        "further_tests": [
            {"measurement": test.to_tree(), "structure": structure.to_tree()} for test, structure in it.further_tests
        ],
        "outliers": [one._asdict() for one in it.outliers],
        "phases": [tuple(row) for row in it.phases],
        "open_masses": np.array(it.open_masses, dtype=np.int64),
        "scale_is_open": bool(it.scale_is_open),
        "is_one_of_many": bool(it.is_one_of_many) if it.asks_for_others else None,
        "uncertainty": if_given(_uncertainty_to_tree, it.quick_uncertainty),
        "intervals": if_given(lambda ends: {"mass": ends.mass, "stiffness": ends.stiffness}, it.quick_intervals),
    }


def answer_from_tree(tree: Tree, structure: Structure) -> dict[str, Any]:
    """Give attributes of an `Answer` by name, of what `answer_to_tree` made; none that were not computed."""
    attributes = {
        "facts": Facts.from_tree(tree["facts"]),
        "residual": tree["residual"],
        "residuals": tuple(tree["residuals"].tolist()),
        "objective": tree["objective"],
        "values": _by_name(tree["values"]),
        "further_tests": tuple(
            (Measurement.from_tree(one["measurement"]), Structure.from_tree(one["structure"]))
            for one in tree["further_tests"]
        ),
        "outliers": tuple(Outlier(**one) for one in tree["outliers"]),
        "phases": [list(row) for row in tree["phases"]],
        "open_masses": tuple(tree["open_masses"].tolist()),
        "scale_is_open": tree["scale_is_open"],
        "is_one_of_many": tree["is_one_of_many"],
        "uncertainty": if_given(lambda part: _uncertainty_from_tree(part, structure), tree["uncertainty"]),
        "_intervals": if_given(lambda part: Intervals(**part), tree["intervals"]),
    }
    return {name: value for name, value in attributes.items() if value is not None}


def _uncertainty_to_tree(u: Uncertainty) -> Tree:
    spectra = u._spectra
    if isinstance(spectra, ModalSpectra):
        of_spectra = {
            "modes": spectra.modes._asdict(),
            "moves": spectra.moves._asdict(),
            "rigid_body_mass": spectra.rigid_body_mass,
        }
    else:
        slopes = {**spectra.slopes._asdict(), "structure": spectra.slopes.structure.to_tree()}
        of_spectra = {"slopes": slopes, "steps": spectra.steps, "normals": spectra.normals}
    plain = {field.name: getattr(u, field.name) for field in fields(u)}
    plain["inflation"] = float(u.inflation)
    named = {"values": _named(u.values), "variables": _named(u.variables)}
    return plain | named | {"_spectra": of_spectra, "structure": None}


def _uncertainty_from_tree(tree: Tree, structure: Structure) -> Uncertainty:
    part = tree["_spectra"]
    spectra: ModalSpectra | DirectSpectra
    if "modes" in part:
        spectra = ModalSpectra(Modes(**part["modes"]), Perturbations(**part["moves"]), part["rigid_body_mass"])
    else:
        slopes = Slopes(**{**part["slopes"], "structure": Structure.from_tree(part["slopes"]["structure"])})
        spectra = DirectSpectra(slopes, part["steps"], part["normals"])
    named = {"values": _by_name(tree["values"]), "variables": _by_name(tree["variables"])}
    return Uncertainty(**{**tree, **named, "_spectra": spectra, "structure": structure})


def _named(values: dict[str, Array]) -> list[Tree]:
    """Arrays with their names, which may be any text, and in their order."""
    return [{"name": name, "value": np.asarray(value)} for name, value in values.items()]


def _by_name(tree: list[Tree]) -> dict[str, Array]:
    return {one["name"]: one["value"] for one in tree}


def if_given(convert: Callable[[Any], Any], value: Any) -> Any:
    """Value by `convert`; None where there is none."""
    return None if value is None else convert(value)
