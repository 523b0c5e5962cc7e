"""The strategies by their names, and "auto": the first that applies, and those after it while there is no good fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from numpy.typing import ArrayLike

from sysid.errors import InputError, SolverError
from sysid.finding import Finding
from sysid.problem.prepared import Prepared
from sysid.search.continuation import Continuation
from sysid.search.modal import Modal
from sysid.search.session import Session
from sysid.search.strategy import DoesNotApplyError, NoStrategyError, Outcome, Strategy
from sysid.search.swarm import Swarm
from sysid.structure.structure import Structure

STRATEGIES: tuple[type[Modal] | type[Continuation] | type[Swarm], ...] = (Modal, Continuation, Swarm)  # as "auto" goes
NAMED: dict[str, Callable[[], Strategy]] = {
    **{kind.name: kind for kind in STRATEGIES},
    "hpso-ls": Swarm.published,
}
NAMES = ", ".join(map(repr, ("auto", *NAMED)))

Start = ArrayLike | Structure | None


def check_strategy(strategy: str | Strategy) -> None:
    """Refuse what is no strategy, before anything is looked for."""
    if not isinstance(strategy, str | Modal | Continuation | Swarm):
        raise InputError(f"strategy is a {type(strategy).__name__}; give one of {NAMES}, or one with its settings")
    if isinstance(strategy, str) and strategy not in ("auto", *NAMED):
        raise InputError(f"strategy {strategy!r} is unknown; give one of {NAMES}")


def choose(strategy: str | Strategy, problem: Prepared, start: Start) -> tuple[Strategy, str]:
    """The strategy that is taken, and why it is."""
    check_strategy(strategy)
    if not isinstance(strategy, str):
        return strategy, f"{strategy.name!r}, as asked"
    if strategy in NAMED:
        return NAMED[strategy](), f"{strategy!r}, as asked"
    refusals: list[str] = []
    for kind in STRATEGIES:
        refusal = kind().refusal(problem, start)
        if refusal is None:
            why = refusals[0] if refusals else "mass, stiffness and modal damping follow from poles and residues"
            return kind(), f"{kind.name!r}: {why}"
        refusals.append(refusal)
    raise InputError(f"no strategy applies: {'; '.join(refusals)}")


class InTurn:
    """A strategy, and under "auto" those after it while there is no good fit.

    Parameters
    ----------
    problem : Prepared
        In squares.
    session : Session
    start : array_like, Structure or None
    mistakes : callable
        Of the problem and a poor outcome the mistakes that explain it, so that no other strategy would do better.
    follow : bool
        Whether others may follow.
    """

    def __init__(
        self, problem: Prepared, session: Session, start: Start,
        mistakes: Callable[[Prepared, Outcome], tuple[Finding, ...]], *, follow: bool,
    ) -> None:  # fmt: skip
        self.problem, self.session, self.start = problem, session, start
        self.mistakes, self.follow = mistakes, follow

    def run(self, chosen: Strategy, why: str) -> tuple[Outcome, str]:
        """Where the best ended, and why it was taken."""
        session = self.session
        session.log(f"strategy {why}")
        try:
            outcome = chosen.run(self.problem, session, self.start)
        except DoesNotApplyError as error:
            if not self.follow or isinstance(chosen, STRATEGIES[-1]):  # after which there is nothing else
                raise
            return self._instead(chosen, error)
        if not outcome.good and outcome.stopped is None and session.time_for_more:
            named = self.mistakes(self.problem, outcome)
            if named:
                return replace(outcome, findings=(*outcome.findings, *named)), why
        after = self._after(chosen) if self.follow and not (outcome.good or outcome.unanimous) else None
        if after is None or outcome.stopped is not None or not session.time_for_more:
            return outcome, why
        why += f"; it left {outcome.history.local:.3g}, and a {after.name} followed"
        try:
            return self._better(outcome, self.run(after, why)[0]), why
        except (InputError, SolverError) as error:
            session.log(f"the {after.name} found nothing: {error}")
        except KeyboardInterrupt as interrupt:
            outcome = replace(outcome, success=False, message="interrupted", stopped=interrupt)
        return outcome, why

    def _instead(self, chosen: Strategy, error: DoesNotApplyError) -> tuple[Outcome, str]:
        """Run what comes after a strategy that turned out not to apply."""
        after = self._after(chosen) or STRATEGIES[-1]()
        try:
            return self.run(after, f"{after.name!r}: the {chosen.name} one does not apply ({error})")
        except InputError as other:
            raise NoStrategyError(
                f"strategy {chosen.name!r} does not apply: {error}; nor does the {after.name}: {other}"
            ) from None

    def _after(self, chosen: Strategy) -> Strategy | None:
        """The next strategy that does not refuse the problem; None after the last."""
        names = [kind.name for kind in STRATEGIES]
        later = (kind() for kind in STRATEGIES[names.index(chosen.name) + 1 :])
        return next((strategy for strategy in later if strategy.refusal(self.problem, self.start) is None), None)

    def _better(self, first: Outcome, second: Outcome) -> Outcome:
        """The better of two outcomes; the first is never lost."""
        assert first.x is not None and second.x is not None
        if self.problem.rank_of(second.x) < self.problem.rank_of(first.x):
            return second
        if second.stopped is None:
            return first
        return replace(first, success=False, message=str(second.stopped) or "interrupted", stopped=second.stopped)
