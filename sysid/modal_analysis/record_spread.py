"""Scatter of the modes of whole records where what is left is no white noise: a sandwich over blocks of lines.

Model error sits at the peaks. Each block of lines, some half-power widths long, then tells its own error: what its
score would move the modes by, in one linear step from the end of the fit. The fit has taken a part of each block's
errors: of white noise, a block with the share H of the information leaves a score of covariance ``H (I - H)``. The
score over the root of ``I - H`` has H again, so that the squares of all moves make the covariance without bias (White
1982; MacKinnon and White 1985, HC2, a block in the place of a number). The whole ``I - H``, HC3, is the jackknife,
which is too wide: a block may hold most of what tells a mode.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.modal_analysis.record_fit import RecordFit, half_inverse, unit_diagonal
from sysid.modal_analysis.record_model import Chunk, Run
from sysid.structure.structure import Array
from sysid.structure.thresholds import FALSE_ALARM, beyond_chance

_TAKEN = 0.98  # share of the information, at most, that is taken to be a block's


def line_blocks(run: Run, fit: RecordFit, shift: float, widths: float = 3.0, least: int = 4) -> list[NDArray[np.intp]]:
    """Lines of a run in blocks of so many half-power widths, of some lines at least; the first begins at a `shift`."""
    modes = fit.parameters.modes
    order = np.argsort(modes.omega)
    width = np.interp(run.w, modes.omega[order], 2 * widths * (modes.ratios * modes.omega)[order])
    spacing = np.gradient(run.w)
    at = np.cumsum(spacing / np.maximum(width, least * spacing)) + shift
    cuts = np.flatnonzero(np.diff(np.floor(at))) + 1
    return np.split(np.arange(run.w.size), cuts)


def scatter(fit: RecordFit) -> Array | None:
    """Twice the covariance of the score over the unknowns of `Index`, (p, p); None where what is left is white.

    With A, the information of the fit, the covariance of the modes is ``A^-1 B A^-1 / 2``; for white noise B is A.
    """
    # Levels stated too low or too high are no reason: the power of the misfit counts once, with the information.
    return scatter_over_blocks(fit) if uneven(fit, 2 * fit.chi2 / fit.model.numbers) else None


def scatter_over_blocks(fit: RecordFit, partitions: int = 4) -> Array:
    """The same, whatever is left, over partitions that begin later each: where blocks begin must not matter."""
    model, p = fit.model, fit.parameters
    N, size = unit_diagonal(fit.normal)
    half = half_inverse(N, 1e-12)
    meat = np.zeros((half.shape[1],) * 2)
    columns = [Chunk(model, p, run.at(slice(0, 1))).columns() for run in model.runs]
    for shift in np.arange(partitions) / partitions:
        for run, run_columns in zip(model.runs, columns, strict=True):
            at = size[run_columns.unknowns]
            for lines in line_blocks(run, fit, shift):
                products = Chunk(model, p, run.at(lines)).products(fit.levels, run_columns)
                score = half[run_columns.unknowns].T @ (products.gradient / at)
                inner = half[run_columns.unknowns].T @ (products.normal / np.outer(at, at)) @ half[run_columns.unknowns]
                taken, turn = np.linalg.eigh(inner)
                grown = turn @ ((turn.T @ score) / np.sqrt(1 - np.clip(taken, 0.0, _TAKEN)))
                meat += np.outer(grown, grown) / partitions
    # In moves of all unknowns, of which those of `Index` are kept: A^-1 B A^-1 is that of the moves.
    kept = model.kept
    moved = (half @ meat @ half.T)[:kept, :kept] / np.outer(size[:kept], size[:kept])
    A = fit.information()
    B = np.zeros_like(A)
    B[:kept, :kept] = 2 * A[:kept, :kept] @ moved @ A[:kept, :kept]
    return B


def uneven(fit: RecordFit, mean: float = 1.0) -> bool:
    """True where the power of what is left differs between blocks of lines, and from its mean, by more than chance.

    In all blocks together, or rises above it in one.
    """
    model, c = fit.model, fit.model.channels
    off, rare = [], []
    powers: list[list[Array]] = [[] for _ in model.runs]
    for chunk in model.chunks(fit.parameters):
        powers[chunk.run.piece].append(chunk.weighed(fit.levels).power)
    for run, parts in zip(model.runs, powers, strict=True):
        power = np.concatenate(parts)
        for lines in line_blocks(run, fit, 0.0):
            held, numbers = np.sum(power[lines]) / mean, c * lines.size
            off.append((held - numbers) / np.sqrt(numbers))
            rare.append(scipy.special.gammaincc(numbers, held))
    return bool(np.sum(np.square(off)) > beyond_chance(len(off), 2) or min(rare) < FALSE_ALARM / (2 * len(rare)))
