"""``sysid show``: a problem in words and tables before anything is searched: its unknowns, and what the data determine.

Rank and null directions are those of the exact Jacobian of all that is fitted, each unknown counted in the unit that
IPOPT counts it in (`sysid.assessment.sensitivity`).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from sysid import catalogue
from sysid.assessment.determination import determine
from sysid.assessment.sensitivity import Sensitivity, directions_in_words, sensitivity, system_matrices
from sysid.cli.output import Output
from sysid.cli.read import tell_channels
from sysid.cli.requests import is_test, recipe_of
from sysid.cli.starting import SUCCESS
from sysid.errors import InputError, SysidError, listed, refuse
from sysid.files import recorded_test
from sysid.finding import MOST_OF_A_KIND
from sysid.identify import identify
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import states_noise
from sysid.models.unknowns import Unknown, scales_of, slices_of
from sysid.nlp import quiet_options
from sysid.problem.direct_response import Slopes, slopes_of
from sysid.problem.feasible import HELD
from sysid.problem.prepared import LOOSE, Prepared, points_of
from sysid.problem.problem import Problem
from sysid.results.identification import load
from sysid.results.storage import FILE_NAME
from sysid.results.summary import WIDTH
from sysid.results.tables import counted, in_columns
from sysid.search.auto import choose
from sysid.search.continuation import DRAWN
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF

_NOISE = 0.01  # of a record's rms, where no noise is stated
_ROOM = 1e-3  # of a constraint's scale, by which the point stays clear of inequalities


def run(options: argparse.Namespace, out: Output) -> int:
    """Tell of a problem; of a result or its folder the summary, of a test that ``sysid read`` wrote the channels."""
    file = options.problem
    folder = not catalogue.is_bundled(file) and os.path.isfile(f"{file}/{FILE_NAME}")  # noqa: PTH113 - as a long name
    if not (folder or is_test(file)):
        recipe = recipe_of(options, out, options.seed)
        problem = catalogue.build(recipe)
        if out.json:
            out.answer(**figures(problem, recipe.title))
        else:
            out.write(f"{show(problem, recipe.title)}\n")
        return SUCCESS
    of_problems = options.settings or options.data or options.seed is not None
    refuse((of_problems, f"{file}: --set, --data and --seed are for problems"))
    if not folder and recorded_test.is_recorded_test(file):
        tell_channels(recorded_test.load(file), out)
    else:
        result = load(file)
        out.write(f"{result.summary()}\n")
        out.answer(result=result.to_dict())
    return SUCCESS


def show(problem: Problem, name: str) -> str:
    """Describe a problem, and what its data determine, in lines of at most 120 columns.

    Its test and strategy; a table of its variables; the unknowns a matrix; their values, IPOPT's units and expected
    standard deviations at a point, which is the reference where the models can hold it, else what the modal strategy
    finds where that applies, else the guess; and the rank of the Jacobian there, with the directions that no record
    sees, in the problem's own names. Refused where the problem cannot be searched, or the Jacobian is finite at no
    point that was looked at.
    """
    prepared = problem.prepared
    prepared.check()
    judged = prepared.screened  # as a search judges them
    blocks = (_test(problem, name), _variables(problem), _unknowns(judged), _at(judged, _point(judged, problem)))
    return "\n\n".join("\n".join(_folded(line) for line in block) for block in blocks)


def figures(problem: Problem, name: str) -> dict[str, Any]:
    """Content of `show` for scripts: numbers, texts, and lists and dictionaries of them; errors as there."""
    problem.check()
    test, point = problem.measurement, _point(problem.prepared.screened, problem)
    known = point.known
    members = zip(problem.variables, slices_of(problem.variables), strict=True)
    return {
        "problem": name,
        "sensors": list(test.sensor_names),
        "base_axes": list(test.base_axes or ()),
        "strategy": choose("auto", problem.prepared, None)[0].name,
        "degrees_of_freedom": problem.geometry.n,
        "unknowns": problem.n_variables,
        "variables": [
            {"name": v.title, "unit": v.unit, "lower": np.min(v.lower), "upper": np.max(v.upper),
             "values": point.x[part].tolist(), "unseen": bool(np.any(np.abs(known.unseen[part]) > NEGLIGIBLE))}
            for v, part in members
        ],
        "point": point.where,
        "rank": known.rank,
        "directions": known.free.shape[1],
        "sentences": list(point.sentences),
    }  # fmt: skip


# -- what is given ------------------------------------------------------------------------------


def _test(problem: Problem, name: str) -> Iterator[str]:
    yield f"{name}: {_records(problem.measurement)}"
    for i, term in enumerate(problem.formulation.further_tests, start=1):
        yield f"further test {i}: {_records(term.test)}"
    stated = (
        (problem.reference is not None, "the reference is known"),
        (problem.validation, f"predicted and never fitted: {counted(len(problem.validation), 'test')}"),
        (problem.goal is not None, f"goal {problem.goal or 0:.3g}"),
        (problem.loss == "huber", "numbers far from the fit count little (Huber's loss)"),
    )
    known = [sentence for holds, sentence in stated if holds]
    yield "; ".join([f"degrees of freedom {problem.geometry.n}, unknowns {problem.n_variables}", *known])
    yield f"--strategy auto takes {choose('auto', problem.prepared, None)[1]}"


def _records(test: Measurement) -> str:
    names = test.sensor_names
    force = "no base force" if test.force is None else "with base force"
    noise = "noise stated" if states_noise(test) else "no noise stated"
    runs, axes = counted(test.n_runs, "run"), " ".join(test.base_axes or ())
    return (
        f"{counted(len(names), 'sensor')} ({listed(names)}), base moving along {axes}, {runs}, "
        f"{test.lines_in_words}, {force}, {noise}"
    )


def _variables(problem: Problem) -> Iterator[str]:
    """A line a variable; the models' own come with the model's name, those of the user with their declaration."""
    rows = [["variable", "shape", "unit", "lower", "upper", "guess", "scale", "declared"]]
    for model, group in zip(problem.models, problem.formulation.of_models, strict=True):
        rows += [_variable(unknown, type(model).__name__) for unknown in group]
    rows += [_variable(variable, variable.declared) for variable in problem.formulation.variables]
    yield from _table(rows)


def _variable(v: Unknown, declared: str) -> list[str]:
    shape = " x ".join(map(str, v.shape)) or "scalar"
    guess = _range(v.guess) + ("" if v.has_guess else " (middle)")
    scale = "fixed" if v.fixed else v.scale
    return [v.title, shape, v.unit or "-", _range(v.lower), _range(v.upper), guess, scale, declared]


def _unknowns(problem: Prepared) -> Iterator[str]:
    """Variables by matrix; a model counts its own, a written matrix all that enter it."""
    formulation = problem.formulation
    titles, counts = {v.name: f"{v.title} ({v.size})" for v in formulation.unknowns}, dict(problem.unknowns)
    labels = {"constraints": counted(formulation.constraints.lower.size, "constraint")}
    rows = [["enters", "unknowns", "variables"]]
    for name, members in formulation.members:
        rows.append([labels.get(name, name), str(counts[name]), ", ".join(titles[v] for v in members)])
    yield from _table(rows)
    if formulation.healed:
        yield "healing: the swarm's candidates are brought to what it states before they are judged"


# -- the point ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Point:
    """Unknowns, where they come from in words, and what the models say of the data there."""

    x: Array
    slopes: Slopes
    known: Sensitivity
    where: str
    sentences: tuple[str, ...] = ()
    at_guess: bool = False
    in_box: bool = False  # a point of the search space, the guess or another


def _point(problem: Prepared, stated: Problem) -> _Point:
    """The point at which the data are judged: the reference, what the modal strategy finds, or a guess."""
    sentences: tuple[str, ...] = ()
    found = _at_reference(problem)
    if found is None and choose("auto", problem, None)[0].name == "modal":
        found, sentences = _at_modes(problem, stated)
    return found or _at_guess(problem, sentences)


def _at_guess(problem: Prepared, sentences: tuple[str, ...]) -> _Point:
    """The guess, else the first of some points of the search space at which there are derivatives."""
    # A free stiffness has all its frequencies equal in the middle of its search space.
    free = problem.formulation.stiffness.free
    why = "as the guess has all frequencies equal" if free else "as the guess makes no structure with derivatives"
    names = ["the guess", *[f"a point of the search space, {why}"] * (DRAWN - 1)]
    guess = _first_judged(problem, names[:1], free)
    point = guess or _first_judged(problem, names, 1)
    if point is None:
        raise InputError(
            f"neither the guess nor any of {DRAWN - 1} points of the search space makes a structure with finite "
            "derivatives: state a guess, or tighter bounds"
        )
    return replace(point, sentences=sentences, at_guess=guess is not None, in_box=True)


def _first_judged(problem: Prepared, names: Sequence[str], start: int) -> _Point | None:
    """The first of the named points of the search space, from `start` on, at which there are derivatives."""
    for x, where in list(zip(points_of(problem.formulation), names, strict=False))[start:]:
        with contextlib.suppress(InputError, np.linalg.LinAlgError):
            return _judged(problem, *_feasible(problem, x, where))
    return None


def _feasible(problem: Prepared, x: Array, where: str) -> tuple[Array, str]:
    """The point next to `x` that keeps the constraints, clear of inequalities where it can be, and where that is."""
    constraints = problem.formulation.constraints
    # What each makes over the search space.
    scale = problem.tolerance / np.where(constraints.equal, LOOSE, HELD)
    lower, upper = constraints.lower / scale, constraints.upper / scale
    room = np.where(constraints.equal, 0.0, _ROOM)
    at = constraints.at(x) / scale
    if np.all((at <= upper - np.where(constraints.equal, -ROUND_OFF, _ROOM)) & (at >= lower - ROUND_OFF)):
        return x, where
    unit = scales_of(problem.variables, x)
    t = ca.MX.sym("t", x.size)
    broken = constraints.function(ca.DM(x) + ca.DM(unit) * t) / ca.DM(scale)
    solver = ca.nlpsol("feasible", "ipopt", {"x": t, "f": ca.sumsqr(t), "g": broken}, quiet_options(200))
    for margin in (room, 0.0):
        answer = solver(
            x0=0.0, lbx=(problem.lower - x) / unit, ubx=(problem.upper - x) / unit, lbg=lower, ubg=upper - margin
        )
        if solver.stats()["success"]:
            return x + unit * np.asarray(answer["x"]).ravel(), f"{where}, moved to where the constraints hold"
    return x, f"{where}, where the constraints do not hold"


def _judged(problem: Prepared, x: Array, where: str) -> _Point:
    with np.errstate(all="ignore"):  # what is not finite is passed over
        slopes = slopes_of(problem.formulation.matrices, x, problem.measurement)
        known = sensitivity(problem.formulation, x, slopes, as_stated=True)
    if not np.all(np.isfinite(known.singular_values)):
        raise np.linalg.LinAlgError("the Jacobian is not finite")
    return _Point(x, slopes, known, where)


def _at_reference(problem: Prepared) -> _Point | None:
    """The reference, where there is one that the models can hold or come near."""
    truth = problem.stated.reference
    if truth is None or not (truth.at_sensors and problem.geometry.at_sensors):
        return None
    try:
        x, where = _feasible(problem, problem.values(truth), "the reference")
        point = _judged(problem, x, where)
        said = determine(problem, truth, x)
    except (InputError, np.linalg.LinAlgError):
        return None
    if _differ(truth, point.slopes.structure):
        where = "what the models can hold of the reference, which is not all of it"
    return replace(point, where=where, sentences=(*said.closed_by, *said.undetermined))


def _differ(a: Structure, b: Structure) -> bool:
    pairs = ((a.mass, b.mass), (a.stiffness, b.stiffness), (a.damping, b.damping))
    return any(np.any(np.abs(A - B) > NEGLIGIBLE * (_sizes(A) + np.abs(A).max() * NEGLIGIBLE)) for A, B in pairs)


def _sizes(matrix: Array) -> Array:
    """Root of the product of the two diagonal entries of each entry, (n, n)."""
    root = np.sqrt(np.abs(np.diag(matrix))) + np.finfo(float).tiny
    return np.outer(root, root)


def _at_modes(problem: Prepared, stated: Problem) -> tuple[_Point | None, tuple[str, ...]]:
    """The modal strategy's answer to the data; only sentences where it has other degrees of freedom."""
    try:
        found = identify(stated, strategy="modal", rng=0)
    except SysidError:
        return None, ()
    sentences = (*found.closed_by, *found.undetermined)
    if found.x is None:
        return None, sentences
    point = _judged(problem, found.x, "what the modal strategy finds in the data")
    return replace(point, sentences=sentences), sentences


# -- what the data determine --------------------------------------------------------------------


def _at(problem: Prepared, point: _Point) -> Iterator[str]:
    """Values, units and expected errors; rank; what is not seen, and what is seen least."""
    known, count = point.known, point.x.size
    noise = "the stated noise" if _all_stated(problem) else f"{100 * _NOISE:g} % noise"
    moves = _moves(problem, point)
    free = known.free.shape[1]
    missed = problem.stated.reference is not None and point.in_box
    yield f"At {point.where}" + (" (the models cannot be inverted to the reference):" if missed else ":")
    yield from _values(problem, point, moves, noise)
    yield from _coordinates(problem)
    s = known.singular_values[: known.rank]
    if s.size:
        seen = ", without those of what no record sees" if known.unseen.shape[1] else ""
        yield (
            f"the scaled Jacobian of all that is fitted has singular values from {s[0]:.3g} to {s[-1]:.3g}{seen}: "
            f"condition number {s[0] / s[-1]:.3g}"
        )
    yield ""
    held = f" that active constraints leave of the {count} unknowns" if free < count else " of the unknowns"
    yield f"Rank: the records see {known.rank} of the {free} directions{held}"
    if known.unseen.shape[1]:
        yield from _unseen(problem, point)
    if moves.shape[1]:
        yield _seen_least(problem, point, moves, noise)
    if problem.formulation.mass.free and (np.any(np.isfinite(problem.known_mass)) or problem.rigid_total is not None):
        yield "  - what is stated of the mass beyond totals is held by the modal strategy, and not counted above"
    yield from (f"  - {sentence}" for sentence in point.sentences)


def _values(problem: Prepared, point: _Point, moves: Array, noise: str) -> Iterator[str]:
    """A line a variable: the largest error of its entries stands for all."""
    known, x = point.known, point.x
    std = np.linalg.norm(moves, axis=1)
    open_ = np.linalg.norm(known.unseen, axis=1) > NEGLIGIBLE
    relative = std / np.where(np.abs(x) > 1e-3 * known.unit, np.abs(x), np.nan)
    rows = [["variable", "value", "unit of IPOPT", f"standard deviation at {noise}"]]
    for v, part in zip(problem.variables, slices_of(problem.variables), strict=True):
        if np.any(open_[part]):
            error = "open" if np.all(open_[part]) else f"open in {np.count_nonzero(open_[part])} of {v.size}"
        elif np.all(np.isfinite(relative[part])):
            error = f"{100 * relative[part].max():.3g} %"
        else:
            error = f"{std[part].max():.3g} {v.unit}".rstrip()
        rows.append([v.title, _range(x[part]), "-" if problem.free_modes else _range(known.unit[part]), error])
    yield from _table(rows)


def _coordinates(problem: Prepared) -> Iterator[str]:
    """Coordinates that IPOPT has in the place of these unknowns, or beside them."""
    formulation = problem.formulation
    if problem.free_modes:
        yield (
            "IPOPT works in mode shapes, participations and the logarithms of frequencies and damping ratios, from "
            "which these unknowns follow; here each counts in units of its size, or 5 % of its range where that is more"
        )
    elif formulation.fits_records and formulation.by_ratios:
        held = ", which stand for the stiffness factor" if formulation.stiffness.free else ""
        yield f"IPOPT has mode shapes and frequencies as further unknowns{held}, as damping is by ratios"


def _unseen(problem: Prepared, point: _Point) -> Iterator[str]:
    """The null directions: what they change, and the shortest in words."""
    known, x = point.known, point.x
    words = sorted(directions_in_words(problem.variables, x, known.unit, known.unseen), key=len)
    of_blocks, base = _moved_matrices(point)
    left = len(words) - of_blocks - base
    kinds = (
        (of_blocks, f"along {of_blocks} mass, stiffness or damping change"),
        (base, f"along {base} only mass and coupling of the base change"),
        (left, f"along {left} nothing changes, as other values of the unknowns make the same structure there"),
    )
    changed = "; ".join(sentence for number, sentence in kinds if number)
    yield f"  - no record sees {counted(len(words), 'direction')}: {changed}"
    more = f" (the {MOST_OF_A_KIND} shortest of {len(words)})" if len(words) > MOST_OF_A_KIND else ""
    yield f"  - unseen{more}:"
    yield from (f"      {word}" for word in words[:MOST_OF_A_KIND])
    other = _first_judged(problem, ["another point of the search space"] * DRAWN, 1) if point.at_guess else None
    if other is not None and other.known.rank > known.rank:
        yield (
            "  - this point is special, by a symmetry for instance: at another point of the search space the records "
            f"see {other.known.rank} directions; state a guess off it"
        )


def _moved_matrices(point: _Point) -> tuple[int, int]:
    """Numbers of unseen directions that move M_SS, K_SS or C, and of the rest that move the base's blocks."""
    s, steps = point.slopes, point.known.unit[:, None] * point.known.unseen
    M, K, C = system_matrices(s.structure)

    def moved(slope: Array, size: Array) -> Array:
        return ((slope @ steps) / size[..., None]).reshape(-1, steps.shape[1])

    blocks = ((s.mass, M), (s.stiffness, K), (s.damping, C))
    of_blocks = np.concatenate([moved(slope, _sizes(A)) for slope, A in blocks])
    rigid = np.sqrt(np.abs(np.diag(s.structure.rigid_body_mass)))
    push = moved(s.d_push, np.sqrt(np.diag(M))[:, None] * rigid)
    base = np.concatenate([push, moved(s.d_rigid, np.outer(rigid, rigid))])
    rank = int(np.linalg.matrix_rank(of_blocks, tol=NEGLIGIBLE))
    return rank, int(np.linalg.matrix_rank(np.concatenate([of_blocks, base]), tol=NEGLIGIBLE)) - rank


def _seen_least(problem: Prepared, point: _Point, moves: Array, noise: str) -> str:
    """The direction of the largest variance, in units."""
    known = point.known
    U, s, _ = np.linalg.svd(moves / known.unit[:, None], full_matrices=False)
    words = directions_in_words(problem.variables, point.x, known.unit, U[:, :1])[0]
    size = 100 * s[0] * np.abs(U[:, 0]).max()  # words have the largest entry at 1 % of its unit
    return f"  - seen least: {words}; its standard deviation at {noise} is {size:.3g} times that"


def _moves(problem: Prepared, point: _Point) -> Array:
    """Moves of x that one standard normal of noise each makes, (p, rank); of 1 % noise where none is stated."""
    formulation, known = problem.formulation, point.known
    if not formulation.fits_records:
        # What stands in the place of the misfit is relative: its norm is 1 where nothing is explained.
        rows = formulation.terms[0].linearised(point.x, np.nan).residuals.size
        s = known.singular_values[: known.rank]
        return known.unit[:, None] * known.seen / s * (_NOISE / np.sqrt(rows))
    if _all_stated(problem):
        return known.normals
    noisy = problem.of_lines(_with_noise(one.records) for one in problem.modal)
    return sensitivity(noisy.formulation, point.x, point.slopes, as_stated=True).normals


def _all_stated(problem: Prepared) -> bool:
    """True where every record that is fitted states its noise."""
    formulation = problem.formulation
    return formulation.fits_records and all(states_noise(term.test) for term in formulation.tests)


def _with_noise(test: Measurement) -> Measurement:
    """The same with noise stated, as `simulate` makes it."""

    def std(record: ComplexArray, stated: Array | None) -> Array:
        return np.array(_NOISE * np.sqrt(np.mean(np.abs(record) ** 2))) if stated is None else stated

    force_std = None if test.force is None else std(test.force, test.force_std)
    return replace(test, response_std=std(test.response, test.response_std), force_std=force_std)


# -- lines --------------------------------------------------------------------------------------


def _range(values: Array) -> str:
    low, high = f"{np.min(values):.4g}", f"{np.max(values):.4g}"
    return low if low == high else f"{low} to {high}"


def _table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of a table, each cell in one line."""
    cells = [[" ".join(cell.split()) for cell in row] for row in rows]
    return (f"  {line}" for line in in_columns(cells, range(len(cells[0]))))


def _folded(line: str) -> str:
    """Fold a long line at the width of a terminal, the rest indented."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    return textwrap.fill(line, WIDTH, subsequent_indent=indent, break_on_hyphens=False)
