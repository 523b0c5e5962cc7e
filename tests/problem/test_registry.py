"""Matrix models as trees: those of the package by their names, others by their module."""

import sys

import numpy as np
import pytest

import sysid
from sysid import catalogue
from sysid.files.tree import check_tree, from_bytes, to_bytes
from sysid.problem import stored
from sysid.problem.stored import model_from_tree, model_to_tree
from sysid.results.identification import Recipe

MODELS = (
    sysid.FullMass([30.0, 31.0], healing="rigid_body"),
    sysid.LumpedMass(12.5),
    sysid.LumpedMass(),
    sysid.KnownMass(np.diag([1.0, 2.0])),
    sysid.SpectralStiffness([10.0, 20.0], 90.0),
    sysid.ChainStiffness(1e3, [1e5, 2e5]),
    sysid.ModalDamping(0.001, 0.1),
    sysid.ProportionalDamping((0.0, 0.5), (0.0, 1e-3)),
)
OWN = """
import numpy as np

class Tank:
    class Half:
        def __init__(self, levels):
            self.levels = levels

        def to_tree(self):
            return {"levels": np.array(self.levels)}

        @classmethod
        def from_tree(cls, tree):
            return cls(tree["levels"].tolist())

class Ring:
    def __init__(self, sectors, stiffness=None):
        self.sectors, self.stiffness = sectors, stiffness

    def unknowns(self, geometry):
        return []

    blocks = values = stated = unknowns

nothing = 3
"""


@pytest.fixture
def tanks(tmp_path, monkeypatch):
    """A module of the user's own."""
    (tmp_path / "tanks_of_mine.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    import tanks_of_mine

    yield tanks_of_mine
    sys.modules.pop("tanks_of_mine", None)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: type(model).__name__)
def test_models_of_the_package_come_back_field_by_field(model):
    tree = model_to_tree(model)
    check_tree(tree)
    assert tree["kind"] == type(model).__name__
    back = model_from_tree(tree)
    assert type(back) is type(model)
    for name, value in vars(model).items():
        if isinstance(value, tuple | str | float) or value is None:
            assert getattr(back, name) == value
        else:
            np.testing.assert_array_equal(getattr(back, name), value)


def test_a_model_of_the_users_own_is_found_by_its_module(tanks):
    tree, _ = from_bytes(to_bytes(model_to_tree(tanks.Tank.Half([0.3, 0.7])), 3))
    assert tree["kind"] == "tanks_of_mine:Tank.Half"
    back = model_from_tree(tree)
    assert type(back) is tanks.Tank.Half and back.levels == [0.3, 0.7]


def test_a_model_without_a_tree_of_its_own_is_stored_by_its_attributes(tanks):
    given = tanks.Ring(12, stiffness=[2e4, 3e3])
    back = model_from_tree(from_bytes(to_bytes(model_to_tree(given), 3))[0])
    assert type(back) is tanks.Ring and back.sectors == 12
    np.testing.assert_array_equal(back.stiffness, [2e4, 3e3])
    with pytest.raises(sysid.InputError, match=r"Ring cannot be stored: its class needs a method to_tree"):
        model_to_tree(tanks.Ring(object()))


def test_a_problem_stores_it_beside_expressions(tanks):
    given = {"mass": tanks.Tank.Half([0.5]), "stiffness": sysid.ChainStiffness(1.0, 2.0), "damping": np.eye(2)}
    back = stored.from_tree(from_bytes(to_bytes(stored.to_tree(given), 3))[0])
    assert back["mass"].levels == [0.5]
    assert (back["stiffness"].lower, back["stiffness"].upper) == (1.0, 2.0)
    np.testing.assert_array_equal(back["damping"], np.eye(2))


@pytest.mark.parametrize("lost", ["nowhere_at_all:Tank", "tanks_of_mine:Cask", "tanks_of_mine:nothing", "os:system"])
def test_a_class_that_is_missing_is_named_with_its_module(tanks, lost):
    module, name = lost.split(":")
    with pytest.raises(sysid.InputError, match=f"a model is made of the class '{name}' of the module '{module}'"):
        model_from_tree({"kind": lost, "fields": {}})


def test_a_file_imports_no_module(tmp_path, monkeypatch):
    (tmp_path / "silent_tanks.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(sysid.InputError, match="'silent_tanks', and a file imports no module by itself"):
        model_from_tree({"kind": "silent_tanks:Ring", "fields": {"sectors": 3, "stiffness": None}})
    assert "silent_tanks" not in sys.modules


def test_no_class_of_what_the_package_imports_is_taken_for_a_model():
    """`sysid report` has no module of the user's: only those of the table of the package's own are found."""
    libraries = ("sysid", "numpy", "scipy", "casadi", "h5py", "matplotlib")
    named = [(name, vars(module)) for name, module in sys.modules.items() if name.partition(".")[0] in libraries]
    alike = {
        f"{name}:{kind}"
        for name, content in named
        for kind, value in content.items()
        if isinstance(value, type) and hasattr(value, "from_tree")
    }
    assert "sysid.results.identification:Recipe" in alike  # it has the methods
    for kind in alike:
        with pytest.raises(sysid.InputError, match="a model is made of the class"):
            model_from_tree({"kind": kind, "fields": {}})


PROBLEM = """
import sysid
from rings_beside import Ring

class Light(sysid.ModalDamping):
    pass

def problem(*, data=None, rng=0):
    return Ring
"""


def run_module(path):
    """As `sysid run` does; what its problem() gives is no problem."""
    with pytest.raises(sysid.InputError, match="not a sysid.Problem"):
        catalogue.build(Recipe(str(path)))


def test_classes_of_a_problem_module_and_beside_it_are_stored_by_names_that_another_process_knows(
    tmp_path, monkeypatch
):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "light_house.py").write_text(PROBLEM)
        (tmp_path / folder / "rings_beside.py").write_text(OWN)
    before = {*sys.modules}
    try:
        run_module(tmp_path / "one" / "light_house.py")
        (private,) = (sys.modules[name] for name in sys.modules if name.endswith("_light_house"))
        trees = [model_to_tree(model) for model in (private.Light(0.001, 0.1), private.Ring(3))]
        assert [tree["kind"] for tree in trees] == ["light_house:Light", "rings_beside:Ring"]
        assert "rings_beside" not in sys.modules
        light, ring = map(model_from_tree, trees)
        assert type(light) is private.Light and light.upper == 0.1
        assert type(ring) is private.Ring and ring.sectors == 3
        run_module(tmp_path / "two" / "light_house.py")
        with pytest.raises(sysid.InputError, match="Light stands in several modules named 'light_house'"):
            model_from_tree(trees[0])
    finally:
        for name in {*sys.modules} - before:
            del sys.modules[name]


def test_a_model_of_a_later_sysid_is_named():
    with pytest.raises(sysid.InputError, match="model 'Foam' is unknown to this sysid"):
        model_from_tree({"kind": "Foam", "fields": {}})


def test_what_could_not_be_found_again_is_refused():
    class Inside(sysid.LumpedMass):
        pass

    with pytest.raises(sysid.InputError, match="Inside cannot be stored: its class stands inside a function"):
        model_to_tree(Inside(3.0))
    with pytest.raises(sysid.InputError, match=r"object cannot be stored: its class needs a method to_tree"):
        model_to_tree(object())


def test_a_tree_of_the_users_own_that_holds_something_else_is_refused_early(tanks, monkeypatch):
    monkeypatch.setattr(tanks.Tank.Half, "to_tree", lambda self: {"when": object()})
    with pytest.raises(sysid.InputError, match="/mass/fields/when: a object cannot be stored"):
        check_tree(stored.to_tree({"mass": tanks.Tank.Half([]), "stiffness": np.eye(1), "damping": np.eye(1)}))
