"""Problem modules that were written from the README and one notebook alone: run as they are."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.command_line import sysid_run
from benchmarks.line import Line
from benchmarks.problem_modules import ROOT

FOLDER = ROOT / "tests" / "modules_from_readme"


def lines(reduced: bool) -> Iterator[Line]:
    """One line a variant: it runs from the command line and ends in success. Both forms are the same."""
    modules = sorted(FOLDER.glob("*.py"))
    if not modules:
        yield Line("modules written from the README alone", "tests/modules_from_readme absent: not run")
    for path in modules:
        with tempfile.TemporaryDirectory() as place:
            run = sysid_run([str(path)], Path(place))
            summary = Path(place) / "out" / "summary.json"
            told = json.loads(summary.read_text(encoding="utf-8")) if summary.is_file() else {}
        yield Line(
            f"module written from the README alone: {path.stem}",
            f"status {run.returncode}, residual {told.get('residual')}, determined {told.get('determined')}"
            + (f"; {run.stderr.strip().splitlines()[-1][:120]}" if run.returncode else ""),
            "status 0",
            run.returncode == 0,
        )
