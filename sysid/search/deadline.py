"""A time limit on work that has no limit of its own, such as drawing a page."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn


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
