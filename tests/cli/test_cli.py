"""The command line: what each command shows and writes, and one line and a status for every way it can end."""

import contextlib
import errno
import json
import os
import re
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.cli import main as cli
from sysid.cli import output
from sysid.report import report
from sysid.results.summary import JUDGEMENTS

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
FREQUENCIES = "truth.natural_frequencies"
KEYS = {
    "problem", "strategy", "seed", "success", "message", "residual", "natural_frequencies_hz", "damping_ratios",
    "total_mass_kg", "total_mass_std_kg", "determined", "evaluations", "wall_time_s", "version",
    "natural_frequencies_std_hz", "damping_ratios_std", "findings", "judgement", "confidence", "objective",
    "residuals", "unknowns", "unknowns_std", "unknown_units",
}  # fmt: skip


# -- success ------------------------------------------------------------------------------------


def test_run_writes_three_files_under_the_name_of_the_module_and_tells_where(here, beside_progress, files, no_pictures):
    assert cli.main(["run", "pair.py", "--seed", "3"]) == 0
    out, error = beside_progress()
    assert error == ""
    assert files(here) == {"pair.py", "results", "results/pair"} | {
        f"results/pair/{name}" for name in ("result.h5", "summary.json", "report.html")
    }
    for name in ("result.h5", "summary.json", "report.html"):
        assert f"results/pair/{name}\n" in out
    # The frequencies of the structure in the module, from SciPy's generalised eigenproblem.
    from scipy.linalg import eigh

    K = 4e3 * np.array([[2.0, -1.0], [-1.0, 2.5]])
    exact = np.sqrt(eigh(K, np.diag([2.0, 1.0]), eigvals_only=True)) / (2 * np.pi)
    for frequency in exact:
        assert f"{frequency:.5g}" in out

    summary = json.loads((here / "results/pair/summary.json").read_text(), parse_constant=pytest.fail)
    assert set(summary) >= KEYS
    assert summary["judgement"] == "one of many"
    assert f"{JUDGEMENTS[summary['judgement']]}: " in out
    assert summary["problem"] == "pair.py"
    assert summary["seed"] == 3
    assert summary["success"] is True
    assert summary["residual"] <= 1e-6
    assert summary["natural_frequencies_hz"] == pytest.approx(exact, rel=1e-5)
    assert summary["total_mass_kg"] == pytest.approx([3.5], rel=1e-9)
    assert summary["version"] == sysid.__version__
    assert summary["strategy"] == "modal"
    assert "strategy 'modal'" in out and "strategy" in [one["kind"] for one in summary["findings"]]
    # Without noise nothing is left but round-off.
    for std in (summary["natural_frequencies_std_hz"], summary["damping_ratios_std"]):
        assert std == [pytest.approx(0, abs=1e-9)] * 2

    result = sysid.load(here / "results/pair")
    assert result.recipe == sysid.Recipe("pair.py", None, 0)
    assert result.residual == summary["residual"]


def test_the_same_seed_gives_the_same_figures_and_the_default_seed_is_zero(here, no_pictures):
    again = {}
    for out, seed in (("a", ["--seed", "0"]), ("b", ["--seed", "1"]), ("c", [])):
        assert cli.main(["run", "pair.py", "--strategy", "swarm", "--out", out, *seed]) == 0
        again[out] = json.loads((here / out / "summary.json").read_text())
        del again[out]["wall_time_s"]
    assert again["a"] == again["c"]
    assert again["a"]["seed"] == 0
    assert again["a"]["residual"] != again["b"]["residual"]


def test_report_is_written_again_from_the_file_or_its_folder(finished, capsys, monkeypatch):
    target = finished / "report.html"
    page = target.read_text()
    assert len(page) > 1000
    target.unlink()
    assert cli.main(["report", str(finished)]) == 0
    assert capsys.readouterr().out == f"{target}\n"
    assert target.read_text() == page  # the same result, the same page
    monkeypatch.setattr(report, "render", lambda result: f"residual {result.residual}")
    assert cli.main(["report", str(finished / "result.h5")]) == 0
    assert capsys.readouterr().out == f"{target}\n"
    assert target.read_text() == f"residual {sysid.load(finished).residual}"


def test_list_names_each_bundled_problem_on_a_line(here, capsys):
    assert cli.main(["list"]) == 0
    out = capsys.readouterr().out
    names = [line.split()[0] for line in out.splitlines()]
    assert names == sorted(names)
    assert {"cantilever_tower", "spacecraft_dummy", "shear_building", "mini_shake_table"} <= set(names)


def test_version_and_help_end_with_zero(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"sysid {sysid.__version__}\n"
    for command in ([], ["run"], ["list"], ["report"]):
        assert cli.main([*command, "--help"]) == 0
        assert "usage: sysid" in capsys.readouterr().out


@pytest.fixture(scope="module")
def in_ascii(tmp_path_factory, without_pictures):
    """What a process said whose module prints other letters than its streams have."""
    folder = tmp_path_factory.mktemp("ascii")
    (folder / "pair.py").write_text("print('ζ²')\n" + without_pictures, encoding="utf-8")
    environment = os.environ | {"FORCE_COLOR": "1", "TTY_COMPATIBLE": "1", "PYTHONIOENCODING": "ascii", "COLUMNS": "40"}
    command = [sys.executable, "-m", "sysid", "run", "pair.py", "--strategy", "swarm"]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, timeout=120, check=False)


def test_plain_output_has_no_control_codes_whatever_the_environment_asks(in_ascii):
    done = in_ascii
    assert done.returncode == 0
    assert b"One of many: " in done.stdout and b" iteration " not in done.stdout
    for stream in (done.stdout, done.stderr):
        assert b"\x1b" not in stream
        assert b"\r" not in stream.replace(os.linesep.encode(), b"\n")
    text = done.stderr.decode("ascii")
    for phase in ("swarm", "local phase"):
        assert re.search(rf"^{phase} +iteration +\d+ +objective +\S+ +[\d.]+ s$", text, re.M)


def test_the_modal_strategy_tells_its_only_phase(here, capsys, no_pictures):
    assert cli.main(["run", "pair.py", "--strategy", "modal"]) == 0
    out, error = capsys.readouterr()
    assert re.search(r"^local phase +iteration +\d+ +objective +\S+ +[\d.]+ s$", error, re.M)
    assert not re.search(r"^swarm ", error, re.M)
    assert "strategy 'modal', as asked" in out
    assert "nan" not in out


def test_what_the_module_prints_cannot_end_the_run_by_its_letters(in_ascii):
    assert in_ascii.returncode == 0
    assert in_ascii.stdout.startswith(b"??")


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")
def test_a_terminal_sees_a_table_that_updates(here, without_pictures):
    import pty

    (here / "pair.py").write_text(without_pictures)
    main_end, process_end = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100", "LINES": "40"}
    command = [sys.executable, "-m", "sysid", "run", "pair.py", "--strategy", "swarm"]
    running = subprocess.Popen(command, cwd=here, env=environment, stdout=process_end, stderr=process_end)
    os.close(process_end)
    shown = b""
    with contextlib.suppress(OSError):  # the end of a pseudo-terminal is an error
        while chunk := os.read(main_end, 65536):
            shown += chunk
    os.close(main_end)
    assert running.wait(60) == 0
    text = shown.decode()
    assert "\x1b[" in text
    for word in ("phase", "iteration", "objective", "swarm", "local phase", "report.html"):
        assert word in text


def test_a_closed_pipe_and_a_full_disk_behind_standard_output(here, process, without_pictures):
    (here / "pair.py").write_text(without_pictures)
    command = f"{sys.executable} -m sysid list | head -c 1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, timeout=60, check=True)
    assert done.stderr == b""
    assert done.stdout.endswith(b"0\n")
    # The search goes on without a reader: its result is in the files.
    done = process("run", "pair.py", cwd=here, preexec_fn=_closed_standard_output)
    assert done.returncode == 0
    assert b"sysid:" not in done.stderr
    assert (here / "results/pair/report.html").exists()
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                [sys.executable, "-m", "sysid", "list"], stdout=full, stderr=subprocess.PIPE, timeout=60, check=False
            )
        assert done.returncode == 2
        assert done.stderr.count(b"\n") == 1
        assert b"No space left" in done.stderr


def _closed_standard_output():
    """Make standard output a pipe that nobody reads."""
    reader, writer = os.pipe()
    os.dup2(writer, 1)
    os.close(reader)
    os.close(writer)


def test_warnings_are_told_after_the_run_a_line_each_and_not_beside_a_mistake(here, complaint, module, no_pictures):
    warned = module.replace("# a mistake goes here", "import warnings; warnings.warn('thin\\nice')")
    (here / "pair.py").write_text(warned)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert cli.main(["run", "pair.py"]) == 0
        error = complaint()
        assert "pair.py:" in error
        assert "thin ice" in error
        (here / "pair.py").write_text(warned.replace("thin\\nice')", "thin'); freq[3] = np.nan"))
        assert cli.main(["run", "pair.py"]) == 2
        assert "thin" not in complaint()


def test_what_is_not_a_number_is_null_in_the_summary(finished):
    result = sysid.load(finished)
    history = replace(result.history, wall_time=np.nan)
    strict = lambda value: json.loads(output.strict_json(value), parse_constant=pytest.fail)  # noqa: E731
    assert strict(replace(result, history=history).to_dict())["wall_time_s"] is None
    assert strict({"a": [np.nan, 1.0, (float("inf"), "x")], "b": None, "c": True}) == {
        "a": [None, 1.0, [None, "x"]], "b": None, "c": True,
    }  # fmt: skip


# -- mistakes -----------------------------------------------------------------------------------

IN_THE_MODULE = {
    "NaN samples": ("response[0, 1, 5] = np.nan", "response holds NaN"),
    "infinite samples": ("base = base * 1.0; base[0, 0, 5] = np.inf", "base holds NaN or infinite"),
    "NaN frequency": ("freq[3] = np.nan", "freq holds NaN"),
    "unsorted frequencies": ("freq[[3, 4]] = freq[[4, 3]]", "freq must rise strictly"),
    "repeated frequencies": ("freq[4] = freq[3]", "drop repeated ones"),
    "fewer lines than samples": ("freq = freq[:-1]", "response has shape|base has shape"),
    "another number of runs": ("response = np.concatenate([response, response])", "runs"),
    "another number of sensors": ("G = np.ones((3, 1))", "rigid_body is"),
    "a mass of zero": ("FullMass(3.5", "FullMass(0.0", "masses must be positive"),
    "a negative mass": ("FullMass(3.5", "FullMass(-3.5", "masses must be positive"),
    "a mass that is no number": ("FullMass(3.5", "FullMass(np.nan", "total_mass holds NaN or infinite"),
    "w_lim below a given frequency": (
        f"({FREQUENCIES})",
        f"({FREQUENCIES}, max_frequency=0.9 * {FREQUENCIES}[-1])",
        "is below the given natural frequency",
    ),
    "unsorted natural frequencies": (f"({FREQUENCIES})", f"({FREQUENCIES}[::-1])", "ascending"),
    "a missing file": ("np.loadtxt('nowhere.csv')", r"pair.py, line 14: FileNotFoundError: .*nowhere.csv"),
    "an unreadable file": ("np.load(__file__)", "pair.py, line 14: "),
    "an exception of many lines": ("raise ValueError('one\\n\\ntwo')", "line 14: ValueError: one two$"),
    "a syntax error": ("return (", "pair.py, line 1[0-9]: syntax error"),
    "no problem()": ("def problem(", "def another(", r"has no function problem\(\)"),
    "problem() without its arguments": ("(*, data=None, rng=0)", "()", "does not take data and rng"),
    "problem() that gives something else": ("return sysid.Problem(", "return dict(measurement=", "gives a dict, not a"),
    "a text as stiffness": (f"sysid.SpectralStiffness({FREQUENCIES})", "'soft'", "stiffness is a str"),
}


@pytest.mark.parametrize("case", IN_THE_MODULE)
def test_a_mistake_in_the_problem_is_one_line_and_nothing_is_written(here, complaint, files, module, case):
    *change, message = IN_THE_MODULE[case]
    old, new = change if len(change) == 2 else ("# a mistake goes here", change[0])
    assert old in module
    text = module.replace(old, new)
    if new.startswith("return dict("):
        text = text.replace("rigid_body=G),\n        mass", "rigid_body=G), mass")
    (here / "pair.py").write_text(text)
    assert cli.main(["run", "pair.py"]) == 2
    assert re.search(message, complaint().rstrip())
    assert files(here) == {"pair.py"}


ON_THE_LINE = {
    "no command": ([], "COMMAND"),
    "unknown command": (["rum", "pair.py"], "invalid choice: 'rum'"),
    "no problem": (["run"], "PROBLEM"),
    "an option cut short": (["run", "pair.py", "--se", "1"], "--se"),
    "unknown option": (["list", "--all"], "--all"),
    "unknown problem": (["run", "cantilever_towr"], "did you mean 'cantilever_tower'.*shear_building"),
    "unknown strategy": (["run", "pair.py", "--strategy", "simplex"], "'simplex'.*auto.*modal.*continuation.*swarm"),
    "missing module": (["run", "nowhere.py"], "nowhere.py cannot be read: No such file"),
    "missing module of a folder": (["run", "some/where"], "No such file"),
    "missing data": (["run", "pair.py", "--data", "nowhere"], "'nowhere': there is no such file or folder"),
    "negative seed": (["run", "pair.py", "--seed", "-1"], "--seed"),
    "seed that is no integer": (["run", "pair.py", "--seed", "1.5"], "'1.5' is not a whole number from 0"),
    "no time": (["run", "pair.py", "--max-time", "0"], "'0' is not a positive number of seconds"),
    "time that is no number": (["run", "pair.py", "--max-time", "nan"], "--max-time"),
    "results in a file": (["run", "pair.py", "--out", "pair.py/out"], "pair.py is not a folder"),
    "missing result": (["report", "nowhere"], "nowhere"),
    "a folder without a result": (["report", "."], "result.h5"),
    "a result that is none": (["report", "pair.py"], "pair.py"),
}


@pytest.mark.parametrize("case", ON_THE_LINE)
def test_a_mistake_on_the_line_is_one_line_and_nothing_is_written(here, complaint, files, case):
    arguments, message = ON_THE_LINE[case]
    assert cli.main(arguments) == 2
    assert re.search(message, complaint())
    assert files(here) == {"pair.py"}


def test_a_mistake_in_a_process_is_one_line_too(here, files, process, module):
    (here / "pair.py").write_text(module.replace("# a mistake goes here", "response[0, 1, 5] = np.nan"))
    done = process("run", "pair.py", cwd=here)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1
    assert b"Traceback" not in done.stderr
    assert files(here) == {"pair.py"}


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_refused_before_the_search(here, complaint):
    locked = here / "locked"
    locked.mkdir(mode=0o500)
    assert cli.main(["run", "pair.py", "--out", "locked/out"]) == 2
    assert " locked " in complaint()


def test_a_file_that_cannot_be_read_is_refused(here, complaint, monkeypatch):
    def refuse(self):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert cli.main(["run", "pair.py"]) == 2
    error = complaint()
    assert "pair.py" in error and os.strerror(errno.EACCES) in error


def test_a_disk_that_is_full_is_one_line_and_leaves_no_half_file(here, complaint, files, monkeypatch):
    def full(self, *arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", full)
    assert cli.main(["run", "pair.py"]) == 2
    assert os.strerror(errno.ENOSPC) in complaint()
    assert files(here) == {"pair.py"}


def test_a_summary_that_cannot_be_written_takes_no_result_away(here, complaint, files, monkeypatch):
    def full(self, *arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    assert cli.main(["run", "pair.py"]) == 2
    error = complaint()
    assert "summary.json" in error and os.strerror(errno.ENOSPC) in error
    assert files(here) == {"pair.py", "results", "results/pair", "results/pair/result.h5"}
