"""Figures of one draw of a kind of test: written, read and run by the command line, and beside the truth."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import sysid
from benchmarks.band.one_structure import OF_MASS
from benchmarks.laboratory.kinds import KINDS, Case
from benchmarks.laboratory.rigs import Rig
from benchmarks.mistakes.named_mistakes import MISTAKES
from benchmarks.records.coupled_records import NEAR, matched
from benchmarks.records.simulated import Modes

TOLERANCE = "0.005"  # what --gain-std states


def figures(kind: str, draw: int) -> dict[str, Any]:
    """Figures of a draw; "said" holds the line of a command line that refuses."""
    rng = np.random.default_rng((draw, 29, list(KINDS).index(kind)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of pyuff
            case = KINDS[kind](rng, folder)
        (folder / "list.toml").write_text(case.sensors, encoding="utf-8")
        files = [str(path) for path in case.files]
        read, _ = command("read", *files, "--sensors", str(folder / "list.toml"), "--out", str(folder / "test.h5"))
        true = (case.rig.shown.omega[: case.rig.count] / (2 * np.pi)).tolist()
        told = {"kind": kind, "draw": draw, "what": case.rig.name, "end": case.rig.end, "true": true}
        if read.returncode:
            return told | {"refused": last_line(read)}
        asked = ["run", str(folder / "test.h5"), "--gain-std", TOLERANCE, *case.options, "--out", str(folder / "out")]
        run, seconds = command(*asked)
        told |= {"seconds": seconds, "read": read.stdout}
        if run.returncode not in (0, 1):
            return told | {"refused": last_line(run)}
        result = sysid.load(folder / "out" / "result.h5")
        return told | _beside(result, case)


def command(*arguments: str) -> tuple[subprocess.CompletedProcess[str], float]:
    """``sysid ARGUMENTS`` in a process of its own, and the seconds of processor time that it takes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "sysid", *arguments], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return done, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def last_line(done: subprocess.CompletedProcess[str]) -> str:
    """What a command said last."""
    return (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]


def _beside(result: sysid.Identification, case: Case) -> dict[str, Any]:
    """An answer beside the truth: errors over deviations, by what they are of."""
    rig, found, known = case.rig, result.structure, result.uncertainty
    low, high = result.measurement.freq[[0, -1]]
    modes = rig.shown
    f, true = found.natural_frequencies, modes.omega / (2 * np.pi)
    mine = np.flatnonzero((f >= low) & (f <= high))
    maybe = np.flatnonzero((true >= low) & (true <= high))  # of which those at the end, or beyond the motion, may lack
    must = maybe[(maybe < rig.count) & (true[maybe] * (1 + modes.zeta[maybe]) <= high)]
    near = np.maximum(NEAR[1] * modes.zeta[maybe] * true[maybe], NEAR[0] * np.nanmax(known.natural_frequencies))
    pairs = np.array(matched(true[maybe], f[mine], near), dtype=int).reshape(-1, 2)
    at, mine = maybe[pairs[:, 0]], mine[pairs[:, 1]]
    counted = bool(np.isin(must, at).all() and np.isin(np.flatnonzero((f >= low) & (f <= high)), mine).all())
    told: dict[str, Any] = {
        "word": result.judgement, "right": result.judgement == case.word, "counted": counted, "found": f.tolist(),
        "accused": [f"{one.kind}: {one.channel or one.sentence[:60]}" for one in result.findings if accuses(one)],
        "against": [f"{one.severity} {one.kind} {one.channel or ''}: {one.sentence[:160]}" for one in result.findings
                    if one.severity != "note"],
        "notes": [f"{one.kind} {one.channel or ''}" for one in result.findings if one.severity == "note"],
        "residual": result.residual, "band": [float(low), float(high)], "off": {},
    }  # fmt: skip
    off = told["off"]
    off["f"] = _over(f[mine] - true[at], known.natural_frequencies[mine])
    off["zeta"] = _over(found.damping_ratios[mine] - modes.zeta[at], known.damping_ratios[mine])
    if counted and case.drifts:
        off["drift"] = _drifts(result, rig, at)
    if counted and result.determined and found.n == at.size and np.all(found.dof_sensors >= 0):
        off |= _matrices(result, modes, at)
    return told


def accuses(one: sysid.Finding) -> bool:
    """True of a finding that speaks against a record or a stated mass, which are all right but for clocks and hum."""
    heavy = one.severity in ("blocking", "contradicts", "caution")
    of_record = one.channel is not None or one.kind in MISTAKES | OF_MASS
    return heavy and of_record and one.kind not in ("late sensor", "tone")


def _over(error: np.ndarray, std: np.ndarray) -> list[float]:
    return [float(one) for one in np.ravel(error / std)]


def _matrices(result: sysid.Identification, modes: Modes, true: np.ndarray) -> dict[str, list[float]]:
    """Errors of M_SS and K_SS against those of the true modes at the same sensors, each entry once."""
    inverse = np.linalg.inv(modes.shapes[np.ix_(result.structure.dof_sensors, true)])
    off = {}
    for name, what, size in (("M", "mass", 1.0), ("K", "stiffness", modes.omega[true, None] ** 2)):
        std = getattr(result.uncertainty, what)
        error = getattr(result.structure, what)[: true.size, : true.size] - inverse.T @ (size * inverse)
        entries = np.tril(std > 0)  # those that a stated form leaves zero have none
        off[name] = _over(error[entries], std[entries])
    return off


def _drifts(result: sysid.Identification, rig: Rig, true: np.ndarray) -> list[float]:
    """Errors of what each storey's drift is for unit base motion, at the natural frequencies, over their deviations."""
    f, modes = rig.frequencies[true], rig.modes
    w, k = 2 * np.pi * f, modes.omega[true, None]
    g = w**2 / (k**2 - w**2 + 2j * modes.zeta[true, None] * k * w)
    drift = np.diff(modes.shapes[:, true], axis=0, prepend=0.0) @ (g * modes.gamma[true])
    mine = result.structure.mode_shapes
    omega, zeta = 2 * np.pi * result.structure.natural_frequencies[:, None], result.structure.damping_ratios[:, None]
    g = w**2 / (omega**2 - w**2 + 2j * zeta * omega * w)
    found = np.diff(mine, axis=0, prepend=0.0) @ (g * result.structure.participation)
    spectra = result.uncertainty._spectra  # deviations of differences of sensors follow from its moves
    differences = replace(
        spectra, modes=spectra.modes._replace(phi=np.diff(spectra.modes.phi, axis=0, prepend=0.0)),
        moves=spectra.moves._replace(phi=np.diff(spectra.moves.phi, axis=0, prepend=0.0)),
    )  # fmt: skip
    return _over(np.abs(found - drift), differences.transmissibility(f)[:, 0])
