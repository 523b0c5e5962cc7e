"""The report: one self-contained static page that tells an identification, from the verdict to the log."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from sysid import plot
from sysid._html import bullets, matrix, number, page, paragraph, picture, table, text
from sysid._panels import is_unit, run_names
from sysid.errors import InputError
from sysid.identification import Identification
from sysid.mass import FullMass
from sysid.measurement import Measurement
from sysid.storage import atomically
from sysid.structure import Array, ComplexArray, Structure

FILE_NAME = "report.html"
_SUFFIXES = (".html", ".htm")
_MANY_PANELS = 40  # beyond which the pictures are drawn with fewer pixels


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
    """How well `structure` predicts a test, sensor by sensor; 1 is perfect."""
    with_base = np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
    predicted = test.predict(structure)
    return Scores(
        _score(predicted, test.relative),
        _score(predicted + with_base, test.response),
        _score(with_base, test.response),
    )


def write(identification: Identification, path: str | Path) -> Path:
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
    target = Path(path)
    if target.suffix.lower() not in _SUFFIXES:
        if target.is_file():
            raise InputError(f"{target} is some other file: give a name that ends in .html, or a folder")
        target = target / FILE_NAME
    content = render(identification).encode("utf-8", "replace")
    with atomically(target) as temporary:
        temporary.write_bytes(content)
    return target


def render(identification: Identification) -> str:
    """Make the page, as a string."""
    it = identification
    return page(
        _title(it),
        _verdict(it),
        [
            ("Modes", _modes(it)),
            ("Rigid-body mass", _rigid_body_mass(it)),
            ("Measured against identified", _responses(it, it.measurement)),
            ("Base force", _base_force(it, it.measurement)),
            ("Validation", _validation(it)),
            ("Convergence", _convergence(it)),
            ("Modal assurance criterion", _mac(it)),
            ("Effective masses", _effective_masses(it)),
            ("Mode shapes", _mode_shapes(it)),
            ("Matrices", _matrices(it)),
            ("What ran", _what_ran(it)),
        ],
    )


def _title(it: Identification) -> str:
    name = PurePath(it.recipe.module).stem if it.recipe else ""
    return f"Identification of {name}" if name else "Identification"


def _verdict(it: Identification) -> str:
    test, n, d = it.measurement, it.structure.n, it.structure.n_base
    runs = f"{test.n_runs} run{'s' if test.n_runs > 1 else ''}"
    head = paragraph(
        f"{n} degrees of freedom, {d} base direction{'s' if d > 1 else ''} ({', '.join(test.base_axes or ())}), "
        f"{runs}, {test.freq.size} lines from {test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz",
        "soft",
    )
    word = "Interrupted: the best until then" if it.interrupted else "Success" if it.success else "No success"
    lines = [f"<strong>{word}</strong>", paragraph(it.message)]
    residual = f"Relative residual {it.residual:.3e}, over the relative accelerations of all runs, sensors and lines"
    if it.problem.goal is not None:
        residual += f" (goal {it.problem.goal:.3g})"
    lines.append(paragraph(residual + "."))
    if it.force_residual is not None:
        lines.append(paragraph(f"Of the base force: {it.force_residual:.3e}."))
    head += f'<div class="verdict {"good" if it.success else "bad"}">{"".join(lines)}</div>'
    if it.determined:
        kind, word = "good", "Determined: this is the mass and stiffness, within the stated model"
    else:
        kind, word = "warn", "Not determined: this is one of many models that explain the data"
    lines = [f"<strong>{word}</strong>"]
    if not it.determined:
        lines.append(
            paragraph(
                "Frequencies, damping ratios and the responses to base motion hold for all of them; the mass, "
                "stiffness and damping matrices below are one choice. What is open:"
            )
        )
        lines.append(bullets(_sentence(s) for s in it.undetermined))
        if it.closed_by:
            lines.append(paragraph("What is fixed:"))
    elif it.closed_by:
        lines.append(paragraph("What fixes it:"))
    lines.append(bullets(_sentence(s) for s in it.closed_by))
    return head + f'<div class="verdict {kind}">{"".join(lines)}</div>'


def _modes(it: Identification) -> str:
    structure, reference = it.structure, it.problem.reference
    axes = it.measurement.base_axes or ()
    share = structure.effective_mass_percent
    head = ["mode", "frequency [Hz]", "damping [%]", *(f"effective mass {a} [%]" for a in axes)]
    known = reference if reference is not None and reference.n == structure.n else None
    if known is not None:
        head += ["reference [Hz]", "difference [%]", "reference damping [%]", "difference [%]"]
    rows = []
    for k, (f, zeta) in enumerate(zip(structure.natural_frequencies, structure.damping_ratios, strict=True)):
        row = [k + 1, number(f, 6), number(100 * zeta), *(f"{v:.2f}" for v in share[k])]
        if known is not None:
            f0, zeta0 = known.natural_frequencies[k], known.damping_ratios[k]
            row += [number(f0, 6), _difference(f, f0), number(100 * zeta0), _difference(zeta, zeta0)]
        rows.append(row)
    rows.append(["sum", "", "", *(f"{v:.2f}" for v in share.sum(axis=0)), *[""] * (4 if known is not None else 0)])
    return table(head, rows, "Effective mass in % of the rigid-body mass of its base direction.")


def _rigid_body_mass(it: Identification) -> str:
    axes, turns = it.measurement.base_axes or (), ~it.measurement.translational
    rigid, reference = it.structure.rigid_body_mass, it.problem.reference
    parts = []
    if it.problem.unit_mass:
        parts.append(
            paragraph(
                "No mass is stated and no base force was measured: the masses are normalised to 1 kg in each base "
                "direction. All mass, stiffness and damping entries carry this scale, which the data do not tell."
            )
        )
    unit = "kg" if not turns.any() else "kg; kg m where one axis is a rotation, kg m² where both are"
    parts.append(matrix(rigid, axes, axes, f"Total mass M_rb = [G; I]' M [G; I], {unit}."))
    if reference is not None:
        parts.append(matrix(reference.rigid_body_mass, axes, axes, f"Of the reference, {unit}."))
    return "".join(parts)


def _responses(it: Identification, test: Measurement) -> str:
    if is_unit(test):
        words = (
            "Absolute acceleration of each sensor per unit base acceleration (transmissibility), magnitude and phase. "
            "The difference of the two is drawn faint."
        )
    else:
        words = (
            "Spectra of each sensor's absolute acceleration in each run, as the base moved: not transmissibilities. "
            "The phase is told against the base direction that moved most. The difference of the two is drawn faint."
        )
    dpi = 130 if test.n_sensors * test.n_runs <= _MANY_PANELS else 92
    parts = [paragraph(words, "soft")]
    for s, name in enumerate(test.sensor_names):
        alt = f"{name}: measured and identified response, {', '.join(run_names(test))}"
        parts.append(picture(plot.responses(it, s, measurement=test), alt, dpi=dpi))
    return "\n".join(parts)


def _base_force(it: Identification, test: Measurement) -> str:
    if test.force is None:
        return ""
    residual = number(test.force_residual(it.structure))
    parts = [paragraph(f"Force of the base on the structure. Relative residual over all of it: {residual}.", "soft")]
    for r, name in enumerate(run_names(test)):
        alt = f"measured and identified base force, {name}"
        parts.append(picture(plot.base_forces(it, r, measurement=test), alt))
    return "\n".join(parts)


def _validation(it: Identification) -> str:
    parts = []
    for i, test in enumerate(it.problem.validation):
        parts.append(f"<h3>Test {i + 1} of {len(it.problem.validation)}: predicted, never fitted</h3>")
        residual = f"Relative residual {number(test.residual(it.structure))}"
        if test.force is not None:
            residual += f", of the base force {number(test.force_residual(it.structure))}"
        parts += [paragraph(residual + "."), _score_table(it, test), _responses(it, test), _base_force(it, test)]
    if parts:
        parts.append("<h3>The test that was fitted, for comparison</h3>" + _score_table(it, it.measurement))
    return "\n".join(parts)


def _score_table(it: Identification, test: Measurement) -> str:
    rows = zip(test.sensor_names, *scores(it.structure, test), strict=True)
    return table(
        ["sensor", "relative acceleration", "absolute acceleration", "“moves with the base”, absolute"],
        ([name, *(f"{v:.3f}" if np.isfinite(v) else "–" for v in values)] for name, *values in rows),
        "Score: 1 − ‖predicted − measured‖ / ‖measured‖ over all runs and lines; 1 is perfect.",
    )


def _convergence(it: Identification) -> str:
    history = it.history
    steps = max(history.local_curve.size - 1, 0)
    rows = [
        ["start", number(history.start), "best of the first candidates, or the start given"],
        ["swarm", number(history.swarm), f"{history.evaluations} candidates in {history.swarm_curve.size} iterations"],
        ["refinement", number(history.refinement), "eigenvalues replaced by those given"],
        ["local phase", number(history.local), f"{steps} iteration{'' if steps == 1 else 's'}, exact derivatives"],
    ]
    if np.isfinite(history.refinement_error):
        rows[2][2] += f", within {history.refinement_error:.1e} (relative, ω²)"
    parts = [
        picture(plot.convergence(it), "residual through swarm, refinement and local phase"),
        table(["after", "relative residual", ""], rows, words=True),
    ]
    if history.states:
        parts.append(table(["state of the swarm", "iterations"], history.states))
    return "".join(parts)


def _mac(it: Identification) -> str:
    known = it.problem.reference is not None
    words = (
        "Identified mode shapes against those of the reference at the sensors: 1 on the diagonal where they agree."
        if known
        else "Mode shapes against each other (no reference is known): off-diagonal entries near 1 tell modes that "
        "these sensors cannot tell apart."
    )
    return paragraph(words, "soft") + picture(plot.mac(it), "modal assurance criterion", colours=None)


def _effective_masses(it: Identification) -> str:
    words = "Bars: each mode; lines: their running sum. What is missing to 100 % moves with the base."
    return paragraph(words, "soft") + picture(plot.effective_masses(it), "effective masses by mode and base direction")


def _mode_shapes(it: Identification) -> str:
    try:
        figure = plot.mode_shapes(it)
    except InputError:  # no positions: no picture
        return ""
    return picture(figure, "mode shapes", "Sticks join neighbouring sensors; grey: at rest.")


def _matrices(it: Identification) -> str:
    structure, test = it.structure, it.measurement
    n, axes = structure.n, test.base_axes or ()
    names = test.sensor_names if n == test.n_sensors else tuple(f"{i + 1}" for i in range(n))
    scale = "; masses normalised to 1 kg" if it.problem.unit_mass else ""
    turns = not test.translational.all()
    coupling = "kg, kg m in columns of a rotation" if turns else "kg"
    base = "kg, kg m, kg m²" if turns else "kg"
    M, K = structure.mass, structure.stiffness
    parts = [
        paragraph(
            "Heat maps: each entry over the root of its two diagonal entries. Tables: entries below 1e-12 of a "
            "matrix's largest are round-off, and stand as 0.",
            "soft",
        ),
        picture(plot.matrices(it), "heat maps of the mass, stiffness and damping matrices", colours=None),
        matrix(M[:n, :n], names, names, f"Mass M_SS, kg{scale}"),
        matrix(M[:n, n:], names, axes, f"Coupling mass M_S0, {coupling}{scale}"),
        matrix(M[n:, n:], axes, axes, f"Base mass M_00, {base}{scale}"),
        matrix(K[:n, :n], names, names, f"Stiffness K_SS, N/m{scale}"),
        matrix(structure.damping, names, names, f"Damping C on the motion relative to the base, N s/m{scale}"),
    ]
    return "".join(parts)


def _what_ran(it: Identification) -> str:
    from sysid import __version__

    problem, recipe = it.problem, it.recipe
    facts: list[list[object]] = [
        ["strategy", it.strategy],
        ["seed", "–" if it.seed is None else it.seed],
        ["wall time", f"{it.history.wall_time:.1f} s"],
        ["mass model", _model(problem.mass)],
        ["stiffness model", _model(problem.stiffness)],
        ["damping model", _model(problem.damping)],
        ["sysid", __version__],
    ]
    if recipe is not None:
        facts[:0] = [["problem", recipe.module], ["data", recipe.data or "its own"], ["problem's rng", recipe.rng]]
    counts = [*problem.unknowns, ("together", problem.n_variables)]
    log = f"<h3>Log</h3><pre>{text(chr(10).join(it.history.log))}</pre>" if it.history.log else ""
    return (
        table(["", ""], facts, words=True)
        + table(["matrix", "unknowns"], counts, "Unknowns of the search, matrix by matrix.")
        + log
    )


def _score(predicted: ComplexArray, measured: ComplexArray) -> Array:
    size = np.linalg.norm(measured, axis=(0, 2))
    miss = np.linalg.norm(predicted - measured, axis=(0, 2))
    return 1 - np.divide(miss, size, out=np.full_like(miss, np.nan), where=size > 0)


def _difference(value: float, reference: float) -> str:
    return f"{100 * (value / reference - 1):+.2g}" if reference else "–"


def _sentence(words: str) -> str:
    """Begin with a capital, end with a stop."""
    return words[:1].upper() + words[1:] + ("" if words.endswith((".", "!")) else ".")


def _model(model: object) -> str:
    kind = type(model).__name__
    return f"{kind} ({model.healing} healing)" if isinstance(model, FullMass) else kind
