"""Noisy tests of a spacecraft of the size of the field's best published case: six base directions, 20 modes."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line, below
from benchmarks.modal.identification import error_text, identify_records
from benchmarks.modal.six_axis_dummy import BAND, dummy

NOISE, LINES, BOUND = 0.01, 1200, 0.01


def lines(reduced: bool) -> Iterator[Line]:
    """Spacecraft dummy: 14 sensors, six base directions with force, 20 modes to 200 Hz."""
    draws = range(1 if reduced else 5)
    truth, length = dummy()
    freq = np.linspace(*BAND, LINES)
    errors, found, seconds, said = [], [], [], []
    for draw in draws:
        test = sysid.simulate(truth, freq, noise=NOISE, force=True, rng=draw)
        begun = time.perf_counter()
        try:
            result = identify_records(test)
        except Exception as error:  # a crash is an answer too, and must not end the others
            errors.append((np.inf, np.inf, np.inf))
            said.append(f"draw {draw}: {error_text(error)}")
            continue
        seconds.append(time.perf_counter() - begun)
        s = result.structure
        pairs = (
            (s.transmissibility(freq), truth.transmissibility(freq)),
            (s.base_force(freq), truth.base_force(freq)),
            (s.rigid_body_mass, truth.rigid_body_mass),
        )
        errors.append(tuple(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs))
        found.append(s.n)
    worst = np.max(errors, axis=0)
    what = (
        f"spacecraft dummy, {truth.n_sensors} sensors, {truth.n_base} base directions with force, {truth.n} modes to "
        f"{truth.natural_frequencies[-1]:.0f} Hz, 1 % noise, {len(draws)} draws: "
    )
    yield below(
        what + "largest relative error of the transmissibility" + "".join(f"; {s}" for s in said), worst[0], BOUND
    )
    yield below(what + "largest relative error of the apparent mass", worst[1], BOUND)
    text = (
        f"largest relative error of the 6 x 6 rigid-body mass (rotations times L = {length:.3f} m, radius of gyration)"
    )
    yield below(what + text, worst[2], BOUND)
    yield Line(what + "modes found; seconds a run", f"{found}; {np.round(seconds, 1).tolist()}")
