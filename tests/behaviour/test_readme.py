"""The README's example runs as it stands, and says what the result says."""

import contextlib
import io
import os
import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.mark.skipif(not README.exists(), reason="no README beside the tests")
def test_the_examples_find_their_own_structure(tmp_path):
    first, second = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    before, names = Path.cwd(), {}
    os.chdir(tmp_path)
    try:
        with contextlib.redirect_stdout(io.StringIO()) as said:
            exec(compile(first, "README.md", "exec"), names)
    finally:
        os.chdir(before)
    np.testing.assert_allclose(names["result"].structure.mass, names["truth"].mass, atol=1e-6)
    np.testing.assert_allclose(names["result"].structure.stiffness, names["truth"].stiffness, atol=1e-3)
    assert "Determined" in said.getvalue()
    assert (tmp_path / "two_floors.h5").exists()
    exec(compile(second, "README.md", "exec"), names)
    assert names["result"].determined
    np.testing.assert_allclose(names["result"].values["spring"], 2000.0, rtol=1e-8)
    np.testing.assert_allclose(names["result"].values["upper floor"], 4.0, rtol=1e-8)
