"""``sysid run --resume`` and ``--fresh``: what a folder with an unfinished run allows, and what is said of it."""

import re
import signal
from pathlib import Path

import pytest

import sysid
from sysid import InputError
from sysid.cli import main as cli
from sysid.results.checkpoint import FILE_NAME, Checkpoint

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
RUN = ["run", "pair.py", "--strategy", "swarm", "--out", "out"]

KEPT = "--modes, --dofs, --data, --set and those of tests from the run in out"


@pytest.fixture(scope="module")
def left():
    """Files that such a run left, by the text of its module: they may be moved."""
    return {}


@pytest.fixture
def stopped(here, module, left, monkeypatch, no_pictures, capsys, commands):
    """Leave a run of pair.py that Ctrl-C ended in iteration 3 of its swarm; its folder."""
    if module in left:
        (here / "out").mkdir()
        for name, content in left[module].items():
            (here / "out" / name).write_bytes(content)
        return here / "out"
    original = sysid.identify

    def identify(*arguments, **options):
        def interrupt(progress):
            if (progress.phase, progress.iteration) == ("swarm", 3):
                raise KeyboardInterrupt

        return original(*arguments, **options, callback=interrupt)

    with monkeypatch.context() as patch:
        patch.setattr(cli, "identify", identify)
        assert cli.main(RUN) == 130
    assert commands(capsys.readouterr().err) == [["run", "pair.py", "--resume", "out"]]
    left[module] = {path.name: path.read_bytes() for path in (here / "out").iterdir()}
    return here / "out"


def runs_in(text):
    """Module, strategy and seed of each run that a text tells of."""
    return re.findall(r"([\w.]+), strategy ([\w-]+), seed (\d+)", text)


def test_a_resumed_run_ends_as_one_that_was_not_stopped(stopped, capsys, files):
    assert cli.main(["run", "--resume", "out", "--trust", "--max-time", "60"]) == 0
    assert capsys.readouterr().out.startswith("going on with pair.py, strategy swarm, seed 0\npair.py: 2 sensors")
    assert files(stopped) == {"result.h5", "summary.json", "report.html"}
    assert cli.main([*RUN[:-1], "other"]) == 0
    resumed, whole = sysid.load(stopped), sysid.load(stopped.with_name("other"))
    assert resumed.x.tobytes() == whole.x.tobytes()
    assert resumed.history.swarm_curve.tobytes() == whole.history.swarm_curve.tobytes()
    assert resumed.recipe == whole.recipe


def test_without_a_word_on_the_unfinished_run_nothing_is_done(stopped, complaint, commands, files):
    before, state = files(stopped), (stopped / FILE_NAME).read_bytes()
    assert cli.main(RUN) == 2
    error = complaint()
    assert commands(error) == [["run", "pair.py", "--resume", "out"]]
    assert "--fresh" in error and "seed" not in error  # it is the one that is asked for
    assert cli.main([*RUN, "--seed", "1"]) == 2
    assert runs_in(complaint()) == [("pair.py", "swarm", "0")]
    assert files(stopped) == before
    assert (stopped / FILE_NAME).read_bytes() == state


def test_fresh_begins_anew(stopped, capsys, files):
    assert cli.main([*RUN, "--fresh", "--seed", "1"]) == 0
    assert "iteration    0" not in capsys.readouterr().out.partition("swarm")[0]
    assert files(stopped) == {"result.h5", "summary.json", "report.html"}
    assert sysid.load(stopped).seed == 1


def test_fresh_throws_nothing_away_where_the_problem_is_wrong(stopped, complaint):
    state = (stopped / FILE_NAME).read_bytes()
    assert cli.main([*RUN, "--fresh", "--set", "nois=0.01"]) == 2
    assert "nois" in complaint()
    assert (stopped / FILE_NAME).read_bytes() == state


def test_what_a_kill_left_of_writing_the_state_goes_with_it(stopped, files):
    (stopped / f".{FILE_NAME}.12ab34cd.tmp").write_bytes(b"half")
    assert cli.main(["run", "pair.py", "--resume", "out"]) == 0
    assert files(stopped) == {"result.h5", "summary.json", "report.html"}


def test_the_problem_may_be_said_again_and_must_be_the_same(stopped, complaint):
    again = ["run", "pair.py", "--strategy", "swarm", "--resume", "out"]
    assert cli.main([*again, "--seed", "2"]) == 2
    there, asked = ("pair.py", "swarm", "0"), ("pair.py", "swarm", "2")
    assert runs_in(complaint()) == [there, asked]
    assert cli.main(again) == 0


def test_a_module_that_was_changed_gives_no_mixture(stopped, complaint, here):
    state = (stopped / FILE_NAME).read_bytes()
    (here / "pair.py").write_text((here / "pair.py").read_text().replace("[0.01, 0.02]", "[0.01, 0.03]"))
    assert cli.main(["run", "pair.py", "--resume", "out"]) == 2
    error = complaint()
    assert runs_in(error) == [("pair.py", "swarm", "0")]
    assert "edited" in error and "--out out --fresh" in error
    assert (stopped / FILE_NAME).read_bytes() == state
    assert cli.main([*RUN, "--fresh"]) == 0


OWN = """import sysid


class Light(sysid.ModalDamping):
    def ratios(self, geometry, y, omega):
        return y
"""


class TestAModelOfTheUsersOwn:
    """Its code stands in no record: only the text of the file beside the module tells an edit."""

    @pytest.fixture
    def module(self, module, tmp_path):
        (tmp_path / "own.py").write_text(OWN)
        return module.replace("import sysid\n", "import sysid\nfrom own import Light\n", 1).replace(
            "goal=1e-6", "damping=Light(), goal=1e-6"
        )

    def test_its_edit_is_told_and_undone_the_run_goes_on(self, stopped, complaint, here, capsys):
        (here / "own.py").write_text(OWN.replace("return y", "return 2 * y"))
        assert cli.main(["run", "--resume", "out", "--trust"]) == 2
        assert "edited" in complaint()
        (here / "own.py").write_text(OWN)
        assert cli.main(["run", "--resume", "out", "--trust"]) == 0
        assert capsys.readouterr().out.startswith("going on with pair.py")

    def test_a_folder_that_was_moved_as_a_whole_goes_on(self, stopped, here, capsys, monkeypatch, tmp_path_factory):
        place = tmp_path_factory.mktemp("elsewhere") / "moved"
        here.rename(place)
        monkeypatch.chdir(place)
        assert cli.main(["run", "--resume", "out", "--trust"]) == 0
        assert capsys.readouterr().out.startswith("going on with pair.py")


def test_a_module_that_the_state_names_runs_where_the_user_names_or_trusts_it(stopped, complaint, here, capsys):
    """The state may come from somebody else: the file of that name in this folder is not what it was made with."""
    module = here / "pair.py"
    text = module.read_text()
    module.write_text("raise SystemExit('it ran')\n")
    assert cli.main(["run", "--resume", "out"]) == 2
    error = complaint()
    assert FILE_NAME in error and f" {module}, " in error
    assert "say --trust" in error and "sysid run MODULE.py --resume out" in error
    assert cli.main(["run", "--resume", "out", "--trust"]) == 2
    assert "pair.py, line 1: SystemExit: it ran" in complaint()
    module.write_text(text)
    assert cli.main(["run", str(module), "--resume", "out"]) == 0
    assert capsys.readouterr().out.startswith("going on with")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--fresh"], "--resume excludes --fresh and --out"),
        (["--out", "x"], "--resume excludes --fresh and --out"),
        (
            ["--seed", "3"],
            KEPT,
        ),
        (["--modes", "2"], KEPT),
        (["--mass", "2"], KEPT),
        (
            ["--set", "n=3"],
            KEPT,
        ),
    ],
)
def test_what_does_not_go_together_is_told(stopped, complaint, more, said):
    assert cli.main(["run", "--resume", "out", *more]) == 2
    assert said in complaint()


def test_where_nothing_is_unfinished_it_begins_anew_or_asks_for_the_problem(
    here, complaint, commands, capsys, no_pictures
):
    assert cli.main(["run", "--resume", "out"]) == 2
    assert commands(complaint()) == [["run", "PROBLEM", "--resume", "out"]]
    assert cli.main(["run"]) == 2
    assert "PROBLEM is missing" in complaint()
    assert cli.main(["run", "pair.py", "--resume", "out"]) == 0
    assert capsys.readouterr().out.startswith("no unfinished run in out: it begins anew\n")
    assert (here / "out/result.h5").is_file()


def test_a_run_that_had_reached_nothing_begins_anew_and_says_so(stopped, capsys, monkeypatch):
    """As after a kill before the first state is written: the file tells how the run was begun."""
    tree = Checkpoint(stopped / FILE_NAME).read()
    monkeypatch.setattr(Checkpoint, "read", lambda self: {**tree, "entries": {}})
    assert cli.main(["run", "pair.py", "--resume", "out"]) == 0
    assert capsys.readouterr().out.startswith("pair.py, strategy swarm, seed 0 had reached nothing: it begins anew\n")


def test_a_damaged_state_is_told_and_fresh_leads_on(stopped, complaint):
    (stopped / FILE_NAME).write_bytes((stopped / FILE_NAME).read_bytes()[:700])
    assert cli.main(["run", "--resume", "out"]) == 2
    with pytest.raises(InputError) as damaged:
        Checkpoint(Path("out", FILE_NAME)).read()
    assert complaint() == f"sysid: {damaged.value}\n"
    assert cli.main(RUN) == 2
    error = complaint()
    assert "damaged" in error and "--fresh" in error
    assert cli.main([*RUN, "--fresh"]) == 0


def test_while_a_process_runs_another_is_refused_and_once_it_is_killed_that_one_goes_on(
    here, without_pictures, no_pictures, interruptible, complaint, files
):
    """By -9, whatever it is doing."""
    (here / "pair.py").write_text(without_pictures.replace("goal=1e-6", "goal=1e-30"))
    running = interruptible("-m", "sysid", "run", "pair.py", "--strategy", "swarm", "--out", "out", cwd=here)
    with running:
        for line in running.stderr:
            if line.startswith("swarm"):
                break
        assert cli.main(["run", "pair.py", "--strategy", "swarm", "--out", "out", "--fresh"]) == 2
        assert f"(process {running.pid} on " in complaint()
        running.send_signal(signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    assert (here / "out" / FILE_NAME).is_file()
    assert cli.main(["run", "pair.py", "--resume", "out"]) == 1  # that goal is beyond round-off
    assert files(here / "out") == {"result.h5", "summary.json", "report.html"}
    assert sysid.load(here / "out").residual < 1e-9
