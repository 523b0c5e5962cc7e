"""Whiteness of what a fit of whole records leaves: bands of lines in which a channel holds more than its noise.

What the errors of all channels tell of the noise of one, over its deviation, is complex white noise of variance one
where model and levels are right. Its power over k lines is then a gamma variable of k, which any band may exceed by
chance: all bands of 8, 16, 32 ... lines, each begun half a band after the other, of all channels and runs are
counted together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.modal_analysis.modal_estimate import Excess
from sysid.modal_analysis.noise_levels import NO_NOISE
from sysid.modal_analysis.record_fit import RecordFit
from sysid.structure.structure import Array
from sysid.structure.thresholds import FALSE_ALARM

_FEWEST = 8  # lines of a band


def excess_of(fit: RecordFit) -> tuple[Excess, ...]:
    """Channels with more than their noise in a band, each its most significant band, the most significant first."""
    powers = noise_powers(fit)
    model, test = fit.model, fit.test
    bands = sum(_count(power.shape[1]) * len(power) for power in powers)
    found: list[tuple[float, Excess]] = []
    levels = np.sqrt(fit.levels_of_runs)
    for number, (lines, power) in enumerate(zip(test.own_lines, powers, strict=True)):
        freq, runs = test.freq[lines], [run for run in model.runs if run.number == number]
        both = np.concatenate([np.vstack([run.outputs, run.base]) for run in runs], axis=1)
        size = np.sqrt(np.mean(np.abs(both) ** 2, axis=1) / runs[0].density)
        for channel in np.flatnonzero(levels[number] > NO_NOISE * size):
            best = most_unlikely(power[channel], bands)
            if best is not None:
                first, last, weight = best
                factor = float(np.sqrt(np.mean(power[channel, first:last])))
                found.append((weight, Excess(
                    int(channel), number, float(freq[first]), float(freq[last - 1]), factor
                )))  # fmt: skip
    return tuple(one for _, one in sorted(found, key=lambda pair: -pair[0]))


def noise_powers(fit: RecordFit) -> list[Array]:
    """Squares of the noise of each channel as all errors tell it, over their variances, (c + d, lines) a run."""
    parts: list[list[Array]] = [[] for _ in range(fit.test.n_runs)]
    for chunk in fit.model.chunks(fit.parameters):
        seen, V = chunk.weighed(fit.levels).whitened_residual, chunk.covered(fit.levels)
        squares = chunk.deviations(fit.levels)[0][:, None] ** 2
        of_outputs = squares - np.sum(np.abs(V) ** 2, axis=0)
        H = chunk.H.swapaxes(0, 1)
        base = np.sum(H.conj() * seen, axis=1)
        hidden = sum(np.abs(np.sum(H.conj() * part, axis=1)) ** 2 for part in V)
        of_base = np.sum(squares * np.abs(H) ** 2, axis=1) - hidden
        both, size = np.abs(np.concatenate([seen, base])) ** 2, np.concatenate([of_outputs, of_base])
        parts[chunk.run.number].append(both / np.where(size > 0, size, np.inf))
    return [np.concatenate(part, axis=1) for part in parts]


def _sizes(lines: int) -> Sequence[int]:
    """Lines of bands: powers of two, and all lines."""
    return [*(_FEWEST * 2**i for i in range(64) if _FEWEST * 2**i < lines), lines] if lines >= _FEWEST else []


def _starts(size: int, lines: int) -> NDArray[np.intp]:
    """First lines of bands of one size."""
    return np.arange(0, lines - size + 1, max(size // 2, 1))


def _count(lines: int) -> int:
    """Number of bands."""
    return sum(_starts(size, lines).size for size in _sizes(lines))


def most_unlikely(power: Array, bands: int) -> tuple[int, int, float] | None:
    """The band of lines with the least likely excess, of `bands` that are looked at; None where all may be chance.

    Parameters
    ----------
    power : (lines,)
        Squares, exponential variables of mean one where nothing but noise is there.

    Returns
    -------
    first line, line after the last, logarithm of how unlikely it is about
    """
    total = np.concatenate([[0.0], np.cumsum(power)])
    best: tuple[int, int, float] | None = None
    for size in _sizes(power.size):
        first = _starts(size, power.size)
        held = total[first + size] - total[first]
        ratio = held / size
        weight = size * (ratio - 1 - np.log(np.maximum(ratio, 1e-300)))  # Chernoff's bound
        weight[ratio <= 1] = 0.0
        at = int(np.argmax(weight))
        if (best is None or weight[at] > best[2]) and scipy.special.gammaincc(size, held[at]) < FALSE_ALARM / bands:
            best = int(first[at]), int(first[at] + size), float(weight[at])
    return best
