"""Modes of spectra as a modal estimate: exact where the records are, and said to be lacking where these fix none."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import sysid
from benchmarks.modal.random_structures import frequency_lines, random_structure
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.spectra_modes import fit_modes_of_lines
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.nlp import IterationMonitor


def fitted(test: sysid.Measurement, count: int | None = None) -> ModalEstimate:
    """The estimate with the modes of its lines."""
    return fit_modes_of_lines(
        ModalEstimate.of_lines(test), find_poles(test), np.ones(test.n_base), count=count,
        monitor=IterationMonitor(None, None), max_iterations=100,
    )  # fmt: skip


@pytest.mark.parametrize("force", [False, True])
def test_modes_of_exact_spectra_are_those_of_the_structure(force):
    truth = random_structure(11, n=5, d=2)
    modal = fitted(sysid.simulate(truth, frequency_lines(truth), force=force))
    np.testing.assert_allclose(modal.omega / (2 * np.pi), truth.natural_frequencies, rtol=1e-7)
    np.testing.assert_allclose(modal.ratios, truth.damping_ratios, rtol=1e-6)
    residues, expected = (
        np.einsum("nk,kd->knd", shapes, pushes)
        for shapes, pushes in ((modal.phi, modal.gamma), (truth.mode_shapes, truth.participation))
    )
    np.testing.assert_allclose(residues, expected, atol=1e-6 * np.abs(expected).max())
    if force:
        np.testing.assert_allclose(modal.gamma.T @ modal.gamma, truth.participation.T @ truth.participation, rtol=1e-5)
        size = np.abs(truth.rigid_body_mass).max()
        np.testing.assert_allclose(modal.rigid, truth.rigid_body_mass, atol=1e-6 * size)
    assert not modal.by_modes and modal.fit is not None and not modal.lacking


def test_the_fit_stands_still_in_the_weights_that_channels_have_in_each_run():
    """Half the fall of chi² that a Gauss-Newton step from it promises, its Jacobian by differences."""
    truth, rng = random_structure(11, n=4, d=2), np.random.default_rng(5)
    clean = sysid.simulate(truth, frequency_lines(truth, 150))
    base = np.einsum("re,edf->rdf", np.array([[1.0, 0.2], [-0.3, 1.0], [0.6, 0.7]]), clean.base)
    response = np.einsum("re,enf->rnf", base[:, :, 0], clean.response)
    std = 0.01 * rng.uniform(0.2, 5.0, (3, 4, 1)) * np.abs(response).mean()
    noise = rng.normal(size=(2, *response.shape)) * std / np.sqrt(2)
    test = replace(clean, base=base, response=response + noise[0] + 1j * noise[1], response_std=std)
    modal = fitted(test)
    m, w, w_k = modal.omega.size, 2 * np.pi * test.freq, modal.omega[:, None]
    assert m == 4

    def errors(x):
        phi, gamma, poles = np.split(x, [4 * m, 6 * m])
        shift, loss = poles.reshape(2, m, 1)
        at, ratios = w_k * np.exp(shift * modal.ratios[:, None]), modal.ratios[:, None] * np.exp(loss)
        q = w**2 / (at**2 - w**2 + 2j * ratios * at * w) * np.einsum("kd,rdf->rkf", gamma.reshape(m, 2), base)
        left = ((test.relative - np.einsum("nk,rkf->rnf", phi.reshape(4, m), q)) / std).ravel()
        return np.concatenate([left.real, left.imag])

    x = np.concatenate([modal.phi.ravel(), modal.gamma.ravel(), np.zeros(2 * m)])
    steps = 1e-5 * np.diag(np.where(x == 0, 1.0, np.abs(x)))
    J, left = np.array([errors(x + h) - errors(x - h) for h in steps]).T, errors(x)
    assert np.linalg.norm(J @ np.linalg.lstsq(J, left, rcond=1e-9)[0]) < 1e-4
    assert np.sum(left**2) == pytest.approx(left.size / 2, rel=0.1)


def test_fewer_modes_are_those_that_the_records_feel_most():
    truth = random_structure(11, n=5, d=2)
    test = sysid.simulate(truth, frequency_lines(truth), noise=0.01, rng=3)
    modal = fitted(test, 2)
    gaps = np.abs(modal.omega[:, None] / (2 * np.pi) / truth.natural_frequencies - 1).min(axis=1)
    assert modal.omega.size == 2 and np.all(gaps < 0.05)
    many = fitted(test, 9)
    assert many.lacking and many.omega.size == 0 and many.fit is None


def test_a_base_that_moves_in_too_few_directions_is_told_and_fixes_no_modes():
    truth = random_structure(11, n=5, d=2)
    test = sysid.simulate(truth, frequency_lines(truth))
    alike = replace(test, base=np.repeat(test.base[:1], 2, axis=0), response=np.repeat(test.response[:1], 2, axis=0))
    modal = fitted(alike)
    assert modal.lacking and modal.omega.size == 0 and modal.fit is None


def test_the_modes_of_spectra_stand_in_the_result_and_are_those_of_its_structure_where_nothing_else_is_stated():
    truth = random_structure(12, n=4, d=1)
    test = sysid.simulate(truth, frequency_lines(truth), force=True, noise=0.005, rng=1)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    deviation = result.uncertainty.natural_frequencies
    found = result.modal[0].omega / (2 * np.pi)
    assert np.all(np.abs(found - result.structure.natural_frequencies) < 0.01 * deviation)


def test_a_written_model_fits_no_modes_and_looks_for_poles_once(monkeypatch):
    """A check of units before the search, and the box of the damping ratios, read the same poles of one estimate."""
    from sysid.modal_analysis import fit, vector_fitting

    calls, find = [], vector_fitting._find
    monkeypatch.setattr(vector_fitting, "_find", lambda *args: calls.append(1) or find(*args))
    estimates, of_lines = [], fit._of_lines
    monkeypatch.setattr(fit, "_of_lines", lambda *args: estimates.append(1) or of_lines(*args))
    m, k = np.array([2.0, 1.0]), np.array([3e3, 2e3])
    K = np.array([[k.sum(), -k[1], -k[0]], [-k[1], k[1], 0.0], [-k[0], 0.0, k[0]]])
    truth = sysid.Structure(np.diag([*m, 0.0]), K, [0.02, 0.02], n_base=1)
    test = sysid.simulate(truth, frequency_lines(truth, 200), force=True, noise=0.005, rng=1)
    problem = sysid.Problem(test, mass=sysid.LumpedMass(), stiffness=sysid.ChainStiffness(1e2, 1e5))
    result = sysid.identify(problem, rng=0)
    assert result.success and result.modal[0].omega.size == 0
    assert len(calls) == len(estimates) == 1

    def endless(test, delays, calibration, monitor):
        with monitor.at_work():
            for _ in range(500):
                time.sleep(0.01)
                monitor.check()
        pytest.fail("five seconds, and nobody stopped it")

    monkeypatch.setattr(fit, "_of_lines", endless)
    with pytest.raises(sysid.SolverError, match="the time was over"):
        sysid.identify(problem, rng=0, max_time=0.5)
