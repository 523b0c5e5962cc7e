"""The main path: one clock, check the records, fit modes, choose a strategy, run it, judge → `Identification`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sysid.assessment.checks.against_records import exchanged_sensors
from sysid.assessment.checks.gains import gain_errors
from sysid.assessment.checks.mistakes import check_records
from sysid.assessment.checks.model_error import changing
from sysid.errors import InputError, SolverError, Stop, finite_array, instance, path_of
from sysid.finding import Finding
from sysid.nlp import one_thread
from sysid.problem.prepared import Prepared, clocks_of
from sysid.problem.problem import Problem
from sysid.results.checkpoint import Checkpoint, identity
from sysid.results.identification import Identification
from sysid.results.judgement import judge, with_stated_masses
from sysid.search.auto import InTurn, check_local_phase, check_strategy, choose, robust_fit, within_tolerances
from sysid.search.session import DeferredInterrupt, Journal, Progress, Session, limits_of, listeners_of, seed_of
from sysid.search.strategy import DoesNotApplyError, NoStrategyError, Strategy
from sysid.structure.structure import Structure


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
    seed, random = seed_of(rng)
    instance("problem", problem, Problem)
    check_strategy(strategy, problem)
    if not isinstance(start, Structure | None):
        start = finite_array("start", start)
    max_time, max_evaluations = limits_of(max_time, max_evaluations)
    listeners = listeners_of(progress=progress, callback=callback)
    kept: contextlib.AbstractContextManager[Journal] = contextlib.nullcontext(Journal())
    if checkpoint is not None:
        if rng is None:
            raise InputError("checkpoint needs rng=: a search without a seed is another one each time")
        file = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(path_of("checkpoint", checkpoint))
        kept = file.journal(identity(problem, strategy, seed, start, max_evaluations))
    with one_thread(), DeferredInterrupt() as interrupt, kept as journal:
        session = Session(listeners, interrupt, max_time, random, max_evaluations, journal)
        clocks = clocks_of(problem)
        prepared = Prepared(problem, delays=[clock.delays for clock in clocks])
        with _telling_why(session, ()), session.fit_monitor() as monitor:
            named = check_records(prepared, clocks, monitor)
        with _telling_why(session, named):
            prepare(prepared, session)
        with _telling_why(session, named, prepared):
            chosen, why = choose(strategy, prepared, start)
            check_local_phase(prepared, chosen)
            follow = strategy == "auto" and not named
            in_turn = InTurn(prepared.screened, session, start, exchanged_sensors, follow)
            outcome, why = in_turn.run(chosen, why)
            prepared, outcome = within_tolerances(prepared, outcome, chosen, session, gain_errors)
            outcome = robust_fit(prepared, outcome, chosen, session)
            outcome = with_stated_masses(prepared.screened, outcome, session)
        outcome = replace(outcome, findings=(*named, *outcome.findings))
        result = judge(problem, prepared, outcome, f"strategy {why}", seed, session)
        if not isinstance(checkpoint, Checkpoint) and not result.interrupted:
            journal.entries.clear()  # so that the file goes
    return result


def prepare(problem: Prepared, session: Session) -> None:
    """Fit modes, find noise, poles and weights, and refuse what cannot be searched, under the session's clock."""
    try:
        with session.fit_monitor() as monitor:
            problem.fit_modes(monitor)
        if any(one.by_modes for one in problem.modal):
            session.finish()
        problem.prepare(session.preparing)
        if problem.stopped:  # perhaps while outliers were looked for
            session.finish()
        problem.check()
    except Stop as stop:
        raise SolverError(f"{stop}: nothing is identified") from None


@contextlib.contextmanager
def _telling_why(session: Session, named: tuple[Finding, ...], prepared: Prepared | None = None) -> Iterator[None]:
    """Tell of a search that came to nothing what mistakes explain it."""
    try:
        yield
    except Stop as stop:  # before there was any structure
        raise SolverError(f"{stop}: nothing is identified") from None
    except (InputError, SolverError) as error:
        if session.max_time is None:  # it has ended by itself, and would end so again
            session.journal.entries.clear()
        if prepared is not None and not named and isinstance(error, DoesNotApplyError | NoStrategyError):
            named = changing(prepared)  # more modes than there can be, of a structure that changes
        if named and isinstance(error, InputError):
            raise InputError("; ".join(map(str, (*named, error)))) from error
        raise
