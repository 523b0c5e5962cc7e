"""Second answers, far from the first, that explain the records as well: told where there are, and only there.

In a chain of two known masses whose roof alone is measured, stretches (springs and dampers) k1 and k2 do what
``k2 (m1 + m2) / m2`` and ``k1 m2 / (m1 + m2)`` do: so the truth, and how many answers there are, is known exactly. The
first floor of a chain leaves one answer (Udwadia, Sharma, SIAM J. Appl. Math. 34 (1978) 104-118).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.problem_modules import load_module
from sysid.results import judgement

NOISE = 0.01
DRAWS = range(20)
VALUE = re.compile(r"= ([-+.0-9e]+) in place of")
NEAR = 0.02  # relative, of a told value from the other answer to the one found
SECONDS, LOOK = 10.0, 4.0  # that a user may wait for an answer, and of these for the search for other answers


@dataclass(frozen=True)
class Chain:
    """A chain of known masses.

    Attributes
    ----------
    mass, springs, dampers : (n,)
        kg, N/m, N s/m, from the base up.
    floors : tuple of int
        Those with a sensor.
    """

    mass: np.ndarray
    springs: np.ndarray
    dampers: np.ndarray
    floors: tuple[int, ...]

    def problem(self, rng: int) -> sysid.Problem:
        """Its springs and dampers unknown, within a hundred and a thousand times either way."""
        n, floors = self.mass.size, list(self.floors)
        stretch = (np.eye(n + 1) - np.roll(np.eye(n + 1), 1, axis=0))[:n]
        K, C = (stretch.T @ np.diag(values) @ stretch for values in (self.springs, self.dampers))
        M, recovery = np.diag([*self.mass, 0.0]), np.eye(n)[floors]
        truth = sysid.Structure(
            M, K, damping_matrix=C[:n, :n], n_base=1, recovery=recovery, rigid_body=np.ones((len(floors), 1))
        )
        f = truth.natural_frequencies
        test = sysid.simulate(truth, np.linspace(0.5 * f[0], 1.3 * f[-1], 300), noise=NOISE, rng=rng)
        k = sysid.Variable("spring", n, lower=2e2, upper=2e6, log=True, unit="N/m")
        c = sysid.Variable("damper", n, lower=0.01, upper=1e4, log=True, unit="N s/m")
        return sysid.Problem(
            test, mass=M, stiffness=stretch.T @ ca.diag(k) @ stretch, damping=stretch.T @ ca.diag(c) @ stretch,
            recovery=recovery,
        )  # fmt: skip

    def other(self, x: np.ndarray) -> np.ndarray:
        """The other answer to one of two masses with the roof measured alone: springs, then dampers."""
        ratio = self.mass.sum() / self.mass[1]
        return np.array([x[1] * ratio, x[0] / ratio, x[3] * ratio, x[2] / ratio])


def one_chain(floors: tuple[int, ...]) -> Chain:
    """A chain of two masses."""
    return Chain(np.array([5.0, 4.0]), np.array([2e4, 1.5e4]), np.array([9.0, 6.0]), floors)


def drawn_chain(seed: int, n: int, floors: tuple[int, ...]) -> Chain:
    """A chain by chance; its modes have damping ratios about one percent."""
    rng = np.random.default_rng(seed)
    springs = rng.uniform(1e4, 3e4, n)
    return Chain(rng.uniform(3.0, 8.0, n), springs, springs * rng.uniform(3e-4, 6e-4, n), floors)


def lines(reduced: bool) -> Iterator[Line]:
    """Second answers told, unique answers not accused, and the seconds of the look."""
    draws = DRAWS[:1] if reduced else DRAWS
    yield _exact(draws)
    named: tuple[tuple[str, Callable[[int], Chain]], ...] = (
        ("one chain of two masses", lambda seed: one_chain((1,))),
        ("chains of two masses by chance", lambda seed: drawn_chain(seed, 2, (1,))),
    )
    for name, chain in named:
        told = [_tells(chain(seed), seed) for seed in draws]
        yield above(f"{name}, roof alone: second answers told by their values, of {len(draws)}", sum(told), len(draws))
    unique: tuple[tuple[str, Callable[[int], sysid.Problem]], ...] = (
        ("one chain of two, both floors", lambda seed: one_chain((0, 1)).problem(seed)),
        ("chains of two by chance, first floor", lambda seed: drawn_chain(seed, 2, (0,)).problem(seed)),
        ("chains of three by chance, first floor and roof", lambda seed: drawn_chain(seed, 3, (0, 2)).problem(seed)),
        *((name, _of_module(name)) for name in ("six_springs", "unmeasured_floors", "five_storeys")),
    )
    # A machine that does other things too makes everybody wait: the short form judges seconds of a processor.
    clock = time.process_time if reduced else time.perf_counter
    waits, looks = [0.0], [0.0]
    for name, problem in unique:
        seeds = draws[:1] if reduced else draws
        accused, wait, look = zip(*(_accused(problem(seed), seed, clock) for seed in seeds), strict=True)
        waits.extend(wait)
        looks.extend(look)
        yield below(f"{name}: unique answers accused, of {len(seeds)}", sum(accused), 0)
    of = "s of a processor" if reduced else "s"
    yield below(
        f"longest wait for an answer of these, the search for other answers included, {of}", max(waits), SECONDS
    )
    text, longest = f"longest search for other answers of these, {of}", max(looks)
    if reduced:
        yield Line(text, f"{longest:.3g}")
        words, longest = at_full_speed(longest, fixed_work())
        text = f"the same {words}"
    yield below(text, longest, LOOK)


def _exact(draws: range) -> Line:
    """By how much the transmissibilities of both answers differ."""
    most = 0.0
    for seed in draws:
        chain = drawn_chain(seed, 2, (1,))
        problem, x = chain.problem(0), np.concatenate([chain.springs, chain.dampers])
        one, other = (problem.structure(at).transmissibility(problem.measurement.freq) for at in (x, chain.other(x)))
        most = max(most, float(np.max(np.abs(one - other) / np.abs(one))))
    return below("chains of two masses by chance: largest relative difference of both answers' responses", most, 1e-9)


def _tells(chain: Chain, seed: int) -> bool:
    """True where the other answer is told by its values, and the first not called determined."""
    result = sysid.identify(chain.problem(seed), rng=seed)
    assert result.x is not None
    others = [one.sentence for one in result.of_kind("other answers")]
    values = [np.array([float(value) for value in VALUE.findall(sentence)]) for sentence in others]
    expected = chain.other(result.x)
    right = [v.shape == expected.shape and np.allclose(v, expected, rtol=NEAR) for v in values]
    return result.success and not result.determined and any(right)


def _accused(problem: sysid.Problem, seed: int, clock: Callable[[], float]) -> tuple[bool, float, float]:
    """True where a unique answer is said to have another; seconds of the identification, and of the look for others."""
    looked: list[float] = []
    look = judgement.with_other_answers

    def timed(*given):
        for _ in range(2):  # a machine has slow moments: a look beyond the bound is timed again, and the least counts
            at = clock()
            outcome = look(*given)
            looked.append(clock() - at)
            if looked[-1] <= LOOK:
                break
        return outcome

    judgement.with_other_answers = timed
    begun = clock()
    try:
        result = sysid.identify(problem, rng=seed)
    finally:
        judgement.with_other_answers = look
    seconds, least = clock() - begun, min(looked, default=0.0)
    return bool(result.of_kind("other answers")), seconds - sum(looked) + least, least


def _of_module(name: str) -> Callable[[int], sysid.Problem]:
    """The problem of a module at noise."""
    return lambda seed: load_module(name).problem(noise=NOISE, rng=seed)
