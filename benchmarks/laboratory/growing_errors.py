"""Errors that grow with the signal: modes, intervals and judgement of stepped sines, and what white noise pays for it.

A stepped sine is read to 0.4 % of each channel at each line, base and force too, gains are off by 0.5 % within a stated
tolerance: one level, two levels, and a frame with a dashpot. Errors are over the deviations that the answer states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import sysid
from benchmarks.laboratory.stepped_tests import KINDS, spoiled
from benchmarks.line import Line, above, below
from sysid.finding import Severity
from sysid.measurement.whole import SteadyLines
from sysid.modal_analysis.fit import fit_modes, whole_fit


@dataclass(frozen=True)
class Draw:
    """One answer: whether its modes are as many as there are, errors over deviations, the word, channels accused."""

    right: bool
    modes: np.ndarray
    matrices: np.ndarray
    word: str
    accused: int


def draw(kind: str, seed: int) -> Draw:
    """Identify one test."""
    truth, test = spoiled(kind, seed)
    answer = sysid.identify(sysid.Problem(test), rng=0)
    s, sd, n = answer.structure, answer.uncertainty, len(truth.mass)
    accused = sum(
        f.channel is not None and f.severity in (Severity.BLOCKING, Severity.CONTRADICTS) for f in answer.findings
    )
    none = np.zeros(0)
    if s.natural_frequencies.size != n or sd is None:
        return Draw(False, none, none, answer.judgement, accused)
    frequency, ratio = truth.poles
    modes = np.concatenate([
        (s.natural_frequencies - frequency) / sd.natural_frequencies, (s.damping_ratios - ratio) / sd.damping_ratios
    ])  # fmt: skip
    matrices = none
    if answer.judgement == "determined":
        upper = np.triu_indices(n)
        pairs = (s.mass, truth.mass, sd.mass), (s.stiffness, truth.stiffness, sd.stiffness)
        matrices = np.concatenate([((a[:n, :n] - b) / std[:n, :n])[upper] for a, b, std in pairs])
    return Draw(True, modes, matrices, answer.judgement, accused)


def price(seeds: range) -> tuple[int, float]:
    """Tests with white noise that are taken for others, and errors with shares fitted to all over those without.

    Root mean squares of errors of frequencies and ratios, each by what its deviation is without shares.
    """
    taken, errors = 0, []
    for seed in seeds:
        truth, test = spoiled("white", seed)
        taken += fit_modes(test).shares is not None
        plain = sysid.identify(sysid.Problem(test), rng=0)
        modes = whole_fit(replace(test, whole=SteadyLines.of(test.n_runs, test.freq))).parameters.modes
        at = np.argsort(modes.omega)
        shared = np.concatenate([modes.omega[at] / (2 * np.pi), modes.ratios[at]])
        without = np.concatenate([plain.structure.natural_frequencies, plain.structure.damping_ratios])
        right = np.concatenate(truth.poles)
        if shared.size != right.size or plain.uncertainty is None:
            return taken, np.inf
        std = np.concatenate([plain.uncertainty.natural_frequencies, plain.uncertainty.damping_ratios])
        errors.append(np.array([(one - right) / std for one in (shared, without)]))
    both = np.sqrt(np.mean(np.concatenate(errors, axis=1) ** 2, axis=1))
    return taken, float(both[0] / both[1])


def lines(reduced: bool) -> Iterator[Line]:
    """Measure 20 draws of each kind; one in the reduced form, too few for a root mean square."""
    seeds = range(1 if reduced else 20)
    for kind in KINDS:
        draws = [draw(kind, seed) for seed in seeds]
        yield above(f"{kind}: draws with as many modes as there are", np.mean([one.right for one in draws]), 0.95)
        errors = np.abs(np.concatenate([one.modes for one in draws]))
        yield above(f"{kind}: f and zeta within 4 deviations", np.mean(errors < 4), 0.99)
        if not reduced:
            rms = float(np.sqrt(np.mean(errors**2)))
            yield Line(f"{kind}: rms of errors over deviations", f"{rms:.2f}", "0.8 to 1.3", 0.8 <= rms <= 1.3)
        if kind != "white":  # with 1 % of the force's rms the lightest modes are not weighed
            words = np.mean([one.word == "determined" for one in draws])
            yield above(f"{kind}: draws called determined", words, 0.95)
        matrices = np.abs(np.concatenate([one.matrices for one in draws]))
        yield above(f"{kind}: M and K, where determined, within 5 deviations", np.mean([*(matrices < 5), 1.0]), 0.99)
        yield below(f"{kind}: right channels accused", sum(one.accused for one in draws), 0)
    taken, ratio = price(seeds)
    yield below("white noise taken for errors that grow, tests", taken, 0)
    yield below("errors by white noise with shares fitted all the same, over those without", ratio, 1.03)
