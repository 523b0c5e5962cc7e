"""Writing that commands share, a result with its pages among it; whether a folder can be written, CSV, JSON."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sysid.cli.output import Output, strict_json
from sysid.errors import InputError, refuse, shown_plainly
from sysid.results.checkpoint import Checkpoint
from sysid.results.identification import Identification
from sysid.results.storage import FILE_NAME as RESULT
from sysid.results.storage import LOCK_NAME, alone, atomically, missing_folders, remove_empty
from sysid.search.session import TimeIsOver, within

_SUMMARY = "summary.json"


def results_folder(given: str | None, default: Path) -> Path:
    """The folder of results; one that cannot be written is refused before the search, without making it."""
    folder = default if given is None else Path(given)
    nameless = given is not None and (not given.strip() or "\0" in given)
    refuse((nameless, f"folder of results {given!r}: give the name of a folder"))
    try:
        place = next((place for place in (folder, *folder.parents) if place.exists()), folder)
        refuse((not place.is_dir(), f"folder of results {folder}: {place} is not a folder"))
    except OSError as error:
        raise InputError(f"folder of results {folder}: {error.strerror or error}") from None
    unwritable = not os.access(place, os.W_OK | os.X_OK)
    refuse((unwritable, f"folder of results {folder}: {place} cannot be written"))
    return folder


def alone_in(folder: Path, remedy: str) -> contextlib.AbstractContextManager[None]:
    """Let no other run write in a folder of results; where one does, it is refused with the remedy."""
    return alone(folder / LOCK_NAME, f"folder of results {folder}", remedy)


def table_as_csv(rows: Sequence[Sequence[object]]) -> bytes:
    """Rows, the first of them the names of the columns; control characters of a text are spelled out."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return shown_plainly(text.getvalue()).encode()


def png(picture: Callable[..., Any], *given: Any, **named: Any) -> bytes:
    """A picture of what is given, in the package's own style."""
    from sysid.plot.canvas import default_style, to_png

    with default_style():
        return to_png(picture(*given, **named), dpi=130)


def write_files(folder: Path, files: Mapping[str, bytes | None], out: Output) -> None:
    """Write files by their names, each whole or not at all, and tell their paths; None removes an earlier one."""
    for name, content in files.items():
        if content is None:
            (folder / name).unlink(missing_ok=True)
            continue
        with atomically(folder / name) as temporary:
            temporary.write_bytes(content)
        out.wrote(folder / name)


def save(result: Identification, folder: Path, checkpoint: Checkpoint) -> None:
    """Write a result, then take away what it replaces."""
    from sysid.report import report

    missing = missing_folders(folder)
    try:
        result.save(folder / RESULT)
        for name in (_SUMMARY, report.FILE_NAME):  # those of another result must not stand beside this one
            (folder / name).unlink(missing_ok=True)
        if not result.interrupted:
            checkpoint.remove()
    except OSError as error:
        raise InputError(f"folder of results {folder}: {error.strerror or error}") from error
    finally:
        remove_empty(missing)  # where nothing could be written


def replaced_in_words(result: Identification, folder: Path) -> str:
    """A line on the result of another strategy that stands in a folder; nothing where there is none."""
    try:
        before = json.loads((folder / _SUMMARY).read_text(encoding="utf-8"))["strategy"]
    except (OSError, ValueError, LookupError, TypeError):  # none, or a file of somebody else's
        return ""
    return f"replaces the result of strategy {before} in {folder}\n" * (before != result.strategy)


def summary_and_figures(result: Identification, left: float | None) -> tuple[str, dict[str, Any]]:
    """Summary and figures of a result; without what takes more than the seconds that are `left`."""
    try:
        with within(left):
            return result.summary(), result.to_dict()
    except TimeIsOver:
        hurried = replace(result, hurried=True)
        return hurried.summary(), hurried.to_dict()


def write_pages(result: Identification, figures: dict[str, Any], folder: Path, out: Output, left: float | None) -> None:
    """Write what people and scripts read of a result that is saved, each file whole or not at all.

    The page is left out where it takes more than the seconds that are `left`.
    """
    from sysid.report import report

    out.wrote(folder / RESULT, "result   ")
    summary = folder / _SUMMARY
    with atomically(summary) as temporary:
        temporary.write_text(strict_json(figures), encoding="utf-8")
    out.wrote(summary, "summary  ")
    try:
        with within(left):
            out.wrote(report.write_report(result, folder / report.FILE_NAME), "report   ")
    except TimeIsOver:
        out.write(f"no report, as the time is over: 'sysid report {folder}' writes it\n")
