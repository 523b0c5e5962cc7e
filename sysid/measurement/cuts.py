"""Whole records that were tapered or padded with zeros, so that no structure's own motion explains their ends."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sysid.errors import InputError
from sysid.measurement.spectra import TimeRun, of_run
from sysid.structure.structure import Array

_STILL = 8  # samples of one value in every channel that count as padding where the structure moved just before
_MOVES = 0.3  # of the record's rms relative motion: no quiet stretch
_FLEXIBLE = 0.05  # of the rms of the responses: less relative motion can hide below the last digit of a recorder
_EDGES = (0, 1, 2, 4, 8)  # ends of the stretches whose rms is compared, in periods from an end of the record
_RISE = 1.2  # from each stretch to the next, of base and of relative motion: t² of a window makes 4 or more
_WHOLE_RISE = 25.0  # from the first stretch to the last; free decay makes it only at a damping of more than a tenth


def check_cuts(runs: Sequence[TimeRun], at_rest: Sequence[bool], rigid_body: Array) -> None:
    """Refuse runs whose ends were made by a window or by padding; those stated to be at rest are right as they are.

    A taper on every channel is no base motion that the structure answered: its transients are not those of modes.
    What cannot be told is let pass: a quiet stretch before an event, padding in front, windows that do not fall to
    zero, fades shorter than some periods of the motion.

    Parameters
    ----------
    runs : sequence of Run
    at_rest : sequence of bool
        Of each run.
    rigid_body : (n_sensors, d)

    Raises
    ------
    InputError
        Names the run and what was done to it.
    """
    for i, (run, rest) in enumerate(zip(runs, at_rest, strict=True)):
        if rest:
            continue
        where = of_run(i, len(runs))
        still = padded(run, rigid_body)
        if still:
            raise InputError(
                f"the last {still} samples{where} hold one value in every channel while the structure was in motion "
                "just before: a record that was padded with zeros, or that stopped early; leave them out: whole "
                "records may have any length"
            )
        if tapered(run, rigid_body):
            raise InputError(
                f"all channels{where}, the base's too, fall to zero together towards both ends, faster than a "
                "structure comes to rest: a window or a fade was laid over the record; give it as it was recorded: "
                "whole records may begin and end in motion (or state at_rest=True where it was at rest at both ends)"
            )


def padded(run: TimeRun, rigid_body: Array) -> int:
    """Number of last samples that hold one value in every channel, where the structure moved just before; else 0."""
    both = np.vstack([run.base, run.outputs])
    moves = np.flatnonzero(np.any(both != both[:, -1:], axis=0))
    if not moves.size:
        return 0
    last = int(moves[-1]) + 1
    still = both.shape[1] - last
    if still < _STILL:
        return 0
    relative = _relative(run, rigid_body)[:, :last]
    before = np.sqrt(np.mean(relative[:, -max(_STILL, int(_period(relative))) :] ** 2, axis=1))
    whole = np.sqrt(np.mean(relative**2, axis=1))
    size = np.sqrt(np.mean(run.response[:, :last] ** 2, axis=1))
    moving = np.all(before >= _MOVES * whole) and np.all(whole > _FLEXIBLE * size)
    return still if moving else 0


def tapered(run: TimeRun, rigid_body: Array) -> bool:
    """True where all channels fall to zero towards both ends as a window does, period by period of the motion."""
    # With their means: what a window takes to zero are the values themselves.
    power = np.array([_pooled(run.base), _pooled(run.response - rigid_body @ run.base)])
    samples = power.shape[1]
    period = _period(_relative(run, rigid_body))
    if period < 2 or 2 * _EDGES[-1] * period > samples:
        return False
    edges = np.round(np.array(_EDGES) * period).astype(int)
    for record in (power, power[:, ::-1]):
        size = [np.sqrt(np.mean(record[:, a:b], axis=1)) for a, b in pairwise(edges)]
        # What is exactly zero there is at rest, and no sign of a window.
        rises = all(np.all((small > 0) & (large > _RISE * small)) for small, large in pairwise(size))
        if not (rises and np.all(size[-1] > _WHOLE_RISE * size[0])):
            return False
    return True


def _relative(run: TimeRun, rigid_body: Array) -> Array:
    """Accelerations relative to the base without their means, (n_sensors, n)."""
    relative = run.response - rigid_body @ run.base
    return np.asarray(relative - relative.mean(axis=1, keepdims=True))


def _pooled(records: Array) -> Array:
    """Squares of channels (c, n), each relative to its own mean square, summed; (n,)."""
    size = np.mean(records**2, axis=1, keepdims=True)
    return np.asarray(np.sum(records**2 / np.where(size > 0, size, 1.0), axis=0))


def _period(relative: Array) -> float:
    """Samples of the period with half of the power of the relative motion above it and half below; 0 without motion."""
    power = np.cumsum(np.sum(np.abs(np.fft.rfft(relative, axis=1)) ** 2, axis=0))
    if power[-1] == 0:
        return 0.0
    return relative.shape[1] / max(int(np.searchsorted(power, power[-1] / 2)), 1)
