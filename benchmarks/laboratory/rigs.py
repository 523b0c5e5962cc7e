"""Structures of the ten kinds of test, with their sensors, by the finite elements of `benchmarks.band`.

All stiffnesses of one are scaled so that its first mode has a drawn frequency. The base moves up to a frequency between
two modes, so that the modes in the lines are known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from benchmarks.band.finite_elements import AXES, Material, Model, OnBase, Section
from benchmarks.band.spacecraft_dummy import spacecraft
from benchmarks.band.structures import AT_NODE, PLANE, REACH, Candidate, beam, chosen, frame, log_uniform
from benchmarks.records.simulated import Modes

RATIOS = (0.005, 0.03)
LEAST = 2e-3  # of the rigid-body mass, that each mode in the lines moves along some axis of the base
APART = 1.15  # the next mode over the last one in the lines, at least
STEEL = Material(210e9, 0.3, 7850.0)
STOUT = 100.0  # times its area: columns that do not stretch, so that floors do not turn
LIGHT = 0.1  # of the mass of such columns of steel: a mass that is stated as lumped is right to 3e-5 then

Place = tuple[str, tuple[float, float, float]]  # axis and position, m, of a sensor


@dataclass(frozen=True, eq=False)
class Rig:
    """A structure to be tested.

    Attributes
    ----------
    name : str
    base : tuple of str
        Axes of the base that `modes` have participations for.
    modes : Modes
        All modes, at the sensors; `count` of them are in the lines, the first ones.
    sensors : tuple of (axis, position)
    count : int
    loss : (modes, modes)
        Phi' C Phi, rad/s.
    weighed : float
        kg, of floors and half the columns at either end of them; 0 where nothing was weighed.
    """

    name: str
    base: tuple[str, ...]
    modes: Modes
    sensors: tuple[Place, ...]
    count: int
    loss: np.ndarray
    weighed: float = 0.0

    @property
    def frequencies(self) -> np.ndarray:
        """Of all modes, Hz."""
        return self.modes.omega / (2 * np.pi)

    @property
    def shown(self) -> Modes:
        """Modes as the lines show them: those in them with the answer of those above, where dampers couple both.

        The dynamic stiffness of those within is D(w) = W² - w² + i w Z + H(w), see `_held`: a mode p has
        Re D(w_k) p = 0, the mass 1 = -p' Re dD/d(w²) p and the loss p' Im D(w_k) p / w_k. A dashpot c between points
        that the modes above let move by F a unit of force damps by c / (1 + (w c F)²): where w c F is large it holds
        them together and damps nothing, however large p' C p is of modes that do without it.
        """
        modes, own, turn = self.modes, slice(0, self.count), np.eye(self.modes.omega.size)
        if not self.loss[own, self.count :].any():
            return modes
        omega, zeta = modes.omega.copy(), modes.zeta.copy()
        for k, w in enumerate(modes.omega[own]):
            last = 0.0
            while abs(w - last) > 1e-12 * w:
                squares, V = np.linalg.eigh(np.diag(modes.omega[own] ** 2) + self._held(w).real)
                last, w = w, np.sqrt(squares[k])
            p, step = V[:, k], 1e-5 * w
            slope = (self._held(w + step) - self._held(w - step)).real / (4 * w * step)  # along w²
            mass, loss = 1 - p @ slope @ p, p @ (self.loss[own, own] + self._held(w).imag / w) @ p
            omega[k], zeta[k], turn[own, k] = w, loss / mass / (2 * w), p * np.sign(p[k]) / np.sqrt(mass)
        return replace(modes, omega=omega, zeta=zeta, shapes=modes.shapes @ turn, gamma=turn.T @ modes.gamma)

    def _held(self, w: float) -> np.ndarray:
        """H(w) = w² Z_ba (W_a² - w² + i w Z_aa)^-1 Z_ab, by which modes above hold those within, (count, count)."""
        above, across = slice(self.count, None), self.loss[self.count :, : self.count]
        X = np.diag(self.modes.omega[above] ** 2 - w**2) + 1j * w * self.loss[above, above]
        return np.asarray(w**2 * across.T @ np.linalg.solve(X, across))

    @property
    def end(self) -> float:
        """Frequency up to which the base moves, Hz: between the last mode in the lines and the next."""
        last, following = self.frequencies[self.count - 1 : self.count + 1]
        return float(min(np.sqrt(last * following), 1.4 * last))

    @property
    def start(self) -> float:
        """Frequency from which it moves, Hz."""
        return 0.5 * float(self.frequencies[0])


def plane(
    rng: np.random.Generator, base: tuple[str, ...] = ("x",), moved: tuple[str, ...] = (), longest: float = 30.0
) -> Rig:
    """A frame of one bay, or a cantilever (base "z"), with one to two sensors a mode in the lines.

    `moved` are the axes along which the base does move, all by default; `longest` is the last frequency over the first.
    """
    while True:
        driven, axes, candidates = (beam if base == ("z",) else frame)(rng, 2 if base == ("z",) else 3)
        driven = _along(driven, axes, base)
        rig = _drawn(rng, driven, base, candidates, (3.0, 10.0), 6, moved=moved, longest=longest)
        if rig:
            return rig


def three_axes(rng: np.random.Generator, most: int = 10) -> Rig:
    """A spacecraft on a base that moves along x, y and z, with twelve sensors."""
    while True:
        driven, sensors = spacecraft(rng)
        kept = [sensors[i] for i in sorted(rng.permutation(len(sensors))[:12])]
        base = ("x", "y", "z")
        rig = _drawn(rng, _along(driven, AXES, base), base, kept, (15.0, 30.0), most, of_all=True)
        if rig:
            return rig


def storeys(rng: np.random.Generator, count: int, first: tuple[float, float]) -> Rig:
    """A building of two columns a storey between stiff floors, a sensor on each; `first` bounds its first mode, Hz."""
    while True:
        height, bay = rng.uniform(0.4, 0.6), 1.0
        floors = rng.uniform(800.0, 1200.0, count)
        columns = [Section.rectangle(STEEL, 0.05, 0.006 * rng.uniform(0.9, 1.15)) for _ in range(count)]
        columns = [
            one._replace(area=STOUT * one.area, material=STEEL._replace(density=LIGHT * STEEL.density / STOUT))
            for one in columns
        ]
        stiff = Section.rectangle(Material(210e13, 0.3, 1.0), 0.1, 0.1)
        levels = np.linspace(0, count * height, 2 * count + 1)
        model = Model(np.array([(x, 0.0, z) for z in levels for x in (0.0, bay)]))
        for at, (low, high) in enumerate(pairwise(range(2 * count + 1))):
            for side in (0, 1):
                model.beam(2 * low + side, 2 * high + side, columns[at // 2], up=(0, 1, 0))
        for floor, mass in enumerate(floors, 1):
            left = 4 * floor
            model.beam(left, left + 1, stiff, up=(0, 1, 0))
            for node in (left, left + 1):
                model.rigid_mass(node, mass / 2, (5.0, 5.0, 5.0))
        driven = model.on_base(("x",), clamped=[0, 1], moving=PLANE)
        sensors = [(4 * floor, "x", AT_NODE) for floor in range(1, count + 1)]
        area = 2 * (sum(one.area for one in columns) - columns[0].area / 2)
        weighed = floors.sum() + area * height * LIGHT * STEEL.density / STOUT
        rig = _drawn(rng, driven, ("x",), sensors, first, count, of_all=True, least=5e-4)
        if rig and rig.count == count:
            return replace(rig, weighed=float(weighed))


def with_dashpot(rng: np.random.Generator, rig: Rig) -> Rig:
    """The same with a dashpot between two sensors, which damps one of the modes in the lines by 1 to 3 % more."""
    both = rng.choice(len(rig.sensors), 2, replace=False)
    stretch = rig.modes.shapes[both[0]] - rig.modes.shapes[both[1]]
    inside = np.arange(rig.count)
    most = int(inside[np.argmax(stretch[inside] ** 2 / rig.modes.omega[inside])])
    size = 2 * rng.uniform(0.01, 0.03) * rig.modes.omega[most] / stretch[most] ** 2
    loss = rig.loss + size * np.outer(stretch, stretch)
    zeta = np.diag(loss) / (2 * rig.modes.omega)
    return replace(rig, loss=loss, modes=replace(rig.modes, zeta=zeta), name=f"{rig.name}, dashpot")


def _along(driven: OnBase, axes: tuple[str, ...], base: tuple[str, ...]) -> OnBase:
    """The structure on a base that moves along some of its axes."""
    at = [axes.index(axis) for axis in base]
    mass = driven.rigid_body_mass[np.ix_(at, at)]
    return replace(driven, load=driven.load[:, at], rigid=driven.rigid[:, at], rigid_body_mass=mass)


def _drawn(
    rng: np.random.Generator, driven: OnBase, base: tuple[str, ...], candidates: list[Candidate],
    first: tuple[float, float], most: int, *, of_all: bool = False, least: float = LEAST, longest: float = 30.0,
    moved: tuple[str, ...] = (),
) -> Rig | None:  # fmt: skip
    """The rig with three to `most` modes in the lines, all of which the base moves; None where there is none."""
    omega, shapes = driven.modes()
    omega = omega * 2 * np.pi * float(log_uniform(rng, first)) / omega[0]
    load = shapes.T @ driven.load
    seen = [base.index(axis) for axis in moved or base]
    weights = np.max((load**2 / np.diag(driven.rigid_body_mass))[:, seen], axis=1)
    room = [
        m for m in range(3, most + 1)
        if omega[m] > APART * omega[m - 1] and omega[m - 1] < longest * omega[0] and np.min(weights[:m]) > least
    ]  # fmt: skip
    if not room:
        return None
    count = room[-1] if of_all else int(rng.choice(room))
    sensors = candidates if of_all else chosen(rng, candidates, round(count * rng.uniform(1.0, 2.0)))
    rows = np.array([driven.row(*sensor) for sensor in sensors])
    if len(sensors) < count or np.linalg.cond(rows @ shapes[:, :count]) > 50:
        return None  # which no sensors tell apart
    kept = omega < REACH * omega[count]
    modes = Modes(
        omega[kept], log_uniform(rng, RATIOS, int(kept.sum())), load[kept], rows @ shapes[:, kept], rows @ driven.rigid,
        driven.rigid_body_mass,
    )  # fmt: skip
    places = tuple(_place(axis, row, base) for (_, axis, _), row in zip(sensors, modes.rigid_body, strict=True))
    name = f"{count} modes, {len(sensors)} sensors"
    return Rig(name, base, modes, places, count, np.diag(2 * modes.zeta * modes.omega))


def _place(axis: str, row: np.ndarray, base: tuple[str, ...]) -> Place:
    """Axis and position of a sensor; of a position only what its motion with the base tells."""
    turned = row[base.index("ry")] if "ry" in base else 0.0
    return axis, ((0.0, 0.0, float(turned)) if axis == "x" else (-float(turned), 0.0, 0.0))
