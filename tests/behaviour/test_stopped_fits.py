"""Fits of whole records that Ctrl-C, a callback or the time limit stops, from the records to the stored result."""

import contextlib
import importlib
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.errors import Stop
from sysid.modal_analysis import fit as fit_module
from sysid.modal_analysis.fit import fit_tests, whole_fit
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.rough_poles import decimated_lines
from sysid.search.session import regularly

ROOT = Path(__file__).resolve().parents[2]
posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture(scope="module")
def records():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        yield [importlib.import_module(f"benchmarks.records.{name}") for name in ("simulated", "trial")]


@pytest.fixture(scope="module")
def storeys(records):
    """Give a function that makes a test of four storeys, so many seconds long."""
    simulated, trial = records
    whole = simulated.four_storeys()

    def test(seconds=30.0, seed=1, rate=200.0):
        setting = simulated.Setting(whole.structure, seconds, rate, (1.0, 20.0), (0.5, 50.0), np.eye(1))
        rng = np.random.default_rng(seed)
        noisy, _ = setting.with_noise(setting.run(rng).records(), rng)
        return trial.measurement([noisy], setting, force=True)

    return test


class Stopped(FitMonitor):
    """A monitor that stops a fit so many calls after there was one to keep."""

    def __init__(self, calls, error=Stop):
        self.left, self.error = calls, error
        super().__init__(check=self.stop)

    def stop(self, kept):
        self.left -= kept
        if self.left < 0:
            raise self.error("asked")


def stopped_callback(error, doing):
    """A callback that raises once a phase of the fit has begun."""

    def callback(progress):
        if progress.doing == doing:
            raise error

    return callback


# -- the fit ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(storeys):
    """A fit that nothing stops."""
    return whole_fit(storeys())


@pytest.mark.parametrize("error", [Stop, KeyboardInterrupt])
def test_a_fit_that_is_stopped_gives_its_best_and_passes_on_what_stopped_it_before_there_was_one(whole, error):
    test = whole.test
    assert not whole.stopped
    fit = whole_fit(test, monitor=Stopped(3, error))
    assert fit.stopped and fit.settled and fit.test is test
    truth = np.sort(whole.parameters.modes.omega)
    np.testing.assert_allclose(np.sort(fit.parameters.modes.omega), truth, rtol=1e-3)
    with pytest.raises(error):
        whole_fit(test, monitor=FitMonitor(check=lambda kept: Stopped(-1, error).stop(True)))


def test_a_fit_of_some_lines_that_is_stopped_is_brought_to_all_of_them(storeys):
    """Its chi-squared, noise and modes are those of all lines, though these were not searched."""
    test = storeys(240.0)
    some = decimated_lines(test)
    assert not np.all(some)
    whole = whole_fit(test)
    fit = whole_fit(test, monitor=Stopped(0))
    assert fit.stopped and fit.test.freq.size == test.freq.size
    assert fit.chi2 == pytest.approx(fit.model.chi2(fit.parameters, fit.levels), rel=1e-12)
    assert fit.reduced == pytest.approx(1.0, abs=5 / np.sqrt(fit.freedom / 2))
    std = fit_module.estimate(whole)
    A = std.information
    m = std.omega.size
    at = A.shape[0] - 2 * m - 1 + np.arange(m)  # of log omega, before log ratios and the mass
    deviation = np.sqrt(np.diag(np.linalg.inv(A)) / 2)[at]
    off = np.log(np.sort(fit.parameters.modes.omega)) - np.log(std.omega)
    assert np.all(np.abs(off) < 0.5 * deviation)
    np.testing.assert_allclose(fit.levels, whole.levels, rtol=0.05)


def test_the_better_fit_of_the_same_lines_is_kept_and_a_spurious_mode_does_not_come_back():
    class Fit:
        def __init__(self, lines, schwarz):
            self.test, self.schwarz = type("Test", (), {"freq": np.zeros(lines)})(), schwarz

    monitor = FitMonitor()
    monitor.begin(1)
    some, better, worse, every = Fit(10, 1.0), Fit(10, 2.0), Fit(10, 1.5), Fit(100, -5.0)
    for fit, best in ((some, some), (better, better), (worse, better), (every, every)):
        monitor.keep(fit)
        assert monitor.best is best
    fewer = Fit(100, -9.0)
    monitor.keep_instead(fewer)
    assert monitor.best is fewer
    monitor.begin(1)
    assert monitor.best is None


def test_a_monitor_ends_nothing_outside_a_fit_nor_while_its_listener_is_at_work():
    asked = []
    monitor = FitMonitor(lambda i, residual, doing: monitor.check(), asked.append)
    monitor.check()
    assert asked == []
    with monitor.at_work():
        monitor(1, 0.5)
    assert asked == [False]  # once the listener was done
    monitor.check()
    assert asked == [False]


def test_tests_share_the_time_and_one_without_a_fit_goes_on_beyond_its_share(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monitor = FitMonitor(seconds=30.0)
    kept = type("Fit", (), {"test": None, "schwarz": 0.0})()
    for tests, share in ((3, 10.0), (2, 10.0), (1, 10.0)):
        monitor.begin(tests)
        with monitor.at_work():
            now[0] += share - 0.01
            monitor.check()
            now[0] += 0.02
            monitor.check()  # without a fit
            monitor.keep_instead(kept)
            with pytest.raises(Stop):
                monitor.check()
        now[0] -= 0.01


def test_a_test_without_modes_beside_others_that_have_them_is_named(storeys):
    tests = [storeys(20.0), storeys(20.0, seed=2)]
    ends = iter([False, True])

    class Second(FitMonitor):
        def begin(self, count):
            super().begin(count)
            self.ends = next(ends)

    monitor = Second(check=lambda kept: Stopped(-1).stop(True) if monitor.ends else None)
    with pytest.raises(Stop, match="2 of 2"):
        fit_tests([(test, None) for test in tests], monitor)


@posix
def test_what_is_called_regularly_may_end_work_that_asks_nobody():
    before, calls = signal.getsignal(signal.SIGALRM), []

    def end():
        calls.append(time.perf_counter())
        if len(calls) == 3:
            raise Stop

    with pytest.raises(Stop), regularly(end, 0.02):
        sum(1 for _ in iter(int, 1))
    assert len(calls) == 3
    assert signal.getsignal(signal.SIGALRM) is before and signal.getitimer(signal.ITIMER_REAL)[0] == 0.0


# -- the identification ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(storeys):
    """An identification that nothing stops."""
    return sysid.identify(sysid.Problem(storeys(), mass=sysid.FullMass()), rng=0)


@posix
@pytest.mark.parametrize("way", ["signal", "callback", "its own interrupt"])
def test_an_identification_ends_with_the_modes_that_a_stopped_fit_had(storeys, finished, tmp_path, monkeypatch, way):
    problem = sysid.Problem(storeys(), mass=sysid.FullMass())

    def callback(progress):
        if progress.doing == "poles by the noise found":
            if way == "signal":
                signal.raise_signal(signal.SIGINT)
            else:
                raise StopIteration if way == "callback" else KeyboardInterrupt

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = sysid.identify(problem, rng=0, callback=callback)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert result.interrupted == (way != "callback")
    assert result.modal[0].stopped and result.success
    assert result.judgement == "one of many"
    assert [one.numbers["modes"] for one in result.of_kind("modes not all tried")] == [4.0]
    np.testing.assert_allclose(result.structure.natural_frequencies, finished.structure.natural_frequencies, rtol=1e-3)

    def refitted(*arguments, **options):
        raise AssertionError("the records were fitted anew")

    result.save(tmp_path)
    for name in ("sysid.modal_analysis.fit.whole_fit", "sysid.problem.prepared.fit_modes"):
        monkeypatch.setattr(name, refitted)
    again = sysid.load(tmp_path)
    assert again.modal[0].stopped and again.judgement == result.judgement
    np.testing.assert_array_equal(again.modal[0].information, result.modal[0].information)
    assert again.summary() == result.summary()
    of_problem = sysid.load(tmp_path, problem=problem)
    np.testing.assert_array_equal(of_problem.modal[0].omega, result.modal[0].omega)


def test_a_stopped_fit_is_kept_by_hubers_loss_and_by_several_tests(storeys):
    test = storeys()
    huber = sysid.Problem(test, mass=sysid.FullMass(), loss="huber")
    result = sysid.identify(huber, rng=0, callback=stopped_callback(KeyboardInterrupt, "poles by the noise found"))
    assert result.interrupted and result.structure.n == 4
    assert result.of_kind("modes not all tried") and result.of_kind("search")


def test_an_interrupt_while_outliers_are_looked_for_keeps_the_modes(storeys, tmp_path):
    huber = sysid.Problem(storeys(20.0), mass=sysid.FullMass(), loss="huber")

    def callback(progress):
        if progress.phase == "poles" and not progress.doing:
            raise KeyboardInterrupt

    result = sysid.identify(huber, rng=0, callback=callback)
    assert result.structure.n == 4 and result.interrupted and result.success
    assert result.of_kind("modes not all tried")
    result.save(tmp_path)
    again = sysid.load(tmp_path)
    assert again.summary() == result.summary() and again.residual == result.residual


def test_a_stopped_fit_of_a_steady_sine_is_refused_too(records):
    simulated, _ = records
    setting, sine = simulated.four_storeys(), 4.3
    turn = np.exp(2j * np.pi * sine * np.arange(30 * int(setting.sample_rate)) / setting.sample_rate)
    H, Z = setting.structure.transmissibility([sine])[:, 0], setting.structure.base_force([sine])[0]
    moving = simulated.Records(turn.real[None], (H * turn).real, (Z * turn).real, setting.sample_rate)
    noisy, _ = simulated.with_noise(moving, np.random.default_rng(0), 0.01)
    test = sysid.Measurement.from_time(
        [(noisy.base, noisy.response, noisy.force)],
        setting.sample_rate, rigid_body=np.ones((4, 1)), band=setting.lines,
    )  # fmt: skip
    with pytest.raises(sysid.InputError, match="steady sine"):
        whole_fit(test, monitor=Stopped(0))


def test_a_stored_fit_stands_for_no_test_of_which_something_else_is_stated(storeys, tmp_path):
    test = storeys(20.0)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    result.save(tmp_path)
    noise = result.modal[0].noise
    stated = type(noise)(*(5 * part for part in (noise.response, noise.base, noise.force)))
    other = replace(test, whole=replace(test.whole, noise=stated))
    given = sysid.load(tmp_path, problem=sysid.Problem(other, mass=sysid.FullMass()))
    np.testing.assert_allclose(given.modal[0].noise.response, stated.response, rtol=1e-12)


def test_the_time_limit_ends_a_fit_that_has_something_to_keep(storeys, monkeypatch):
    """The share of the fit is over as soon as there is a first one, and what follows still has its time."""
    problem = sysid.Problem(storeys(), mass=sysid.FullMass())
    monkeypatch.setattr("sysid.search.session.Session.fit_monitor", _at_once)
    result = sysid.identify(problem, rng=0, max_time=60.0)
    assert not result.interrupted and result.judgement == "one of many"
    assert [one.kind for one in result.open_findings] == ["modes not all tried"]


@contextlib.contextmanager
def _at_once(session):
    yield FitMonitor(session.preparing, session._check_fit, 0.0)


def test_damaged_fits_in_a_file_are_refused(storeys):
    fit = whole_fit(storeys(20.0))
    tree, other = fit.to_tree(), storeys(20.0)
    again = type(fit).from_tree(tree, other)
    assert again.chi2 == fit.chi2 and again.likelihood == fit.likelihood
    for damage in ({"levels": fit.levels[:, :-1]}, {"rigid": np.full((1, 1), np.nan)}, {"ends": np.zeros((1, 2))}):
        with pytest.raises(sysid.InputError):
            type(fit).from_tree(tree | damage, other)
