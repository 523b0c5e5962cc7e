"""Damping models: physical damping in the modes, Rayleigh's closed form, round trips, refusals."""

import casadi as ca
import numpy as np
import pytest

from sysid import InputError, ModalDamping, ProportionalDamping
from sysid.models.damping import physical_damping
from sysid.models.geometry import Layout

SEEDS = range(5)
LAYOUT = Layout(np.ones((4, 1)), np.ones(1, bool))


def numbers(expression):
    return np.asarray(ca.evalf(expression))


@pytest.mark.parametrize("seed", SEEDS)
def test_physical_damping_is_eq_33(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=5, d=2)
    omega, n = 2 * np.pi * s.natural_frequencies, s.n
    C = numbers(physical_damping(*(ca.DM(v) for v in (s.mass[:n, :n], s.mode_shapes, omega, s.damping_ratios))))
    inverse = np.linalg.inv(s.mode_shapes)
    expected = inverse.T @ np.diag(2 * s.damping_ratios * omega) @ inverse
    np.testing.assert_allclose(C, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_with_fewer_modes_those_left_out_are_undamped(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=5, d=2)
    omega, n, m = 2 * np.pi * s.natural_frequencies, s.n, 3
    pieces = (s.mass[:n, :n], s.mode_shapes[:, :m], omega[:m], s.damping_ratios[:m])
    C = numbers(physical_damping(*(ca.DM(v) for v in pieces)))
    modal = s.mode_shapes.T @ C @ s.mode_shapes
    expected = np.diag([*(2 * s.damping_ratios * omega)[:m], 0, 0])
    np.testing.assert_allclose(modal, expected, atol=1e-10 * expected.max())


@pytest.mark.parametrize("seed", SEEDS)
def test_rayleigh_ratios_are_those_of_alpha_M_plus_beta_K(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=1)
    alpha, beta = rng.uniform(0.1, 2), rng.uniform(1e-5, 1e-3)
    n, omega = s.n, 2 * np.pi * s.natural_frequencies
    C = alpha * s.mass[:n, :n] + beta * s.stiffness[:n, :n]
    expected = np.diag(s.mode_shapes.T @ C @ s.mode_shapes) / (2 * omega)
    model = ProportionalDamping((0, 2), (0, 1e-3))
    ratios = numbers(model.ratios(ca.DM([alpha, beta]), ca.DM(omega))).ravel()
    np.testing.assert_allclose(ratios, expected, rtol=1e-9)
    np.testing.assert_allclose(ratios, alpha / (2 * omega) + beta * omega / 2, rtol=1e-12)
    np.testing.assert_allclose(model.values(ratios, omega), [alpha, beta], rtol=1e-9)


def test_modal_ratios_are_the_unknowns():
    y = np.array([0.01, 0.02, 0.03, 0.04])
    np.testing.assert_array_equal(numbers(ModalDamping().ratios(ca.DM(y), ca.DM([1, 2, 3, 4]))).ravel(), y)
    np.testing.assert_array_equal(ModalDamping().values(y, np.arange(1.0, 5)), y)


def test_search_spaces():
    (variable,) = ModalDamping().variables(LAYOUT)
    np.testing.assert_array_equal([variable.lower, variable.upper], [[0.005] * 4, [0.05] * 4])  # eq. 38
    (variable,) = ProportionalDamping((0.1, 2), (1e-5, 1e-3)).variables(LAYOUT)
    np.testing.assert_array_equal([variable.lower, variable.upper], [[0.1, 1e-5], [2, 1e-3]])


@pytest.mark.parametrize(
    "bounds", [(0.0, 0.1), (-0.1, 0.1), (0.1, 0.1), (0.2, 0.1), (0.1, 1.0), (np.nan, 0.1), (0.1, np.nan)]
)
def test_modal_bounds_that_are_none(bounds):
    with pytest.raises(InputError, match="ModalDamping: 0 < lower < upper < 1"):
        ModalDamping(*bounds).variables(LAYOUT)


@pytest.mark.parametrize("bad", [(-1.0, 1.0), (1.0, 1.0), (2.0, 1.0), (0.0, np.inf), (np.nan, 1.0)])
def test_proportional_bounds_that_are_none(bad):
    with pytest.raises(InputError, match="alpha needs"):
        ProportionalDamping(bad, (0, 1)).variables(LAYOUT)
    with pytest.raises(InputError, match="beta needs"):
        ProportionalDamping((0, 1), bad).variables(LAYOUT)
