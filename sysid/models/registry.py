"""Matrix models as trees: the class by its name, and what the class makes of itself."""

from __future__ import annotations

import importlib
from typing import Any

from sysid.errors import InputError
from sysid.models.damping import ModalDamping, ProportionalDamping
from sysid.models.field_tree import plain
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.stiffness import ChainStiffness, SpectralStiffness

_OWN: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        FullMass, LumpedMass, KnownMass, SpectralStiffness, ChainStiffness, ModalDamping, ProportionalDamping,
    )
}  # fmt: skip
_TREE, _MODEL = ("to_tree", "from_tree"), ("unknowns", "blocks", "values", "stated")


def is_storable(model: Any) -> bool:
    """Whether something is a model: its class has `to_tree` and `from_tree`, or the methods of a matrix model."""
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
    name = kind.__name__ if _OWN.get(kind.__name__) is kind else f"{kind.__module__}:{kind.__qualname__}"
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
    """Give the model of a tree that `model_to_tree` made; the module of a user's own class is imported.

    Raises
    ------
    InputError
        Where the class is not to be found; says which one, and in which module.
    """
    module, colon, name = tree["kind"].rpartition(":")
    if not colon and name not in _OWN:
        raise InputError(f"model {name!r} is unknown to this sysid: a later one is needed")
    kind = _imported(module, name) if colon else _OWN[name]
    if _has(kind, _TREE):
        return kind.from_tree(tree["fields"])
    model = object.__new__(kind)
    vars(model).update(tree["fields"])
    return model


def _imported(module: str, name: str) -> Any:
    """The class `name` of a module."""
    try:
        kind: Any = importlib.import_module(module)
        for part in name.split("."):
            kind = getattr(kind, part)
        if isinstance(kind, type) and (_has(kind, _TREE) or _has(kind, _MODEL)):
            return kind
        problem = "it is no class of a matrix model"
    except Exception as error:  # a module of the user's may fail in any way
        problem = f"{type(error).__name__}: {error}"
    raise InputError(
        f"the class {name} of the module {module!r} is needed, of which a model is made, and cannot be imported "
        f"({problem}); put the module on Python's path, or import it first"
    )
