"""The comparison: every strategy of the package, then the peers with the budget of its swarm; its table."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.compare import peers
from sysid.compare.peers import MATRICES, MethodResult, Recorder, Status, errors_of, status_of
from sysid.errors import InputError, SolverError, refuse
from sysid.identify import identify, prepare
from sysid.nlp import one_thread
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.results.facts import seconds_in_words
from sysid.results.summary import folded
from sysid.results.tables import in_columns
from sysid.search.auto import NAMED, check_strategy
from sysid.search.modal import Modal
from sysid.search.session import DeferredInterrupt, Session
from sysid.search.strategy import DoesNotApplyError, Strategy
from sysid.search.swarm import Swarm


@dataclass(frozen=True, eq=False)
class Comparison:
    """Methods side by side on one problem.

    Attributes
    ----------
    problem : Problem
    seed : int
    max_time : float or None
        s, of each method.
    results : tuple of MethodResult
        In the order in which the methods ran.
    interrupted : bool
        Ctrl-C ended it, and `results` holds what there was until then.
    """

    problem: Problem
    seed: int
    max_time: float | None
    results: tuple[MethodResult, ...]
    interrupted: bool = False

    @property
    def quantity(self) -> str:
        """What is minimised: "residual" where the relative residual is all of it, else "objective"."""
        test = self.problem.measurement
        noise = test.is_whole or test.response_std is not None
        alone = not noise and test.force is None and len(self.problem.formulation.terms) == 1
        return "residual" if alone else "objective"

    @property
    def success(self) -> bool:
        """True where any method found a fit."""
        return any(result.status is Status.FIT for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as numbers, texts, lists and dictionaries."""
        rows = [
            {
                **result.to_dict(),
                "phases": [
                    {"phase": name, "seconds": curve[:, 0].tolist(), "objective": curve[:, 1].tolist()}
                    for name, curve in result.phases
                ],
            }
            for result in self.results
        ]
        settings = {name: getattr(self, name) for name in ("seed", "max_time", "interrupted", "quantity")}
        return {**settings, "unknowns": self.problem.n_variables, "methods": rows}


def compare(
    problem: Problem,
    *,
    rng: int = 0,
    max_time: float | None = None,
    modal: Modal | None = None,
    listener: Callable[[MethodResult], object] = lambda result: None,
) -> Comparison:
    """Run every strategy that applies, and the peers where the extra "benchmark" is installed.

    A peer has as many evaluations as the swarm took, searches what the swarm searches (the same objective, with the
    same refinement), and the same local phase follows. Without a time limit the same seed gives the same bits.

    Parameters
    ----------
    problem : Problem
    rng : int
        Seed of each strategy, as of `identify`; a peer's is drawn from it.
    max_time : float, optional
        s, of each method.
    modal : Modal, optional
        With the modes and sensors that are asked for.
    listener : callable
        Called with each method's result when it has ended.

    Returns
    -------
    Comparison
        Also where Ctrl-C ended it.

    Raises
    ------
    InputError
        Where no strategy applies, with the reason of each, or the problem cannot be searched.
    """
    loss = f"compare minimises squares, and the problem has loss={problem.loss!r}: leave it out"
    refuse((problem.loss != "squares", loss))
    modal = modal or Modal()
    check_strategy(modal, problem)
    results: list[MethodResult] = []
    try:
        for result in _results(problem, rng, max_time, modal):
            results.append(result)
            listener(result)
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        return Comparison(problem, rng, max_time, tuple(results), interrupted=True)
    return Comparison(problem, rng, max_time, tuple(results))


def _results(problem: Problem, rng: int, max_time: float | None, modal: Modal) -> Iterator[MethodResult]:
    """Run one method after the other."""
    with one_thread(), DeferredInterrupt() as interrupt:
        session = Session([], interrupt)
        prepared = Prepared(problem)
        prepare(prepared, session)
        strategies = {name: make() for name, make in NAMED.items()} | {modal.name: modal}
        refusals = {name: strategy.refusal(prepared, None) for name, strategy in strategies.items()}
        reasons = "; ".join(f"{name}: {why}" for name, why in refusals.items())
        refuse((all(refusals.values()), f"no strategy applies: {reasons}"))
        landscape = None if refusals[Swarm.name] else peers.Landscape.of(prepared, session)
        interrupt.check()
    most = 0
    for name, strategy in strategies.items():
        result = _strategy(strategy, refusals[name], problem, rng, max_time)
        yield replace(result, widened=result.widened or (landscape is not None and bool(landscape.steps)))
        most += result.evaluations * (name == Swarm.name)
    for number, name in enumerate(peers.names()):
        if landscape is None or most == 0:
            yield MethodResult(name, Status.REFUSED, "the swarm, whose objective and budget it takes, did not run")
            continue
        random = np.random.SeedSequence(rng, spawn_key=(number,))
        with one_thread(), DeferredInterrupt() as interrupt:
            recorder = Recorder()
            session = Session([recorder], interrupt, max_time, random)
            result = peers.run(name, landscape, most, session, recorder)
        yield result


def _strategy(
    strategy: Strategy, refusal: str | None, problem: Problem, rng: int, max_time: float | None
) -> MethodResult:
    """Run a strategy of the package, unless it refuses the problem."""
    if refusal is not None:
        return MethodResult(strategy.name, Status.REFUSED, refusal)
    recorder = Recorder()
    try:
        result = identify(problem, strategy=strategy, rng=rng, max_time=max_time, callback=recorder)
    except DoesNotApplyError as error:
        return MethodResult(strategy.name, Status.REFUSED, str(error))
    except (InputError, SolverError) as error:
        return MethodResult(strategy.name, Status.FAILED, str(error))
    history = result.history
    before = [value for value in (history.swarm, history.start) if np.isfinite(value)]
    return MethodResult(
        strategy.name,
        status_of(result.success, result.interrupted),
        result.message,
        before[0] if before else np.nan,
        result.objective,
        result.residual,
        errors_of(result.structure, problem.reference),
        history.evaluations,
        history.wall_time,
        recorder.phases,
        any(phase == "continuation" for phase, _ in recorder.phases),
    )


def comparison_text(comparison: Comparison) -> str:
    """Table for a terminal: a line a method, below it what the columns are, and why a method is no fit."""
    results = comparison.results
    columns = [
        ("method", [result.name for result in results]),
        ("before", [_number(result.before, ".2e") for result in results]),
        ("after", [_number(result.after, ".2e") for result in results]),
        *[("residual", [_number(result.residual, ".2e") for result in results])] * (comparison.quantity != "residual"),
        *[(f"{name}, %", [_number(result.errors[i], ".2g") for result in results]) for i, name in enumerate(MATRICES)]
        * (comparison.problem.reference is not None),
        ("evaluations", [_number(result.evaluations or np.nan, ",.0f") for result in results]),
        ("seconds", [_number(result.seconds, ".2f") for result in results]),
        ("status", [result.status.value for result in results]),
    ]
    rows = zip(*([head, *column] for head, column in columns), strict=True)
    return "\n".join([*in_columns(rows, (0, -1)), *_notes(comparison)])


def line(result: MethodResult) -> str:
    """One method in a line, as it has ended."""
    if not result.ran:
        return f"{result.name}: {result.status.value}"
    before = f"{_number(result.before, '.2e')} -> " if np.isfinite(result.before) else ""
    return f"{result.name}: {result.status.value}, {before}{result.after:.2e}, {seconds_in_words(result.seconds)}"


def as_csv(comparison: Comparison) -> str:
    """Rows of `MethodResult.to_dict`, below their names; empty cells for what is not known."""
    rows = [result.to_dict() for result in comparison.results]
    out = io.StringIO()
    writer = csv.DictWriter(out, list(MethodResult("", Status.FAILED).to_dict()), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value != value else value for name, value in row.items()} for row in rows)
    return out.getvalue()


def _notes(comparison: Comparison) -> Iterator[str]:
    """Meaning of the columns, and the words of the methods that are no fit."""
    what = {
        "residual": "relative residual",
        "objective": "objective (all that is fitted, weighed by its noise)",
    }[comparison.quantity]
    truth, errors = comparison.problem.reference, ""
    if truth is not None:
        undamped = ", which has no damping, so that C has no relative error" * (not np.any(truth.damping))
        errors = f"; M, K, C: error against the reference{undamped}"
    yield folded(f"before, after: {what} before and after the local phase{errors}")
    for result in comparison.results:
        if result.status is not Status.FIT:
            yield folded(f"  - {result.name}: {' '.join(result.message.split())}")


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "-"
