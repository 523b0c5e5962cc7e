"""``sysid compare``: what it shows and writes, and how it can end."""

import json
from pathlib import Path

import pytest

from sysid.cli import main as cli
from sysid.compare import comparison, peers
from sysid.errors import how_to_install

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MODULE = Path(__file__).with_name("pair_problem.py").read_text()
PNG = b"\x89PNG"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in an empty folder with one module, without the extra."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(peers, "missing_packages", lambda: ["cma"])
    (tmp_path / "pair.py").write_text(MODULE)
    return tmp_path


def files(folder):
    return {path.name for path in folder.iterdir()}


def test_a_line_a_method_then_one_table_and_one_picture(here, capsys):
    assert cli.main(["compare", "pair.py"]) == 0
    out, error = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].startswith("pair.py: ")
    assert how_to_install("benchmark") in lines[1]
    assert "no reference" in lines[2]
    assert [line.partition(":")[0] for line in error.splitlines()] == ["modal", "continuation", "swarm", "hpso-ls"]
    assert lines[4].split() == ["method", "before", "after", "evaluations", "seconds", "status"]
    assert out.endswith("results/pair/comparison.png\n\n") or out.endswith("results/pair/comparison.png\n")
    assert files(here / "results/pair") == {"comparison.png"}
    assert (here / "results/pair/comparison.png").read_bytes().startswith(PNG)


def test_a_folder_takes_the_rows_too(here, capsys):
    (here / "pair.py").write_text(MODULE.replace("rng=0)", "rng=0, goal=1e-6)").replace("goal=1e-6,", "goal=goal,"))
    assert (
        cli.main(["compare", "pair.py", "--out", "side", "--seed", "2", "--set", "goal=1e-30", "--max-time", "1"]) == 1
    )
    assert files(here / "side") == {"comparison.png", "comparison.csv", "comparison.json"}
    told = json.loads((here / "side/comparison.json").read_text(), parse_constant=pytest.fail)
    assert (told["problem"], told["parameters"], told["seed"]) == ("pair.py", {"goal": 1e-30}, 2)
    assert [row["status"] for row in told["methods"]] == ["no fit", "does not apply", "no fit", "no fit"]
    assert "pair.py (goal=1e-30)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "problem 'nowhere' is unknown"),
        (["pair.py", "--max-time", "0"], "not a positive number"),
        (["pair.py", "--set", "goal=1"], "parameters of this module: none"),
        (["pair.py", "--out", "pair.py"], "not a folder"),
        (["known.py"], "known entries of a FullMass"),
    ],
)
def test_a_mistake_is_one_line(here, capsys, arguments, told):
    known = MODULE.replace('FullMass(3.5, healing="rigid_body"', "FullMass(3.5, known=[[2.0, np.nan]] + [[np.nan] * 2]")
    (here / "known.py").write_text(
        known.replace("goal=", "damping=sysid.ProportionalDamping((0.0, 5.0), (0.0, 1e-3)), goal=")
    )
    assert cli.main(["compare", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert told in error
    assert files(here) == {"pair.py", "known.py"}


def test_ctrl_c_shows_the_table_of_what_is_finished(here, capsys, monkeypatch):
    real = comparison.identify

    def identify(problem, *, strategy, **options):
        if strategy.name == "swarm":
            raise KeyboardInterrupt
        return real(problem, strategy=strategy, **options)

    monkeypatch.setattr(comparison, "identify", identify)
    assert cli.main(["compare", "pair.py", "--out", "side"]) == 130
    out, error = capsys.readouterr()
    assert error.splitlines()[-1].startswith("sysid: interrupted")
    assert "modal " in out
    assert files(here / "side") == {"comparison.png", "comparison.csv", "comparison.json"}
