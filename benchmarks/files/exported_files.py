"""Round trips of every exported format, and the superelement driven at its base by pyYeti.

The structures are random, with two or three base directions, one of them a rotation; the test is noise-free with force.
"""

from __future__ import annotations

import csv
import importlib.util
import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.io import loadmat

import sysid
from benchmarks.line import Line, below


def lines(reduced: bool) -> Iterator[Line]:
    """Measure."""
    results = [_identified(seed) for seed in range(2 if reduced else 8)]
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        yield below("CSV: largest relative difference of M and K", max(_csv(it, where) for it in results), 0)
        yield below("MAT: largest relative difference of M and K", max(_mat(it, where) for it in results), 0)
        if importlib.util.find_spec("pyyeti") is None:
            yield Line("OP4 and DMIG", "pyyeti is not installed")
        else:
            op4 = [_op4(it, where) for it in results]
            yield below("OP4: largest relative difference of M and K", max(m for m, _ in op4), 0)
            yield below("OP4: transmissibility and base force by pyyeti", max(a for _, a in op4), 1e-6)
            dmig = [_dmig(it, where) for it in results]
            yield below("DMIG: largest relative difference of an entry", max(m for m, _ in dmig), 5.1e-10)
            yield below("DMIG: transmissibility and base force by pyyeti", max(a for _, a in dmig), 1e-6)
        yield from _by_pynastran(results[0], where)
        if importlib.util.find_spec("pyuff") is None:
            yield Line("UFF 55", "pyuff is not installed")
        else:
            yield below("UFF 55: frequencies, damping, shapes", max(_uff(it, where) for it in results), 1e-5)


def _identified(seed: int) -> sysid.Identification:
    """A random structure of four sensors, identified from its own FRFs and base force."""
    rng = np.random.default_rng(seed)
    n = 4
    heights = np.sort(rng.uniform(0.5, 4.0, n))
    G = np.column_stack([np.ones(n), heights])
    springs = rng.standard_normal((n, n))
    K = 1e5 * (springs @ springs.T + np.diag(rng.uniform(0.5, 3.0, n)))
    masses = rng.standard_normal((n + 2, n + 2))
    M = masses @ masses.T + 5 * np.eye(n + 2)
    full = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    truth = sysid.Structure(M, full, rng.uniform(0.01, 0.03, n), n_base=2)
    freq = np.linspace(0.5, 1.3, 300)[:, None] * truth.natural_frequencies
    freq = np.unique(freq)
    sensors = [sysid.Sensor(f"sensor {k}", (0.0, 0.0, float(z)), "x") for k, z in enumerate(heights)]
    test = sysid.Measurement.from_frf(
        freq, truth.transmissibility(freq), force=truth.base_force(freq), rigid_body=G, base_axes="x ry",
        sensors=sensors,
    )  # fmt: skip
    models = sysid.FullMass(), sysid.SpectralStiffness(), sysid.ModalDamping()
    return sysid.identify(sysid.Problem(test, **dict(zip(("mass", "stiffness", "damping"), models, strict=True))))


def _difference(found: np.ndarray, right: np.ndarray) -> float:
    """Largest relative difference of an entry; where an entry is zero, that of the other is its own."""
    size = np.where(right == 0, 1.0, np.abs(right))
    return float(np.max(np.abs(found - right) / size))


def _csv(it: sysid.Identification, where: Path) -> float:
    text = sysid.export(it, where / "m.csv").read_text(encoding="utf-8").splitlines()
    read = {letter: np.zeros_like(it.structure.mass) for letter in "MKC"}
    for row in csv.DictReader(line for line in text if not line.startswith("#")):
        read[row["matrix"]][int(row["row"]) - 1, int(row["column"]) - 1] = float(row["value"])
    return max(_difference(read["M"], it.structure.mass), _difference(read["K"], it.structure.stiffness))


def _mat(it: sysid.Identification, where: Path) -> float:
    read = loadmat(sysid.export(it, where / "m.mat"))
    return max(_difference(read["M"], it.structure.mass), _difference(read["K"], it.structure.stiffness))


def _op4(it: sysid.Identification, where: Path) -> tuple[float, float]:
    from pyyeti.nastran import op4

    read = op4.read(str(sysid.export(it, where / "m.op4")))
    kept = max(_difference(read["m"], it.structure.mass), _difference(read["k"], it.structure.stiffness))
    return kept, _answers(it, read["mcb"], read["ccb"], read["kcb"], read["rcb"])


def _dmig(it: sysid.Identification, where: Path) -> tuple[float, float]:
    from pyyeti.nastran import bulk

    read = bulk.rddmig(str(sysid.export(it, where / "m.bdf")))
    n = it.structure.n
    points = [(1, 1), (1, 5), *((1001 + k, 0) for k in range(n))]
    M, C, K = (read[x].reindex(index=points, columns=points).fillna(0).to_numpy() for x in ("mcb", "bcb", "kcb"))
    R = read["rcb"].reindex(columns=points).to_numpy()
    form, order = it.structure.to_craig_bampton(), [n, n + 1, *range(n)]
    right = form.mass[np.ix_(order, order)], form.stiffness[np.ix_(order, order)], form.recovery[:, order]
    return max(map(_difference, (M, K, R), right)), _answers(it, M, C, K, R)


def _by_pynastran(it: sysid.Identification, where: Path) -> Iterator[Line]:
    """Matrices that pyNastran reads, in the environment whose Python SYSID_PYNASTRAN names."""
    python = os.environ.get("SYSID_PYNASTRAN")
    if not python or importlib.util.find_spec("pyyeti") is None:
        yield Line("OP4 and DMIG by pyNastran", "SYSID_PYNASTRAN names no Python with it, or pyyeti is missing")
        return
    for name in ("m.op4", "m.bdf"):
        sysid.export(it, where / name)
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    script = Path(__file__).with_name("read_by_pynastran.py")
    subprocess.run([python, str(script), str(where)], check=True, env=alone, stdout=subprocess.DEVNULL)
    with np.load(where / "read.npz") as read:
        kept = max(_difference(read["M"], it.structure.mass), _difference(read["K"], it.structure.stiffness))
        yield below("OP4 by pyNastran: largest relative difference of M and K", kept, 0)
        digits = 0.0
        for bulk, op4 in (("mcb", "MCB"), ("kcb", "KCB"), ("bcb", "CCB")):
            # Points without an entry, such as the base in the stiffness, are not in what it gives.
            at = [
                (1, 5).index(component) if point == 1 else point - 999 for point, component in read[f"{bulk}_columns"]
            ]
            digits = max(digits, _difference(read[bulk], read[op4][np.ix_(at, at)]))
        yield below("DMIG by pyNastran: largest relative difference of an entry", digits, 5.1e-10)


def _answers(it: sysid.Identification, M: np.ndarray, C: np.ndarray, K: np.ndarray, R: np.ndarray) -> float:
    """Largest difference of pyYeti's transmissibility and base force from the identified ones, over the largest."""
    from pyyeti import cb

    freq, s = it.measurement.freq, it.structure
    driven = [cb.cbtf(M, C, K, unit, freq, np.arange(s.n_base)) for unit in np.eye(s.n_base)]
    motion, force = np.stack([R @ d.a for d in driven], 1), np.stack([d.frc for d in driven], 1)
    pairs = (motion, s.transmissibility(freq)), (force, s.base_force(freq))
    return max(float(np.abs(found - right).max() / np.abs(right).max()) for found, right in pairs)


def _uff(it: sysid.Identification, where: Path) -> float:
    import pyuff

    file = pyuff.UFF(str(sysid.export(it, where / "m.unv")))
    modes = [file.read_sets(int(k)) for k in np.flatnonzero(file.get_set_types() == 55)]
    s = it.structure
    found = [
        np.array([mode["freq"] for mode in modes]), np.array([mode["modal_damp_vis"] for mode in modes]),
        np.transpose([mode["r1"] for mode in modes]),
    ]  # fmt: skip
    return max(map(_difference, found, (s.natural_frequencies, s.damping_ratios, s.mode_shapes)))
