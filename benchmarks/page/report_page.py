"""The report page: first screen, controls, contrast and width in a browser, and print."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import sysid
from benchmarks.line import Line, below
from benchmarks.page import browser
from benchmarks.page.page_speed import answer
from sysid.report import report

WIDTHS = ((1280, False), (768, True), (380, False), (380, True))  # pixels; dark
CONTRAST = 4.5  # of text, WCAG 2.2 AA


def lines(reduced: bool) -> Iterator[Line]:
    """Of the first command's page, and of one of 20 sensors, three directions and 1,000 lines."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        command = [sys.executable, "-m", "sysid", "run", "cantilever_tower", "--quiet", "--out", str(where / "tower")]
        subprocess.run(command, check=True, cwd=where)
        pages = {"tower": (where / "tower" / report.FILE_NAME).read_text(encoding="utf-8")}
        if browser.CHROMIUM is None:
            yield Line("the page in a browser", "no Chromium is installed")
            return
        if not reduced:
            large = sysid.write_report(answer(20, 1000, force=True), where / "large")
            pages["large"] = large.read_text(encoding="utf-8")
        for name, page in pages.items():
            yield from _in_a_browser(name, page, where, WIDTHS[::3] if reduced else WIDTHS)
        still = browser.seen_without_scripts(pages["tower"], where, 380)
        shown = still["sheets"], still["modes"], still["sideways"]
        expected = ((10 + 2) * 2, 10, 0)
        text = "tower without scripts, 380 pixels: curves, mode shapes, pixels wider than the page"
        yield Line(text, ", ".join(map(str, shown)), ", ".join(map(str, expected)), shown == expected)
        sheets = browser.pages_printed(where / "tower" / report.FILE_NAME, where)
        yield Line("tower: sheets of its print", f"{sheets}", "from 2 on", sheets > 1)


def _in_a_browser(name: str, page: str, where: Path, widths: Sequence[tuple[int, bool]]) -> Iterator[Line]:
    for width, dark in widths:
        told = browser.measured(page, where, width, dark=dark)
        what = f"{name}, {width} pixels{', dark' * dark}: "
        yield below(what + "errors in the console", len(told["errors"]), 0)
        works = all(told[key] for key in ("zoomed", "whole", "all_lines", "keys", "moved"))
        yield Line(what + "zoom, keys, choices and moving modes", "all work" if works else str(told), "all work", works)
        lowest = max(told["first"])
        yield below(what + "judgement, next step, masses, first mode: lowest edge, pixels", lowest, 800)
        wide = len(told["over"]) + max(told["sideways"], 0)
        yield below(what + "elements wider than the page", wide, 0)
        least = told["contrast"]
        yield Line(what + "least contrast of text", f"{least:.2f}", f">= {CONTRAST}", least >= CONTRAST)
