"""Judgement of modes of whole records, by products of many at once, against plain loops and matrices written out."""

from dataclasses import replace

import numpy as np
import pytest

import sysid
from sysid.modal_analysis import model_order
from sysid.modal_analysis.first_modes import leads_to
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import units_of
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import Run
from sysid.modal_analysis.model_order import (
    joint_worth,
    least_of,
    least_worth,
    peaks_of,
    pruned,
    trials_of,
    without_weak_modes,
    worth,
)
from sysid.modal_analysis.noise_levels import ErrorSpectra, _likelihood
from sysid.modal_analysis.record_fit import ROUGH, Limits, as_one, record_modes, refitted

RATE, SECONDS = 40.0, 40.0
REACH = 15.0  # half-power widths


def two_runs(force, seed=3, noise=0.02, n=2):
    """Runs of three storeys with noise of all channels; the second stands still at both ends."""
    rng = np.random.default_rng(seed)
    K = np.array([[5e3, -2e3, 0, -3e3], [-2e3, 4e3, -2e3, 0], [0, -2e3, 2e3, 0], [-3e3, 0, 0, 3e3]])
    structure = sysid.Structure(np.diag([2.0, 1.5, 1.0, 1.0]), K, [0.01, 0.012, 0.02], n_base=1)
    runs = []
    for _ in range(n):
        base = rng.standard_normal((1, int(RATE * SECONDS)))
        clean = (base, structure.simulate(base, RATE), structure.simulate_force(base, RATE))
        noisy = [one + noise * np.std(one) * rng.standard_normal(one.shape) for one in clean]
        runs.append((*noisy[:2], noisy[2] if force else None))
    test = sysid.Measurement.from_time(
        runs, RATE, rigid_body=np.ones((3, 1)), band=(1.0, 15.0), estimator="records", at_rest=[False, True][:n]
    )
    return test, 2 * np.pi * structure.natural_frequencies


@pytest.fixture(scope="module", params=[True, False], ids=["force", "no force"])
def fit_of_two(request):
    """The two lowest of three modes."""
    test, omega = two_runs(request.param)
    fit = record_modes(test, omega[:2], np.full(2, 0.012))
    return refitted(fit, fit.parameters), omega[2]


def inverse_root(matrix):
    lam, V = np.linalg.eigh(matrix)
    return V / np.sqrt(lam) @ V.T


def fall(fit, omega, ratio):
    """Fall of e' S^-1 e by the likeliest residue of rank one at a pole, line by line."""
    model = fit.model
    c, inputs = model.channels, model.d + 2 * len(model.moving)
    gradient, S, U, power = np.zeros((c, inputs)), np.zeros((c, c)), np.zeros((inputs, inputs)), 0.0
    for chunk in model.chunks(fit.parameters):
        run, levels = chunk.run, fit.levels[chunk.run.piece] * chunk.run.density
        u = chunk.inputs(chunk.weighed(fit.levels).base)
        for at in np.flatnonzero(np.abs(run.w - omega) <= 2 * REACH * ratio * omega):
            w, T = run.w[at], chunk.H[:, :, at]
            inverse = np.linalg.inv(np.diag(levels[:c]) + T @ np.diag(levels[c:]) @ T.conj().T)
            g = w**2 / (omega**2 - w**2 + 2j * ratio * omega * w)
            gradient += np.outer(inverse @ chunk.error[:, at], (g * u[:, at]).conj()).real
            S += abs(g) ** 2 * inverse.real
            U += abs(g) ** 2 * np.outer(u[:, at], u[:, at].conj()).real
            power += abs(g) ** 2
    size = np.sqrt(np.diag(U))
    return (
        np.linalg.svd(inverse_root(S / power) @ (gradient / size) @ inverse_root(U / np.outer(size, size)))[1][0] ** 2
    )


def test_worth_of_trial_poles_is_that_of_a_plain_loop(fit_of_two):
    fit, _ = fit_of_two
    trials = trials_of(fit)
    worth_of_each, shapes, loads = trials.likeliest()
    assert set(trials.ratios) == {0.004, 0.012, 0.036}
    for k in np.random.default_rng(0).choice(worth_of_each.size, 8, replace=False):
        assert worth_of_each[k] == pytest.approx(fall(fit, trials.omega[k], trials.ratios[k]), rel=1e-8)
        # The fall of the quadratic that gradient and normal matrix make, at this residue.
        residue = np.outer(shapes[k], loads[k])
        bend = np.einsum("ci,ce,ij,ej->", residue, trials.weights[k], trials.power[k], residue)
        assert 2 * np.sum(trials.gradient[k] * residue) - bend == pytest.approx(worth_of_each[k], rel=1e-8)


def test_the_mode_that_is_missing_is_the_worthiest_peak(fit_of_two):
    fit, missing = fit_of_two
    peaks = peaks_of(fit, 30.0)
    assert peaks[0].omega == pytest.approx(missing, rel=0.03)
    for i, one in enumerate(peaks):
        apart = [abs(np.log(one.omega / other.omega)) for other in peaks[:i]]
        assert all(distance > 2 * one.ratio for distance in apart)


def test_peaks_are_asked_for_between_two_frequencies(fit_of_two):
    fit, missing = fit_of_two
    low, high = 0.8 * missing, 0.95 * missing  # beside the worthiest
    peaks = peaks_of(fit, least_worth(fit.model), within=(low, high))
    assert peaks and all(low <= one.omega <= high for one in peaks)


def test_modes_lead_to_the_end_of_a_fit_that_has_them_within_the_lines(fit_of_two):
    fit, missing = fit_of_two
    modes, last = fit.parameters.modes, 2 * np.pi * fit.test.freq[-1]
    assert leads_to(fit, modes)
    assert not leads_to(fit, modes.at([0]))
    assert not leads_to(fit, modes._replace(omega=np.array([modes.omega[0], missing])))
    assert not leads_to(replace(fit, settled=False), modes)
    above = replace(fit, parameters=fit.parameters.with_modes(
        modes._replace(omega=np.array([modes.omega[0], 1.2 * last])), fit.parameters.ends
    ))  # fmt: skip
    assert leads_to(above, modes._replace(omega=np.array([modes.omega[0], 1.5 * last])))


def test_a_pole_above_the_lines_without_damping_holds_no_other_mode(fit_of_two):
    """Its damping hardly shows: a step of its logarithm as long as that allows is beyond all measure."""
    fit, _ = fit_of_two
    modes, last = fit.parameters.modes, 2 * np.pi * fit.test.freq[-1]
    above = Modes(0.3 * modes.phi[:, :1], modes.gamma[:1], np.array([1.5 * last]), np.array([1e-13]))
    moved = modes._replace(omega=1.001 * modes.omega).joined(above)
    p = fit.parameters.with_modes(moved, np.vstack([fit.parameters.ends, fit.parameters.ends[:1]]))
    again = refitted(fit, p)
    assert again.likelihood > fit.likelihood - 1.0
    assert again.parameters.modes.omega[:-1] == pytest.approx(modes.omega, rel=1e-4)


def test_steps_end_where_one_gains_less_than_it_must(fit_of_two):
    fit, _ = fit_of_two
    modes = fit.parameters.modes
    p = fit.parameters.with_modes(modes._replace(omega=1.002 * modes.omega), fit.parameters.ends)
    ends = [refitted(fit, p, limits=Limits(1, *one)) for one in ((60, 0, 1e12), (1, 0, 0.0), (60, 0, 0.0))]
    assert ends[0].likelihood == ends[1].likelihood < ends[2].likelihood and not ends[0].settled


def test_worth_is_the_schur_complement_of_all_else(fit_of_two):
    fit, _ = fit_of_two
    model, p, unit = fit.model, fit.parameters, units_of(fit.normal)
    N, index = fit.normal * np.outer(unit, unit), fit.model.index

    def by_solving(modes):
        shape = np.array([index.phi.start + s * model.m + k for k in modes for s in range(model.n)])
        ends = model.n_ends // model.m
        gone = [
            at for k in modes for at in (
                *(index.gamma.start + k * model.d + np.arange(model.d)), index.log_omega.start + k,
                index.log_ratios.start + k, *(model.kept + k * ends + np.arange(ends)),
            )
        ]  # fmt: skip
        others = np.setdiff1d(np.arange(model.size), np.concatenate([shape, gone]))
        cross = N[np.ix_(others, shape)]
        inner = N[np.ix_(others, others)] + 1e-10 * np.eye(others.size)
        left = N[np.ix_(shape, shape)] - cross.T @ np.linalg.solve(inner, cross)
        phi = p.modes.phi[:, modes].T.ravel() / unit[shape]
        return phi @ left @ phi

    np.testing.assert_allclose(worth(fit), [by_solving([0]), by_solving([1])], rtol=1e-5)
    assert joint_worth(fit)(np.array([True, True])) == pytest.approx(by_solving([0, 1]), rel=1e-5)


def test_the_likelihood_of_levels_is_that_of_covariances_written_out():
    rng = np.random.default_rng(1)
    c, d, lines, density = 4, 2, 15, 0.7
    z = rng.standard_normal((2, c, 1 + d, lines))
    e, H = z[0, :, 0] + 1j * z[1, :, 0], z[0, :, 1:] + 1j * z[1, :, 1:]
    x = rng.uniform(-1, 1, c + d)
    run = Run(np.ones(lines), np.zeros((d, lines), complex), np.zeros_like(e), density, 0, np.ones(lines), 0)
    value, _, fisher = _likelihood([ErrorSpectra(e, H, run)], {0: np.eye(c + d)}, x)
    v, made, information = density * np.exp(x), 0.0, np.zeros((c + d, c + d))
    for at in range(lines):
        directions = np.hstack([np.eye(c), H[:, :, at]])
        S = (directions * v) @ directions.conj().T
        slopes = [v[i] * np.outer(directions[:, i], directions[:, i].conj()) for i in range(c + d)]
        G = np.linalg.inv(S)
        made -= np.linalg.slogdet(S)[1] + (e[:, at].conj() @ G @ e[:, at]).real
        information += [[np.trace(G @ a @ G @ b).real for b in slopes] for a in slopes]
    assert value == pytest.approx(made, rel=1e-12)
    np.testing.assert_allclose(fisher, information, rtol=1e-10)


@pytest.mark.parametrize("seed, noise, near", [(5, 1e-3, 1.005), (32, 1e-3, 1.01)])
def test_a_mode_that_its_neighbour_makes_look_worth_something_goes(seed, noise, near):
    """Three modes and one close to the third: beside it the fourth explains much, and alone the third does."""
    test, omega = two_runs(True, seed, noise, n=1)
    fit = record_modes(test, np.append(omega, near * omega[2]), np.full(4, 0.012))
    fit = refitted(fit, fit.parameters)
    assert fit.settled and np.min(worth(fit)) > least_worth(fit.model) and pruned(fit, FitMonitor()) is fit
    fewer = without_weak_modes(fit, FitMonitor())
    np.testing.assert_allclose(np.sort(fewer.parameters.modes.omega), omega, rtol=1e-3)
    assert fit.likelihood - fewer.likelihood < least_worth(fit.model)
    assert without_weak_modes(fewer, FitMonitor()) is fewer


def test_a_mode_that_another_one_had_cancelled_becomes_one_with_it():
    test, omega = two_runs(False, n=1)
    right = record_modes(test, omega, np.full(3, 0.012))
    right = refitted(right, right.parameters)
    p = right.parameters
    twice = p.at(np.array([0, 0, 1, 2]))  # of the first mode fifty times too much, and as much less of one next to it
    twice.modes.phi[:, 0] *= 51
    twice.modes.phi[:, 1] *= -50
    one = as_one(replace(right, parameters=twice), np.array([True, True, False, False]), 1)
    for found, expected in zip(one.modes[2:], p.modes[2:], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    for weights in (lambda q: q.modes.gamma, lambda q: q.ends):  # a shape and its participation share a factor
        for k in range(3):
            found, expected = (np.outer(q.modes.phi[:, k], weights(q)[k]) for q in (one, p))
            np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_two_that_cancelled_each_other_begin_as_one_where_one_alone_leads_away(monkeypatch):
    test, omega = two_runs(False, n=1)
    split = record_modes(test, np.append(omega, 1.0001 * omega[2]), np.full(4, 0.012))
    split = refitted(split, split.parameters, limits=ROUGH)
    assert np.count_nonzero(least_of(split)) == 1  # noise explains one of them
    starts = []

    def leads_away(fit, start, **how):
        starts.append(start)
        found = refitted(fit, start, **how)
        return replace(found, chi2=found.chi2 + 1e6) if len(starts) == 1 else found

    monkeypatch.setattr(model_order, "refitted", leads_away)
    fewer = pruned(split, FitMonitor())
    assert len(starts) == 2 and starts[1].modes.omega.size == 3
    np.testing.assert_allclose(np.sort(fewer.parameters.modes.omega), omega, rtol=1e-3)
    assert split.likelihood - fewer.likelihood < least_worth(split.model)
