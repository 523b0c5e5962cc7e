"""Variants by people who had read the README and one notebook: run as they were first written."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.line import Line

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "newcomers"


def newcomers() -> Iterator[Line]:
    """One line a variant: it runs from the command line and ends in success."""
    for path in sorted(FOLDER.glob("*.py")):
        with tempfile.TemporaryDirectory() as place:
            run = subprocess.run(
                [sys.executable, "-m", "sysid", "run", str(path), "--out", "out"],
                cwd=place, capture_output=True, text=True, check=False,
            )  # fmt: skip
            summary = Path(place) / "out" / "summary.json"
            told = json.loads(summary.read_text(encoding="utf-8")) if summary.is_file() else {}
            yield Line(
                f"variant of a newcomer: {path.stem}",
                f"status {run.returncode}, residual {told.get('residual')}, determined {told.get('determined')}"
                + (f"; {run.stderr.strip().splitlines()[-1][:120]}" if run.returncode else ""),
                "status 0",
                run.returncode == 0,
            )
