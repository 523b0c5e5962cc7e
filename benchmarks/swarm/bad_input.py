"""The mistakes that a user makes at the command line, and how each ends."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.command_line import sysid_run
from benchmarks.line import Line

_MODULE = """
import numpy as np
import sysid

freq = np.linspace(1.0, 12.0, 40)
K = 1000.0 * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
truth = sysid.Structure(np.diag([1.0, 2.0, 0.0]), K, [0.01, 0.02], n_base=1)
test = sysid.simulate(truth, freq)
base, response, G = test.base.copy(), test.response.copy(), test.rigid_body
given = truth.natural_frequencies.round(3)
mass, limit = 3.0, None


def problem(*, data=None, rng=0):
    {change}
    return sysid.Problem(
        sysid.Measurement(freq, base, response, rigid_body=G),
        mass=sysid.FullMass(mass),
        stiffness=sysid.SpectralStiffness(given, max_frequency=limit),
    )
"""


@dataclass(frozen=True)
class Case:
    """One mistake.

    Attributes
    ----------
    change : str
        A statement at the start of ``problem()`` of the module above.
    module : str
        The whole module, where it is another one; empty for none.
    arguments : tuple of str
        After ``sysid run``; the module's path stands as MODULE.
    """

    change: str = "pass"
    module: str = _MODULE
    arguments: tuple[str, ...] = ("MODULE",)


CASES = {
    "missing file": Case(arguments=("absent.py",)),
    "unreadable file": Case(arguments=("MODULE", "--data", "absent-folder")),
    "record file missing in the folder": Case(arguments=("mini_shake_table", "--data", ".")),
    "NaN sample": Case("response[0, 0, 3] = np.nan"),
    "infinite sample": Case("base[0, 0, 0] = np.inf"),
    "unsorted frequencies": Case("freq[[3, 4]] = freq[[4, 3]]"),
    "repeated frequencies": Case("freq[4] = freq[3]"),
    "shapes that disagree": Case("return sysid.Measurement(freq, base, response[:, :1], rigid_body=G)"),
    "mass of zero": Case("global mass; mass = 0.0"),
    "negative mass": Case("global mass; mass = -3.0"),
    "w_lim below a given frequency": Case("global limit; limit = 0.9 * given[-1]"),
    "unknown problem": Case(arguments=("cantilever_towr",)),
    "unknown strategy": Case(arguments=("MODULE", "--strategy", "genetic")),
    "module without problem()": Case(module="x = 1\n"),
    "problem() that gives something else": Case(module="def problem(*, data=None, rng=0):\n    return 42\n"),
    "negative seed": Case(arguments=("MODULE", "--seed", "-1")),
}


def lines(reduced: bool) -> Iterator[Line]:
    """One line a mistake: status 2, one line on stderr, and nothing written. Both forms are the same."""
    for name, case in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            yield Line(f"bad input: {name}", *_outcome(case, Path(folder)))


def _outcome(case: Case, folder: Path) -> tuple[str, str, bool]:
    """Run one mistake in an empty folder: figure, bound, met."""
    (folder / "mistake.py").write_text(case.module.replace("{change}", case.change), encoding="utf-8")
    arguments = [str(folder / "mistake.py") if a == "MODULE" else a for a in case.arguments]
    run = sysid_run(arguments, folder)
    said = run.stderr.strip().splitlines()
    written = sorted(p.name for p in folder.iterdir() if p.name not in ("mistake.py", "__pycache__"))
    met = run.returncode == 2 and len(said) == 1 and "Traceback" not in run.stderr and not written
    figure = f"status {run.returncode}, {len(said)} line(s) on stderr, {len(written)} file(s) written: {said[:1]}"
    return figure.replace(str(folder), "."), "status 2, one line, nothing written", met
