"""The paper's hPSO-LS as by default on tests with 1 % noise, beside the modal strategy on the same statements."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.problem_modules import load_module
from benchmarks.swarm import controls
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.response import weighted_error
from sysid.models.mass import total_of
from sysid.models.model import Geometry

SEEDS = range(9200, 9220)
WITHOUT = 5  # seeds that are searched without a swarm too, in the full form: with all restarts they take the longest
NOISE = 0.01
GOAL = 1.05  # times the residual that the truth leaves, as the tower's own
AS_GOOD = 1.001  # times the modal strategy's objective
ROUND_OFF = 1e-9  # relative, of a total
SECONDS = 15.0  # of a processor, median of the tower
TOTALS = {"trace": "the total stated as a trace", "rigid_body": "the rigid-body mass's diagonal stated"}


class Run(NamedTuple):
    """One identification: its result, the seconds of a processor that it took."""

    result: sysid.Identification
    seconds: float

    @property
    def objective(self) -> float:
        """Of the records, in the weights that all strategies have."""
        return weighted_error(self.result.problem.measurement, self.result.structure)

    @property
    def miss(self) -> float:
        """Largest relative error of a stated total; NaN where not all modes are at the sensors."""
        stated, geometry = self.result.problem.formulation.mass.totals, self.result.problem.geometry
        if not self.result.structure.at_sensors:
            return float("nan")
        return float(np.abs(total_of(geometry, self.result.structure.mass, stated.kind) / stated.values - 1).max())


def tower_lines(reduced: bool) -> Iterator[Line]:
    """README's tower, whose seconds are judged."""
    tower = load_module("cantilever_tower").problem
    yield from _lines("README's tower", lambda seed: tower(rng=seed), SEEDS[: 1 if reduced else 20], SECONDS)


def lines(reduced: bool) -> Iterator[Line]:
    """Random coupled structures with force, without, and with force and stated total."""
    seeds = SEEDS[: 1 if reduced else 20]
    for n in (6,) if reduced else (6, 10):
        what = f"random coupled structures, n = {n}, d = 3"
        for force in (True, False):
            told = f"{what}, {'with' if force else 'without'} force"
            yield from _lines(told, partial(random_test, n=n, force=force), seeds)
        for kind, words in TOTALS.items():
            yield from _lines(f"{what}, with force and {words}", partial(random_test, n=n, kind=kind), seeds)


def random_test(seed: int, *, n: int, force: bool = True, kind: str | None = None) -> sysid.Problem:
    """A full mass, free stiffness and modal damping as by default; the true total of a kind is stated where asked."""
    truth = random_structure(seed, n=n, d=3)
    test = sysid.simulate(truth, frequency_lines(truth), noise=NOISE, force=force, rng=seed)
    mass = sysid.FullMass()
    if kind is not None:
        total = total_of(Geometry(ModalEstimate.of_lines(test)), truth.mass, kind)
        mass = sysid.FullMass(total, healing=kind)
    return sysid.Problem(test, mass=mass, reference=truth, goal=GOAL * test.residual(truth))


def _lines(
    what: str, problem: Callable[[int], sysid.Problem], seeds: range, seconds: float | None = None
) -> Iterator[Line]:
    """Both strategies on one kind of test, and in the full form the first without its swarm."""
    what += f", {NOISE:.0%} noise, {len(seeds)} seeds: "
    modal = [_run(problem(seed), "modal", seed) for seed in seeds]
    runs = _all(problem, sysid.Swarm.published(), seeds)
    yield from _judged(what + "hpso-ls, ", runs, modal)
    if seconds is not None:
        yield _time(what + "hpso-ls, ", runs, seconds, lambda: _all(problem, sysid.Swarm.published(), seeds))
    few = seeds[:WITHOUT] if len(seeds) == len(SEEDS) else seeds[:0]
    if few:
        without = _all(problem, controls.two_points(sysid.Swarm.published()), few)
        told = f"two random points, no swarm, {len(few)} seeds: exit 0; {_told(without, modal[: len(few)])}"
        yield Line(what + told, str(_exits(without)))


def _time(what: str, runs: list[Run], seconds: float, again: Callable[[], list[Run]]) -> Line:
    """Line of the median; in the reduced form of the least of up to three, each by fixed work of its own moment."""
    words, least = "", _median(runs)
    if len(runs) < len(SEEDS):
        words, least = at_full_speed(least, _usual_work())
        for _ in range(2):
            if least > seconds:
                both = (words, least), at_full_speed(_median(again()), _usual_work())
                words, least = min(both, key=lambda one: one[1])
    return below(f"{what}median seconds of a processor {words}".rstrip(), least, seconds)


def _usual_work() -> float:
    """Mean seconds of fixed work at this moment, as a run of many seconds has slow and fast ones."""
    return float(np.mean([fixed_work(1) for _ in range(5)]))


def _median(runs: list[Run]) -> float:
    return float(np.median([run.seconds for run in runs]))


def _judged(what: str, runs: list[Run], modal: list[Run]) -> Iterator[Line]:
    """Each line of one kind of test, with its bound."""
    yield above(f"{what}exit 0; {_told(runs, modal)}", _exits(runs), len(runs))
    if runs[0].result.problem.formulation.mass.totals is not None:
        yield below(
            f"{what}largest relative error of a stated total (modal strategy {_largest_miss(modal):.2g})",
            _largest_miss(runs), ROUND_OFF,
        )  # fmt: skip
    near = sum(ratio <= AS_GOOD for ratio in _ratios(runs, modal))
    yield above(f"{what}objective at most {AS_GOOD:g} of the modal strategy's", near, len(runs) - len(runs) // 20)


def _largest_miss(runs: list[Run]) -> float:
    """NaN, which meets no bound, where one is."""
    return float(np.max([run.miss for run in runs]))


def _told(runs: list[Run], modal: list[Run]) -> str:
    """Restarts, seconds, and the largest ratio to the modal strategy's objective."""
    restarts = ", ".join(str(run.result.history.restarts) for run in runs)
    return (
        f"restarts {restarts}; median {_median(runs):.2g} s of a processor; largest objective over the modal "
        f"strategy's, which ends with 0 in {_exits(modal)}, {max(_ratios(runs, modal)):.5g}"
    )


def _ratios(runs: list[Run], modal: list[Run]) -> list[float]:
    return [run.objective / other.objective for run, other in zip(runs, modal, strict=True)]


def _exits(runs: list[Run]) -> int:
    """Number of tests that the command line would end with exit status 0."""
    return sum(run.result.success for run in runs)


def _all(problem: Callable[[int], sysid.Problem], strategy: sysid.Swarm, seeds: range) -> list[Run]:
    return [_run(problem(seed), strategy, seed) for seed in seeds]


def _run(problem: sysid.Problem, strategy: str | sysid.Swarm, seed: int) -> Run:
    begun = time.process_time()
    result = sysid.identify(problem, strategy=strategy, rng=seed)
    return Run(result, time.process_time() - begun)
