"""One continuous structure identified from its test, beside the truth and the Cramér-Rao bound.

``python -m benchmarks.band.one_structure NUMBER SECONDS`` prints the figures as JSON, unless it takes more of a
processor's time.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np

import sysid
from benchmarks.band.cramer_rao import Bound, bound, in_band
from benchmarks.band.own_process import answer
from benchmarks.band.simulated_tests import Draw, draw, transfer
from benchmarks.band.structures import Continuous, structure
from benchmarks.mistakes.named_mistakes import MISTAKES
from benchmarks.records.coupled_records import NEAR, matched

LEVEL = 0.95
OF_MASS = {"stated mass", "stated masses", "force misfit"}
SYMMETRIC = ("effective_masses", "mass", "stiffness")


@dataclass(frozen=True)
class Figures:
    """Outcome of one test.

    Attributes
    ----------
    determined : bool
    open : str
        What first speaks against it or leaves it open.
    found : int
        Modes in the lines; `matched` of them are modes of the structure.
    accused : list of str
        Sentences that accuse a right record.
    ratios : dict of str to list of float
        Errors in the band over their bounds.
    held : dict of str to list of bool
        Which 95 % intervals hold the truth.
    drive : float
        Distance of absolute accelerations and forces for unit base motion, over their norm in the lines: the larger.
    seconds : float
        Of processor time.
    """

    determined: bool
    open: str
    found: int
    matched: int
    accused: list[str]
    ratios: dict[str, list[float]]
    held: dict[str, list[bool]]
    drive: float
    seconds: float


def compared(truth: Continuous, test: Draw, least: Bound) -> Figures:
    """Identify from the records alone, and compare."""
    start = time.process_time()
    result = sysid.identify(sysid.Problem(test.measurement, mass=sysid.FullMass()), rng=0)
    seconds = time.process_time() - start
    found = result.structure
    inside = np.flatnonzero(found.natural_frequencies <= truth.lines[1])
    f = least.values["natural_frequencies"]
    half_width = least.values["damping_ratios"] * f
    near = np.maximum(NEAR[0] * least.std["natural_frequencies"], NEAR[1] * half_width)
    pairs = matched(f, found.natural_frequencies[inside], near)
    first = next(
        (f"{it.kind}: {it.sentence}" for it in result.findings if it.severity in ("contradicts", "caution")), ""
    )
    all_there = len(pairs) == len(inside) == truth.count
    mine = inside[[j for _, j in pairs]] if all_there else inside[:0]
    return Figures(
        result.determined, first, len(inside), len(pairs), accusations(result),
        _ratios(found, least, mine) if all_there else {}, intervals_held(result, least, mine) if all_there else {},
        _drive(found, truth, test), seconds,
    )  # fmt: skip


def accusations(result: sysid.Identification) -> list[str]:
    """Sentences that accuse a record, or a mass that is stated."""
    kinds = MISTAKES | OF_MASS
    accused = [it for it in result.contradictions if it.channel is not None or it.kind in kinds]
    return [f"{it.kind}: {it.sentence}" for it in accused]


def _ratios(found: sysid.Structure, least: Bound, mine: np.ndarray) -> dict[str, list[float]]:
    """Errors over bounds; `mine` are the modes in the lines."""
    values = in_band(
        2 * np.pi * found.natural_frequencies[mine], found.damping_ratios[mine], found.participation[mine],
        found.mode_shapes[np.ix_(least.dofs, mine)] * _signs(found, least, mine),
    )  # fmt: skip
    return {
        name: (_once(name, values[name] - least.values[name]) / _once(name, std)).tolist()
        for name, std in least.std.items()
    }


def intervals_held(result: sysid.Identification, least: Bound, mine: np.ndarray) -> dict[str, list[bool]]:
    """Flags of the intervals of what belongs to modes, those that are told."""
    held = {}
    for name in ("natural_frequencies", "damping_ratios", "effective_masses", "mode_shapes"):
        ends = result.uncertainty.interval(name, level=LEVEL)
        if name == "mode_shapes":
            ends = np.sort(ends[:, least.dofs][..., mine] * _signs(result.structure, least, mine), axis=0).swapaxes(
                1, 2
            )
        else:
            ends = ends[:, mine]
        low, high = (_once(name, end) for end in ends)
        exact, told = _once(name, least.values[name]), np.isfinite(low)
        held[name] = ((low <= exact) & (exact <= high))[told].tolist()
    return held


def _signs(found: sysid.Structure, least: Bound, mine: np.ndarray) -> np.ndarray:
    """Signs of the shapes, (m,), by which they are nearer to the true ones."""
    return np.sign(np.sum(found.mode_shapes[np.ix_(least.dofs, mine)] * least.values["mode_shapes"].T, axis=0))


def _once(name: str, values: np.ndarray) -> np.ndarray:
    """Values of modes as they are, of symmetric matrices each entry once."""
    return (values[..., *np.tril_indices(values.shape[-1])] if name in SYMMETRIC else values).ravel()


def _drive(found: sysid.Structure, truth: Continuous, test: Draw) -> float:
    freq = test.omega / (2 * np.pi)
    H, Z = transfer(truth.modes, test.omega)
    mine = found.relative_acceleration(freq) + truth.modes.rigid_body[..., None]
    pairs = ((mine, H), (found.base_force(freq), Z))
    return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)


def case(number: int) -> dict:
    """Figures of one structure."""
    truth = structure(number)
    test = draw(truth)
    return asdict(compared(truth, test, bound(truth, test)))


if __name__ == "__main__":
    answer(case)
