"""Simulated tests of a building, right and with one mistake each, as spectra and as whole records.

What is the mistake, what names it, and where no statement of the model excludes it the other right model that fits the
same records: docs/mistakes.md has the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

import sysid
from benchmarks.records.simulated import Modes, Run, random_motion, with_noise

FORMS = ("full", "lumped", "chain", "written")
SPECTRA, RECORDS = "spectra", "records"
NOISE, GRAVITY = 0.01, 9.80665
MASSES, SPRINGS = np.array([560.0, 500.0, 460.0, 420.0]), np.array([1.45e6, 1.05e6, 8.0e5, 5.8e5])
RATIOS = np.array([0.012, 0.014, 0.017, 0.020])
HEIGHTS = np.array([3.0, 6.0, 9.5, 12.5])  # m
RATE, DURATION, BAND = 200.0, 60.0, (1.0, 20.0)
N = MASSES.size
NAMES = tuple(f"storey {i + 1}" for i in range(N))
DELAY = 0.005  # s, one sample of whole records
SHORT = 2.0  # s: segments that resolve no peak
ELONGATION = np.eye(N) - np.eye(N, k=-1)


@dataclass(frozen=True)
class Data:
    """Data of a laboratory: spectra for unit base motion, or records in time; force or none.

    Attributes
    ----------
    base, response, force : (d, d, n), (n_sensors, d, n), (d, d, n) of spectra; (d, n), (n_sensors, n), (d, n)
    axis : (n,), Hz, of spectra; the sample rate of records
    rigid_body : (n_sensors, d)
    axes : str
    estimator : str
    segment : int or None
    """

    base: np.ndarray
    response: np.ndarray
    force: np.ndarray | None
    axis: Any
    rigid_body: np.ndarray
    axes: str
    estimator: str = "records"
    segment: int | None = None

    @property
    def test(self) -> sysid.Measurement:
        """The test that is read from them."""
        sensors = [sysid.Sensor(name, (0.0, 0.0, float(z)), "x") for name, z in zip(NAMES, HEIGHTS, strict=True)]
        given: Any = {"rigid_body": self.rigid_body, "base_axes": self.axes, "sensors": sensors}
        if self.axes != "x":  # positions that are in mm disagree with nothing else
            del given["sensors"]
        if np.ndim(self.axis):
            return sysid.Measurement.from_frf(self.axis, self.response, force=self.force, **given)
        runs = [(self.base, self.response, self.force)]
        return sysid.Measurement.from_time(
            runs, self.axis, band=BAND, estimator=self.estimator, segment=self.segment, **given
        )


def truth(axes: str = "x") -> sysid.Structure:
    """Four storeys, all floors measured; with a base that rotates too where `axes` says so."""
    G = _rigid_body(axes)
    M, K = np.diag(MASSES), ELONGATION.T @ np.diag(SPRINGS) @ ELONGATION
    d = G.shape[1]
    mass = np.block([[M, np.zeros((N, d))], [np.zeros((d, N + d))]])
    stiffness = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    return sysid.Structure(mass, stiffness, RATIOS, n_base=d)


def _rigid_body(axes: str) -> np.ndarray:
    return np.ones((N, 1)) if axes == "x" else np.column_stack([np.ones(N), HEIGHTS])


def right(kind: str, *, force: bool, axes: str = "x", seed: int = 0) -> Data:
    """A test without any mistake, 1 % noise on all channels (of spectra on responses and force)."""
    structure, rng = truth(axes), np.random.default_rng(seed)
    if kind == SPECTRA:
        f = structure.natural_frequencies
        lines = np.geomspace(0.4 * f[0], 1.4 * f[-1], 400)
        test = sysid.simulate(structure, lines, noise=NOISE, force=True, rng=rng, base_axes=axes)
        by_input = lambda record: np.moveaxis(record, 0, 1)  # noqa: E731
        force_ = by_input(test.force) if force else None
        return Data(by_input(test.base), by_input(test.response), force_, test.freq, test.rigid_body, axes)
    motion = random_motion(rng, DURATION, RATE, (0.5, 50.0), correlation=np.eye(structure.n_base))
    ringing = Run.ringing(Modes.of(structure), motion, rng)
    noisy, _ = with_noise(ringing.records(), rng, NOISE, NOISE)
    return Data(noisy.base, noisy.response, noisy.force if force else None, RATE, structure.rigid_body, axes)


def problem(form: str, test: sysid.Measurement) -> sysid.Problem:
    """One of the forms of the model, with what is stated of it right."""
    total = float(MASSES.sum())
    if form == "full":
        return sysid.Problem(test, mass=sysid.FullMass())
    if form == "lumped":
        moment = float(MASSES @ HEIGHTS**2)
        return sysid.Problem(test, mass=sysid.LumpedMass(total if test.n_base == 1 else [total, moment]))
    if form == "chain":
        springs = sysid.ChainStiffness(1.5e5, 6e6)
        return sysid.Problem(test, mass=sysid.LumpedMass(total), stiffness=springs)
    m = sysid.Variable("mass", N, lower=250.0, upper=1000.0, unit="kg", log=True)
    k = sysid.Variable("spring", N, lower=1.5e5, upper=6e6, unit="N/m", log=True)
    zeta = sysid.Variable("damping ratio", N, lower=1e-3, upper=0.1, log=True)
    stiffness = ELONGATION.T @ ca.diag(k) @ ELONGATION
    return sysid.Problem(test, mass=ca.diag(m), stiffness=stiffness, damping=zeta)


def _scaled(data: Data, *, base: float = 1.0, sensors: Any = 1.0, force: float = 1.0) -> Data:
    """Numbers in other units; of spectra the base stays one, and what it moves takes the reciprocal."""
    by = np.broadcast_to(np.asarray(sensors, dtype=float), (len(data.response),))
    spectra = bool(np.ndim(data.axis))
    response = data.response * by.reshape(-1, *[1] * (data.response.ndim - 1)) / (base if spectra else 1.0)
    reaction = None if data.force is None else data.force * (force / base if spectra else force)
    return replace(data, base=data.base if spectra else base * data.base, response=response, force=reaction)


def _one(factor: float, sensor: int) -> np.ndarray:
    return np.where(np.arange(N) == sensor, factor, 1.0)


def _relative(data: Data) -> Data:
    moved = np.einsum("sd,d...->s...", data.rigid_body, data.base)
    return replace(data, response=data.response - moved)


def _swapped(data: Data) -> Data:
    return replace(data, response=data.response[[0, 2, 1, 3]])


def _late(data: Data) -> Data:
    if np.ndim(data.axis):
        return replace(data, response=data.response * np.exp(-2j * np.pi * data.axis * DELAY))
    late = round(DELAY * data.axis)
    force = None if data.force is None else data.force[:, late:]
    return replace(data, base=data.base[:, late:], response=data.response[:, :-late], force=force)


def _tapered(data: Data) -> Data:
    window = np.hanning(data.base.shape[1])
    force = None if data.force is None else window * data.force
    return replace(data, base=window * data.base, response=window * data.response, force=force)


def _in_millimetres(data: Data) -> Data:
    return replace(data, rigid_body=data.rigid_body * [1.0, 1000.0])


def _conjugated(data: Data) -> Data:
    return replace(data, response=data.response.conj(), force=None if data.force is None else data.force.conj())


@dataclass(frozen=True)
class Cause:
    """A mistake.

    Attributes
    ----------
    made : callable
        The data with it.
    named : str
        Regular expression that the first sentence matches.
    finding : str
        Kind of the first finding; empty where reading refuses the records, or nothing is wrong.
    untold : dict of str to callable
        By form: the right model that fits the same records, where there is one.
    kinds : tuple of str
        In which of spectra and records it can be made.
    force : bool or None
        Whether it needs a force; None for both.
    axes : str
        Base directions.
    """

    made: Callable[[Data], Data]
    named: str
    finding: str
    untold: dict[str, Callable[[sysid.Structure], sysid.Structure]] = field(default_factory=dict)
    kinds: tuple[str, ...] = (SPECTRA, RECORDS)
    force: bool | None = None
    axes: str = "x"


def times(mass: float, stiffness: float) -> Callable[[sysid.Structure], sysid.Structure]:
    """The structure with all masses and stiffnesses multiplied."""
    return lambda s: sysid.Structure(mass * s.mass, stiffness * s.stiffness, s.damping_ratios, n_base=s.n_base)


def exchanged(s: sysid.Structure) -> sysid.Structure:
    """The structure with its second and third sensor in each other's place."""
    order = [0, 2, 1, 3, *range(N, s.mass.shape[0])]
    at = np.ix_(order, order)
    return sysid.Structure(s.mass[at], s.stiffness[at], s.damping_ratios, n_base=s.n_base)


_OTHER = {"full": times(1.0, (2 * np.pi) ** 2), "lumped": times(1.0, (2 * np.pi) ** 2)}
CAUSES = {
    "lines in rad/s": Cause(
        lambda it: replace(it, axis=2 * np.pi * it.axis), r"rad/s.*2 pi|2 pi.*rad/s", "frequencies in rad/s", _OTHER,
        (SPECTRA,),
    ),
    "conjugated": Cause(_conjugated, r"conjugate", "conjugated spectra", kinds=(SPECTRA,)),
    "relative": Cause(_relative, r"relative to the base", "relative responses"),
    "one sign": Cause(lambda it: _scaled(it, sensors=_one(-1.0, 1)), r"sign of storey 2", "sign"),
    "swapped": Cause(
        _swapped, r"storey 2 and storey 3 .*(swapped|exchanged)", "swapped sensors",
        {"full": exchanged, "lumped": exchanged},
    ),
    "swapped, rows of G differ": Cause(_swapped, r"sensor 2 and sensor 3 .*swapped", "swapped sensors", axes="x ry"),
    "one sensor in g": Cause(lambda it: _scaled(it, sensors=_one(1 / GRAVITY, 2)), r"storey 3.*9\.81", "unit"),
    "sensors in g": Cause(lambda it: _scaled(it, sensors=1 / GRAVITY), r"sensors.*9\.81", "unit"),
    "base in g": Cause(lambda it: _scaled(it, base=1 / GRAVITY), r"base.*9\.81", "unit"),
    "all in g, no force": Cause(
        lambda it: _scaled(it, base=1 / GRAVITY, sensors=1 / GRAVITY), "nothing is wrong", "",
        {form: times(1.0, 1.0) for form in FORMS}, force=False,
    ),
    "all in g": Cause(
        lambda it: _scaled(it, base=1 / GRAVITY, sensors=1 / GRAVITY), r"9\.81", "force unit",
        {"full": times(GRAVITY, GRAVITY)}, force=True,
    ),
    "force sign": Cause(lambda it: _scaled(it, force=-1.0), r"sign of the base force", "force sign", force=True),
    "force in kN": Cause(
        lambda it: _scaled(it, force=1e-3), r"force.*1,000", "force unit", {"full": times(1e-3, 1e-3)}, force=True
    ),
    "one gain 1.3": Cause(lambda it: _scaled(it, sensors=_one(1.3, 2)), r"gain.*storey 3", "gain"),
    "positions in mm": Cause(_in_millimetres, r"positions.*1,000", "positions", axes="x ry"),
    "short segments": Cause(
        lambda it: replace(it, estimator="h1", segment=round(SHORT * it.axis)), r"segments", "short segments",
        kinds=(RECORDS,),
    ),
    "clock skew": Cause(_late, r"late|delay", "late sensor"),
    "tapered": Cause(_tapered, r"window|taper|fade", "", kinds=(RECORDS,)),
}  # fmt: skip
