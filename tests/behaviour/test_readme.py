"""The examples of README and docs run as they stand, and say what the result says."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
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


def test_the_lines_of_the_readme_go_from_a_loggers_file_of_each_kind_to_an_export(
    tmp_path, monkeypatch, capsys, no_pictures
):
    op4, pyuff = pytest.importorskip("pyyeti.nastran.op4"), pytest.importorskip("pyuff")
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
    base = rng.standard_normal((1, 1000))
    table = np.vstack([base / 9.80665, truth.simulate(base, rate), truth.simulate_force(base, rate) / 1000])
    table *= 1 + 0.003 * rng.standard_normal(table.shape)
    _write_log(table, rate, described, pyuff)
    for line in filter(None, lines.splitlines()):
        assert cli.main(line.split()[1:]) == 0, capsys.readouterr().err
    result = sysid.load("results/test")
    assert result.determined and (tmp_path / "results/test/report.html").exists()
    assert np.all(np.abs(result.structure.mass - truth.mass)[:2, :2] < 5 * result.uncertainty.mass[:2, :2])
    exported = {name: op4.read(f"{name}.op4")["m"] for name in ("model", "matlab", "universal")}
    np.testing.assert_array_equal(exported["model"], result.structure.mass)
    scale = np.abs(exported["model"]).max()
    np.testing.assert_allclose(exported["matlab"], exported["model"], rtol=0, atol=1e-6 * scale)  # CSV has ten digits
    np.testing.assert_allclose(exported["universal"], exported["model"], rtol=0, atol=1e-4 * scale)  # single precision


def _write_log(table, rate, described, pyuff):
    """log.csv, log.mat and log.unv with the same channels, and nodes.toml, which names those of the last."""
    time, names = np.arange(table.shape[1]) / rate, ("table", "a1", "a2", "force")
    head = "time [s],table [g],a1 [m/s²],a2 [m/s²],force [kN]"
    np.savetxt("log.csv", np.vstack([time, table]).T, "%.10g", ",", header=head, comments="", encoding="utf-8")
    savemat("log.mat", {"time": time} | dict(zip(names, table, strict=True)))
    described = described.replace('time = "time" ', "# ")
    for node, name in enumerate(names, 1):
        described = described.replace(f'column = "{name}"', f'column = "{node}+X"')
    Path("nodes.toml").write_text(described, encoding="utf-8")
    sets = [
        pyuff.prepare_58(
            binary=0, func_type=1, rsp_node=node, rsp_dir=1, ref_node=0, ref_dir=0, x=time, num_pts=time.size, data=row,
            id1="", id2="", id3="", id4="", id5="", load_case_id=0, rsp_ent_name="s", ref_ent_name="r", ord_data_type=2,
            abscissa_spacing=1, abscissa_inc=1 / rate, abscissa_min=0.0, ordinate_spec_data_type=0,
            orddenom_spec_data_type=0, abscissa_spec_data_type=17,
        )
        for node, row in enumerate(table, 1)
    ]  # fmt: skip
    pyuff.UFF("log.unv").write_sets(sets, "overwrite")


def test_the_examples_of_the_docs_find_their_own_structure(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (first,), (second, complex_terms, _, third) = map(examples, ("docs/notebooks.md", "docs/own_unknowns.md"))
    names = {}
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
    exec(compile(complex_terms, "own_unknowns.md", "exec"), names)
    exec(compile(third, "own_unknowns.md", "exec"), names)
    _ring_is_identified(names["RingStiffness"]())


def test_the_lines_on_records_and_results_run_one_after_the_other():
    rng, G = np.random.default_rng(1), np.ones((2, 1))
    K = 2000.0 * np.array([[2, -1, -1], [-1, 1, 0], [-1, 0, 1]])
    truth = sysid.Structure(np.diag([5.0, 4.0, 0.0]), K, [0.01, 0.015], n_base=1)
    base = rng.standard_normal((1, 2000))
    still = truth.simulate(base, 100.0)
    base, response = base[:, 500:], still[:, 500:] + 0.01 * rng.standard_normal((2, 1500))  # begins in motion
    names = {"sysid": sysid, "G": G, "base": base, "response": response, "freq": np.linspace(0.5, 8.0, 20)}
    (records,), (bounds,), (motion,) = map(
        examples, ("docs/records_and_noise.md", "docs/what_the_data_determine.md", "docs/results.md")
    )
    exec(compile(records, "records_and_noise.md", "exec"), names)
    names["result"] = sysid.identify(sysid.Problem(names["test"], mass=sysid.LumpedMass(total_mass=9.0)), rng=0)
    exec(compile(bounds, "what_the_data_determine.md", "exec"), names)
    exec(compile(motion, "results.md", "exec"), names)
    assert names["scores"].error.max() < 0.03 and names["force"].shape == base.shape
    np.testing.assert_allclose(names["result"].structure.mass[:2, :2], np.diag([5.0, 4.0]), atol=0.05)


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
