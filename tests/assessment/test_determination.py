"""Which judge speaks, and what both say of variables beside the matrices, of other answers and of factors' entries."""

import re

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import ChainStiffness, FullMass, LumpedMass, Prior, Problem, ProportionalDamping, SpectralStiffness, Variable
from sysid.assessment.determination import BY_CONE, BY_RANK, determine, intervals, open_masses, scale_is_open
from sysid.assessment.uncertainty import uncertainty
from sysid.finding import cautions

FREQ = np.linspace(1.0, 30.0, 60)
MASSES, SPRINGS = np.array([3.0, 2.0, 1.0]), np.array([2e4, 1.5e4, 1e4])
ALPHA, BETA = 0.8, 2e-4
T = np.eye(3) - np.eye(3, k=-1)


@pytest.fixture
def truth():
    K = T.T @ np.diag(SPRINGS) @ T
    return on_springs(MASSES, K, ALPHA * np.diag(MASSES) + BETA * K)


def on_springs(masses, K, C):
    one = np.ones((3, 1))
    full = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    ratios = sysid.Structure(np.diag([*masses, 0.0]), full, damping_matrix=C, n_base=1).damping_ratios
    return sysid.Structure(np.diag([*masses, 0.0]), full, ratios, n_base=1)


def weighed(lower=0.0, **options):
    return Variable("weighed elsewhere", lower=lower, upper=1.0, guess=0.4, **options)


def free(truth, *, force=False, **options):
    test = sysid.simulate(truth, FREQ, force=force, noise=options.pop("noise", 0.0), rng=1)
    return Problem(test, mass=FullMass(), stiffness=SpectralStiffness(truth.natural_frequencies), **options)


def by_models(truth, total=None, noise=0.0):
    return Problem(
        sysid.simulate(truth, FREQ, noise=noise, rng=1), mass=LumpedMass(total), stiffness=ChainStiffness(1e3, 1e6),
        damping=ProportionalDamping((0.0, 5.0), (0.0, 1e-2)),
    )  # fmt: skip


def by_hand(truth, total=None, noise=0.0):
    """The same chain in variables, damping by ratios."""
    m = Variable("m", 3, lower=0.1, upper=10.0, guess=MASSES)
    k = Variable("k", 3, lower=1e3, upper=1e6, guess=SPRINGS)
    a, b = Variable("a", lower=0.0, upper=5.0, guess=ALPHA), Variable("b", lower=0.0, upper=1e-2, guess=BETA)
    M, K = ca.diag(m), T.T @ ca.diag(k) @ T
    return Problem(
        sysid.simulate(truth, FREQ, noise=noise, rng=1), mass=M, stiffness=K, damping=a * M + b * K,
        constraints=[] if total is None else [ca.sum1(m) == total],
    )  # fmt: skip


class TestWhichSpeaks:
    def test_the_cone_where_models_tell_all_of_the_matrices(self, truth):
        for problem in (free(truth), free(truth, force=True), by_models(truth), by_models(truth, 6.0)):
            x = problem.values(truth)
            assert determine(problem.prepared, truth, x).judged_by == BY_CONE

    def test_the_rank_where_a_matrix_is_written_or_something_beside_the_records_tells_of_it(self, truth):
        ratios = Variable("z", 3, lower=0.001, upper=0.1, guess=truth.damping_ratios)
        problems = by_hand(truth), free(truth, damping=ratios, residuals=[Prior(ratios[0], 0.01, 0.001)])
        for problem in problems:
            x = problem.formulation.guess
            told = determine(problem.prepared, problem.structure(x), x)
            assert told.judged_by == BY_RANK
            assert not told.determined
            assert open_masses(problem.prepared, truth) == []

    def test_the_rank_needs_the_unknowns(self, truth):
        problem = by_hand(truth)
        for judge in (determine, intervals):
            with pytest.raises(sysid.InputError, match="give x"):
                judge(problem, truth, None)

    @pytest.mark.parametrize("total", [None, 6.0])
    def test_both_say_the_same_of_one_chain(self, truth, total):
        """A chain on accelerations alone has one scale open, which its total closes."""
        x_models, hand = by_models(truth, total).values(truth), by_hand(truth, total)
        cone = determine(by_models(truth, total).prepared, truth, x_models)
        rank = determine(hand.prepared, truth, np.concatenate([MASSES, SPRINGS, [ALPHA, BETA]]))
        assert cone.determined is rank.determined is (total is not None)
        ends = (
            intervals(by_models(truth, total).prepared, truth, None),
            intervals(hand.prepared, truth, hand.formulation.guess),
        )
        for one, other in zip(*((e.mass, e.stiffness) for e in ends), strict=True):
            # To first order both ends of an open entry are.
            np.testing.assert_array_equal(np.any(np.isinf(one), axis=0), np.any(np.isinf(other), axis=0))

    def test_ratios_that_are_written_leave_the_cone_valid(self, truth):
        ratios = Variable("z", 3, lower=0.001, upper=0.1, guess=truth.damping_ratios)
        told = determine(free(truth, force=True, damping=ratios).prepared, truth, None)
        assert told.judged_by == BY_CONE and told.determined


class TestVariablesBeside:
    """A variable that enters no matrix changes nothing of what is said about these."""

    def test_what_is_known_of_it_is_its_deviation(self, truth):
        v = weighed()
        problem = free(truth, force=True, noise=0.01, residuals=[Prior(v, 0.4, 0.05)])
        x = np.concatenate([problem.values(truth)[:-1], [0.4]])
        told = determine(problem.prepared, truth, x)
        assert told.determined and told.judged_by == BY_CONE
        assert told == determine(free(truth, force=True, noise=0.01).prepared, truth, None)
        u, alone = (
            uncertainty(problem.prepared, truth, x),
            uncertainty(free(truth, force=True, noise=0.01).prepared, truth, None),
        )
        assert u.variables == {v.name: pytest.approx(0.05, rel=1e-9)}
        assert u.values == {v.name: 0.4}
        np.testing.assert_array_equal(u.mass, alone.mass)
        low, high = u.interval(v.name)
        assert (high - low) / 2 == pytest.approx(1.959964 * 0.05, rel=1e-6)

    def test_two_weighings_count_by_their_deviations(self, truth):
        v = weighed()
        problem = free(truth, residuals=[Prior(v, 0.41, 0.03), Prior(2 * v, 0.78, 0.08)])
        x = np.concatenate([problem.values(truth)[:-1], [0.4]])
        expected = 1 / np.sqrt(1 / 0.03**2 + 4 / 0.08**2)
        assert uncertainty(problem.prepared, truth, x).variables[v.name] == pytest.approx(expected, rel=1e-9)

    def test_one_that_nothing_sees_is_named_and_the_matrices_stay_determined(self, truth):
        v, w = weighed(), Variable("other", lower=0.0, upper=1.0)
        problem = free(truth, force=True, residuals=[Prior(v + w, 0.9, 0.05)])
        x = np.concatenate([problem.values(truth)[:-2], [0.4, 0.5]])
        told = determine(problem.prepared, truth, x)
        assert told.determined
        (one,) = (one for one in told.findings if v.name in one.sentence)
        assert one.kind == "fixed" and w.name in one.sentence
        assert all(np.isnan(std) for std in uncertainty(problem.prepared, truth, x).variables.values())

    def test_beside_open_masses_it_is_one_more_thing_open(self, truth):
        v, w = weighed(), Variable("other", lower=0.0, upper=1.0)
        problem = free(truth, residuals=[Prior(v + w, 0.9, 0.05)])
        x = np.concatenate([problem.values(truth)[:-2], [0.4, 0.5]])
        told = determine(problem.prepared, truth, x)
        assert not told.determined
        assert any(v.name in sentence for sentence in told.undetermined)

    def test_an_equality_fixes_it(self, truth):
        v, w = weighed(), Variable("other", lower=0.0, upper=1.0)
        problem = free(truth, force=True, residuals=[Prior(v + w, 0.9, 0.05)], constraints=[v - w == -0.1])
        x = np.concatenate([problem.values(truth)[:-2], [0.4, 0.5]])
        assert not any(v.name in sentence for sentence in determine(problem.prepared, truth, x).closed_by)
        for std in uncertainty(problem.prepared, truth, x).variables.values():
            assert std == pytest.approx(0.025, rel=1e-9)


class TestOtherAnswers:
    def test_one_with_other_matrices_is_told_by_its_unknowns(self, truth):
        problem, x = by_hand(truth, 6.0), np.concatenate([MASSES, SPRINGS, [ALPHA, BETA]])
        other = x.copy()
        other[3] *= 1.5
        told = determine(problem.prepared, truth, x, [other])
        assert not told.determined
        (open_,) = cautions(told.findings)
        assert (open_.kind, open_.numbers) == ("other answers", {"k[0]": other[3]})
        assert determine(problem.prepared, truth, x, [x]).determined

    def test_one_that_noise_does_not_tell_apart_is_the_same(self, truth):
        """The other spring is off by a part of its deviation, and by so many that no noise explains it."""
        problem, x = by_hand(truth, 6.0, noise=0.2), np.concatenate([MASSES, SPRINGS, [ALPHA, BETA]])
        std = uncertainty(problem.prepared, problem.structure(x), x).variables["k"][0]
        assert std > 2e-3 * SPRINGS[0]  # so that the two structures are not the same to a thousandth
        for times, same in ((1, True), (100, False)):
            other = x.copy()
            other[3] += times * std
            told = determine(problem.prepared, problem.structure(x), x, [other])
            assert told.determined is same, told

    def test_models_tell_it_too(self, truth):
        problem = by_models(truth, 6.0)
        x = problem.values(truth)
        other = x.copy()
        other[3] *= 1.5
        told = determine(problem.prepared, truth, x, [other])
        (open_,) = cautions(told.findings)
        assert (open_.kind, open_.numbers) == ("other answers", {"spring 1": other[3]})
        shares = x.copy()
        shares[:3] *= 0.5  # the same masses
        assert determine(problem.prepared, truth, x, [shares]).determined

    def test_where_the_cone_is_open_it_is_a_member_and_nothing_new(self, truth):
        problem = by_models(truth)
        x = problem.values(truth)
        other = x.copy()
        other[3] *= 1.5
        assert determine(problem.prepared, truth, x, [other]) == determine(problem.prepared, truth, x)


def test_entries_of_factors_are_counted_and_not_named(truth):
    """Knowledge of a ratio leaves the cone to the rank; the scale of each mode is open, and M_00."""
    ratios = Variable("z", 3, lower=0.001, upper=0.1, guess=truth.damping_ratios)
    problem = free(truth, damping=ratios, residuals=[Prior(ratios[0], 0.02, 0.001)])
    of_models = [model.values(problem.geometry, truth) for model in problem.models[:2]]
    x = np.concatenate([*of_models, truth.damping_ratios])
    told = determine(problem.prepared, problem.structure(x), x)
    assert not told.determined
    # Of the scales of three modes and M_00 the total mass, which is an unknown, is one.
    open_ = cautions(told.findings)[0]
    assert "total mass" in open_.sentence and 1 + open_.numbers["unnamed"] == 3 + truth.n_base
    assert not any(label in open_.sentence for label in problem.formulation.labels if "factor" in label)
    u = uncertainty(problem.prepared, problem.structure(x), x)
    assert list(u.variables) == ["z"]
    assert np.all(np.isfinite(u.variables["z"])) and np.all(np.isnan(np.diag(u.mass)))


class TestUnknownsOfModels:
    def test_springs_of_a_chain_have_the_deviations_of_the_same_chain_by_hand(self, truth):
        models, hand = by_models(truth, 6.0, noise=0.01), by_hand(truth, 6.0, noise=0.01)
        one = uncertainty(models.prepared, truth, models.values(truth))
        other = uncertainty(hand.prepared, truth, np.concatenate([MASSES, SPRINGS, [ALPHA, BETA]]))
        np.testing.assert_allclose(one.values["spring"], SPRINGS, rtol=1e-9)
        # Both have 8 unknowns, one of them tied by the total in one way or another.
        np.testing.assert_allclose(one.variables["spring"], other.variables["k"], rtol=1e-6)
        np.testing.assert_allclose(one.variables["rayleigh_alpha"], other.variables["a"], rtol=1e-6)
        np.testing.assert_allclose(one.variables["rayleigh_beta"], other.variables["b"], rtol=1e-6)
        np.testing.assert_allclose(np.diag(one.mass), other.variables["m"], rtol=1e-6)
        assert set(one.variables) == {"spring", "rayleigh_alpha", "rayleigh_beta"}
        low, high = one.interval("spring")
        np.testing.assert_allclose((high + low) / 2, SPRINGS)

    def test_without_a_total_they_are_open_and_ratios_are_not(self, truth):
        problem = by_models(truth, noise=0.01)
        u = uncertainty(problem.prepared, truth, problem.values(truth))
        assert np.all(np.isnan(u.variables["spring"]))
        assert np.all(np.isfinite(u.variables["rayleigh_alpha"])) and np.all(np.isfinite(u.variables["rayleigh_beta"]))

    def test_their_covariance_is_given_where_all_of_them_mean_something(self, truth):
        test = sysid.simulate(truth, FREQ, noise=0.01, rng=1)
        chain = Problem(test, mass=np.diag(MASSES), stiffness=ChainStiffness(1e3, 1e6))
        u = uncertainty(chain.prepared, truth, chain.values(truth))
        assert u.parameters == (*(f"spring {i}" for i in (1, 2, 3)), *(f"damping ratio {i}" for i in (1, 2, 3)))
        np.testing.assert_allclose(np.sqrt(np.diag(u.covariance))[:3], u.variables["spring"])
        np.testing.assert_allclose(u.variables["damping_ratio"], u.damping_ratios, rtol=1e-6)
        lumped = Problem(test, mass=LumpedMass(6.0), stiffness=ChainStiffness(1e3, 1e6))
        assert uncertainty(lumped.prepared, truth, lumped.values(truth)).parameters[0] == "frequency 1, Hz"

    def test_a_model_of_ones_own_is_judged_by_what_it_states(self, truth):
        """Masses stated to be lumped, in a class that the package does not know."""

        class Lumps:
            def __init__(self):
                lumped = LumpedMass(6.0)
                self.unknowns, self.blocks = lumped.unknowns, lumped.blocks
                self.values, self.stated = lumped.values, lumped.stated

        other = Problem(
            sysid.simulate(truth, FREQ), mass=Lumps(), stiffness=ChainStiffness(1e3, 1e6),
            damping=ProportionalDamping((0.0, 5.0), (0.0, 1e-2)),
        )  # fmt: skip
        x = other.values(truth)
        assert determine(other.prepared, truth, x) == determine(by_models(truth, 6.0).prepared, truth, x)


class TestMassesThatNobodyWeighed:
    """Masses are normalised to 1 kg where nobody states any; that is no knowledge."""

    def chain(self, truth, total=None):
        k = Variable("k", 3, lower=10.0, upper=1e6, guess=SPRINGS / 6.0)
        test = sysid.simulate(truth, FREQ, noise=0.01, rng=1)
        return Problem(test, mass=LumpedMass(total), stiffness=T.T @ ca.diag(k) @ T)

    def test_a_written_stiffness_beside_them_is_open_by_their_scale(self, truth):
        problem = self.chain(truth)
        x = np.concatenate([MASSES / 3.0, truth.damping_ratios, SPRINGS / 6.0])
        told = determine(problem.prepared, problem.structure(x), x)
        assert told.judged_by == BY_RANK and not told.determined
        direction, unit = told.undetermined
        assert direction.endswith("no record sees a change of total mass +1 %, k +1 %")
        assert "normalised to 1 kg" in unit
        ends = intervals(problem.prepared, problem.structure(x), x)
        assert np.all(np.isinf(np.diagonal(ends.mass[1]))) and np.all(np.isinf(np.diagonal(ends.stiffness[1])))
        # A diagonal stays positive; to first order nothing stops the coupling of the springs.
        np.testing.assert_array_equal(np.diagonal(ends.stiffness[0]), 0.0)
        np.testing.assert_array_equal(np.diagonal(ends.stiffness[0], 1), -np.inf)
        assert np.all(np.isnan(uncertainty(problem.prepared, problem.structure(x), x).variables["k"]))

    def test_their_total_closes_it(self, truth):
        problem = self.chain(truth, 6.0)
        x = np.concatenate([MASSES / 3.0, truth.damping_ratios, SPRINGS])
        told = determine(problem.prepared, problem.structure(x), x)
        assert told.determined
        assert told.closed_by == ("the data and the written model fix mass, stiffness and damping",)
        assert np.all(np.isfinite(intervals(problem.prepared, problem.structure(x), x).stiffness))
        assert np.all(np.isfinite(uncertainty(problem.prepared, problem.structure(x), x).variables["k"]))


@pytest.mark.parametrize("force", [False, True])
def test_a_written_chain_without_force_is_told_that_its_scale_is_open(force):
    m, k = sysid.Variable("m", 2, lower=0.1, upper=9.0), sysid.Variable("k", 2, lower=1e2, upper=1e4)
    truth = sysid.Structure(
        np.diag([2.0, 1.0, 0.0]), 1e3 * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]]), [0.01, 0.02], n_base=1
    )
    test = sysid.simulate(truth, np.linspace(1.0, 9.0, 60), force=force)
    stiffness = ca.blockcat([[k[0] + k[1], -k[1]], [-k[1], k[1]]])
    problem = sysid.Problem(test, mass=ca.diagcat(m[0], m[1]), stiffness=stiffness)
    order = {"m": [2.0, 1.0], "k": [1e3, 1e3], "damping_ratio": [0.01, 0.02]}
    x = np.concatenate([order[unknown.name] for unknown in problem.formulation.unknowns])
    assert scale_is_open(problem.prepared, truth, x) is not force
    assert (
        any("one mass" in told for told in determine(problem.prepared, truth, x).undetermined) is not force
    )  # in kg, to state


class TestOnlyTheScale:
    @pytest.mark.parametrize("total", [None, 6.0])
    def test_of_a_chain_by_cone_and_by_rank(self, truth, total):
        x = np.concatenate([MASSES, SPRINGS, [ALPHA, BETA]])
        assert scale_is_open(by_models(truth, total).prepared, truth, None) is (total is None)
        assert scale_is_open(by_hand(truth, total).prepared, truth, x) is (total is None)

    @pytest.mark.parametrize(("mass", "open_"), [(LumpedMass(), True), (LumpedMass(6.0), False), (FullMass(), False)])
    def test_of_lumped_and_full_masses(self, truth, mass, open_):
        """Of a full mass every modal mass is open by itself, and a total closes none."""
        problem = Problem(sysid.simulate(truth, FREQ), mass=mass)
        assert scale_is_open(problem.prepared, truth, None) is open_

    def test_a_scale_for_each_base_direction_is_more_than_one(self):
        """One chain along x, one along y: records of neither tell its mass against the other's."""
        K = T[:2, :2].T @ np.diag(SPRINGS[:2]) @ T[:2, :2]
        G = np.kron(np.eye(2), np.ones((2, 1)))
        K_SS = np.kron(np.diag([1.0, 1.7]), K)
        full = np.block([[K_SS, -K_SS @ G], [-G.T @ K_SS, G.T @ K_SS @ G]])
        two = sysid.Structure(np.diag([3.0, 2.0, 1.0, 2.5, 0.0, 0.0]), full, [0.01] * 4, n_base=2)
        test = sysid.simulate(two, FREQ)
        assert open_masses(Problem(test, mass=LumpedMass()).prepared, two) == [0, 1, 2, 3]
        assert not scale_is_open(Problem(test, mass=LumpedMass()).prepared, two, None)
        m = Variable("m", 2, lower=0.1, upper=10.0, guess=np.ones(2))
        every = ca.diag(ca.vertcat(m[0], m[0], m[1], m[1]))
        hand = Problem(test, mass=every @ two.mass[:4, :4], stiffness=every @ K_SS)
        x = np.concatenate([np.ones(2), two.damping_ratios])
        assert scale_is_open(hand.prepared, hand.structure(x), x) is False


@pytest.mark.parametrize("second", [2.0, 3.0])
def test_a_damper_that_no_record_sees_is_open_by_itself(second):
    """Between two equal masses on equal springs, which move alike, it does nothing; between others it shows."""
    a, b = (Variable(name, lower=0.1, upper=50.0, guess=5.0) for name in "ab")
    one = Variable("k", lower=100.0, upper=1e4, guess=800.0)
    between = np.array([[1.0, -1.0], [-1.0, 1.0]])
    truth = sysid.Structure(
        np.diag([2.0, second, 0.0]), np.array([[1000.0, -200, -800], [-200, 1000, -800], [-800, -800, 1600]]),
        n_base=1, damping_matrix=5 * np.eye(2) + 5 * between,
    )  # fmt: skip
    problem = Problem(
        sysid.simulate(truth, np.linspace(1.0, 9.0, 60)), mass=np.diag([2.0, second]),
        stiffness=one * np.eye(2) + 200 * between, damping=a * np.eye(2) + b * between,
    )  # fmt: skip
    x = np.array([{"a": 5.0, "b": 5.0, "k": 800.0}[label] for label in problem.formulation.labels])
    told = determine(problem.prepared, problem.structure(x), x)
    assert told.judged_by == BY_RANK
    assert told.determined is (second != 2.0)
    assert all(re.findall(r"change of (\w+)", sentence) == ["b"] for sentence in told.undetermined)


@pytest.mark.parametrize(("off", "hardly"), [(0.0, False), (1e-9, True)])
def test_an_unknown_that_moves_exact_records_by_less_than_is_left_of_them_is_hardly_held(off, hardly):
    """A damper of a hundred millionth beside another: a fit that is off by 1e-9 of that one says nothing of it."""
    a, b = (Variable(name, lower=0.1, upper=50.0, guess=5.0) for name in "ab")
    between = np.array([[1.0, -1.0], [-1.0, 1.0]])
    K = np.array([[1000.0, -200], [-200, 1000]])
    G = np.ones((2, 1))
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    truth = sysid.Structure(np.diag([2.0, 3, 0]), full, n_base=1, damping_matrix=5 * np.eye(2) + 5e-8 * between)
    problem = Problem(
        sysid.simulate(truth, np.linspace(1.0, 9.0, 60)), mass=np.diag([2.0, 3.0]), stiffness=K,
        damping=a * np.eye(2) + 1e-8 * b * between,
    )  # fmt: skip
    order = [problem.formulation.labels.index(label) for label in "ab"]
    x = np.empty(2)
    x[order] = 5.0 * (1 + off), 5.0
    told = determine(problem.prepared, problem.structure(x), x)
    assert [re.findall(r"(\w+) \+1 %", one.sentence) for one in cautions(told.findings)] == [["b"]] * hardly
    assert not any("seen" in one.numbers for one in cautions(told.findings))
    assert told.determined is not hardly
