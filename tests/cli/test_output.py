"""Output of commands: one JSON document with ``--json``, nothing with ``--quiet``; and what ``sysid doctor`` finds."""

import importlib.metadata
import json
import os
import re
import sys

import matplotlib
import numpy as np
import pytest

import sysid
from sysid.cli import doctor
from sysid.cli import main as cli
from sysid.errors import how_to_install

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


@pytest.fixture
def document(capsys):
    """Give a function that runs a command with --json and returns its status, its document, and standard error."""

    def run(*words):
        status = cli.main([*map(str, words), "--json"])
        out, error = capsys.readouterr()
        told = json.loads(out, parse_constant=pytest.fail)
        assert told["status"] == status
        assert all(os.path.exists(path) for path in told["files"])  # noqa: PTH110
        return status, told, error

    return run


@pytest.fixture
def pair(here, no_pictures, capsys):
    """The folder of a result."""
    assert cli.main(["run", "pair.py", "--quiet"]) == 0
    return here / "results/pair"


def test_a_run_as_a_document_is_the_summary_with_its_files(here, document, no_pictures):
    status, told, error = document("run", "pair.py")
    assert status == 0
    assert told["result"] == json.loads((here / "results/pair/summary.json").read_text())
    assert told["files"] == [f"results/pair/{name}" for name in ("result.h5", "summary.json", "report.html")]
    assert "error" not in told
    assert " iteration " in error


def test_nothing_that_is_printed_beside_it_gets_into_the_document(here, process, without_pictures):
    (here / "pair.py").write_text("import os\nprint('of Python')\nos.write(1, b'of C')\n" + without_pictures)
    done = process("run", "pair.py", "--json", cwd=here)
    assert json.loads(done.stdout)["result"]["success"] is True
    assert b"of Python" in done.stderr and b"of C" in done.stderr


def test_every_command_that_tells_has_a_document(pair, document):
    _, told, _ = document("list")
    assert "shear_building" in [one["name"] for one in told["problems"]]
    _, told, _ = document("show", "shear_building")
    # Three shares of the stated total, three springs and two numbers of the damping; one sum of shares is open.
    assert (told["unknowns"], told["rank"], told["directions"]) == (8, 7, 8)
    assert {one["name"] for one in told["variables"] if one["unseen"]} == {"mass share"}
    assert document("new", "mine")[1]["files"] == ["mine.py", "test_mine.py"]
    assert document("report", pair)[1]["files"] == [str(pair / "report.html")]
    _, told, _ = document("export", pair, "pair.csv")
    assert told["files"] == ["pair.csv"] and told["precision"].startswith("exact")


@pytest.mark.parametrize("words", [["run", "nowhere.py"], ["rum"], ["run", "pair.py", "--seed", "x"]])
def test_a_mistake_is_in_the_document_too(here, document, words):
    status, told, error = document(*words)
    assert status == 2
    assert error == f"sysid: {told['error']}\n"


def test_other_ends_and_warnings_are_in_the_document(here, document, monkeypatch, module, no_pictures):
    (here / "pair.py").write_text(module.replace("noise=0.0", "noise=0.05"))
    status, told, _ = document("run", "pair.py")
    assert status == 1 and told["result"]["success"] is False

    def identify(*arguments, **options):
        raise RuntimeError("a bug")

    monkeypatch.setattr(cli, "identify", identify)
    status, told, _ = document("run", "pair.py")
    assert status == 70 and "RuntimeError: a bug" in told["error"]


def test_quiet_says_nothing_but_mistakes(here, capsys, no_pictures):
    assert cli.main(["run", "pair.py", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert sysid.load(here / "results/pair").success
    assert cli.main(["run", "nowhere.py", "--quiet"]) == 2
    out, error = capsys.readouterr()
    assert out == "" and error.startswith("sysid: ") and error.count("\n") == 1
    assert cli.main(["run", "pair.py", "--quiet", "--json"]) == 0
    out, error = capsys.readouterr()
    assert json.loads(out)["status"] == 0 and error == ""


def test_doctor_finds_what_is_here(document, capsys):
    status, told, _ = document("doctor")
    assert status == 0
    assert "mumps" in told["linear_solvers"]
    versions = {one["name"]: one["version"] for one in told["packages"]}
    assert versions["numpy"] == np.__version__
    assert cli.main(["doctor"]) == 0
    words = capsys.readouterr().out
    assert re.search(rf"^  numpy +{re.escape(np.__version__)}$", words, re.MULTILINE)
    assert re.search("^IPOPT works .* found: (.*)$", words, re.MULTILINE)[1].split(", ") == told["linear_solvers"]
    assert repr(matplotlib.get_backend().lower()) in words.lower()


def test_doctor_tells_what_is_missing_with_the_command_that_installs_it(capsys, monkeypatch):
    stated = ["numpy>=1.26", "nowhere>=2; extra == 'uff'", 'scipy>=99.1.2 ; extra == "control"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: stated)
    monkeypatch.setattr(doctor, "linear_solvers", lambda: ["mumps"])
    assert cli.main(["doctor"]) == 0
    extras = {line.split()[0]: line for line in capsys.readouterr().out.partition("\nextras\n")[2].splitlines()}
    assert extras["uff"].split()[1:3] == ["nowhere", "missing:"] and extras["uff"].endswith(how_to_install("uff"))
    assert "scipy" in extras["control"] and "99.1.2" in extras["control"]
    assert extras["control"].endswith(how_to_install("control"))
    stated.append("scipy>=99")
    assert cli.main(["doctor"]) == 2
    assert capsys.readouterr().err == (
        "sysid: these packages are missing or too old: python -m pip install 'scipy>=99'\n"
    )
    stated.pop()
    monkeypatch.setattr(doctor, "linear_solvers", list)
    assert cli.main(["doctor"]) == 2
    assert "casadi" in capsys.readouterr().err


def test_doctor_says_where_it_cannot_know_what_is_needed(capsys, monkeypatch):
    def requires(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", requires)
    monkeypatch.setattr(doctor, "linear_solvers", lambda: ["mumps"])
    assert cli.main(["doctor"]) == 0
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "package", "extra"),
    [
        (["export", "RESULT", "m.op4"], "pyyeti", "nastran"),
        (["read", "shake.unv"], "pyuff", "uff"),
        (["refine", "RESULT", "--trust", "--scheduler", "tcp://host:8786"], "distributed", "dask"),
    ],
)
def test_a_missing_extra_is_one_line_with_the_command_that_installs_it(
    here, complaint, pair, monkeypatch, words, package, extra
):
    (here / "shake.unv").write_text("    -1\n    58\n    -1\n")
    monkeypatch.setitem(sys.modules, package, None)
    assert cli.main([str(pair) if word == "RESULT" else word for word in words]) == 2
    assert complaint().endswith(f"needs the package {package}: python -m pip install 'structural-sysid[{extra}]'\n")


def test_quiet_tells_a_run_without_a_fit_in_one_line(here, capsys, no_pictures, module):
    (here / "pair.py").write_text(module.replace("goal=1e-6", "goal=1e-30"))
    assert cli.main(["run", "pair.py", "--quiet"]) == 1
    out, error = capsys.readouterr()
    assert out == "" and error.count("\n") == 1 and "no fit" in error


def test_show_prints_the_summary_of_a_result_and_the_channels_of_a_test(here, finished, capsys, document):
    result, file = sysid.load(finished), finished / "result.h5"
    assert cli.main(["show", str(file)]) == 0
    assert capsys.readouterr().out == f"{result.summary()}\n"
    assert cli.main(["show", str(finished)]) == 0
    assert capsys.readouterr().out == f"{result.summary()}\n"
    assert document("show", file)[1]["result"]["residual"] == pytest.approx(result.residual)
    assert document("show", file, "--set", "floors=3")[0] == 2
    columns = np.column_stack([np.arange(200) / 50, np.random.default_rng(0).standard_normal((200, 2))])
    np.savetxt(here / "run.csv", columns, delimiter=",", header="time [s],base [m/s²],top [m/s²]", comments="")
    sensors = ("--sensor", "base", "role=base", "axis=x", "--sensor", "top", "role=response", "axis=x")
    read = document("read", "run.csv", *sensors, "--out", "test.h5")[1]
    assert document("show", "test.h5")[1]["channels"] == read["channels"]


def test_a_run_says_that_it_replaces_the_result_of_another_strategy(here, capsys, no_pictures):
    assert cli.main(["run", "pair.py"]) == 0
    assert "replaces" not in capsys.readouterr().out
    summary = here / "results/pair/summary.json"
    summary.write_text(json.dumps({**json.loads(summary.read_text()), "strategy": "swarm"}))
    assert cli.main(["run", "pair.py"]) == 0
    assert "replaces the result of strategy swarm" in capsys.readouterr().out
