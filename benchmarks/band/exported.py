r"""Exported files of answers in the band, read back by other programs, driven at their base and integrated in time.

The base drive of what a file holds, and the time history, are those of this module's own equations:

.. math:: M_{qq} \ddot q + C_{qq} \dot q + K_{qq} q = -M_{qb} \ddot u_0, \qquad a = R [\ddot q; \ddot u_0], \qquad
    f_0 = M_{bq} \ddot q + M_{bb} \ddot u_0

solved line by line, and by SciPy's ``lsim``, exact for a base acceleration that is linear between samples of 40
times the rate. ``python -m benchmarks.band.exported NUMBER SECONDS`` prints the figures of one structure.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

import sysid
from benchmarks.band.own_process import answer, figures_of_each
from benchmarks.band.simulated_tests import RISE, Draw, draw, transfer
from benchmarks.band.structures import Continuous, structure
from benchmarks.line import Line, above, below
from benchmarks.records.simulated import random_motion

STRUCTURES, PATIENCE = 12, 120  # s of processor time each
SHORT, SHORT_PATIENCE = (7,), 20  # one that takes few seconds
BEYOND = 1.2  # of the last line, up to where files must answer as the structure does
SAME, DIGITS, OF_TEXT = 1e-6, 1e-8, 1e-5  # base drive; entries of DMIG; universal files, of six digits
IN_TIME, PERIODS = 1e-3, 30  # of the rms; of the first mode
END = 10  # samples at either end, where splines are less exact
RATE, FACTOR = 5.0, 40  # samples a period of the last line; steps of the integrator a sample
NOISE = 1.2  # what the superelement leaves of the test, over its noise
DRIVE, GAP = 0.02, 0.25  # of the truth; of the way to the next mode, just beyond the band
ROUND_OFF = 1e-9


class Superelement(NamedTuple):
    """Matrices with the d motions of the base first, and the recovery of the sensors."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    recovery: np.ndarray
    d: int

    def parts(self) -> tuple[np.ndarray, ...]:
        """M_qq, C_qq, K_qq, M_qb, M_bb."""
        q, b = slice(self.d, None), slice(self.d)
        return self.mass[q, q], self.damping[q, q], self.stiffness[q, q], self.mass[q, b], self.mass[b, b]

    def driven(self, freq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations (n_sensors, d, lines) and forces (d, d, lines) for unit base accelerations."""
        M, C, K, M_qb, M_bb = self.parts()
        w = 2 * np.pi * freq[:, None, None]
        q = w**2 * np.linalg.solve(K - w**2 * M + 1j * w * C, np.broadcast_to(M_qb + 0j, (freq.size, *M_qb.shape)))
        a = self.recovery[:, self.d :] @ q + self.recovery[:, : self.d]
        return np.moveaxis(a, 0, -1), np.moveaxis(M_qb.T @ q + M_bb, 0, -1)

    def integrated(self, base: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations and forces in time under base accelerations (d, samples), from rest."""
        M, C, K, M_qb, M_bb = self.parts()
        n, minus = len(M), -np.linalg.inv(M)
        A = np.block([[np.zeros((n, n)), np.eye(n)], [minus @ K, minus @ C]])
        B = np.vstack([np.zeros_like(M_qb), minus @ M_qb])
        system = A, B, A[n:], B[n:]
        time = step * np.arange(base.shape[1])
        q = scipy.signal.lsim(system, base.T, time, interp=True)[1].reshape(time.size, n).T
        return self.recovery[:, self.d :] @ q + self.recovery[:, : self.d] @ base, M_qb.T @ q + M_bb @ base


def lines(reduced: bool) -> Iterator[Line]:
    """Twelve structures; or one."""
    numbers = list(SHORT if reduced else range(STRUCTURES))
    found = figures_of_each("band.exported", numbers, SHORT_PATIENCE if reduced else PATIENCE)
    what = f"exported answers of {len(found)} continuous structures: "
    said = [f"{number}: {it['said'][:100]}" for number, it in zip(numbers, found, strict=True) if "said" in it]
    yield below(what + "without a result" + f" ({'; '.join(said)})" * bool(said), len(said), 0)
    found = [it for it in found if "said" not in it]
    if not found:
        return
    worst = {name: max(it[name] for it in found if name in it) for name in sorted(set().union(*found))}
    drive = f"base drive, up to {BEYOND:g} of the last line, "
    for name, text, most in (
        ("op4", drive + "OP4 by pyYeti", SAME), ("dmig", drive + "DMIG by pyYeti", SAME),
        ("dmig digits", "DMIG by pyYeti, entries", DIGITS), ("mat", drive + "MAT by SciPy", SAME),
        ("uff", "modes in the lines, UFF 55 by pyuff", OF_TEXT),
        ("pynastran op4", drive + "OP4 by pyNastran", SAME), ("pynastran dmig", drive + "DMIG by pyNastran", SAME),
        ("time", "time history, SciPy's lsim beside Structure.simulate", IN_TIME),
        ("test", "what the superelement leaves of the test, over its noise", NOISE),
        ("drive", "base drive off the truth's in the lines", DRIVE),
    ):  # fmt: skip
        yield below(what + text, worst[name], most) if name in worst else Line(what + text, "no reader here")
    text = what + "least eigenvalue of M of the superelement, its diagonal one"
    yield above(text, min(it["least"] for it in found), -ROUND_OFF)
    yield Line(
        what + f"base drive off the truth's a {GAP:g} of the way to the next mode, most", f"{worst['beyond']:.2g}"
    )


def case(number: int) -> dict:
    """Figures of one structure."""
    truth = structure(number)
    test = draw(truth)
    it = sysid.identify(sysid.Problem(test.measurement, mass=sysid.FullMass()), rng=0)
    s = it.structure
    freq = np.linspace(truth.lines[0], BEYOND * truth.lines[1], 1000)
    right = s.transmissibility(freq), s.base_force(freq)
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        figures = {"mat": _mat(it, where, freq, right)}
        if importlib.util.find_spec("pyyeti"):
            taken, written = _op4(it, where), _dmig(it, where)
            digits = [_digits(a, b) for a, b in zip(written[:4], taken[:4], strict=True)]
            figures |= {"op4": _off(taken.driven(freq), right), "dmig": _off(written.driven(freq), right)}
            figures |= {"dmig digits": max(digits)} | _by_pynastran(where, s.n_base, freq, right)
        else:
            form = s.to_craig_bampton()
            order = np.roll(np.arange(len(form.mass)), s.n_base)
            at = np.ix_(order, order)
            taken = Superelement(form.mass[at], form.damping[at], form.stiffness[at], form.recovery[:, order], s.n_base)
        if importlib.util.find_spec("pyuff"):
            figures["uff"] = _uff(it, where)
    size = np.sqrt(np.diag(taken.mass))
    figures["least"] = float(np.linalg.eigvalsh(taken.mass / np.outer(size, size))[0])
    return figures | {"time": _in_time(s, taken, truth)} | _coupled(taken, truth, test, it.prepared.measurement)


def _off(found: tuple[np.ndarray, ...], right: tuple[np.ndarray, ...]) -> float:
    """Largest difference of accelerations, or of forces, over the largest of them."""
    return max(float(np.max(np.abs(a - b)) / np.max(np.abs(b))) for a, b in zip(found, right, strict=True))


def _digits(found: np.ndarray, right: np.ndarray) -> float:
    """Largest relative difference of an entry."""
    return float(np.max(np.abs(found - right) / np.where(right == 0, 1.0, np.abs(right))))


def _op4(it: sysid.Identification, where: Path) -> Superelement:
    from pyyeti.nastran import op4

    read = op4.read(str(sysid.export(it, where / "m.op4")))
    return Superelement(read["mcb"], read["ccb"], read["kcb"], read["rcb"], it.structure.n_base)


def _dmig(it: sysid.Identification, where: Path) -> Superelement:
    from pyyeti.nastran import bulk

    read, s = bulk.rddmig(str(sysid.export(it, where / "m.bdf"))), it.structure
    components = [1 + ("x", "y", "z", "rx", "ry", "rz").index(axis) for axis in it.measurement.base_axes or ()]
    points = [(1, one) for one in components] + [(1001 + k, 0) for k in range(s.n + s.residual.count)]
    M, C, K = (read[x].reindex(index=points, columns=points).fillna(0).to_numpy() for x in ("mcb", "bcb", "kcb"))
    return Superelement(M, C, K, read["rcb"].reindex(columns=points).fillna(0).to_numpy(), s.n_base)


def _by_pynastran(where: Path, d: int, freq: np.ndarray, right: tuple[np.ndarray, ...]) -> dict[str, float]:
    """Both Nastran files by pyNastran, in the environment whose Python SYSID_PYNASTRAN names; nothing without one."""
    python = os.environ.get("SYSID_PYNASTRAN")
    if not python:
        return {}
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    script = Path(__file__).parents[1] / "files" / "read_by_pynastran.py"
    subprocess.run([python, str(script), str(where)], check=True, env=alone, stdout=subprocess.DEVNULL)
    with np.load(where / "read.npz") as read:
        op4 = Superelement(read["MCB"], read["CCB"], read["KCB"], read["RCB"], d)
        # Points without an entry, such as the base in the stiffness, are not in what it gives.
        points = sorted(map(tuple, read["mcb_columns"]))
        full = []
        for name in ("mcb", "bcb", "kcb"):
            at = [points.index(tuple(point)) for point in read[f"{name}_columns"]]
            full.append(np.zeros((len(points),) * 2))
            full[-1][np.ix_(at, at)] = read[name]
        dmig = Superelement(*full, read["RCB"], d)
    return {"pynastran op4": _off(op4.driven(freq), right), "pynastran dmig": _off(dmig.driven(freq), right)}


def _mat(it: sysid.Identification, where: Path, freq: np.ndarray, right: tuple[np.ndarray, ...]) -> float:
    """Accelerations by the file's state space; forces by its modes, and by M and K, which hold the rigid motion."""
    read = scipy.io.loadmat(sysid.export(it, where / "m.mat"))
    A, B, C, D, M, K = (read[name] for name in ("A", "B", "Cy", "D", "M", "K"))
    n, s = len(M) - D.shape[1], 2j * np.pi * freq[:, None, None]
    H = C @ np.linalg.solve(s * np.eye(len(A)) - A, np.broadcast_to(B + 0j, (freq.size, *B.shape))) + D
    f, zeta, gamma = (
        np.concatenate([read[name], read[f"{name}_residual"].reshape(-1, read[name].shape[1])])
        for name in ("f_hz", "zeta", "Gamma")
    )
    rigid = np.vstack([-np.linalg.solve(K[:n, :n], K[:n, n:]), np.eye(D.shape[1])])
    g = freq**2 / (f**2 - freq**2 + 2j * zeta * f * freq)
    Z = np.einsum("ke,kf,kd->edf", gamma, g, gamma) + (rigid.T @ M @ rigid)[..., None]
    return _off((np.moveaxis(H, 0, -1), Z), right)


def _uff(it: sysid.Identification, where: Path) -> float:
    """Largest relative difference of frequencies and ratios, and of shapes over the largest of each mode."""
    import pyuff

    file = pyuff.UFF(str(sysid.export(it, where / "m.unv")))
    modes = [file.read_sets(int(k)) for k in np.flatnonzero(file.get_set_types() == 55)]
    s, shapes = it.structure, np.transpose([mode["r1"] for mode in modes])
    off = np.max(np.abs(shapes - s.mode_shapes) / np.max(np.abs(s.mode_shapes), axis=0))
    pairs = ("freq", s.natural_frequencies), ("modal_damp_vis", s.damping_ratios)
    return max(float(off), *(_digits(np.array([mode[name] for mode in modes]), right) for name, right in pairs))


def _in_time(s: sysid.Structure, taken: Superelement, truth: Continuous) -> float:
    """Largest rms difference of a channel in time over its rms, under random motion that rises from zero, and falls."""
    rate, first = RATE * truth.lines[1], float(s.natural_frequencies[0])
    rng, directions = np.random.default_rng(7), np.eye(len(truth.base))
    motion = random_motion(rng, PERIODS / first, rate, truth.lines, correlation=directions)
    base = motion.in_time(motion.amplitudes, FACTOR)
    edge = RISE * base.shape[1]
    near = np.minimum(np.arange(base.shape[1]), np.arange(base.shape[1])[::-1]) / edge
    base = base * (1 - np.cos(np.pi * np.minimum(near, 1.0))) / 2
    apart = [whole[:, ::FACTOR] for whole in taken.integrated(base, 1 / (FACTOR * rate))]
    coarse = base[:, ::FACTOR]
    pairs = zip((s.simulate(coarse, rate), s.simulate_force(coarse, rate)), apart, strict=True)
    worst = 0.0
    for found, right in pairs:
        left = np.linalg.norm((found - right)[:, END:-END], axis=1) / np.linalg.norm(right[:, END:-END], axis=1)
        worst = max(worst, float(np.max(left)))
    return worst


def _coupled(taken: Superelement, truth: Continuous, test: Draw, fitted: sysid.Measurement) -> dict[str, float]:
    """The superelement under the base motion of the test, beside what was recorded; and beside the truth, beyond too.

    `fitted` is the test without its transients. The noise of the base is driven too.
    """
    freq, last = test.omega / (2 * np.pi), truth.count
    both = np.concatenate(taken.driven(freq))
    left = np.concatenate([fitted.response, fitted.force], axis=1) - np.einsum("cdf,rdf->rcf", both, fitted.base)
    variance = test.own_std[..., None] ** 2 + np.sum(np.abs(both * test.base_std[:, None]) ** 2, axis=1)
    scale = np.linalg.norm(fitted.base) / np.linalg.norm(test.base)  # of its Fourier transform
    figures = {"test": float(np.sqrt(np.mean(np.abs(left / scale) ** 2 / variance)))}
    end = truth.lines[1] + GAP * (truth.frequencies[last] - truth.lines[1])
    for name, at in (("drive", freq), ("beyond", np.linspace(truth.lines[1], end, 50))):
        pairs = zip(taken.driven(at), transfer(truth.modes, 2 * np.pi * at), strict=True)
        figures[name] = max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)
    return figures


if __name__ == "__main__":
    answer(case)
