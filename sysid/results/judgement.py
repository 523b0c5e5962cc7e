"""The judgement of where a search ended, after its fit was adjusted to what is stated of masses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.assessment.checks import CHECKS, OF_THE_END, QUICK
from sysid.assessment.checks.context import Context, run
from sysid.assessment.checks.gains import rests_on
from sysid.assessment.determination import BY_RANK, determine
from sysid.assessment.information import Index
from sysid.assessment.sensitivity import KNOWN, largest_deviations
from sysid.assessment.statements import Adjusted, Statements, adjust, predict_statements, statements_of
from sysid.assessment.uncertainty import LARGE, moves_by_records
from sysid.errors import InputError, listed
from sysid.finding import Finding, Severity, cautions, contradicting, is_fit, weightiest_first
from sysid.modal_analysis.modal_estimate import theta_of
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.response import states_noise
from sysid.problem.matrices import assemble, blocks_of_modes
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.results.identification import Identification
from sysid.search.modal import objective_of
from sysid.search.other_answers import with_other_answers
from sysid.search.session import Session, TimeIsOver, within
from sysid.search.stated_masses import positive_part, to_stated_totals
from sysid.search.strategy import Outcome
from sysid.structure.amplitude import FittedLaw
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, FALSE_ALARM, LIKELY

_NOT_JUDGED = Finding(
    "not judged", Severity.CAUTION,
    "what data and model determine, and how far noise leaves it known, was not judged: the time or Ctrl-C ended it",
    "let it end, or give it more time (--max-time, max_time=)",
)  # fmt: skip


class Verdict(NamedTuple):
    """Verdict on where a search ended: a fit or why not, with what the solver says."""

    success: bool
    message: str


def _of_its_modes(laws: Sequence[FittedLaw], structure: Structure) -> list[FittedLaw]:
    """Those laws whose modes a structure has, one of each mode."""
    f = structure.natural_frequencies
    modes = {law.mode_among(f): law for law in laws if law.mode_among(f, followed=True) is not None}
    return [law for mode, law in modes.items() if mode is not None]


def judge(problem: Problem, prepared: Prepared, end: Outcome, why: str, seed: int, session: Session) -> Identification:
    """Judge where a search ended: `why` tells why its strategy was taken, the session has its log and clock."""
    try:
        end = replace(end, structure=end.structure.with_laws(prepared.laws))
    except InputError as error:
        left_out = f"laws of amplitude are left out of the structure: {error}"
        end = replace(end, structure=end.structure.with_laws(_of_its_modes(prepared.laws, end.structure)))
        end = replace(end, findings=(*end.findings, Finding("amplitude open", Severity.CAUTION, left_out)))
    context = Context(prepared, end, session.cut_short)
    verdict = verdict_of(context)
    session.log(f"done: {verdict.message}")
    try:
        with within(session.left):
            known = determine(prepared.screened, end.structure, end.x, end.alternatives)
            run(context, CHECKS)
        open_ = cautions(known.findings)
        if verdict.success and known.judged_by == BY_RANK and not (open_ or contradicting(context.found)):
            end = with_other_answers(prepared, end, session)
            with within(session.left):
                open_ = cautions(determine(prepared.screened, end.structure, end.x, end.alternatives).findings)
        closed = tuple(one for one in known.findings if one not in cautions(known.findings))
    except TimeIsOver:
        run(context, QUICK)
        open_, closed = (_NOT_JUDGED,), ()
    found = [*context.found, *end.findings, *open_]
    if not (contradicting(found) or cautions(found)):
        found = [*closed, *found]
    strategy, ending = Finding("strategy", Severity.NOTE, why), Finding("ending", Severity.NOTE, end.message)
    it = Identification(
        structure=end.structure,
        problem=problem,
        prepared=prepared,
        x=end.x,
        strategy=end.strategy,
        seed=seed,
        history=replace(end.history, log=tuple(session.lines), wall_time=session.seconds),
        findings=weightiest_first((strategy, *found, ending)),
        interrupted=session.interrupted or isinstance(end.stopped, KeyboardInterrupt),
    )
    try:
        with within(session.left):
            more = tuple(_check_precision(it))
            return it.with_findings(more) if more else it
    except TimeIsOver:
        return it.with_findings((_NOT_JUDGED,))


def verdict_of(context: Context) -> Verdict:
    """Judge where a search ended, by checks of the end of a search alone: a fit or not."""
    found, end = [one for check in OF_THE_END for one in check(context)], context.end
    wrong = [str(one) for one in contradicting(found) if one.kind not in ("stopped", "no solution")]
    # What the solver says stands first where it did not succeed, else last.
    return Verdict(is_fit(found), "; ".join((*wrong, end.message) if end.success else (end.message, *wrong)))


def _check_precision(it: Identification) -> Iterator[Finding]:
    """Entries that noise leaves open though they are fixed without it, and gains that what is determined rests on.

    Null directions of exact records are closed by their noise, and show as large standard deviations only.
    """
    if not it.determined:
        return
    exact = max(it.residual, it.force_residual or 0.0) < EXACT
    if it.x is not None and not it.prepared.free_modes:
        # A further test may be noisy, and what is stated as known always is.
        exact = exact and not it.prepared.formulation.priors and it.prepared.objective(it.x) < EXACT
    if exact:
        return
    if it.structure.mode_shapes.size > LARGE:
        sentence = "whether noise leaves each entry known was not judged, as that takes minutes: see uncertainty"
        yield Finding("noise not judged", Severity.NOTE, sentence)
        return
    u, open_ = it.uncertainty, False
    for name, largest in largest_deviations(it.structure, (u.mass, u.stiffness, u.damping)).items():
        if not largest <= KNOWN:
            up_to = "open" if np.isnan(largest) else f"with standard deviations up to {100 * largest:.2g} %"
            sentence, open_ = f"noise leaves entries of {name} {up_to}", True
            yield Finding("noise", Severity.CAUTION, sentence, numbers={"largest": largest})
    if not open_ and it.prepared.formulation.fits_records:
        yield from rests_on(it.measurement, it.gains, it.gain_worth)


def with_stated_masses(problem: Prepared, end: Outcome, session: Session) -> Outcome:
    """The fit adjusted to records and statements together, told of statements that contradict the rest."""
    if end.stopped is not None or statements_of(problem, end.structure) is None:
        return end
    try:
        with within(session.left):
            return _adjusted(problem, end)
    except TimeIsOver:
        late = "the time was over before stated masses were adjusted together with the records"
        return replace(end, success=False, message=f"{end.message}; {late}")


def _adjusted(problem: Prepared, end: Outcome) -> Outcome:
    first = end.structure
    stated = statements_of(problem, first)
    assert stated is not None
    modes, index, _, normals, *_ = moves_by_records(problem, first)
    if problem.measurement.response_std is None:
        least = EXACT / max(problem.measurement.residual(first), np.finfo(float).eps)
        normals = normals * max(1.0, least)
    theta = theta_of(modes, first.rigid_body_mass, index)
    best = adjust(problem, stated, theta, index, normals)
    said = tuple(_contradictions(problem, stated, best, theta, index, normals))
    try:
        structure = _structure(problem, first, theta, best.theta, index)
    except (InputError, np.linalg.LinAlgError):
        structure = None
    if structure is None or not best.holds:
        unmet = "the stated masses cannot all be met together with the records"
        said = said or (Finding("stated masses", Severity.CONTRADICTS, unmet),)
        return replace(end, findings=(*end.findings, *said))
    x = problem.values(structure)
    if end.x is not None:
        at = problem.formulation.parts.damping
        x[at] = np.clip(x[at], problem.lower[at], problem.upper[at])
        x[at.stop :] = end.x[at.stop :]
    history = replace(end.history, local=objective_of(problem, structure, x))
    return replace(end, structure=structure, x=x, history=history, findings=(*end.findings, *said))


def _structure(problem: Prepared, first: Structure, before: Array, after: Array, index: Index) -> Structure:
    """The structure of adjusted modal parameters; what was repeated in the first stays so."""
    phi, gamma, log_omega, log_ratios, rigid = (part[..., 0] for part in index.split(after[:, None]))
    _, _, omega_before, ratios_before, _ = (part[..., 0] for part in index.split(before[:, None]))
    omega = 2 * np.pi * first.natural_frequencies * np.exp(log_omega - omega_before)
    ratios = first.damping_ratios * np.exp(log_ratios - ratios_before)
    order = np.argsort(omega, kind="stable")
    end = Modes(phi, gamma, omega, ratios).at(order)
    geometry, P, G = problem.geometry, np.linalg.inv(end.phi), problem.geometry.rigid_body
    if problem.measurement.force is None:
        groups = geometry.directions[: geometry.n]
        remainder = np.diag(problem.totals)
        _, left = to_stated_totals(problem, P, end.gamma, G, groups, remainder, scaled=True)
    else:
        left = rigid - end.gamma.T @ end.gamma
        size = np.sqrt(np.diag(rigid))
        left = positive_part(left / np.outer(size, size)) * np.outer(size, size)
    loss = first.modal_damping_matrix[np.ix_(order, order)]
    loss = loss - np.diag(np.diag(loss)) + np.diag(2 * end.ratios * end.omega)
    return assemble(
        *blocks_of_modes(P, end.gamma, end.omega, G, left), G, ratios=end.ratios if first.modal_damping else None,
        damping=None if first.modal_damping else P.T @ loss @ P, test=problem.measurement,
    )  # fmt: skip


def _contradictions(
    problem: Prepared, stated: Statements, best: Adjusted, theta: Array, index: Index, normals: Array
) -> Iterator[Finding]:
    """Statements and records that disagree beyond chance, and which statements explain it."""
    numbers = _numbers(problem, index)
    chance = _chance(best, numbers)
    if chance >= FALSE_ALARM:
        return
    found = f"the stated masses cannot all be met together with the records (chance {chance:.1g})"
    explained: list[tuple[float, tuple[float, float], str]] = []
    for row in range(stated.values.size):
        without = adjust(problem, stated.without(row), theta, index, normals)
        if without.freedom == best.freedom or _chance(without, numbers) < FALSE_ALARM:
            continue
        value = (predict_statements(problem, stated, without.theta, index)[0] * stated.scale)[row]
        off = np.sqrt(max(best.misfit - without.misfit, 0.0))
        both = (float(stated.values[row]), float(value))
        explained.append((off, both, _in_words(problem, stated, row, value, off)))
    if explained:
        explained.sort(key=lambda one: -one[0])
        near = [words for off, _, words in explained if off**2 > explained[0][0] ** 2 - LIKELY**2]
        yield Finding(
            "stated masses", Severity.CONTRADICTS, f"{found}: {listed(near, '; or ')}",
            numbers={
                "chance": chance, "deviations": float(explained[0][0]), "stated": explained[0][1][0],
                "by the records": explained[0][1][1], "statements": float(len(near)),
            },
        )  # fmt: skip
        return
    factor = _common_factor(problem, stated, theta, index, normals)
    if factor > 0:
        scaled = stated._replace(values=factor * stated.values, std=factor * stated.std)
        if _chance(adjust(problem, scaled, theta, index, normals), numbers) >= FALSE_ALARM:
            yield Finding(
                "stated masses", Severity.CONTRADICTS, f"{found}; all of them would be met {factor:.4g} times as large",
                "is a unit or the force's gain wrong?", numbers={"chance": chance, "factor": factor},
            )  # fmt: skip
            return
    unexplained = f"{found}; no single one of them explains it"
    yield Finding("stated masses", Severity.CONTRADICTS, unexplained, numbers={"chance": chance})


def _common_factor(problem: Prepared, stated: Statements, theta: Array, index: Index, normals: Array) -> float:
    """By what all statements would be wrong in common, by what a base force weighs; zero where none was measured."""
    if problem.measurement.force is None:
        return 0.0
    values, slopes = predict_statements(problem, stated, theta, index)
    noise = slopes @ normals
    weight = np.linalg.pinv(noise @ noise.T, hermitian=True)
    given = stated.values / stated.scale
    return float(given @ weight @ values / (given @ weight @ given))


def _in_words(problem: Prepared, stated: Statements, row: int, value: float, off: float) -> str:
    test, n = problem.measurement, problem.geometry.n
    axes = test.base_axes or [f"base direction {i + 1}" for i in range(test.n_base)]
    given = stated.values[row]
    factor = f", {value / given:.4g} times as much" if given else ""
    if row < len(stated.entries):
        i, j = stated.entries[row]
        column = test.sensor_names[j] if j < n else f"base {axes[j - n]}"
        name = f"row {test.sensor_names[i]}, column {column}"
    else:
        i, j = stated.totals[row - len(stated.entries)]
        name = f"the total in {axes[i]}" if i == j else f"the rigid-body mass between {axes[i]} and {axes[j]}"
    return (
        f"{name} is stated as {given:.4g}, and the records with all other statements make it {value:.4g}{factor} "
        f"({off:.2g} deviations off)"
    )


def _numbers(problem: Prepared, index: Index) -> float:
    """Degrees of freedom of the records' own noise; infinite where it is stated."""
    test = problem.measurement
    return np.inf if states_noise(test) else float(max(2 * test.numbers - index.size, 1))


def _chance(found: Adjusted, numbers: float) -> float:
    """Probability of a misfit so large where all statements are right."""
    from scipy.special import chdtrc, fdtrc

    if found.freedom <= 0:
        return 1.0
    if np.isinf(numbers):
        return float(chdtrc(found.freedom, found.misfit))
    return float(fdtrc(found.freedom, numbers, found.misfit / found.freedom))
