"""Results whose problem module is not there: readers work, what needs the problem says so; ``--module`` gives it."""

import sys

import pytest

import sysid
from sysid.cli import main as cli
from sysid.report import report

MODULE = '''
"""Two storeys; their stiffness is a class of this module."""

import casadi as ca
import numpy as np

import sysid


class Storeys:
    def unknowns(self, geometry):
        return [sysid.Unknown("spring", np.full(2, 1e3), np.full(2, 1e5), unit="N/m")]

    def blocks(self, geometry, y, mass):
        return ca.blockcat([[y[0] + y[1], -y[1]], [-y[1], y[1]]])

    def values(self, geometry, structure):
        return np.array([structure.stiffness[0, :2].sum(), -structure.stiffness[0, 1]])

    def stated(self, geometry):
        return sysid.Stated(sentence="two storeys")


def problem(*, data=None, rng=0, noise=0.01):
    K = 1e4 * np.array([[3.0, -1.0, -2.0], [-1.0, 1.0, 0.0], [-2.0, 0.0, 2.0]])
    truth = sysid.Structure(np.diag([3.0, 2.0, 0.0]), K, [0.01, 0.02], n_base=1)
    test = sysid.simulate(truth, np.linspace(1.0, 40.0, 80), noise=noise, force=True, rng=rng)
    return sysid.Problem(test, mass=np.diag([3.0, 2.0, 0.0]), stiffness=Storeys(), damping=sysid.ModalDamping())
'''


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a result, and its module, which the process has forgotten."""
    folder = tmp_path_factory.mktemp("own")
    module = folder / "storeys.py"
    module.write_text(MODULE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        # The pictures take longest, and need no problem.
        patch.setattr(report, "picture", lambda figure, alt, caption="", **_: f"<p>{caption}</p>")
        yield _run(folder, module)


def _run(folder, module):
    assert cli.main(["run", str(module), "--out", str(folder / "result"), "--quiet"]) == 0
    for name in [name for name in sys.modules if name.startswith("_sysid_problem_")]:
        del sys.modules[name]
    return folder / "result", module


def test_report_and_export_need_no_module(run, tmp_path, monkeypatch):
    folder, module = run
    page = (folder / "report.html").read_bytes()
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(module.parent)])
    (tmp_path / "result.h5").write_bytes((folder / "result.h5").read_bytes())
    assert cli.main(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").read_bytes() == page
    assert cli.main(["export", str(tmp_path), str(tmp_path / "storeys.csv")]) == 0
    assert "K,1,1," in (tmp_path / "storeys.csv").read_text(encoding="utf-8")


def test_what_needs_the_problem_names_module_and_class(run):
    back = sysid.load(run[0])
    with pytest.raises(
        sysid.InputError, match=r"the class 'Storeys' of the module 'storeys'.*made by .*storeys\.py.*--module FILE"
    ):
        _ = back.problem


def test_the_module_that_is_named_makes_the_problem_anew(run, tmp_path, capsys):
    folder, module = run
    assert cli.main(["export", str(folder), str(tmp_path / "a.csv"), "--module", str(module)]) == 0
    assert cli.main(["report", str(folder), "--module", str(module)]) == 0
    other = tmp_path / "other.py"
    other.write_text(MODULE.replace("noise=0.01", "noise=0.02"), encoding="utf-8")
    capsys.readouterr()
    assert cli.main(["report", str(folder), "--module", str(other)]) == 2
    assert "(response)" in capsys.readouterr().err
