"""The report: one self-contained static page that tells an identification, from the verdict to the log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from sysid import plot
from sysid.measurement.measurement import Measurement
from sysid.plot.canvas import default_style
from sysid.report.curves import curves, mode_shape_view
from sysid.report.html import (
    Cell,
    aligned,
    bullets,
    escaped,
    heat_maps,
    matrix,
    number,
    page,
    paragraph,
    picture,
    sentence,
    table,
)
from sysid.report.opening import (
    CHOSEN,
    ONE_OF_MANY,
    Lines,
    NoiseLevel,
    half_widths,
    matrix_tables,
    noise_of_test,
    noise_table,
    opening,
    rounded,
    sensor_table,
    share_of_noise,
    trust,
    width_text,
)
from sysid.results import tables
from sysid.results.facts import COLUMNS, seconds_in_words
from sysid.results.identification import Identification
from sysid.results.storage import atomically, file_or_folder
from sysid.results.summary import JUDGEMENTS, residual_in_words
from sysid.results.version import __version__
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import ROUND_OFF

FILE_NAME = "report.html"
_SUFFIXES = (".html", ".htm")
_PER_UNIT = "Absolute acceleration of each sensor per unit base acceleration (transmissibility), magnitude and phase."
_DRAWN_SHAPES = (
    "Motion relative to the base, which stands still, at the places of the sensors along their axes; grey: at rest. "
    "The largest motion is drawn alike in all modes."
)
_SHAPES_CAPTION = (
    "Motion of each sensor relative to the base, the largest of each mode 1. Sensors with positions have their mode "
    "shapes drawn."
)
_AS_MOVED = (
    "Spectra of each sensor's absolute acceleration in each run, as the base moved: not transmissibilities. The phase "
    "is told against the base direction that moves the sensor most with it."
)
_LAST_PHASE = "Only the last phase, of the start that ended best: any fits with widened peaks before it are left out."
_WIDENED = (
    "Dashed: the swarm's objective of responses with widened peaks, which does not compare with that of the records "
    "themselves; what the phases leave of these stands below."
)
_AGAINST_LEVEL = (
    "Level: envelope of the mode's own acceleration at the sensor where its shape is largest. Points: a linear mode "
    "fitted to each stretch of the records; where the level changes within it, its damping is too large."
)
_MAC_IN_NUMBERS = 12  # modes
_NORMALISED = "~ normalised, one of many"


class Scores(NamedTuple):
    """``1 - ‖predicted - measured‖ / ‖measured‖`` of each sensor over all runs and lines, (n_sensors,).

    NaN where nothing was measured. ``relative`` and ``absolute`` are the model's, on the accelerations
    relative to the base and as recorded; ``rigid`` is what "the sensors move with the base" scores
    on those recorded (on the relative ones it scores 0).
    """

    relative: Array
    absolute: Array
    rigid: Array


def scores(structure: Structure, test: Measurement) -> Scores:
    """Scores of a test as `structure` predicts it, sensor by sensor; 1 is perfect."""
    with_base = np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
    predicted = test.predict(structure)
    absolute, rigid = (_score(moved, test.response) for moved in (predicted + with_base, with_base))
    return Scores(_score(predicted, test.relative), absolute, rigid)


def write_report(identification: Identification, path: str | Path) -> Path:
    """Write the report, whole or not at all.

    Parameters
    ----------
    identification : Identification
    path : str or Path
        The file (``.html``), or the folder in which it becomes ``report.html``; folders are made.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    target = file_or_folder(path, FILE_NAME, _SUFFIXES)
    with default_style():
        content = render(identification).encode("utf-8", "replace")
    with atomically(target) as temporary:
        temporary.write_bytes(content)
    return target


def render(identification: Identification) -> str:
    """Make the page, as a string."""
    it = identification
    level = noise_of_test(it.fitted.records, it.structure)
    return page(
        _title(it),
        opening(it, level),
        [
            ("How far to trust it", trust(it)),
            ("Modes", _modes(it)),
            ("Amplitude", _amplitude(it)),
            ("Mode shapes", _shapes(it)),
            ("Measured against identified", _responses(it, it.measurement, level) + _residuals(it, level)),
            ("Validation", _validation(it)),
            ("Further tests", _further(it)),
            ("Total mass", _rigid_body_mass(it)),
            ("Unknowns", _unknowns(it)),
            ("Matrices", matrix_tables(it)),
            ("Noise", noise_table(it)),
            ("Sensors", sensor_table(it)),
            ("Outliers", _outliers(it)),
            ("Poles in the data", _poles(it)),
            ("Modal assurance criterion", _mac(it)),
            ("Effective masses", _effective_masses(it)),
            ("How it was found", _how(it) + _convergence(it) + _what_ran(it)),
        ],
    )


def _title(it: Identification) -> str:
    if it.recipe is None:
        return "Identification"
    return f"Identification of {PurePath(it.recipe.title.partition(' (')[0]).name.removesuffix('.py')}"


def _unknowns(it: Identification) -> str:
    rows = [
        (
            row.label, *rounded(row.value, row.std, 6), row.unit, number(row.lower), number(row.upper), row.on_bound,
        )
        for row in tables.unknown_rows(it)
    ]  # fmt: skip
    if not rows:
        return ""
    head = ("unknown", "value", "±", "unit", "lower", "upper", "")
    values = bullets(sentence(s) for s in tables.stated_values(it))
    return table(head, rows, "± is half of the 95 % interval that noise leaves; open: the data do not tell.") + values


def _modes(it: Identification) -> str:
    structure, reference, u = it.structure, it.records.reference, it.quick_uncertainty
    many, frequencies, percent = tables.is_one_of_many(it), structure.natural_frequencies, 100 * it.identified_ratios
    widths = np.zeros((2, structure.n)) if u is None else np.array([u.natural_frequencies, 100 * u.damping_ratios])
    rounded_frequencies = [rounded(f, std, 6) for f, std in zip(frequencies, widths[0], strict=True)]
    damping = [rounded(ratio, std) for ratio, std in zip(percent, widths[1], strict=True)]
    columns: list[list[object]] = [
        ["mode", *range(1, structure.n + 1), "sum"],
        ["frequency [Hz]", *(value for value, _ in rounded_frequencies), ""],
        ["damping [%]", *(value for value, _ in damping), ""],
    ]
    lines = it.measurement.freq
    notes = [f"Modes within the lines, {number(lines[0])} to {number(lines[-1])} Hz."] * (
        it.structure.residual.count > 0
    )
    notes.append("Effective mass in % of the rigid-body mass of its base direction.")
    notes += ["Modes that follow an amplitude are given at rest."] * bool(structure.laws)
    if u is not None:
        columns.insert(2, ["±", *(width for _, width in rounded_frequencies), ""])
        columns.append(["±", *(width for _, width in damping), ""])
        notes.append("±: half of the 95 % interval that the noise of the records makes; 0 where it is round-off.")
        notes += ["It holds for a model that fits: this one does not."] * (not it.success)
        if it.measurement.response_std is None:
            notes.append("No noise is stated, so the misfit is taken for it.")
    columns += _effective_mass_columns(it, many)
    if reference is not None and reference.n == structure.n:
        for name, ours, theirs, digits in (
            ("reference [Hz]", frequencies, reference.natural_frequencies, 6),
            ("reference damping [%]", percent, 100 * reference.damping_ratios, 4),
        ):
            columns.append([name, *(number(value, digits) for value in theirs), ""])
            columns.append(["difference [%]", *map(_difference, ours, theirs), ""])
    if many.any():
        notes.append("~: one of many values that fit as well.")
    notes += map(sentence, tables.missing_mass(it))
    head, *rows = zip(*columns, strict=True)
    return table(head, rows, " ".join(notes))


def _amplitude(it: Identification) -> str:
    """Laws of modes that follow their amplitude, beside what stretches of the records show; nothing without a law."""
    if not it.structure.laws:
        return ""
    return picture(plot.amplitude(it), "frequency and damping ratio against level", _AGAINST_LEVEL)


def _shapes(it: Identification) -> str:
    drawn = mode_shape_view(it)
    if drawn:
        return paragraph(_DRAWN_SHAPES, "soft") + drawn
    shapes = it.structure.mode_shapes
    largest = np.take_along_axis(shapes, np.abs(shapes).argmax(axis=0)[None], axis=0)
    shapes = np.divide(shapes, largest, out=np.zeros_like(shapes), where=largest != 0)
    rows = [*it.measurement.sensor_names, "base"]
    columns = [f"mode {k}" for k in range(1, it.structure.n + 1)]
    return matrix(np.vstack([shapes, np.zeros(it.structure.n)]), rows, columns, _SHAPES_CAPTION)


def _effective_mass_columns(it: Identification, many: Array) -> Iterator[list[object]]:
    """Effective masses of all modes and their sum, a column a base direction."""
    share, std = it.structure.effective_mass_percent, tables.mass_percent_std(it)
    for i, axis in enumerate(it.measurement.base_axes or ()):
        below = [_below_percent(tables.half_width(value, 100.0)) for value in std[:, i]]
        cells = [
            Cell(f"{tables.tilde(one)}{v:.2f}", b) for v, one, b in zip(share[:, i], many[:, i], below, strict=True)
        ]
        yield [f"effective mass {axis} [%]", *cells, f"{tables.tilde(many[:, i])}{share[:, i].sum():.2f}"]


def _below_percent(width: str) -> tuple[str, ...]:
    """Line below a share that is told to 0.01 %: half of its 95 % interval, where that is known and not round-off."""
    if width in ("open", "0"):
        return ()
    return (f"± {width_text(width)}" if float(width) >= 0.005 else "± <0.01",)


def _rigid_body_mass(it: Identification) -> str:
    axes, turns = it.measurement.base_axes or (), ~it.measurement.translational
    rigid, reference = it.structure.rigid_body_mass, it.records.reference
    unit = "kg; kg m where one axis is a rotation, kg m² where both are" if turns.any() else "kg"
    parts, label, u = "", _NORMALISED * it.facts.unit_mass, it.quick_uncertainty
    below: Lines = []
    if it.facts.unit_mass:
        parts = paragraph(
            "No mass is stated and no base force was measured: the masses are normalised to 1 kg in each base "
            "direction. All mass, stiffness and damping entries carry this scale, which the data do not tell."
        )
    elif u is not None:
        below = half_widths(rigid, u.rigid_body_mass, it.facts.stated_rigid_body)
        label = ONE_OF_MANY * bool(np.all(np.isnan(u.rigid_body_mass)) and not it.facts.stated_rigid_body.any())
    parts += matrix(rigid, axes, axes, f"Total mass M_rb = [G; I]' M [G; I], {unit}.", below=below, label=label)
    rows = [
        (axis, number(total), f"{tables.tilde(open_)}{number(of_modes)}", number(100 * of_modes / total))
        for axis, total, of_modes, open_, _ in tables.masses_of_modes(it)
    ]
    caption = "Effective masses of all modes together, beside the total mass; kg, or kg m² about an axis."
    parts += table(("base", "total mass", "in these modes", "share [%]"), rows, caption)
    if reference is not None:
        parts += matrix(reference.rigid_body_mass, axes, axes, f"Of the reference, {unit}.")
    return parts


def _responses(it: Identification, test: Measurement, level: NoiseLevel) -> str:
    words = _PER_UNIT if test.has_unit_runs else _AS_MOVED
    if test is it.measurement and it.records.measurement.is_whole:
        words += " The transients of the records are taken off."
    return paragraph(words, "soft") + curves(it, test, level)


def _residuals(it: Identification, level: NoiseLevel) -> str:
    """Residual of each channel, beside its noise."""
    test = it.fitted.records
    noise = share_of_noise(level.response, test.relative)
    if test.force is not None:
        noise = np.concatenate([noise, share_of_noise(level.force, test.force)])
    known, beyond = bool(np.any(np.isfinite(noise))), it.structure.residual.count > 0
    rows = [
        (one.channel, aligned(100 * one.left), *[aligned(100 * share)] * known, *[aligned(100 * one.beyond)] * beyond)
        for one, share in zip(tables.fit_of_channels(it), noise, strict=True)
    ]
    caption = "What the fit leaves of each channel: ‖identified - measured‖ / ‖measured‖, of accelerations relative "
    caption += "to the base; and its noise likewise." if known else "to the base."
    caption += " Of what was measured, residual modes, which lie beyond the lines, add the last column." * beyond
    caption += " Outliers that stand alone are left out." * (test is not it.measurement)
    heads = ("channel", "left [%]", *[f"noise{level.bound} [%]"] * known, *["modes beyond [%]"] * beyond)
    return table(heads, rows, caption)


def _outliers(it: Identification) -> str:
    """The numbers that are farthest from the fit."""
    found = it.outliers
    rows = [(o.test, o.run, o.channel, number(o.freq, 6), number(o.size, 3)) for o in found[:10]]
    more = len(found) - len(rows)
    all_of_them = "summary.json and Identification.outliers hold all of them"
    caption = "Numbers of the records that are farthest from the fit; test 1 is the problem's own."
    head = ("test", "run", "channel", "frequency [Hz]", "deviations from the fit")
    return table(head, rows, caption) + (paragraph(f"And {more} more: {all_of_them}.", "soft") if more else "")


def _further(it: Identification) -> str:
    parts = []
    for i, (test, structure) in enumerate(it.further_tests, start=1):
        parts.append(f"<h3>Test {i} of {len(it.further_tests)}, fitted beside the first one</h3>")
        parts.append(paragraph(f"{_residual(test, structure)}; the structure as it was then:"))
        rows = zip(structure.natural_frequencies, 100 * structure.damping_ratios, strict=True)
        cells = [(k, number(f, 6), number(ratio)) for k, (f, ratio) in enumerate(rows, start=1)]
        parts.append(table(("mode", "frequency [Hz]", "damping [%]"), cells))
        scored = zip(test.sensor_names, map(number, scores(structure, test).relative), strict=True)
        caption = "1 - ‖predicted - measured‖ / ‖measured‖ of the accelerations relative to the base."
        parts.append(table(("sensor", "score"), scored, caption))
    return "\n".join(parts)


def _residual(test: Measurement, structure: Structure) -> str:
    force = "" if test.force is None else f", of the base force {number(test.force_residual(structure))}"
    return f"Relative residual {number(test.residual(structure))}{force}"


def _validation(it: Identification) -> str:
    parts = []
    for i, test in enumerate(it.validation, start=1):
        parts += [
            f"<h3>Test {i} of {len(it.records.validation)}: predicted, never fitted</h3>",
            paragraph(f"{_residual(test, it.structure)}{tables.beyond_lines(it, test)}."),
            _score_table(it, test),
            _responses(it, test, noise_of_test(test, it.structure)),
        ]
    if parts:
        parts.append("<h3>The test that was fitted, for comparison</h3>" + _score_table(it, it.fitted.records))
    return "\n".join(parts)


def _score_table(it: Identification, test: Measurement) -> str:
    rows = zip(test.sensor_names, *scores(it.structure, test), strict=True)
    return table(
        ["sensor", "relative acceleration", "absolute acceleration", "“moves with the base”, absolute"],
        ([name, *(f"{v:.3f}" if np.isfinite(v) else "–" for v in values)] for name, *values in rows),
        "Score: 1 − ‖predicted − measured‖ / ‖measured‖ over all runs and lines; 1 is perfect.",
    )


def _poles(it: Identification) -> str:
    diagram = plot.stabilisation(it)
    left = (
        "poles of models of rising order, over the largest singular value of the FRFs; a mode is a column of poles "
        "that stay where they are"
    )
    if diagram.axes[0].texts:
        left = "the largest singular value; why it is without poles stands in the picture"
    right = "all singular values; two that peak at one line are two modes there"
    aside = ", outliers that stand alone left out" * (it.records.loss == "huber")
    indicator = plot.cmif(it)
    for figure in (diagram, indicator):
        figure.set_size_inches(5.6, 4.2)  # beside each other, and on a phone, at nearly the size of their words
    return paragraph(f"What the records show without the model{aside}. Left: {left}. Right: {right}.", "soft") + (
        f'<div class="pair">{picture(diagram, "stabilisation diagram", right=0.7)}'
        f"{picture(indicator, 'complex mode indicator function')}</div>"
    )


def _convergence(it: Identification) -> str:
    history = it.history
    if not it.phases:
        return ""
    steps = max(history.local_curve.size - 1, 0)
    refined = "eigenvalues replaced by those given"
    if np.isfinite(history.refinement_error):
        refined += f", within {history.refinement_error:.1e} (relative, ω²)"
    ran = it.phases
    swarm = f"{history.evaluations} candidates in {history.swarm_curve.size} iterations of the swarm; {refined}; "
    note = swarm * bool(history.swarm_curve.size) + f"{tables.counted(steps, 'local iteration')}, exact gradients"
    if it.records.reference is not None:
        note += ". Errors are those of the reference: M_SS, K_SS and C in Frobenius norm"
    alt = f"objective through {', '.join(row[0] for row in ran) or 'no search'}"
    caption = _LAST_PHASE * (it.strategy == "continuation")
    if history.swarm_curve.size and np.isnan(history.start):
        caption = _WIDENED
    parts = [picture(plot.convergence(it), alt, caption)] if _falls(it) else []
    columns = [k for k in range(len(COLUMNS)) if any(row[k] != "-" for row in ran)]  # of a reference only where it is
    rows = [[row[k] for k in columns] for row in ran]
    parts.append(table([COLUMNS[k] for k in columns], rows, f"{note}.", words=True))
    if history.restarts:
        again = (
            f"{tables.counted(history.restarts, 'further swarm')} followed, as the first ended at no solution that fits"
        )
        parts.append(paragraph(f"{again}; {history.evaluations} candidates are those of all.", "soft"))
    if history.refinement_in_words:
        parts.append(paragraph(f"{history.refinement_in_words}.", "soft"))
    parts.append(table(["state of the swarm", "iterations"], history.states))
    return "".join(parts)


def _falls(it: Identification) -> bool:
    """True where there is a search to be seen: a swarm's, or one whose objective fell by more than a tenth."""
    local = it.history.local_curve
    return bool(it.history.swarm_curve.size or (local.size > 1 and local[-1] < 0.9 * local[0]))


def _mac(it: Identification) -> str:
    known = it.records.reference is not None
    words = (
        "Identified mode shapes (rows) against those of the reference (columns) at the sensors: 1 on the diagonal "
        "where they agree."
        if known
        else "Mode shapes against each other (no reference is known): off-diagonal entries near 1 tell modes that "
        "these sensors cannot tell apart."
    )
    drawn, numbers = heat_maps({"MAC": it.mac}, "Blues", 0.0), ""
    if max(it.mac.shape) <= _MAC_IN_NUMBERS:
        rows, columns = (range(1, size + 1) for size in it.mac.shape)
        numbers = matrix(it.mac.round(3), rows, columns, "MAC" + " against the reference" * known)
    return paragraph(words, "soft") + drawn + numbers


def _effective_masses(it: Identification) -> str:
    words, reference = "Bars: each mode; lines: their running sum", it.records.reference
    words += "; short dashes: each mode of the reference" * (reference is not None and reference.n == it.structure.n)
    words += ". What is missing to 100 % moves with the base, or in modes beyond the lines."
    label, caption = (ONE_OF_MANY, CHOSEN) if tables.is_one_of_many(it).any() else ("", "")
    alt = "effective masses by mode and base direction"
    return paragraph(words, "soft") + picture(plot.effective_masses(it), alt, caption, label=label)


def _how(it: Identification) -> str:
    """Objective and end of the search, in its own words."""
    all_records = "over the relative accelerations of all runs, sensors and lines, unweighted"
    all_records += "; outliers that stand alone are left out" * (it.records.loss == "huber")
    of = all_records if it.residuals else "of the misfit that the problem states"
    lines = [
        f"{JUDGEMENTS[it.judgement]}. The search: {it.message}.",
        *(sentence(str(one)) for one in it.of_kind("strategy")),
        f"Relative residual {residual_in_words(it)}, {of}.",
        f"Objective {it.objective:.3e}: all that is fitted, each record weighted by its noise.",
    ]
    if it.force_residual is not None:
        lines.append(f"Of the base force: {it.force_residual:.3e}.")
    return "".join(map(paragraph, lines))


def _what_ran(it: Identification) -> str:
    of_problem, recipe = it.facts, it.recipe
    facts: list[list[object]] = []
    if recipe is not None:
        facts += [["problem", recipe.title], ["data", recipe.data or "its own"], ["problem's rng", recipe.rng]]
    facts += [
        ["strategy", it.strategy],
        ["seed", "–" if it.seed is None else it.seed],
        ["wall time", seconds_in_words(it.history.wall_time)],
    ]
    facts += [[f"{name} model", words] for name, words in of_problem.models]
    facts.append(["sysid", __version__])
    counts = [*of_problem.counts, ("together", of_problem.n_variables)]
    log = f"<h3>Log</h3><pre>{escaped(chr(10).join(it.history.log))}</pre>" if it.history.log else ""
    return (
        table(["", ""], facts, words=True)
        + table(["matrix", "unknowns"], counts, "Unknowns of the search, matrix by matrix.")
        + log
    )


def _score(predicted: ComplexArray, measured: ComplexArray) -> Array:
    return 1 - tables.share_of_channels(predicted - measured, measured)


def _difference(value: float, reference: float) -> str:
    if not reference:
        return "–"
    share = value / reference - 1
    return f"{100 * share:+.2g}" if abs(share) > ROUND_OFF else "0"
