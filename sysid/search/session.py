"""Progress reporting, time limit and interruption of a search."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Phase = Literal["swarm", "refinement", "continuation", "local phase"]


@dataclass(frozen=True, eq=False)
class Progress:
    """What a callback sees.

    Attributes
    ----------
    phase : str
        "swarm", "refinement", "continuation" (of widened peaks) or "local phase".
    iteration, of : int
        The iteration, and the most there can be (0: not known).
    residual : float
        Of the best candidate so far: root of the squared relative residuals of all that this phase fits.
    seconds : float
        Since the start.
    """

    phase: Phase
    iteration: int
    of: int
    residual: float
    seconds: float

    def __str__(self) -> str:
        return f"{self.phase:12s}  iteration {self.iteration:4d}  residual {self.residual:.3e}  {self.seconds:6.1f} s"


class DeferredInterrupt:
    """Hold Ctrl-C back until the search next reports: raised inside compiled code it would lose the best so far.

    A second Ctrl-C acts at once. Where somebody else handles the signal, or outside the main thread, nothing changes.
    """

    def __init__(self) -> None:
        self.asked = False
        self.raised = False
        self.ours = False

    def __enter__(self) -> DeferredInterrupt:
        self.ours = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        if self.ours:
            signal.signal(signal.SIGINT, self._hold)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if self.ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        # CasADi turns a KeyboardInterrupt that strikes inside it into some other exception.
        if self.raised and isinstance(error, Exception):
            raise KeyboardInterrupt from error

    def _hold(self, number: int, frame: object) -> None:
        if self.asked:
            self.raised = True
            raise KeyboardInterrupt
        self.asked = True

    def check(self) -> None:
        """Raise the KeyboardInterrupt that was held back."""
        if self.asked:
            raise KeyboardInterrupt


class Stop(Exception):  # noqa: N818 - not an error
    """The callback asked to stop."""


class Desk:
    """The clock, the log, and the listeners of an identification."""

    def __init__(
        self, listeners: list[Callable[[Progress], object]], interrupt: DeferredInterrupt, max_time: float | None
    ) -> None:
        self.listeners, self.interrupt, self.max_time = listeners, interrupt, max_time
        self.begun = time.perf_counter()
        self.log: list[str] = []

    @property
    def seconds(self) -> float:
        """Seconds since the search began."""
        return time.perf_counter() - self.begun

    @property
    def left(self) -> float | None:
        """Seconds that are left, at least one; None without a limit."""
        return None if self.max_time is None else max(self.max_time - self.seconds, 1.0)

    @property
    def time_for_more(self) -> bool:
        """Whether half of the time is left."""
        return self.max_time is None or self.seconds < self.max_time / 2

    def note(self, line: str) -> None:
        """Add a line to the log, with the time."""
        self.log.append(f"{self.seconds:8.2f} s  {line}")

    def tell(self, phase: Phase, iteration: int, of: int, cost: float) -> None:
        """Report an iteration to the listeners; raise `Stop` or KeyboardInterrupt where the search is to end."""
        self.interrupt.check()
        for listener in self.listeners:
            try:
                listener(Progress(phase, iteration, of, cost, self.seconds))
            except StopIteration:
                raise Stop("the callback stopped the search") from None
