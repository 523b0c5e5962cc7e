"""Whole records as a model: transients in closed form, and derivatives and weights against dense references."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid.measurement.channels import without_delays
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import WholeRecords
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.record_model import Chunk, Parameters, RecordModel
from sysid.modal_analysis.response import gains
from sysid.structure.structure import Array, ComplexArray

OMEGA, RATIO, RATE, SAMPLES = 2 * np.pi * 3.1, 0.02, 40.0, 700
FORCED = 2j * np.pi * 2.2345  # between two lines


def _motion() -> tuple[list[tuple[complex, complex]], list[tuple[complex, complex]]]:
    """Base and displacement of an oscillator as sums of ``Re c exp(s t)``: forced off the lines, and free."""
    c, pole = 1.3 - 0.4j, OMEGA * (-RATIO + 1j * np.sqrt(1 - RATIO**2))
    forced = -c / (FORCED**2 + 2 * RATIO * OMEGA * FORCED + OMEGA**2)
    return [(c, FORCED)], [(forced, FORCED), (0.003 + 0.002j, pole)]


def _transform(parts: list[tuple[complex, complex]], w: Array, derivative: int) -> ComplexArray:
    T = SAMPLES / RATE
    terms = [(a * s**derivative / 2, s) for a, s in parts]
    both = [*terms, *((np.conj(a), np.conj(s)) for a, s in terms)]
    return np.sum([a * (np.exp(s * T) - 1) / (s - 1j * w) for a, s in both], axis=0)


def _change(parts: list[tuple[complex, complex]], derivative: int) -> float:
    return float(sum((a * s**derivative * (np.exp(s * SAMPLES / RATE) - 1)).real for a, s in parts))


def test_transform_of_a_moving_record_is_the_response_and_two_numbers() -> None:
    base, motion = _motion()
    freq = np.arange(10, 300) * RATE / SAMPLES
    w = 2 * np.pi * freq
    dq, dv = _change(motion, 0), _change(motion, 1)
    ends = np.array([OMEGA**2 * dv, OMEGA**2 * dq + 2 * RATIO * OMEGA * dv])
    g = gains(freq, np.array([OMEGA]), np.array([RATIO]))[0]
    inputs = ends @ WholeRecords((SAMPLES,), RATE, (False,)).transients(freq)
    exact = _transform(motion, w, 2)
    model = g * (_transform(base, w, 0) + inputs)
    assert np.linalg.norm(model - exact) < 1e-9 * np.linalg.norm(exact)
    assert np.linalg.norm(g * inputs) > 0.1 * np.linalg.norm(exact)  # the numbers matter


def _model(force: bool, d: int, coupled: bool = False) -> tuple[RecordModel, Parameters, Array]:
    """Two runs of unequal length, one at rest; data and parameters at random, so that no error is small."""
    r = np.random.default_rng(3)
    n, m, rate = 3, 2, 20.0
    runs = [(r.normal(size=(d, N)), r.normal(size=(n, N)), r.normal(size=(d, N)) if force else None) for N in (64, 50)]
    test = Measurement.from_time(
        runs, rate, rigid_body=r.normal(size=(n, d)) / 4, band=(1.0, 9.0), at_rest=[False, True],
        base_axes="xyz"[:d],
    )  # fmt: skip
    model = RecordModel(test, m, coupled=coupled)
    rigid = (2.0 * np.eye(d) + 0.1) if force else np.zeros((d, d))
    modes = Modes(r.normal(size=(n, m)), r.normal(size=(m, d)), np.array([15.0, 35.0]), np.array([0.06, 0.1]))
    traces = r.normal(size=(2, model.channels, 3))
    coupling = np.array([[0.0, 0.8], [0.8 if force else -0.5, 0.0]]) if coupled else None
    p = Parameters(modes, rigid, r.normal(size=(m, 2)), traces, coupling)
    return model, p, r.uniform(0.3, 2.0, (2, model.channels + d))


def _dense(chunk: Chunk, levels: Array) -> ComplexArray:
    """S of each line, (L, c, c)."""
    c, T, own = chunk.model.channels, np.moveaxis(chunk.H, -1, 0), levels[chunk.run.number]
    return chunk.run.density * (np.diag(own[:c]) + T @ np.diag(own[c:]) @ T.conj().swapaxes(1, 2))


def _dense_chi2(model: RecordModel, p: Parameters, levels: Array) -> float:
    total = 0.0
    for chunk in model.chunks(p):
        for S, e in zip(_dense(chunk, levels), chunk.error.T, strict=True):
            total += (e.conj() @ np.linalg.solve(S, e)).real
    return total


CASES = pytest.mark.parametrize(
    ("force", "d", "coupled"), [(f, d, c) for f in (True, False) for d in (1, 2) for c in (False, True)]
)


@CASES
def test_whitened_errors_sum_to_those_of_the_dense_covariance(force: bool, d: int, coupled: bool) -> None:
    model, p, levels = _model(force, d, coupled)
    assert model.chi2(p, levels) == pytest.approx(_dense_chi2(model, p, levels), rel=1e-10)


@CASES
def test_gradient_is_that_of_the_sum_with_covariance_varying(force: bool, d: int, coupled: bool) -> None:
    model, p, levels = _model(force, d, coupled)
    made, x = model.normal_equations(p, levels), model.pack(p)
    h = 1e-5
    slope = [
        (_dense_chi2(model, model.unpack(x + h * u), levels) - _dense_chi2(model, model.unpack(x - h * u), levels))
        / (2 * h)
        for u in np.eye(x.size)
    ]
    np.testing.assert_allclose(-2 * made.gradient, slope, atol=1e-6 * np.abs(slope).max())
    assert made.chi2 == pytest.approx(_dense_chi2(model, p, levels), rel=1e-10)


@CASES
def test_normal_matrix_is_that_of_derivatives_at_the_likeliest_base(force: bool, d: int, coupled: bool) -> None:
    model, p, levels = _model(force, d, coupled)
    made, x, h = model.normal_equations(p, levels), model.pack(p), 1e-5
    dense = np.zeros_like(made.normal)
    for run in model.runs:
        here = model.chunk(p, run)
        S, T = _dense(here, levels), np.moveaxis(here.H, -1, 0)
        pulled = np.einsum("lcd,lc->ld", T.conj(), np.linalg.solve(S, here.error.T[..., None])[..., 0])
        likely = run._replace(base=run.base + (run.density * levels[run.number, model.channels :] * pulled).T)
        J = np.array([
            (model.chunk(model.unpack(x - h * u), likely).error - model.chunk(model.unpack(x + h * u), likely).error)
            / (2 * h)
            for u in np.eye(x.size)
        ])  # fmt: skip
        J = np.moveaxis(J, -1, 0)  # (L, p, c)
        dense += np.einsum("lpc,lcq->pq", J.conj(), np.linalg.solve(S, J.swapaxes(1, 2))).real
    np.testing.assert_allclose(made.normal, dense, atol=1e-7 * np.abs(dense).max())


def test_lines_of_unequal_runs_are_their_own_transforms() -> None:
    r = np.random.default_rng(0)
    runs = [(r.normal(size=(1, N)), r.normal(size=(2, N)), None) for N in (60, 84)]
    test = Measurement.from_time(runs, 12.0, rigid_body=[[1.0], [1.0]])
    for run, own, (base, response, _) in zip(RecordModel(test, 1).runs, test.own_lines, runs, strict=True):
        N = base.shape[1]
        lines = np.rint(test.freq[own] * N / 12.0).astype(int)
        np.testing.assert_allclose(test.freq[own], lines * 12.0 / N, rtol=1e-12)
        scale = (run.base[0] / np.fft.rfft(base[0])[lines])[0]
        np.testing.assert_allclose(run.base, scale * np.fft.rfft(base)[:, lines], rtol=1e-9)
        np.testing.assert_allclose(run.outputs, scale * np.fft.rfft(response)[:, lines], rtol=1e-9)
        assert scale == pytest.approx(1 / 12.0)
        assert not np.any(test.response[run.number][:, ~own])


@CASES
def test_weights_of_lines_count_in_sum_gradient_and_normal_matrix(force: bool, d: int, coupled: bool) -> None:
    """Weights of 0, 1 and 2: a line that is left out, as it is, and twice there."""
    model, p, levels = _model(force, d, coupled)
    weights = [np.arange(run.w.size) % 3 for run in model.runs]
    weighed = model.weighed_by([weight.astype(float) for weight in weights])
    parts = []
    for times in (1, 2):
        some = model.weighed_by([np.ones(np.count_nonzero(weight == times)) for weight in weights])
        some.runs = [run._replace(weight=one.weight) for run, one in zip(
            (run.at(weight == times) for run, weight in zip(model.runs, weights, strict=True)), some.runs, strict=True
        )]  # fmt: skip
        parts.append(some.normal_equations(p, levels))
    once, twice = parts
    made, slope = weighed.normal_equations(p, levels), weighed.gradient(p, levels)
    np.testing.assert_allclose(made.normal, once.normal + 2 * twice.normal, atol=1e-9 * np.abs(made.normal).max())
    for gradient in (made.gradient, slope.gradient):
        expected = once.gradient + 2 * twice.gradient
        np.testing.assert_allclose(gradient, expected, atol=1e-9 * np.abs(expected).max())
    for chi2 in (made.chi2, slope.chi2, weighed.chi2(p, levels)):
        assert chi2 == pytest.approx(once.chi2 + 2 * twice.chi2, rel=1e-10)


@CASES
def test_what_transients_take_off_the_information_is_as_they_move_along(force: bool, d: int, coupled: bool) -> None:
    """The covariance of the modes is that part of the inverse of all unknowns' normal matrix."""
    model, p, levels = _model(force, d, coupled)
    normal = model.normal_equations(p, levels).normal
    made = RecordFit(model.test, p, levels, 1.0, True).information()[: model.kept, : model.kept]
    inner, across = normal[model.kept :, model.kept :], normal[model.kept :, : model.kept]
    expected = normal[: model.kept, : model.kept] - across.T @ np.linalg.solve(inner, across)
    np.testing.assert_allclose(made, expected, atol=1e-9 * np.abs(expected).max())
    assert np.abs(across.T @ np.linalg.solve(inner, across)).max() > 0.01 * np.abs(expected).max()


@pytest.mark.parametrize("d", [1, 2])
def test_columns_of_gains_are_those_of_base_motion_and_of_a_mode_far_above_the_lines(d: int) -> None:
    """A share e of the base's motion is a change of G by e; a mode at W far above the lines adds e w² for ``e W²``.

    The third kind is a mode without damping at 1.3 times the last line.
    """
    model, p, levels = _model(False, d)
    n, fit = model.n, RecordModel(model.test, 2, gains=True)
    gradient = fit.normal_equations(p, levels).gradient[fit.n_fit : fit.delays].reshape(3, n, d)
    h, last, far = 1e-5, 2 * np.pi * model.test.freq[-1], 1e4
    more = RecordModel(model.test, 4)

    def left(i: int, j: int, share: float, rising: float, above: float) -> float:
        G = model.test.rigid_body.copy()
        G[i, j] += share
        phi, gamma = np.eye(n)[:, [i, i]] * [rising, above], np.eye(d)[[j, j]] * [[far**2], [1.0]]
        modes = Modes(
            np.hstack([p.modes.phi, phi]), np.vstack([p.modes.gamma, gamma]),
            np.append(p.modes.omega, [far * last, 1.3 * last]), np.append(p.modes.ratios, [1e-6, 0.0]),
        )  # fmt: skip
        every = Parameters(modes, p.rigid, np.vstack([p.ends, np.zeros((2, p.ends.shape[1]))]), p.traces)
        more.test = replace(model.test, rigid_body=G)
        return _dense_chi2(more, every, levels)

    for i, j in np.ndindex(n, d):
        for kind, step in enumerate(h * np.eye(3)):
            slope = (left(i, j, *step) - left(i, j, *-step)) / (2 * h)
            assert -2 * gradient[kind, i, j] == pytest.approx(slope, rel=1e-4, abs=1e-4 * np.abs(gradient).max())


@CASES
def test_columns_of_delays_are_what_turned_outputs_lose(force: bool, d: int, coupled: bool) -> None:
    """A sensor, or the force in all its directions, that is earlier by h is missed by as much as one late by -h."""
    model, p, levels = _model(force, d, coupled)
    fit = RecordModel(model.test, model.m, gains=True, coupled=coupled)
    gradient, size, h = fit.normal_equations(p, levels).gradient[fit.delays :], model.n + force, 1e-6
    assert gradient.shape == (size,)
    for channel in range(size):
        chi2 = []
        for delay in (h, -h):
            model.test = without_delays(fit.test, delay * np.eye(size)[channel])
            chi2.append(RecordModel(model.test, model.m, coupled=coupled).chi2(p, levels))
        slope = (chi2[0] - chi2[1]) / (2 * h)
        assert 2 * gradient[channel] == pytest.approx(-slope, rel=1e-4, abs=1e-5 * np.abs(gradient).max())


@CASES
def test_the_likelihood_is_that_of_the_dense_covariance(force: bool, d: int, coupled: bool) -> None:
    """Of circular complex errors, but for the powers of pi; between two sets of levels as well."""
    model, p, levels = _model(force, d, coupled)
    for at in (levels, levels[::-1] ** 2):
        fit = RecordFit(model.test, p, at, model.chi2(p, at), True)
        exponents = [np.sum(np.linalg.slogdet(_dense(chunk, at))[1]) for chunk in model.chunks(p)]
        assert fit.likelihood == pytest.approx(-sum(exponents) - _dense_chi2(model, p, at), rel=1e-10)


@CASES
def test_unknowns_are_as_many_as_the_records_determine(force: bool, d: int, coupled: bool) -> None:
    """The rank of the normal matrix: without a force the scale of each mode is not seen."""
    model, p, levels = _model(force, d, coupled)
    normal = model.normal_equations(p, levels).normal
    size = np.sqrt(np.diag(normal))
    lam = np.linalg.eigvalsh(normal / np.outer(size, size))
    assert np.count_nonzero(lam > 1e-10 * lam[-1]) == model.unknowns


def test_chi_squared_of_right_modes_and_levels_is_its_degrees_of_freedom() -> None:
    """Sensors that move with the base, white noise on all channels: within four of the law's own deviations."""
    r, d, n, samples = np.random.default_rng(11), 2, 3, 2000
    G, levels = r.normal(size=(n, d)), np.array([0.3, 0.5, 0.2, 0.1, 0.4]) ** 2
    base = r.normal(size=(d, samples))
    noise = np.sqrt(levels)[:, None] * r.normal(size=(n + d, samples))
    test = Measurement.from_time(
        [(base + noise[n:], G @ base + noise[:n], None)], 50.0, rigid_body=G, base_axes="xy", band=(1.0, 24.0)
    )
    model = RecordModel(test, 1)
    modes = Modes(np.zeros((n, 1)), np.ones((1, d)), np.array([30.0]), np.array([0.02]))
    p = Parameters(modes, np.zeros((d, d)), np.zeros((1, 2)), np.zeros((1, n, 3)))
    fit = RecordFit(test, p, levels[None], model.chi2(p, levels[None]), True)
    assert fit.reduced == pytest.approx(1.0, abs=4 * np.sqrt(2 / fit.freedom))


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize("gains", [True, False])
def test_equations_of_couplings_that_are_zero_need_no_coupled_modes(force: bool, gains: bool) -> None:
    model, p, levels = _model(force, 2, coupled=True)
    model = RecordModel(model.test, model.m, gains=gains, coupled=True)
    plain = model.normal_equations(replace(p, coupling=None), levels)
    general = model.normal_equations(replace(p, coupling=np.zeros((2, 2))), levels)
    np.testing.assert_allclose(plain.normal, general.normal, atol=1e-12 * np.abs(general.normal).max())
    np.testing.assert_allclose(plain.gradient, general.gradient, atol=1e-12 * np.abs(general.gradient).max())
