"""Units on clocks of their own, moved to the clock of the base by the motion that their records share.

Coarsely by the peak of the response to what the base records, which is late by up to a period of the motion; then,
where the base moves below the first mode, by the records of these frequencies alone, where all moves with the base.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.errors import refuse
from sysid.files.description import Description
from sysid.files.recording import Column
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import largest_modulus


class UnitColumns(NamedTuple):
    """Records of one clock: the file's name, time of the first sample by it, s, samples a second, and its columns."""

    name: str
    begin: float
    rate: float
    columns: Sequence[Column]


class _Pair(NamedTuple):
    """A record of the base and one of a unit, their lag in samples, and how clear it is: one at least."""

    base: Array
    record: Array
    lag: int = 0
    clear: float = 0.0


def clock_moves(units: Sequence[UnitColumns], said: Description) -> tuple[Array, list[str]]:
    """Seconds by which each unit's clock is put forward, (units,), and that in words; 0 of the unit that has the base.

    What is left is a delay, which the fit of the modes finds; a clock that is right but for such stays as it is.

    Raises
    ------
    InputError
        Where no unit has the base, or the records of a unit do not show when it moved.
    """
    axes = {str(one.column): str(one.axis or "").lstrip("+-") for one in said.channels}
    base = [str(one.column) for one in said.channels if one.role == "base"]
    first = next((at for at, unit in enumerate(units) if any(one.name in base for one in unit.columns)), -1)
    refuse((first < 0, "no file has the base's column under the name that is stated; --align needs it by its name"))
    rate, reference = min(unit.rate for unit in units), units[first]
    others = [unit for at, unit in enumerate(units) if at != first]
    pairs = [_clearest(reference, unit, axes, rate) for unit in others]
    last = min((_quasi_static(pair) for pair in pairs), default=0.0)
    found, remarks = [], []
    for unit, pair in zip(others, pairs, strict=True):
        lag, reach = _refined(pair, last)
        move = reference.begin - lag / rate - unit.begin
        found.append(move if abs(move) * rate > reach else 0.0)
        by = f"is moved by {found[-1]:+.4g} s to" if found[-1] else "is already on"
        remarks.append(f"{unit.name} {by} the clock of {reference.name}")
    words = "these moves are coarse: what is left is found with the modes (late sensor)"
    return np.insert(np.array(found), first, 0.0), [*remarks, words]


def _clearest(reference: UnitColumns, unit: UnitColumns, axes: dict[str, str], rate: float) -> _Pair:
    """Those records of the base's unit and of another, along one axis as far as it is said, whose lag is clearest."""
    every = []
    for a in _described(reference, axes):
        along = [b for b in _described(unit, axes) if len({axes.get(one.name, "") for one in (a, b)} - {""}) < 2]
        every += [_with_lag(_at_rate(a, reference.rate, rate), _at_rate(b, unit.rate, rate)) for b in along]
    best = max(every, key=lambda pair: pair.clear, default=_Pair(np.zeros(1), np.zeros(1)))
    words = f"its records and those of {reference.name} show no motion in common by which to bring them to one clock"
    refuse((best.clear < 1, f"{unit.name}: {words} (--align): are both of the same run?"))
    return best


def _described(unit: UnitColumns, axes: dict[str, str]) -> list[Column]:
    """The columns that are described; all where none is."""
    return [one for one in unit.columns if one.name in axes] or list(unit.columns)


def _at_rate(column: Column, given: float, rate: float) -> Array:
    """A record without its mean at so many samples a second, linear between its own."""
    values = np.real(column.values) - np.mean(np.real(column.values))
    times = np.arange(int(values.size / given * rate)) / rate
    return np.interp(times, np.arange(values.size) / given, values)


def _spectra(a: Array, b: Array) -> tuple[ComplexArray, ComplexArray, int]:
    """Spectra of two records of any length, and how many samples they are of, so many that nothing folds back."""
    n = 2 ** int(np.ceil(np.log2(a.size + b.size)))
    return np.fft.rfft(a, n), np.fft.rfft(b, n), n


def _least(power: Array, share: float = 0.01) -> float:
    """Power of the base from which it counts as moved at a line: a share of its mean."""
    return share * float(power.mean())


def _with_lag(base: Array, record: Array) -> _Pair:
    """Two records with the lag at the peak of the impulse response from one to the other.

    Beside its peak the envelope is, of noise, a Rayleigh variable; twice the power that chance makes of that is clear.
    """
    X, Y, n = _spectra(base, record)
    power = np.abs(X) ** 2
    if not np.any(power) or not np.any(Y):
        return _Pair(base, record)
    envelope = np.abs(np.fft.ifft(Y * X.conj() / (power + _least(power)), n))
    at = int(np.argmax(envelope))
    chance = np.sqrt(2 / np.log(2)) * largest_modulus(n) * np.median(envelope)
    return _Pair(base, record, at if at < record.size else at - n, float(envelope[at] / chance))


def _quasi_static(pair: _Pair, blocks: int = 400) -> float:
    """Cycles a sample up to which a record grows to no more than twice what it is where the base moves most slowly."""
    X, Y, n = _spectra(*(one * np.hanning(one.size) for one in (pair.base, pair.record)))
    size = -(-X.size // blocks)
    whole = X.size // size * size
    base, record = (np.sum(np.abs(one[:whole]).reshape(-1, size) ** 2, axis=1) for one in (X, Y))
    moved = np.flatnonzero(base > _least(base))
    gain = record[moved] / base[moved]
    beyond = moved[gain > 4 * gain[0]]
    return float(beyond[0] * size / n if beyond.size else 0.5)


def _refined(pair: _Pair, last: float, fewest: int = 10) -> tuple[int, float]:
    """Lag in samples, and by how many it may be off: by the lines up to `last`, cycles a sample, where there are some.

    A tenth of their shortest period; else two periods of the motion.
    """
    X, Y, n = _spectra(pair.base, pair.record)
    line, moved = np.arange(X.size), np.abs(Y) ** 2
    power = np.abs(np.fft.rfft(pair.base * np.hanning(pair.base.size), n)) ** 2  # without leakage of what was cut off
    slow = (line < last * n) & (power > _least(power))
    # Of less than an octave one period passes for another.
    if np.count_nonzero(slow) < fewest or 2 * np.quantile(line[slow], 0.1) > last * n:
        return pair.lag, float(2 * n * moved.sum() / np.sum(line * moved))
    shared = np.abs(np.fft.irfft(np.where(slow, Y * X.conj(), 0.0), n))
    near = pair.lag + np.arange(-int(1 / last), int(1 / last) + 1)
    return int(near[np.argmax(shared[near % n])]), 0.1 / last
