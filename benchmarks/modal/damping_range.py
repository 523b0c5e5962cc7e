"""Lumped and chain structures with little, usual, much and mixed damping: what is left, and what is said of it.

Matrices and responses are put together here: eq. 13 of Cerini et al. (2024) is solved line by line, and the package's
simulator has no part in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.modal.spread import spread

RANGES = {"0.05-0.4 %": (5e-4, 4e-3), "0.5-5 %": (5e-3, 0.05), "5-25 %": (0.05, 0.25), "mixed": (5e-4, 0.25)}
USUAL = 0.01  # damping ratio of all modes of the test that each is compared with
DRAWS = 15  # of each range, with and without force
SAME_JUDGEMENT, NEAR = 118 / 120, 1.05
NOISE = 0.01  # of the rms over the channels of a record, at each line
LUMPED, CHAIN = (5, 3), (4, 2)  # most floors, with one base direction and with two
GRID, ABOUT = 24, 20  # lines: a mode over the whole band, and about each mode, within its peak
MASS, SPRING, SPREAD = 1000.0, 2e6, 2.0  # kg, N/m: nominal, and the factor either way
BRACE = 0.02  # of a spring: stiffness of what couples all floors
LEAST = 0.01  # of the mass of a direction, that each mode carries
ACCUSES = {  # kinds of findings about mass, form, damping, force and sensors
    "stated mass", "stated masses", "lumped total", "known entries", "damping", "misfit", "force misfit",
    "beyond noise", "rigid motion", "one motion", "positions", "sign", "gain", "unit", "force sign", "force unit",
    "swapped sensors",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A structure and its test: range of the damping, draw, and whether the base force is measured."""

    damping: str
    draw: int
    force: bool

    @property
    def chain(self) -> bool:
        """True where the stiffness is stated to be a chain; else it is free, and the mass lumped alike."""
        return self.draw % 2 == 1


@dataclass(frozen=True, eq=False)
class Matrices:
    """A structure on a rigid base: M_SS and K_SS (n, n), C (n, n) and G (n, d); no mass below the sensors."""

    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    rigid: np.ndarray
    omega: np.ndarray
    ratios: np.ndarray


def lines(reduced: bool) -> Iterator[Line]:
    """All ranges with and without force: residual over the truth's, judgement beside that at 1 %, accusations."""
    draws = 1 if reduced else DRAWS
    cases = [
        Case(name, 7 * reduced * i + draw, force)
        for i, (name, force) in enumerate((name, force) for name in RANGES for force in (False, True))
        for draw in range(draws)
        if not reduced or i % 4 in (0, 3)  # of each range one
    ]
    ends = dict(zip(cases, spread(compared, cases), strict=True))
    for name in RANGES:
        own = [ends[case] for case in cases if case.damping == name]
        worst = max(one[0] for one in own)
        yield below(f"damping {name}, {len(own)} tests: largest residual over that of the truth", worst, NEAR)
    other = {case: end for case, end in ends.items() if end[1] != end[2]}
    told = "; ".join(f"{case}: {end[1]}, at 1 % {end[2]} ({end[3][:150]})" for case, end in [*other.items()][:4])
    text = f"judgement of the same test at 1 % damping, of {len(cases)}" + f" ({told})" * bool(told)
    yield above(text, len(cases) - len(other), np.floor(SAME_JUDGEMENT * len(cases)))
    accused = {case: end[3] for case, end in ends.items() if end[4] & ACCUSES}
    told = "; ".join(f"{case}: {said[:200]}" for case, said in [*accused.items()][:3])
    yield below("mass, form or damping accused" + f" ({told})" * bool(told), len(accused), 0)


def compared(case: Case) -> tuple[float, str, str, str, set[str]]:
    """Residual over the truth's, judgement, that of the same test at 1 % damping, what is said, and its kinds."""
    truth = drawn(case)
    try:
        result, floor = identified(case, truth)
        usual, _ = identified(case, _damped(truth, np.full(len(truth.omega), USUAL)))
    except sysid.SysidError as error:
        return np.inf, "an error", "", str(error), set()
    against = [one for one in result.findings if one.severity != "note"]
    said, kinds = "; ".join(map(str, against)), {one.kind for one in against}
    return result.residual / floor, result.judgement, usual.judgement, said, kinds


def identified(case: Case, truth: Matrices) -> tuple[sysid.Identification, float]:
    """Answer of the package to a test, and the residual that the truth leaves of it."""
    test, floor = measured(case, truth)
    total = truth.rigid.T @ np.diag(truth.mass)
    mass = sysid.LumpedMass(None if case.force else total)
    springs = {"stiffness": sysid.ChainStiffness(SPRING / 30, SPRING * 30)} if case.chain else {}
    return sysid.identify(sysid.Problem(test, mass=mass, **springs), rng=0), floor


def drawn(case: Case) -> Matrices:
    """Masses and springs of one or two chains; where no chain is stated, braces couple floors and directions."""
    rng = np.random.default_rng((case.draw, list(RANGES).index(case.damping), case.force))
    d = 1 + int(rng.integers(2))
    n = d * int(rng.integers(2, 1 + (CHAIN if case.chain else LUMPED)[d - 1]))
    ratios = np.exp(rng.uniform(*np.log(RANGES[case.damping]), n))
    while True:
        truth = _damped(_undamped(rng, n, d, braced=not case.chain), ratios)
        if np.all(_carried(truth).max(axis=1) >= LEAST):
            return truth


def _undamped(rng: np.random.Generator, n: int, d: int, *, braced: bool) -> Matrices:
    masses, springs = (unit * SPREAD ** rng.uniform(-1, 1, n) for unit in (MASS, SPRING))
    strain = np.eye(n) - np.eye(n, k=-d)  # each sensor against the one below in its direction
    K = strain.T @ np.diag(springs) @ strain
    if braced:
        brace = rng.standard_normal((2, n))
        K = K + BRACE * SPRING * brace.T @ brace
    return Matrices(np.diag(masses), K, np.zeros((n, n)), np.eye(d)[np.arange(n) % d], np.zeros(n), np.zeros(n))


def _carried(truth: Matrices) -> np.ndarray:
    """Part of the mass of each base direction that each mode carries, (n, d)."""
    root = np.sqrt(np.diag(truth.mass))
    psi = np.linalg.eigh(truth.stiffness / np.outer(root, root))[1]
    pushed = psi.T @ (root[:, None] * truth.rigid)
    return pushed**2 / (np.diag(truth.mass) @ truth.rigid)


def _damped(truth: Matrices, ratios: np.ndarray) -> Matrices:
    """The same with these damping ratios, in ascending order of frequency: ``C = M Phi diag(2 zeta w) Phi' M``."""
    root = np.sqrt(np.diag(truth.mass))
    lam, psi = np.linalg.eigh(truth.stiffness / np.outer(root, root))
    omega, half = np.sqrt(lam), root[:, None] * psi
    return replace(truth, damping=(half * (2 * ratios * omega)) @ half.T, omega=omega, ratios=ratios)


def lines_of(truth: Matrices) -> np.ndarray:
    """Lines over the band, and more of them about each mode: as a stepped sine takes them, Hz."""
    f = truth.omega / (2 * np.pi)
    about = np.tan(np.linspace(-1.4, 1.4, ABOUT))  # half-power half-widths: up to six of them
    peaks = f[:, None] * (1 + truth.ratios[:, None] * about)
    whole = np.geomspace(0.4 * f[0], 1.6 * f[-1], GRID * len(f))
    every = np.concatenate([whole, peaks.ravel()])
    return np.unique(every[(every >= whole[0]) & (every <= whole[-1])])


def answered(truth: Matrices, freq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Absolute accelerations (d, n, lines) and base force (d, d, lines) for unit motion of each base direction."""
    M, C, K, G = truth.mass, truth.damping, truth.stiffness, truth.rigid
    B = M @ G
    response = np.empty((G.shape[1], len(G), freq.size), dtype=complex)
    force = np.empty((G.shape[1], G.shape[1], freq.size), dtype=complex)
    for at, w in enumerate(2 * np.pi * freq):
        a = np.linalg.solve(-(w**2) * M + 1j * w * C + K, w**2 * B)  # eq. 13
        response[:, :, at] = (a + G).T
        force[:, :, at] = (B.T @ a + G.T @ B).T
    return response, force


def measured(case: Case, truth: Matrices) -> tuple[sysid.Measurement, float]:
    """The test with its noise, and the residual of relative accelerations that the truth leaves."""
    rng = np.random.default_rng((case.draw, len(truth.omega)))
    freq = lines_of(truth)
    response, force = answered(truth, freq)
    noisy, std = zip(*(_noisy(record, rng) for record in (response, force)), strict=True)
    d = force.shape[0]
    base = np.repeat(np.eye(d)[..., None], freq.size, axis=2) + 0j
    given = {"force": noisy[1], "force_std": std[1]} if case.force else {}
    test = sysid.Measurement(freq, base, noisy[0], rigid_body=truth.rigid, response_std=std[0], **given)
    still = truth.rigid.T[..., None]
    return test, float(np.linalg.norm(noisy[0] - response) / np.linalg.norm(noisy[0] - still))


def _noisy(record: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    std = np.broadcast_to(NOISE * np.sqrt(np.mean(np.abs(record) ** 2, axis=(0, 1))), record.shape)
    error = rng.standard_normal(record.shape) + 1j * rng.standard_normal(record.shape)
    return record + std * error / np.sqrt(2), std
