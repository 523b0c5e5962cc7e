"""``--set KEY=VALUE``: parameters of a problem module reach it and the stored result; mistakes are one line each."""

import io
import json

import pytest

import sysid
from sysid import catalogue
from sysid.cli import main as cli
from sysid.cli.output import Output
from sysid.results.identification import Recipe

MODULE = '''"""One mass on a spring."""

import numpy as np

import sysid


def problem(*, data=None, rng=0, mass=2.0, name="mast", noise=0.0, lines=(1.0, 20.0)):
    k = 4e3 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    truth = sysid.Structure(np.diag([mass, 0.5]), k, [0.01], n_base=1)
    sensors = [sysid.Sensor(name, (0, 0, 1), "x")]
    truth = sysid.Structure(np.diag([mass, 0.5]), k, [0.01], n_base=1, sensors=sensors)
    test = sysid.simulate(truth, np.linspace(*lines, 60), noise=noise, rng=rng)
    return sysid.Problem(test, mass=sysid.LumpedMass(mass), reference=truth)
'''


@pytest.mark.parametrize(
    ("said", "title"),
    [
        ({}, "a.h5"),
        ({"lumped": True, "mass": 103.0}, "a.h5, lumped mass, 103 kg stated"),
        (
            {"estimator": "h1", "mass": [103.0, 98.5], "band": (0.5, 40.0), "goal": 0.05},
            "a.h5, estimator='h1', 103 and 98.5 kg stated, 0.5-40 Hz, goal 0.05",
        ),
    ],
)
def test_a_test_read_from_files_is_called_by_its_file_and_what_was_said_of_it(said, title):
    assert Recipe("recorded_test", "folder/a.h5", 0, said).title == title


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in an empty folder with one module."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mast.py").write_text(MODULE)
    return tmp_path


def test_values_are_python_where_they_can_be_read_as_such_and_else_texts(here):
    settings = ["mass=3", "name=tip of the mast = x", "lines=(2, 1e1)", "noise=0.01", "rng=7"]
    command = ["run", "mast.py", *(part for setting in settings for part in ("--set", setting))]
    recipe = cli.requests.recipe_of(cli.command_parser().parse_args(command), Output())
    assert recipe == Recipe(
        "mast.py", None, 7, {"mass": 3, "name": "tip of the mast = x", "lines": (2, 10.0), "noise": 0.01}
    )
    problem = catalogue.build(recipe)
    assert problem.measurement.sensor_names == ("tip of the mast = x",)
    assert problem.measurement.freq[[0, -1]].tolist() == [2.0, 10.0]
    assert problem.totals.tolist() == [3.0]


def test_a_result_keeps_the_parameters_it_was_made_with(here, capsys, no_pictures):
    assert cli.main(["run", "mast.py", "--set", "mass=3.5", "--set", "name=tip", "--set", "lines=[2, 10]"]) == 0
    assert "mast.py (mass=3.5, name='tip', lines=[2, 10]): 1 sensors" in capsys.readouterr().out
    recipe = sysid.load("results/mast").recipe
    assert recipe.parameters == {"mass": 3.5, "name": "tip", "lines": [2, 10]}
    assert catalogue.build(recipe).totals.tolist() == [3.5]
    assert json.loads((here / "results/mast/summary.json").read_text())["parameters"] == recipe.parameters


def test_equal_recipes_have_one_hash_and_come_back_from_their_tree():
    one, other = Recipe("mast", parameters={"a": [1], "b": "x"}), Recipe("mast", parameters={"b": "x", "a": [1]})
    assert one == other
    assert hash(one) == hash(other)
    assert len({one, other, Recipe("mast", parameters={"a": [2], "b": "x"})}) == 2
    assert Recipe.from_tree(one.to_tree()) == one
    assert len({Recipe("mast", parameters={"a": value}) for value in (1, 1.0, True)}) == 3


def test_a_whole_number_given_as_a_float_is_a_seed_that_comes_back():
    assert Recipe.from_tree(Recipe("mast", rng=4.0).to_tree()).rng == 4


@pytest.mark.parametrize("value", [1j, b"x", {1, 2}, float("nan"), io, [float("inf")]])
def test_a_recipe_takes_plain_values_alone(value):
    with pytest.raises(sysid.InputError, match="parameter a = .* give a number"):
        Recipe("mast", parameters={"a": value})
    with pytest.raises(sysid.InputError, match="'rng' is a field"):
        Recipe("mast", parameters={"rng": 3})


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--set", "mas=3"], "'mas'"),
        (["--set", "mass"], "--set 'mass' is not KEY=VALUE"),
        (["--set", "=3"], "--set '=3' is not KEY=VALUE"),
        (["--set", "tip mass=3"], "is not KEY=VALUE"),
        (["--set", "mass=3", "--set", "mass=4"], "'mass' is set twice"),
        (["--data", ".", "--set", "data=."], "'data' is set twice"),
        (["--set", "rng=1.5"], "rng = 1.5 is not"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_parameters(here, capsys, arguments, told):
    for command in ("run", "show", "compare"):
        assert cli.main([command, "mast.py", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert told in error
        for name in ("mass=2.0", "name='mast'", "noise=0.0", "lines=(1.0, 20.0)"):
            assert name in error
    assert {path.name for path in here.iterdir()} == {"mast.py"}


def test_the_seed_of_the_noise_is_set_once(here, capsys):
    assert cli.main(["show", "mast.py", "--seed", "1", "--set", "rng=1"]) == 2
    error = capsys.readouterr().err
    assert "'rng'" in error and "twice" in error
    assert cli.main(["show", "mast.py", "--set", "rng=1", "--set", "noise=0.1"]) == 0


def test_a_parameter_without_a_default_has_to_be_set(here, capsys):
    (here / "mast.py").write_text(MODULE.replace("mass=2.0", "mass"))
    assert cli.main(["show", "mast.py"]) == 2
    assert "'mass'" in capsys.readouterr().err
    assert cli.main(["show", "mast.py", "--set", "mass=2.5"]) == 0
