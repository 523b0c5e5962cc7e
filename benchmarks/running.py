"""Files of the package in which a function runs while ``sysid run test.h5`` works: a script, run in a process.

``python THIS FOLDER`` writes a logger's file of a two-storey frame with its force, reads it into ``test.h5``, runs it
and prints the files as JSON. It stands alone, so that the sysid of an earlier commit runs it too.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import threading
from pathlib import Path

import numpy as np

RATE, SECONDS = 100.0, 60.0  # Hz, s
SENSORS = """[[sensor]]
column = "{name}"
role = "{role}"
axis = "x"
{position}
unit = "{unit}"
"""


def write_test(folder: Path) -> None:
    """Records of a two-storey frame on a shaken base, at ten times the rate: ``log.csv``, ``log.toml``."""
    mass, stiffness, step = np.diag([100.0, 80.0]), np.array([[9e4, -4e4], [-4e4, 4e4]]), 1 / (10 * RATE)
    damping = 0.05 * mass + 2e-4 * stiffness
    random = np.random.default_rng(1)
    base = np.convolve(random.normal(size=int(10 * RATE * SECONDS)), np.hanning(80), "same")
    x, v, rows = np.zeros(2), np.zeros(2), []
    implicit = np.linalg.inv(mass + step / 2 * damping + step**2 / 4 * stiffness)  # average acceleration
    a = np.linalg.solve(mass, -mass @ np.full(2, base[0]))
    for u in base:
        ahead, speed = x + step * v + step**2 / 4 * a, v + step / 2 * a
        a = implicit @ (-mass @ np.full(2, u) - damping @ speed - stiffness @ ahead)
        x, v = ahead + step**2 / 4 * a, speed + step / 2 * a
        rows.append((u, *(a + u), np.diag(mass) @ (a + u)))
    records = np.array(rows)[::10]
    records += 0.005 * records.std(axis=0) * random.normal(size=records.shape)
    time = np.arange(len(records)) / RATE
    np.savetxt(
        folder / "log.csv", np.column_stack([time, records]), "%.9g", ",", header="time,base,a1,a2,force", comments=""
    )
    channels = (
        ("base", "base", "m/s²"),
        ("a1", "response", "m/s²"),
        ("a2", "response", "m/s²"),
        ("force", "force", "N"),
    )
    (folder / "log.toml").write_text(
        "".join(
            SENSORS.format(
                name=name, role=role, unit=unit,
                position=f"position = [0.0, 0.0, {3.0 * i}]" if role == "response" else "",
            )
            for i, (name, role, unit) in enumerate(channels)
        ),
        encoding="utf-8",
    )  # fmt: skip


def running_files(folder: Path) -> list[str]:
    """Files below ``sysid/`` in which a function ran, the imports' own code apart."""
    import sysid
    import sysid.report.report  # else bodies of its classes run, as it is imported where it is first used
    from sysid.cli.main import main

    package = str(Path(sysid.__file__).parent)
    seen: set[str] = set()

    def note(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_name != "<module>" and code.co_filename.startswith(package):
            seen.add(code.co_filename[len(package) + 1 :])

    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        if main(["read", "log.csv", "--out", "test.h5"]):
            raise SystemExit("the logger's file is not read")
        threading.setprofile(note)
        sys.setprofile(note)
        try:
            main(["run", "test.h5"])
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return sorted(seen)


if __name__ == "__main__":
    write_test(Path(sys.argv[1]))
    print(json.dumps(running_files(Path(sys.argv[1]))))
