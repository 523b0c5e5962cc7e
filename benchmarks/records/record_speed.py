"""Seconds and memory from records in time to a judged result with its intervals, each in a process of its own.

``python -m benchmarks.records.record_speed NAME`` runs one and prints its figures as JSON.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.modal.six_axis_dummy import spacecraft
from benchmarks.own_process import figures_of
from benchmarks.records import trial
from benchmarks.records.simulated import Records, Setting, coupled_structure, four_storeys, softened

PATIENCE = 5.0  # times the bound on the seconds, after which a run is ended


class Case(NamedTuple):
    """A test, how it is run, and the seconds and GiB that an identification of it may take."""

    setting: Callable[[], Setting]
    runs: Callable[[Setting, np.random.Generator], list[Records]]
    seconds: float
    memory: float = 2.0
    force: bool = True


def one_run(setting: Setting, rng: np.random.Generator) -> list[Records]:
    """One run of the setting."""
    return [setting.run(rng).records()]


def five_times(setting: Setting, rng: np.random.Generator) -> list[Records]:
    """Five runs of the setting, each with motion of its own."""
    return [setting.run(rng).records() for _ in range(5)]


def axis_by_axis(setting: Setting, rng: np.random.Generator, cross: float = 0.02) -> list[Records]:
    """A run for each base direction, the others moving by a small share of it."""
    d = setting.structure.n_base
    share = cross + (1 - cross) * np.eye(d)
    return [replace(setting, correlation=np.diag(one**2)).run(rng).records() for one in share]


def softening(setting: Setting, rng: np.random.Generator) -> list[Records]:
    """One run during which the first mode softens by 3 %."""
    return [softened(setting.run(rng), 0.03)]


def of_sensors(n: int, duration: float, rate: float, top: float) -> Setting:
    """N sensors and modes, 3 directions, from 2 Hz to `top`, Hz."""
    structure = coupled_structure(np.random.default_rng(1), n, 3, np.geomspace(2.0, top, n))
    return Setting(structure, duration, rate, (1.0, 1.5 * top), (0.5, 2.5 * top), np.eye(3))


def ten_minutes(n: int = 10) -> Setting:
    """Ten minutes at 500 Hz, modes to 40 Hz."""
    return of_sensors(n, 600.0, 500.0, 40.0)


def frame() -> Setting:
    """Four storeys, 100 s."""
    return replace(four_storeys(), duration=100.0)


def dummy() -> Setting:
    """A spacecraft dummy, 12 modes, 60 s at 512 Hz."""
    structure = spacecraft(12)
    top = float(structure.natural_frequencies[-1])
    return Setting(structure, 60.0, 512.0, (8.0, 1.15 * top), (5.0, 1.4 * top), np.eye(3))


CASES = {
    "four_storeys": Case(four_storeys, one_run, 2.0),
    "five_short_runs": Case(lambda: of_sensors(4, 40.0, 100.0, 12.0), five_times, 4.0),
    "ten_minutes": Case(ten_minutes, one_run, 8.0),
    "five_runs": Case(lambda: of_sensors(6, 120.0, 200.0, 30.0), five_times, 10.0),
    "softening": Case(frame, softening, 20.0, force=False),
    "spacecraft": Case(dummy, axis_by_axis, 60.0),
    "thirty_sensors": Case(lambda: ten_minutes(30), one_run, 60.0),
}


def lines(reduced: bool) -> Iterator[Line]:
    """Full mass, 1 % noise; the reduced form leaves out the long ones."""
    for name, case in list(CASES.items())[: 1 if reduced else None]:
        figures = figures_of("benchmarks.records.record_speed", [name], PATIENCE * case.seconds)
        if "said" in figures:
            yield Line(f"{name}: {figures['said']}", "no result", f"<= {case.seconds:g} s", False)
            continue
        words, seconds = "", figures["seconds"]
        if reduced:  # in CI, on machines that are slow for hours
            words, seconds = at_full_speed(seconds, fixed_work())
        yield below(f"{name}: seconds {words}".rstrip(), seconds, case.seconds)
        yield below(f"{name}: peak memory, GiB", figures["memory"], case.memory)
        yield Line(
            f"{name}: modes found, residual, judgement", "{found}, {residual:.3g}, {judgement}".format(**figures)
        )


def test_of(case: Case) -> sysid.Measurement:
    """The test of a case."""
    setting, rng = case.setting(), np.random.default_rng(0)
    records = [setting.with_noise(run, rng)[0] for run in case.runs(setting, rng)]
    return trial.measurement(records, setting, force=case.force)


def main() -> None:
    """Run one, and print its figures."""
    test = test_of(CASES[sys.argv[1]])
    begun = time.perf_counter()
    try:
        result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
        result.uncertainty.interval("mass")
    except sysid.SysidError as error:
        print(json.dumps({"said": str(error)}))
        return
    seconds = time.perf_counter() - begun
    unit = 2**10 if sys.platform.startswith("linux") else 1  # ru_maxrss is in KiB there, in bytes on macOS
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
    figures = {"seconds": seconds, "memory": peak, "found": result.structure.n, "residual": result.residual}
    print(json.dumps({**figures, "judgement": result.judgement}))


if __name__ == "__main__":
    main()
