"""The modal strategy: poles from the data, the fit in modal coordinates, modal masses by what is known, the structure.

No swarm and no start are needed: residues at given poles are a linear least-squares problem, a residue of rank one is
shape times participation, and what remains is the scale of each mode, its modal mass (`modal_masses`). As many
degrees of freedom as modes are chosen from the sensors; the other sensors follow by a recovery matrix, and where there
are more modes than sensors, modal coordinates stand beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, SolverError, Stop, refuse, sequence, whole_number
from sysid.finding import Finding
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_estimate import ModalEstimate, index_of, residual_of, theta_of
from sysid.modal_analysis.modal_fit import ModalFit, Modes, modes_in_band, modes_within, separate_poles, too_few
from sysid.modal_analysis.response import weighted_error
from sysid.modal_analysis.vector_fitting import Poles, poles_near
from sysid.models.spectrum import SOLVED
from sysid.models.stiffness_and_damping import FREQUENCY_WINDOW
from sysid.models.unknowns import lower_of, upper_of
from sysid.nlp import IterationMonitor, ended_in_words
from sysid.problem.matrices import assemble, blocks_of_modes
from sysid.problem.prepared import Prepared
from sysid.problem.stated import StatedProblem
from sysid.search.degrees_of_freedom import DegreesOfFreedom, degrees_of_freedom, sensors_by_name
from sysid.search.local import LocalResult, solve
from sysid.search.modal_program import End, Ties, fit_apart, free_spectrum, solve_modes
from sysid.search.session import Session
from sysid.search.stated_masses import modal_masses_of, positive_part, stated_totals, to_stated_totals
from sysid.search.strategy import DoesNotApplyError, History, Outcome, Phase, search_note
from sysid.structure.structure import Array, Structure
from sysid.structure.superelement import ResidualModes
from sysid.structure.thresholds import AS_GOOD, EXACT

Integers = NDArray[np.intp]

_AGREES = 0.01  # relative; a stated total that the base force weighs within this is held in the fit
_PLAIN = "; noise of the base and transients look like modes in plain spectra: take whole records (estimator='records')"


@dataclass(frozen=True)
class Modal:
    """Strategy "modal" with its settings.

    Parameters
    ----------
    sensors : sequence of str or int, optional
        Sensors (names, or numbers from 0) whose motions are the physical degrees of freedom where there are fewer modes
        than sensors, at most one a mode (modal coordinates make up the rest); chosen by a pivoted QR of the mode shapes
        where none are given. Mass, stiffness and damping matrices stand on them.
    max_iterations : int
        Of IPOPT, in each fit.
    modes : int, optional
        So many modes within the lines: of those that stand out of the noise, the ones that the records need most. What
        stands for modes beyond the lines is not counted. All by default.
    """

    sensors: Sequence[str | int] | None = None
    max_iterations: int = 200
    modes: int | None = None
    name: ClassVar[str] = "modal"

    def __post_init__(self) -> None:
        whole_number("Modal: max_iterations", self.max_iterations, at_least=1)
        if self.modes is not None:
            whole_number("Modal: modes", self.modes, at_least=1)
        for sensor in () if self.sensors is None else sequence("Modal: sensors", self.sensors, "a list of sensors"):
            if not isinstance(sensor, str):
                whole_number("Modal: a sensor", sensor, at_least=0)

    def check(self, problem: StatedProblem) -> None:
        """Refuse what a test cannot have, before anything is fitted.

        Sensors that are none of its, and other numbers of modes than its lines can hold or its model has.
        """
        test, count = problem.measurement, self.modes
        chosen = sensors_by_name(test, self.sensors or ())
        if count is None:
            return
        lines, (n, d) = np.count_nonzero(test.own_lines, axis=1), test.rigid_body.shape
        # A mode has a shape, participations and a pole; each pole takes two lines.
        most = int(min(2 * n * lines.sum() // (n + d + 1), (lines.max() - 1) // 2 * min(n, d)))
        mass, stated = problem.declared.mass, problem.frequencies.size
        formed = not mass.free or mass.entries is not None
        refuse(
            (count > most, f"Modal: modes={count}, and these {lines.max()} lines hold {most} at most"),
            (chosen.size > count, f"Modal: modes={count}, and {chosen.size} sensors are named as degrees of freedom"),
            (0 < stated < count, f"Modal: modes={count}, and SpectralStiffness states {stated} frequencies"),
            (formed and count != n, f"Modal: modes={count}; with this mass there are {n}, one a sensor"),
        )

    def refusal(self, problem: Prepared, start: ArrayLike | Structure | None) -> str | None:
        """Why poles and residues do not make the matrices, or a start that it would not read."""
        formulation, written = problem.formulation, "the problem is written in unknowns of its own"
        part, mass = formulation.parts.stiffness, formulation.mass
        reasons = (
            (not formulation.test_alone or formulation.healed or not formulation.geometry.at_sensors, written),
            (not formulation.stiffness.free and part.stop > part.start, "the stiffness has a form of its own"),
            (not formulation.stiffness.free or not (mass.free or mass.entries is not None), written),
            (not formulation.damping.free, "the damping has a form of its own"),
            (formulation.residual_modes and not problem.answers_in_band, "with this mass it fits no residual modes"),
            (start is not None, "a start was given"),
        )
        return next((why for applies, why in reasons if applies), None)

    def run(self, problem: Prepared, session: Session, start: ArrayLike | Structure | None) -> Outcome:
        """Modes from the data, and the structure that they make; a start is not read."""
        refusal = self.refusal(problem, None)
        if refusal:
            raise DoesNotApplyError(
                "strategy 'modal' needs a free stiffness (SpectralStiffness) and ModalDamping, and "
                f"{refusal}; 'auto' chooses another strategy"
            )
        return run_modal(problem, self, session)


def structure_of_modes(
    problem: Prepared, modes: Modes, remainder: Array, chosen: DegreesOfFreedom, *, to_totals: bool,
    residual: ResidualModes, coupling: Array | None = None, across: Array | None = None,
) -> Structure:  # fmt: skip
    """Structure of a modal model; `remainder` (d, d) is the rigid-body mass that no mode carries.

    Dampers have ``Phi' C Phi`` off its diagonal: `coupling` (m, m), rad/s; of residual modes `across` (r, m + r).
    With `to_totals` all modal masses take one factor, and the remainder what is left, so that stated totals are met.
    """
    P, G, groups = chosen.coordinates(problem, modes.phi)
    recovery = modes.phi @ P
    # Exact where a degree of freedom is a sensor.
    recovery[chosen.sensors] = np.eye(len(P))[: chosen.sensors.size]
    gamma = modes.gamma
    plain = chosen.modes.size == 0 and chosen.sensors.size == problem.geometry.n
    if to_totals:
        known = plain and bool(np.nansum(np.abs(problem.known_mass)) > 0)
        t, remainder = to_stated_totals(problem, P, gamma, G, groups, remainder, scaled=known)
        P, gamma, residual = P * np.sqrt(t), gamma * np.sqrt(t), residual.scaled(np.sqrt(t))
    if across is not None and np.any(across):
        residual = replace(residual, coupling=np.hstack([across[:, : len(P)] @ P, across[:, len(P) :]]))
    found = assemble(
        *blocks_of_modes(P, gamma, modes.omega, G, remainder), G, test=problem.measurement,
        ratios=modes.ratios if coupling is None else None, recovery=None if plain else recovery,
        damping=None if coupling is None else P.T @ (np.diag(2 * modes.ratios * modes.omega) + coupling) @ P,
    )  # fmt: skip
    return found.with_residual(residual)


def run_modal(problem: Prepared, options: Modal, session: Session) -> Outcome:
    """Modes from the data, and the structure that they make."""
    count = _modes_asked(problem, options)
    if fit_records_as_asked(problem, options, session.fit_monitor()):
        session.finish()
    monitor = IterationMonitor(session.reporter("local phase"), session.left)
    try:
        structure, end, chosen, poles = modal_structure(problem, options, monitor)
    except DoesNotApplyError:
        if monitor.stopped is None:
            raise
        if not isinstance(monitor.stopped, Stop | KeyboardInterrupt):
            raise monitor.stopped from None
        raise SolverError("stopped before there was a first fit: nothing is identified") from None
    session.log(
        f"{poles.omega.size} poles found in the data, {structure.n} modes: "
        + ", ".join(f"{f:.4g}" for f in structure.natural_frequencies)
        + f" Hz (free residues fit within {poles.residual:.2e})"
    )
    modal = problem.modal[0]
    unsettled, late = modal.by_modes and not modal.settled, monitor.is_over and bool(end.residual > EXACT)
    success = (end.status in SOLVED or end.residual <= EXACT) and not (unsettled or late)
    message = ended_in_words(end.status) + f"; ended on a bound: {end.bounds}" * bool(end.bounds)
    message += "; the fit of whole records did not settle: modes or noise still moved" * unsettled
    message += "; the time was over before every further fit was tried" * late
    answer = LocalResult(np.zeros(0), success, message, np.array(monitor.curve), monitor.stopped)
    notes = _left_out(problem, structure, count)
    # Ratios are no unknowns that tell dampers which couple modes.
    if structure.at_sensors and (structure.modal_damping or problem.formulation.beside):
        structure, answer = _in_unknowns(problem, structure, answer, monitor, session)
    elif problem.formulation.mass.free:
        if not structure.at_sensors:
            notes += (search_note(f"degrees of freedom are {', '.join(_coordinates(problem, chosen))}"),)
    else:
        plain = problem.measurement.sample_rate is not None
        raise DoesNotApplyError(
            f"{structure.n} modes stand out of the data of {problem.geometry.n} sensors: a lumped or known mass needs "
            f"as many modes as sensors in the lines; leave sensors out or widen the lines{_PLAIN * plain}"
        )
    x = answer.x if answer.x.size else None
    left = objective_of(problem, structure, x)
    phases = (Phase("local phase", left, answer.x, session.seconds, answer.curve.size),)
    history = History(local=left, local_curve=answer.curve, phases=phases)
    session.log(f"local phase: {answer.message}, {answer.curve.size} iterates, objective {history.local:.4e}")
    success, message, stopped = answer.success, answer.message, answer.stopped
    if stopped is not None:
        if not isinstance(stopped, Stop | KeyboardInterrupt):
            raise stopped
        success, message = False, str(stopped) or "interrupted"
    return Outcome(structure, x, options.name, success, message, history, stopped, findings=notes)


def fit_records_as_asked(problem: Prepared, options: Modal, monitor: AbstractContextManager[FitMonitor]) -> bool:
    """Fit whole records with the modes asked for and those that stand for all above; False where none are to be."""
    count = _modes_asked(problem, options)
    if not (problem.modal[0].by_modes and (count is not None or problem.answers_in_band)):
        return False
    poles_of(problem)  # a stated frequency that is none of the records' is told
    with monitor as watch:
        problem.fit_records(count, watch)
    return True


def _left_out(problem: Prepared, structure: Structure, count: int | None) -> tuple[Finding, ...]:
    """Poles within the lines that are none of the modes that were asked for."""
    found = problem.geometry.found
    if count is None or found is None:
        return ()
    ours, (first, last) = 2 * np.pi * structure.natural_frequencies, 2 * np.pi * problem.measurement.freq[[0, -1]]
    others = found.omega[~modes_within(found.omega, ours, ours) & (found.omega >= first) & (found.omega <= last)]
    if not others.size:
        return ()
    which = ", ".join(f"{w / (2 * np.pi):.5g}" for w in others)
    return (search_note(f"asked for {count} of the modes: what stands out of the data at {which} Hz too is left out"),)


def _in_unknowns(
    problem: Prepared, structure: Structure, end: LocalResult, monitor: IterationMonitor, session: Session
) -> tuple[Structure, LocalResult]:
    """The unknowns that stand for a structure; a mass that is not free is fitted as it stands from there."""
    if problem.free_modes:
        held = End(problem.values(structure), 0.0, "", "")
        return structure, replace(end, x=fit_apart(problem, held, monitor).x)
    if end.stopped is not None:
        return structure, end
    # The stated model holds the modes; from here it is fitted as it stands.
    answer = solve(
        problem, held_by_model(problem, structure), max_time=session.left,
        monitor=lambda i, objective: session.report("local phase", monitor.taken + i, 0, objective),
    )  # fmt: skip
    return problem.structure(answer.x), replace(answer, curve=np.concatenate([end.curve, answer.curve]))


def objective_of(problem: Prepared, structure: Structure, x: Array | None) -> float:
    """Objective at an answer; where modes are free from the structure alone, without any graph of the matrices."""
    if x is not None and not problem.free_modes:
        return problem.objective(x)
    left = weighted_error(problem.measurement, structure)
    return left if x is None else float(np.linalg.norm([left, *(term.error(x) for term in problem.formulation.beside)]))


def _coordinates(problem: Prepared, chosen: DegreesOfFreedom) -> list[str]:
    """Degrees of freedom, in words."""
    names = problem.measurement.sensor_names
    return [names[i] for i in chosen.sensors] + [f"the coordinate of mode {k + 1}" for k in chosen.modes]


def modal_structure(
    problem: Prepared, options: Modal, monitor: IterationMonitor
) -> tuple[Structure, ModalFit, DegreesOfFreedom, Poles]:
    """Structure that the data suggest without any search, and how it was fitted.

    With a lumped or known mass it is where the local phase in the unknowns starts; its modal masses come from the
    model. A `DoesNotApplyError` where a stated frequency is none of the data's, these do not suffice, or the modes are
    too much alike at the sensors.
    """
    test, mass = problem.measurement, problem.formulation.mass
    end, poles = _fitted(problem, options, monitor)
    # With all modes at the sensors totals are adjusted together with the other statements, afterwards.
    later = mass.weighs and end.modes.omega.size == test.n_sensors
    held = None if later else held_to_totals(problem, end, monitor, options.max_iterations)
    end = held or end
    modes, residual, coupling, across = _in_band(problem, end)
    count = _modes_asked(problem, options)
    if count is not None and count != modes.omega.size:
        raise DoesNotApplyError(too_few(modes.omega.size, count))
    chosen = degrees_of_freedom(problem, modes, options.sensors)
    remainder = positive_part(end.rigid - modes.gamma.T @ modes.gamma)
    if test.force is None:
        t = modal_masses_of(problem, modes, chosen)
        modes = modes._replace(phi=modes.phi / np.sqrt(t), gamma=modes.gamma * np.sqrt(t)[:, None])
        remainder = np.diag(problem.totals)
        residual = residual.without_mass(problem.totals)  # nothing weighs them
    # A stated total is kept, even where the base force weighs another, but not where it misses modes below the lines.
    kept = mass.totals is not None and held is None and not later and end.modes.omega.min() >= 2 * np.pi * test.freq[0]
    unmet = mass.free and (test.force is None or kept)
    try:
        structure = structure_of_modes(
            problem, modes, remainder, chosen, to_totals=unmet, residual=residual, coupling=coupling, across=across
        )  # fmt: skip
        return structure, end, chosen, poles
    except InputError as error:
        raise DoesNotApplyError(
            "the modes found are too much alike at the sensors, as where a sign, gain or axis in rigid_body is "
            f"wrong, or the responses are not absolute accelerations ({error})"
        ) from None


def _fitted(problem: Prepared, options: Modal, monitor: IterationMonitor) -> tuple[ModalFit, Poles]:
    """Where IPOPT ends from the estimate, and its poles: without the last above the lines where shapes are alike.

    Far above the lines they are so where they stand for something else, as a gain.
    """
    poles = poles_of(problem)
    while True:
        try:
            return ended(problem, _estimated(problem, poles, options, monitor), monitor, options.max_iterations), poles
        except SolverError as error:
            if problem.modal[0].of_records or poles.omega[-1] <= 2 * np.pi * problem.measurement.freq[-1]:
                raise DoesNotApplyError(f"{error}: use fewer modes, Modal(modes=), or narrow the band") from None
            poles = Poles(poles.omega[:-1], poles.ratios[:-1], poles.residual)


def _in_band(problem: Prepared, end: ModalFit) -> tuple[Modes, ResidualModes, Array | None, Array | None]:
    """The modes of the structure, those beyond the lines, which stand for all there, and couplings of both."""
    inside, others = _by_frequency(problem, end)
    beyond, static = end.modes.at(others), end.static if others.size else 0
    residual = ResidualModes(beyond.omega / (2 * np.pi), beyond.ratios, beyond.phi, beyond.gamma, static)
    return modes_in_band(end.modes.at(inside), residual, *_coupling(problem, end))


def _by_frequency(problem: Prepared, end: ModalFit) -> tuple[Integers, Integers]:
    """Numbers of the modes of the structure by frequency, as a fit may move one past another; and of residual ones."""
    inside, order = problem.of_structure(end.modes.omega), np.argsort(end.modes.omega, kind="stable")
    return order[inside[order]], np.flatnonzero(~inside)


def _coupling(problem: Prepared, end: ModalFit) -> tuple[Array | None, Array | None]:
    """Couplings by dampers where a fit ended: of the structure's modes, and of residual ones; None without."""
    modal = problem.modal[0]
    if modal.coupling is None:
        return None, None
    index, (inside, others) = index_of(modal), _by_frequency(problem, end)
    found = modal.coupling.about(theta_of(end.modes, end.rigid, index) - theta_of(modal.modes, modal.rigid, index))
    return found[np.ix_(inside, inside)], found[np.ix_(others, np.concatenate([inside, others]))]


def _modes_asked(problem: Prepared, options: Modal) -> int | None:
    """Number of modes of the structure that is asked for, by itself or by stated frequencies; None where it is open."""
    if options.modes is None and problem.answers_in_band and problem.stated.states_frequencies:
        return problem.stated.frequencies.size
    return options.modes


def _estimated(problem: Prepared, poles: Poles, options: Modal, monitor: IterationMonitor) -> ModalFit:
    """The modes of the records: fitted with the transients of whole ones, else to the lines, from poles close by."""
    modal = problem.modal[0]
    if not modal.by_modes:
        modal = problem.fit_lines(poles, _modes_asked(problem, options), monitor, options.max_iterations)
        if modal.fit is None:
            raise DoesNotApplyError(modal.lacking + _without_pole(problem, poles))
        return modal.fit
    residual = residual_of(modal, modal.modes)
    return ModalFit(modal.modes, modal.rigid, residual, residual, "not solved", "", static=modal.static)


def held_to_totals(problem: Prepared, end: ModalFit, monitor: IterationMonitor, max_iterations: int) -> ModalFit | None:
    """The same fit with stated totals held, where what the base force weighs agrees with them; else None."""
    ties, modes = stated_totals(problem), end.modes
    if ties is None or monitor.is_over:
        return None
    off = ca.vertcat(*ties(ca.DM(modes.phi), ca.DM(modes.gamma), ca.DM(end.rigid)))
    if np.any(np.abs(np.asarray(off)) > _AGREES):
        return None
    held = _again(problem, end, monitor, max_iterations, ties)
    agrees = held.residual <= AS_GOOD * end.residual + EXACT
    return held if agrees and held.status in SOLVED else None


def ended(problem: Prepared, estimate: ModalFit, monitor: IterationMonitor, max_iterations: int) -> ModalFit:
    """Where IPOPT ends from an estimate, with damping ratios within their bounds and no negative mass.

    The estimate itself where nobody wants to wait for it; a `SolverError` where shapes cannot be told apart.
    """
    within = _within_bounds(problem, estimate)
    if monitor.is_over or monitor.stopped is not None:
        return estimate
    # Bounds that nothing presses on would cost iterations, as IPOPT begins away from them.
    end = _again(problem, estimate, monitor, max_iterations, bounded=False) if within else estimate
    return end if within and _within_bounds(problem, end) else _again(problem, end, monitor, max_iterations)


def _within_bounds(problem: Prepared, end: ModalFit) -> bool:
    """True where all damping ratios are within the problem's bounds."""
    low, high = damping_bounds(problem)
    return bool(np.all((end.modes.ratios >= low) & (end.modes.ratios <= high)))


def damping_bounds(problem: Prepared) -> tuple[float, float]:
    """Bounds of the free damping ratios of a problem, those of all modes alike."""
    unknowns = problem.formulation.of_models[2]
    return float(lower_of(unknowns).min()), float(upper_of(unknowns).max())


def _again(
    problem: Prepared, end: ModalFit, monitor: IterationMonitor, max_iterations: int, ties: Ties | None = None,
    *, bounded: bool = True, far: float = 1.2,
) -> ModalFit:  # fmt: skip
    """A fit from where another ended, with ties, and damping ratios within the problem's bounds.

    The statistics of an estimate hold near it: where what they lead to misses `far` times as much of the records as it
    does, as with mass that a light mode cannot have, the lines tell.
    """
    modes = end.modes
    first, pole = separate_poles(modes)
    unit, bounds = np.sqrt(problem.totals), damping_bounds(problem) if bounded else (0.0, np.inf)
    # Poles beyond the lines mean nothing by themselves, and several may be next to exchangeable.
    held = ~problem.of_structure(modes.omega[first])
    solved = lambda modal: solve_modes(  # noqa: E731
        modal, modes, free_spectrum(modes.omega[first], modes.ratios[first], pole, *bounds, held=held),
        unit=unit, remainder=end.rigid - modes.gamma.T @ modes.gamma, ties=ties, weights=end.weights, monitor=monitor,
        max_iterations=max_iterations,
    )  # fmt: skip
    modal = problem.modal[0]
    found = solved(modal)
    near = not modal.of_records or modal.coupling is not None or monitor.is_over
    if not near and residual_of(modal, found.modes) > far * residual_of(modal, modal.modes) + EXACT:
        found = solved(ModalEstimate.of_lines(modal.records))
    return replace(found, static=end.static)


def held_by_model(problem: Prepared, structure: Structure) -> Array:
    """Unknowns (n_variables,) of a lumped or known mass with a model's poles and the shapes nearest to its own."""
    formulation = problem.formulation
    x = problem.values(structure)
    M_SS, M_S0, M_00, *_ = formulation.matrices.numbers(x)
    L = np.linalg.cholesky(M_SS)
    u, _, vt = np.linalg.svd(L.T @ structure.mode_shapes)
    root = L @ (u @ vt) * (2 * np.pi * structure.natural_frequencies)
    near = assemble(
        M_SS, M_S0, M_00, root @ root.T, problem.geometry.rigid_body, ratios=structure.damping_ratios,
        test=problem.measurement,
    )  # fmt: skip
    x[formulation.parts.stiffness] = formulation.models[1].values(problem.geometry, near)
    return x


def _without_pole(problem: Prepared, poles: Poles) -> str:
    """Stated frequencies that have no pole of their own, to be added to a refusal; nothing where none is."""
    stated, ends = 2 * np.pi * problem.stated.frequencies, 2 * np.pi * problem.measurement.freq[[0, -1]]
    lacking = stated[~modes_within(stated, ends, poles.omega, FREQUENCY_WINDOW)] / (2 * np.pi)
    each = ", ".join(f"{f:.5g}" for f in lacking)
    said = f": of the stated natural frequencies {each} Hz does not stand out, as the base may not move this mode"
    return said * bool(lacking.size)


def poles_of(problem: Prepared) -> Poles:
    """Poles of the data; for stated frequencies theirs, with those beyond the lines where the answer is in the band.

    Others are looked for where a mass of a form of its own is said to have more.
    """
    if problem.poles is not None:
        return problem.poles
    stated, test, in_band = problem.formulation.stiffness.spectrum, problem.measurement, problem.answers_in_band
    assert stated is not None
    try:
        found = None if stated.size == test.n_sensors and not in_band else problem.geometry.poles
    except InputError:  # too few lines to look for any
        if not in_band:
            raise
        found = None
    missed = [w for w in stated if found and np.min(np.abs(np.log(found.omega / w))) > np.log1p(FREQUENCY_WINDOW)]
    if found is None or (missed and in_band and not problem.modal[0].by_modes):
        try:
            return poles_near(test, stated, FREQUENCY_WINDOW)
        except InputError as error:
            raise DoesNotApplyError(str(error)) from error
    if missed:
        missing, others = (", ".join(f"{w / (2 * np.pi):.5g}" for w in omega) for omega in (missed, found.omega))
        raise DoesNotApplyError(
            f"of the stated natural frequencies {missing} Hz does not stand out of the data; found are {others} Hz"
        )
    first, last = 2 * np.pi * test.freq[[0, -1]]
    kept = problem.of_structure(found.omega) | (found.omega < first) | (found.omega > last)
    return Poles(found.omega[kept], found.ratios[kept], found.residual)
