"""The pipeline: choose a strategy, run it, judge what came out → `Identification`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sysid.assessment.checks import check_records
from sysid.assessment.checks.bounds import bounds_explain
from sysid.assessment.checks.changing import changing
from sysid.assessment.checks.exchanged import exchanged_sensors
from sysid.errors import InputError, SolverError, finite_array, function, instance, number, path_of, whole_number
from sysid.nlp import one_thread
from sysid.problem.problem import Problem
from sysid.results.checkpoint import Checkpoint, identity
from sysid.results.identification import Identification
from sysid.results.judgement import judge
from sysid.results.stated_masses import with_stated_masses
from sysid.search.continuation import Continuation
from sysid.search.journal import Journal
from sysid.search.modal import Modal
from sysid.search.robust import check, settled
from sysid.search.session import DeferredInterrupt, Progress, Session, Stop
from sysid.search.strategy import DoesNotApplyError, NoStrategyError, Outcome, Strategy
from sysid.search.swarm import Swarm
from sysid.structure.structure import Structure

STRATEGIES: tuple[type[Modal] | type[Continuation] | type[Swarm], ...] = (Modal, Continuation, Swarm)  # as "auto" goes
NAMED: dict[str, Callable[[], Strategy]] = {
    **{kind.name: kind for kind in STRATEGIES},
    "hpso-ls": Swarm.published,
}
NAMES = ", ".join(map(repr, ("auto", *NAMED)))


def identify(
    problem: Problem,
    *,
    strategy: str | Strategy = "auto",
    rng: int | np.random.Generator | None = None,
    start: ArrayLike | Structure | None = None,
    max_time: float | None = None,
    max_evaluations: int | None = None,
    callback: Callable[[Progress], object] | None = None,
    progress: Callable[[Progress], object] | None = None,
    checkpoint: str | Path | Checkpoint | None = None,
) -> Identification:
    """Identify a structure.

    Parameters
    ----------
    problem : Problem
    strategy : str, Swarm, Modal or Continuation
        "modal" takes poles and residues from the data and polishes them in modal coordinates: no swarm, no
        frequencies needed, mostly within a second or two. "hpso-ls" is the paper's algorithm (`Swarm.published`);
        "swarm" has constants of ours and ends in modal coordinates where mass and stiffness are free. "continuation" is
        for matrices with a form of their own: gradients from the guess and from further starts, through responses
        whose peaks were widened. A `Modal`, `Swarm` or `Continuation` object is that with other
        settings. "auto" takes the first of modal, continuation and swarm that applies, and the next where that one
        turns out not to apply or finds no good fit; the result's finding "strategy" says which and why.
    rng : int, numpy Generator or None
        The same seed gives the same bits. None draws one, which the result reports.
    start : array_like (n_variables,) or Structure, optional
        A guess that joins the first swarm, or takes the place of the variables' guesses; "auto" then takes no modal
        strategy.
    max_time : float, optional
        s; the swarm takes at most two thirds of it. It holds within a tenth or 2 s, whichever is more: what would not
        be done in time is not begun, and a judgement that takes too long is given up (in the main thread, under POSIX),
        which the result says.
    max_evaluations : int, optional
        Candidates that the swarm may evaluate.
    callback : callable, optional
        Called with a `Progress` at each iteration; raising StopIteration ends the search, and the
        result holds the best until then.
    progress : callable, optional
        Called likewise, only to show: ``progress=print`` prints a line an iteration.
    checkpoint : str, Path or Checkpoint, optional
        File in which the state of a swarm or a continuation is kept every few seconds, and at Ctrl-C. Where it is there
        of the same search (problem, strategy, `rng`), the search goes on from it, and ends with the bits that it would
        have ended with. A file given by its name is gone once the search has ended by itself. One search
        uses it at a time.

    Returns
    -------
    Identification
        Also where Ctrl-C stopped the search, with `interrupted` set.
    """
    seed, random = _seed(rng)
    instance("problem", problem, Problem)
    _check_strategy(strategy)
    if not isinstance(start, Structure | None):
        start = finite_array("start", start)
    if max_time is not None:
        max_time = number("max_time", max_time, "a positive number of seconds", above=0)
    if max_evaluations is not None:
        max_evaluations = whole_number("max_evaluations", max_evaluations, at_least=1)
    for name, given in (("callback", callback), ("progress", progress)):
        function(name, given)
    listeners = [listener for listener in (progress, callback) if listener is not None]
    kept: contextlib.AbstractContextManager[Journal] = contextlib.nullcontext(Journal())
    if checkpoint is not None:
        if rng is None:
            raise InputError("checkpoint needs rng=: a search without a seed is another one each time")
        file = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(path_of("checkpoint", checkpoint))
        kept = file.journal(identity(problem, strategy, seed, start, max_evaluations))
    with one_thread(), DeferredInterrupt() as interrupt, kept as journal:
        session = Session(listeners, interrupt, max_time, random, max_evaluations, journal)
        named = check_records(problem)
        try:
            prepare(problem, session)
            chosen, why = choose(strategy, problem, start)
            check(problem, chosen)
            outcome, why = _run(chosen, why, problem.screened, session, start, follow=strategy == "auto" and not named)
            outcome = settled(problem, outcome, chosen, session)
            outcome = with_stated_masses(problem.screened, outcome, session)
            outcome = replace(outcome, findings=(*named, *outcome.findings))
        except Stop as stop:  # before there was any structure
            raise SolverError(f"{stop}: nothing is identified") from None
        except (InputError, SolverError) as error:
            if max_time is None:  # it has ended by itself, and would end so again
                journal.entries.clear()
            # More modes than there can be, of a structure that changes.
            told = named or (changing(problem) if isinstance(error, DoesNotApplyError | NoStrategyError) else ())
            if told and isinstance(error, InputError):
                raise InputError("; ".join(map(str, (*told, error)))) from error
            raise
        result = judge(problem, outcome, f"strategy {why}", seed, session)
        if not isinstance(checkpoint, Checkpoint) and not result.interrupted:
            journal.entries.clear()  # so that the file goes
    return result


def prepare(problem: Problem, session: Session) -> None:
    """Find poles and weights, and refuse what cannot be searched, under the session's clock."""
    try:
        problem.prepare(session.preparing)
        problem.check()
    except Stop as stop:
        raise SolverError(f"{stop}: nothing is identified") from None


def choose(strategy: str | Strategy, problem: Problem, start: ArrayLike | Structure | None) -> tuple[Strategy, str]:
    """The strategy that is taken, and why it is."""
    _check_strategy(strategy)
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


def _check_strategy(strategy: str | Strategy) -> None:
    """Refuse what is no strategy, before anything is looked for."""
    if not isinstance(strategy, str | Modal | Continuation | Swarm):
        raise InputError(f"strategy is a {type(strategy).__name__}; give one of {NAMES}, or one with its settings")
    if isinstance(strategy, str) and strategy not in ("auto", *NAMED):
        raise InputError(f"strategy {strategy!r} is unknown; give one of {NAMES}")


def _run(
    chosen: Strategy, why: str, problem: Problem, session: Session, start: ArrayLike | Structure | None, follow: bool
) -> tuple[Outcome, str]:
    """Run a strategy, and under "auto" those after it while there is no good fit: the best."""
    session.log(f"strategy {why}")
    try:
        outcome = chosen.run(problem, session, start)
    except DoesNotApplyError as error:
        if not follow or isinstance(chosen, STRATEGIES[-1]):  # after which there is nothing else
            raise
        return _instead(chosen, error, problem, session, start)
    bad = not outcome.good and outcome.stopped is None and session.time_for_more
    if bad:
        pressed = bounds_explain(problem, outcome.structure, outcome.x)  # what they leave may look like swapped sensors
        told = exchanged_sensors(problem, outcome.structure, wholly=pressed)
        if told:
            return replace(outcome, findings=(*outcome.findings, *told)), why
    after = _after(chosen, problem, start) if follow and not (outcome.good or outcome.unanimous) else None
    if after is None or outcome.stopped is not None or not session.time_for_more:
        return outcome, why
    why += f"; it left {outcome.history.local:.3g}, and a {after.name} followed"
    try:
        return _better(problem, outcome, _run(after, why, problem, session, start, True)[0]), why
    except (InputError, SolverError) as error:
        session.log(f"the {after.name} found nothing: {error}")
    except KeyboardInterrupt as interrupt:
        outcome = replace(outcome, success=False, message="interrupted", stopped=interrupt)
    return outcome, why


def _instead(
    chosen: Strategy, error: DoesNotApplyError, problem: Problem, session: Session, start: ArrayLike | Structure | None
) -> tuple[Outcome, str]:
    """Run what comes after a strategy that turned out not to apply."""
    after = _after(chosen, problem, start) or STRATEGIES[-1]()
    why = f"{after.name!r}: the {chosen.name} one does not apply ({error})"
    try:
        return _run(after, why, problem, session, start, follow=True)
    except InputError as other:
        raise NoStrategyError(
            f"strategy {chosen.name!r} does not apply: {error}; nor does the {after.name}: {other}"
        ) from None


def _after(chosen: Strategy, problem: Problem, start: ArrayLike | Structure | None) -> Strategy | None:
    """The next strategy that does not refuse the problem; None after the last."""
    names = [kind.name for kind in STRATEGIES]
    later = (kind() for kind in STRATEGIES[names.index(chosen.name) + 1 :])
    return next((strategy for strategy in later if strategy.refusal(problem, start) is None), None)


def _better(problem: Problem, first: Outcome, second: Outcome) -> Outcome:
    """The better of two outcomes; the first is never lost."""
    assert first.x is not None and second.x is not None
    if problem.rank_of(second.x) < problem.rank_of(first.x):
        return second
    if second.stopped is None:
        return first
    return replace(first, success=False, message=str(second.stopped) or "interrupted", stopped=second.stopped)


def _seed(rng: int | np.random.Generator | None) -> tuple[int, np.random.SeedSequence]:
    """A seed to report, and the random source that it makes."""
    if isinstance(rng, np.random.Generator):
        seed = int(rng.integers(2**63))
    elif rng is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> 1)
    else:
        seed = whole_number("rng", rng, at_least=0)
    return seed, np.random.SeedSequence(seed)
