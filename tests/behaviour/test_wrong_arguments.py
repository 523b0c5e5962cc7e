"""Whatever is given in the place of one argument: an InputError that names it, or an object that works."""

import inspect
from datetime import date
from fractions import Fraction
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sysid

FREQ = np.linspace(1.0, 5.0, 40)
TRUTH = sysid.Structure(
    np.diag([2.0, 1.0, 0.0]), 1e3 * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]]), [0.01, 0.02], n_base=1
)
TEST = sysid.simulate(TRUTH, FREQ)
SENSORS = [sysid.Sensor("low", (0, 0, 1), "x"), sysid.Sensor("high", (0, 0, 2), "x")]
K = sysid.Variable("k", 2, lower=1.0, upper=9.0)
STIFFNESS = ca.blockcat([[K[0] + K[1], -K[1]], [-K[1], K[1]]])
SHAKEN = [(np.sin(np.arange(64.0) ** 2)[None], np.cos(np.arange(128.0).reshape(2, 64) ** 2), None)]
PROBLEM = sysid.Problem(TEST, mass=sysid.FullMass(3.0))


class BeganError(Exception):
    """A search began: what it was given passed."""


def began(*_):
    raise BeganError


def identify(**arguments):
    with pytest.raises(BeganError):
        sysid.identify(**({"progress": began, "callback": None} | arguments))


def in_a_problem(**models):
    return lambda model: sysid.Problem(TEST, **({"mass": sysid.FullMass(3.0)} | dict.fromkeys(models, model)))


# What is made, and arguments of which all are right.
CASES = {
    "Sensor": (sysid.Sensor, {"name": "tip", "position": (0, 0, 1), "axis": "x"}),
    "rigid_body": (
        sysid.rigid_body, {"positions": [[0, 0, 1.0]], "axes": ["x"], "base_axes": "x", "origin": (0, 0, 0)},
    ),
    "Structure": (
        sysid.Structure,
        {
            "mass": TRUTH.mass, "stiffness": TRUTH.stiffness, "damping_ratios": [0.01, 0.02], "n_base": 1,
            "damping_matrix": None, "rigid_body": None, "recovery": None, "sensors": SENSORS,
        },
    ),
    "Measurement": (
        sysid.Measurement,
        {
            "freq": FREQ, "base": TEST.base, "response": TEST.response, "rigid_body": TEST.rigid_body, "force": None,
            "sensors": SENSORS, "response_std": 0.1, "force_std": None, "base_axes": "x",
        },
    ),
    "Measurement.from_frf": (
        sysid.Measurement.from_frf,
        {
            "freq": FREQ, "frf": TEST.response[0], "rigid_body": TEST.rigid_body, "force": None, "sensors": None,
            "response_std": 0.1, "force_std": None, "base_axes": None,
        },
    ),
    "Measurement.from_time": (
        sysid.Measurement.from_time,
        {
            "runs": SHAKEN, "sample_rate": 10.0, "rigid_body": TEST.rigid_body, "estimator": "h1", "segment": 16,
            "band": (1.0, 4.0), "sensors": None, "base_axes": None,
        },
    ),
    "resample": (
        sysid.resample, {"records": [(np.arange(9.0), np.ones(9)), (np.arange(9.0), np.ones(9))], "sample_rate": 1.0},
    ),
    "simulate": (
        sysid.simulate,
        {"structure": TRUTH, "freq": FREQ, "noise": 0.1, "force": True, "rng": 1, "base_axes": None},
    ),
    "Unknown": (
        sysid.Unknown, {"name": "share", "lower": [0.0, 1.0], "upper": [2.0, 3.0], "unit": "kg", "relative": False},
    ),
    "Variable": (
        sysid.Variable,
        {
            "name": "k", "shape": 2, "lower": 1.0, "upper": 2.0, "guess": 1.5, "log": True, "fixed": False,
            "unit": "N/m",
        },
    ),
    "FullMass": (sysid.FullMass, {"total_mass": 3.0, "healing": "trace", "known": None}),
    "LumpedMass": (sysid.LumpedMass, {"total_mass": 3.0}),
    "KnownMass": (sysid.KnownMass, {"matrix": np.diag([2.0, 1.0])}),
    "SpectralStiffness": (sysid.SpectralStiffness, {"natural_frequencies": [2.0, 4.0], "max_frequency": 5.0}),
    "ChainStiffness": (sysid.ChainStiffness, {"lower": 1e3, "upper": [1e5, 1e6]}),
    "ModalDamping": (sysid.ModalDamping, {"lower": 0.01, "upper": 0.1}),
    "ProportionalDamping": (sysid.ProportionalDamping, {"alpha": (0.0, 1.0), "beta": (0.0, 1e-3)}),
    "Prior": (sysid.Prior, {"expression": K, "value": [2.0, 3.0], "std": 0.1}),
    "FurtherTest": (
        sysid.FurtherTest,
        {
            "measurement": TEST, "mass": np.diag([2.0, 1.0]), "stiffness": STIFFNESS, "damping": 0.01 * STIFFNESS,
            "recovery": None, "rigid_body_dofs": None,
        },
    ),
    "Problem": (
        sysid.Problem,
        {
            "measurement": TEST, "mass": sysid.FullMass(3.0), "stiffness": sysid.SpectralStiffness(),
            "damping": sysid.ModalDamping(), "residuals": [], "constraints": [], "misfit": None, "recovery": None,
            "rigid_body_dofs": None, "healing": {}, "reference": TRUTH, "validation": [TEST], "goal": 0.1,
        },
    ),
    "Swarm": (
        sysid.Swarm,
        {
            "max_iterations": 9, "n_particles": 9, "stall_iterations": 9, "stall_tolerance": 0.1, "refine": True,
            "refine_by": "ipopt", "write_back": False, "gradient_every": 0, "local": "modal", "restarts": 1,
            "settings": sysid.SwarmSettings(), "name": "swarm",
        },
    ),
    "SwarmSettings": (
        sysid.SwarmSettings, dict.fromkeys(inspect.signature(sysid.SwarmSettings).parameters, 1) | {"guides": 2},
    ),
    "minimize_swarm": (
        sysid.minimize_swarm,
        {
            "fun": lambda rows: rows.sum(axis=1), "bounds": [(0, 1), (0, 2)], "rng": 1, "n_particles": 4,
            "max_iterations": 2, "max_evaluations": 20, "max_time": 1.0, "target": 0.1, "stall_iterations": 2,
            "stall_tolerance": 0.1, "callback": None, "improve": None, "improve_every": 0, "on_leader": None,
            "repair": None, "x0": [0.5, 0.5], "settings": None,
        },
    ),
    "Continuation": (sysid.Continuation, {"starts": 2}),
    "Modal": (sysid.Modal, {"sensors": [0, 1], "max_iterations": 9}),
    "Recipe": (
        sysid.Recipe, {"module": "tower", "data": None, "rng": 0, "parameters": {"floors": 3}, "start": (1.0, 2.0)},
    ),
    "identify": (
        identify,
        {
            "problem": PROBLEM, "strategy": "modal", "rng": 1, "start": None, "max_time": 9.0,
            "max_evaluations": 99,
        },
    ),
    "load": (sysid.load, {"path": "nowhere.h5"}),
}  # fmt: skip

# A matrix model that was made goes into a problem.
USED = {
    "FullMass": in_a_problem(mass=...), "LumpedMass": in_a_problem(mass=...), "KnownMass": in_a_problem(mass=...),
    "SpectralStiffness": in_a_problem(stiffness=...), "ChainStiffness": in_a_problem(stiffness=...),
    "ModalDamping": in_a_problem(damping=...), "ProportionalDamping": in_a_problem(damping=...),
}  # fmt: skip


# What else a message calls an argument: an entry of it, or what contradicts it.
ALIASES = {
    "axes": ["axis"], "runs": ["run 1"], "records": ["record 1"], "path": ["no result at"], "bounds": ["x0"],
    "sample_rate": ["line between", "one above", "clocks", "low-pass"], "segment": ["line between"],
    "band": ["line between"],
    "rigid_body": ["run 1"], "residuals": ["residual 1"], "constraints": ["constraint 1"],
    "damping_ratios": ["damping ratio"],
}  # fmt: skip


class Nothing:
    """An object of a class that the package does not know."""

    def __repr__(self):
        return "<nothing>\n<at all>"


SINGLE = [
    None, "", "a", "2", "x y", b"x", np.nan, np.inf, -np.inf, -1, -1.5, 0, 1.9, 1e300, 1e-300, 10**400, 1j, True,
    np.True_, np.float64(2.5), np.int64(2), np.datetime64("2020-01-01"), date(2020, 1, 1), Fraction(1, 3), Nothing(),
    began, Path("x"), {}, {"a": 1}, {1, 2}, range(2), ca.MX.sym("free"), ca.SX.sym("free", 2), ca.DM(3), K,
    np.ma.masked_array([1.0, 2.0], [False, True]), TEST, TRUTH, SENSORS[0], sysid.FullMass(3.0),
]  # fmt: skip
# By their places: Hypothesis would compare and hash the objects themselves, which for a Variable writes expressions.
PLACES = st.integers(0, len(SINGLE) - 1)
NUMBERS = st.one_of(st.floats(), st.integers(-3, 5), st.sampled_from([None, "a", 1j, np.nan]))
WRONG = st.one_of(
    PLACES.map(SINGLE.__getitem__),
    PLACES.map(lambda place: [SINGLE[place]]),
    st.lists(NUMBERS, max_size=3),
    st.lists(st.lists(NUMBERS, max_size=3), max_size=3),
    st.tuples(st.sampled_from([(), (1,), (2,), (40,), (2, 2), (3, 3), (1, 2, 40), (0, 2)]), st.floats()).map(
        lambda drawn: np.full(*drawn)
    ),
    st.text(max_size=4),
)


@pytest.mark.parametrize("name", CASES)
@settings(derandomize=True, max_examples=40, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_wrong_argument_is_refused_by_name_or_what_is_made_works(name, data):
    make, right = CASES[name]
    argument = data.draw(st.sampled_from(sorted(right)))
    check(name, make, right, argument, data.draw(WRONG))


def check(name, make, right, argument, wrong):
    try:
        made = make(**(right | {argument: wrong}))
        assert repr(made)
        USED.get(name, repr)(made)
    except BeganError:  # a function of ours was called
        pass
    except sysid.InputError as error:
        said = str(error).lower().replace("_", " ")
        words = (argument, name, *ALIASES.get(argument, ()))
        assert any(word.lower().replace("_", " ") in said for word in words), said
        assert len(said) < 400, said


TWO_WAYS = sysid.Measurement(FREQ, np.repeat(np.eye(2)[:, :, None], 40, 2), np.ones((2, 2, 40)), rigid_body=np.eye(2))
STORED = {"freq": FREQ, "base": TWO_WAYS.base, "response": TWO_WAYS.response, "rigid_body": np.eye(2)}
MASKED = np.ma.masked_array(np.ones((2, 40)), np.arange(80).reshape(2, 40) == 3)
LEVELS = sysid.NoiseLevels([0.1, 0.1], [0.1])


def in_directions(*axes, **arguments):
    sensors = [sysid.Sensor(f"s{i}", (0, 0, i), axis) for i, axis in enumerate(axes)]
    return sysid.Measurement(**(STORED | {"sensors": sensors} | arguments))


def from_time(**arguments):
    return sysid.Measurement.from_time(SHAKEN, 10.0, rigid_body=TEST.rigid_body, **arguments)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: in_directions("-x", "y", base_axes="xy"), "'s0' has the axis '-x', but by its row"),
        (lambda: in_directions("x", "z", base_axes="xy"), "'s1' has the axis 'z'"),
        (lambda: in_directions("x", "x"), "'s1' has the axis 'x'|'s0' has the axis 'x'"),
        (lambda: sysid.Measurement(**(STORED | {"response": [list(MASKED)] * 2})), "response has masked entries"),
        (lambda: sysid.Measurement(**(STORED | {"response": np.zeros((2, 2, 40))})), "response is zero everywhere"),
        (lambda: sysid.Measurement(**STORED, dropped=-1), "dropped is -1"),
        (lambda: from_time(segment=16), "segment goes with 'h1' and 'h2'"),
        (lambda: from_time(estimator="h1", at_rest=True), "at_rest goes with estimator='records'"),
        (lambda: from_time(estimator="spectra", noise=LEVELS), "noise goes with estimator='records'"),
        (lambda: from_time(noise=0.1), "noise is a float, not a sysid.NoiseLevels"),
        (lambda: sysid.ProportionalDamping(), "alpha is missing; give its bounds"),
        (lambda: sysid.ProportionalDamping((0.0, 1.0)), "beta is missing; give its bounds"),
        (lambda: sysid.ChainStiffness(1e3), "upper is missing; give bounds"),
        (lambda: sysid.ChainStiffness(1e5, 1e3), "0 < lower < upper"),
        (lambda: sysid.Structure(TRUTH.mass, TRUTH.stiffness, [0.01, 0.02], n_base=1.9), "n_base is 1.9"),
        (lambda: sysid.Sensor("tip", (0, 0, np.nan), "x"), "the position of sensor 'tip' holds NaN"),
        (lambda: sysid.Sensor("tip", (0, 0, 1), (0, np.inf, 1)), "the axis of sensor 'tip' holds NaN or infinite"),
        (
            lambda: sysid.Problem(
                TEST, mass=sysid.FullMass(known=np.eye(2)), stiffness=sysid.ChainStiffness(1.0, 1e5)
            ).check(),
            "known entries of a FullMass.* go with the modal strategy only",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_right_is_refused(make, said):
    with pytest.raises(sysid.InputError, match=said):
        make()


def test_sensors_along_their_rows_are_taken_whatever_the_direction_of_the_base():
    assert in_directions("x", (0.0, 2.0, 0.0), base_axes="xy").base_axes == ("x", "y")
    askew = in_directions("x", "y", base=TWO_WAYS.base[:, :1], rigid_body=[[0.6], [0.8]])
    assert askew.in_band(1.0, 3.0).n_base == 1


@pytest.mark.parametrize("name", CASES)
def test_the_right_arguments_are_right(name):
    make, right = CASES[name]
    if name == "load":
        with pytest.raises(sysid.InputError, match=r"no result at nowhere\.h5"):
            make(**right)
    else:
        make(**right)
