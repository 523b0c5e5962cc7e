"""Counts of names, numbers and sentences in the package and its tests: ideas that stand in several places.

Each function says what it counts and what it gives on 47a2c0f, so that other commits can be counted alike.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from benchmarks.syntax import Found, Module, Package, identifier, places

SENTENCES = {
    "sentence", "remedy", "message", "undetermined", "against", "remarks", "closed_by", "confidence", "mistakes",
}  # fmt: skip # fields that hold what people read
SEARCHES = {"partition", "rpartition", "removeprefix", "startswith", "endswith", "split", "replace"}
PROSE = re.compile(r"[a-z]{2} |: |; ")  # in a text that is looked for
THREE_WORDS = re.compile(r"[a-z]+ [a-z]+ [a-z]+")
EVERYDAY = re.compile(r"(^|_)(told|own|made|begun|shown)(_|$)", re.IGNORECASE)
FIT_ROOMS = ("measurement", "modal_analysis")


def reads_of_modal(package: Package) -> Found:
    """Attributes ``modal`` that are read, as long as a class ``Measurement`` has a field of that name (69)."""
    if "modal" not in _fields_of_measurements(package):
        return 0, []
    return places(
        package,
        lambda node: isinstance(node, ast.Attribute) and node.attr == "modal" and isinstance(node.ctx, ast.Load),
    )


def _fields_of_measurements(package: Package) -> set[str]:
    classes = [n for m in package.modules for n in m.nodes if isinstance(n, ast.ClassDef) and n.name == "Measurement"]
    return {identifier(line.target) for found in classes for line in found.body if isinstance(line, ast.AnnAssign)}


def none_tests_of_fits(package: Package) -> Found:
    """Comparisons of an attribute ``whole`` or ``modal`` with None outside measurement/ and modal_analysis/ (36)."""
    found = [
        m.place(n) for m in package.modules if m.room not in FIT_ROOMS for n in m.nodes if _compares_fit_with_none(n)
    ]
    return len(found), found


def _compares_fit_with_none(node: ast.AST) -> bool:
    if not isinstance(node, ast.Compare):
        return False
    sides = [side.value if isinstance(side, ast.NamedExpr) else side for side in (node.left, *node.comparators)]
    is_none = any(isinstance(side, ast.Constant) and side.value is None for side in sides)
    return is_none and any(isinstance(side, ast.Attribute) and side.attr in ("whole", "modal") for side in sides)


def constants(package: Package) -> Found:
    """Names of modules, each assigned alone, whose value is a number or an expression of numbers (435).

    Several names in one assignment and tuples of numbers are not counted: with them it is 509.
    """
    found = [
        module.place(line)
        for module in package.modules
        for line in _top(module)
        if isinstance(line, ast.Assign | ast.AnnAssign) and line.value is not None and _is_number(line.value)
        if isinstance(line.targets[0] if isinstance(line, ast.Assign) else line.target, ast.Name)
    ]
    return len(found), found


def _is_number(node: ast.AST) -> bool:
    match node:
        case ast.UnaryOp(operand=inner):
            return _is_number(inner)
        case ast.BinOp(left=left, right=right):
            return _is_number(left) and _is_number(right)
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
    return False


def _top(module: Module) -> list[ast.stmt]:
    """Statements of a module that stand in nothing else."""
    return ast.parse(module.text).body


def shared_names(package: Package) -> Found:
    """Public functions and classes, not in others, whose name stands in two modules or more (37)."""
    places_of: dict[str, set[str]] = defaultdict(set)
    for module in package.modules:
        for line in _top(module):
            if isinstance(line, ast.FunctionDef | ast.ClassDef) and not line.name.startswith("_"):
                places_of[line.name].add(f"sysid/{module.path}")
    found = [f"{name}: {', '.join(sorted(paths))}" for name, paths in sorted(places_of.items()) if len(paths) > 1]
    return len(found), found


def everyday_names(package: Package) -> Found:
    """Definitions and assignments of names with the word told, own, made, begun or shown in them (365).

    Functions, classes, arguments, variables and attributes, each as often as it is defined or assigned.
    """
    return places(package, lambda node: any(EVERYDAY.search(name) for name in _defined(node)))


def _defined(node: ast.AST) -> Iterator[str]:
    match node:
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
            yield name
        case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
            yield name


def searches_in_sentences(package: Package) -> Found:
    """Code that looks into what was written for people (10; 8 without ``startswith`` and ``replace``).

    ``in`` and ``not in`` between a text or a constant of a module and one of `SENTENCES`; methods of `SEARCHES` with
    a text of words; functions of ``re`` on one of `SENTENCES`.
    """
    return places(package, _searches)


def _searches(node: ast.AST) -> bool:
    match node:
        case ast.Compare(left=left, ops=[ast.In() | ast.NotIn()], comparators=[right]):
            return (_is_text(left) or identifier(left).isupper()) and identifier(right) in SENTENCES
        case ast.Call(func=ast.Attribute(value=ast.Name(id="re")), args=arguments):
            return any(identifier(argument) in SENTENCES for argument in arguments)
        case ast.Call(func=ast.Attribute(attr=method), args=[ast.Constant(value=str(text)), *_]):
            return method in SEARCHES and PROSE.search(text) is not None
    return False


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def asserts_on_prose(_: Package) -> Found:
    """Assertions of tests, but for the file with most of them, that look for three words in a row in a text (167).

    ``assert "three small words" in ...``, or ``not in``; with that file 183.
    """
    return _asserts_on_prose(Path(__file__).resolve().parents[1] / "tests")


def _asserts_on_prose(tests: Path) -> Found:
    of_file = {
        path.relative_to(tests).as_posix(): [
            f"tests/{path.relative_to(tests).as_posix()}:{node.lineno}"
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Assert) and _looks_for_prose(node.test)
        ]
        for path in sorted(tests.rglob("*.py"))
    }
    most = max(of_file, key=lambda name: len(of_file[name]))
    found = [place for name, ones in of_file.items() if name != most for place in ones]
    return len(found), found


def _looks_for_prose(test: ast.expr) -> bool:
    compared = (
        node
        for node in ast.walk(test)
        if isinstance(node, ast.Compare) and any(isinstance(op, ast.In | ast.NotIn) for op in node.ops)
    )
    return any(
        THREE_WORDS.search(part.value)
        for node in compared
        for part in ast.walk(node)
        if isinstance(part, ast.Constant) and isinstance(part.value, str)
    )


def files(package: Package) -> Found:
    """Python files (224)."""
    return len(package.modules), []
