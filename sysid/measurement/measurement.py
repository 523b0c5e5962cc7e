"""A base-shake test: spectra of the base and of the sensors, from FRFs, time records or a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, as_float, check_frequencies, choice, numbers, refuse, sequence, whole_number
from sysid.measurement import spectra
from sysid.measurement.damaged_runs import DamagedChannel, names_of_channels, sound_runs
from sysid.measurement.spectra import FORCE_NEEDED, Missing, checked_deviations, checked_lines, complete, named, present
from sysid.measurement.steady_tones import with_steady_tones
from sysid.measurement.whole import NoiseLevels, WholeRecords, check_options, levels_at_rest, whole_of
from sysid.structure.sensor import (
    BASE_AXES,
    BaseSensor,
    Sensor,
    axes_of_base,
    checked_sensors,
    motion_of_sensors,
    sensors_from_tree,
    sensors_to_tree,
    tolerances,
    without_delay,
)
from sysid.structure.structure import Array, ComplexArray, Structure

_RECORDS = ("freq", "base", "response", "force", "response_std", "force_std")  # what has lines


@dataclass(frozen=True, eq=False, repr=False)
class Measurement:
    """Spectra of a base-shake test.

    Parameters
    ----------
    freq : array_like, shape (n_freq,)
        Hz, strictly increasing.
    base : array_like, complex, shape (runs, d, n_freq)
        Base acceleration, m/s² (rad/s² for a rotation). One run may be given without its axis.
    response : array_like, complex, shape (runs, n_sensors, n_freq)
        *Absolute* acceleration of the sensors, m/s².
    rigid_body : array_like, shape (n_sensors, d), optional
        Motion of the sensors for unit base motion (`sysid.rigid_body`); by default what `sensors` and `base_axes` tell.
    force : array_like, complex, shape (runs, d, n_freq), optional
        Force of the base on the structure, N (N m): it tends to ``+M_rb u0''`` at low frequency.
    sensors : sequence of Sensor, optional
    response_std, force_std : array_like, optional
        Standard deviation of the complex noise, ``sqrt(E|e|²)``; broadcast to their records. The median stands for
        zeros among others.
    base_axes : str or sequence of str, optional
        Names of the base directions (see `sysid.rigid_body`); by default those that the sensors' axes tell, else
        x y z rx ry rz in this order. Needed where fewer than four directions hold a rotation.
    missing : {"refuse", "drop"}
        What is done with NaN in the records or their deviations: "drop" leaves out every line that holds any.
    dropped : int
        How many lines were left out so, of all records.
    holes : tuple of (str, ndarray)
        What held NaN there, a sensor's name or that of another record, and at which lines, Hz.
    averaged : bool or int
        Averages over segments, of independent blocks as many as are known, as "h1" of `from_time` gives: see `window`.
    window : str
        "hann" of functions H1 under that window, "taken off" without what it makes of their poles, "" of all else.
    whole : WholeRecords, optional
        Of spectra of whole records, which neither begin nor end at rest: see `from_time`.
    sample_rate : float, optional
        Hz; of the plain spectra of whole records, in m/s² s, that `from_time` gives with the estimator "spectra".
    gain_std, base_gain_std, force_gain_std : array_like, optional
        Tolerances: standard deviations of the relative error of each gain, of the sensors (n_sensors,), of the base's
        (d,) and of the force's (d,); one number is that of all. By default those that `sensors` state, others exact.
    damage : tuple of DamagedChannel
        Damaged samples of the records of which `from_time` makes it.
    base_sensors : tuple of BaseSensor
        Of which the base's motion was made, where they are more than its directions.

    Notes
    -----
    Spectra follow ``exp(+i w t)``. Their common scale (per Hz, one-sided or not) does not matter
    as long as base, response and force share it.
    """

    freq: Array
    base: ComplexArray
    response: ComplexArray
    rigid_body: Array = field(default=None, kw_only=True)  # type: ignore[arg-type] # filled below
    force: ComplexArray | None = field(default=None, kw_only=True)
    sensors: tuple[Sensor, ...] | None = field(default=None, kw_only=True)
    response_std: Array | None = field(default=None, kw_only=True)
    force_std: Array | None = field(default=None, kw_only=True)
    base_axes: tuple[str, ...] = field(default=None, kw_only=True)  # type: ignore[arg-type] # filled below
    missing: InitVar[Missing] = field(default="refuse", kw_only=True)
    dropped: int = field(default=0, kw_only=True)
    holes: tuple[tuple[str, Array], ...] = field(default=(), kw_only=True)
    averaged: int = field(default=False, kw_only=True)
    window: str = field(default="", kw_only=True)
    whole: WholeRecords | None = field(default=None, kw_only=True)
    sample_rate: float | None = field(default=None, kw_only=True)
    gain_std: Array | None = field(default=None, kw_only=True)
    base_gain_std: Array | None = field(default=None, kw_only=True)
    force_gain_std: Array | None = field(default=None, kw_only=True)
    damage: tuple[DamagedChannel, ...] = field(default=(), kw_only=True)
    base_sensors: tuple[BaseSensor, ...] = field(default=(), kw_only=True)

    def __post_init__(self, missing: Missing) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 - a frozen class fills itself
        choice("missing", missing, ("refuse", "drop"))
        choice("window", self.window, ("", "hann", "taken off"))
        put("freq", check_frequencies(self.freq))
        whole_number("dropped", self.dropped, at_least=0)
        lines: Array = self.freq
        holes: dict[str, NDArray[np.bool_]] = {}
        if missing == "drop":
            there, holes = present({name: getattr(self, name) for name in _RECORDS})
            put("dropped", self.dropped + self.freq.size - there["freq"].size)
            for name, record in there.items():
                put(name, record)
        put("base", checked_lines("base", self.base, self.freq.size))
        put("response", checked_lines("response", self.response, self.freq.size))
        put("rigid_body", motion_of_sensors(self.rigid_body, self.sensors, self.base_axes, self.base.shape[1]))
        (runs, d, _), (response_runs, sensors, _) = self.base.shape, self.response.shape
        if self.force is not None:
            put("force", checked_lines("force", self.force, self.freq.size))
            if self.force.shape != self.base.shape:
                words = f"force is {self.force.shape} but base is {self.base.shape}; they have the same axes"
                raise InputError(f"{words}: {FORCE_NEEDED}" if self.force.shape[1] < self.base.shape[1] else words)
        put("sensors", checked_sensors(self.sensors))
        refuse(
            (runs != response_runs, f"base has {runs} runs but response has {response_runs}"),
            (
                self.rigid_body.shape != (sensors, d),
                f"rigid_body is {self.rigid_body.shape}, but response has {sensors} sensors and base {d} directions: "
                f"({sensors}, {d}) is needed",
            ),
            (not np.any(self.base), "base is zero everywhere: there is no excitation to identify from"),
            (not np.any(self.response), "response is zero everywhere: there is no motion to identify from"),
            (
                self.sensors is not None and len(self.sensors) != sensors,
                f"{len(self.sensors or ())} sensors are described but response has {sensors}",
            ),
        )
        put("base_axes", axes_of_base(self.base_axes, self.sensors or (), self.rigid_body))
        put("holes", (*self.holes, *named(holes, lines, self.sensor_names)))
        put("response_std", checked_deviations("response_std", self.response_std, self.response))
        put("force_std", checked_deviations("force_std", self.force_std, self.force))
        if self.gain_std is None and any(sensor.gain_std for sensor in self.sensors or ()):
            put("gain_std", np.array([sensor.gain_std for sensor in self.sensors or ()]))
        for name, count in (("gain_std", sensors), ("base_gain_std", d), ("force_gain_std", d)):
            put(name, tolerances(name, getattr(self, name), count))
        late = stated_delays(self.sensors, self.n_sensors)
        if np.any(late):
            put("sensors", without_delay(self.sensors))
            put("response", self.response * np.exp(2j * np.pi * late[:, None] * self.freq))
            put("whole", self.whole and self.whole.earlier(np.append(late, [0.0] * (self.force is not None))))

    def to_tree(self) -> dict[str, Any]:
        """Give records, geometry and sensors as dictionaries, arrays and texts; `from_tree` takes them back."""
        return {
            "freq": self.freq, "base": self.base, "response": self.response, "rigid_body": self.rigid_body,
            "force": self.force, "sensors": sensors_to_tree(self.sensors), "response_std": self.response_std,
            "force_std": self.force_std, "base_axes": self.base_axes, "dropped": self.dropped,
            "holes": [{"name": name, "freq": freq} for name, freq in self.holes],
            "averaged": self.averaged, "window": self.window, "whole": self.whole and self.whole.to_tree(),
            "sample_rate": self.sample_rate, "gain_std": self.gain_std, "base_gain_std": self.base_gain_std,
            "force_gain_std": self.force_gain_std, "damage": [dict(vars(one)) for one in self.damage],
            "base_sensors": [one._asdict() for one in self.base_sensors],
        }  # fmt: skip

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Measurement:
        """Give the measurement of a tree that `to_tree` made."""
        holes = tuple((hole["name"], hole["freq"]) for hole in tree["holes"])
        whole = tree["whole"] and WholeRecords.from_tree(tree["whole"])
        damage = tuple(DamagedChannel(**one) for one in tree.get("damage", ()))
        given = {"sensors": sensors_from_tree(tree["sensors"]), "holes": holes, "whole": whole, "damage": damage}
        given["base_sensors"] = tuple(BaseSensor(**one) for one in tree.get("base_sensors", ()))
        return cls(**{**tree, **given})

    @property
    def translational(self) -> NDArray[np.bool_]:
        """Which base directions are translations, (d,)."""
        return np.array([name in BASE_AXES[:3] for name in self.base_axes])

    def __repr__(self) -> str:
        axes = " ".join(self.base_axes)
        force = ", force" if self.force is not None else ""
        return f"<Measurement: {self.n_sensors} sensors, base {axes}, {self.n_runs} runs, {self.lines_in_words}{force}>"

    @property
    def lines_in_words(self) -> str:
        """Number of lines, from where to where, and how many were left out for what was missing."""
        dropped = f" ({self.dropped} more hold NaN and are left out)" if self.dropped else ""
        return f"{self.freq.size} lines from {self.freq[0]:.4g} to {self.freq[-1]:.4g} Hz{dropped}"

    @property
    def gaps(self) -> NDArray[np.intp]:
        """Lines before which others were left out, at which no curve is joined."""
        before = np.searchsorted(self.freq, np.concatenate([freq for _, freq in self.holes] or [self.freq[:0]]))
        return np.unique(before[(before > 0) & (before < self.freq.size)])

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return int(self.base.shape[0])

    @property
    def n_base(self) -> int:
        """Number d of base directions."""
        return int(self.base.shape[1])

    @property
    def n_sensors(self) -> int:
        """Number of sensor axes."""
        return int(self.response.shape[1])

    @property
    def inputs(self) -> ComplexArray:
        """Inputs of the structure: the base, then of whole records the motion at the ends of each run.

        (runs, d + 2 r, n_freq) for r runs that are not stated to be at rest at both ends.
        """
        if self.whole is None or not self.whole.moving:
            return self.base
        ends = np.zeros((self.n_runs, 2 * len(self.whole.moving), self.freq.size), complex)
        for at, run in enumerate(self.whole.moving):
            ends[run, 2 * at : 2 * at + 2] = self.own_lines[run] * self.whole.transients(self.freq)
        return np.concatenate([self.base, ends], axis=1)

    @property
    def outputs(self) -> ComplexArray:
        """Responses and, where they were measured, forces, (runs, channels, n_freq)."""
        return self.response if self.force is None else np.concatenate([self.response, self.force], axis=1)

    @property
    def is_in_time(self) -> bool:
        """True where its lines are those of records in time: of whole ones, or of runs from rest to rest."""
        return self.is_whole or (self.sample_rate is not None and not self.averaged)

    @property
    def is_whole(self) -> bool:
        """True where it is of whole records, which hold their transients."""
        return self.whole is not None

    @property
    def own_lines(self) -> NDArray[np.bool_]:
        """Which lines are a run's own, (runs, n_freq): whole records of other lengths have zeros at the others."""
        return np.any(self.base != 0, axis=1)

    @property
    def numbers(self) -> int:
        """Number of complex numbers recorded: of all responses, and forces, at each run's own lines."""
        forces = 0 if self.force is None else self.n_base
        return int(np.count_nonzero(self.own_lines)) * (self.n_sensors + forces)

    @property
    def has_unit_runs(self) -> bool:
        """True where run i is unit motion in base direction i alone, so that responses are transmissibilities."""
        return self.n_runs == self.n_base and np.array_equal(self.base, unit_runs(self.n_base, self.freq.size))

    @property
    def relative(self) -> ComplexArray:
        """Acceleration relative to the moving base, ``response - G base``, (runs, n_sensors, n_freq)."""
        return self.response - np.einsum("sd,rdf->rsf", self.rigid_body, self.base)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names for tables; numbered where the sensors are not described."""
        if self.sensors is None:
            return tuple(f"sensor {i + 1}" for i in range(self.n_sensors))
        return tuple(sensor.name for sensor in self.sensors)

    def predict(self, structure: Structure) -> ComplexArray:
        """Relative accelerations of a structure under this test's base motion, (runs, n_sensors, n_freq)."""
        if structure.rigid_body.shape != self.rigid_body.shape:
            raise InputError(
                f"the structure has {structure.rigid_body.shape[0]} sensors and {structure.n_base} base directions, "
                f"the measurement {self.n_sensors} and {self.n_base}"
            )
        return np.einsum("sdf,rdf->rsf", structure.relative_acceleration(self.freq), self.base)

    def predict_force(self, structure: Structure) -> ComplexArray:
        """Base force of a structure under this test's base motion, (runs, d, n_freq)."""
        return np.einsum("edf,rdf->ref", structure.base_force(self.freq), self.base)

    def residual(self, structure: Structure) -> float:
        """``‖predicted - measured‖ / ‖measured‖`` over relative accelerations of all runs, sensors and lines."""
        measured = self.relative
        return float(np.linalg.norm(self.predict(structure) - measured) / np.linalg.norm(measured))

    def force_residual(self, structure: Structure) -> float | None:
        """The same over the base force; None where none was measured."""
        if self.force is None:
            return None
        return float(np.linalg.norm(self.predict_force(structure) - self.force) / np.linalg.norm(self.force))

    def in_band(self, low: float, high: float) -> Measurement:
        """The lines from `low` to `high` Hz, both included."""
        low, high = as_float("the lower end of the band", low), as_float("the upper end of the band", high)
        keep, ends = (self.freq >= low) & (self.freq <= high), f"{self.freq[0]:g} to {self.freq[-1]:g} Hz"
        if not np.any(keep):
            raise InputError(f"no line between {low:g} and {high:g} Hz; the record has {ends}")
        return self.at(keep)

    def at(self, keep: NDArray[np.bool_]) -> Measurement:
        """The lines where `keep`, (n_freq,), is true."""
        lines: Any = {name: getattr(self, name)[..., keep] for name in _RECORDS if getattr(self, name) is not None}
        return replace(self, **lines)

    def of_runs(self, keep: NDArray[np.bool_]) -> Measurement:
        """The runs where `keep`, (runs,), is true, at their own lines."""
        runs: Any = {name: getattr(self, name)[keep] for name in _RECORDS[1:] if getattr(self, name) is not None}
        some = replace(self, whole=self.whole and self.whole.of_runs(keep), **runs)
        return some.at(np.any(some.own_lines, axis=0))

    def less(self, taken: ComplexArray, **changes: Any) -> Measurement:
        """The test with this taken off its `outputs`, and other changes of its fields."""
        response, *force = np.split(self.outputs - taken, [self.n_sensors], axis=1)
        return replace(self, response=response, force=None if self.force is None else force[0], **changes)

    def of_sensors(self, keep: NDArray[np.bool_]) -> Measurement:
        """The sensors where `keep`, (n_sensors,), is true."""
        std, sensors, whole = self.response_std, self.sensors, self.whole
        return replace(
            self, response=self.response[:, keep], rigid_body=self.rigid_body[keep],
            response_std=None if std is None else std[:, keep], whole=whole and whole.of_sensors(keep),
            gain_std=None if self.gain_std is None else self.gain_std[keep],
            sensors=sensors and tuple(sensors[i] for i in np.flatnonzero(keep)),
        )  # fmt: skip

    @classmethod
    def from_frf(
        cls,
        freq: ArrayLike,
        frf: ArrayLike,
        *,
        rigid_body: ArrayLike | None = None,
        force: ArrayLike | None = None,
        sensors: Sequence[Sensor] | None = None,
        response_std: ArrayLike | None = None,
        force_std: ArrayLike | None = None,
        base_axes: str | Sequence[str] | None = None,
        missing: Missing = "refuse",
        window: Literal["", "hann"] = "",
        averages: int | None = None,
        coherence: ArrayLike | None = None,
        force_coherence: ArrayLike | None = None,
    ) -> Measurement:
        """From frequency response functions: d unit runs, one a base direction.

        Parameters
        ----------
        freq : array_like, shape (n_freq,)
            Hz.
        frf : array_like, complex, shape (n_sensors, d, n_freq)
            Transmissibility: absolute acceleration per unit base acceleration. With one base
            direction (n_sensors, n_freq) will do.
        force : array_like, complex, shape (d, d, n_freq), optional
            Apparent mass, kg: [force direction, base direction] per unit base acceleration.
        response_std, force_std : array_like, optional
            Standard deviations of `frf` and `force`, broadcast to them.
        window, averages : str, int, optional
            Of functions H1 that an analyser averaged: its window, and how many independent blocks.
        coherence, force_coherence : array_like, optional
            Coherences of `frf` and `force`, broadcast to them, which tell their deviations by `averages`:
            ``|H|² (1 - coherence) / (coherence averages)`` (Bendat and Piersol, *Random Data*, ch. 9).
        rigid_body, sensors, base_axes, missing
            As in `Measurement`.
        """
        lines = check_frequencies(freq)
        choice("missing", missing, ("refuse", "drop"))
        choice("window", window, ("", "hann"))
        stated = coherence is not None or force_coherence is not None
        refuse((stated and averages is None, "coherences tell noise where averages= is given, such as 40"))
        averages = 0 if averages is None else whole_number("averages", averages, at_least=2)
        read = numbers if missing == "drop" else complete  # lines with NaN go where the records have all runs
        H = read("frf", frf, complex)
        H = checked_lines("frf", H[:, None] if H.ndim == 2 else H, lines.size, read)
        d = H.shape[1]
        F = None if force is None else checked_lines("force", force, lines.size, read)
        if F is not None and F.shape != (d, d, lines.size):
            raise InputError(f"force is {F.shape}; with {d} base directions it is {(d, d, lines.size)}: {FORCE_NEEDED}")
        for name, function, known in (("coherence", H, coherence), ("force_coherence", F, force_coherence)):
            if known is not None and function is not None:
                seen = spectra.coherence_of(name, known, function.shape)
                std = spectra.std_of_functions(function, seen, averages)
                response_std, force_std = (std, force_std) if function is H else (response_std, std)
        given = (
            H, F, checked_deviations("response_std", response_std, H, read),
            checked_deviations("force_std", force_std, F, read),
        )  # fmt: skip
        # The base direction comes first: it becomes the run.
        by_run: Any = [None if record is None else np.moveaxis(record, 1, 0) for record in given]
        options: Any = {"rigid_body": rigid_body, "sensors": sensors, "base_axes": base_axes, "missing": missing}
        return cls(
            lines, unit_runs(d, lines.size), by_run[0], force=by_run[1], response_std=by_run[2], force_std=by_run[3],
            averaged=averages or window != "", window=window, **options,
        )  # fmt: skip

    @classmethod
    def from_time(
        cls,
        runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None]],
        sample_rate: float,
        *,
        rigid_body: ArrayLike | None = None,
        estimator: Literal["records", "spectra", "h1", "h2"] = "records",
        at_rest: bool | Sequence[bool] = False,
        noise: NoiseLevels | None = None,
        segment: int | None = None,
        band: tuple[float, float] | None = None,
        sensors: Sequence[Sensor] | None = None,
        base_axes: str | Sequence[str] | None = None,
        base_delay: float = 0.0,
        force_delay: float = 0.0,
    ) -> Measurement:
        """From time records on one clock (`sysid.resample` brings unequal clocks together).

        Parameters
        ----------
        runs : sequence of (base, response, force or None)
            Records (d, n_samples), (n_sensors, n_samples) and (d, n_samples); responses absolute.
        sample_rate : float
            Hz.
        rigid_body, sensors, base_axes
            As in `Measurement`.
        estimator : {"records", "spectra", "h1", "h2"}
            "records" takes each run whole, of any length and cut anywhere, in motion too: its transients, two numbers a
            mode and run, and the noise of all channels, base and force included, are found with the modes. "spectra" is
            the Fourier transform of each whole record without them, right for motion that starts and ends at rest where
            the model misses more than noise. "h1" (noise on the responses) and "h2" (noise on the base) average over
            segments and runs by Welch's method and give d unit runs; "h1" solves for several base directions at once.
        at_rest : bool or sequence of bool
            Of "records": whether all runs, or each, begin and end at rest, and so have no transients.
        noise : NoiseLevels, optional
            Of "records": standard deviations of the noise of a sample of each channel; found where none are stated.
        segment : int, optional
            Samples a segment of "h1" and "h2"; a quarter of the shortest record by default. Its lines must be
            several times closer than the narrowest resonance is wide (rate / segment well below 2 zeta f), else
            leakage flattens the peak, and damping and masses come out wrong.
        band : (low, high), optional
            Hz, both ends included; by default all lines but zero, of "records" up to 0.4 of the sample rate, as motion
            that sampling folds back is largest above.
        base_delay, force_delay : float
            s, by which these records are late; sensors state theirs. Records are shifted by them, cut at their ends.

        Examples
        --------
        Two runs of 4 and 3 s at 100 Hz, the second at rest at both ends:

        >>> rng = np.random.default_rng(0)
        >>> runs = [(rng.standard_normal((1, n)), rng.standard_normal((2, n)), None) for n in (400, 300)]
        >>> Measurement.from_time(runs, 100.0, rigid_body=[[1.0], [1.0]], at_rest=[False, True], band=(1.0, 10.0))
        <Measurement: 2 sensors, base x, 2 runs, 55 lines from 1 to 10 Hz>
        """
        choice("estimator", estimator, ("records", "spectra", "h1", "h2"))
        check_options(estimator, at_rest=at_rest, noise=noise, segment=segment)
        G = motion_of_sensors(rigid_body, sensors, base_axes, spectra.directions(runs))
        records = spectra.check_runs(runs, sample_rate, G.shape)
        described = checked_sensors(sensors)
        others = as_float("base_delay", base_delay), as_float("force_delay", force_delay)
        delays = np.append(stated_delays(described, len(G)), others)
        names, cut = names_of_channels(described, G, base_axes), estimator == "records"
        sound = sound_runs(records, float(sample_rate), names, delays, cut=cut)
        records = spectra.runs_on_one_clock(sound.runs, delays, float(sample_rate))
        given: Any = {"rigid_body": G, "sensors": without_delay(described), "base_axes": base_axes}
        if estimator in ("records", "spectra"):
            freq, base, response, force = spectra.whole_record(records, sample_rate)
            if estimator == "records":
                given["whole"] = whole_of(records, float(sample_rate), sound.rests(at_rest), sound.levels(noise), G)
            else:
                given["sample_rate"] = float(sample_rate)
            test = cls(freq, base, response, force=force, damage=sound.damage, **given)
        else:
            estimate = spectra.averaged(records, sample_rate, kind=estimator, segment=segment)
            test = cls.from_frf(
                estimate.freq, estimate.frf, force=estimate.force, response_std=estimate.frf_std,
                force_std=estimate.force_std, **given,
            )  # fmt: skip
            test = replace(test, averaged=True, damage=sound.damage)
        if band is None and estimator == "records":
            band = test.freq[0], max(spectra.FOLDED * sample_rate, test.freq[0])
        test = test if band is None else test.in_band(*sequence("band", band, "(low, high) in Hz", 2))
        of_tones = test.freq, test.own_lines, test.base, test.outputs
        return replace(test, whole=test.whole and with_steady_tones(test.whole, *of_tones))

    noise_from_rest = staticmethod(levels_at_rest)


def stated_delays(sensors: Sequence[Sensor] | None, count: int) -> Array:
    """Delays that sensors state, s, (count,); zero where not so many are described."""
    found = np.array([sensor.delay for sensor in sensors or ()])
    return found if found.size == count else np.zeros(count)


def unit_runs(d: int, n_freq: int) -> ComplexArray:
    """Base spectra of d runs, each of unit acceleration in its own direction, (d, d, n_freq)."""
    return np.repeat(np.eye(d, dtype=complex)[:, :, None], n_freq, axis=2)
