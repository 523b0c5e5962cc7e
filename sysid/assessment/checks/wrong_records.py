"""Mistakes in records, or between them and what is stated, named before a search."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from sysid.assessment.checks.context import Context
from sysid.assessment.checks.leakage import unresolved
from sysid.assessment.checks.mistakes import CONJUGATED, is_gross, mistakes_of
from sysid.assessment.checks.stated_mass import MISFIT
from sysid.errors import InputError
from sysid.files.units import POUND, STANDARD_GRAVITY
from sysid.finding import Finding, Severity
from sysid.measurement.in_time import as_whole
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.direct_terms import DirectTerms, direct_terms
from sysid.modal_analysis.rough_poles import poles_of_test
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared, points_of
from sysid.problem.terms import FurtherTest
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import CANDIDATES, most_deviations

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


def wrong_records(context: Context) -> Iterator[Finding]:
    """Records, or what is stated of them, are wrong by a sign, a unit, a delay, a swapped sensor.

    Blocking where it spoils all channels, or a channel of a problem whose model has a form of its own, so that a
    search would be in vain. After a search, what was named before or by it.
    """
    if context.outcome is not None:
        yield from context.named
        return
    problem, declared = context.problem.stated, context.problem.stated.declared
    tests = [problem.measurement] if problem.misfit is None else []
    tests += [given.measurement for given in problem.residuals if isinstance(given, FurtherTest)]
    for i, test in enumerate(tests, start=1):
        for mistake in _of_test(context.problem, declared, test, first=test is problem.measurement):
            in_vain = mistake.severity is Severity.BLOCKING or (is_gross(mistake) and not declared.free_modes)
            one = mistake._replace(severity=Severity.BLOCKING if in_vain else mistake.severity)
            yield one if len(tests) == 1 else one.of_test(i)


def _of_test(problem: Prepared, declared: Formulation, test: Measurement, *, first: bool) -> list[Finding]:
    try:
        terms = direct_terms(test)
        found = mistakes_of(test, terms)
        if found and terms is not None and terms.misfit <= CONJUGATED and not test.is_whole:
            # Of records cut in motion, transients that were left in look like delays and gains.
            test = as_whole(test)
            if test.is_whole:
                terms = direct_terms(test)
                found = mistakes_of(test, terms)
        if first and not found and terms is not None:
            found = [*_of_mass(declared, test, terms), *_of_frequencies(problem, declared, test)]
        if not found and test.averaged:
            found = list(unresolved(test, *poles_of_test(test)))
    except (np.linalg.LinAlgError, InputError):  # records that tell nothing; the search says so
        return []
    return found


def _of_mass(declared: Formulation, test: Measurement, terms: DirectTerms) -> Iterator[Finding]:
    """The base force weighs what is stated but for a factor of two units."""
    allowed = None if terms.mass is None or terms.below else _masses(declared)
    if allowed is None or terms.mass is None or terms.modal_mass is None or terms.mass_std is None:
        return
    low, high = (part[test.translational] for part in allowed)
    weighed, std, modal = (np.diag(it)[test.translational] for it in (terms.mass, terms.mass_std, terms.modal_mass))
    known = (weighed > most_deviations(CANDIDATES) * std) & np.isfinite(low) & (high > 0)
    if not np.any(known):
        return
    low, high, weighed, modal = low[known], high[known], weighed[known], modal[known]
    if np.any((weighed > low / MISFIT) & (weighed < high * MISFIT)):
        return
    for factor, label, words in _FACTORS:
        # What no mode carries may be a fixture, of whatever mass.
        mended, of_modes = weighed / factor, modal / factor
        agree = (mended > low / _WITHIN) & (mended < high * _WITHIN) & (of_modes > _MODAL * low)
        if np.all(agree):
            masses = ", ".join(f"{m:.4g}" for m in weighed)
            stated = ", ".join(f"{a:.4g}" if a == b else f"{a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True))
            yield Finding(
                "force unit", Severity.BLOCKING,
                f"the base force weighs {masses} kg where {stated} kg are stated, a factor of {label}: {words}",
                numbers={"factor": factor},
            )  # fmt: skip
            return


def _masses(declared: Formulation) -> tuple[Array, Array] | None:
    """Least and largest mass that what is stated lets move in each base direction, (d,) each; None where it is open."""
    totals = declared.mass.totals
    if totals is not None:
        return totals.by_direction, totals.by_direction
    # A total that is not stated is searched about what the force weighs, of which nothing is known yet.
    weighed = declared.geometry.weighs and any(u.name == "total_mass" for u in declared.of_models[0])
    if declared.mass.free or declared.stiffness.free or weighed:
        return None
    found = [np.diag(s.rigid_body_mass) for s in _structures(declared)]
    return (np.min(found, axis=0), np.max(found, axis=0)) if found else None


def _of_frequencies(problem: Prepared, declared: Formulation, test: Measurement) -> Iterator[Finding]:
    """Lines are in rad/s, as frequencies that are stated, or that the bounds allow, show."""
    stated = getattr(problem.stated.stiffness, "natural_frequencies", None)
    if declared.stiffness.free and stated is None:
        return
    # The search reads the poles of lines that stand for themselves, and finds them here already.
    plain = problem.in_squares and not any(one.is_whole for one in problem.stated.tests)
    found = (problem.geometry.poles.omega if plain else poles_of_test(test)[0]) / (2 * np.pi)
    if stated is not None:
        low = high = np.atleast_1d(np.array(stated, dtype=float))
        what = "the stated natural frequencies are"
    else:
        frequencies = [s.natural_frequencies for s in _structures(declared)]
        if not frequencies:
            return
        low, high = np.min(frequencies, axis=0), np.max(frequencies, axis=0)
        what = "the bounds of the model allow first natural frequencies"
    inside = lambda f: bool(low[0] / _WITHIN < f[0] < high[0] * _WITHIN and f[-1] < high[-1] * _WITHIN)  # noqa: E731
    if stated is not None and found[0] < low[0] / MISFIT and inside(2 * np.pi * found):
        yield Finding(
            "frequencies in rad/s", Severity.BLOCKING,
            f"the stated natural frequencies are in rad/s, not Hz: {', '.join(f'{f:.4g}' for f in low[:4])} Hz are "
            f"stated, the records have modes at {', '.join(f'{f:.4g}' for f in found[:4])} Hz, and a factor of 2 pi = "
            "6.283 lies between",
            "divide what is stated by 2 pi", numbers={"stated": float(low[0]), "found": float(found[0])},
        )  # fmt: skip
    mended = found / (2 * np.pi)
    if found[0] > MISFIT * high[0] and inside(mended):
        span = f"{low[0]:.4g}" if stated is not None else f"of {low[0]:.4g} to {high[0]:.4g}"
        yield Finding(
            "frequencies in rad/s", Severity.BLOCKING,
            f"the lines are in rad/s, not Hz: the records have modes at {', '.join(f'{f:.4g}' for f in found[:4])} Hz "
            f"as they are given, {what} {span} Hz, and a factor of 2 pi = 6.283 lies between",
            "divide the frequencies by 2 pi", numbers={"stated": float(low[0]), "found": float(found[0])},
        )  # fmt: skip


def _structures(declared: Formulation) -> list[Structure]:
    """Structures over the search space, its corners among them."""
    unknowns, lower, upper = declared.unknowns, declared.lower, declared.upper
    ends = np.cumsum([unknown.size for unknown in unknowns])
    points = list(points_of(declared))
    if len(unknowns) <= 6:  # more bounds make too many corners
        for choice in product((False, True), repeat=len(unknowns)):
            points.append(np.where(np.repeat(choice, np.diff(ends, prepend=0)), upper, lower))
    structures = []
    for x in points:
        try:
            structures.append(declared.matrices.structure(x, declared.own_test.test))
        except InputError:  # no structure there
            continue
    return structures
