"""Every mistake of an author gives one InputError, with the name of a variable and the place of its declaration."""

import warnings

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.search.swarm_objective import SwarmObjective

FREQ = np.linspace(1.0, 30.0, 25)
MASSES, SPRINGS = np.array([3.0, 2.0, 1.0]), np.array([2e4, 1.5e4, 1e4])
ONE, T = np.ones((3, 1)), np.eye(3) - np.eye(3, k=-1)


def chain(k):
    return ca.DM(T).T @ ca.diag(k) @ ca.DM(T)


K_TRUE = T.T @ np.diag(SPRINGS) @ T
TRUTH = sysid.Structure(
    np.diag([*MASSES, 0.0]),
    np.block([[K_TRUE, -K_TRUE @ ONE], [-ONE.T @ K_TRUE, ONE.T @ K_TRUE @ ONE]]),
    damping_matrix=0.2 * np.diag(MASSES) + 2e-4 * K_TRUE,
    n_base=1,
)
TEST = sysid.simulate(TRUTH, FREQ)
M = np.diag(MASSES)


def declare(name, shape=3, lower=1e3, upper=1e5, **options):
    """Variables of these tests are declared in this module, whose name every message must have."""
    return sysid.Variable(name, shape, lower=lower, upper=upper, **options)


def springs():
    return declare("springs")


def build(**given):
    given = {"mass": M, "damping": [0.01, 0.01, 0.01], **given}
    return sysid.Problem(given.pop("measurement", TEST), **given)


def based(K, k):
    """With columns of the base that have the wrong sign."""
    b = ca.vertcat(k[0], 0, 0)
    return ca.blockcat([[K, b], [b.T, k[0]]])


def uneven(k):
    K = chain(k)
    K[0, 1] = 1.1 * K[0, 1]
    return K


# What is wrong, the problem that has it, words of its message, and the variables that it must name.
MISTAKES = {
    "not square": (lambda k, z: {"stiffness": ca.horzcat(k, k)}, "stiffness is 3 x 2, and a square", ["springs"]),
    "a column": (lambda k, z: {"stiffness": k}, "3 x 1, and a square matrix is needed", ["springs"]),
    "a flat list": (lambda k, z: {"stiffness": [k[0], k[1], k[2]]}, "3 x 1, and a square", ["springs"]),
    "not symmetric": (lambda k, z: {"stiffness": uneven(k)}, "stiffness is not symmetric", ["springs"]),
    "mass not symmetric": (
        lambda k, z: {"mass": M + z * np.eye(3, k=1), "stiffness": chain(k)}, "mass is not symmetric", ["other"]
    ),
    "damping not symmetric": (
        lambda k, z: {"damping": z * np.eye(3, k=1) + M, "stiffness": chain(k)}, "damping is not symmetric", ["other"]
    ),
    "not symmetric away from the guess": (
        lambda k, z: {"stiffness": chain(k) + (z - 1) * 1e4 * np.eye(3, k=1)}, "away from the guess",
        ["springs", "other"],
    ),
    "logarithm of zero": (
        lambda k, z: {"stiffness": chain(k) * ca.log(z - 1)}, "-inf at the guess",
        ["springs", "other"],
    ),
    "division by zero": (lambda k, z: {"mass": M / (z - 1), "stiffness": chain(k)}, "inf at the guess", ["other"]),
    "damping no number": (
        lambda k, z: {"damping": M * ca.sqrt(z - 3), "stiffness": chain(k)}, "nan at the guess", ["other"]
    ),
    "residual no number": (
        lambda k, z: {"stiffness": chain(k), "residuals": [z, ca.log(z - 1)]},
        "residual 2 is -inf at the guess", ["other"],
    ),
    "constraint no number": (
        lambda k, z: {"stiffness": chain(k), "constraints": [1 / (z - 1) <= 3]}, "constraint 1 is inf at", ["other"]
    ),
    "misfit no number": (
        lambda k, z: {"stiffness": chain(k), "misfit": ca.sqrt(z - 3) * k}, "misfit [0] is nan at the guess", ["other"]
    ),
    "no point keeps a linear constraint": (
        lambda k, z: {"stiffness": chain(k), "constraints": [ca.sum1(k) <= 0]}, "no point within the bounds",
        ["springs"],
    ),
    "no point keeps an equality": (
        lambda k, z: {"stiffness": chain(k), "constraints": [k[0] == 2e5]}, "no point within the bounds", ["springs"]
    ),
    "no point keeps a nonlinear constraint": (
        lambda k, z: {"stiffness": chain(k) * z, "constraints": [z**2 + z * k[0] / 1e9 == -1]},
        "satisfies constraint 1", ["springs", "other"],
    ),
    "two constraints contradict each other": (
        lambda k, z: {"stiffness": chain(k), "constraints": [k[0] + 2e4 <= k[1], k[1] <= k[0]]},
        "satisfies constraint 1", ["springs"],
    ),
    "two equalities contradict each other": (
        lambda k, z: {"stiffness": chain(k), "constraints": [ca.sum1(k) == 5e4, ca.sum1(k) == 6e4]},
        "and constraint 2", ["springs"],
    ),
    "mass nowhere positive definite": (
        lambda k, z: {"mass": -z * M, "stiffness": chain(k)}, "mass is not positive definite", ["other"]
    ),
    "stiffness nowhere positive definite": (
        lambda k, z: {"stiffness": ca.diag(ca.vertcat(k[:2], 0))}, "stiffness is not positive definite", ["springs"]
    ),
    "base columns with the wrong sign": (
        lambda k, z: {"stiffness": based(chain(k), k)}, "K_S0 must be -K_SS G", ["springs"]
    ),
}  # fmt: skip


# What only points of the search space show, or IPOPT: the constructor takes it, and `check` refuses it.
SEARCHED = {mistake for mistake in MISTAKES if mistake.startswith(("no point", "two ")) or "nowhere" in mistake}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused_with_names_and_places(mistake):
    given, words, names = MISTAKES[mistake]
    k, z = springs(), declare("other", (), 0.5, 1.5)
    if mistake in SEARCHED:
        problem = build(**given(k, z))
        with pytest.raises(sysid.InputError) as caught:
            problem.check()
    else:
        with pytest.raises(sysid.InputError) as caught:
            build(**given(k, z))
    message = str(caught.value)
    assert words in message
    for name in names:
        assert f"'{name}' (" in message
        assert "test_declarations.py, line " in message
    assert "\n" not in message


UNNAMED = {
    "stiffness too large": (lambda k, z: {"stiffness": ca.diagcat(chain(k), chain(k))}, "6 x 6"),
    "mass too small": (lambda k, z: {"mass": z * np.eye(2), "stiffness": chain(k)}, "mass is 2 x 2"),
    "damping too small": (lambda k, z: {"damping": z * np.eye(2), "stiffness": chain(k)}, "damping is 2 x 2"),
    "a constraint that is no relation": (
        lambda k, z: {"stiffness": chain(k), "constraints": [k[0] - k[1]]}, "a constraint is a relation"
    ),
    "two relations joined": (
        lambda k, z: {"stiffness": chain(k), "constraints": [ca.logic_and(k[0] <= k[1], k[1] <= k[2])]},
        "a constraint is a relation",
    ),
    "not equal": (lambda k, z: {"stiffness": chain(k), "constraints": [k[0] != k[1]]}, "a constraint is a relation"),
    "rows of unequal length": (lambda k, z: {"stiffness": [[z, 0, 0], [0, z], [0, 0, z]]}, "rows do not fit together"),
    "text among expressions": (lambda k, z: {"stiffness": [[z, "a", 0], ["a", z, 0], [0, 0, z]]}, "stiffness"),
    "None among expressions": (lambda k, z: {"stiffness": [[z, None, 0], [None, z, 0], [0, 0, z]]}, "stiffness"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", UNNAMED)
def test_a_mistake_of_no_one_variable_is_refused_with_a_place(mistake):
    given, words = UNNAMED[mistake]
    with pytest.raises(sysid.InputError, match=r"test_declarations\.py, line \d+") as caught:
        build(**given(springs(), declare("other", (), 0.5, 1.5)))
    assert words in str(caught.value)


PLAIN = {
    "mass a text": (lambda k: {"mass": "heavy"}, "mass is a str"),
    "mass None": (lambda k: {"mass": None}, "mass is a NoneType"),
    "mass a class": (lambda k: {"mass": sysid.FullMass}, "mass is a type"),
    "stiffness None": (lambda k: {"stiffness": None, "mass": k[0] * M}, "stiffness is a NoneType"),
    "stiffness a text": (lambda k: {"stiffness": "stiff", "mass": k[0] * M}, "stiffness is a str"),
    "stiffness a dict": (lambda k: {"stiffness": {"k": k}, "mass": k[0] * M}, "stiffness is a dict"),
    "stiffness a function": (lambda k: {"stiffness": chain, "mass": k[0] * M}, "stiffness is a function"),
    "damping None": (lambda k: {"damping": None}, "damping is a NoneType"),
    "damping a number": (lambda k: {"damping": 0.02}, "damping is a"),
    "constraints no list": (lambda k: {"constraints": k[0] <= k[1]}, "constraints is a MX; give a list"),
    "residuals no list": (lambda k: {"residuals": k[0] - 1}, "residuals is a MX; give a list"),
    "a constraint True": (lambda k: {"constraints": [True]}, "constraint 1 is bool"),
    "a constraint in words": (lambda k: {"constraints": ["k > 0"]}, "constraint 1 is str"),
    "a constraint None": (lambda k: {"constraints": [k >= 0, None]}, "constraint 2 is NoneType"),
    "a residual in words": (lambda k: {"residuals": ["zero"]}, "residual 1"),
    "a residual None": (lambda k: {"residuals": [None]}, "residual 1"),
    "healing of a name": (lambda k: {"healing": {"springs": k}}, "healing is a dictionary from variables"),
    "healing of a variable of no matrix": (
        lambda k: {"healing": {declare("stranger"): 2 * k}}, "no unknown of this problem"
    ),
    "healing in words": (lambda k: {"healing": {k: "twice"}}, "healing"),
    "rigid_body_dofs of another shape": (lambda k: {"rigid_body_dofs": np.ones((3, 2))}, "rigid_body_dofs has shape"),
    "rigid_body_dofs that do not fit": (lambda k: {"rigid_body_dofs": 2 * ONE}, "differs from the measurement's"),
    "a goal in words": (lambda k: {"goal": "small"}, "goal"),
    "a further test with a model": (
        lambda k: {
            "residuals": [sysid.FurtherTest(TEST, mass=sysid.FullMass(6), stiffness=chain(k), damping=k[0] * M)]
        },
        "FurtherTest: mass is a model",
    ),
    "a further test with ratios": (
        lambda k: {"residuals": [sysid.FurtherTest(TEST, mass=k[0] * M, stiffness=chain(k), damping=[0.1] * 3)]},
        "damping must be a matrix",
    ),
    "recovery of another shape with a known mass": (
        lambda k: {"recovery": np.ones((2, 3)), "rigid_body_dofs": ONE}, "recovery has shape (2, 3)"
    ),
    "recovery alone with a known mass": (lambda k: {"recovery": np.eye(3)}, "state rigid_body_dofs"),
    "a further test of another size": (
        lambda k: {"residuals": [sysid.FurtherTest(TEST, mass=np.eye(2), stiffness=chain(k), damping=k[0] * M)]},
        "mass matrix is (2, 2)",
    ),
    "recovery with a stiffness model": (
        lambda k: {"mass": k[0] * M, "stiffness": sysid.ChainStiffness(1, 9), "recovery": np.eye(3)}, "with recovery"
    ),
    "recovery without the motion of the base": (
        lambda k: {"mass": k[0] * M, "recovery": np.eye(3)}, "state rigid_body_dofs"
    ),
    "recovery with too few rows": (
        lambda k: {"mass": k[0] * M, "recovery": np.eye(3)[:2], "rigid_body_dofs": ONE}, "recovery has shape (2, 3)"
    ),
    "recovery flat": (lambda k: {"mass": k[0] * M, "recovery": np.ones(3), "rigid_body_dofs": ONE}, "(3,)"),
    "recovery in words": (lambda k: {"mass": k[0] * M, "recovery": "eye", "rigid_body_dofs": ONE}, "recovery"),
    "recovery of other degrees of freedom": (
        lambda k: {"mass": k[0] * M, "recovery": np.ones((3, 2)), "rigid_body_dofs": ONE}, "(2, 1)"
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", PLAIN)
def test_what_is_of_the_wrong_kind_is_refused(mistake):
    given, words = PLAIN[mistake]
    k = springs()
    with pytest.raises(sysid.InputError) as caught:
        build(**{"stiffness": chain(k), **given(k)})
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(lambda k: {"healing": [k]}, id="healing no mapping"),
        pytest.param(lambda k: {"healing": {k: k[0]}}, id="healing of another shape"),
        pytest.param(lambda k: {"residuals": [0.3]}, id="a residual without variables"),
        pytest.param(
            lambda k: {"residuals": [sysid.FurtherTest(3, mass=k[0] * M, stiffness=chain(k), damping=k[0] * M)]},
            id="a further test that is none",
        ),
        pytest.param(lambda k: {"damping": ca.sqrt(k - 1e6)}, id="ratios no number at the guess"),
        pytest.param(lambda k: {"damping": -k}, id="ratios nowhere positive"),
        pytest.param(lambda k: {"reference": 3}, id="reference no structure"),
        pytest.param(lambda k: {"validation": TEST}, id="validation no list"),
        pytest.param(
            lambda k: {"stiffness": ca.blockcat([[chain(k), -chain(k) @ ONE], [-ONE.T @ chain(k), 2 * k[0]]])},
            id="base corner of the stiffness",
        ),
    ],
)  # fmt: skip
def test_what_should_be_refused_too(mistake):
    k = springs()
    with pytest.raises(sysid.InputError):
        build(**{"stiffness": chain(k), **mistake(k)})


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        pytest.param(lambda k: {"damping": -k[0] * M}, "damping_matrix is not positive semidefinite", id="damping"),
        pytest.param(
            lambda k: {"mass": ca.blockcat([[ca.DM(M) + k[0] * 1e-9, k], [k.T, 0]])},
            "mass is not positive semidefinite", id="whole mass",
        ),
    ],
)  # fmt: skip
def test_matrices_of_a_structure_nowhere_are_refused_before_a_search(mistake, words):
    k = springs()
    problem = build(**{"stiffness": chain(k), **mistake(k)})
    with pytest.raises(sysid.InputError, match=words) as caught:
        problem.check()
    assert "test_declarations.py, line " in str(caught.value)


def test_a_prior_beside_a_misfit_of_one_s_own_is_refused():
    k = springs()
    with pytest.raises(sysid.InputError, match="Prior beside a misfit of your own"):
        build(stiffness=chain(k), misfit=k / 1e4 - 1, residuals=[sysid.Prior(k[0], 2e4, 10.0)])


def test_a_further_test_may_have_a_mass_that_is_known():
    k = springs()
    further = sysid.FurtherTest(TEST, mass=sysid.KnownMass(M), stiffness=chain(k), damping=1e-4 * chain(k))
    problem = build(stiffness=chain(k), damping=0.2 * M + 2e-4 * chain(k), residuals=[further])
    assert [term.name for term in problem.formulation.tests] == ["the test", "residual 1"]


@pytest.mark.parametrize(
    "given",
    [
        lambda k, z: {"mass": sysid.FullMass(known=np.where(M > 2, M, np.nan)), "stiffness": chain(k)},
        lambda k, z: {
            "mass": sysid.FullMass([[7.0]], healing="rigid_body"), "stiffness": sysid.ChainStiffness(1e3, 1e5)
        },
        lambda k, z: {
            "mass": sysid.FullMass([[7.0]], healing="rigid_body"), "damping": z * M,
            "stiffness": sysid.SpectralStiffness([3.0, 5.0, 9.0]),
        },
    ],
)  # fmt: skip
def test_what_a_full_mass_knows_beside_other_models_is_refused(given):
    """Only modal coordinates hold it."""
    with pytest.raises(sysid.InputError, match="go with the modal strategy only"):
        build(**{"damping": sysid.ModalDamping(), **given(springs(), declare("other", (), 0.5, 1.5))})


@pytest.mark.parametrize("size", [5, 6])
def test_a_stiffness_of_another_size_beside_recovery_is_refused(size):
    """A size other than n + d cannot tell the motion of the degrees of freedom."""
    k = springs()
    whole = ca.blockcat([[chain(k), ca.MX(3, size - 3)], [ca.MX(size - 3, 3), ca.MX(size - 3, size - 3)]])
    with pytest.raises(sysid.InputError, match=rf"stiffness is {size} x {size} .*\(3, 3\) or.*\(4, 4\).*'springs'"):
        build(mass=k[0] * M, stiffness=whole, recovery=np.eye(3))


@pytest.mark.parametrize("symbol", [ca.MX.sym("stranger"), ca.MX.sym("stranger", 3)])
@pytest.mark.parametrize("place", ["stiffness", "mass", "damping", "residuals", "constraints", "misfit", "healing"])
def test_a_free_symbol_is_told_by_its_name_and_with_the_place_of_the_problem(symbol, place):
    k, first = springs(), symbol[0]
    given = {
        "stiffness": {"stiffness": first * chain(k)}, "mass": {"mass": first * M}, "damping": {"damping": first * M},
        "residuals": {"residuals": [first]}, "constraints": {"constraints": [first <= k[0]]},
        "misfit": {"misfit": first * k}, "healing": {"healing": {k: first * k}},
    }[place]  # fmt: skip
    with pytest.raises(sysid.InputError) as caught:
        build(**{"stiffness": chain(k), **given})
    message = str(caught.value)
    assert "'stranger'" in message
    assert "free CasADi symbol" in message
    assert "functools" not in message
    assert "test_declarations.py, line " in message


@pytest.mark.parametrize("nested", [False, True])
def test_a_symbol_of_the_other_kind_is_refused(nested):
    k, s = springs(), ca.SX.sym("s")
    given = [[k[0], 0, 0], [0, k[1], 0], [0, 0, s]] if nested else s * ca.DM.eye(3)
    with pytest.raises(sysid.InputError, match=r"stiffness"):
        build(stiffness=given, damping=k[0] * M)


def test_two_variables_of_one_name_are_refused_with_both_places():
    k = sysid.Variable("twin", 3, lower=1e3, upper=1e5)
    m = sysid.Variable("twin", 3, lower=1, upper=9)
    with pytest.raises(sysid.InputError, match="'twin'") as caught:
        sysid.Problem(TEST, mass=ca.diag(m), stiffness=chain(k), damping=[0.01] * 3)
    assert k.declared in str(caught.value)
    assert m.declared in str(caught.value)
    assert k.declared != m.declared


def test_a_variable_with_the_name_of_a_model_s_unknowns_is_refused():
    spring = declare("spring", (), 0.5, 1.5)
    with pytest.raises(sysid.InputError, match="spring"):
        sysid.Problem(TEST, mass=spring * M, stiffness=sysid.ChainStiffness(1e3, 1e5), damping=[0.01] * 3)


@pytest.mark.parametrize("held", ["alone", "in a list", "in a dict"])
def test_a_variable_that_enters_nothing_is_no_unknown(held):
    """Only a problem module must use all that it declares: elsewhere a variable may wait for a problem to come."""
    k, idle = springs(), declare("idle")
    if held == "in a list":
        idle = [idle]
    elif held == "in a dict":
        idle = {"a": idle}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem = sysid.Problem(TEST, mass=M, stiffness=chain(k), damping=[0.01] * 3)
    assert problem.variables == (k,)
    assert idle is not None


def test_a_fixed_variable_and_one_of_a_constraint_only_enter():
    k, z = springs(), declare("z", (), 0.5, 1.5, guess=1, fixed=True)
    y = declare("y", (), 0.5, 1.5)
    problem = sysid.Problem(TEST, mass=z * M, stiffness=chain(k), damping=[0.01] * 3, constraints=[1e4 * y <= k[0]])
    assert problem.n_variables == 4


def test_a_problem_without_unknowns_is_refused():
    k = declare("k", guess=SPRINGS, fixed=True)
    with pytest.raises(sysid.InputError, match="no unknowns"):
        sysid.Problem(TEST, mass=M, stiffness=chain(k), damping=[0.01] * 3)


# -- what the search meets later ---------------------------------------------------------------------------------------


def free_stiffness(guess):
    """All entries of a stiffness that may be indefinite within the bounds."""
    a = sysid.Variable("a", 3, lower=1e3, upper=5e4, guess=np.diag(K_TRUE) * 1.05)
    b = sysid.Variable("b", 3, lower=-4e4, upper=4e4, guess=guess)
    K = ca.blockcat([[a[0], b[0], b[1]], [b[0], a[1], b[2]], [b[1], b[2], a[2]]])
    beta = sysid.Variable("beta", lower=1e-5, upper=1e-3, guess=1.5e-4)
    return sysid.Problem(TEST, mass=M, stiffness=K, damping=0.2 * M + beta * K)


def test_points_of_the_box_that_are_no_structure_do_not_end_the_search():
    result = sysid.identify(free_stiffness([-1.4e4, 0.0, -0.9e4]), rng=0)
    assert result.residual < 1e-6


def test_a_guess_that_is_no_structure_is_left_for_other_starts():
    result = sysid.identify(free_stiffness([-4e4, 4e4, -4e4]), rng=0)
    assert result.residual < 1e-6


def test_a_constraint_that_is_no_number_on_half_of_the_box_can_be_kept():
    k, a = springs(), declare("a", 2, 0.0, 10.0, guess=[5.0, 4.9])
    problem = build(stiffness=chain(k) + ca.diag(ca.vertcat(a, 0)), constraints=[ca.log(a[0] - a[1] - 0.05) <= -3.5])
    problem.check()
    assert problem.formulation.constraints.lower.size == 1


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_degree_of_freedom_without_damper_leaves_nothing_open():
    k, c = declare("k", guess=SPRINGS), declare("c", (), 0.1, 100.0, guess=20)
    truth = sysid.Structure(TRUTH.mass, TRUTH.stiffness, n_base=1, damping_matrix=np.diag([20.0, 0, 0]))
    problem = sysid.Problem(
        sysid.simulate(truth, FREQ, noise=0.003, rng=1), mass=M, stiffness=chain(k),
        damping=ca.diag(ca.vertcat(c, 0, 0)),
    )  # fmt: skip
    result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
    assert result.determined, result.undetermined


def test_noise_of_the_force_calls_for_no_swarm():
    k, beta = declare("k", guess=SPRINGS), declare("beta", (), 1e-5, 1e-3, guess=1e-4)
    test = sysid.simulate(TRUTH, np.linspace(2, 30, 60), noise=0.01, force=True, rng=1)
    problem = sysid.Problem(test, mass=M, stiffness=chain(k), damping=0.2 * M + beta * chain(k))
    result = sysid.identify(problem, rng=0)
    assert result.success
    assert "followed" not in str(result.of_kind("strategy")[0])


def test_healing_that_leaves_the_box_is_put_back_into_it():
    k = springs()
    problem = build(stiffness=chain(k), healing={k: 100 * k})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        x = SwarmObjective(problem.prepared).unknowns(np.full(3, 5e4))
    np.testing.assert_array_equal(x, 1e5)
