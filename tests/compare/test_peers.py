"""Peers search what the swarm searches: the same numbers, no more of them, and the same bits for the same seed."""

import contextlib

import numpy as np
import pytest

import sysid
from sysid.compare import comparison, peers
from sysid.compare.peers import Recorder, Status
from sysid.search.session import DeferredInterrupt, Session

TRUTH = sysid.Structure(
    np.diag([2.0, 1.0, 0.5]), 4e3 * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]), [0.01, 0.02],
    n_base=1,
)  # fmt: skip

needs_the_extra = pytest.mark.skipif(bool(peers.missing_packages()), reason="the extra 'benchmark' is not installed")
every_peer = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=needs_the_extra if "SciPy" not in name else ()) for name in peers.PEERS]
)


def two_masses(mass=None, **given):
    test = sysid.simulate(TRUTH, np.linspace(2.0, 20.0, 40))
    return sysid.Problem(test, mass=mass or sysid.FullMass(3.0), reference=TRUTH, goal=1e-6, **given)


def a_session(max_time=None, seed=0, listeners=()):
    return Session(list(listeners), DeferredInterrupt(), max_time, np.random.SeedSequence(seed))


@pytest.fixture(scope="module")
def landscape():
    return peers.Landscape.of(two_masses().prepared, a_session())


class Bowl:
    """A paraboloid in the unit cube, 1,500 evaluations of it."""

    def __init__(self):
        self.seen = []

    def __call__(self, unit):
        assert np.all((unit >= 0) & (unit <= 1))
        self.seen += np.sum((unit - [0.3, 0.6, 0.1]) ** 2, axis=1).tolist()
        if len(self.seen) > 1500:
            raise peers.Spent
        return np.array(self.seen[-len(unit) :])


@every_peer
def test_a_peer_goes_down_a_bowl_the_same_way_each_time_and_leaves_the_global_source_alone(name):
    state, ways = np.random.get_state()[1].copy(), []  # noqa: NPY002 - it is what must not change
    for _ in range(2):
        bowl = Bowl()
        with contextlib.suppress(peers.Spent):
            peers.PEERS[name](bowl, 3, np.random.default_rng(5))
        ways.append(bowl.seen)
    assert ways[0] == ways[1]
    assert min(ways[0]) < 1e-3
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_what_is_searched_is_the_objective_of_the_refined_structure(landscape):
    problem, rng = landscape.problem, np.random.default_rng(1)
    s = landscape.at(rng.random((5, problem.n_variables)))
    values = landscape.objective(s)
    for row, value in zip(s, values, strict=True):
        x = landscape.objective.refined(landscape.objective.unknowns(row))
        # The measured frequencies are the structure's, and another path to the objective agrees.
        frequencies = problem.structure(x).natural_frequencies
        np.testing.assert_allclose(frequencies, problem.formulation.stiffness.spectrum / (2 * np.pi), rtol=1e-9)
        assert problem.objective(x) == pytest.approx(value, rel=1e-9)


def test_without_a_stated_spectrum_nothing_is_refined_and_peaks_are_widened_as_the_swarms(landscape):
    assert landscape.steps == []
    chain = two_masses(sysid.LumpedMass(3.0), stiffness=sysid.ChainStiffness(4e2, 4e4))
    other = peers.Landscape.of(chain.prepared, a_session())
    assert len(other.steps) == 4
    x = np.full(chain.n_variables, 0.5)
    assert other.objective.refined(x) is x
    # The wide peaks are easier: away from the truth their misfit is another one.
    s = other.at(np.full((1, chain.n_variables), 0.4))
    assert other.objective(s)[0] != pytest.approx(chain.objective(other.objective.unknowns(s[0])), rel=1e-3)


def test_the_budget_is_never_exceeded_and_the_best_is_kept(landscape):
    evaluator = peers.Evaluator(landscape, 25, a_session())
    points = np.random.default_rng(0).random((40, landscape.problem.n_variables))
    first = evaluator(points[:20])
    with pytest.raises(peers.Spent):
        evaluator(points[20:])
    assert evaluator.count == 25
    every = landscape.objective(landscape.at(points[:25]))
    np.testing.assert_array_equal(first, every[:20])
    assert evaluator.best == every.min()
    np.testing.assert_array_equal(evaluator.s, landscape.at(points[np.argmin(every)]))
    assert [value for _, value in evaluator.curve] == [every[:20].min(), every.min()]


def test_a_search_ends_with_its_share_of_the_time(landscape):
    evaluator = peers.Evaluator(landscape, 10**6, a_session(max_time=1e-9))
    with pytest.raises(peers.Spent):
        evaluator(np.full((1, landscape.problem.n_variables), 0.5))


def test_ctrl_c_ends_a_peer_with_its_best(landscape, monkeypatch):
    session = a_session()

    def search(evaluate, size, rng):
        evaluate(rng.random((10, size)))
        session.interrupt.count = 1
        evaluate(rng.random((10, size)))

    monkeypatch.setitem(peers.PEERS, "stopped", search)
    result = peers.run("stopped", landscape, 1000, session, Recorder())
    assert result.status is Status.INTERRUPTED
    assert result.evaluations == 10
    assert result.before == result.after == pytest.approx(dict(result.phases)["search"][-1, 1], rel=1e-9)


def test_a_search_without_a_structure_is_a_row_that_says_so(landscape, monkeypatch):
    monkeypatch.setitem(peers.PEERS, "lost", lambda evaluate, size, rng: evaluate(np.full((1, size), 0.5)))
    objective = landscape.objective
    monkeypatch.setattr(type(objective), "__call__", lambda self, s: np.full(len(s), np.nan))
    monkeypatch.setattr(type(objective), "unknowns", lambda self, s: np.zeros(s.size))
    result = peers.run("lost", landscape, 10, a_session(), Recorder())
    assert result.status is Status.FAILED
    assert not result.ran
    assert result.message


def test_peers_take_the_swarms_evaluations_and_its_local_phase(monkeypatch):
    monkeypatch.setattr(peers, "missing_packages", list)
    monkeypatch.setattr(peers, "PEERS", {name: peers.PEERS[name] for name in ("SciPy DE", "SciPy L-BFGS-B")})
    monkeypatch.setattr(comparison, "NAMED", {"swarm": lambda: sysid.Swarm(max_iterations=30)})
    first, second = (comparison.compare(two_masses(), rng=1).results for _ in range(2))
    swarm = next(result for result in first if result.name == "swarm")
    for one, other in zip(first[-2:], second[-2:], strict=True):
        assert 0 < one.evaluations <= swarm.evaluations
        assert one.status is Status.FIT
        assert one.after < 1e-9 < one.before
        assert {name for name, _ in one.phases} == {"search", "local phase"}
        assert (one.before, one.after, one.errors) == (other.before, other.after, other.errors)
    assert first[-2].evaluations == swarm.evaluations


def test_where_the_swarm_refuses_peers_do_too(monkeypatch):
    monkeypatch.setattr(peers, "missing_packages", list)
    problem = two_masses(sysid.FullMass(3.0, known=[[2.0, np.nan], [np.nan, np.nan]]))
    results = comparison.compare(problem).results
    assert results[0].status is Status.FIT
    assert {result.name for result in results[1:]} == {"continuation", "swarm", "hpso-ls", *peers.PEERS}
    assert {result.status for result in results[1:]} == {Status.REFUSED}
