"""``sysid refine``: the distinct minima of many starts, told, written, and gone on with."""

import csv
import re
from pathlib import Path

import pytest

import sysid
from sysid.cli import main as cli

README = Path(__file__).resolve().parents[2] / "README.md"
PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A folder with a result of two springs that a chain of known masses hides well."""
    folder = tmp_path_factory.mktemp("refine")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert cli.main(["run", "physical_damping"]) == 0
    return folder


@pytest.fixture(autouse=True)
def inside(here, monkeypatch):
    monkeypatch.chdir(here)


def test_a_line_a_start_then_the_minima_a_table_and_a_picture(capsys):
    assert cli.main(["refine", "results/physical_damping", "--starts", "3", "--workers", "1"]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    lines = out.splitlines()
    assert lines[0] == "physical_damping: 3 starts, the first at the result"
    assert [line.split()[:5] for line in lines[1:4]] == [[str(i + 1), "of", "3", "start", str(i)] for i in range(3)]
    folder = Path("results/physical_damping/refine")
    assert lines[-3:] == [str(folder / name) for name in ("starts.csv", "minima.png", "jobs.sqlite")]
    rows = list(csv.DictReader((folder / "starts.csv").read_text().splitlines()))
    assert [row["start"] for row in rows] == ["0", "1", "2"]
    reached = sum(int(line.split()[2]) for line in lines if line[:7].strip().isdigit() and "of" not in line)
    assert reached == 3
    assert (folder / "minima.png").read_bytes().startswith(PNG)
    # Once more, with one start more: what is there is told at once.
    assert cli.main(["refine", "results/physical_damping/result.h5", "--starts", "4", "--workers", "1"]) == 0
    again = list(csv.DictReader((folder / "starts.csv").read_text().splitlines()))
    assert again[:3] == rows and len(again) == 4


def test_draws_of_noise_are_told_beside_the_linear_deviations(capsys, tmp_path):
    assert cli.main(["run", "shear_building", "--set", "noise=0.02", "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    assert cli.main(["refine", str(tmp_path), "--draws", "4", "--workers", "1"]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    lines = out.splitlines()
    assert lines[0] == "shear_building (noise=0.02): 4 draws of noise, each fitted from the result"
    assert lines[6].split() == ["value", "linear", "std", "draws", "std", "ratio", "within,", "%"]
    assert lines[7].startswith("mode 1: frequency, Hz")
    folder = tmp_path / "refine"
    assert lines[-4:] == [str(folder / name) for name in ("draws.csv", "spreads.csv", "draws.png", "jobs.sqlite")]
    rows = list(csv.DictReader((folder / "spreads.csv").read_text().splitlines()))
    assert [row["quantity"] for row in rows[6:9]] == ["spring 1", "spring 2", "spring 3"]
    assert all(0 < float(row["draws_std"]) < 4 * float(row["linear_std"]) for row in rows)
    assert len((folder / "draws.csv").read_text().splitlines()) == 5
    assert (folder / "draws.png").read_bytes().startswith(PNG)


def test_one_draw_has_no_spread_and_is_written(capsys, tmp_path):
    assert cli.main(["run", "shear_building", "--set", "noise=0.02", "--out", str(tmp_path)]) == 0
    assert cli.main(["refine", str(tmp_path), "--draws", "1", "--workers", "1"]) == 0
    assert "1 of 1 draws ended in a fit; two are needed for a spread" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "refine").iterdir()) == ["draws.csv", "jobs.sqlite"]


@pytest.mark.parametrize("last", ["distinct", "write_files"])
def test_ctrl_c_while_saving_tells_where_the_results_are(last, capsys, tmp_path, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    command = ["refine", "results/physical_damping", "--starts", "1", "--workers", "1", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(f"sysid.cli.refine.{last}", interrupt)
        assert cli.main(command) == 130
    told = f"results are in {tmp_path / 'jobs.sqlite'}: the same command writes the files\n"
    assert capsys.readouterr().err == f"sysid: interrupted while saving; {told}"
    assert cli.main(command) == 0
    assert (tmp_path / "starts.csv").is_file()


def test_without_noise_there_is_nothing_to_draw(capsys):
    assert cli.main(["refine", "results/physical_damping", "--draws", "3"]) == 2
    assert "fits its records exactly: without noise there is nothing to draw" in capsys.readouterr().err


@pytest.mark.skipif(not README.exists(), reason="no README beside the tests")
def test_the_example_of_the_readme_refines_that_result():
    names = {"sysid": sysid}
    exec(re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)[0], names)
    assert [end.index for end in names["ends"]] == [0, 1, 2, 3]
    assert names["ends"][0].residual <= max(names["result"].residual, 1e-12) * (1 + 1e-6)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "no result at nowhere"),
        (["results/physical_damping", "--starts", "0"], "not a whole number from 1"),
        (["results/physical_damping", "--starts", "2", "--draws", "2"], "--starts and --draws exclude each other"),
        (["results/physical_damping", "--workers", "2", "--scheduler", "tcp://host:1"], "exclude each other"),
        (["results/physical_damping", "--out", "results/physical_damping/result.h5"], "is not a folder"),
    ],
)
def test_mistakes_are_one_line(arguments, told, capsys):
    assert cli.main(["refine", *arguments]) == 2
    out, error = capsys.readouterr()
    assert out == "" and told in error and error.count("\n") == 1


def test_no_scheduler_is_told(capsys):
    pytest.importorskip("distributed", reason="needs the extra 'dask'")
    assert cli.main(["refine", "results/physical_damping", "--scheduler", "nonsense://here"]) == 2
    assert "no Dask scheduler answers at nonsense://here" in capsys.readouterr().err
