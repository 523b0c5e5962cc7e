"""Measured records: stated deviations of frequencies against a jackknife over blocks of lines, refitted here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.problem_modules import load_module
from benchmarks.swarm.shake_table import ABSENT, EVENTS, records_folder
from sysid.modal_analysis.least_squares import unit_diagonal
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.record_fit import RecordFit, record_modes, refitted

WITHIN = 1.5
MODES = np.array([3.75, 11.2, 16.6])  # Hz, bending along X, by others
NEAR = 0.02
WIDTH = 0.2  # Hz, of a block: some three half-power widths of these modes
SHIFTS = 4  # partitions, each begun a part of a block later


def lines(reduced: bool) -> Iterator[Line]:
    """mini_shake_table, fitted on either event, in the reduced form on one; `swarm.shake_table` holds its scores."""
    data = records_folder()
    if data is None:
        yield ABSENT
        return
    event = load_module("mini_shake_table").event
    for name in EVENTS[: 1 if reduced else None]:
        yield from _deviations(name, event(data / name, "records"), 1 if reduced else SHIFTS)


def _deviations(name: str, test: sysid.Measurement, shifts: int) -> Iterator[Line]:
    """Stated deviations of frequencies beside those of a jackknife."""
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(healing="rigid_body")), rng=0)
    found = result.structure.natural_frequencies
    close = found.size == len(MODES) and bool(np.all(np.abs(found / MODES - 1) < NEAR))
    shown = " / ".join(f"{f:.3f}" for f in found)
    yield Line(f"{name}: frequencies found, Hz", shown, " / ".join(map(str, MODES)) + f" within {NEAR:.0%}", close)
    variance, plain = _jackknife(_fit(test, result.modal[0]), shifts)
    wide = np.sqrt(plain)
    ratios = wide * result.uncertainty.natural_frequencies / np.sqrt(variance)
    met = bool(np.all((ratios <= WITHIN) & (ratios >= 1 / WITHIN)))
    text = f"{name}: times that this jackknife is too wide where what is left is white, which are taken off"
    yield Line(text, " / ".join(f"{w:.2f}" for w in wide))
    text = f"{name}: stated deviations over those of the jackknife as it is"
    yield Line(text, " / ".join(f"{r:.2f}" for r in ratios / wide))
    text = f"{name}: stated deviations of frequencies over those of a jackknife by blocks of {WIDTH:g} Hz"
    yield Line(text, " / ".join(f"{r:.2f}" for r in ratios), f"{1 / WITHIN:.2f} to {WITHIN:g}", met)


def _jackknife(fit: RecordFit, shifts: int) -> tuple[np.ndarray, np.ndarray]:
    """Variances of frequencies, Hz², (m,), by leaving out one block of lines at a time and refitting the rest.

    B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982), chapter 3. Variances are means over the
    partitions. A block may hold most of what tells a mode, and the jackknife is then too wide, by a known factor where
    what is left is white: without a block an estimate moves by the difference of both variances, V_b - V. Their sum
    over V, (m,), stands beside the variances.
    """
    freq, own, order = fit.test.freq, _variances(fit), np.argsort(fit.parameters.modes.omega)
    variance, plain = np.zeros(own.size), np.zeros(own.size)
    for shift in np.arange(shifts) / shifts:
        part = np.floor((freq - freq[0]) / WIDTH + shift)
        blocks = np.unique(part)
        fits = [_refitted(fit, part != block) for block in blocks]
        left = np.array([one.parameters.modes.omega[order] / (2 * np.pi) for one in fits])
        left -= left.mean(axis=0)
        share = (blocks.size - 1) / blocks.size / shifts
        variance += share * np.sum(left**2, axis=0)
        plain += share * sum(_variances(one) / own - 1 for one in fits)[order]
    return variance, plain


def _fit(test: sysid.Measurement, found: ModalEstimate) -> RecordFit:
    """The fit of all lines, from the modes that were found."""
    fit = record_modes(test, found.omega, found.ratios)
    return refitted(fit, fit.parameters)


def _refitted(fit: RecordFit, keep: np.ndarray) -> RecordFit:
    """The same modes fitted to some of the lines, from where the fit of all ended, for its levels of noise."""
    part = replace(fit, test=fit.test.at(keep))
    return replace(refitted(part, fit.parameters), levels=fit.levels)


def _variances(fit: RecordFit) -> np.ndarray:
    """Relative variances of frequencies where what is left is white noise of the fit's levels."""
    information, size = unit_diagonal(fit.information())
    variance = np.diag(np.linalg.pinv(information, rcond=1e-11, hermitian=True)) / size**2
    return variance[fit.model.index.log_omega] / 2
