"""Matrix models as trees: the class by its name, and what the class makes of itself."""

from __future__ import annotations

import importlib
from typing import Any

from sysid.errors import InputError
from sysid.models.damping import ModalDamping, ProportionalDamping
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.stiffness import ChainStiffness, SpectralStiffness

_OWN: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        FullMass, LumpedMass, KnownMass, SpectralStiffness, ChainStiffness, ModalDamping, ProportionalDamping,
    )
}  # fmt: skip


def is_storable(model: Any) -> bool:
    """Whether something is a model that can be stored: its class has `to_tree` and `from_tree`."""
    return all(callable(getattr(type(model), name, None)) for name in ("to_tree", "from_tree"))


def model_to_tree(model: Any) -> dict[str, Any]:
    """Tree of a matrix model of the package, or of any other class with `to_tree` and `from_tree`.

    Raises
    ------
    InputError
        Where the class could not be found again.
    """
    kind = type(model)
    if not is_storable(model):
        raise InputError(
            f"a {kind.__name__} cannot be stored: its class needs a method to_tree(), which gives a dictionary of "
            "arrays, numbers and texts, and a class method from_tree(tree), which takes it back"
        )
    if "<locals>" in kind.__qualname__:
        raise InputError(
            f"a {kind.__name__} cannot be stored: its class stands inside a function ({kind.__qualname__}), where no "
            "other program finds it; move the class to the top of its module"
        )
    name = kind.__name__ if _OWN.get(kind.__name__) is kind else f"{kind.__module__}:{kind.__qualname__}"
    return {"kind": name, "fields": model.to_tree()}


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
    return (_imported(module, name) if colon else _OWN[name]).from_tree(tree["fields"])


def _imported(module: str, name: str) -> Any:
    """The class `name` of a module."""
    try:
        kind: Any = importlib.import_module(module)
        for part in name.split("."):
            kind = getattr(kind, part)
        if isinstance(kind, type) and callable(getattr(kind, "from_tree", None)):
            return kind
        problem = "it is no class with from_tree"
    except Exception as error:  # a module of the user's may fail in any way
        problem = f"{type(error).__name__}: {error}"
    raise InputError(
        f"the class {name} of the module {module!r} is needed, of which a model is made, and cannot be imported "
        f"({problem}); put the module on Python's path, or import it first"
    )
