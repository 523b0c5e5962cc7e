"""Errors that grow with the signal: their likelihood, its derivatives, and which spectra are taken to have them."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.optimize import approx_fprime

import sysid
from benchmarks.laboratory.stepped_tests import frame, spoiled
from sysid.measurement.channels import without_delays
from sysid.measurement.whole import SteadyLines
from sysid.modal_analysis.delays import Delays
from sysid.modal_analysis.fit import fit_modes
from sysid.modal_analysis.growing_errors import scatter_of_lines
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import Parameters
from sysid.modal_analysis.noise_levels import _designs, _likelihood, _parts
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.residual_tests import delays_of

SHARES = 0.003, 0.01


@pytest.fixture(scope="module", params=[False, True])
def model_at(request):
    """A model of three modes and two base directions at arbitrary parameters, coupled or not, and its levels."""
    rng = np.random.default_rng(3)
    n, d, m, lines, runs = 3, 2, 3, 40, 2
    draw = lambda *shape: rng.standard_normal((*shape, 2)) @ [1, 1j]  # noqa: E731
    freq = np.sort(rng.uniform(2.0, 20.0, lines))
    test = sysid.Measurement(
        freq, draw(runs, d, lines), draw(runs, n, lines), rigid_body=rng.standard_normal((n, d)),
        force=draw(runs, d, lines), base_axes=("x", "y"),
    )  # fmt: skip
    modes = Modes(
        rng.standard_normal((n, m)), rng.standard_normal((m, d)), np.array([30.0, 50.0, 90.0]), np.full(m, 0.1)
    )
    coupling = np.array([[0, 1.0, 0.5], [1.0, 0, 2.0], [0.5, 2.0, 0]]) if request.param else None
    p = Parameters(modes, np.array([[9.0, 1.0], [1.0, 7.0]]), np.zeros((m, 0)), np.zeros((runs, n + d, 0)), coupling)
    whole = SteadyLines.of(runs, freq)
    model = RecordModel(replace(test, whole=whole), m, coupled=request.param).at_signal(p)
    levels = np.hstack([rng.uniform(0.5, 2.0, (runs, n + 2 * d)), rng.uniform(*SHARES, (runs, n + 2 * d))])
    return model, p, levels


def dense(model, p, levels):
    """Covariance of the errors at each line of each run by the formula, (c, c), the errors and H."""
    c = model.channels
    for run in model.runs:
        lines = model.chunk(p, run)
        H, signal = np.moveaxis(lines.H, -1, 0), np.abs(np.vstack([run.outputs - lines.error, run.base])) ** 2
        own, shares = np.split(levels[run.piece], 2)
        for k in range(run.w.size):
            v = own + shares * signal[:, k]
            yield np.diag(v[:c]) + H[k] @ np.diag(v[c:]) @ H[k].conj().T, lines.error[:, k]


def test_errors_weigh_by_the_inverse_of_their_whole_covariance(model_at) -> None:
    model, p, levels = model_at
    expected = sum((e.conj() @ np.linalg.solve(S, e)).real for S, e in dense(model, p, levels))
    assert model.chi2(p, levels) == pytest.approx(expected, rel=1e-10)


def test_the_likelihood_of_shares_is_that_of_complex_normal_errors_and_its_score_the_slope(model_at) -> None:
    model, p, levels = model_at
    expected = sum(
        -np.linalg.slogdet(S)[1] - (e.conj() @ np.linalg.solve(S, e)).real for S, e in dense(model, p, levels)
    )
    parts, x = _parts(model, p), np.log(levels)
    found = [
        _likelihood([one for one in parts if one.run.piece == r], _designs(model, r, x.shape[1]), x[r]) for r in (0, 1)
    ]
    assert sum(one[0] for one in found) == pytest.approx(expected, rel=1e-10)
    for r, (_, score, fisher) in enumerate(found):
        of_run, D = [one for one in parts if one.run.piece == r], _designs(model, r, x.shape[1])
        slope = approx_fprime(x[r], lambda x, of_run=of_run, D=D: _likelihood(of_run, D, x)[0], 1e-6)
        np.testing.assert_allclose(score, slope, rtol=1e-4, atol=1e-3)
        # Information of complex normal errors: tr(S^-1 dS S^-1 dS'), here of a run's first sensor and base direction.
        c, signal = model.channels, model.runs[r].signal
        for i, j in ((0, 0), (0, c), (c, c), (0, signal.shape[0]), (c + 1, signal.shape[0] + c)):
            assert fisher[i, j] == pytest.approx(information(model, p, levels, r, i, j), rel=1e-8)


def information(model, p, levels, r, i, j):
    """``sum tr(S^-1 dS_i S^-1 dS_j)`` of logarithms of levels i and j of a run."""
    c, run = model.channels, model.runs[r]
    lines, total = model.chunk(p, run), 0.0
    own, shares = np.split(levels[r], 2)
    for k in range(run.w.size):
        H, v = lines.H[:, :, k], own + shares * run.signal[:, k]
        inverse = np.linalg.inv(np.diag(v[:c]) + H @ np.diag(v[c:]) @ H.conj().T)
        moves = []
        for at in (i, j):
            channel, grows = at % v.size, at >= v.size
            size = shares[channel] * run.signal[channel, k] if grows else own[channel]
            along = np.eye(c)[:, channel] if channel < c else H[:, channel - c]
            moves.append(inverse @ (size * np.outer(along, along.conj())))
        total += np.trace(moves[0] @ moves[1]).real
    return total


def test_the_gradient_of_the_fit_is_that_of_its_sum_of_squares(model_at) -> None:
    model, p, levels = model_at
    x = model.pack(p)
    found = model.normal_equations(p, levels)
    steps = np.eye(x.size) * 1e-6 * np.maximum(np.abs(x), 1.0)
    slope = [
        (model.chi2(model.unpack(x + h), levels) - model.chi2(model.unpack(x - h), levels)) / (2 * np.abs(h).sum())
        for h in steps
    ]
    np.testing.assert_allclose(-2 * found.gradient, slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    np.testing.assert_allclose(model.gradient(p, levels).gradient, found.gradient, rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(found.normal / np.sqrt(np.outer(*[np.diag(found.normal)] * 2))) > -1e-9)


@functools.cache
def fitted(kind: str, seed: int):
    truth, test = spoiled(kind, seed)
    return truth, fit_modes(test)


@pytest.mark.parametrize(("kind", "seed"), [("stepped", 0), ("two levels", 0), ("dashpot", 4)])
def test_a_stepped_sine_read_to_four_tenths_of_a_per_cent_has_its_modes_and_these_shares(kind: str, seed: int) -> None:
    truth, modal = fitted(kind, seed)
    assert modal.omega.size == len(truth.mass)
    np.testing.assert_allclose(modal.shares, 0.004, rtol=0.25)
    np.testing.assert_allclose(modal.omega / (2 * np.pi), truth.poles[0], rtol=3e-4)
    assert modal.coupling is not None if kind == "dashpot" else modal.coupling is None
    assert modal.given.whole is None and modal.records.whole is None


def test_white_noise_and_stated_noise_are_left_as_they_are() -> None:
    _, test = spoiled("white", 0)
    assert fit_modes(test).shares is None
    _, stepped = spoiled("stepped", 0)
    assert fit_modes(replace(stepped, response_std=np.array(0.02))).shares is None


def test_shares_are_told_and_stored_with_the_answer(tmp_path) -> None:
    _, test = spoiled("stepped", 1)
    answer = sysid.identify(sysid.Problem(test), rng=0)
    assert answer.judgement == "determined"
    noise = {one["channel"]: one["percent_of_signal"] for one in answer.to_dict()["noise"]}
    assert set(noise) == {*test.sensor_names, "base x", "force x"}
    assert all(share == pytest.approx(0.4, rel=0.25) for share in noise.values())
    answer.save(tmp_path / "answer.h5")
    again = sysid.load(tmp_path / "answer.h5")
    np.testing.assert_array_equal(again.modal[0].shares, answer.modal[0].shares)
    assert again.summary() == answer.summary()
    np.testing.assert_array_equal(again.uncertainty.covariance, answer.uncertainty.covariance)


def late_test(seed: int, late: float = 4e-4):
    """A stepped sine of two levels, two sensors of which are late, with noise that rises with frequency, and hum."""
    truth, test = spoiled("two levels", seed)
    test = test.at(np.arange(test.freq.size) % 2 == 0)
    rng, f, delays = np.random.default_rng(seed), test.freq, np.zeros(test.n_sensors + 1)
    delays[[0, 2]] = late
    rms = np.sqrt(np.mean(np.abs(test.response) ** 2, axis=(0, 2)))[:, None]
    mains = 1.3 * truth.poles[0][1]
    size = 0.004 * f / f[-1] * (1 + 9 * (np.abs(f / mains - 1) < 0.015))
    noise = rms * size * (rng.standard_normal((*test.response.shape, 2)) @ [1, 1j]) / np.sqrt(2)
    return truth, without_delays(replace(test, response=test.response + noise), -delays), delays, mains


@pytest.fixture(scope="module")
def late():
    """A late test and its fit."""
    made = late_test(0)
    return made, fit_modes(made[1], Delays.none(made[1]))


def test_late_channels_noise_that_rises_and_hum_of_a_stepped_sine_are_found_beside_its_modes(late) -> None:
    (truth, test, delays, mains), modal = late
    assert np.count_nonzero(modal.omega < 2 * np.pi * test.freq[-1]) == len(truth.mass)
    np.testing.assert_array_equal(modal.delays.values != 0, delays != 0)
    late = delays != 0
    assert np.all(np.abs(modal.delays.values - delays)[late] < 4 * modal.delays.std[late])
    assert np.all(modal.delays.std < 0.05 * delays.max())
    profile = modal.record_fit.test.whole.profile
    hum = np.abs(test.freq / mains - 1) < 0.015
    assert np.all(profile[hum] > 10 * np.median(profile))
    assert np.median(profile[~hum][-30:]) > 5 * np.median(profile[~hum][:30])


def test_delays_and_the_profile_of_noise_are_stored_with_the_fit_and_refused_of_another_test(late) -> None:
    fit = late[1].record_fit
    tree, records = fit.to_tree(), replace(fit.test, whole=None)
    again = RecordFit.from_tree(tree, records)
    assert again.likelihood == fit.likelihood
    np.testing.assert_array_equal(again.information(), fit.information())
    np.testing.assert_array_equal(delays_of(again).std, delays_of(fit).std)
    for name in ("profile", "taken"):
        with pytest.raises(sysid.InputError, match="another test"):
            RecordFit.from_tree({**tree, name: tree[name][1:]}, records)


def test_ctrl_c_ends_a_fit_that_no_monitor_watches(monkeypatch) -> None:
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("sysid.modal_analysis.fit.find_poles", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit_modes(spoiled("stepped", 0)[1])


def test_noise_is_drawn_anew_with_the_shares_that_were_found() -> None:
    _, modal = fitted("two levels", 0)
    test = modal.given
    every = np.abs(np.concatenate([test.response, test.force, test.base], axis=1))
    np.testing.assert_allclose(np.median(modal.channel_deviations / every, axis=2), 0.004, rtol=0.5)


def test_errors_that_neighbouring_lines_share_widen_the_covariance_of_plain_spectra_and_white_ones_do_not() -> None:
    """Of frequencies, at the modes as they are; errors smoothed over nine lines have as much power in each mode's."""
    truth, test = spoiled("white", 4)
    lam, phi = scipy.linalg.eigh(truth.stiffness, truth.mass)
    n, ones = lam.size, np.ones(lam.size)
    modes = Modes(phi, (phi.T @ truth.mass @ ones)[:, None], np.sqrt(lam), truth.poles[1])
    rigid = np.array([[ones @ truth.mass @ ones]])
    assert scatter_of_lines(test, modes, rigid) is None
    clean, noise = test.base * truth.answers(test.freq)[0], np.random.default_rng(1).standard_normal((n, 700, 2))
    alike = np.array([np.convolve(row, np.ones(9) / 3, mode="same") for row in noise @ [1, 1j]])[:, : test.freq.size]
    found = scatter_of_lines(replace(test, response=clean + 0.02 * alike, force=None), modes, rigid)
    assert found is not None
    at = slice(n * n + n, n * n + 2 * n)  # logarithms of frequencies, behind shapes and participations
    inverse = np.linalg.pinv(found[0], rcond=1e-12, hermitian=True)
    wide = np.sqrt(np.diag(inverse @ found[1] @ inverse)[at] / np.diag(inverse)[at])
    assert np.all(wide > 1.5) and np.all(wide < 6.0)  # three times where a peak is wider than nine lines


def test_frequency_responses_of_two_directions_read_to_half_a_per_cent_have_their_modes_and_are_determined() -> None:
    """Two frames that a spring joins, one along each direction; each line of a direction has one error of the base."""
    rng = np.random.default_rng(2)
    along, across = frame(rng), frame(rng)
    n, first = len(along.mass) + len(across.mass), len(along.mass)
    M = scipy.linalg.block_diag(along.mass, across.mass)
    K = scipy.linalg.block_diag(along.stiffness, across.stiffness)
    K[0, first] = K[first, 0] = 0.05 * K[0, 0]
    lam, phi = scipy.linalg.eigh(K, M)
    C = M @ phi @ np.diag(0.024 * np.sqrt(lam)) @ phi.T @ M
    G = np.repeat(np.eye(2), [first, n - first], axis=0)
    f = np.sqrt(lam) / (2 * np.pi)
    about = [one * (1 + 0.012 * np.linspace(-4, 4, 13)) for one in f]
    freq = np.sort(np.concatenate([np.geomspace(0.4 * f[0], 1.1 * f[-1], 80), *about]))
    w = 2 * np.pi * freq[:, None, None]
    H = np.moveaxis(np.linalg.solve(K + 1j * w * C - w**2 * M, w**2 * (M @ G)), 0, -1) + G[:, :, None]
    Z = np.einsum("nd,nm,mef->def", G, M, H)
    reads = lambda *shape: 1 + 0.005 * rng.standard_normal((*shape, 2)) @ [1, 1j] / np.sqrt(2)  # noqa: E731
    of_base = reads(1, 2, freq.size)
    test = sysid.Measurement.from_frf(
        freq, H * reads(*H.shape) * of_base, force=Z * reads(*Z.shape) * of_base, rigid_body=G, base_axes=("x", "y")
    )
    answer = sysid.identify(sysid.Problem(test), rng=0)
    assert answer.judgement == "determined"
    errors = (answer.structure.natural_frequencies - f) / answer.uncertainty.natural_frequencies
    assert np.all(np.abs(errors) < 4)
    assert all(one["percent_of_signal"] == pytest.approx(0.5, rel=0.2) for one in answer.to_dict()["noise"])
