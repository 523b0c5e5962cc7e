"""``sysid new``: what it writes runs at once, reads like the bundled problems, and never takes the place of a file."""

import ast
import errno
import os
import subprocess
import sys

import pytest

import sysid
from sysid.cli import main as cli
from sysid.cli import new


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_is_written_passes_its_own_test_with_warnings_as_errors(here):
    assert cli.main(["new", "my_tower"]) == 0
    command = [sys.executable, "-W", "error", "-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider"]
    # Plugins that are here by chance take time to import, and options of this run of pytest may be theirs.
    alone = os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": ""}
    done = subprocess.run(
        [*command, "test_my_tower.py"], capture_output=True, text=True, cwd=here, timeout=300, env=alone, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 passed" in done.stdout


def test_what_is_written_runs_from_the_command_line_in_seconds(here, capsys, beside_progress, no_pictures):
    assert cli.main(["new", "my_tower"]) == 0
    told = capsys.readouterr().out
    for command in ("sysid show my_tower.py", "sysid run my_tower.py", "python -m pytest test_my_tower.py"):
        assert command in told
    assert cli.main(["run", "my_tower.py"]) == 0
    out, error = beside_progress()
    assert error == ""
    assert "Determined" in out
    assert sysid.load(here / "results/my_tower").history.wall_time < 60


def test_the_module_reads_like_the_bundled_ones(here):
    module, test = new.write_new_problem("my_tower")
    for path in (module, test):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) < 60
        assert max(map(len, text.splitlines())) <= 120
        assert ast.get_docstring(ast.parse(text)).startswith("my_tower: ")
        assert "NAME" not in text
    lines = module.read_text(encoding="utf-8").splitlines()
    assert [line.split()[1] for line in lines if line.startswith("    # ")] == ["1.", "2.", "3.", "4.", "5."]


@pytest.mark.parametrize("there", ["chain.py", "test_chain.py"])
def test_nothing_is_written_over_a_file_nor_beside_it(here, complaint, files, there):
    (here / there).write_text("mine")
    assert cli.main(["new", "chain"]) == 2
    assert f"{there} exists already" in complaint()
    assert files(here) == {there}
    assert (here / there).read_text() == "mine"


def test_a_link_to_nowhere_and_a_folder_are_files_that_exist(here, complaint, files):
    (here / "chain.py").symlink_to("nowhere")
    (here / "test_tower.py").mkdir()
    for name in ("chain", "tower"):
        assert cli.main(["new", name]) == 2
        assert "exists already" in complaint()
    assert files(here) == {"chain.py", "test_tower.py"}


@pytest.mark.parametrize("failing", [1, 2])
def test_both_files_or_neither(here, files, monkeypatch, failing):
    calls, replace = [], os.replace

    def fail(source, target):
        calls.append(target)
        if len(calls) == failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(sysid.InputError, match=os.strerror(errno.ENOSPC)):
        new.write_new_problem("chain")
    assert len(calls) == failing
    assert files(here) == set()


NAMES = {
    "chain.py": "without .py: sysid new chain",
    "my-chain": "sysid new my_chain",
    "two words": "sysid new two_words",
    "2nd": "sysid new my_2nd",
    "": "sysid new my_problem",
    "problems/chain": "no folder.*sysid new chain",
    "class": "word of Python.*sysid new my_class",
    "sysid": "would hide it.*sysid new my_sysid",
    "random": "would hide it",
    "numpy": "would hide it",
    "conftest": "would hide it",
}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_python_cannot_import_is_refused_with_one_that_it_can(here, files, name):
    with pytest.raises(sysid.InputError, match=NAMES[name]) as refused:
        new.write_new_problem(name)
    assert files(here) == set()
    proposed = str(refused.value).rpartition("sysid new ")[2]
    assert new.write_new_problem(proposed)[0].exists()


def test_a_name_too_long_for_the_disk_is_one_line(here, complaint, files):
    assert cli.main(["new", "x" * 300]) == 2
    assert os.strerror(errno.ENAMETOOLONG) in complaint()
    assert files(here) == set()
