"""Seconds and memory from records in time to a judged result with its intervals, each in a process of its own.

``python -m benchmarks.records.record_speed NAME`` runs one and prints its figures as JSON.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.own_process import figures_of
from benchmarks.records import trial
from benchmarks.records.simulated import Setting, coupled_structure, four_storeys

PATIENCE = 5.0  # times the bound on the seconds, after which a run is ended


def ten_minutes() -> Setting:
    """10 sensors, 3 directions, 10 minutes at 500 Hz."""
    rng = np.random.default_rng(1)
    structure = coupled_structure(rng, 10, 3, np.geomspace(2.0, 40.0, 10))
    return Setting(structure, 600.0, 500.0, (1.0, 60.0), (0.5, 100.0), np.eye(3))


CASES: dict[str, tuple[Callable[[], Setting], float, float]] = {  # s, GiB
    "four_storeys": (four_storeys, 2.0, 2.0),
    "ten_minutes": (ten_minutes, 30.0, 2.0),
}


def lines(reduced: bool) -> Iterator[Line]:
    """Full mass, with force, 1 % noise; the reduced form leaves out the ten minutes."""
    for name in list(CASES)[: 1 if reduced else None]:
        _, seconds, memory = CASES[name]
        figures = figures_of("benchmarks.records.record_speed", [name], PATIENCE * seconds)
        if "said" in figures:
            yield Line(f"{name}: {figures['said']}", "no result", f"<= {seconds:g} s", False)
            continue
        yield below(f"{name}: seconds", figures["seconds"], seconds)
        yield below(f"{name}: peak memory, GiB", figures["memory"], memory)
        yield Line(f"{name}: modes found, residual", f"{figures['found']}, {figures['residual']:.3g}")


def main() -> None:
    """Run one, and print its figures."""
    setting, rng = CASES[sys.argv[1]][0](), np.random.default_rng(0)
    records, _ = setting.with_noise(setting.run(rng).records(), rng)
    begun = time.perf_counter()
    try:
        test = trial.measurement([records], setting, force=True)
        result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
        result.uncertainty.interval("mass")
    except sysid.SysidError as error:
        print(json.dumps({"said": str(error)}))
        return
    seconds = time.perf_counter() - begun
    unit = 2**10 if sys.platform.startswith("linux") else 1  # ru_maxrss is in KiB there, in bytes on macOS
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
    print(json.dumps({"seconds": seconds, "memory": peak, "found": result.structure.n, "residual": result.residual}))


if __name__ == "__main__":
    main()
