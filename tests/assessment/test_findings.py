"""Findings as data: a closed list of kinds, the order of weight, the four words of judgement, and how one is worded."""

import ast
import inspect
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.assessment.checks import CHECKS, OF_THE_END, QUICK
from sysid.assessment.checks.context import Context, run
from sysid.assessment.checks.mistakes import check_records
from sysid.finding import KINDS, Finding, Severity, is_fit, judgement_of, weightiest_first
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.problem.prepared import clocks_of
from sysid.search.strategy import Outcome

PACKAGE = Path(inspect.getfile(sysid)).parent
DOCS = Path(__file__).parents[2] / "docs" / "mistakes.md"


def finding(kind="gain", severity=Severity.CONTRADICTS, sentence="it is wrong", **parts):
    return Finding(kind, severity, sentence, **parts)


def kinds_in_code():
    """Texts that are kinds, in the modules of the package beside the list itself."""
    for path in PACKAGE.rglob("*.py"):
        if path.name != "finding.py":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            yield from (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))


def test_every_kind_is_found_by_some_code_and_stands_once_in_the_list():
    assert len(set(KINDS)) == len(KINDS)
    assert set(KINDS) - {value for value in kinds_in_code() if isinstance(value, str)} == {"own term"}  # of a user's


def test_the_page_on_mistakes_has_a_row_for_each_check_in_their_order():
    rows = [line for line in DOCS.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert rows == [f"| `{check.__name__}` | {inspect.getdoc(check).splitlines()[0]} |" for check in CHECKS]


def test_all_but_blocking_checks_wait_for_the_end_of_a_search():
    truth = sysid.Structure(np.diag([1.0, 0.0]), 900.0 * np.array([[1.0, -1], [-1, 1]]), [0.02], n_base=1)
    problem = sysid.Problem(sysid.simulate(truth, np.linspace(2, 8, 60)), mass=sysid.FullMass())
    assert check_records(problem.prepared, clocks_of(problem), FitMonitor()) == ()
    assert not {"screened", "at_rest", "formulation"} & set(vars(problem))  # nothing is fitted before a search
    assert set(OF_THE_END) < set(QUICK) < set(CHECKS)
    end = Outcome(truth, problem.values(truth), "by hand", False, "no end", sysid.History())
    assert [one.kind for one in run(Context(problem.prepared, end, cut_short=True), CHECKS)] == ["no solution"]
    end = Outcome(truth, problem.values(truth), "by hand", False, "no end", sysid.History(), KeyboardInterrupt())
    assert [one.kind for one in run(Context(problem.prepared, end), CHECKS)] == ["stopped"]


@pytest.mark.parametrize(
    ("found", "judgement", "fits"),
    [
        ([], "determined", True),
        ([finding(severity=Severity.NOTE)], "determined", True),
        ([finding("beyond noise", Severity.CAUTION)], "one of many", True),  # a goal that is met accepts it
        ([finding("open", Severity.CAUTION), finding()], "doubtful", True),
        ([finding("beyond noise"), finding()], "no fit", False),
        ([finding("goal")], "no fit", False),
        ([finding("no solution"), finding("open", Severity.CAUTION)], "no fit", False),
    ],
)
def test_a_judgement_follows_from_kinds_and_severities(found, judgement, fits):
    assert (judgement_of(found), is_fit(found)) == (judgement, fits)


def test_the_weightiest_stand_first_each_once_and_those_alike_as_they_were_found():
    note, first, second = finding(severity=Severity.NOTE), finding("misfit"), finding("gain")
    blocking, caution = finding(severity=Severity.BLOCKING), finding("open", Severity.CAUTION)
    assert weightiest_first([note, first, caution, second, first, blocking]) == (
        blocking, first, second, caution, note,
    )  # fmt: skip
    assert all(a is not b for a, b in pairwise(weightiest_first([note, first, note])))


def test_a_finding_is_the_same_after_a_tree_whatever_its_texts():
    one = finding("level", Severity.NOTE, "β", remedy="r", run=2, channel="a/b", numbers={"x/y": 1.5, "": np.inf})
    assert Finding.from_tree(one.to_tree()) == one
    assert Finding.from_tree(one.to_tree()).severity is Severity.NOTE
    assert one.of_test(3).numbers["test"] == 3 and one.numbers.get("test") is None


def test_as_a_text_a_finding_is_its_sentence_and_its_remedy():
    assert str(finding(remedy="mend it")) == "it is wrong; mend it" and str(finding()) == "it is wrong"
