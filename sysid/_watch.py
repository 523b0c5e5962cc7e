"""What happens between the iterations of IPOPT."""

from __future__ import annotations

import time
from collections.abc import Callable

import casadi as ca
import numpy as np

from sysid.structure import Array

OBJECTIVE_SCALE = 1e3  # lifts a residual of 1e-8 above IPOPT's tolerance


class Watch:
    """What happens between the iterations of all attempts: the curve, the monitor, and its wish to stop."""

    def __init__(self, monitor: Callable[[int, float], object] | None, max_time: float | None) -> None:
        self.monitor = monitor
        self.deadline = np.inf if max_time is None else time.perf_counter() + max_time
        self.curve: list[float] = []
        self.stopped: BaseException | None = None
        self.z: Array = np.zeros(0)

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.perf_counter()

    @property
    def taken(self) -> int:
        """Iterates so far."""
        return len(self.curve)

    def callback(self, start: Array, n_ties: int) -> ca.Callback:
        self.z = start
        return _IterationCallback(self, start.size, n_ties)

    def take(self, z: Array, objective: float) -> bool:
        """Take an iterate; whether to stop."""
        try:
            self.z = z
            self.curve.append(float(np.sqrt(max(objective, 0.0) / OBJECTIVE_SCALE)))
            if self.monitor is not None:
                self.monitor(len(self.curve) - 1, self.curve[-1])
        except BaseException as error:  # must not unwind through IPOPT; the caller raises it again
            self.stopped = error
        return self.stopped is not None


class _IterationCallback(ca.Callback):
    """CasADi's shape of an iteration callback."""

    def __init__(self, watch: Watch, n: int, n_ties: int) -> None:
        ca.Callback.__init__(self)
        self.watch = watch
        self.sizes = {"x": n, "f": 1, "g": n_ties, "lam_x": n, "lam_g": n_ties, "lam_p": 0}
        self.construct("iteration", {})

    def get_n_in(self) -> int:
        """Count the outputs of an nlpsol."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Give one flag."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Name an nlpsol output."""
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        """Name the flag."""
        return "stop"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shapes of the nlpsol outputs."""
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arg: list) -> list:
        """Hand the iterate on; a nonzero answer stops IPOPT."""
        return [int(self.watch.take(np.asarray(arg[0]).ravel(), float(arg[1])))]
