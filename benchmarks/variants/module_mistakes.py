"""The mistakes that the author of a variant makes, each in a module run from the command line."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.command_line import sysid_run
from benchmarks.line import Line

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
    return sysid.Problem(test, mass=M, stiffness=K, constraints=constraints)
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


def lines(reduced: bool) -> Iterator[Line]:
    """One line a mistake: status 2, one message, with name, file and line. Both forms are the same."""
    for name, (change, words) in CASES.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            (folder / "variant.py").write_text(_MODULE.replace("{change}", change), encoding="utf-8")
            run = sysid_run(["variant.py"], folder)
            said = run.stderr.strip().splitlines()
            named = all(word in run.stderr for word in (*words, "variant.py, line "))
            alone = not (folder / "out").exists() and len(said) == 1 and run.returncode == 2
            yield Line(
                f"mistake: {name}",
                f"status {run.returncode}, {len(said)} line(s): {said[0][:160] if said else ''}",
                "status 2, one line with name, file and line",
                bool(alone and named),
            )
