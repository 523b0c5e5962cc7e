"""Tests of continuous structures and their Cramér-Rao bound: against matrices, an integrator, differences and draws."""

import importlib
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("structures", "simulated_tests", "cramer_rao")
IN_SPECTRA, IN_RECORDS = 13, 11  # numbers of structures of few modes and sensors


@pytest.fixture(scope="module")
def band():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        return SimpleNamespace(**{name: importlib.import_module(f"benchmarks.band.{name}") for name in NAMES})


def _distance(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def test_structures_and_tests_are_as_the_module_says(band):
    """Modes in the lines, the end of the lines between two modes, sensors, and all modes to six times the last line."""
    for number in range(0, 60, 13):
        it = band.structures.structure(number)
        f, m = it.frequencies, it.count
        assert 3 <= m <= 15
        assert it.lines[0] < f[0]
        assert 0.2 <= (it.lines[1] - f[m - 1]) / (f[m] - f[m - 1]) <= 0.8
        assert f[-1] > 6 * it.lines[1]
        assert m / 2 - 1 <= len(it.modes.shapes) <= 4 * m + 1
        assert 1 <= len(it.base) <= 3
        assert np.all((it.modes.zeta >= 0.003) & (it.modes.zeta <= 0.03))
        assert 0.003 <= it.noise <= 0.03


@pytest.mark.parametrize("draw", ["beam", "frame", "plate"])
def test_the_sum_over_all_modes_is_the_response_of_the_matrices(band, draw):
    """Without damping, between resonances and beyond them: no mode is missing, and no residual is needed."""
    rng = np.random.default_rng(1)
    driven, _, candidates = getattr(band.structures, draw)(rng, 3)
    omega, shapes = driven.modes()
    rows = np.array([driven.row(*sensor) for sensor in candidates[:9]])
    modes = band.structures.Modes(
        omega, np.zeros(omega.size), shapes.T @ driven.load, rows @ shapes, rows @ driven.rigid, driven.rigid_body_mass
    )
    w = np.sqrt(omega[:8] * omega[1:9])
    H, Z = band.simulated_tests.transfer(modes, w)
    for f, line in enumerate(w):
        relative = line**2 * np.linalg.solve(driven.stiffness - line**2 * driven.mass, driven.load)
        assert _distance(H[..., f], rows @ (relative + driven.rigid)) < 1e-7
        assert _distance(Z[..., f], driven.load.T @ relative + driven.rigid_body_mass) < 1e-7


@pytest.fixture(scope="module")
def from_rest(band):
    """A run of a structure with four modes, and its motion."""
    it = band.structures.structure(IN_RECORDS)
    few = {name.name: getattr(it.modes, name.name) for name in fields(it.modes)}
    few |= {name: few[name][:4] for name in ("omega", "zeta", "gamma")} | {"shapes": few["shapes"][:, :4]}
    modes = band.structures.Modes(**few)
    rng = np.random.default_rng(0)
    motion = band.simulated_tests.random_motion(
        rng, 30 / it.frequencies[0], 6.4 * it.lines[1], (0.9 * it.lines[0], 1.2 * it.lines[1]),
        correlation=np.eye(len(it.base)),
    )  # fmt: skip
    return it, modes, motion, band.simulated_tests.FromRest.of(modes, motion)


def test_records_from_rest_solve_the_equations_of_motion(band, from_rest):
    """Against a Runge-Kutta integration of each mode, driven by the raised motion."""
    _, modes, motion, run = from_rest
    k = round(motion.period / (2 * band.simulated_tests.RISE * motion.samples))
    slow = 2 * np.pi * k * motion.sample_rate / motion.period

    def base(t):
        raised = (1 - np.cos(slow * t)) / 2 if slow * t < np.pi else 1.0
        return raised * (motion.amplitudes @ np.exp(1j * motion.omega * t)).real

    def acceleration(t, q, rate):
        return -(modes.gamma @ base(t)) - 2 * modes.zeta * modes.omega * rate - modes.omega**2 * q

    n = modes.omega.size
    time = np.arange(motion.samples + 1) / motion.sample_rate
    solved = scipy.integrate.solve_ivp(
        lambda t, y: np.concatenate([y[n:], acceleration(t, y[:n], y[n:])]), time[[0, -1]], np.zeros(2 * n),
        method="DOP853", t_eval=time, rtol=1e-9, atol=1e-13, max_step=0.5 / motion.sample_rate,
    )  # fmt: skip
    records = run.records()
    q = np.array([acceleration(t, y[:n], y[n:]) for t, y in zip(time, solved.y.T, strict=True)]).T[:, :-1]
    u = np.array([base(t) for t in time[:-1]]).T
    np.testing.assert_allclose(records.base, u, atol=1e-9)
    assert _distance(records.response, modes.shapes @ q + modes.rigid_body @ u) < 1e-6
    assert _distance(records.force, modes.gamma.T @ q + modes.rigid_body_mass @ u) < 1e-6
    np.testing.assert_allclose(np.concatenate(run.at_end()), solved.y[:, -1], atol=1e-6 * np.max(np.abs(solved.y)))


def _model(modes, layout, theta, base, omega, scale):
    """Spectra (channels, lines) of the bound's model at its unknowns; its alpha are over `scale`, (m,)."""
    s, m, d = layout.sensors, layout.modes, layout.d
    parts = np.split(theta, layout.ends[:-1])
    phi, static, gamma = parts[0].reshape(s, m), parts[1].reshape(s, d), parts[2].reshape(m, d)
    wk, zeta = np.exp(parts[3])[:, None], np.exp(parts[4])[:, None]
    rigid, pushed = np.zeros((2, d, d))
    for matrix, values in ((rigid, parts[5]), (pushed, parts[6])):
        matrix[np.triu_indices(d)] = values
        matrix += np.triu(matrix, 1).T
    ends = parts[7].reshape(2, m) if layout.runs else np.zeros((2, m))
    w = omega
    A = w**2 * (gamma @ base) + (ends[0] * scale)[:, None] + 1j * w * ends[1][:, None]
    A = A / (wk**2 - w**2 + 2j * zeta * wk * w)
    a = phi @ A + modes.rigid_body @ base + w**2 * (static @ base)
    return np.concatenate([a, gamma.T @ A + rigid @ base + w**2 * (pushed @ base)])


def _unknowns(modes, layout, ends):
    """The bound's unknowns at the truth of one run."""
    m, d = layout.modes, layout.d
    rest = modes.gamma[m:] / modes.omega[m:, None] ** 2
    static, pushed = modes.shapes[:, m:] @ rest, modes.gamma[m:].T @ rest
    triangle = np.triu_indices(d)
    parts = [modes.shapes[:, :m].ravel(), static.ravel(), modes.gamma[:m].ravel(), np.log(modes.omega[:m])]
    parts += [np.log(modes.zeta[:m]), modes.rigid_body_mass[triangle], pushed[triangle]]
    return np.concatenate([*parts, ends[:m, 0] / modes.omega[:m], ends[:m, 1]] if layout.runs else parts)


def _case(band, number, poles, draw=0):
    it = band.structures.structure(number)
    test = band.simulated_tests.draw(it, draw)
    runs = len(test.base) if np.any(test.ends) else 0
    return it, test, band.cramer_rao.Layout(len(it.modes.shapes), it.count + poles, len(it.base), runs)


def test_records_have_the_spectra_of_the_bounds_model(band, from_rest):
    """But for tails that fold back at the sample rate, of the base too: polynomials, and numbers over each pole."""
    it, modes, motion, run = from_rest
    layout = band.cramer_rao.Layout(len(modes.shapes), 4, len(it.base), 1)
    freq = np.fft.rfftfreq(motion.samples, 1 / motion.sample_rate)
    keep = (freq >= it.lines[0]) & (freq <= it.lines[1])
    w, records = 2 * np.pi * freq[keep], run.records()
    q, v = run.at_end()
    ends = motion.sample_rate * np.column_stack(
        [modes.omega**2 * v, modes.omega**2 * q + 2 * modes.zeta * modes.omega * v]
    )
    base = np.fft.rfft(records.base)[:, keep]
    modelled = _model(modes, layout, _unknowns(modes, layout, ends), base, w, modes.omega)
    seen = np.concatenate([np.fft.rfft(records.response), np.fft.rfft(records.force)])[:, keep]
    den = modes.omega[:, None] ** 2 - w**2 + 2j * (modes.zeta * modes.omega)[:, None] * w
    folded = np.column_stack([*((1j * w / w[-1]) ** p for p in range(8)), *(1 / den), *(1j * w / den)])
    folded = np.vstack([folded.real, folded.imag]) / np.linalg.norm(folded, axis=0)
    for channel, exact in zip(modelled, seen, strict=True):
        left = np.concatenate([(exact - channel).real, (exact - channel).imag])
        assert np.linalg.norm(left - folded @ np.linalg.lstsq(folded, left)[0]) < 1e-6 * np.linalg.norm(exact)


@pytest.mark.parametrize("number", [IN_SPECTRA, IN_RECORDS])
def test_derivatives_are_those_of_differences(band, number):
    """By each unknown, of every channel; what modes without a pole add is the exact response less the model's."""
    it, test, layout = _case(band, number, 1)
    modes, w = it.modes, test.omega
    theta = _unknowns(modes, layout, test.ends[0])

    def model(x):
        return _model(modes, layout, x, test.base[0], w, modes.omega[: layout.modes])

    J = np.zeros((layout.size, *model(theta).shape), dtype=complex)
    omega, zeta = (it[: layout.modes, None] for it in (modes.omega, modes.zeta))
    den = omega**2 - w**2 + 2j * zeta * omega * w
    for channel, (at, slopes) in enumerate(band.cramer_rao.derivatives(modes, test, layout, 0, slice(None))):
        inside = at < layout.size
        J[at[inside], channel] = slopes[inside]
        H = np.concatenate(band.simulated_tests.transfer(modes, w))[channel]
        out = np.concatenate([modes.shapes, modes.gamma.T])[channel, : layout.modes]
        ended = out @ (test.ends[0, : layout.modes] @ np.array([np.ones(w.size), 1j * w]) / den)
        missing = np.einsum("df,df->f", H, test.base[0]) + ended - model(theta)[channel]
        np.testing.assert_allclose(
            slopes[at == layout.size][0], missing, atol=1e-9 * np.max(np.abs(model(theta)[channel]))
        )
    sizes = np.concatenate(
        [np.full(part.size, np.max(np.abs(part), initial=0)) for part in np.split(theta, layout.ends[:-1])]
    )
    for p in range(layout.size):
        step = np.zeros(layout.size)
        step[p] = 1e-6 * sizes[p]
        difference = (model(theta + step) - model(theta - step)) / (2 * step[p])
        assert (
            np.linalg.norm(difference - J[p])
            < 1e-5 * np.linalg.norm(J[p]) + 1e-12 * np.linalg.norm(model(theta)) / step[p]
        )


@pytest.mark.parametrize("number", [IN_SPECTRA, IN_RECORDS])
def test_one_step_from_the_truth_errs_by_the_bound(band, number):
    """Noise has the size that the bound counts with, that of the base too, and unknowns err by its covariance."""
    chi_square, steps = [], []
    for draw in range(10):
        it, test, layout = _case(band, number, 1, draw)
        silent = band.simulated_tests.draw(replace(it, noise=1e-9 * it.noise), draw).measurement
        e, H = _noise(band, it, test, silent)
        known = band.cramer_rao.information(it.modes, test, layout)[:-1, :-1]
        h = H * test.base_std[:, None]
        total, gradient = 0.0, np.zeros(layout.size + 1)
        for run, error in enumerate(e):
            S = np.einsum("cdf,edf->fce", h, h.conj()) + np.diag(test.own_std[run] ** 2)
            weighted = np.linalg.solve(S, error.T[..., None])[..., 0].T
            total += 2 * np.vdot(error, weighted).real
            for channel, (at, J) in enumerate(band.cramer_rao.derivatives(it.modes, test, layout, run, slice(None))):
                gradient[at] += 2 * (J.conj() @ weighted[channel]).real
        chi_square.append(total / (2 * e.size))
        units = np.sqrt(np.diag(known))
        whole = gradient[:-1] / units
        steps.append(whole @ np.linalg.solve(known / np.outer(units, units), whole) / whole.size)
    assert np.mean(chi_square) == pytest.approx(1, abs=0.02)
    assert np.mean(steps) == pytest.approx(1, abs=0.15)


def _noise(band, it, test, silent):
    """Noise of responses and forces, less what noise of the base makes of it, (runs, channels, lines); and [H; Z]."""
    noisy = test.measurement
    scale = noisy.whole.sample_rate if noisy.is_whole else 1.0
    e = {name: scale * (getattr(noisy, name) - getattr(silent, name)) for name in ("base", "response", "force")}
    H = np.concatenate(band.simulated_tests.transfer(it.modes, test.omega))
    return np.concatenate([e["response"], e["force"]], axis=1) - np.einsum("cdf,rdf->rcf", H, e["base"]), H


def test_complex_steps_are_differences(band):
    """Of f, zeta, effective masses, M and K by shapes, participations and poles."""
    rng = np.random.default_rng(2)
    m, d = 3, 2
    omega, zeta = np.array([20.0, 50.0, 90.0]), np.array([0.01, 0.02, 0.015])
    gamma, phi = rng.standard_normal((m, d)), rng.standard_normal((m, m)) + 2 * np.eye(m)
    theta = np.concatenate([phi.ravel(), gamma.ravel(), np.log(omega), np.log(zeta)])

    def of(x):
        phi, gamma, log_omega, log_zeta = np.split(x, [m * m, m * (m + d), m * (m + d + 1)])
        return band.cramer_rao.in_band(np.exp(log_omega), np.exp(log_zeta), gamma.reshape(m, d), phi.reshape(m, m))

    slopes = band.cramer_rao.complex_steps(of, theta)
    for p in range(theta.size):
        step = 1e-6 * np.eye(theta.size)[p]
        for name, slope in slopes.items():
            difference = (of(theta + step)[name] - of(theta - step)[name]) / 2e-6
            np.testing.assert_allclose(slope[p], difference, atol=1e-6 * np.max(np.abs(slope)))
