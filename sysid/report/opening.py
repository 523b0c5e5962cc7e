"""The opening of a report, its matrices and its channels: what was identified, how far to trust it, and its noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.context import noise_at_most
from sysid.assessment.sensitivity import system_matrices
from sysid.measurement.measurement import Measurement
from sysid.plot.plots import normalised
from sysid.report.html import (
    aligned,
    bullets,
    escaped,
    heat_maps,
    matrix,
    no_lines,
    number,
    paragraph,
    prose,
    sentence,
    table,
)
from sysid.results import tables
from sysid.results.identification import Identification
from sysid.results.summary import FIRST, JUDGEMENTS, fitted_in_words, next_steps, verdict
from sysid.results.tables import beyond_lines, counted, deck_masses, half_width, runs_can_be_left_out, unknown_rows
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import ROUND_OFF

ONE_OF_MANY, CHOSEN = "one of many", "as the modal masses were chosen"
_NO_FIT = "of a model that does not fit"
_ENDS_ELSEWHERE = " How far the entries may go is in the result's mass_interval and stiffness_interval."
_ENDS_BELOW = (
    " Below an entry of M_SS and K_SS: from where to where it goes in the models that explain the data and hold what "
    "was stated."
)

Lines = list[list[tuple[str, ...]]]  # below each entry of a matrix
_COLOUR = {"determined": "good", "one of many": "warn", "doubtful": "warn", "no fit": "bad"}
_HOLDS = (
    "frequencies, damping ratios and responses to base motion hold whichever of these models is taken; mass, stiffness "
    "and damping matrices are one choice"
)
_MOST_MODES, _MOST_UNKNOWNS = 4, 5  # whose figures stand in the opening; all of them follow


def matrix_tables(it: Identification) -> str:
    """HTML of heat maps and tables of M_SS, K_SS, C and the base's blocks of M."""
    structure, test = it.structure, it.measurement
    n, axes, names = structure.n, test.base_axes or (), it.degrees_of_freedom
    scale = "; masses normalised to 1 kg" if it.facts.unit_mass else ""
    coupling, base = "kg", "kg"
    if not test.translational.all():
        coupling, base = "kg, kg m in columns of a rotation", "kg, kg m, kg m²"
    (M, K, C), M_full = system_matrices(structure), structure.mass
    stds = [it.quick_std(name)[:n, :n] for name in ("mass", "stiffness", "damping")]
    ends = None if it.determined else it.quick_intervals
    label = "" if it.determined or np.all(np.isfinite(stds[0])) else ONE_OF_MANY
    mark = _NO_FIT * (not it.success) or label
    words = (
        "Heat maps: each entry over the root of its two diagonal entries. Tables: entries below 10⁻¹² of a matrix's "
        "largest are round-off, and stand as 0."
    )
    if np.any(np.isfinite(stds)):
        words += " ±: half of the 95 % interval, from the noise of the records; open: the data do not tell."
        words += " It holds for a model that fits: this one does not." * (not it.success)
    lower = list(map(half_widths, (M, K, C), stds))
    if label:
        lower[2] = no_lines(C.shape)  # half-widths about one choice tell less than its mark
        words += _ENDS_ELSEWHERE * (ends is None)
    if ends is not None:
        words += _ENDS_BELOW
        lower[:2] = map(_ranges, (ends.mass, ends.stiffness), lower[:2])
    parts = [
        paragraph(words, "soft"),
        heat_maps(
            {name: normalised(A) for name, A in (("M_SS", M), ("K_SS", K), ("C", C))}, "RdBu_r", -1.0,
            CHOSEN if label else "", label=mark,
        ),
        matrix(M, names, names, f"Mass M_SS, kg{scale}", below=lower[0], label=mark),
        _of_base(M_full[:n, n:], names, axes, f"Coupling mass M_S0, {coupling}{scale}", mark),
        _of_base(M_full[n:, n:], axes, axes, f"Base mass M_00, {base}{scale}", mark),
        matrix(K, names, names, f"Stiffness K_SS, N/m{scale}", below=lower[1], label=mark),
        matrix(
            C, names, names, f"Damping C on the motion relative to the base, N s/m{scale}", below=lower[2], label=mark
        ),
    ]  # fmt: skip
    return "".join(parts)


def _of_base(block: Array, rows: Sequence[str], columns: Sequence[str], caption: str, label: str) -> str:
    """HTML of a block of the base in the mass, (rows, columns); a line where it is zero, as of masses at sensors."""
    return matrix(block, rows, columns, caption, label=label) if block.any() else paragraph(f"{caption}: zero", "soft")


def half_widths(values: Array, std: Array, stated: Array | bool = False) -> Lines:
    """Lines below the entries of a matrix: half of the 95 % interval, or "open"; nothing where it is round-off.

    `stated` tells the entries that were stated. No lines at all where everything is open.
    """
    stated = np.broadcast_to(stated, std.shape)
    lines = no_lines(std.shape)
    if not np.any(np.isfinite(std) | stated):
        return lines
    size = np.sqrt(np.abs(np.diag(values)))
    for i, j in np.ndindex(*std.shape):
        width = width_text(half_width(float(std[i, j]), float(size[i] * size[j])))
        if stated[i, j] or width == "open":
            lines[i][j] = ("stated" if stated[i, j] else "open",)
        elif width != "0":
            lines[i][j] = (f"± {width}",)
    return lines


def width_text(width: str) -> str:
    """A half-width as "110", not "1.1e+02"; words stay."""
    return width if width == "open" else f"{float(width):.6g}"


def _ranges(ends: Array, otherwise: Lines) -> Lines:
    """Lines below the entries of a matrix: both ends of their range (2, n, n), or `otherwise` where they look alike."""
    lines = [list(line) for line in otherwise]
    for i, j in np.argwhere(~np.isclose(ends[0], ends[1], rtol=ROUND_OFF, atol=0.0)):
        least, most = (number(end, 3) for end in ends[:, i, j])
        if least == most != "–":
            continue
        bounded = np.isfinite(ends[:, i, j])
        words_of = {
            (True, True): (f"{least} to", most),
            (True, False): (f"from {least}",),
            (False, True): (f"to {most}",),
        }
        lines[i][j] = words_of.get((bool(bounded[0]), bool(bounded[1])), ("any value",))
    return lines


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
    against = bullets(sentence(str(one)) for one in it.contradictions[:FIRST])
    judged = f"{paragraph(sentence(verdict(it)))}{against}<p><b>Next:</b> {prose(_steps(it)[0])}</p>"
    box = f'<div class="verdict {_COLOUR[it.judgement]}"><strong>{escaped(word)}</strong>{judged}</div>'
    unknowns = unknown_rows(it)
    few = [(f"mass at {one.name}", one.mass, one.std, "kg") for one in deck_masses(it)]
    few += [(row.label, row.value, row.std, row.unit) for row in unknowns] * (len(unknowns) <= _MOST_UNKNOWNS)
    figures = ((name, _with_interval(it, value, std, unit).strip()) for name, value, std, unit in few)
    rows = [*_masses(it), *figures, *_modes(it), *_fit(it, level)]
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
        ("What no record of this test can show", [str(one) for one in it.assumptions]),
        ("To be known besides", [str(one) for one in it.notes]),
    ]
    return "".join(f"<h3>{name}</h3>{bullets(map(sentence, sentences))}" for name, sentences in parts if sentences)


def _subject(it: Identification) -> str:
    test, n, d = it.measurement, it.structure.n, it.structure.n_base
    of = f"{n} degrees of freedom" + f" from {test.n_sensors} sensors" * (n != test.n_sensors)
    records = "whole records, their transients taken off, " * it.records.measurement.is_whole
    words = (
        f"Identified: mass, stiffness and damping matrices of {of}. From: {fitted_in_words(it)}, "
        f"{counted(d, 'base direction')} ({', '.join(test.base_axes or ())}), {records}{test.lines_in_words}, "
        f"{'with' if test.force is not None else 'without'} base force."
    )
    return paragraph(words, "soft")


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
        one_by_one = ", or each run by the others: 'sysid refine RESULT --leave-out run'" * runs_can_be_left_out(it)
        return [
            f"Predict a test that was not fitted (in Python validation=[...]{one_by_one}): it alone shows what the "
            "model leaves out."
        ]
    return ["Take the matrices: sysid export writes them for Nastran, MATLAB and others."]


def _masses(it: Identification) -> Iterator[tuple[str, str]]:
    masses, std = np.diag(it.structure.rigid_body_mass), np.diag(it.quick_std("rigid_body_mass"))
    by_user = np.diag(it.facts.stated_rigid_body)
    for axis, mass, deviation, known in zip(it.measurement.base_axes or (), masses, std, by_user, strict=True):
        what, unit = ("moment of inertia", "kg m²") if axis.startswith("r") else ("total mass", "kg")
        if it.facts.unit_mass:
            yield f"{what}, {axis}", f"~{number(mass)} {unit}, normalised: no mass is stated, no force was measured"
            continue
        exact = known and half_width(deviation, mass) in ("open", "0")
        words = f"{number(mass)} {unit}, as stated" if exact else _with_interval(it, mass, deviation, unit)
        yield f"{what}, {axis}", words


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
        words = f"missed by {missed} % of its accelerations relative to the base{beyond_lines(it, unseen)}"
        yield f"unfitted test {i}", words


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


def noise_table(it: Identification) -> str:
    """The noise of each channel."""
    found = tables.noise_of_channels(it)
    rows = [(one.channel, one.level_in_words, one.unit, aligned(one.percent), *one.signal_in_words) for one in found]
    of = "a sample in time, of noise up to half the sample rate"
    if grows := it.modal[0].shares is not None:
        of = "a line, of all lines together"
    caption = (
        f"Noise of each channel, {tables.noise_source(it)}: standard deviation of {of} (from least to most, where runs "
        "differ), and its share of what was recorded at the lines."
        + " The last column: the part of the noise that grows with the signal, as a share of it at each line; at most "
        "5 % is looked for." * grows
    )
    return table(("channel", *tables.noise_columns(it)), rows, caption)


def sensor_table(it: Identification) -> str:
    """The gain of each sensor as the records show it, and its delay."""
    found = tables.gains_of_sensors(it)
    priced = it.determined and any(g.worth > 0 for g in found)  # else M_SS has no deviation, or was stated
    late, within = any(g.delay for g in found), any(g.within for g in found)
    caption = (
        "Gain of each sensor against the base, as the constant term of the transmissibility shows it; masses assume 1"
        + ", what is likely within stated tolerances taken off; intervals of M, K and C hold the rest" * within
        + ". ±: half of the 95 % interval."
        + " Delay: by which the records were late; it was taken off." * late
        + " The last column: by how many of its stated deviations M_SS is off where a gain is 1 % off." * priced
    )
    columns = *["taken off"] * within, *["delay, ms", "±"] * late, *["1 % moves M_SS by, deviations"] * priced
    delays = [rounded(1e3 * g.delay, 1e3 * g.delay_std) * late for g in found]
    rows = [
        (g.sensor, *rounded(g.gain, g.std), *[f"{1 + g.within:.4f}"] * within, *delay, *[number(g.worth, 2)] * priced)
        for g, delay in zip(found, delays, strict=True)
    ]
    return table(("sensor", "gain", "±", *columns), rows, caption)
