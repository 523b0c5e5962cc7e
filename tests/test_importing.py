"""The import of the package: what it loads, and linear algebra that is loaded later."""

import json
import os
import subprocess
import sys

_LOADED_WHERE_USED = {
    "scipy.linalg", "scipy.special", "scipy.optimize", "scipy.sparse", "scipy.fft", "scipy.stats", "h5py", "matplotlib",
    "rich", "importlib.metadata",
}  # fmt: skip


def told_by_fresh_python(code: str, **environment: str) -> object:
    """Output of a new process, as JSON."""
    ran = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=os.environ | environment
    )
    return json.loads(ran.stdout)


def test_the_import_loads_no_large_package_beside_numpy_and_casadi():
    loaded = told_by_fresh_python("import json, sys, sysid; print(json.dumps(list(sys.modules)))")
    assert "sysid.identify" in loaded
    assert _LOADED_WHERE_USED.isdisjoint(loaded)


def test_one_thread_holds_libraries_that_the_package_had_not_loaded_before():
    code = """
import json
from threadpoolctl import threadpool_info
import sysid
from sysid.nlp import one_thread
with one_thread():
    import scipy.linalg, scipy.optimize
    print(json.dumps([[pool["filepath"], pool["num_threads"]] for pool in threadpool_info()]))
"""
    found = told_by_fresh_python(code, OPENBLAS_NUM_THREADS="2", OMP_NUM_THREADS="2")
    assert found
    assert all(threads == 1 for _, threads in found), found
