"""``--modes`` and ``--dofs``: so many modes, on these sensors, of a run, of jobs about its result, and side by side."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.cli import main as cli
from sysid.files import recorded_test
from sysid.files.recorded_test import RecordedTest
from sysid.results.checkpoint import RunRequest

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MASSES, SPRINGS = np.array([2.0, 3.0, 2.5]), np.array([3.0, 2.0, 1.5]) * 1e4
NAMES = "low", "middle", "high"


@pytest.fixture(scope="module")
def truth():
    K = np.diag(SPRINGS + np.append(SPRINGS[1:], 0)) - np.diag(SPRINGS[1:], 1) - np.diag(SPRINGS[1:], -1)
    one = np.ones((3, 1))
    full = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    return sysid.Structure(np.diag([*MASSES, 1.0]), full, [0.01, 0.012, 0.014], n_base=1)


@pytest.fixture(scope="module")
def file(truth, tmp_path_factory):
    """Spectra up to between the second and the third mode."""
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.linspace(0.5 * f[0], (f[1] + f[2]) / 2, 150), noise=0.01, force=True, rng=0)
    sensors = tuple(sysid.Sensor(name, (0, 0, float(i)), "x") for i, name in enumerate(NAMES))
    run = test.base[0], test.response[0], test.force[0]
    path = tmp_path_factory.mktemp("test") / "test.h5"
    path.write_bytes(RecordedTest((run,), sensors, ("x",), (0.0, 0.0, 0.0), None, test.freq, ()).to_bytes())
    return str(path)


def test_tolerances_of_all_gains_at_the_command_line(folder, file, capsys):
    assert cli.main(["run", file, "--gain-std", "0.004", "--out", "within"]) == 0
    result = sysid.load("within")
    assert result.modal[0].calibration.tolerance.tolist() == [0.004] * 5
    least = 0.004 * np.diag(result.structure.mass)[: result.structure.n]  # of the force's gain alone
    assert np.all(np.diag(result.uncertainty.mass) > least)
    within = result.modal[0].calibration.seen(result.measurement)
    told = capsys.readouterr().out
    assert all(f"{1 + one:.4f}  " in told for one in within) and "taken off" in told and "assumes" not in told
    kept = json.loads(Path("within/summary.json").read_text(encoding="utf-8"))
    assert [one["within"] for one in kept["gains"]] == pytest.approx(within)
    assert kept["total_mass_std_kg"] == np.diag(result.uncertainty.rigid_body_mass).tolist()
    for wrong, why in (("5", "gain_std"), ("0.5%", "0.005 is half a per cent"), ("nan", "0.005 is half a per cent")):
        assert cli.main(["run", file, "--gain-std", wrong]) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and why in told


@pytest.fixture
def folder(tmp_path, monkeypatch, no_pictures):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def summary(folder):
    return json.loads((folder / "out" / "summary.json").read_text())


def test_the_matrices_stand_on_the_sensors_that_are_named(folder, file, truth):
    assert cli.main(["run", file, "--modes", "2", "--dofs", "high,low", "--out", "out", "--quiet"]) == 0
    told = summary(folder)
    assert told["modes_asked"] == 2 and told["judgement"] == "determined"
    assert told["degrees_of_freedom"] == ["low", "high"]
    np.testing.assert_allclose(told["natural_frequencies_hz"], truth.natural_frequencies[:2], rtol=1e-3)
    residual = told["residual_modes"]
    assert residual["count"] >= residual["static"] and 0 < residual["share_of_response"] < 0.5
    f = truth.natural_frequencies
    assert told["band_hz"] == pytest.approx([0.5 * f[0], (f[1] + f[2]) / 2])
    effective = truth.participation[:2, 0] ** 2
    assert told["effective_mass_kg"] == pytest.approx([effective.sum()], rel=0.01)
    assert told["effective_mass_kg"][0] < told["total_mass_kg"][0]
    result = sysid.load(folder / "out")
    assert (result.recipe.modes, result.recipe.sensors) == (2, ("high", "low"))
    M = np.linalg.inv(truth.normal_modes[[0, 2], :2])
    np.testing.assert_allclose(result.structure.mass[:2, :2], M.T @ M, rtol=0.02)


def test_fewer_modes_than_the_lines_hold_are_obeyed_and_kept_by_jobs(folder, file, capsys):
    cli.main(["run", file, "--modes", "1", "--out", "out", "--quiet"])
    assert summary(folder)["modes_asked"] == 1 and len(summary(folder)["natural_frequencies_hz"]) == 1
    capsys.readouterr()
    assert cli.main(["refine", "out", "--bands", "5-15", "--workers", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["identifications"]
    assert [row["score"]["modes"] for row in rows] == [1, 1]
    assert rows[0]["title"] == "test.h5, 1 mode"


def test_quiet_names_a_sensor_of_the_other_sign(folder, file, capsys):
    test = recorded_test.load(file)
    ((base, response, force),) = test.runs
    turned = np.where(np.arange(len(response)) == 1, -1.0, 1.0)[:, None] * response
    Path("turned.h5").write_bytes(replace(test, runs=((base, turned, force),)).to_bytes())
    assert cli.main(["run", "turned.h5", "--out", "out", "--quiet"]) == 1
    out, error = capsys.readouterr()
    assert out == "" and all(line.startswith("sysid: warning: ") for line in error.splitlines())
    assert NAMES[1] in error and not any(name in error for name in NAMES if name != NAMES[1])


def test_draws_of_an_answer_in_the_band_keep_its_modes_and_sensors(folder, file, capsys):
    """Two of three modes, so that it tells no unknowns."""
    cli.main(["run", file, "--dofs", "high,low", "--out", "out", "--quiet"])
    result = sysid.load(folder / "out")
    assert result.x is None
    capsys.readouterr()
    assert cli.main(["refine", "out", "--draws", "8", "--workers", "1", "--json"]) == 0
    spreads = {one["name"]: one for one in json.loads(capsys.readouterr().out)["spreads"]}
    assert len(spreads) == 4  # frequencies and ratios
    for k, std in enumerate(result.uncertainty.natural_frequencies, start=1):
        assert spreads[f"mode {k}: frequency, Hz"]["std"] == pytest.approx(std)
        assert 0.5 < spreads[f"mode {k}: frequency, Hz"]["drawn"] / std < 1.6  # by chance 0.25 off 1
    rows = (folder / "out" / "refine" / "draws.csv").read_text().splitlines()
    assert len(rows) == 9 and rows[0].count("mode ") == 4
    assert cli.main(["refine", "out", "--starts", "2", "--workers", "1"]) == 2


def test_numbers_of_modes_are_compared_up_to_those_within_the_lines(folder, file, capsys):
    cli.main(["run", file, "--out", "out", "--quiet"])
    capsys.readouterr()
    assert cli.main(["refine", "out", "--orders", "1-5", "--workers", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["identifications"]
    assert [row["score"]["modes"] for row in rows] == [2, 1, 2]
    assert [row["success"] for row in rows][::2] == [True, True]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--modes", "3"], "2 modes stand out of the noise, fewer than the 3 asked for"),
        (["--modes", "none"], "'none' is not a whole number from 1"),
        (["--modes", "900"], "modes=900, and these 150 lines hold 74 at most"),
        (["--dofs", "low,top"], "'top' is no sensor; the sensors are low, middle, high"),
        (["--dofs", "low,low"], "named twice"),
        (["--dofs", "low,,high"], "is no list of sensors"),
        (["--modes", "1", "--dofs", "low,high"], "modes=1, and 2 sensors are named"),
        (["--modes", "2", "--strategy", "swarm"], "of the strategy 'modal', and 'swarm' is asked for"),
        (["--modes", "2", "--lumped", "--mass", "7.5"], "modes=2; with this mass there are 3"),
        (["--mass", "7.5", "--set", "mass=3"], "parameter 'mass' is set twice"),
    ],
)
def test_a_mistake_is_one_line_with_status_2(folder, file, beside_progress, arguments, told):
    assert cli.main(["run", file, *arguments, "--out", "out", "--quiet"]) == 2
    line = beside_progress()[1].strip()
    assert told in line and "\n" not in line
    assert not (folder / "out" / "result.h5").exists()


def test_methods_side_by_side_ask_the_modal_one_for_so_many(folder, file, capsys):
    common = ["recorded_test", "--data", file, "--max-time", "0.3", "--json"]
    assert cli.main(["compare", *common, "--dofs", "top"]) == 2
    capsys.readouterr()
    cli.main(["compare", *common, "--modes", "1"])
    methods = json.loads(capsys.readouterr().out)["comparison"]["methods"]
    (modal,) = [one for one in methods if one["method"] == "modal"]
    assert modal["residual"] > 0.05  # of 1 % noise


def test_an_unfinished_search_is_of_so_many_modes():
    recipe = sysid.Recipe("recorded_test", "test.h5", modes=3, sensors=("a", "b"))
    search = RunRequest(recipe, "auto", 0)
    assert RunRequest.from_tree(search.to_tree()) == search
    assert search != RunRequest(sysid.Recipe("recorded_test", "test.h5"), "auto", 0)
    assert recipe.strategy("auto") == sysid.Modal(("a", "b"), modes=3)
    assert recipe.title == "test.h5, 3 modes, on a, b"
