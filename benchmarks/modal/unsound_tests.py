"""Tests that cannot tell what is asked of them, and whether the result says so.

What counts is an `InputError` with a sentence that names the cause, or a result with ``determined`` False and such a
sentence in ``undetermined``. A sound test must draw no such sentence.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

import sysid
from benchmarks.line import Line
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.problem_modules import load_module

NOISE = 0.01


@dataclass(frozen=True)
class Case:
    """One unsound test.

    Attributes
    ----------
    problem : callable
        Gives the `sysid.Problem`.
    cause : str
        Regular expression that the sentence must match.
    in_band : bool
        True where fewer degrees of freedom than sensors are determined all the same, as the answer says.
    """

    problem: Callable[[], sysid.Problem]
    cause: str
    in_band: bool = False


def lines(reduced: bool) -> Iterator[Line]:
    """One line a case; both forms are the same."""
    for name, case in CASES.items():
        said, flagged, figure = outcome(case)
        figure = figure + "".join(f"; {sentence!r}" for sentence in said)
        yield Line(f"negative: {name}", figure, f"says so (/{case.cause}/)", flagged)
    said, flagged, figure = outcome(Case(_sound, "."))
    yield Line(
        "negative: a sound test with base force and 1 % noise draws no such sentence",
        figure + "".join(f"; {sentence!r}" for sentence in said), "determined, nothing said",
        figure == "determined True" and not said,
    )  # fmt: skip


def outcome(case: Case) -> tuple[tuple[str, ...], bool, str]:
    """Sentences about what is wrong, whether one names the cause, and how the run ended."""
    try:
        result = sysid.identify(case.problem(), strategy="modal")
        said: tuple[str, ...] = (*result.undetermined, *result.closed_by) if case.in_band else result.undetermined
    except sysid.InputError as error:
        said = (str(error),)
        return said, _names(said, case.cause), "InputError"
    except Exception as error:  # a crash names no cause
        return (str(error),), False, type(error).__name__
    honest = not result.determined or (case.in_band and result.structure.n < result.structure.n_sensors)
    return said, honest and _names(said, case.cause), f"determined {result.determined}"


def _names(said: tuple[str, ...], cause: str) -> bool:
    return any(re.search(cause, sentence) for sentence in said)


def _test(n: int = 6, d: int = 3, *, count: int | None = None) -> sysid.Measurement:
    """A sound test of a random structure, with base force and noise."""
    truth = random_structure(1, n=n, d=d)
    return sysid.simulate(truth, frequency_lines(truth, count), noise=NOISE, force=True, rng=1)


def _sound() -> sysid.Problem:
    return sysid.Problem(_test(), mass=sysid.FullMass())


def _still_mode() -> sysid.Structure:
    """A structure whose third mode no base motion excites."""
    truth = random_structure(1, n=6, d=2)
    n, G = truth.n, truth.rigid_body
    L = np.linalg.cholesky(truth.mass[:n, :n])
    driven = np.linalg.solve(L, truth.mass[:n, :n] @ G + truth.mass[:n, n:])  # (n, d): a mode orthogonal to it rests
    rng = np.random.default_rng(1)
    shapes = np.linalg.qr(np.hstack([driven, rng.standard_normal((n, n - 2))]))[0]
    still = shapes[:, -1:]
    others = np.linalg.qr(np.hstack([still, rng.standard_normal((n, n - 1))]))[0][:, 1:]
    half = L @ np.insert(others, 2, still[:, 0], axis=1)
    K = (half * (2 * np.pi * truth.natural_frequencies) ** 2) @ half.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return sysid.Structure(truth.mass, (full + full.T) / 2, truth.damping_ratios, n_base=2)


def _invisible(*, stated: bool) -> sysid.Problem:
    truth = _still_mode()
    test = sysid.simulate(truth, frequency_lines(truth), noise=NOISE, force=True, rng=1)
    given = truth.natural_frequencies if stated else None
    return sysid.Problem(test, mass=sysid.FullMass(), stiffness=sysid.SpectralStiffness(given))


def _one_run() -> sysid.Problem:
    unit = _test()
    assert unit.force is not None
    direction = np.array([0.8, 0.5, 0.33])
    base, response, force = (
        np.einsum("d,dif->if", direction, record)[None] for record in (unit.base, unit.response, unit.force)
    )
    test = sysid.Measurement(unit.freq, base, response, rigid_body=unit.rigid_body, force=force)
    return sysid.Problem(test, mass=sysid.FullMass())


def _wrong_force(factor: float, *, stated: bool) -> sysid.Problem:
    """Base force times `factor`; the total may be stated."""
    test = _test()
    assert test.force is not None and test.force_std is not None
    wrong = replace(test, force=factor * test.force, force_std=abs(factor) * test.force_std)
    total = np.diag(random_structure(1, n=6, d=3).rigid_body_mass) if stated else None
    return sysid.Problem(wrong, mass=sysid.FullMass(total, healing="rigid_body"))


def _few_lines(*, stated: bool) -> sysid.Problem:
    """Eight sensors, one direction, four lines: 64 numbers for 80 unknowns of the modal model."""
    truth = random_structure(1, n=8, d=1)
    test = sysid.simulate(truth, frequency_lines(truth, 4), force=True)
    given = truth.natural_frequencies if stated else None
    return sysid.Problem(test, mass=sysid.FullMass(), stiffness=sysid.SpectralStiffness(given))


def _twins() -> sysid.Problem:
    """The last sensor records what the first does, with noise of its own."""
    truth = random_structure(1, n=6, d=3)
    freq = frequency_lines(truth)
    clean, noisy = (sysid.simulate(truth, freq, noise=level, force=True, rng=1) for level in (0.0, NOISE))
    response, G = noisy.response.copy(), noisy.rigid_body.copy()
    response[:, -1] = clean.response[:, 0] + (noisy.response[:, -1] - clean.response[:, -1])
    G[-1] = G[0]
    return sysid.Problem(replace(noisy, response=response, rigid_body=G), mass=sysid.FullMass())


def _no_mode(noise: float) -> sysid.Problem:
    truth = random_structure(1, n=6, d=3)
    freq = np.linspace(0.05, 0.3, 360) * truth.natural_frequencies[0]
    return sysid.Problem(sysid.simulate(truth, freq, noise=noise, force=True, rng=1), mass=sysid.FullMass())


def _dashpot(noise: float) -> sysid.Problem:
    """The three-storey building with a dashpot of 40 N s/m between its second and third floor."""
    building = load_module("shear_building").building()
    across = np.array([0.0, -1.0, 1.0])
    truth = sysid.Structure(
        building.mass, building.stiffness, n_base=1, damping_matrix=building.damping + 40.0 * np.outer(across, across)
    )
    test = sysid.simulate(truth, np.linspace(0.2, 6.0, 300), noise=noise, force=True, rng=1)
    return sysid.Problem(replace(test, force=None, force_std=None), mass=sysid.FullMass())


_STILL = r"not moved|modes? stands? out .*for \d+ sensors|cannot excite|fewer modes|do(es)? not stand out"
_UNIT = r"weighs|\bunits?\b|rigid-body"
CASES = {
    "a mode that the base cannot excite": Case(lambda: _invisible(stated=False), "does not excite", in_band=True),
    "a mode that the base cannot excite, its frequency stated": Case(lambda: _invisible(stated=True), _STILL),
    "one run in one fixed direction as a test in three": Case(_one_run, r"independent|(one|fixed|only \d.*) direction"),
    "base force with the wrong sign": Case(lambda: _wrong_force(-1.0, stated=False), r"\bsign\b"),
    "base force with the wrong sign, total stated": Case(lambda: _wrong_force(-1.0, stated=True), r"\bsign\b|" + _UNIT),
    "kN called N, total stated": Case(lambda: _wrong_force(1e-3, stated=True), _UNIT),
    "N called kN, total stated": Case(lambda: _wrong_force(1e3, stated=True), _UNIT),
    "lbf called N, total stated": Case(lambda: _wrong_force(1 / 4.448222, stated=True), _UNIT),
    "N called lbf, total stated": Case(lambda: _wrong_force(4.448222, stated=True), _UNIT),
    "fewer lines than unknowns": Case(lambda: _few_lines(stated=False), r"too few|fewer lines|unknowns"),
    "fewer lines than unknowns, frequencies stated": Case(
        lambda: _few_lines(stated=True), r"too few|fewer lines|unknowns"
    ),
    "two sensors that are one": Case(
        _twins, r"sensors?\b.*\b(same|one|alike|identical|copy|twice|equal|apart|dependent)\b"
    ),
    "a band without a mode, 1 % noise": Case(lambda: _no_mode(NOISE), r"no mode|outside the|\bband\b"),
    "a band without a mode, no noise": Case(lambda: _no_mode(0.0), r"no mode|outside the|\bband\b"),
    "a dashpot between two floors, 1 % noise": Case(lambda: _dashpot(NOISE), r"classical|dashpot|damper"),
    "a dashpot between two floors, no noise": Case(lambda: _dashpot(0.0), r"classical|dashpot|damper"),
}
