"""Spectra averaged over segments: peaks that are too narrow for their lines, and modes that leakage doubles."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.finding import Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import NEGLIGIBLE

_SAME_SHAPE = 0.95  # modal assurance criterion
_FEWEST = 8.0  # lines in a half-power width; a Hann window then takes 2 % off a peak, and more with fewer
_RESOLVED = 2.5  # distances of lines; narrower peaks are mostly the window's
_TWICE = 2.0  # distances of lines, within which a peak that was smeared over them is taken for two modes
_MISSED = 3.0  # times the relative misfit elsewhere, beyond which spectra of unknown origin show a peak flattened
_NEAR = 1.5  # half-power widths, or distances of lines, about a peak


class Peaks(NamedTuple):
    """Modes within the lines: numbers as users count them, Hz, half-power widths and distances of lines there, Hz."""

    number: NDArray[np.intp]
    frequency: Array
    width: Array
    spacing: Array


def leakage(test: Measurement, structure: Structure) -> Iterator[Finding]:
    """Lines are too coarse for the modes that were found, and modes that may be none.

    Averages over segments (`Measurement.averaged`) are judged by their lines alone. Frequency response functions of
    unknown origin may be exact at any lines, so that they must miss more at the peak than elsewhere. Spectra of whole
    records are no averages, and never judged.
    """
    if test.freq.size < 2 or not (test.averaged or test.has_unit_runs):
        return
    peaks = _peaks(test, structure)
    coarse = peaks.spacing * _FEWEST > peaks.width
    averaged = "" if test.averaged else "if these spectra are averages over segments, "
    groups = _found_twice(peaks, coarse, structure)
    if groups:
        of_groups = ", ".join(" and ".join(f"{f:.4g}" for f in peaks.frequency[group]) for group in groups)
        most = np.max(peaks.spacing[[group[0] for group in groups]])
        yield Finding(
            "one mode twice", Severity.CONTRADICTS,
            f"modes at {of_groups} Hz have the same shape, and lines are up to {most:.2g} Hz apart: {averaged}one mode "
            "found twice is leakage of segments that are too short, no second mode",
            numbers={"frequency": float(peaks.frequency[groups[0][0]]), "spacing": float(most)},
        )  # fmt: skip
    if not np.any(coarse):
        return
    k = int(np.argmax(np.where(coarse, peaks.spacing / peaks.width, 0.0)))
    missed = "" if test.averaged else _missed(test, structure, float(peaks.frequency[k]), float(peaks.width[k]))
    if missed is None:
        return
    seconds = _FEWEST / float(peaks.width[k])
    yield Finding(
        "coarse lines", Severity.CONTRADICTS,
        f"lines are {peaks.spacing[k]:.2g} Hz apart, mode {peaks.number[k]} is {peaks.width[k]:.2g} Hz wide{missed}: "
        f"{averaged}their window flattens its peak, and damping and masses come out wrong",
        f"take whole records (from_time with estimator='records'), or segments of {seconds:.3g} s or longer",
        numbers={
            "mode": float(peaks.number[k]), "spacing": float(peaks.spacing[k]), "width": float(peaks.width[k]),
            "seconds": seconds,
        },
    )  # fmt: skip


def unresolved(test: Measurement, omega: Array, ratios: Array) -> Iterator[Finding]:
    """Averages over segments have too few lines in most peaks of poles found in them.

    Where only some are so narrow `leakage` tells it of the structure that was fitted. The window itself makes a narrow
    peak about one and a half distances of lines wide.

    Parameters
    ----------
    omega, ratios : (m,)
        rad/s, fractions of critical damping.
    """
    f = omega / (2 * np.pi)
    inside = (f >= test.freq[0]) & (f <= test.freq[-1])
    if not test.averaged or test.freq.size < 2 or not np.any(inside):
        return
    f, width = f[inside], 2 * ratios[inside] * f[inside]
    spacing = np.interp(f, test.freq, np.gradient(test.freq))
    k = int(np.argmax(spacing / width))
    if 2 * np.count_nonzero(width < _RESOLVED * spacing) >= f.size:
        yield Finding(
            "short segments", Severity.CONTRADICTS,
            f"the segments are too short: lines are {spacing[k]:.2g} Hz apart ({1 / spacing[k]:.3g} s a segment), and "
            f"the peak at {f[k]:.4g} Hz is no wider than their window makes any peak, so that damping and masses are "
            "the window's",
            "take whole records (from_time with estimator='records'), or segments several times as long",
            numbers={"spacing": float(spacing[k]), "frequency": float(f[k])},
        )  # fmt: skip


def _peaks(test: Measurement, structure: Structure) -> Peaks:
    """Modes within the lines."""
    freq, f = test.freq, structure.natural_frequencies
    inside = np.flatnonzero((f >= freq[0]) & (f <= freq[-1]))
    width = 2 * structure.damping_ratios[inside] * f[inside]
    return Peaks(inside + 1, f[inside], width, np.interp(f[inside], freq, np.gradient(freq)))


def _found_twice(peaks: Peaks, coarse: NDArray[np.bool_], structure: Structure) -> list[list[int]]:
    """Groups of modes of one shape, each within two distances of lines from the next."""
    groups: list[list[int]] = []
    for i, j in pairwise(range(peaks.number.size)):
        near = peaks.frequency[j] - peaks.frequency[i] < _TWICE * peaks.spacing[i]
        if not (near and coarse[i] and coarse[j] and _mac(structure, *peaks.number[[i, j]] - 1) > _SAME_SHAPE):
            continue
        if groups and groups[-1][-1] == i:
            groups[-1].append(j)
        else:
            groups.append([i, j])
    return groups


def _mac(structure: Structure, i: int, j: int) -> float:
    """Modal assurance criterion of two modes at the sensors, 0 to 1."""
    a, b = (structure.mode_shapes[:, [i, j]]).T
    return float((a @ b) ** 2 / max((a @ a) * (b @ b), np.finfo(float).tiny))


def _missed(test: Measurement, structure: Structure, frequency: float, width: float) -> str | None:
    """Misfit of a fit about a peak, in words; None where that is no more than elsewhere.

    Noise as large at all lines is more of a weak mode's response, but no larger there; noise in proportion to the
    response is no more of it. Only a peak itself that is not what modes make of it stands out both ways.
    """
    distance = np.gradient(test.freq)
    near = np.abs(test.freq - frequency) < _NEAR * np.maximum(width, distance)
    if not np.any(near) or np.all(near):
        return None
    left = test.relative - test.predict(structure)
    size = lambda record, at: float(np.sqrt(np.mean(np.abs(record[..., at]) ** 2)))  # noqa: E731
    missed, missed_elsewhere = size(left, near), size(left, ~near)
    there, elsewhere = missed / size(test.relative, near), missed_elsewhere / size(test.relative, ~near)
    if there < max(_MISSED * elsewhere, NEGLIGIBLE) or missed < _MISSED * missed_elsewhere:
        return None
    return f", and the fit misses {100 * there:.3g} % of the response there ({100 * elsewhere:.3g} % elsewhere)"
