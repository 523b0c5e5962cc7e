"""The list of benchmarks, names that are not in it, and what counts as not met. Nothing is measured here."""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def package(monkeypatch):
    """Runner and registry, from the checkout."""
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("benchmarks.__main__"), importlib.import_module("benchmarks.registry")


def test_names_are_unique_and_every_module_is_there(package):
    _, registry = package
    names = [benchmark.name for benchmark in registry.BENCHMARKS]
    groups = {benchmark.group for benchmark in registry.BENCHMARKS}
    assert len(set(names)) == len(names)
    assert not {registry.ALL, *groups} & set(names)
    for benchmark in registry.BENCHMARKS:
        assert (ROOT / "benchmarks" / (benchmark.module.replace(".", "/") + ".py")).is_file()


def test_the_list_has_a_row_for_each(package, capsys):
    runner, registry = package
    assert runner.main([]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert len(rows) == len(registry.BENCHMARKS)
    for row, benchmark in zip(rows, registry.BENCHMARKS, strict=True):
        assert row.split()[:2] == [benchmark.group, benchmark.name] or row.split()[0] == benchmark.name


def test_a_group_stands_for_all_its_benchmarks_once(package):
    _, registry = package
    chosen = registry.select(["variants", "six_springs"])
    assert chosen == [benchmark for benchmark in registry.BENCHMARKS if benchmark.module.startswith("variants.")]


def test_an_unknown_name_is_refused_in_one_line(package, capsys):
    runner, _ = package
    assert runner.main(["tower", "towre"]) == 2
    printed = capsys.readouterr()
    assert "'towre'" in printed.err
    assert printed.err.count("\n") == 1
    assert not printed.out


def test_lines_that_are_not_met_and_crashes_count(package, monkeypatch, capsys):
    runner, registry = package
    line = importlib.import_module("benchmarks.line")

    def lines(self, reduced):
        yield line.below("time, s", 1.0, 2.0)
        yield line.below("error", 3.0, 2.0)
        raise RuntimeError("broken")

    monkeypatch.setattr(registry.Benchmark, "lines", lines)
    assert runner.main(["tower"]) == 1
    printed = capsys.readouterr()
    assert "lines: 3; not met: 2" in printed.out
    assert "RuntimeError: broken" in printed.err


def test_a_crash_beside_others_counts_too(package, capsys):
    _, registry = package
    measure = importlib.import_module("benchmarks.measure")
    missing = registry.Benchmark("no_module", "nothing", "-", "-")
    alone = registry.Benchmark("no_module", "nothing", "-", "-", timed=True)
    assert len(measure.run([alone, missing], reduced=True, processes=2)) == 2
    assert "lines: 2; not met: 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "full", "reduced"),
    [({}, False, False), ({"timed": True}, True, True), ({"timed": True, "reduced_timed": False}, True, False)],
)
def test_nothing_runs_beside_a_form_that_judges_seconds(package, given, full, reduced):
    _, registry = package
    benchmark = registry.Benchmark("module", "nothing", "-", "-", **given)
    assert (benchmark.alone(False), benchmark.alone(True)) == (full, reduced)
