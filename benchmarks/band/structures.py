"""Sixty continuous structures, with how they are tested: beams, frames, and plates on four springs.

Each number gives one structure, always the same: beam, frame, plate in turn, tested by spectra and by whole records in
turn. All its modes are kept, some hundred of them; those in the lines are the first ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.band.finite_elements import Material, Model, OnBase, Section
from benchmarks.records.simulated import Modes

ALUMINIUM = Material(70e9, 0.33, 2700.0)
RATIOS = (0.003, 0.03)
NOISE = (0.003, 0.03)  # over each channel's rms
IN_LINES = (3, 15)
SENSORS = (0.5, 4.0)  # over the number of modes in the lines
END = (0.2, 0.8)  # of the way from the last mode in the lines to the next one, where they end
START = (0.5, 0.8)  # of the first mode, where they begin
APART = 1.08  # the next mode over the last one in the lines, at least
SPECTRA, RECORDS = "spectra", "records"
LONGEST = {SPECTRA: 700.0, RECORDS: 150.0}  # last line over the first mode
LEAST = 1e-3  # of the rigid-body mass, that each mode in the lines moves along some axis of the base
REACH = 6.0  # of the last line: up to there all modes of the elements are kept
PLANE = ("x", "z", "ry")
STEP = 0.1  # m, between nodes of frames, at most

Candidate = tuple[
    int, str, tuple[float, float, float]
]  # node and axis of a possible sensor, its place from the node, m
AT_NODE = (0.0, 0.0, 0.0)
BRACKET = 0.04  # m, from a beam's axis, so that torsion is seen


@dataclass(frozen=True, eq=False)
class Continuous:
    """A structure and its test.

    Attributes
    ----------
    name : str
    kind : str
        `SPECTRA` or `RECORDS`.
    base : tuple of str
        Axes along which the base moves.
    modes : Modes
        All modes, at the sensors; `count` of them are in the lines, the first ones.
    count : int
    lines : (low, high)
        Hz.
    noise : float
        Of each channel, over its rms.
    """

    name: str
    kind: str
    base: tuple[str, ...]
    modes: Modes
    count: int
    lines: tuple[float, float]
    noise: float

    @property
    def frequencies(self) -> np.ndarray:
        """Of all modes, Hz."""
        return self.modes.omega / (2 * np.pi)


def structure(number: int) -> Continuous:
    """Draw structure `number`; one that leaves no gap for the end of the lines, or hides modes, is drawn again."""
    rng = np.random.default_rng((number, 27))
    draw = (beam, frame, plate)[number % 3]
    kind = (SPECTRA, RECORDS)[number // 3 % 2]
    while True:
        driven, base, candidates = draw(rng, int(rng.integers(1, 4)))
        omega, shapes = driven.modes()
        weights = np.max((shapes.T @ driven.load) ** 2 / np.diag(driven.rigid_body_mass), axis=1)
        last = last_mode(rng, omega / (2 * np.pi), weights, kind)
        if last:
            break
    f = omega / (2 * np.pi)
    end = f[last - 1] + rng.uniform(*END) * (f[last] - f[last - 1])
    sensors = chosen(rng, candidates, round(last * rng.uniform(*SENSORS)))
    rows = np.array([driven.row(*sensor) for sensor in sensors])
    modes = Modes(
        omega, log_uniform(rng, RATIOS, omega.size), shapes.T @ driven.load, rows @ shapes, rows @ driven.rigid,
        driven.rigid_body_mass,
    )  # fmt: skip
    name = f"{draw.__name__} {number}: d = {len(base)}, {last} modes, {len(rows)} sensors, {kind}"
    lines = (float(f[0] * rng.uniform(*START)), float(end))
    return Continuous(name, kind, base, modes, last, lines, float(log_uniform(rng, NOISE)))


def last_mode(rng: np.random.Generator, f: np.ndarray, weights: np.ndarray, kind: str) -> int:
    """Number of modes in the lines: one of those after which there is room for their end; 0 where there is none."""
    low, high = IN_LINES
    room = [
        m for m in range(low, high + 1)
        if f[m] > APART * f[m - 1] and f[m] < LONGEST[kind] * f[0] and np.min(weights[:m]) > LEAST
    ]  # fmt: skip
    return int(rng.choice(room)) if room and f[-1] > REACH * f[room[-1]] else 0


def chosen(rng: np.random.Generator, candidates: list[Candidate], count: int) -> list[Candidate]:
    """Sensors spread over the structure: one of each of `count` equal parts of all places in their order."""
    count = min(max(count, 2), len(candidates))
    at = (np.arange(count) + rng.random(count)) * len(candidates) / count
    return [candidates[int(i)] for i in at]


def log_uniform(rng: np.random.Generator, ends: tuple[float, float], size: int | None = None) -> np.ndarray:
    """Draw numbers whose logarithm is uniform between those of two ends."""
    return np.exp(rng.uniform(*np.log(ends), size))


def beam(rng: np.random.Generator, d: int) -> tuple[OnBase, tuple[str, ...], list[Candidate]]:
    """Draw a cantilever of stepped sections with a rigid body off its tip: in a plane, or in space for d = 3."""
    elements, steps, length = 24, int(rng.integers(2, 5)), rng.uniform(1.0, 3.0)
    model = Model(np.outer(np.linspace(0, length, elements + 1), (1, 0, 0)))
    width, height = rng.uniform(0.02, 0.04) * rng.uniform(0.6, 1.4, (2, steps))
    for i in range(elements):
        step = i * steps // elements
        model.beam(i, i + 1, Section.rectangle(ALUMINIUM, width[step], height[step]))
    body = rng.uniform(0.05, 0.5) * np.trace(model.mass[::6, ::6])
    offset = rng.uniform(0.02, 0.08, 3) * rng.choice([-1, 1], 3) * length
    model.rigid_mass(elements, body, body * (rng.uniform(0.02, 0.06, 3) * length) ** 2, offset)
    base = (("z",), ("x", "z"), ("x", "y", "z"))[d - 1]
    moving = PLANE if d < 3 else ("x", "y", "z", "rx", "ry", "rz")
    places = {"z": (0.0, BRACKET, 0.0), "y": (0.0, 0.0, -BRACKET), "x": AT_NODE}
    along = (("z",), ("z", "x"), ("y", "z", "x"))[d - 1]
    candidates = [(i, axis, places[axis]) for i in range(1, elements + 1) for axis in along]
    return model.on_base(base, clamped=[0], moving=moving), base, candidates


def frame(rng: np.random.Generator, d: int) -> tuple[OnBase, tuple[str, ...], list[Candidate]]:
    """Draw a plane frame of one bay and one to four storeys, with rigid bodies on its beams."""
    storeys, bay = int(rng.integers(1, 5)), rng.uniform(0.6, 1.5)
    heights = np.concatenate([[0], np.cumsum(rng.uniform(0.4, 0.9, storeys))])
    nodes = _Nodes()
    members: list[tuple[list[int], Section]] = []

    def member(start: tuple[float, float], end: tuple[float, float]) -> None:
        section = Section.rectangle(ALUMINIUM, rng.uniform(0.02, 0.05), rng.uniform(0.008, 0.02))
        members.append((nodes.along(start, end), section))

    for low, high in pairwise(heights):
        member((0, low), (0, high))
        member((bay, low), (bay, high))
        member((0, high), (bay, high))
    model = Model(np.array(nodes.places))
    for line, section in members:
        for first, second in pairwise(line):
            model.beam(first, second, section, up=(0, 1, 0))
    for line, _ in members[2::3]:
        for node in rng.choice(line, 2, replace=False):
            body = rng.uniform(0.1, 1.0)
            model.rigid_mass(node, body, body * rng.uniform(0.01, 0.05, 3) ** 2)
    base = (("x",), ("x", "z"), PLANE)[d - 1]
    feet = [members[0][0][0], members[1][0][0]]
    candidates = list(dict.fromkeys(
        (node, "z" if i % 3 == 2 else "x", AT_NODE) for i, (line, _) in enumerate(members) for node in line[1:]
    ))  # fmt: skip
    return model.on_base(base, clamped=feet, moving=PLANE), base, candidates


def plate(rng: np.random.Generator, d: int) -> tuple[OnBase, tuple[str, ...], list[Candidate]]:
    """Draw a thin plate on four unequal springs near its corners, with three rigid bodies on it."""
    across, along = 10, 8
    a, b, thickness = rng.uniform(0.7, 1.2), rng.uniform(0.4, 0.65), rng.uniform(0.004, 0.008)
    x, y = np.meshgrid(np.linspace(0, a, across + 1), np.linspace(0, b, along + 1), indexing="ij")
    number = np.arange(x.size).reshape(x.shape)
    centre = np.array([0.45 * a, 0.55 * b])  # the base turns about it
    model = Model(np.column_stack([x.ravel() - centre[0], y.ravel() - centre[1], np.zeros(x.size)]))
    for i in range(across):
        for j in range(along):
            corners = [number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]]
            model.plate(corners, thickness, ALUMINIUM)
    mass = ALUMINIUM.density * a * b * thickness
    for node in rng.choice(x.size, 3, replace=False):
        body = mass * rng.uniform(0.03, 0.15)
        model.rigid_mass(node, body, body * rng.uniform(0.02, 0.05, 3) ** 2)
    rigidity = ALUMINIUM.young * thickness**3 / (12 * (1 - ALUMINIUM.poisson**2))
    first = np.sqrt(rigidity / (ALUMINIUM.density * thickness)) * 22.4 / max(a, b) ** 2  # of a free strip
    stiffness = mass / 4 * (first * log_uniform(rng, (0.4, 2.0))) ** 2
    for node in (number[1, 1], number[-2, 1], number[-2, -2], number[1, -2]):
        model.spring(node, (0, 0, stiffness * rng.uniform(0.6, 1.4), 0, 0, 0))
    axes = ("z", "rx", "ry")
    return model.on_base(axes[:d], moving=axes), axes[:d], [(int(node), "z", AT_NODE) for node in number.ravel()]


class _Nodes:
    """Nodes of a plane frame, each place once."""

    def __init__(self) -> None:
        self.places: list[tuple[float, float, float]] = []

    def along(self, start: tuple[float, float], end: tuple[float, float]) -> list[int]:
        """Numbers of the nodes of a straight member, from start to end, (x, z), m."""
        count = int(np.ceil(np.hypot(end[0] - start[0], end[1] - start[1]) / STEP)) + 1
        return [self._number(float(x), float(z)) for x, z in np.linspace(start, end, count)]

    def _number(self, x: float, z: float) -> int:
        place = (round(x, 9), 0.0, round(z, 9))
        if place not in self.places:
            self.places.append(place)
        return self.places.index(place)


def structures(count: int) -> Iterator[Continuous]:
    """Draw the first `count` structures."""
    return map(structure, range(count))
