"""Changes of what a job identifies: a band, all runs or sensors but one, some modes, or noise drawn anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, as_float, refuse, whole_number
from sysid.measurement.channels import without_delays
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.misfit import inflation_of, misfits_of, noise_records, without_transients_of
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.residues import independent
from sysid.models.stiffness_and_damping import SpectralStiffness
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.problem.stated import StatedProblem
from sysid.problem.terms import FurtherTest, Prior
from sysid.results.identification import Identification
from sysid.structure.structure import Array, ComplexArray, Structure


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
        at_rest = result.structure.with_laws(())  # what laws add is taken off these records
        return without_transients_of(test.at(outside), at_rest).residual(at_rest)


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
        at_rest = result.structure.with_laws(())
        return without_transients_of(left_out, at_rest).residual(at_rest)


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
        # Residual modes of the whole test would be fitted to the sensor that is to be predicted.
        if problem.free_modes or problem.formulation.residual_modes or result.x is None:
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
        held = not problem.declared.free_modes
        refuse((held, "the number of modes is open only where mass and stiffness are free"))
        return replace(problem, goal=None, reference=None)

    def predicted(self, problem: Prepared, result: Identification) -> None:
        """Nothing is left out: the validation tests are what is predicted."""


Change = Band | WithoutRun | WithoutSensor | NumberOfModes


def _on(problem: Problem, test: Measurement, **others: Any) -> Problem:
    """The problem on another part of its test; a goal and the truth belonged to the whole one."""
    misfit = not problem.declared.fits_records
    refuse((misfit, "the problem states a misfit of its own: what part of the records it reads is not known"))
    return replace(problem, measurement=test, validation=(), reference=None, goal=None, **others)


def _all_but(index: int, count: int, what: str) -> NDArray[np.bool_]:
    """Which of so many runs or sensors are left without one, (count,)."""
    refuse(
        (index >= count, f"there is no {what} {index + 1} ({what}={index}, counted from 0): the test has {count}"),
        (count == 1, f"the test has one {what}; without it nothing is left"),
    )
    return np.arange(count) != index


def _for_fewer(stiffness: SpectralStiffness, sensors: int) -> SpectralStiffness:
    """The stiffness without its stated frequencies, where these are too many for so few sensors."""
    given = stiffness.natural_frequencies
    if given is None or np.size(given) <= sensors:
        return stiffness
    return SpectralStiffness(max_frequency=stiffness.max_frequency)


def drawn(problem: Prepared, x: Array, random: np.random.SeedSequence) -> StatedProblem:
    """The problem with records simulated from the structure of `x` in the place of the measured ones.

    Their noise has the stated standard deviations, raised as the linear uncertainty is where the misfit is larger, else
    the size of the misfit that `x` leaves; values known to some accuracy are drawn too (parametric bootstrap: B. Efron
    and R. Tibshirani, An Introduction to the Bootstrap, 1993). With pseudo-values for records, as under Huber's loss,
    it is the noise under which squares scatter as that loss does: larger than that of the records by 1 / sqrt(0.95)
    without outliers, and by more with them, and so are the residuals of the draws.
    """
    check_drawable(problem.stated)
    formulation, rng = problem.formulation, np.random.default_rng(random)
    tests, modal = iter(formulation.further_tests), iter(problem.modal[1:])
    priors = iter(formulation.priors)
    residuals = []
    for given in problem.stated.residuals:
        if isinstance(given, FurtherTest):
            term = next(tests)
            structure = term.matrices.structure(x, term.test)
            drawn = _as_recorded(_again(term.test, structure, problem.n_variables, rng), next(modal), rng)
            again = replace(given, measurement=drawn)
        else:
            _, value, std = given.column("Prior")
            at = value + std * next(priors).numbers(x)
            again = replace(given, value=at + std * rng.standard_normal(at.size))
        residuals.append(again)
    test = _test_again(problem.modal[0], problem.structure(x), problem.n_variables, rng)
    return replace(problem.stated, measurement=test, residuals=residuals, loss="squares", validation=(), reference=None)


def drawn_from(answer: Identification, random: np.random.SeedSequence) -> Problem:
    """The problem of an answer that tells no unknowns, such as one in the band, with records drawn likewise."""
    s, modal = answer.structure, answer.modal[0]
    check_drawable(answer.problem)
    refuse((answer.problem.loss != "squares", "draws of an answer in the band need loss='squares'"))
    # A shape and a participation each mode, a frequency and a ratio.
    unknowns = s.n * (s.n_sensors + s.n_base + 2)
    test = _test_again(modal, s, unknowns, np.random.default_rng(random))
    return replace(answer.problem, measurement=test, goal=None, validation=(), reference=None)


def check_drawable(problem: StatedProblem) -> None:
    """Refuse a problem with something fitted whose noise nobody knows: a misfit or residuals of the user's own."""
    without_noise = [given for given in problem.residuals if not isinstance(given, FurtherTest | Prior)]
    if without_noise or problem.misfit is not None:
        raise InputError(
            "draws of noise need records, and values known to some accuracy (Prior): what noise the misfit or the "
            "residuals have that this problem states for itself is not known"
        )


def _test_again(modal: ModalEstimate, structure: Structure, unknowns: int, rng: np.random.Generator) -> Measurement:
    if modal.noise is None:
        again = _again(modal.records, structure, unknowns, rng)
    else:
        again = _whole_again(modal, structure, rng)
    return _as_recorded(again, modal, rng)


def _as_recorded(test: Measurement, modal: ModalEstimate, rng: np.random.Generator) -> Measurement:
    """The test with errors of gains within tolerances, and its delays: each draw finds them anew."""
    test = test if modal.calibration is None else modal.calibration.recorded(test, rng)
    return test if modal.delays is None else without_delays(test, -modal.delays.values)


def _again(test: Measurement, structure: Structure, unknowns: int, rng: np.random.Generator) -> Measurement:
    """The test with the records that the structure makes, and noise of the same size."""
    inflation = inflation_of(test, noise_records(test, structure, unknowns), unknowns)
    more = inflation if np.isfinite(inflation) else 1.0
    taken = [misfit - _noise(more * std, rng) for misfit, std in misfits_of(test, structure, unknowns)]
    return test.less(np.concatenate(taken, axis=1))


def _whole_again(modal: ModalEstimate, structure: Structure, rng: np.random.Generator) -> Measurement:
    """Whole records that the structure makes with the same transients, and noise of the same levels in all channels."""
    test, at_rest, (n, d) = modal.given, modal.records, structure.rigid_body.shape
    of_sensors, of_force, of_base = np.split(modal.channel_deviations, [n, -d], axis=1)

    def drawn(record: ComplexArray, std: Array) -> ComplexArray:
        return np.where(test.own_lines[:, None], _noise(np.broadcast_to(std, record.shape), rng), 0.0)

    response = test.response - (at_rest.relative - at_rest.predict(structure)) + drawn(test.response, of_sensors)
    force = None
    if test.force is not None and at_rest.force is not None:
        force = test.force - (at_rest.force - at_rest.predict_force(structure)) + drawn(test.force, of_force)
    return replace(test, base=test.base + drawn(test.base, of_base), response=response, force=force)


def _noise(std: Array, rng: np.random.Generator) -> ComplexArray:
    """Circular complex noise, ``E|e|² = std²``."""
    real, imaginary = rng.standard_normal((2, *std.shape))
    noise: ComplexArray = std * (real + 1j * imaginary) / np.sqrt(2)
    return noise
