"""Transients that a known structure predicts of whole records: traces of detrending, and motion at the ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.modal.random_structures import frequency_lines, random_structure
from sysid import simulate
from sysid.measurement.whole import WholeRecords
from sysid.modal_analysis.misfit import without_transients_of


@pytest.mark.parametrize("at_rest", [True, False])
def test_traces_are_taken_off_every_run_and_motion_at_the_ends_off_those_not_at_rest(at_rest: bool) -> None:
    truth = random_structure(1, n=3, d=1)
    plain = simulate(truth, frequency_lines(truth), force=True)
    assert plain.force is not None
    rng, w, n = np.random.default_rng(0), 2 * np.pi * plain.freq, truth.n
    size = np.sqrt(np.mean(np.abs(plain.response) ** 2))
    kinds = np.stack([np.ones_like(w) + 0j, 1j * w / w[-1], w[0] / 1j / w])
    traces = size * rng.normal(size=(plain.n_sensors, 3)) @ kinds
    whole = WholeRecords((1000,), 100.0, (at_rest,))
    drifting = replace(plain, response=plain.response + traces, response_std=None, force_std=None, whole=whole)
    assert without_transients_of(drifting, truth).residual(truth) < 1e-9
    stiffness = truth.stiffness[:n, :n] - w[:, None, None] ** 2 * truth.mass[:n, :n]
    Z = stiffness + 1j * w[:, None, None] * truth.damping
    velocity = rng.normal(size=n)  # its change over the run
    ends = np.linalg.solve(Z, (truth.stiffness[:n, :n] @ velocity)[None, :, None])[..., 0]
    push = truth.mass[:n, :n] @ truth.rigid_body_dofs + truth.mass[:n, n:]
    ends *= size / np.sqrt(np.mean(np.abs(ends) ** 2))
    moving = replace(
        drifting, response=drifting.response + truth.recovery @ ends.T, force=plain.force + push.T @ ends.T
    )
    left = without_transients_of(moving, truth).residual(truth)
    assert left > 0.01 if at_rest else left < 1e-9
