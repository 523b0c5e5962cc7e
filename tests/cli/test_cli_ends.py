"""Ends of the command line that are no success: goals missed, errors of ours, Ctrl-C, files that cannot grow."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import pytest

import sysid
from sysid.cli import main as cli
from sysid.cli.starting import NOTHING_SAVED
from sysid.report import report
from sysid.results import storage
from sysid.search.session import DeferredInterrupt, TimeIsOver, within
from sysid.search.swarm_objective import SwarmObjective

NOTHING = f"sysid: {NOTHING_SAVED}\n"


def test_a_doubtful_fit_ends_with_one_and_the_same_word_everywhere(here, beside_progress, module, no_pictures):
    misread = module.replace("# a mistake goes here", "response[:, 1] *= 1.02").replace("goal=1e-6", "goal=0.1")
    (here / "pair.py").write_text(misread)
    assert cli.main(["run", "pair.py"]) == 1
    out, error = beside_progress()
    summary = json.loads((here / "results/pair/summary.json").read_text())
    first = summary["findings"][0]
    assert error == "" and out.lstrip().splitlines()[2].startswith("Doubtful: ")
    assert (summary["judgement"], summary["success"]) == ("doubtful", True)
    assert (first["kind"], first["severity"], first["channel"]) == ("gain", "contradicts", "sensor 2")
    assert first["numbers"]["gain"] == pytest.approx(1.02, abs=1e-4)
    assert sysid.load(here / "results/pair").judgement == "doubtful"


def test_a_goal_that_is_not_reached_ends_with_one_and_writes_all(here, beside_progress, module, no_pictures):
    (here / "pair.py").write_text(module.replace("noise=0.0", "noise=0.05"))
    assert cli.main(["run", "pair.py"]) == 1
    out, error = beside_progress()
    assert error == ""
    assert "No fit: " in out
    summary = json.loads((here / "results/pair/summary.json").read_text())
    assert summary["success"] is False
    (missed,) = [one for one in summary["findings"] if one["kind"] == "goal"]
    assert missed["numbers"] == {"residual": summary["residual"], "goal": 1e-6} and summary["residual"] > 1e-6
    assert missed["sentence"] in " ".join(out.split())
    assert (here / "results/pair/report.html").exists()


def test_a_search_without_a_candidate_ends_with_one_and_writes_nothing(here, complaint, files, monkeypatch):
    def identify(*arguments, **options):
        raise sysid.SolverError("no candidate\nat all")

    monkeypatch.setattr(cli, "identify", identify)
    assert cli.main(["run", "pair.py"]) == 1
    assert complaint() == "sysid: no candidate at all\n"
    assert files(here) == {"pair.py"}


def test_an_error_of_ours_is_one_line_and_its_traceback_is_in_the_log(here, complaint, files, monkeypatch):
    def identify(*arguments, **options):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr(cli, "identify", identify)
    assert cli.main(["run", "pair.py"]) == 70
    error = complaint()
    assert "RuntimeError: two lines" in error
    assert str(here / "sysid-error.log") in error
    log = (here / "sysid-error.log").read_text()
    assert "Traceback" in log
    assert "in identify" in log
    assert sysid.__version__ in log
    assert files(here) == {"pair.py", "sysid-error.log"}


def test_the_log_goes_to_the_temporary_folder_where_the_current_one_cannot_be_written(
    here, complaint, monkeypatch, tmp_path_factory
):
    def identify(*arguments, **options):
        raise RuntimeError("a bug")

    elsewhere = tmp_path_factory.mktemp("temporary")
    (here / "sysid-error.log").mkdir()
    monkeypatch.setattr(cli, "identify", identify)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(elsewhere))
    assert cli.main(["run", "pair.py"]) == 70
    assert str(elsewhere / "sysid-error.log") in complaint()
    assert "a bug" in (elsewhere / "sysid-error.log").read_text()
    (elsewhere / "sysid-error.log").unlink()
    (elsewhere / "sysid-error.log").mkdir()
    assert cli.main(["run", "pair.py"]) == 70
    assert "sysid-error.log" not in complaint()


def test_a_report_that_fails_takes_no_result_away(here, capsys, monkeypatch):
    def write(*arguments, **options):
        raise RuntimeError("a bug")

    monkeypatch.setattr(report, "write_report", write)
    assert cli.main(["run", "pair.py"]) == 70
    assert "result.h5" in capsys.readouterr().out
    assert sysid.load(here / "results/pair").success


def test_an_interrupted_search_saves_the_best_so_far_and_ends_with_130(
    here, complaint, commands, monkeypatch, no_pictures
):
    original = sysid.identify

    def identify(*arguments, **options):
        def interrupt(progress):
            if progress.phase == "swarm" and progress.iteration == 3:
                raise KeyboardInterrupt

        return original(*arguments, **(options | {"callback": interrupt}))

    monkeypatch.setattr(cli, "identify", identify)
    assert cli.main(["run", "pair.py", "--strategy", "swarm"]) == 130
    error = complaint()
    assert commands(error) == [["run", "pair.py", "--resume", "results/pair"]]
    assert sysid.load(here / "results/pair").interrupted
    assert json.loads((here / "results/pair/summary.json").read_text())["success"] is False
    assert (here / "results/pair/report.html").exists()


def test_ctrl_c_before_any_candidate_writes_nothing(here, complaint, files, monkeypatch):
    def identify(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "identify", identify)
    assert cli.main(["run", "pair.py"]) == 130
    assert complaint() == NOTHING
    assert files(here) == {"pair.py"}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_report_that_takes_more_time_than_is_left_is_left_out(
    here, capsys, commands, files, monkeypatch, no_pictures
):
    (here / "results/pair").mkdir(parents=True)
    (here / "results/pair/report.html").write_text("of another result")

    def write(*arguments, **options):
        while True:
            time.sleep(0.01)

    monkeypatch.setattr(report, "write_report", write)
    assert cli.main(["run", "pair.py", "--max-time", "1.5"]) == 0
    assert ["report", "results/pair"] in commands(capsys.readouterr().out)
    assert files(here / "results/pair") == {"result.h5", "summary.json"}
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_ctrl_c_while_saving_says_that_files_are_missing(here, complaint, files, monkeypatch):
    def write(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "write_report", write)
    assert cli.main(["run", "pair.py"]) == 130
    assert "results/pair" in complaint()
    assert files(here / "results/pair") == {"result.h5", "summary.json"}
    assert not [name for name in files(here) if name.endswith(".tmp")]


ENDLESS = """
import sysid
from sysid import identify
from sysid.cli import main as cli

endless = sysid.Swarm(10**6, stall_iterations=10**6)
cli.identify = lambda *a, strategy, **k: identify(*a, **k, strategy=endless)
raise SystemExit(cli.main(["run", "free.py"]))
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_the_signal_itself_saves_the_best_so_far(here, without_pictures, interruptible):
    """Wherever it strikes: the benchmark `jobs.interrupted_runs` sends it at random times."""
    (here / "endless.py").write_text(ENDLESS)
    (here / "free.py").write_text(without_pictures.replace("goal=1e-6", "goal=1e-30"))
    running = interruptible("endless.py", cwd=here)
    with running:
        for line in running.stderr:
            if line.startswith("swarm"):
                break
        time.sleep(0.1)
        running.send_signal(signal.SIGINT)
        out, error = running.communicate(timeout=60)
    on = "'sysid run free.py --resume results/free' goes on"
    complaints = [line for line in error.splitlines() if " iteration " not in line]
    assert complaints == [f"sysid: interrupted; the best so far is in results/free; {on}"]
    assert running.returncode == 130
    assert "search: interrupted" in out
    assert sysid.load(here / "results/free").interrupted


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_the_signal_before_any_candidate_writes_nothing(here, files, interruptible):
    (here / "pair.py").write_text("import time\nprint('here', flush=True)\ntime.sleep(60)\n")
    running = interruptible("-m", "sysid", "run", "pair.py", cwd=here)
    with running:
        assert running.stdout.readline() == "here\n"
        running.send_signal(signal.SIGINT)
        _, error = running.communicate(timeout=60)
    assert error == NOTHING
    assert running.returncode == 130
    assert files(here) == {"pair.py"}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_the_signal_while_python_imports_is_one_line_of_the_command_alone(here, interruptible):
    """The first import after sysid itself begins sends the signal."""
    (here / "casadi.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n")
    (here / "sysid_script").write_text("from sysid.cli.main import command\ncommand()\n")
    (here / "bin").mkdir()
    (here / "sysid_script").rename(here / "bin/sysid")
    paths = os.pathsep.join([str(here), *filter(None, [os.environ.get("PYTHONPATH")])])
    for given in (["-m", "sysid", "list"], ["bin/sysid", "list"]):
        with interruptible(*given, cwd=here, env={**os.environ, "PYTHONPATH": paths}) as running:
            _, error = running.communicate(timeout=60)
        assert (error, running.returncode) == (NOTHING, 130)
    with interruptible("-c", "import sysid", cwd=here, env={**os.environ, "PYTHONPATH": paths}) as running:
        _, error = running.communicate(timeout=60)
    assert error.endswith("KeyboardInterrupt\n")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_third_ctrl_c_acts_at_once_and_what_it_breaks_is_no_error_of_ours(
    here, complaint, files, monkeypatch, ctrl_c
):
    """As CasADi does it, the interrupt comes out as another exception."""

    def judge(self, particles):
        for _ in range(2):  # they wait for the next report
            signal.raise_signal(signal.SIGINT)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr(SwarmObjective, "__call__", judge)
    assert cli.main(["run", "pair.py", "--strategy", "swarm"]) == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert complaint() == NOTHING
    assert files(here) == {"pair.py"}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("times", [1, 5])
@pytest.mark.parametrize("place", ["search", "save", "report"])
def test_ctrl_c_after_the_search_loses_nothing(here, complaint, files, monkeypatch, no_pictures, place, times, ctrl_c):
    """As the search is done, while the result is written, and while the page is made (a third one ends that)."""
    owner, name = {"search": (cli, "identify"), "save": (storage, "write_tree"), "report": (report, "write_report")}[
        place
    ]
    original = getattr(owner, name)

    def struck(*arguments, **options):
        if place == "search":
            found = original(*arguments, **options)
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
        return found if place == "search" else original(*arguments, **options)

    monkeypatch.setattr(owner, name, struck)
    assert cli.main(["run", "pair.py"]) == 130
    ended = place == "report" and times > 2
    assert "results/pair" in complaint()
    written = files(here / "results/pair")
    assert written == {"result.h5", "summary.json"} | (set() if ended else {"report.html"})
    assert sysid.load(here / "results/pair").success


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_ctrl_c_that_one_holds_is_known_to_another_within_it(ctrl_c):
    with DeferredInterrupt(patience=None) as outer:
        signal.raise_signal(signal.SIGINT)
        with DeferredInterrupt() as inner, pytest.raises(KeyboardInterrupt):
            inner.check()
        assert outer.count == 1


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_time_limit_outlives_what_swallows_it_once():
    """Libraries take any Exception, and compiled code makes another one of it."""
    with pytest.raises(TimeIsOver), within(0.05), contextlib.suppress(Exception):
        time.sleep(0.1)
    with pytest.raises(TimeIsOver), within(0.05):
        try:
            time.sleep(0.1)
        except TimeIsOver as error:
            raise SystemError("returned a result with an exception set") from error
    with pytest.raises(SystemError), within(60.0):
        raise SystemError("of its own")
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_run_that_was_told_to_ignore_ctrl_c_ignores_it(here, monkeypatch, no_pictures, ctrl_c):
    original = sysid.identify
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def identify(*arguments, **options):
        signal.raise_signal(signal.SIGINT)
        return original(*arguments, **options)

    monkeypatch.setattr(cli, "identify", identify)
    assert cli.main(["run", "pair.py"]) == 0
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
def test_files_that_cannot_grow_are_one_line(here, files):
    import resource

    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))  # noqa: E731
    command = [sys.executable, "-m", "sysid", "run", "pair.py"]
    done = subprocess.run(command, capture_output=True, timeout=120, check=False, cwd=here, preexec_fn=limit)
    assert done.returncode == 2
    assert [line.startswith(b"sysid: ") for line in done.stderr.splitlines() if b" iteration " not in line] == [True]
    assert files(here) == {"pair.py"}
