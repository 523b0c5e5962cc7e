"""An identification in words and figures: the summary for a terminal, and what it shares with the report."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

import numpy as np

from sysid.assessment.sensitivity import system_matrices
from sysid.finding import Judgement
from sysid.measurement.in_time import peaks
from sysid.results import tables
from sysid.results.answer import Answer
from sysid.results.facts import COLUMNS, seconds_in_words
from sysid.structure.thresholds import UNEXPLAINED

_SCALE = (
    "one number in kg is enough: state the mass of what the sensors stand for (sysid run test.h5 --lumped --mass KG; "
    "in Python LumpedMass(KG), or one unknown of a written mass), or measure the force between table and structure"
)
_NOT_COMPUTED = (
    "uncertainty not computed, as the time was over: Identification.uncertainty and 'sysid report' compute it"
)
_RANGES_LEFT = (
    "how far the entries may go over all these models is not computed here: Identification.mass_interval and "
    "stiffness_interval compute it"
)
JUDGEMENTS: dict[Judgement, str] = {  # as screen, page and files write them
    "determined": "Determined", "one of many": "One of many", "doubtful": "Doubtful", "no fit": "No fit",
}  # fmt: skip
_AS_STATED = ". No force was measured: they are as right as the mass or stiffness that is stated"
WIDTH = 120  # letters in a line
FIRST = 2  # sentences beside the verdict; the others follow the tables
_FORCE = 3.0  # times the residual of the accelerations, from which that of the force is the larger concern
_OF_A_FIT = ", which holds for a model that fits: this one does not"


def summary(it: Answer) -> str:
    """Table of the result, at most 120 columns wide."""
    s, records = it.structure, it.records
    force = "" if it.force_residual is None else f", of the base force {it.force_residual:.3e}"
    sentences = it.undetermined or it.closed_by
    lines = [
        f"{JUDGEMENTS[it.judgement]}: {verdict(it)}." + ("" if it.success else f" Fitted: {fitted_in_words(it)}."),
        *(f"  - {sentence}" for sentence in sentences[:FIRST]),
        *(f"  > {step}" for step in next_steps(it)),
        "",
        *_mode_table(it),
        "",
        *_unknowns(it),
        f"relative residual {residual_in_words(it)}{force}; seed {it.seed}, {seconds_in_words(it.history.wall_time)}"
        + f"; {tables.counted(it.history.restarts, 'further swarm')}" * bool(it.history.restarts),
        *(tables.in_columns([COLUMNS, *it.phases]) if len(it.phases) > 1 else []),
        *filter(None, [it.history.refinement_in_words]),
        *map(str, (*it.of_kind("strategy"), *it.notes)),
        "rigid-body mass "
        + ", ".join(_rigid_masses(it))
        + " (~ normalised: no mass is stated, no force was measured)" * it.facts.unit_mass,
        *_deck_masses(it),
    ]
    lines += tables.stated_values(it)
    further = it.further_tests
    for i, (test, structure) in enumerate(further, start=1):
        frequencies = ", ".join(f"{f:.5g}" for f in structure.natural_frequencies[:8])
        lines.append(
            f"further test {i} of {len(further)}: relative residual {test.residual(structure):.3e}, natural "
            f"frequencies {frequencies} Hz"
        )
    for i, test in enumerate(it.validation, start=1):
        lines.append(
            f"test {i} of {len(records.validation)} never fitted: relative residual {test.residual(s):.3e}"
            + tables.beyond_lines(it, test)
        )
    lines += [*_noise(it), *_gains(it)]
    rest = [f"  - {sentence}" for sentence in sentences[FIRST:]]
    if it.judgement == "one of many" and not it.hurried and it.open_masses:
        rest += _ranges(it)
    lines += ["besides:"] * bool(rest) + rest
    lines += [f"assumed: {one}" for one in it.assumptions]
    lines += [_NOT_COMPUTED] * it.hurried
    lines.append(f"search: {it.message}")
    return "\n".join(folded(line) for line in lines)


def _noise(it: Answer) -> list[str]:
    """Table of the noise of each channel, where it was found or stated with the modes."""
    rows = [
        (one.channel, one.level_in_words, one.unit, f"{one.percent:.3g}", *one.signal_in_words)
        for one in tables.noise_of_channels(it)
    ]
    return _table((f"noise {tables.noise_source(it)}", *tables.noise_columns(it)), rows)


def _gains(it: Answer) -> list[str]:
    """Table of each sensor's gain as the records show it."""
    found = tables.gains_of_sensors(it)
    within = any(g.within for g in found)
    rows = [
        (g.sensor, f"{g.gain:.4f}", tables.half_width(g.std, g.gain), *[f"{1 + g.within:.4f}"] * within,
         "-" if np.isnan(g.worth) else f"{g.worth:.2g}")
        for g in found
    ]  # fmt: skip
    first = "gain against the base" + " (M assumes 1)" * (not within)
    head = (first, "by the records", "+- (95 %)", *["taken off"] * within, "1 % moves M_SS by, deviations")
    return _table(head, rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; nothing without rows, or with too many of them for a terminal."""
    return tables.in_columns([head, *rows]) if 0 < len(rows) <= tables.MANY else []


def residual_in_words(it: Answer) -> str:
    """The residual of all that is fitted, the goal beside it, and each test's own where there are more."""
    goal = "" if it.records.goal is None else f" (goal {it.records.goal:.3g})"
    if len(it.residuals) < 2:
        return f"{it.residual:.3e}{goal}"
    each = ", ".join(f"{value:.3e}" for value in it.residuals)
    return f"{it.residual:.3e}{goal} over {len(it.residuals)} tests (test by test {each})"


def verdict(it: Answer) -> str:
    """Meaning of the judgement for this answer."""
    match it.judgement:
        case "no fit":
            return "these matrices do not explain the records as they should"
        case "determined":
            one = "data and stated model leave one mass and one stiffness matrix"
            return one + _AS_STATED * it.facts.by_accelerations
        case "doubtful":
            return "a fit, but something speaks against this model, so that its matrices may be wrong"
    if it.of_kind("not judged"):
        return "as far as was judged before Ctrl-C or the end of the time"
    if it.hurried or it.is_one_of_many:
        return "other models explain the data as well"
    return "some entries of the matrices are not known well enough"


def fitted_in_words(it: Answer) -> str:
    """The runs that were fitted, and how strongly they move the sensors, where that is known."""
    test = it.records.measurement
    moved = [f"{level:.3g}" for level in sorted(peaks(test))]
    runs = tables.counted(test.n_runs, "run")
    if not moved:
        return runs
    to = " to ".join(dict.fromkeys((moved[0], moved[-1])))
    return f"{runs} (peak acceleration of the sensors relative to the base: {to} m/s²)"


def next_steps(it: Answer) -> list[str]:
    """Steps that would close what is open, in sentences."""
    if it.determined or it.hurried or it.of_kind("not judged"):
        return []
    if not it.success:
        return _towards_a_fit(it)
    if it.judgement == "doubtful":
        return ["deal with what speaks against this model, in the order given: correct it, or measure again"]
    if not it.is_one_of_many:
        return []
    if it.scale_is_open:
        return [_SCALE]
    if not it.open_masses:
        return [
            "state one of these unknowns (fixed=True with its value), a relation between them as a "
            "constraint, or fit another record that sees them: a base force, a sensor, a test with a known mass added"
        ]
    if it.measurement.force is not None:
        return ["to weigh these modes: more force at their frequencies, longer records, or another base direction"]
    return [
        "measure the force between table and structure; or state what is known of the mass, where it is "
        "true: that all of it sits at the sensors (sysid run test.h5 --lumped --mass KG; LumpedMass(KG)), or single "
        "masses (FullMass(known=...))" + "; a total mass alone only bounds it" * it.facts.mass_is_free
    ]


def _towards_a_fit(it: Answer) -> list[str]:
    """Steps towards a fit where there is none, the first thing first."""
    if it.interrupted:
        return ["let the search end: 'sysid run --resume FOLDER' goes on with one that the command line began"]
    if it.records.goal is not None:
        return ["put right what is named first; a goal below the noise of the records cannot be reached"]
    steps = ["deal with what speaks against it, in the order given"]
    if it.of_kind("changing"):
        one_by_one = "; 'sysid refine RESULT --leave-out run' shows what each run does to the answer"
        steps = [
            "fit by itself a run in which structure and level of motion stay the same, at the level of interest: "
            "'sysid read RUN.csv --out one.h5', then 'sysid run one.h5'" + one_by_one * tables.runs_can_be_left_out(it)
        ]
        if not it.structure.laws and any(one.numbers.get("trend") for one in it.of_kind("changing")):
            steps.append(
                "or let the mode follow its amplitude, which whole records tell: sysid run test.h5 --amplitude "
                "(Problem(..., amplitude=AmplitudeLaw()))"
            )
    # A goal is of accelerations: it takes no force for explained.
    if it.residual > UNEXPLAINED or (it.force_residual or 0.0) > _FORCE * it.residual:
        return steps
    enough = f"{np.ceil(100 * it.residual) / 100:.2g}"
    return [*steps, f"if a fit as near as this one will do, say so: goal={enough} (sysid run test.h5 --goal {enough})"]


def _mode_table(it: Answer) -> list[str]:
    """Frequencies, damping and effective masses, with half-widths where they are known and there is room."""
    s, u, axes = it.structure, it.quick_uncertainty, it.measurement.base_axes or ()
    std, many = tables.mass_percent_std(it), tables.is_one_of_many(it)
    shares, k = s.effective_mass_percent, range(s.n)
    f_std = np.full(s.n, np.nan) if u is None else u.natural_frequencies
    columns = [
        ["mode", *(f"{i + 1}" for i in k), "sum"],
        ["frequency, Hz", *map(tables.as_known, s.natural_frequencies, f_std), ""],
        ["damping, %", *("-" if np.isnan(zeta) else f"{100 * zeta:.4g}" for zeta in it.identified_ratios), ""],
    ]
    if u is not None:
        columns.insert(2, ["+-", *map(tables.half_width, u.natural_frequencies, s.natural_frequencies), ""])
        columns.append(["+-", *map(tables.half_width, 100 * u.damping_ratios, 100 * s.damping_ratios), ""])
    cells = np.vstack([shares, shares.sum(axis=0)])
    marks = np.vstack([many, many.any(axis=0)])
    masses = [
        [f"mass {axis}, %", *(f"{tables.tilde(mark)}{share:.1f}" for share, mark in zip(*entries, strict=True))]
        for axis, *entries in zip(axes, cells.T, marks.T, strict=True)
    ]
    mass_widths = [["+-", *(tables.half_width(value, 100.0) for value in entries), ""] for entries in std.T]
    both = [column for pair in zip(masses, mass_widths, strict=True) for column in pair]
    lines = tables.in_columns(zip(*columns, *both, strict=True))
    if not np.any(np.isfinite(std)) or len(lines[0]) > WIDTH:
        lines = tables.in_columns(zip(*columns, *masses, strict=True))
    notes = [] if u is None else ["+- half of the 95 % interval" + _OF_A_FIT * (not it.success)]
    notes.append("mass: effective, in % of the rigid-body mass")
    notes += ["~ one of many values that fit as well"] * bool(many.any())
    notes += ["modes that follow an amplitude: at rest"] * bool(s.laws)
    return [*lines, "; ".join(notes), *tables.missing_mass(it), *tables.residual_modes(it)]


def _deck_masses(it: Answer) -> list[str]:
    """The masses of a lumped model, in one line."""
    masses = [
        f"{one.name} {tables.tilde(one.one_of_many)}{one.mass:.5g}"
        f"{tables.known_half_width(one.std, one.mass, ' +-')} kg"
        for one in tables.deck_masses(it)
    ]
    return [f"masses at the sensors (diagonal of M_SS): {', '.join(masses)}"] * bool(masses)


def _unknowns(it: Answer) -> list[str]:
    """Table of the unknowns that mean something by themselves, where there are some and not too many."""
    computed = it.quick_uncertainty is not None
    cells = [
        (
            row.label, f"{row.value:.6g}", tables.half_width(row.std, row.value) if computed else "-", row.unit,
            row.on_bound or f"{row.lower:.4g} to {row.upper:.4g}",
        )
        for row in tables.unknown_rows(it)
    ]  # fmt: skip
    lines = _table(("unknown", "value", "+- (95 %)", "unit", "search space"), cells)
    return [*lines, *[""] * bool(lines)]


def _rigid_masses(it: Answer) -> Iterator[str]:
    """Rigid-body mass by base direction, with its half-width where noise moves it, and what of it is in the modes."""
    for one, deviation in zip(tables.masses_of_modes(it), np.diag(it.quick_std("rigid_body_mass")), strict=True):
        width = tables.known_half_width(deviation, one.rigid_body, " +-")
        words = f"{tables.tilde(it.facts.unit_mass)}{one.rigid_body:.6g}{width} {one.unit}"
        modes = f" ({tables.tilde(one.one_of_many)}{one.in_modes:.4g} {one.unit} in these modes)"
        yield f"{one.axis} {words}" + modes * (not it.facts.unit_mass)


def _ranges(it: Answer) -> Iterator[str]:
    """Ranges of the diagonals, in one line, where something may move; where that takes time, what computes them."""
    if it.scale_is_open:
        return
    ends = it.intervals_at_once
    if ends is None:
        yield f"  - {_RANGES_LEFT}"
        return
    words = []
    M, K, _ = system_matrices(it.structure)
    for name, matrix, (lower, upper) in (("M_SS", M, ends.mass), ("K_SS", K, ends.stiffness)):
        diagonal = np.diag(matrix)
        low, high = abs(float(np.min(np.diag(lower) / diagonal))), float(np.max(np.diag(upper) / diagonal))
        if high - low > 1e-6:
            top = f"{high:.3g} times" if np.isfinite(high) else "any number of times"
            words.append(f"{low:.3g} to {top} those of this {name}")
    if words:
        yield f"  - over all these models the diagonal entries are {', '.join(words)}"


def folded(line: str) -> str:
    """Fold a long line at the width of a terminal, the rest indented."""
    if len(line) <= WIDTH:
        return line
    indent = "    " if line.startswith(("  - ", "  > ")) else "  "
    return textwrap.fill(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
