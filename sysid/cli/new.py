"""``sysid new NAME``: a commented problem module and its test, to be changed into one's own."""

from __future__ import annotations

import argparse
import contextlib
import importlib.machinery
import keyword
import os
import re
import sys
from pathlib import Path

from sysid.cli.output import Output
from sysid.cli.starting import SUCCESS
from sysid.errors import InputError, refuse
from sysid.files import recorded_test
from sysid.results.storage import atomically


def run(options: argparse.Namespace, out: Output) -> int:
    """Write module and test, and tell what to do with them."""
    module, test = write_new_problem(options.name, data=options.data)
    out.wrote(module)
    out.wrote(test)
    out.write(
        f"Try them, then change the steps of {module} into your own:\n"
        f"  sysid show {module}    what is unknown, and what the data determine\n"
        f"  sysid run {module}     identify, and write results/{module.stem}/report.html\n"
        f"  python -m pytest {test}\n"
    )
    return SUCCESS


def write_new_problem(name: str, *, data: str | None = None) -> tuple[Path, Path]:
    """Write ``NAME.py`` and ``test_NAME.py``, both whole or neither, and never over what is there.

    The test imports the module by its name. The module identifies the test `data`, which ``sysid read`` wrote, or a
    simulated one.
    """
    _check(name)
    texts = [_filled(text, {"NAME": name, **words}) for text, words in _templates(data)]
    module, test = Path(f"{name}.py"), Path(f"test_{name}.py")
    for path in (module, test):
        if os.path.lexists(path):
            raise InputError(f"{path} exists already, so nothing was written: choose another name, or move it away")
    try:
        with atomically(module) as module_text, atomically(test) as test_text:
            module_text.write_text(texts[0], encoding="utf-8")
            test_text.write_text(texts[1], encoding="utf-8")
    except BaseException:
        with contextlib.suppress(OSError):
            test.unlink(missing_ok=True)  # the first to take its place; it was not there before
        raise
    return module, test


def _check(name: str) -> None:
    """Refuse what Python cannot import by this name, with one that it can."""
    if name.endswith(".py") and name[:-3].isidentifier():
        raise InputError(f"{name}: give the name without .py: sysid new {name[:-3]}")
    if not name.isidentifier():
        near = re.sub(r"\W+", "_", Path(name).name.removesuffix(".py")).strip("_")
        near = near if near.isidentifier() and not keyword.iskeyword(near) else f"my_{near or 'problem'}"
        where = ", and no folder: the files are written in the current one" if "/" in name or os.sep in name else ""
        raise InputError(
            f"{name!r} cannot be imported: a name of letters, digits and underscores is needed that starts with no "
            f"digit{where}; such as: sysid new {near}"
        )
    refuse(
        (
            keyword.iskeyword(name),
            f"{name!r} is a word of Python itself and names no module; such as: sysid new my_{name}",
        ),
        (
            name == "conftest" or _is_taken(name),
            f"{name!r} is a module that Python imports from elsewhere, and {name}.py would hide it; such as: "
            f"sysid new my_{name}",
        ),
    )


def _templates(data: str | None) -> tuple[tuple[str, dict[str, str]], ...]:
    """Templates of a module and its test, of a test file where one is given, with what is filled in beside the name."""
    if data is None:
        return (_MODULE, {}), (_TEST, {})
    test = recorded_test.load(data)
    # In a comment, where a line feed would end it: `repr` spells that out, though a sensor has none in its name.
    sensors = "\n".join(f"#   {sensor.name!r}: {sensor.axis!r} at {sensor.position} m" for sensor in test.sensors)
    words = {"PATH": repr(str(Path(data))), "SENSORS": sensors, "AXES": " ".join(test.base_axes)}
    return (_DATA_MODULE, words), (_DATA_TEST, {})


def _filled(template: str, words: dict[str, str]) -> str:
    """A template with words in their places, at once: what is put in may hold the name of another place."""
    return re.sub("|".join(words), lambda found: words[found[0]], template)


def _is_taken(name: str) -> bool:
    """True where a module of this name can be imported, the current folder aside."""
    here = Path.cwd()
    elsewhere = [place for place in sys.path if Path(place or ".").absolute() != here]
    spec = importlib.machinery.PathFinder.find_spec(name, elsewhere)
    found = spec is not None and spec.origin is not None  # a folder that happens to be there has none
    return found or name in sys.stdlib_module_names


_MODULE = '''"""NAME: three masses in a row on a shaken base, simulated.

Say here what the structure is and where its data come from, then change the five steps below into your own.
"""

import casadi as ca
import numpy as np

import sysid

# What the test is simulated with, from the base up. Real records need none of it.
MASSES = np.array([4.0, 3.0, 2.0])  # kg
SPRINGS = np.array([9e3, 7e3, 5e3])  # N/m
DAMPERS = np.array([9.0, 7.0, 5.0])  # N s/m, beside the springs
TOTAL = MASSES.sum()  # kg, from a scale

# Stretch of each spring for unit motion of each mass and, in the last column, of the base.
STRETCH = np.array([[1.0, 0.0, 0.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [0.0, -1.0, 1.0, 0.0]])


def measure(rng):
    """The test: spectra of the base and of three sensors, 0.5 to 20 Hz, with 1 % noise."""
    K = STRETCH.T @ np.diag(SPRINGS) @ STRETCH
    C = (STRETCH.T @ np.diag(DAMPERS) @ STRETCH)[:3, :3]
    truth = sysid.Structure(np.diag([*MASSES, 0.0]), K, damping_matrix=C, n_base=1)
    return sysid.simulate(truth, np.linspace(0.5, 20.0, 200), noise=0.01, rng=rng)


def problem(*, data=None, rng=0):
    # 1. The test. --data PATH arrives as `data`: read it, and return sysid.Measurement.from_time(...) or from_frf(...).
    if data is not None:
        raise sysid.InputError("NAME is simulated and takes no --data")
    test = measure(rng)

    # 2. The unknowns: name, shape, the widest bounds that you believe; log where only the order of magnitude is known.
    m = sysid.Variable("mass", 3, lower=0.5, upper=8.0, unit="kg")
    k = sysid.Variable("spring", 3, lower=1e3, upper=1e5, log=True, unit="N/m")
    c = sysid.Variable("damper", 3, lower=1.0, upper=50.0, log=True, unit="N s/m")

    # 3. The matrices, written in them. Stiffness has the base in its last row; damping acts on the relative motion.
    M = ca.diag(m)
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    C = STRETCH[:, :3].T @ ca.diag(c) @ STRETCH[:, :3]

    # 4. What else is known. Accelerations leave one common scale of M, K and C open; the total mass closes it.
    known = [ca.sum1(m) == TOTAL, k[1] <= k[0]]

    # 5. The problem. `healing` takes the swarm's candidates to the total; `goal` is the residual of a good fit.
    return sysid.Problem(
        test, mass=M, stiffness=K, damping=C, constraints=known, healing={m: TOTAL * m / ca.sum1(m)}, goal=0.02
    )
'''

_TEST = '''"""NAME: the structure that the test was simulated with is found."""

import numpy as np
import pytest

import NAME as module
import sysid

TRUTH = {"mass": module.MASSES, "spring": module.SPRINGS, "damper": module.DAMPERS}


@pytest.fixture(scope="module")
def result():
    return sysid.identify(module.problem(), rng=0)


def test_the_data_determine_every_unknown(result):
    assert result.success, result.message
    assert result.determined, result.undetermined


@pytest.mark.parametrize("name", TRUTH)
def test_each_unknown_is_found_within_its_uncertainty(result, name):
    found, std = result.values[name], result.uncertainty.variables[name]
    assert np.all(np.abs(found - TRUTH[name]) < 4 * std)
    assert np.all(std < 0.05 * TRUTH[name])


def test_the_total_mass_is_held(result):
    assert result.values["mass"].sum() == pytest.approx(module.TOTAL, rel=1e-6)
'''

_DATA_MODULE = '''"""NAME: a structure, identified from a recorded test.

Say here what the structure is and how it was tested, then change the three steps below into your own.
"""

from pathlib import Path

import sysid
from sysid.files import recorded_test

TEST = Path(__file__).parent / PATH
# Sensors of the test; its base moves along AXES:
SENSORS


def problem(*, data=None, rng=0):
    # 1. The test: its records whole, in the band that the base excites; band=(low, high) in Hz takes other lines,
    #    estimator="h1" averages them.
    test = recorded_test.load(data or TEST).measurement()

    # 2. What is known of the masses: their total, if no base force was measured: sysid.FullMass(1450.0, ...);
    #    masses at the sensors alone: sysid.LumpedMass(1450.0).
    mass = sysid.FullMass(healing="rigid_body")

    # 3. The problem. The stiffness is found by its modes, with one damping ratio for each.
    return sysid.Problem(test, mass=mass, stiffness=sysid.SpectralStiffness(), damping=sysid.ModalDamping())
'''

_DATA_TEST = '''"""NAME: the recorded test is read, and its problem can be searched."""

import NAME as module


def test_the_problem_can_be_searched():
    module.problem().check()
'''
