"""Progress reporting, time limit and interruption of a search."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid.errors import Stop, as_float, function, whole_number
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.nlp import GRACE, suffices
from sysid.search.journal import Journal
from sysid.structure.structure import Array

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

    Parameters
    ----------
    patience : int or None
        How many are held; the next one acts at once, whatever is lost. None holds all.
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

    Parameters
    ----------
    listeners : list of callable
        Called with a `Progress` at each iteration.
    interrupt : DeferredInterrupt
    max_time : float or None
        s.
    random : SeedSequence
    max_evaluations : int or None
        Candidates that a swarm may evaluate.
    journal : Journal, optional
        Keeps what the search has reached.
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
        """Tell the listeners of an iteration.

        Raises
        ------
        Stop, KeyboardInterrupt
            Where a listener or the user wants to stop.
        """
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

    def fit_monitor(self, share: float = 0.8) -> FitMonitor:
        """Monitor of the fit of modes, which has a share of the time: the rest is for what follows."""
        return FitMonitor(self.preparing, self._check_fit, None if self.left is None else share * self.left)

    def _check_fit(self, kept: bool) -> None:
        """End a fit, at any time: at Ctrl-C, at the time limit, and, where one is `kept`, as a callback wants it."""
        if kept and self.stop_asked is not None:
            raise self.stop_asked
        self._check_limits()

    def _check_limits(self) -> None:
        self.interrupt.check()
        if self.is_over:
            raise Stop("the time was over before the modes of the records were found")

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
