"""`max_time` holds: within the larger of a tenth and 2 s, judgement included, and what it cuts off is told as that.

Seconds are those of the processor, so that what else the machine does is none of ours.
"""

import os
import re
import signal
import time
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.finding import Finding, Severity
from sysid.nlp import GRACE, IterationMonitor
from sysid.results.answer import Answer
from sysid.search.local import fit_in_matrices
from sysid.search.session import DeferredInterrupt, Session, TimeIsOver, in_time, within
from sysid.search.swarm_objective import SwarmObjective

posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture(autouse=True)
def imported():
    """Import beforehand what is imported where it is used."""
    import scipy.optimize
    import scipy.stats

    return scipy.optimize, scipy.stats


def free(random_case, n):
    return random_case(np.random.default_rng(0), "rigid_body", n=n, d=1)[1]


def chain(n):
    """A chain of n masses that are known, its springs and dampers unknown."""
    T = np.eye(n) - np.eye(n, k=-1)
    springs, dampers = np.linspace(2e4, 4e4, n), np.linspace(10.0, 20.0, n)
    M, K = np.eye(n), T.T @ np.diag(springs) @ T
    G = np.ones((n, 1))
    truth = sysid.Structure(
        np.block([[M, 0 * G], [0 * G.T, 0]]), np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]]), n_base=1,
        damping_matrix=T.T @ np.diag(dampers) @ T,
    )  # fmt: skip
    f = truth.natural_frequencies
    k = sysid.Variable("k", n, lower=1e4, upper=1e5, unit="N/m")
    c = sysid.Variable("c", n, lower=1.0, upper=100.0, unit="N s/m")
    return sysid.Problem(
        sysid.simulate(truth, np.geomspace(0.5 * f[0], 1.2 * f[-1], 200)),
        mass=M, stiffness=T.T @ ca.diag(k) @ T, damping=T.T @ ca.diag(c) @ T,
    )  # fmt: skip


@pytest.fixture
def seconds_of(monkeypatch):
    """Give a function that identifies by a clock of the processor's seconds: the result and how many it took."""

    def run(problem, max_time, **options):
        begun = time.process_time()
        result = sysid.identify(problem, rng=0, max_time=max_time, **options)
        return result, time.process_time() - begun

    monkeypatch.setattr(time, "perf_counter", time.process_time)
    return run


def test_graphs_that_would_not_be_done_in_time_are_not_begun(random_case, seconds_of):
    """The published way with 20 sensors, whose graphs take longer."""
    result, seconds = seconds_of(free(random_case, 20), 0.5, strategy="hpso-ls")
    assert seconds < 2.5
    assert not result.success
    assert float(re.search(r"derivatives take some (\S+) s", result.message)[1]) > 0.5
    assert "local minimum" not in result.message  # nobody knows
    assert not result.determined


def test_a_model_of_its_own_is_no_exception(seconds_of):
    result, seconds = seconds_of(chain(16), 1.5, strategy="continuation")
    assert seconds < 2.5
    assert not result.success
    assert float(re.search(r"takes? some (\S+) s", result.message)[1]) > 1.5
    # A fit that was not made says nothing of data and model.
    assert not any("rigid_body" in sentence for sentence in result.undetermined)


@posix
@pytest.mark.parametrize(
    "name",
    [
        "sysid.results.judgement.determine", "sysid.assessment.checks.against_records.gain_errors",
        "sysid.results.judgement._check_precision",
    ],
)  # fmt: skip
def test_a_judgement_that_takes_too_long_is_given_up_and_determines_nothing(random_case, monkeypatch, name):
    problem = random_case(np.random.default_rng(0), "rigid_body", n=3, d=1, force=True)[1]
    assert sysid.identify(problem, rng=0).determined

    def endless(*arguments, **options):
        end = time.perf_counter() + 20
        while time.perf_counter() < end:
            time.sleep(0.01)

    monkeypatch.setattr(name, endless)
    begun = time.perf_counter()
    result = sysid.identify(problem, rng=0, max_time=1.0)
    assert time.perf_counter() - begun < 10
    assert result.success
    assert not result.closed_by and [one.kind for one in result.open_findings] == ["not judged"]
    assert result.judgement == "one of many" and not result.contradictions


def test_a_summary_in_a_hurry_leaves_out_what_is_not_computed_and_calls_nothing_open(random_case, monkeypatch):
    problem = random_case(np.random.default_rng(0), "lumped", "chain", "proportional", n=2, d=1)[1]
    result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))

    def refused(self):
        raise AssertionError("asked for")

    monkeypatch.setattr(Answer, "uncertainty", property(refused))
    monkeypatch.setattr(Answer, "_intervals", property(refused))
    told = replace(result.with_findings([Finding("open", Severity.CAUTION, "-")]), hurried=True)
    words, figures = told.summary(), told.to_dict()
    assert "~" not in words
    assert "open" not in words
    assert figures["natural_frequencies_std_hz"] == [None] * 2


def test_the_session_counts_what_is_left():
    def session(max_time, seconds):
        made = Session([], DeferredInterrupt(), max_time)
        made.start_time -= seconds
        return made

    assert session(None, 99.0).left is None
    assert session(None, 99.0).allows(1e9)
    assert not session(None, 99.0).is_over
    assert session(10.0, 4.0).left == pytest.approx(6.0, abs=0.1)
    assert session(10.0, 11.0).left == GRACE
    assert session(10.0, 11.0).is_over
    # Three times the seconds, as others may work on the machine, and 0.4 s late at most.
    assert session(10.0, 4.0).allows(2.1)
    assert not session(10.0, 4.0).allows(2.3)
    late = session(10.0, 4.0)
    assert not late.cut_short
    late.left_out = True
    assert late.cut_short


def test_a_run_of_ipopt_ends_at_the_deadline_though_its_graphs_were_made_before():
    problem = chain(2)
    monitor = IterationMonitor(None, 30.0)
    monitor.listener = lambda iteration, objective: setattr(monitor, "deadline", -np.inf)
    end = fit_in_matrices(problem.prepared, problem.formulation.guess, monitor, 50)
    assert monitor.taken == 1
    assert end.status == "Maximum_WallTime_Exceeded"


def test_a_clock_beside_the_objective_changes_no_bit(random_case):
    problem = free(random_case, 3)
    objective = SwarmObjective(problem.prepared, (), problem.formulation.stiffness.spectrum)
    rows = np.random.default_rng(1).uniform(problem.lower, problem.upper, (600, problem.n_variables))
    clocked = in_time(objective, len, Session([], DeferredInterrupt(), 1e6), 256)
    np.testing.assert_array_equal(clocked(rows), objective(rows))


def test_what_there_is_no_time_for_is_left_out_after_the_first_rows():
    over = Session([], DeferredInterrupt(), 1e-9)
    seen = in_time(lambda rows: 2 * rows, lambda rows: 0 * rows, over, 2)(np.arange(1.0, 6.0))
    np.testing.assert_array_equal(seen, [2, 4, 0, 0, 0])


def test_a_swarm_that_cannot_begin_in_time_does_not(random_case):
    problem = free(random_case, 3)
    with pytest.raises(sysid.SolverError, match="before it had a single candidate"):
        sysid.identify(problem, strategy=sysid.Swarm(n_particles=10**9), rng=0, max_time=5.0)


@posix
def test_a_time_limit_hands_back_the_alarm_that_was_set_before():
    rung = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: rung.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 100.0, 7.0)
        with within(60.0):
            time.sleep(0.05)
        left, again = signal.getitimer(signal.ITIMER_REAL)
        assert 50.0 < left < 99.96
        assert again == pytest.approx(7.0)
        with pytest.raises(TimeIsOver), within(0.02):
            time.sleep(10.0)
        assert 50.0 < signal.getitimer(signal.ITIMER_REAL)[0] < 99.95
        # One that would have rung meanwhile rings at the end.
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        with within(60.0):
            time.sleep(0.05)
            assert rung == []
        time.sleep(0.05)
        assert rung == [signal.SIGALRM]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
