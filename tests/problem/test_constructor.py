"""Putting a problem together: nothing is searched, and no graph of the matrices of a model is built."""

import time

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.modal_analysis import fit, modal_estimate
from sysid.problem import formulation, matrices
from sysid.swarm import box

SPRINGS = np.array([2e4, 1.5e4, 1e4])
FREQ = np.linspace(1.0, 30.0, 60)
ONE = np.ones((3, 1))
K = np.diag([3.5e4, 2.5e4, 1e4]) - np.diag([1.5e4, 1e4], 1) - np.diag([1.5e4, 1e4], -1)
TRUTH = sysid.Structure(
    np.diag([3.0, 2.0, 1.0, 0.5]), np.block([[K, -K @ ONE], [-ONE.T @ K, ONE.T @ K @ ONE]]), [0.01] * 3, n_base=1
)
TEST = sysid.simulate(TRUTH, FREQ)
WEIGHED = sysid.simulate(TRUTH, FREQ, force=True)


def unknown():
    return sysid.Variable("k", 3, lower=1e3, upper=1e5, guess=SPRINGS)


def chain(k):
    T = ca.DM(np.eye(3) - np.eye(3, k=-1))
    return T.T @ ca.diag(k) @ T


def further(k):
    return sysid.FurtherTest(TEST, mass=np.diag([3.0, 2, 1]), stiffness=chain(k), damping=np.eye(3))


PROBLEMS = {
    "full mass": lambda k: {"mass": sysid.FullMass(6.5)},
    "frequencies stated": lambda k: {"mass": sysid.LumpedMass(6.0), "stiffness": sysid.SpectralStiffness([5, 15, 25])},
    "a limit of frequencies that is low": lambda k: {
        "mass": sysid.LumpedMass(6.0), "stiffness": sysid.SpectralStiffness(max_frequency=29.0)
    },
    "weighed by the base force": lambda k: {"mass": sysid.FullMass(), "measurement": WEIGHED},
    "written": lambda k: {"mass": np.diag([3.0, 2, 1]), "stiffness": chain(k), "damping": 1e-3 * chain(k)},
    "a further test": lambda k: {"mass": sysid.LumpedMass(6.0), "stiffness": chain(k), "residuals": [further(k)]},
    "a prior": lambda k: {"mass": sysid.FullMass(6.5), "residuals": [sysid.Prior(k[0], 2e4, 10.0)]},
    "a constraint and healing": lambda k: {
        "mass": sysid.LumpedMass(6.0), "stiffness": chain(k), "constraints": [ca.sum1(k) == 4.5e4],
        "healing": {k: 4.5e4 * k / ca.sum1(k)},
    },
    "a misfit": lambda k: {"mass": sysid.FullMass(6.5), "misfit": k / SPRINGS - 1},
}  # fmt: skip


@pytest.fixture
def calls(monkeypatch):
    """Names of the searches that ran."""
    ran = []

    def counted(module, name):
        was = getattr(module, name)

        def called(*given, **options):
            ran.append(name)
            return was(*given, **options)

        monkeypatch.setattr(module, name, called)

    counted(modal_estimate, "find_poles")
    counted(fit, "find_poles")
    counted(formulation, "noise_level")
    counted(matrices, "weighed_mass")
    counted(ca, "nlpsol")
    counted(box, "latin_hypercube")
    return ran


@pytest.mark.parametrize("which", PROBLEMS)
def test_nothing_is_searched(calls, which):
    given = {"measurement": TEST, **PROBLEMS[which](unknown())}
    made = sysid.Problem(given.pop("measurement"), **given)
    repr(made)
    assert calls == []
    assert "formulation" not in vars(made)


@pytest.mark.parametrize(
    ("which", "searches"),
    [
        ("full mass", {"find_poles"}),
        ("frequencies stated", {"find_poles", "latin_hypercube"}),  # damping is searched about the poles' ratios
        ("a limit of frequencies that is low", {"find_poles", "latin_hypercube"}),
        ("weighed by the base force", {"find_poles", "weighed_mass"}),
        ("written", {"find_poles", "latin_hypercube"}),
        ("a further test", {"find_poles", "latin_hypercube"}),
        ("a prior", {"find_poles", "latin_hypercube"}),
        ("a constraint and healing", {"find_poles", "nlpsol", "latin_hypercube"}),
        ("a misfit", {"find_poles", "latin_hypercube"}),
    ],
)
def test_what_is_needed_is_searched_by_the_check_and_once(calls, which, searches):
    given = {"measurement": TEST, **PROBLEMS[which](unknown())}
    made = sysid.Problem(given.pop("measurement"), **given)
    made.check()
    assert set(calls) == searches
    assert calls.count("find_poles") <= len(made.tests)
    assert calls.count("weighed_mass") <= 1
    calls.clear()
    assert made.formulation is made.formulation
    assert made.totals.shape == (1,)
    assert made.lower.shape == (made.n_variables,)
    assert calls == []


def many(n, lines):
    """Random records of many sensors."""
    rng = np.random.default_rng(0)
    base = np.repeat(np.eye(3)[:, :, None], lines, axis=2)
    record = rng.normal(size=(3, n, lines))
    return sysid.Measurement(np.linspace(1, 200, lines), base, record, rigid_body=np.eye(3)[np.arange(n) % 3])


def test_three_hundred_sensors_and_two_thousand_lines_take_less_than_a_second():
    test = many(300, 2000)
    begun = time.process_time()
    sysid.Problem(test, mass=sysid.FullMass(9.0))
    assert time.process_time() - begun < 1.0


@pytest.mark.parametrize("beside", ["nothing", "prior"])
def test_no_graph_is_built_of_a_large_full_mass(monkeypatch, beside):
    """Neither by the constructor, nor by bounds, guesses, constraints, priors and tables of the unknowns."""
    u = sysid.Variable("u", lower=0.0, upper=2.0)
    given = {} if beside == "nothing" else {"residuals": [sysid.Prior(u, 1.0, 0.1)], "constraints": [u <= 1.5]}
    test = many(60, 12)
    operations = []
    build = ca.Function.__init__

    def counted(self, *arguments):
        build(self, *arguments)
        operations.append(self.n_instructions() if self.is_a("SXFunction") else 0)

    monkeypatch.setattr(ca.Function, "__init__", counted)
    stiffness = sysid.SpectralStiffness(np.linspace(1, 200, 60))
    made = sysid.Problem(test, mass=sysid.FullMass(9.0), stiffness=stiffness, **given)
    assert operations == [] or beside == "prior"
    f = made.formulation
    assert f.free_modes
    assert f.guess.shape == made.lower.shape == (made.n_variables,)
    assert f.constraints.lower.size == len(f.priors) == len(given.get("constraints", ()))
    assert dict(made.unknowns)["mass"] == 63 * 64 // 2
    assert made.prepared.keeps_constraints(f.guess)
    # The sampling of each entry takes some operations; a product of matrices would take 60 times as many.
    assert max(operations) < 30 * made.n_variables


def test_the_geometry_before_a_search_has_poles_and_weights_that_are_made_up(calls):
    made = sysid.Problem(WEIGHED, mass=sysid.FullMass())
    before = made.declared.geometry
    np.testing.assert_array_equal(before.weighed, [1.0])
    assert before.poles.omega.shape == (3,)
    assert calls == []
    assert (before.n, before.d, before.weighs, before.at_sensors) == (3, 1, True, True)
    np.testing.assert_allclose(made.geometry.weighed, TRUTH.rigid_body_mass.diagonal(), rtol=1e-3)
    assert calls.count("weighed_mass") == calls.count("find_poles") == 1
    assert not sysid.Problem(TEST, mass=sysid.FullMass()).geometry.weighs


def test_a_base_that_stands_still_in_a_direction_weighs_nothing_there():
    """Refused at once where a total is to be weighed, and of no matter where it is stated."""
    G = np.eye(2)[[0, 1, 0]]
    base = np.array([np.ones((2, 5)) * [[1.0], [0.0]]])
    test = sysid.Measurement(
        np.arange(1.0, 6), base, np.random.default_rng(0).normal(size=(1, 3, 5)), rigid_body=G, force=np.ones((1, 2, 5))
    )
    stiffness = sysid.SpectralStiffness([2.0, 3.0, 4.0])
    for mass in (sysid.FullMass, sysid.LumpedMass):
        with pytest.raises(sysid.InputError, match="the base moves in only 1 of 2 independent directions"):
            sysid.Problem(test, mass=mass(), stiffness=stiffness)
        assert sysid.Problem(test, mass=mass(5.0), stiffness=stiffness).n_variables > 0
