"""The pipeline: global phase, eigenvalue refinement, local phase → `Identification`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from sysid.assessment.checks import doubts, written_doubts
from sysid.assessment.determination import written_determination
from sysid.assessment.modal_mass_cone import determination
from sysid.errors import InputError, SolverError
from sysid.models.damping import ModalDamping
from sysid.models.mass import FullMass
from sysid.models.spectrum import SOLVED
from sysid.models.stiffness import SpectralStiffness
from sysid.nlp import EXACT, Watch
from sysid.problem.problem import Problem
from sysid.results.identification import Identification
from sysid.search import local
from sysid.search.continuation import Continuation, by_continuation
from sysid.search.modal import Modal, NotModalError, held_by_model, modal_structure
from sysid.search.session import DeferredInterrupt, Desk, Progress, Stop
from sysid.search.strategy import History, Outcome
from sysid.search.swarm import Swarm, by_swarm
from sysid.structure.structure import Structure

_KNOWN = 0.1  # of the root of two diagonal entries; an entry with a larger standard deviation is not known
_LARGE = 4000  # entries of the mode shapes, beyond which the covariance takes minutes and gigabytes
_NO_FIT = 0.5  # relative residual above which nothing is explained
STRATEGIES = ("auto", "swarm", "modal", "continuation")


def identify(
    problem: Problem,
    *,
    strategy: str | Swarm | Modal | Continuation = "auto",
    rng: int | np.random.Generator | None = None,
    start: ArrayLike | Structure | None = None,
    max_time: float | None = None,
    max_evaluations: int | None = None,
    callback: Callable[[Progress], object] | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Identification:
    """Identify a structure.

    Parameters
    ----------
    problem : Problem
    strategy : str, Swarm, Modal or Continuation
        "modal" takes poles and residues from the data and polishes them in modal coordinates: no swarm, no
        frequencies needed, mostly within a second or two. "swarm" is the paper's hPSO-LS. "continuation" is for
        structured stiffness and whatever is written in expressions: gradients from the guess and from further starts,
        through responses whose peaks were widened. A `Modal`, `Swarm` or `Continuation` object is that with other
        settings. "auto" takes modal for a full, lumped or known mass with spectral stiffness and modal damping, else
        continuation where the stiffness has a form of its own or anything is written in expressions, else the swarm,
        and the swarm too where the one that was taken turns out not to apply or finds no good fit; the result's
        remarks say which and why.
    rng : int, numpy Generator or None
        The same seed gives the same bits. None draws one, which the result reports.
    start : array_like (n_variables,) or Structure, optional
        A guess that joins the first swarm, or takes the place of the variables' guesses; "auto" then takes no modal
        strategy.
    max_time : float, optional
        s; the swarm takes at most two thirds of it.
    max_evaluations : int, optional
        Candidates that the swarm may evaluate.
    callback : callable, optional
        Called with a `Progress` at each iteration; raising StopIteration ends the search, and the
        result holds the best until then.
    progress : callable, optional
        Called likewise, only to show: ``progress=print`` prints a line an iteration.

    Returns
    -------
    Identification
        Also where Ctrl-C stopped the search, with `interrupted` set.
    """
    options, why = options_of(strategy, problem, start)
    seed, random = _seed(rng)
    if max_time is not None and not max_time > 0:
        raise InputError(f"max_time = {max_time}: a positive number of seconds is needed")
    listeners = [f for f in (progress, callback) if f is not None]
    with threadpool_limits(limits=1), DeferredInterrupt() as interrupt:
        desk = Desk(listeners, interrupt, max_time)
        if isinstance(options, Modal):
            try:
                return _finish(problem, _by_modes(problem, options, desk), why, seed, desk)
            except NotModalError as error:
                if strategy != "auto":
                    raise
                why = f"strategy 'swarm': the modal one does not apply ({error})"
                desk.note(why)
                try:
                    end = by_swarm(problem, Swarm(), desk, random, start, max_evaluations)
                except InputError as other:
                    raise InputError(f"strategy 'modal' does not apply: {error}; nor does the swarm: {other}") from None
                return _finish(problem, end, why, seed, desk)
        desk.note(why)
        if isinstance(options, Continuation):
            end, misfit, good = by_continuation(problem, options, desk, random, start)
            if strategy == "auto" and not good and end.stopped is None and desk.time_for_more:
                why += f"; it left {misfit:.3g}, and a swarm followed"
                desk.note(why)
                end = _followed(problem, end, desk, random, start, max_evaluations)
            return _finish(problem, end, why, seed, desk)
        return _finish(problem, by_swarm(problem, options, desk, random, start, max_evaluations), why, seed, desk)


def _followed(
    problem: Problem, end: Outcome, desk: Desk, random: np.random.SeedSequence, start: ArrayLike | Structure | None,
    max_evaluations: int | None,
) -> Outcome:  # fmt: skip
    """The better of what a continuation found and what a swarm after it does; the first is never lost."""
    stopped: BaseException | None
    try:
        swarm = by_swarm(problem, Swarm(), desk, random, start, max_evaluations)
    except (InputError, SolverError) as error:
        desk.note(f"the swarm found nothing: {error}")
        return end
    except KeyboardInterrupt as interrupt:
        stopped = interrupt
    else:
        assert swarm.x is not None and end.x is not None
        if problem.rank_of(swarm.x) < problem.rank_of(end.x):
            return swarm
        stopped = swarm.stopped
    if stopped is None:
        return end
    return replace(end, success=False, message=str(stopped) or "interrupted", stopped=stopped)


def options_of(
    strategy: str | Swarm | Modal | Continuation, problem: Problem, start: ArrayLike | Structure | None
) -> tuple[Swarm | Modal | Continuation, str]:
    """Settings of the strategy that is taken, and why it is."""
    if isinstance(strategy, Swarm | Modal | Continuation):
        return strategy, f"strategy {type(strategy).__name__.lower()!r}, as asked"
    if strategy not in STRATEGIES:
        raise InputError(f"strategy {strategy!r} is unknown; give one of {', '.join(map(repr, STRATEGIES))}")
    if strategy != "auto":
        kinds = {"modal": Modal, "swarm": Swarm, "continuation": Continuation}
        return kinds[strategy](), f"strategy {strategy!r}, as asked"
    if problem.is_written:
        return Continuation(), "strategy 'continuation': the problem is written in unknowns of its own"
    if not isinstance(problem.stiffness, SpectralStiffness):
        return Continuation(), "strategy 'continuation': the stiffness has a form of its own"
    if not isinstance(problem.damping, ModalDamping):
        return Swarm(), "strategy 'swarm': the damping has a form of its own"
    if start is not None:
        return Swarm(), "strategy 'swarm': a start was given"
    return Modal(), "strategy 'modal': mass, spectral stiffness and modal damping follow from poles and residues"


def _by_modes(problem: Problem, options: Modal, desk: Desk) -> Outcome:
    """Modes from the data, and the structure that they make."""
    if problem.is_written or not (
        isinstance(problem.stiffness, SpectralStiffness) and isinstance(problem.damping, ModalDamping)
    ):
        raise NotModalError("strategy 'modal' needs SpectralStiffness and ModalDamping; use 'swarm' for this problem")
    watch = Watch(lambda i, cost: desk.tell("local phase", i, 0, cost), desk.left)
    try:
        structure, end, chosen, poles = modal_structure(problem, options, watch)
    except NotModalError:
        if watch.stopped is None:
            raise
        if not isinstance(watch.stopped, Stop | KeyboardInterrupt):
            raise watch.stopped from None
        raise SolverError("stopped before there was a first fit: nothing is identified") from None
    test, n = problem.measurement, problem.layout.n
    desk.note(
        f"{poles.omega.size} poles found in the data, {structure.n} modes: "
        + ", ".join(f"{f:.4g}" for f in structure.natural_frequencies)
        + f" Hz (free residues fit within {poles.residual:.2e})"
    )
    success, message, stopped = (
        end.status in SOLVED or end.residual <= EXACT,
        f"IPOPT: {end.status}",
        watch.stopped,
    )
    remarks = []
    x = None
    if structure.at_sensors:
        if isinstance(problem.mass, FullMass):
            x = problem.values(structure)
        elif stopped is None:
            # The stated model holds the modes; from here it is fitted as it stands.
            answer = local.solve(
                problem, held_by_model(problem, structure), max_time=desk.left,
                monitor=lambda i, cost: desk.tell("local phase", watch.taken + i, 0, cost),
            )  # fmt: skip
            watch.curve += answer.curve.tolist()
            x, success, message, stopped = answer.x, answer.success, answer.message, answer.stopped
            structure = problem.structure(x)
    elif not isinstance(problem.mass, FullMass):
        raise NotModalError(
            f"{structure.n} modes stand out of the data of {n} sensors: a lumped or known mass needs as many modes as "
            "sensors in the lines; leave sensors out or widen the lines"
        )
    else:
        names = test.sensor_names
        coordinates = [names[i] for i in chosen.sensors] + [f"the coordinate of mode {k + 1}" for k in chosen.modes]
        remarks.append(f"degrees of freedom are {', '.join(coordinates)}")
    history = replace(History(), local=_misfit(problem, structure), local_curve=np.array(watch.curve))
    desk.note(f"local phase: {message}, {len(watch.curve)} iterates, residual {history.local:.4e}")
    if stopped is not None:
        if not isinstance(stopped, Stop | KeyboardInterrupt):
            raise stopped
        success, message = False, str(stopped) or "interrupted"
    return Outcome(structure, x, "modal", success, message, history, stopped, tuple(remarks))


def _misfit(problem: Problem, structure: Structure) -> float:
    test = problem.measurement
    return float(np.hypot(test.residual(structure), test.force_residual(structure) or 0.0))


def _seed(rng: int | np.random.Generator | None) -> tuple[int, np.random.SeedSequence]:
    if isinstance(rng, np.random.Generator):
        seed = int(rng.integers(2**63))
    elif rng is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> 1)
    elif isinstance(rng, int | np.integer) and rng >= 0:
        seed = int(rng)
    else:
        raise InputError(f"rng = {rng!r}: a nonnegative integer, a numpy Generator or None is needed")
    return seed, np.random.SeedSequence(seed)


def _finish(problem: Problem, end: Outcome, why: str, seed: int, desk: Desk) -> Identification:
    """Judge where the search ended, and say what it is worth."""
    structure, success, message = end.structure, end.success, end.message
    residual = problem.measurement.residual(structure)
    if problem.is_written and end.x is not None:
        residual = problem.residual_of(end.x)
    if problem.is_written and end.x is not None:
        others = [test.residual(m.structure(end.x, test)) for test, m in problem.formulation.others]
        residual = max([residual, *others])
    if end.x is not None and success and not problem.keeps_constraints(end.x):
        success = False
        message += "; a constraint does not hold"
    if problem.goal is not None and residual > problem.goal:
        success = False
        message += f"; the residual {residual:.3g} is above the goal {problem.goal:.3g}"
    elif problem.goal is None and residual > _NO_FIT and end.stopped is None:
        success = False
        message += (
            f"; the residual {residual:.3g} is no fit: are the frequencies in Hz, the responses absolute and complex "
            "with exp(+iwt), the axes and signs of rigid_body right, the bounds wide enough?"
        )
    desk.note(f"done: residual {residual:.4e}, {message}")
    if problem.is_written:
        assert end.x is not None
        known = written_determination(problem, end.x, end.rivals)
        doubtful = written_doubts(problem, end.x) if end.stopped is None and success else ()
    else:
        known = determination(problem, structure)
        # What was stopped on its way has misfits of another kind.
        doubtful = doubts(problem, structure) if end.stopped is None else ()
    open_ = (*doubtful, *known.undetermined)
    if doubtful:
        message += "; " + "; ".join(doubtful)
    if not success:
        open_ = ("the search did not end in a fit, so this is not yet any structure that explains the data", *open_)
    remarks = (why, *end.remarks)
    if problem.is_written and end.x is not None:
        near = 1e-6 * (problem.upper - problem.lower)
        at = (end.x - problem.lower < near) | (problem.upper - end.x < near)
        names = [label for label, on in zip(problem.formulation.labels, at, strict=True) if on]
        if names:
            remarks += (f"on a bound of the search space, beyond which the truth may lie: {', '.join(names)}",)
    if problem.is_written and problem.formulation.misfit is not None:
        remarks += ("the problem states a misfit of its own; pictures and scores compare with the records as they are",)
    return _as_certain(
        Identification(
            structure=structure,
            problem=problem,
            x=end.x,
            strategy=end.strategy,
            seed=seed,
            success=success,
            message=message,
            history=replace(end.history, log=tuple(desk.log), wall_time=desk.seconds),
            determined=not open_,
            closed_by=() if open_ else known.closed_by,
            undetermined=open_,
            remarks=remarks,
            interrupted=isinstance(end.stopped, KeyboardInterrupt),
        )
    )


def _as_certain(it: Identification) -> Identification:
    """The same; not determined where noise leaves matrices open that are fixed without it.

    Null directions of exact records are closed by their noise, and show as large standard deviations only.
    """
    exact = max(it.residual, it.force_residual or 0.0) < EXACT
    if it.problem.is_written:
        assert it.x is not None
        # A further test may be noisy, and what is stated as known always is.
        exact = exact and it.problem.formulation.known is None and it.problem.misfit_of(it.x) < EXACT
    if not it.determined or exact:
        return it
    if it.structure.mode_shapes.size > _LARGE:
        told = "whether noise leaves each entry known was not judged, as that takes minutes: see uncertainty"
        return replace(it, remarks=(*it.remarks, told))
    s, u = it.structure, it.uncertainty
    n, open_ = s.n, []
    pairs = ("M_SS", s.mass[:n, :n], u.mass), ("K_SS", s.stiffness[:n, :n], u.stiffness), ("C", s.damping, u.damping)
    for name, matrix, std in pairs:
        size = np.sqrt(np.diag(matrix))
        size[size == 0] = max(size.max(), np.finfo(float).tiny)  # a degree of freedom without a damper
        relative = std / np.outer(size, size)
        if not np.all(relative <= _KNOWN):
            told = (
                "open" if np.any(np.isnan(relative)) else f"with standard deviations up to {100 * relative.max():.2g} %"
            )
            open_.append(f"noise leaves entries of {name} {told}")
    return replace(it, determined=False, closed_by=(), undetermined=tuple(open_)) if open_ else it
