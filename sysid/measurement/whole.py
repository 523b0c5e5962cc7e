"""Whole records: what their spectra hold beside the response to the base, and the noise of every channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, finite_array, instance, refuse, sequence
from sysid.measurement.spectra import TimeRun, of_run, runs_of_records
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Standard deviations of the noise of a sample in time, were it white up to half the sample rate.

    Attributes
    ----------
    response : (n_sensors,) or (runs, n_sensors)
        m/s²; a row a run where they were found in several.
    base : (d,) or (runs, d)
        m/s² (rad/s² for a rotation).
    force : (d,), (runs, d) or None
        N (N m); None where no force was measured.

    Examples
    --------
    Two sensors, one base direction, no force:

    >>> NoiseLevels(response=[0.02, 0.03], base=[0.01]).outputs
    array([0.02, 0.03])
    """

    response: Array
    base: Array
    force: Array | None = None

    def __post_init__(self) -> None:
        for name in ("response", "base", "force"):
            value = getattr(self, name)
            if value is not None:
                array = np.atleast_1d(finite_array(f"noise of the {name}", value))
                if array.ndim > 2 or np.any(array < 0):
                    raise InputError(f"noise of the {name}: one standard deviation >= 0 a channel, or run and channel")
                object.__setattr__(self, name, array)

    def of(self, runs: int, n_sensors: int, d: int, force: bool) -> NoiseLevels:
        """The levels of a test of so many runs and channels: one number for all of a kind will do.

        Those given as a row a run stay so, (runs, channels); others are (channels,). Refused where there are levels of
        another number of channels, or none of a force that was measured.
        """
        refuse((
            force and self.force is None,
            "noise states no level of the force, which was measured: NoiseLevels(force=...)",
        ))  # fmt: skip
        levels = {}
        for name, count in (("response", n_sensors), ("base", d), *[("force", d)] * force):
            value = getattr(self, name)
            refuse((
                value.shape not in ((1,), (count,), (runs, count)),
                f"noise of the {name} has shape {value.shape}: one number, ({count},), or a row of them a run, "
                f"({runs}, {count})",
            ))  # fmt: skip
            levels[name] = np.broadcast_to(value, (runs, count) if value.ndim == 2 else (count,)).copy()
        return NoiseLevels(**levels)

    @property
    def outputs(self) -> Array:
        """Of responses and, behind them, forces, (n_sensors [+ d],) or a row of them a run."""
        return self.response if self.force is None else np.concatenate([self.response, self.force], axis=-1)


@dataclass(frozen=True, eq=False)
class WholeRecords:
    """Properties of whole records beside their spectra; one entry a run.

    A record of N `samples` neither starts nor ends at rest: its finite Fourier transform is the response to the base,
    and two real numbers a mode, by which the motion at its end differs from that at its start; those stated to begin
    and end `at_rest` have no such numbers. Lines are multiples of ``sample_rate / N``, Hz. `noise` is stated, or None
    where it is estimated with the fit. `varying`, (runs, channels), are sensors, forces and base directions whose level
    is found to vary over the lines; `taken`, (n_sensors [+ 1],), s, are delays that were taken off sensors and force:
    at one of its ends such a record holds what is not its own. `constants`, (n_sensors, d), are shares of the base's
    motion that were taken off the sensors. `plain` tells that squares are fitted, the base's motion
    as recorded, and `grows` that the noise of each channel holds a share of its signal. All five are set by the fit, in
    no file. `tones` are frequencies of steady sines, Hz, of which each channel and run holds one.
    """

    samples: tuple[int, ...]
    sample_rate: float
    at_rest: tuple[bool, ...]
    noise: NoiseLevels | None = field(default=None)
    varying: NDArray[np.bool_] | None = field(default=None)
    taken: Array | None = field(default=None)
    constants: Array | None = field(default=None)
    plain: bool = field(default=False)
    grows: bool = field(default=False)
    tones: tuple[float, ...] = field(default=())

    @property
    def of_sampling(self) -> int:
        """Real numbers of each channel and run of 1, i w, 1 / (i w), by sampling and detrending, and two a tone."""
        return 3 + 2 * len(self.tones)

    @property
    def moving(self) -> tuple[int, ...]:
        """Runs that are not stated to begin and end at rest."""
        return tuple(run for run, rest in enumerate(self.at_rest) if not rest)

    @property
    def density(self) -> Array:
        """Variance of a spectral line's noise over that of a sample in time, of each run, s²."""
        return np.array(self.samples) / self.sample_rate**2

    @property
    def spacing(self) -> Array:
        """Distance of the lines of each run, Hz."""
        return self.sample_rate / np.array(self.samples)

    def of_runs(self, kept: NDArray[np.bool_]) -> WholeRecords:
        """That of some runs."""
        samples, rest = (tuple(np.array(part)[kept].tolist()) for part in (self.samples, self.at_rest))
        noise = self.noise
        if noise is not None and noise.base.ndim == 2:
            noise = NoiseLevels(**{name: part[kept] for name, part in vars(noise).items() if part is not None})
        return replace(self, samples=samples, at_rest=rest, noise=noise)

    def of_sensors(self, kept: NDArray[np.bool_]) -> WholeRecords:
        """That of some sensors."""
        taken = self.taken
        if taken is not None:
            taken = np.concatenate([taken[: kept.size][kept], taken[kept.size :]])
        noise = self.noise and replace(self.noise, response=self.noise.response[..., kept])
        constants = None if self.constants is None else self.constants[kept]
        return replace(self, noise=noise, taken=taken, constants=constants)

    def earlier(self, delays: Array) -> WholeRecords:
        """That of records whose delays, s, (n_sensors [+ 1],), were taken off their spectra."""
        taken = delays if self.taken is None else self.taken + delays
        return replace(self, taken=taken if np.any(taken) else None)

    def less(self, constants: Array) -> WholeRecords:
        """That of records of whose sensors shares of the base's motion, (n_sensors, d), were taken off."""
        total = constants if self.constants is None else self.constants + constants
        return replace(self, constants=total if np.any(total) else None)

    def profile_at(self, lines: NDArray[np.bool_]) -> Array | float:
        """Noise at lines, (n_freq,), over its level: alike at all."""
        return 1.0

    def transients(self, freq: Array) -> ComplexArray:
        """Motion at the ends of a run as further inputs at lines in Hz: a change of velocity, of displacement; (2, n).

        ``g_k (a / w² + i b / w)`` is what ``(a + i w b) / (w_k² - w² + 2 i zeta_k w_k w)`` is.
        """
        w = 2 * np.pi * freq
        return np.stack([1 / w**2, 1j / w])

    def pulses(self, last: float) -> tuple[Array, NDArray[np.bool_]]:
        """Times from an end, s, (k,), at which turned records hold what is not theirs, for lines up to `last`, Hz.

        And which sensors, and the force, do there, (n_sensors [+ 1], k). So many as tell a signal in these lines that
        is as long as the largest delay, by half periods, and two; none where traces of sampling make up for it.
        """
        taken = np.zeros(0) if self.taken is None else self.taken
        times, spacing = [], []
        for end in (taken.max(initial=0.0), taken.min(initial=0.0)):
            periods = 2 * last * abs(end)
            count = int(np.ceil(periods)) + 2 * (periods > 0.25) if periods > 0.02 else 0
            times.append(end * (np.arange(count) + 0.5) / max(count, 1))
            spacing.append(np.full(count, abs(end) / max(count, 1)))
        at, width = np.concatenate(times), np.concatenate(spacing)
        return at, (taken[:, None] * at > 0) & (np.abs(at) < np.abs(taken[:, None]) + width / 2)

    def traces(self, freq: Array, last: float) -> ComplexArray:
        """Spectra at lines in Hz of which a channel of a run holds multiples beside its response, (3 + k, n).

        Those of sampling, 1, i w and 1 / (i w), for lines up to `last`, Hz, of tones, and then those of the `pulses`.
        """
        unit = freq / last
        plain = np.stack([np.ones_like(unit) + 0j, 1j * unit, -1j / unit])[: self.of_sampling]
        of_tones = [self.of_tone(one, freq) for one in self.tones]
        return np.concatenate([plain, *of_tones, np.exp(2j * np.pi * self.pulses(last)[0][:, None] * freq)])

    def of_tone(self, tone: float, freq: Array) -> ComplexArray:
        """Spectra at lines in Hz, (2, n), of whose real multiples that of any steady sine of `tone` Hz is made, and 1.

        At a line, where ``exp(i w T)`` is one, the sum of ``exp(i (v - w) t)`` over the samples of a record is a number
        of the record over ``exp(i (v - w) dt) - 1``, so that of a sine is a real combination of
        ``i sin(w dt) / (cos(w dt) - cos(v dt))``, ``sin(v dt)`` over the same, and 1.
        """
        w, v = 2 * np.pi * freq / self.sample_rate, 2 * np.pi * tone / self.sample_rate
        half = np.sin((v - w) / 2)  # of a tone at a line this is a spectrum of that line alone
        half = np.where(np.abs(half) < 1e-11, 1e-11, half)
        over = 2 * half * np.sin((v + w) / 2)
        return np.stack([1j * np.sin(w) / over, np.sin(v) / over + 0j])

    def to_tree(self) -> dict[str, Any]:
        """Give it as dictionaries and arrays; `from_tree` takes it back."""
        return {
            "samples": np.array(self.samples),
            "sample_rate": self.sample_rate,
            "at_rest": np.array(self.at_rest),
            "noise": self.noise and dict(vars(self.noise)),
            "tones": np.array(self.tones),
        }

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> WholeRecords:
        """Give what a tree of `to_tree` stands for."""
        noise = tree["noise"] and NoiseLevels(**tree["noise"])
        samples, rest = tuple(map(int, tree["samples"])), tuple(map(bool, tree["at_rest"]))
        tones = tuple(np.asarray(tree.get("tones", ())).tolist())
        return cls(samples, float(tree["sample_rate"]), rest, noise, tones=tones)


@dataclass(frozen=True, eq=False)
class SteadyLines(WholeRecords):
    """Lines that stand for themselves, without transients, as stepped sines leave them, or an analyser.

    `sample_rate` is their least distance, Hz; variances are those of the complex numbers themselves. `profile`,
    (n_freq,), is the noise of all channels that is no share of their signal, at each line over its level: a dwell of so
    many cycles holds the more of it the shorter it is, and much at lines about that of the mains. The fit sets it.
    """

    profile: Array | None = field(default=None)

    @classmethod
    def of(cls, runs: int, freq: Array, *, grows: bool = True) -> SteadyLines:
        """Those of so many runs at lines in Hz."""
        return cls((1,) * runs, float(np.diff(freq).min()), (True,) * runs, grows=grows)

    @property
    def of_sampling(self) -> int:
        """None: see `WholeRecords`."""
        return 0

    @property
    def density(self) -> Array:
        """One each."""
        return np.ones(len(self.samples))

    def profile_at(self, lines: NDArray[np.bool_]) -> Array | float:
        """See `WholeRecords`."""
        return 1.0 if self.profile is None else self.profile[lines]

    def pulses(self, last: float) -> tuple[Array, NDArray[np.bool_]]:
        """None: see `WholeRecords`."""
        return np.zeros(0), np.zeros((1, 0), bool)


def check_options(estimator: str, *, at_rest: Any, noise: Any, segment: Any) -> None:
    """Refuse options of `Measurement.from_time` that its estimator does not read."""
    whole, averaged = estimator == "records", estimator in ("h1", "h2")
    rests = np.any(np.asarray(at_rest, dtype=object) != False)  # noqa: E712 - entry by entry
    if noise is not None:
        instance("noise", noise, NoiseLevels)
    refuse(
        (not whole and rests, f"at_rest goes with estimator='records', not {estimator!r}: leave it out"),
        (not whole and noise is not None, f"noise goes with estimator='records', not {estimator!r}: leave it out"),
        (not averaged and segment is not None, f"segment goes with 'h1' and 'h2', not {estimator!r}: leave it out"),
    )


def whole_of(
    runs: Sequence[TimeRun], sample_rate: float, at_rest: Any, noise: NoiseLevels | None, rigid_body: Array
) -> WholeRecords:
    """Properties of the whole records of a test, of what `Measurement.from_time` is told of them.

    Refused where the ends of a run are not as they were recorded, see `check_cuts`.
    """
    count, (n, d) = len(runs), rigid_body.shape
    rest = np.asarray([at_rest] * count if isinstance(at_rest, bool | np.bool_) else at_rest)
    if rest.shape != (count,) or rest.dtype != bool:
        raise InputError(f"at_rest = {at_rest!r}: give True or False, or one of them for each of the {count} runs")
    check_cuts(runs, rest.tolist(), rigid_body)
    levels = noise and noise.of(count, n, d, runs[0].force is not None)
    return WholeRecords(tuple(run.base.shape[1] for run in runs), sample_rate, tuple(rest.tolist()), levels)


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
    zero, fades shorter than some periods of the motion. `rigid_body` is (n_sensors, d).
    """
    for i in np.flatnonzero(~np.array(at_rest)).tolist():
        run, where = runs[i], of_run(i, len(runs))
        still = padded(run, rigid_body)
        refuse(
            (
                still,
                f"the last {still} samples{where} hold one value in every channel while the structure was in motion "
                "just before: a record that was padded with zeros, or that stopped early; leave them out: whole "
                "records may have any length",
            ),
            (
                tapered(run, rigid_body),
                f"all channels{where}, the base's too, fall to zero together towards both ends, faster than a "
                "structure comes to rest: a window or a fade was laid over the record; give it as it was recorded: "
                "whole records may begin and end in motion (or state at_rest=True where it was at rest at both ends)",
            ),
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


_FEWEST_LINES = 50  # a deviation known to 7 %


def levels_at_rest(
    runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]],
    sample_rate: float,
    *,
    band: tuple[float, float] | None = None,
) -> NoiseLevels:
    """Noise of each channel from stretches in which nothing moves, for ``from_time(noise=)``.

    Deviations of a sample in time, were the noise white as it is in the band. A mean and a straight line are taken off
    each record; the lowest line, which that touches, is left out.

    Parameters
    ----------
    runs : sequence of (base, response, force or None)
        Records at rest, as in `Measurement.from_time`.
    sample_rate : float
        Hz.
    band : (low, high), optional
        Hz, both ends included: that of the test; noise that is not white has another level elsewhere.

    Raises
    ------
    InputError
        Records that do not fit each other, or are too short for a level.
    """
    records = runs_of_records(runs, sample_rate)
    low, high = (0.0, np.inf) if band is None else sequence("band", band, "(low, high) in Hz", 2)
    level = _levels(records, sample_rate, low, high)
    n, d = records[0].response.shape[0], records[0].base.shape[0]
    return NoiseLevels(level[:n], level[n : n + d], None if records[0].force is None else level[n + d :])


def _levels(runs: Sequence[TimeRun], sample_rate: float, low: float, high: float) -> Array:
    """Deviations of a sample of responses, base and force, (channels,), by the lines from `low` to `high` Hz."""
    power, lines = np.zeros(1), 0
    for run in runs:
        records = np.vstack([one for one in (run.response, run.base, run.force) if one is not None])
        n = records.shape[1]
        freq = np.fft.rfftfreq(n, 1 / sample_rate)
        keep = (np.arange(freq.size) > 1) & (freq < sample_rate / 2) & (freq >= low) & (freq <= high)
        unit = np.vander(np.linspace(-1.0, 1.0, n), 2)
        slopes = np.linalg.lstsq(unit, records.T, rcond=None)[0]
        spectra = np.fft.rfft(records - (unit @ slopes).T, axis=1)[:, keep]
        power, lines = power + np.sum(np.abs(spectra) ** 2, axis=1) / n, lines + int(keep.sum())
    if lines < _FEWEST_LINES:
        raise InputError(
            f"the stretch at rest has {lines} lines in the band, too few for a level (at least {_FEWEST_LINES}): "
            "give a longer stretch, or a wider band"
        )
    return np.sqrt(power / lines)


def separable(std: Array | None, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Weights 1/std as a product: of the channels (channels,) and of the lines of each run (runs, n_freq).

    They are geometric means over the other axes of `std`, (runs, channels, n_freq): exact where the noise is a product
    of the two, as it is where one number, one number for each channel or one spectrum is stated, and ones where nothing
    is. Fits with other weights than 1/std are unbiased all the same, and their covariance is computed with the stated
    noise.
    """
    runs, channels, lines = shape
    floored = raised(std)
    if floored is None:
        return np.ones(channels), np.ones((runs, lines))
    weight = -np.log(floored)
    channel = weight.mean(axis=(0, 2))
    return np.exp(channel), np.exp((weight - channel[:, None]).mean(axis=1))


def products(std: Array | None, shape: tuple[int, int, int]) -> list[tuple[NDArray[np.intp], Array, Array]]:
    """`separable` weights of as many runs together as share their factors of the channels: of all, or of each alone.

    Numbers of runs (r,), weights of channels (channels,) and of lines (r, n_freq). The deviations of different runs are
    seldom one product: what one direction of the base moves most, another hardly does.
    """
    runs, every, std = np.arange(shape[0]), separable(std, shape), raised(std)
    each = [separable(None if std is None else std[[run]], (1, *shape[1:])) for run in runs]
    channel = np.array([one / np.exp(np.log(one).mean()) for one, _ in each])
    if np.allclose(channel, channel[0], rtol=ROUND_OFF, atol=0.0):
        return [(runs, *every)]
    return [(runs[[run]], *one) for run, one in enumerate(each)]


def factors_of_runs(
    std: Array | None, shape: tuple[int, int, int], *, together: bool = False
) -> tuple[Array, Array]:  # fmt: skip
    """`products` as weights of the channels in each run, (runs, channels), and of lines, (runs, n_freq).

    With `together` channels weigh alike in all runs.
    """
    groups = [(np.arange(shape[0]), *separable(std, shape))] if together else products(std, shape)
    of_channels, of_lines = np.empty(shape[:2]), np.empty((shape[0], shape[2]))
    for runs, channel, line in groups:
        of_channels[runs], of_lines[runs] = channel, line
    return of_channels, of_lines


def raised(std: Array | None) -> Array | None:
    """Stated deviations as fits weigh by them, the smallest raised; None where none is stated, or none above zero."""
    if std is None or not np.any(std > 0):
        return None
    return np.maximum(std, NEGLIGIBLE * np.median(std[std > 0]))
