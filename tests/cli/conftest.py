"""Fixtures of tests of the command line: a folder with a problem, a run of it, and how they read what was said."""

import contextlib
import io
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sysid.cli import main as cli
from sysid.report import report


@pytest.fixture(scope="session")
def module():
    """Text of a problem module that is identified in a second."""
    return Path(__file__).with_name("pair_problem.py").read_text()


@pytest.fixture(scope="session")
def without_pictures(module):
    """Text of that module for a process of its own whose report is not looked at: drawing takes longest."""
    return module + "\n\nfrom sysid.report import report\n\nreport.render = lambda result: 'report'\n"


@pytest.fixture
def here(tmp_path, monkeypatch, module):
    """Work in an empty folder that is the temporary one too, with the problem in ``pair.py``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair.py").write_text(module)
    return tmp_path


@pytest.fixture
def no_pictures(monkeypatch):
    """Write an empty report, where a test does not look at it."""
    monkeypatch.setattr(report, "render", lambda result: "report")


@pytest.fixture(scope="session")
def finished(tmp_path_factory, module):
    """Run the problem once: its folder of results."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "pair.py").write_text(module)
    with contextlib.redirect_stdout(io.StringIO()):
        assert cli.main(["run", str(folder / "pair.py"), "--out", str(folder / "out")]) == 0
    return folder / "out"


@pytest.fixture
def beside_progress(capsys):
    """Give a function that returns what is on standard output, and what is on standard error beside progress."""

    def read():
        out, error = capsys.readouterr()
        return out, re.sub(r"^[a-z][\w ]+ iteration +\d+ .*\n", "", error, flags=re.MULTILINE)

    return read


@pytest.fixture
def complaint(beside_progress):
    """Give a function that returns the one line on standard error that is no progress."""

    def read():
        error = beside_progress()[1]
        assert error.startswith("sysid: ")
        assert error.count("\n") == 1
        assert error.endswith("\n")
        assert "Traceback" not in error
        return error

    return read


@pytest.fixture
def commands():
    """Give a function that reads from a text the commands of ours that it quotes: lists of arguments."""
    return lambda text: [words.split() for words in re.findall(r"'sysid (.+?)'", text)]


@pytest.fixture
def files():
    """Give a function that names everything in a folder."""
    return lambda folder: {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.fixture
def process():
    """Give a function that runs the command line in a process of its own."""

    def run(*arguments, **options):
        command = [sys.executable, "-m", "sysid", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, timeout=120, **options)

    return run


@pytest.fixture
def interruptible():
    """Give a function that starts Python with Ctrl-C as a terminal has it, however these tests were started."""

    def start(*arguments, **options):
        return subprocess.Popen(
            [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **options,
        )  # fmt: skip

    return start
