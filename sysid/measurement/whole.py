"""Whole records: what their spectra hold beside the response to the base, and the noise of every channel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, finite_array, instance, refuse
from sysid.structure.structure import Array, ComplexArray


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

        Those given as a row a run stay so, (runs, channels); others are (channels,).

        Raises
        ------
        InputError
            Where there are levels of another number of channels, or none of a force that was measured.
        """
        refuse(
            (
                force and self.force is None,
                "noise states no level of the force, which was measured: NoiseLevels(force=...)",
            )
        )
        given = {"response": n_sensors, "base": d} | ({"force": d} if force else {})
        levels = {}
        for name, count in given.items():
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

    def to_tree(self) -> dict[str, Any]:
        """Give the levels as a dictionary of arrays; ``NoiseLevels(**tree)`` takes it back."""
        return {"response": self.response, "base": self.base, "force": self.force}


@dataclass(frozen=True, eq=False)
class WholeRecords:
    """Properties of whole records beside their spectra; one entry a run.

    A record of N samples neither starts nor ends at rest: its finite Fourier transform is the response to the base,
    and two real numbers a mode, by which the motion at its end differs from that at its start.

    Attributes
    ----------
    samples : tuple of int
        N of each run; lines are multiples of ``sample_rate / N``.
    sample_rate : float
        Hz.
    at_rest : tuple of bool
        Runs that are stated to begin and end at rest, and have no such numbers.
    noise : NoiseLevels or None
        Stated; None where they are estimated with the fit.
    varying : (runs, channels) of bool, or None
        Sensors, forces and base directions whose level is found to vary over the lines; set by the fit, in no file.
    """

    samples: tuple[int, ...]
    sample_rate: float
    at_rest: tuple[bool, ...]
    noise: NoiseLevels | None = field(default=None)
    varying: NDArray[np.bool_] | None = field(default=None)

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
        noise = self.noise
        return replace(self, noise=None if noise is None else replace(noise, response=noise.response[..., kept]))

    def transients(self, freq: Array) -> ComplexArray:
        """Motion at the ends of a run as further inputs at lines in Hz: a change of velocity, of displacement; (2, n).

        ``g_k (a / w² + i b / w)`` is what ``(a + i w b) / (w_k² - w² + 2 i zeta_k w_k w)`` is.
        """
        w = 2 * np.pi * freq
        return np.stack([1 / w**2, 1j / w])

    def to_tree(self) -> dict[str, Any]:
        """Give it as dictionaries and arrays; `from_tree` takes it back."""
        return {
            "samples": np.array(self.samples),
            "sample_rate": self.sample_rate,
            "at_rest": np.array(self.at_rest),
            "noise": None if self.noise is None else self.noise.to_tree(),
        }

    @classmethod
    def from_tree(cls, tree: dict[str, Any] | None) -> WholeRecords | None:
        """Give what a tree of `to_tree` stands for; None for None."""
        if tree is None:
            return None
        noise = None if tree["noise"] is None else NoiseLevels(**tree["noise"])
        samples, rest = tuple(map(int, tree["samples"])), tuple(map(bool, tree["at_rest"]))
        return cls(samples, float(tree["sample_rate"]), rest, noise)


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


def per_run(name: str, value: Any, runs: int) -> tuple[bool, ...]:
    """One bool, or one a run, as one a run."""
    array = np.asarray([value] * runs if isinstance(value, bool | np.bool_) else value)
    if array.shape != (runs,) or array.dtype != bool:
        raise InputError(f"{name} = {value!r}: give True or False, or one of them for each of the {runs} runs")
    return tuple(bool(one) for one in array)
