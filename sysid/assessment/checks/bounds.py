"""Unknowns that end on a bound, and whether their bounds explain a misfit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.assessment.checks.context import Context
from sysid.assessment.checks.gains import distinct_poles
from sysid.assessment.sensitivity import left_by_constraints, rows_of
from sysid.errors import listed
from sysid.finding import Finding, Severity, contradicting
from sysid.modal_analysis.residues import Records
from sysid.models.stiffness_and_damping import FREQUENCY_WINDOW
from sysid.models.unknowns import scales_of, split
from sysid.problem.direct_response import stacked_rows
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import CANDIDATES, EXACT, NEGLIGIBLE, ROUND_OFF, beyond_chance

_CLOSE = 1e-4  # .. and, where the range spans decades, of the bound itself
_SHARE = 0.25  # of the squared misfit: bounds that explain less, to first order, are not its cause


class OnBound(NamedTuple):
    """An unknown that ends on a bound.

    Attributes
    ----------
    name, entry : str
        "damping ratio" and " 3", "k" and "[0]".
    side : {"lower", "upper"}
    bound : str
        With its unit.
    source : str
        Who states it: a model's name, or the place where a variable is declared.
    place : int
        In x; -1 for a natural frequency, which is none of the problem's unknowns.
    """

    name: str
    entry: str
    side: str
    bound: str
    source: str
    place: int


def sides_of(lower: Array, upper: Array, values: Array, relative: ArrayLike = False) -> NDArray[np.str_]:
    """The bound on which each of some values rests: "lower", "upper", or "" for none.

    A `relative` one, of an unknown whose ratios alone count, is in units of the largest of that unknown, and rests on a
    positive lower bound or on none.
    """
    span, any_scale = NEGLIGIBLE * (upper - lower), np.asarray(relative)
    near = [np.where(end == 0, span, np.minimum(span, _CLOSE * np.abs(end))) for end in (lower, upper)]
    low = (values - lower < near[0]) & ((lower > 0) | ~any_scale)
    high = (upper - values < near[1]) & ~any_scale
    return np.select([low, high], ["lower", "upper"], "")


def on_bounds(problem: Prepared, structure: Structure, x: Array | None) -> list[OnBound]:
    """Unknowns that end on bounds which the search kept: those of models, variables, and stated frequencies.

    Parameters
    ----------
    problem : Prepared
    structure : Structure
        The answer.
    x : (n_variables,) or None
        The unknowns that stand for it; None where the modal strategy chose other degrees of freedom.
    """
    formulation, parts = problem.formulation, problem.formulation.parts
    at = _ratios_alone(formulation, structure) if x is None else x
    unknowns = formulation.unknowns
    relative = np.repeat([v.relative for v in unknowns], [v.size for v in unknowns])
    largest = [np.full(v.size, np.abs(values).max()) for v, values in zip(unknowns, split(unknowns, at), strict=True)]
    sides = sides_of(
        formulation.lower, formulation.upper, at / np.where(relative, np.concatenate(largest), 1.0), relative
    )
    # Modes stand for a free stiffness, and for a mass where modes are free: no bound holds their entries.
    sides[parts.mass] = np.where(problem.free_modes, "", sides[parts.mass])
    sides[parts.stiffness] = np.where(formulation.stiffness.free, "", sides[parts.stiffness])
    models = zip(problem.stated.models, formulation.of_models, strict=True)
    sources = [type(model).__name__ for model, group in models for _ in group]
    sources += [v.declared for v in formulation.variables if not v.fixed]
    entries = [(v, i, source) for v, source in zip(unknowns, sources, strict=True) for i in range(v.size)]
    found = []
    for place in np.flatnonzero(sides != "").tolist():
        v, i, source = entries[place]
        side, entry = str(sides[place]), v.labels[i].removeprefix(v.title)
        found.append(OnBound(v.title, entry, side, f"{getattr(v, side)[i]:.4g} {v.unit}".strip(), source, place))
    return [*found, *_on_windows(problem, structure)]


def _ratios_alone(formulation: Formulation, structure: Structure) -> Array:
    """Unknowns (n_variables,) of which only the damping ratios are known; NaN for the others."""
    at, part = np.full(formulation.size, np.nan), formulation.parts.damping
    ratios = structure.damping_ratios[: part.stop - part.start]
    at[part.start : part.start + ratios.size] = ratios
    return at


def _on_windows(problem: Prepared, structure: Structure) -> Iterator[OnBound]:
    """Natural frequencies on the edge of what a stated one may be wrong by."""
    stated = problem.formulation.stiffness.spectrum
    given = np.zeros(0) if stated is None else stated
    found, window = structure.natural_frequencies[: given.size], np.log1p(FREQUENCY_WINDOW)
    off = np.log(2 * np.pi * found / given[: found.size])
    for i in np.flatnonzero(np.abs(np.abs(off) - window) < NEGLIGIBLE * window):
        edge = f"{found[i]:.5g} Hz, {100 * FREQUENCY_WINDOW:g} % from the one stated or found in the data"
        side = ("lower", "upper")[int(off[i] > 0)]
        yield OnBound("natural frequency", f" {i + 1}", side, edge, type(problem.stated.stiffness).__name__, -1)


def bounds_in_words(found: Sequence[OnBound]) -> str:
    """The unknowns with their bounds, in words: "spring 2, 3 (upper, 1e+06 N/m)"."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for one in found:
        groups.setdefault((one.name, one.side, one.bound), []).append(one.entry)
    words = [f"{name}{listed(entries, ',')} ({side}, {bound})" for (name, side, bound), entries in groups.items()]
    return listed(words)


def keeping_bounds(context: Context) -> Iterator[Finding]:
    """Bounds keep the fit from the records; whatever else a misfit speaks against may be right once they are wider."""
    if context.is_judged and not context.named:
        found, press = _pressure_of(context)
        yield from (_pressing(found, press),) if press.explains else ()


def pressed_bounds(context: Context) -> Iterator[Finding]:
    """Bounds take a little of the fit, where nothing else speaks against it."""
    if context.is_judged and not (contradicting(context.found) or context.has("changing", "beyond noise")):
        found, press = _pressure_of(context)
        yield from (_pressing(found, press),) if press.significant else ()


def on_a_bound(context: Context) -> Iterator[Finding]:
    """Unknowns end on a bound, beyond which the truth may lie."""
    if context.outcome is None or context.has("bounds"):
        return
    found = on_bounds(context.problem.screened, context.outcome.structure, context.outcome.x)
    if found:
        sentence = f"on a bound, beyond which the truth may lie: {bounds_in_words(found)}"
        yield Finding("on a bound", Severity.NOTE, sentence, numbers={"unknowns": float(len(found))})


def _pressure_of(context: Context) -> tuple[list[OnBound], Pressure]:
    problem, end = context.problem.screened, context.end
    found = on_bounds(problem, end.structure, end.x)
    return found, pressure(problem, end.structure, end.x, found)


def _pressing(found: Sequence[OnBound], press: Pressure) -> Finding:
    """That bounds keep the fit from the records."""
    sources = dict.fromkeys(one.source for one in found)
    return Finding(
        "bounds", Severity.CONTRADICTS, f"bounds keep the fit from the records: {bounds_in_words(found)}",
        f"widen them first ({', '.join(sources)}): the truth lies beyond, or these unknowns make up for something "
        "else that is wrong, which is not judged before",
        numbers={"unknowns": float(len(found)), "share": press.share},
    )  # fmt: skip


class Pressure(NamedTuple):
    """The gain, to first order, if unknowns on bounds may pass them.

    ``share`` is that of the squared misfit; ``significant`` that noise does not gain as much by chance.
    """

    share: float
    significant: bool

    @property
    def explains(self) -> bool:
        """True where the bounds are a cause of the misfit."""
        return self.significant and self.share >= _SHARE


def bounds_explain(problem: Prepared, structure: Structure, x: Array | None) -> bool:
    """True where bounds on which unknowns end are a cause of the misfit."""
    return pressure(problem, structure, x, on_bounds(problem, structure, x)).explains


def pressure(problem: Prepared, structure: Structure, x: Array | None, found: Sequence[OnBound]) -> Pressure:
    """The part of the misfit that unknowns on bounds would take away.

    The squared misfit less that of the linear least squares about x: with all unknowns free, over those with the ones
    on bounds held. Where modes are free the misfit of free residues, at the structure's poles over those at the data's.

    Parameters
    ----------
    problem : Prepared
    structure : Structure
    x : (n_variables,) or None
        The answer.
    found : sequence of OnBound
    """
    if found and (x is None or problem.free_modes):
        return _of_poles(problem, structure, len(found))
    places = [one.place for one in found if one.place >= 0]
    if x is None or not places:  # a window about a stated frequency is on none of the problem's unknowns
        return Pressure(float(bool(found)), significant=bool(found))
    formulation = problem.formulation
    rows, unit = stacked_rows(rows_of(formulation, x)), scales_of(formulation.unknowns, x)
    J = rows.jacobian * unit
    free = left_by_constraints(formulation, x, unit, J, np.full(x.size, True))
    _, s, Vt = np.linalg.svd(free[places])
    held = free @ Vt[np.count_nonzero(s > ROUND_OFF) :].T  # what moves no unknown on a bound
    gained = _explained(J @ free, rows.residuals) - _explained(J @ held, rows.residuals)
    least = max(float(np.mean(rows.std**2)) * beyond_chance(len(places), CANDIDATES), EXACT**2)
    return Pressure(gained / max(float(np.sum(rows.residuals**2)), EXACT**2), significant=gained > least)


def _explained(J: Array, residuals: Array) -> float:
    """Squares of the residuals that the columns of J explain."""
    U, s, _ = np.linalg.svd(J, full_matrices=False)
    return float(np.sum((U[:, s > ROUND_OFF * s.max(initial=0.0)].T @ residuals) ** 2))


def _of_poles(problem: Prepared, structure: Structure, count: int) -> Pressure:
    """The same of modes with free shapes, by `count` unknowns on bounds; none where no pole stands out of the data."""
    if not problem.geometry.pole_ratios.size:
        return Pressure(0.0, significant=False)
    records, poles = Records(problem.measurement), problem.geometry.poles
    fit, exact = records.fit(*distinct_poles(structure)), EXACT**2 * records.size
    gained = fit.squared_error - poles.residual**2 * records.size
    least = max(records.noise(fit.left, fit.residues.size) * beyond_chance(count, CANDIDATES), exact)
    return Pressure(gained / max(fit.squared_error, exact), significant=bool(gained > least))
