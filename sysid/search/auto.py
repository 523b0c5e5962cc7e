"""The strategies by their names, "auto", and what follows any of them: gains, and rounds of Huber's loss.

"auto" takes the first strategy that applies, and those after it while there is no good fit. Errors of gains that are
likely beside stated tolerances are read off its answer and taken off the records, which are fitted once more. Huber's
loss is least squares of pseudo-values, again and again from the last answer, until it stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, SolverError, Stop, refuse
from sysid.finding import Finding
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.outliers import HUBER, loss, whitened
from sysid.modal_analysis.response import predicted
from sysid.problem.prepared import Prepared
from sysid.problem.stated import StatedProblem
from sysid.search.continuation import Continuation
from sysid.search.local import solve
from sysid.search.modal import Modal, objective_of
from sysid.search.session import Session
from sysid.search.strategy import DoesNotApplyError, History, NoStrategyError, Outcome, Phase, Strategy
from sysid.search.swarm import Swarm
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import ROUND_OFF

STRATEGIES: tuple[type[Modal] | type[Continuation] | type[Swarm], ...] = (Modal, Continuation, Swarm)  # as "auto" goes
NAMED: dict[str, Callable[[], Strategy]] = {**{kind.name: kind for kind in STRATEGIES}, "hpso-ls": Swarm.published}
NAMES = ", ".join(map(repr, ("auto", *NAMED)))

Start = ArrayLike | Structure | None


def check_strategy(strategy: str | Strategy, problem: StatedProblem) -> None:
    """Refuse what is no strategy, or asks for modes or sensors that the problem's test cannot have, before any fit."""
    known, named = isinstance(strategy, Modal | Continuation | Swarm), isinstance(strategy, str)
    other = f"strategy is a {type(strategy).__name__}; give one of {NAMES}, or one with its settings"
    refuse(
        (not (known or named), other),
        (named and strategy not in ("auto", *NAMED), f"strategy {strategy!r} is unknown; give one of {NAMES}"),
    )
    if isinstance(strategy, Modal):
        strategy.check(problem)


def choose(strategy: str | Strategy, problem: Prepared, start: Start) -> tuple[Strategy, str]:
    """The strategy that is taken, and why it is."""
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


@dataclass(frozen=True)
class InTurn:
    """A strategy, and under "auto", where others may `follow`, those after it while there is no good fit.

    `mistakes` are those that explain a poor outcome, so that no other strategy would do better.
    """

    problem: Prepared  # in squares
    session: Session
    start: Start
    mistakes: Callable[[Prepared, Outcome], tuple[Finding, ...]]
    follow: bool

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
        except (InputError, SolverError) as other:
            kind = NoStrategyError if isinstance(other, InputError) else SolverError
            raise kind(
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


_GAINS = "gains within tolerances"  # the phase of the fit without their errors


class ShownGains(Protocol):
    """Errors of the sensors' gains against the base that a test shows, and their deviations, (n_sensors,)."""

    @property
    def error(self) -> Array:
        """NaN where none is shown."""

    @property
    def std(self) -> Array:
        """Likewise."""


def within_tolerances(
    problem: Prepared, end: Outcome, strategy: Strategy, session: Session,
    shown: Callable[[ModalEstimate, Structure], ShownGains], rounds: int = 4,
) -> tuple[Prepared, Outcome]:  # fmt: skip
    """The problem and where its search ended, without the errors of gains that spectra and tolerances make likely.

    Those of whole records were taken off with the fit of their modes. `shown` gives what a fit shows of gains: its
    poles hold what is wrong with them, so that a few rounds are needed where these are not free.
    """
    first, near = problem.modal, 0.1  # of its deviation, that an error still moves by
    for _ in range(rounds):
        if end.stopped is not None or problem.stopped or all(one.calibration is None for one in first):
            break
        modal, moved = list(first), 0.0
        for at, (one, its) in enumerate(problem.screened.fits(end.structure, end.x), start=problem.first_test - 1):
            if one.calibration is None or one.of_records:
                continue
            stated, found = first[at].calibration, shown(one, its)
            assert stated is not None
            likely = stated.given(one.records, found.error, found.std)
            modal[at] = first[at].without_errors(likely)
            std = np.sqrt(np.maximum(np.diag(likely.covariance), np.finfo(float).tiny))
            moved = max(moved, float(np.max(np.abs(likely.values - one.calibration.values) / std)))
        if moved < near:
            break
        try:
            other = Prepared(problem.stated, modal, in_squares=problem.in_squares)
            again = _fitted(other.screened, end, strategy, session)
        except (Stop, KeyboardInterrupt) as stop:
            return problem, _cut_short(end, str(stop) or "interrupted", stop)
        except (InputError, SolverError) as error:
            return problem, _cut_short(end, f"the fit without errors of gains came to nothing: {error}")
        end = _with_round(other.screened, replace(end, findings=again.findings), again, session, _GAINS)
        problem = other
    return problem, end


_SETTLED, _NEAR = 2e-3, 0.05  # standard deviations of the unknowns, root mean square: is settled, is as good


def robust_fit(problem: Prepared, end: Outcome, strategy: Strategy, session: Session, rounds: int = 40) -> Outcome:
    """Where Huber's loss is least, in so many rounds at most, from the answer to the screened records.

    The modal strategy fits each round anew; after all others the local phase goes on from the last unknowns. `end` is
    of a search in ``problem.screened``, and `strategy` has its settings, as far as it was its own.
    """
    if problem.in_squares or end.stopped is not None:
        return end
    if problem.stopped:
        return end.with_note("Huber's loss was not fitted, as the search for modes was stopped: squares were")
    moved, fitted = np.inf, problem.pseudo_values(end.structure, end.x)
    for number in range(1, rounds + 1):
        try:
            again = _fitted(fitted, end, strategy, session)
            if again.stopped is not None:
                raise again.stopped
            if end.strategy != Modal.name:
                again = _farther(problem, end, again)
            fitted = problem.pseudo_values(again.structure, again.x)
        except (Stop, KeyboardInterrupt) as stop:
            return _cut_short(end, str(stop) or "interrupted", stop)
        except (InputError, SolverError) as error:
            return _cut_short(end, f"round {number} of Huber's loss came to nothing: {error}")
        moved = _moved(fitted, end, again)
        session.log(f"round {number} of Huber's loss: {again.message}; the unknowns move by {moved:.2g} deviations")
        end = _with_round(problem.screened, end, again, session)
        if moved < _SETTLED:
            return end.with_note(f"Huber's loss settled after {number} rounds")
        if session.is_over:
            break
    sentence = f"Huber's loss did not settle in {number} rounds: the last moved by {moved:.2g} deviations"
    return end.with_note(sentence) if moved < _NEAR else _cut_short(end, sentence)


def check_local_phase(problem: Prepared, strategy: Strategy) -> None:
    """Refuse a swarm without its local phase, which would leave nothing to go on from."""
    if problem.stated.loss == "huber" and isinstance(strategy, Swarm) and strategy.local is None:
        raise InputError("loss='huber' is fitted by the local phase, and Swarm(local=None) has none")


def _with_round(problem: Prepared, end: Outcome, again: Outcome, session: Session, name: str = HUBER) -> Outcome:
    """A round's answer, with all that ran before it in its history; objectives are of the screened records."""
    left = objective_of(problem, again.structure, again.x)
    curve = np.concatenate([end.history.local_curve, again.history.local_curve])
    phases = [phase for phase in end.history.phases if phase.name != name]
    before = sum(phase.evaluations for phase in end.history.phases if phase.name == name)
    x = np.zeros(0) if again.x is None else again.x
    phases.append(Phase(name, left, x, session.seconds, before + again.history.local_curve.size))
    history = replace(end.history, local=left, local_curve=curve, phases=tuple(phases))
    return replace(again, findings=end.findings, history=history)


def _cut_short(end: Outcome, why: str, stopped: BaseException | None = None) -> Outcome:
    return replace(end, success=False, message=f"{end.message}; {why}", stopped=stopped)


def _fitted(problem: Prepared, end: Outcome, strategy: Strategy, session: Session) -> Outcome:
    """The answer to pseudo-values, from the last one."""
    if end.strategy == Modal.name:
        return (strategy if isinstance(strategy, Modal) else Modal()).run(problem, session, None)
    assert end.x is not None
    coordinates = (strategy.local if isinstance(strategy, Swarm) else None) or "modal"
    answer = solve(
        problem, end.x, max_time=session.left, monitor=session.reporter("local phase"), coordinates=coordinates
    )
    return replace(
        end, structure=problem.structure(answer.x), x=answer.x, success=answer.success, message=answer.message,
        history=History(local_curve=answer.curve), stopped=answer.stopped,
    )  # fmt: skip


def _farther(problem: Prepared, before: Outcome, after: Outcome) -> Outcome:
    """The answer, or one farther along its step, as far as the loss falls while steps double.

    Where most of what tells an unknown is still far off, each number pulls as little as an outlier.
    """
    assert before.x is not None and after.x is not None
    fits = problem.fits(after.structure, after.x)
    predictions = [(modal.records, predicted(modal.records, its)) for modal, its in fits]
    stds = [part.std for test, values in predictions for part in whitened(test, values, problem.n_variables)]

    def left(x: Array, structure: Structure) -> float:
        found = 0.0
        units = iter(stds)
        for modal, its in problem.fits(structure, x):
            test = modal.records
            records = [record for record in (test.relative, test.force) if record is not None]
            found += sum(loss((y - f) / next(units)) for y, f in zip(records, predicted(test, its), strict=True))
        return found

    best, step, times = left(after.x, after.structure), after.x - before.x, 2.0
    while times <= 64.0:  # steps that are doubled
        x = np.clip(before.x + times * step, np.minimum(problem.lower, after.x), np.maximum(problem.upper, after.x))
        try:
            structure = problem.structure(x)
        except InputError:
            break
        value = left(x, structure)
        if not value < best:
            break
        after, best, times = replace(after, x=x, structure=structure), value, 2 * times
    return after


def _moved(problem: Prepared, before: Outcome, after: Outcome) -> float:
    """Distance of two answers by what they make of the records, in standard deviations of an unknown; 0 where exact."""
    squares = change = size = 0.0
    fits = zip(problem.fits(before.structure, before.x), problem.fits(after.structure, after.x), strict=True)
    for (modal, one), (_, other) in fits:
        test = modal.records
        # Pseudo-values state the noise as it counts.
        stds = [std for std in (test.response_std, test.force_std) if std is not None]
        for a, b, std in zip(predicted(test, one), predicted(test, other), stds, strict=True):
            squares += 2 * float(np.sum(np.abs((a - b) / std) ** 2))
            change += float(np.sum(np.abs(a - b) ** 2))
            size += float(np.sum(np.abs(b) ** 2))
    return 0.0 if change <= ROUND_OFF**2 * size else float(np.sqrt(squares / problem.n_variables))
