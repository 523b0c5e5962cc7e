"""All benchmarks.

To add one, write ``benchmarks/NAME.py``, or ``benchmarks/GROUP/NAME.py`` in a group, with a function
``lines(reduced: bool) -> Iterator[Line]``, and add one line to `BENCHMARKS`. Nothing else names it.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.line import Line

ALL = "all"


@dataclass(frozen=True)
class Benchmark:
    """A module that measures something.

    Attributes
    ----------
    module : str
        Below `benchmarks`: ``"NAME"``, or ``"GROUP.NAME"``. It is imported only when it runs.
    what : str
        What it measures, in one line.
    full, reduced : str
        About how long each form takes on two cores.
    """

    module: str
    what: str
    full: str
    reduced: str

    @property
    def name(self) -> str:
        """What it is called by; unique among all benchmarks and groups."""
        return self.module.rpartition(".")[2]

    @property
    def group(self) -> str:
        """The group that it runs with; empty for none."""
        return self.module.rpartition(".")[0]

    def lines(self, reduced: bool) -> Iterator[Line]:
        """Measure, line by line; the reduced form takes fewer seeds and leaves out what takes minutes."""
        lines: Iterator[Line] = importlib.import_module(f"benchmarks.{self.module}").lines(reduced)
        return lines


BENCHMARKS = (
    Benchmark("swarm.tower", "how exact the swarm strategy identifies the tower without noise", "FULL", "RED"),
    Benchmark("swarm.tower_noise", "residual over the noise floor, tower with 1 % noise", "FULL", "RED"),
    Benchmark("swarm.swarm_alone", "residual that the swarm reaches without a gradient step", "FULL", "RED"),
    Benchmark("swarm.spacecraft", "successes and seconds of the swarm strategy on the spacecraft", "FULL", "RED"),
    Benchmark("swarm.shake_table", "measured records: fit of one event, prediction of another", "FULL", "RED"),
    Benchmark("swarm.bad_input", "how mistakes at the command line are reported", "FULL", "RED"),
    Benchmark("swarm.fresh_install", "the README's two commands in a new environment", "FULL", "RED"),
    Benchmark("modal.noise_free", "residual and matrices of noise-free tests of random structures", "FULL", "RED"),
    Benchmark("modal.speed", "seconds that an identification of 10 or 20 modes takes", "FULL", "RED"),
    Benchmark("modal.modes_found", "modes found, missed and spurious in noisy tests", "FULL", "RED"),
    Benchmark("modal.accuracy", "errors over the Cramér-Rao bound, and coverage of 95 % intervals", "FULL", "RED"),
    Benchmark("modal.building", "matrices of a building, and their extremes where they are open", "FULL", "RED"),
    Benchmark("modal.six_axis_spacecraft", "errors of predictions and rigid-body mass, 20 modes", "FULL", "RED"),
    Benchmark("modal.large_tests", "seconds and memory for 50 and 100 modes", "FULL", "RED"),
    Benchmark("modal.unsound_tests", "whether results say what a test cannot tell", "FULL", "RED"),
    Benchmark("variants.six_springs", "errors of springs and dampers at four levels of noise", "FULL", "RED"),
    Benchmark("variants.five_storeys", "errors of storey stiffnesses at 5 % noise", "FULL", "RED"),
    Benchmark("variants.newcomers", "whether variants run as their first users wrote them", "FULL", "RED"),
    Benchmark("variants.module_mistakes", "how mistakes in a problem module are reported", "FULL", "RED"),
    Benchmark("house", "imports one way, tests of types, branches, sizes of functions and files", "2 s", "2 s"),
)


def names() -> set[str]:
    """All that may be asked for: benchmarks, groups, and "all"."""
    return {ALL} | {b.name for b in BENCHMARKS} | {b.group for b in BENCHMARKS if b.group}


def select(wanted: list[str]) -> list[Benchmark]:
    """Benchmarks that some names stand for, each once, in the order of the registry."""
    return [b for b in BENCHMARKS if {b.name, b.group, ALL}.intersection(wanted)]
