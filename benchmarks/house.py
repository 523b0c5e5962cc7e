"""Counts of the package's shape: imports one way, few tests of types, few branches, short functions.

Everything is counted on the syntax trees of ``sysid/``; nothing is imported. ``tests/test_architecture.py`` holds the
same counts. Each function says what it counts, so that other commits can be counted alike. On cfd962a, which had no
rooms yet, it gives 64 files in the root, 42 reads of ``is_written``, 66 tests of a model's class (62 by ``isinstance``,
4 by the name of its unknowns), 36 tests for None on fields of the formulation, 89 lines in the longest function, 95
branches in 1,000 lines and 16,600 lines in all.
"""

from __future__ import annotations

import ast
import math
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from benchmarks import names
from benchmarks.line import Line, below
from benchmarks.own_process import figures_of
from benchmarks.syntax import Found, Package, fields_of, identifier, package_folder, places

# Each floor imports only from those before it; rooms of one floor from each other too, as long as they make no circle.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("errors", "finding"),
    ("finding",),
    ("nlp",),
    ("structure", "frame"),  # sysid.frame is the public name of sysid.structure.frame
    ("swarm",),
    ("measurement",),
    ("files",),
    ("modal_analysis",),
    ("models",),
    ("problem",),
    ("search",),
    ("assessment",),
    ("results",),
    ("export",),
    ("identify",),
    ("catalogue", "compare", "jobs"),
    ("plot",),
    ("report",),
    ("cli",),
    ("__init__", "__main__"),
)
FLOOR_OF = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}

MODEL_NAME = re.compile(r"[A-Z]\w*(Mass|Stiffness|Damping|Models?)|Written[A-Z]?\w*")
NO_MODELS = {"PointMass"}  # a part of a frame
UNKNOWNS_OF_MODELS = {
    "mass_factor", "mass_share", "stiffness_factor", "damping_ratio", "rayleigh_factor", "rayleigh_alpha",
    "rayleigh_beta",
}  # fmt: skip
SHARED_FIELDS = {"mass", "stiffness", "damping", "constraints", "healing"}  # a problem has them too
FORMULATIONS = {"formulation", "f"}  # what a formulation is called where it is used
PATIENCE = 300.0  # s of the run whose files are counted

# Imports


def _room_of(name: str) -> str:
    return name.split(".")[1] if "." in name else "__init__"


def wrong_arrows(package: Package) -> Found:
    """Imports of a room from a floor that is not below its own; a room that `FLOORS` does not name is one too."""
    unknown = [
        f"sysid/{m.path}: FLOORS in {__name__} has no such room" for m in package.modules if m.room not in FLOOR_OF
    ]
    wrong = [
        module.place(node)
        for module, target, node in package.imports
        if _room_of(target) != module.room and not FLOOR_OF.get(_room_of(target), 99) <= FLOOR_OF.get(module.room, -1)
    ]
    return len(unknown + wrong), unknown + wrong


def needs_of_the_swarm(package: Package) -> Found:
    """Imports of `sysid.swarm` from anything but itself and `sysid.errors`: it minimises any function."""
    return _imports_of(package, "swarm", lambda target: _room_of(target) not in ("swarm", "errors"))


def search_in_assessment(package: Package) -> Found:
    """Imports of `sysid.assessment` from `sysid.search`: checks know no strategy."""
    return _imports_of(package, "assessment", lambda target: _room_of(target) == "search")


def _imports_of(package: Package, room: str, is_wrong: Callable[[str], bool]) -> Found:
    wrong = [module.place(node) for module, target, node in package.imports if module.room == room and is_wrong(target)]
    return len(wrong), wrong


def circles(package: Package) -> Found:
    """Modules that import themselves through others.

    A folder's ``__init__`` counts where an import names the folder, not where a module in it is imported.
    """
    arrows: dict[str, set[str]] = {module.name: set() for module in package.modules}
    for module, target, _ in package.imports:
        arrows[module.name].add(target)
    reached = {name: _reached(name, arrows) for name in arrows}
    groups = {frozenset(other for other in reached[name] if name in reached.get(other, ())) for name in arrows}
    return sum(map(len, groups)), [" <-> ".join(sorted(group)) for group in groups if group]


def _reached(name: str, arrows: dict[str, set[str]]) -> set[str]:
    reached: set[str] = set()
    waiting = list(arrows[name])
    while waiting:
        if (target := waiting.pop()) not in reached:
            reached.add(target)
            waiting += arrows.get(target, ())
    return reached


# Two kinds of problem, types, None


def reads_of_is_written(package: Package) -> Found:
    """Attributes and names ``is_written``: whether a problem was written in expressions."""
    return places(package, lambda node: identifier(node) == "is_written")


def written_twins(package: Package) -> Found:
    """Modules, functions and classes ``written_...`` above `sysid.problem`: second ways for problems in expressions."""
    above = [module for module in package.modules if FLOOR_OF.get(module.room, 99) > FLOOR_OF["problem"]]
    twin = re.compile(r"_*(written_|Written[A-Z])\w*")
    modules = [f"sysid/{m.path}" for m in above if twin.fullmatch(m.path.rpartition("/")[2].removesuffix(".py"))]
    names = [
        module.place(node)
        for module in above
        for node in module.nodes
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and twin.fullmatch(node.name)
    ]
    return len(modules + names), modules + names


def class_tests(package: Package) -> Found:
    """Tests of the class of a matrix model outside `sysid.models`, by class or by name.

    By class: ``isinstance``, ``issubclass``, comparisons of ``type(...)`` and ``__class__``, class patterns and tables
    with classes as keys. By name: comparisons and patterns with a class, or one of `UNKNOWNS_OF_MODELS`, as text. A
    class is of a matrix model where its name ends in Mass, Stiffness, Damping or Model, or begins with Written.
    """
    return places(package, _tests_a_model, but="models")


def _tests_a_model(node: ast.AST) -> bool:
    match node:
        case ast.Call(func=ast.Name(id="isinstance" | "issubclass"), args=[_, tested]):
            return _names_a_model(tested)
        case ast.Compare():
            of_types = any(_is_type(part) for part in (node.left, *node.comparators))
            return (of_types and _names_a_model(node)) or _quotes_a_model(node)
        case ast.MatchClass():
            return _names_a_model(node.cls)
        case ast.MatchValue():
            return _quotes_a_model(node.value)
        case ast.Dict():
            return any(key is not None and _is_model(identifier(key)) for key in node.keys)
    return False


def _is_type(node: ast.AST) -> bool:
    return (isinstance(node, ast.Call) and identifier(node.func) == "type") or identifier(node) == "__class__"


def _names_a_model(node: ast.AST) -> bool:
    return any(_is_model(identifier(part)) for part in ast.walk(node))


def _quotes_a_model(node: ast.AST) -> bool:
    texts = (part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str))
    return any(text in UNKNOWNS_OF_MODELS or _is_model(text) for text in texts)


def _is_model(name: str) -> bool:
    return MODEL_NAME.fullmatch(name) is not None and name not in NO_MODELS


def none_tests(package: Package) -> Found:
    """Comparisons of a formulation's field with None, outside `sysid.models`, which knows no formulation.

    A field is told by its name, whatever it is read from; one of `SHARED_FIELDS` only where it is read from something
    called "formulation" or "f".
    """
    fields = fields_of(package, "Formulation")
    return places(package, lambda node: _is_none_test(node, fields), but="models")


def _is_none_test(node: ast.AST, fields: set[str]) -> bool:
    if not isinstance(node, ast.Compare):
        return False
    sides = [side.value if isinstance(side, ast.NamedExpr) else side for side in (node.left, *node.comparators)]
    if not any(isinstance(side, ast.Constant) and side.value is None for side in sides):
        return False
    read = [side for side in sides if isinstance(side, ast.Attribute) and side.attr in fields]
    return any(side.attr not in SHARED_FIELDS or identifier(side.value) in FORMULATIONS for side in read)


# Sizes


def root_modules(package: Package) -> Found:
    """Python files in ``sysid/`` itself."""
    names = [module.path for module in package.modules if "/" not in module.path]
    return len(names), names


def hidden_modules(package: Package) -> Found:
    """Files and folders whose name begins with an underscore, ``__init__`` and ``__main__`` apart."""
    hidden = [m.path for m in package.modules if re.search(r"(^|/)_(?!_init__\.py|_main__\.py)", m.path)]
    return len(hidden), hidden


def longest_function(package: Package) -> Found:
    """Lines from ``def`` to the end, comments, blank lines and inner functions included, its own docstring not."""
    sizes = [
        (node.end_lineno - node.lineno + 1 - _docstring_lines(node), module.place(node))
        for module in package.modules
        for node in module.nodes
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None
    ]
    sizes.sort(reverse=True)
    return sizes[0][0], [f"{size} lines, {place}" for size, place in sizes[:10]]


def _docstring_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    first = node.body[0]
    return (first.end_lineno or 0) - first.lineno + 1 if ast.get_docstring(node, clean=False) is not None else 0


def branches(package: Package) -> Found:
    """``if``, ``elif``, conditional expressions and ``case`` in 1,000 lines that are neither blank nor comment alone.

    Lines of docstrings count among the lines. Conditions of comprehensions, ``and`` and ``or`` are no branches.
    """
    kinds = (ast.If, ast.IfExp, ast.match_case)
    count = sum(isinstance(node, kinds) for module in package.modules for node in module.nodes)
    lines = [line.strip() for module in package.modules for line in module.text.splitlines()]
    return 1000 * count / sum(bool(line) and not line.startswith("#") for line in lines), [f"{count} branches in all"]


def all_lines(package: Package) -> Found:
    """Lines of all files, blank ones and comments included."""
    return sum(len(module.text.splitlines()) for module in package.modules), []


def main_path(package: Package) -> Found:
    """Lines of ``identify.py`` (212), the file that a reader opens first."""
    return sum(len(module.text.splitlines()) for module in package.modules if module.path == "identify.py"), []


def longest_file(package: Package) -> Found:
    """Lines of the longest file."""
    sizes = sorted(((len(m.text.splitlines()), f"sysid/{m.path}") for m in package.modules), reverse=True)
    return sizes[0][0], [f"{size} lines, {path}" for size, path in sizes[:5]]


@dataclass(frozen=True)
class Check:
    """A count over the package and the most it may be.

    Attributes
    ----------
    text : str
        What is counted.
    bound : float
    count : callable
        Of a `Package`: the figure, and the places where it was counted.
    """

    text: str
    bound: float
    count: Callable[[Package], Found]


CHECKS = {
    "arrows": Check("imports between rooms that do not go down", 0, wrong_arrows),
    "swarm": Check("imports of swarm/ from other rooms than errors", 0, needs_of_the_swarm),
    "assessment": Check("imports of assessment/ from search/", 0, search_in_assessment),
    "circles": Check("modules on a circle of imports", 0, circles),
    "is_written": Check("reads of is_written", 0, reads_of_is_written),
    "twins": Check("modules, functions and classes for written problems alone, above problem/", 0, written_twins),
    "classes": Check("tests of a matrix model's class outside models/", 8, class_tests),
    "none": Check("tests for None on fields of the formulation", 0, none_tests),
    "root": Check("Python files in the root of sysid/", 8, root_modules),
    "hidden": Check("files and folders with a leading underscore", 0, hidden_modules),
    "function": Check("lines of the longest function without its docstring", 60, longest_function),
    "branches": Check("branches in 1,000 lines", 70, branches),
    "lines": Check("lines in all", 33_000, all_lines),
    "file": Check("lines of the longest file", 500, longest_file),
    "files": Check("Python files", 190, names.files),
    "main": Check("lines of identify.py", 149, main_path),
    "modal": Check("reads of Measurement.modal", 0, names.reads_of_modal),
    "fits": Check("tests for None of `whole` and `modal` above modal_analysis/", 0, names.none_tests_of_fits),
    "constants": Check("numeric constants of modules", 200, names.constants),
    "shared": Check("public names in two modules", 5, names.shared_names),
    "everyday": Check("definitions of names with told, own, made, begun or shown", 60, names.everyday_names),
    "sentences": Check("code that searches in sentences", 0, names.searches_in_sentences),
    "prose": Check("assertions on prose outside one file of tests", 20, names.asserts_on_prose),
}


def lines(reduced: bool) -> Iterator[Line]:
    """One line a count, and one of the files that run. Both forms are the same."""
    package = Package(package_folder())
    for check in CHECKS.values():
        value, _ = check.count(package)
        yield Line(
            check.text,
            f"{value:,.4g}" if value < 1000 else f"{value:,.0f}",
            f"<= {check.bound:,g}",
            value <= check.bound,
        )
    yield below("files of sysid/ in which a function runs during `sysid run test.h5`", *_running(80))


def _running(bound: int) -> tuple[float, int]:
    """Counted by sys.setprofile in a process of its own, on records of a frame of two storeys (115; 116 on others)."""
    with tempfile.TemporaryDirectory() as folder:
        found = figures_of("benchmarks.running", [folder], PATIENCE)
    return (float(len(found)) if isinstance(found, list) else math.nan), bound
