"""Monitor of fits of whole records: progress, time limit and interruption, and the best fit until then."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from sysid.errors import Stop
from sysid.measurement.measurement import Measurement


class Fitted(Protocol):
    """A fit, as far as it is compared with others: see `sysid.modal_analysis.record_fit.RecordFit`."""

    @property
    def test(self) -> Measurement:
        """The test that was fitted."""

    @property
    def schwarz(self) -> float:
        """By which fits of the same lines are compared: the larger, the better."""


class FitMonitor:
    """Monitor of fits of whole records, test by test.

    Parameters
    ----------
    listener : callable, optional
        ``listener(iteration, residual, doing)``, the last in words; what it raises ends the fit.
    check : callable, optional
        ``check(kept)`` raises `Stop` or KeyboardInterrupt where the fit is to end; `kept` tells whether there is a fit
        that would be returned.
    seconds : float or None
        In which all tests are to be fitted. A test without any fit goes on all the same, until `check` ends it.

    Attributes
    ----------
    best : RecordFit or None
        The best fit of the test at work that a search has not gone on to reject.
    doing : str
        What is tried, such as "a 13th mode".
    """

    def __init__(
        self,
        listener: Callable[[int, float, str], object] = lambda iteration, residual, doing: None,
        check: Callable[[bool], object] = lambda kept: None,
        seconds: float | None = None,
    ) -> None:
        self._listener, self._check = listener, check
        self._end = np.inf if seconds is None else time.perf_counter() + seconds
        self._deadline = self._end
        self._may_end = False
        self.best: Fitted | None = None
        self.doing = ""

    def begin(self, tests: int) -> None:
        """Begin a test, which has its share of the time of so many that are left."""
        now = time.perf_counter()
        self._deadline = now + (self._end - now) / max(tests, 1)
        self.best, self.doing = None, ""

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        """Let `check` end the fit: within, and not while the listener is at work."""
        self._may_end = True
        try:
            yield
        finally:
            self._may_end = False

    def __call__(self, iteration: int, residual: float) -> None:
        """Tell an iteration, and end the fit where that is wanted."""
        before, self._may_end = self._may_end, False
        self._listener(iteration, residual, self.doing)
        self._may_end = before
        self.check()

    def check(self) -> None:
        """End the fit where that is wanted; may be called at any time, from a signal too."""
        if not self._may_end:
            return
        self._check(self.best is not None)
        if self.best is not None and time.perf_counter() > self._deadline:
            raise Stop("the time for the modes was over")

    def keep(self, fit: Fitted) -> None:
        """Keep a fit that was judged, unless that of the same lines that is kept already is better."""
        best = self.best
        if best is None or best.test.freq.size != fit.test.freq.size or fit.schwarz > best.schwarz:
            self.best = fit

    def keep_instead(self, fit: Fitted) -> None:
        """Keep a fit in the place of another one that was found to be wrong."""
        self.best = fit
