"""A sensor on a soft bracket, which redundancy tells: a diagonal mass that is stated, or sensors to spare on a part.

The bracket is one more degree of freedom of the structure, a small mass on a spring. Structures are masses and springs,
all modes in the lines, and those of `benchmarks.band`, with modes above the lines and four sensors on one rigid part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg

import sysid
from benchmarks.band.finite_elements import OnBase
from benchmarks.band.simulated_tests import draw
from benchmarks.band.structures import (
    APART,
    END,
    NOISE,
    RATIOS,
    RECORDS,
    SPECTRA,
    START,
    Continuous,
    beam,
    frame,
    log_uniform,
    plate,
)
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread
from benchmarks.records.simulated import Modes

TIMES = (2.0, 5.0)  # the top mode in the lines: frequency of the bracket
LIGHT = 1e-4  # of the structure's mass: that of the sensor on its bracket
DAMPING = (0.003, 0.03)
MOVED = 5.0  # deviations of M, by which a bracket must move it to be asked for
STRUCTURES = tuple(range(100))
QUICK = (0, 1, 3, 16)  # which take a second each
NAMED = 0.9
SHOWN = 0.003  # of the rigid-body mass, that each mode of masses and springs moves at least
MODES = (3, 6)
LONGEST = {beam: 40.0, frame: 12.0, plate: 12.0}  # first mode above the lines over the first mode, at most
GAIN = 1.03
CASES = ("clean", "soft", "gain", "model")
KIND = "soft bracket"


@dataclass(frozen=True, eq=False)
class Mounted:
    """A structure with one sensor stiffly mounted, on its bracket, and what is stated of it.

    `other` is like it, but not as stated: its mass is not diagonal, or a sensor of the part is elsewhere. `dofs` are
    the sensors of M; none where they are all.
    """

    name: str
    clean: Continuous
    soft: Continuous
    other: Continuous
    sensor: int
    sensors: tuple[sysid.Sensor, ...]
    dofs: tuple[int, ...]


@dataclass(frozen=True)
class Found:
    """What came of a test: the sensors that are told to be on a soft bracket, M and its deviations."""

    name: str
    case: str
    right: str
    told: list[str]
    mass: np.ndarray
    std: np.ndarray
    said: str


def lines(reduced: bool) -> Iterator[Line]:
    """A hundred structures, each with a stiff and a soft mounting, and with other errors; or a few."""
    numbers = QUICK if reduced else STRUCTURES
    found, count = spread(one_test, [(case, number) for number in numbers for case in CASES]), len(numbers)
    by_case = {case: [one for one in found if one.case == case] for case in CASES}
    asked = [(soft, moved) for soft, moved in zip(by_case["soft"], _moved(by_case), strict=True) if moved > MOVED]
    missed = [f"{soft.name}, M by {moved:.2g}: {soft.said[:80]}" for soft, moved in asked if soft.told != [soft.right]]
    what = f"{count} brackets of {TIMES[0]:g}-{TIMES[1]:g} times the top mode"
    text = f"{what}, {len(asked)} move M by > {MOVED:g} deviations"
    yield above(f"{text}: named{_examples(missed)}", 1 - len(missed) / max(len(asked), 1), NAMED)
    either = sum(one.told == [""] for one in by_case["soft"])
    wrong = [one.name for one in by_case["soft"] if one.told not in ([], [""], [one.right])]
    yield Line(f"all {count} brackets: told of two or more sensors", f"{either}")
    yield Line(f"all {count} brackets: another sensor named{_examples(wrong)}", f"{len(wrong)}")
    for case, what in (("clean", "stiffly mounted"), ("gain", f"with one gain of {GAIN:g}")):
        told = [f"{one.name}: {one.told}" for one in by_case[case] if one.told]
        yield below(f"{count} tests {what}: a bracket told{_examples(told)}", len(told), 0)
    for masses, what in (
        (False, "with a sensor that is not where it is said to be"),
        (True, "whose mass is not diagonal"),
    ):
        some = [one for one in by_case["model"] if one.name.startswith("masses") == masses]
        told = [f"{one.name}: {one.told}" for one in some if one.told]
        yield Line(f"{len(some)} tests {what}: a bracket told{_examples(told)}", f"{len(told)}")


def _moved(by_case: dict[str, list[Found]]) -> Iterator[float]:
    """Deviations that each bracket moves M by at most; zero where M is not known."""
    for clean, soft in zip(by_case["clean"], by_case["soft"], strict=True):
        if clean.mass.shape != soft.mass.shape or np.isnan(clean.std).any():
            yield 0.0
            continue
        known = clean.std > 0
        yield float(np.max(np.abs(soft.mass - clean.mass)[known] / clean.std[known], initial=0.0))


def one_test(task: tuple[str, int]) -> Found:
    """One test of a case."""
    case, number = task
    its = mounted(number)
    test = draw({"soft": its.soft, "model": its.other}.get(case, its.clean)).measurement
    if case == "gain":
        gain = np.ones((test.n_sensors, 1))
        gain[its.sensor] = GAIN
        std = test.response_std
        test = replace(test, response=gain * test.response, response_std=None if std is None else gain * std)
    test = replace(test, sensors=its.sensors)
    problem = sysid.Problem(test, mass=sysid.FullMass() if its.dofs else sysid.LumpedMass())
    try:
        result = sysid.identify(problem, strategy=sysid.Modal(its.dofs) if its.dofs else "modal", rng=0)
    except sysid.InputError as error:  # of a lumped mass with other modes than sensors
        none = np.zeros((0, 0))
        return Found(its.name, case, test.sensor_names[its.sensor], [], none, none, f"refused: {error}")
    n = result.structure.n
    said = next((f"{one.kind}: {one.sentence}" for one in result.findings if one.severity != "note"), "nothing")
    return Found(
        its.name, case, test.sensor_names[its.sensor],
        [one.channel or "" for one in result.findings if one.kind == KIND],
        result.structure.mass[:n, :n], result.uncertainty.mass, said,
    )  # fmt: skip


@lru_cache(maxsize=1)
def mounted(number: int) -> Mounted:
    """Draw structure `number`: masses and springs, or with a rigid part, in turn."""
    rng = np.random.default_rng((number, 83))
    return (_lumped if number % 2 else _with_part)(rng, number, (SPECTRA, RECORDS)[number // 2 % 2])


def _lumped(rng: np.random.Generator, number: int, kind: str) -> Mounted:
    """Draw masses in a plane that springs join, each to one before it or the base; sensors along the base's axes."""
    while True:
        d, points = int(rng.integers(1, 3)), int(rng.integers(3, 6))
        points = points if d == 1 else 2 + points % 2
        n = d * points
        mass = np.repeat(rng.uniform(1.0, 8.0, points), d)
        K = np.zeros((n, n))
        pairs = [(i, int(rng.integers(-1, i))) for i in range(points) for _ in range(d)]
        pairs += [(int(i), int(j)) for i, j in (rng.choice(points, 2, replace=False) for _ in range(points // 2))]
        for i, j in pairs:
            angle = rng.uniform(0, np.pi)
            along = np.array([1.0]) if d == 1 else np.array([np.cos(angle), np.sin(angle)])
            strain = np.zeros(n)
            strain[d * i : d * (i + 1)] = along
            if j >= 0:
                strain[d * j : d * (j + 1)] -= along
            K += rng.uniform(1e5, 6e5) * np.outer(strain, strain)
        rigid = np.tile(np.eye(d), (points, 1))
        M = np.diag(mass)
        freedoms = tuple((i // d, "xy"[i % d]) for i in range(n))
        driven = OnBase(M, K, M @ rigid, rigid, rigid.T @ M @ rigid, freedoms)
        if np.linalg.eigvalsh(K)[0] < 1e-3 * np.linalg.eigvalsh(K)[-1]:
            continue
        omega, shapes = driven.modes()
        share = np.max((shapes.T @ driven.load) ** 2 / np.diag(driven.rigid_body_mass), axis=1)
        if share.min() > SHOWN and np.all(omega[1:] > 1.05 * omega[:-1]):
            break
    coupling = 0.1 * np.diag(np.sqrt(mass[:-d] * mass[d:]), d)
    coupled = M + coupling + coupling.T
    other = replace(driven, mass=coupled, load=coupled @ rigid, rigid_body_mass=rigid.T @ coupled @ rigid)
    base = ("x", "y")[:d]
    sensors = tuple(sysid.Sensor(f"{node + 1}{axis}", (0.0, 0.0, float(node)), axis) for node, axis in freedoms)
    sensor = int(rng.integers(n))
    return _tested(rng, f"masses {number}", kind, base, n, (driven, other), (np.eye(n),) * 2, sensor, sensors, ())


def _with_part(rng: np.random.Generator, number: int, kind: str) -> Mounted:
    """Draw a beam, frame or plate with a rigid part at one of its nodes: four sensors on it, where three would do."""
    of = (beam, frame, plate)[number // 2 % 3]
    while True:
        driven, base, candidates = of(rng, int(rng.integers(1, 3)))
        omega, shapes = driven.modes()
        weights = np.max((shapes.T @ driven.load) ** 2 / np.diag(driven.rigid_body_mass), axis=1)
        room = [
            m for m in range(MODES[0], MODES[1] + 1)
            if APART * omega[m - 1] < omega[m] < LONGEST[of] * omega[0] and weights[:m].min() > SHOWN
        ]  # fmt: skip
        if not room:
            continue
        count = int(rng.choice(room))
        node = candidates[int(rng.integers(len(candidates)))][0]
        axes = "zzzz" if of is plate else "xxzz"
        reach = np.array([0.15, 0.15, 0.0]) if of is plate else np.array([0.15, 0.0, 0.15])
        places = rng.uniform(-1, 1, (4, 3)) * reach
        rows = np.array([driven.row(node, axis, place) for axis, place in zip(axes, places, strict=True)])
        spare = scipy.linalg.null_space(rows.T)
        if spare.shape[1] == 1 and np.abs(spare).min() > 0.25:
            break
    others = [candidates[int(i)] for i in rng.choice(len(candidates), count, replace=False)]
    everywhere = [(node, axis, place) for axis, place in zip(axes, places, strict=True)] + others
    sensor = int(rng.integers(4))
    rows = np.array([driven.row(*one) for one in everywhere])
    moved = list(everywhere)
    far = (sensor + 1) % 4
    moved[far] = (node, axes[far], places[far] + 0.05 * np.sign(reach))
    wrong = np.array([driven.row(*one) for one in moved])
    sensors = tuple(
        sysid.Sensor(f"s{i + 1}", tuple(np.asarray(place, float).tolist()) if i < 4 else (9.0, 9.0, float(i)), axis,
                     part="block" if i < 4 else "")
        for i, (_, axis, place) in enumerate(everywhere)
    )  # fmt: skip
    phi = rows @ shapes[:, :count]
    left = phi - np.outer(phi @ phi[sensor], phi[sensor]) / (phi[sensor] @ phi[sensor])  # beside the one on the bracket
    chosen = scipy.linalg.qr(left.T, mode="r", pivoting=True)[1]
    dofs = (sensor, *[int(i) for i in chosen if i != sensor][: count - 1])
    name = f"{of.__name__} {number}"
    return _tested(rng, name, kind, base, count, (driven, driven), (rows, wrong), sensor, sensors, dofs)


def _tested(
    rng: np.random.Generator, name: str, kind: str, base: tuple[str, ...], count: int,
    structures: tuple[OnBase, OnBase], rows: tuple[np.ndarray, np.ndarray], sensor: int,
    sensors: tuple[sysid.Sensor, ...], dofs: tuple[int, ...],
) -> Mounted:  # fmt: skip
    """The test of `count` modes of a structure, stiffly and softly mounted, and of one that is not as stated."""
    driven, other = structures
    omega = driven.modes()[0]
    ratios = log_uniform(rng, RATIOS, omega.size + 1)
    times, noise = float(rng.uniform(*TIMES)), float(log_uniform(rng, NOISE))
    top = omega[count - 1]
    last = top + rng.uniform(*END) * (omega[count] - top) if omega.size > count else 1.25 * top
    ends = (float(omega[0] * rng.uniform(*START) / (2 * np.pi)), float(last / (2 * np.pi)))
    soft, soft_rows = on_bracket(driven, rows[0], sensor, times * top)

    def test(of: OnBase, at: np.ndarray) -> Continuous:
        w, shapes = of.modes()
        modes = Modes(w, ratios[: w.size], shapes.T @ of.load, at @ shapes, at @ of.rigid, of.rigid_body_mass)
        return Continuous(name, kind, base, modes, count, ends, noise)

    name += f": d = {len(base)}, {count} modes, {len(sensors)} sensors, noise {noise:.2g}, {times:.2g} times, {kind}"
    right = replace(test(other, rows[1]), noise=noise)
    right = replace(right, modes=replace(right.modes, rigid_body=rows[0] @ driven.rigid))  # as stated
    return Mounted(name, test(driven, rows[0]), test(soft, soft_rows), right, sensor, sensors, dofs)


def on_bracket(driven: OnBase, rows: np.ndarray, sensor: int, omega: float) -> tuple[OnBase, np.ndarray]:
    """The structure with one more degree of freedom, its sensor on a spring, rad/s, and the rows of all sensors."""
    n, place = len(driven.mass), rows[sensor]
    mass = LIGHT * float(driven.rigid_body_mass[0, 0])
    M, K = np.zeros((2, n + 1, n + 1))
    M[:n, :n], M[n, n] = driven.mass, mass
    K[:n, :n] = driven.stiffness
    strain = np.append(-place, 1.0)
    K += mass * omega**2 * np.outer(strain, strain)
    moves = place @ driven.rigid
    at = np.hstack([rows, np.zeros((len(rows), 1))])
    at[sensor] = np.append(np.zeros(n), 1.0)
    return OnBase(
        M, K, np.vstack([driven.load, mass * moves]), np.vstack([driven.rigid, moves]),
        driven.rigid_body_mass + mass * np.outer(moves, moves), (*driven.freedoms, (-1, "bracket")),
    ), at  # fmt: skip


def _examples(texts: list[str], most: int = 4) -> str:
    return f" ({'; '.join(texts[:most])})" if texts else ""
