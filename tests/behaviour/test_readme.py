"""The README's example runs as it stands, and says what the result says."""

import contextlib
import io
import os
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import circulant

import sysid

README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.mark.skipif(not README.exists(), reason="no README beside the tests")
def test_the_examples_find_their_own_structure(tmp_path):
    """Those of the notebook; that of jobs, the first, is run beside a result of the command line."""
    _, first, second, third = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
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
    exec(compile(third, "README.md", "exec"), names)
    _ring_is_identified(names["RingStiffness"]())


def _ring_is_identified(model):
    """The matrix model of the README finds the springs of a ring of sectors that differ in mass."""
    to_base, coupling, G = 2e4, 3e3, np.ones((4, 1))
    K = circulant([to_base + 2 * coupling, -coupling, 0.0, -coupling])
    mass = np.diag([1.0, 1.2, 0.9, 1.1, 0.0])
    truth = sysid.Structure(mass, np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]]), [0.01] * 4, n_base=1)
    test = sysid.simulate(truth, np.linspace(15.0, 35.0, 60), noise=0.01, rng=0)
    problem = sysid.Problem(test, mass=mass, stiffness=model)
    result = sysid.identify(problem, strategy=sysid.Continuation(starts=1), rng=0)
    assert result.determined, result.undetermined
    for name, value in (("spring to base", to_base), ("coupling", coupling)):
        (found,), (std,) = result.values[name], result.uncertainty.variables[name]
        assert abs(found - value) < 4 * std < 0.01 * value
        assert re.search(rf"^ *{name} +{found:.6g} .* N/m ", result.summary(), re.M)
