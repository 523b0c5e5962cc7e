"""Writing that commands share: whether a folder can be written, files, CSV and strict JSON."""

from __future__ import annotations

import contextlib
import csv
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid.cli.output import Output
from sysid.errors import InputError, shown_plainly
from sysid.results.lock import FILE_NAME as LOCK
from sysid.results.lock import alone
from sysid.results.storage import atomically


def results_folder(given: str | None, default: Path) -> Path:
    """The folder of results; one that cannot be written is refused before the search, without making it."""
    folder = default if given is None else Path(given)
    if given is not None and (not given.strip() or "\0" in given):
        raise InputError(f"folder of results {given!r}: give the name of a folder")
    try:
        place = next((place for place in (folder, *folder.parents) if place.exists()), folder)
        if not place.is_dir():
            raise InputError(f"folder of results {folder}: {place} is not a folder")
    except OSError as error:
        raise InputError(f"folder of results {folder}: {error.strerror or error}") from None
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"folder of results {folder}: {place} cannot be written")
    return folder


def alone_in(folder: Path, remedy: str) -> contextlib.AbstractContextManager[None]:
    """Let no other run write in a folder of results; where one does, it is refused with the remedy."""
    return alone(folder / LOCK, f"folder of results {folder}", remedy)


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
