"""Matrix models as trees: the class by its name, and what the class makes of itself.

A tree may come from a file of somebody else's. So nothing is imported for it: a class is found only in a module that
was imported before, by the user's script or as a problem module that the user named.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from sysid.errors import InputError, refuse, shown
from sysid.models.damping import ModalDamping, ProportionalDamping
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.model import plain
from sysid.models.stiffness import ChainStiffness, SpectralStiffness

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
    """Tree of a matrix model: what `to_tree` of its class gives, else its attributes.

    Raises
    ------
    InputError
        Where the class could not be found again, or an attribute is no number, array of numbers, text or None.
    """
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
    module that was named to it (see `sysid.catalogue.build`), or beside that one.

    Raises
    ------
    InputError
        Where the class is not to be found; says which one, and in which module.
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
    """The class `name` of a module that is imported.

    Raises
    ------
    InputError
        Where there is none, or there are several from different files.
    """
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
