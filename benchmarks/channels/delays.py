"""Late channels: whether their delays are found first, how exactly, and that none is found of channels on one clock.

Whole records are sums over modes in closed form, cut in motion: those of a late channel are the same sums at earlier
times, so that no delay is rounded to a sample. Spectra are such sums too, turned by ``exp(-i w tau)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import sysid
from benchmarks.band.simulated_tests import transfer
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread
from benchmarks.records.simulated import Modes, Records, Run, Setting, coupled_structure, four_storeys

DRAWS, CLEAN = 120, 100
SHORT, SHORT_CLEAN = 6, 3
SAMPLES = (0.05, 30.0)  # of a delay; of spectra two and a half of them are a period of the last line
BEYOND = 5.0  # deviations, from which a delay is to be found
WITHIN, DEVIATIONS = 0.03, 3.0  # of a delay, or of its deviations
SHARE = 0.97
MATRICES = 5.0  # deviations, by which M, K and C are off at most
NOISE = 0.01
CASES = ("one sensor", "all", "the force")
KINDS = ("chain, records", "chain, spectra", "full, records", "full, spectra", "lumped, records", "lumped, spectra")


@dataclass(frozen=True)
class Found:
    """What was found of one draw.

    Attributes
    ----------
    name : str
    late : bool
        Whether a channel was.
    first : bool
        Whether the first finding is a delay, and of the right channel alone.
    error, deviations, size : float
        Of the delay: relative error, error and truth over the stated deviation.
    matrices : float
        Largest error of an entry of M, K and C over its stated deviation.
    said : str
        What was found in the place of it.
    """

    name: str
    late: bool
    first: bool
    error: float
    deviations: float
    size: float
    matrices: float
    said: str


def lines(reduced: bool) -> Iterator[Line]:
    """120 draws with a delay and 100 without; or 6 and 3."""
    count, clean = (SHORT, SHORT_CLEAN) if reduced else (DRAWS, CLEAN)
    every = spread(one_draw, [(number, True) for number in range(count)] + [(number, False) for number in range(clean)])
    late, right = [one for one in every if one.late], [one for one in every if not one.late]
    seen = [one for one in late if not one.size < BEYOND]
    text = f"{len(late)} late channels, {len(seen)} of them by more than {BEYOND:g} deviations: "
    missed = [f"{one.name}: {one.said}" for one in seen if not one.first]
    yield above(text + f"first finding{_examples(missed)}", float(np.mean([one.first for one in seen])), SHARE)
    good = [one.first and (one.error < WITHIN or one.deviations < DEVIATIONS) for one in seen]
    yield above(text + f"within {WITHIN:.0%} or {DEVIATIONS:g} deviations", float(np.mean(good)), SHARE)
    errors = [one.deviations for one in seen if one.first]
    yield Line(text + "rms error over the stated deviation", f"{np.sqrt(np.mean(np.square(errors))):.2f}")
    off = [f"{one.name}: {one.matrices:.3g}" for one in late if one.matrices > MATRICES]
    text = f"{len(late)} late channels: M, K, C beyond {MATRICES:g} deviations{_examples(off)}"
    yield below(text, len(off) / len(late), 1 - SHARE)
    wrong = [f"{one.name}: {one.said}" for one in right if not one.first]
    yield below(f"{len(right)} tests on one clock: a delay found{_examples(wrong)}", len(wrong), 0)


def one_draw(task: tuple[int, bool]) -> Found:
    """One test of a number, late or not."""
    number, late = task
    kind, case = KINDS[number % len(KINDS)], CASES[number // len(KINDS) % len(CASES)]
    rng = np.random.default_rng((number, 28))
    setting = _setting(kind, rng)
    n = setting.structure.n_sensors
    delays, which = np.zeros(n + 1), {"one sensor": [int(rng.integers(n))], "all": range(n + 1), "the force": [n]}
    rate = setting.sample_rate if "records" in kind else 2.5 * setting.lines[1]
    delays[list(which[case])] = late * rng.choice([-1, 1]) * np.exp(rng.uniform(*np.log(SAMPLES))) / rate
    test = _records(setting, delays, rng) if "records" in kind else _spectra(setting, delays, rng)
    name = f"{kind}, {case} {1e3 * delays.max() + 1e3 * delays.min():.3g} ms (draw {number})"
    try:
        result = sysid.identify(_problem(kind, test), rng=0)
    except sysid.InputError as error:  # a right test that is refused
        return Found(name, late, False, np.inf, np.inf, np.inf, np.inf, str(error)[:100])
    return _found(name, result, setting.structure, delays, late)


def _found(name: str, result: sysid.Identification, truth: sysid.Structure, delays: np.ndarray, late: bool) -> Found:
    told = result.modal[0].delays
    assert told is not None
    said = str(result.findings[0])[:100] if result.findings else "nothing"
    kinds = [one.kind for one in result.findings]
    right = bool(np.array_equal(told.values != 0, delays != 0))
    first = right and (kinds[:1] == ["late sensor"] if late else "late sensor" not in kinds)
    at = np.flatnonzero(delays)
    error = np.abs(told.values - delays)[at].max(initial=0.0)
    std = told.std[at].max(initial=0.0)
    size = np.abs(delays).max()
    return Found(
        name, late, first, error / size if late else 0.0, error / std if std else np.inf * late,
        size / std if std else np.inf, _matrices(result, truth), said,
    )  # fmt: skip


def _matrices(result: sysid.Identification, truth: sysid.Structure) -> float:
    """Largest error of an entry over its deviation; infinite where the structure is of another size."""
    found, n = result.structure, truth.n
    if found.n != n:
        return np.inf
    std = result.uncertainty
    parts = [
        (found.mass[:n, :n] - truth.mass[:n, :n], std.mass), (found.stiffness[:n, :n] - truth.stiffness[:n, :n],
        std.stiffness), (found.damping - truth.damping, std.damping),
    ]  # fmt: skip
    sizes = [np.abs(error) / np.where(one[:n, :n] > 0, one[:n, :n], np.inf) for error, one in parts]
    return float(max(np.nanmax(size) for size in sizes))


def _setting(kind: str, rng: np.random.Generator) -> Setting:
    """Four storeys, or four coupled degrees of freedom of close frequencies."""
    if "full" not in kind:
        return four_storeys(table=0.0)  # a lumped mass has none between load cells and first storey
    f = 2.0 * np.cumprod([1.0, *rng.uniform(1.1, 1.6, 3)])
    structure = coupled_structure(rng, 4, 1, f, np.ones(4))
    return Setting(structure, 100 / f[0], 8 * f[-1], (0.3 * f[0], 1.6 * f[-1]), (0.2 * f[0], 3 * f[-1]), np.eye(1))


def _problem(kind: str, test: sysid.Measurement) -> sysid.Problem:
    if "chain" in kind:
        return sysid.Problem(test, mass=sysid.LumpedMass(), stiffness=sysid.ChainStiffness(lower=1e5, upper=1e7))
    return sysid.Problem(test, mass=sysid.LumpedMass()) if "lumped" in kind else sysid.Problem(test)


def _records(setting: Setting, delays: np.ndarray, rng: np.random.Generator) -> sysid.Measurement:
    run = setting.run(rng)
    clean, *parts = run.records(), *(_earlier(run, delay).records() for delay in delays)
    response = np.stack([part.response[i] for i, part in enumerate(parts[:-1])])
    late = Records(clean.base, response, parts[-1].force, clean.sample_rate)
    noisy, _ = setting.with_noise(late, rng)
    return sysid.Measurement.from_time(
        [(noisy.base, noisy.response, noisy.force)], noisy.sample_rate, rigid_body=setting.structure.rigid_body,
        band=setting.lines,
    )  # fmt: skip


def _earlier(run: Run, time: float) -> Run:
    """The same motion, recorded later by a time, s: what is recorded at t happened at ``t - time``."""
    turned = run.motion.amplitudes * np.exp(-1j * run.motion.omega * time)
    return Run(run.modes, replace(run.motion, amplitudes=turned), run.free * np.exp(-run.modes.poles * time))


def _spectra(setting: Setting, delays: np.ndarray, rng: np.random.Generator) -> sysid.Measurement:
    freq, modes = np.linspace(*setting.lines, 500), Modes.of(setting.structure)
    turn = np.exp(-2j * np.pi * freq * delays[:, None, None])
    parts = {}
    pairs = zip(transfer(modes, 2 * np.pi * freq), (turn[:-1], turn[-1:]), strict=True)
    for name, (clean, late) in zip(("response", "force"), pairs, strict=True):
        record = np.moveaxis(clean * late, 1, 0)  # a run of unit motion along each axis
        std = NOISE * np.sqrt(np.mean(np.abs(record) ** 2, axis=2, keepdims=True))
        real, imaginary = rng.standard_normal((2, *record.shape)) / np.sqrt(2)
        parts |= {name: record + std * (real + 1j * imaginary), f"{name}_std": std}
    base = np.ones((1, 1, freq.size))  # of one axis
    return sysid.Measurement(freq, base, rigid_body=modes.rigid_body, **parts)


def _examples(texts: list[str], most: int = 3) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""
