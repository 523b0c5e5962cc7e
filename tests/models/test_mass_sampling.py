"""The sampling transform of the mass factor: its exponent by quadrature, its inverse, expression and numbers."""

import casadi as ca
import numpy as np
import pytest
import scipy.integrate

from sysid import FullMass
from sysid.models.mass import gather_rows, sampling_exponent, spread_rows
from sysid.models.model import FACTOR_FLOOR


class TestSampling:
    @pytest.mark.parametrize("k", range(1, 31))
    def test_exponent_meets_eq_19_by_quadrature(self, k):
        alpha = sampling_exponent(k)
        # y² over [-1, 1], u = 1 - |x|; the power of u is integrable whatever alpha > 0.
        integral, error = scipy.integrate.quad(lambda u: (1 - u**alpha) ** 2, 0, 1, epsabs=1e-13, epsrel=1e-13)
        assert error < 1e-9
        assert 2 * integral == pytest.approx(1 / k, rel=1e-9)

    @pytest.mark.parametrize("c", [0.3, 0.7, 1.0])
    def test_exponent_for_other_levels(self, c):
        for k in (1, 4, 9):
            alpha = sampling_exponent(k, c)
            integral, _ = scipy.integrate.quad(lambda u, a=alpha: (1 - u**a) ** 2, 0, 1)
            assert 2 * integral == pytest.approx(c / k, rel=1e-7)

    def test_every_row_has_the_same_expected_squared_norm(self):
        """E of row k is c / 2 = 1/2 by Monte Carlo: the diagonal entry has half the range and the same mean square."""
        rng, count = np.random.default_rng(0), 40000
        for k in range(1, 13):
            x = rng.uniform(-1, 1, (count, k))
            x[:, -1] = np.abs(x[:, -1])
            squares = np.sum(spread_rows(x, np.full(k, sampling_exponent(k))) ** 2, axis=1)
            assert np.mean(squares) == pytest.approx(0.5, abs=4.5 * np.std(squares) / np.sqrt(count))

    @pytest.mark.parametrize("k", [1, 2, 3, 7, 20])
    def test_spread_and_gather_are_inverse_odd_monotone_and_stay_in_the_box(self, k):
        alpha = np.array(sampling_exponent(k))
        x = np.linspace(-1, 1, 2001)
        y = spread_rows(x, alpha)
        assert (y[0], y[1000], y[-1]) == (-1, 0, 1)
        assert np.all(np.diff(y) > 0)
        np.testing.assert_allclose(y, -y[::-1], atol=1e-15)
        # 1 - |y| = (1 - |x|)^alpha loses digits only through the slope of its inverse.
        np.testing.assert_allclose(gather_rows(y, alpha), x, atol=1e-12)
        # The other way round, 1 - |x| = (1 - |y|)^(1 / alpha) is below round-off close to the bounds of long rows.
        inner = x[np.abs(x) <= 0.9]
        np.testing.assert_allclose(spread_rows(gather_rows(inner, alpha), alpha), inner, atol=1e-9)

    def test_expression_and_numbers_agree_also_a_round_off_outside(self):
        x = np.array([-1 - 1e-15, -1, -0.3, 0, 1e-9, 0.999, 1, 1 + 1e-15])
        alpha = np.array([sampling_exponent(k) for k in range(1, 9)])
        s = ca.SX.sym("s", 8)
        out = np.asarray(ca.Function("f", [s], [spread_rows(s, alpha)])(x)).ravel()
        np.testing.assert_allclose(out, spread_rows(x, alpha), atol=1e-15)
        assert np.all(np.abs(out) <= 1)

    def test_the_model_samples_row_by_row_and_keeps_the_diagonal_off_zero(self, geometry_of):
        geometry = geometry_of(np.eye(2)[[0, 0, 0]])
        (variable,) = FullMass(1.0).unknowns(geometry)
        s = ca.SX.sym("s", variable.size)
        y = np.asarray(ca.Function("f", [s], [variable.sampling(s)])(variable.lower)).ravel()
        rows, columns = np.tril_indices(5)
        assert np.all(y[rows == columns] >= FACTOR_FLOOR)
        assert np.all(y[rows == columns] < 2 * FACTOR_FLOOR)
        assert np.all(y[rows != columns] == -1)
        x = np.random.default_rng(0).uniform(0.1, 0.9, variable.size)
        y = np.asarray(ca.Function("f", [s], [variable.sampling(s)])(x)).ravel()
        expected = [1 - (1 - v) ** sampling_exponent(int(row) + 1) for v, row in zip(x, rows, strict=True)]
        np.testing.assert_allclose(y, expected, rtol=1e-12)
        np.testing.assert_allclose(variable.unsampling(y), x, rtol=1e-10)
