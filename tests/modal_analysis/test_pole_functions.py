"""Functions of poles of several runs, eliminated run by run, against designs with all columns written out."""

import numpy as np
import pytest

import sysid
from sysid.modal_analysis.pole_functions import factorised, orthonormal
from sysid.modal_analysis.residues import Records, SubsetFits
from sysid.modal_analysis.vector_fitting import _projected

POLES = 2 * np.pi * np.array([1.7, 3.1, 4.4]), np.array([0.02, 0.015, 0.03])
RATE = 20.0


@pytest.fixture(scope="module")
def test():
    """Three runs of noise of two lengths, the second at rest: 2 base directions, 3 sensors."""
    rng = np.random.default_rng(2)
    runs = [tuple(rng.standard_normal((c, samples)) for c in (2, 3)) for samples in (240, 240, 300)]
    return sysid.Measurement.from_time(
        [(base, response, None) for base, response in runs], RATE, rigid_body=rng.uniform(-1, 1, (3, 2)),
        band=(0.5, 7.0), estimator="records", at_rest=[False, True, False],
    )  # fmt: skip


def design(test, omega, ratios, velocity):
    """Columns (complex numbers of all runs, poles, inputs) from the definition, and the records beside them."""
    w = 2 * np.pi * test.freq
    g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)[:, None] * w)
    X = np.einsum("kf,rif->rfki", g, test.inputs)
    if velocity:
        X = np.concatenate([X, np.einsum("kf,rif->rfki", 1j * w / omega[:, None] * g, test.base)], axis=3)
    lines = test.own_lines
    split = lambda rows: np.concatenate([rows.real, rows.imag])  # noqa: E731
    return split(X[lines]), split(test.relative.swapaxes(1, 2)[lines])


@pytest.mark.parametrize("velocity", [False, True])
def test_the_fit_is_least_squares_on_all_columns(test, velocity):
    records = Records(test)
    assert len(test.whole.moving) == 2
    X, data = design(test, *POLES, velocity)
    flat = X.reshape(len(X), -1)
    found, *_ = np.linalg.lstsq(flat, data, rcond=None)
    fit = records.fit(*POLES, velocity=velocity)
    if not velocity:
        residues = found.reshape(3, -1, 3).swapaxes(1, 2)
        np.testing.assert_allclose(records.by_sensor(fit.residues), residues, rtol=1e-8, atol=1e-10 * abs(found).max())
    left = np.sum((data - flat @ found) ** 2)
    assert fit.squared_error == pytest.approx(left, rel=1e-10)
    without = [np.delete(X, k, axis=1).reshape(len(X), -1) for k in range(3)]
    rises = [np.linalg.lstsq(one, data, rcond=None)[1].sum() - left for one in without]
    np.testing.assert_allclose(fit.gain, rises, rtol=1e-8)
    worth, _ = SubsetFits(records, *POLES, velocity=velocity).worth(np.arange(3))
    unknowns = 3 * (fit.residues[0].size + 2)
    np.testing.assert_allclose(worth, np.array(rises) / records.noise(fit.left, unknowns), rtol=1e-7)


@pytest.mark.parametrize("velocity", [False, True])
def test_the_basis_is_orthonormal_and_factorises_the_functions(test, velocity):
    functions = Records(test).functions(*POLES, velocity=velocity)
    basis, triangle, sizes = orthonormal(functions)
    Q = basis.times(np.eye(len(triangle)))
    np.testing.assert_allclose(Q.T @ Q, np.eye(len(triangle)), atol=1e-13)
    np.testing.assert_allclose(np.tril(triangle, -1), 0, atol=1e-15)
    X = functions.dense()[:, np.concatenate(functions.places)]
    np.testing.assert_allclose(Q @ triangle * sizes, X, atol=1e-12 * np.abs(X).max())
    np.testing.assert_allclose(basis.answers(X), Q.T @ X, atol=1e-10)


@pytest.mark.parametrize("velocity", [False, True])
def test_the_step_of_all_poles_is_that_of_the_derivative_of_the_projection(test, velocity):
    """Gradient by central differences of the squared error; the matrix is Kaufman's, from columns written out."""
    records, p, h = Records(test), np.log(np.concatenate(POLES)), 1e-6
    H, slope = _projected(records, p, records.fit(*POLES, velocity=velocity), velocity)

    def error(q):
        return records.fit(np.exp(q[:3]), np.exp(q[3:]), velocity=velocity).squared_error

    differences = [(error(p + h * e) - error(p - h * e)) / (2 * h) for e in np.eye(6)]
    np.testing.assert_allclose(-2 * slope, differences, rtol=1e-5, atol=1e-5 * np.abs(differences).max())
    X, data = design(test, *POLES, velocity)
    found = np.linalg.lstsq(X.reshape(len(X), -1), data, rcond=None)[0]
    Q = np.linalg.qr(X.reshape(len(X), -1))[0]
    J = []
    for e in np.eye(6):
        above, below = (design(test, np.exp(q[:3]), np.exp(q[3:]), velocity)[0] for q in (p + h * e, p - h * e))
        change = ((above - below) / (2 * h)).reshape(len(X), -1) @ found
        J.append((change - Q @ (Q.T @ change)).ravel())
    J = np.array(J)
    np.testing.assert_allclose(H, J @ J.T, rtol=1e-5, atol=1e-6 * np.abs(H).max())


@pytest.mark.parametrize("apart", [1.0, 1e-6, 1e-12, 0.0])
def test_columns_however_close_have_an_orthonormal_basis(apart):
    """The second is so far from the first, relative: the two products alone would lose the difference from 1e-8 on."""
    A = np.random.default_rng(0).standard_normal((60, 5))
    A[:, 1] = A[:, 0] + apart * A[:, 1]
    Q, R = factorised(A)
    np.testing.assert_allclose(Q.T @ Q, np.eye(5), atol=1e-14)
    np.testing.assert_allclose(Q @ R, A, atol=1e-13)
    assert np.all(np.tril(R, -1) == 0)
    np.testing.assert_allclose(np.abs(np.diag(R)), np.abs(np.diag(np.linalg.qr(A)[1])), rtol=1e-3, atol=1e-14)


def test_other_columns_are_projected(test):
    records = Records(test)
    fit, other = records.fit(*POLES), records.functions(np.array([12.0, 25.0]), np.array([0.01, 0.02]))
    beside, products = fit.beside(other)
    X = records.functions(*POLES).dense()
    plain = other.dense()
    left = plain - X @ np.linalg.lstsq(X, plain, rcond=None)[0]
    np.testing.assert_allclose(beside.gram(), left.T @ left, atol=1e-10 * np.abs(left.T @ left).max())
    np.testing.assert_allclose(beside.squares(), np.sum(left**2, axis=0), rtol=1e-9)
    np.testing.assert_allclose(products, left.T @ records.data, atol=1e-10 * np.abs(products).max())


def test_a_short_run_of_fewer_rows_than_columns_is_fitted_wholly():
    """Against least squares on all columns written out, which takes those beyond as combinations of the others."""
    rng = np.random.default_rng(0)
    runs = [(rng.standard_normal((2, samples)), rng.standard_normal((3, samples)), None) for samples in (800, 40)]
    short = sysid.Measurement.from_time(
        runs, RATE, rigid_body=rng.uniform(-0.7, 0.7, (3, 2)), band=(0.5, 7.0), estimator="records"
    )
    omega, ratios = 2 * np.pi * np.linspace(1.0, 6.0, 15), np.full(15, 0.02)
    X, data = design(short, omega, ratios, False)
    flat = X.reshape(len(X), -1)
    left = data - flat @ np.linalg.lstsq(flat, data, rcond=None)[0]
    fit = Records(short).fit(omega, ratios)
    assert fit.squared_error == pytest.approx(np.sum(left**2), rel=1e-8)
    assert np.all(np.isfinite(fit.residues)) and np.all(fit.gain >= 0)
