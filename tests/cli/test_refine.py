"""``sysid refine``: the distinct minima of many starts, told, written, and gone on with."""

import csv
import os
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.cli import main as cli
from sysid.cli import refine
from sysid.cli.output import Output
from sysid.jobs import JobResult
from sysid.report import report

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "refinement_jobs.md"
PNG = b"\x89PNG"


FLOORS = """'Springs of two floors{more}.'
import casadi as ca
import numpy as np

import sysid


def problem(*, data=None, rng=0):
    stretch = np.array([[1.0, 0, -1], [-1, 1, 0]])
    M, C = np.diag([300.0, 200.0, 0.0]), stretch.T @ np.diag([900.0, 700.0]) @ stretch
    truth = sysid.Structure(M, stretch.T @ np.diag([3e5, 2e5]) @ stretch, damping_matrix=C[:2, :2], n_base=1)
    test = sysid.simulate(truth, np.linspace(0.5, 10, 60), noise={noise}, rng=7)
    k = {springs}
    return sysid.Problem(test, mass=M, stiffness=stretch.T @ ca.diag(k) @ stretch, damping=C)
"""


SPRINGS = 'sysid.Variable("spring", 2, lower=1e4, upper=1e6, log=True)'
ALIKE = 'ca.repmat(sysid.Variable("spring", lower=1e4, upper=1e6, log=True), 2, 1)'


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A folder with results of two springs, exact and of noisy records, and a module that takes both for one."""
    folder = tmp_path_factory.mktemp("refine")
    (folder / "exact.py").write_text(FLOORS.format(more="", springs=SPRINGS, noise=0.0))
    (folder / "two.py").write_text(FLOORS.format(more="", springs=SPRINGS, noise=0.02))
    (folder / "one.py").write_text(FLOORS.format(more=", alike", springs=ALIKE, noise=0.02))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(report, "render", lambda result: "report")
        assert cli.main(["run", "exact.py"]) == 0
        assert cli.main(["run", "two.py"]) == 0
    return folder


@pytest.fixture(autouse=True)
def inside(here, monkeypatch):
    monkeypatch.chdir(here)


@pytest.fixture
def floors():
    return Path("results/two")


def test_a_line_a_start_then_the_minima_a_table_and_a_picture(floors, capsys):
    assert cli.main(["refine", str(floors), "--trust", "--starts", "3", "--workers", "1"]) == 0
    out, error = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0] == "two.py: 3 starts, the first at the result"
    assert [line.split()[:5] for line in error.splitlines()] == [
        [str(i + 1), "of", "3", "start", str(i)] for i in range(3)
    ]
    folder = floors / "refine"
    assert lines[-3:] == [str(folder / name) for name in ("starts.csv", "minima.png", "jobs.sqlite")]
    rows = list(csv.DictReader((folder / "starts.csv").read_text().splitlines()))
    assert [row["start"] for row in rows] == ["0", "1", "2"]
    reached = sum(int(line.split()[2]) for line in lines if line[:7].strip().isdigit() and "of" not in line)
    assert reached == 3
    assert (folder / "minima.png").read_bytes().startswith(PNG)
    # Once more, with one start more: what is there is told at once.
    assert cli.main(["refine", str(floors / "result.h5"), "--trust", "--starts", "4", "--workers", "1"]) == 0
    again = list(csv.DictReader((folder / "starts.csv").read_text().splitlines()))
    assert again[:3] == rows and len(again) == 4


def test_draws_of_noise_are_told_beside_the_linear_deviations(capsys, tmp_path, no_pictures):
    assert cli.main(["run", "shear_building", "--set", "noise=0.02", "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    assert cli.main(["refine", str(tmp_path), "--draws", "4", "--workers", "1"]) == 0
    out, error = capsys.readouterr()
    assert len(error.splitlines()) == 4
    lines = out.splitlines()
    assert lines[0] == "shear_building (noise=0.02): 4 draws of noise, each fitted from the result"
    assert lines[2].split() == ["value", "linear", "std", "draws", "std", "ratio", "within,", "%"]
    assert lines[3].startswith("mode 1: frequency, Hz")
    folder = tmp_path / "refine"
    assert lines[-4:] == [str(folder / name) for name in ("draws.csv", "spreads.csv", "draws.png", "jobs.sqlite")]
    rows = list(csv.DictReader((folder / "spreads.csv").read_text().splitlines()))
    assert [row["quantity"] for row in rows[6:9]] == ["spring 1", "spring 2", "spring 3"]
    assert all(0 < float(row["draws_std"]) < 4 * float(row["linear_std"]) for row in rows)
    assert len((folder / "draws.csv").read_text().splitlines()) == 5
    assert (folder / "draws.png").read_bytes().startswith(PNG)


def test_identifications_without_each_sensor_are_told_beside_the_result(floors, capsys):
    assert cli.main(["refine", str(floors), "--trust", "--leave-out", "sensor", "--workers", "1"]) == 0
    out, error = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0] == "two.py: 2 identifications, each without one sensor"
    assert [line.split()[4:6] for line in error.splitlines()] == [["sensor", "1"], ["sensor", "2"]]
    assert lines[2].split() == ["a", "fit", "determined", "residual", "predicted", "farthest"]
    assert [line.split()[0] for line in lines[3:6]] == ["two.py", "without", "without"]
    files = ("without_sensor.csv", "without_sensor_moves.csv", "without_sensor.png", "jobs.sqlite")
    assert lines[-4:] == [str(floors / "refine" / name) for name in files]
    rows = list(csv.DictReader((floors / "refine" / "without_sensor_moves.csv").read_text().splitlines()))
    assert [row["quantity"] for row in rows[:2]] == ["spring 1", "spring 2"] and len(rows) == 12
    assert all(abs(float(row["step_in_std"])) < 5 for row in rows)
    assert (floors / "refine" / "without_sensor.png").read_bytes().startswith(PNG)


def test_a_band_without_lines_is_a_line_without_a_result(floors, capsys):
    assert cli.main(["refine", str(floors), "--module", "two.py", "--bands", "0.5-8", "20-30", "--workers", "1"]) == 0
    out, error = capsys.readouterr()
    (cells,) = [re.split("  +", line) for line in error.splitlines() if "20 to 30 Hz" in line]
    assert cells[-2] == "no result" and {"20", "30"} <= set(cells[-1].split())  # and why
    assert "predicted:" in out
    rows = list(csv.DictReader((floors / "refine" / "bands.csv").read_text().splitlines()))
    assert [(row["identification"], row["success"]) for row in rows] == [
        ("two.py", "True"), ("0.5 to 8 Hz", "True"), ("20 to 30 Hz", "False"),
    ]  # fmt: skip


def test_a_model_that_is_too_simple_loses_by_aic_and_bic(floors, capsys):
    assert cli.main(["refine", str(floors), "--trust", "--variants", "one.py", "--workers", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split() for line in lines if line.startswith(("two.py ", "one.py "))}
    assert rows["two.py"][4:7] == ["3", "0.0", "0.0"]
    assert rows["one.py"][4] == "2" and min(map(float, rows["one.py"][5:7])) > 100


def test_draws_without_a_spread_leave_no_picture_of_earlier_ones(floors, capsys, tmp_path):
    for name in ("spreads.csv", "draws.png"):
        (tmp_path / name).write_text("of earlier draws")
    result = sysid.load(floors)
    ends = [JobResult(0, 0, True, "", result.x, 0.02), JobResult(1, 0, False, "lost", result.x[:0], np.nan)]
    refine.report_draws(tmp_path, result, result.recipe, ends, Output())
    assert "1 of 2 draws" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["draws.csv"]


def test_a_module_that_a_result_names_runs_where_the_user_names_or_trusts_it(floors, capsys, tmp_path, monkeypatch):
    (tmp_path / "two.py").write_text("raise SystemExit('it ran')\n")
    result = str(floors.absolute())
    monkeypatch.chdir(tmp_path)
    assert cli.main(["refine", result]) == 2
    error = capsys.readouterr().err
    assert f" {tmp_path / 'two.py'}, " in error
    assert "--trust" in error and "--module FILE.py" in error and error.count("\n") == 1
    assert cli.main(["refine", result, "--module", "two.py"]) == 2
    assert "two.py, line 1: SystemExit: it ran" in capsys.readouterr().err


def test_a_module_that_gives_other_records_than_the_results_is_told(floors, capsys):
    module = Path("two.py")
    text = module.read_text()
    module.write_text(text.replace("noise=0.02", "noise=0.04"))
    try:
        for kind in (["--starts", "2"], ["--draws", "2"], ["--leave-out", "sensor"]):
            assert cli.main(["refine", str(floors), "--trust", *kind]) == 2
            out, error = capsys.readouterr()
            assert out == "" and error.count("\n") == 1
            assert "two.py" in error and "'sysid run'" in error
    finally:
        module.write_text(text)


def test_more_modes_than_stand_out_are_told_in_one_line(capsys, tmp_path, no_pictures):
    assert (
        cli.main(["run", "cantilever_tower", "--set", "force=False", "--set", "elements=2", "--out", str(tmp_path)])
        == 0
    )
    capsys.readouterr()
    assert cli.main(["refine", str(tmp_path), "--orders", "3-30", "--workers", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(": 2 identifications, each of so many modes: no more than 4 stand out of the noise")
    rows = {line[:7]: line for line in lines if line.startswith(("3 modes", "4 modes"))}
    assert "  no  " in rows["3 modes"] and "  yes  " in rows["4 modes"]
    assert not any("one motion" in line for line in lines)  # of sensors that three modes do not tell apart
    assert cli.main(["refine", str(tmp_path), "--orders", "5-6", "--workers", "1"]) == 2
    assert capsys.readouterr().err == "sysid: 4 modes stand out of the noise, fewer than the 5 asked for\n"


@pytest.mark.parametrize("last", ["distinct", "write_files"])
def test_ctrl_c_while_saving_tells_where_the_results_are(last, floors, capsys, tmp_path, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    command = ["refine", str(floors), "--trust", "--starts", "1", "--workers", "1", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(f"sysid.cli.refine.{last}", interrupt)
        assert cli.main(command) == 130
    told = f"results are in {tmp_path / 'jobs.sqlite'}: the same command writes the files\n"
    assert capsys.readouterr().err.endswith(f"\nsysid: interrupted while saving; {told}")
    assert cli.main(command) == 0
    assert (tmp_path / "starts.csv").is_file()


AT_WORK = """

import multiprocessing
import os
import time

if multiprocessing.parent_process():
    os.write(1, b"at work\\n")  # whole: another worker writes beside it
    time.sleep(60)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("place", ["imports", "jobs"])
def test_ctrl_c_of_a_terminal_is_one_line_whatever_the_workers_are_at(place, floors, tmp_path, interruptible):
    """It reaches all processes at once: as soon as the first has been started, or when one has taken a job."""
    (tmp_path / "two.py").write_text(Path("two.py").read_text() + AT_WORK)
    options = ["--module", "two.py", "--workers", "2", "--out", "refine"]
    command = ["-u", "-m", "sysid", "refine", str(floors.absolute()), *options]
    with interruptible(*command, cwd=tmp_path, start_new_session=True) as running:
        assert running.stdout.readline() == "two.py: 16 starts, the first at the result\n"
        if place == "jobs":
            assert running.stdout.readline() == "at work\n"
        else:
            time.sleep(0.2)
        os.killpg(running.pid, signal.SIGINT)
        out, error = running.communicate(timeout=30)
    assert error == "sysid: interrupted after 0 of 16 jobs; the same command goes on from there\n"
    assert running.returncode == 130
    assert [line for line in out.splitlines() if line != "at work"] == [str(Path("refine/jobs.sqlite"))]
    assert [path.name for path in (tmp_path / "refine").iterdir()] == ["jobs.sqlite"]


def test_without_noise_there_is_nothing_to_draw(capsys):
    assert cli.main(["refine", "results/exact", "--trust", "--draws", "3"]) == 2
    out, error = capsys.readouterr()
    assert out == "" and "results/exact" in error
    assert not Path("results/exact/refine/draws.csv").exists()


@pytest.mark.skipif(not PAGE.exists(), reason="no docs beside the tests")
def test_the_example_of_its_page_refines_that_result(floors):
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[:1]
    (named,) = re.findall(r'sysid.load\("results/(\w+)"\)', example)
    names = {"sysid": sysid}
    exec(example.replace(f"results/{named}", str(floors)), names)
    assert [end.index for end in names["ends"]] == [0, 1, 2, 3]
    assert names["ends"][0].residual <= max(names["result"].residual, 1e-12) * (1 + 1e-6)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "no result at nowhere"),
        (["results/exact", "--starts", "0"], "not a whole number from 1"),
        (["results/exact", "--starts", "2", "--draws", "2"], "--draws: not allowed with argument --starts"),
        (["results/exact", "--leave-out", "run"], "the test has one run; without it nothing is left"),
        (["results/exact", "--bands", "5-1"], "'5-1' is no band: write its ends in Hz, such as 0.5-20"),
        (["results/exact", "--variants", "known_masses"], "known_masses has other records than"),
        (["results/exact", "--bands", "100-200"], "no line between 100 and 200 Hz"),
        (["results/exact", "--orders", "2-4"], "open only where mass and stiffness are free"),
        (["results/exact", "--draws", "1"], "not a whole number from 2"),
        (["results/exact", "--workers", "2", "--scheduler", "tcp://host:1"], "exclude each other"),
        (["results/exact", "--out", "results/exact/result.h5"], "is not a folder"),
    ],
)
def test_mistakes_are_one_line(arguments, told, capsys):
    assert cli.main(["refine", "--trust", *arguments]) == 2
    out, error = capsys.readouterr()
    assert out == "" and told in error and error.count("\n") == 1


def test_no_scheduler_is_told(capsys):
    pytest.importorskip("distributed", reason="needs the extra 'dask'")
    assert cli.main(["refine", "results/exact", "--trust", "--scheduler", "nonsense://here"]) == 2
    assert "no Dask scheduler answers at nonsense://here" in capsys.readouterr().err
