"""Progress of a search on standard error: a table that updates in a terminal, elsewhere lines."""

from __future__ import annotations

import math
import time
from typing import IO, TYPE_CHECKING, cast

from sysid.cli.output import Output
from sysid.errors import InputError
from sysid.search.session import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


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
