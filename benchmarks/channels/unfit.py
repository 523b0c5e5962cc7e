"""Whole records that no model of modes fits: none does worse than a rigid body, or than spectra of as many modes.

Frames whose storeys yield (Bouc and Wen), integrated by SciPy; chains on two supports of which one is recorded; bridges
that vehicles cross. The last two are sums of modes at eight times the rate, each by a recursion that is exact for loads
that are linear between their samples. All is low-passed and decimated, and noise is added.

``python -m benchmarks.channels.unfit NUMBER SECONDS`` runs one and prints its figures as JSON.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import numpy as np
import scipy

import sysid
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.structures import log_uniform
from benchmarks.channels.damaged import recursion
from benchmarks.line import Line, above, below
from sysid.modal_analysis.modal_estimate import ModalEstimate

FASTER = 8
TESTS = 40
SHORT = (5, 15, 19)  # one of each kind, that take a second or two
SECONDS = 60.0  # of processor time, an identification of whole records
PATIENCE = 180  # s of processor time, with the simulation and spectra
RIGID = 1.0  # residual of a rigid body, which moves with the base
ABOVE = 1.01  # times the residual of spectra: where their fit ends
BLOCK, QUIETEST = 16, 0.1  # lines next to each other; share of such blocks
CHANCE = 1.1  # times what the quietest lines hold
FIRST = (0.8, 5.0)  # Hz, first frequency
RATIO = (0.005, 0.03)
NOISE = (0.003, 0.03)  # of each channel's rms
PERIODS = (60, 250)  # of the first mode
UNFIT = ("doubtful", "no fit")


class Recorded(NamedTuple):
    """Base (1, n), absolute accelerations (sensors, n), perhaps base force (1, n), at the faster rate; band, Hz."""

    base: np.ndarray
    response: np.ndarray
    force: np.ndarray | None
    band: tuple[float, float]


class Clock(NamedTuple):
    """Times at the faster rate, s, (n,), and that rate, Hz."""

    time: np.ndarray
    rate: float

    @classmethod
    def of(cls, rng: np.random.Generator, first: float, last: float) -> Clock:
        """That of a test of modes from the first to the last frequency, Hz."""
        rate = FASTER * last * float(rng.uniform(4.0, 8.0))
        return cls(np.arange(round(log_uniform(rng, PERIODS) / first * rate)) / rate, rate)

    def random(self, rng: np.random.Generator, band: tuple[float, float]) -> np.ndarray:
        """Random motion in a band of 1 m/s² rms, (n,)."""
        filtered = scipy.signal.butter(3, band, "bandpass", fs=self.rate, output="sos")
        motion = scipy.signal.sosfilt(filtered, rng.standard_normal(self.time.size))
        return np.asarray(motion / motion.std())

    def shaking(self, rng: np.random.Generator, band: tuple[float, float], rest: bool) -> np.ndarray:
        """Random motion, or an earthquake that begins at rest and dies away."""
        motion = self.random(rng, band)
        if rest:
            share = self.time / self.time[-1]
            motion = motion * np.minimum(share / 0.1, 1.0) ** 2 * np.exp(-12 * np.maximum(share - 0.25, 0))
        return np.asarray(motion)


def lines(reduced: bool) -> Iterator[Line]:
    """40 tests, or three quick ones."""
    numbers = SHORT if reduced else range(TESTS)
    every = figures_of_each("channels.unfit", numbers, PATIENCE)
    failed = [f"{number}: {one['said']}" for number, one in zip(numbers, every, strict=True) if "said" in one]
    yield below(f"{len(every)} tests: neither an answer nor a refusal{_examples(failed)}", len(failed), 0)
    refused = [f"{one['name']}: {one['refused'][:80]}" for one in every if "refused" in one]
    yield Line(f"{len(every)} tests: refused{_examples(refused)}", f"{len(refused)}")
    found = [one for one in every if "residual" in one]
    worse = [max(one["residual"], one["left"]) for one in found]
    wrong = [f"{one['name']}: {most:.3g}" for one, most in zip(found, worse, strict=True) if not most <= RIGID]
    yield below(f"{len(found)} tests: residual above a rigid body's{_examples(wrong)}", len(wrong), 0)
    beside = [one for one in found if np.isfinite(one["spectra"])]
    wrong = [
        f"{one['name']}: {one['left']:.3g} beside {one['spectra']:.3g}" for one in beside
        if not one["left"] <= ABOVE * one["spectra"]
    ]  # fmt: skip
    yield below(f"{len(beside)} tests: residual above that of spectra{_examples(wrong)}", len(wrong), 0)
    for what in ("base", "sensors"):
        wrong = [f"{one['name']}: {one[what]:.3g}" for one in found if not one[what] <= CHANCE]
        text = f"{len(found)} tests: noise of {what} above what the quietest tenth of lines holds{_examples(wrong)}"
        yield below(text, len(wrong), 0)
    wrong = [f"{one['name']}: {one['judgement']}" for one in found if one["judgement"] not in UNFIT]
    yield above(f"{len(found)} tests: told to be doubtful, or no fit{_examples(wrong)}", 1 - len(wrong) / len(found), 1)
    yield below("slowest identification, s of processor time", max(one["seconds"] for one in found), SECONDS)


class Case(NamedTuple):
    """Records of one test with their noise, at the rate, Hz, and how they are fitted."""

    name: str
    run: tuple[np.ndarray, np.ndarray, np.ndarray | None]
    rate: float
    band: tuple[float, float]
    rest: bool
    lumped: bool

    @classmethod
    def of(cls, number: int) -> Case:
        """That of a number, always the same."""
        rng = np.random.default_rng((number, 284))
        kind = [*KINDS][number % len(KINDS)]
        rest, lumped = bool(rng.random() < 0.5), kind != "moving load" and bool(rng.random() < 0.5)
        recorded, rate = KINDS[kind](rng, rest)
        share = float(log_uniform(rng, NOISE))
        base, response = (_noisy(one, share, rng) for one in (recorded.base, recorded.response))
        force = None if recorded.force is None else _noisy(recorded.force, share, rng)
        how = f"{'lumped' if lumped else 'free'}{', at rest' * rest}{', force' * (force is not None)}"
        return cls(
            f"{number} ({kind}, {how})", (base, response, force), rate / FASTER, recorded.band, rest, lumped
        )  # fmt: skip

    def test(self, estimator: Literal["records", "spectra"] = "records") -> sysid.Measurement:
        """The test as whole records or as plain spectra."""
        ends = {"at_rest": self.rest} if estimator == "records" else {}
        return sysid.Measurement.from_time(
            [self.run], self.rate, rigid_body=np.ones((len(self.run[1]), 1)), band=self.band, estimator=estimator,
            **ends,
        )  # fmt: skip

    def identified(
        self, estimator: Literal["records", "spectra"] = "records", strategy: str | sysid.Modal = "auto"
    ) -> sysid.Identification:
        """The answer."""
        mass = {"mass": sysid.LumpedMass()} if self.lumped else {}
        return sysid.identify(sysid.Problem(self.test(estimator), **mass), strategy=strategy, rng=0)


def figures(number: int) -> dict:
    """Residuals of one test, and its noise over what the quietest lines hold."""
    case = Case.of(number)
    begun = time.process_time()
    try:
        result = case.identified()
    except sysid.InputError as error:
        return {"name": case.name, "refused": str(error)}
    seconds, test, modal = time.process_time() - begun, case.test(), result.modal[0]
    count = int(result.structure.natural_frequencies.size)
    spectra = np.inf  # where they show no modes, or too many for lumped masses
    for strategy in ["auto"] if case.lumped else [sysid.Modal(modes=count), sysid.Modal()]:
        try:
            spectra = case.identified("spectra", strategy).residual
        except (sysid.InputError, sysid.SolverError):  # where spectra show fewer modes
            continue
        break
    return {
        "name": case.name, "residual": result.residual,
        "left": _left(test, modal, result.structure), "spectra": spectra, "modes": count, "seconds": seconds,
        **_noise(modal, test), "judgement": result.judgement, "kinds": [one.kind for one in result.findings],
    }  # fmt: skip


def _left(test: sysid.Measurement, modal: ModalEstimate, structure: sysid.Structure) -> float:
    """What a structure leaves of the records beside transients, over the records as they are: as spectra have it."""
    left = modal.records.relative - test.predict(structure)
    return float(np.linalg.norm(left) / np.linalg.norm(test.relative))


def _noise(modal: ModalEstimate, test: sysid.Measurement) -> dict[str, float]:
    """Levels found of base and sensors over what the quietest lines of their records hold, the largest."""
    if modal.noise is None:
        return {"base": 0.0, "sensors": 0.0}
    density = modal.density[0]
    pairs = {"base": (modal.noise.base, test.base[0]), "sensors": (modal.noise.response, test.response[0])}
    return {what: float(np.max(level / _quietest(record, density))) for what, (level, record) in pairs.items()}


def _quietest(record: np.ndarray, density: float) -> np.ndarray:
    """Deviation of a sample of white noise whose quietest tenth of blocks holds as much, (channels,)."""
    blocks = record.shape[1] // BLOCK
    power = np.abs(record[:, : blocks * BLOCK]) ** 2 / density
    held = np.quantile(power.reshape(len(power), blocks, BLOCK).mean(axis=2), QUIETEST, axis=1)
    # The mean of so many squares is a gamma variable.
    return np.asarray(np.sqrt(held * BLOCK / scipy.special.gammaincinv(BLOCK, QUIETEST)))


def _yielding(rng: np.random.Generator, rest: bool) -> tuple[Recorded, float]:
    """A frame of two to five storeys whose springs yield: their forces are a k d + (1 - a) k z, z that of Bouc and Wen.

    ``z' = d' (1 - (1 + sign(d' z)) / 2 |z / y|^p)``, y the displacement at which they yield.
    """
    n = int(rng.integers(2, 6))
    masses, springs = rng.uniform(0.7, 1.3, n) * 400, rng.uniform(0.7, 1.3, n) * np.linspace(1, 0.6, n)
    chain = np.eye(n) - np.eye(n, k=-1)  # from displacements to drifts
    first, last = np.sqrt(scipy.linalg.eigh(chain.T * springs @ chain, np.diag(masses), eigvals_only=True))[[0, -1]]
    f1 = float(log_uniform(rng, FIRST))
    springs, last = springs * (2 * np.pi * f1 / first) ** 2, last / first * f1
    band = (0.4 * f1, 1.3 * last)
    clock = Clock.of(rng, f1, last)
    base = clock.shaking(rng, (0.5 * f1, 1.2 * last), rest)
    dampers = float(log_uniform(rng, RATIO)) * springs / (np.pi * f1)
    hardening, sharp = rng.uniform(0.1, 0.7), rng.uniform(1.0, 4.0)
    w, zeta = 2 * np.pi * f1, 0.03
    drift = np.abs(recursion(w, zeta, -base, 1 / clock.rate)).max() / w**2 * chain.sum() / n
    y = rng.uniform(0.15, 0.6) * drift * rng.uniform(0.7, 1.3, n)
    moved = scipy.interpolate.CubicSpline(clock.time, base)

    def forces(v: np.ndarray, d: np.ndarray, z: np.ndarray) -> np.ndarray:
        shear = springs * (hardening * d + (1 - hardening) * z) + dampers * v
        return -(shear @ chain) / masses

    def rates(t: float, state: np.ndarray) -> np.ndarray:
        x, speed, z = state.reshape(3, n)
        d, v = chain @ x, chain @ speed
        loading = v * z > 0
        return np.concatenate([speed, forces(v, d, z) - moved(t), v * (1 - loading * np.abs(z / y) ** sharp)])

    ended = scipy.integrate.solve_ivp(
        rates, clock.time[[0, -1]], np.zeros(3 * n), "DOP853", t_eval=clock.time, rtol=1e-7, atol=1e-9 * drift,
        max_step=0.2 / last,
    )  # fmt: skip
    x, speed, z = ended.y.reshape(3, n, -1)
    response = np.array([forces(v, d, one) for v, d, one in zip((chain @ speed).T, (chain @ x).T, z.T, strict=True)]).T
    force = masses @ response if rng.random() < 0.5 else None
    return _decimated(base[None], response, force, band), clock.rate


def _two_supports(rng: np.random.Generator, rest: bool) -> tuple[Recorded, float]:
    """A chain of masses between two supports: the second moves later, otherwise, or not at all."""
    n = int(rng.integers(2, 6))
    masses, springs = rng.uniform(0.7, 1.3, n), rng.uniform(0.7, 1.3, n + 1)
    K = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    squares, shapes = scipy.linalg.eigh(K, np.diag(masses))
    f = np.sqrt(squares / squares[0]) * float(log_uniform(rng, FIRST))
    second = np.linalg.solve(K, springs[-1] * np.eye(n)[-1])  # the static motion that it makes
    clock, band = Clock.of(rng, f[0], f[-1]), (0.4 * f[0], 1.3 * f[-1])
    moved, other = (clock.shaking(rng, (0.5 * f[0], 1.2 * f[-1]), rest) for _ in range(2))
    late, own = round(rng.uniform(0, 0.5) / f[0] * clock.rate), rng.uniform(0.0, 1.0)
    beside = rng.choice([0.0, 1.0, 2.0]) * np.roll(moved, late) * (np.arange(moved.size) >= late) + own * other
    static = np.outer(1 - second, moved) + np.outer(second, beside)
    response = static + _modal(clock, f, shapes, -(shapes.T * masses) @ static, rng)
    return _decimated(moved[None], response, None, band), clock.rate


def _moving_load(rng: np.random.Generator, rest: bool) -> tuple[Recorded, float]:
    """A simply supported beam that vehicles cross while its supports move: their weights change as the road does."""
    modes, sensors = np.arange(1, 5)[:, None], np.sort(rng.uniform(0.1, 0.9, int(rng.integers(3, 6))))
    f = float(log_uniform(rng, FIRST)) * modes[:, 0] ** 2.0
    clock, band = Clock.of(rng, f[0], f[2]), (0.4 * f[0], 1.3 * f[2])
    base = clock.shaking(rng, (0.5 * f[0], 1.2 * f[2]), rest)
    participation = np.sqrt(2) * (1 - np.cos(np.pi * modes)) / (np.pi * modes)  # of a mass of one
    loads, length = -participation * base, clock.time[-1]
    for _ in range(int(rng.integers(1, 5))):
        lasting = rng.uniform(0.1, 0.4) * length
        share = (clock.time - rng.uniform(0.05, 0.5) * length) / lasting
        weight = log_uniform(rng, (0.03, 3.0)) * (rng.uniform(0, 3) + clock.random(rng, (0.3 * f[0], 1.5 * f[2])))
        inside = (share > 0) & (share < 1)
        loads = loads + np.sqrt(2) * np.sin(np.pi * modes * share) * inside * weight
    shapes = np.sqrt(2) * np.sin(np.pi * modes.T * sensors[:, None])
    response = base + _modal(clock, f, shapes, loads, rng)
    return _decimated(base[None], response, None, band), clock.rate


KINDS: dict[str, Callable[[np.random.Generator, bool], tuple[Recorded, float]]] = {
    "yielding": _yielding, "two supports": _two_supports, "moving load": _moving_load,
}  # fmt: skip


def _modal(clock: Clock, f: np.ndarray, shapes: np.ndarray, loads: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Accelerations by modes of these frequencies, Hz, (m,), shapes (sensors, m) and loads (m, n)."""
    ratios = log_uniform(rng, RATIO, f.size)
    q = [recursion(2 * np.pi * one, z, load, 1 / clock.rate) for one, z, load in zip(f, ratios, loads, strict=True)]
    return np.asarray(shapes @ np.array(q))


def _decimated(base: np.ndarray, response: np.ndarray, force: np.ndarray | None, band: tuple[float, float]) -> Recorded:
    every = np.vstack([base, response] if force is None else [base, response, force])
    slow = scipy.signal.decimate(every, FASTER, ftype="fir", axis=1)
    n = len(response)
    return Recorded(slow[:1], slow[1 : n + 1], None if force is None else slow[n + 1 :], band)


def _noisy(record: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    size = np.sqrt(np.mean(record**2, axis=1, keepdims=True))
    return np.asarray(record + share * size * rng.standard_normal(record.shape))


def _examples(texts: list[str], most: int = 3) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""


if __name__ == "__main__":
    answer(figures)
