"""What the commands print: output that takes any character, one line for a mistake, progress."""

from __future__ import annotations

import contextlib
import errno
import io
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import IO, TYPE_CHECKING, Any, cast

from sysid.search.session import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_CLOSED = OSError(errno.EBADF, "it is closed")
_PLAIN_EVERY = 5.0  # s between lines where the display is no terminal


class Output:
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


def complain(message: object) -> None:
    """One line on standard error, whatever the message holds; nothing where that is closed."""
    if sys.stderr is None:
        return
    with contextlib.suppress(OSError, ValueError):
        print("sysid:", " ".join(str(message).split()), file=sys.stderr, flush=True)


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

    terminal = out.isatty()
    # No markup, and no control codes unless it is a terminal, whatever the environment asks.
    console = Console(
        file=cast(IO[str], out), force_terminal=terminal, force_jupyter=False, markup=False, emoji=False,
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

    def __enter__(self) -> _Lines:
        return self

    def __exit__(self, *exception: object) -> None:
        self._print()

    def __call__(self, progress: Progress) -> None:
        """Take the newest progress."""
        begins = progress.phase != self._phase
        if begins:
            self._print()
        self._phase, self._pending = progress.phase, progress
        if begins or progress.seconds - self._printed >= _PLAIN_EVERY:
            self._print()

    def _print(self) -> None:
        if self._pending is not None:
            self._printed = self._pending.seconds
            self._out.write(f"{self._pending}\n")
            self._out.flush()
        self._pending = None


class _LiveTable:
    """Progress as a table that updates: a row a phase."""

    def __init__(self, console: Console) -> None:
        from rich.live import Live

        self._phases: dict[str, Progress] = {}
        self._begun = time.perf_counter()
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
        now = time.perf_counter() - self._begun
        rows = list(self._phases.values())
        seconds = [p.seconds for p in rows]
        if rows and self._live.is_started:
            seconds[-1] = now  # the clock of the phase at work runs on between its reports
        for p, elapsed in zip(rows, seconds, strict=True):
            count = f"{p.iteration} / {p.of}" if p.of else f"{p.iteration}"
            table.add_row(p.phase, count, f"{p.objective:.3e}", f"{elapsed:.1f} s")
        if not rows:
            table.add_row("preparation", "", "", f"{now:.1f} s")
        return table
