"""The opening of a report: what was identified, how far to trust it, its figures, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sysid.report.html import bullets, number, paragraph, sentence, table, text
from sysid.results.identification import Identification
from sysid.results.summary import DEVIATES, counted, half_width, next_steps, verdict
from sysid.results.unknowns_table import rows_of
from sysid.structure.structure import Array, ComplexArray

_KIND = {"determined": "good", "one of many": "warn", "no fit": "bad"}
_WORD = {"determined": "Determined", "one of many": "One of many", "no fit": "No fit"}
_MOST_MODES, _MOST_UNKNOWNS = 4, 5  # whose figures stand in the opening; all of them follow


def opening(it: Identification) -> str:
    """HTML of what was identified, the judgement, the next thing to do, and the figures."""
    word = "Stopped before its end: the best until then. " * it.interrupted + _WORD[it.judgement]
    judged = paragraph(_meaning(it)) + f"<p><b>Next:</b> {text(_next(it))}</p>"
    box = f'<div class="verdict {_KIND[it.judgement]}"><strong>{text(word)}</strong>{judged}</div>'
    rows = [*_masses(it), *_unknowns(it), *_modes(it), *_fit(it)]
    return _subject(it) + box + table(["", ""], rows, words=True)


def trust(it: Identification) -> str:
    """HTML of what speaks against the answer, what is open, and what fixes it; remarks after these."""
    parts = []
    if it.undetermined:
        parts.append(paragraph("Open, or against it:") + bullets(map(sentence, it.undetermined)))
        if it.success:
            parts.append(
                paragraph(
                    "Frequencies, damping ratios and responses to base motion hold whichever of these models is taken; "
                    "mass, stiffness and damping matrices are one choice."
                )
                if it.is_one_of_many
                else ""
            )
    if it.closed_by:
        parts.append(paragraph("What fixes the matrices:") + bullets(map(sentence, it.closed_by)))
    if it.remarks[1:]:
        parts.append(paragraph("To be known besides:") + bullets(map(sentence, it.remarks[1:])))
    return "".join(parts)


def _subject(it: Identification) -> str:
    test, n, d = it.measurement, it.structure.n, it.structure.n_base
    of = f"{n} degrees of freedom"
    if n != test.n_sensors:
        of += f" from {test.n_sensors} sensors"
    told = (
        f"{of}, {counted(d, 'base direction')} ({', '.join(test.base_axes or ())}), {counted(test.n_runs, 'run')}, "
        f"{test.lines_in_words}, {'with' if test.force is not None else 'without'} base force"
    )
    return paragraph(told, "soft")


def _meaning(it: Identification) -> str:
    if it.judgement == "no fit":
        return sentence(f"these matrices do not explain the records: {it.confidence[0]}")
    return sentence(verdict(it).partition(": ")[2] or verdict(it))


def _next(it: Identification) -> str:
    """The one thing to do next."""
    steps = next_steps(it)
    if steps:
        return sentence(steps[0].removeprefix("to close it: "))
    if it.judgement == "one of many":
        return "mend or measure what is named first below."
    if not it.problem.validation:
        return "predict a test that was not fitted (validation=[...]): it alone shows what the model leaves out."
    return "take the matrices: sysid export writes them for Nastran, MATLAB and others."


def _masses(it: Identification) -> Iterator[tuple[str, str]]:
    if it.problem.unit_mass:
        yield "total mass", "not determined: no mass is stated and no force was measured (1 kg is taken)"
        return
    masses, std = np.diag(it.structure.rigid_body_mass), np.diag(it.quick_std("rigid_body_mass"))
    for axis, mass, own in zip(it.measurement.base_axes or (), masses, std, strict=True):
        unit = "kg m²" if axis.startswith("r") else "kg"
        yield f"total mass, {axis}", f"{_with_interval(mass, own)} {unit}"


def _unknowns(it: Identification) -> Iterator[tuple[str, str]]:
    """Unknowns with a meaning of their own, where they are few."""
    rows = rows_of(it)
    for row in rows if len(rows) <= _MOST_UNKNOWNS else ():
        yield row.label, f"{_with_interval(row.value, row.std)} {row.unit}"


def _modes(it: Identification) -> Iterator[tuple[str, str]]:
    s, u = it.structure, it.quick_uncertainty
    n = min(s.n, _MOST_MODES)
    widths = np.zeros((2, n)) if u is None else np.array([u.natural_frequencies[:n], u.damping_ratios[:n]])
    for k in range(n):
        f, percent = s.natural_frequencies[k], 100 * s.damping_ratios[k]
        damping = _with_interval(percent, 100 * widths[1, k])
        yield f"mode {k + 1}", f"{_with_interval(f, widths[0, k])} Hz, damping {damping} %"
    if s.n > n:
        yield "", f"and {counted(s.n - n, 'further mode')} up to {number(s.natural_frequencies[-1], 4)} Hz, below"


def _fit(it: Identification) -> Iterator[tuple[str, str]]:
    test = it.problem.screened.measurement
    left = f"{number(100 * it.residual, 3)} % of the accelerations relative to the base"
    noise = _share(test.response_std, test.relative)
    left += f" (noise {number(100 * noise, 3)} %)" if noise else ""
    if it.force_residual is not None and test.force is not None:
        left += f", {number(100 * it.force_residual, 3)} % of the base force"
        noise = _share(test.force_std, test.force)
        left += f" (noise {number(100 * noise, 3)} %)" if noise else ""
    yield "the fit leaves", left
    for i, unseen in enumerate(it.validation, start=1):
        yield f"unfitted test {i}", f"missed by {number(100 * unseen.residual(it.structure), 3)} %"


def _with_interval(value: float, std: float) -> str:
    """A value and half of its 95 % interval, to two digits of that; four digits of a value without noise."""
    if half_width(std, value) in ("open", "0"):
        return number(value) + " (open)" * (not np.isfinite(std))
    places = int(np.clip(1 - np.floor(np.log10(DEVIATES * std)), 0, 9))
    return f"{value:.{places}f} ± {DEVIATES * std:.{places}f}"


def _share(std: Array | None, records: ComplexArray) -> float:
    """Noise over records, as the residual measures them; zero where it is not known."""
    if std is None:
        return 0.0
    return float(np.sqrt(np.sum(np.broadcast_to(std, records.shape) ** 2)) / np.linalg.norm(records))
