"""What is stated, held against what is found: bounds that unknowns end on, masses, values stated as known."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.assessment.checks.context import Context, Ended
from sysid.assessment.checks.gains import below_lines, distinct_poles
from sysid.assessment.sensitivity import left_by_constraints, rows_of
from sysid.errors import InputError, listed
from sysid.files.units import POUND, STANDARD_GRAVITY
from sysid.finding import Finding, Severity, contradicting
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.calibration import Calibration
from sysid.modal_analysis.direct_terms import DirectTerms
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.residues import Records, force_residual_left
from sysid.modal_analysis.response import weighed_mass, weighed_mass_std
from sysid.modal_analysis.rough_poles import poles_of_test
from sysid.models.mass import total_of
from sysid.models.stiffness_and_damping import FREQUENCY_WINDOW
from sysid.models.unknowns import scales_of, split
from sysid.problem.direct_response import stacked_rows
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared, points_of
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import CANDIDATES, EXACT, NEGLIGIBLE, ROUND_OFF, beyond_chance, most_deviations

_CLOSE = 1e-4  # .. and, where the range spans decades, of the bound itself
_SHARE = 0.25  # of the squared misfit: bounds that explain less, to first order, are not its cause
MISFIT = 1.5  # times what free residues leave, beyond which a force is not what the modes make of it
_WITHIN = 1.15  # times the same, up to which mended records agree
_MODAL = 0.4  # of the mended mass, that the modes between the lines carry at least
_FACTORS = (  # of the weighed mass over the right one, and what they are in words
    (1e-3, "1,000", "the base force is in kN, not N"),
    (1e3, "1,000", "the base force is in N, and was taken for kN"),
    (
        STANDARD_GRAVITY,
        "9.81",
        "base and sensors are in g, not m/s² (or the base force is in N, and was taken for kgf)",
    ),
    (1 / STANDARD_GRAVITY, "9.81", "the base force is in kgf, not N"),
    (1 / POUND, "4.448", "the base force is in lbf, not N"),
    (POUND, "4.448", "the base force is in N, and was taken for lbf"),
)


class OnBound(NamedTuple):
    """An unknown that ends on a bound.

    `name` and `entry` as "k" and "[0]"; `bound` with its unit; `source` is who states it, a model's name or the place
    where a variable is declared; `place` in x, -1 for a natural frequency, which is none of the problem's unknowns.
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

    The unknowns x (n_variables,) are None where the modal strategy chose other degrees of freedom.
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
        found, press = pressure_of(context.problem.screened, context.end)
        yield from (_pressing(found, press),) if press.explains else ()


def pressed_bounds(context: Context) -> Iterator[Finding]:
    """Bounds take a little of the fit, where nothing else speaks against it."""
    if context.is_judged and not (contradicting(context.found) or context.has("changing", "beyond noise")):
        found, press = pressure_of(context.problem.screened, context.end)
        yield from (_pressing(found, press),) if press.significant else ()


def on_a_bound(context: Context) -> Iterator[Finding]:
    """Unknowns end on a bound, beyond which the truth may lie."""
    if context.has("bounds"):
        return
    found = on_bounds(context.problem.screened, context.end.structure, context.end.x)
    if found:
        sentence = f"on a bound, beyond which the truth may lie: {bounds_in_words(found)}"
        yield Finding("on a bound", Severity.NOTE, sentence, numbers={"unknowns": float(len(found))})


def pressure_of(problem: Prepared, end: Ended) -> tuple[list[OnBound], Pressure]:
    """Unknowns that end on bounds, and what they would gain beyond them."""
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


def pressure(problem: Prepared, structure: Structure, x: Array | None, found: Sequence[OnBound]) -> Pressure:
    """The part of the misfit that unknowns on bounds would take away.

    The squared misfit less that of the linear least squares about x: with all unknowns free, over those with the ones
    on bounds held. Where modes are free the misfit of free residues, at the structure's poles over those at the
    data's.
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


def stated_masses(context: Context) -> Iterator[Finding]:
    """A stated mass, or the base force, is not that of the modes that the accelerations show."""
    if context.is_explained or not context.problem.formulation.fits_records:
        return
    problem, structure = context.problem.screened, context.end.structure
    for check in (_stated_mass, _known_entries, _lumped_total):
        yield from check(problem, structure)
    yield from force_misfit(problem.formulation, problem.measurement, structure, problem.modal[0].calibration)


def _stated_mass(problem: Prepared, structure: Structure) -> Iterator[Finding]:
    """The base force weighs another mass than the stated one."""
    test, stated = problem.measurement, problem.formulation.mass
    whole = stated.totals is not None or np.all(np.isfinite(problem.known_mass))
    told = test.force is not None and not below_lines(test, structure).size
    if not told or stated.weighs or not whole or not structure.modal_damping:
        return
    poles = distinct_poles(structure)
    weighed, expected = np.diag(weighed_mass(test, *poles)), np.diag(structure.rigid_body_mass)
    # A direction beside a rotation may be weighed worse.
    noise = most_deviations(test.n_base) * weighed_mass_std(test, *poles) / expected
    usual = max(0.01, 3 * force_residual_left(test, *poles) / np.sqrt(test.freq.size))
    if np.any(np.abs(weighed / expected - 1) >= np.maximum(usual, noise)):
        given, found = (", ".join(f"{m:.4g}" for m in masses) for masses in (expected, weighed))
        numbers = {f"stated {i + 1}": float(m) for i, m in enumerate(expected)}
        yield Finding(
            "stated mass", Severity.CONTRADICTS,
            f"the stated mass makes {given} kg in the base directions, but the base force weighs {found} kg",
            "one of them, or the unit of the force, is wrong; the force weighs an adapter or base plate on its cells "
            "too",
            numbers=numbers | {f"weighed {i + 1}": float(m) for i, m in enumerate(weighed)},
        )  # fmt: skip


def _known_entries(problem: Prepared, structure: Structure) -> Iterator[Finding]:
    """Known entries of the mass are not used, or are more than the stated total."""
    geometry, mass = problem.geometry, problem.formulation.mass
    if not mass.free or mass.entries is None:
        return
    if not structure.at_sensors:
        unused = "the known entries of the mass are not used: the degrees of freedom are not the sensors alone"
        yield Finding("known entries", Severity.CONTRADICTS, unused)
        return
    if mass.totals is not None and problem.measurement.force is None:
        makes = total_of(geometry, structure.mass, mass.totals.kind)
        std = mass.totals.std_by_direction
        if np.any(makes > problem.totals * (1 + NEGLIGIBLE) + most_deviations(std.size) * std):
            given, least = (", ".join(f"{m:.4g}" for m in masses) for masses in (problem.totals, makes))
            more = f"the known entries of the mass make {least} kg or more, and {given} kg are stated in all"
            yield Finding("known entries", Severity.CONTRADICTS, more)


def _lumped_total(problem: Prepared, structure: Structure) -> Iterator[Finding]:
    """The total of a lumped mass, a sum over the sensors of a direction, is not what moves in that direction."""
    totals, geometry = problem.formulation.mass.totals, problem.geometry
    if totals is None or totals.kind != "sensors":
        return
    moves = np.einsum("j,ji->i", np.diag(structure.mass)[: geometry.n], geometry.rigid_body**2)
    has_sensors = np.isin(np.arange(geometry.d), geometry.directions[: geometry.n])
    off = np.abs(moves / totals.values - 1) > 1e-6
    for i in np.flatnonzero(geometry.translational & has_sensors & off):
        yield Finding(
            "lumped total", Severity.CONTRADICTS,
            f"{totals.values[i]:.4g} kg are stated over the sensors of base direction {i + 1}, but their masses "
            f"make {moves[i]:.4g} kg in it: a lumped mass needs sensors along the base directions, not skew ones",
            numbers={"direction": i + 1.0, "stated": float(totals.values[i]), "made": float(moves[i])},
        )  # fmt: skip


def force_misfit(
    formulation: Formulation, test: Measurement, structure: Structure, calibration: Calibration | None
) -> Iterator[Finding]:
    """The base force is not that of the modes that the accelerations show, nor are gains within tolerances why."""
    if test.force is None or below_lines(test, structure).size:
        return
    entries, n = formulation.mass.entries, formulation.geometry.n
    # Masses are open, and none of them is below the sensors.
    lumped = not formulation.mass.free and entries is not None and np.isnan(entries).any() and not entries[:, n:].any()
    fixture = (
        ", and mass below the sensors (base ring, fixture), which a full mass may have, a lumped one not"
        if lumped
        else ""
    )
    # Both misfits in units of the stated noise: what is left at a noisy peak speaks against nothing.
    left = replace(test, force=test.force - test.predict_force(structure))
    misfit = float(np.sqrt(Records(left, force=True).size / Records(test, force=True).size))
    velocity = not structure.modal_damping
    possible = max(force_residual_left(test, *distinct_poles(structure), velocity=velocity), EXACT)
    gains = 0.0 if calibration is None else float(np.sqrt(np.diag(calibration.covariance).max()))
    if misfit > max(MISFIT * np.hypot(possible, gains), NEGLIGIBLE):
        yield Finding(
            "force misfit", Severity.CONTRADICTS,
            f"the base force misses what the modes of the accelerations make of it by {100 * misfit:.3g} % "
            f"(free residues leave {100 * possible:.3g} %)",
            f"check its sign, unit, axes and point of reference{fixture}",
            numbers={"misfit": misfit, "free residues": possible},
        )  # fmt: skip


def missed_values(context: Context) -> Iterator[Finding]:
    """Stated masses, or values stated as known, cannot be met together with the records."""
    if not context.has("bounds"):
        yield from (one for one in context.end.findings if one.kind == "stated masses")
    if not context.is_explained and context.end.x is not None:
        formulation, x = context.problem.formulation, context.end.x
        yield from _priors(formulation, x)
        yield from (one for term in formulation.beside for one in term.findings(x))


def _priors(formulation: Formulation, x: Array) -> Iterator[Finding]:
    """Values that are stated as known, where errors as stated do not miss them all so far."""
    names = [name for term in formulation.priors for name in term.labels]
    off = np.concatenate([np.zeros(0), *(term.numbers(x) for term in formulation.priors)])
    if np.sum(off**2) > beyond_chance(off.size) and not any(term.findings(x) for term in formulation.priors):
        missed = ", ".join(f"{name} by {z:+.2g}" for name, z in zip(names, off, strict=True))
        yield Finding(
            "stated values", Severity.CONTRADICTS,
            f"the values that are stated as known are missed together, in standard deviations: {missed}",
            "they, another number, or the model is wrong",
            numbers=dict(zip(names, off.tolist(), strict=True)),
        )  # fmt: skip


def wrong_statements(
    problem: Prepared, declared: Formulation, test: Measurement, terms: DirectTerms, monitor: FitMonitor
) -> Iterator[Finding]:
    """Masses and frequencies that are stated in another unit than the records show, before a search.

    The monitor may stop the fit of modes that frequencies are compared with.
    """
    yield from _of_mass(declared, test, terms)
    yield from _of_frequencies(problem, declared, test, monitor)


def _of_mass(declared: Formulation, test: Measurement, terms: DirectTerms) -> Iterator[Finding]:
    """The base force weighs what is stated but for a factor of two units."""
    if terms.mass is None or terms.below or terms.modal_mass is None or terms.mass_std is None:
        return
    weighed, std, modal = (np.diag(it)[test.translational] for it in (terms.mass, terms.mass_std, terms.modal_mass))
    shown = weighed > most_deviations(CANDIDATES) * std
    low = high = np.full(weighed.size, np.nan)
    for mass in _masses(declared):
        low, high = np.fmin(low, mass[test.translational]), np.fmax(high, mass[test.translational])
        if np.any(shown & (weighed > low / MISFIT) & (weighed < high * MISFIT)):  # right units show at once
            return
    known = shown & np.isfinite(low) & (high > 0)
    low, high, weighed, modal = low[known], high[known], weighed[known], modal[known]
    for factor, label, words in _FACTORS:
        # What no mode carries may be a fixture, of whatever mass.
        mended, of_modes = weighed / factor, modal / factor
        agree = (mended > low / _WITHIN) & (mended < high * _WITHIN) & (of_modes > _MODAL * low)
        if np.any(known) and np.all(agree):
            masses = ", ".join(f"{m:.4g}" for m in weighed)
            stated = ", ".join(f"{a:.4g}" if a == b else f"{a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True))
            yield Finding(
                "force unit", Severity.BLOCKING,
                f"the base force weighs {masses} kg where {stated} kg are stated, a factor of {label}: {words}",
                numbers={"factor": factor},
            )  # fmt: skip
            return


def _masses(declared: Formulation) -> Iterator[Array]:
    """Masses that what is stated lets move in each base direction, (d,) each; none where they are open."""
    totals = declared.mass.totals
    # A total that is not stated is searched about what the force weighs, of which nothing is known yet.
    weighed = declared.geometry.weighs and any(u.name == "total_mass" for u in declared.of_models[0])
    if totals is not None:
        yield totals.by_direction
    elif not (declared.mass.free or declared.stiffness.free or weighed):
        yield from (np.diag(structure.rigid_body_mass) for structure in _structures(declared))


def _of_frequencies(
    problem: Prepared, declared: Formulation, test: Measurement, monitor: FitMonitor
) -> Iterator[Finding]:
    """Lines are in rad/s, as frequencies that are stated, or that the bounds allow, show."""
    stated = getattr(problem.stated.stiffness, "natural_frequencies", None)
    if declared.stiffness.free and stated is None:
        return
    # The search reads the poles of lines that stand for themselves, and finds them here already.
    plain = problem.in_squares and not any(one.is_whole for one in problem.stated.tests)
    if plain:
        problem.fit_modes(monitor)
    found = (problem.geometry.poles.omega if plain else poles_of_test(test)[0]) / (2 * np.pi)
    if stated is not None:
        low = high = np.atleast_1d(np.array(stated, dtype=float))
        what = f"the stated natural frequencies are {low[0]:.4g}"
    else:
        frequencies = []
        for structure in _structures(declared):
            frequencies.append(structure.natural_frequencies)
            if found[0] <= MISFIT * frequencies[-1][0]:  # as right lines are at once: nothing more to look at
                return
        if not frequencies:
            return
        low, high = np.min(frequencies, axis=0), np.max(frequencies, axis=0)
        what = f"the bounds of the model allow first natural frequencies of {low[0]:.4g} to {high[0]:.4g}"
    inside = lambda f: bool(low[0] / _WITHIN < f[0] < high[0] * _WITHIN and f[-1] < high[-1] * _WITHIN)  # noqa: E731
    modes, between = ", ".join(f"{f:.4g}" for f in found[:4]), "and a factor of 2 pi = 6.283 lies between"
    numbers = {"stated": float(low[0]), "found": float(found[0])}
    if stated is not None and found[0] < low[0] / MISFIT and inside(2 * np.pi * found):
        yield Finding(
            "frequencies in rad/s", Severity.BLOCKING,
            f"the stated natural frequencies are in rad/s, not Hz: {', '.join(f'{f:.4g}' for f in low[:4])} Hz are "
            f"stated, the records have modes at {modes} Hz, {between}",
            "divide what is stated by 2 pi", numbers=numbers,
        )  # fmt: skip
    if found[0] > MISFIT * high[0] and inside(found / (2 * np.pi)):
        yield Finding(
            "frequencies in rad/s", Severity.BLOCKING,
            f"the lines are in rad/s, not Hz: the records have modes at {modes} Hz as they are given, {what} Hz, "
            f"{between}",
            "divide the frequencies by 2 pi", numbers=numbers,
        )  # fmt: skip


def _structures(declared: Formulation) -> Iterator[Structure]:
    """Structures over the search space, its corners among them."""
    sizes = [unknown.size for unknown in declared.unknowns]
    choices = product((False, True), repeat=len(sizes)) if len(sizes) <= 6 else ()  # more bounds make too many corners
    corners = (np.where(np.repeat(choice, sizes), declared.upper, declared.lower) for choice in choices)
    for x in chain(points_of(declared), corners):
        with contextlib.suppress(InputError):  # no structure there
            yield declared.matrices.structure(x, declared.own_test.test)
