"""Changes of what a job identifies: a band, all runs or sensors but one, some modes, in the place of all of a test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, as_float, whole_number
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.misfit import without_transients_of
from sysid.modal_analysis.residues import independent
from sysid.models.stiffness import SpectralStiffness
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.results.identification import Identification


@dataclass(frozen=True)
class Band:
    """The lines from `low` to `high` Hz, both included; further tests (`FurtherTest`) keep theirs.

    Parameters
    ----------
    low, high : float
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        as_float("Band: low", self.low, "a frequency in Hz", at_least=0)
        as_float("Band: high", self.high, f"a frequency in Hz above {self.low:g}", above=self.low)

    @property
    def title(self) -> str:
        """Name of its row in tables."""
        return f"{self.low:g} to {self.high:g} Hz"

    def of(self, problem: Problem) -> Problem:
        """The problem with these lines alone."""
        return _on(problem, problem.measurement.in_band(self.low, self.high))

    def predicted(self, problem: Prepared, result: Identification) -> float:
        """Relative residual of the lines outside; NaN where there are none, or mass and stiffness are free.

        Free matrices are those of the modes inside.
        """
        test = problem.measurement
        outside = (test.freq < self.low) | (test.freq > self.high)
        if problem.free_modes or not np.any(outside):
            return np.nan
        return without_transients_of(test.at(outside), result.structure).residual(result.structure)


@dataclass(frozen=True)
class WithoutRun:
    """All runs but one; further tests (`FurtherTest`) stay.

    Parameters
    ----------
    run : int
        Counted from 0.
    """

    run: int

    def __post_init__(self) -> None:
        whole_number("WithoutRun: run", self.run, at_least=0)

    @property
    def title(self) -> str:
        """Name of its row in tables; runs are counted from 1 there."""
        return f"without run {self.run + 1}"

    def of(self, problem: Problem) -> Problem:
        """The problem with the other runs; refused where they do not excite all that free matrices' modes need."""
        test = problem.measurement
        kept = _all_but(self.run, test.n_runs, "run")
        if problem.declared.free_modes and independent(test.base[kept]).shape[1] < independent(test.base).shape[1]:
            raise InputError(
                f"without run {self.run + 1} the base does not move in every direction: modes that this run alone "
                "excites cannot be found from the others"
            )
        return _on(problem, test.of_runs(kept))

    def predicted(self, problem: Prepared, result: Identification) -> float:
        """Relative residual of the run that was left out."""
        test = problem.measurement
        left_out = test.of_runs(~_all_but(self.run, test.n_runs, "run"))
        return without_transients_of(left_out, result.structure).residual(result.structure)


@dataclass(frozen=True)
class WithoutSensor:
    """All sensors but one.

    Where mass or stiffness have a form of their own, the degrees of freedom stay, and the sensor left out is one that
    was not measured; full matrices are those of the other sensors. Further tests (`FurtherTest`) keep theirs.

    Parameters
    ----------
    sensor : int
        Counted from 0.
    name : str
        For tables.
    """

    sensor: int
    name: str = ""

    def __post_init__(self) -> None:
        whole_number("WithoutSensor: sensor", self.sensor, at_least=0)

    @property
    def title(self) -> str:
        """Name of its row in tables; sensors without a name are counted from 1 there."""
        return f"without {self.name or f'sensor {self.sensor + 1}'}"

    def of(self, problem: Problem) -> Problem:
        """The problem with the other sensors."""
        test = problem.measurement
        kept = _all_but(self.sensor, test.n_sensors, "sensor")
        other = test.of_sensors(kept)
        if problem.declared.free_modes:
            return _on(problem, other, stiffness=_for_fewer(problem.stiffness, test.n_sensors - 1))
        direct = problem.recovery is None
        G = test.rigid_body if direct else problem.rigid_body_dofs
        recovery = np.eye(test.n_sensors) if direct else np.asarray(problem.recovery)
        return _on(problem, other, recovery=recovery[kept], rigid_body_dofs=G)

    def predicted(self, problem: Prepared, result: Identification) -> float:
        """Relative residual of the sensor that was left out; NaN where the structure does not tell its motion."""
        if problem.free_modes or result.x is None:
            return np.nan
        test = without_transients_of(problem.measurement, problem.structure(result.x))
        left, measured = test.relative - test.predict(problem.structure(result.x)), test.relative
        return float(np.linalg.norm(left[:, self.sensor]) / np.linalg.norm(measured[:, self.sensor]))


@dataclass(frozen=True)
class NumberOfModes:
    """So many modes, where mass and stiffness are free: see `sysid.Modal`.

    Parameters
    ----------
    count : int
    """

    count: int

    def __post_init__(self) -> None:
        whole_number("NumberOfModes: count", self.count, at_least=1)

    @property
    def title(self) -> str:
        """Name of its row in tables."""
        return f"{self.count} mode{'s' * (self.count > 1)}"

    def of(self, problem: Problem) -> Problem:
        """The problem itself, without the goal and the truth, which belong to all modes."""
        if not problem.declared.free_modes:
            raise InputError("the number of modes is open only where mass and stiffness are free")
        return replace(problem, goal=None, reference=None)

    def predicted(self, problem: Prepared, result: Identification) -> None:
        """Nothing is left out: the validation tests are what is predicted."""


Change = Band | WithoutRun | WithoutSensor | NumberOfModes


def _on(problem: Problem, test: Measurement, **others: Any) -> Problem:
    """The problem on another part of its test; a goal and the truth belonged to the whole one."""
    if not problem.declared.fits_records:
        raise InputError("the problem states a misfit of its own: what part of the records it reads is not known")
    return replace(problem, measurement=test, validation=(), reference=None, goal=None, **others)


def _all_but(index: int, count: int, what: str) -> NDArray[np.bool_]:
    """Which of so many runs or sensors are left without one, (count,)."""
    if index >= count:
        raise InputError(f"there is no {what} {index + 1} ({what}={index}, counted from 0): the test has {count}")
    if count == 1:
        raise InputError(f"the test has one {what}; without it nothing is left")
    return np.arange(count) != index


def _for_fewer(stiffness: SpectralStiffness, sensors: int) -> SpectralStiffness:
    """The stiffness without its stated frequencies, where these are too many for so few sensors."""
    given = stiffness.natural_frequencies
    if given is None or np.size(given) <= sensors:
        return stiffness
    return SpectralStiffness(max_frequency=stiffness.max_frequency)
