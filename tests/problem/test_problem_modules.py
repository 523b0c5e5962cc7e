"""A problem module must use every variable that it declares; its mistakes are told with the line of the declaration."""

import pytest

import sysid
from sysid import catalogue
from sysid.cli import main as cli
from sysid.results.identification import Recipe

MODULE = '''"""Three floors."""

import casadi as ca
import numpy as np

import sysid

{top}

def problem(*, data=None, rng=0):
    T, one = ca.DM(np.eye(3) - np.eye(3, k=-1)), np.ones((3, 1))
    K = np.asarray(T.T @ ca.diag(ca.DM([2e4, 1.5e4, 1e4])) @ T)
    truth = sysid.Structure(
        np.diag([3.0, 2, 1, 0]), np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]]), [0.01] * 3, n_base=1
    )
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5)
    {inside}
    return sysid.Problem(
        sysid.simulate(truth, np.linspace(1, 30, 25)), mass=np.diag([3.0, 2, 1]), damping=[0.01] * 3,
        stiffness={stiffness},
    )
'''


def module_at(folder, inside="pass", top="", stiffness="T.T @ ca.diag(k) @ T"):
    path = folder / "floors.py"
    path.write_text(MODULE.format(inside=inside, top=top, stiffness=stiffness))
    return path


@pytest.mark.parametrize(
    "inside",
    [
        "idle = sysid.Variable('idle', lower=0, upper=1)",
        "sysid.Variable('idle', lower=0, upper=1)",
        "(lambda: sysid.Variable('idle', lower=0, upper=1))()",
        "idle = 2 * sysid.Variable('idle', lower=0, upper=1)",
        "hidden = {'a': [sysid.Variable('idle', lower=0, upper=1)]}",
    ],
)
def test_a_module_s_variable_that_enters_nothing_is_refused(inside, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(sysid.InputError, match=r"'idle' \(.*floors\.py, line 17\)"):
        catalogue.build(Recipe(str(module_at(tmp_path, inside))))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inside": "idle = sysid.Variable('idle', lower=0, upper=1)"}, ["'idle'", "line 17"]),
        ({"inside": "bad = sysid.Variable('bad', lower=1, upper=0)"}, ["'bad'", "line 17", "reversed"]),
        ({"stiffness": "ca.diag(ca.log(k - 50500))"}, ["-inf", "'k'", "line 16"]),
        ({"stiffness": "ca.horzcat(k, k)"}, ["'k'", "line 16", "square"]),
        ({"stiffness": "ca.diag(k[:4])"}, ["floors.py"]),
        ({"stiffness": "ca.diag(k) @ ca.MX.sym('free', 3, 3)"}, ["'free'"]),
    ],
)
def test_sysid_run_ends_with_status_2_and_one_line(change, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    status = cli.main(["run", str(module_at(tmp_path, **change)), "--out", "out"])
    told = capsys.readouterr().err.strip()
    assert status == 2
    assert len(told.splitlines()) == 1
    for word in words:
        assert word in told


def test_a_variable_beside_problem_that_enters_nothing_is_refused_too(tmp_path):
    path = module_at(tmp_path, top='idle = sysid.Variable("idle", lower=0, upper=1)\n')
    with pytest.raises(sysid.InputError, match="'idle'"):
        catalogue.build(Recipe(str(path)))
