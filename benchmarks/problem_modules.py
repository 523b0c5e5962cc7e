"""The checkout's problem modules, as Python modules: benchmarks call more than ``problem()``."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]


def load_module(name: str) -> ModuleType:
    """Module ``problems/NAME.py`` of the checkout."""
    spec = importlib.util.spec_from_file_location(f"benchmarked_{name}", ROOT / "problems" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
