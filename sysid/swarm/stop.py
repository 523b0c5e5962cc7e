"""Stop rules of a search, and the message at its end."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from sysid.errors import as_float, whole_number

from .particles import ParticleSwarm


class StopReason(Enum):
    """Why a search ended."""

    TARGET = "target"
    STALL = "stall"
    MAX_ITERATIONS = "max_iterations"
    MAX_EVALUATIONS = "max_evaluations"
    MAX_TIME = "max_time"
    CALLBACK = "callback"


@dataclass(frozen=True, kw_only=True)
class StopRules:
    """The stop rules of one search; see `minimize_swarm` for each.

    Raises
    ------
    InputError
        If a rule cannot be used.
    """

    max_iterations: int
    max_evaluations: int | None
    max_time: float | None
    target: float | None
    stall_iterations: int | None
    stall_tolerance: float

    def __post_init__(self) -> None:
        whole_number("max_iterations", self.max_iterations, at_least=1)
        if self.max_evaluations is not None:
            whole_number("max_evaluations", self.max_evaluations, at_least=1)
        if self.stall_iterations is not None:
            whole_number("stall_iterations", self.stall_iterations, at_least=1)
        if self.max_time is not None:
            as_float("max_time", self.max_time, "zero or more seconds, or None for no limit,", at_least=0, finite=False)
        if self.target is not None:
            as_float("target", self.target, "a number that a cost can reach, or None for no target,", finite=False)
        as_float("stall_tolerance", self.stall_tolerance, "a part of the cost, in [0, 1),", at_least=0, below=1)

    def room_for(self, n_rows: int, nfev: int) -> bool:
        """True where `n_rows` more rows may be evaluated after `nfev`."""
        return self.max_evaluations is None or nfev + n_rows <= self.max_evaluations

    def reason(self, swarm: ParticleSwarm, seconds: float) -> StopReason | None:
        """Return the first rule that ends the search after an iteration, or None to go on."""
        if self.target is not None and math.isfinite(swarm.best_cost) and swarm.best_cost <= self.target:
            return StopReason.TARGET
        if self.stall_iterations is not None and stalled(swarm.history, self.stall_iterations, self.stall_tolerance):
            return StopReason.STALL
        if swarm.nit >= self.max_iterations:
            return StopReason.MAX_ITERATIONS
        if self.max_time is not None and seconds >= self.max_time:
            return StopReason.MAX_TIME
        return None

    def message(self, reason: StopReason, swarm: ParticleSwarm) -> str:
        """Message that says why the search ended, and what to do next."""
        if math.isinf(swarm.best_cost):
            return (
                f"None of the {swarm.nfev} costs was finite: evaluate fun at a point that should work, "
                "and narrow the bounds to where it is defined."
            )
        happened = {
            StopReason.TARGET: f"Reached the target {self.target}.",
            StopReason.STALL: (
                f"The best cost has not fallen by more than {self.stall_tolerance} of itself in "
                f"{self.stall_iterations} iterations: refine x locally, or start again with another rng "
                "or more particles."
            ),
            StopReason.MAX_ITERATIONS: (
                f"Spent max_iterations = {self.max_iterations}: if the history still falls, raise it, "
                "or refine x locally."
            ),
            StopReason.MAX_EVALUATIONS: (
                f"Spent max_evaluations = {self.max_evaluations}, as far as whole iterations fit: if the history "
                "still falls, raise it, or refine x locally."
            ),
            StopReason.MAX_TIME: (
                f"Spent max_time = {self.max_time} s: if the history still falls, raise it, or refine x locally."
            ),
            StopReason.CALLBACK: "The callback stopped the search; x is the best point until then.",
        }[reason]
        if self.target is not None and reason is not StopReason.TARGET:
            happened += f" The target {self.target} was not reached; the best cost is {swarm.best_cost:.6g}."
        return happened


def stalled(history: list[float], iterations: int, tolerance: float) -> bool:
    """True where the best cost fell by no more than `tolerance` times itself over the last `iterations`."""
    if len(history) <= iterations:
        return False
    before, now = history[-1 - iterations], history[-1]
    if math.isinf(before):
        return math.isinf(now)
    return before - now <= tolerance * abs(before)
