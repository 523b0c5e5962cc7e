"""Limits of CasADi's expressions, and of a problem, are told with the line and what to write."""

import linecache
import re

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.models.stiffness_and_damping import check_rigid

FREQ = np.linspace(1.0, 30.0, 25)
MASSES, SPRINGS = np.array([3.0, 2.0, 1.0]), np.array([2e4, 1.5e4, 1e4])
M, ONE, T = np.diag(MASSES), np.ones((3, 1)), np.eye(3) - np.eye(3, k=-1)


def whole(K, G=None):
    """A stiffness with the base's rows last."""
    G = np.ones((len(K), 1)) if G is None else G
    return np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])


K_TRUE = T.T @ np.diag(SPRINGS) @ T
TEST = sysid.simulate(sysid.Structure(np.diag([*MASSES, 0.0]), whole(K_TRUE), [0.01, 0.02, 0.03], n_base=1), FREQ)


def chain(k):
    return ca.DM(T).T @ ca.diag(k) @ ca.DM(T)


def declare(name, shape=(), lower=0.5, upper=1.5):
    return sysid.Variable(name, shape, lower=lower, upper=upper)


def springs():
    return declare("springs", 3, 1e3, 1e5)


def build(**given):
    return sysid.Problem(TEST, **{"mass": M, "damping": [0.01, 0.01, 0.01], **given})


# What is asked of expressions that CasADi cannot do: raised at once, with the line.
SYMBOLIC = {
    "chained relations": (lambda k, z: k[0] <= k[1] <= 1e6, "[lower <= k, k <= upper]"),
    "an if": (lambda k, z: 1 if k[0] > 3 else 2, "ca.if_else"),
    "an if on a variable itself": (lambda k, z: 1 if k else 2, "ca.if_else"),
    "the larger of two": (lambda k, z: max(k[0], k[1]), "ca.fmax(a, b)"),
    "both of two": (lambda k, z: (k[0] <= k[1]) and (k[1] <= k[2]), "of `a and b` [a, b]"),
    "a complex stiffness": (lambda k, z: build(stiffness=(1 + 0.02j * z) * chain(k)), "damping=[eta / 2"),
    "a complex damping of a variable": (lambda k, z: build(stiffness=chain(k), damping=1j * k), "real ones only"),
    "a complex ratio of variables": (
        lambda k, z: build(stiffness=chain(k), damping=[0.01, 0.01, 1j * z]), "damping=[eta / 2"
    ),
    "a complex exponential in a mass": (
        lambda k, z: build(stiffness=chain(k), mass=np.exp(-1j * z) * M), "ca.cos(a) and -ca.sin(a)"
    ),
    "a complex relation": (lambda k, z: k[0] <= 1j, "real ones only"),
    "a complex power": (lambda k, z: k**1j, "real ones only"),
    "records less a response among residuals": (
        lambda k, z: build(
            stiffness=chain(k),
            residuals=[TEST.response[0] - sysid.FurtherTest(TEST, mass=M, stiffness=chain(k), damping=M).response],
        ),
        "sysid.real_and_imaginary(record - response)",
    ),
    "records less an expression in place of the misfit": (
        lambda k, z: build(stiffness=chain(k), misfit=TEST.response[0, 0, :3] - k), "sysid.real_and_imaginary(record"
    ),
    "a complex entry": (
        lambda k, z: build(stiffness=[[k[0], 1j, 0], [1j, k[1], 0], [0, 0, k[2]]]), "real ones only"
    ),
    "a complex damping": (lambda k, z: build(stiffness=chain(k), damping=0.01j * M), "give its real part"),
    "a complex ratio": (lambda k, z: build(stiffness=chain(k), damping=[0.01 + 0.1j] * 3), "give its real part"),
    "a complex known mass": (lambda k, z: build(stiffness=chain(k), mass=M * (1 + 0.1j)), "give its real part"),
    "a test among residuals": (lambda k, z: build(stiffness=chain(k), residuals=[TEST]), "sysid.FurtherTest(test, "),
    "base rows first in the mass": (
        lambda k, z: build(stiffness=chain(k), mass=ca.diag(ca.vertcat(0, z, z, z))), "no mass in its first row"
    ),
    "base rows first in a known mass": (
        lambda k, z: build(stiffness=chain(k), mass=np.diag([0.0, *MASSES])), "no mass in its first row"
    ),
    "two factors as damping": (
        lambda k, z: build(stiffness=chain(k), damping=(z, declare("a", (), 0, 1))), "write a list, [a, b], for ratios"
    ),
    "two entries of a column as damping": (
        lambda k, z: build(stiffness=chain(k), damping=(k[0], k[1])), "write a list, [a, b], for ratios"
    ),
    "a float": (lambda k, z: float(k[0]), "fixed=True"),
    "a float of a variable": (lambda k, z: float(z), "fixed=True"),
    "an int": (lambda k, z: int(k[0] + 1), "fixed=True"),
    "an entry that is changed": (lambda k, z: k.__setitem__(0, 9e3), "ca.vertcat(a, b, c)"),
    "recovery of variables": (
        lambda k, z: build(stiffness=chain(k), recovery=z * np.eye(3)), "is written in variables, and it must be"
    ),
    "recovery of numbers and variables": (
        lambda k, z: build(stiffness=chain(k), recovery=[[z, 0, 0], [0, 1, 0], [0, 0, 1]]), "it must be numbers"
    ),
    "motion of the base in variables": (
        lambda k, z: build(stiffness=chain(k), recovery=np.eye(3), rigid_body_dofs=z * ONE), "rigid_body_dofs ("
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", SYMBOLIC)
def test_what_no_expression_can_do_is_told_with_its_line_and_a_remedy(mistake, pytestconfig, monkeypatch):
    monkeypatch.chdir(pytestconfig.rootpath)
    wrong, remedy = SYMBOLIC[mistake]
    line = wrong.__code__.co_firstlineno
    with pytest.raises(sysid.InputError) as caught:
        wrong(springs(), declare("other"))
    message = str(caught.value)
    assert remedy in message
    assert "\n" not in message
    told = int(re.search(r"test_modelling_language\.py, line (\d+)", message).group(1))
    assert line <= told <= line + 3 or "sysid.Problem(" in linecache.getline(__file__, told)  # in `build`


def test_what_is_written_with_operators_is_a_casadi_expression_of_the_same_value():
    k, z = springs(), declare("other")
    x, y = np.array([2e3, 3e3, 5e3]), 1.25
    written = [
        (k[0] + 1, x[0] + 1), (1 + k[1], 1 + x[1]), (k - x, x - x), (x - k, x - x), (2 * k[1:], 2 * x[1:]),
        (k / z, x / y), (1 / k, 1 / x), (z**3, y**3), (2**z, 2**y), (T @ k, T @ x), (-abs(-k), -x),
        (np.exp(z) * np.ones(3), np.exp(y) * np.ones(3)), (np.float64(3) * z, 3 * y),
        (k[0] * ca.sum1(k), x[0] * x.sum()),
    ]  # fmt: skip
    for expression, value in written:
        assert isinstance(expression, ca.MX)
        found = ca.Function("f", [k.symbol, z.symbol], [expression])(x, y)
        np.testing.assert_allclose(np.asarray(found).ravel(), np.ravel(value), rtol=1e-14)


def test_a_relation_that_is_settled_has_a_value():
    k = springs()
    assert bool(k[0] == k[0]) is True
    assert bool(k[0] != k[0]) is False


def test_a_list_of_two_variables_is_a_ratio_a_mode():
    truth = sysid.Structure(
        np.diag([3.0, 2.0, 0.0]), whole(np.array([[3e4, -1e4], [-1e4, 1e4]])), [0.02, 0.03], n_base=1
    )
    test = sysid.simulate(truth, FREQ)
    a, b = declare("a", (), 0.0, 0.1), declare("b", (), 0.0, 0.1)
    problem = sysid.Problem(test, mass=truth.mass, stiffness=truth.stiffness, damping=[a, b])
    np.testing.assert_allclose(problem.structure([0.02, 0.03]).damping_ratios, [0.02, 0.03], rtol=1e-12)


def test_a_stiffness_with_the_base_first_is_told_where_the_motion_of_the_base_shows_it():
    G = np.array([[1.0], [0.5], [0.0]])
    last = whole(K_TRUE, G)
    check_rigid(ca.MX(last), G)
    with pytest.raises(sysid.InputError, match=r"test_modelling_language\.py, line \d+\) has the rows .* base first"):
        check_rigid(ca.MX(np.roll(last, (1, 1), (0, 1))), G)
    last[0, 3] += 1.0
    with pytest.raises(sysid.InputError, match="strains when the base moves"):
        check_rigid(ca.MX(last), G)
