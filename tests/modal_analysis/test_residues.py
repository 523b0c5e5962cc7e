"""Residues of given poles against numpy's least squares with the whole design written out."""

import numpy as np
import pytest

from sysid import Measurement
from sysid.measurement.measurement import unit_runs
from sysid.modal_analysis.residues import Records, force_residual_left, independent, linear_residues

POLES = 2 * np.pi * np.array([5.0, 9.0, 9.4]), np.array([0.01, 0.02, 0.015])
M = 3


def normal(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def records(rng, *, unit, n=4, d=2, lines=40, std=None, force=False, base=None):
    """A test of records that no poles answer."""
    if base is None:
        base = unit_runs(d, lines) if unit else normal(rng, 3, d, lines)
    return Measurement(
        np.linspace(2, 14, lines), base, normal(rng, len(base), n, lines), rigid_body=rng.uniform(-0.5, 0.5, (n, d)),
        response_std=std, force=30 * normal(rng, *base.shape) if force else None,
    )  # fmt: skip


def deviations(rng, test_like, n, lines):
    """Noise that separates, as one number a sensor, a run and a line."""
    return rng.uniform(0.1, 9, (n, 1)) * rng.uniform(0.1, 9, lines) * rng.uniform(0.1, 9, (test_like, 1, 1))


def gains(freq, omega, ratios):
    w = 2 * np.pi * freq
    return w**2 / (omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)[:, None] * w)


def real_least_squares(design, record):
    stacked, target = (np.concatenate([part.real, part.imag]) for part in (design, record))
    answer = np.linalg.lstsq(stacked, target, rcond=None)[0]
    return answer, np.sum((stacked @ answer - target) ** 2)


def reference(test, omega, ratios, *, velocity=False):
    """Residues (m, n, d) or with velocities (m, 2, n, d), and the squared error of each sensor in units of its std."""
    g = gains(test.freq, omega, ratios)[:, None]
    if velocity:
        g = np.concatenate([g, 2j * np.pi * test.freq / omega[:, None, None] * g], axis=1)
    design = np.einsum("kvf,rdf->rfkvd", g, test.base)
    std = np.ones(test.response.shape) if test.response_std is None else test.response_std
    found, error = [], []
    for s in range(test.n_sensors):
        rows = (design / std[:, s, :, None, None, None]).reshape(std[:, s].size, -1)
        answer, left = real_least_squares(rows, (test.relative[:, s] / std[:, s]).ravel())
        found.append(answer.reshape(design.shape[2:]))
        error.append(left)
    residues = np.moveaxis(np.array(found), 0, 2)
    return (residues if velocity else residues[:, 0]), np.array(error)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("unit", [False, True])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_residues_are_those_of_weighted_least_squares(d, unit, weighted):
    rng = np.random.default_rng(d)
    std = deviations(rng, d if unit else 3, 4, 40) if weighted else None
    test = records(rng, unit=unit, d=d, std=std)
    book = Records(test)
    assert book.unit is unit
    fit = book.fit(*POLES)
    expected, error = reference(test, *POLES)
    np.testing.assert_allclose(book.by_sensor(fit.residues), expected, rtol=1e-9, atol=1e-11)
    assert fit.squared_error == pytest.approx(error.sum(), rel=1e-9)
    assert book.size == pytest.approx(np.sum(np.abs(test.relative / (1.0 if std is None else std)) ** 2), rel=1e-12)
    residues, left = linear_residues(test, *POLES)
    np.testing.assert_array_equal(residues, book.by_sensor(fit.residues))
    assert left == pytest.approx(np.sqrt(error.sum() / book.size), rel=1e-9)


@pytest.mark.parametrize("unit", [False, True])
@pytest.mark.parametrize("d", [1, 2])
def test_velocities_are_further_inputs(d, unit):
    rng = np.random.default_rng(d)
    test = records(rng, unit=unit, d=d, std=deviations(rng, d if unit else 3, 4, 40))
    book = Records(test)
    fit = book.fit(*POLES, velocity=True)
    expected, error = reference(test, *POLES, velocity=True)
    # A unit run has one input a channel; else inputs are combinations of the directions, motions before velocities.
    inputs = fit.residues.shape[1] // 2
    assert inputs == (1 if unit else d)
    for part, at in enumerate((slice(0, inputs), slice(inputs, None))):
        np.testing.assert_allclose(book.by_sensor(fit.residues[:, at]), expected[:, part], rtol=1e-9, atol=1e-11)
    assert fit.squared_error == pytest.approx(error.sum(), rel=1e-9)


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("unit", [False, True])
def test_gain_is_what_the_error_rises_by_without_a_pole(unit, velocity):
    rng = np.random.default_rng(5)
    test = records(rng, unit=unit, std=deviations(rng, 2 if unit else 3, 4, 40))
    book, (omega, ratios) = Records(test), POLES
    fit = book.fit(omega, ratios, velocity=velocity)
    without = [
        book.fit(np.delete(omega, k), np.delete(ratios, k), velocity=velocity).squared_error for k in range(M)
    ]  # fmt: skip
    np.testing.assert_allclose(fit.gain, np.array(without) - fit.squared_error, rtol=1e-9)
    assert fit.gain == pytest.approx(np.sum(fit.whitened**2, axis=(1, 2)))


@pytest.mark.parametrize("unit", [False, True])
def test_spread_is_the_scatter_of_the_residues(unit):
    """The inverse of the design's Gram matrix, pole by pole."""
    book = Records(records(np.random.default_rng(11), unit=unit))
    fit = book.fit(*POLES)
    X = book.basis(gains(book.freq, *POLES))
    scatter = np.linalg.inv(X.T @ X)
    spread = fit.spread.reshape(-1, fit.spread.shape[2])
    np.testing.assert_allclose(spread @ spread.T, scatter, rtol=1e-8, atol=1e-12 * np.abs(scatter).max())


@pytest.mark.parametrize("unit", [False, True])
def test_one_pole_less_leaves_no_less_than_is_said(unit):
    """One alone: its gain. Of two, with nothing left by both: no pole in their place, wherever it is, leaves less."""
    rng = np.random.default_rng(12)
    test = records(rng, unit=unit)
    omega, ratios = POLES
    residues = rng.normal(size=(M, 4, 2))
    exact = np.einsum("ksd,kf,rdf->rsf", residues, gains(test.freq, *POLES), test.base)
    response = exact + test.response - test.relative
    book = Records(Measurement(test.freq, test.base, response, rigid_body=test.rigid_body))
    fit = book.fit(omega, ratios)
    for k in range(M):
        assert fit.rise_with_one_less(np.array([k])) == pytest.approx(fit.gain[k], rel=1e-9)
    said = fit.rise_with_one_less(np.array([1, 2]))
    assert 0 < said < fit.gain[[1, 2]].min()
    for place in np.linspace(0.9 * omega[1], 1.1 * omega[2], 21):
        for ratio in (0.005, 0.01, 0.02, 0.04):
            assert book.fit(np.array([omega[0], place]), np.array([ratios[0], ratio])).squared_error > said * (1 - 1e-9)


def test_whitened_residues_of_white_noise_have_unit_variance():
    rng = np.random.default_rng(6)
    test = records(rng, unit=False, n=2000)
    book = Records(test)
    book.data = rng.normal(size=book.data.shape)
    whitened = book.fit(*POLES).whitened
    for block in whitened:
        np.testing.assert_allclose(block @ block.T / block.shape[1], np.eye(2), atol=0.15)


@pytest.mark.parametrize("unit", [False, True])
def test_the_basis_is_orthonormal_and_what_is_left_is_orthogonal_to_it(unit):
    book = Records(records(np.random.default_rng(7), unit=unit))
    fit = book.fit(*POLES)
    np.testing.assert_allclose(fit.Q.T @ fit.Q, np.eye(fit.Q.shape[1]), atol=1e-12)
    np.testing.assert_allclose(fit.Q.T @ fit.left, 0.0, atol=1e-11)


class TestDependentDirections:
    """The base moves along one line in two of three directions: only what answers that line is known."""

    @pytest.fixture
    def test(self):
        rng = np.random.default_rng(8)
        base = normal(rng, 3, 3, 40)
        base[:, 1] = 2.5 * base[:, 0]
        return records(rng, unit=False, d=3, base=base)

    def test_the_answers_are_the_best_that_there_are(self, test):
        moving = independent(test.base)
        assert moving.shape == (3, 2)
        inputs = np.einsum("di,rdf->rif", moving, test.base)
        assert np.linalg.matrix_rank(np.moveaxis(inputs, 1, 0).reshape(2, -1)) == 2
        residues, left = linear_residues(test, *POLES)
        predicted = np.einsum("ksd,kf,rdf->rsf", residues, gains(test.freq, *POLES), test.base)
        _, error = reference(test, *POLES)
        assert np.linalg.norm(predicted - test.relative) ** 2 == pytest.approx(error.sum(), rel=1e-9)
        assert left == pytest.approx(np.linalg.norm(predicted - test.relative) / np.linalg.norm(test.relative))

    def test_directions_that_move_together_answer_together(self, test):
        """The least residues, each direction in units of its own motion."""
        residues, _ = linear_residues(test, *POLES)
        np.testing.assert_allclose(residues[:, :, 1] * 2.5, residues[:, :, 0], rtol=1e-9)

    def test_a_direction_at_rest_has_no_residues(self):
        rng = np.random.default_rng(9)
        base = normal(rng, 3, 2, 40)
        base[:, 1] = 0.0
        test = records(rng, unit=False, base=base)
        residues, _ = linear_residues(test, *POLES)
        np.testing.assert_array_equal(residues[:, :, 1], 0.0)
        one = Measurement(
            test.freq, base[:, :1], test.response, rigid_body=test.rigid_body[:, :1],
        )  # fmt: skip
        np.testing.assert_allclose(residues[:, :, :1], linear_residues(one, *POLES)[0], rtol=1e-9)


@pytest.mark.parametrize("unit", [False, True])
def test_what_free_residues_and_a_free_mass_leave_of_the_force(unit):
    test = records(np.random.default_rng(10), unit=unit, force=True)
    g = np.concatenate([np.ones((1, test.freq.size)), gains(test.freq, *POLES)])
    design = np.einsum("kf,rdf->rfkd", g, test.base).reshape(test.base[:, 0].size, -1)
    error = sum(real_least_squares(design, test.force[:, i].ravel())[1] for i in range(2))
    assert force_residual_left(test, *POLES) == pytest.approx(np.sqrt(error) / np.linalg.norm(test.force), rel=1e-9)
