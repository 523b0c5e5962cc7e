"""Spurious modes of whole records: what the modes miss of their own motion, explained by one more mode.

A frame that softens with amplitude, under a steady sine, leaves errors at the lines of the sine and of its harmonics
that are far beyond the noise, and a further mode near by explains them. Where what is left is no white noise, such
lines count for less, and the one block of lines where a mode shows most is no evidence for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.record_fit import RecordFit, record_modes, refitted, without, worth
from sysid.modal_analysis.record_more import least_worth
from sysid.modal_analysis.record_spread import line_blocks, uneven
from sysid.structure.structure import Array

_MORE = 4.0  # times what a mode must be worth where noise alone is left


def without_spurious_modes(
    fit: RecordFit, *, some: Measurement | None = None, monitor: FitMonitor | None = None
) -> RecordFit:
    """The fit without spurious modes, one after the other; as it is where what is left is white noise.

    Where lines are many, `some` is the test at a few of them, as in `refitted`.
    """
    first, test = fit, fit.test
    while np.any(least := _spurious(fit)):
        # From new residues, a few steps: two modes close together may have cancelled each other.
        modes = without(fit, least).modes
        fit = record_modes(some or test, modes.omega, modes.ratios, monitor=monitor)
    if fit is first:
        return fit
    fit = refitted(replace(fit, test=test), fit.parameters, some=some, monitor=monitor)
    return without_spurious_modes(fit, some=some, monitor=monitor)


def _spurious(fit: RecordFit) -> NDArray[np.bool_]:
    """The mode that is worth least beyond what the model misses, if too little, (m,)."""
    m = fit.parameters.modes.omega.size
    if m == 1 or not uneven(fit):
        return np.zeros(m, bool)
    value = worth_beyond_misfit(fit)
    return (np.arange(m) == np.argmin(value)) & (value < _MORE * least_worth(fit.model))


def worth_beyond_misfit(fit: RecordFit) -> Array:
    """`worth` of each mode, (m,), in lines that count for less where the model misses more, but for one block of them.

    At a line the model misses what is left in its block, and the share of the modes' motion there that it misses of all
    lines together.
    """
    model, p, c = fit.model, fit.parameters, fit.model.channels
    powers: list[list[Array]] = [[] for _ in model.runs]  # of what is left, of all modes, and of each, (2 + m, L)
    for chunk in model.chunks(p):
        pushed = p.modes.gamma @ chunk.run.base + chunk.pushed_by_ends
        each = (chunk.shapes[:, :, None] * chunk.g * pushed).swapaxes(0, 1)  # (m, c, L)
        moved_by = [None, each.sum(axis=0), *each]
        powers[chunk.run.piece].append(np.stack([chunk.weighed(fit.levels, one).power for one in moved_by]))
    whole = [np.concatenate(one, axis=1) for one in powers]
    left, moved, parts = [one[0] for one in whole], [one[1] for one in whole], [one[2:] for one in whole]
    share = sum(map(np.sum, left)) / sum(map(np.sum, moved))
    blocks = [line_blocks(run, fit, 0.0) for run in model.runs]
    weights = [
        1 / (_by_block(lines, power, c) + share * motion / c)
        for lines, power, motion in zip(blocks, left, moved, strict=True)
    ]
    value = worth(fit, model.weighed_by(weights).normal_equations(p, fit.levels).normal)
    sums = np.hstack(
        [
            [[np.sum((weight * mode)[part]) for part in lines] for mode in modes]
            for lines, weight, modes in zip(blocks, weights, parts, strict=True)
        ]
    )  # (m, blocks)
    return np.asarray(value * (1 - sums.max(axis=1) / sums.sum(axis=1)))


def _by_block(blocks: list[NDArray[np.intp]], power: Array, channels: int) -> Array:
    """Misfit about a line in its block, in units of the noise, one at least, (L,)."""
    return np.concatenate([np.full(lines.size, max(1.0, power[lines].mean() / channels)) for lines in blocks])
