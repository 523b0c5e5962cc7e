"""A time limit on work that has no limit of its own, such as drawing a page."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
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
    in_main_thread = threading.current_thread() is threading.main_thread()
    if seconds is None or not in_main_thread or not hasattr(signal, "setitimer"):
        yield
        return
    start, before = time.perf_counter(), signal.signal(signal.SIGALRM, _raise)
    # Again every second: compiled code and __del__ lose an exception that strikes inside them.
    other, again = signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    except Exception as error:  # compiled code makes another one of ours
        if time.perf_counter() < start + seconds:
            raise
        raise TimeIsOver from error
    finally:
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        finally:  # the alarm may have come just before
            signal.signal(signal.SIGALRM, before)
            if other > 0:
                # Zero would set no alarm.
                signal.setitimer(signal.ITIMER_REAL, max(other - (time.perf_counter() - start), 1e-6), again)


def _raise(number: int, frame: object) -> NoReturn:
    raise TimeIsOver
