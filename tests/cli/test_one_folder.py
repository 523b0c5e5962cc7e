"""Commands that write into a folder of results while another one does: refused in one line, and nothing is touched."""

import os
from pathlib import Path

import pytest

from sysid.cli import main as cli
from sysid.cli.output import alone_in


@pytest.fixture
def in_use(finished):
    """Hold the folder of a finished run, as a run that goes on there does."""
    with alone_in(finished, "wait"):
        yield finished


def state(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["run", "pair.py", "--out", "{folder}"], "wait for its end, or write elsewhere with --out DIR"),
        (["run", "pair.py", "--out", "{folder}", "--fresh"], "wait for its end, or write elsewhere with --out DIR"),
        (["run", "--resume", "{folder}"], "wait for its end"),
        (["refine", "{folder}", "--trust", "--out", "{folder}"], "wait for its end, or write elsewhere with --out DIR"),
        (["report", "{folder}"], "it writes its report itself"),
        (["report", "{folder}/result.h5"], "it writes its report itself"),
    ],
)
def test_a_folder_in_use_is_left_alone(here, in_use, complaint, arguments, remedy):
    before = state(in_use)
    assert cli.main([one.format(folder=in_use) for one in arguments]) == 2
    error = complaint()
    assert f" {in_use} " in error and f"(process {os.getpid()} on " in error
    assert error.rstrip().endswith(remedy)
    assert state(in_use) == before


def test_another_folder_is_free(here, in_use, no_pictures, files):
    assert cli.main(["run", "pair.py", "--out", "beside"]) == 0
    assert files(here / "beside") == {"result.h5", "summary.json", "report.html"}


def test_a_mistake_leaves_no_folder_behind(here, complaint):
    assert cli.main(["run", "pair.py", "--set", "nois=1", "--out", "a/b"]) == 2
    assert "nois" in complaint()
    assert not Path("a").exists()
