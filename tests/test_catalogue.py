"""Problem modules are found where the rules say, and every mistake in one is told with its place."""

import ast
import errno
import os
import re
import signal
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

import pytest

import sysid
from sysid import catalogue
from sysid.results.identification import Recipe

CHAIN = '''"""Two masses in a row."""

import numpy as np

import sysid


def problem(*, data=None, rng=0):
    mass, k = np.diag([2.0, 1.0, 0.5]), 4e3
    stiffness = k * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    truth = sysid.Structure(mass, stiffness, [0.01, 0.02], n_base=1)
    return sysid.Problem(
        sysid.simulate(truth, np.linspace(1.0, 20.0, 40), rng=rng),
        mass=sysid.FullMass(3.5),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
    )
'''


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(module, **options):
    """Build `module` and return the message of the InputError that this raises."""
    with pytest.raises(sysid.InputError) as caught:
        catalogue.build(Recipe(str(module), **options))
    return str(caught.value)


def test_bundled_problems_are_listed_with_the_first_line_of_their_docstrings(here):
    found = {entry.name: entry for entry in catalogue.entries()}
    assert {path.stem for path in catalogue.bundled_folder().glob("[!_]*.py")} == set(found)
    for entry in found.values():
        assert entry.bundled
        docstring = ast.get_docstring(ast.parse(entry.path.read_text(encoding="utf-8")))
        assert entry.description == docstring.splitlines()[0]


def test_listing_imports_nothing_and_survives_modules_that_cannot_be_read(here):
    (here / "problems").mkdir()
    (here / "problems" / "loud.py").write_text('"""It shouts.\n\nLong."""\nraise RuntimeError("imported")\n')
    (here / "problems" / "broken.py").write_text("def (:\n")
    (here / "problems" / "silent.py").write_text("x = 1\n")
    (here / "problems" / "binary.py").write_bytes(b"\0\xff\n")
    (here / "problems" / "_private.py").write_text("x = 1\n")
    own = {entry.name: entry.description for entry in catalogue.entries() if not entry.bundled}
    assert own["loud"] == "It shouts."
    assert own["broken"] == "(syntax error in line 1)"
    assert own["silent"] == ""
    assert set(own) == {"loud", "broken", "silent", "binary"}


def test_bundled_problems_are_inside_an_installed_package_and_beside_a_checkout(tmp_path, monkeypatch):
    package = tmp_path / "sysid"
    monkeypatch.setattr(catalogue, "__file__", str(package / "catalogue.py"))
    assert catalogue.bundled_folder() == tmp_path / "problems"
    (package / "bundled_problems").mkdir(parents=True)
    assert catalogue.bundled_folder() == package / "bundled_problems"


def test_a_path_an_own_problem_a_dotted_module_and_the_order_among_them(here, monkeypatch):
    (here / "chain.py").write_text(CHAIN)
    assert catalogue.build(Recipe("chain.py")).geometry.n == 2
    assert catalogue.build(Recipe("./chain.py")).geometry.n == 2
    assert "unknown" in refused("chain")

    (here / "problems").mkdir()
    (here / "problems" / "chain.py").write_text(CHAIN)
    assert catalogue.build(Recipe("chain")).geometry.n == 2
    # The user's own problem hides a bundled one of its name where it is typed, and in no recipe.
    (here / "problems" / "shear_building.py").write_text("raise SystemExit('it ran')\n")
    assert catalogue.build(Recipe("shear_building")).geometry.n > 2
    typed, remark = catalogue.typed("shear_building")
    assert Path(typed) == Path("problems/shear_building.py") and remark.startswith(f"{typed} ")
    assert "it ran" in refused(typed)
    assert [entry.bundled for entry in catalogue.entries() if entry.name == "shear_building"] == [False]
    assert catalogue.typed("chain") == ("chain", "")

    package = here / "lab_of_chains"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "second.py").write_text("from lab_of_chains.first import problem\n")
    (package / "first.py").write_text(CHAIN)
    monkeypatch.syspath_prepend(str(here))
    assert catalogue.build(Recipe("lab_of_chains.second")).geometry.n == 2
    assert "unknown" in refused("lab_of_chains.third")
    assert "unknown" in refused("no_such_lab.first")
    (package / "lame.py").write_text("\nimport no_such_module_at_all\n")
    message = refused("lab_of_chains.lame")
    assert "lame.py, line 2" in message
    assert "no_such_module_at_all" in message


def test_the_name_for_results_is_the_stem_of_the_module():
    assert catalogue.short_name("a/b/tower.py") == "tower"
    assert catalogue.short_name("tower.py") == "tower"
    assert catalogue.short_name("tower") == "tower"
    assert catalogue.short_name("lab.problems.tower") == "tower"


def test_data_and_rng_reach_the_module(here):
    (here / "records").mkdir()
    (here / "echo.py").write_text(
        "def problem(*, data=None, rng=0):\n    raise ValueError(f'{data.is_dir()} {data.name} {rng}')\n"
    )
    assert "ValueError: True records 7" in refused("echo.py", data="records", rng=7)


def test_loading_leaves_nothing_behind_and_reads_the_file_anew(here):
    module = here / "chain.py"
    module.write_text(CHAIN)
    before = set(sys.modules)
    catalogue.build(Recipe("chain.py"))
    (added,) = (name for name in set(sys.modules) - before if "chain" in name)
    assert added.startswith("_sysid_problem_")  # a private name: it hides no module of the user's
    # Same size, same second: a cached compilation would be taken for this one.
    module.write_text(CHAIN.replace("FullMass(3.5)", "FullMass(4.5)"))
    assert catalogue.build(Recipe("chain.py")).totals == pytest.approx([4.5])
    assert [path.name for path in here.iterdir()] == ["chain.py"]


def test_a_module_may_define_dataclasses_under_postponed_annotations(here):
    head = "from __future__ import annotations\nimport dataclasses\n@dataclasses.dataclass\nclass A:\n    x: int = 0\n"
    (here / "chain.py").write_text(head + CHAIN)
    assert catalogue.build(Recipe("chain.py")).geometry.n == 2


def test_a_module_does_not_inherit_this_packages_future_imports(here):
    (here / "eager.py").write_text(
        "def f(x: 1 + 1):\n    pass\n\n"
        "def problem(*, data=None, rng=0):\n    raise ValueError(f.__annotations__['x'])\n"
    )
    assert refused("eager.py").endswith("ValueError: 2")  # the sum, not the text of it


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = 1\ndef problem(:\n", ["bad.py, line 2", "syntax error"]),
        ("import no_such_module_at_all\n", ["bad.py, line 1", "no_such_module_at_all"]),
        ("x = 1\n\ny = x / 0\n", ["bad.py, line 3", "ZeroDivisionError: division by zero"]),
        ("def problem(*, data=None, rng=0):\n    return {}['key']\n", ["bad.py, line 2", "KeyError: 'key'"]),
        (
            "import json\ndef problem(*, data=None, rng=0):\n    json.loads('{')\n",
            ["bad.py, line 3", "JSONDecodeError"],  # the module's own line, not the library's
        ),
        ("import sys\nsys.exit('enough')\n", ["bad.py, line 2", "SystemExit: enough"]),
        ("eval('1 +')\n", ["bad.py, line 1", "SyntaxError"]),
        ("def problem(*, data=None, rng=0):\n    open('nowhere')\n", ["line 2", "FileNotFoundError", "nowhere"]),
        ("x = '\xff'\n".encode("latin-1"), ["bad.py"]),
        (b"x = 1\0\n", ["bad.py", "null bytes"]),
        ("x = 1\n", ["bad.py", "has no function problem()", "def problem(*, data=None, rng=0)"]),
        ("problem = 3\n", ["has no function problem()"]),
        ("def problem():\n    return 1\n", ["does not take data and rng"]),
        ("def problem(data, rng, /):\n    return 1\n", ["does not take data and rng"]),
        ("def problem(*, data=None, rng=0):\n    return {'mass': 1}\n", ["gives a dict, not a sysid.Problem"]),
        ("def problem(*, data=None, rng=0):\n    pass\n", ["gives a NoneType, not a sysid.Problem"]),
    ],
)
def test_a_mistake_in_a_module_is_told_with_its_place(here, text, told):
    (here / "bad.py").write_bytes(text if isinstance(text, bytes) else text.encode())
    message = refused("bad.py")
    for words in told:
        assert words in message


@pytest.mark.parametrize(
    ("line", "remedy"),
    [
        ("0 <= ca.sum1(k) <= 5", "[lower <= k, k <= upper]"),
        ("1 if ca.sum1(k) > 3 else 2", "ca.if_else"),
        ("ca.diag(k) * (1 + 0.02j)", "damping=[eta / 2"),
        ("np.array([1 + 2j, 3.0]) - ca.exp(k)", "record.real - real"),
        ("ca.exp(k) - np.complex128(1j)", "record.real - real"),
        ("ca.exp(-1j * ca.sum1(k))", "ca.cos(a) and -ca.sin(a)"),
    ],
)
def test_what_casadi_cannot_do_with_what_its_functions_gave_is_told_with_the_remedy(here, line, remedy):
    (here / "symbolic.py").write_text(
        "import casadi as ca\nimport numpy as np\nimport sysid\n\n\ndef problem(*, data=None, rng=0):\n"
        f"    k = sysid.Variable('k', 2, lower=0, upper=1)\n    {line}\n"
    )
    message = refused("symbolic.py")
    assert message.startswith("symbolic.py, line 8: ")
    assert remedy in message


def test_another_error_of_casadi_is_told_as_it_is(here):
    (here / "symbolic.py").write_text(
        "import casadi as ca\n\n\ndef problem(*, data=None, rng=0):\n    ca.MX.sym('a', 2) + ca.MX.sym('b', 3)\n"
    )
    message = refused("symbolic.py")
    assert message.startswith("symbolic.py, line 5: RuntimeError: ")
    assert "imension mismatch" in message


def test_an_input_error_from_inside_passes_as_it_is(here):
    (here / "bad.py").write_text(
        "import sysid\ndef problem(*, data=None, rng=0):\n    raise sysid.InputError('no records on Sundays')\n"
    )
    assert refused("bad.py") == "no records on Sundays"


WRITTEN = """import casadi as ca
import numpy as np
import sysid

def problem(*, data=None, rng=0):
    stretch = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
    truth = sysid.Structure(np.diag([2.0, 1.0, 0.0]), stretch.T @ np.diag([3e4, 2e4]) @ stretch, [0.01, 0.02], n_base=1)
    k = sysid.Variable("spring", 2, lower=1e3, upper=1e5, log=True)
    m = sysid.Variable("mass", 2, lower=0.1, upper=9.0, guess=[2.0, 1.0], fixed=True)
    f = sysid.Variable("factor", lower=0.0, upper=2.0)
    return sysid.Problem(
        sysid.simulate(truth, np.linspace(1.0, 40.0, 30)), mass=ca.diag(m), stiffness=stretch.T @ ca.diag(k) @ stretch,
        constraints=[CONSTRAINT],
    )
"""


def test_a_variable_that_enters_nothing_is_refused_with_its_line(here):
    module = here / "written.py"
    module.write_text(WRITTEN.replace("CONSTRAINT", "k[1] <= k[0]"))
    message = refused("written.py")
    assert re.findall(r"'(\w+)' \((.*?)\)", message) == [("factor", "written.py, line 10")]  # 'mass' is fixed, and used
    module.write_text(WRITTEN.replace("CONSTRAINT", "k[1] <= f * k[0]"))
    assert [v.name for v in catalogue.build(Recipe("written.py")).variables[1:]] == ["spring", "factor"]


def test_what_cannot_be_searched_is_refused_when_it_is_built(here):
    (here / "written.py").write_text(WRITTEN.replace("CONSTRAINT", "f * k[0] >= 3e5"))
    assert "constraint 1" in refused("written.py")


def test_ctrl_c_inside_a_module_is_no_mistake_of_the_module(here, monkeypatch, ctrl_c):
    """Nor where a library that it calls raises it anew, as asyncio does."""
    monkeypatch.setattr(signal, "wakeup", interrupted, raising=False)
    for line in ("signal.raise_signal(signal.SIGINT)", "signal.wakeup()"):
        (here / "slow.py").write_text(f"import signal\n\n{line}\n")
        with pytest.raises(KeyboardInterrupt):
            catalogue.build(Recipe("slow.py"))
        assert not any("slow" in name for name in sys.modules if name.startswith("_sysid_problem_"))


def interrupted():
    raise KeyboardInterrupt


def test_a_module_that_raises_what_ctrl_c_raises_is_a_mistake(here):
    (here / "raises.py").write_text("raise KeyboardInterrupt\n")
    assert refused("raises.py") == "raises.py raised KeyboardInterrupt, which is Ctrl-C's alone"


def test_a_module_may_have_a_search_path_of_its_own(here):
    (here / "chain.py").write_text(f"import sys\n\nsys.path.pop(0)\n{CHAIN}")
    before = list(sys.path)
    catalogue.build(Recipe("chain.py"))
    assert sys.path == before


PACKAGE = """from . import numbers


def stiffness():
    from .further import deeper  # imported while the problem is built

    return deeper.K
"""


@pytest.mark.parametrize("init", ["__init__.py", None])
def test_a_package_beside_a_module_is_imported_anew_each_time_and_leaves_nothing(here, init, monkeypatch):
    """With and without an ``__init__.py``; the module in ``problem()`` sees the same package as at its top."""
    (here / "lab" / "further").mkdir(parents=True)
    if init:
        (here / "lab" / init).write_text("")
    (here / "lab" / "numbers.py").write_text("K = 4e3\n")
    (here / "lab" / "further" / "deeper.py").write_text("from lab.numbers import K\n")
    (here / "lab" / "model.py").write_text(PACKAGE)
    (here / "alone.py").write_text("TOTAL = 3.5\n")
    text = "import lab.model\nfrom alone import TOTAL\n" + CHAIN.replace("FullMass(3.5)", "FullMass(TOTAL)").replace(
        "k = np.diag([2.0, 1.0, 0.5]), 4e3", "k = np.diag([2.0, 1.0, 0.5]), lab.model.stiffness()"
    )
    (here / "chain.py").write_text(text)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    before, path = set(sys.modules), list(sys.path)
    first, files = catalogue.built(Recipe("chain.py"))
    expected = {"chain.py", "alone.py", "lab/model.py", "lab/numbers.py", "lab/further/deeper.py"}
    assert {file.relative_to(here).as_posix() for file in files} == expected | ({f"lab/{init}"} if init else set())
    assert all("chain" in name for name in set(sys.modules) - before)
    assert (sys.path, sys.dont_write_bytecode) == (path, False)
    assert not list(here.rglob("__pycache__"))
    (here / "lab" / "numbers.py").write_text("K = 1e3\n")
    (here / "alone.py").write_text("TOTAL = 4.5\n")
    second = catalogue.build(Recipe("chain.py"))
    ratio = first.stiffness.natural_frequencies / second.stiffness.natural_frequencies
    assert ratio == pytest.approx([2.0, 2.0])  # of the root of the springs' ratio
    assert (first.totals, second.totals) == (pytest.approx([3.5]), pytest.approx([4.5]))


def test_what_the_script_has_imported_from_beside_a_module_is_read_anew_and_given_back(here, monkeypatch):
    """Unless it has compiled parts, which many packages cannot have twice."""
    (here / "alone.py").write_text("TOTAL = 3.5\n")
    (here / "fast").mkdir()
    (here / "fast" / "__init__.py").write_text("TOTAL = 9.0\n")
    (here / "chain.py").write_text(
        "from alone import TOTAL\nfrom fast import TOTAL as LOADED\n" + CHAIN.replace("(3.5)", "(TOTAL + LOADED)")
    )
    for name, file, total in (
        ("alone", "alone.py", 1.0),
        ("fast", "fast/__init__.py", 2.0),
        ("fast.inner", f"fast/inner{EXTENSION_SUFFIXES[0]}", 3.0),
    ):
        module = ModuleType(name)
        module.__file__, module.TOTAL = str(here / file), total
        monkeypatch.setitem(sys.modules, name, module)
    before = dict(sys.modules)
    problem, files = catalogue.built(Recipe("chain.py"))
    assert problem.totals == pytest.approx([5.5])
    assert files == {here / "chain.py", here / "alone.py"}
    assert {name: sys.modules[name] for name in before} == before


def test_an_unknown_name_lists_the_known_ones_and_the_closest(here):
    (here / "problems").mkdir()
    (here / "problems" / "my_tower.py").write_text(CHAIN)
    message = refused("my_towr")
    assert re.findall(r"'(\w+)'\?", message) == ["my_tower"]
    for entry in catalogue.entries():
        assert entry.name in message
    assert re.findall(r"'(\w+)'\?", refused("zzz")) == []
    assert "module is ''" in refused("")
    assert "unknown" in refused("..")


def test_a_file_that_is_not_there_or_not_a_file(here):
    for name in ("nowhere.py", "some/where/chain.py"):
        assert name in refused(name) and os.strerror(errno.ENOENT) in refused(name)
    (here / "test.h5").write_text(CHAIN)
    assert refused("./test.h5").startswith("problem test.h5: ") and " .py;" in refused("./test.h5")
    (here / "folder.py").mkdir()
    assert refused("folder.py").startswith("problem folder.py is ")
    assert os.strerror(errno.ENAMETOOLONG) in refused("x" * 5000 + ".py")
    assert "unknown" in refused("x" * 5000)


def test_data_that_is_not_there_is_refused_before_the_module_runs(here):
    (here / "loud.py").write_text("raise RuntimeError('ran')\n")
    assert refused("loud.py", data="nowhere").startswith("data 'nowhere': ")
    assert "data is ''" in refused("loud.py", data="")
