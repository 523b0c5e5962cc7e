"""The counts over the package, on packages of a few lines that were counted by hand."""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def house(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("benchmarks.house")


@pytest.fixture
def count(house, tmp_path):
    """Give a function that writes a package, path by path, and counts one thing in it."""

    def counted(name, files):
        for path, text in files.items():
            file = tmp_path / "sysid" / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        value, places = house.CHECKS[name].count(house.Package(tmp_path / "sysid"))
        return value, [place.removeprefix("sysid/").split(": ")[0] for place in places]

    return counted


ROOMS = {f"{room}/__init__.py": "" for room in ("structure", "models", "problem", "search", "assessment", "swarm")}


def test_imports_go_down_only_late_ones_and_those_for_types_too(count):
    assert count(
        "arrows",
        ROOMS
        | {
            "__init__.py": "from sysid import structure\nfrom sysid.search import local\n",
            "errors.py": "",
            "problem/problem.py": "from sysid.errors import A\nfrom sysid.structure import B\nfrom .terms import C\n",
            "problem/terms.py": "def f():\n    from sysid.search.local import solve\n",
            "search/local.py": "from sysid import problem\n",
            "models/mass.py": "if TYPE_CHECKING:\n    import sysid.problem.problem\nfrom sysid import __version__\n",
            "structure/beam.py": "from ..models import mass\n",
            "attic.py": "",
        },
    ) == (5, ["attic.py", "models/mass.py:2", "models/mass.py:3", "problem/terms.py:2", "structure/beam.py:1"])


def test_assessment_and_search_do_not_know_each_other_and_the_swarm_knows_errors_alone(count):
    files = ROOMS | {
        "assessment/checks/against_records.py": "from sysid.search import local\n",
        "search/local.py": "from sysid.assessment import checks\n",
        "swarm/box.py": "from sysid.errors import InputError\nfrom . import stop\nfrom sysid import nlp\n",
        "swarm/stop.py": "",
        "nlp.py": "",
        "errors.py": "",
    }
    assert count("assessment", files) == (1, ["assessment/checks/against_records.py:1"])
    assert count("arrows", files) == (1, ["search/local.py:1"])
    assert count("swarm", files) == (1, ["swarm/box.py:3"])


def test_modules_on_circles_are_counted_through_folders_and_late_imports(count):
    value, groups = count(
        "circles",
        {
            "a.py": "from sysid.b import x\n",
            "b.py": "import sysid.c\n",
            "c.py": "def f():\n    from sysid import a\n",
            "d.py": "from sysid import a, e\n",
            "e/__init__.py": "from sysid.e.f import g\n",
            "e/f.py": "from sysid import e\n",
        },
    )
    assert value == 5
    assert sorted(groups) == ["sysid.a <-> sysid.b <-> sysid.c", "sysid.e <-> sysid.e.f"]


MODELS = """\
isinstance(m, FullMass) and isinstance(k, ChainStiffness | SpectralStiffness)
type(m) is KnownMass
type(m).__name__ == "LumpedMass"
{ModalDamping: 1}[type(c)]
match m:
    case WrittenMass():
        pass
    case "FullMass":
        pass
if name in ("damping_ratio", "other"): pass
isinstance(p, PointMass), isinstance(v, Variable), type(m) is int, name == "mass"
FullMass(3.0), blocks["stiffness_factor"]
"""


def test_tests_of_a_models_class_by_class_and_by_name(count):
    value, places = count("classes", {"search/local.py": MODELS, "models/mass.py": MODELS})
    assert value == 8
    assert places == [f"search/local.py:{line}" for line in (1, 1, 2, 3, 4, 6, 8, 10)]


def test_tests_for_none_on_fields_of_a_formulation(count):
    files = {
        "problem/formulation.py": "class Formulation:\n    healing: Function\n    mass: Stated\n    x = 1\n",
        "search/local.py": (
            "formulation.healing is None\n"
            "problem.formulation.mass is not None\n"
            "(h := f.healing) is None\n"
            "further.mass is None\n"
            "f.x is None\n"
            "f.healing is f.mass\n"
        ),
    }
    assert count("none", files) == (3, ["search/local.py:1", "search/local.py:2", "search/local.py:3"])


def test_two_kinds_of_problem(count):
    files = {
        "search/local.py": "a.is_written or is_written\nclass WrittenCost: pass\n",
        "assessment/written_ranges.py": "def _written_ranges(): pass\n",
        "problem/problem.py": "def is_written(): pass\ndef written_in(): pass\n",
    }
    assert count("is_written", files) == (2, ["search/local.py:1", "search/local.py:1"])
    assert count("twins", files)[0] == 3


FUNCTION = '''\
def long(a):
    """Says
    much."""
    # a comment
    b = 1 if a else 2
    # another

    if b:
        return [c for c in b if c]
    elif a:
        return 0
'''


def test_sizes(count):
    """11 lines, 9 without the docstring's two, 8 neither blank nor comment; if, elif and one conditional expression."""
    files = {"errors.py": FUNCTION, "_inside.py": "", "__init__.py": "", "swarm/_box.py": ""}
    assert count("function", files)[0] == 9
    assert count("branches", files)[0] == pytest.approx(1000 * 3 / 8)
    assert count("lines", files)[0] == count("file", files)[0] == 11
    assert count("root", files)[0] == 3
    assert count("hidden", files)[0] == 2
