"""``sysid show``: a problem in words and tables before anything is searched: its unknowns, and what the data determine.

Rank and null directions are those of the exact Jacobian of all that is fitted, each unknown counted in the unit that
IPOPT counts it in (`sysid.sensitivity`).
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sysid.assessment.modal_mass_cone import determination
from sysid.assessment.sensitivity import Sensitivity, Slopes, directions_in_words, sensitivity, slopes_of
from sysid.errors import InputError, SysidError
from sysid.identify import Modal, identify, options_of
from sysid.measurement.measurement import Measurement
from sysid.models.mass import FullMass
from sysid.models.stiffness import SpectralStiffness
from sysid.models.unknowns import Block, Variable, steps_of
from sysid.problem.blocks import Misfit
from sysid.problem.feasibility import points_of, scale_of
from sysid.problem.formulation import Formulation, guess_of, sampled
from sysid.problem.problem import Problem
from sysid.search.local_structured import needs_modes, unit_of
from sysid.structure.structure import Array, ComplexArray, Structure

_WIDTH = 120
_NOISE = 0.01  # of a record's rms, where no noise is stated
_SHORTEST = 3  # null directions that are told in full where there are more
_TRIED = 20  # points of the search space looked at for one that makes a structure
_SAME = 1e-6  # of the root of two diagonals: matrices that differ by less are the same
_ROOM = 1e-3  # of a constraint's scale, by which the point stays clear of inequalities
_HELD = 1e-9  # of it, to which the point keeps equalities
_TOUCHED = 1e-6  # of its unit, by which an unseen step of order one moves an unknown that it leaves open


def show(problem: Problem, name: str) -> str:
    """What a problem is, and what its data determine, in lines of at most 120 columns.

    Parameters
    ----------
    problem : Problem
    name : str
        As the first line calls it.

    Returns
    -------
    str
        Its test and strategy; a table of its variables; the unknowns a matrix; their values, IPOPT's units and
        expected standard deviations at a point, which is the reference where the models can hold it, else what the
        modal strategy finds where that applies, else the guess; and the rank of the Jacobian there, with the
        directions that no record sees, in the problem's own names.

    Raises
    ------
    InputError
        Where no point of the search space makes a structure, or the Jacobian there is not finite.
    """
    point = _point(problem)
    blocks = (_test(problem, name), _variables(problem), _unknowns(problem), _at(problem, point))
    return "\n\n".join("\n".join(_folded(line) for line in block) for block in blocks)


# -- what is given ------------------------------------------------------------------------------


def _test(problem: Problem, name: str) -> Iterator[str]:
    yield f"{name}: {_records(problem.measurement)}"
    for i, (test, _) in enumerate(problem.formulation.others, start=1):
        yield f"further test {i}: {_records(test)}"
    n = len(problem.formulation.matrices.rigid_body_dofs)
    known = ["the reference is known"] if problem.reference is not None else []
    known += [f"predicted and never fitted: {_count(len(problem.validation), 'test')}"] if problem.validation else []
    known += [f"goal {problem.goal:.3g}"] if problem.goal is not None else []
    yield "; ".join([f"degrees of freedom {n}, unknowns {problem.n_variables}", *known])
    yield f"--strategy auto takes {options_of('auto', problem, None)[1].removeprefix('strategy ')}"


def _records(test: Measurement) -> str:
    names = test.sensor_names
    sensors = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    force = "no base force" if test.force is None else "with base force"
    noise = "noise stated" if _noise_is_stated(test) else "no noise stated"
    runs, axes = _count(test.n_runs, "run"), " ".join(test.base_axes or ())
    return (
        f"{_count(len(names), 'sensor')} ({sensors}), base moving along {axes}, {runs}, {test.freq.size} lines from "
        f"{test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz, {force}, {noise}"
    )


def _variables(problem: Problem) -> Iterator[str]:
    rows = [["variable", "shape", "unit", "lower", "upper", "guess", "scale", "declared"]]
    formulation = problem.formulation
    for v in (*formulation.variables, *formulation.fixed):
        if isinstance(v, Variable):
            shape, told = " x ".join(map(str, v.shape)) or "scalar", v.has_guess
            scale, declared = "fixed" if v.fixed else _scale(v), v.declared
        else:
            shape, told, scale, declared = str(v.size), False, _scale(v), _model(problem, v)
        guess = _range(guess_of(v)) + ("" if told else " (middle)")
        rows.append([v.name, shape, v.unit or "-", _range(v.lower), _range(v.upper), guess, scale, declared])
    yield from _table(rows)


def _scale(variable: Block | Variable) -> str:
    """How the swarm spreads its candidates over the bounds."""
    if variable.sampling is None:
        return "linear"
    middle, product = sampled(variable, (variable.lower + variable.upper) / 2), variable.lower * variable.upper
    return "log" if np.all(product > 0) and np.allclose(middle, np.sqrt(np.abs(product))) else "by row"


def _model(problem: Problem, block: Block) -> str:
    """The matrix model that a block of unknowns belongs to: of the first matrix that has it."""
    models = {"mass": problem.mass, "stiffness": problem.stiffness, "damping": problem.damping}
    matrix = next(name for name, members in problem.formulation.members if block.name in members)
    return type(models[matrix]).__name__


def _unknowns(problem: Problem) -> Iterator[str]:
    """Variables by matrix; a model counts its own, a written matrix all that enter it."""
    formulation = problem.formulation
    sizes, counts = {v.name: v.size for v in formulation.variables}, dict(problem.unknowns)
    rows = [["enters", "unknowns", "variables"]]
    starts = np.cumsum([0, *(v.size for v in formulation.variables)])
    for name, members in formulation.members:
        if not problem.is_written:
            at = getattr(problem.parts, name)
            members = tuple(
                v.name for v, i in zip(formulation.variables, starts, strict=False) if at.start <= i < at.stop
            )
        label = name
        if name == "constraints" and formulation.constraints is not None:
            label = _count(formulation.constraints.lower.size, "constraint")
        rows.append([label, str(counts[name]), ", ".join(f"{v} ({sizes[v]})" for v in members)])
    yield from _table(rows)
    if formulation.healing is not None:
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


def _point(problem: Problem) -> _Point:
    """The point at which the data are judged."""
    sentences: tuple[str, ...] = ()
    if not problem.is_written:
        found = _at_reference(problem)
        if found is None and isinstance(options_of("auto", problem, None)[0], Modal):
            found, sentences = _at_modes(problem)
        if found is not None:
            return found
    formulation = problem.formulation
    guess, *others = points_of(formulation)[:_TRIED]
    # A spectral stiffness has all its frequencies equal in the middle of its search space.
    spectral = isinstance(problem.stiffness, SpectralStiffness)
    why = "as the guess has all frequencies equal" if spectral else "as the guess makes no structure with derivatives"
    for i, x in list(enumerate((guess, *others)))[spectral:]:
        where = "the guess" if i == 0 else f"a point of the search space, {why}"
        try:
            return _judged(problem, *_feasible(problem, x, where), sentences)
        except (InputError, np.linalg.LinAlgError):
            continue
    raise InputError(
        f"neither the guess nor any of {_TRIED - 1} points of the search space makes a structure with finite "
        "derivatives: state a guess, or tighter bounds"
    )


def _feasible(problem: Problem, x: Array, where: str) -> tuple[Array, str]:
    """The point next to `x` that keeps the constraints, clear of inequalities where it can be, and where that is."""
    formulation = problem.formulation
    constraints = formulation.constraints
    if constraints is None:
        return x, where
    scale = scale_of(formulation, points_of(formulation))
    lower, upper = constraints.lower / scale, constraints.upper / scale
    room = np.where(lower < upper, _ROOM, 0.0)
    at = np.asarray(constraints.function(x)).ravel() / scale
    if np.all((at <= upper - np.where(room > 0, room, -_HELD)) & (at >= lower - _HELD)):
        return x, where
    unit = steps_of(problem.variables, x)
    t = ca.MX.sym("t", x.size)
    broken = constraints.function(ca.DM(x) + ca.DM(unit) * t) / ca.DM(scale)
    solver = ca.nlpsol(
        "feasible", "ipopt", {"x": t, "f": ca.sumsqr(t), "g": broken},
        {"print_time": False, "show_eval_warnings": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 200}},
    )  # fmt: skip
    for margin in (room, 0.0):
        answer = solver(
            x0=0.0, lbx=(problem.lower - x) / unit, ubx=(problem.upper - x) / unit, lbg=lower, ubg=upper - margin
        )
        if solver.stats()["success"]:
            return x + unit * np.asarray(answer["x"]).ravel(), f"{where}, moved to where the constraints hold"
    return x, f"{where}, where the constraints do not hold"


def _judged(problem: Problem, x: Array, where: str, sentences: tuple[str, ...] = ()) -> _Point:
    with np.errstate(all="ignore"):  # what is not finite is passed over
        slopes = slopes_of(problem.formulation.matrices, x, problem.measurement)
        known = sensitivity(problem, x, slopes, as_stated=True)
    if not np.all(np.isfinite(known.singular_values)):
        raise np.linalg.LinAlgError("the Jacobian is not finite")
    return _Point(x, slopes, known, where, sentences)


def _at_reference(problem: Problem) -> _Point | None:
    """The reference, where there is one that the models can hold or come near."""
    truth = problem.reference
    if truth is None or not truth.at_sensors:
        return None
    try:
        x = problem.values(truth)
        sentences = _sentences(problem, truth)
        point = _judged(problem, x, "the reference", sentences)
    except (InputError, np.linalg.LinAlgError):
        return None
    if _differ(truth, point.slopes.structure):
        return replace(point, where="what the models can hold of the reference, which is not all of it")
    return point


def _differ(a: Structure, b: Structure) -> bool:
    for one, other in ((a.mass, b.mass), (a.stiffness, b.stiffness), (a.damping, b.damping)):
        size = np.sqrt(np.abs(np.diag(one)))
        if np.any(np.abs(one - other) > _SAME * (np.outer(size, size) + np.abs(one).max() * _SAME)):
            return True
    return False


def _at_modes(problem: Problem) -> tuple[_Point | None, tuple[str, ...]]:
    """What the modal strategy finds in the data; only sentences where it has other degrees of freedom."""
    try:
        found = identify(problem, strategy="modal", rng=0)
    except SysidError:
        return None, ()
    sentences = (*found.closed_by, *found.undetermined)
    if found.x is None:
        return None, sentences
    return _judged(problem, found.x, "what the modal strategy finds in the data", sentences), sentences


def _sentences(problem: Problem, structure: Structure) -> tuple[str, ...]:
    said = determination(problem, structure)
    return (*said.closed_by, *said.undetermined)


# -- what the data determine --------------------------------------------------------------------


def _at(problem: Problem, point: _Point) -> Iterator[str]:
    """Values, units and expected errors; rank; what is not seen, and what is seen least."""
    formulation, known, x = problem.formulation, point.known, point.x
    noise = "the stated noise" if _all_stated(problem) else f"{100 * _NOISE:g} % noise"
    moves = _moves(problem, point)
    free, count = known.free.shape[1], x.size
    inverse = problem.is_written and problem.reference is not None
    yield f"At {point.where}" + (" (a written problem cannot be inverted to its reference):" if inverse else ":")
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
        yield _seen_least(formulation, point, moves, noise)
    if isinstance(problem.mass, FullMass) and not problem.mass.healable:
        yield "  - what is stated of the mass beyond totals is held by the modal strategy, and not counted above"
    yield from (f"  - {sentence}" for sentence in point.sentences)


def _values(problem: Problem, point: _Point, moves: Array, noise: str) -> Iterator[str]:
    """A line a variable: the largest error of its entries stands for all."""
    formulation, known, x = problem.formulation, point.known, point.x
    std = np.linalg.norm(moves, axis=1)
    open_ = np.linalg.norm(known.unseen, axis=1) > _TOUCHED
    rows = [["variable", "value", "unit of IPOPT", f"standard deviation at {noise}"]]
    modal = problem.free_modes
    at = 0
    for v in formulation.variables:
        part = slice(at, at + v.size)
        at += v.size
        relative = std[part] / np.where(np.abs(x[part]) > 1e-3 * known.unit[part], np.abs(x[part]), np.nan)
        if np.any(open_[part]):
            told = "open" if np.all(open_[part]) else f"open in {np.count_nonzero(open_[part])} of {v.size}"
        elif np.all(np.isfinite(relative)):
            told = f"{100 * relative.max():.3g} %"
        else:
            told = f"{std[part].max():.3g} {v.unit}".rstrip()
        rows.append([v.name, _range(x[part]), "-" if modal else _range(unit_of(v, x[part])), told])
    yield from _table(rows)


def _coordinates(problem: Problem) -> Iterator[str]:
    """What IPOPT has in the place of these unknowns, or beside them."""
    if problem.free_modes:
        yield (
            "IPOPT works in mode shapes, participations and the logarithms of frequencies and damping ratios, from "
            "which these unknowns follow; here each counts in units of its size, or 5 % of its range where that is more"
        )
    elif needs_modes(problem):
        held = ", which stand for the stiffness factor" if isinstance(problem.stiffness, SpectralStiffness) else ""
        yield f"IPOPT has mode shapes and frequencies as further unknowns{held}, as damping is by ratios"


def _unseen(problem: Problem, point: _Point) -> Iterator[str]:
    """The null directions: what they change, and the shortest in words."""
    known, x = point.known, point.x
    words = sorted(directions_in_words(problem.formulation.variables, x, known.unit, known.unseen), key=len)
    own, base = _moved_matrices(point)
    left = len(words) - own - base
    kinds = [f"mass, stiffness or damping change along {own}"] if own else []
    kinds += [f"only mass and coupling of the base along {base}"] if base else []
    kinds += [f"no matrix (the same structure, written otherwise) along {left}"] if left else []
    yield f"  - no record sees {_count(len(words), 'direction')}; of these {', '.join(kinds)}"
    more = f" (the {_SHORTEST} shortest of {len(words)})" if len(words) > _SHORTEST else ""
    yield f"  - unseen{more}:"
    yield from (f"      {word}" for word in words[:_SHORTEST])
    where, rank = _generic(problem, point)
    if rank > known.rank:
        yield (
            f"  - this point is special, by a symmetry for instance: at {where} the records see {rank} directions; "
            "state a guess off it"
        )


def _moved_matrices(point: _Point) -> tuple[int, int]:
    """How many unseen directions move M_SS, K_SS or C; how many of the rest move the base's blocks."""
    s, steps = point.slopes, point.known.unit[:, None] * point.known.unseen
    n = s.structure.n
    M, K, C = s.structure.mass[:n, :n], s.structure.stiffness[:n, :n], s.structure.damping

    def moved(slope: Array, size: Array) -> Array:
        return ((slope @ steps) / size[..., None]).reshape(-1, steps.shape[1])

    def sizes(matrix: Array) -> Array:
        root = np.sqrt(np.abs(np.diag(matrix))) + np.finfo(float).tiny
        return np.outer(root, root)

    own = np.concatenate([moved(slope, sizes(A)) for slope, A in ((s.mass, M), (s.stiffness, K), (s.damping, C))])
    rigid = np.sqrt(np.abs(np.diag(s.structure.rigid_body_mass)))
    push = moved(s.d_push, np.sqrt(np.diag(M))[:, None] * rigid)
    base = np.concatenate([push, moved(s.d_rigid, np.outer(rigid, rigid))])
    rank = int(np.linalg.matrix_rank(own, tol=_SAME))
    return rank, int(np.linalg.matrix_rank(np.concatenate([own, base]), tol=_SAME)) - rank


def _generic(problem: Problem, point: _Point) -> tuple[str, int]:
    """Rank at another point of the search space, where this one is a guess; nothing where it is not."""
    if not (problem.is_written and point.where.startswith("the guess")):
        return "", 0
    for x in points_of(problem.formulation)[1:_TRIED]:
        where = "another point of the search space"
        try:
            return where, _judged(problem, *_feasible(problem, x, where)).known.rank
        except (InputError, np.linalg.LinAlgError):
            continue
    return "", 0


def _seen_least(formulation: Formulation, point: _Point, moves: Array, noise: str) -> str:
    """The direction of the largest variance, in units."""
    known = point.known
    U, s, _ = np.linalg.svd(moves / known.unit[:, None], full_matrices=False)
    words = directions_in_words(formulation.variables, point.x, known.unit, U[:, :1])[0]
    size = 100 * s[0] * np.abs(U[:, 0]).max()  # words have the largest entry at 1 % of its unit
    return f"  - seen least: {words}; its standard deviation at {noise} is {size:.3g} times that"


def _moves(problem: Problem, point: _Point) -> Array:
    """Moves of x that one standard normal of noise each makes, (p, rank); of 1 % noise where none is stated."""
    test, formulation, known = problem.measurement, problem.formulation, point.known
    if formulation.misfit is not None:
        # What stands in the place of the misfit is relative: its norm is 1 where nothing is explained.
        rows = formulation.misfit.size1_out(0)
        s = known.singular_values[: known.rank]
        return known.unit[:, None] * known.seen / s * (_NOISE / np.sqrt(rows))
    if _all_stated(problem):
        return known.normals
    residuals = [
        replace(r, measurement=_with_noise(r.measurement)) if isinstance(r, Misfit) else r for r in problem.residuals
    ]
    noisy = replace(problem, measurement=_with_noise(test), residuals=residuals)
    return sensitivity(noisy, point.x, point.slopes, as_stated=True).normals


def _all_stated(problem: Problem) -> bool:
    """Whether every record that is fitted states its noise."""
    tests = [problem.measurement, *(test for test, _ in problem.formulation.others)]
    return problem.formulation.misfit is None and all(map(_noise_is_stated, tests))


def _noise_is_stated(test: Measurement) -> bool:
    return test.response_std is not None and (test.force is None or test.force_std is not None)


def _with_noise(test: Measurement) -> Measurement:
    """The same with noise stated, as `simulate` makes it."""

    def std(record: ComplexArray, stated: Array | None) -> Array:
        return np.array(_NOISE * np.sqrt(np.mean(np.abs(record) ** 2))) if stated is None else stated

    force_std = None if test.force is None else std(test.force, test.force_std)
    return replace(test, response_std=std(test.response, test.response_std), force_std=force_std)


# -- lines --------------------------------------------------------------------------------------


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _range(values: Array) -> str:
    low, high = f"{np.min(values):.4g}", f"{np.max(values):.4g}"
    return low if low == high else f"{low} to {high}"


def _table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of a table, every column as wide as its longest cell."""
    cells = [[" ".join(cell.split()) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        yield "  " + "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()


def _folded(line: str) -> str:
    """Fold a long line at the width of a terminal, the rest indented."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    return textwrap.fill(line, _WIDTH, subsequent_indent=indent, break_on_hyphens=False) if len(line) > _WIDTH else line
