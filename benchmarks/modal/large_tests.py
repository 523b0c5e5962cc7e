"""Time and memory that large noise-free tests take, each in a process of its own.

``python -m benchmarks.modal.large_tests N D LINES`` runs one and prints its figures as JSON.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.modal.identification import identify_records, matrix_distance
from benchmarks.modal.random_structures import frequency_lines, random_structure
from benchmarks.own_process import figures_of

SIZES = ((50, 3, 1000, 10.0), (100, 3, 2000, 90.0))  # n, d, lines, s
MEMORY = 4.0  # GiB
PATIENCE = 5.0  # times the bound on the seconds, after which a run is ended


def lines(reduced: bool) -> Iterator[Line]:
    """Noise-free tests with base force; the reduced form takes the smaller one, judged at a machine's full speed."""
    for n, d, count, seconds in SIZES[: 1 if reduced else None]:
        what = f"no noise, base force, n = {n}, d = {d}, {count} lines: "
        figures = figures_of("benchmarks.modal.large_tests", [str(n), str(d), str(count)], PATIENCE * seconds)
        if "said" in figures:
            yield Line(what + figures["said"], "no result", f"<= {seconds:g} s", False)
            continue
        words, taken = at_full_speed(figures["seconds"], fixed_work() if reduced else 0.0)
        yield below(f"{what}seconds {words}" if reduced else what + "seconds", taken, seconds)
        yield below(what + "peak memory, GiB", figures["memory"], MEMORY)
        shown = ", ".join(f"{figures[name]:.1e}" for name in ("residual", "force_residual", "matrices"))
        yield Line(
            what + "residual, residual of the force, relative distance of M_SS, K_SS and C, modes found",
            f"{shown}, {figures['found']}",
        )


def main() -> None:
    """Run one, and print its figures."""
    n, d, count = (int(a) for a in sys.argv[1:])
    truth = random_structure(0, n=n, d=d)
    test = sysid.simulate(truth, frequency_lines(truth, count), force=True)
    begun = time.perf_counter()
    try:
        result = identify_records(test)
    except sysid.SysidError as error:
        print(json.dumps({"said": str(error)}))
        return
    seconds = time.perf_counter() - begun
    unit = 2**10 if sys.platform.startswith("linux") else 1  # ru_maxrss is in KiB there, in bytes on macOS
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
    found = result.structure
    figures = {
        "seconds": seconds,
        "memory": peak,
        "residual": result.residual,
        "force_residual": result.force_residual,
        "matrices": matrix_distance(found, truth) if found.n == n else np.inf,
        "found": found.n,
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
