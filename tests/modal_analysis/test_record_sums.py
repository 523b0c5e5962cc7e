from dataclasses import replace

import numpy as np
import pytest

import sysid
from sysid.modal_analysis.record_fit import record_modes, refitted
from sysid.modal_analysis.record_model import Chunk, RecordModel
from sysid.modal_analysis.rough_poles import decimated_lines

RATE, SAMPLES = 40.0, 400


def whole_records():
    """Two sensors, two directions, force, of noise: derivatives and sums hold for any records."""
    rng = np.random.default_rng(3)
    base, response, force = (rng.standard_normal((2, SAMPLES)) for _ in range(3))
    return sysid.Measurement.from_time([(base, response + base, force)], RATE, rigid_body=np.eye(2), band=(0.5, 8.0))


@pytest.fixture
def model():
    return RecordModel(whole_records(), 2)


@pytest.fixture
def x(model):
    x = np.random.default_rng(4).standard_normal(model.n_fit)
    x[model.index.log_omega], x[model.index.log_ratios] = np.log([12.0, 30.0]), np.log([0.03, 0.05])
    return x


@pytest.fixture
def levels(model):
    return np.random.default_rng(5).uniform(0.5, 2.0, (1, model.channels + model.d))


def inverse(chunk, levels):
    """S^-1 of each line, (L, c, c)."""
    c, T = chunk.model.channels, np.moveaxis(chunk.H, -1, 0)
    v = levels[0] * chunk.run.density
    return np.linalg.inv(np.diag(v[:c]) + T @ np.diag(v[c:]) @ T.conj().transpose(0, 2, 1))


def test_the_sum_of_squares_is_that_of_the_covariance(model, x, levels):
    (chunk,) = model.chunks(model.unpack(x))
    made = np.einsum("il,lij,jl->", chunk.error.conj(), inverse(chunk, levels), chunk.error).real
    assert model.chi2(model.unpack(x), levels) == pytest.approx(made, rel=1e-10)


def test_the_gradient_is_that_at_fixed_covariance(model, x, levels):
    p, h = model.unpack(x), 1e-6
    made = model.normal_equations(p, levels)
    (chunk,) = model.chunks(p)
    likeliest = chunk.weighed(levels).base
    S = inverse(chunk, levels)
    run = chunk.run._replace(base=likeliest)
    columns = [
        (Chunk(model, model.unpack(x - h * e), run).error - Chunk(model, model.unpack(x + h * e), run).error) / (2 * h)
        for e in np.eye(x.size)
    ]
    J = np.array(columns)  # (p, c, L)
    normal = np.einsum("pil,lij,qjl->pq", J.conj(), S, J, optimize=True).real
    gradient = np.einsum("pil,lij,jl->p", J.conj(), S, chunk.error, optimize=True).real
    assert np.allclose(made.normal, normal, rtol=1e-6, atol=1e-6 * np.abs(normal).max())
    assert np.allclose(made.gradient, gradient, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())
    assert np.allclose(model.gradient(p, levels).gradient, made.gradient, rtol=1e-12)


def test_what_bends_along_a_step_is_the_second_derivative_of_the_errors(model, x, levels):
    p, h = model.unpack(x), 1e-6
    step = 0.1 * np.random.default_rng(7).standard_normal(x.size)
    (chunk,) = model.chunks(p)
    run = chunk.run._replace(base=chunk.weighed(levels).base)
    at = lambda moved, run=chunk.run: Chunk(model, model.unpack(moved), run).error  # noqa: E731
    J = np.array([(at(x - h * e, run) - at(x + h * e, run)) / (2 * h) for e in np.eye(x.size)])
    k = 0.01  # differences of fourth order
    bend = sum(c * at(model.moved(x, t * k * step)) for t, c in zip(range(-2, 3), [-1, 16, -30, 16, -1], strict=True))
    bent = np.einsum("pil,lij,jl->p", J.conj(), inverse(chunk, levels), bend / (12 * k**2), optimize=True).real
    assert np.allclose(model.bent(p, levels, x, step, share=1e-3), bent, rtol=1e-4, atol=1e-4 * np.abs(bent).max())


def test_a_fit_that_begins_with_some_lines_ends_as_that_of_all():
    rng = np.random.default_rng(6)
    K = np.array([[5e3, -2e3, -3e3], [-2e3, 4e3, -2e3], [-3e3, -2e3, 5e3]])
    structure = sysid.Structure(np.diag([2.0, 3.0, 1.0]), K, [0.01, 0.02], n_base=1)
    base = rng.standard_normal((1, 60000))
    response, force = structure.simulate(base, 60.0), structure.simulate_force(base, 60.0)
    noisy = [record + 0.01 * np.std(record) * rng.standard_normal(record.shape) for record in (base, response, force)]
    test = sysid.Measurement.from_time([tuple(noisy)], 60.0, rigid_body=np.ones((2, 1)), band=(3.0, 14.0))
    lines = decimated_lines(test)
    assert np.count_nonzero(lines) < test.freq.size / 2
    poles = 2 * np.pi * structure.natural_frequencies, np.array([0.01, 0.02])
    rough = record_modes(test.at(lines), *poles)
    direct, staged = (
        refitted(record_modes(test, *poles), rough.parameters),
        refitted(replace(rough, test=test), rough.parameters, some=rough.test),
    )
    assert direct.settled
    assert staged.settled
    assert staged.chi2 == pytest.approx(direct.chi2, abs=2e-3 * direct.freedom**0.5)
    spread = np.sqrt(np.diag(np.linalg.pinv(direct.information())))[direct.model.index.log_omega]
    off = np.log(staged.parameters.modes.omega / direct.parameters.modes.omega)
    assert np.all(np.abs(off) < 0.03 * spread)
