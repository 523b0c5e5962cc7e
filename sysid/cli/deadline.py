"""A time limit on work that has no limit of its own, such as drawing a page."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from typing import NoReturn

_AGAIN = 1.0  # s between further attempts, as compiled code and __del__ lose an exception that strikes inside them


class TimeIsOver(BaseException):  # no library's ``except Exception`` must take it
    """The time is over."""


@contextlib.contextmanager
def within(seconds: float | None) -> Iterator[None]:
    """Raise `TimeIsOver` in the midst of Python code once so many seconds have passed; None sets no limit.

    Without POSIX signals, or outside the main thread, what has begun is not cut short.
    """
    if seconds is not None and seconds <= 0:
        raise TimeIsOver
    in_main_thread = threading.current_thread() is threading.main_thread()
    if seconds is None or not in_main_thread or not hasattr(signal, "setitimer"):
        yield
        return
    end, before = time.perf_counter() + seconds, signal.signal(signal.SIGALRM, _raise)
    signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN)
    try:
        yield
    except Exception as error:  # compiled code makes another one of ours
        if time.perf_counter() < end:
            raise
        raise TimeIsOver from error
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _raise(number: int, frame: object) -> NoReturn:
    raise TimeIsOver
