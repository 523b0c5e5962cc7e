"""Make ``laboratory`` importable, what tests of files share."""

import importlib.util
import sys
from pathlib import Path

_SPEC = importlib.util.spec_from_file_location("laboratory", Path(__file__).with_name("laboratory.py"))
sys.modules["laboratory"] = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(sys.modules["laboratory"])
