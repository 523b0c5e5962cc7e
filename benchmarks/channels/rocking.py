"""Tables that rock: the base is recorded along its axes, and turns about others in proportion.

Frames and masts of finite elements, with modes above the lines, and towers of floors on springs, along one axis or two
that are coupled; by spectra and by whole records, with the base's force and without. The rotation loads the structure
as any motion of its base does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import sysid
from benchmarks.band.finite_elements import Model, OnBase, Section
from benchmarks.band.one_structure import accusations
from benchmarks.band.simulated_tests import ABOVE, PEAK, PEAK_LINES, RATE, SPREAD_LINES, FromRest, transfer
from benchmarks.band.structures import (
    ALUMINIUM,
    APART,
    END,
    LEAST,
    PLANE,
    RATIOS,
    RECORDS,
    SPECTRA,
    START,
    frame,
    log_uniform,
)
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread
from benchmarks.records.simulated import Modes, random_motion, with_noise

SLOPES = (0.02, 0.1)  # rad/m
NOISE = (0.003, 0.01)  # over each channel's rms
MODES = (2, 6)  # in the lines, where there are more
LONGEST = {SPECTRA: 300.0, RECORDS: 40.0}  # first mode above the lines over the first mode, at most
PERIODS = (60, 100)  # of the first mode, in a record
TESTS = 40
NAMED = 38 / 40
MISREAD, SCATTER = 0.02, 0.005  # one gain, and all of them, of straight tables
ACCUSED = 0.05
SHORT = {"rocks": 4, "straight": 4}  # tests of a case, of the others two: the fourth is of whole records
CASES = ("rocks", "stated", "straight", "one sensor", "all sensors", "base")
KIND = "table rocks"
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class OnTable:
    """A structure and its sensors on a table, with modes of all directions in which it moves.

    `moves` names these; the first `recorded` have a sensor of their own.
    """

    name: str
    modes: Modes
    moves: tuple[str, ...]
    recorded: int
    sensors: tuple[sysid.Sensor, ...]
    lines: tuple[float, float]
    count: int
    noise: float


@dataclass(frozen=True)
class Found:
    """What came of a test: slopes told, by the axes recorded and turned about, and who is accused beside."""

    name: str
    case: str
    slope: float
    told: list[tuple[str, float, float]]
    accused: list[str]
    said: str


def lines(reduced: bool) -> Iterator[Line]:
    """Forty tables that rock, unknown and stated, and as many that do not in each of four cases; or a few."""
    found = spread(
        one_test, [(case, number) for case in CASES for number in range(SHORT.get(case, 2) if reduced else TESTS)]
    )
    rocks, stated, *others = ([one for one in found if one.case == case] for case in CASES)
    missed = [f"{one.name}, {one.slope:.2g}: {one.said[:90]}" for one in rocks if len(one.told) != 1 or one.accused]
    text = f"{len(rocks)} tables that rock by {SLOPES[0]:g}-{SLOPES[1]:g} rad/m: told, and no sensor accused"
    yield above(text + _examples(missed), 1 - len(missed) / len(rocks), NAMED)
    off = [abs(slope - one.slope) / std for one in rocks for _, slope, std in one.told]
    size = [abs(slope / one.slope - 1) for one in rocks for _, slope, std in one.told]
    yield Line("its slope: rms error over its deviation", f"{np.sqrt(np.mean(np.square(off))):.3g}")
    yield Line("its slope: largest error over itself", f"{max(size, default=np.nan):.3g}")
    accused = [f"{one.name}: {one.said[:90]}" for one in stated if one.told or one.accused]
    yield below(f"{len(stated)} of them with the rotation in rigid_body, no force: share accused{_examples(accused)}",
                len(accused) / len(stated), ACCUSED)  # fmt: skip
    what = (
        "",
        f", one gain {MISREAD:.0%} off",
        f", all gains by {SCATTER:.1%}",
        f", the base's gain {MISREAD:.0%} off",
    )
    for some, case in zip(others, what, strict=True):
        told = [f"{one.name}: {one.told}" for one in some if one.told]
        yield below(f"{len(some)} straight tables{case}: told to rock{_examples(told)}", len(told), 0)


def one_test(task: tuple[str, int]) -> Found:
    """One test of a case."""
    case, number = task
    its, rng = on_table(number), np.random.default_rng((number, 19))
    slope = float(log_uniform(rng, SLOPES) * rng.choice([-1, 1])) if case in ("rocks", "stated") else 0.0
    along = int(rng.integers(its.recorded))
    mixture = np.eye(len(its.moves), its.recorded)
    mixture[its.recorded + along, along] = slope  # each direction that is not recorded belongs to one that is
    test = tested(
        its, mixture, rng, kind=(SPECTRA, RECORDS)[number // 3 % 2], weighed=case != "stated" and number % 2 == 0
    )
    if case == "stated":
        test = replace(test, rigid_body=its.modes.rigid_body @ mixture)
    gains = np.ones(test.n_sensors)
    if case == "one sensor":
        gains[rng.choice(np.flatnonzero(np.abs(test.rigid_body[:, along]) > 0.5))] += MISREAD * rng.choice([-1, 1])
    if case == "all sensors":
        gains += SCATTER * rng.standard_normal(gains.size)
    if case == "base":
        gains[:] += MISREAD * rng.choice([-1, 1])  # of all sensors: the same, but for the force
    std = test.response_std
    test = replace(
        test, response=gains[:, None] * test.response, response_std=None if std is None else gains[:, None] * std,
    )  # fmt: skip
    result = sysid.identify(sysid.Problem(test), rng=0)
    of_table = [one for one in result.findings if one.kind == KIND]
    accused = [one for one in accusations(result) if not one.startswith(KIND)]
    said = next((f"{one.kind}: {one.sentence}" for one in result.findings if one.severity != "note"), "nothing")
    told = [(one.channel or "", one.numbers["slope"], one.numbers["std"]) for one in of_table]
    return Found(f"{its.name} (test {number})", case, slope, told, accused, accused[0] if accused else said)


def tested(
    its: OnTable, mixture: np.ndarray, rng: np.random.Generator, *, kind: str, weighed: bool
) -> sysid.Measurement:
    """A test whose base moves by `mixture` (moves, recorded) of what is recorded."""
    G = its.modes.rigid_body[:, : its.recorded]
    of_axes = {"sensors": its.sensors, "rigid_body": G, "base_axes": its.moves[: its.recorded]}
    return (_records if kind == RECORDS else _spectra)(its, mixture, rng, weighed, of_axes)


def _spectra(its: OnTable, mixture: np.ndarray, rng: np.random.Generator, weighed: bool, of_axes: dict):
    """Functions for unit motion along each recorded axis, closer lines about the peaks."""
    (low, high), m, d = its.lines, its.count, its.recorded
    f = its.modes.omega[:m, None] / (2 * np.pi)
    widths = its.modes.zeta[:m, None] * np.tan(np.linspace(-1, 1, PEAK_LINES) * np.arctan(PEAK))
    freq = np.concatenate([np.geomspace(low, high, SPREAD_LINES * m), (f * (1 + widths)).ravel()])
    freq = np.unique(freq[(freq >= low) & (freq <= high)])
    H, Z = transfer(its.modes, 2 * np.pi * freq)
    clean = np.einsum("cdf,dr->crf", np.concatenate([H, Z[:d]]), mixture)
    std = its.noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=(1, 2), keepdims=True)) * np.ones(clean.shape)
    parts = rng.standard_normal((2, *clean.shape)) / np.sqrt(2)
    noisy, n = clean + std * (parts[0] + 1j * parts[1]), len(H)
    force = {"force": noisy[n:], "force_std": std[n:]} if weighed else {}
    return sysid.Measurement.from_frf(freq, noisy[:n], response_std=std[:n], **force, **of_axes)


def _records(its: OnTable, mixture: np.ndarray, rng: np.random.Generator, weighed: bool, of_axes: dict):
    """One run from rest, cut in motion, with noise on all channels."""
    (low, high), d = its.lines, its.recorded
    duration = float(log_uniform(rng, PERIODS)) / (its.modes.omega[0] / (2 * np.pi))
    motion = random_motion(rng, duration, RATE * high, (0.9 * low, ABOVE * high), correlation=np.eye(d))
    clean = FromRest.of(its.modes, replace(motion, amplitudes=mixture @ motion.amplitudes)).records()
    noisy = with_noise(replace(clean, base=clean.base[:d], force=clean.force[:d]), rng, its.noise)[0]
    run = (noisy.base, noisy.response, noisy.force if weighed else None)
    return sysid.Measurement.from_time([run], RATE * high, band=its.lines, **of_axes)


def on_table(number: int) -> OnTable:
    """Draw structure `number`: tower, frame and mast in turn."""
    rng = np.random.default_rng((number, 61))
    of, kind = (tower, plane_frame, mast)[number % 3], (SPECTRA, RECORDS)[number // 3 % 2]
    while True:
        driven, moves, rows, sensors = of(rng)
        omega, shapes = driven.modes()
        d = len(moves) // 2
        gamma, G, mass = shapes.T @ driven.load, rows @ driven.rigid, driven.rigid_body_mass
        weights = np.max(gamma[:, :d] ** 2 / np.diag(mass)[:d], axis=1)
        low, high = MODES if of is not tower else (omega.size, omega.size)
        next_ = np.append(omega, 1.5 * omega[-1])
        room = [
            m for m in range(low, high + 1)
            if next_[m] > APART * omega[m - 1] and next_[m] < LONGEST[kind] * omega[0]
            and np.min(weights[:m]) > LEAST and np.all(omega[1:m] > 1.03 * omega[: m - 1])
        ]  # fmt: skip
        if room:
            break
    count = int(rng.choice(room))
    last = omega[count - 1] + rng.uniform(*END) * (next_[count] - omega[count - 1])
    ends = (float(omega[0] * rng.uniform(*START) / (2 * np.pi)), float(last / (2 * np.pi)))
    modes = Modes(omega, log_uniform(rng, RATIOS, omega.size), gamma, rows @ shapes, G, mass)
    name = f"{of.__name__} {number}: {' '.join(moves[:d])}, {count} modes, {len(rows)} sensors, {kind}"
    return OnTable(name, modes, moves, d, sensors, ends, count, float(log_uniform(rng, NOISE)))


Drawn = tuple[OnBase, tuple[str, ...], np.ndarray, tuple[sysid.Sensor, ...]]


def tower(rng: np.random.Generator) -> Drawn:
    """Draw floors on springs, along x or along x and y with springs that couple them; a sensor a floor and axis."""
    d, floors = int(rng.integers(1, 3)), int(rng.integers(4, 7))
    floors -= 2 * (d == 2) * (floors == 6)
    height = np.cumsum(rng.uniform(0.25, 0.8, floors))
    mass = np.repeat(rng.uniform(1.0, 8.0, floors), d)
    K = np.zeros((d * floors, d * floors))
    for i in range(floors):
        spring = np.diag(rng.uniform(1e5, 6e5, d))
        spring += 0.2 * spring[0, 0] * rng.uniform(-1, 1) * (1 - np.eye(d))
        strain = np.zeros((d, d * floors))
        strain[:, d * i : d * (i + 1)] = np.eye(d)
        if i:
            strain[:, d * (i - 1) : d * i] = -np.eye(d)
        K += strain.T @ spring @ strain
    freedoms = tuple((i // d, "xy"[i % d]) for i in range(d * floors))
    sensors = tuple(sysid.Sensor(f"floor {i + 1} {axis}", (0.0, 0.0, float(height[i])), axis) for i, axis in freedoms)
    moves = ("x", "ry") if d == 1 else ("x", "y", "ry", "rx")
    rigid = np.hstack([np.tile(np.eye(d), (floors, 1)), np.kron(height[:, None], np.diag([1.0, -1.0][:d]))])
    M = np.diag(mass)
    driven = OnBase(M, K, M @ rigid, rigid, rigid.T @ M @ rigid, freedoms)
    return driven, moves, np.eye(d * floors), sensors


def plane_frame(rng: np.random.Generator) -> Drawn:
    """Draw a frame of `benchmarks.band`, with sensors along x at four to eight heights and up to two along z."""
    while True:
        driven, _, candidates = frame(rng, 3)
        rows = np.array([driven.row(*one) for one in candidates])
        G = rows @ driven.rigid  # x z ry
        upright = np.flatnonzero(G[:, 0] > 0.5)
        if np.ptp(G[upright, 2]) > 0.5 and len(upright) > 8:
            break
    columns = upright[np.argsort(G[upright, 2], kind="stable")]
    count = int(rng.integers(4, 9))
    at = columns[((np.arange(count) + rng.uniform(0.3, 1.0, count)) * len(columns) / count).astype(int)]
    level = rng.choice(np.flatnonzero(G[:, 1] > 0.5), int(rng.integers(0, 3)), replace=False)
    chosen = [*at, *level]
    places = [(0.0, 0.0, G[i, 2]) if G[i, 0] > 0.5 else (-G[i, 2], 0.0, 0.0) for i in chosen]
    sensors = tuple(
        sysid.Sensor(f"s{k + 1}", tuple(map(float, place)), "x" if G[i, 0] > 0.5 else "z")
        for k, (i, place) in enumerate(zip(chosen, places, strict=True))
    )
    keep = [0, 2]
    seen = replace(
        driven, load=driven.load[:, keep], rigid=driven.rigid[:, keep],
        rigid_body_mass=driven.rigid_body_mass[np.ix_(keep, keep)],
    )  # fmt: skip
    return seen, ("x", "ry"), rows[chosen], sensors


def mast(rng: np.random.Generator) -> Drawn:
    """Draw an upright cantilever of two sections with a rigid body at its tip, and four to eight sensors along x."""
    elements, height = 20, float(rng.uniform(1.0, 3.0))
    model = Model(np.outer(np.linspace(0, height, elements + 1), (0, 0, 1)))
    width, depth = rng.uniform(0.02, 0.04) * rng.uniform(0.6, 1.4, (2, 2))
    for i in range(elements):
        step = 2 * i // elements
        model.beam(i, i + 1, Section.rectangle(ALUMINIUM, width[step], depth[step]), up=(0, 1, 0))
    body = rng.uniform(0.05, 0.5) * np.trace(model.mass[::6, ::6])
    model.rigid_mass(elements, body, body * (rng.uniform(0.02, 0.06, 3) * height) ** 2)
    driven = model.on_base(("x", "ry"), clamped=[0], moving=PLANE)
    count = int(rng.integers(4, 9))
    nodes = 1 + ((np.arange(count) + rng.random(count)) * elements / count).astype(int)
    rows = np.array([driven.row(int(node), "x", (0.0, 0.0, 0.0)) for node in nodes])
    sensors = tuple(
        sysid.Sensor(f"s{k + 1}", (0.0, 0.0, float(node * height / elements)), "x") for k, node in enumerate(nodes)
    )
    return driven, ("x", "ry"), rows, sensors


def _examples(texts: list[str], most: int = 5) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""
