"""The mistakes that the author of a variant makes, each in a module run from the command line."""

from __future__ import annotations

import contextlib
import io
import os
import re
import runpy
import tempfile
from collections.abc import Iterator
from pathlib import Path

import sysid
from benchmarks.command_line import sysid_run
from benchmarks.line import Line
from sysid.cli.main import main

_MODULE = '''"""A chain of two floors."""
import casadi as ca
import numpy as np
import sysid

STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
STIFFNESS = STRETCH.T @ np.diag([900.0, 700.0]) @ STRETCH


def problem(*, data=None, rng=0):
    truth = sysid.Structure(np.diag([3.0, 2.0, 0.0]), STIFFNESS, [0.02, 0.02], n_base=1)
    test = sysid.simulate(truth, np.linspace(0.5, 6.0, 60))
    m = sysid.Variable("mass", 2, lower=0.5, upper=10.0, unit="kg")
    k = sysid.Variable("spring", 2, lower=50.0, upper=5000.0, log=True, unit="N/m")
    M, K = ca.diag(m), STRETCH.T @ ca.diag(k) @ STRETCH
    constraints = [ca.sum1(m) == 5.0]
    {change}
    return sysid.Problem(test, mass=M, stiffness=K, constraints=constraints{more})
'''
_FREE = "K = K + ca.diag(ca.vertcat(ca.MX.sym('stray'), 0, 0))"
_TWIN = "k2 = sysid.Variable('spring', lower=1.0, upper=2.0); K = K * k2"
_LOGS = "K = K * ca.log(m[0] - 5.25) / ca.log(m[0] - 5.25)"

# What is done in the line {change}, and what the message must name beside that line's file.
CASES = {
    "a bound reversed": ("b = sysid.Variable('ratio', lower=0.2, upper=0.1)", ("ratio",)),
    "a matrix not square": ("K = K[:2, :]", ("stiffness", "spring")),
    "a matrix not symmetric": ("K = K + ca.triu(ca.repmat(k[0], 3, 3), False)", ("stiffness", "spring")),
    "a free symbol": (_FREE, ("stray",)),
    "a variable unused": ("c = sysid.Variable('idle', lower=1.0, upper=2.0)", ("idle",)),
    "two variables of one name": (_TWIN, ("spring",)),
    "a NaN at the guess": (_LOGS, ("stiffness", "mass")),
    "a constraint that no point satisfies": ("constraints = [ca.sum1(m) == 50.0]", ("mass",)),
    "constraints that exclude each other": ("constraints = [m[0] >= m[1] + 1.0, m[1] >= m[0]]", ("mass",)),
    "an unbounded variable": ("b = sysid.Variable('ratio', lower=0.0, upper=np.inf)", ("ratio",)),
    "a guess outside the bounds": ("b = sysid.Variable('ratio', lower=0.0, upper=1.0, guess=2.0)", ("ratio",)),
    "a matrix nowhere positive definite": ("K = -1.0 * K", ("stiffness", "spring")),
}


_ETA = "eta = sysid.Variable('loss factor', lower=0.0, upper=0.1); "
_TAU = "tau = sysid.Variable('delay', lower=0.0, upper=0.1); "
_TWO = "a, b = (sysid.Variable(name, lower=0.0, upper=0.1) for name in 'ab')"
_OTHER = "of = sysid.FurtherTest(test, mass=M, stiffness=K, damping=0.1 * np.eye(2)).response; "

# Of the modelling language: what is done in the line {change}, what more is given to Problem, and the remedy.
OF_THE_LANGUAGE = {
    "chained relations": ("constraints = [k[0] <= k[1] <= 1e6]", "", "make two constraints"),
    "an if on a variable": ("K = K if k[0] > 3 else 2 * K", "", "ca.if_else("),
    "a complex stiffness": (f"{_ETA}K = K * (1 + 1j * eta)", "", "damping=[eta / 2"),
    "a complex exponential": (f"{_TAU}K = K * np.exp(-1j * tau)", "", "ca.cos(a) and -ca.sin(a)"),
    "a complex record less an expression": (
        f"{_OTHER}r = test.response[0, :1] - of.real[:1, :]",
        ", residuals=[r]",
        "sysid.real_and_imaginary(record - ",
    ),
    "a complex damping": ("pass", ", damping=(0.02 + 0.01j) * np.eye(2)", "give its real part"),
    "a measurement among residuals": ("pass", ", residuals=[test]", "sysid.FurtherTest(test, "),
    "the base first in M": ("M = ca.diag(ca.vertcat(0.0, m))", "", "the base stand last"),
    "damping of two variables": (_TWO, ", damping=(a, b)", "write a list, [a, b]"),
    "a recovery of variables": (_TWO, ", recovery=[[1, 0], [a, 1]]", "it must be numbers"),
}


def lines(reduced: bool) -> Iterator[Line]:
    """One line a mistake: status 2, one message, with name, file and line; those of the language from Python too.

    The reduced form runs the command line in this process.
    """
    for name, (change, words) in CASES.items():
        status, said, left = _run(_MODULE.replace("{change}", change).replace("{more}", ""), reduced)
        named = all(word in said for word in (*words, "variant.py, line "))
        yield Line(
            f"mistake: {name}", f"status {status}: {said[:160]}", "status 2, one line with name, file and line",
            status == 2 and _is_one_line(said) and named and not left,
        )  # fmt: skip
    for name, (change, more, remedy) in OF_THE_LANGUAGE.items():
        module = _MODULE.replace("{change}", change).replace("{more}", more)
        # Complex expressions are right in residuals of one's own: they are refused where a matrix is made of them.
        at_problem = more or change.startswith(("M = ", _ETA, _TAU))
        mark = "return sysid.Problem" if at_problem else change
        place = f"variant.py, line {module[: module.index(mark)].count(chr(10)) + 1}"
        status, said, left = _run(module, reduced)
        error = _from_python(module)
        yield Line(
            f"mistake: {name}, by sysid run and from Python",
            f"status {status}: {said[:160]}" + ("" if error in said else f"; from Python {error[:160]}"),
            "both one line with file, line and remedy",
            status == 2
            and not left
            and all(_is_one_line(one) and place in one and remedy in one for one in (said, error)),
        )


def _run(module: str, reduced: bool) -> tuple[int, str, bool]:
    """Status of ``sysid run``, what it says on standard error, and whether it leaves a folder of results."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "variant.py").write_text(module, encoding="utf-8")
        if not reduced:
            run = sysid_run(["variant.py"], folder)
            return run.returncode, run.stderr.strip(), (folder / "out").exists()
        before, said = Path.cwd(), io.StringIO()
        os.chdir(folder)
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                status = main(["run", "variant.py", "--out", "out"])
        finally:
            os.chdir(before)
        return status, said.getvalue().strip(), (folder / "out").exists()


def _from_python(module: str) -> str:
    """The message of the InputError that the module raises where Python runs it; of anything else its kind."""
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "variant.py"
        file.write_text(module, encoding="utf-8")
        try:
            runpy.run_path(str(file))["problem"]()
        except sysid.InputError as error:
            return str(error).replace(f"{place}{os.sep}", "")
        except Exception as error:
            return re.sub(r"\s+", " ", f"no InputError but {type(error).__name__}: {error}")
        return "nothing"


def _is_one_line(said: str) -> bool:
    return len(said.splitlines()) == 1
