"""Wording: messages that are made cheaply are compared whole here; where one stands here, other tests ask for facts.

Figures in a sentence are those that the test states, or those of the finding's `numbers`.
"""

import errno
import functools
import importlib.metadata
import os
import re
import signal
import socket
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid import (
    FullMass,
    InputError,
    KnownMass,
    LumpedMass,
    Measurement,
    Problem,
    Recipe,
    SpectralStiffness,
    catalogue,
    errors,
)
from sysid.cli import doctor, refine, requests
from sysid.cli import main as cli
from sysid.cli.output import Output, alone_in, results_folder
from sysid.compare.comparison import Comparison, comparison_text
from sysid.files import description, reading
from sysid.files.assembly import work_of_force
from sysid.finding import Finding, Severity
from sysid.jobs import JobResult
from sysid.measurement.damaged_runs import DamagedChannel
from sysid.nlp import time_too_short
from sysid.report import html, report
from sysid.results.checkpoint import Checkpoint, RunRequest
from sysid.results.storage import atomically
from sysid.results.summary import next_steps, verdict
from sysid.swarm import minimize_swarm

K = 1e3 * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
TRUTH = sysid.Structure(np.diag([2.0, 1.0, 0.0]), K, [0.01, 0.02], n_base=1)
LINES = np.linspace(1.0, 9.0, 60)
UNTRUSTED = Namespace(trust=False)
TEST, FORCED = (sysid.simulate(TRUTH, LINES, force=force) for force in (False, True))

MODULE = """import numpy as np
import sysid

def problem(*, data=None, rng=0):
    K = 1e3 * np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    truth = sysid.Structure(np.diag([2.0, 1.0, 0.0]), K, [0.01, 0.02], n_base=1)
    factor, idle = (sysid.Variable(name, lower=0.5, upper=2.0) for name in ("factor", "idle"))
    test = sysid.simulate(truth, np.linspace(1.0, 9.0, 60))
    return sysid.Problem(test, mass=factor * np.diag([2.0, 1.0]), stiffness=K[:2, :2])
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in an empty folder but for a problem module and a file that is none."""
    monkeypatch.chdir(tmp_path)
    for name in ("idle.py", "test.h5"):
        Path(name).write_text(MODULE, encoding="utf-8")
    Path("exact.py").write_text(
        MODULE.replace("mass=factor * np.diag([2.0, 1.0]), stiffness=K[:2, :2]", "mass=truth.mass").replace(
            "factor, idle =", "_ ="
        ),
        encoding="utf-8",
    )


def in_use():
    """Take a folder of results twice."""
    Path("out").mkdir()
    with alone_in(Path("out"), "wait for its end"), alone_in(Path("out"), "wait for its end"):
        pass


def impossible():
    """Check a problem whose constraint no point keeps."""
    m = sysid.Variable("m", lower=1.0, upper=2.0)
    Problem(TEST, mass=m * np.eye(2), stiffness=K[:2, :2], constraints=[m >= 3.0]).check()


LINE = impossible.__code__.co_firstlineno


def own_damping():
    """Ask for the modal strategy where the damping has a form of its own."""
    damping = sysid.ProportionalDamping((0.0, 1.0), (0.0, 0.1))
    sysid.identify(Problem(TEST, mass=FullMass(), damping=damping), strategy="modal")


def outside_of_any_structure():
    """Check a problem whose damping takes no energy anywhere."""
    k = sysid.Variable("k", lower=1.0, upper=2.0)
    Problem(TEST, mass=np.diag([2.0, 1.0]), stiffness=k * K[:2, :2], damping=-k * np.eye(2)).check()


NOWHERE = outside_of_any_structure.__code__.co_firstlineno


def locked():
    """Ask for a folder of results where nobody may write."""
    Path("there").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "access", lambda *_: False)
        results_folder("there/out", Path("out"))


def full_disk():
    """Write a file where no space is left."""
    with atomically(Path("summary.json")):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def other_records():
    """Read a result with a problem of other records."""
    answer("force").save("result.h5")
    sysid.load("result.h5", problem=Problem(replace(TEST, response=2 * TEST.response), mass=FullMass()))


def other_noise():
    """Refine a result whose module gives other records now."""
    refine.check_same_records(answer("nothing"), Recipe("shear_building"))


def begun(strategy="swarm", **given):
    return RunRequest(Recipe("pair.py"), strategy, 0, **given)


def identified(test, mass=None, **given):
    return sysid.identify(Problem(test, mass=mass or FullMass(), **given), rng=0)


REFUSED = {
    "a number": (
        lambda: errors.as_float("goal", -1, "a number above 0", above=0), "goal = -1: a number above 0 is needed",
    ),
    "a whole number": (lambda: errors.whole_number("starts", 0, at_least=1), "starts is 0; give 1 or above."),
    "a fraction": (
        lambda: errors.whole_number("starts", 1.5, at_least=1), "starts is 1.5; give a whole number, 1 or above.",
    ),
    "a word": (
        lambda: errors.choice("frf", "FRF", ("relative", "transmissibility")),
        "frf = 'FRF' is unknown; give one of 'relative', 'transmissibility'",
    ),
    "a hole": (
        lambda: errors.finite_array("start", [1.0, np.nan]),
        "start holds NaN or infinite entries (1 of 2, the first at index (1,))",
    ),
    "a text of numbers": (
        lambda: errors.numbers("start", ["one"]), "start is not an array of real numbers: ['one']",
    ),
    "an extra": (
        lambda: errors.needed("nowhere", "uff", "shake.unv"),
        "shake.unv needs the package nowhere: python -m pip install 'structural-sysid[uff]'",
    ),
    "a folder for a module": (
        lambda: (Path("folder.py").mkdir(), catalogue.build(Recipe("folder.py"))), "problem folder.py is not a file",
    ),
    "a folder of a result for a module": (
        lambda: (Path("kept").mkdir(), Path("kept/result.h5").touch(), catalogue.build(Recipe("kept/"))),
        "problem kept is not a file; 'sysid show' tells of a result, 'sysid new' makes a problem",
    ),
    "a table for a module": (
        lambda: (Path("log.csv").touch(), catalogue.build(Recipe("log.csv"))),
        "problem log.csv: the name of a problem module ends in .py; 'sysid read FILE --out TEST.h5' makes a test "
        "of a logger's file, 'sysid run TEST.h5' runs it, and 'sysid new NAME --data TEST.h5' makes a module of it",
    ),
    "sensors in single brackets": (
        lambda: (Path("s.toml").write_text("[sensor]\nname='a'\n[sensor]"), description.from_toml(Path("s.toml"))),
        "s.toml is no TOML: Cannot declare ('sensor',) twice (at line 3, column 8); a sensor begins with [[sensor]], "
        "in two brackets",
    ),
    "no module": (
        lambda: catalogue.build(Recipe("nowhere.py")),
        f"problem nowhere.py cannot be read: {os.strerror(errno.ENOENT)}",
    ),
    "a test for a module": (
        lambda: catalogue.build(Recipe("./test.h5")),
        "problem test.h5: the name of a problem module ends in .py; 'sysid read FILE --out TEST.h5' makes "
        "a test of a logger's file, 'sysid run TEST.h5' runs it, and 'sysid new NAME --data TEST.h5' makes a module "
        "of it",
    ),
    "no data": (
        lambda: catalogue.build(Recipe("idle.py", "nowhere")),
        "data 'nowhere': there is no such file or folder; where a result names it, put it there, or work in the folder "
        "that the result was made in",
    ),
    "an idle variable": (
        lambda: catalogue.build(Recipe("idle.py")),
        "idle.py: variable 'idle' (idle.py, line 7) enters no matrix, residual or constraint: use it, or take it out",
    ),
    "a constraint": (
        impossible,
        f"no point within the bounds satisfies constraint 1, written in 'm' ({__file__}, line {LINE + 2}) (problem at "
        f"{__file__}, line {LINE + 3}): widen the bounds of these variables, or correct the relation",
    ),
    "a strategy": (
        own_damping,
        "strategy 'modal' needs a free stiffness (SpectralStiffness) and ModalDamping, and the damping has a form of "
        "its own; 'auto' chooses another strategy",
    ),
    "an untrusted module": (
        lambda: requests.check_trust(Recipe("idle.py"), Path("out/result.h5"), "--module FILE.py", UNTRUSTED),
        "out/result.h5 names the problem module {here}/idle.py, whose code would run: say --trust where you know what "
        "stands in it, or name the module yourself: --module FILE.py",
    ),
    "a module that is gone": (
        lambda: requests.check_trust(Recipe("gone.py"), Path("out/result.h5"), "--module FILE.py", UNTRUSTED),
        "out/result.h5 names the problem module {here}/gone.py, which is not here: get and name it: "
        "--module FILE.py",
    ),
    "an edited module": (
        lambda: requests.with_source(begun(source="of another text"), [Path("idle.py")], Path("out")),
        "out holds an unfinished run of pair.py, strategy swarm, seed 0, and since it began its module or what this "
        "imports from beside itself was edited: give the problem with --out out --fresh to begin anew, or undo the "
        "edit",
    ),
    "a strategy without refinement": (
        lambda: requests.strategy_of(begun("modal", refine_by="leaders")),
        "--refine-by is of the strategies 'swarm' and 'hpso-ls', and the strategy is 'modal': leave it out, or give "
        "--strategy swarm or hpso-ls",
    ),
    "a folder in use": (
        in_use, f"folder of results out is in use by another run (process {os.getpid()} on {{host}}): wait for its end",
    ),
    "a folder that nobody may write": (locked, "folder of results there/out: there cannot be written"),
    "a full disk": (full_disk, f"summary.json cannot be written: {os.strerror(errno.ENOSPC)}"),
    "a damaged state": (
        lambda: (Path("state.h5").write_bytes(b"text"), Checkpoint(Path("state.h5")).read()),
        "state.h5 cannot be read: it is damaged: its first 512 bytes are not those that were written; take another "
        "copy of it, or run the problem again",
    ),
    "a problem of other records": (
        other_records,
        "result.h5: the problem that was given has other records than the result (response): give the problem of the "
        "same test, with the same data and parameters",
    ),
    "a module of other records": (
        other_noise,
        "shear_building now gives other records than those of the result, as the module, its data or what it reads "
        "has changed: identify them anew by 'sysid run'",
    ),
    "a start of another shape": (
        lambda: sysid.identify(Problem(TEST, mass=FullMass()), start=[1.0, 2.0, 3.0]),
        "start has shape (3,); (11,) finite unknowns, or a Structure, is needed",
    ),
    "matrices of no structure": (
        outside_of_any_structure,
        f"the matrices (problem at {__file__}, line {NOWHERE + 3}) are those of a structure nowhere, neither at the "
        "guess (damping_matrix is not positive semidefinite: the structure would feed energy in) nor at any of 127 "
        f"points of the search space; it is written in 'k' ({__file__}, line {NOWHERE + 2})",
    ),
    "a base the other way round": (
        lambda: identified(replace(TEST, base=-TEST.base)),
        "the sign of the base is reversed, or that of all sensors: beside their modes all move against the base; "
        "change the sign of the base's record",
    ),
    "rad/s": (
        lambda: identified(TEST, stiffness=SpectralStiffness(2 * np.pi * TRUTH.natural_frequencies)),
        "the stated natural frequencies are in rad/s, not Hz: {:.4g}, {:.4g} Hz are stated, the records have modes "
        "at {:.4g}, {:.4g} Hz, and a factor of 2 pi = 6.283 lies between; divide what is stated by 2 pi".format(
            *2 * np.pi * TRUTH.natural_frequencies, *TRUTH.natural_frequencies
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_is_told_with_the_place_and_the_remedy(here, tmp_path, name):
    made, sentence = REFUSED[name]
    with pytest.raises(InputError) as refused:
        made()
    assert str(refused.value) == sentence.format(here=tmp_path, host=socket.gethostname())


def test_a_sentence_begins_with_a_capital_but_a_channel_keeps_its_name():
    assert html.sentence("half-open data, at rest") == "Half-open data, at rest."
    assert html.sentence("x5 reads 2 % low") == "x5 reads 2 % low."
    assert html.sentence("mTop reads 2 % low!") == "mTop reads 2 % low!"


ENDED = {
    "search": "interrupted; the best so far is in results/shear_building",
    "pages": "interrupted while saving; the result is there, but not every file is in results/shear_building",
    "afterwards": "interrupted; the result is in results/shear_building",
}


@pytest.mark.parametrize("struck", ENDED)
def test_an_interrupted_run_says_what_is_left(here, capsys, monkeypatch, ctrl_c, struck):
    """In the search, while the page is written, or once it is done."""

    def identify(*_, **__):
        if struck == "afterwards":
            signal.raise_signal(signal.SIGINT)
        return replace(answer("force"), interrupted=struck == "search")

    def write_report(*_):
        if struck == "pages":
            raise KeyboardInterrupt
        return Path("report.html")

    monkeypatch.setattr(cli, "identify", identify)
    monkeypatch.setattr(report, "write_report", write_report)
    assert cli.main(["run", "shear_building", "--quiet"]) == 130
    assert capsys.readouterr().err == f"sysid: {ENDED[struck]}\n"


def test_an_error_of_sysid_without_a_log_says_so(here, capsys, monkeypatch):
    def identify(*_, **__):
        raise RuntimeError("a bug")

    monkeypatch.setattr(cli, "identify", identify)
    Path("sysid-error.log").mkdir()
    monkeypatch.setattr("tempfile.gettempdir", lambda: "nowhere")
    assert cli.main(["run", "shear_building", "--quiet"]) == 70
    assert capsys.readouterr().err == (
        "sysid: an error of sysid itself (RuntimeError: a bug); no log file could be written\n"
    )


COMMANDS = {
    "run": "PROBLEM is missing (see 'sysid run --help')",
    "run --resume out": "no unfinished run in out: 'sysid run PROBLEM --resume out' begins one there, and goes on with "
    "it where there is one",
    "run idle.py --resume out --fresh": "--resume excludes --fresh and --out",
    "run shear_building --goal 0.1": "--mass, --lumped, --band, --gain-std, --at-rest, --amplitude and --goal are for "
    "a test that 'sysid read' wrote; what a module's problem() takes is said by --set KEY=VALUE",
    "show shear_building --seed 1 --set rng=1": "parameter 'rng' is set twice; parameters of this module: noise=0.0",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_mistake_on_the_command_line_is_one_line(here, capsys, command):
    assert cli.main(command.split()) == 2
    assert capsys.readouterr() == ("", f"sysid: {COMMANDS[command]}\n")


def late(*delays):
    """The test with noise of 1 %, its sensors late by so many seconds."""
    test = sysid.simulate(TRUTH, LINES, noise=0.01, rng=0)
    return replace(test, response=test.response * np.exp(-2j * np.pi * LINES * np.array(delays)[:, None]))


def on_bracket(test, frequency=20.0):
    """The test as a second sensor on a bracket of this frequency, Hz, records it."""
    return replace(test, response=test.response / [np.ones(LINES.size), 1 - (LINES / frequency) ** 2])


ALIKE = "other mass and stiffness matrices answer identically"
UNIT = "no number with a unit of mass is given: masses are normalised to 1 kg in each base direction"
CASES = {
    "gain": lambda: identified(replace(TEST, response=TEST.response * [[1.0], [1.02]])),
    "low gain": lambda: identified(replace(TEST, response=TEST.response * [[1.0], [0.9956]])),
    "bracket": lambda: identified(on_bracket(sysid.simulate(TRUTH, LINES, noise=0.001, rng=0)), LumpedMass(3.0)),
    "late": lambda: identified(late(0.0, 0.012)),
    "late base": lambda: identified(late(-0.012, -0.012)),
    "goal": lambda: identified(sysid.simulate(TRUTH, LINES, noise=0.01, rng=0), goal=1e-4),
    "force": lambda: identified(FORCED),
    "nothing": lambda: identified(TEST),
    "lumped": lambda: identified(TEST, LumpedMass()),
    "total": lambda: identified(TEST, LumpedMass(3.0)),
    "wrong total": lambda: identified(FORCED, LumpedMass(4.0)),
}


@functools.cache
def answer(name):
    """Identify a case where it is first asked for."""
    return CASES[name]()


FOUND = [
    (
        "gain", "gain",
        lambda of: f"sensor 2 reads 2 % high against the base (standard deviation {100 * of['std']:.1g} %): M_SS, K_SS "
        "and C are wrong in its row and column; calibrate it and divide its record by 1.0200 (gain = 1.0200 in "
        "sensors.toml), or correct its axis or its row of rigid_body",
    ),
    (
        "low gain", "gain",
        lambda of: f"sensor 2 reads 0.44 % low against the base (standard deviation {100 * of['std']:.1g} %): M_SS, "
        "K_SS and C are wrong in its row and column; calibrate it and divide its record by 0.9956 (gain = 0.9956 in "
        "sensors.toml), or correct its axis or its row of rigid_body, or state its tolerance (gain_std, --gain-std "
        "0.005)",
    ),
    (
        "late", "late sensor",
        lambda of: f"sensor 2 is recorded {1e3 * of['delay']:.4g} ms late against the base (standard deviation "
        f"{1e3 * of['std']:.1g} ms), as by a clock or a filter of its own; that is taken off before anything else is "
        f"judged; state it where the channel is described: delay = {of['delay']:.6f}".rstrip("0") + ", or bring the "
        "records to one clock (sysid.resample), or filter all channels alike",
    ),
    (
        "late base", "late sensor",
        lambda of: f"the base is recorded {-1e3 * of['delay']:.4g} ms late against all other channels (standard "
        f"deviation {1e3 * of['std']:.1g} ms), as by a clock or a filter of its own; that is taken off before anything "
        f"else is judged; state it where the channel is described: delay = {-of['delay']:.6f}".rstrip("0") + ", or "
        "bring the records to one clock (sysid.resample), or filter all channels alike",
    ),
    ("goal", "goal", lambda of: f"the residual {of['residual']:.3g} is above the goal 0.0001"),
    (
        "wrong total", "stated mass",
        lambda of: "the stated mass makes 4 kg in the base directions, but the base force weighs "
        f"{of['weighed 1']:.4g} kg; one of them, or the unit of the force, is wrong; the force weighs an adapter or "
        "base plate on its cells too",
    ),
    (
        "total", "assumed total",
        lambda of: "all of the stated 3 kg is taken to sit at the sensors. Mass that moves with the table, such as an "
        "adapter or a base ring, must not be in it: no record can show it, and M, K and C are in proportion to it",
    ),
    ("total", "fixed", lambda of: "the mass is stated to be lumped on the sensors, with its total given"),
    (
        "force", "assumed force gain",
        lambda of: "no record can show whether the gain of the base force is right. M, K and C are in proportion to "
        "it: an error of 1 % in it makes 1 % in them",
    ),
    (
        "force", "assumed mounting",
        lambda of: "the sensors are taken to be mounted rigidly: one on a bracket of five times the last frequency "
        "reads 4 % too much there, which makes up to 8 % in M_SS, and no record can show it; tap them; or put one "
        "sensor more on a rigid part than its motion needs, and state the part",
    ),
    (
        "lumped", "assumed mass",
        lambda of: "the mass is taken to be diagonal, as stated: M, K and C are as right as that. Records contradict "
        "it only where they show all modes closely",
    ),
    (
        "lumped", "assumed base",
        lambda of: "the base is taken to be rigid and to move along x alone: motion of it that is not recorded counts "
        "as the structure's",
    ),
    (
        "bracket", "soft bracket",
        lambda of: f"sensor 2 seems to be on a soft bracket of {of['frequency']:.4g} Hz (standard deviation "
        f"{of['std']:.2g} Hz): it reads more than the stated model allows, if that is right, the more so the higher "
        f"the frequency, {100 * of['error']:.2g} % too much at {TRUTH.natural_frequencies[1]:.4g} Hz. M_SS, K_SS and C "
        "are wrong in its row and column; stiffen its mounting, or leave the sensor out (of a record at hand: "
        f"times 1 - (f / {of['frequency']:.4g} Hz)²)",
    ),
    ("force", "fixed", lambda of: "the measured base force weighs each mode that the base moves"),
    ("nothing", "open", lambda of: f"all modal masses are open: {ALIKE}"),
    (
        "lumped", "open",
        lambda of: f"mass, stiffness and damping are known up to one common factor: {ALIKE}, within what is stated",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("case", "kind", "sentence"), FOUND, ids=[f"{case}: {kind}" for case, kind, _ in FOUND])
def test_a_finding_says_what_was_found_and_what_to_do(case, kind, sentence):
    first, *more = [one for one in (*answer(case).findings, *answer(case).assumptions) if one.kind == kind]
    assert str(first) == sentence(first.numbers)
    assert [str(one) for one in more] == [UNIT] * (kind == "open")


JUDGED = [
    ("force", (), "data and stated model leave one mass and one stiffness matrix", None),
    (
        "total", (), "data and stated model leave one mass and one stiffness matrix. No force was measured: they are "
        "as right as the mass or stiffness that is stated", None,
    ),
    (
        "nothing", (), "other models explain the data as well",
        "measure the force between table and structure; or state what is known of the mass, where it is true: that all "
        "of it sits at the sensors (sysid run test.h5 --lumped --mass KG; LumpedMass(KG)), or single masses "
        "(FullMass(known=...)); a total mass alone only bounds it",
    ),
    (
        "lumped", (), "other models explain the data as well",
        "one number in kg is enough: state the mass of what the sensors stand for (sysid run test.h5 --lumped --mass "
        "KG; in Python LumpedMass(KG), or one unknown of a written mass), or measure the force between table and "
        "structure",
    ),
    (
        "force", [("gain", "contradicts")],
        "a fit, but something speaks against this model, so that its matrices may be wrong",
        "deal with what speaks against this model, in the order given: correct it, or measure again",
    ),
    (
        "force", [("residual", "contradicts")], "these matrices do not explain the records as they should",
        "deal with what speaks against it, in the order given",
    ),
    ("force", [("noise", "caution")], "some entries of the matrices are not known well enough", None),
    (
        "force", [("residual", "contradicts"), ("changing", "contradicts")],
        "these matrices do not explain the records as they should",
        "fit by itself a run in which structure and level of motion stay the same, at the level of interest: 'sysid "
        "read RUN.csv --out one.h5', then 'sysid run one.h5'",
    ),
    (
        "goal", (), "these matrices do not explain the records as they should",
        "put right what is named first; a goal below the noise of the records cannot be reached",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("case", "found", "means", "step"), JUDGED)
def test_a_judgement_says_what_it_means_and_what_to_do_first(case, found, means, step):
    it = answer(case)
    if found:
        it = it.with_findings([Finding(kind, Severity(severity), "-") for kind, severity in found])
    assert verdict(it) == means
    assert next_steps(it)[:1] == ([] if step is None else [step])


def test_a_stated_frequency_that_no_mode_has_is_told():
    """Where a fit from there ends is chance."""
    stated = TRUTH.natural_frequencies * [1.0, 1.4]
    with pytest.raises(InputError) as refused:
        sysid.identify(Problem(TEST, mass=FullMass(), stiffness=SpectralStiffness(stated)), strategy="modal")
    assert re.sub(r"ends at \S+ Hz", "ends at F Hz", str(refused.value)) == (
        f"of the stated natural frequencies {stated[1]:.5g} Hz does not stand out of the data (a fit from there ends "
        "at F Hz): the base may not move this mode"
    )


def test_a_summary_in_a_hurry_says_what_computes_the_rest():
    lines = replace(answer("force"), hurried=True).summary().splitlines()
    assert [line for line in lines if line.startswith("uncertainty")] == [
        "uncertainty not computed, as the time was over: Identification.uncertainty and 'sysid report' compute it"
    ]
    assert time_too_short(70.0) == "not begun, as its derivatives take some 7e+01 s to set up: too little time"


def test_a_summary_names_the_masses_of_a_lumped_model():
    lines = answer("total").summary().splitlines()
    assert [line for line in lines if line.startswith("masses")] == [
        "masses at the sensors (diagonal of M_SS): sensor 1 2 kg, sensor 2 1 kg"
    ]


def test_a_comparison_says_what_its_columns_are():
    undamped = sysid.Structure(TRUTH.mass, TRUTH.stiffness, [0.0, 0.0], n_base=1)
    noisy = sysid.simulate(TRUTH, LINES, noise=0.01, rng=0)
    told = [
        " ".join(
            comparison_text(Comparison(Problem(test, mass=FullMass(), reference=truth), 0, None, ())).split("\n")[1:]
        )
        for test, truth in ((TEST, None), (TEST, undamped), (noisy, TRUTH))
    ]
    before = "before, after: {} before and after the local phase{}"
    assert [" ".join(words.split()) for words in told] == [
        before.format("relative residual", ""),
        before.format(
            "relative residual",
            "; M, K, C: error against the reference, which has no damping, so that C has no relative error",
        ),
        before.format("objective (all that is fitted, weighed by its noise)", "; M, K, C: error against the reference"),
    ]


def test_doctor_says_what_is_wrong(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "linear_solvers", list)
    assert cli.main(["doctor"]) == 2
    out, error = capsys.readouterr()
    assert error == "sysid: IPOPT does not work: python -m pip install --force-reinstall casadi\n"
    assert [line for line in out.splitlines() if line.startswith("matplotlib")] == [
        "matplotlib draws by its backend 'Agg'; report.html is written without a browser"
    ]

    def requires(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", requires)
    monkeypatch.setattr(doctor, "linear_solvers", lambda: ["mumps"])
    assert cli.main(["doctor"]) == 0
    assert capsys.readouterr().err == (
        "sysid: warning: sysid is imported from its folder, not installed, so that what it needs is not known: "
        "pip install it\n"
    )


def test_draws_say_why_there_is_no_spread(here, capsys):
    it = answer("force")
    ends = [JobResult(0, 0, True, "", it.x, 0.02), JobResult(1, 0, False, "lost", it.x[:0], np.nan)]
    refine.report_draws(Path("out"), it, Recipe("pair.py"), ends, Output())
    assert capsys.readouterr().out.splitlines()[1] == "1 of 2 draws ended in a fit; two are needed for a spread"


def test_exact_records_are_not_drawn(here, capsys):
    folder = Path("out")
    replace(identified(TEST, KnownMass(TRUTH.mass)), recipe=Recipe("exact.py")).save(folder / "result.h5")
    assert cli.main(["refine", "out", "--draws", "3", "--trust"]) == 2
    assert capsys.readouterr() == (
        "", "sysid: out fits its records exactly: without noise there is nothing to draw\n"
    )  # fmt: skip


def test_an_own_problem_of_a_bundled_name_is_remarked(here):
    Path("problems").mkdir()
    Path("problems/shear_building.py").write_text("")
    assert catalogue.typed("shear_building") == (
        "problems/shear_building.py", "problems/shear_building.py hides the bundled problem shear_building: it is taken"
    )  # fmt: skip


def test_lines_and_the_power_of_a_force_are_told():
    response = TEST.response.copy()
    response[0, 1, 30:34] = np.nan
    left = Measurement(LINES, TEST.base, response, rigid_body=TEST.rigid_body, missing="drop")
    assert left.lines_in_words == "56 lines from 1 to 9 Hz (4 more hold NaN and are left out)"
    runs = [(FORCED.base[0], FORCED.response[0], sign * FORCED.force[0]) for sign in (1, -1)]
    assert [work_of_force([run], LINES) for run in runs] == [
        ["the base force gives power to the structure, as the force of the table on it does"],
        [
            "the base force takes power from the structure: it seems to be the force of the structure on the table; "
            'where it is, turn the axes of the load cells (axis = "-x" for "x")'
        ],
    ]


SWARMS = [
    (
        {"max_iterations": 5, "target": 0.5}, 1.0,
        "Spent max_iterations = 5: if the history still falls, raise it, or refine x locally. The target 0.5 was not "
        "reached; the best cost is 1.",
    ),
    (
        {"stall_iterations": 3}, 1.0,
        "The best cost has not fallen by more than {stall} of itself in 3 iterations: refine x locally, or start again "
        "with another rng or more particles.",
    ),
    (
        {"max_iterations": 2}, np.nan,
        "None of the {nfev} costs was finite: evaluate fun at a point that should work, and narrow the bounds to where "
        "it is defined.",
    ),
    ({"target": 2.0}, 1.0, "Reached the target 2.0."),
]  # fmt: skip


@pytest.mark.parametrize(("given", "cost", "sentence"), SWARMS)
def test_a_swarm_says_why_it_ended_and_what_to_do(given, cost, sentence):
    result = minimize_swarm(lambda rows: np.full(len(rows), cost), [(-1.0, 1.0)] * 2, rng=0, **given)
    assert result.message == sentence.format(nfev=result.nfev, stall=1e-8)


def test_leaders_that_ipopt_refined_are_counted_in_a_sentence():
    ended = {"refinement_statuses": (("Restoration_Failed", 1), ("Solve_Succeeded", 2))}
    assert sysid.History(**ended, leaders_tried=3, leaders_won=1).refinement_in_words == (
        "IPOPT refined 3 leaders of the swarm, 1 better than the closed form (Restoration_Failed 1, Solve_Succeeded 2)"
    )
    assert sysid.History(**ended).refinement_in_words == (
        "IPOPT refined 3 candidates (Restoration_Failed 1, Solve_Succeeded 2)"
    )
    assert sysid.History().refinement_in_words == ""


def test_what_a_file_leaves_open_is_remarked(here):
    Path("run.csv").write_text("time,table,top\ns,m/s²,m/s²\n0.0,1,2\n0.1,2,1\n0.2,0,1\n0.3,1", encoding="utf-8")
    np.savez("frf.npz", w=LINES, h1=TEST.response[0, 0])
    base, top = ({"column": name, "role": role, "axis": "x"} for name, role in (("table", "base"), ("top", "response")))
    assert reading.gather(Path("run.csv"), {"sensor": [base, top]}).remarks == (
        "run.csv: line 6, the last, is cut short and left out",
    )
    said = {"base_axes": "x", "frf": "transmissibility", "frequency": "w", "convention": "exp(+iwt)"}
    assert reading.gather(Path("frf.npz"), said | {"sensor": [top | {"column": "h1"}]}).remarks == (
        "frf.npz: 1 line in the half-power width of its sharpest peak, too few for its damping: export finer lines "
        "(longer blocks)",
        "frf.npz: array 'w': frequencies have no unit, and are taken as Hz", "spectra follow exp(+iwt), as stated",
    )  # fmt: skip


DAMAGED = [
    (
        ("clipped", 366, 807, 5.711), False,
        "sensor 2 is damaged: 807 of 6000 samples (13 %) in 366 places from 1.5 to 118.25 s hold its largest value, "
        "5.711: a range that was too small; leave this channel out, cut the record there, or record it anew",
    ),
    (
        ("dropout", 1, 40, 0.0), True,
        "sensor 2 is damaged: 40 of 6000 samples (0.67 %) from 1.5 to 118.25 s are zero while the other channels move: "
        "a gap; the run is cut there, and what is damaged left out",
    ),
    (
        ("tone", 1, 6000, 50.0), False,
        "sensor 2 hums at 50 Hz all along: a steady tone that no other channel has; it stays in these records: take "
        "whole records, which fit it, or find its source, such as the mains",
    ),
    (
        ("equal channels", 1, 6000, 1.0), False,
        "sensor 2 holds the same samples as sensor 1: one record stands in two places; it may be so by symmetry; "
        "else read the right one, or leave this channel out",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("made", "left_out", "sentence"), DAMAGED, ids=[made[0] for made, _, _ in DAMAGED])
def test_damage_is_told_with_channel_place_count_and_remedy(made, left_out, sentence):
    kind, places, count, value = made
    stretches = np.linspace(1.5, 118.25, 2 * places).reshape(-1, 2)
    one = DamagedChannel(kind, 1, "sensor 2", stretches, count, 6000, value, "sensor 1", left_out)
    assert f"{one.sentence}; {one.remedy}" == sentence
