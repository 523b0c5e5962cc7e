"""Searches from several starts through widened peaks: what they find, and what they must not lose."""

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

import sysid
from sysid.search.continuation import _alternatives, _best, _Run, apart, as_good_as, smoothed_tests
from sysid.search.local import LocalResult
from sysid.search.session import DeferredInterrupt, Session

STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
MASS, SPRINGS, DAMPERS = np.array([5.0, 4.0]), np.array([2e4, 1.5e4]), np.array([9.0, 6.0])
FREQ = np.linspace(2.0, 20.0, 150)
COUPLING = 8e3


def two_floors():
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    return sysid.Structure(np.diag([*MASS, 0.0]), K, damping_matrix=C[:2, :2], n_base=1)


def measured(**options):
    return sysid.simulate(two_floors(), FREQ, rng=0, **options)


def springs_and_dampers(lower=1e3, upper=1e6):
    k = sysid.Variable("spring", 2, lower=lower, upper=upper, log=True, unit="N/m")
    c = sysid.Variable("damper", 2, lower=0.1, upper=500.0, log=True, unit="N s/m")
    return k, c, STRETCH.T @ ca.diag(k) @ STRETCH, (STRETCH.T @ ca.diag(c) @ STRETCH)[:2, :2]


@pytest.mark.parametrize("seed", range(2))
def test_starts_that_are_no_structure_are_passed_over(seed):
    """Half of this search space is indefinite, and modes are needed: damping by ratios."""
    K = np.diag([3.5e4, 1.5e4]) - 1.5e4 * (np.ones((2, 2)) - np.eye(2))
    full = np.block([[K, -K.sum(axis=1, keepdims=True)], [-K.sum(axis=0, keepdims=True), K.sum().reshape(1, 1)]])
    truth = sysid.Structure(np.diag([*MASS, 0.0]), full, [0.02, 0.01], n_base=1)
    a, d = (sysid.Variable(name, lower=5e3, upper=1e5) for name in "ad")
    b, zeta = sysid.Variable("b", lower=-1e5, upper=1e5, guess=-1e4), sysid.Variable("zeta", 2, lower=1e-3, upper=0.1)
    problem = sysid.Problem(sysid.simulate(truth, FREQ), mass=np.diag(MASS), stiffness=[[a, b], [b, d]], damping=zeta)
    result = sysid.identify(problem, rng=seed)
    assert result.success
    np.testing.assert_allclose(result.structure.stiffness[:2, :2], K, rtol=1e-6)


def test_no_answer_breaks_a_constraint_to_fit_better():
    """The force weighs 9 kg, and 9.05 are stated: the misfit would rather have the former."""
    m = sysid.Variable("mass", 2, lower=1.0, upper=20.0, unit="kg")
    _, _, K, C = springs_and_dampers()
    total = [ca.sum1(m) == 9.05]
    problem = sysid.Problem(measured(force=True), mass=ca.diag(m), stiffness=K, damping=C, constraints=total)
    for strategy in ("auto", sysid.Swarm(max_iterations=30, restarts=0)):
        result = sysid.identify(problem, strategy=strategy, rng=0)
        np.testing.assert_allclose(result.values["mass"].sum(), 9.05, rtol=1e-7)
        assert not result.determined  # the force says otherwise


def test_a_range_of_nine_decades_is_no_scale():
    _, _, K, C = springs_and_dampers(lower=1e2, upper=1e11)
    result = sysid.identify(sysid.Problem(measured(), mass=np.diag(MASS), stiffness=K, damping=C), rng=0)
    assert result.determined
    np.testing.assert_allclose(result.values["spring"], SPRINGS, rtol=1e-8)


def test_the_same_seed_gives_the_same_bits():
    def once():
        _, _, K, C = springs_and_dampers()
        problem = sysid.Problem(measured(noise=0.01), mass=np.diag(MASS), stiffness=K, damping=C)
        return sysid.identify(problem, rng=3, strategy=sysid.Continuation(starts=2))

    first, second = once(), once()
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.history.local_curve, second.history.local_curve)


@pytest.mark.parametrize("after", [0, 5, 40])
def test_a_callback_that_stops_it_leaves_the_best_so_far(after):
    seen = []

    def stop(progress):
        seen.append(progress)
        if len(seen) > after:
            raise StopIteration

    _, _, K, C = springs_and_dampers()
    problem = sysid.Problem(measured(noise=0.01), mass=np.diag(MASS), stiffness=K, damping=C)
    result = sysid.identify(problem, rng=0, callback=stop)
    assert not result.success
    assert not result.determined
    assert np.all(np.isfinite(result.x))


def coupled(sensors):
    """A problem of two masses whose coupling is 8000 N/m, with sensors on the first or on both of them.

    The base drives coordinate 1 alone, so that its motion holds the square of the coupling to coordinate 2.
    From the motion of coordinate 1 that coupling is 8000 N/m or -8000 N/m; the motion of coordinate 2 tells the sign.
    """
    M, C, G = np.diag([5.0, 4.0]), np.diag([12.0, 9.0]), np.array([[1.0], [0.0]])
    w = 2 * np.pi * FREQ[::3, None, None]
    K = np.array([[3e4, COUPLING], [COUPLING, 2e4]])
    absolute = np.linalg.solve(-(w**2) * M + 1j * w * C + K, w**2 * (M @ G) + 0j)[..., 0].T + G
    test = sysid.Measurement(
        FREQ[::3], np.ones((1, len(w))), absolute[None, :sensors], rigid_body=G[:sensors], base_axes="x"
    )
    k = sysid.Variable("coupling", lower=-2e4, upper=2e4, guess=3e3, unit="N/m")
    return sysid.Problem(
        test, mass=M, stiffness=ca.blockcat([[3e4, k], [k, 2e4]]), damping=C,
        recovery=np.eye(2)[:sensors], rigid_body_dofs=G,
    )  # fmt: skip


@pytest.mark.parametrize("sensors", [1, 2])
def test_a_second_structure_that_explains_the_data_exactly_is_told(sensors):
    problem = coupled(sensors)
    result = sysid.identify(problem, strategy=sysid.Continuation(starts=5), rng=0)
    assert result.success
    found = result.values["coupling"].item()
    if sensors == 2:
        assert found == pytest.approx(COUPLING, rel=1e-8)
        assert result.determined
        return
    assert abs(found) == pytest.approx(COUPLING, rel=1e-8)
    assert not result.determined
    (told,) = result.of_kind("other answers")
    assert told.numbers["coupling"] == pytest.approx(-found)


def test_ends_of_other_starts_that_explain_the_data_as_well_are_alternatives_once_each():
    """Of the coupling the sign is open; what explains nothing is none."""
    problem = coupled(1)
    ends = [
        (problem.objective(np.array([k])), LocalResult(np.array([k]), True, "", np.zeros(0)))
        for k in (COUPLING, -COUPLING, 0.5 * COUPLING, -COUPLING * (1 + 1e-9), COUPLING * (1 - 1e-9))
    ]
    found = _alternatives(problem.prepared, np.array([COUPLING]), ends[0][0], ends)
    assert [other.item() for other in found] == [-COUPLING]


def two_tests(**options):
    """The same structure measured twice, with the same noise."""
    k, _, K, C = springs_and_dampers()
    tests = [sysid.simulate(two_floors(), FREQ, noise=0.01, rng=seed) for seed in (1, 2)]
    further = sysid.FurtherTest(tests[1], mass=np.diag(MASS), stiffness=K, damping=C)
    more = options.get("residuals", lambda k: [])(k)
    return sysid.Problem(tests[0], mass=np.diag(MASS), stiffness=K, damping=C, residuals=[further, *more])


def test_the_floor_of_several_tests_is_about_what_the_truth_leaves():
    """Free residues at the poles of the data take little of the noise of hundreds of numbers with them."""
    problem = two_tests()
    truth = np.concatenate([SPRINGS, DAMPERS])
    assert smoothed_tests(problem.prepared).floor == pytest.approx(problem.objective(truth), rel=0.1)


def test_what_residuals_of_the_users_leave_does_not_make_a_fit_of_the_tests_worse():
    """Two priors of a spring that contradict each other by 400 of their deviations, and the truth between them."""
    problem = two_tests(residuals=lambda k: [sysid.Prior(k[0], SPRINGS[0] + off, 10.0) for off in (-2e3, 2e3)])
    truth = np.concatenate([SPRINGS, DAMPERS])
    with DeferredInterrupt() as interrupt:
        outcome = sysid.Continuation(starts=1).run(problem.prepared, Session([], interrupt), truth)
    np.testing.assert_allclose(outcome.x, truth, rtol=0.01)
    assert problem.objective(outcome.x) > 5 * smoothed_tests(problem.prepared).floor
    assert outcome.good


def test_starts_are_unanimous_where_three_end_at_one_fit_of_sorts():
    """Where peaks are not those of the records at all, all may end at one bound, and another strategy may do better."""
    _, _, K, C = springs_and_dampers()
    problem = sysid.Problem(measured(noise=0.01), mass=np.diag(MASS), stiffness=K, damping=C)
    truth, soft = np.concatenate([SPRINGS, DAMPERS]), np.concatenate([SPRINGS / 9, DAMPERS])
    assert problem.residual(truth) < 0.02 and problem.residual(soft) > 0.5
    with DeferredInterrupt() as interrupt:
        run = _Run(problem.prepared, Session([], interrupt))
    for ends, joined, unanimous in (
        ([truth, truth, truth], 0, True), ([truth], 2, True), ([truth, truth], 0, False),
        ([truth, truth, 1.1 * truth], 0, False), ([soft, soft, soft], 0, False),
    ):  # fmt: skip
        results = [LocalResult(x, True, "", np.zeros(1)) for x in ends]
        run.ends, run.joined = [(problem.objective(one.x), one) for one in results], joined
        assert run._unanimous(results[0]) is unanimous


def test_a_start_comes_the_way_of_another_where_that_was_at_the_same_unknowns_after_the_same_step():
    _, _, K, C = springs_and_dampers()
    problem = sysid.Problem(measured(), mass=np.diag(MASS), stiffness=K, damping=C)
    with DeferredInterrupt() as interrupt:
        run = _Run(problem.prepared, Session([], interrupt))
    x = np.concatenate([SPRINGS, DAMPERS])
    run.ways = [[x, 1.1 * x], [1.2 * x]]
    assert run._was_at(0, x) and run._was_at(1, 1.1005 * x) and run._was_at(0, 1.2 * x)
    assert not run._was_at(0, 1.1 * x) and not run._was_at(1, 1.102 * x) and not run._was_at(2, x)


def test_the_best_end_keeps_the_constraints_even_where_one_that_breaks_them_fits_better():
    k, _, K, C = springs_and_dampers()
    problem = sysid.Problem(measured(), mass=np.diag(MASS), stiffness=K, damping=C, constraints=[k[0] <= 1.9e4])
    truth, kept = np.concatenate([SPRINGS, DAMPERS]), np.array([1.8e4, 1.6e4, *DAMPERS])
    ends = [(problem.objective(x), LocalResult(x, True, "", np.zeros(1))) for x in (truth, kept)]
    assert ends[0][0] < ends[1][0]
    np.testing.assert_array_equal(_best(problem.prepared, ends)[1].x, kept)


def test_as_good_as_another_is_what_chance_explains_in_one_of_a_thousand():
    """Two answers of p unknowns differ by a chi-squared of p in the squares of N numbers over N - p."""
    problem = two_tests()
    numbers, p = 2 * 2 * 2 * FREQ.size, 4  # real numbers of two tests of two sensors
    expected = 0.03 * np.sqrt(1 + chi2.isf(1e-3, p) / (numbers - p))
    assert as_good_as(problem.prepared, 0.03) == pytest.approx(expected, rel=1e-12)


def test_distances_are_of_the_size_of_an_unknown_or_of_its_range():
    """a may be zero: a thousandth of its range of 4 is its least size; b is larger than its range of 1."""
    a, b = sysid.Variable("a", lower=-2.0, upper=2.0), sysid.Variable("b", lower=100.0, upper=101.0)
    problem = sysid.Problem(
        measured(), mass=np.diag(MASS), stiffness=STRETCH.T @ ca.diag(ca.vertcat(2e4 + 100 * a, 150 * b)) @ STRETCH,
        damping=1e-3 * np.eye(2),
    )  # fmt: skip
    for x, other, far in (
        ([0.5, 100.5], [0.4, 100.5], 0.1 / 0.4), ([0.001, 100.5], [0.0, 100.5], 0.001 / 0.004),
        ([0.5, 100.5], [0.5, 100.2], 0.3), ([0.5, 100.5], [0.5, 100.5], 0.0),
    ):  # fmt: skip
        assert apart(problem.prepared, np.array(x), np.array(other)) == pytest.approx(far, rel=1e-9)


def test_starts_left_out_for_want_of_time_are_told(monkeypatch):
    """The verdict needs to know whether another structure explains the data."""
    monkeypatch.setattr("sysid.search.session.Session.time_for_more", False)
    _, _, K, C = springs_and_dampers()
    problem = sysid.Problem(measured(noise=0.01), mass=np.diag(MASS), stiffness=K, damping=C)
    result = sysid.identify(problem, strategy=sysid.Continuation(starts=4), rng=0)
    assert result.success
    assert any(one.sentence.startswith("3 of 4 starts") for one in result.of_kind("search"))


def test_time_over_before_there_is_any_structure_is_an_error_of_the_search(monkeypatch):
    from sysid.errors import Stop

    def over(problem, monitor):
        raise Stop("the time was over")

    monkeypatch.setattr("sysid.search.continuation.smoothed_tests", over)
    _, _, K, C = springs_and_dampers()
    problem = sysid.Problem(measured(noise=0.01), mass=np.diag(MASS), stiffness=K, damping=C)
    with pytest.raises(sysid.SolverError, match="the time was over: nothing is identified"):
        sysid.identify(problem, strategy="continuation", rng=0)


def test_a_guess_with_all_modes_at_one_pole_is_a_start_like_any_other():
    """Without a force, of a full mass: more modes at the pole than there are base directions."""
    problem = sysid.Problem(
        measured(), mass=sysid.FullMass(9.0), stiffness=sysid.SpectralStiffness(two_floors().natural_frequencies)
    )
    found, other = (sysid.identify(problem, strategy=one, rng=0) for one in ("continuation", "modal"))
    assert found.success
    assert found.residual == pytest.approx(other.residual, rel=1e-6)
