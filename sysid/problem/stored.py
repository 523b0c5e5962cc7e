"""Tree of what a problem is given beside its measurement: models by class and fields, numbers, and expressions.

A tree may come from a file of somebody else's. So nothing is imported for it: a model's class is found only in a module
that was imported before, by the user's script or as a problem module that the user named. All expressions are made of
the variables by one list of operations: see `sysid.problem.encoding`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError, refuse, shown
from sysid.measurement.channels import without_delays
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.calibration import Calibration, calibrated, stored_calibrations
from sysid.modal_analysis.delays import Delays, stored_delays
from sysid.modal_analysis.record_fit import RecordFit
from sysid.models.expressions import as_matrix, is_column, is_expression
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.model import plain
from sysid.models.stiffness_and_damping import ChainStiffness, ModalDamping, ProportionalDamping, SpectralStiffness
from sysid.models.unknowns import Variable, variable_of
from sysid.problem.decoding import decode
from sysid.problem.encoding import NotStorableError, encode
from sysid.problem.matrices import MATRICES
from sysid.problem.terms import ComplexResidual, FurtherTest, Prior

# A problem module that is a file has a name of its own in Python: this, eight digits, and the name of the file.
PROBLEM_MODULE = "_sysid_problem_"
_PACKAGE = __name__.partition(".")[0]
BESIDE = "__sysid_beside__"  # in such a module: the modules by name that it imported from beside itself

_PACKAGE_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        FullMass, LumpedMass, KnownMass, SpectralStiffness, ChainStiffness, ModalDamping, ProportionalDamping,
    )
}  # fmt: skip
_TREE, _MODEL = ("to_tree", "from_tree"), ("unknowns", "blocks", "values", "stated")


def is_storable(model: Any) -> bool:
    """True where something is a model: its class has `to_tree` and `from_tree`, or the methods of a matrix model."""
    return _has(type(model), _TREE) or _has(type(model), _MODEL)


def _has(kind: type, methods: tuple[str, ...]) -> bool:
    return all(callable(getattr(kind, name, None)) for name in methods)


def model_to_tree(model: Any) -> dict[str, Any]:
    """Tree of a matrix model: what `to_tree` of its class gives, else its attributes; refused where there is none."""
    kind = type(model)
    if "<locals>" in kind.__qualname__:
        raise InputError(
            f"a {kind.__name__} cannot be stored: its class stands inside a function ({kind.__qualname__}), where no "
            "other program finds it; move the class to the top of its module"
        )
    of_package = _PACKAGE_KINDS.get(kind.__name__) is kind
    name = kind.__name__ if of_package else f"{_public_name(kind.__module__)}:{kind.__qualname__}"
    return {"kind": name, "fields": model.to_tree() if _has(kind, _TREE) else _attributes(model)}


def _attributes(model: Any) -> dict[str, Any]:
    """Attributes of a model whose class tells no tree of its own."""
    try:
        if _has(type(model), _MODEL):
            return {name: plain(value) for name, value in vars(model).items()}
    except (TypeError, ValueError):
        pass
    raise InputError(
        f"a {type(model).__name__} cannot be stored: its class needs a method to_tree(), which gives a dictionary of "
        "arrays, numbers and texts, and a class method from_tree(tree), which takes it back"
    )


def model_from_tree(tree: dict[str, Any]) -> Any:
    """Give the model of a tree that `model_to_tree` made; nothing is imported for it.

    A class of the user's own has to be there already: in a module that this process has imported, or in a problem
    module that was named to it (see `sysid.catalogue.build`), or beside that one. Else it is refused by name and
    module.
    """
    module, colon, name = str(tree["kind"]).rpartition(":")
    if not colon and name not in _PACKAGE_KINDS:
        raise InputError(f"model {shown(name)} is unknown to this sysid: a later one is needed")
    kind = _found(module, name) if colon else _PACKAGE_KINDS[name]
    if _has(kind, _TREE):
        return kind.from_tree(tree["fields"])
    model = object.__new__(kind)
    vars(model).update(tree["fields"])
    return model


def _public_name(module: str) -> str:
    """Name of a module as the user knows it: of a problem module that is a file, the file's."""
    return re.sub(rf"^{PROBLEM_MODULE}[0-9a-f]{{8}}_", "", module)


def _found(module: str, name: str) -> Any:
    """The class `name` of a module that is imported; refused where there is none, or several from different files."""
    found = [(one, kind) for one in _imported(module) if (kind := _class_in(one, name)) is not None]
    if not found:
        raise InputError(
            f"a model is made of the class {shown(name)} of the module {shown(module)}, and a file imports no module "
            "by itself: import it first, or name the module (--module FILE at the command line)"
        )
    places = sorted({str(getattr(one, "__file__", "")) for one, _ in found})
    refuse((len(places) > 1, f"the class {name} stands in several modules named {module!r}: {', '.join(places)}"))
    return found[-1][1]


def _imported(name: str) -> Iterator[ModuleType]:
    """Modules of this name in this process, problem modules and what they imported from beside themselves too."""
    for key, module in list(sys.modules.items()):
        if key == name and name.partition(".")[0] not in (_PACKAGE, *sys.stdlib_module_names):
            yield module
        elif key.startswith(PROBLEM_MODULE):
            if _public_name(key) == name:
                yield module
            beside = vars(module).get(BESIDE, {})
            if name in beside:
                yield beside[name]


def _class_in(module: ModuleType, name: str) -> Any:
    """A class of a matrix model by its dotted name in the module that defines it; None where it is none.

    It is looked up without `getattr`, by which some modules import others.
    """
    kind: Any = module
    for part in name.split("."):
        kind = getattr(kind, "__dict__", {}).get(part)
    defined = isinstance(kind, type) and (kind.__module__, kind.__qualname__) == (module.__name__, name)
    return kind if defined and (_has(kind, _TREE) or _has(kind, _MODEL)) else None


_ARRAYS = ("recovery", "rigid_body_dofs")

Tree = dict[str, Any]


class NotRebuiltError(InputError):
    """A file does not hold all of a problem: its module is needed."""


def to_tree(given: Mapping[str, Any]) -> Tree:
    """Tree of the models, numbers and expressions that a `Problem` was given, by the names of its parameters.

    Without the expressions where one of them holds what cannot be stored, such as a Python callback; "without" then
    says which, and is None elsewhere. An `InputError` where a model cannot be stored.
    """
    outputs = _Outputs()
    tree = {
        **_matrices_to_tree(given, outputs),
        "residuals": [_residual_to_tree(i, r, outputs) for i, r in enumerate(given.get("residuals", ()), start=1)],
        "constraints": np.array(
            [outputs.add(f"constraint {i}", c) for i, c in enumerate(given.get("constraints", ()), start=1)], np.int64
        ),
        "misfit": _misfit_to_tree(given.get("misfit"), outputs),
        "healing": [
            {"variable": variable.name, "expression": outputs.add("healing", expression)}
            for variable, expression in given.get("healing", {}).items()
        ],
    }
    return {**tree, **outputs.to_tree()}


def from_tree(tree: Tree) -> dict[str, Any]:
    """Arguments of `Problem` beside measurement, reference, validation and goal, of a tree that `to_tree` made.

    Raises
    ------
    NotRebuiltError
        Where a class of the user's own is missing, or the expressions were not stored; InputError where they are
        damaged.
    """
    if tree["without"] is not None:
        what = "".join(filter(str.isprintable, tree["without"]))  # nothing that moves a terminal's cursor
        raise NotRebuiltError(f"it was stored without the expressions of its problem, as {what} cannot be stored")
    variables = {part["name"]: _variable_from_tree(part) for part in tree["variables"]}
    symbols, misfit = [variable.symbol for variable in variables.values()], tree["misfit"]
    made = [] if tree["expressions"] is None else decode(tree["expressions"], symbols)
    outputs: dict[int | None, ca.MX | None] = {None: None, **dict(enumerate(made))}
    return {
        **_matrices_from_tree(tree, outputs),
        "residuals": [_residual_from_tree(part, outputs) for part in tree["residuals"]],
        "constraints": [outputs[i] for i in tree["constraints"].tolist()],
        "misfit": _residual_from_tree(misfit, outputs) if isinstance(misfit, dict) else outputs[misfit],
        "healing": {variables[part["variable"]]: outputs[part["expression"]] for part in tree["healing"]},
    }


def stored_fits(
    tree: dict[str, Any], tests: Sequence[Measurement]
) -> tuple[list[Delays], list[Calibration | None], list[RecordFit | None]]:
    """Delays and gains of the tests of a stored problem, and the fits of their whole records."""
    delays, gains = stored_delays(tree, tests), stored_calibrations(tree, tests)
    given = zip((tree.get("fits") or [None] * len(tests))[: len(tests)], tests, delays, gains, strict=True)
    fits = [
        fit and RecordFit.from_tree(fit, without_delays(calibrated(test, gain), d.values))
        for fit, test, d, gain in given
    ]
    return delays, gains, fits


def needs_module(tree: Tree) -> bool:
    """True where a tree that `to_tree` made does not hold all of a problem: expressions, or the class of a model."""
    models = [tree[name] for name in MATRICES] + [part.get("source") for part in tree["residuals"]]
    models += [part[name] for part in tree["residuals"] if part["kind"] == "test" for name in MATRICES]
    return tree["without"] is not None or any(isinstance(one, dict) and _is_user_class(one) for one in models)


def _is_user_class(tree: Tree) -> bool:
    """True where a model's class is one of the user's."""
    return ":" in tree.get("kind", "")


class _Outputs:
    """Expressions of a problem, numbered."""

    def __init__(self) -> None:
        self.expressions: list[tuple[str, ca.MX]] = []

    def add(self, name: str, expression: Any) -> int | None:
        """Number of an expression, None where none is given; the name is for messages."""
        if expression is None:
            return None
        self.expressions.append((name, as_matrix(name, expression)))
        return len(self.expressions) - 1

    def to_tree(self) -> Tree:
        """The variables of all expressions, and the function that gives the expressions."""
        found = {variable_of(s) for _, expression in self.expressions for s in ca.symvar(expression)}
        variables = sorted((v for v in found if v is not None), key=lambda variable: variable.order)
        expressions, without = None, None
        if self.expressions:
            try:
                expressions = _encoded(variables, [expression for _, expression in self.expressions])
            except NotStorableError:
                without = ", ".join(self._reasons(variables))
        return {
            "variables": [_variable_to_tree(variable) for variable in variables],
            "expressions": expressions,
            "without": without,
        }

    def _reasons(self, variables: Sequence[Variable]) -> list[str]:
        """Which expressions cannot be stored, and for what in them."""
        found = []
        for name, expression in self.expressions:
            try:
                _encoded(variables, [expression])
            except NotStorableError as error:
                found.append(f"{error} in {name}")
        return found or ["all of them together"]


def _encoded(variables: Sequence[Variable], expressions: Sequence[ca.MX]) -> Tree:
    """Expressions as operations, tried at the guess and at another point of the search space."""
    share, points = np.random.default_rng(0), list[list[ca.DM]]()
    for of_guess in (True, False):
        at = [v.guess if of_guess else v.lower + share.random(v.size) * (v.upper - v.lower) for v in variables]
        points.append([ca.reshape(ca.DM(np.ravel(x)), *v.symbol.shape) for x, v in zip(at, variables, strict=True)])
    return encode([variable.symbol for variable in variables], expressions, points)


def _matrices_to_tree(given: Mapping[str, Any], outputs: _Outputs) -> Tree:
    """Mass, stiffness, damping and what takes their degrees of freedom to the sensors."""
    matrices = {name: _matrix_to_tree(name, given[name], outputs) for name in MATRICES}
    return matrices | {name: plain(given.get(name)) for name in _ARRAYS}


def _matrices_from_tree(tree: Tree, outputs: Mapping[int | None, Any]) -> Tree:
    return {name: _matrix_from_tree(tree[name], outputs) for name in MATRICES} | {n: tree[n] for n in _ARRAYS}


def _matrix_to_tree(name: str, value: Any, outputs: _Outputs) -> Any:
    """A model as a dictionary, numbers as an array, an expression as its number among the outputs."""
    value = getattr(value, "written", value)
    if is_expression(value):
        # A single ratio in one dimension is no 1 x 1 matrix.
        return {"expression": outputs.add(name, value), "dimensions": 1 if is_column(value) else 2}
    return model_to_tree(value) if is_storable(value) else np.array(value, dtype=float)


def _matrix_from_tree(tree: Any, outputs: Mapping[int | None, Any]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "expression" not in tree:
        return _model_from_tree(tree)
    expression = outputs[tree["expression"]]
    return [expression] if tree["dimensions"] == 1 else expression


def _residual_to_tree(number: int, value: Any, outputs: _Outputs) -> Tree:
    name = f"residual {number}"
    if isinstance(value, FurtherTest):
        return {"kind": "test", "measurement": value.measurement.to_tree(), **_matrices_to_tree(vars(value), outputs)}
    if isinstance(value, Prior):
        numbers = {part: np.array(getattr(value, part), dtype=float) for part in ("value", "std")}
        return {"kind": "prior", "expression": outputs.add(name, value.expression), **numbers}
    if isinstance(value, ComplexResidual):
        return {"kind": "complex", "expression": outputs.add(name, value.stacked), "force": value.force}
    if is_storable(value):
        return {"kind": "own", "source": model_to_tree(value)}
    return {"kind": "rows", "expression": outputs.add(name, value)}


def _residual_from_tree(tree: Tree, outputs: Mapping[int | None, Any]) -> Any:
    if tree["kind"] == "test":
        return FurtherTest(Measurement.from_tree(tree["measurement"]), **_matrices_from_tree(tree, outputs))
    if tree["kind"] == "prior":
        return Prior(outputs[tree["expression"]], tree["value"], tree["std"])
    if tree["kind"] == "complex":
        return ComplexResidual(outputs[tree["expression"]], bool(tree["force"]))
    return _model_from_tree(tree["source"]) if tree["kind"] == "own" else outputs[tree["expression"]]


def _misfit_to_tree(value: Any, outputs: _Outputs) -> Any:
    """The number of a misfit of the user's, or of a complex one a dictionary; None where there is none."""
    if not isinstance(value, ComplexResidual):
        return outputs.add("misfit", value)
    return {"kind": "complex", "expression": outputs.add("misfit", value.stacked), "force": value.force}


def _model_from_tree(tree: Tree) -> Any:
    try:
        return model_from_tree(tree)
    except InputError as error:
        if _is_user_class(tree):
            raise NotRebuiltError(str(error)) from error
        raise


def _variable_to_tree(variable: Variable) -> Tree:
    names = ("name", "unit", "lower", "upper", "log", "fixed", "declared")
    return {
        **{name: getattr(variable, name) for name in names},
        "shape": np.array(variable.shape, dtype=np.int64),
        "guess": variable.guess if variable.has_guess else None,
    }


def _variable_from_tree(tree: Tree) -> Variable:
    shape = tuple(tree["shape"].tolist())
    numbers: dict[str, Any] = {
        name: np.reshape(tree[name], shape, order="F") for name in ("lower", "upper", "guess") if tree[name] is not None
    }
    plain = {name: tree[name] for name in ("log", "fixed", "unit")}
    variable = Variable(tree["name"], shape, **numbers, **plain)
    variable.declared = tree["declared"]  # messages name the author's line
    return variable
