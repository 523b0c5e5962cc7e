"""Progress, time limit and interruption of a search, and the journal from which it goes on after its process has ended.

A search repeats bit for bit with the same seed. So it is enough to keep where its long parts ended, and the state of
the one that runs: a resumed search takes the same way, and reads these in place of running them (`Journal`).
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType
from typing import Any, Literal, NoReturn

import numpy as np

from sysid.errors import InputError, Stop, as_float, function, whole_number
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.nlp import GRACE, suffices
from sysid.structure.structure import Array

Tree = dict[str, Any]

EVERY = 3.0  # s between two writings
_SHARE = 0.05  # of the time that writing may take


class Journal:
    """The long parts of a search in their order.

    `write` keeps the entries that it is given, at least `every` so many s, more where writing takes long; without it
    nothing is kept. `entries` are those of an earlier run of the same search: name and content of each part, by its
    number as a text.
    """

    def __init__(
        self, write: Callable[[Tree], object] | None = None, entries: Tree | None = None, every: float = EVERY
    ) -> None:
        self.entries = dict(entries or {})
        self._write, self._every = write, every
        self._next, self._written, self._took = 0, time.perf_counter(), 0.0
        self._unwritten = False

    def part(self, name: str) -> Part:
        """Begin the next part; an InputError where the earlier run had another one here."""
        number, self._next = str(self._next), self._next + 1
        found = self.entries.get(number)
        if found is not None and found["part"] != name:
            raise InputError(
                f"the unfinished run had part {found['part']!r} where this one has {name!r}: it was of another search"
            )
        return Part(self, number, name, None if found is None else found["content"])

    def keep(self, number: str, name: str, content: Callable[[], Tree], *, at_once: bool = False) -> None:
        """Take the content of a part, where it is time to write, or anyway."""
        due = time.perf_counter() - self._written > max(self._every, self._took / _SHARE)
        if self._write is None or not (due or at_once):
            return
        # What came after an older state of this part does not follow from this one.
        self.entries = {key: entry for key, entry in self.entries.items() if int(key) < int(number)}
        self.entries[number] = {"part": name, "content": content()}
        self._unwritten = True
        if due:
            self.flush()

    def flush(self) -> None:
        """Write what is not written."""
        if self._write is None or not self._unwritten:
            return
        start = time.perf_counter()
        self._write(self.entries)
        self._written = time.perf_counter()
        self._took, self._unwritten = self._written - start, False


@dataclass(frozen=True, eq=False)
class Part:
    """One part of a search; `found` is what an earlier run kept of it."""

    journal: Journal
    number: str
    name: str
    found: Tree | None

    def running(self, content: Callable[[], Tree]) -> None:
        """Keep its present state, where it is time to."""
        self.journal.keep(self.number, self.name, content)

    def ended(self, content: Callable[[], Tree]) -> None:
        """Keep its end, or its state where it is stopped."""
        self.journal.keep(self.number, self.name, content, at_once=True)


class TimeIsOver(BaseException):  # no library's ``except Exception`` must take it
    """The time is over."""


@contextlib.contextmanager
def within(seconds: float | None) -> Iterator[None]:
    """Raise `TimeIsOver` in the midst of Python code once so many seconds have passed; None sets no limit.

    Without POSIX signals, or outside the main thread, what has begun is not cut short. An alarm that somebody else has
    set comes at its time, or where that has passed, at the end.
    """
    if seconds is not None and seconds <= 0:
        raise TimeIsOver
    if seconds is None:
        yield
        return
    start = time.perf_counter()
    try:
        # Again every second: compiled code and __del__ lose an exception that strikes inside them.
        with _alarm(_raise, seconds, 1.0):
            yield
    except Exception as error:  # compiled code makes another one of ours
        if time.perf_counter() < start + seconds or not _can_alarm():
            raise
        raise TimeIsOver from error


def regularly(call: Callable[[], object], every: float = 0.1) -> contextlib.AbstractContextManager[None]:
    """Call a function every so many seconds in the midst of Python code; what it raises ends that.

    Where `within` cuts nothing short it is not called.
    """
    return _alarm(lambda number, frame: call(), every, every)


def _can_alarm() -> bool:
    """True in the main thread, where there are POSIX signals."""
    return threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer")


@contextlib.contextmanager
def _alarm(handler: Callable[[int, FrameType | None], object], first: float, again: float) -> Iterator[None]:
    """Handle an alarm after so many seconds, and then again and again; then the alarm is set as it was before."""
    if not _can_alarm():
        yield
        return
    start, before = time.perf_counter(), signal.signal(signal.SIGALRM, handler)
    other, other_again = signal.setitimer(signal.ITIMER_REAL, first, again)
    try:
        yield
    finally:
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        finally:  # the alarm may have come just before
            signal.signal(signal.SIGALRM, before)
            if other > 0:
                # Zero would set no alarm.
                left = max(other - (time.perf_counter() - start), 1e-6)
                signal.setitimer(signal.ITIMER_REAL, left, other_again)


def _raise(number: int, frame: object) -> NoReturn:
    raise TimeIsOver


Phase = Literal["poles", "swarm", "continuation", "local phase", "other answers"]


@dataclass(frozen=True, eq=False)
class Progress:
    """State of a search for a callback.

    Attributes
    ----------
    phase : str
        "poles" (of the records), "swarm", "continuation" (of widened peaks), "local phase" or "other answers" (the
        search for them, before an answer is called determined).
    iteration, of : int
        The iteration, and the most there can be (0: not known).
    objective : float
        Of the best candidate so far: root of the sum of squares of all that this phase fits, each record relative and
        weighed by its noise.
    seconds : float
        Since the start.
    doing : str
        What is tried, such as "further modes"; empty where the phase says it.
    """

    phase: Phase
    iteration: int
    of: int
    objective: float
    seconds: float
    doing: str = ""

    def __str__(self) -> str:
        counts = f"iteration {self.iteration:4d}  objective {self.objective:.3e}"
        return f"{self.phase:12s}  {counts}  {self.seconds:6.1f} s  {self.doing}".rstrip()


class DeferredInterrupt:
    """Hold Ctrl-C back until the search next reports: raised inside compiled code it would lose the best so far.

    Where somebody else handles the signal, or outside the main thread, nothing changes. Within another one this one
    answers the signal: it takes over what that one holds, and hands all back at its end.

    So many are held as there is `patience`; the next one acts at once, whatever is lost. None holds all.
    """

    def __init__(self, patience: int | None = 2) -> None:
        self.patience = patience
        self.count = 0
        self.raised = False
        self.ours = False

    @property
    def asked(self) -> bool:
        """True where there was a Ctrl-C."""
        return self.count > 0

    def __enter__(self) -> DeferredInterrupt:
        self._before = signal.getsignal(signal.SIGINT)
        outer = getattr(self._before, "__self__", None)
        self._outer = outer if isinstance(outer, DeferredInterrupt) else None
        standard = self._outer is not None or self._before is signal.default_int_handler
        self.ours = standard and threading.current_thread() is threading.main_thread()
        if self.ours:
            signal.signal(signal.SIGINT, self._hold)
            if self._outer is not None:
                self.count, self._outer.count = self.count + self._outer.count, 0
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if self.ours:
            signal.signal(signal.SIGINT, self._before)
            if self._outer is not None:
                self._outer.count += self.count
        # CasADi turns a KeyboardInterrupt that strikes inside it into some other exception.
        if self.raised and isinstance(error, Exception):
            raise KeyboardInterrupt from error

    def _hold(self, number: int, frame: object) -> None:
        self.count += 1
        if self.patience is not None and self.count > self.patience:
            self.raised = True
            raise KeyboardInterrupt

    def check(self) -> None:
        """Raise the KeyboardInterrupt that was held back."""
        if self.asked:
            raise KeyboardInterrupt


class Session:
    """The clock, the log, the listeners and the random source of an identification.

    Listeners are called with a `Progress` at each iteration; `max_time` is in s, `max_evaluations` the candidates that
    a swarm may evaluate.
    """

    def __init__(
        self,
        listeners: list[Callable[[Progress], object]],
        interrupt: DeferredInterrupt,
        max_time: float | None = None,
        random: np.random.SeedSequence | None = None,
        max_evaluations: int | None = None,
        journal: Journal | None = None,
    ) -> None:
        self.journal = journal or Journal()
        self.listeners, self.interrupt, self.max_time = listeners, interrupt, max_time
        self.random = random or np.random.SeedSequence(0)
        self.max_evaluations = max_evaluations
        self.start_time = time.perf_counter()
        self.lines: list[str] = []
        self.stop_asked: Stop | None = None  # by a callback, before there was anything to keep
        self.left_out = False  # a part of the search, for want of time
        self.interrupted = False  # by a Ctrl-C that ended the fit of modes

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.start_time

    @property
    def left(self) -> float | None:
        """Seconds that are left, at least `GRACE`; None without a limit."""
        return None if self.max_time is None else max(self.max_time - self.seconds, GRACE)

    @property
    def is_over(self) -> bool:
        """True where the time is over."""
        return self.max_time is not None and self.seconds >= self.max_time

    @property
    def cut_short(self) -> bool:
        """True where the time is over, or did not suffice for a part of the search: with more it may end elsewhere."""
        return self.is_over or self.left_out

    def allows(self, seconds: float) -> bool:
        """True where work that cannot be stopped, and takes about so many seconds of a processor, may begin."""
        return self.left is None or suffices(self.left, seconds)

    @property
    def time_for_more(self) -> bool:
        """True where half of the time is left."""
        return self.max_time is None or self.seconds < self.max_time / 2

    def log(self, line: str) -> None:
        """Add a line to the log."""
        self.lines.append(f"{self.seconds:8.2f} s  {line}")

    def report(self, phase: Phase, iteration: int, of: int, objective: float, doing: str = "") -> None:
        """Tell the listeners of an iteration; a Stop or KeyboardInterrupt where one or the user wants to stop."""
        self.interrupt.check()
        if self.stop_asked is not None and phase != "poles":
            raise self.stop_asked
        for listener in self.listeners:
            try:
                listener(Progress(phase, iteration, of, objective, self.seconds, doing))
            except StopIteration:
                raise Stop("the callback stopped the search") from None

    def reporter(self, phase: Phase) -> Callable[[int, float], None]:
        """`report` for a phase whose iterations are not counted beforehand."""
        return lambda iteration, objective: self.report(phase, iteration, 0, objective)

    def preparing(self, iteration: int, objective: float, doing: str = "") -> None:
        """`report` while modes and poles are looked for, before there is anything to keep: the time limit ends it too.

        A callback that wants to stop does so once there are modes, or when the search itself first reports.
        """
        try:
            self.report("poles", iteration, 0, objective, doing)
        except Stop as stop:
            self.stop_asked = stop
        except KeyboardInterrupt:  # a callback's own: held like one of the signal
            self.interrupt.count = max(self.interrupt.count, 1)
        self._check_limits()

    @contextlib.contextmanager
    def fit_monitor(self, share: float = 0.8) -> Iterator[FitMonitor]:
        """Monitor of the fit of modes, asked at any time; the fit has a share of the time, what follows the rest."""
        monitor = FitMonitor(self.preparing, self._check_fit, None if self.left is None else share * self.left)
        with regularly(monitor.check):
            yield monitor

    def _check_fit(self, kept: bool) -> None:
        """End a fit, at any time: at Ctrl-C, at the time limit, and, where one is `kept`, as a callback wants it."""
        if kept and self.stop_asked is not None:
            raise self.stop_asked
        self._check_limits()

    def _check_limits(self) -> None:
        self.interrupt.check()
        if self.is_over:
            raise Stop("the time was over before the modes of the records were found (give more by --max-time)")

    def finish(self, seconds: float = 1.0) -> None:
        """Leave so many seconds to what is still to be done, where Ctrl-C or a callback ended the fit of modes."""
        if self.interrupt.asked or self.stop_asked is not None:
            self.interrupted, self.interrupt.count, self.stop_asked = self.interrupt.asked, 0, None
            self.max_time = min(self.max_time or np.inf, self.seconds + seconds)


def in_time(
    function: Callable[[Array], Array], otherwise: Callable[[Array], Array], session: Session, at_once: int
) -> Callable[[Array], Array]:
    """A function of so many rows at once, and another one of the rows that the session has no time for any more."""

    def of_rows(rows: Array) -> Array:
        pieces = [rows[at : at + at_once] for at in range(0, len(rows), at_once)]
        return np.concatenate(
            [(otherwise if i and session.is_over else function)(rows) for i, rows in enumerate(pieces)]
        )

    return function if session.max_time is None else of_rows


def seed_of(rng: int | np.random.Generator | None) -> tuple[int, np.random.SeedSequence]:
    """A seed to report, and the random source that it makes."""
    if isinstance(rng, np.random.Generator):
        seed = int(rng.integers(2**63))
    elif rng is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> 1)
    else:
        seed = whole_number("rng", rng, at_least=0)
    return seed, np.random.SeedSequence(seed)


def limits_of(max_time: float | None, max_evaluations: int | None) -> tuple[float | None, int | None]:
    """Seconds and evaluations, checked; None where there is no limit."""
    seconds = None if max_time is None else as_float("max_time", max_time, "a positive number of seconds", above=0)
    return seconds, None if max_evaluations is None else whole_number("max_evaluations", max_evaluations, at_least=1)


def listeners_of(**given: Callable[[Progress], object] | None) -> list[Callable[[Progress], object]]:
    """Those that are given, checked, by the names of the arguments."""
    for name, listener in given.items():
        function(name, listener)
    return [listener for listener in given.values() if listener is not None]
