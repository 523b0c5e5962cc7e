"""Output of commands: words or one JSON document, progress of a search, complaints, and the files of results.

Words and document are on standard output, progress and complaints on standard error; progress is a table that updates
in a terminal, elsewhere lines.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

from sysid.cli.starting import MISTAKE
from sysid.errors import InputError, shown_plainly
from sysid.search.session import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace

from sysid.errors import refuse
from sysid.results.checkpoint import Checkpoint
from sysid.results.identification import Identification
from sysid.results.storage import FILE_NAME as RESULT
from sysid.results.storage import LOCK_NAME, alone, atomically, missing_folders, remove_empty
from sysid.search.session import TimeIsOver, within

_CLOSED = OSError(errno.EBADF, "it is closed")


class Stream:
    """A text stream that takes any character and never raises.

    A closed pipe or a full disk must not end a search whose result goes elsewhere; `failed` keeps
    the first such error. None is a stream that was closed before the process began.
    """

    def __init__(self, stream: IO[str] | None) -> None:
        self._stream = io.StringIO() if stream is None else stream
        self.encoding = getattr(stream, "encoding", None) or "utf-8"
        self.failed = _CLOSED if stream is None else None

    def write(self, text: str) -> int:
        """Write what the stream can show of a text; its length."""
        self._try(self._stream.write, text.encode(self.encoding, "replace").decode(self.encoding))
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        self._try(self._stream.flush)

    def close(self) -> None:
        """Leave the stream open: it is not a problem module's to close."""

    def _try(self, do: Callable[..., object], *arguments: str) -> None:
        if self.failed is None:
            try:
                do(*arguments)
            except OSError as error:
                self.failed = error
            except ValueError:  # a closed file
                self.failed = _CLOSED

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Output:
    """Output of one command; control characters, as a name in a file may hold some, are spelled out.

    With `json` one document takes the place of words, at the end: ``status``, ``files`` that were written,
    ``warnings``, the command's own figures, and ``error`` where there is one. `quiet` leaves complaints, warnings and
    the document alone.
    """

    def __init__(self, *, json: bool = False, quiet: bool = False) -> None:
        self.stdout, self.stderr = Stream(sys.stdout), Stream(sys.stderr)
        self.json, self.quiet = json, quiet
        self._document: dict[str, Any] = {"files": [], "warnings": []}

    @property
    def prints(self) -> Stream:
        """Where what argparse, a problem module or CasADi prints goes: not into the document."""
        return self.stderr if self.json or self.quiet else self.stdout

    def write(self, words: str) -> None:
        """Say words to people."""
        if not (self.json or self.quiet):
            self.stdout.write(shown_plainly(words))

    def flush(self) -> None:
        """Flush the words."""
        self.stdout.flush()

    def progress(self, words: str) -> None:
        """Say how far the work is."""
        if not self.quiet:
            self.stdout.flush()
            self.stderr.write(shown_plainly(words))
            self.stderr.flush()

    def answer(self, **figures: Any) -> None:
        """Add to the document: numbers, texts, and lists and dictionaries of them."""
        self._document.update(figures)

    def wrote(self, path: Path, label: str = "") -> None:
        """Tell a file that was written."""
        self._document["files"].append(str(path))
        self.write(f"{label}{path}\n")

    def complain(self, message: object) -> None:
        """One line on standard error, whatever the message holds."""
        line = " ".join(str(message).split())
        self._document["error"] = line
        self._complain(line)

    def warn(self, message: object) -> None:
        """The same for what is no mistake, once."""
        line = " ".join(str(message).split())
        if line in self._document["warnings"]:
            return
        self._document["warnings"].append(line)
        self._complain(f"warning: {line}")

    def end(self, status: int) -> int:
        """Write the document, if that was asked for; the exit status, also where standard output cannot be written."""
        if self.json:
            self.stdout.write(strict_json({"status": status, **self._document}))
        self.flush()
        failed = self.stdout.failed
        if failed is None:
            return status
        # What is left in the interpreter's own buffer would fail once more at exit.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(failed, BrokenPipeError):  # a reader that has seen enough is no mistake
            return status
        self._complain(f"standard output cannot be written: {failed.strerror}")
        return status or MISTAKE

    def _complain(self, line: str) -> None:
        self.stdout.flush()
        self.stderr.write(f"sysid: {shown_plainly(line)}\n")
        self.stderr.flush()


def strict_json(value: object) -> str:
    """JSON with null for what is not a number."""
    finite = json.loads(json.dumps(value, default=lambda array: array.tolist()), parse_constant=lambda _: None)
    return json.dumps(finite, indent=2, allow_nan=False) + "\n"


def keep_for_document() -> None:
    """Keep standard output of this process for the document: what else is printed goes to standard error."""
    with contextlib.suppress(OSError):  # one of them is closed
        sys.stdout = os.fdopen(os.dup(1), "w", encoding="utf-8")
        os.dup2(2, 1)


@contextlib.contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """Keep warnings for the end: they would tear the live display, or stand beside the one line of a mistake."""
    lines: list[str] = []
    with warnings.catch_warnings():
        # An assignment, and not record=True: warnings that are errors stay so.
        warnings.showwarning = lambda message, category, filename, lineno, file=None, line=None: lines.append(
            f"{filename}:{lineno}: {category.__name__}: {message}"
        )
        yield lines


def display_on(out: Output) -> _LiveTable | _Lines:
    """Display of progress: a table that updates in a terminal, elsewhere a line at times."""
    from rich.console import Console

    terminal = out.stderr.isatty() and not out.quiet
    # No markup, and no control codes unless it is a terminal, whatever the environment asks.
    console = Console(
        file=cast(IO[str], out.stderr), force_terminal=terminal, force_jupyter=False, markup=False, emoji=False,
        highlight=False,
    )  # fmt: skip
    return _LiveTable(console) if console.is_terminal and not console.is_dumb_terminal else _Lines(out)


class _Lines:
    """Progress as lines: the first and the last of each phase, and one every few seconds."""

    def __init__(self, out: Output) -> None:
        self._out = out
        self._phase = ""
        self._printed = -math.inf
        self._pending: Progress | None = None  # the newest, where it is not printed
        self._held: list[str] = []

    def __enter__(self) -> _Lines:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        self._print()
        if kind is None or not issubclass(kind, InputError):
            self._release()

    def __call__(self, progress: Progress) -> None:
        """Take the newest progress."""
        begins = progress.phase != self._phase
        if begins:
            self._print()
        self._phase, self._pending = progress.phase, progress
        if begins or progress.seconds - self._printed >= 5.0:  # s
            self._print()
        # Lines of the poles are held back for a second: a mistake that is found by then is told alone.
        if progress.phase != "poles" or progress.seconds >= 1.0:
            self._release()

    def _print(self) -> None:
        if self._pending is not None:
            self._printed = self._pending.seconds
            self._held.append(f"{self._pending}\n")
        self._pending = None

    def _release(self) -> None:
        for line in self._held:
            self._out.progress(line)
        self._held = []


class _LiveTable:
    """Progress as a table that updates: a row a phase."""

    def __init__(self, console: Console) -> None:
        from rich.live import Live

        self._phases: dict[str, Progress] = {}
        self._start = time.perf_counter()
        self._live = Live(get_renderable=self._table, console=console, refresh_per_second=8)

    def __enter__(self) -> _LiveTable:
        self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._live.stop()

    def __call__(self, progress: Progress) -> None:
        """Take the newest progress."""
        self._phases.pop(progress.phase, None)  # the phase at work is the last
        self._phases[progress.phase] = progress

    def _table(self) -> Table:
        from rich import box
        from rich.table import Table

        table = Table(box=box.SIMPLE, pad_edge=False)
        table.add_column("phase", min_width=12)
        for name, width in (("iteration", 10), ("objective", 10), ("time", 8)):
            table.add_column(name, justify="right", min_width=width, no_wrap=True)
        now = time.perf_counter() - self._start
        rows = list(self._phases.values())
        seconds = [p.seconds for p in rows]
        if rows and self._live.is_started:
            seconds[-1] = now  # the clock of the phase at work runs on between its reports
        for p, elapsed in zip(rows, seconds, strict=True):
            count = f"{p.iteration} / {p.of}" if p.of else f"{p.iteration}"
            table.add_row(f"{p.phase}  {p.doing}".rstrip(), count, f"{p.objective:.3e}", f"{elapsed:.1f} s")
        if not rows:
            table.add_row("preparation", "", "", f"{now:.1f} s")
        return table


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


def wrong_in_words(result: Identification) -> list[str]:
    """What contradicts the records, a sentence each, or that there is no fit."""
    return [str(one) for one in result.contradictions] if result.success else [f"no fit: {result.undetermined[0]}"]


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
