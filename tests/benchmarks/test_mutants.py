"""Finding of wrong changes in the package, and what counts as not noticed. No change is made here."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def mutants(monkeypatch):
    """The module, from the checkout."""
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("benchmarks.mutants")


def test_identifiers_are_unique(mutants):
    identifiers = [mutant.identifier for mutant in mutants.MUTANTS]
    assert len(set(identifiers)) == len(identifiers)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("y = f(a, 10)", 1),
        ("if x:\n    y = f(\n        a,\n        10\n    )\n", 1),
        ("y=f(a,10); y = f(a, 10)", 2),
        ("y = f(a, 100)", 0),
        ("my = f(a, 10)", 1),
        ("y = f(a)", 0),
    ],
)
def test_code_is_found_whatever_its_white_space(mutants, tmp_path, text, count):
    path = tmp_path / "module.py"
    path.write_text(text, encoding="utf-8")
    assert len(mutants.occurrences("= f(a, 10)", path)) == count
    assert len(mutants.occurrences("f(a, 10", path)) == count


@pytest.mark.parametrize(
    ("code", "tests", "detail"),
    [
        ("no such = code(anywhere)", "test_moves", "occurs 0 times"),
        ("import numpy as np", "test_moves", r"occurs \d+ times"),
        ("to_global_best *= attractor - self._positions", "test_moves test_of_nothing", "not all files"),
    ],
)
def test_what_is_not_found_is_not_noticed(mutants, code, tests, detail):
    result = mutants.examine(mutants.Mutant("X", "nothing", code, "pass", tests))
    assert result.verdict == "not found"
    assert "not found" in str(result)
    assert re.search(detail, result.detail)


def test_a_test_that_fails_without_the_change_too_gives_no_verdict(mutants, tmp_path, monkeypatch):
    """One test of a file passes and one does not, whatever the package is."""
    (tmp_path / "test_two.py").write_text("def test_good():\n    pass\n\n\ndef test_bad():\n    assert False\n")
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    mutant = mutants.Mutant("X", "nothing", "code", "pass", "test_two")
    given = [
        mutants.Result(mutant, "killed", "there", 0.0, f"test_two.py::{name}") for name in ("test_good", "test_bad")
    ]
    good, bad = mutants.without_changes(given)
    assert (good.verdict, bad.verdict) == ("killed", "no verdict")
    assert "does not pass without the change" in str(bad)


def test_an_unknown_identifier_is_an_error_that_names_those_there_are(mutants):
    with pytest.raises(ValueError, match="no mutant is called A0; give some of A07, "):
        mutants.run(["A0"])


def test_the_code_of_each_wrong_change_stands_once_in_the_package(mutants):
    """So that a change of the code that a mutant names is seen at once, and not when all of them run next."""
    files = sorted((ROOT / "sysid").rglob("*.py"))
    found = {
        mutant.identifier: sum(len(mutants.occurrences(mutant.code, path)) for path in files)
        for mutant in mutants.MUTANTS
    }
    assert {identifier: count for identifier, count in found.items() if count != 1} == {}
