"""Damaged samples of records in time: flat tops, gaps, held values, equal channels, spikes, hum of one channel.

Each is judged by its likelihood in a sound record of the same quantisation and rate of change, at one rate of false
alarms for all channels and samples of a run:

- A quantised record has equal neighbours by chance: where it changes by d a sample, two of them share a step q with
  probability q / d. Flat tops of smooth motion are no steeper beside them than a parabola.
- Hum and spikes are what the other channels, or the samples around, do not predict.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import FALSE_ALARM, ROUND_OFF

Damage = Literal["equal channels", "clipped", "dropout", "held value", "spikes", "tone"]
Stretches = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class DamagedSamples:
    """Damage of one kind in one channel of a run.

    Attributes
    ----------
    kind : str
    channel : int
        Row of the records.
    stretches : (k, 2)
        First and last sample of each, both included.
    value : float
        Of "clipped" the largest level in magnitude, of "held value" the first value, of "spikes" the largest height,
        in the unit of the record; of "tone" its frequency, in cycles a sample; of "equal channels" the other's row.
    """

    kind: Damage
    channel: int
    stretches: Stretches
    value: float

    @property
    def count(self) -> int:
        """Number of samples."""
        return int(np.sum(self.stretches[:, 1] - self.stretches[:, 0] + 1))


def damaged_samples(records: Array, n_base: int = 1) -> list[DamagedSamples]:
    """Damage of the records of a run.

    Parameters
    ----------
    records : (channels, n)
        The base first, `n_base` of them: a base may rest while sensors move.

    Returns
    -------
    list of DamagedSamples
        Channel by channel; the worst of each channel first. None of channels that never move.
    """
    if records.shape[1] < _AROUND:
        return []
    quanta = np.array([_quantum(record) for record in records])
    flat = [list(_flat(records, channel, quantum, n_base)) for channel, quantum in enumerate(quanta)]
    held = [np.concatenate([np.zeros((0, 2), np.intp), *(one.stretches for one in its)]) for its in flat]
    found = [*_equal(records, n_base), *itertools.chain(*flat), *_spikes(records, quanta, held)]
    sound = np.delete(np.arange(len(records)), [one.channel for one in found])
    found += [replace(one, channel=int(sound[one.channel])) for one in _tones(records[sound])]
    return sorted(found, key=lambda one: one.channel)


def _equal(records: Array, n_base: int, least: int = 50) -> Iterator[DamagedSamples]:
    """Sensors and force with the samples of one before, that change `least` times at least.

    A base may move along two of its axes alike, and be the record of a sensor that it carries.
    """
    sizes = np.sum(np.abs(records), axis=1)
    for channel in range(n_base + 1, len(records)):
        for other in n_base + np.flatnonzero(sizes[n_base:channel] == sizes[channel]):
            one = records[channel]
            if np.array_equal(one, records[other]) and np.count_nonzero(np.diff(one)) >= least:
                yield DamagedSamples("equal channels", channel, np.array([[0, one.size - 1]]), float(other))
                break


# Flat tops and held values.

_AROUND = 64  # samples on either side, of which what is usual about others is told


def _round_off(record: Array) -> float:
    return ROUND_OFF * float(np.abs(record).max())


def _is_large(record: Array) -> NDArray[np.bool_]:
    """Which samples are above a tenth of the largest, or of the largest tenth: spikes may be larger than all else."""
    size = np.abs(record)
    return np.asarray(size >= min(0.1 * size.max(), np.quantile(size[:: size.size // 10_000 + 1], 0.9)))


def _quantum(record: Array) -> float:
    """Step of a record: the least difference of neighbours where it is large; equal ones are within round-off."""
    steps = np.abs(np.diff(record))[_is_large(record)[1:]]
    tolerance = _round_off(record)
    steps = steps[steps > tolerance]
    return float(steps.min()) if steps.size else tolerance


def _runs(flags: NDArray[np.bool_]) -> Stretches:
    """First and last of each run of true flags, (k, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return np.column_stack([edges[::2], edges[1::2] - 1])


def _flat(records: Array, channel: int, quantum: float, n_base: int, lively: float = 0.12) -> Iterator[DamagedSamples]:
    """Flat tops, then gaps, then held values of a channel; none of one that a slow converter or recorder holds."""
    record = records[channel]
    tolerance, chance = _round_off(record), np.log(FALSE_ALARM / (2 * len(records)))
    at = _alike(record)
    if _is_slow(record, at):
        return
    ends = [_runs(sign * record >= np.max(sign * record) - tolerance) for sign in (1, -1)]
    logs = [_log_chance_of_tops(sign * record, at, quantum) for sign, at in zip((1, -1), ends, strict=True)]
    if abs(record.max() + record.min()) < quantum:  # of one range
        logs = [sum(logs)] * 2
    # Pulses to one side begin and end at rest, be it zero or where most samples are; so does a gap.
    is_rest = [abs(record[at[0, 0]]) <= tolerance or 2 * np.sum(at[:, 1] - at[:, 0] + 1) > record.size for at in ends]
    tops = [at for at, log, rest in zip(ends, logs, is_rest, strict=True) if log < chance and not rest]
    clipped = np.concatenate([np.zeros((0, 2), np.intp), *tops])
    if len(clipped):
        clipped = clipped[np.argsort(clipped[:, 0])]
        yield DamagedSamples("clipped", channel, clipped, float(np.abs(record[clipped[:, 0]]).max()))
    at = at[(at[:, 1] - at[:, 0] > 1) & ~np.isin(at[:, 0], clipped[:, 0])]
    at = at[_held(record, at, quantum, FALSE_ALARM / records.size, lively)]
    at = at[_no_rest(records, channel, at, n_base, lively)]
    zero = np.abs(record[at[:, 0]]) <= tolerance
    if np.any(zero):
        yield DamagedSamples("dropout", channel, at[zero], 0.0)
    if not np.all(zero):
        yield DamagedSamples("held value", channel, at[~zero], float(record[at[~zero][0, 0]]))


def _alike(record: Array) -> Stretches:
    """First and last of each stretch of samples of one value, be it one sample, (k, 2)."""
    ends = np.flatnonzero(np.abs(np.diff(record)) > _round_off(record))
    return np.column_stack([np.append(0, ends + 1), np.append(ends, record.size - 1)])


def _is_slow(record: Array, at: Stretches) -> bool:
    """True of a record that never moves, or of whose large values between its ends most are held."""
    if 2 * len(at) > record.size + 1:  # a value has less than two samples
        return False
    value, tolerance = record[at[:, 0]], _round_off(record)
    between = (value < record.max() - tolerance) & (value > record.min() + tolerance)
    length = (at[:, 1] - at[:, 0] + 1)[between & _is_large(record)[at[:, 0]]]
    return len(at) == 1 or (length.size > 0 and bool(np.median(length) > 1))


def _log_chance_of_tops(record: Array, at: Stretches, quantum: float, nearest: int = 8, more: float = 1.5) -> float:
    """Logarithm of the chance that a sound record has its highest value at all of these stretches.

    Of steps q. A smooth top of L samples within a step falls by at most ((1 + 2/L)² + 1) q to its neighbours; where
    both fall by d and more, each further sample shares the step by a chance of q / d. Tops that share a step without
    a flat are as many as a density with the singularity of a sine makes of the `nearest` values next to them, or
    `more` times as many.
    """
    first, last = at.T
    length, inside = last - first + 1, (first > 0) & (last < record.size - 1)
    top = record[first[0]]
    fall = top - np.maximum(record[np.maximum(first - 1, 0)], record[np.minimum(last + 1, record.size - 1)])
    steep = inside & (length > 1) & (fall > quantum * ((1 + 2 / length) ** 2 + 1))
    each = np.where(steep, (length - 1) * np.log(quantum / np.where(steep, fall, 1.0)), 0.0)
    count, flat = len(at), int(np.count_nonzero(steep))
    after = record[np.minimum(last + 1, record.size - 1)]
    if count > 2 and np.median(np.abs(after - np.median(after))) < 4 * quantum:  # one phase of a sine: one chance
        return float(each.min())
    log = float(each.sum()) + float(np.log(scipy.special.binom(count, flat)) if flat < count else 0.0)
    below = np.sort(np.partition(record, -min(record.size, int(length.sum()) + 2000))[-int(length.sum()) - 2000 :])
    below = below[below < top - 0.5 * quantum]
    distinct = below[np.concatenate([np.diff(below) > 0.5 * quantum, [True]])] if below.size else below
    if count > 1 and distinct.size >= nearest:
        share = np.sqrt(quantum / (top - distinct[-nearest] + quantum))  # of a sine's values there, in its last step
        expected = np.count_nonzero(below >= distinct[-nearest]) * share / (1 - share)
        log += float(np.log(max(scipy.special.gammainc(count - 1, more * expected), 1e-300)))
    return log


def _held(
    record: Array, at: Stretches, quantum: float, chance: float, lively: float, edge: int = 8, least: float = 1.5
) -> NDArray[np.bool_]:
    """Which stretches of one value, (k, 2), a sound record that moves as it does on both sides would not have.

    In the `edge` samples beside it the record moves by `least` steps, and is `lively` against more samples there; what
    begins or ends at rest is let pass.
    """
    first, last = at.T
    steps = np.diff(record)
    power = np.concatenate([[0.0], np.cumsum(steps**2)])
    few = np.clip((last - first + 1) // 6, 2, _AROUND)
    n = steps.size  # those before a stretch end at `first`, those behind it begin at `last`

    def motion(width: Stretches | int) -> Array:
        start, end = np.maximum(first - width, 0), np.minimum(last + width, n)
        before, after = (power[first] - power[start]) / width, (power[end] - power[last]) / width
        return np.sqrt([np.where(first > 0, before, np.inf), np.where(last < n, after, np.inf)])

    near, about = motion(edge), motion(_AROUND)
    about[:, (first == 0) | (last == n)] = np.sqrt(power[-1] / n)
    moves = np.all(np.isinf(near) | (near >= np.maximum(lively * about, least * quantum)), axis=0)
    sides = motion(few)
    sides = np.where(np.isinf(sides), sides[::-1], sides)
    size = np.maximum(np.sqrt(2 * np.pi * sides[0] * sides[1]), quantum)
    return np.asarray(moves & ((last - first) * np.log(quantum / size) < np.log(chance)))


def _no_rest(records: Array, channel: int, at: Stretches, n_base: int, lively: float) -> NDArray[np.bool_]:
    """Which stretches (k, 2) are no rest: a base may stand still between bursts, while sensors ring.

    So may any channel with the base and, at an end of a record, with one axis of it or a tenth of the others.
    """
    if channel < n_base or not len(at):
        return np.zeros(len(at), dtype=bool)
    away = (records - np.median(records, axis=1, keepdims=True)) ** 2
    least = lively**2 * np.var(records, axis=1)
    moves = np.array([(away[:, first : last + 1].mean(axis=1) > least) | (least == 0) for first, last in at])
    at_end, base = np.any((at == 0) | (at == records.shape[1] - 1), axis=1), moves[:, :n_base]
    others = np.mean(np.delete(moves, channel, axis=1), axis=1) > 0.9
    return np.where(at_end, np.all(base, axis=1) & others, np.any(base, axis=1))


# Spikes: samples that those around them do not predict.


@dataclass(frozen=True, eq=False)
class _Errors:
    """Estimates of errors of one sample, and of two that have the same, beside what they usually are.

    An error h of the samples of a spectrum D has the estimate ``sum(D* X / S) / sum(|D|² / S)`` in a record X of the
    power spectrum S. Attributes: `single`, those of one sample, with signs, (channels, n); `filters`, 1 / S,
    (channels, lines); `heights`, sizes of both, (channels, 2, n); `usual`, those of the `parts` beside each part, and
    `level`, what is beyond them and the size of the record there, (channels, 2, parts).
    """

    single: Array
    filters: Array
    heights: Array
    usual: Array
    level: Array
    parts: Stretches

    @classmethod
    def of(cls, records: Array, quanta: Array, out: float = 8.0) -> _Errors:
        n = records.shape[1]
        parts = np.append(np.arange(0, max(n - _AROUND, 0) + 1, _AROUND), n)
        single, filters = _filtered(records)
        heights = _heights(single, filters)
        usual = np.sqrt(np.pi / 2) * _beside(heights, parts)
        around = _beside(np.abs(records - records.mean(axis=1, keepdims=True)), parts)
        level = np.maximum(out * usual, np.maximum(around, out * quanta[:, None])[:, None])
        return cls(single, filters, heights, np.maximum(usual, np.finfo(float).tiny), level, parts)

    def highest(
        self, channel: int, out: float = 8.0, apart: float = 1.5, most: int = 400
    ) -> Iterator[tuple[int, int, float]]:
        """First and last sample, and size, of all errors that stand out in a channel, the largest first.

        They are so much larger than all that is not `out`: motion in jerks has large errors and less large ones. What
        the filter makes of each beside it is taken off before the next.
        """
        heights, level, usual = self.heights[channel], self.level[channel], self.usual[channel]
        if not np.any(np.maximum.reduceat(heights, self.parts[:-1], axis=1) > level):
            return  # of most channels
        pulse = scipy.fft.irfft(self.filters[channel], heights.shape[1])
        pulse /= pulse[0]
        usual, level = (np.repeat(part, np.diff(self.parts), axis=1) for part in (usual, level))
        times = heights / usual
        level = np.maximum(level, [[apart * np.max(its[its < out])] for its in times] * usual)
        more, at = np.nonzero(heights > level)
        usual, level = usual[more, at], level[more, at]
        first, second = np.take(self.single[channel], [at, at + 1], mode="wrap")
        for _ in range(min(most, at.size)):
            error = np.where(more, (first + second) / (2 + 2 * pulse[1]), first)
            times = np.where(np.abs(error) > level, np.abs(error) / usual, 0.0)
            top = int(np.argmax(times))
            if times[top] == 0.0:
                return
            yield int(at[top]), int(at[top] + more[top]), float(np.abs(error[top]))
            away = at - at[top]
            before, here, behind = np.take(pulse, [away - 1, away, away + 1], mode="wrap")
            first -= error[top] * (here + more[top] * before)
            second -= error[top] * (behind + more[top] * here)

    def is_alone(self, channel: int, first: int, foot: int = 3, far: int = 32, hit: float = 5.0) -> bool:
        """True where no other channel stands out, nor more about it: else the structure was hit."""
        usual = self.usual[:, :, np.searchsorted(self.parts, first, side="right") - 1]
        near, about = (
            np.max(self.heights[:, :, max(first - r, 0) : first + r + 1].max(axis=2) / usual, axis=1)
            for r in (foot, far)
        )
        return not np.any(np.delete((near > hit) | (about > near[channel]), channel))


def _spikes(records: Array, quanta: Array, held: list[Stretches], clear: int = 16) -> Iterator[DamagedSamples]:
    """Samples of one channel that stand out of what all others of it predict.

    They are held against what is usual beside them, and against the record there. Where other channels have such
    samples at once, the structure was hit. Nothing is judged within `clear` samples of the ends and of what is `held`,
    nor where a channel starts or stops moving.
    """
    n = records.shape[1]
    errors = _Errors.of(records, quanta)
    for channel in range(len(records)):
        sizes = np.zeros(n)
        for first, last, size in errors.highest(channel):
            near = np.any((held[channel][:, 0] - clear <= first) & (first <= held[channel][:, 1] + clear))
            steps = np.abs(np.diff(records[channel, max(first - clear, 0) : last + clear]))
            sides = np.median(steps[: clear - 2]), np.median(steps[2 - clear :])
            near |= not clear <= first < n - clear or min(sides) < 0.1 * max(sides)
            beside = records[channel, [first - 1, (last + 1) % n]].mean()
            near |= abs(records[channel, first] - beside) < 0.25 * size  # what the filter makes of a smooth pulse
            if not near and errors.is_alone(channel, first):
                sizes[first : last + 1] = size
        runs = _runs(sizes > 0)
        runs = runs[runs[:, 1] - runs[:, 0] < 2]  # longer ones are pulses
        if len(runs):
            yield DamagedSamples("spikes", channel, runs, float(sizes[runs].max()))


def _filtered(records: Array) -> tuple[Array, Array]:
    """Estimates of an error of each sample, (channels, n), and the filters that gave them, (channels, lines)."""
    n = records.shape[1]
    first, last = records[:, :1], records[:, -1:]
    moving = records - first - np.linspace(0, 1, n) * (last - first)
    size = np.maximum(np.abs(moving).max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    spectra = scipy.fft.rfft((moving / size).astype(np.float32))  # in half the time
    power = spectra.real**2 + spectra.imag**2
    mean = np.maximum(power.mean(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    width = max(power.shape[1] // 256, 4)
    starts = np.arange(0, max(power.shape[1] - width, 1), width)
    sizes = np.diff(np.append(starts, power.shape[1]))
    inverse = 1 / (np.add.reduceat(power, starts, axis=1) / (sizes * mean) + 1e-5)
    filters = np.repeat(inverse.astype(np.float32), sizes, axis=1)
    spectra *= filters * (size / filters.mean(axis=1, keepdims=True)).astype(np.float32)
    return scipy.fft.irfft(spectra, n, overwrite_x=True), filters


def _heights(single: Array, filters: Array) -> Array:
    """Sizes of errors of each sample, and of each two that have the same, (channels, 2, n)."""
    # The spectrum of two samples that are alike is 2 cos(w / 2) times that of one.
    twice = (2 * np.cos(np.linspace(0, np.pi / 2, filters.shape[1]))) ** 2
    share = filters @ twice.astype(np.float32) / filters.sum(axis=1)
    heights = np.stack([single, np.roll(single, -1, axis=1)], axis=1)
    heights[:, 1] += single
    heights[:, 1] /= share[:, None]
    return np.abs(heights, out=heights)


def _beside(size: Array, parts: Stretches) -> Array:
    """The larger of the means of sizes (..., n) over the parts before and behind each part, whose edges are `parts`.

    Those at the ends have themselves beside them.
    """
    mean = np.add.reduceat(size, parts[:-1], axis=-1) / np.diff(parts)
    mean = np.concatenate([mean[..., :1], mean, mean[..., -1:]], axis=-1)
    return np.asarray(np.maximum(mean[..., :-2], mean[..., 2:]))


# Hum: a line of one channel that the other channels do not predict, steady along the record.


def _tones(records: Array, stands_out: float = 40.0, low: int = 4) -> Iterator[DamagedSamples]:
    """Steady sines of single channels, by lines of a windowed record that linear combinations of the others lack.

    The `low` first lines hold means and drift. A tone stands so many times out of the median power of what is not
    predicted about it.
    """
    channels, n = records.shape
    lines, width = n // 2, max(64, 6 * channels)
    if channels < 3 or lines < 2 * width:
        return
    size = np.std(records, axis=1, keepdims=True)
    moving = np.where(size > 0, (records - records.mean(axis=1, keepdims=True)) / np.where(size > 0, size, 1.0), 0.0)
    spectra = scipy.fft.rfft(moving * np.hanning(n))[:, low:]
    count = spectra.shape[1] // width
    blocks = np.moveaxis(spectra[:, : count * width].reshape(channels, count, width), 0, 1)
    times = _power(_unpredicted(blocks))
    best, told = times.max(axis=2), set()
    for block in np.flatnonzero(np.any(best > stands_out, axis=1)):
        channel = int(np.argmax(best[block]))
        start = block * width + int(np.argmax(times[block, channel])) - width // 2
        start = min(max(start, 0), spectra.shape[1] - width)
        at, place, alone = _tone_at(spectra[:, start : start + width], channel, n, stands_out)
        line = start + at + low + place
        if alone and (channel, round(line)) not in told:
            told.add((channel, round(line)))
            yield DamagedSamples("tone", channel, np.array([[0, n - 1]]), line / n)


def _tone_at(
    lines: ComplexArray, channel: int, samples: int, stands_out: float, loud: float = 0.01, sine: float = 8.0,
    elsewhere: float = 15.0,
) -> tuple[int, float, bool]:  # fmt: skip
    """Line of a tone of a channel among lines (channels, k), its place from there, and whether it is one, and alone.

    It is `loud` against the channel's rms, beyond what steps make of a sine; it leaves little of the lines about it
    (`sine`); and without its channel no other stands out as much as `elsewhere`.
    """
    blocks = lines[None]
    times = _power(_unpredicted(blocks))[0, channel]
    at = int(np.argmax(times))
    reach = np.arange(max(at - 3, 0), min(at + 4, lines.shape[1]))
    left = _unpredicted(blocks, np.delete(blocks, reach, axis=2))[0, channel]
    place, steady = _steady(left[reach], reach - at)
    size = np.abs(left[at]) / (samples / 4)  # a Hann window's peak of a sine of one
    others = _power(_unpredicted(np.delete(blocks, channel, axis=1)))[0, :, max(at - 1, 0) : at + 2]
    stands = times[at] > stands_out and others.max() < elsewhere
    return at, place, bool(stands and size > loud and steady > sine)


def _unpredicted(blocks: ComplexArray, fitted: ComplexArray | None = None) -> ComplexArray:
    """What each channel has beside a combination of the others, in blocks of lines (k, channels, lines).

    Combinations are those that leave least in the blocks, or in `fitted`, some of their lines.
    """
    lines = blocks if fitted is None else fitted
    gram = lines @ np.conj(np.swapaxes(lines, 1, 2))
    floor = 1e-6 * np.einsum("kcc->kc", gram).real + np.finfo(float).tiny
    inverse = np.linalg.inv(gram + floor[..., None] * np.eye(gram.shape[1]))
    return np.asarray(inverse @ blocks / np.einsum("kcc->kc", inverse)[..., None])


def _power(left: ComplexArray) -> Array:
    """Power of lines (k, channels, lines) over its median in the block."""
    power = np.abs(left) ** 2
    return np.asarray(power / np.maximum(np.median(power, axis=2, keepdims=True) / np.log(2), np.finfo(float).tiny))


def _steady(lines: ComplexArray, at: Stretches) -> tuple[float, float]:
    """Place of a steady sine among lines of a Hann window at whole places, and its power over what it leaves."""
    places = np.linspace(-1, 1, 81)
    away = at - places[:, None] + 1e-9  # no zero over zero
    sines = (-1.0) ** at * np.sinc(away) / (1 - away**2)
    power = np.abs(sines @ lines) ** 2 / np.sum(sines**2, axis=1)
    best = int(np.argmax(power))
    left = max(float(np.sum(np.abs(lines) ** 2) - power[best]), np.finfo(float).tiny)
    return float(places[best]), float(power[best]) / left
