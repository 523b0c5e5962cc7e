"""Files of other programs of a structure that a sensor at -x recorded: its rows name the sign, or are turned to +x.

A shear building whose matrices and spectra are made here by NumPy. Files are read by other programs: as recorded each
entry has the sign that its rows' names say, turned all entries are those of the building.
"""

from __future__ import annotations

import csv
import importlib.util
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat

import sysid
from benchmarks.line import Line, above, below
from sysid.export.state_space import control_system

MASSES, SPRINGS, RATIO = (4.0, 3.0, 2.0), (3e4, 2e4, 1.5e4), 0.02
BASE = 5.0  # kg
LINES = np.linspace(4.0, 34.0, 160)
DOWN = ((1,), (0, 2), (0, 1, 2), (0,), (2,))  # sensors at -x of each test
NEAR = 1e-9  # of the largest entry
DIGITS = 1e-5  # the same of universal files, which keep six


class Building(NamedTuple):
    """M, K and C with the base's row last, and shapes on a fixed base, mass-normalised, (3, 3)."""

    matrices: dict[str, np.ndarray]
    shapes: np.ndarray


class Content(NamedTuple):
    """What a file holds: matrices by letter or responses, and names of its rows of sensors."""

    parts: dict[str, np.ndarray]
    names: str


def lines(reduced: bool) -> Iterator[Line]:
    """Five sets of sensors at -x; or one."""
    truth = _building()
    tests = [(down, _identified(truth, down)) for down in DOWN[: 1 if reduced else None]]
    with tempfile.TemporaryDirectory() as folder:
        for name, (package, read) in READERS.items():
            if package and importlib.util.find_spec(package) is None:
                yield Line(name, f"{package} is not installed")
                continue
            turned, recorded, named, near = [], [], [], DIGITS if name.startswith("UFF") else NEAR
            for down, result in tests:
                signs = np.array([-1.0 if i in down else 1.0 for i in range(3)])
                turned.append(_off(read(result, Path(folder), True), truth, np.ones(3)))
                found = read(result, Path(folder), False)
                recorded.append(_off(found, truth, np.ones(3) if name.startswith("UFF") else signs))
                axes = [f"floor {i + 1} ({'-' * (i in down)}x)" for i in range(3)]
                named.append(name.startswith("UFF") or all(axis in found.names for axis in axes))
            yield below(f"{name}, turned to +x: error of an entry over the largest", max(turned), near)
            yield below(f"{name}, as recorded: the same with the signs of the rows", max(recorded), near)
            yield above(f"{name}: files whose rows name axis and sign, or that are along +x", np.mean(named), 1)


def _building() -> Building:
    stretch = np.array([[1.0, 0, 0, -1], [-1, 1, 0, 0], [0, -1, 1, 0]])
    K, M = stretch.T @ np.diag(SPRINGS) @ stretch, np.diag([*MASSES, BASE])
    root = 1 / np.sqrt(np.array(MASSES))
    squares, vectors = np.linalg.eigh(K[:3, :3] * np.outer(root, root))
    shapes = root[:, None] * vectors
    loss = M[:3, :3] @ shapes @ np.diag(2 * RATIO * np.sqrt(squares)) @ shapes.T @ M[:3, :3]
    relative = np.hstack([np.eye(3), -np.ones((3, 1))])
    return Building({"M": M, "K": K, "C": relative.T @ loss @ relative}, shapes)


def _identified(truth: Building, down: tuple[int, ...]) -> sysid.Identification:
    """From exact spectra of unit base motion, of which some sensors read the negative."""
    w = 2 * np.pi * LINES
    D = [truth.matrices["K"] + 1j * one * truth.matrices["C"] - one**2 * truth.matrices["M"] for one in w]
    moved = np.array([np.append(-np.linalg.solve(one[:3, :3], one[:3, 3]), 1) for one in D])
    force = np.array([one[3] @ u for one, u in zip(D, moved, strict=True)]) / -(w**2)
    signs = np.array([-1.0 if i in down else 1.0 for i in range(3)])
    sensors = [
        sysid.Sensor(f"floor {i + 1}", (0, 0, 3.0 * i), "x" if sign > 0 else "-x") for i, sign in enumerate(signs)
    ]
    test = sysid.Measurement.from_frf(LINES, moved[:, :3].T * signs[:, None], force=force[None, None], sensors=sensors)
    return sysid.identify(sysid.Problem(test), rng=0)


def _off(found: Content, truth: Building, signs: np.ndarray) -> float:
    """Largest error of what a file holds, over the largest entry; modes have no sign of their own."""
    both, errors = np.append(signs, 1.0), []
    for name, part in found.parts.items():
        if name in truth.matrices:
            right = truth.matrices[name] * np.outer(both, both)
        elif name == "rigid":
            right = signs
        else:
            right = truth.shapes * signs[:, None]
            part = part * np.sign(np.sum(part * right, axis=0))
        errors.append(np.abs(part - right).max() / np.abs(right).max())
    return float(max(errors))


def _csv(it: sysid.Identification, where: Path, positive: bool) -> Content:
    text = sysid.export(it, where / "m.csv", positive_axes=positive).read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in text if not line.startswith("#")))
    parts = {letter: np.zeros((4, 4)) for letter in "MKC"}
    for row in rows:
        parts[row["matrix"]][int(row["row"]) - 1, int(row["column"]) - 1] = float(row["value"])
    return Content(parts, " ".join(row["row_name"] for row in rows))


def _mat(it: sysid.Identification, where: Path, positive: bool) -> Content:
    read = loadmat(sysid.export(it, where / "m.mat", positive_axes=positive))
    parts = {name: read[name] for name in ("M", "K", "C")} | {"rigid": read["G"][:, 0], "shapes": read["Phi"]}
    return Content(parts, " ".join(str(cell[0]) for cell in read["dof_names"][:, 0]))


def _op4(it: sysid.Identification, where: Path, positive: bool) -> Content:
    from pyyeti.nastran import op4

    read = op4.read(str(sysid.export(it, where / "m.op4", positive_axes=positive)))
    note = " ".join(" ".join("".join(map(chr, line.astype(int))) for line in read["note"]).split())
    parts = {name: read[name.lower()] for name in ("M", "K", "C")}
    return Content(parts | {"rigid": read["rcb"][:, 0], "shapes": read["rcb"][:, 1:]}, note.partition("order: ")[2])


def _dmig(it: sysid.Identification, where: Path, positive: bool) -> Content:
    from pyyeti.nastran import bulk

    path = sysid.export(it, where / "m.bdf", positive_axes=positive)
    R = bulk.rddmig(str(path))["rcb"].reindex(columns=[(1, 1), *((1001 + k, 0) for k in range(3))]).to_numpy()
    words = " ".join(path.read_text(encoding="ascii").replace("$", " ").split())
    return Content({"rigid": R[:, 0], "shapes": R[:, 1:]}, words.partition("its rows: ")[2])


def _uff(it: sysid.Identification, where: Path, positive: bool) -> Content:
    import pyuff

    file = pyuff.UFF(str(sysid.export(it, where / "m.unv", positive_axes=positive)))
    modes = [file.read_sets(int(k)) for k in np.flatnonzero(file.get_set_types() == 55)]
    return Content({"shapes": np.transpose([mode["r1"] for mode in modes])}, "")


def _control(it: sysid.Identification, where: Path, positive: bool) -> Content:
    """Rigid motion, by the response at 0 Hz."""
    system = control_system(it, positive_axes=positive)
    return Content({"rigid": np.real(system(0.0))[:, 0]}, " ".join(system.output_labels))


Reader = Callable[[sysid.Identification, Path, bool], Content]
READERS: dict[str, tuple[str, Reader]] = {
    "CSV": ("", _csv), "MAT": ("", _mat), "OP4": ("pyyeti", _op4), "DMIG": ("pyyeti", _dmig), "UFF 55": ("pyuff", _uff),
    "python-control": ("control", _control),
}  # fmt: skip
