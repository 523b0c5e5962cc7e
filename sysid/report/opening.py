"""The opening of a report: what was identified, how far to trust it, its figures, noise, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.noise_multiples import noise_at_most
from sysid.measurement.measurement import Measurement
from sysid.report.html import bullets, escaped, number, paragraph, prose, sentence, table
from sysid.report.matrices import stated
from sysid.results.identification import Identification
from sysid.results.summary import FIRST, JUDGEMENTS, fitted_in_words, next_steps, verdict
from sysid.results.tables import counted, deck_masses, half_width, unknown_rows
from sysid.structure.structure import Array, ComplexArray, Structure

_COLOUR = {"determined": "good", "one of many": "warn", "doubtful": "warn", "no fit": "bad"}
_HOLDS = (
    "frequencies, damping ratios and responses to base motion hold whichever of these models is taken; mass, stiffness "
    "and damping matrices are one choice"
)
_MOST_MODES, _MOST_UNKNOWNS = 4, 5  # whose figures stand in the opening; all of them follow


class NoiseLevel(NamedTuple):
    """Standard deviations of accelerations and base force, (runs, channels, n_freq or 1); None where not known.

    `at_most`: not known, but no larger than what a fit leaves of the quietest lines.
    """

    response: Array | None
    force: Array | None
    at_most: bool

    @property
    def bound(self) -> str:
        """Sign that stands behind a figure of it."""
        return " at most" * self.at_most


def opening(it: Identification, level: NoiseLevel) -> str:
    """HTML of what was identified, the judgement, the next thing to do, and the figures; `level` of the records."""
    word = "Stopped before its end: the best until then. " * it.interrupted + JUDGEMENTS[it.judgement]
    judged = paragraph(sentence(verdict(it))) + _reasons(it) + f"<p><b>Next:</b> {prose(_steps(it)[0])}</p>"
    box = f'<div class="verdict {_COLOUR[it.judgement]}"><strong>{escaped(word)}</strong>{judged}</div>'
    rows = [*_masses(it), *_deck_masses(it), *_unknowns(it), *_modes(it), *_fit(it, level)]
    return _subject(it) + box + table(["", ""], rows, words=True)


def trust(it: Identification) -> str:
    """HTML of what speaks against the answer, what is open, what fixes it, and what to measure next."""
    open_, steps = [str(one) for one in it.open_findings], _steps(it)
    open_ += [_HOLDS] * bool(open_ and it.success and it.is_one_of_many)
    parts = [
        ("What speaks against it", [str(one) for one in it.contradictions]),
        ("What the data do not determine", open_),
        ("What fixes the matrices", it.closed_by),
        ("What to measure or to do next", steps if len(steps) > 1 else ()),  # one alone stands in the opening
        ("To be known besides", [str(one) for one in it.notes]),
    ]
    return "".join(f"<h3>{name}</h3>{bullets(map(sentence, sentences))}" for name, sentences in parts if sentences)


def _subject(it: Identification) -> str:
    test, n, d = it.measurement, it.structure.n, it.structure.n_base
    of = f"{n} degrees of freedom"
    if n != test.n_sensors:
        of += f" from {test.n_sensors} sensors"
    records = "whole records, their transients taken off, " * it.records.measurement.is_whole
    words = (
        f"Identified: mass, stiffness and damping matrices of {of}. From: {fitted_in_words(it)}, "
        f"{counted(d, 'base direction')} ({', '.join(test.base_axes or ())}), {records}{test.lines_in_words}, "
        f"{'with' if test.force is not None else 'without'} base force."
    )
    return paragraph(words, "soft")


def _reasons(it: Identification) -> str:
    """HTML of what speaks against the answer most."""
    return bullets(sentence(str(one)) for one in it.contradictions[:FIRST])


def _steps(it: Identification) -> list[str]:
    """Steps to do next, the first thing first."""
    steps = [sentence(step) for step in next_steps(it)]
    if steps:
        return steps
    if it.hurried or it.of_kind("not judged"):
        return ["Give it more time (--max-time, max_time=): what it is worth was not judged."]
    if it.judgement == "one of many":
        return ["Measure more closely what is not known well enough: it is named below."]
    if not it.records.validation:
        one_by_one = ", or each run by the others: 'sysid refine RESULT --leave-out run'" * (it.measurement.n_runs > 1)
        return [
            f"Predict a test that was not fitted (in Python validation=[...]{one_by_one}): it alone shows what the "
            "model leaves out."
        ]
    return ["Take the matrices: sysid export writes them for Nastran, MATLAB and others."]


def _masses(it: Identification) -> Iterator[tuple[str, str]]:
    masses, std = np.diag(it.structure.rigid_body_mass), np.diag(it.quick_std("rigid_body_mass"))
    by_user = np.diag(stated(it))
    for axis, mass, deviation, known in zip(it.measurement.base_axes or (), masses, std, by_user, strict=True):
        what, unit = ("moment of inertia", "kg m²") if axis.startswith("r") else ("total mass", "kg")
        if it.facts.unit_mass:
            yield f"{what}, {axis}", f"~{number(mass)} {unit}, normalised: no mass is stated, no force was measured"
            continue
        exact = known and half_width(deviation, mass) in ("open", "0")
        words = f"{number(mass)} {unit}, as stated" if exact else _with_interval(it, mass, deviation, unit)
        yield f"{what}, {axis}", words


def _deck_masses(it: Identification) -> Iterator[tuple[str, str]]:
    """Masses of a lumped model, sensor by sensor."""
    for one in deck_masses(it):
        yield f"mass at {one.name}", _with_interval(it, one.mass, one.std, "kg")


def _unknowns(it: Identification) -> Iterator[tuple[str, str]]:
    """Unknowns with a meaning of their own, where they are few."""
    rows = unknown_rows(it)
    for row in rows if len(rows) <= _MOST_UNKNOWNS else ():
        yield row.label, _with_interval(it, row.value, row.std, row.unit).strip()


def _modes(it: Identification) -> Iterator[tuple[str, str]]:
    s, u = it.structure, it.quick_uncertainty
    n = min(s.n, _MOST_MODES)
    widths = np.zeros((2, n)) if u is None else np.array([u.natural_frequencies[:n], u.damping_ratios[:n]])
    for k in range(n):
        f, percent = s.natural_frequencies[k], 100 * it.identified_ratios[k]
        damping = "not determined" if np.isnan(percent) else _with_interval(it, percent, 100 * widths[1, k], "%")
        yield f"mode {k + 1}", f"{_with_interval(it, f, widths[0, k], 'Hz')}, damping {damping}"
    if not it.success:
        yield "", "without intervals: they hold for a model that fits, and this one does not"
    if s.n > n:
        yield "", f"and {counted(s.n - n, 'further mode')} up to {number(s.natural_frequencies[-1], 4)} Hz, below"


def _fit(it: Identification, level: NoiseLevel) -> Iterator[tuple[str, str]]:
    test = it.fitted.records
    left = f"{number(100 * it.residual, 3)} % of the accelerations relative to the base"
    left += _beside(share_of_all_noise(level.response, test.relative), level)
    if it.force_residual is not None and test.force is not None:
        left += f", {number(100 * it.force_residual, 3)} % of the base force"
        left += _beside(share_of_all_noise(level.force, test.force), level)
    yield "the fit leaves", left
    for i, unseen in enumerate(it.validation, start=1):
        missed = number(100 * unseen.residual(it.structure), 3)
        yield f"unfitted test {i}", f"missed by {missed} % of its accelerations relative to the base"


def _beside(noise: float, level: NoiseLevel) -> str:
    return f" (noise{level.bound} {number(100 * noise, 3)} %)" if noise else ""


def rounded(value: float, std: float, digits: int = 4) -> tuple[str, str]:
    """A value to two digits of half of its 95 % interval, and that; with so many `digits` where noise leaves none."""
    width = half_width(std, value)
    if width in ("open", "0"):
        return number(value, digits), width
    half, largest = float(width), np.floor(np.log10(max(abs(value), float(width))))
    places = 1 - int(np.floor(np.log10(half)))
    if places > 9 or largest > 6:  # such as a compliance, or a large stiffness
        return f"{value + 0.0:.{max(places + int(largest), 1)}e}", f"{half:.1e}"
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}", f"{half:.{max(places, 0)}f}"


def _with_interval(it: Identification, value: float, std: float, unit: str) -> str:
    """A value with its interval; of a model that does not fit without one, as it leaves out what is missed."""
    words, width = rounded(value, std if it.success or np.isnan(std) else 0.0)
    if width == "open" and it.quick_uncertainty is not None:
        return f"{words} {unit}, one of many: these data do not determine it"
    return f"{words} {unit}" if width in ("open", "0") else f"{words} ± {width} {unit}"


def noise_of_test(test: Measurement, structure: Structure) -> NoiseLevel:
    """The noise of a test: stated, found with the fit, or a bound by what `structure` leaves of it."""
    if test.response_std is not None:
        return NoiseLevel(test.response_std, test.force_std, False)
    response = noise_at_most(test, test.relative - test.predict(structure))
    force = test.force_std
    if force is None and test.force is not None:
        force = noise_at_most(test, test.force - test.predict_force(structure))
    return NoiseLevel(response, force, True)


def share_of_noise(std: Array | None, records: ComplexArray) -> Array:
    """Noise over records, (channels,), as the residual measures them; NaN where it is not known.

    A run has no noise at the lines of others, where it holds zeros.
    """
    if std is None:
        return np.full(records.shape[1], np.nan)
    size = np.linalg.norm(records, axis=(0, 2))
    recorded = np.any(records != 0, axis=1, keepdims=True)
    noise = np.sqrt(np.sum(np.where(recorded, std, 0.0) ** 2 * np.ones(records.shape), axis=(0, 2)))
    return np.divide(noise, size, out=np.full_like(size, np.nan), where=size > 0)


def share_of_all_noise(std: Array | None, records: ComplexArray) -> float:
    """Noise over records, all channels together; zero where it is not known."""
    size = np.linalg.norm(records, axis=(0, 2))
    return float(np.sqrt(np.nansum((share_of_noise(std, records) * size) ** 2)) / np.linalg.norm(size))
