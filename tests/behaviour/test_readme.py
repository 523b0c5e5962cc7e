"""The examples of README and docs run as they stand, and say what the result says."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import circulant

import sysid
from sysid.cli import main as cli

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(not (ROOT / "README.md").exists(), reason="no README beside the tests")


def examples(name):
    """The Python of a page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), re.DOTALL)


def test_the_example_of_the_readme_is_determined(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,), names = examples("README.md"), {}
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(example, "README.md", "exec"), names)
    result, truth = names["result"], names["truth"]
    assert result.judgement == "determined" and "Determined" in said.getvalue()
    assert np.all(np.abs(result.structure.mass - truth.mass)[:2, :2] < 5 * result.uncertainty.mass[:2, :2])
    assert (tmp_path / "two_floors.html").stat().st_size > 1e4


def test_the_lines_of_the_readme_go_from_a_loggers_file_to_an_export(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (described,) = re.findall(r"```toml\n(.*?)```", readme, re.DOTALL)
    (tmp_path / "sensors.toml").write_text(described, encoding="utf-8")
    (lines,) = re.findall(r"```\n(sysid read .*?)```", readme, re.DOTALL)
    truth = sysid.Structure(
        [[5e3, 0, 0], [0, 4e3, 0], [0, 0, 0]],
        [[4e6, -2e6, -2e6], [-2e6, 2e6, 0], [-2e6, 0, 2e6]],
        [0.01, 0.015],
        n_base=1,
    )
    rng, rate = np.random.default_rng(0), 50.0
    base = rng.standard_normal((1, 3000))
    response = truth.simulate(base, rate)
    force = truth.simulate_force(base, rate)
    table = np.vstack([np.arange(3000) / rate, base / 9.80665, response, force / 1000])
    table[1:] *= 1 + 0.003 * rng.standard_normal(table[1:].shape)
    head = "time [s],table [g],a1 [m/s²],a2 [m/s²],force [kN]"
    np.savetxt("log.csv", table.T, "%.9g", ",", header=head, comments="", encoding="utf-8")
    for line in lines.splitlines():
        assert cli.main(line.split()[1:]) == 0, capsys.readouterr().err
    result = sysid.load("results/test")
    assert result.determined and (tmp_path / "model.bdf").exists() and (tmp_path / "results/test/report.html").exists()
    assert np.all(np.abs(result.structure.mass - truth.mass)[:2, :2] < 5 * result.uncertainty.mass[:2, :2])


def test_the_examples_of_the_docs_find_their_own_structure(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (first,), (second, third), names = examples("docs/notebooks.md"), examples("docs/own_unknowns.md"), {}
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(first, "notebooks.md", "exec"), names)
    np.testing.assert_allclose(names["result"].structure.mass, names["truth"].mass, atol=1e-6)
    np.testing.assert_allclose(names["result"].structure.stiffness, names["truth"].stiffness, atol=1e-3)
    assert "Determined" in said.getvalue()
    assert (tmp_path / "two_floors.h5").exists()
    exec(compile(second, "own_unknowns.md", "exec"), names)
    assert names["result"].determined
    np.testing.assert_allclose(names["result"].values["spring"], 2000.0, rtol=1e-8)
    np.testing.assert_allclose(names["result"].values["upper floor"], 4.0, rtol=1e-8)
    exec(compile(third, "own_unknowns.md", "exec"), names)
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
