"""Damaged samples: whether kind and channel are told of one damaged channel a test, and nothing of sound tests.

Beams, frames and plates of the finite elements of `band`. Their base moves at eight times the rate of the record: each
mode follows by a recursion that is exact for a base acceleration that is linear between its samples. The sums are
low-passed and decimated, noise is added, and all is rounded to the steps of a recorder of 8 to 24 bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.signal

from benchmarks.band.structures import Continuous, log_uniform, structure
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread
from sysid.measurement.damaged_samples import damaged_samples

FASTER = 8
STRUCTURES = 60
DRAWS, CLEAN = 100, 200
SHORT, SHORT_CLEAN = 2, 18
SHARE = 0.98
RATE = (3.2, 12.0)  # samples a period of the last line
SAMPLES, FEW = (4000, 16000), (400, 1500)
MOST = 2.0  # times the rate: modes above it are left out
NOISE = (1e-4, 0.03)  # of each channel's rms
BITS = (12, 16, 24)
CLIPPED = (1.0, 3.0)  # of a channel's rms
LEAST = 5  # samples that clipping changes
LASTING = (0.05, 2.0)  # s, of gaps and held values; a quarter of the record at most, 5 samples at least
SPIKES, HEIGHT = 8, (4.0, 100.0)  # number, times the rms
KNOCKS, KNOCK = 5, (5.0, 60.0)  # of the base, times its rms
HUM = (0.05, 0.5)  # of the rms
DAMAGE = ("clipped", "dropout", "equal channels", "spikes", "tone", "held value")
SOUND = (
    "random, 8 bit", "random", "sweep", "sweep, 8 bit", "dwell", "dwell, 8 bit", "at rest at both ends",
    "at rest, 8 bit", "short", "short, 8 bit", "low-passed and decimated", "bursts", "bursts, 8 bit", "noise-free",
    "pulses to one side", "second axis later", "knocks of the base",
)  # fmt: skip


@dataclass(frozen=True)
class Told:
    """What was told of one test: kinds and channels, and those that were made."""

    name: str
    made: tuple[tuple[str, int], ...]
    told: tuple[tuple[str, int], ...]

    @property
    def is_right(self) -> bool:
        """True where all that was made was told, and nothing else."""
        return self.told == self.made


def lines(reduced: bool) -> Iterator[Line]:
    """100 tests of each kind of damage and 200 sound ones; or a few of each."""
    count, clean = (SHORT, SHORT_CLEAN) if reduced else (DRAWS, CLEAN)
    tasks = [(kind, number) for kind in DAMAGE for number in range(count)]
    every = spread(one_test, [*tasks, *((SOUND[number % len(SOUND)], number) for number in range(clean))])
    for kind in DAMAGE:
        of_kind = [one for one in every if one.name.startswith(f"{kind} ")]
        wrong = [f"{one.name}: {one.told or 'nothing'} for {one.made}" for one in of_kind if not one.is_right]
        text = f"{kind}, {len(of_kind)} tests: kind and channel told{_examples(wrong)}"
        yield above(text, float(np.mean([one.is_right for one in of_kind])), SHARE)
    sound = [one for one in every if one.name.startswith(SOUND)]
    wrong = [f"{one.name}: {one.told}" for one in sound if not one.is_right]
    yield below(f"{len(sound)} sound tests: something told{_examples(wrong)}", len(wrong), 0)


def one_test(task: tuple[str, int]) -> Told:
    """One test, damaged by its kind or sound."""
    kind, number = task
    rng = np.random.default_rng((number, 28, [*DAMAGE, *SOUND].index(kind)))
    rig = structure(int(rng.integers(STRUCTURES)))
    records, rate = recorded(rig, kind, rng)
    d = len(rig.base)
    made: list[tuple[str, int]] = []
    if kind in DAMAGE:
        of_base = kind in ("clipped", "spikes", "tone")  # a base rests, and may be the record of a sensor
        channel = int(rng.integers(0 if of_base else d, len(records)))
        damage: dict[str, Callable[..., None]] = {
            "clipped": _clip, "dropout": _gap, "equal channels": _copy, "spikes": _spike, "tone": _hum,
            "held value": _hold,
        }  # fmt: skip
        damage[kind](records, channel, rng, rate, rig)
        made += [(kind, channel)] * (kind != "equal channels")
    bits = 8 if "8 bit" in kind else int(rng.choice(BITS))
    shown = _rounded(records, bits, rng)
    # Those that are equal by symmetry are told rightly too.
    made += [("equal channels", i) for i in range(d, len(shown)) if np.any(np.all(shown[d:i] == shown[i], axis=1))]
    told = sorted((one.kind, one.channel) for one in damaged_samples(shown, d))
    return Told(f"{kind} {number}, {bits} bit, {rig.name}", tuple(sorted(made)), tuple(told))


def recorded(rig: Continuous, kind: str, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Base, sensors and force of a test with noise, (2 d + n_sensors, n), and their rate, Hz."""
    rate = float(rig.lines[1] * rng.uniform(*RATE))
    n = round(log_uniform(rng, FEW if "short" in kind else SAMPLES))
    base = _base(rig, kind, rng, n, rate)
    modes = rig.modes
    kept = np.flatnonzero(modes.omega < 2 * np.pi * MOST * rate)
    step = 1 / (FASTER * rate)
    acceleration = np.array([
        recursion(modes.omega[k], modes.zeta[k], -modes.gamma[k] @ base, step) for k in kept
    ])  # fmt: skip
    high = np.vstack([
        base, modes.shapes[:, kept] @ acceleration + modes.rigid_body @ base,
        modes.gamma[kept].T @ acceleration + modes.rigid_body_mass @ base,
    ])  # fmt: skip
    records = scipy.signal.decimate(high, FASTER, ftype="fir", axis=1)
    if "decimated" in kind:
        records, rate = scipy.signal.decimate(records, 2, axis=1), rate / 2
    size = np.sqrt(np.mean(records**2, axis=1, keepdims=True))
    quiet = kind in ("noise-free", "second axis later") or ("burst" in kind and rng.random() < 0.5)
    records = records + (not quiet) * log_uniform(rng, NOISE) * size * rng.standard_normal(records.shape)
    if "at rest" in kind and rng.random() < 0.5:  # a recorder that waits for motion
        loud = np.flatnonzero(np.max(np.abs(records) / size, axis=0) > 0.1)
        records[:, : loud[0]] = records[:, loud[-1] + 1 :] = 0.0
    return records, rate


def recursion(omega: float, zeta: float, load: np.ndarray, step: float) -> np.ndarray:
    """Acceleration of a mode from rest under a load that is linear between its samples, exactly."""
    pole = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    # z(t + h) = E z(t) + h (phi_1 - phi_2) f(t) + h phi_2 f(t + h); q = Im z / w_d with z' = pole z + f.
    E, first, second = scipy.linalg.expm(np.array([[pole * step, 1, 0], [0, 0, 1], [0, 0, 0]]))[0]
    driven = step * ((first - second) * load[:-1] + second * load[1:])
    z = np.concatenate([[0], scipy.signal.lfilter([1.0], [1.0, -E], driven)])
    return np.asarray((pole**2 * z).imag / pole.imag + load)


def _base(rig: Continuous, kind: str, rng: np.random.Generator, n: int, rate: float) -> np.ndarray:
    """Base acceleration (d, n) at the faster rate."""
    time, (low, high) = np.arange(FASTER * n) / (FASTER * rate), rig.lines
    d, seconds = len(rig.base), n / rate
    if "sweep" in kind or "dwell" in kind:
        if "sweep" in kind:
            turns = seconds / np.log(high / low) * low * np.exp(time / seconds * np.log(high / low))
        else:
            steps = rng.choice([rate / rng.integers(4, 20), rig.frequencies[0], rng.uniform(low, high)], 3)
            turns = np.cumsum(steps[np.minimum(3 * time / seconds, 2).astype(int)]) * (time[1] - time[0])
        size = np.concatenate([[1.0], rng.uniform(0, 0.3, d - 1)])
        return np.asarray(np.outer(size, np.sin(2 * np.pi * turns) * np.minimum(time / (0.05 * seconds), 1)))
    band = scipy.signal.butter(4, [low, min(1.2 * high, 0.4 * rate)], "bandpass", fs=FASTER * rate, output="sos")
    base = scipy.signal.sosfilt(band, rng.standard_normal((d, time.size)), axis=1)
    if "at rest" in kind:
        start, end = np.sort(rng.uniform(0.05, 0.5, 2)) * seconds
        rise, fall = (time - start) / (0.05 * seconds), (start + end - time) / (0.1 * seconds)
        base = base * np.clip(rise, 0, 1) * np.clip(fall, 0, 1)
    elif "bursts" in kind:
        base = base * (time * rng.uniform(2, 6) / seconds % 1 < 0.5)
    elif kind == "second axis later":
        base[-1, time < rng.uniform(0.05, 0.5) * seconds] = 0.0
    elif kind in ("pulses to one side", "knocks of the base"):
        base, size = base * (kind != "pulses to one side"), log_uniform(rng, KNOCK) * base.std(axis=1)
        for _ in range(KNOCKS):
            turns = (time - rng.uniform(0.1, 0.9) * seconds) * rate / rng.uniform(2, 16)
            base = base + np.outer(size, np.where((turns > 0) & (turns < 0.5), np.sin(2 * np.pi * turns), 0.0))
    return np.asarray(base)


def _rounded(records: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    """Records in steps of recorders whose range holds each channel, up to four times."""
    full = np.abs(records).max(axis=1, keepdims=True) * rng.uniform(1.0, 4.0 if bits > 8 else 1.5)
    step = full / 2 ** (bits - 1)
    return np.asarray(step * np.round(records / step))


def _clip(records: np.ndarray, channel: int, rng: np.random.Generator, *_: object) -> None:
    record = records[channel]
    size = np.sqrt(np.mean(record**2))
    most = min(CLIPPED[1], np.sort(np.abs(record))[-LEAST] / size)
    level = size * rng.uniform(CLIPPED[0], most)
    np.clip(record, -level, level, out=record)


def _stretch(n: int, rng: np.random.Generator, rate: float) -> slice:
    length = int(np.clip(rate * log_uniform(rng, LASTING), 5, n // 4))
    start = int(rng.integers(1, n - length))
    return slice(start, start + length)


def _gap(records: np.ndarray, channel: int, rng: np.random.Generator, rate: float, *_: object) -> None:
    records[channel, _stretch(records.shape[1], rng, rate)] = 0.0


def _hold(records: np.ndarray, channel: int, rng: np.random.Generator, rate: float, *_: object) -> None:
    stretch = _stretch(records.shape[1], rng, rate)
    records[channel, stretch] = records[channel, stretch.start - 1]


def _copy(records: np.ndarray, channel: int, rng: np.random.Generator, _: float, rig: Continuous) -> None:
    """One record in the place of another; a base may well move along two axes alike."""
    first = len(rig.base) if channel < len(rig.base) else 0
    records[channel] = records[rng.choice([i for i in range(first, len(records)) if i != channel])]


def _spike(records: np.ndarray, channel: int, rng: np.random.Generator, *_: object) -> None:
    size = np.sqrt(np.mean(records[channel] ** 2))
    for _ in range(int(rng.integers(1, SPIKES + 1))):
        at = int(rng.integers(20, records.shape[1] - 20))
        records[channel, at : at + int(rng.integers(1, 3))] += rng.choice([-1, 1]) * size * log_uniform(rng, HEIGHT)


def _hum(records: np.ndarray, channel: int, rng: np.random.Generator, rate: float, rig: Continuous) -> None:
    on = rng.random() < 0.5
    f = rng.choice(rig.frequencies[: rig.count]) if on else rng.uniform(*rig.lines)
    time = np.arange(records.shape[1]) / rate
    size = np.sqrt(2 * np.mean(records[channel] ** 2)) * log_uniform(rng, HUM)
    records[channel] += size * np.sin(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi))


def _examples(texts: list[str], most: int = 3) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""
