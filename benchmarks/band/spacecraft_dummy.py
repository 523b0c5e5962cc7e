r"""Spacecraft dummies on a base that moves in six directions, with modes beyond the 200 Hz of their tests.

A central tube with a ring at its foot carries a tank, a deck with equipment at its corners, an antenna on a mast and
two stubs of solar arrays. Fourteen accelerometers, one run a base direction, forces and moments of the base, 1 % noise.
An engineer of coupled loads takes base drive, mass, centre of gravity and inertia from the answer, by

.. math:: M_{rb} = \begin{bmatrix} m I & -m [c]_\times \\ m [c]_\times & I_0 \end{bmatrix}, \qquad
    I_c = I_0 + m [c]_\times [c]_\times

``python -m benchmarks.band.spacecraft_dummy NUMBER SECONDS`` prints the figures of one.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np

import sysid
from benchmarks.band.finite_elements import AXES, Material, Model, OnBase, Section
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.simulated_tests import draw, transfer
from benchmarks.band.structures import AT_NODE, REACH, SPECTRA, Candidate, Continuous
from benchmarks.line import Line, below
from benchmarks.records.simulated import Modes

DUMMIES, PATIENCE = range(5), 600  # s of processor time each
SHORT, SHORT_PATIENCE = (303,), 120
LESS = 100  # the dummy of a number above is that of its last two digits, tested to a half, third, ... of the last line
BAND = (5.0, 200.0)  # Hz
NOISE, RATIOS = 0.01, (0.008, 0.02)
LINES = 2000  # where base drives are compared
DRIVE, RIGID = 0.01, 0.005

ALUMINIUM = Material(70e9, 0.33, 2700.0)
ELEMENTS = 3  # a member
CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


def lines(reduced: bool) -> Iterator[Line]:
    """Five dummies to 200 Hz; or one to 50 Hz."""
    numbers = list(SHORT if reduced else DUMMIES)
    found = figures_of_each("band.spacecraft_dummy", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    high = dummy(numbers[0]).lines[1]
    what = (
        f"{len(found)} spacecraft dummies, 14 sensors, six base directions, to {high:g} Hz, {100 * NOISE:g} % noise: "
    )
    said = [f"{number}: {it['said'][:100]}" for number, it in zip(numbers, found, strict=True) if "said" in it]
    yield below(what + "without a result" + f" ({'; '.join(said)})" * bool(said), len(said), 0)
    found = [it for it in found if "said" not in it]
    if not found:
        return
    for name, text, most in (
        ("accelerations", "base drive, accelerations off the truth's", DRIVE),
        ("forces", "base drive, forces and moments off the truth's", DRIVE),
        ("channel", "base drive, the sensor, force or moment that is most off the truth's", DRIVE),
        ("mass", "mass from M_rb off the truth's, along any axis", RIGID),
        ("centre of gravity", "centre of gravity from M_rb off the truth's, over its height", RIGID),
        ("inertia", "inertia about the base point in M_rb off the truth's, over moments of inertia", RIGID),
    ):
        each = [it[name] for it in found]
        yield below(what + text + f" ({', '.join(f'{value:.2g}' for value in each)})", max(each), most)
    # What mass and centre of gravity take off it leaves a fifth of the inertia, and all of its error.
    each = ", ".join(f"{it['central inertia']:.2g}" for it in found)
    yield Line(what + "inertia about the centre of gravity off the truth's, over moments of inertia", each)
    modes = ", ".join(f"{it['found']} of {it['count']}" for it in found)
    yield Line(what + f"modes found in the lines ({modes}); seconds of processor time, most",
               f"{max(it['seconds'] for it in found):.0f}")  # fmt: skip


@dataclass(frozen=True)
class Figures:
    """Outcome of one test.

    Attributes
    ----------
    found, count : int
        Modes in the lines, and true ones.
    accelerations, forces : float
        Distance from the truth's for unit base motion, over its norm; a rotation is one over the radius of gyration.
    channel : float
        The largest of any accelerometer, force or moment.
    seconds : float
        Of processor time.
    """

    found: int
    count: int
    accelerations: float
    forces: float
    channel: float
    seconds: float


def case(number: int) -> dict:
    """Figures of one dummy."""
    truth = dummy(number)
    test = draw(truth).measurement
    begun = time.process_time()
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    seconds = time.process_time() - begun
    found, freq = result.structure, np.linspace(*truth.lines, LINES)
    right = truth.modes.rigid_body_mass
    scale = np.repeat([1.0, np.sqrt(np.trace(right[:3, :3]) / np.trace(right[3:, 3:]))], 3)[:, None]
    H, Z = (one * scale for one in transfer(truth.modes, 2 * np.pi * freq))
    pairs = (
        (found.transmissibility(freq) * scale, H),
        (found.base_force(freq) * scale * scale[:, None], Z * scale[:, None]),
    )
    figures = Figures(
        int(np.count_nonzero(found.natural_frequencies <= truth.lines[1])), truth.count,
        *(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs),
        max(float(np.linalg.norm(x - y) / np.linalg.norm(y)) for a, b in pairs for x, y in zip(a, b, strict=True)),
        seconds,
    )  # fmt: skip
    return asdict(figures) | rigid_errors(found.rigid_body_mass, right)


def rigid_errors(found: np.ndarray, right: np.ndarray) -> dict[str, float]:
    """Distances of masses, centre of gravity, and inertia about base point and centre, over those of the truth."""
    (masses, place, inertia), (true, centre, about) = properties(found), properties(right)

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.max(np.abs(a - b) / np.sqrt(np.outer(np.diag(b), np.diag(b)))))

    return {
        "mass": float(np.max(np.abs(masses / true - 1))),
        "centre of gravity": float(np.linalg.norm(place - centre) / np.linalg.norm(centre)),
        "inertia": apart(found[3:, 3:], right[3:, 3:]),
        "central inertia": apart(inertia, about),
    }


def properties(rigid_body_mass: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses along x, y, z, kg, centre of gravity, m, and inertia about it, kg m², from the base point."""
    masses, coupling = np.diag(rigid_body_mass)[:3], rigid_body_mass[3:, :3]
    m = masses.mean()
    across = (coupling - coupling.T) / (2 * m)  # [c] with its antisymmetry
    centre = np.array([across[2, 1], across[0, 2], across[1, 0]])
    return masses, centre, rigid_body_mass[3:, 3:] + m * across @ across


def dummy(number: int) -> Continuous:
    """Spacecraft dummy `number`, always the same: dimensions and masses are drawn about those of a small spacecraft."""
    times, number = divmod(number, LESS)
    rng = np.random.default_rng((number, 14))
    driven, sensors = spacecraft(rng)
    omega, shapes = driven.modes()
    f = omega / (2 * np.pi)
    kept = f < REACH * BAND[1]
    omega, shapes = omega[kept], shapes[:, kept]
    modes = Modes(
        omega, rng.uniform(*RATIOS, omega.size), shapes.T @ driven.load,
        np.vstack([driven.row(*at) for at in sensors]) @ shapes,
        np.vstack([driven.row(*at) for at in sensors]) @ driven.rigid, driven.rigid_body_mass,
    )  # fmt: skip
    lines = BAND[0], BAND[1] / (1 + times)
    return Continuous(f"dummy {number}", SPECTRA, AXES, modes, int(np.count_nonzero(f < lines[1])), lines, NOISE)


def tube(diameter: float, wall: float) -> Section:
    """Thin-walled circular tube of aluminium, m."""
    second = np.pi * diameter**3 * wall / 8
    return Section(ALUMINIUM, np.pi * diameter * wall, second, second, 2 * second)


def spacecraft(rng: np.random.Generator) -> tuple[OnBase, list[Candidate]]:
    """Draw a spacecraft, and where its fourteen accelerometers are."""

    def about(value: float) -> float:
        return float(value * rng.uniform(0.85, 1.15))

    middle, high, half = about(0.7), about(1.2), about(0.45)
    places = [(0, 0, 0), (0, 0, middle), (0, 0, high)]
    places += [(half * x, half * y, high) for x, y in CORNERS]
    places += [(about(0.3), about(0.1), high + about(0.5)), (about(0.05), half + about(0.4), high),
               (-about(0.05), -half - about(0.4), high)]  # fmt: skip
    body, deck, rim = tube(0.5, 1.5e-3), tube(0.14, 2e-3), tube(0.07, 1.5e-3)
    mast, arm = tube(0.07, 2e-3), tube(0.06, 2e-3)
    members = [(0, 1, body), (1, 2, body)]
    members += [(2, 3 + i, deck) for i in range(4)]
    members += [(3 + i, 3 + (i + 1) % 4, rim) for i in range(4)]
    members += [(2, 7, mast), (3, 8, arm), (4, 8, arm), (5, 9, arm), (6, 9, arm)]
    model = _meshed(places, members)
    for node, mass, arms in (  # kg, radii of gyration, m
        (0, 10.0, 0.3), (1, 90.0, 0.3), (2, 40.0, 0.25), (3, 5.0, 0.06), (4, 6.0, 0.06), (5, 4.0, 0.06), (6, 7.0, 0.06),
        (7, 5.0, 0.2), (8, 4.0, 0.2), (9, 4.0, 0.2),
    ):  # fmt: skip
        kg = about(mass)
        model.rigid_mass(node, kg, kg * rng.uniform(0.7, 1.3, 3) * arms**2, rng.uniform(-0.1, 0.1, 3) * arms)
    at = [(1, "x"), (1, "y"), (1, "z"), (2, "x"), (2, "y"), (3, "z"), (4, "x"), (5, "y"), (5, "z"), (7, "x"), (7, "y")]
    at += [(7, "z"), (8, "z"), (9, "x")]
    return model.on_base(AXES, clamped=[0]), [(node, axis, AT_NODE) for node, axis in at]


def _meshed(places: Sequence[Sequence[float]], members: Sequence[tuple[int, int, Section]]) -> Model:
    """Beams between places, each of `ELEMENTS` elements whose nodes come after the places."""
    ends = np.asarray(places, dtype=float)
    inner = [np.linspace(ends[a], ends[b], ELEMENTS + 1)[1:-1] for a, b, _ in members]
    model = Model(np.vstack([ends, *inner]))
    for i, (a, b, section) in enumerate(members):
        first = len(ends) + (ELEMENTS - 1) * i
        up = (0, 1, 0) if np.allclose(ends[a, :2], ends[b, :2]) else (0, 0, 1)
        for one, other in pairwise([a, *range(first, first + ELEMENTS - 1), b]):
            model.beam(one, other, section, up)
    return model


if __name__ == "__main__":
    answer(case)
