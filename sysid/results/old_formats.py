"""Results of format 1 (problems of models) and 2 (problems in their own unknowns), read into the tree of today.

Their HDF5 begins with the file, without a SHA-256: numbers that were changed on the disk cannot be told from others.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.files.allowance import Allowance
from sysid.files.guarded import guarded
from sysid.files.tree import Tree, read_group
from sysid.measurement.measurement import Measurement
from sysid.models.registry import model_from_tree
from sysid.models.unknowns import Variable, split
from sysid.problem import stored
from sysid.problem.terms import FurtherTest, Prior

CONTENT = "sysid identification"
SIGNATURE = b"\x89HDF\r\n\x1a\n"

_FORMATS = (1, 2)
_NO_END = "the search did not end in a fit"  # as results began one of their sentences


def content(path: Path) -> Tree:
    """Everything in a file of format 1 or 2, for a process of its own: h5py and CasADi may crash on a damaged one.

    Raises
    ------
    InputError
        Where the file is something else; a damaged file may raise anything.
    """
    import h5py

    with h5py.File(path, "r") as file:
        if file.attrs.get("content") != CONTENT.encode():
            raise InputError("it is an HDF5 file, but not a result of sysid")
        if file.attrs.get("format") not in _FORMATS:
            raise InputError(f"it is damaged: format {file.attrs.get('format')} begins with another text")
        tree: Tree = _plain(read_group(file, Allowance(path.stat().st_size), set()))
    if "formulation" in tree["problem"]:
        _try_functions(tree["problem"]["formulation"])
    return tree


def tree_of(path: Path) -> Tree:
    """The tree of a file of format 1 or 2, as format 3 has it.

    Raises
    ------
    InputError
        Where the file is something else, or its reader crashes; what is missing in it may raise anything.
    """
    tree = guarded(f"{__name__}:content", path)
    problem = tree["problem"]
    tests = problem.get("validation", {})
    return {
        "x": None, "seed": None, "closed_by": (), "undetermined": (), "remarks": (),  # the first files have no remarks
        **tree,
        "structure": _structure(tree["structure"]),
        "problem": {
            "measurement": _measurement(problem["measurement"]),
            "given": _given(problem),
            "reference": _structure(problem["reference"]) if "reference" in problem else None,
            "validation": [_measurement(tests[str(i)]) for i in range(len(tests))],
            "goal": problem.get("goal"),
        },
        "recipe": {"data": None, **tree["recipe"]} if "recipe" in tree else None,
    }  # fmt: skip


def with_against(tree: Tree) -> Tree:
    """The tree of a result that joined what speaks against it to its message, as results have it today."""
    message, undetermined = tree["message"], tuple(tree["undetermined"])
    against = tuple(told for told in filter(None, undetermined) if told in message or told.startswith(_NO_END))
    for told in against:
        message = message.replace(f"{told}; ", "").replace(f"; {told}", "")
    if not (against or tree["success"]):
        against = (message,)
    return {**tree, "message": message, "against": against, "changing": False}


def _plain(value: Any) -> Any:
    """Numbers in the place of arrays without a dimension, in which the old formats have them."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return value.item() if isinstance(value, np.ndarray) and not value.ndim else value


def _structure(old: Tree) -> Tree:
    return {"damping_ratios": None, "damping_matrix": None, **old, "sensors": _sensors(old)}


def _measurement(old: Tree) -> Tree:
    absent = dict.fromkeys(("force", "response_std", "force_std", "base_axes"))
    return {**absent, **old, "sensors": _sensors(old)}


def _sensors(old: Tree) -> list[Tree] | None:
    """Tables become one tree a sensor; an empty axis stands for a vector."""
    table = old.get("sensors")
    if table is None:
        return None
    rows = zip(table["name"], table["position"], table["axis"], table["axis_vector"], strict=True)
    return [{"name": name, "position": r, "axis": word or vector} for name, r, word, vector in rows]


def _given(problem: Tree) -> Tree:
    """What the problem was given: models, or expressions made of the functions of x in the file."""
    if "formulation" in problem:
        return stored.to_tree(_written(problem["formulation"]))
    models = {}
    for name in ("mass", "stiffness", "damping"):
        kind = problem[name].pop("kind")
        models[name] = model_from_tree({"kind": kind, "fields": problem[name]})
    return stored.to_tree(models)


def _try_functions(formulation: Tree) -> None:
    """Read and evaluate CasADi's texts."""
    places = [formulation["matrices"], *formulation.get("others", {}).values(), formulation.get("constraints", {})]
    texts = [place["function"] for place in places if "function" in place]
    texts += [formulation[name] for name in ("residuals", "known", "misfit", "healing") if name in formulation]
    for text in texts:
        function = ca.Function.deserialize(text)
        x = ca.MX.sym("x", function.size1_in(0))
        ca.Function("probe", [x], function.call([x], True, False))(0.5)


def _written(old: Tree) -> dict[str, Any]:
    """Parameters of `Problem` of a formulation; unknowns of models became variables."""
    every = [_variable(old["variables"][str(i)]) for i in range(len(old["variables"]))]
    searched = [v for v in every if not v.fixed]
    pieces = [ca.vec(v.symbol) for v in searched]
    x = ca.vertcat(*pieces)

    def outputs(place: Tree, name: str) -> list[ca.MX]:
        return list(ca.Function.deserialize(place[name]).call([x], True, False)) if name in place else []

    given = _matrices(old["matrices"], outputs)
    # Fixed variables are numbers in the functions: a zero written in them keeps them in the problem.
    given["stiffness"] += sum((_zero(v) for v in every if v.fixed), ca.MX(0))
    others = old.get("others", {})
    residuals: list[Any] = [
        FurtherTest(Measurement.from_tree(_measurement(test["measurement"])), **_matrices(test, outputs))
        for test in (others[str(i)] for i in range(len(others)))
    ]
    residuals += outputs(old, "residuals")
    residuals += [Prior(known, 0.0, 1.0) for known in outputs(old, "known")]
    given |= {"residuals": residuals, "constraints": [], "misfit": next(iter(outputs(old, "misfit")), None)}
    if "healing" in old:
        healed = split(searched, outputs(old, "healing")[0])
        given["healing"] = {v: ca.reshape(part, *v.symbol.shape) for v, part in zip(searched, healed, strict=True)}
    if "constraints" in old:
        rows, equal = outputs(old["constraints"], "function")[0], np.atleast_1d(old["constraints"]["equal"])
        given["constraints"] = [rows[i] == 0 if same else rows[i] <= 0 for i, same in enumerate(equal.tolist())]
    return given


def _matrices(old: Tree, outputs: Callable[[Tree, str], list[ca.MX]]) -> dict[str, Any]:
    M, M_S0, M_00, K, damping = outputs(old, "function")[:5]
    recovery = old["recovery"]
    at_sensors = np.array_equal(recovery, np.eye(len(recovery)))
    return {
        "mass": ca.blockcat([[M, M_S0], [M_S0.T, M_00]]),
        "stiffness": K,
        "damping": [damping] if old["by_ratios"] and K.numel() == 1 else damping,
        "recovery": None if at_sensors else recovery,
        "rigid_body_dofs": old["rigid_body_dofs"],
    }


def _variable(old: Tree) -> Variable:
    """A variable; an unknown of a model, which has no such fields, is on a linear scale and without a guess."""
    shape = tuple(map(int, old.get("shape", ())))
    shaped = {name: np.reshape(old[name], shape, order="F") for name in ("lower", "upper", "guess")}
    fixed = old.get("fixed", False)
    if not (old.get("guessed", False) or fixed):
        del shaped["guess"]
    return Variable(old["name"], shape, **shaped, unit=old["unit"], log=old.get("log", False), fixed=fixed)


def _zero(variable: Variable) -> ca.MX:
    """Zero whatever the variable, in a form that CasADi does not simplify."""
    return ca.fmax(0, ca.fmin(0, variable.symbol[0]))
