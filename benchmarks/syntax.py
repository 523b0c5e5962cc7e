"""The syntax trees of the package, for counts: modules, what they import, and where something stands."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

Found = tuple[float, Sequence[str]]


@dataclass(frozen=True)
class Module:
    """One file of the package.

    Attributes
    ----------
    path : str
        Below the package, with "/".
    text : str
    nodes : tuple of ast.AST
        All nodes of its syntax tree, line by line.
    """

    path: str
    text: str
    nodes: tuple[ast.AST, ...]

    @property
    def room(self) -> str:
        """Its folder, or the name of a file in the root."""
        return self.path.partition("/")[0].removesuffix(".py")

    @property
    def name(self) -> str:
        """Its dotted name; of an ``__init__.py`` the folder's."""
        below = self.path.removesuffix(".py").removesuffix("__init__").rstrip("/")
        return "sysid." + below.replace("/", ".") if below else "sysid"

    @property
    def package(self) -> str:
        """Package that relative imports start from."""
        return self.name if self.path.endswith("__init__.py") else self.name.rpartition(".")[0]

    def place(self, node: ast.AST) -> str:
        """File, line and first line of a node, for a message."""
        line = getattr(node, "lineno", 0)
        return f"sysid/{self.path}:{line}: {self.text.splitlines()[line - 1].strip()}"


class Package:
    """The syntax trees of a folder ``sysid/``."""

    def __init__(self, folder: Path) -> None:
        self.modules = tuple(_parsed(folder, path) for path in sorted(folder.rglob("*.py")) if _is_ours(folder, path))

    @cached_property
    def imports(self) -> tuple[tuple[Module, str, ast.AST], ...]:
        """Module, what it imports of the package and where; late imports and those for types alone included."""
        names = {module.name for module in self.modules}
        return tuple(
            (module, target, node)
            for module, package in ((module, module.package) for module in self.modules)
            for node in module.nodes
            for target in _targets(node, package, names)
        )


def _is_ours(folder: Path, path: Path) -> bool:
    return "bundled_problems" not in path.relative_to(folder).parts  # in a wheel the problem modules travel inside


def _parsed(folder: Path, path: Path) -> Module:
    text = path.read_text(encoding="utf-8")
    nodes = sorted(ast.walk(ast.parse(text)), key=lambda node: getattr(node, "lineno", 0))
    return Module(path.relative_to(folder).as_posix(), text, tuple(nodes))


def package_folder() -> Path:
    """``sysid/`` of the checkout; where only the benchmarks were copied, that of the installation."""
    checkout = Path(__file__).resolve().parents[1] / "sysid"
    if checkout.is_dir():
        return checkout
    spec = importlib.util.find_spec("sysid")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent


def _targets(node: ast.AST, package: str, names: set[str]) -> Iterator[str]:
    """Modules of the package that an import statement names; of ``from sysid.search import local`` the submodule."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "sysid")
    elif isinstance(node, ast.ImportFrom):
        above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
        source = ".".join([*above, *(node.module.split(".") if node.module else [])])
        if source.split(".")[0] == "sysid":
            yield from dict.fromkeys(
                f"{source}.{alias.name}" if f"{source}.{alias.name}" in names else source for alias in node.names
            )


def identifier(node: ast.AST) -> str:
    """The last name of an expression: ``c`` of ``a.b.c``; empty where it has none."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
    return ""


def fields_of(package: Package, name: str) -> set[str]:
    """Annotated names in the bodies of classes of that name."""
    classes = [
        node for m in package.modules for node in m.nodes if isinstance(node, ast.ClassDef) and node.name == name
    ]
    return {identifier(line.target) for found in classes for line in found.body if isinstance(line, ast.AnnAssign)}


def places(package: Package, is_one: Callable[[ast.AST], bool], but: str = "") -> Found:
    """All nodes for which `is_one` holds, outside the room `but`."""
    found = [m.place(node) for m in package.modules if m.room != but for node in m.nodes if is_one(node)]
    return len(found), found
